"""Training of the baselines: it learns, it is reproducible, it ends, it says what it did."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from trajectron_model.baselines import recipes, registry, saving
from trajectron_model.baselines.training import BaselineSettings, Batches, Validated
from trajectron_model.checkpoint import CheckpointError
from trajectron_model.data.recording import Recording
from trajectron_model.data.windows import sgan_windows
from trajectron_model.simulation import Scenario, simulate

QUICK = {
    name: replace(settings, windows=4, samples=min(2, settings.samples), threads=1)
    for name, settings in recipes.SETTINGS.items()
}


def simulated(name: str, seed: int, steps: int = 32) -> Recording:
    """A crossing of social-force walkers."""
    frames = list(itertools.islice(simulate(Scenario.CROSSING, 8, seed=seed), steps))
    ids = sorted({agent for frame in frames for agent in frame.ids}, key=int)
    rows = [
        (step, ids.index(agent), *place)
        for step, frame in enumerate(frames)
        for agent, place in zip(frame.ids, frame.positions.tolist(), strict=True)
    ]
    table = np.array(rows)
    return Recording.from_rows(
        name=name,
        dt_s=0.4,
        start_time_s=0.0,
        ids=ids,
        types=["pedestrian"] * len(ids),
        step=table[:, 0].astype(np.int64),
        agent=table[:, 1].astype(np.int64),
        position=table[:, 2:],
        source_sha256=f"{seed}" * 64,
    )


@pytest.fixture(scope="module")
def training() -> list[Recording]:
    return [simulated("first", 1), simulated("second", 2)]


@pytest.fixture(scope="module")
def validation() -> list[Recording]:
    return [simulated("third", 3)]


def run(
    name: str,
    settings: BaselineSettings,
    data: tuple[list[Recording], list[Recording]],
    folder: Path,
) -> tuple[Path, list[Validated]]:
    seen: list[Validated] = []
    path = recipes.train(
        name, settings, *data, folder, provenance={"task": "test"}, observe=seen.append
    )
    return path, seen


@pytest.mark.parametrize("name", registry.LEARNED)
def test_every_baseline_that_learns_is_trained_saved_and_loaded(
    name: str, training: list[Recording], validation: list[Recording], tmp_path: Path
) -> None:
    settings = replace(QUICK[name], validate_every=2, patience=1, rates=1, minutes=0.5)
    path, _ = run(name, settings, (training, validation), tmp_path)
    facts = saving.describe(path).provenance
    assert [one["name"] for one in facts["training"]["recordings"]] == ["first", "second"]
    assert facts["validation"]["recordings"][0]["sha256"] == "3" * 64
    assert facts["task"] == "test" and facts["outcome"] in ("converged", "reached the cap")
    windows = sgan_windows(validation[0])[:2]
    (forecast, _) = registry.load(name, path).predict(windows, num_samples=3, seed=0)
    assert forecast.samples.shape == (3, len(windows[0].judged), 12, 2)


def test_a_training_learns_and_keeps_its_best(
    training: list[Recording], validation: list[Recording], tmp_path: Path
) -> None:
    settings = replace(QUICK["lstm"], validate_every=8, patience=2, rates=1)
    path, seen = run("lstm", settings, (training, validation), tmp_path)
    assert len(seen) > 2 and seen[-1].loss < seen[0].loss - 0.5
    best = min(seen, key=lambda one: one.ade_m + 0.5 * one.fde_m)
    selected = saving.describe(path).provenance["selected"]
    assert selected["step"] == best.step == seen[-1].best_step
    assert selected["validation_figures"]["ade_m"] == pytest.approx(best.ade_m)


def test_a_training_ends_when_it_has_converged(
    training: list[Recording], validation: list[Recording], tmp_path: Path
) -> None:
    """At a learning rate of nothing no validation betters the first: two rates, two waits each."""
    settings = replace(
        QUICK["lstm"], learning_rate=0.0, validate_every=1, patience=2, rates=2, minutes=5.0
    )
    path, seen = run("lstm", settings, (training, validation), tmp_path)
    facts = saving.describe(path).provenance
    assert (len(seen), facts["steps"], facts["outcome"]) == (5, 5, "converged")
    assert facts["selected"]["step"] == 1


def test_a_training_ends_at_its_cap(
    training: list[Recording], validation: list[Recording], tmp_path: Path
) -> None:
    path, _ = run("lstm", replace(QUICK["lstm"], minutes=1e-6), (training, validation), tmp_path)
    facts = saving.describe(path).provenance
    assert (facts["steps"], facts["outcome"]) == (1, "reached the cap")


def test_the_same_seed_gives_the_same_weights(
    training: list[Recording], validation: list[Recording], tmp_path: Path
) -> None:
    settings = replace(QUICK["sgan"], learning_rate=1e-3, validate_every=2, patience=1, rates=1)
    hashes = []
    for number, seed in enumerate((5, 5, 6)):
        path, _ = run(
            "sgan", replace(settings, seed=seed), (training, validation), tmp_path / str(number)
        )
        hashes.append(saving.describe(path).sha256)
    assert hashes[0] == hashes[1] != hashes[2]


def test_batches_follow_from_seed_and_number(training: list[Recording]) -> None:
    settings = replace(QUICK["social-lstm"], agents=3)
    network, _ = recipes.begin("social-lstm", settings)
    windows = sgan_windows(training[0])
    batches, again = (Batches(windows, network, settings) for _ in range(2))
    torch.testing.assert_close(batches.batch(7).position, again.batch(7).position)
    assert batches.batch(7).position.shape[0] == 20
    assert torch.bincount(batches.batch(7).scene).max() <= 3
    other = Batches(windows, network, replace(settings, seed=1))
    assert batches.batch(7).position.shape != other.batch(7).position.shape or not torch.equal(
        batches.batch(7).position, other.batch(7).position
    )


def test_data_without_windows_are_refused(validation: list[Recording], tmp_path: Path) -> None:
    empty = [validation[0].between(0, 10)]
    for name in ("lstm", "kalman"):
        with pytest.raises(ValueError, match="no window with two agents throughout"):
            run(name, QUICK[name], (empty, validation), tmp_path)
        with pytest.raises(ValueError, match="no window with two agents throughout"):
            run(name, QUICK[name], (validation, empty), tmp_path)


def saved(folder: Path) -> Path:
    network, _ = recipes.begin("lstm", QUICK["lstm"])
    saving.save(folder / "x.y", "lstm", network, {"task": "test"})
    return folder / "x.y"


def test_files_that_do_not_belong_together_are_refused(tmp_path: Path) -> None:
    path = saved(tmp_path)
    assert registry.load("lstm", path).name == "lstm"
    with pytest.raises(CheckpointError, match="is of lstm, not of sgan"):
        registry.load("sgan", path)
    with pytest.raises(CheckpointError, match="the learned baselines are kalman"):
        registry.load("linear", path)
    weights = tmp_path / "x.y.safetensors"
    weights.write_bytes(weights.read_bytes()[:-1])
    with pytest.raises(CheckpointError, match="damaged, truncated"):
        registry.load("lstm", path)
    (tmp_path / "x.y.json").write_text("{}")
    with pytest.raises(CheckpointError, match="not the JSON of a baseline"):
        registry.load("lstm", path)
    with pytest.raises(CheckpointError, match="No such file"):
        registry.load("lstm", tmp_path / "none")
