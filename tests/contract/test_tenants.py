"""Two tenants behind TLS: who is let in, and that neither finds anything of the other's."""

from __future__ import annotations

import ssl
import subprocess
from collections.abc import AsyncIterator, Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import grpc
import httpx
import pytest
import pytest_asyncio
from fastapi.routing import APIRoute
from starlette.routing import Mount
from tests.contract.servers import small_settings

from trajectron_client import (
    Access,
    AsyncClient,
    AsyncHttpClient,
    TrajectronError,
    TransportError,
)
from trajectron_proto.v1 import evaluation_pb2 as epb
from trajectron_proto.v1 import evaluation_pb2_grpc, trajectron_pb2_grpc
from trajectron_proto.v1 import trajectron_pb2 as pb
from trajectron_service import access
from trajectron_service.http_routes import http_app
from trajectron_service.lifecycle import Service, running
from trajectron_service.protection import load_tls
from trajectron_service.settings import Settings, SettingsError
from trajectron_service.tenancy import Scope
from trajectron_service.tokens import entry, new_token

pytestmark = pytest.mark.asyncio(loop_scope="module")

WORK = [Scope.PREDICT, Scope.SESSIONS, Scope.EVALUATE]
TOKENS = {"ann": new_token(), "bob": new_token(), "eve": new_token()}
CSV = b"time,id,type,x,y\n" + b"".join(
    b"%.1f,a,pedestrian,%.1f,0\n" % (0.4 * step, 0.4 * step) for step in range(24)
)
SESSION, EVALUATION = "crossing", "night"


@dataclass(frozen=True)
class Place:
    """A running service, and what its clients need."""

    service: Service
    ca: Path
    folder: Path

    def http(self, name: str | None) -> httpx.AsyncClient:
        headers = {"Authorization": f"Bearer {TOKENS[name]}"} if name else {}
        return httpx.AsyncClient(
            base_url=f"https://localhost:{self.service.http_port}",
            headers=headers,
            verify=ssl.create_default_context(cafile=self.ca),
            timeout=60.0,
        )

    def channel(self) -> grpc.aio.Channel:
        credentials = grpc.ssl_channel_credentials(self.ca.read_bytes())
        return grpc.aio.secure_channel(f"localhost:{self.service.grpc_port}", credentials)


def make_certificate(folder: Path, name: str) -> tuple[Path, Path]:
    """A certificate for localhost that is its own authority."""
    certificate, key = folder / f"{name}.crt", folder / f"{name}.key"
    command = [
        "openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1",
        "-nodes", "-days", "2", "-subj", f"/CN={name}", "-keyout", str(key), "-out",
        str(certificate), "-addext", "subjectAltName=DNS:localhost,IP:127.0.0.1",
    ]  # fmt: skip
    subprocess.run(command, check=True, capture_output=True, timeout=30)
    return certificate, key


@pytest_asyncio.fixture(scope="module", loop_scope="module")
async def place(model_path: Path, tmp_path_factory: pytest.TempPathFactory) -> AsyncIterator[Place]:
    folder = tmp_path_factory.mktemp("protected")
    certificate, key = make_certificate(folder, "server")
    file = folder / "tokens.toml"
    scopes = {"ann": WORK, "bob": WORK, "eve": [Scope.ADMIN]}
    file.write_text("\n".join(entry(TOKENS[name], name, scopes[name]) for name in TOKENS))
    settings = small_settings(
        model_path,
        tls_certificate=certificate,
        tls_key=key,
        tokens=file,
        evaluation_priority="normal",
    )
    async with running(settings) as service:
        yield Place(service, certificate, folder)


def metadata(name: str | None) -> list[tuple[str, str]]:
    return [("authorization", f"Bearer {TOKENS[name]}")] if name else []


async def opened(place: Place, name: str) -> None:
    """Opens a session and an evaluation under names that everybody would choose."""
    files = [("files", ("walk.csv", CSV))]
    form = {"evaluation": f'{{"evaluation_id": "{EVALUATION}", "models": ["linear"]}}'}
    async with place.http(name) as http:
        answer = await http.post("/v1/sessions", json={"session_id": SESSION})
        assert answer.status_code in (201, 409)
        answer = await http.post("/v1/evaluations", data=form, files=files)
        assert answer.status_code in (201, 409), answer.text


