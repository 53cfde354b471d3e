"""What comes out of a forecast: frozen, with numpy arrays in absolute positions.

Shape letters: Z modes (latent values), H horizon steps, S samples. Metres and seconds throughout.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from trajectron_client.scene import ForecastMode

Float64 = NDArray[np.float64]


def covariance_matrices(upper: Float64) -> Float64:
    """[Z, H, 2, 2] matrices of the [Z, H, 3] entries xx, xy, yy that travel."""
    return upper[..., [0, 1, 1, 2]].reshape(*upper.shape[:-1], 2, 2)  # [Z, H, 2, 2]


@dataclass(frozen=True, eq=False)
class AgentForecast:
    """One agent's futures.

    Attributes:
        id: the agent's id, as you sent it.
        type: the agent's type, as the model knows it.
        position: [2] where it was last observed.
        last_observed_time: when that was, on your clock; earlier than the forecast's
            ``reference_time`` for an agent that is out of sight.
        observations: steps at which it was seen since it (re)appeared.
        heading_known: False when it has shown no direction yet: its forecast is isotropic.
        mode_probabilities: [Z], sums to one.
        mean: [Z, H, 2] each mode's mean position; None unless asked for.
        covariance: [Z, H, 2, 2] each mode's covariance in square metres; None unless asked for.
        samples: [S, H, 2] sampled positions; None for ``mode="gmm"``. Samples of different agents
            are independent of each other given the histories.
        sample_modes: [S] the latent value each sample came from; None for ``mode="gmm"``.
    """

    id: str
    type: str
    position: Float64
    last_observed_time: float
    observations: int
    heading_known: bool
    mode_probabilities: Float64
    mean: Float64 | None
    covariance: Float64 | None
    samples: Float64 | None
    sample_modes: NDArray[np.int64] | None

    @property
    def most_probable_mode(self) -> int:
        """The latent value of the highest probability."""
        return int(self.mode_probabilities.argmax())

    def mixture_mean(self) -> Float64:
        """[H, 2] the mean over all modes at each step.

        Raises:
            ValueError: the forecast came without modes.
        """
        mean, _ = self._modes()
        mixture: Float64 = np.einsum("z,zhd->hd", self.mode_probabilities, mean)
        return mixture

    def mixture_covariance(self) -> Float64:
        """[H, 2, 2] the covariance of the whole mixture at each step.

        The law of total covariance: the mean of the modes' covariances, and the covariance of
        their means.

        Raises:
            ValueError: the forecast came without modes.
        """
        mean, covariance = self._modes()
        apart = mean - self.mixture_mean()
        spread = covariance + apart[..., :, None] * apart[..., None, :]  # [Z, H, 2, 2]
        mixture: Float64 = np.einsum("z,zhij->hij", self.mode_probabilities, spread)
        return mixture

    def _modes(self) -> tuple[Float64, Float64]:
        if self.mean is None or self.covariance is None:
            raise ValueError("this forecast has no modes; ask with include_modes=True")
        return self.mean, self.covariance


@dataclass(frozen=True, eq=False)
class Forecast:
    """A scene's futures; ``forecast["7"]`` is the agent with that id.

    Attributes:
        model: the model's name.
        model_hash: sha256 of its weights.
        mode: how the futures were drawn.
        seed: what the samples were drawn with.
        reference_time: of the frame that the forecast starts from, on your clock.
        time_offsets_s: [H] seconds after ``reference_time``, the first above zero.
        agents: the agents, in the order asked for.
        sample_semantics: how samples go together: those of different agents are independent of
            each other given the histories; those of one agent are independent
            (``"independent_agents"``) or stratified (``"independent_agents_stratified"``).
        mode_probability_floor: modes that were less probable are left out: their probability
            is zero, and their mean and covariance repeat the most probable mode's.
        num_samples: of each agent; 0 for ``mode="gmm"``.
        fewer_samples: whether they are fewer than asked for: ``allow_fewer_samples``.
    """

    model: str
    model_hash: str
    mode: ForecastMode
    seed: int
    reference_time: float
    time_offsets_s: Float64
    agents: tuple[AgentForecast, ...]
    sample_semantics: str
    mode_probability_floor: float = 0.0
    num_samples: int = 0
    fewer_samples: bool = False

    @property
    def times(self) -> Float64:
        """[H] the time of each step on your clock."""
        return self.reference_time + self.time_offsets_s

    @cached_property
    def _by_id(self) -> dict[str, AgentForecast]:
        return {agent.id: agent for agent in self.agents}

    def __getitem__(self, agent_id: str) -> AgentForecast:
        return self._by_id[agent_id]

    def __contains__(self, agent_id: object) -> bool:
        return agent_id in self._by_id

    def __iter__(self) -> Iterator[AgentForecast]:
        return iter(self.agents)

    def __len__(self) -> int:
        return len(self.agents)
