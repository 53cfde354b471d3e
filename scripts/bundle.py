"""Bundles trained models: judges each on its test set and puts it among the package's weights.

Usage: ``bundle.py --data DIR RUNS``, where ``RUNS/m-SET`` is what ``trajectron train
--eth-ucy SET --out RUNS/m-SET`` left, for ``all`` and for the five test sets. The figures
go into the provenance beside the hash of the data and windows they were measured on; the
default model, trained on parts of all recordings, has figures on validation data only.
"""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path
from typing import Any

from trajectron_model import checkpoint, registry
from trajectron_model.checkpoint import Checkpoint
from trajectron_model.data.eth_ucy import TEST_SETS, EthUcy
from trajectron_model.data.windows import PROTOCOLS
from trajectron_model.evaluate import Contender, Entry, EvaluationSet, evaluate
from trajectron_model.predictor import TrajectronPredictor

WEIGHTS = Path(registry.__file__).parent / "weights"
SAMPLES, SEED = 100, 0


def figures(trained: Checkpoint, test_set: str, benchmark: EthUcy) -> dict[str, Any]:
    """What the provenance says of a leave-one-out model's errors on its test set."""
    predictor = TrajectronPredictor(trained.model, trained.name)
    contender = Contender.of_model(predictor, trained.sha256, trained.provenance)
    result = evaluate(
        [Entry(trained.name, {test_set: contender})],
        [EvaluationSet(test_set, tuple(benchmark.test(test_set)))],
        protocol=PROTOCOLS["sgan"],
        samples=SAMPLES,
        seed=SEED,
    )
    scores = asdict(result.rows[0].sets[0].scores)
    return {"fingerprint": asdict(result.fingerprint), "errors_m": scores}


def main() -> None:
    """Bundles all six."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("runs", type=Path)
    parser.add_argument("--data", type=Path, required=True)
    arguments = parser.parse_args()
    benchmark = EthUcy(arguments.data)
    WEIGHTS.mkdir(exist_ok=True)
    for test_set in ("all", *TEST_SETS):
        trained = Checkpoint.load(arguments.runs / f"m-{test_set}")
        provenance = dict(trained.provenance)
        name = registry.DEFAULT
        if test_set != "all":
            name = f"{registry.DEFAULT}-without-{test_set}"
            provenance["evaluation"] = figures(trained, test_set, benchmark)
        checkpoint.save(WEIGHTS / name, trained.model, provenance)
        print(name, provenance["selected"], provenance.get("evaluation", {}).get("errors_m", ""))


if __name__ == "__main__":
    main()
