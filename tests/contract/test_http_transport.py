"""What holds of HTTP alone: bodies, problems, content types, documentation, operations."""

from __future__ import annotations

import asyncio
import json
import re
from typing import Any

import httpx
import numpy as np
import pytest
from tests.contract.drivers import forecast_view, http_refusal
from tests.contract.scenes import frame, walking
from tests.contract.servers import MAX_MESSAGE_BYTES

from trajectron_proto.v1 import trajectron_pb2 as pb
from trajectron_service import http_answers as answers
from trajectron_service.lifecycle import Service

pytestmark = pytest.mark.asyncio(loop_scope="session")

JSON = dict[str, Any]


def body(**changes: Any) -> JSON:
    """A good request with changes."""
    return {"frames": walking(), "num_samples": 2, "seed": 1, **changes}


async def test_both_paths_predict(http: httpx.AsyncClient) -> None:
    short, full = [await http.post(path, json=body()) for path in ("/predict", "/v1/predict")]
    assert short.status_code == full.status_code == 200
    assert short.json().keys() == full.json().keys()
    assert short.headers["content-type"] == "application/json"


@pytest.mark.parametrize("mode", ["full", "z_best", "gmm"])
@pytest.mark.parametrize("include_modes", [True, False])
async def test_forecasts_are_as_the_documentation_describes_them(
    http: httpx.AsyncClient, mode: str, include_modes: bool
) -> None:
    answer = await http.post("/predict", json=body(mode=mode, include_modes=include_modes))
    answers.Forecast.model_validate_json(answer.content, strict=True)


async def test_other_answers_are_as_the_documentation_describes_them(
    http: httpx.AsyncClient,
) -> None:
    created = await http.post("/v1/sessions", json={"session_id": "documented"})
    assert created.status_code == 201
    assert created.headers["location"] == "/v1/sessions/documented"
    answers.Session.model_validate_json(created.content)
    observed = await http.post("/v1/sessions/documented:observe", json={"frames": walking()})
    answers.FrameResults.model_validate_json(observed.content)
    shapes: dict[str, type[answers.Answer]] = {
        "/v1/sessions/documented": answers.SessionWithGraph,
        "/v1/sessions": answers.Sessions,
        "/v1/models": answers.Models,
        "/healthz": answers.Status,
        "/readyz": answers.Status,
    }
    for path, shape in shapes.items():
        shape.model_validate_json((await http.get(path)).content)
    predicted = await http.post("/v1/sessions/documented:predict")
    answers.Forecast.model_validate_json(predicted.content)
    deleted = await http.delete("/v1/sessions/documented")
    assert (deleted.status_code, deleted.content) == (204, b"")


async def test_whoever_asks_for_protobuf_gets_the_message(http: httpx.AsyncClient) -> None:
    accept = {"Accept": "application/x-protobuf"}
    answer = await http.post("/predict", json=body(include_modes=True), headers=accept)
    assert answer.headers["content-type"] == "application/x-protobuf"
    message = pb.PredictResponse.FromString(answer.content)
    plain = (await http.post("/predict", json=body(include_modes=True))).json()
    seen = forecast_view(message.forecast)
    for one, other in zip(seen["agents"], plain["agents"], strict=True):
        np.testing.assert_allclose(one["samples"], other["samples"], atol=1e-5)
        np.testing.assert_allclose(one["mean"], other["mean"], atol=1e-5)
    # Offsets from the last position, not positions.
    first = message.forecast.agents[2]
    assert first.y == 2.0
    offsets = np.frombuffer(first.samples.data, "<f4").reshape(tuple(first.samples.shape))
    np.testing.assert_allclose(
        offsets + np.array([first.x, first.y]), plain["agents"][2]["samples"], atol=1e-5
    )


