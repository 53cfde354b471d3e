"""The ETH/UCY benchmark: eight recordings of pedestrians, five leave-one-out test sets.

A recording's rows before ``validation_starts_at_frame`` of ``splits.json`` are its training
part, the rest its validation part; a test set is whole recordings.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from trajectron_model.data.errors import DataError
from trajectron_model.data.readers import read_eth_ucy
from trajectron_model.data.recording import Part, Recording

DATA_VARIABLE = "TRAJECTRON_DATA"
TEST_SETS = ("eth", "hotel", "univ", "zara1", "zara2")

_SPLITS = "splits.json"


def find_folder(folder: str | Path | None = None) -> Path:
    """The folder with ``splits.json``: given, or in the environment's ``TRAJECTRON_DATA``.

    Either may also be its parent, which holds it as ``eth_ucy``.

    Raises:
        DataError: no folder given, or none with ``splits.json``.
    """
    given = folder if folder is not None else os.environ.get(DATA_VARIABLE)
    if not given:
        reason = f"no data folder: give one, or set {DATA_VARIABLE}"
        raise DataError(_SPLITS, None, reason)
    for candidate in (Path(given), Path(given) / "eth_ucy"):
        if (candidate / _SPLITS).is_file():
            return candidate
    raise DataError(given, None, f"neither it nor its folder eth_ucy has a {_SPLITS}")


@dataclass(frozen=True)
class _Source:
    """What ``splits.json`` says of one recording."""

    rows: int
    agents: int
    first_frame: int
    validation_starts_at_frame: int


class EthUcy:
    """The benchmark's recordings and splits, read from a folder; each file is read once.

    Args:
        folder: see `find_folder`.

    Raises:
        DataError: a folder or ``splits.json`` that is missing or damaged; later, from every
            method, a recording that is, or that is not the one which ``splits.json`` describes.
    """

    def __init__(self, folder: str | Path | None = None) -> None:
        self.folder = find_folder(folder)
        path = self.folder / _SPLITS
        try:
            content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
            self._frames_per_step = int(content["frames_per_step"])
            self._dt_s = float(content["seconds_per_frame"]) * self._frames_per_step
            self._sources = {
                name: _Source(**{key: int(source[key]) for key in _Source.__annotations__})
                for name, source in content["recordings"].items()
            }
            self._test = {name: tuple(part) for name, part in content["test_sets"].items()}
            self._training = {name: tuple(part) for name, part in content["training"].items()}
        except json.JSONDecodeError as error:
            raise DataError(path, error.lineno, error.msg) from error
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            raise DataError(path, None, f"not the splits of ETH/UCY: {error!r}") from error
        self._whole: dict[str, Recording] = {}

    @property
    def names(self) -> tuple[str, ...]:
        """The names of all recordings."""
        return tuple(self._sources)

    @property
    def test_sets(self) -> Mapping[str, tuple[str, ...]]:
        """The names of each test set's recordings."""
        return self._test

    def recording(self, name: str) -> Recording:
        """One whole recording.

        Raises:
            KeyError: no such recording.
        """
        if name not in self._whole:
            self._whole[name] = self._read(name, self._sources[name])
        return self._whole[name]

    def _read(self, name: str, source: _Source) -> Recording:
        path = self.folder / f"{name}.txt"
        recording = read_eth_ucy(path, frames_per_step=self._frames_per_step, dt_s=self._dt_s)
        found = (len(recording.step), len(recording.ids))
        if found != (source.rows, source.agents):
            reason = (
                f"{found[0]} rows and {found[1]} agents; {_SPLITS} says {source.rows} and "
                f"{source.agents}: this is another version of the recording"
            )
            raise DataError(path, None, reason)
        return recording

    def part(self, name: str, part: Part) -> Recording:
        """One recording, or its training or validation part.

        Raises:
            KeyError: no such recording.
        """
        whole = self.recording(name)
        source = self._sources[name]
        frames = source.validation_starts_at_frame - source.first_frame
        # A frame between two steps begins with the later of them.
        boundary = -(-frames // self._frames_per_step)
        if part == "training":
            return replace(whole.between(0, boundary), part=part)
        if part == "validation":
            return replace(whole.between(boundary, whole.num_steps), part=part)
        return whole

    def training(self, test_set: str) -> list[Recording]:
        """The training parts for a test set: those of all recordings that are not in it.

        Raises:
            KeyError: no such test set.
        """
        return [self.part(name, "training") for name in self._training[test_set]]

    def validation(self, test_set: str) -> list[Recording]:
        """The validation parts of the recordings in `training`.

        Raises:
            KeyError: no such test set.
        """
        return [self.part(name, "validation") for name in self._training[test_set]]

    def test(self, test_set: str) -> list[Recording]:
        """The whole recordings of a test set.

        Raises:
            KeyError: no such test set.
        """
        return [self.recording(name) for name in self._test[test_set]]

    def training_all(self) -> list[Recording]:
        """The training parts of all recordings: for a model that is not for this benchmark."""
        return [self.part(name, "training") for name in self.names]

    def validation_all(self) -> list[Recording]:
        """The validation parts of all recordings."""
        return [self.part(name, "validation") for name in self.names]
