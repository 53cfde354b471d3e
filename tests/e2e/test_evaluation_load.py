"""The benchmark of evaluations beside forecasts: its ratios, and what it refuses to report."""

from __future__ import annotations

import dataclasses
from datetime import UTC, datetime
from pathlib import Path

import pytest

from benchmarks import evaluation_load as benchmark
from trajectron_client import Evaluation, EvaluationProgress, EvaluationState
from trajectron_model.data.readers import read_csv


def test_ratios_are_of_latencies_beside_an_evaluation_over_those_without() -> None:
    without = [0.001 * n for n in range(1, 102)]  # 1 to 101 ms: median 51, p99 100
    found = benchmark.compared(without, [2.0 * value for value in without])
    assert found["p50"] == {"without_ms": 51.0, "beside_ms": 102.0, "ratio": 2.0}
    assert found["p99"] == {"without_ms": 100.0, "beside_ms": 200.0, "ratio": 2.0}
    figures = {"windows_judged": 7, "priority": "idle", "latency": {"predict": found}}
    assert "| predict | 202 | 51.0 | 102.0 | 2.0 | 100.0 | 200.0 | 2.0 |" in (
        benchmark.table(figures)
    )


def test_the_evaluation_has_work_for_longer_than_a_phase(tmp_path: Path) -> None:
    file = benchmark.crowd()
    path = tmp_path / file.name
    path.write_bytes(file.content)
    recording = read_csv(path)
    assert recording.num_steps == benchmark.CROWD_STEPS


def test_an_evaluation_that_ended_too_early_makes_no_figures() -> None:
    failed = Evaluation(
        id="a", models=("eth_ucy",), dataset="", sets=("crowd",), files=("crowd.csv",),
        protocol="sgan", num_samples=1, seed=0, in_sample=False, max_windows=None,
        frames_per_step=10, state=EvaluationState.FAILED,
        progress=EvaluationProgress(0.0, 0, 0, "", "", None), error="no windows",
        created_at=datetime.now(UTC), started_at=None, ended_at=None,
    )  # fmt: skip
    with pytest.raises(SystemExit, match="failed too early: no windows"):
        benchmark.still_running(failed)
    stopped = dataclasses.replace(
        failed,
        state=EvaluationState.CANCELLED,
        progress=EvaluationProgress(0.2, 3, 15, "eth_ucy", "crowd", 9.0),
    )
    assert benchmark.still_running(stopped) == 3