async def test_every_answer_has_its_message(http: httpx.AsyncClient) -> None:
    accept = {"Accept": "application/x-protobuf"}

    async def ask(verb: str, path: str, content: JSON | None = None) -> bytes:
        answer = await http.request(verb, path, json=content, headers=accept)
        assert answer.headers["content-type"] == "application/x-protobuf", answer.text
        return answer.content

    name = "message"
    content = await ask("POST", "/v1/sessions", {"session_id": name})
    assert pb.CreateSessionResponse.FromString(content).session.id == name
    content = await ask("POST", f"/v1/sessions/{name}:observe", {"frames": walking(2)})
    assert len(pb.ObserveResponse.FromString(content).results) == 2
    content = await ask("POST", f"/v1/sessions/{name}:predict", {})
    assert len(pb.PredictSessionResponse.FromString(content).forecast.agents) == 3
    content = await ask("GET", f"/v1/sessions/{name}")
    assert len(pb.GetSessionResponse.FromString(content).graph.nodes) == 3
    content = await ask("GET", "/v1/sessions")
    assert name in [one.id for one in pb.ListSessionsResponse.FromString(content).sessions]
    content = await ask("GET", "/v1/models")
    assert pb.ListModelsResponse.FromString(content).models
    await http.delete(f"/v1/sessions/{name}")


@pytest.mark.parametrize(
    "raw",
    [b"{", b"", b"nonsense", b'{"frames": [}', b"\xff\xfe\x00", b"[" * 100_000,
     b'{"frames": "\\ud800"}', b'{"a": 1} trailing', b'{"seed": ' + b"9" * 5000 + b"}"],
)  # fmt: skip
async def test_broken_json_is_400(http: httpx.AsyncClient, raw: bytes) -> None:
    answer = await http.post("/predict", content=raw)
    refusal = http_refusal(answer)
    # No body at all is an empty object, which lacks its frames.
    expected = ("INVALID_ARGUMENT", "422") if raw == b"" else ("MALFORMED", "400")
    assert (refusal.kind, refusal.code) == expected
    assert (await http.post("/predict", json=body())).status_code == 200


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"frames": 3}, "frames"),
        ({"frames": [3]}, "frames[0]"),
        ({"frames": [{"time": "0", "agents": []}]}, "frames[0].time"),
        ({"frames": [{"time": 0, "agents": {}}]}, "frames[0].agents"),
        ({"frames": [frame(0.0, {"id": 7, "type": "pedestrian", "x": 0, "y": 0})]},
         "frames[0].agents[0].id"),
        ({"frames": [frame(0.0, {"id": "7", "type": "pedestrian", "x": "0", "y": 0})]},
         "frames[0].agents[0].x"),
        ({"frames": [frame(0.0, {"id": "7", "type": "pedestrian", "x": 0, "y": True})]},
         "frames[0].agents[0].y"),
        ({"frames": [frame(0.0, {"id": "7", "type": None, "x": 0, "y": 0})]},
         "frames[0].agents[0].type"),
        ({"frames": [frame(0.0, {"id": "7", "type": "pedestrian", "x": 0, "y": 0, "z": 1})]},
         "frames[0].agents[0].z"),
        ({"num_sample": 5}, "num_sample"),
        ({"num_samples": 1.5}, "num_samples"),
        ({"num_samples": "5"}, "num_samples"),
        ({"num_samples": -1}, "num_samples"),
        ({"num_samples": 10**30}, "num_samples"),
        ({"horizon": -3}, "horizon"),
        ({"seed": -1}, "seed"),
        ({"seed": 2**64}, "seed"),
        ({"mode": "best"}, "mode"),
        ({"sampling": "halton"}, "sampling"),
        ({"agents": "7"}, "agents"),
        ({"agents": [7]}, "agents[0]"),
        ({"include_modes": 1}, "include_modes"),
        ({"unknown_types": "drop"}, "unknown_types"),
        ({"type_map": {"a": 1}}, "type_map.a"),
        ({"frame_interval_s": "fast"}, "frame_interval_s"),
        ({"model": 5}, "model"),
    ],
)  # fmt: skip
async def test_mistyped_and_unknown_fields_are_named(
    http: httpx.AsyncClient, changes: JSON, field: str
) -> None:
    answer = await http.post("/predict", json=body(**changes))
    refusal = http_refusal(answer)
    assert (refusal.kind, refusal.code) == ("INVALID_ARGUMENT", "422")
    assert refusal.fields == (field,)
    assert field in refusal.message


