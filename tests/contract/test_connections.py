"""Clients that are slow or many: each is cut off, the others never notice."""

from __future__ import annotations

import asyncio
import contextlib
import json
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any, Self

import grpc
import httpx
import pytest
import pytest_asyncio
from tests.contract.scenes import walking
from tests.contract.servers import small_settings

from trajectron_proto.v1 import trajectron_pb2 as pb
from trajectron_proto.v1.trajectron_pb2_grpc import TrajectronServiceStub
from trajectron_service import grpc_server
from trajectron_service.errors import ServiceError
from trajectron_service.http_body import Arriving
from trajectron_service.lifecycle import Service, running

pytestmark = pytest.mark.asyncio(loop_scope="module")

RECEIVE_S = 0.4
CONNECTIONS = 8
CALLS = 4
HEAD = b"POST /predict HTTP/1.1\r\nhost: here\r\n"
NOWHERE = HEAD.replace(b"predict", b"nowhere")
BODY = json.dumps({"frames": walking(), "num_samples": 2}).encode()
WHOLE = HEAD + b"content-length: %d\r\n\r\n" % len(BODY) + BODY

Reader = asyncio.StreamReader
Writer = asyncio.StreamWriter


@pytest_asyncio.fixture(scope="module", loop_scope="module")
async def service(model_path: Path) -> AsyncIterator[Service]:
    settings = small_settings(
        model_path,
        receive_timeout_s=RECEIVE_S,
        max_connections=CONNECTIONS,
        max_calls=CALLS,
    )
    async with running(settings) as service:
        # The first call of a process blocks the loop, the clients' as well, for some time.
        assert await answers(service) == 200
        yield service


@contextlib.asynccontextmanager
async def connection(service: Service) -> AsyncIterator[tuple[Reader, Writer]]:
    reader, writer = await asyncio.open_connection("127.0.0.1", service.http_port)
    try:
        yield reader, writer
    finally:
        writer.close()
        with contextlib.suppress(ConnectionError):
            await writer.wait_closed()


def cut(service: Service, reason: str) -> float:
    name, labels = "trajectron_http_connections_cut_total", {"reason": reason}
    return service.metrics.registry.get_sample_value(name, labels) or 0.0


async def trickle(writer: Writer, head: bytes, piece: bytes) -> None:
    """A beginning, then a little now and then, for ever."""
    writer.write(head)
    with contextlib.suppress(ConnectionError):
        while True:
            writer.write(piece)
            await writer.drain()
            await asyncio.sleep(RECEIVE_S / 10)


@contextlib.asynccontextmanager
async def trickling(writer: Writer, head: bytes, piece: bytes) -> AsyncIterator[None]:
    task = asyncio.create_task(trickle(writer, head, piece))
    try:
        yield
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task


async def answers(service: Service) -> int:
    async with httpx.AsyncClient(timeout=30.0) as client:
        url = f"http://127.0.0.1:{service.http_port}/predict"
        return (await client.post(url, content=BODY)).status_code


async def last_words(reader: Reader) -> bytes:
    """What comes until the connection ends."""
    words = b""
    with contextlib.suppress(ConnectionError):
        async with asyncio.timeout(20.0):
            while piece := await reader.read(4096):
                words += piece
    return words


@pytest.mark.parametrize(
    ("head", "piece", "said"),
    [
        (HEAD, b"x-more: 1\r\n", b"HTTP/1.1 408"),
        (HEAD + b"content-length: 100000\r\n\r\n", b" ", b"HTTP/1.1 408"),
        (HEAD + b"transfer-encoding: chunked\r\n\r\n", b"1\r\n \r\n", b"HTTP/1.1 408"),
        # The second request of a connection, begun at once and behind the first.
        (WHOLE + HEAD, b"x-more: 1\r\n", b"HTTP/1.1 200"),
        # Answered before the body is in: nobody there; the rest is not waited for either.
        (NOWHERE + b"content-length: 100000\r\n\r\n", b" ", b"HTTP/1.1 404"),
    ],
    ids=["headers", "body", "chunks", "second request", "answered"],
)
async def test_a_request_that_trickles_in_ends_and_others_are_answered_meanwhile(
    service: Service, head: bytes, piece: bytes, said: bytes
) -> None:
    before = cut(service, "slow_request")
    async with connection(service) as (reader, writer), trickling(writer, head, piece):
        words = asyncio.create_task(last_words(reader))
        assert await answers(service) == 200
        assert (await words).startswith(said)
    assert cut(service, "slow_request") == before + 1
    assert await answers(service) == 200


async def test_a_connection_that_says_nothing_ends_without_a_word(service: Service) -> None:
    async with connection(service) as (reader, _):
        assert await last_words(reader) == b""


async def test_a_slow_answer_is_no_slow_request(service: Service) -> None:
    before = cut(service, "slow_request")
    async with connection(service) as (reader, writer):
        for _ in range(3):
            writer.write(WHOLE)
            assert (await reader.readline()).startswith(b"HTTP/1.1 200")
            length = 0
            while (line := await reader.readline()) != b"\r\n":
                name, _, value = line.partition(b":")
                length = int(value) if name == b"content-length" else length
            await reader.readexactly(length)
            await asyncio.sleep(1.5 * RECEIVE_S)  # kept open between requests
    assert cut(service, "slow_request") == before


async def test_a_client_that_does_not_read_its_answer_is_cut_off(service: Service) -> None:
    before = cut(service, "slow_reader")
    large = json.dumps({"frames": walking(), "num_samples": 2000, "horizon": 60}).encode()
    async with connection(service) as (_, writer):
        writer.write(HEAD + b"content-length: %d\r\n\r\n" % len(large) + large)
        await writer.drain()
        await _until(lambda: cut(service, "slow_reader") == before + 1)
    assert await answers(service) == 200


