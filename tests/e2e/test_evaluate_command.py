"""``trajectron evaluate`` on a benchmark in small, with a model from a checkpoint."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from trajectron_model import checkpoint
from trajectron_model.config import ModelConfig
from trajectron_model.data.eth_ucy import EthUcy
from trajectron_model.trajectron import Trajectron
from trajectron_service.cli import main

STEPS = 23
AGENTS = 3


@pytest.fixture(scope="module")
def benchmark(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two recordings, each a test set of its own: three walkers side by side."""
    folder = tmp_path_factory.mktemp("benchmark")
    rng = np.random.default_rng(0)
    for name in ("street", "park"):
        steps = rng.normal([0.5, 0.0], 0.05, size=(STEPS, AGENTS, 2))
        walks = np.cumsum(steps, axis=0) + np.arange(AGENTS)[:, None] * [0.0, 1.0]
        rows = [
            f"{10 * step}\t{agent + 1}\t{x:.4f}\t{y:.4f}\n"
            for step, scene in enumerate(walks.tolist())
            for agent, (x, y) in enumerate(scene)
        ]
        (folder / f"{name}.txt").write_text("".join(rows))
    source = {"rows": STEPS * AGENTS, "agents": AGENTS}
    source |= {"first_frame": 0, "validation_starts_at_frame": 200}
    splits = {
        "seconds_per_frame": 0.04,
        "frames_per_step": 10,
        "recordings": {"street": source, "park": source},
        "test_sets": {"street": ["street"], "park": ["park"]},
        "training": {"street": ["park"], "park": ["street"]},
    }
    (folder / "splits.json").write_text(json.dumps(splits))
    return folder


@pytest.fixture(scope="module")
def model(benchmark: Path, tmp_path_factory: pytest.TempPathFactory) -> str:
    """A small model that says it was trained on the park."""
    torch.manual_seed(0)
    config = ModelConfig(decoder_size=16, latent_values=4, mixture_components=3)
    data = EthUcy(benchmark)
    provenance = {
        "training": {"recordings": [one.provenance for one in data.training("street")]},
        "validation": {"recordings": [one.provenance for one in data.validation("street")]},
    }
    path = tmp_path_factory.mktemp("models") / "small"
    checkpoint.save(path, Trajectron(config), provenance)
    return str(path)


def run(*arguments: str) -> int:
    """The exit status of ``trajectron evaluate``."""
    with pytest.raises(SystemExit) as left:
        main(["evaluate", *arguments])
    return int(left.value.code or 0)


def test_a_model_and_constant_velocity_are_judged_side_by_side(
    benchmark: Path, model: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "result.json"
    arguments = ["--data", str(benchmark), "--sets", "street", "--model", model]
    assert run(*arguments, "--samples", "5", "--seed", "3", "--json", str(file)) == 0
    printed = capsys.readouterr().out
    content = json.loads(file.read_text())
    assert "5 samples, independent unless a row says stratified, seed 3" in printed
    assert "4 / 12" in printed  # windows and judged agents
    baseline, judged = content["rows"]
    assert (baseline["name"], judged["name"]) == ("constant-velocity", model)
    assert judged["sets"][0]["model_sha256"] == checkpoint.Checkpoint.load(model).sha256
    assert judged["in_sample"] is False
    for row in (baseline, judged):
        ade, fde = (row["mean"]["metrics"][name]["value"] for name in ("ade_mean", "fde_mean"))
        assert f"{ade:.3f}/{fde:.3f}" in printed
    assert run(*arguments, "--samples", "5", "--seed", "3", "--json", str(file)) == 0
    assert json.loads(file.read_text()) == content


def test_a_run_is_kept_and_goes_on_in_its_folder(
    benchmark: Path, model: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    work, table = tmp_path / "work", tmp_path / "result.csv"
    arguments = ["--data", str(benchmark), "--sets", "street", "--model", model, "--samples", "5"]
    arguments += ["--work", str(work), "--csv", str(table)]
    assert run(*arguments) == 0
    first = capsys.readouterr().out
    shards = {file: file.stat().st_mtime_ns for file in (work / "shards").iterdir()}
    assert run(*arguments) == 0
    assert capsys.readouterr().out == first
    assert {file: file.stat().st_mtime_ns for file in shards} == shards
    lines = table.read_text().splitlines()
    assert lines[0] == "entry,set,group,metric,step,value,low,high,agents"
    assert any(line.startswith("constant-velocity,street,,ade_mean,,") for line in lines)
    assert run(*arguments, "--seed", "9") == 2
    assert "holds the work of another plan" in capsys.readouterr().err


@pytest.mark.parametrize("protocol", ["all", "streaming", "paper"])
def test_every_protocol_can_be_asked_for(
    protocol: str, benchmark: Path, model: str, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["--data", str(benchmark), "--sets", "street", "--model", model]
    arguments += ["--protocol", protocol, "--samples", "5", "--kde-samples", "10"]
    assert run(*arguments) == 0
    printed = capsys.readouterr().out
    assert f"Protocol {protocol}" in printed
    assert "NLL a step, mixture" in printed


def test_files_are_sets_of_their_own(
    benchmark: Path, model: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(str(benchmark / "street.txt"), "--model", model, "--samples", "5") == 0
    printed = capsys.readouterr().out
    assert "street" in printed
    assert "4 / 12" in printed
    assert run(str(benchmark / "street.txt"), "--leave-one-out", "--samples", "5") == 2
    assert "not for street; name a model" in capsys.readouterr().err


def test_a_report_is_written(
    benchmark: Path, model: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["--data", str(benchmark), "--sets", "street", "--model", model]
    assert run(*arguments, "--samples", "20", "--report", str(tmp_path / "report")) == 0
    page = (tmp_path / "report" / "report.html").read_text()
    assert "constant-velocity" in page or "constant velocity" in page
    assert (tmp_path / "report" / "report.md").is_file()
    capsys.readouterr()


def test_a_model_is_judged_on_its_own_recordings_only_when_asked(
    benchmark: Path, model: str, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["--data", str(benchmark), "--sets", "park", "--model", model, "--samples", "1"]
    assert run(*arguments) == 2
    assert "was trained or selected on park" in capsys.readouterr().err
    assert run(*arguments, "--in-sample") == 0
    assert "(in sample)" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (["--sets", "street,moon"], "unknown: moon; the test sets are street, park"),
        (["--sets", ","], "none given"),
        (["--model", "nowhere", "--sets", "park"], "nowhere: neither a bundled model"),
    ],
)
def test_wrong_use_is_explained(
    benchmark: Path, arguments: list[str], reason: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("--data", str(benchmark), *arguments) == 2
    assert reason in capsys.readouterr().err


def test_a_missing_data_folder_is_explained(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("--data", str(tmp_path)) == 2
    assert "has a splits.json" in capsys.readouterr().err
