"""What is to be evaluated, and how: all that defines an evaluation, as one value."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

PROTOCOLS = ("sgan", "all", "streaming", "paper")
PAPER_KDE_SAMPLES = 2000
"""Positions a step in the paper's kernel density estimates."""

MAX_SAMPLES = 2000


class PlanError(ValueError):
    """A plan that cannot be carried out; the message names the field."""


@dataclass(frozen=True)
class EvaluationPlan:
    """Which contenders are judged on which windows, with what.

    Attributes:
        entries: the rows, by name; see `contenders.resolve`.
        sets: test sets of the ETH/UCY benchmark; or empty, with ``files``.
        files: paths of recordings (ETH/UCY text or CSV), each a set named by its stem.
        protocol: ``sgan``, ``all``, ``streaming`` or ``paper``; see `protocols`.
        samples: futures drawn for each judged agent of each window.
        seed: of the samples, the jitter and the bootstrap.
        in_sample: whether a model may be judged on recordings that it has seen; its row is
            then marked.
        kde_samples: positions a step in kernel density estimates; None for 2000 under
            ``paper`` and otherwise ``samples``.
        max_windows: at most so many windows of each set: every k-th; None for all.
        jitter_m: standard deviation of Gaussian noise on observed positions, metres.
        bootstrap: resamplings behind the confidence intervals.
        frames_per_step: frame numbers between two steps of ``files`` in ETH/UCY text.
        dt_s: seconds between two steps of ``files``.

    Raises:
        PlanError: a field out of bounds.
    """

    entries: tuple[str, ...]
    sets: tuple[str, ...] = ()
    files: tuple[str, ...] = ()
    protocol: str = "sgan"
    samples: int = 100
    seed: int = 0
    in_sample: bool = False
    kde_samples: int | None = None
    max_windows: int | None = None
    jitter_m: float = 0.0
    bootstrap: int = 1000
    frames_per_step: int = 10
    dt_s: float = 0.4

    def __post_init__(self) -> None:
        if not self.entries or len(set(self.entries)) != len(self.entries):
            raise PlanError("entries must be one or more distinct names")
        if bool(self.sets) == bool(self.files):
            raise PlanError("give either sets or files")
        names = self.set_names
        if len(set(names)) != len(names):
            raise PlanError(f"sets must have distinct names; they are {', '.join(names)}")
        if self.protocol not in PROTOCOLS:
            raise PlanError(f"protocol {self.protocol!r} is none of {', '.join(PROTOCOLS)}")
        _check("samples", self.samples, 1, MAX_SAMPLES)
        _check("kde_samples", self.kde_samples, 2, MAX_SAMPLES)
        _check("seed", self.seed, 0, 2**63 - 1)
        _check("max_windows", self.max_windows, 1, 10**9)
        _check("jitter_m", self.jitter_m, 0.0, 10.0)
        _check("bootstrap", self.bootstrap, 100, 100_000)
        _check("frames_per_step", self.frames_per_step, 1, 10_000)
        _check("dt_s", self.dt_s, 0.01, 60.0)

    @property
    def set_names(self) -> tuple[str, ...]:
        """The test sets' names, in order."""
        return self.sets or tuple(Path(file).stem for file in self.files)

    @property
    def samples_in_kde(self) -> int:
        """How many positions a step go into kernel density estimates."""
        if self.kde_samples is not None:
            return self.kde_samples
        return PAPER_KDE_SAMPLES if self.protocol == "paper" else self.samples

    @property
    def samples_drawn(self) -> int:
        """How many futures are drawn for each judged agent of each window."""
        return max(self.samples, self.samples_in_kde)

    def to_json(self) -> dict[str, Any]:
        """As JSON values; the inverse of `from_json`."""
        values = dataclasses.asdict(self)
        return {k: list(v) if isinstance(v, tuple) else v for k, v in values.items()}

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> EvaluationPlan:
        """Reads `to_json`'s values.

        Raises:
            PlanError: a missing, unknown, mistyped or impossible field.
        """
        known = {f.name for f in dataclasses.fields(cls)}
        if unknown := sorted(set(values) - known):
            raise PlanError(f"unknown fields: {', '.join(unknown)}")
        fields = dict(values)
        for name in ("entries", "sets", "files"):
            texts = fields.get(name, ())
            if not isinstance(texts, list | tuple) or not all(isinstance(t, str) for t in texts):
                raise PlanError(f"{name} must be a list of texts")
            fields[name] = tuple(texts)
        for name in ("protocol", "in_sample"):
            kind = bool if name == "in_sample" else str
            if name in fields and not isinstance(fields[name], kind):
                raise PlanError(f"{name} must be a {kind.__name__}")
        return cls(**fields)


def _check(name: str, value: object, least: float, most: float) -> None:
    if value is None and name in ("kde_samples", "max_windows"):
        return
    whole = name not in ("jitter_m", "dt_s")
    kinds: tuple[type, ...] = (int,) if whole else (int, float)
    number = value if isinstance(value, int | float) and isinstance(value, kinds) else None
    if number is None or isinstance(value, bool) or not least <= number <= most:
        kind = "a whole number" if whole else "a number"
        raise PlanError(f"{name} must be {kind} from {least:g} to {most:g}; it is {value!r}")
