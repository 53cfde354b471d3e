"""Bundles trained models: puts them among the package's weights, with their measured errors.

Usage: ``bundle.py RUNS [--evaluation FILE]``, where ``RUNS/m-SET`` is what ``trajectron
train --eth-ucy SET --out RUNS/m-SET`` left, for ``all`` and for the five test sets, and
FILE what ``trajectron evaluate --leave-one-out --json FILE`` wrote for these very weights.
The default model, trained on parts of all recordings, has figures on validation data only.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from trajectron_model import checkpoint, registry
from trajectron_model.checkpoint import Checkpoint
from trajectron_model.data.eth_ucy import TEST_SETS
from trajectron_model.evaluation.judging import BEST_OF

WEIGHTS = Path(registry.__file__).parent / "weights"


def errors_of(evaluation: dict[str, Any], test_set: str, sha256: str) -> dict[str, Any]:
    """What the provenance says of a leave-one-out model's errors on its test set.

    Raises:
        SystemExit: the evaluation judged no such weights on that set out of sample.
    """
    found = [
        judged
        for row in evaluation["rows"]
        for judged in row["sets"]
        if judged["test_set"] == test_set and judged["model_sha256"] == sha256
    ]
    if len(found) != 1 or found[0]["in_sample"]:
        raise SystemExit(f"the evaluation has no out-of-sample row of {sha256[:8]} on {test_set}")
    fingerprint = evaluation["fingerprint"]
    of_set = next(s for s in fingerprint["sets"] if s["test_set"] == test_set)
    return {
        "errors_m": errors_m(found[0]["scores"]["metrics"]),
        "fingerprint": {**fingerprint, "sets": [of_set]},
    }


def errors_m(metrics: dict[str, Any]) -> dict[str, Any]:
    """The displacement errors among an evaluation's metrics, metres."""

    def pair(ade: str, fde: str) -> dict[str, float]:
        return {"ade_m": metrics[ade]["value"], "fde_m": metrics[fde]["value"]}

    return {
        "mode_mean": pair("ade_mode", "fde_mode"),
        "mean": pair("ade_mean", "fde_mean"),
        "best_of": [
            {
                "n": n,
                "per_agent": pair(f"min_ade_{n}", f"min_fde_{n}"),
                "joint": pair(f"joint_ade_{n}", f"joint_fde_{n}"),
            }
            for n in BEST_OF
            if f"min_ade_{n}" in metrics
        ],
    }


def main() -> None:
    """Bundles all six."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("runs", type=Path)
    parser.add_argument("--evaluation", type=Path)
    arguments = parser.parse_args()
    evaluation = json.loads(arguments.evaluation.read_text()) if arguments.evaluation else None
    WEIGHTS.mkdir(exist_ok=True)
    for test_set in ("all", *TEST_SETS):
        trained = Checkpoint.load(arguments.runs / f"m-{test_set}")
        provenance = dict(trained.provenance)
        name = registry.DEFAULT
        if test_set != "all":
            name = f"{registry.DEFAULT}-without-{test_set}"
            if evaluation is not None:
                provenance["evaluation"] = errors_of(evaluation, test_set, trained.sha256)
        checkpoint.save(WEIGHTS / name, trained.model, provenance)
        print(name, trained.sha256[:8], provenance["selected"])


if __name__ == "__main__":
    main()
