"""A real Redis server on a free port of loopback, with a folder of its own."""

from __future__ import annotations

import shutil
import socket
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

START_S = 30.0
DURABLE = ("--appendonly", "yes", "--appendfsync", "always")


def binary() -> str:
    """The program; skips the test where there is none."""
    found = shutil.which("redis-server")
    if found is None:
        pytest.skip("no redis-server; install Debian's redis-server")
    return found


def free_port() -> int:
    """A port of loopback that nobody listens on."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
    return port


def start(folder: Path, port: int, *options: str) -> subprocess.Popen[bytes]:
    """A server, ready; it is the caller's to end."""
    command = [binary(), "--bind", "127.0.0.1", "--port", str(port), "--dir", str(folder)]
    with (folder / "redis.log").open("ab") as log:
        process = subprocess.Popen(
            [*command, "--save", "", *(options or DURABLE)], stdout=log, stderr=log
        )
    deadline = time.monotonic() + START_S
    while time.monotonic() < deadline and process.poll() is None:
        with socket.socket() as probe:
            if probe.connect_ex(("127.0.0.1", port)) == 0:
                probe.sendall(b"PING\r\n")
                if probe.recv(16).startswith(b"+PONG"):
                    return process
        time.sleep(0.02)
    process.kill()
    process.wait()
    raise AssertionError((folder / "redis.log").read_text())


@contextmanager
def running(folder: Path, *options: str) -> Iterator[str]:
    """The URL of a server that lives as long as the block."""
    port = free_port()
    process = start(folder, port, *options)
    try:
        yield f"redis://127.0.0.1:{port}/0"
    finally:
        process.kill()
        process.wait()