async def test_the_field_of_a_session_id_is_the_one_that_errors_name(
    http: httpx.AsyncClient,
) -> None:
    refusal = http_refusal(await http.post("/v1/sessions", json={"session_id": "a b"}))
    assert refusal.fields == ("session_id",)
    assert http_refusal(await http.post("/v1/sessions", json={"id": "a"})).fields == ("id",)


@pytest.mark.parametrize("value", ["NaN", "Infinity", "-Infinity", "1e999"])
@pytest.mark.parametrize("field", ["x", "time", "seed", "frame_interval_s"])
async def test_literals_that_are_no_numbers_are_named(
    http: httpx.AsyncClient, field: str, value: str
) -> None:
    request = body(seed=1, frame_interval_s=0.4)
    text = re.sub(rf'("{field}": )[^,}}\]]+', rf"\g<1>{value}", json.dumps(request), count=1)
    refusal = http_refusal(await http.post("/predict", content=text))
    assert refusal.code == "422"
    assert refusal.fields[0].rpartition(".")[2] == field


async def test_many_faults_are_told_in_few_words(http: httpx.AsyncClient) -> None:
    crowd = [{"id": k, "type": k, "x": "a", "y": "b"} for k in range(1000)]
    answer = await http.post("/predict", json=body(frames=[frame(0.0, *crowd)]))
    assert answer.status_code == 422
    assert len(answer.content) < 10_000


async def test_problems_have_the_shape_of_rfc_9457(http: httpx.AsyncClient) -> None:
    problem = (await http.post("/predict", json=body(horizon=99))).json()
    assert problem.keys() == {
        "type", "title", "status", "detail", "reason", "violations", "retryable",
    }  # fmt: skip
    assert problem["type"] == "urn:trajectron:problem:INVALID_ARGUMENT"
    assert problem["title"] == "Invalid argument"
    assert problem["status"] == 422
    assert problem["reason"] == "INVALID_ARGUMENT"
    assert problem["retryable"] is False
    [violation] = problem["violations"]
    assert violation["field"] == "horizon"
    assert "60" in violation["description"]


@pytest.mark.parametrize(
    ("verb", "path", "code"),
    [
        ("GET", "/nowhere", 404),
        ("POST", "/v1/sessions/a/b", 404),
        ("POST", "/v1/sessions/a:explode", 405),
        ("GET", "/predict", 405),
        ("DELETE", "/v1/models", 405),
        ("PUT", "/v1/sessions/a", 405),
        ("GET", "/docs/assets/no-such-file.js", 404),
        ("GET", "/docs/assets/../../pyproject.toml", 404),
        ("GET", "/docs/assets/%2e%2e/core.py", 404),
    ],
)
async def test_wrong_paths_and_methods_are_problems_too(
    http: httpx.AsyncClient, verb: str, path: str, code: int
) -> None:
    answer = await http.request(verb, path)
    refusal = http_refusal(answer)
    assert refusal.code == str(code)
    if code == 405:
        assert answer.headers["allow"]


@pytest.mark.parametrize("query", ["page_size=many", "page_size=1.5"])
async def test_mistyped_parameters_are_named(http: httpx.AsyncClient, query: str) -> None:
    refusal = http_refusal(await http.get(f"/v1/sessions?{query}"))
    assert (refusal.code, refusal.fields) == ("422", ("page_size",))


async def test_a_body_announced_too_large_is_refused_unread(service: Service) -> None:
    answer = await raw_exchange(
        service.http_port,
        b"POST /predict HTTP/1.1\r\nHost: x\r\nContent-Length: 999999999999\r\n\r\n",
    )
    assert answer.startswith(b"HTTP/1.1 413 ")
    assert b"application/problem+json" in answer
    assert b'"TOO_LARGE"' in answer


