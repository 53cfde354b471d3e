"""The benchmarks run, and give every figure its floor."""

from __future__ import annotations

import importlib.util
import json
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
            assert row["ours_ms"] > row["floor_ms"] > 0.0 and row["ratio"] > 1.0
    assert "| sampling_200x12 | 3 |" in capsys.readouterr().out
