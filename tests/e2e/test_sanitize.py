"""The kernels hold under sanitizers, and the sanitizers would say so if they did not."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from scripts import sanitize

pytestmark = pytest.mark.timeout(400)
ROOT = Path(__file__).parents[2]
UNABLE = 3
# A scene that says it has more agents than there are records for.
OVERRUN = """
import numpy as np, torch
from trajectron_model import online
from trajectron_model.config import ModelConfig
from trajectron_model.kernels import stepping
from trajectron_model.packed import blank_scene
from trajectron_model.state import SceneFrame
from trajectron_model.trajectron import Trajectron

def test_overrun(monkeypatch):
    right = stepping.SceneRows.__init__
    def wrong(self, *args, **kwargs):
        right(self, *args, **kwargs)
        self.node_start[-1] += 1
    monkeypatch.setattr(stepping.SceneRows, "__init__", wrong)
    model = Trajectron(ModelConfig()).eval().requires_grad_(False)
    frame = SceneFrame(0.0, ("a",), ("pedestrian",), np.zeros((1, 2)))
    online.step(model, [blank_scene()], [frame])
"""


def sanitized(*arguments: str) -> subprocess.CompletedProcess[str]:
    done = subprocess.run(
        [sys.executable, "scripts/sanitize.py", *arguments, "-q", "-p", "no:cacheprovider"],
        cwd=ROOT,
        env={k: v for k, v in os.environ.items() if not k.startswith("PYTEST")},
        capture_output=True,
        text=True,
        timeout=380,
        check=False,
    )
    if done.returncode == UNABLE:
        pytest.skip(done.stderr.strip())
    return done


def test_the_kernels_tests_hold_under_sanitizers() -> None:
    done = sanitized(*sanitize.TESTS)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    assert "passed" in done.stdout


def test_a_deliberate_overrun_is_caught(tmp_path: Path) -> None:
    (tmp_path / "test_overrun.py").write_text(OVERRUN)
    # Without capturing: what is captured is lost when the process ends.
    done = sanitized(str(tmp_path / "test_overrun.py"), "-s")
    assert done.returncode != 0
    assert "AddressSanitizer" in done.stderr + done.stdout
