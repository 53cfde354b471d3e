"""What stratified samples gain over independent ones: best of N, and the variance of estimates.

The same model forecasts the same windows with both, under several seeds. Exactly N samples
are drawn for a best of N: parts of a larger stratified draw are not what asking for fewer gives.
ETH/UCY's test sets with the leave-one-out models, every k-th window of protocol ``sgan``;
without a data folder, a simulated crossing with the default model.

    python benchmarks/sampling.py [--data path/to/eth_ucy] [--agents 150] [--seeds 20,10]
        [--json benchmarks/results/sampling.json]
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from trajectron_model import registry
from trajectron_model.data.eth_ucy import TEST_SETS, EthUcy
from trajectron_model.data.recording import Recording
from trajectron_model.data.windows import Window, batches, sgan_windows
from trajectron_model.forecast import ForecastRequest
from trajectron_model.noise import Sampling, scene_noise
from trajectron_model.simulation import Scenario, simulate
from trajectron_model.state import SceneState
from trajectron_model.trajectron import Trajectron

COUNTS = (20, 100)
RESAMPLINGS = 2000
MAX_ROLLOUTS = 5000

Float = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Judged:
    """Windows with the state of each, and who forecasts them."""

    name: str
    model: Trajectron
    windows: Sequence[Window]
    states: Sequence[SceneState]

    @property
    def owner(self) -> NDArray[np.int64]:
        """[A] the window that each judged agent belongs to."""
        return np.repeat(np.arange(len(self.windows)), [len(w.judged) for w in self.windows])


@dataclass(frozen=True, eq=False)
class Scores:
    """Of A agents over R seeds, with one kind of sampling."""

    ade_m: Float  # [R, A] smallest over the samples
    fde_m: Float  # [R, A]
    end_m: Float  # [R, A, 2] mean of the samples at the last step


@dataclass(frozen=True)
class Gain:
    """Independent beside stratified samples on one test set, or the mean of several.

    ``low`` and ``high`` bound the gain with 95% confidence, by bootstrap over windows.
    """

    iid_m: float
    stratified_m: float
    gain: float
    low: float
    high: float


@dataclass(frozen=True)
class Row:
    """One test set and one number of samples; of errors in metres the mean over agents.

    ``variance_ratio``: of the sample mean at the last step, independent over stratified,
    median over agents: how many times more independent samples would be as exact.
    """

    set: str
    agents: int
    samples: int
    seeds: int
    min_ade: Gain
    min_fde: Gain
    variance_ratio: float


def observed(model: Trajectron, windows: Sequence[Window]) -> list[SceneState]:
    """The states after each window's frames."""
    states = [model.initial_state() for _ in windows]
    for frames in zip(*(window.frames() for window in windows), strict=True):
        states = model.step(states, frames)
    return states


