"""Streams that go on by themselves: against a server that breaks off where the test says."""

from __future__ import annotations

import asyncio
import queue
import socket
import threading
from collections.abc import AsyncIterator, Iterator, Sequence
from concurrent import futures
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from typing import Any

import grpc
import pytest
from google.protobuf.timestamp_pb2 import Timestamp
from tests.client.crowd import frame, walking
from tests.process import Served

import trajectron_client as tc
from trajectron_client.resuming import Attempts, Reopening
from trajectron_proto.v1 import trajectron_pb2 as pb
from trajectron_proto.v1 import trajectron_pb2_grpc
from trajectron_service.errors import ErrorKind, ServiceError
from trajectron_service.grpc_errors import status_message

T0 = datetime(2026, 1, 1, tzinfo=UTC)


class Scripted:
    """A service that keeps its sessions and breaks off each stream after so many frames.

    ``script`` has, for each stream in turn, how many frames it takes, how many of these it
    answers, and the status it ends with; afterwards streams go on to their end.
    """

    def __init__(self, script: Sequence[tuple[int, int, str]] = ()) -> None:
        self.script = list(script)
        self.taken: list[int] = []
        self.opened: list[pb.StreamOpen] = []
        self.created = T0
        self.forgotten = 0

    def StreamPredict(  # noqa: N802  the contract's name
        self, request_iterator: Iterator[pb.StreamPredictRequest], context: Any
    ) -> Iterator[pb.StreamPredictResponse]:
        opening = next(request_iterator).open
        self.opened.append(opening)
        created = Timestamp()
        created.FromDatetime(self.created)
        last = len(self.taken) - self.forgotten
        session = pb.Session(id=opening.session_id, create_time=created)
        if last:
            session.last_sequence = last
        takes, answers, end = self.script.pop(0) if self.script else (10_000, 10_000, "")
        if end == "REFUSED":
            context.abort(grpc.StatusCode.UNAVAILABLE, "not today")
        if end == "CROWDED":
            full = ServiceError(ErrorKind.TOO_MANY_STREAMS, "full", retry_after_s=0.05)
            details = status_message(full).SerializeToString()
            context.set_trailing_metadata((("grpc-status-details-bin", details),))
            context.abort(grpc.StatusCode.RESOURCE_EXHAUSTED, "full")
        yield pb.StreamPredictResponse(
            opened=pb.StreamOpened(session=session, resumed=len(self.opened) > 1)
        )
        for number in range(takes):
            request = next(request_iterator, None)
            if request is None:
                return
            sequence = request.frame.sequence
            known = sequence in self.taken
            if not known:
                self.taken.append(sequence)
            outcome = pb.FRAME_OUTCOME_DUPLICATE if known else pb.FRAME_OUTCOME_ACCEPTED
            if number < answers:
                result = pb.FrameResult(outcome=outcome, version=len(self.taken))
                reply = pb.StreamFrameReply(sequence=sequence, result=result)
                yield pb.StreamPredictResponse(reply=reply)
        self._end(context, end)

    def _end(self, context: Any, end: str) -> None:
        if end == "DRAINING":
            error = ServiceError(ErrorKind.DRAINING, "stopping", retry_after_s=0.05)
            details = status_message(error).SerializeToString()
            context.set_trailing_metadata((("grpc-status-details-bin", details),))
        context.abort(grpc.StatusCode.UNAVAILABLE, "broken off")


@contextmanager
def serving(service: Scripted) -> Iterator[str]:
    """Its address."""
    server = grpc.server(futures.ThreadPoolExecutor(8))
    method: Any = grpc.stream_stream_rpc_method_handler
    handler = method(
        service.StreamPredict,
        request_deserializer=pb.StreamPredictRequest.FromString,
        response_serializer=pb.StreamPredictResponse.SerializeToString,
    )
    name = pb.DESCRIPTOR.services_by_name["TrajectronService"].full_name
    handlers = grpc.method_handlers_generic_handler(name, {"StreamPredict": handler})
    server.add_generic_rpc_handlers((handlers,))
    port = server.add_insecure_port("127.0.0.1:0")
    server.start()
    try:
        yield f"127.0.0.1:{port}"
    finally:
        server.stop(0)


