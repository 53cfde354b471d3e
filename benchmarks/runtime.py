"""Times 200 samples for all agents of a scene, ours beside its rivals (the paper's Table 2).

Scenes are instants of the benchmark's recordings, spread evenly over those of the protocol
``paper``; everyone in sight is forecast, 12 steps ahead. One thread; every contender is timed
in the same run, in turn, so that what slows the machine slows all. Ours is timed as the service
runs it: the state of the scene is at hand, one frame is observed, then all are forecast; a row
beside it starts from 8 bare frames. Social GAN keeps no state and always starts from them.

    python -m benchmarks.runtime --data path/to/eth_ucy [--scenes 12] [--repeats 5] [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import platform
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from tqdm import tqdm

from trajectron_model import registry
from trajectron_model.data.eth_ucy import TEST_SETS, EthUcy
from trajectron_model.data.recording import Recording
from trajectron_model.data.windows import Window
from trajectron_model.evaluation.contenders import FAMILY, resolve
from trajectron_model.forecast import ForecastRequest
from trajectron_model.predictor import Predictor
from trajectron_model.trajectron import Trajectron

VERSION = 2
"""Of what is timed: a change to it, or to the code's speed, makes timings kept before useless."""

SAMPLES, OBSERVED, HORIZON = 200, 8, 12
CHUNK_STEPS = 100
REFERENCE = "Social GAN, one batched call"
BASELINES = {
    "sgan": "Social GAN",
    "social-attention": "Social Attention",
    "social-lstm": "Social LSTM",
    "lstm": "LSTM",
    "linear": "Linear",
    "kalman": "Kalman filter",
    "constant-velocity-noise": "constant velocity with noise",
}

Mode = Literal["full", "z_best", "gmm"]
_MODES: dict[Mode, str] = {"full": "Full", "z_best": "z_best", "gmm": "gmm (no samples)"}

Call = Callable[[], object]
Prepare = Callable[[Window], Call]
"""Makes ready for a scene, off the clock; what it gives is timed."""


@dataclass(frozen=True)
class Timing:
    """Seconds for a scene's samples: the mean over a set's scenes, once for each repeat.

    Attributes:
        median_s, low_s, high_s: median, least and largest of the repeats.
        ratio: seconds over those of `REFERENCE` in the same repeat, median; None without it.
        ratio_low, ratio_high: least and largest.
    """

    median_s: float
    low_s: float
    high_s: float
    ratio: float | None
    ratio_low: float | None
    ratio_high: float | None


@dataclass(frozen=True)
class SetTimings:
    """The timings of one set's scenes."""

    test_set: str
    scenes: int
    mean_agents: float
    timings: Mapping[str, Timing]
    missing: Mapping[str, str]

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> SetTimings:
        """Reads the values of `dataclasses.asdict`."""
        timings = {name: Timing(**one) for name, one in values["timings"].items()}
        return cls(**{**values, "timings": timings})


class _Contenders(NamedTuple):
    ready: dict[str, Prepare]
    missing: dict[str, str]


def scenes(recordings: Sequence[Recording], count: int) -> list[Window]:
    """Instants at which somebody is in sight, with all in sight to be forecast.

    The instants of the protocol ``paper`` (every 8th step of each chunk of 100), of which
    ``count`` are taken, evenly spread.
    """
    found = []
    for recording in recordings:
        last = recording.num_steps - HORIZON
        for step in range(OBSERVED - 1, last):
            if step % CHUNK_STEPS % OBSERVED != OBSERVED - 1:
                continue
            agents = recording.agent[recording.rows(step, step + 1)]
            if len(agents):
                found.append(
                    Window(recording, step - OBSERVED + 1, OBSERVED, HORIZON, np.unique(agents))
                )
    if not found:
        raise ValueError("no scene: the recordings are too short")
    picked = np.unique(np.linspace(0, len(found) - 1, count).round().astype(int))
    return [found[index] for index in picked.tolist()]


def contenders(model: Trajectron, test_set: str, wanted: Sequence[str]) -> _Contenders:
    """All that is timed on a set, the reference first; and what is not, with the reason.

    Args:
        model: ours.
        test_set: which learned baselines were not trained on.
        wanted: baselines, keys of `BASELINES`.
    """
    ready: dict[str, Prepare] = {}
    missing: dict[str, str] = {}
    for name in wanted:
        try:
            predictor = resolve(name, test_set).predictor
        except ValueError as error:  # a ContenderError or a CheckpointError, by their base
            missing[BASELINES[name]] = str(error)
            continue
        if name == "sgan":
            ready[REFERENCE] = _whole(predictor)
            ready["Social GAN, 200 calls of one sample"] = _one_by_one(predictor)
        else:
            ready[BASELINES[name]] = _whole(predictor)
    for mode, named in _MODES.items():
        ready[f"Trajectron, {named}"] = _online(model, mode)
    ready["Trajectron, Full, from 8 frames"] = _from_frames(model)
    return _Contenders(ready, missing)


def _online(model: Trajectron, mode: Mode) -> Prepare:
    request = ForecastRequest(mode=mode, num_samples=SAMPLES, horizon=HORIZON)

    def prepare(window: Window) -> Call:
        *before, newest = window.frames()
        state = model.initial_state()
        for frame in before:
            (state,) = model.step([state], [frame])

        def call() -> object:
            return model.forecast(model.step([state], [newest]), [request])

        return call

    return prepare