async def test_a_body_without_an_announced_size_is_cut_off_at_the_limit(
    http: httpx.AsyncClient,
) -> None:
    sent = 0

    async def endless() -> Any:
        nonlocal sent
        for _ in range(64 * MAX_MESSAGE_BYTES // 65536):
            sent += 65536
            yield b" " * 65536

    try:
        answer = await http.post("/predict", content=endless())
        assert http_refusal(answer).kind == "TOO_LARGE"
    except httpx.TransportError:
        pass  # the connection was closed on us in the middle of the body: as good an answer
    assert sent < 32 * MAX_MESSAGE_BYTES
    assert (await http.post("/predict", json=body())).status_code == 200


async def test_a_body_just_within_the_limit_is_read(http: httpx.AsyncClient) -> None:
    content = json.dumps(body()).encode()
    padded = content + b" " * (MAX_MESSAGE_BYTES - len(content))
    assert (await http.post("/predict", content=padded)).status_code == 200
    over = http_refusal(await http.post("/predict", content=padded + b" "))
    assert (over.kind, over.code) == ("TOO_LARGE", "413")


async def test_compressed_bodies_are_refused_in_words(http: httpx.AsyncClient) -> None:
    answer = await http.post("/predict", content=b"\x1f\x8b", headers={"Content-Encoding": "gzip"})
    assert "Content-Encoding" in http_refusal(answer).message


async def test_no_http_at_all_harms_nobody(http: httpx.AsyncClient, service: Service) -> None:
    assert b" 400 " in await raw_exchange(service.http_port, b"\x00\x01\x02 nonsense\r\n\r\n")
    assert (await http.post("/predict", json=body())).status_code == 200


async def raw_exchange(port: int, request: bytes) -> bytes:
    """What comes back for some bytes, up to the end of the first answer's body."""
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    try:
        writer.write(request)
        await writer.drain()
        answer = b""
        async with asyncio.timeout(10):
            while chunk := await reader.read(65536):
                answer += chunk
                if b"retryable" in answer:
                    break
        return answer
    finally:
        writer.close()


async def test_a_request_id_is_echoed_or_assigned(http: httpx.AsyncClient) -> None:
    answer = await http.get("/v1/models", headers={"X-Request-Id": "my-id-7"})
    assert answer.headers["x-request-id"] == "my-id-7"
    one, other = [(await http.get("/nowhere")).headers["x-request-id"] for _ in range(2)]
    assert one != other
    for forged in ("a b", "x" * 500, "<script>"):
        answer = await http.get("/healthz", headers={"X-Request-Id": forged})
        assert answer.headers["x-request-id"] != forged


async def test_the_service_says_that_it_is_ready(http: httpx.AsyncClient) -> None:
    for path in ("/healthz", "/readyz"):
        answer = await http.get(path)
        assert (answer.status_code, answer.json()) == (200, {"status": "ok"})


async def test_metrics_measure_routes_not_paths(http: httpx.AsyncClient) -> None:
    await http.post("/predict", json=body())
    await http.get("/v1/sessions/some-secret-name")
    await http.get("/some-other-secret")
    await http.request("SECRET", "/predict")
    answer = await http.get("/metrics")
    assert answer.headers["content-type"].startswith("text/plain; version=")
    text = answer.text
    name = "trajectron_request_duration_seconds_count"
    assert f'{name}{{code="200",method="POST /predict",protocol="http"}}' in text
    assert f'{name}{{code="404",method="GET /v1/sessions/{{session_id}}",protocol="http"}}' in text
    assert f'{name}{{code="404",method="GET unknown",protocol="http"}}' in text
    assert f'{name}{{code="405",method="other /predict",protocol="http"}}' in text
    assert "secret" not in text.lower()


async def test_the_documentation_needs_no_other_host(http: httpx.AsyncClient) -> None:
    page = await http.get("/docs")
    assert page.status_code == 200
    references = re.findall(r"""(?:src|href)=["']([^"']+)""", page.text)
    references += re.findall(r"""url["']?:\s*["']([^"']+)""", page.text)
    assert "/openapi.json" in references
    for reference in references:
        assert reference.startswith(("/", "data:")), reference
        assert not reference.startswith("//"), reference
        if reference.startswith("/"):
            assert (await http.get(reference)).status_code == 200
    assert not re.search(r"https?://", page.text)
    # What the page's script might still ask for, the browser will not fetch.
    policy = page.headers["content-security-policy"]
    assert policy.startswith("default-src 'self'")
    assert "http" not in policy
    assert '"validatorUrl": null' in page.text
    assert (await http.get("/", follow_redirects=True)).url.path == "/docs"


async def test_the_documentation_describes_everything(http: httpx.AsyncClient) -> None:
    openapi = (await http.get("/openapi.json")).json()
    assert openapi["paths"].keys() == {
        "/predict", "/v1/predict", "/v1/models", "/v1/sessions", "/v1/sessions/{session_id}",
        "/v1/sessions/{session_id}:observe", "/v1/sessions/{session_id}:predict",
        "/v1/evaluations", "/v1/evaluations/{evaluation_id}",
        "/v1/evaluations/{evaluation_id}:watch", "/v1/evaluations/{evaluation_id}:cancel",
        "/v1/evaluations/{evaluation_id}/result.json",
        "/v1/evaluations/{evaluation_id}/result.csv",
        "/v1/evaluations/{evaluation_id}/report.html",
        "/healthz", "/readyz", "/metrics",
    }  # fmt: skip
    schemas = openapi["components"]["schemas"]
    for reference in re.findall(r'"#/components/schemas/([^"]+)"', json.dumps(openapi)):
        assert reference in schemas, reference
    for name, schema in schemas.items():
        assert schema.get("description"), name
        for field, described in schema.get("properties", {}).items():
            assert described.get("description"), f"{name}.{field}"
    for path, operations in openapi["paths"].items():
        for verb, operation in operations.items():
            assert operation.get("description"), f"{verb} {path}"
            for code, answer in operation["responses"].items():
                if code >= "400" and path.startswith(("/v1", "/predict")):
                    assert answer["content"].keys() == {"application/problem+json"}
                    example = answer["content"]["application/problem+json"]["example"]
                    assert str(example["status"]) == code
    assert schemas["Agent"]["required"] == ["id", "type", "x", "y"]


async def test_the_examples_of_the_documentation_work(http: httpx.AsyncClient) -> None:
    schemas = (await http.get("/openapi.json")).json()["components"]["schemas"]
    [example] = schemas["PredictRequest"]["examples"]
    assert (await http.post("/predict", json=example)).status_code == 200
    [example] = schemas["CreateSessionRequest"]["examples"]
    path = f"/v1/sessions/{example['session_id']}"
    assert (await http.post("/v1/sessions", json=example)).status_code == 201
    [example] = schemas["ObserveRequest"]["examples"]
    assert (await http.post(f"{path}:observe", json=example)).status_code == 200
    [example] = schemas["PredictSessionRequest"]["examples"]
    assert (await http.post(f"{path}:predict", json=example)).status_code == 200
    assert (await http.delete(path)).status_code == 204


@pytest.mark.parametrize(
    ("charset", "text", "status"),
    [
        # Decodes to a lone surrogate, which no answer can hold.
        ("utf-7", b"+2AA-", 400),
        # Raises an error of its own, after a time quadratic in the text.
        ("punycode", b"xn--a.", 400),
        ("utf-16", b"{}", 400),
        # As it is without a charset: the JSON is read, and lacks its models.
        ("UTF-8", b"{}", 422),
    ],
)
async def test_forms_are_utf_8(
    http: httpx.AsyncClient, charset: str, text: bytes, status: int
) -> None:
    part = b'--B\r\nContent-Disposition: form-data; name="evaluation"\r\n\r\n'
    answer = await http.post(
        "/v1/evaluations",
        content=part + text + b"\r\n--B--\r\n",
        headers={"content-type": f"multipart/form-data; boundary=B; charset={charset}"},
    )
    assert answer.status_code == status, answer.text
