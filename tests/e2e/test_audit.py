"""The audit reads every pin, names what is weak, and says when it could not ask."""

from __future__ import annotations

import httpx
import pytest
from scripts import audit


def test_every_pin_is_asked_about() -> None:
    pinned = dict(audit.pins(audit.CONSTRAINTS.read_text()))
    assert pinned["torch"] == "2.13.0"
    assert len(pinned) > 80
    assert audit.pins("# a==1\nb==2  # why\n\nc>=3\n") == [("b", "2")]


def test_a_weakness_fails_the_audit(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def answer(url: str, *, json: dict[str, list[object]], timeout: float) -> httpx.Response:
        results: list[dict[str, object]] = [{} for _ in json["queries"]]
        results[0] = {"vulns": [{"id": "GHSA-1"}, {"id": "CVE-2"}]}
        request = httpx.Request("POST", url, extensions={"timeout": timeout})
        return httpx.Response(200, json={"results": results}, request=request)

    monkeypatch.setattr(httpx, "post", answer)
    assert audit.main() == 1
    assert "GHSA-1, CVE-2" in capsys.readouterr().out


def test_without_a_network_it_says_that_nothing_is_known(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def unreachable(*_args: object, **_kwargs: object) -> httpx.Response:
        raise httpx.ConnectError("no route")

    monkeypatch.setattr(httpx, "post", unreachable)
    assert audit.main() == 0
    assert "could not ask" in capsys.readouterr().out
