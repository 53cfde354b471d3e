"""The real service as a process of its own, as ``trajectron serve`` starts it."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

START_S = 110.0
STOP_S = 60.0
LOG = "serve.log"


class Served(NamedTuple):
    """Where a running service answers."""

    http_url: str
    grpc_target: str


def environment() -> dict[str, str]:
    """This process's environment, in which ``python -m trajectron_service`` finds itself."""
    return os.environ | {"PYTHONPATH": os.pathsep.join(sys.path), "OMP_NUM_THREADS": "1"}


@contextmanager
def serving(model: Path, folder: Path) -> Iterator[Served]:
    """A service with one model on free ports, ready; stopped by SIGTERM at the end."""
    process, served = launch(model, folder, {})
    try:
        yield served
        process.send_signal(signal.SIGTERM)
        assert process.wait(STOP_S) == 0, (folder / LOG).read_text()
    finally:
        process.kill()
        process.wait()


def launch(
    model: Path, folder: Path, settings: Mapping[str, str], start_s: float = START_S
) -> tuple[subprocess.Popen[bytes], Served]:
    """A service in a process that is the caller's to end, ready; its log is in the folder."""
    log = folder / LOG
    command = ["serve", "--model", str(model), "--http-port", "0", "--grpc-port", "0"]
    variables = {f"TRAJECTRON_{name.upper()}": value for name, value in settings.items()}
    with log.open("w") as file:
        process = subprocess.Popen(
            [sys.executable, "-m", "trajectron_service", *command, "--log-format", "json"],
            env=environment() | variables,
            stdout=file,
            stderr=subprocess.STDOUT,
        )
    try:
        ready = _wait_until_ready(process, log, start_s)
    except BaseException:
        process.kill()
        process.wait()
        raise
    host = "127.0.0.1"
    return process, Served(f"http://{host}:{ready['http_port']}", f"{host}:{ready['grpc_port']}")


def _wait_until_ready(
    process: subprocess.Popen[bytes], log: Path, start_s: float
) -> dict[str, int]:
    """The fields of the line that says that the service is ready."""
    deadline = time.monotonic() + start_s
    while time.monotonic() < deadline:
        for line in log.read_text().splitlines():
            if line.startswith("{") and json.loads(line).get("event") == "ready":
                fields: dict[str, int] = json.loads(line)
                return fields
        if process.poll() is not None:
            break
        time.sleep(0.05)
    raise AssertionError(f"the service did not become ready:\n{log.read_text()}")
