"""What all tests share: the real recordings, where there are any, and a running service."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from tests.process import Served, serving

from trajectron_model.data.eth_ucy import EthUcy

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="session")
def data_folder() -> Path:
    """The folder of real recordings: ``TRAJECTRON_DATA``, or ``../shared/data``."""
    folder = Path(os.environ.get("TRAJECTRON_DATA") or ROOT.parent / "shared" / "data")
    if not folder.is_dir():
        pytest.skip(f"no recordings in {folder}; set TRAJECTRON_DATA to their folder")
    return folder


@pytest.fixture(scope="session")
def eth_ucy(data_folder: Path) -> EthUcy:
    """The ETH/UCY benchmark."""
    return EthUcy(data_folder)


@pytest.fixture(scope="session")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """A service in a process of its own, with a small model of random weights."""
    from tests.contract.servers import save_small_model

    folder = tmp_path_factory.mktemp("served")
    with serving(save_small_model(folder / "small"), folder) as service:
        yield service
