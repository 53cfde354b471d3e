"""What is judged: test sets with their recordings and windows, and their fingerprints."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from trajectron_model.data.eth_ucy import EthUcy
from trajectron_model.data.readers import read
from trajectron_model.data.recording import Recording
from trajectron_model.data.windows import Window
from trajectron_model.evaluation import protocols
from trajectron_model.evaluation.plan import EvaluationPlan, PlanError
from trajectron_model.evaluation.results import SetFingerprint


@dataclass(frozen=True)
class TestSet:
    """Recordings to judge on, and the windows that are judged.

    Attributes:
        name: of the set.
        recordings: as they were read.
        windows: as the plan has them cut, thinned and jittered.
        every_nth: 1 where all windows were kept, k for every k-th.
    """

    name: str
    recordings: tuple[Recording, ...]
    windows: tuple[Window, ...]
    every_nth: int

    @property
    def agents(self) -> int:
        """Judged agents over all windows."""
        return sum(len(window.judged) for window in self.windows)


def load(plan: EvaluationPlan, data: Path | None) -> list[TestSet]:
    """The test sets of a plan.

    Args:
        plan: names sets or files.
        data: the benchmark's folder; see `eth_ucy.find_folder`.

    Raises:
        PlanError: an unknown set, one without windows, or sets of unequal dt.
        DataError: a file that is missing or damaged.
    """
    found: dict[str, tuple[Recording, ...]]
    if plan.files:
        found = {
            Path(file).stem: (read(file, dt_s=plan.dt_s, frames_per_step=plan.frames_per_step),)
            for file in plan.files
        }
    else:
        benchmark = EthUcy(data)
        unknown = [name for name in plan.sets if name not in benchmark.test_sets]
        if unknown:
            known = ", ".join(benchmark.test_sets)
            raise PlanError(f"sets: unknown: {', '.join(unknown)}; the test sets are {known}")
        found = {name: tuple(benchmark.test(name)) for name in plan.sets}
    dts_s = {recording.dt_s for recordings in found.values() for recording in recordings}
    if len(dts_s) != 1:
        raise PlanError(f"the sets' steps must have one length; they have {sorted(dts_s)} s")
    return [_test_set(plan, name, recordings) for name, recordings in found.items()]


def _test_set(plan: EvaluationPlan, name: str, recordings: tuple[Recording, ...]) -> TestSet:
    every = protocols.windows(plan.protocol, recordings)
    if not every:
        raise PlanError(f"{name} has no window of the protocol {plan.protocol}")
    kept, every_nth = protocols.thinned(every, plan.max_windows)
    windows = protocols.jittered(kept, plan.jitter_m, plan.seed)
    return TestSet(name, recordings, tuple(windows), every_nth)


def fingerprint(test_set: TestSet) -> SetFingerprint:
    """What a set's scores are of."""
    data, cut = hashlib.sha256(), hashlib.sha256()
    for recording in test_set.recordings:
        head = (recording.name, *recording.ids, *recording.types)
        times = (recording.dt_s, recording.start_time_s, recording.num_steps)
        data.update(repr((head, times)).encode())
        for array in (recording.step, recording.agent, recording.position):
            data.update(np.ascontiguousarray(array).tobytes())
    for window in test_set.windows:
        place = (window.recording.name, window.first, window.observed, window.horizon, window.ids)
        cut.update(repr(place).encode())
        if window.in_best_of is not None:
            cut.update(window.in_best_of.tobytes())
    return SetFingerprint(
        test_set.name,
        tuple(recording.name for recording in test_set.recordings),
        data.hexdigest(),
        cut.hexdigest(),
        len(test_set.windows),
        test_set.agents,
        _in_best_of(test_set.windows),
    )


def _in_best_of(windows: Sequence[Window]) -> int:
    return sum(
        len(window.judged) if window.in_best_of is None else int(window.in_best_of.sum())
        for window in windows
    )