BREAKS = [
    pytest.param([(3, 3, "")], id="after the replies"),
    pytest.param([(3, 1, "")], id="with replies lost"),
    pytest.param([(0, 0, ""), (1, 0, ""), (2, 1, ""), (2, 2, "")], id="again and again"),
    pytest.param([(2, 1, ""), (0, 0, "CROWDED"), (0, 0, "CROWDED")], id="to a tenant's limit"),
    pytest.param([(2, 1, "DRAINING"), (0, 0, "REFUSED"), (0, 0, "REFUSED")], id="while it drains"),
]


def test_a_tenants_limit_is_told_to_who_opens_its_first_stream() -> None:
    with serving(Scripted([(0, 0, "CROWDED")])) as target, tc.Client(target) as client:
        with pytest.raises(tc.TooManyStreamsError) as told:
            client.stream(walking(2))
        assert told.value.retry_after_s == 0.05
        assert len(list(client.stream(walking(2), forecast_every_frame=False))) == 2


@pytest.mark.parametrize("script", BREAKS)
def test_every_frame_counts_once_and_has_its_reply(script: list[tuple[int, int, str]]) -> None:
    service = Scripted(script)
    with serving(service) as target, tc.Client(target) as client:
        stream = client.stream(walking(8), forecast_every_frame=False)
        replies = list(stream)
    assert [reply.sequence for reply in replies] == service.taken == list(range(1, 9))
    assert stream.reconnects == sum(end not in ("REFUSED", "CROWDED") for _, _, end in script)
    assert len({opening.session_id for opening in service.opened}) == 1
    assert [opening.must_exist for opening in service.opened] == [False] + [True] * len(script)


@pytest.mark.parametrize("script", BREAKS)
async def test_the_asyncio_stream_goes_on_as_well(script: list[tuple[int, int, str]]) -> None:
    service = Scripted(script)

    async def live() -> AsyncIterator[tc.Frame]:
        for one in walking(8):
            await asyncio.sleep(0)
            yield one

    with serving(service) as target:
        async with tc.AsyncClient(target) as client:
            stream = client.stream(live(), forecast_every_frame=False)
            replies = [reply async for reply in stream]
    assert [reply.sequence for reply in replies] == service.taken == list(range(1, 9))
    assert stream.reconnects == sum(end not in ("REFUSED", "CROWDED") for _, _, end in script)


def test_a_frame_that_comes_while_nobody_is_connected_is_sent_when_somebody_is() -> None:
    service = Scripted([(1, 1, "")])
    frames: queue.Queue[tc.Frame | None] = queue.Queue()
    with serving(service) as target, tc.Client(target) as client:
        stream = client.stream(iter(frames.get, None), forecast_every_frame=False)
        frames.put(frame(0))
        assert next(stream).sequence == 1

        def later() -> None:
            frames.put(frame(1))
            frames.put(None)

        # gRPC's thread of the stream that broke off is waiting for this one.
        threading.Timer(0.3, later).start()
        assert [reply.sequence for reply in stream] == [2]
    assert service.taken == [1, 2]


def test_the_next_address_is_used_when_one_fails() -> None:
    first, second = Scripted([(2, 1, "DRAINING")]), Scripted()
    second.taken = first.taken  # they share a store
    with serving(first) as one, serving(second) as other:
        with tc.Client([one, other]) as client:
            replies = list(client.stream(walking(5), forecast_every_frame=False))
            assert len(replies) == 5
            # Whoever comes next begins where it goes well.
            assert client.stream([], forecast_every_frame=False).reconnects == 0
        assert (len(first.opened), len(second.opened)) == (1, 2)
        with socket.socket() as closed:
            closed.bind(("127.0.0.1", 0))
            nobody = f"127.0.0.1:{closed.getsockname()[1]}"
            with tc.Client([nobody, other]) as client:
                client.stream([], forecast_every_frame=False)
        assert len(second.opened) == 3


def test_it_gives_up_in_the_end_and_says_why() -> None:
    service = Scripted([(1, 1, ""), *[(0, 0, "REFUSED")] * 1000])
    with serving(service) as target:
        with tc.Client(target, reconnect_for_s=0.3) as client:
            stream = client.stream(walking(3), forecast_every_frame=False)
            assert next(stream).sequence == 1
            with pytest.raises(tc.TransportError, match="UNAVAILABLE"):
                next(stream)
        service.script[:0] = [(1, 1, "")]
        with tc.Client(target, reconnect_for_s=0.0) as client:
            stream = client.stream(walking(3), forecast_every_frame=False)
            with pytest.raises(tc.TransportError, match="broken off"):
                list(stream)


