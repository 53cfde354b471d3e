"""Kills the service under streaming load, again and again, and looks for what is missing.

    python -m benchmarks.crash --kills 100 --json benchmarks/results/crash.json

Sessions stream into a service that keeps them in SQLite. At random moments it gets SIGKILL and is
started again; the clients go on by themselves. After each restart every session must have each
acknowledged frame, once; in the end every forecast is compared with that of a session that
was never interrupted. Half of the kills are done with every forecast alone in its batch, where
it must be the same to the last bit; half with batches shared, where DESIGN.md's rule holds
(parameters to 1e-4; at most one sample in 10,000 differs).
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import random
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from benchmarks.interruptions import ALONE, Comparison, Load, check_stored, compare, middle
from benchmarks.replica import Replica

MODEL = "eth_ucy"


def crash(
    kills: int, sessions: int, folder: Path, *, alone: bool, seed: int, model: str = MODEL
) -> tuple[Comparison, list[float]]:
    """Kills one service so often; what came of it, and the seconds of each restart."""
    chance = random.Random(seed)
    settings = ALONE if alone else {}
    store = {"store": f"sqlite:{folder / 'sessions.sqlite3'}"}
    replica = Replica(folder, model, {**settings, **store})
    load = Load((replica.target,), sessions)
    restarts: list[float] = []
    try:
        replica.start()
        load.start()
        for _ in range(kills):
            load.moves_on()
            time.sleep(chance.uniform(0.0, 1.0))
            acknowledged = load.acknowledged()
            replica.kill()
            restarts.append(replica.start())
            check_stored(replica.target, load.walks, acknowledged)
        load.moves_on()
        load.stop()
        return compare(load.walks, replica.target), restarts
    finally:
        replica.end()


def report(kills: int, sessions: int, seed: int) -> dict[str, Any]:
    """Both parts, as JSON values."""
    parts: dict[str, Any] = {}
    for name, alone, share in (("alone", True, kills - kills // 2), ("shared", False, kills // 2)):
        if not share:
            continue
        with tempfile.TemporaryDirectory() as folder:
            result, restarts = crash(share, sessions, Path(folder), alone=alone, seed=seed)
        parts[name] = {
            "kills": share,
            **dataclasses.asdict(result),
            "restart_median_s": middle(restarts),
            "passed": result.exact if alone else result.whole,
        }
        print_part(name, parts[name])
    return {"kills": kills, "seed": seed, "store": "sqlite", "parts": parts}


def print_part(name: str, part: dict[str, Any]) -> None:
    """One part as a table of two columns."""
    print(f"\n{name}")
    for field, value in part.items():
        print(f"  {field:<24} {value}")


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--sessions", type=int, default=4)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    result = report(args.kills, args.sessions, args.seed)
    if args.json:
        args.json.write_text(json.dumps(result, indent=2) + "\n")
    if not all(part["passed"] for part in result["parts"].values()):
        sys.exit("frames or forecasts are not what they would have been")


if __name__ == "__main__":
    main()
