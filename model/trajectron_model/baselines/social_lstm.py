"""Social LSTM: Alahi et al., "Social LSTM: Human trajectory prediction in crowded spaces" (2016).

An LSTM for each agent. At every step the hidden states of the others are summed over the cells
of a grid around it (the social tensor H, equation 1), embedded (a, equation 2), and fed to the
LSTM beside the embedded step (r and equation 3); a bivariate Gaussian comes out (equation 4).
The grid has the paper's 4 x 4 cells (a pooling size of 32 with 8 x 8 windows).

Where it differs: embeddings of 32 and a hidden state of 64, half of the paper's; displacements in
place of positions, as in `lstm`; the paper's pooling size is in pixels of each video, here the
grid is 4 m wide, which with 1 m cells is about what its figures show; Adam in place of RMSprop.

Shape letters: S samples, N agents, E ordered pairs, C cells, D hidden size.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from trajectron_model.baselines.scenes import Pairs, SceneBatch, pairs_of
from trajectron_model.baselines.stepping import State, SteppingNetwork, stepped


def grid_cell(offset: Tensor, cells: int, width_m: float) -> Tensor:
    """The cell of a grid, centred on an agent, that another one stands in.

    Args:
        offset: [..., 2] metres, from the agent to the other.
        cells: of each side.
        width_m: of each side.

    Returns:
        [...] int64: row * cells + column, rows along x; -1 outside. Cells are half-open.
    """
    place = torch.floor((offset / width_m + 0.5) * cells).long()  # [..., 2]
    inside = ((place >= 0) & (place < cells)).all(-1)
    return torch.where(inside, place[..., 0] * cells + place[..., 1], -1)


def social_tensor(
    hidden: Tensor, position: Tensor, pairs: Pairs, seen: Tensor, cells: int, width_m: float
) -> Tensor:
    """Equation 1: the hidden states of the others, summed over the cells around each agent.

    Args:
        hidden: [S, N, D].
        position: [S, N, 2] metres.
        pairs: within each scene.
        seen: [E] bool, whether both of a pair are present.
        cells, width_m: as in `grid_cell`.

    Returns:
        [S, N, C * D].
    """
    samples, agents, size = hidden.shape
    offset = position[:, pairs.sender] - position[:, pairs.receiver]  # [S, E, 2]
    # Few of a crowd's pairs are near: the rest is done for those alone.
    near = (offset.abs().amax(-1) <= 0.5 * width_m) & seen  # [S, E]
    sample, pair = near.nonzero(as_tuple=True)
    cell = grid_cell(offset[sample, pair], cells, width_m)
    inside = cell >= 0
    sample, pair, cell = sample[inside], pair[inside], cell[inside]
    target = (sample * agents + pairs.receiver[pair]) * cells**2 + cell
    total = hidden.new_zeros(samples * agents * cells**2, size)
    total = total.index_add(0, target, hidden[sample, pairs.sender[pair]])
    return total.view(samples, agents, cells**2 * size)


class SocialLstm(SteppingNetwork):
    """See the module.

    Args:
        embedding: size of an embedded displacement, and of the embedded social tensor.
        hidden: size of the hidden state.
        cells: of each side of the grid.
        grid_m: width of the grid, metres.
    """

    def __init__(
        self, embedding: int = 32, hidden: int = 64, cells: int = 4, grid_m: float = 4.0
    ) -> None:
        super().__init__(hidden)
        self.cells, self.grid_m = cells, grid_m
        self.embed = nn.Sequential(nn.Linear(2, embedding), nn.ReLU())
        self.embed_others = nn.Sequential(nn.Linear(cells**2 * hidden, embedding), nn.ReLU())
        self.cell = nn.LSTMCell(2 * embedding, hidden)

    def links(self, batch: SceneBatch) -> tuple[Tensor, ...]:
        """Every ordered pair of a scene."""
        return pairs_of(batch.scene)

    def blank(self, batch: SceneBatch, links: tuple[Tensor, ...]) -> State:
        """Hidden state and memory, zero; [1, N, D] each."""
        del links
        zero = torch.zeros(1, len(batch.scene), self.hidden_size)
        return zero, zero

    def advance(
        self,
        state: State,
        links: tuple[Tensor, ...],
        position: Tensor,
        displacement: Tensor,
        present: Tensor,
    ) -> State:
        """See `SteppingNetwork`."""
        hidden, memory = state
        pairs = Pairs(*links)
        seen = present[pairs.receiver] & present[pairs.sender]
        others = social_tensor(hidden, position, pairs, seen, self.cells, self.grid_m)
        inputs = torch.cat([self.embed(displacement), self.embed_others(others)], dim=-1)
        return stepped(self.cell, inputs, hidden, memory, present)
