"""Carries out one evaluation, in a process of its own.

Its arguments are the folder of the run and, where there is one, that of the data set. It runs the
plan of ``plan.json`` where it stands; killed at any time, it goes on from there. It tells its
progress, or why it cannot go on.
"""

from __future__ import annotations

import fcntl
import json
import sys
import time
from pathlib import Path

from trajectron_model.checkpoint import CheckpointError, write_atomically
from trajectron_model.data.errors import DataError
from trajectron_model.evaluation.contenders import ContenderError, InSampleError
from trajectron_model.evaluation.pictures import AllScores
from trajectron_model.evaluation.plan import EvaluationPlan, PlanError
from trajectron_model.evaluation.report import write_report
from trajectron_model.evaluation.results import Evaluation
from trajectron_model.evaluation.run import RESULT, Progress, load_scores, run
from trajectron_service.evaluations.entries import as_asked, asked
from trajectron_service.evaluations.launch import say

# Mistakes in what was asked for; anything else is a fault, with its traceback in the log.
_REFUSALS = (CheckpointError, ContenderError, InSampleError, PlanError)
# People watch: more often tells them nothing.
_SHORTEST_PAUSE_S = 0.2


class _Teller:
    """Tells progress, not more often than anybody wants to know."""

    def __init__(self) -> None:
        self._told_s = -_SHORTEST_PAUSE_S

    def __call__(self, progress: Progress) -> None:
        now_s = time.monotonic()
        if now_s - self._told_s >= _SHORTEST_PAUSE_S or progress.share >= 1.0:
            self._told_s = now_s
            say({"progress": progress._replace(entry=asked(progress.entry))._asdict()})


def main(folder: Path, data: Path | None) -> int:
    """Runs the plan to its end; gives the exit status, 1 after having told why it could not."""
    with (folder / "lock").open("w") as lock:
        # The process of a service that was killed may be about to go; it must not write as well.
        fcntl.flock(lock, fcntl.LOCK_EX)
        try:
            plan = EvaluationPlan.from_json(json.loads(Path("plan.json").read_bytes()))
            evaluation = run(plan, folder, data=data, progress=_Teller(), cancelled=lambda: False)
        except DataError as error:
            # Not its folder, which is the operator's to know.
            line = "" if error.line is None else f":{error.line}"
            say({"refused": f"{error.path.name}{line}: {error.reason}"})
            return 1
        except _REFUSALS as error:
            say({"refused": str(error)})
            return 1
        _write_results(evaluation, load_scores(plan, folder, data=data), folder)
    return 0


def _write_results(evaluation: Evaluation, scores: AllScores, folder: Path) -> None:
    """Every form of the result, by the names asked for; the JSON replaces the run's own."""
    named = as_asked(evaluation)
    scores = {(asked(entry), test_set): found for (entry, test_set), found in scores.items()}
    content = json.dumps(named.to_json(), allow_nan=False) + "\n"
    write_atomically(folder / RESULT, content.encode())
    write_atomically(folder / "result.csv", named.to_csv().encode())
    write_report(named, scores, folder)


if __name__ == "__main__":
    raise SystemExit(main(Path(sys.argv[1]), Path(sys.argv[2]) if len(sys.argv) > 2 else None))
