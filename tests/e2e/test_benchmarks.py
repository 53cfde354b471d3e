"""The benchmarks run, and give every figure its floor."""

from __future__ import annotations

import importlib.util
import json
import os
import sys
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


def test_the_model_benchmark_sets_ours_beside_the_bare_products(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    spec = importlib.util.spec_from_file_location("benchmark_model", BENCHMARKS / "model.py")
    assert spec is not None and spec.loader is not None
    benchmark = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(benchmark)
    monkeypatch.setattr(benchmark, "AGENTS", (2, 3))
    monkeypatch.setattr(benchmark, "GROWTH", (10, 20))
    out = tmp_path / "model.json"
    arguments = ["model.py", "--threads", "1", "--repeats", "1", "--json", str(out)]
    monkeypatch.setattr(sys, "argv", arguments)
    benchmark.main()
    figures = json.loads(out.read_text())
    for name in ("sampling_200x12", "encoder_step"):
        assert set(figures[name]) == {"2", "3"}
        for row in figures[name].values():
            assert row["ours_ms"] > 0.0 and row["floor_ms"] > 0.0 and row["ratio"] > 0.1
    assert figures["step_of_100_scenes_of_5"]["together_ms"] > 0.0
    assert "| sampling_200x12 | 3 |" in capsys.readouterr().out


def test_the_benchmark_of_steps_sets_ours_beside_torch(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from benchmarks import step

    monkeypatch.setattr(step, "AGENTS", (1, 3, 5, 8, 10, 12))
    monkeypatch.setattr(step, "CROWDS", (5, 10))
    monkeypatch.setattr(step, "MANY_SCENES", 4)
    out = tmp_path / "step.json"
    monkeypatch.setattr(sys, "argv", ["", "--threads", "1", "--repeats", "1", "--json", str(out)])
    step.main()
    figures = json.loads(out.read_text())
    steps = [row for row in figures["rows"] if row["what"] == "step"]
    assert [row["agents"] for row in steps] == [1, 3, 5, 8, 10, 12]
    assert all(set(row["times"]) == {"torch", "bare products"} for row in steps)
    assert figures["bytes_of_a_scene"]["12"] > figures["bytes_of_a_scene"]["1"] > 0
    assert "| step of 4 scenes | 20 |" in capsys.readouterr().out


def test_the_benchmark_of_the_service_measures_every_row(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from tests.contract.servers import save_small_model

    from benchmarks import service

    out = tmp_path / "service.json"
    model = str(save_small_model(tmp_path / "small"))
    arguments = ["--seconds", "0.4", "--sessions", "20", "--model", model, "--json", str(out)]
    monkeypatch.setattr(sys, "argv", ["service.py", *arguments])
    with monkeypatch.context() as patch:
        patch.setattr("os.environ", os.environ.copy())
        service.main()
    figures = json.loads(out.read_text())
    assert figures["predict_10_agents_20_samples"]["per_s"] > 0.0
    for row in figures["streams_64_of_8_agents_gmm"]:
        assert row["sent"] == row["forecasts"] + sum(row["refusals"].values())
        assert row["lost"] == 0 and not row["broken_sessions"]
    assert "| 64 streams of 8 agents, 300 frames a second offered |" in capsys.readouterr().out


def test_the_benchmark_of_overload_counts_every_frame(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from tests.contract.servers import save_small_model

    from benchmarks import overload

    out = tmp_path / "overload.json"
    model = str(save_small_model(tmp_path / "small"))
    arguments = ["--seconds", "2", "--search-seconds", "1", "--agents", "5", "--samples", "50"]
    monkeypatch.setattr(sys, "argv", ["", *arguments, "--model", model, "--json", str(out)])
    with monkeypatch.context() as patch:
        patch.setattr("os.environ", os.environ.copy())
        overload.main()
    figures = json.loads(out.read_text())
    assert figures["best_in_time_per_s"] > 0.0
    assert figures["overload"]["lost"] == 0
    assert figures["overload"]["sent"] > 0