def subset(windows: Sequence[Window], agents: int) -> Sequence[Window]:
    """Every k-th window, such that about so many agents are judged."""
    total = sum(len(window.judged) for window in windows)
    return windows[:: max(1, total // agents)]


def crossing(people: int, steps: int) -> Recording:
    """People on two crossing ways, simulated."""
    frames = list(islice(simulate(Scenario.CROSSING, people, seed=4), steps))
    ids = sorted({name for frame in frames for name in frame.ids})
    return Recording.from_rows(
        name="simulated crossing",
        dt_s=0.4,
        start_time_s=0.0,
        ids=ids,
        types=["pedestrian"] * len(ids),
        step=np.repeat(np.arange(steps), [len(frame.ids) for frame in frames]),
        agent=np.array([ids.index(name) for frame in frames for name in frame.ids]),
        position=np.concatenate([frame.positions for frame in frames]),
    )


def judged_sets(data: Path | None, agents: int) -> Iterator[Judged]:
    """The benchmark's sets, each with the model that has not seen it; or a simulated one."""
    if data is None:
        loaded = registry.load(registry.DEFAULT).model
        windows = subset(sgan_windows(crossing(people=12, steps=60)), agents)
        yield Judged("simulated crossing", loaded, windows, observed(loaded, windows))
        return
    recordings = EthUcy(data)
    for name in TEST_SETS:
        loaded = registry.load(f"eth_ucy-without-{name}").model
        cut = [window for found in recordings.test(name) for window in sgan_windows(found)]
        windows = subset(cut, agents)
        yield Judged(name, loaded, windows, observed(loaded, windows))


def score(judged: Judged, samples: int, seeds: int, sampling: Sampling) -> Scores:
    """Draws exactly so many samples for every agent, under each seed."""
    columns: list[list[Float]] = [[], [], []]
    for seed in range(seeds):
        parts: list[tuple[Float, Float, Float]] = []
        for batch in batches(judged.windows, MAX_ROLLOUTS // samples):
            requests = [
                ForecastRequest(
                    num_samples=samples,
                    horizon=window.horizon,
                    seed=seed,
                    step=window.now,
                    agents=window.ids,
                    sampling=sampling,
                )
                for window in batch
            ]
            first = len(parts)
            states = judged.states[first : first + len(batch)]
            for window, found in zip(batch, judged.model.forecast(states, requests), strict=True):
                assert found.samples is not None
                path = found.samples + found.position[:, None, None, :]  # [A, S, H, 2]
                error = np.linalg.norm(path - window.future()[:, None], axis=-1)  # [A, S, H]
                best = error.mean(axis=-1).min(axis=1), error[..., -1].min(axis=1)
                parts.append((*best, path[:, :, -1].mean(axis=1)))
        for column, part in zip(columns, zip(*parts, strict=True), strict=True):
            column.append(np.concatenate(part))
    return Scores(*(np.stack(column) for column in columns))


def resampled(scores: Sequence[Float], owners: Sequence[NDArray[np.int64]]) -> Float:
    """[B] means over sets of means over agents, windows drawn again within each set."""
    random = np.random.default_rng(0)
    means = []
    for values, owner in zip(scores, owners, strict=True):
        windows = int(owner[-1]) + 1
        total = np.bincount(owner, values, windows)
        count = np.bincount(owner, minlength=windows)
        drawn = random.integers(windows, size=(RESAMPLINGS, windows))
        means.append(total[drawn].sum(axis=1) / count[drawn].sum(axis=1))
    return np.mean(means, axis=0)  # type: ignore[no-any-return]


def gain(iid: Sequence[Float], other: Sequence[Float], owners: Sequence[NDArray[np.int64]]) -> Gain:
    """From errors [R, A] of each set; both kinds are resampled alike."""
    one, two = ([values.mean(axis=0) for values in kind] for kind in (iid, other))
    before, after = (float(np.mean([values.mean() for values in kind])) for kind in (one, two))
    gains = 1.0 - resampled(two, owners) / resampled(one, owners)
    low, high = np.quantile(gains, [0.025, 0.975])
    return Gain(before, after, 1.0 - after / before, float(low), float(high))


def variances(scores: Scores) -> Float:
    """[A] of the mean of the samples at the last step, square metres, both axes together."""
    return np.asarray(scores.end_m.var(axis=0, ddof=1).sum(axis=-1))


def row(
    name: str,
    samples: int,
    iid: Sequence[Scores],
    other: Sequence[Scores],
    owners: Sequence[NDArray[np.int64]],
) -> Row:
    """Of one set or of several together."""
    ratios = [variances(one) / variances(two) for one, two in zip(iid, other, strict=True)]
    return Row(
        set=name,
        agents=sum(len(owner) for owner in owners),
        samples=samples,
        seeds=len(iid[0].ade_m),
        min_ade=gain([s.ade_m for s in iid], [s.ade_m for s in other], owners),
        min_fde=gain([s.fde_m for s in iid], [s.fde_m for s in other], owners),
        variance_ratio=float(np.median(np.concatenate(ratios))),
    )


def measure(sets: Sequence[Judged], seeds: Sequence[int]) -> list[Row]:
    """Every set and number of samples, and the mean of the sets where there are several."""
    rows = []
    for samples, repeats in zip(COUNTS, seeds, strict=True):
        iid = [score(one, samples, repeats, "iid") for one in sets]
        other = [score(one, samples, repeats, "stratified") for one in sets]
        owners = [one.owner for one in sets]
        found = zip(sets, iid, other, owners, strict=True)
        rows += [row(one.name, samples, [i], [o], [own]) for one, i, o, own in found]
        if len(sets) > 1:
            rows.append(row("mean", samples, iid, other, owners))
    return rows


def drawing_us(samples: int) -> dict[Sampling, float]:
    """Microseconds of processor for the noise of one agent of 40, 12 steps: the best of 20."""
    ids = [str(agent) for agent in range(40)]
    kinds: tuple[Sampling, ...] = ("iid", "stratified")
    best: dict[Sampling, float] = dict.fromkeys(kinds, np.inf)
    for _ in range(20):
        for sampling in kinds:
            begun = time.process_time()
            scene_noise(0, ids, 0, samples, 12, sampling)
            best[sampling] = min(best[sampling], 1e6 * (time.process_time() - begun) / len(ids))
    return best


def table(rows: Sequence[Row]) -> str:
    """The rows as Markdown; gains with 95% confidence intervals."""
    columns = ["samples", "set", "agents"]
    columns += ["minADE iid", "stratified", "gain", "minFDE iid", "stratified", "gain"]
    columns += ["variance of the mean, iid / stratified"]
    lines = [f"| {' | '.join(columns)} |", "| --- " * len(columns) + "|"]
    for one in rows:
        cells = [
            f"{g.iid_m:.3f} | {g.stratified_m:.3f} | "
            f"{100 * g.gain:.1f}% ({100 * g.low:.1f} to {100 * g.high:.1f})"
            for g in (one.min_ade, one.min_fde)
        ]
        lines.append(
            f"| {one.samples} | {one.set} | {one.agents} | {' | '.join(cells)} | "
            f"{one.variance_ratio:.2f} |"
        )
    return "\n".join(lines)


def main() -> None:
    """Measures, prints and writes."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--data", type=Path, help="folder of ETH/UCY")
    parser.add_argument("--agents", type=int, default=150, help="about so many of each set")
    parser.add_argument(
        "--seeds", default="20,10", help=f"how many for {COUNTS[0]} samples, and for {COUNTS[1]}"
    )
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    with torch.inference_mode():
        sets = list(judged_sets(arguments.data, arguments.agents))
        rows = measure(sets, [int(count) for count in arguments.seeds.split(",")])
    drawing = {samples: drawing_us(samples) for samples in COUNTS}
    print(table(rows))
    for samples, of in drawing.items():
        print(
            f"\nNoise of {samples} samples: {of['iid']:.0f} us, {of['stratified']:.0f} us an agent"
        )
    if arguments.json:
        figures = {
            "about": {
                "protocol": "sgan",
                "models": "eth_ucy-without-SET" if arguments.data else registry.DEFAULT,
                "torch": torch.__version__,
            },
            "rows": [dataclasses.asdict(one) for one in rows],
            "drawing_us_per_agent": drawing,
        }
        arguments.json.write_text(json.dumps(figures, indent=1) + "\n")


if __name__ == "__main__":
    main()
