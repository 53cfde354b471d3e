"""Hostile input by the thousand: over HTTP from the OpenAPI document, over gRPC from the protos.

    python scripts/fuzz.py [--cases 20000] [--seed 0] [--json benchmarks/results/fuzz.json]

HTTP cases are schemathesis's, half of them against the document. gRPC cases are messages of
random fields, such messages with bytes changed, and random bytes, several at once. No case may
be answered 500, 501 or 502, INTERNAL, UNKNOWN or UNIMPLEMENTED, nor be left without an answer; the
service has to live, its memory to stay, a session that nobody names to stay as it was, and one
that is named to change by no call that is refused. Exits 1 otherwise.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import random
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

import grpc
import httpx
import schemathesis
from google.protobuf import message_factory
from google.protobuf.descriptor import FieldDescriptor, MethodDescriptor
from google.protobuf.message import Message
from hypothesis import HealthCheck, Phase, given, seed, settings
from schemathesis import GenerationMode

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.evaluation_load import service as running_service
from benchmarks.processes import child, resident_bytes
from trajectron_client import Client, Frame
from trajectron_proto.v1 import evaluation_pb2, trajectron_pb2

_AT_ONCE = 8
# Four times what the service allows itself: who hears nothing until then is left without an answer.
_TIMEOUT_S = 20.0
_HUNG = "no answer"
_FORBIDDEN_STATUS = {500, 501, 502}
_FORBIDDEN_CODES = {"INTERNAL", "UNKNOWN", "UNIMPLEMENTED", _HUNG}
# Cases that name a session, one at a time, between two looks at it.
_NAMING_SHARE = 0.02
# schemathesis takes a tenth of a second to think of a case.
_HTTP_SHARE = 0.1
# Caches and pools fill in the beginning.
_WARM_UP_SHARE = 0.2
_MOST_GROWTH = 0.05
# Answers that go on for as long as an evaluation does.
_ENDLESS = (":watch",)
_NUMBERS = (0, 1, -1, 2**31 - 1, -(2**31), 2**63 - 1, -(2**63), 315_576_000_000, 7)
_FLOATS = (0.0, -0.0, 1.5, float("nan"), float("inf"), -float("inf"), 1e308, 5e-324, 1e9)
_TEXTS = (
    "",
    "a",
    "pedestrian",
    "../../etc/passwd",
    "x" * 3000,
    "\u202e\u0000\n\r\x1b[31m",
    "ü" * 9,
)


def main() -> None:
    """Runs all cases, prints the verdict, writes the report."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--cases", type=int, default=20_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--model", default="eth_ucy", help="served: a name or a path")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    arguments.priority = "idle"
    os.environ |= {
        "TRAJECTRON_STORE": "memory",
        "TRAJECTRON_REQUEST_TIMEOUT_S": "5",
        # A frame of few agents and a forecast of few points: cases are many, not heavy.
        "TRAJECTRON_MAX_FORECAST_POINTS": "20000",
    }
    with (
        tempfile.TemporaryDirectory() as folder,
        running_service(arguments, Path(folder)) as (http_port, grpc_port),
    ):
        report = _run(arguments, http_port, grpc_port)
    print(json.dumps(report, indent=1))
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    sys.exit(0 if report["passed"] else 1)


def _run(arguments: argparse.Namespace, http_port: int, grpc_port: int) -> dict[str, Any]:
    pid = child()
    over_http = int(_HTTP_SHARE * arguments.cases)
    naming = int(_NAMING_SHARE * arguments.cases)
    over_grpc = arguments.cases - over_http - naming
    url, target = f"http://127.0.0.1:{http_port}", f"127.0.0.1:{grpc_port}"
    with Client(target, timeout_s=30.0) as client:
        session, named = (_walked(client) for _ in range(2))
        before = client.get_session(session)
    answers = {"http": Counter[str](), "grpc": Counter[str]()}
    faults: list[str] = []
    warm = int(_WARM_UP_SHARE * over_grpc)
    _fuzz_http(url, over_http, arguments.seed, answers["http"], faults)
    asyncio.run(_fuzz_grpc(target, warm, arguments.seed + 1, answers["grpc"], faults))
    resident = resident_bytes(pid)
    asyncio.run(_fuzz_grpc(target, over_grpc - warm, arguments.seed, answers["grpc"], faults))
    growth = resident_bytes(pid) / resident - 1.0
    refused = _fuzz_named(target, named, naming, arguments.seed, answers["grpc"], faults)
    with Client(target, timeout_s=30.0) as client:
        after = client.get_session(session)
    untouched = (before.info.version, before.graph) == (after.info.version, after.graph)
    alive = httpx.get(f"{url}/healthz", timeout=30.0).is_success
    return {
        "cases": sum(counts.total() for counts in answers.values()),
        "answers": {name: dict(counts.most_common()) for name, counts in answers.items()},
        "memory_growth": growth,
        "session_untouched": untouched,
        "refused_of_those_naming_a_session": refused,
        "alive": alive,
        "faults": faults[:20],
        "passed": not faults and untouched and alive and growth < _MOST_GROWTH,
    }


