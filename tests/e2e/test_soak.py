"""Two minutes of what ``make soak`` does for thirty, and what its committed run says."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

import pytest
from tests.contract.servers import save_small_model

from benchmarks import soak

ROOT = Path(__file__).parents[2]


@pytest.mark.timeout(400)
def test_sessions_and_faults_come_and_go_and_nothing_grows_or_is_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "soak.json"
    model = str(save_small_model(tmp_path / "small"))
    arguments = ["--minutes", "2", "--model", model, "--json", str(out)]
    monkeypatch.setattr(sys, "argv", ["soak.py", *arguments])
    monkeypatch.setattr("os.environ", os.environ.copy())
    with pytest.raises(SystemExit) as end:
        soak.main()
    figures = json.loads(out.read_text())
    assert end.value.code == 0, figures["criteria"]
    assert len(figures["faults"]) == 5
    assert figures["frames"] > 0


def test_the_committed_run_is_whole_and_met_every_criterion() -> None:
    figures = json.loads((ROOT / "benchmarks" / "results" / "soak.json").read_text())
    assert figures["minutes"] >= 30.0
    assert figures["passed"], figures["criteria"]
    assert all(figures["criteria"].values())
    assert figures["frames"] > 1000


def test_growth_and_losses_fail_the_run() -> None:
    samples = [soak.Sample(60.0 * k, 100_000_000 + 300_000 * k, 20, 5) for k in range(30)]
    grown = soak._verdict(soak.Soak(samples=samples), version=0, minutes=30.0)
    assert not grown["criteria"]["memory"] and not grown["passed"]
    flat = [soak.Sample(60.0 * k, 100_000_000, 20, 5) for k in range(30)]
    assert soak._verdict(soak.Soak(samples=flat), version=0, minutes=30.0)["passed"]
    assert not soak._verdict(soak.Soak(samples=flat, acknowledged=1), 0, 30.0)["passed"]
    assert not soak._verdict(soak.Soak(samples=flat, lost=1), 0, 30.0)["passed"]
    more = [soak.Sample(60.0 * k, 100_000_000, 20 + k // 15, 5) for k in range(30)]
    assert not soak._verdict(soak.Soak(samples=more), 0, 30.0)["criteria"]["descriptors"]