def _from_frames(model: Trajectron) -> Prepare:
    request = ForecastRequest(num_samples=SAMPLES, horizon=HORIZON)

    def prepare(window: Window) -> Call:
        frames = window.frames()

        def call() -> object:
            state = model.initial_state()
            for frame in frames:
                (state,) = model.step([state], [frame])
            return model.forecast([state], [request])

        return call

    return prepare


def _whole(predictor: Predictor) -> Prepare:
    return lambda window: lambda: predictor.predict([window], num_samples=SAMPLES, seed=0)


def _one_by_one(predictor: Predictor) -> Prepare:
    return lambda window: (
        lambda: [predictor.predict([window], num_samples=1, seed=n) for n in range(SAMPLES)]
    )


def measure(
    windows: Sequence[Window],
    ready: Mapping[str, Prepare],
    repeats: int,
    progress: Callable[[], object] = lambda: None,
) -> dict[str, Timing]:
    """Times every contender on every scene, in turn, after a warm-up.

    Args:
        windows: the scenes.
        ready: the contenders; `REFERENCE` among them gives the ratios.
        repeats: how often.
        progress: called after each scene.
    """
    calls = [{name: prepare(window) for name, prepare in ready.items()} for window in windows]
    seconds = {name: np.zeros((repeats, len(windows))) for name in ready}
    for call in calls[0].values():
        call()
    for repeat in range(repeats):
        for scene, by_name in enumerate(calls):
            for name, call in by_name.items():
                begun = time.perf_counter()
                call()
                seconds[name][repeat, scene] = time.perf_counter() - begun
            progress()
    means = {name: found.mean(axis=1) for name, found in seconds.items()}  # [repeats]
    return {name: _timing(found, means.get(REFERENCE)) for name, found in means.items()}


def _timing(seconds: np.ndarray[Any, Any], reference: np.ndarray[Any, Any] | None) -> Timing:
    found = seconds.tolist()
    ratios = [] if reference is None else (seconds / reference).tolist()
    return Timing(
        statistics.median(found),
        min(found),
        max(found),
        statistics.median(ratios) if ratios else None,
        min(ratios, default=None),
        max(ratios, default=None),
    )


def measure_set(
    test_set: str,
    recordings: Sequence[Recording],
    model: Trajectron,
    *,
    scene_count: int,
    repeats: int,
    wanted: Sequence[str] = tuple(BASELINES),
    progress: Callable[[], object] = lambda: None,
) -> SetTimings:
    """The timings of one set's scenes; see `measure` and `contenders`."""
    windows = scenes(recordings, scene_count)
    found = contenders(model, test_set, wanted)
    with torch.inference_mode():
        timings = measure(windows, found.ready, repeats, progress)
    agents = statistics.fmean(len(window.judged) for window in windows)
    return SetTimings(test_set, len(windows), agents, timings, found.missing)


def about(threads: int, repeats: int) -> dict[str, Any]:
    """What the figures were measured on and how."""
    return {
        "samples": SAMPLES,
        "horizon_steps": HORIZON,
        "threads": threads,
        "repeats": repeats,
        "torch": torch.__version__,
        "processor": processor(),
    }


def processor() -> str:
    """The processor's name, where the system tells it."""
    info = Path("/proc/cpuinfo")
    if info.exists():
        for line in info.read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def table(found: Sequence[SetTimings]) -> str:
    """The figures as Markdown: seconds a scene, and the ratio to the reference."""
    names = list(dict.fromkeys(name for one in found for name in one.timings))
    lines = [
        "| seconds a scene | " + " | ".join(one.test_set for one in found) + " |",
        "| --- |" + " --- |" * len(found),
        "| mean agents | " + " | ".join(f"{one.mean_agents:.1f}" for one in found) + " |",
    ]
    for name in names:
        cells = []
        for one in found:
            timing = one.timings.get(name)
            if timing is None:
                cells.append("-")
                continue
            ratio = "" if timing.ratio is None else f", x{timing.ratio:.2f}"
            cells.append(
                f"{timing.median_s:.3g} ({timing.low_s:.3g} to {timing.high_s:.3g}{ratio})"
            )
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    for name, why in {k: v for one in found for k, v in one.missing.items()}.items():
        lines.append(f"\n{name} is missing: {why}")
    return "\n".join(lines)


def main() -> None:
    """Measures, prints and writes."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--data", type=Path, help="default: TRAJECTRON_DATA")
    parser.add_argument("--sets", default=",".join(TEST_SETS))
    parser.add_argument("--scenes", type=int, default=12, help="of each set")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    data = EthUcy(arguments.data)
    names = arguments.sets.split(",")
    with tqdm(total=len(names) * arguments.scenes * arguments.repeats, unit=" scenes") as bar:
        found = [
            measure_set(
                name,
                data.test(name),
                our_model(name),
                scene_count=arguments.scenes,
                repeats=arguments.repeats,
                progress=bar.update,
            )
            for name in names
        ]
    print(table(found))
    if arguments.json:
        figures = {
            "about": about(arguments.threads, arguments.repeats),
            "sets": [asdict(one) for one in found],
        }
        arguments.json.write_text(json.dumps(figures, indent=1) + "\n")


def our_model(test_set: str) -> Trajectron:
    """The bundled model that was trained without the set."""
    return registry.load(FAMILY.format(test_set=test_set)).model


if __name__ == "__main__":
    main()
