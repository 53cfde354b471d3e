"""The README's commands exist and do what it says: most of them are run as they stand."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import sysconfig
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import pytest
import typer
from typer.core import TyperGroup

from trajectron_service.commands import app

ROOT = Path(__file__).resolve().parents[2]
DOCUMENTS = ("README.md", "CONTRIBUTING.md", "deploy/README.md")
BIN = Path(sysconfig.get_path("scripts"))


def blocks(document: str, language: str) -> list[str]:
    """The fenced blocks of one language."""
    text = (ROOT / document).read_text(encoding="utf-8")
    return re.findall(rf"^```{language}\n(.*?)^```", text, re.MULTILINE | re.DOTALL)


def commands(document: str) -> list[list[str]]:
    """The words of every shell command; quotes and backslashes may span lines."""
    found = []
    for block in blocks(document, "sh"):
        pending = ""
        for line in block.splitlines():
            pending += line + "\n"
            try:
                words = shlex.split(pending, comments=True)
            except ValueError:  # within quotes, or before a backslash's next line
                continue
            if pending.endswith("\\\n"):
                continue
            if words:
                found.append(words)
            pending = ""
        assert not pending, f"{document}: an unfinished command: {pending}"
    return found


ALL = [(document, words) for document in DOCUMENTS for words in commands(document)]
README = commands("README.md")


def program(words: list[str]) -> str:
    return Path(words[0]).name


@pytest.mark.parametrize(("document", "words"), ALL, ids=lambda v: v if isinstance(v, str) else "")
def test_every_command_is_of_a_known_program(document: str, words: list[str]) -> None:
    known = {"make", "trajectron", "curl", "docker", "pre-commit"}
    assert program(words) in known, f"{document}: {shlex.join(words)}"


def test_the_two_main_commands_come_first() -> None:
    assert README[:2] == [["make", "serve"], ["make", "test"]]


@pytest.mark.parametrize("words", [w for _, w in ALL if program(w) == "make"], ids=shlex.join)
def test_every_make_target_exists(words: list[str]) -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    assert re.search(rf"^{re.escape(words[1])}:", makefile, re.MULTILINE)


@pytest.mark.parametrize("words", [w for _, w in ALL if program(w) == "trajectron"], ids=shlex.join)
def test_every_subcommand_and_its_flags_exist(words: list[str]) -> None:
    group = typer.main.get_command(app)
    assert isinstance(group, TyperGroup)
    command = group.commands[words[1]]
    flags = {flag for option in command.params for flag in option.opts}
    assert {word for word in words[2:] if word.startswith("-")} <= flags


@pytest.fixture(scope="module")
def ports() -> tuple[int, int]:
    """Two free ports: HTTP, gRPC."""
    with socket.socket() as first, socket.socket() as second:
        first.bind(("127.0.0.1", 0))
        second.bind(("127.0.0.1", 0))
        return first.getsockname()[1], second.getsockname()[1]


@pytest.fixture(scope="module")
def served(
    ports: tuple[int, int], tmp_path_factory: pytest.TempPathFactory
) -> Iterator[subprocess.Popen[bytes]]:
    """The service as ``make serve`` starts it, with the default model, on free ports."""
    log = tmp_path_factory.mktemp("serve") / "log"
    variables = {"TRAJECTRON_HTTP_PORT": str(ports[0]), "TRAJECTRON_GRPC_PORT": str(ports[1])}
    with (
        log.open("wb") as out,
        subprocess.Popen(
            [str(BIN / "trajectron"), "serve"],
            env={**os.environ, **variables},
            stdout=out,
            stderr=subprocess.STDOUT,
        ) as process,
    ):
        try:
            _wait_until_ready(process, ports[0], log)
            yield process
        finally:
            process.send_signal(signal.SIGTERM)


def _wait_until_ready(process: subprocess.Popen[bytes], port: int, log: Path) -> None:
    deadline = time.monotonic() + 110.0
    while time.monotonic() < deadline:
        assert process.poll() is None, log.read_text()
        try:
            urllib.request.urlopen(f"http://127.0.0.1:{port}/readyz", timeout=5).close()
        except OSError:
            time.sleep(0.1)
        else:
            return
    pytest.fail(f"not ready: {log.read_text()}")


def on_ports(text: str, ports: tuple[int, int]) -> str:
    """The README's text with the ports of the service under test."""
    return text.replace(":8000", f":{ports[0]}").replace(":50051", f":{ports[1]}")


@pytest.mark.skipif(not shutil.which("curl"), reason="curl is not installed")
@pytest.mark.parametrize("words", [w for w in README if program(w) == "curl"], ids=lambda w: w[2])
@pytest.mark.usefixtures("served")
def test_every_call_with_curl_is_answered(words: list[str], ports: tuple[int, int]) -> None:
    here = [on_ports(word, ports) for word in words]
    ran = subprocess.run([*here, "--fail"], capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stdout
    expected = {"/predict": '"samples":[[[', "/readyz": '"status"', "/metrics": "trajectron_ready"}
    assert expected[words[2].split("8000")[1]] in ran.stdout


@pytest.mark.parametrize("code", blocks("README.md", "python"))
@pytest.mark.usefixtures("served")
def test_the_code_for_planners_runs(code: str, ports: tuple[int, int]) -> None:
    ran = subprocess.run(
        [sys.executable, "-c", on_ports(code, ports)], capture_output=True, text=True, check=False
    )
    assert ran.returncode == 0, ran.stderr
    assert ran.stdout.startswith("4.8"), "the first forecast ends 4.8 s after the first frame"


@pytest.mark.timeout(300)
@pytest.mark.usefixtures("served")
def test_the_commands_for_researchers_run_one_after_the_other(
    ports: tuple[int, int], tmp_path: Path
) -> None:
    # Training and evaluation have tests of their own: here they would take too long.
    chosen = {"simulate", "predict", "replay"}
    listed = [w for w in README if program(w) == "trajectron" and w[1] in chosen]
    assert [w[1] for w in listed] == ["simulate", "predict", "replay"]
    for words in listed:
        more = ["--server", f"127.0.0.1:{ports[1]}"] if words[1] == "replay" else []
        ran = subprocess.run(
            [str(BIN / "trajectron"), *words[1:], *more],
            cwd=tmp_path,
            capture_output=True,
            text=True,
            check=False,
        )
        assert ran.returncode == 0, f"{shlex.join(words)}: {ran.stderr}"
    assert (tmp_path / "forecast.png").read_bytes().startswith(b"\x89PNG")


def test_serving_announces_itself_and_stops_on_sigterm(
    served: subprocess.Popen[bytes], ports: tuple[int, int]
) -> None:
    served.send_signal(signal.SIGTERM)
    assert served.wait(timeout=30) == 0
    with pytest.raises(urllib.error.URLError):
        urllib.request.urlopen(f"http://127.0.0.1:{ports[0]}/healthz", timeout=5)
