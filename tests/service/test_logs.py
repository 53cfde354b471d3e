"""Logs: one event a line, for machines or for people, those of libraries included."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator

import pytest

from trajectron_service import logs


@pytest.fixture(autouse=True)
def _as_before() -> Iterator[None]:
    root = logging.getLogger()
    handlers, level = root.handlers[:], root.level
    yield
    root.handlers[:] = handlers
    root.setLevel(level)


def test_json_lines_carry_fields_and_faults(capsys: pytest.CaptureFixture[str]) -> None:
    logs.configure("info", "json")
    log = logs.get("trajectron_service.test")
    log.debug("not shown")
    log.info("opened", sessions=3)
    try:
        raise ValueError("what was wrong")
    except ValueError:
        log.exception("failed")
    logging.getLogger("library").warning("watch %s", "out")
    opened, failed, library = map(json.loads, capsys.readouterr().err.splitlines())
    assert (opened["event"], opened["sessions"], opened["level"]) == ("opened", 3, "info")
    assert opened["logger"] == "trajectron_service.test"
    assert "what was wrong" in failed["exception"]
    assert (library["event"], library["logger"]) == ("watch out", "library")


def test_a_fault_is_told_without_the_values_of_variables(
    capsys: pytest.CaptureFixture[str],
) -> None:
    logs.configure("info", "console")
    private = "the-position-of-somebody"
    try:
        raise ValueError(len(private))
    except ValueError:
        logs.get("t").exception("failed")
    text = capsys.readouterr().err
    assert "ValueError: 24" in text
    assert private not in text
