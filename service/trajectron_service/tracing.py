"""What the service tells of single requests: the interface of tracing, and tracing switched off.

Knows no tracing library, so that the service runs without one: ``telemetry`` has the form
that exports spans (OpenTelemetry). Everything here costs next to nothing.

A call has a span, continued from the client's ``traceparent``; below it are the stages of its
way. Work for the inference thread takes a *ticket* along, because a batch belongs to several
calls at once.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import NewType, Protocol

# Says which call a job belongs to; None when that call is not traced.
Ticket = NewType("Ticket", object)

TRACEPARENT = "traceparent"
CARRIED = (TRACEPARENT, "tracestate")
"""What clients send and what is sent back: headers over HTTP, metadata over gRPC."""


class Call(Protocol):
    """A call being traced."""

    @property
    def traceparent(self) -> str | None:
        """What to send back, so that the client finds the trace; None when there is none."""
        ...

    def end(self, method: str, code: str, *, failed: bool) -> None:
        """It has been answered; ``failed``: by a fault of the service."""
        ...


class Tracing(Protocol):
    """Told of calls, stages and batches."""

    def call(self, protocol: str, method: str, carried: Mapping[str, str]) -> Call:
        """Begins a call, in a task of its own: what that task does from now on is below it.

        Args:
            protocol: ``http`` or ``grpc``.
            method: as far as it is known yet.
            carried: of the request, whatever of ``CARRIED`` came.
        """
        ...

    def stage(self, name: str) -> AbstractContextManager[object]:
        """A stage of the call that the running task is in."""
        ...

    def ticket(self) -> Ticket | None:
        """For a job that the running task is about to queue."""
        ...

    def batch(self, tickets: Sequence[Ticket | None]) -> AbstractContextManager[object]:
        """A batch of jobs with these tickets runs on the inference thread: their wait is over."""
        ...

    def staged(self, name: str, seconds: float) -> None:
        """A stage of the batch that is running has just ended, after so long."""
        ...

    def close(self) -> None:
        """Sends what has not been sent; may take some seconds."""
        ...


class _NoCall:
    """A call that nobody traces."""

    traceparent: str | None = None

    def end(self, method: str, code: str, *, failed: bool) -> None:
        """Nothing to tell."""


class NoTracing:
    """Tracing switched off."""

    _call = _NoCall()
    _nothing: AbstractContextManager[object] = nullcontext()

    def call(self, protocol: str, method: str, carried: Mapping[str, str]) -> Call:
        """A call that nobody traces."""
        return self._call

    def stage(self, name: str) -> AbstractContextManager[object]:
        """Nothing."""
        return self._nothing

    def ticket(self) -> None:
        """None."""

    def batch(self, tickets: Sequence[Ticket | None]) -> AbstractContextManager[object]:
        """Nothing."""
        return self._nothing

    def staged(self, name: str, seconds: float) -> None:
        """Nothing."""

    def close(self) -> None:
        """Nothing."""


OFF = NoTracing()