async def test_connections_beyond_the_limit_are_told_so_and_it_recovers(service: Service) -> None:
    async with contextlib.AsyncExitStack() as stack:
        for _ in range(CONNECTIONS):
            await stack.enter_async_context(connection(service))
        async with connection(service) as (reader, _):
            words = await last_words(reader)
            assert words.startswith(b"HTTP/1.1 503") and b"retry-after: 1\r\n" in words
        assert cut(service, "too_many") >= 1
    await _until(lambda: _open(service) == 0)
    assert await answers(service) == 200


async def test_calls_beyond_the_limit_are_refused_and_it_recovers(service: Service) -> None:
    async with contextlib.AsyncExitStack() as stack:
        stubs = []
        for number in range(2):  # one connection's streams are bounded by themselves
            options = [("grpc.use_local_subchannel_pool", 1), ("test.number", number)]
            address = f"127.0.0.1:{service.grpc_port}"
            channel = grpc.aio.insecure_channel(address, options=options)
            stubs.append(TrajectronServiceStub(await stack.enter_async_context(channel)))
        streams = [stubs[0].StreamPredict() for _ in range(CALLS)]
        for number, stream in enumerate(streams):
            opened = pb.StreamOpen(session_id=f"many-{number}")
            await stream.write(pb.StreamPredictRequest(open=opened))
            await stream.read()
        with pytest.raises(grpc.aio.AioRpcError) as caught:
            await stubs[1].ListModels(pb.ListModelsRequest())
        assert caught.value.code() is grpc.StatusCode.RESOURCE_EXHAUSTED
        assert "4 calls are open" in (caught.value.details() or "")
        streams[0].cancel()
        async with asyncio.timeout(20.0):
            while True:
                with contextlib.suppress(grpc.aio.AioRpcError):
                    await stubs[1].ListModels(pb.ListModelsRequest())
                    break
        for stream in streams:
            stream.cancel()


async def test_bodies_in_sum_are_bounded(service: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    arriving = Arriving(100_000)
    arriving.take(100_000)
    async with httpx.AsyncClient(timeout=30.0) as client:
        monkeypatch.setattr("trajectron_service.http_body.Arriving.take", arriving.take)
        url = f"http://127.0.0.1:{service.http_port}/predict"
        refused = await client.post(url, content=BODY)
        assert refused.status_code == 429 and refused.json()["type"].endswith("OVERLOADED")
        assert int(refused.headers["retry-after"]) >= 1
    monkeypatch.undo()
    assert await answers(service) == 200


async def test_what_a_body_held_is_given_back() -> None:
    arriving = Arriving(10)
    for _ in range(3):
        arriving.take(10)
        arriving.give_back(10)
    arriving.take(4)
    with pytest.raises(ServiceError, match="too much at once"):
        arriving.take(7)
    arriving.take(6)


class Tap:
    """A connection in between that falls silent when told to, without a word to either side."""

    def __init__(self, port: int) -> None:
        self._port = port
        self._silent = asyncio.Event()
        self._tasks: list[asyncio.Task[None]] = []
        self._server: asyncio.Server | None = None

    async def __aenter__(self) -> Self:
        self._server = await asyncio.start_server(self._join, "127.0.0.1", 0)
        return self

    async def __aexit__(self, *_: object) -> None:
        assert self._server is not None
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        self._server.close()

    @property
    def port(self) -> int:
        assert self._server is not None
        port: int = self._server.sockets[0].getsockname()[1]
        return port

    def fall_silent(self) -> None:
        self._silent.set()

    async def _join(self, near: Reader, near_end: Writer) -> None:
        far, far_end = await asyncio.open_connection("127.0.0.1", self._port)
        for source, sink in ((near, far_end), (far, near_end)):
            self._tasks.append(asyncio.create_task(self._carry(source, sink)))

    async def _carry(self, source: Reader, sink: Writer) -> None:
        with contextlib.suppress(ConnectionError):
            while data := await source.read(65536):
                if not self._silent.is_set():
                    sink.write(data)
                    await sink.drain()


async def test_a_stream_whose_connection_fell_silent_is_ended_and_what_it_held_is_free(
    model_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(grpc_server, "_KEEPALIVE_MS", 500)
    monkeypatch.setattr(grpc_server, "_KEEPALIVE_TIMEOUT_MS", 500)
    opening = pb.StreamPredictRequest(open=pb.StreamOpen(session_id="silent"))
    async with running(small_settings(model_path)) as service, Tap(service.grpc_port) as tap:
        streams = service.metrics.streams._value
        async with grpc.aio.insecure_channel(f"127.0.0.1:{tap.port}") as channel:
            stream = TrajectronServiceStub(channel).StreamPredict()
            await stream.write(opening)
            opened: Any = await stream.read()
            assert opened.opened.session.id == "silent"
            assert streams.get() == 1
            await asyncio.sleep(1.5)  # answers pings: it stays
            assert streams.get() == 1
            tap.fall_silent()
            await _until(lambda: streams.get() == 0)
            async with grpc.aio.insecure_channel(f"127.0.0.1:{service.grpc_port}") as direct:
                again = TrajectronServiceStub(direct).StreamPredict()
                await again.write(opening)
                opened = await again.read()
                assert opened.opened.resumed
                again.cancel()


def _open(service: Service) -> float:
    return service.metrics.registry.get_sample_value("trajectron_http_connections") or 0.0


async def _until(holds: Callable[[], bool]) -> None:
    async with asyncio.timeout(20.0):
        while not holds():  # noqa: ASYNC110 - what it waits for tells nobody
            await asyncio.sleep(0.02)
