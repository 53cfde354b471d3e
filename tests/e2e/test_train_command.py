"""``trajectron train``: from a recording's file to a model that can be served."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from trajectron_model import registry
from trajectron_service.cli import main

FEW = ("--steps", "4", "--validate-every", "2", "--agents", "8", "--threads", "1")


def run(*arguments: str | Path) -> int:
    with pytest.raises(SystemExit) as end:
        main([str(argument) for argument in arguments])
    return int(end.value.code or 0)


@pytest.fixture(scope="module")
def crowd(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two minutes of a simulated crossing at 10 Hz."""
    file = tmp_path_factory.mktemp("crowd") / "crowd.csv"
    arguments = ("--agents", "8", "--seconds", "120", "--seed", "1", "-o", file)
    assert run("simulate", "crossing", *arguments) == 0
    return file


def test_a_recording_becomes_a_model(
    tmp_path: Path, crowd: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("train", crowd, "--out", tmp_path, *FEW) == 0
    shown = capsys.readouterr()
    assert "validation nll" in shown.out + shown.err and "4/4" in shown.err
    found = registry.describe(tmp_path)
    assert found.provenance["training"]["recordings"][0]["name"] == "crowd"
    assert found.provenance["training"]["recordings"][0]["part"] == "training"
    assert found.provenance["validation"]["recordings"][0]["part"] == "validation"
    assert run("predict", crowd, "--model", tmp_path / "model.json", "--json") == 0
    assert json.loads(capsys.readouterr().out)["agents"]


def test_loss_terms_are_logged_for_tensorboard(tmp_path: Path, crowd: Path) -> None:
    assert run("train", crowd, "--out", tmp_path, *FEW) == 0
    log = EventAccumulator(str(tmp_path / "tensorboard"))
    log.Reload()
    assert [event.step for event in log.Scalars("training/nll")] == [1, 2, 3, 4]
    assert [event.step for event in log.Scalars("validation/min_ade_20")] == [2, 4]


def test_a_training_goes_on_where_it_was(
    tmp_path: Path, crowd: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("train", crowd, "--out", tmp_path, *FEW) == 0
    first = registry.describe(tmp_path).sha256
    capsys.readouterr()
    assert run("train", crowd, "--out", tmp_path, "--resume", *FEW) == 0
    assert registry.describe(tmp_path).sha256 == first, "there was nothing left to do"
    assert run("train", crowd, "--out", tmp_path, "--resume", *FEW, "--seed", "1") == 2
    assert "begun with other settings" in capsys.readouterr().err


def test_a_training_goes_on_from_weights(
    tmp_path: Path, crowd: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first, second = tmp_path / "first", tmp_path / "second"
    assert run("train", crowd, "--out", first, *FEW) == 0
    onward = ("--learning-rate", "0.0005", "--average-steps", "2", "--start")
    assert run("train", crowd, "--out", second, *FEW, *onward, first) == 0
    told = registry.describe(second).provenance
    assert told["settings"]["learning_rate"] == 0.0005 and told["settings"]["average_steps"] == 2
    assert told["start"]["weights_sha256"] == registry.describe(first).weights_sha256
    for start, reason in (
        ("eth_ucy", "trained on other recordings"),
        ("none", "neither a bundled"),
    ):
        assert run("train", crowd, "--out", second, *FEW, "--start", start) == 2
        assert reason in capsys.readouterr().err


@pytest.mark.parametrize(
    ("row", "reason"),
    [
        ("0.4,1,pedestrian,nan,2.0", "nan"),
        ("0.4,1,pedestrian,1.0", "columns"),
        ("soon,1,pedestrian,1.0,2.0", "soon"),
    ],
)
def test_bad_data_is_answered_with_file_line_and_reason(
    tmp_path: Path, row: str, reason: str, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "broken.csv"
    file.write_text(f"time,id,type,x,y\n0.0,1,pedestrian,0.0,0.0\n{row}\n")
    assert run("train", file, "--out", tmp_path / "out", *FEW) == 2
    error = capsys.readouterr().err
    assert f"{file}:3: " in error and reason in error and "Traceback" not in error


def test_what_cannot_be_trained_is_refused_in_one_line(
    tmp_path: Path, crowd: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for arguments, reason in (
        ((crowd, "--preset", "best"), "the presets are default"),
        ((), "give recordings to train on"),
        ((crowd, "--eth-ucy", "eth"), "leave out the files"),
    ):
        assert run("train", *arguments, "--out", tmp_path, *FEW) == 2
        assert reason in capsys.readouterr().err
