"""What a process beside the service does first: it lowers its priority and watches the service.

``python -m trajectron_service.evaluations.launch PRIORITY MODULE ARGUMENTS`` then runs the module,
whose imports alone would take a second from the forecasts. Its standard input is held open by
the service, which never writes to it: at its end the service has gone, however it went, and so
does the process. What it has to say it prints as JSON, one value a line.
"""

from __future__ import annotations

import os
import runpy
import sys
import threading
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Literal, get_args

import orjson

Priority = Literal["idle", "low", "normal"]
"""``low`` is the lowest nice value; ``idle`` runs where nothing else wants to."""

_LOWEST_NICE = 19
_AUTOGROUP = Path("/proc/self/autogroup")
_STDIN, _STDOUT = 0, 1


def say(value: Mapping[str, Any]) -> None:
    """Tells the service."""
    os.write(_STDOUT, orjson.dumps(dict(value)) + b"\n")


def main() -> None:
    """Settles, and runs the module as a program of its own."""
    priority, module, *arguments = sys.argv[1:]
    _lower(priority)
    threading.Thread(target=_leave_with_the_service, daemon=True).start()
    # What libraries print is no message of ours.
    sys.stdout = sys.stderr
    sys.argv = [module, *arguments]
    runpy.run_module(module, run_name="__main__")


def _lower(priority: str) -> None:
    if priority not in get_args(Priority):
        raise SystemExit(f"{priority}: not a priority")
    if priority != "normal":
        os.nice(_LOWEST_NICE)
        # Where Linux groups processes by session, a nice value counts within the session only:
        # then the session is what has to be nice, where it is this process's own.
        if _AUTOGROUP.exists() and os.getsid(0) == os.getpid():
            with suppress(OSError):  # as in some containers
                _AUTOGROUP.write_text(str(_LOWEST_NICE))
    if priority == "idle" and hasattr(os, "SCHED_IDLE"):
        # Some containers forbid it; then the nice value has to do.
        with suppress(PermissionError):
            os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))


def _leave_with_the_service() -> None:
    # Not through sys.stdin, whose lock would be held when the program ends by itself.
    os.read(_STDIN, 1)
    # No exception: the main thread may be deep in a computation. What is half-written stands
    # under another name and is never read.
    os._exit(1)


if __name__ == "__main__":
    main()
