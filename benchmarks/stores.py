"""What keeping sessions costs: acknowledged frames per second, and bytes per agent, by store.

    python -m benchmarks.stores --json benchmarks/results/stores.json

Frames: sessions push frames one after the other, all sessions at once, through the application
(no transport, the default model); every acknowledged frame is safe in its store. Stores take
turns within one run, so that ratios to memory hold on a busy machine, too; the best round counts.
Writes: the same bytes straight into the store, for what it can take at most.
Bytes: the record of a scene in which 1, 10 or 40 people have walked for 12 frames.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import tempfile
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

from benchmarks.handover import redis_server
from trajectron_service import engine as engines
from trajectron_service import records, tenancy
from trajectron_service.application import Application
from trajectron_service.engine import Engine
from trajectron_service.messages import Agent, Frame, SessionConfig
from trajectron_service.metrics import Metrics
from trajectron_service.settings import Settings
from trajectron_service.stores import Quota, SessionKey, SessionStore, StoredSession, new_revision
from trajectron_service.stores.memory import MemoryStore
from trajectron_service.stores.redis import RedisStore
from trajectron_service.stores.sqlite import SqliteStore

_DT_S = 0.4
_WARM = 12  # frames: as long as the history that counts
_AGENTS = (1, 10, 40)
_WRITES = 2000

Opening = Callable[[], Awaitable[SessionStore]]


def frame(step: int, agents: int) -> Frame:
    """People a metre apart who walk along x at 1.25 m/s."""
    people = (Agent(f"{n}", "pedestrian", 0.5 * step, float(n)) for n in range(agents))
    return Frame(step * _DT_S, tuple(people))


@asynccontextmanager
async def application(engine: Engine, store: SessionStore) -> AsyncIterator[Application]:
    """The service without a transport, over one store."""
    app = Application(Settings(warm_up=False), engine, Metrics(), store=store)
    try:
        yield app
    finally:
        await app.close()
        await store.close()


async def frames_per_second(
    engine: Engine, opening: Opening, sessions: int, frames: int, agents: int
) -> float:
    """Frames acknowledged in a second, of all sessions together."""
    async with application(engine, await opening()) as app:
        ids = [(await app.create_session(None, SessionConfig())).id for _ in range(sessions)]

        async def push(session_id: str, steps: range) -> None:
            for step in steps:
                await app.observe(session_id, (frame(step, agents),), None)

        await asyncio.gather(*(push(one, range(2)) for one in ids))
        began = time.perf_counter()
        await asyncio.gather(*(push(one, range(2, 2 + frames)) for one in ids))
        took_s = time.perf_counter() - began
        for one in ids:
            await app.delete_session(one)
    return sessions * frames / took_s


async def writes_per_second(opening: Opening, sessions: int, data: bytes) -> float:
    """Writes of a record that a store acknowledges in a second, of all sessions together."""
    store = await opening()

    async def push(number: int) -> None:
        key, last = (
            SessionKey(tenancy.current(), str(number)),
            StoredSession(new_revision(), 1e12, data),
        )
        await store.create(key, last, Quota(sessions))
        for _ in range(_WRITES // sessions):
            following = StoredSession(new_revision(), 1e12, data)
            assert await store.write(key, following, last.revision)
            last = following

    began = time.perf_counter()
    await asyncio.gather(*map(push, range(sessions)))
    took_s = time.perf_counter() - began
    await store.close()
    return _WRITES / took_s


async def stored_bytes(engine: Engine, agents: int) -> tuple[int, int, bytes]:
    """Bytes of a session's record, those of them that are states, and the record."""
    store = MemoryStore(durable=True)
    async with application(engine, store) as app:
        info = await app.create_session("one", SessionConfig())
        for step in range(_WARM):
            await app.observe(info.id, (frame(step, agents),), None)
        stored = await store.read(SessionKey(tenancy.current(), info.id))
    assert stored is not None  # just written
    states = records.decode(stored.data).states
    assert isinstance(states, bytes)  # as they were stored
    return len(stored.data), len(states), stored.data


async def measure(
    folder: Path, url: str, sessions: int, frames: int, rounds: int
) -> dict[str, Any]:
    """Everything, as JSON values."""
    engine = engines.load(Settings())
    places = iter(range(10_000))

    async def memory() -> SessionStore:
        return MemoryStore()

    async def packed() -> SessionStore:
        return MemoryStore(durable=True)

    async def sqlite() -> SessionStore:
        return SqliteStore.open(folder / f"{next(places)}.sqlite3")

    async def redis() -> SessionStore:
        opened = await RedisStore.open(url)
        await opened._client.flushdb()  # noqa: SLF001  this server is the benchmark's own
        return opened

    sizes = {agents: await stored_bytes(engine, agents) for agents in _AGENTS}
    stores: dict[str, Opening] = {
        "memory": memory,
        "memory, packed": packed,
        "sqlite": sqlite,
        "redis": redis,
    }
    best = {name: {"frames": 0.0, "writes": 0.0} for name in stores}
    for _ in range(rounds):
        for name, opening in stores.items():
            rate = await frames_per_second(engine, opening, sessions, frames, 10)
            best[name]["frames"] = max(best[name]["frames"], rate)
            rate = await writes_per_second(opening, sessions, sizes[10][2])
            best[name]["writes"] = max(best[name]["writes"], rate)
    return {
        "sessions": sessions,
        "agents": 10,
        "rounds": rounds,
        "stores": {
            name: {
                "frames_per_s": round(rates["frames"], 1),
                "frames_beside_memory": round(rates["frames"] / best["memory"]["frames"], 3),
                "writes_per_s": round(rates["writes"], 1),
            }
            for name, rates in best.items()
        },
        "bytes": {
            str(agents): {
                "record": whole,
                "states": states,
                "per_agent": round(whole / agents, 1),
            }
            for agents, (whole, states, _) in sizes.items()
        },
    }


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--sessions", type=int, default=32)
    parser.add_argument("--frames", type=int, default=20)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--folder", type=Path, help="on the disk to measure; a temporary one")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    with (
        tempfile.TemporaryDirectory(dir=args.folder) as name,
        redis_server(Path(name)) as url,
    ):
        result = asyncio.run(measure(Path(name), url, args.sessions, args.frames, args.rounds))
    print(f"{'store':<15} {'frames/s':>9} {'beside memory':>14} {'writes/s':>9}")
    for store, row in result["stores"].items():
        rates = (row["frames_per_s"], row["frames_beside_memory"], row["writes_per_s"])
        print(f"{store:<15} {rates[0]:>9} {rates[1]:>14} {rates[2]:>9}")
    print(f"\n{'agents':<15} {'record':>9} {'states':>14} {'per agent':>9}")
    for agents, row in result["bytes"].items():
        print(f"{agents:<15} {row['record']:>9} {row['states']:>14} {row['per_agent']:>9}")
    if args.json:
        args.json.write_text(json.dumps(result, indent=2) + "\n")


if __name__ == "__main__":
    main()