# What each RPC is asked about another tenant's things; None: it names nothing of anybody's.
FRAMES = [pb.Frame(time_s=0.0)]
ASKED: dict[str, Any] = {
    "Predict": None,
    "ListModels": None,
    "CreateSession": None,
    "ListSessions": pb.ListSessionsRequest(),
    "GetSession": pb.GetSessionRequest(session_id=SESSION),
    "DeleteSession": pb.DeleteSessionRequest(session_id=SESSION),
    "Observe": pb.ObserveRequest(session_id=SESSION, frames=FRAMES),
    "PredictSession": pb.PredictSessionRequest(session_id=SESSION),
    "StreamPredict": None,
    "CreateEvaluation": None,
    "ListEvaluations": epb.ListEvaluationsRequest(),
    "GetEvaluation": epb.GetEvaluationRequest(evaluation_id=EVALUATION),
    "WatchEvaluation": epb.WatchEvaluationRequest(evaluation_id=EVALUATION),
    "CancelEvaluation": epb.CancelEvaluationRequest(evaluation_id=EVALUATION),
    "DeleteEvaluation": epb.DeleteEvaluationRequest(evaluation_id=EVALUATION),
    "GetEvaluationResult": epb.GetEvaluationResultRequest(evaluation_id=EVALUATION),
}
SERVICES = [
    (pb, "TrajectronService", trajectron_pb2_grpc.TrajectronServiceStub),
    (epb, "EvaluationService", evaluation_pb2_grpc.EvaluationServiceStub),
]
METHODS = [
    (method, stub)
    for contract, name, stub in SERVICES
    for method in contract.DESCRIPTOR.services_by_name[name].methods
]


def paths_of(routes: Iterable[Any]) -> list[str]:
    """The templates of all routes; fails for a kind of route that it does not know."""
    paths = []
    for route in routes:
        if isinstance(route, APIRoute | Mount):
            paths.append(route.path)
        else:
            paths.extend(paths_of(route.original_router.routes))
    return paths


async def ask(channel: grpc.aio.Channel, method: Any, stub: Any, request: Any, who: Any) -> Any:
    call = getattr(stub(channel), method.name)
    if method.client_streaming:
        request = iter([request])
    answer = call(request, metadata=metadata(who), timeout=20)
    if method.server_streaming:
        return [one async for one in answer]
    return await answer


async def code(
    channel: grpc.aio.Channel, method: Any, stub: Any, request: Any, who: str | None
) -> grpc.StatusCode:
    try:
        await ask(channel, method, stub, request, who)
    except grpc.aio.AioRpcError as error:
        return error.code()
    return grpc.StatusCode.OK


async def test_every_rpc_declares_a_scope_and_what_it_is_asked_here() -> None:
    names = {method.name for method, _ in METHODS}
    assert names == access.RPCS.keys() == ASKED.keys()


async def test_every_route_declares_a_scope(place: Place) -> None:
    service = place.service
    app = http_app(
        service.application, service.evaluations, service.health, service.metrics,
        service.admission, max_body_bytes=1, max_arriving_bytes=1,
        metrics_here=True, version="0",
    )  # fmt: skip
    paths = paths_of(app.routes)
    assert {"/metrics", "/docs", "/v1/sessions/{session_id}:observe"} < set(paths)
    assert [path for path in paths if not access.declared(path)] == []
    assert access.scope_of_path("/v1/new") is Scope.ADMIN


async def test_every_rpc_asks_for_a_token_and_its_scope(place: Place) -> None:
    async with place.channel() as channel:
        for method, stub in METHODS:
            empty = method.input_type._concrete_class()
            assert await code(channel, method, stub, empty, None) is (
                grpc.StatusCode.UNAUTHENTICATED
            ), method.name
            assert await code(channel, method, stub, empty, "eve") is (
                grpc.StatusCode.PERMISSION_DENIED
            ), method.name


