"""Where a service keeps its evaluations: their records, and a folder for each."""

from __future__ import annotations

import asyncio
import fcntl
import tempfile
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

from trajectron_service.evaluations.folders import EvaluationFolder
from trajectron_service.evaluations.store import EvaluationStore, StoredEvaluation

_RECORDS = "evaluations.sqlite"
_FOLDERS = "evaluations"
_LOCK = "lock"


class ArchiveError(ValueError):
    """A folder that cannot be used; the message names it."""


class Archive:
    """The evaluations in a folder, which one service at a time may use.

    Args:
        path: the folder, made where there is none; None for a temporary one.

    Raises:
        ArchiveError: it cannot be made or written, or another service uses it.
        StoreError: its records are not ours.
    """

    def __init__(self, path: Path | None) -> None:
        with ExitStack() as stack:
            if path is None:
                path = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="trajectron-")))
            self._path = path.resolve()
            try:
                (self._path / _FOLDERS).mkdir(parents=True, exist_ok=True)
                lock = stack.enter_context((self._path / _LOCK).open("w"))
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                raise ArchiveError(f"{path}: another service uses this folder") from error
            except OSError as error:
                raise ArchiveError(f"{path}: {error.strerror}") from error
            self._store = EvaluationStore(self._path / _RECORDS)
            self._resources = stack.pop_all()

    def folder(self, number: int) -> EvaluationFolder:
        """Where an evaluation's files are, or will be; by number, as ids may be any text."""
        return EvaluationFolder(self._path / _FOLDERS / f"{number:08d}")

    async def load(self) -> list[StoredEvaluation]:
        """All evaluations in the order of creation; files that belong to none are removed.

        Raises:
            StoreError: a record is damaged.
        """
        stored = await self._store.load()
        await asyncio.to_thread(self._sweep, [one.number for one in stored])
        return stored

    def _sweep(self, numbers: Sequence[int]) -> None:
        known = {self.folder(number).path for number in numbers}
        for path in (self._path / _FOLDERS).iterdir():
            if path not in known:
                EvaluationFolder(path).remove()

    async def add(self, stored: StoredEvaluation) -> None:
        """Writes the record of files that are there, or removes them where it cannot."""
        try:
            await self._store.add(stored)
        except BaseException:
            await self.remove_files(stored)
            raise

    async def change(self, stored: StoredEvaluation) -> None:
        """Writes a changed record, unless it has been removed; on return it is on the disk."""
        await self._store.change(stored)

    async def remove_record(self, stored: StoredEvaluation) -> None:
        """Removes a record.

        It goes before its files do: those without a record are swept up at the next start; a
        record without its files would be an evaluation that cannot be carried out.
        """
        await self._store.delete(stored)

    async def remove_files(self, stored: StoredEvaluation) -> None:
        """Removes the files of an evaluation, which nobody uses."""
        await asyncio.to_thread(self.folder(stored.number).remove)

    async def close(self) -> None:
        """Closes the records, and removes a temporary folder."""
        await self._store.close()
        await asyncio.to_thread(self._resources.close)
