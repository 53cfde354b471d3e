"""``trajectron train-baseline`` on a benchmark in small: from recordings to a baseline's files."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from trajectron_model.baselines import registry, saving
from trajectron_service.cli import main

STEPS = 46


@pytest.fixture(scope="module")
def benchmark(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two recordings of three walkers; ETH is the street, so its training is the park."""
    folder = tmp_path_factory.mktemp("benchmark")
    random = np.random.default_rng(0)
    for name in ("street", "park"):
        steps = random.normal([0.5, 0.0], 0.05, size=(STEPS, 3, 2))
        walks = np.cumsum(steps, axis=0) + np.arange(3)[:, None] * [0.0, 1.0]
        rows = [
            f"{10 * step}\t{agent + 1}\t{x:.4f}\t{y:.4f}\n"
            for step, scene in enumerate(walks.tolist())
            for agent, (x, y) in enumerate(scene)
        ]
        (folder / f"{name}.txt").write_text("".join(rows))
    source = {"rows": STEPS * 3, "agents": 3, "first_frame": 0}
    source |= {"validation_starts_at_frame": 230}
    splits = {
        "seconds_per_frame": 0.04,
        "frames_per_step": 10,
        "recordings": {"street": source, "park": source},
        "test_sets": {"eth": ["street"]},
        "training": {"eth": ["park"]},
    }
    (folder / "splits.json").write_text(json.dumps(splits))
    return folder


def run(*arguments: str | Path) -> int:
    with pytest.raises(SystemExit) as end:
        main([str(argument) for argument in ("train-baseline", *arguments)])
    return int(end.value.code or 0)


@pytest.mark.parametrize("name", ["lstm", "kalman"])
def test_a_baseline_is_trained_and_can_be_loaded(
    name: str, benchmark: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    where = ("--data", benchmark, "--out", tmp_path, "--threads", "1")
    assert run(name, "--eth-ucy", "eth", "--minutes", "0.01", *where) == 0
    assert f"{tmp_path / 'baseline'}.json: " in capsys.readouterr().out
    facts = saving.describe(tmp_path / "baseline").provenance
    assert facts["training"]["recordings"][0]["name"] == "park"
    assert facts["task"].endswith("but test set eth") and "licence" in facts
    assert registry.load(name, tmp_path / "baseline").name == name


def test_all_recordings_can_be_learned_from(benchmark: Path, tmp_path: Path) -> None:
    assert run("kalman", "--eth-ucy", "all", "--data", benchmark, "--out", tmp_path) == 0
    facts = saving.describe(tmp_path / "baseline").provenance
    assert {one["name"] for one in facts["training"]["recordings"]} == {"street", "park"}


def test_what_learns_nothing_cannot_be_trained(
    benchmark: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("linear", "--eth-ucy", "eth", "--data", benchmark, "--out", tmp_path) == 2
    assert "the baselines that learn are kalman, lstm" in capsys.readouterr().err
