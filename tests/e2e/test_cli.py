"""Every subcommand of ``trajectron``, run for real on small recordings."""

from __future__ import annotations

import csv
import json
import re
import subprocess
import sys
from collections.abc import Sequence
from io import StringIO
from pathlib import Path

import httpx
import numpy as np
import pytest
from tests.contract.servers import save_small_model
from tests.process import Served, environment

from trajectron_model.data.readers import read
from trajectron_service.cli import main
from trajectron_service.commands.options import out
from trajectron_service.http_answers import Forecast, Models

COMMANDS = ("serve", "predict", "replay", "simulate", "models", "train", "evaluate")
STEPS = 12


class Cli:
    """``trajectron`` in this process."""

    def __init__(self, capsys: pytest.CaptureFixture[str]) -> None:
        self._capsys = capsys

    def __call__(self, *arguments: str | Path) -> str:
        """What a command that succeeds writes to standard output."""
        code, out, err = self.ends(*arguments)
        assert code == 0, err
        return out

    def ends(self, *arguments: str | Path) -> tuple[int, str, str]:
        """The exit code, standard output and standard error of any command."""
        with pytest.raises(SystemExit) as end:
            main([str(argument) for argument in arguments])
        captured = self._capsys.readouterr()
        return int(end.value.code or 0), captured.out, captured.err


