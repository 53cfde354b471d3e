"""The leave-one-out splits: on a benchmark in small, and on the real one where it is at hand."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from trajectron_model.data.errors import DataError
from trajectron_model.data.eth_ucy import TEST_SETS, EthUcy

SPLITS: dict[str, Any] = {
    "seconds_per_frame": 0.04,
    "frames_per_step": 10,
    "recordings": {
        "near": {"rows": 4, "agents": 1, "first_frame": 100, "validation_starts_at_frame": 130},
        "far": {"rows": 4, "agents": 1, "first_frame": 0, "validation_starts_at_frame": 20},
    },
    "test_sets": {"near": ["near"], "far": ["far"]},
    "training": {"near": ["far"], "far": ["near"]},
}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two recordings of one walker and four steps each."""
    place = tmp_path / "eth_ucy"
    place.mkdir()
    for name, first in (("near", 100), ("far", 0)):
        rows = "".join(f"{first + 10 * k}\t1\t{k}.0\t0.0\n" for k in range(4))
        (place / f"{name}.txt").write_text(rows)
    (place / "splits.json").write_text(json.dumps(SPLITS))
    return place


def test_training_and_validation_are_the_parts_of_the_other_recordings(folder: Path) -> None:
    data = EthUcy(folder)
    (training,), (validation,), (test,) = (
        data.training("far"),
        data.validation("far"),
        data.test("far"),
    )
    assert (training.name, validation.name, test.name) == ("near", "near", "far")
    assert (training.part, validation.part, test.part) == ("training", "validation", "whole")
    assert training.position[:, 0].tolist() == [0.0, 1.0, 2.0]
    assert validation.position[:, 0].tolist() == [3.0]
    assert validation.start_time_s == pytest.approx(13 * 0.4)
    assert test.num_steps == 4


def test_a_model_for_everyday_use_trains_on_all_training_parts(folder: Path) -> None:
    data = EthUcy(folder)
    assert [(one.name, one.num_steps) for one in data.training_all()] == [("near", 3), ("far", 2)]
    assert [(one.name, one.num_steps) for one in data.validation_all()] == [("near", 1), ("far", 2)]


def test_the_folder_is_given_or_in_the_environment(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert EthUcy(folder.parent).folder == folder
    monkeypatch.setenv("TRAJECTRON_DATA", str(folder.parent))
    assert EthUcy().folder == folder
    monkeypatch.delenv("TRAJECTRON_DATA")
    with pytest.raises(DataError, match="set TRAJECTRON_DATA"):
        EthUcy()
    with pytest.raises(DataError, match=r"nor its folder eth_ucy has a splits\.json"):
        EthUcy(folder.parent / "elsewhere")


def test_another_version_of_a_recording_is_refused(folder: Path) -> None:
    with (folder / "near.txt").open("a") as file:
        file.write("140\t1\t4.0\t0.0\n")
    data = EthUcy(folder)
    assert data.test("far")
    with pytest.raises(DataError, match=r"near\.txt: 5 rows and 1 agents; splits\.json says 4"):
        data.test("near")


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("{", r"splits\.json:1: Expecting"),
        ("[]", "not the splits of ETH/UCY"),
        ("{}", "not the splits of ETH/UCY: KeyError"),
        (json.dumps(SPLITS | {"recordings": {"near": {"rows": 4}}}), "not the splits"),
    ],
)
def test_damaged_splits_are_a_data_error(folder: Path, text: str, reason: str) -> None:
    (folder / "splits.json").write_text(text)
    with pytest.raises(DataError, match=reason):
        EthUcy(folder)


def test_every_real_recording_is_the_one_described(eth_ucy: EthUcy) -> None:
    assert len(eth_ucy.names) == 8
    for name in eth_ucy.names:
        recording = eth_ucy.recording(name)  # refuses other counts of rows and agents
        assert recording.dt_s == pytest.approx(0.4)
        assert set(recording.types) == {"pedestrian"}


def test_no_real_track_has_a_gap(eth_ucy: EthUcy) -> None:
    for name in eth_ucy.names:
        recording = eth_ucy.recording(name)
        order = np.lexsort((recording.step, recording.agent))
        same = np.diff(recording.agent[order]) == 0
        assert np.all(np.diff(recording.step[order])[same] == 1), name


@pytest.mark.parametrize("test_set", TEST_SETS)
def test_no_real_training_part_holds_a_test_recording(eth_ucy: EthUcy, test_set: str) -> None:
    tested = {recording.name for recording in eth_ucy.test(test_set)}
    trained = eth_ucy.training(test_set)
    assert tested.isdisjoint(recording.name for recording in trained)
    assert len(trained) + len(tested) == 8
    rows = {recording.name: len(recording.step) for recording in trained}
    for part in eth_ucy.validation(test_set):
        assert rows[part.name] + len(part.step) == len(eth_ucy.recording(part.name).step)
