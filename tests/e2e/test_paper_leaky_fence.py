"""No command serves `paper-leaky` or forecasts with it: its inputs contain the future."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from trajectron_model.paper_leaky import NAME, saving
from trajectron_model.paper_leaky.network import LeakyNetwork
from trajectron_service.cli import main

CROWD = "time,id,type,x,y\n" + "".join(f"{0.4 * n:.1f},ann,pedestrian,{n},1\n" for n in range(9))


def refused(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> str:
    """What a command says that ends with wrong use."""
    with pytest.raises(SystemExit) as end:
        main([str(argument) for argument in arguments])
    assert end.value.code == 2
    return capsys.readouterr().err


@pytest.fixture
def crowd(tmp_path: Path) -> Path:
    file = tmp_path / "crowd.csv"
    file.write_text(CROWD, encoding="utf-8")
    return file


def test_its_name_is_no_model(capsys: pytest.CaptureFixture[str], crowd: Path) -> None:
    for command in (("serve",), ("predict", crowd)):
        said = refused(capsys, *command, "--model", NAME)
        assert "paper-leaky: neither a bundled model" in said


def test_its_files_are_no_checkpoint(
    capsys: pytest.CaptureFixture[str], crowd: Path, tmp_path: Path
) -> None:
    torch.manual_seed(0)
    saving.save(tmp_path / "leaky", LeakyNetwork(), {})
    for command in (("serve",), ("predict", crowd)):
        said = refused(capsys, *command, "--model", tmp_path / "leaky.json")
        assert re.search(r"leaky\.json: not the JSON of a checkpoint", said)


def test_what_serves_does_not_load_it() -> None:
    loaded = (
        "import sys, trajectron_service.lifecycle, trajectron_service.engine;"
        "print(*(m for m in sys.modules if 'paper_leaky' in m))"
    )
    result = subprocess.run(
        [sys.executable, "-c", loaded], capture_output=True, text=True, check=True
    )
    assert not result.stdout.strip()