def _walked(client: Client) -> str:
    """A session with two agents who have walked three steps."""
    session = client.create_session()
    for step in range(3):
        places = [(0.4 * step, 0.0), (0.0, 0.5 * step)]
        client.observe(session.id, Frame.from_arrays(0.4 * step, ["a", "b"], places))
    return session.id


def _fuzz_named(
    target: str, session: str, cases: int, first: int, answers: Counter[str], faults: list[str]
) -> int:
    """Calls that name a session: one that is refused leaves it as it was. How many were."""
    draw = random.Random(first + 2)
    methods = [
        method
        for method in trajectron_pb2.DESCRIPTOR.services_by_name["TrajectronService"].methods
        if "session_id" in method.input_type.fields_by_name and method.name != "DeleteSession"
    ]
    refused = 0
    with Client(target, timeout_s=30.0) as client, grpc.insecure_channel(target) as channel:
        for number in range(cases):
            method = methods[number % len(methods)]
            message = message_factory.GetMessageClass(method.input_type)()
            _fill(draw, message, 0)
            setattr(message, "session_id", session)  # noqa: B010 - known of a descriptor alone
            before = client.get_session(session)
            path = f"/{method.containing_service.full_name}/{method.name}"
            code = _unary(channel.unary_unary(path), message.SerializeToString())
            after = client.get_session(session)
            answers[code] += 1
            refused += code != "OK"
            changed = (before.info.version, before.graph) != (after.info.version, after.graph)
            if code in _FORBIDDEN_CODES or (changed and code != "OK"):
                faults.append(f"{method.full_name}: {code}, changed: {changed}: {message}"[:500])
    return refused


