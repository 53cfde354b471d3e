"""``trajectron load``: what was sent is counted, whatever became of it."""

from __future__ import annotations

import json

import pytest
from tests.process import Served

from trajectron_service.cli import main
from trajectron_service.commands.loading import LoadReport

SMALL = ("--sessions", "3", "--agents", "4", "--rate", "10", "--seconds", "0.6", "--horizon", "4")


def run(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str]:
    with pytest.raises(SystemExit) as end:
        main(["load", *SMALL, *arguments])
    return int(end.value.code or 0), capsys.readouterr().out


@pytest.mark.parametrize("transport", ["grpc", "http"])
def test_every_frame_is_answered_or_refused_and_counted(
    served: Served, capsys: pytest.CaptureFixture[str], transport: str
) -> None:
    where = ("--server", served.grpc_target) if transport == "grpc" else ("--http", served.http_url)
    code, out = run(capsys, *where, "--json")
    figures = json.loads(out)
    assert code == 0
    assert figures["sent"] == 18
    assert figures["forecasts"] + sum(figures["refusals"].values()) == 18
    assert figures["lost"] == 0
    assert figures["latency_ms"]["p50"] <= figures["latency_ms"]["p99"]


def test_refusals_are_told_by_their_reason(
    served: Served, capsys: pytest.CaptureFixture[str]
) -> None:
    code, out = run(capsys, "--server", served.grpc_target, "--horizon", "60", "--model", "none")
    assert code == 1
    assert "sessions broken: UnknownModelError" in out


def test_nobody_there_is_said_in_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    code, out = run(capsys, "--server", "127.0.0.1:1")
    assert code == 1
    assert "sessions broken: TransportError" in out


def test_what_is_never_answered_is_lost() -> None:
    report = LoadReport(sent=5, forecasts=2)
    report.refusals["OVERLOADED"] += 1
    assert report.lost == 2
    assert report.to_json()["lost"] == 2


def test_late_is_what_comes_after_its_deadline() -> None:
    report = LoadReport()
    report.answered(due=0.0, deadline_s=0.1)
    assert (report.forecasts, report.late) == (1, 1)
    report.answered(due=1e12, deadline_s=0.1)
    assert (report.forecasts, report.late) == (2, 1)