@pytest.fixture
def cli(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Cli:
    monkeypatch.setenv("COLUMNS", "120")
    return Cli(capsys)


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save_small_model(tmp_path_factory.mktemp("cli") / "small")


@pytest.fixture(scope="module")
def crowd(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two people who walk towards each other; the second one is gone after six steps."""
    file = tmp_path_factory.mktemp("cli") / "crowd.csv"
    rows = [f"{0.4 * n:.1f},ann,pedestrian,{0.5 * n:.2f},0.0\n" for n in range(STEPS)]
    rows += [f"{0.4 * n:.1f},bob,pedestrian,{6 - 0.5 * n:.2f},1.0\n" for n in range(6)]
    file.write_text("time,id,type,x,y\n" + "".join(rows))
    return file


def in_a_process(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "trajectron_service", *map(str, arguments)],
        env=environment() | {"COLUMNS": "120"},
        capture_output=True,
        text=True,
        check=False,
    )


def test_help_names_every_command_and_loads_nothing_heavy() -> None:
    script = (
        "import sys\n"
        "from trajectron_service.cli import main\n"
        "try:\n"
        "    main(['--help'])\n"
        "except SystemExit as end:\n"
        "    heavy = {'torch', 'scipy', 'fastapi', 'grpc', 'matplotlib', 'pydantic'}\n"
        "    print('code', end.code, 'heavy', sorted(heavy & set(sys.modules)))\n"
    )
    result = subprocess.run(
        [sys.executable, "-c", script],
        env=environment() | {"COLUMNS": "120"},
        capture_output=True,
        text=True,
        check=True,
    )
    assert "code 0 heavy []" in result.stdout
    for command in COMMANDS:
        assert f" {command} " in result.stdout


@pytest.mark.parametrize("command", COMMANDS)
def test_help_of_each_command_has_examples(cli: Cli, command: str) -> None:
    text = cli(command, "--help")
    assert f"trajectron {command}" in text
    assert "xample" in text


def test_a_simulated_crowd_is_a_recording_and_its_seed_repeats_it(cli: Cli, tmp_path: Path) -> None:
    text = cli("simulate", "corridor", "--agents", "4", "--seconds", "2", "--seed", "3")
    rows = list(csv.DictReader(StringIO(text)))
    assert list(rows[0]) == ["time", "id", "type", "x", "y"]
    assert {float(row["time"]) for row in rows} == {0.0, 0.4, 0.8, 1.2, 1.6, 2.0}
    assert {row["type"] for row in rows} == {"pedestrian"}

    again = tmp_path / "again.csv"
    options = ("--agents", "4", "--seconds", "2", "--seed", "3", "-o", again)
    assert cli("simulate", "corridor", *options) == ""
    assert again.read_text() == text
    assert cli("simulate", "corridor", "--agents", "4", "--seconds", "2", "--seed", "4") != text


@pytest.mark.parametrize("layout", ["crossing", "square"])
def test_a_simulated_crowd_in_eth_ucy_text_has_the_same_walks(
    cli: Cli, tmp_path: Path, layout: str
) -> None:
    for form, suffix in (("csv", "csv"), ("eth-ucy", "txt")):
        options = ("--agents", "5", "--seconds", "1.2", "--format", form)
        cli("simulate", layout, *options, "-o", tmp_path / f"crowd.{suffix}")
    one, other = read(tmp_path / "crowd.csv"), read(tmp_path / "crowd.txt")
    np.testing.assert_allclose(one.position, other.position, atol=1e-6)
    np.testing.assert_array_equal(one.step, other.step)


def test_a_forecast_as_a_table(cli: Cli, model: Path, crowd: Path) -> None:
    text = cli("predict", crowd, "--model", model, "--at", "2", "--seed", "1")
    assert "crowd at 2 s: where in 4.8 s" in text
    assert "model small, mode full, seed 1" in text
    ann, bob = (line for line in text.splitlines() if line.strip().startswith(("ann", "bob")))
    assert "2.5, 0.0" in ann
    assert "3.5, 1.0" in bob
    assert "%" in bob


def test_an_agent_out_of_sight_is_marked(cli: Cli, model: Path, crowd: Path) -> None:
    text = cli("predict", crowd, "--model", model, "--at", "2.8")
    (bob,) = (line for line in text.splitlines() if line.strip().startswith("bob"))
    assert "6, 0.8 s ago" in bob


@pytest.mark.parametrize("sampling", ["iid", "stratified"])
def test_json_is_what_the_service_answers(
    cli: Cli, model: Path, crowd: Path, served: Served, sampling: str
) -> None:
    options = ("--samples", "3", "--horizon", "5", "--seed", "7", "--at", "2")
    text = cli("predict", crowd, "--model", model, *options, "--sampling", sampling, "--json")
    Forecast.model_validate_json(text)
    with crowd.open() as file:
        rows = [row for row in csv.DictReader(file) if float(row["time"]) <= 2.0]
    frames = [
        {
            "time": float(time),
            "agents": [
                {"id": r["id"], "type": r["type"], "x": float(r["x"]), "y": float(r["y"])}
                for r in rows
                if r["time"] == time
            ],
        }
        for time in sorted({row["time"] for row in rows}, key=float)
    ]
    body = {"frames": frames, "num_samples": 3, "horizon": 5, "seed": 7, "sampling": sampling}
    answer = httpx.post(f"{served.http_url}/predict", json=body, timeout=60.0).json()
    ours = json.loads(text)
    assert ours.keys() == answer.keys()
    assert ours["model_hash"] == answer["model_hash"]
    assert ours["sample_semantics"] == answer["sample_semantics"]
    assert ours["sample_semantics"].endswith("stratified") == (sampling == "stratified")
    for agent, twin in zip(ours["agents"], answer["agents"], strict=True):
        assert agent.keys() == twin.keys()
        np.testing.assert_allclose(agent["samples"], twin["samples"], atol=1e-4)


def test_json_of_some_agents_without_samples(cli: Cli, model: Path, crowd: Path) -> None:
    options = ("--at", "2", "--mode", "gmm", "--agents", "bob", "--json")
    answer = json.loads(cli("predict", crowd, "--model", model, *options))
    (bob,) = answer["agents"]
    assert (bob["id"], bob["samples"]) == ("bob", None)
    assert np.shape(bob["mean"])[1:] == (12, 2)


@pytest.mark.parametrize("mode", ["full", "gmm"])
def test_a_forecast_as_a_picture(
    cli: Cli, model: Path, crowd: Path, tmp_path: Path, mode: str
) -> None:
    file = tmp_path / "scene.png"
    cli("predict", crowd, "--model", model, "--at", "2.8", "--mode", mode, "--plot", file)
    assert file.read_bytes().startswith(b"\x89PNG")


def test_models_are_listed(cli: Cli, model: Path) -> None:
    text = cli("models", model)
    assert "small" in text
    assert "pedestrian" in text
    answer = Models.model_validate_json(cli("models", model, "--json"))
    assert answer.models[0].provenance["seed"] == 0


def test_a_replay_shows_forecasts_and_latencies(served: Served, crowd: Path) -> None:
    result = in_a_process("replay", crowd, "--server", served.grpc_target, "--speed", "0")
    assert result.returncode == 0, result.stderr
    lines = [line for line in result.stdout.splitlines() if " agents " in line]
    assert len(lines) == STEPS
    assert "ann to (" in lines[3]
    assert f"{STEPS} in " in result.stdout
    assert "p99" in result.stdout


def test_a_replay_keeps_its_own_rate_and_its_session(served: Served, crowd: Path) -> None:
    part = ("--start", "1.2", "--seconds", "1.2", "--speed", "3", "--quiet", "--session", "kept")
    result = in_a_process("replay", crowd, "--server", served.grpc_target, *part)
    assert result.returncode == 0, result.stderr
    assert " agents " not in result.stdout
    (line,) = (line for line in result.stdout.splitlines() if "frames" in line)
    assert " 4 in " in line
    assert float(line.split(" in ")[1].split(" s")[0]) >= 0.4  # three steps at three times the rate
    session = httpx.get(f"{served.http_url}/v1/sessions/kept", timeout=60.0).json()
    assert session["version"] == 4
    httpx.delete(f"{served.http_url}/v1/sessions/kept", timeout=60.0)


def test_a_replay_may_stratify_its_samples(served: Served, crowd: Path) -> None:
    options = ("--speed", "0", "--mode", "full", "--sampling", "stratified", "--quiet")
    result = in_a_process("replay", crowd, "--server", served.grpc_target, *options)
    assert result.returncode == 0, result.stderr
    assert f"{STEPS} in " in result.stdout


def test_a_replay_to_nobody_says_so(crowd: Path) -> None:
    result = in_a_process("replay", crowd, "--server", "127.0.0.1:1")
    assert result.returncode == 1
    assert result.stderr.startswith("error: UNAVAILABLE")
    assert "Traceback" not in result.stderr


BROKEN_ROW = "time,id,type,x,y\n0.0,1,pedestrian,0.0,0.0\n0.4,1,pedestrian,here,0.0\n"


@pytest.mark.parametrize("command", ["predict", "replay"])
def test_a_bad_file_is_named_with_line_and_reason(cli: Cli, tmp_path: Path, command: str) -> None:
    file = tmp_path / "broken.csv"
    file.write_text(BROKEN_ROW)
    code, _, err = cli.ends(command, file)
    assert code == 2
    assert err.startswith(f"error: {file}:3: ")
    assert "here" in err


def wrong_uses(model: Path, crowd: Path, folder: Path) -> dict[str, Sequence[str | Path]]:
    predict = ("predict", crowd, "--model", model)
    return {
        "no-such-file.csv": ("predict", "no-such-file.csv"),
        "--at 99: the recording goes from 0 s to 4.4 s": (*predict, "--at", "99"),
        "nobody": (*predict, "--agents", "nobody"),
        "the suffix must be one of": (*predict, "--plot", folder / "scene.mp4"),
        "there is no folder": (*predict, "--plot", folder / "nowhere" / "scene.png"),
        "nonesuch": ("predict", crowd, "--model", "nonesuch"),
        "nonesuch: neither": ("models", "nonesuch"),
        "--samples": (*predict, "--samples", "0"),
        "log_level": ("serve", "--config", folder / "bad.toml"),
        "such-layout": ("simulate", "such-layout"),
    }


@pytest.mark.parametrize("number", range(10))
def test_wrong_use_is_one_clear_line_and_exit_code_2(
    cli: Cli, model: Path, crowd: Path, tmp_path: Path, number: int
) -> None:
    (tmp_path / "bad.toml").write_text('log_level = "loud"\n')
    expected, arguments = list(wrong_uses(model, crowd, tmp_path).items())[number]
    code, out, err = cli.ends(*arguments)
    assert code == 2
    assert expected in err
    assert "Traceback" not in out + err


@pytest.mark.parametrize("columns", [80, 200])
def test_bundled_models_are_listed_with_their_figures(
    cli: Cli, monkeypatch: pytest.MonkeyPatch, columns: int
) -> None:
    """On validation data all of them, on a test set those that were kept from one."""
    monkeypatch.setattr(type(out), "width", columns)
    lines = cli("models").splitlines()
    rows = {line.split()[0]: line for line in lines if line.strip().startswith("eth_ucy")}
    assert len(rows) == 6 and len(re.findall(r"\d\.\d{3}/\d\.\d{3}", rows["eth_ucy*"])) == 1
    for name, line in rows.items():
        if name != "eth_ucy*":
            assert len(re.findall(r"\d\.\d{3}/\d\.\d{3}", line)) == 2
