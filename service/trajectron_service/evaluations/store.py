"""The records of evaluations in an SQLite file: written before anything is acknowledged."""

from __future__ import annotations

import asyncio
import dataclasses
import sqlite3
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import orjson

from trajectron_service.evaluations.messages import (
    EvaluationConfig,
    EvaluationInfo,
    EvaluationProgress,
    EvaluationProtocol,
    EvaluationState,
)

T = TypeVar("T")

# Rises with the meaning of the columns; a file of another version is refused.
_VERSION = 1
# ``number`` is the order of creation. ``record`` is the evaluation as JSON.
_SCHEMA = """
CREATE TABLE IF NOT EXISTS evaluations (
    number INTEGER PRIMARY KEY,
    tenant TEXT NOT NULL,
    id TEXT NOT NULL,
    request_id TEXT NOT NULL,
    request_sha256 TEXT NOT NULL,
    record BLOB NOT NULL,
    UNIQUE (tenant, id)
)
"""
_BUSY_S = 5.0


class StoreError(ValueError):
    """A file that cannot be used as a store; the message names it."""


@dataclass(frozen=True)
class StoredEvaluation:
    """An evaluation with what only the server knows of it.

    Attributes:
        number: rises in the order of creation.
        tenant: whose it is.
        info: as clients see it, its progress as it last was.
        request_id: of the request that made it; empty for none.
        request_sha256: of that request's content.
    """

    number: int
    tenant: str
    info: EvaluationInfo
    request_id: str = ""
    request_sha256: str = ""


class EvaluationStore:
    """The evaluations of a file; what is written there outlives the process and the machine.

    Args:
        path: of the file, made where there is none.

    Raises:
        StoreError: not a store, or one of another version.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        # SQLite waits for the disk: it does so on a thread of its own, one write at a time.
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="evaluations-store")
        self._database = sqlite3.connect(
            path, timeout=_BUSY_S, isolation_level=None, check_same_thread=False
        )
        try:
            self._prepare()
        except sqlite3.Error as error:
            self._database.close()
            raise StoreError(f"{path}: not a store of evaluations: {error}") from error

    def _prepare(self) -> None:
        (version,) = self._database.execute("PRAGMA user_version").fetchone()
        if version not in (0, _VERSION):
            raise sqlite3.DatabaseError(f"its version is {version}, expected {_VERSION}")
        self._database.execute("PRAGMA journal_mode = WAL")
        # In WAL mode only FULL waits for the disk at each commit.
        self._database.execute("PRAGMA synchronous = FULL")
        self._database.execute(_SCHEMA)
        self._database.execute(f"PRAGMA user_version = {_VERSION}")

    async def load(self) -> list[StoredEvaluation]:
        """All evaluations in the order of creation.

        Raises:
            StoreError: a record is damaged.
        """

        def read() -> list[StoredEvaluation]:
            rows = self._database.execute(
                "SELECT number, tenant, record, request_id, request_sha256 FROM evaluations"
                " ORDER BY number"
            )
            return [
                StoredEvaluation(number, tenant, self._decoded(record), request_id, sha256)
                for number, tenant, record, request_id, sha256 in rows
            ]

        return await self._on_thread(read)

    def _decoded(self, record: bytes) -> EvaluationInfo:
        try:
            return decode(record)
        except (KeyError, TypeError, ValueError) as error:
            raise StoreError(f"{self._path}: a record is damaged: {error!r}") from error

    async def add(self, stored: StoredEvaluation) -> None:
        """Writes a new evaluation; on return it is on the disk.

        Raises:
            sqlite3.IntegrityError: its number or its id is another's.
        """
        row = (
            stored.number,
            stored.tenant,
            stored.info.id,
            stored.request_id,
            stored.request_sha256,
            encode(stored.info),
        )

        def insert() -> None:
            self._database.execute("INSERT INTO evaluations VALUES (?, ?, ?, ?, ?, ?)", row)

        await self._on_thread(insert)

    async def change(self, stored: StoredEvaluation) -> None:
        """Writes what an evaluation has become; nothing happens where it is not there."""
        row = (encode(stored.info), stored.number)

        def update() -> None:
            self._database.execute("UPDATE evaluations SET record = ? WHERE number = ?", row)

        await self._on_thread(update)

    async def delete(self, stored: StoredEvaluation) -> None:
        """Removes an evaluation; nothing happens where it is not there."""

        def remove() -> None:
            self._database.execute("DELETE FROM evaluations WHERE number = ?", (stored.number,))

        await self._on_thread(remove)

    async def close(self) -> None:
        """Closes the file, after what is being written."""
        await self._on_thread(self._database.close)
        self._thread.shutdown()

    async def _on_thread(self, work: Callable[[], T]) -> T:
        return await asyncio.get_running_loop().run_in_executor(self._thread, work)


def encode(info: EvaluationInfo) -> bytes:
    """An evaluation as JSON."""
    return orjson.dumps(dataclasses.asdict(info))


def decode(record: bytes) -> EvaluationInfo:
    """The inverse of ``encode``; raises KeyError, TypeError or ValueError for anything else."""
    fields: dict[str, Any] = orjson.loads(record)
    config: dict[str, Any] = fields["config"]
    config |= {
        "models": tuple(config["models"]),
        "sets": tuple(config["sets"]),
        "protocol": EvaluationProtocol(config["protocol"]),
    }
    return EvaluationInfo(
        **fields
        | {
            "config": EvaluationConfig(**config),
            "files": tuple(fields["files"]),
            "state": EvaluationState(fields["state"]),
            "progress": EvaluationProgress(**fields["progress"]),
        }
    )