@pytest.mark.parametrize("path", ["/v1/sessions", "/v1/models", "/v1/evaluations", "/metrics"])
async def test_http_asks_for_a_token_and_its_scope(place: Place, path: str) -> None:
    wrong = "ann" if path == "/metrics" else "eve"
    async with place.http(None) as http:
        answer = await http.get(path)
        assert answer.status_code == 401
        assert answer.headers["WWW-Authenticate"].startswith("Bearer")
    async with place.http(wrong) as http:
        assert (await http.get(path)).status_code == 403
    async with place.http("eve" if path == "/metrics" else "ann") as http:
        assert (await http.get(path)).status_code == 200


@pytest.mark.parametrize("path", ["/healthz", "/readyz", "/docs", "/openapi.json"])
async def test_probes_and_the_description_need_no_token(place: Place, path: str) -> None:
    async with place.http(None) as http:
        assert (await http.get(path)).status_code == 200


async def test_no_rpc_finds_anything_of_another_tenant(place: Place) -> None:
    await opened(place, "ann")
    async with place.channel() as channel:
        for method, stub in METHODS:
            request = ASKED[method.name]
            if request is None:
                continue
            if method.name.startswith("List"):
                answer = await ask(channel, method, stub, request, "bob")
                assert not list(getattr(answer, "sessions", [])), method.name
                assert not list(getattr(answer, "evaluations", [])), method.name
                continue
            found = await code(channel, method, stub, request, "bob")
            assert found is grpc.StatusCode.NOT_FOUND, method.name
        mine = pb.GetSessionRequest(session_id=SESSION)
        assert (await trajectron_pb2_grpc.TrajectronServiceStub(channel).GetSession(
            mine, metadata=metadata("ann"))).session.id == SESSION  # fmt: skip


async def test_no_path_finds_anything_of_another_tenant(place: Place) -> None:
    await opened(place, "ann")
    one, other = f"/v1/sessions/{SESSION}", f"/v1/evaluations/{EVALUATION}"
    frames = {"frames": [{"time": 0.0, "agents": []}]}
    calls: list[tuple[str, str, Any]] = [
        ("GET", one, None), ("DELETE", one, None), ("POST", f"{one}:observe", frames),
        ("POST", f"{one}:predict", {}), ("GET", other, None), ("DELETE", other, None),
        ("GET", f"{other}:watch", None), ("POST", f"{other}:cancel", None),
        ("GET", f"{other}/result.json", None), ("GET", f"{other}/result.csv", None),
        ("GET", f"{other}/report.html", None),
    ]  # fmt: skip
    async with place.http("bob") as http:
        for verb, path, body in calls:
            answer = await http.request(verb, path, json=body)
            assert answer.status_code == 404, (verb, path, answer.text)
        assert (await http.get("/v1/sessions")).json()["sessions"] == []
        assert (await http.get("/v1/evaluations")).json()["evaluations"] == []
    async with place.http("ann") as http:
        assert (await http.get(one)).status_code == 200
        assert (await http.get(other)).status_code == 200


async def test_tenants_use_the_same_names_without_meeting(place: Place) -> None:
    """Last: bob now has a session and an evaluation, too, and ann's outlive them."""
    await opened(place, "ann")
    stream = pb.StreamPredictRequest(open=pb.StreamOpen(session_id=SESSION))
    async with place.channel() as channel:
        stub = trajectron_pb2_grpc.TrajectronServiceStub(channel)
        answers = stub.StreamPredict(iter([stream]), metadata=metadata("bob"))
        replies = [one async for one in answers]
        assert replies[0].opened.resumed is False
    await opened(place, "bob")
    async with place.http("bob") as http:
        assert (await http.delete(f"/v1/sessions/{SESSION}")).status_code == 204
        assert (await http.delete(f"/v1/evaluations/{EVALUATION}")).status_code == 204
    async with place.http("ann") as http:
        assert (await http.get(f"/v1/sessions/{SESSION}")).status_code == 200
        assert (await http.get(f"/v1/evaluations/{EVALUATION}")).status_code == 200


