"""A service in a process of its own, to be killed, drained and started again on the same ports."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path

import trajectron_client as tc

_PATIENCE_S = 120.0


def free_port() -> int:
    """A port of loopback that nobody listens on."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
    return port


class Replica:
    """One replica.

    Args:
        folder: where its log goes.
        model: a bundled model's name, or a path.
        settings: by their names; see ``trajectron_service.settings``.
    """

    def __init__(self, folder: Path, model: str, settings: Mapping[str, str]) -> None:
        self._port = free_port()
        self._log = folder / f"replica-{self._port}.log"
        self._command = [
            sys.executable, "-m", "trajectron_service", "serve", "--model", model,
            "--grpc-port", str(self._port), "--http-port", "0", "--log-format", "json",
            "--log-level", "warning",
        ]  # fmt: skip
        self._environment = os.environ | {
            "PYTHONPATH": os.pathsep.join(sys.path),
            "OMP_NUM_THREADS": "1",
            "TRAJECTRON_WARM_UP": "false",
            **{f"TRAJECTRON_{name.upper()}": value for name, value in settings.items()},
        }
        self._process: subprocess.Popen[bytes] | None = None
        self._began = 0.0

    @property
    def target(self) -> str:
        """Its gRPC address."""
        return f"127.0.0.1:{self._port}"

    @property
    def log(self) -> str:
        """What it has logged, all its lives."""
        return self._log.read_text() if self._log.exists() else ""

    def start(self) -> float:
        """Starts it; the seconds until it was ready."""
        self.launch()
        return self.ready()

    def launch(self) -> None:
        """Starts it, and does not wait."""
        self._began = time.monotonic()
        with self._log.open("ab") as log:
            self._process = subprocess.Popen(
                self._command, env=self._environment, stdout=log, stderr=log
            )

    def ready(self) -> float:
        """Returns once it takes work: the seconds since it was started."""
        assert self._process is not None
        with tc.Client(self.target) as client:
            while not client.is_ready(timeout_s=1.0):
                if self._process.poll() is not None or time.monotonic() - self._began > _PATIENCE_S:
                    self.end()
                    raise RuntimeError(f"the service did not become ready:\n{self.log[-2000:]}")
                time.sleep(0.02)
        return time.monotonic() - self._began

    def kill(self) -> None:
        """SIGKILL: it has no time for anything."""
        assert self._process is not None
        self._process.kill()
        self._process.wait()

    def drain(self) -> None:
        """SIGTERM: it finishes its work in hand, and exits."""
        assert self._process is not None
        self._process.send_signal(signal.SIGTERM)
        if self._process.wait(_PATIENCE_S) != 0:
            raise RuntimeError(f"the service did not stop in good order:\n{self.log[-2000:]}")

    def end(self) -> None:
        """Makes sure that it does not run any more."""
        if self._process is not None and self._process.poll() is None:
            self.kill()
