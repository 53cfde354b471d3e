"""How a stream goes on after its connection broke: when, where, and after which frame.

A frame that was sent is kept until its reply has come. After a break the stream is opened again,
on the next address, and everything without a reply is sent again under its old number: what the
service has already, it calls a duplicate, so that every frame counts once.
"""

from __future__ import annotations

import random
import time
from collections.abc import Callable
from dataclasses import dataclass

import grpc

from trajectron_client import protobuf
from trajectron_client.exceptions import (
    DrainingError,
    ResourceExhaustedError,
    SessionLostError,
    StoreUnavailableError,
    TrajectronError,
    TransportError,
)
from trajectron_client.grpc_errors import from_rpc_error
from trajectron_client.replies import SessionInfo
from trajectron_client.scene import Frame, StreamFrame
from trajectron_proto.v1 import trajectron_pb2 as pb

_FIRST_PAUSE_S = 0.05
_LONGEST_PAUSE_S = 2.0
# What gRPC itself says of a connection that broke; the service's own errors have details.
_BROKEN = frozenset({"UNAVAILABLE", "UNKNOWN", "INTERNAL"})


@dataclass(frozen=True)
class Reopening:
    """What a stream needs to know to go on.

    Attributes:
        within_s: how long it tries after a break; 0 for not at all.
        addresses: how many there are.
        turn: makes the next address the one that calls go to.
    """

    within_s: float
    addresses: int
    turn: Callable[[], None]


class Attempts:
    """The attempts to go on since the last reply: bounded in time, ever further apart."""

    def __init__(self, reopening: Reopening) -> None:
        self._reopening = reopening
        self._number = 0
        self._until = 0.0

    def succeeded(self) -> None:
        """A reply has come: the next break is a new one."""
        self._number = 0

    def pause_s(self, error: TrajectronError) -> float:
        """How long to wait before the next attempt, with jitter; turns to the next address.

        Raises:
            TrajectronError: ``error``, when the time is over.
        """
        now = time.monotonic()
        if self._number == 0:
            self._until = now + self._reopening.within_s
        longest = min(_LONGEST_PAUSE_S, _FIRST_PAUSE_S * 2.0 ** min(self._number, 10))
        pause_s = random.uniform(0.0, longest)
        told_s = getattr(error, "retry_after_s", None)
        if told_s and self._reopening.addresses == 1:
            pause_s = told_s * random.uniform(0.5, 1.5)
        if now + pause_s >= self._until:
            raise error
        self._number += 1
        self._reopening.turn()
        return float(pause_s)


def broken(error: grpc.RpcError) -> TrajectronError:
    """The client's exception for a broken stream that can go on; raises that of any other."""
    told = from_rpc_error(error)
    if isinstance(told, (DrainingError, StoreUnavailableError)):
        return told
    if isinstance(told, ResourceExhaustedError) and told.retry_after_s is not None:
        return told  # of a stream that is opened: quotas of the tenant, for the moment
    if type(told) is TransportError and error.code().name in _BROKEN:
        return told
    raise told from error


def again(opening: pb.StreamOpen, session: SessionInfo) -> pb.StreamOpen:
    """The message that opens the same stream again: its session has to be there."""
    copy = pb.StreamOpen()
    copy.CopyFrom(opening)
    copy.session_id = session.id
    copy.must_exist = True
    return copy


def same_session(before: SessionInfo, now: SessionInfo, acknowledged: int) -> None:
    """Raises ``SessionLostError`` where the service has another session, or less of it, now.

    Args:
        before: as it was when the stream began.
        now: as it is when the stream is opened again.
        acknowledged: the highest number that a reply has named.
    """
    if now.created_at != before.created_at:
        raise SessionLostError(f"another session is open as {before.id!r} now")
    if (now.last_sequence or 0) < acknowledged:
        raise SessionLostError(
            f"the service has frames up to {now.last_sequence or 0} only, and had acknowledged "
            f"{acknowledged}: its store has lost them"
        )


class Numbering:
    """Numbers the frames of a stream on from the last one that the session acknowledged."""

    def __init__(self, session: SessionInfo) -> None:
        self._last = session.last_sequence or 0

    def request(self, value: Frame | StreamFrame) -> pb.StreamPredictRequest:
        """The message for a frame, under its own number or the next one."""
        item = StreamFrame(value) if isinstance(value, Frame) else value
        self._last = self._last + 1 if item.sequence is None else item.sequence
        own = None if item.options is None else protobuf.forecast_options(**item.options)
        return pb.StreamPredictRequest(
            frame=pb.StreamFrame(sequence=self._last, frame=protobuf.frame(item.frame), options=own)
        )
