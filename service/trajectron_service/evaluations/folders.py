"""The files of one evaluation: what it was asked, what it was sent, what it has made.

::

    FOLDER/
        worker.log          what the worker said
        work/               where the worker runs
            plan.json       what it is to do
            recordings/     as they were sent along
            NAME.json ...   served models that are not bundled
        run/                shards, and in the end the result
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import orjson

from trajectron_service.evaluations.messages import (
    EvaluationResult,
    RecordingFile,
    ResultFormat,
)

RECORDINGS = "recordings"
"""The folder, beside the plan, of the recordings sent along."""

MODEL_SUFFIXES = (".json", ".safetensors")
"""What a model's files are called, after its name."""

_RESULTS = {
    ResultFormat.JSON: ("result.json", "application/json"),
    ResultFormat.CSV: ("result.csv", "text/csv; charset=utf-8"),
    ResultFormat.HTML: ("report.html", "text/html; charset=utf-8"),
}
_LONGEST_LINE = 300


@dataclass(frozen=True)
class EvaluationFolder:
    """Where one evaluation has its files; every method waits for the disk."""

    path: Path

    @property
    def work(self) -> Path:
        """Where the worker runs."""
        return self.path / "work"

    @property
    def plan(self) -> Path:
        """What the worker is to do."""
        return self.work / "plan.json"

    @property
    def run(self) -> Path:
        """Shards and results."""
        return self.path / "run"

    @property
    def log(self) -> Path:
        """What the worker said."""
        return self.path / "worker.log"

    def fill(
        self,
        plan: Mapping[str, Any],
        files: Iterable[RecordingFile],
        models: Mapping[str, Path],
    ) -> None:
        """Makes the folder with all that the worker needs; on return it is on the disk.

        Args:
            plan: as JSON values.
            files: the recordings sent along.
            models: files to copy, by the model's name, without their suffixes.
        """
        (self.work / RECORDINGS).mkdir(parents=True)
        self.run.mkdir()
        for file in files:
            _write(self.work / RECORDINGS / file.name, file.content)
        for name, stem in models.items():
            for suffix in MODEL_SUFFIXES:
                content = stem.with_name(stem.name + suffix).read_bytes()
                _write(self.work / f"{name}{suffix}", content)
        _write(self.plan, orjson.dumps(dict(plan)))
        for folder in (self.work / RECORDINGS, self.work, self.path, self.path.parent):
            _sync(folder)

    def remove(self) -> None:
        """Removes everything; nothing happens where there is nothing."""
        if self.path.exists():
            shutil.rmtree(self.path)

    def result(self, form: ResultFormat) -> EvaluationResult:
        """The result in one form; raises FileNotFoundError where it is not there."""
        name, content_type = _RESULTS[form]
        return EvaluationResult((self.run / name).read_bytes(), content_type)

    def last_words(self) -> str:
        """The last line that the worker said, shortened; empty where it said nothing.

        Not where the folder is: its name counts the evaluations of all tenants.
        """
        try:
            text = self.log.read_text(encoding="utf-8", errors="replace")
        except FileNotFoundError:
            return ""
        lines = [line.strip() for line in text.splitlines() if line.strip()]
        return lines[-1].replace(f"{self.path}/", "")[:_LONGEST_LINE] if lines else ""


def _write(file: Path, content: bytes) -> None:
    with file.open("xb") as stream:
        stream.write(content)
        stream.flush()
        os.fsync(stream.fileno())


def _sync(folder: Path) -> None:
    """A file is found after a power cut only when its folder was written as well."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
