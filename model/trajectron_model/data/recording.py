"""A recording: who was where at each step of a regular time grid.

Shape letters: R rows (one agent at one step), A agents, T steps.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from trajectron_model.state import SceneFrame

Part = Literal["whole", "training", "validation"]


@dataclass(frozen=True, eq=False)
class Recording:
    """One scene over time, sparse: a row for each agent at each step it was seen.

    Rows are sorted by step, then by agent. Steps without rows exist: nobody was there.
    Arrays are shared between recordings and must not be written to.

    Attributes:
        name: of the recording, unique within its data set.
        dt_s: seconds between two steps.
        start_time_s: time of step 0, seconds, any origin.
        ids: [A] the agents' ids, unique.
        types: [A] the agents' types, such as ``pedestrian``.
        step: [R] index of the step, from 0 to ``num_steps - 1``.
        agent: [R] index into ``ids`` and ``types``.
        position: [R, 2] metres, world-fixed.
        num_steps: steps in the recording, empty ones included.
        source_sha256: hash of the file it was read from; empty where it was not read from one.
        part: which part of its file it is.
    """

    name: str
    dt_s: float
    start_time_s: float
    ids: tuple[str, ...]
    types: tuple[str, ...]
    step: NDArray[np.int64]
    agent: NDArray[np.int64]
    position: NDArray[np.float64]
    num_steps: int
    source_sha256: str = ""
    part: Part = "whole"

    @classmethod
    def from_rows(
        cls,
        *,
        name: str,
        dt_s: float,
        start_time_s: float,
        ids: Sequence[str],
        types: Sequence[str],
        step: NDArray[np.int64],
        agent: NDArray[np.int64],
        position: NDArray[np.float64],
        num_steps: int | None = None,
        source_sha256: str = "",
    ) -> Recording:
        """A recording of rows in any order.

        Args:
            ids, types: [A] of the agents.
            step, agent, position: [R], [R], [R, 2] as in the class.
            num_steps: None for one more than the last step that has a row.

        Raises:
            ValueError: shapes or indices that do not fit, an id or a row that occurs twice.
        """
        rows = np.lexsort((agent, step))
        if num_steps is None:
            num_steps = int(step.max()) + 1 if len(step) else 0
        recording = cls(
            name=name,
            dt_s=dt_s,
            start_time_s=start_time_s,
            ids=tuple(ids),
            types=tuple(types),
            step=step[rows].astype(np.int64, copy=False),
            agent=agent[rows].astype(np.int64, copy=False),
            position=np.ascontiguousarray(position[rows], dtype=np.float64),
            num_steps=num_steps,
            source_sha256=source_sha256,
        )
        recording._check()
        return recording

    def _check(self) -> None:
        rows = len(self.step)
        if self.agent.shape != (rows,) or self.position.shape != (rows, 2):
            raise ValueError("step, agent and position must have one row each")
        if len(self.types) != len(self.ids) or len(set(self.ids)) != len(self.ids):
            raise ValueError("ids must be unique, with one type each")
        if rows == 0:
            return
        if self.step[0] < 0 or self.step[-1] >= self.num_steps:
            raise ValueError("steps must lie in 0 .. num_steps - 1")
        if self.agent.min() < 0 or self.agent.max() >= len(self.ids):
            raise ValueError("agents must be indices into ids")
        if np.any((np.diff(self.step) == 0) & (np.diff(self.agent) == 0)):
            raise ValueError("an agent has two rows at one step")

    @cached_property
    def _first_row(self) -> NDArray[np.int64]:
        """[num_steps + 1] the first row of each step, and the number of rows."""
        steps = np.arange(self.num_steps + 1)
        return np.searchsorted(self.step, steps).astype(np.int64, copy=False)

    def rows(self, first: int = 0, last: int | None = None) -> slice:
        """The rows of steps ``first`` to ``last - 1`` (``last`` None: to the end).

        Raises:
            IndexError: steps outside of the recording.
        """
        last = self.num_steps if last is None else last
        if not 0 <= first <= last <= self.num_steps:
            raise IndexError(f"steps {first}..{last} are outside of 0..{self.num_steps}")
        return slice(int(self._first_row[first]), int(self._first_row[last]))

    def time_s(self, step: int) -> float:
        """Time of a step, seconds, on the recording's own clock."""
        return self.start_time_s + step * self.dt_s

    def frame(self, step: int) -> SceneFrame:
        """The scene at one step, as the model's ``step`` takes it."""
        # Imported here, so that recordings are read and written without loading torch.
        from trajectron_model.state import SceneFrame  # noqa: PLC0415

        rows = self.rows(step, step + 1)
        agents = self.agent[rows].tolist()
        return SceneFrame(
            time_s=self.time_s(step),
            ids=tuple(self.ids[agent] for agent in agents),
            types=tuple(self.types[agent] for agent in agents),
            positions=self.position[rows],
        )

    def between(self, first: int, last: int) -> Recording:
        """Steps ``first`` to ``last - 1`` as a recording of their own.

        Its steps count from 0 again; times stay; agents not seen in them are left out.

        Raises:
            IndexError: steps outside of the recording.
        """
        rows = self.rows(first, last)
        kept, agent = np.unique(self.agent[rows], return_inverse=True)
        return replace(
            self,
            start_time_s=self.time_s(first),
            ids=tuple(self.ids[index] for index in kept),
            types=tuple(self.types[index] for index in kept),
            step=self.step[rows] - first,
            agent=agent.astype(np.int64, copy=False),
            position=self.position[rows],
            num_steps=last - first,
        )

    def dense(
        self, first: int = 0, last: int | None = None
    ) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Steps ``first`` to ``last - 1`` as arrays (``last`` None: to the end).

        Returns:
            agents: [A'] indices of those seen in these steps, ascending.
            positions: [T, A', 2] metres, NaN where an agent is absent.

        Raises:
            IndexError: steps outside of the recording.
        """
        last = self.num_steps if last is None else last
        rows = self.rows(first, last)
        agents, column = np.unique(self.agent[rows], return_inverse=True)
        positions = np.full((last - first, len(agents), 2), np.nan)  # [T, A', 2]
        positions[self.step[rows] - first, column] = self.position[rows]
        return agents.astype(np.int64, copy=False), positions

    @property
    def provenance(self) -> dict[str, str]:
        """What a checkpoint records of a recording it was trained or selected on."""
        return {"name": self.name, "part": self.part, "sha256": self.source_sha256}
