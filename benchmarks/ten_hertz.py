"""Accuracy and coverage under jitter at 10 Hz, through sessions of the service's core.

    python -m benchmarks.ten_hertz [--data path/to/eth_ucy] [--max-windows 40]
        [--json benchmarks/results/ten-hertz.json]

Every k-th window of the protocol ``sgan`` is streamed into a session of its own, once a frame
every 0.4 s and once every 0.1 s (the frames between by straight lines), with independent
Gaussian noise on every coordinate of every frame. Frames that both rates have carry the same
noise; the truth stays clean. Models are the leave-one-out ones, and means are over sets.
"""

from __future__ import annotations

import argparse
import asyncio
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from tqdm import tqdm

from trajectron_model import registry
from trajectron_model.data.eth_ucy import TEST_SETS, EthUcy
from trajectron_model.data.windows import Window
from trajectron_model.evaluation import metrics, protocols
from trajectron_model.evaluation.contenders import FAMILY
from trajectron_model.evaluation.densities import LEVELS, highest_density_regions
from trajectron_model.predictor import PositionMixture
from trajectron_service.application import Application
from trajectron_service.engine import Engine
from trajectron_service.messages import Agent, AgentForecast, ForecastOptions, Frame, SessionConfig
from trajectron_service.metrics import Metrics
from trajectron_service.settings import Settings

Float = NDArray[np.float64]
JITTER_M = (0.0, 0.02, 0.05, 0.1)
FRAMES_PER_STEP = (1, 4)
_FINEST = max(FRAMES_PER_STEP)
_SAMPLES = 100
_BEST_OF = 20


@dataclass(frozen=True)
class Figures:
    """Means over agents of one set, then over sets; metres and shares."""

    best_ade: float
    best_fde: float
    point_ade: float
    point_fde: float
    covered: tuple[float, ...]  # at LEVELS


def observed(window: Window) -> tuple[tuple[str, ...], Float]:
    """Who is seen in a window, and where in each of the finest frames: ids and [F, A, 2]."""
    agents, steps = window.recording.dense(window.first, window.first + window.observed)
    at = np.arange((window.observed - 1) * _FINEST + 1) / _FINEST
    before = np.floor(at).astype(np.int64)
    after, share = np.ceil(at).astype(np.int64), (at - before)[:, None, None]
    fine = (1.0 - share) * steps[before] + share * steps[after]
    return tuple(window.recording.ids[agent] for agent in agents.tolist()), fine


async def forecast(
    app: Application, window: Window, ids: Sequence[str], fine: Float, frames_per_step: int
) -> list[AgentForecast]:
    """The forecasts of the judged agents after a session has seen the window at that rate."""
    interval_s = window.recording.dt_s / frames_per_step
    session = await app.create_session(None, SessionConfig(frame_interval_s=interval_s))
    for number, places in enumerate(fine[:: _FINEST // frames_per_step]):
        agents = tuple(
            Agent(name, "pedestrian", float(x), float(y))
            for name, (x, y) in zip(ids, places, strict=True)
            if not np.isnan(x)
        )
        await app.observe(session.id, (Frame(number * interval_s, agents),), None)
    options = ForecastOptions(
        num_samples=_SAMPLES, seed=window.first, agents=window.ids, include_modes=True
    )
    found = await app.predict_session(session.id, options, None)
    await app.delete_session(session.id)
    by_id = {agent.id: agent for agent in found.agents}
    return [by_id[name] for name in window.ids]


def errors(found: Sequence[AgentForecast], truth: Float, random: np.random.Generator) -> Float:
    """[A, 4 + levels] what `Figures` holds, of each agent."""
    place = np.array([(agent.x, agent.y) for agent in found])  # [A, 2]
    drawn = np.stack([a.samples for a in found if a.samples is not None], axis=1)
    samples = place[:, None] + drawn  # [S, A, H, 2]
    mixture = PositionMixture(
        np.stack([a.mode_probabilities for a in found]).astype(np.float64),
        place[:, None, None] + np.stack([a.mean for a in found if a.mean is not None]),
        np.stack([a.covariance for a in found if a.covariance is not None]).astype(np.float64),
    )
    point = (mixture.probability[:, :, None, None] * mixture.mean).sum(axis=1)
    distance, off = metrics.displacement(samples, truth), metrics.displacement(point, truth)
    covered = highest_density_regions(mixture, truth, random).covered  # [L, A, H]
    return np.column_stack(
        [
            metrics.best_of(metrics.average_displacement(distance), _BEST_OF),
            metrics.best_of(metrics.final_displacement(distance), _BEST_OF),
            metrics.average_displacement(off),
            metrics.final_displacement(off),
            covered.mean(axis=2).T,
        ]
    )


async def judge(
    test_set: str, windows: Sequence[Window], jitter_m: float, frames_per_step: int
) -> Float:
    """[4 + levels] means over the judged agents of a set."""
    settings = Settings(warm_up=False, live_accuracy=False)
    model = registry.load(FAMILY.format(test_set=test_set))
    app = Application(settings, Engine([model]), Metrics())
    rows = []
    try:
        for number, window in enumerate(windows):
            random = np.random.default_rng([number, *test_set.encode()])
            ids, fine = observed(window)
            fine = fine + random.normal(0.0, jitter_m, fine.shape)
            found = await forecast(app, window, ids, fine, frames_per_step)
            rows.append(errors(found, window.future(), random))
    finally:
        await app.close()
    mean: Float = np.concatenate(rows).mean(axis=0)
    return mean


def main() -> None:
    """Measures and prints."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path)
    parser.add_argument("--max-windows", type=int, default=40)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    benchmark = EthUcy(arguments.data)
    windows = {
        name: protocols.thinned(
            protocols.windows("sgan", benchmark.test(name)), arguments.max_windows
        )[0]
        for name in TEST_SETS
    }
    rows: dict[str, Figures] = {}
    plan = [(jitter, rate) for jitter in JITTER_M for rate in FRAMES_PER_STEP]
    levels = "/".join(f"{100 * level:.0f}" for level in LEVELS)
    print(f"| jitter, rate | best of {_BEST_OF} | point | covered, {levels}% |")
    print("| --- | --- | --- | --- |")
    for jitter_m, rate in tqdm(plan, unit=" rows"):
        of_sets = [asyncio.run(judge(name, windows[name], jitter_m, rate)) for name in TEST_SETS]
        mean = np.mean(of_sets, axis=0).tolist()
        one = Figures(mean[0], mean[1], mean[2], mean[3], tuple(mean[4:]))
        name = f"{100 * jitter_m:g} cm, {rate / 0.4:g} Hz"
        rows[name] = one
        shares = "/".join(f"{100 * share:.0f}" for share in one.covered)
        tqdm.write(
            f"| {name} | {one.best_ade:.3f}/{one.best_fde:.3f} | "
            f"{one.point_ade:.3f}/{one.point_fde:.3f} | {shares} |"
        )
    if arguments.json:
        told = {
            "windows": {name: len(found) for name, found in windows.items()},
            "samples": _SAMPLES,
            "rows": {name: asdict(one) for name, one in rows.items()},
        }
        arguments.json.write_text(json.dumps(told, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
