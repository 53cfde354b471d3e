"""What each judged agent scored: named columns, from which every table is made.

A column is [A], or [A, H] with a value for every horizon step; NaN where a metric is not
defined for the agent or the truth is not known.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]

_FACTS = ("window", "agent", "type", "observations")


@dataclass(frozen=True, eq=False)
class AgentScores:
    """The scores of A judged agents of some windows, window by window.

    Attributes:
        window: [A] index of the agent's window among those of its set; rising.
        agent: [A] ids.
        type: [A] types.
        observations: [A] steps at which the agent was seen since it last (re)appeared.
        columns: the metrics, [A] or [A, H].
        sample_errors: ``ade`` and ``fde`` of all samples, for boxplots: [A, Q], metres, sorted
            and cut into Q equal slices, of which the means are kept; see
            `metrics.sorted_slices`.
    """

    window: NDArray[np.int64]
    agent: NDArray[np.str_]
    type: NDArray[np.str_]
    observations: NDArray[np.int64]
    columns: Mapping[str, Float]
    sample_errors: Mapping[str, Float] = field(default_factory=dict)

    @classmethod
    def concatenate(cls, parts: Sequence[AgentScores]) -> AgentScores:
        """Those of several runs of windows, in order.

        Raises:
            ValueError: none, or parts with unequal columns.
        """
        if not parts or any(part.columns.keys() != parts[0].columns.keys() for part in parts):
            raise ValueError("one or more parts with the same columns are needed")
        facts = [np.concatenate([getattr(part, name) for part in parts]) for name in _FACTS]
        return cls(
            facts[0],
            facts[1],
            facts[2],
            facts[3],
            {
                name: np.concatenate([part.columns[name] for part in parts])
                for name in parts[0].columns
            },
            {
                name: np.concatenate([part.sample_errors[name] for part in parts])
                for name in parts[0].sample_errors
            },
        )

    def to_bytes(self) -> bytes:
        """As the content of an ``.npz`` file; nothing in it is pickled."""
        arrays = {f"fact.{name}": getattr(self, name) for name in _FACTS}
        arrays |= {f"column.{name}": column for name, column in self.columns.items()}
        arrays |= {f"errors.{name}": errors for name, errors in self.sample_errors.items()}
        stream = BytesIO()
        np.savez_compressed(stream, allow_pickle=False, **arrays)
        return stream.getvalue()

    @classmethod
    def load(cls, file: Path) -> AgentScores:
        """Reads `to_bytes`'s content from a file."""
        with np.load(file, allow_pickle=False) as arrays:
            facts = [arrays[f"fact.{name}"] for name in _FACTS]
            columns, errors = (
                {
                    name.removeprefix(kind): arrays[name]
                    for name in arrays.files
                    if name.startswith(kind)
                }
                for kind in ("column.", "errors.")
            )
        return cls(facts[0], facts[1], facts[2], facts[3], columns, errors)
