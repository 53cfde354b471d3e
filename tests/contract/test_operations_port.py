"""Metrics and probes on a port of their own, and what the OpenAPI document says of tokens."""

from __future__ import annotations

import asyncio
from pathlib import Path

import httpx
import pytest
from tests.contract.servers import small_settings

from trajectron_service.lifecycle import running
from trajectron_service.settings import SettingsError
from trajectron_service.tenancy import Scope
from trajectron_service.tokens import entry, new_token

pytestmark = pytest.mark.asyncio(loop_scope="session")


async def test_metrics_have_a_port_of_their_own_that_asks_for_no_token(
    model_path: Path, tmp_path: Path
) -> None:
    tokens = tmp_path / "tokens.toml"
    token = new_token()
    tokens.write_text(entry(token, "ann", [Scope.ADMIN]))
    settings = small_settings(model_path, metrics_port=0, tokens=tokens)
    async with running(settings) as service, httpx.AsyncClient(timeout=30.0) as client:
        own, main = (
            f"http://127.0.0.1:{port}" for port in (service.metrics_port, service.http_port)
        )
        measured = await client.get(f"{own}/metrics")
        assert measured.status_code == 200 and "trajectron_sessions " in measured.text
        for base in (own, main):
            assert (await client.get(f"{base}/readyz")).json() == {"status": "ok"}
            assert (await client.get(f"{base}/healthz")).status_code == 200
        for path in ("/v1/sessions", "/predict", "/docs", "/openapi.json"):
            assert (await client.get(f"{own}{path}")).status_code == 404, path
        asked = {"authorization": f"Bearer {token}"}
        assert (await client.get(f"{main}/metrics", headers=asked)).status_code == 404


async def test_connections_of_all_ports_are_counted_together(model_path: Path) -> None:
    settings = small_settings(model_path, metrics_port=0)
    async with running(settings) as service, httpx.AsyncClient(timeout=30.0) as client:

        async def counted(expected: int) -> None:
            async with asyncio.timeout(30):
                while True:
                    page = await client.get(f"http://127.0.0.1:{service.metrics_port}/metrics")
                    if f"trajectron_http_connections {expected}.0\n" in page.text:
                        return
                    await asyncio.sleep(0.01)

        held = [await asyncio.open_connection("127.0.0.1", service.http_port) for _ in range(3)]
        await counted(3 + 1)  # who asks is one
        for _, writer in held:
            writer.close()
        await counted(1)


async def test_metrics_are_on_the_main_port_unless_told(model_path: Path) -> None:
    async with running(small_settings(model_path)) as service, httpx.AsyncClient() as client:
        assert service.metrics_port is None
        url = f"http://127.0.0.1:{service.http_port}/metrics"
        assert (await client.get(url)).status_code == 200


async def test_a_metrics_port_that_is_taken_is_named(model_path: Path) -> None:
    async with running(small_settings(model_path)) as service:
        taken = small_settings(model_path, metrics_port=service.http_port)
        with pytest.raises(SettingsError, match="metrics_port"):
            async with running(taken):
                pass


async def test_the_document_says_which_calls_need_a_token_and_how_they_are_refused(
    http: httpx.AsyncClient,
) -> None:
    document = (await http.get("/openapi.json")).json()
    assert document["components"]["securitySchemes"]["token"]["scheme"] == "bearer"
    needed = {
        f"{verb} {path}": ("security" in call, {"401", "403", "429"} <= call["responses"].keys())
        for path, calls in document["paths"].items()
        for verb, call in calls.items()
    }
    assert {call for call, (token, _) in needed.items() if not token} == {
        "get /healthz",
        "get /readyz",
    }
    assert all(token == told for token, told in needed.values())