def _fuzz_http(url: str, cases: int, first: int, answers: Counter[str], faults: list[str]) -> None:
    """About as many cases, shared among operations; half against the document."""
    schema: Any = schemathesis.openapi.from_url(f"{url}/openapi.json")
    operations = [
        operation
        for operation in (result.ok() for result in schema.get_all_operations())
        if not operation.path.endswith(_ENDLESS)
    ]
    each = max(1, cases // (2 * len(operations)))
    with httpx.Client(base_url=url, timeout=30.0) as caller:
        for operation in operations:
            for mode in (GenerationMode.POSITIVE, GenerationMode.NEGATIVE):
                _fuzz_operation(operation, mode, each, first, caller, answers, faults)


def _fuzz_operation(
    operation: Any,
    mode: GenerationMode,
    cases: int,
    first: int,
    caller: httpx.Client,
    answers: Counter[str],
    faults: list[str],
) -> None:
    @seed(first)
    @settings(
        max_examples=cases,
        deadline=None,
        database=None,
        phases=(Phase.generate,),
        suppress_health_check=list(HealthCheck),
    )
    @given(case=operation.as_strategy(generation_mode=mode))
    def send(case: Any) -> None:
        response = case.call(timeout=30.0)
        answers[str(response.status_code)] += 1
        if response.status_code in _FORBIDDEN_STATUS:
            faults.append(f"{case.as_curl_command()[:500]}: {response.status_code}")

    del caller
    try:
        send()
    except Exception as error:  # noqa: BLE001 - an operation that cannot be negated has no cases
        if "negat" not in str(error).lower() and "Unsatisfiable" not in type(error).__name__:
            faults.append(f"{operation.label}: {type(error).__name__}: {error}"[:500])


async def _fuzz_grpc(
    target: str, cases: int, first: int, answers: Counter[str], faults: list[str]
) -> None:
    methods = [
        method
        for file in (trajectron_pb2, evaluation_pb2)
        for service in file.DESCRIPTOR.services_by_name.values()
        for method in service.methods
    ]
    draw = random.Random(first)
    gate = asyncio.Semaphore(_AT_ONCE)
    blocking = grpc.insecure_channel(target)
    async with grpc.aio.insecure_channel(target) as channel:

        async def one(number: int) -> None:
            method = methods[number % len(methods)]
            requests = [_bytes(draw, method) for _ in range(draw.randint(1, 4))]
            if method.client_streaming and draw.random() < 0.7:
                opening = trajectron_pb2.StreamOpen(close_session_at_end=True)
                request = trajectron_pb2.StreamPredictRequest(open=opening)
                requests.insert(0, request.SerializeToString())
            async with gate:
                code = await _call(channel, blocking, method, requests)
            answers[code] += 1
            if code in _FORBIDDEN_CODES:
                faults.append(f"{method.full_name}: {code}: {requests[0][:200].hex()}")

        await asyncio.gather(*(one(number) for number in range(cases)))
    blocking.close()


def _bytes(draw: random.Random, method: MethodDescriptor) -> bytes:
    """A message, one with bytes changed, or no message at all."""
    kind = draw.random()
    if kind < 0.1:
        return draw.randbytes(draw.randint(0, 200))
    message = message_factory.GetMessageClass(method.input_type)()
    _fill(draw, message, 0)
    data = bytearray(message.SerializeToString())
    if kind < 0.5:
        for _ in range(draw.randint(1, 5)):
            if data:
                data[draw.randrange(len(data))] = draw.randrange(256)
    return bytes(data)


def _fill(draw: random.Random, message: Message, depth: int) -> None:
    """Some fields, with values at their edges."""
    for field in message.DESCRIPTOR.fields:
        if depth > 5 or draw.random() < 0.25:
            continue
        if field.message_type is not None and field.message_type.GetOptions().map_entry:
            continue
        if field.is_repeated:
            values = getattr(message, field.name)
            for _ in range(draw.randint(0, 3)):
                if field.message_type is not None:
                    _fill(draw, values.add(), depth + 1)
                else:
                    values.append(_value(draw, field))
        elif field.message_type is not None:
            inner = getattr(message, field.name)
            inner.SetInParent()
            _fill(draw, inner, depth + 1)
        else:
            setattr(message, field.name, _value(draw, field))


def _value(draw: random.Random, field: Any) -> Any:
    if field.cpp_type in (FieldDescriptor.CPPTYPE_DOUBLE, FieldDescriptor.CPPTYPE_FLOAT):
        return draw.choice(_FLOATS) if draw.random() < 0.5 else draw.uniform(-10.0, 10.0)
    if field.cpp_type == FieldDescriptor.CPPTYPE_BOOL:
        return draw.random() < 0.5
    if field.type == FieldDescriptor.TYPE_BYTES:
        return draw.randbytes(draw.randint(0, 50))
    if field.cpp_type == FieldDescriptor.CPPTYPE_STRING:
        return draw.choice(_TEXTS)
    if field.cpp_type == FieldDescriptor.CPPTYPE_ENUM:
        return draw.choice((0, 1, 2, 3, 99))
    bits = 64 if "64" in str(field.cpp_type) or field.cpp_type in (2, 4) else 32
    signed = field.cpp_type in (FieldDescriptor.CPPTYPE_INT32, FieldDescriptor.CPPTYPE_INT64)
    least, most = (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1) if signed else (0, 2**bits - 1)
    return max(least, min(most, draw.choice(_NUMBERS)))


async def _call(
    channel: Any, blocking: Any, method: MethodDescriptor, requests: list[bytes]
) -> str:
    path = f"/{method.containing_service.full_name}/{method.name}"
    began = time.monotonic()
    try:
        async with asyncio.timeout(2.0 * _TIMEOUT_S):
            if method.client_streaming:
                return await asyncio.to_thread(_stream, blocking.stream_stream(path), requests)
            if method.server_streaming:
                call = channel.unary_stream(path)(requests[0], timeout=_TIMEOUT_S)
                async for _ in call:
                    pass
            else:
                await channel.unary_unary(path)(requests[0], timeout=_TIMEOUT_S)
    except grpc.RpcError as error:
        return _said(error, began)
    except TimeoutError:
        return _HUNG
    return "OK"


def _said(error: Any, began: float) -> str:
    """The code of a call's end; one that our own deadline made is no answer of the service."""
    code = str(error.code().name)
    waited_s = time.monotonic() - began
    return _HUNG if code == "DEADLINE_EXCEEDED" and waited_s > 0.95 * _TIMEOUT_S else code


def _unary(call: Any, request: bytes) -> str:
    began = time.monotonic()
    try:
        call(request, timeout=_TIMEOUT_S)
    except grpc.RpcError as error:
        return _said(error, began)
    return "OK"


def _stream(call: Any, requests: list[bytes]) -> str:
    """The status that the server ended a stream with.

    By the synchronous API: that of asyncio makes an INTERNAL of its own where it was still
    writing when the server ended the stream.
    """
    began = time.monotonic()
    try:
        for _ in call(iter(requests), timeout=_TIMEOUT_S):
            pass
    except grpc.RpcError as error:
        return _said(error, began)
    return "OK"


if __name__ == "__main__":
    main()
