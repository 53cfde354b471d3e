"""Moves sessions between two replicas on one Redis, mid-stream, by killing and draining them.

    python -m benchmarks.handover --kills 10 --drains 10 --json benchmarks/results/handover.json

Sessions stream to a list of two addresses. In turn a replica gets SIGKILL or SIGTERM at a random
moment, the other one goes on with its sessions, and it is started again. After each move every
session must have each acknowledged frame, once; in the end every forecast is compared with
that of a session that was never interrupted, to the last bit: each is alone in its batch.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from benchmarks.interruptions import ALONE, Comparison, Load, check_stored, compare, middle
from benchmarks.replica import Replica, free_port

MODEL = "eth_ucy"


def handover(
    kills: int,
    drains: int,
    sessions: int,
    folder: Path,
    redis: str,
    *,
    seed: int,
    model: str = MODEL,
) -> tuple[Comparison, dict[str, list[float]]]:
    """Moves sessions so often; what came of it, and how long the streams stood still at each."""
    chance = random.Random(seed)
    ways = ["kill"] * kills + ["drain"] * drains
    chance.shuffle(ways)
    settings = ALONE | {"store": redis, "drain_grace_s": "5"}
    replicas = [Replica(folder, model, settings) for _ in range(2)]
    load = Load([replica.target for replica in replicas], sessions)
    stood_s: dict[str, list[float]] = {"kill": [], "drain": []}
    try:
        for replica in replicas:
            replica.launch()
        for replica in replicas:
            replica.ready()
        load.start()
        for turn, way in enumerate(ways):
            load.moves_on()
            time.sleep(chance.uniform(0.0, 1.0))
            # Whoever has the sessions now: they moved to the other one the last time.
            leaving, staying = replicas[turn % 2], replicas[1 - turn % 2]
            acknowledged = load.acknowledged()
            began = time.monotonic()
            if way == "kill":
                leaving.kill()
            else:
                leaving.drain()
            load.moves_on()
            stood_s[way].append(time.monotonic() - began)
            check_stored(staying.target, load.walks, acknowledged)
            if turn + 1 < len(ways):
                leaving.start()
        load.stop()
        return compare(load.walks, staying.target), stood_s
    finally:
        for replica in replicas:
            replica.end()


@contextmanager
def redis_server(folder: Path) -> Iterator[str]:
    """The URL of a durable Redis that lives as long as the block."""
    program = shutil.which("redis-server")
    if program is None:
        sys.exit("redis-server is needed; install Debian's redis-server")
    port = free_port()
    command = [program, "--port", str(port), "--bind", "127.0.0.1", "--dir", str(folder)]
    durable = ["--appendonly", "yes", "--appendfsync", "always", "--save", ""]
    with (folder / "redis.log").open("wb") as log:
        process = subprocess.Popen([*command, *durable], stdout=log, stderr=log)
    try:
        yield f"redis://127.0.0.1:{port}/0"
    finally:
        process.kill()
        process.wait()


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--kills", type=int, default=10)
    parser.add_argument("--drains", type=int, default=10)
    parser.add_argument("--sessions", type=int, default=4)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as name, redis_server(Path(name)) as url:
        result, stood_s = handover(
            args.kills, args.drains, args.sessions, Path(name), url, seed=args.seed
        )
    report: dict[str, Any] = {
        "store": "redis",
        "kills": args.kills,
        "drains": args.drains,
        **dataclasses.asdict(result),
        "until_all_go_on_after_kill_median_s": middle(stood_s["kill"]),
        "until_all_go_on_after_drain_median_s": middle(stood_s["drain"]),
        "passed": result.exact,
    }
    for field, value in report.items():
        print(f"  {field:<38} {value}")
    if args.json:
        args.json.write_text(json.dumps(report, indent=2) + "\n")
    if not result.exact:
        sys.exit("frames or forecasts are not what they would have been")


if __name__ == "__main__":
    main()