def test_acknowledged_frames_that_are_gone_are_not_passed_over_in_silence() -> None:
    service = Scripted([(3, 3, "")])
    with serving(service) as target, tc.Client(target) as client:
        stream = client.stream(walking(6), forecast_every_frame=False)
        for _ in range(3):
            next(stream)
        service.forgotten = 1
        with pytest.raises(tc.SessionLostError, match="up to 2 only"):
            next(stream)
        service.forgotten, service.script = 0, [(1, 1, "")]
        stream = client.stream([frame(9), frame(10)], forecast_every_frame=False)
        next(stream)
        service.created = datetime(2026, 1, 2, tzinfo=UTC)
        with pytest.raises(tc.SessionLostError, match="another session"):
            next(stream)


def test_pauses_grow_have_jitter_and_keep_to_their_time() -> None:
    turns: list[None] = []
    attempts = Attempts(Reopening(1000.0, 2, lambda: turns.append(None)))
    error = tc.TransportError("gone")
    pauses = [attempts.pause_s(error) for _ in range(40)]
    assert len(turns) == 40
    assert max(pauses[:1]) <= 0.05
    assert 0.5 < max(pauses) <= 2.0
    assert len(set(pauses)) == 40
    told = tc.DrainingError("stopping", retry_after_s=4.0)
    alone = Attempts(Reopening(1000.0, 1, lambda: None))
    assert 2.0 <= alone.pause_s(told) <= 6.0
    with pytest.raises(tc.TransportError):
        Attempts(Reopening(0.0, 1, lambda: None)).pause_s(error)


def test_a_session_that_has_to_exist_is_not_made(served: Served) -> None:
    opening = pb.StreamOpen(session_id="nobody-made-it", must_exist=True)
    with grpc.insecure_channel(served.grpc_target) as channel:
        stub = trajectron_pb2_grpc.TrajectronServiceStub(channel)
        call = stub.StreamPredict(iter([pb.StreamPredictRequest(open=opening)]))
        with pytest.raises(grpc.RpcError) as refusal:
            next(call)
        assert refusal.value.code() is grpc.StatusCode.NOT_FOUND


class Tap:
    """A connection in between that falls silent when told to, without a word to either side."""

    def __init__(self, target: str) -> None:
        host, port = target.split(":")
        self._target = (host, int(port))
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._listener.getsockname()[1]
        self.silent = threading.Event()
        self.connections = 0
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self) -> None:
        while True:
            try:
                near, _ = self._listener.accept()
            except OSError:
                return
            self.connections += 1
            far = socket.create_connection(self._target)
            doomed = self.connections == 1
            for source, sink in ((near, far), (far, near)):
                args = (source, sink, doomed)
                threading.Thread(target=self._carry, args=args, daemon=True).start()

    def _carry(self, source: socket.socket, sink: socket.socket, doomed: bool) -> None:
        with suppress(OSError):  # closed by the other side
            while data := source.recv(65536):
                if not (doomed and self.silent.is_set()):
                    sink.sendall(data)

    def close(self) -> None:
        self._listener.close()


def test_a_connection_that_falls_silent_is_left_for_a_new_one() -> None:
    service = Scripted()
    quick = [
        ("grpc.keepalive_time_ms", 500),
        ("grpc.keepalive_timeout_ms", 500),
        ("grpc.http2.ping_timeout_ms", 500),
    ]
    with serving(service) as target:
        tap = Tap(target)
        frames: queue.Queue[tc.Frame | None] = queue.Queue()
        with tc.Client(f"127.0.0.1:{tap.port}", options=quick) as client:
            stream = client.stream(iter(frames.get, None), forecast_every_frame=False)
            frames.put(frame(0))
            assert next(stream).sequence == 1
            tap.silent.set()
            frames.put(frame(1))
            assert next(stream).sequence == 2
            assert stream.reconnects == 1
            frames.put(None)
            assert list(stream) == []
        tap.close()
    assert service.taken == [1, 2]
    assert tap.connections == 2
