"""The committed figures are of the weights that ship, and the README quotes them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from trajectron_model import registry
from trajectron_model.evaluation.contenders import FAMILY, LEAVE_ONE_OUT

ROOT = Path(__file__).parents[2]
QUOTED = {
    "sgan": {
        "point forecast: mean of all modes": ("ade_mean", "fde_mean"),
        "point forecast: most probable mode": ("ade_mode", "fde_mode"),
        "best of 20, per agent": ("min_ade_20", "min_fde_20"),
        "best of 20, joint per scene": ("joint_ade_20", "joint_fde_20"),
        "best of 100, per agent": ("min_ade_100", "min_fde_100"),
        "best of 100, joint per scene": ("joint_ade_100", "joint_fde_100"),
    },
    "paper": {"ours, causal, streaming": ("joint_ade_100", "joint_fde_100")},
}


def ours(protocol: str) -> dict[str, Any]:
    file = ROOT / "benchmarks" / "results" / f"evaluation-{protocol}.json"
    rows: list[dict[str, Any]] = json.loads(file.read_text(encoding="utf-8"))["rows"]
    return next(row for row in rows if row["name"] == LEAVE_ONE_OUT)


@pytest.mark.parametrize("protocol", QUOTED)
def test_the_committed_figures_are_of_the_bundled_weights(protocol: str) -> None:
    judged = {one["test_set"]: one["model_sha256"] for one in ours(protocol)["sets"]}
    shipped = {name: registry.load(FAMILY.format(test_set=name)).sha256 for name in judged}
    assert judged == shipped and len(judged) == 5


@pytest.mark.parametrize("protocol", QUOTED)
def test_the_readme_quotes_the_committed_figures(protocol: str) -> None:
    row = ours(protocol)
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    for title, (ade, fde) in QUOTED[protocol].items():
        scores = [*(one["scores"] for one in row["sets"]), row["mean"]]
        cells = [
            f"{one['metrics'][ade]['value']:.3f}/{one['metrics'][fde]['value']:.3f}"
            for one in scores
        ]
        assert f"| {title} | {' | '.join(cells)} |" in readme