async def test_a_key_sent_by_another_tenant_is_another_key(place: Place) -> None:
    form = {"evaluation": '{"models": ["linear"]}'}
    made = []
    for name in ("ann", "ann", "bob"):
        async with place.http(name) as http:
            answer = await http.post(
                "/v1/evaluations",
                data=form,
                files=[("files", ("walk.csv", CSV))],
                headers={"Idempotency-Key": "the-same"},
            )
            assert answer.status_code == 201, answer.text
            made.append(answer.json()["id"])
    assert made[0] == made[1] != made[2]


async def test_who_does_not_trust_the_certificate_does_not_talk(place: Place) -> None:
    url = f"https://localhost:{place.service.http_port}/healthz"
    async with httpx.AsyncClient() as http:
        with pytest.raises(httpx.ConnectError, match="CERTIFICATE_VERIFY_FAILED"):
            await http.get(url)
        with pytest.raises(httpx.TransportError):
            await http.get(url.replace("https", "http"))


async def test_nothing_older_than_tls_1_2_is_spoken(place: Place) -> None:
    certificate, key = make_certificate(place.folder, "modern")
    tls = load_tls(Settings(tls_certificate=certificate, tls_key=key))
    assert tls is not None
    assert tls.http.minimum_version >= ssl.TLSVersion.TLSv1_2


async def test_a_key_of_another_certificate_is_told(place: Place) -> None:
    _, key = make_certificate(place.folder, "other")
    with pytest.raises(SettingsError, match="no certificate with its"):
        load_tls(Settings(tls_certificate=place.ca, tls_key=key))


async def test_the_clients_show_their_token_and_trust_the_authority(place: Place) -> None:
    access = Access(token=TOKENS["ann"], ca=place.ca)
    assert TOKENS["ann"] not in repr(access)
    target = f"localhost:{place.service.grpc_port}"
    url = f"https://localhost:{place.service.http_port}"
    async with AsyncClient(target, access=access) as grpc_client:
        assert await grpc_client.list_models()
    async with AsyncHttpClient(url, access=access) as http_client:
        assert await http_client.list_models()
    async with AsyncHttpClient(url, access=Access(ca=place.ca)) as nobody:
        with pytest.raises(TrajectronError):
            await nobody.list_models()
    async with AsyncHttpClient(url, access=Access(token=TOKENS["ann"])) as trusts_nobody:
        with pytest.raises(TransportError):
            await trusts_nobody.list_models()


async def test_access_comes_from_the_environment(
    place: Place, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TRAJECTRON_CLIENT_TOKEN", TOKENS["bob"])
    monkeypatch.setenv("TRAJECTRON_CLIENT_CA", str(place.ca))
    access = Access.from_environment()
    assert access == Access(token=TOKENS["bob"], ca=place.ca)
    async with AsyncClient(f"localhost:{place.service.grpc_port}", access=access) as client:
        assert await client.list_models()
    with pytest.raises(ValueError, match="go together"):
        Access(certificate=place.ca)


async def test_with_client_certificates_none_else_gets_in(place: Place, model_path: Path) -> None:
    certificate, key = place.ca, place.folder / "server.key"
    own, own_key = make_certificate(place.folder, "client")
    settings = small_settings(
        model_path, tls_certificate=certificate, tls_key=key, tls_client_ca=own, warm_up=False
    )
    trusting: Callable[[], ssl.SSLContext] = lambda: ssl.create_default_context(  # noqa: E731
        cafile=certificate
    )
    known = trusting()
    known.load_cert_chain(own, own_key)
    async with running(settings) as service:
        url = f"https://localhost:{service.http_port}/v1/models"
        async with httpx.AsyncClient(verify=known) as http:
            assert (await http.get(url)).status_code == 200
        async with httpx.AsyncClient(verify=trusting()) as http:
            with pytest.raises(httpx.TransportError):
                await http.get(url)
        target, roots = f"localhost:{service.grpc_port}", certificate.read_bytes()
        pair = own_key.read_bytes(), own.read_bytes()
        for files, expected in (((), grpc.StatusCode.UNAVAILABLE), (pair, grpc.StatusCode.OK)):
            credentials = grpc.ssl_channel_credentials(roots, *files)
            async with grpc.aio.secure_channel(target, credentials) as channel:
                method, stub = next(one for one in METHODS if one[0].name == "ListModels")
                assert await code(channel, method, stub, pb.ListModelsRequest(), None) is expected
