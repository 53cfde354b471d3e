"""What a session is at one version, as a value, and as bytes for a store."""

from __future__ import annotations

import dataclasses
import hashlib
import struct
import zlib
from dataclasses import dataclass
from typing import Any

import numpy as np
import orjson
from numpy.typing import NDArray

from trajectron_service.messages import SessionConfig, SessionInfo, UnknownTypes
from trajectron_service.scenes import States, no_states
from trajectron_service.timebase import Committed, Grid, Observation, Seen, Timeline

# magic, version, checksum of the rest; length of the head, head, packed states.
_MAGIC = b"TJS"
_VERSION = b"\x02"
_CHECKSUM_BYTES = 8
_LENGTH = struct.Struct("<I")
# Higher levels gain little on names and cost more than the rest of the write.
_LEVEL = 1


class RecordError(ValueError):
    """Bytes that are no session, or not as they were written."""


class UnknownFormatError(RecordError):
    """A session in a format that this version of the service does not know."""


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
    """The record with its states as the engine packed them.

    Every id and type is written once and named by its place after that; the newest frame's
    agents stand where they were last seen, so only their places are written again.
    """
    timeline = record.timeline
    ids = _Names()
    types = _Names()
    seen = [(ids.place(agent), types.place(last.type)) for agent, last in timeline.seen.items()]
    newest = timeline.newest
    head = {
        "config": dataclasses.asdict(record.config),
        "model_hash": record.model_hash,
        "created_at": record.created_at,
        "version": record.version,
        "last_sequence": record.last_sequence,
        "edge_count": record.edge_count,
        "grid": dataclasses.astuple(timeline.grid),
        "newest": newest and (newest.time_s, [ids.place(agent) for agent in newest.ids]),
        "seen_types": [place for _, place in seen],
        "departed": timeline.departed,
        "committed": [
            (state.serial, state.time_s, ids.places(state.ids), ids.places(state.pending))
            for state in timeline.committed
        ],
        "next_serial": timeline.next_serial,
        "ids": ids.names,
        "types": types.names,
    }
    text = orjson.dumps(head)
    places = np.array([(s.time_s, s.x, s.y) for s in timeline.seen.values()], dtype="<f8")
    told = zlib.compress(b"".join((_LENGTH.pack(len(text)), text, places.tobytes())), _LEVEL)
    body = b"".join((_LENGTH.pack(len(told)), told, packed))
    return b"".join((_MAGIC, _VERSION, _checksum(body), body))


def decode(data: bytes) -> SceneRecord:
    """The inverse of ``encode``; the states stay bytes until the engine needs them.

    Raises:
        UnknownFormatError: it is a record of another version of the format.
        RecordError: these bytes are no record, or not as they were written.
    """
    if not data.startswith(_MAGIC):
        raise RecordError("these bytes are no session")
    version = data[len(_MAGIC) : len(_MAGIC) + 1]
    if version and version != _VERSION:
        raise UnknownFormatError(f"its format has version {version[0]}, not {_VERSION[0]}")
    start = len(_MAGIC) + 1 + _CHECKSUM_BYTES
    body = data[start:]
    if len(body) < _LENGTH.size or data[start - _CHECKSUM_BYTES : start] != _checksum(body):
        raise RecordError("its checksum does not fit")
    end = _LENGTH.size + _LENGTH.unpack_from(body)[0]
    try:
        told = zlib.decompress(body[_LENGTH.size : end])
        split = _LENGTH.size + _LENGTH.unpack_from(told)[0]
        head = orjson.loads(told[_LENGTH.size : split])
        places = np.frombuffer(told[split:], dtype="<f8").reshape(-1, 3)  # [A, 3] time, x, y
        return SceneRecord(
            config=_config(head["config"]),
            model_hash=head["model_hash"],
            created_at=head["created_at"],
            timeline=_timeline(head, places),
            version=head["version"],
            last_sequence=head["last_sequence"],
            states=body[end:] or no_states(),
            edge_count=head["edge_count"],
        )
    except (zlib.error, struct.error, LookupError, TypeError, ValueError) as error:
        raise RecordError(f"it is damaged: {error}") from error


class _Names:
    """Names in the order in which they were first met; each is written once."""

    def __init__(self) -> None:
        self.names: list[str] = []
        self._places: dict[str, int] = {}

    def place(self, name: str) -> int:
        """Where the name stands, now if not before."""
        place = self._places.setdefault(name, len(self.names))
        if place == len(self.names):
            self.names.append(name)
        return place

    def places(self, names: frozenset[str]) -> list[int]:
        """Where these stand, rising."""
        return sorted(self.place(name) for name in sorted(names))


def _checksum(body: bytes) -> bytes:
    return hashlib.blake2b(body, digest_size=_CHECKSUM_BYTES).digest()


def _config(fields: dict[str, Any]) -> SessionConfig:
    return SessionConfig(**{**fields, "unknown_types": UnknownTypes(fields["unknown_types"])})


def _timeline(head: dict[str, Any], places: NDArray[np.float64]) -> Timeline:
    ids, types, newest = head["ids"], head["types"], head["newest"]
    rows = zip(head["seen_types"], places.tolist(), strict=True)
    seen = [Seen(time_s, types[kind], x, y) for kind, (time_s, x, y) in rows]

    def named(numbers: list[int]) -> frozenset[str]:
        return frozenset(ids[number] for number in numbers)

    return Timeline(
        grid=Grid(*head["grid"]),
        newest=newest and _observation(newest[0], newest[1], ids, seen),
        # The agents seen were named first.
        seen=dict(zip(ids, seen, strict=False)),
        departed=tuple(head["departed"]),
        committed=tuple(
            Committed(serial, time_s, named(held), named(pending))
            for serial, time_s, held, pending in head["committed"]
        ),
        next_serial=head["next_serial"],
    )


def _observation(
    time_s: float, numbers: list[int], ids: list[str], seen: list[Seen]
) -> Observation:
    agents = [seen[number] for number in numbers]
    places = np.array([(one.x, one.y) for one in agents], dtype=np.float64).reshape(-1, 2)
    names = tuple(ids[number] for number in numbers)
    return Observation(time_s, names, tuple(one.type for one in agents), places)
