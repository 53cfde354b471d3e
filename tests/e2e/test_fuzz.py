"""Two thousand hostile cases, of the twenty thousand that ``make fuzz`` sends."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

import pytest
from scripts import fuzz
from tests.contract.servers import save_small_model

ROOT = Path(__file__).parents[2]


@pytest.mark.timeout(400)
def test_hostile_input_neither_breaks_nor_changes_anything(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "fuzz.json"
    model = str(save_small_model(tmp_path / "small"))
    arguments = ["--cases", "2000", "--seed", "7", "--model", model, "--json", str(out)]
    monkeypatch.setattr(sys, "argv", ["fuzz.py", *arguments])
    monkeypatch.setattr("os.environ", os.environ.copy())
    with pytest.raises(SystemExit) as end:
        fuzz.main()
    report = json.loads(out.read_text())
    assert end.value.code == 0, report
    assert report["cases"] > 1800


def test_the_committed_run_found_nothing() -> None:
    report = json.loads((ROOT / "benchmarks" / "results" / "fuzz.json").read_text())
    assert report["passed"] and report["cases"] >= 19_000
