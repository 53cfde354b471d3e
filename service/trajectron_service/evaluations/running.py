"""What the processes beside the service do for it: read recordings, carry an evaluation out."""

from __future__ import annotations

import signal
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from trajectron_service.errors import ErrorKind, FieldViolation, ServiceError
from trajectron_service.evaluations.background import Background, told
from trajectron_service.evaluations.folders import RECORDINGS, EvaluationFolder
from trajectron_service.evaluations.messages import EvaluationProgress


class FailedError(Exception):
    """An evaluation that did not come to its end; the message says why."""


async def check_recordings(
    folder: EvaluationFolder, files: Sequence[str], frames_per_step: int, background: Background
) -> None:
    """Raises INVALID_ARGUMENT for the first recording that cannot be read: file, line, reason.

    Args:
        folder: of the evaluation, filled.
        files: the names of the recordings sent along.
        frames_per_step: see ``EvaluationConfig``.
        background: how the process runs that reads them.
    """
    paths = [f"{RECORDINGS}/{name}" for name in files]
    async with background.process(
        "reading", str(frames_per_step), *paths, folder=folder.work, log=folder.log
    ) as process:
        faults = [fault async for fault in told(process)]
        status = await process.wait()
    if status:
        raise RuntimeError(f"recordings could not be read: {_end(status)} {folder.last_words()}")
    for fault in faults:
        line = "" if fault["line"] is None else f"line {fault['line']}: "
        place = fault["file"]
        description = f"{files[place]}: {line}{fault['reason']}"
        raise ServiceError(
            ErrorKind.INVALID_ARGUMENT,
            f"files[{place}]: {description}",
            violations=(FieldViolation(f"files[{place}]", description),),
        )


async def carry_out(
    folder: EvaluationFolder,
    data: Path | None,
    background: Background,
    note: Callable[[EvaluationProgress], object],
) -> None:
    """Runs an evaluation to its end, from wherever it was; cancelled, it can be run again.

    Args:
        folder: of the evaluation, filled.
        data: the data set's folder, where the evaluation needs it.
        background: how its process runs.
        note: told how far it is.

    Raises:
        FailedError: it was refused, failed, or was ended by somebody else.
    """
    refused = ""
    where = [str(folder.run)] if data is None else [str(folder.run), str(data)]
    async with background.process("worker", *where, folder=folder.work, log=folder.log) as process:
        async for message in told(process):
            if "progress" in message:
                note(_progress(message["progress"]))
            refused = message.get("refused", refused)
        status = await process.wait()
    if status:
        words = folder.last_words()
        raise FailedError(refused or f"{_end(status)}{words and ': '}{words}")


def _progress(values: dict[str, Any]) -> EvaluationProgress:
    return EvaluationProgress(
        share=values["share"],
        windows_done=values["windows_done"],
        windows_total=values["windows_total"],
        model=values["entry"],
        set=values["set"],
        seconds_left=values["seconds_left"],
    )


def _end(status: int) -> str:
    if status < 0:
        name = signal.Signals(-status).name
        return f"its process was ended by {name}" + (
            " (the machine may have run out of memory)" if name == "SIGKILL" else ""
        )
    return f"its process ended with status {status}"
