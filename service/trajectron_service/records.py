"""What a session is at one version, as a value, and as bytes for a store."""

from __future__ import annotations

import dataclasses
import struct
from dataclasses import dataclass
from typing import Any

import numpy as np
import orjson

from trajectron_service.messages import SessionConfig, SessionInfo, UnknownTypes
from trajectron_service.scenes import States, no_states
from trajectron_service.timebase import Committed, Grid, Observation, Seen, Timeline

_MAGIC = b"TJS1"
_LENGTH = struct.Struct("<Q")


class RecordError(ValueError):
    """Bytes that are no session, or one of a format that this server does not know."""


@dataclass(frozen=True, eq=False)
class SceneRecord:
    """A session at one version: nothing in it changes, an accepted frame makes the next one.

    Attributes:
        config: resolved, every field set.
        model_hash: of the weights that made the states.
        created_at: Unix seconds.
        version: frames accepted so far.
        last_sequence: the highest acknowledged on a stream, None before one.
        timeline: the frames so far.
        states: the scene's states, in the order of ``timeline.committed``.
        edge_count: edges of the newest state.
    """

    config: SessionConfig
    model_hash: str
    created_at: float
    timeline: Timeline
    version: int = 0
    last_sequence: int | None = None
    states: States = dataclasses.field(default_factory=no_states)
    edge_count: int = 0

    @property
    def agent_count(self) -> int:
        """Agents in the scene, those missing but not timed out included."""
        return len(self.timeline.seen)

    @property
    def model(self) -> str:
        """The name of the session's model."""
        assert self.config.model is not None  # resolved
        return self.config.model

    @property
    def idle_timeout_s(self) -> float:
        """How long the session may be unused."""
        assert self.config.idle_timeout_s is not None  # resolved
        return self.config.idle_timeout_s

    def info(self, session_id: str, expires_at: float) -> SessionInfo:
        """The session as clients see it."""
        newest = self.timeline.newest
        return SessionInfo(
            id=session_id,
            config=self.config,
            dt_s=self.timeline.grid.dt_s,
            version=self.version,
            created_at=self.created_at,
            expires_at=expires_at,
            last_frame_time=None if newest is None else newest.time_s,
            agent_count=self.agent_count,
            last_sequence=self.last_sequence,
        )


def encode(record: SceneRecord, packed: bytes) -> bytes:
    """The record with its states as the engine packed them."""
    timeline = record.timeline
    newest = timeline.newest
    head = {
        "config": {**dataclasses.asdict(record.config)},
        "model_hash": record.model_hash,
        "created_at": record.created_at,
        "version": record.version,
        "last_sequence": record.last_sequence,
        "edge_count": record.edge_count,
        "grid": dataclasses.astuple(timeline.grid),
        "newest": newest and [newest.time_s, newest.ids, newest.types, newest.positions.tolist()],
        "seen": {agent: tuple(last) for agent, last in timeline.seen.items()},
        "departed": timeline.departed,
        "committed": [
            (state.serial, state.time_s, sorted(state.ids), sorted(state.pending))
            for state in timeline.committed
        ],
        "next_serial": timeline.next_serial,
    }
    text = orjson.dumps(head)
    return b"".join((_MAGIC, _LENGTH.pack(len(text)), text, packed))


def decode(data: bytes) -> SceneRecord:
    """The inverse of ``encode``; the states stay bytes until the engine needs them.

    Raises:
        RecordError: these bytes are no record.
    """
    start = len(_MAGIC) + _LENGTH.size
    if data[: len(_MAGIC)] != _MAGIC or len(data) < start:
        raise RecordError("these bytes are no session of this format")
    end = start + _LENGTH.unpack_from(data, len(_MAGIC))[0]
    try:
        head = orjson.loads(data[start:end])
        return SceneRecord(
            config=_config(head["config"]),
            model_hash=head["model_hash"],
            created_at=head["created_at"],
            timeline=_timeline(head),
            version=head["version"],
            last_sequence=head["last_sequence"],
            states=data[end:] or no_states(),
            edge_count=head["edge_count"],
        )
    except (orjson.JSONDecodeError, KeyError, TypeError, ValueError) as error:
        raise RecordError(f"this session's record is damaged: {error}") from error


def _config(fields: dict[str, Any]) -> SessionConfig:
    return SessionConfig(**{**fields, "unknown_types": UnknownTypes(fields["unknown_types"])})


def _timeline(head: dict[str, Any]) -> Timeline:
    newest = head["newest"]
    return Timeline(
        grid=Grid(*head["grid"]),
        newest=newest and _observation(*newest),
        seen={agent: Seen(*last) for agent, last in head["seen"].items()},
        departed=tuple(head["departed"]),
        committed=tuple(
            Committed(serial, time_s, frozenset(ids), frozenset(pending))
            for serial, time_s, ids, pending in head["committed"]
        ),
        next_serial=head["next_serial"],
    )


def _observation(
    time_s: float, ids: list[str], types: list[str], positions: list[list[float]]
) -> Observation:
    places = np.array(positions, dtype=np.float64).reshape(-1, 2)
    return Observation(time_s, tuple(ids), tuple(types), places)
