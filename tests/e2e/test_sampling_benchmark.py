"""The benchmark of sampling runs without data, and its figures say what was gained."""

from __future__ import annotations

import importlib.util
import json
import sys
from pathlib import Path

import pytest

BENCHMARK = Path(__file__).parents[2] / "benchmarks" / "sampling.py"


def test_stratified_samples_are_judged_beside_independent_ones(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    spec = importlib.util.spec_from_file_location("benchmark_sampling", BENCHMARK)
    assert spec is not None and spec.loader is not None
    benchmark = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, spec.name, benchmark)  # where dataclasses look
    spec.loader.exec_module(benchmark)
    monkeypatch.setattr(benchmark, "COUNTS", (4, 9))
    out = tmp_path / "sampling.json"
    arguments = ["sampling.py", "--agents", "30", "--seeds", "8,6", "--json", str(out)]
    monkeypatch.setattr(sys, "argv", arguments)
    benchmark.main()
    figures = json.loads(out.read_text())
    few, more = figures["rows"]
    assert (few["samples"], few["seeds"], more["samples"], more["seeds"]) == (4, 8, 9, 6)
    for row in (few, more):
        for error in (row["min_ade"], row["min_fde"]):
            assert error["low"] < error["gain"] < error["high"] < 1.0
            assert error["gain"] == pytest.approx(1.0 - error["stratified_m"] / error["iid_m"])
        assert row["variance_ratio"] > 1.2, "stratified samples estimate means better"
    assert more["min_ade"]["iid_m"] < few["min_ade"]["iid_m"]
    assert "| 9 | simulated crossing |" in capsys.readouterr().out
