"""Processes beside the service: at low priority, and ended when the service ends.

``launch`` is the other side: what such a process does first, and how it tells something.
"""

from __future__ import annotations

import asyncio
import os
import sys
from asyncio.subprocess import DEVNULL, PIPE, Process
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import orjson

from trajectron_service.evaluations.launch import Priority

# Every library that the model may use has its own.
_THREAD_VARIABLES = (
    "OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMEXPR_NUM_THREADS",
)  # fmt: skip
# To die of SIGTERM takes no time, unless the machine is busy.
_TERM_S = 5.0
_LONGEST_LINE = 1 << 20


@dataclass(frozen=True)
class Background:
    """How processes beside the service run.

    Attributes:
        priority: see ``launch.Priority``.
        threads: how many each may use.
    """

    priority: Priority
    threads: int

    @asynccontextmanager
    async def process(
        self, module: str, *arguments: str, folder: Path, log: Path | None = None
    ) -> AsyncIterator[Process]:
        """A process that runs ``python -m MODULE ARGUMENTS``; ended when the block is left.

        Args:
            module: of this package.
            arguments: of the command.
            folder: where it runs.
            log: where its standard error is appended; None throws it away.
        """
        errors: IO[bytes] | None = None if log is None else log.open("ab")
        try:
            process = await asyncio.create_subprocess_exec(
                sys.executable,
                "-P",  # nothing is imported from the folder, which holds what clients sent
                "-m",
                "trajectron_service.evaluations.launch",
                self.priority,
                f"trajectron_service.evaluations.{module}",
                *arguments,
                stdin=PIPE,
                stdout=PIPE,
                stderr=errors or DEVNULL,
                cwd=folder,
                env=dict(os.environ) | dict.fromkeys(_THREAD_VARIABLES, str(self.threads)),
                # Ctrl-C in a terminal is for the service alone.
                start_new_session=True,
                limit=_LONGEST_LINE,
            )
        finally:
            if errors is not None:
                errors.close()
        try:
            yield process
        finally:
            await _end(process)


async def told(process: Process) -> AsyncIterator[dict[str, Any]]:
    """What a process tells, until it ends; a line that was cut off by its end is left out."""
    assert process.stdout is not None
    while line := await process.stdout.readline():
        with suppress(orjson.JSONDecodeError):
            yield orjson.loads(line)


async def _end(process: Process) -> None:
    if process.returncode is None:
        with suppress(ProcessLookupError):  # it has just ended by itself
            process.terminate()
        try:
            async with asyncio.timeout(_TERM_S):
                await process.wait()
        except TimeoutError:
            process.kill()
    await process.wait()
