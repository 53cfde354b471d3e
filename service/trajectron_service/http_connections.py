"""HTTP connections of clients that are slow or many, on purpose or not.

uvicorn bounds neither how long a request may take to arrive nor how many connections there
are; each would cost memory and a file descriptor for as long as the client likes. Here a request
has a time to arrive whole, an answer must move, and connections beyond a number are told so.
"""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from typing import Any, ClassVar

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol

from trajectron_service.metrics import Metrics

# For the last words to be read, before the connection is closed hard.
_LINGER_S = 1.0
_LINE = "HTTP/1.1 {status}\r\nconnection: close\r\ncontent-length: 0\r\n{more}\r\n"
_SLOW = _LINE.format(status="408 Request Timeout", more="").encode()
_FULL = _LINE.format(status="503 Service Unavailable", more="retry-after: 1\r\n").encode()


@dataclass(frozen=True)
class ConnectionLimits:
    """What a client may do with connections.

    Attributes:
        connections: open at once, all clients together.
        receive_s: for a request to arrive whole, from its first byte, or from the beginning of a
            connection that says nothing; and for an answer to move at all.
    """

    connections: int
    receive_s: float


def bounded_protocol(limits: ConnectionLimits, metrics: Metrics) -> type[asyncio.Protocol]:
    """uvicorn's protocol for HTTP/1.1 within limits; ``metrics`` hear of those cut off."""

    class Bounded(_BoundedProtocol):
        limits_ = limits
        metrics_ = metrics

    return Bounded


class _BoundedProtocol(H11Protocol):
    limits_: ClassVar[ConnectionLimits]
    metrics_: ClassVar[Metrics]

    def __init__(self, *arguments: Any, **named: Any) -> None:
        super().__init__(*arguments, **named)
        self._arrival: asyncio.TimerHandle | None = None  # runs while a request is awaited
        self._stuck: asyncio.TimerHandle | None = None  # runs while an answer waits to be read
        self._waiting_bytes = 0
        self._cut = False

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        # Counted up and down: each port has its own connections, and all have this one metric.
        self.metrics_.http_connections.inc()
        if len(self.connections) > self.limits_.connections:
            self._cut_off("too_many", _FULL)
        else:
            self._await_request()

    def connection_lost(self, exc: Exception | None) -> None:
        self._arrived()
        self._moves()
        super().connection_lost(exc)
        self.metrics_.http_connections.dec()

    def data_received(self, data: bytes) -> None:
        if self._cut:
            return
        if self._arrival is None:
            self._await_request()
        super().data_received(data)
        self._look()

    def on_response_complete(self) -> None:
        super().on_response_complete()
        # A request behind this one may have begun already; the rest of this one may not be in.
        if self._arrival is None and self.conn.their_state is h11.SEND_BODY:
            self._await_request()
        self._look()

    def pause_writing(self) -> None:
        super().pause_writing()
        self._waiting_bytes = self.transport.get_write_buffer_size()
        self._stuck = self.loop.call_later(self.limits_.receive_s, self._see_if_it_moves)

    def resume_writing(self) -> None:
        super().resume_writing()
        self._moves()

    def _await_request(self) -> None:
        self._arrival = self.loop.call_later(self.limits_.receive_s, self._too_slow)

    def _look(self) -> None:
        """Whether the request that was awaited is whole."""
        if self.conn.their_state not in (h11.IDLE, h11.SEND_BODY):
            self._arrived()

    def _arrived(self) -> None:
        if self._arrival is not None:
            self._arrival.cancel()
            self._arrival = None

    def _moves(self) -> None:
        if self._stuck is not None:
            self._stuck.cancel()
            self._stuck = None

    def _too_slow(self) -> None:
        self._arrival = None
        answered = self.conn.our_state not in (h11.IDLE, h11.SEND_RESPONSE)
        silent = self.conn.their_state is h11.IDLE and not self.conn.trailing_data[0]
        self._cut_off("slow_request", b"" if answered or silent else _SLOW)

    def _see_if_it_moves(self) -> None:
        left = self.transport.get_write_buffer_size()
        if left < self._waiting_bytes:
            self._waiting_bytes = left
            self._stuck = self.loop.call_later(self.limits_.receive_s, self._see_if_it_moves)
            return
        self._stuck = None
        self.metrics_.connections_cut.labels("slow_reader").inc()
        self.transport.abort()

    def _cut_off(self, reason: str, last_words: bytes) -> None:
        """Ends the connection; what is on its way is not looked at any more."""
        self._cut = True
        self.metrics_.connections_cut.labels(reason).inc()
        if self.transport.is_closing():
            return
        if last_words and self.transport.can_write_eof():
            # Closed at once while the client still sends, it would lose our last words.
            self.transport.write(last_words)
            self.transport.write_eof()
        else:
            self.transport.write(last_words)
            self.transport.close()
        self.loop.call_later(_LINGER_S, self.transport.abort)
