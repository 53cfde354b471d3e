"""Two thousand hostile cases, of the twenty thousand that ``make fuzz`` sends."""

from __future__ import annotations

import json
import os
import sys
import time
from pathlib import Path

import grpc
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
    assert report["refused_of_those_naming_a_session"] >= 10


class Ended(grpc.RpcError):
    def __init__(self, code: grpc.StatusCode) -> None:
        self._code = code

    def code(self) -> grpc.StatusCode:
        return self._code


def test_a_call_that_only_our_own_deadline_ended_had_no_answer() -> None:
    late, soon = time.monotonic() - fuzz._TIMEOUT_S, time.monotonic()
    deadline = Ended(grpc.StatusCode.DEADLINE_EXCEEDED)
    assert fuzz._said(deadline, late) in fuzz._FORBIDDEN_CODES
    assert fuzz._said(deadline, soon) == "DEADLINE_EXCEEDED"
    assert fuzz._said(Ended(grpc.StatusCode.NOT_FOUND), late) == "NOT_FOUND"


def test_the_committed_run_found_nothing() -> None:
    report = json.loads((ROOT / "benchmarks" / "results" / "fuzz.json").read_text())
    assert report["passed"] and report["cases"] >= 19_000
