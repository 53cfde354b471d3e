"""Sessions in Redis: shared by replicas, as durable as the server's append-only file.

**Group commit.** One pipeline is on its way at a time; the writes of other sessions gather behind
it and share the next one, which the server answers after one write of its append-only file.
Reads do not wait for it.

**Durability** is the server's to give: it is asked on every new connection, and a connection to
a server that gives less than the settings name is refused.
"""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable, Mapping
from dataclasses import asdict
from typing import Any

import redis.asyncio as aioredis
from redis import exceptions
from redis.asyncio.retry import Retry
from redis.backoff import NoBackoff

from trajectron_service.stores import (
    CLOSURES_KEPT,
    CLOSURES_KEPT_S,
    QUARANTINED_KEPT,
    Closure,
    Creation,
    Durability,
    Quota,
    SessionKey,
    StoredSession,
    StoreError,
    redis_scripts,
)

_PREFIX = "{trajectron}:"
_EXPIRIES = f"{_PREFIX}expiries"
_CLOSURES = f"{_PREFIX}closures"
_CLOSURE = f"{_PREFIX}closure:"
_ASIDE = f"{_PREFIX}quarantined"
# Commands of one pipeline; more would make the first of them wait too long.
_GROUP = 512
_CONNECTIONS = 8
_ORDER = (Durability.NONE, Durability.OS, Durability.DISK)
# Everything that the client raises, and the operating system through it.
_FAULTS = (exceptions.RedisError, OSError, asyncio.TimeoutError)
_Command = tuple[str, tuple[str, ...], tuple[str | bytes | float, ...]]


class RedisStore:
    """Implements ``SessionStore``. Use ``open``.

    Args:
        url: as ``redis.from_url`` takes it.
        durability: the least that the server must give.
        timeout_s: for a connection, and for an answer.
        on_commit: told how many operations one pipeline took together.
    """

    kind = "redis"
    shared = True
    durable = True

    def __init__(
        self,
        url: str,
        durability: Durability,
        timeout_s: float,
        on_commit: Callable[[int], None] = lambda _operations: None,
    ) -> None:
        self._asked = durability
        self.durability = durability
        self._on_commit = on_commit
        self._pool = aioredis.BlockingConnectionPool.from_url(
            url,
            max_connections=_CONNECTIONS,
            timeout=timeout_s,
            socket_timeout=timeout_s,
            socket_connect_timeout=timeout_s,
            socket_keepalive=True,
            protocol=2,
            # Once more at once: a connection that was idle may have died with its server.
            retry=Retry(NoBackoff(), 1),
            retry_on_error=[exceptions.ConnectionError],
            redis_connect_func=self._greet,
        )
        self._client = aioredis.Redis(connection_pool=self._pool)
        self._waiting: list[tuple[_Command, asyncio.Future[Any]]] = []
        self._sender: asyncio.Task[None] | None = None

    @staticmethod
    async def open(
        url: str,
        durability: Durability = Durability.DISK,
        timeout_s: float = 5.0,
        on_commit: Callable[[int], None] = lambda _operations: None,
    ) -> RedisStore:
        """The store, connected.

        Raises:
            StoreError: the server cannot be reached, or gives less durability than asked.
        """
        try:
            store = RedisStore(url, durability, timeout_s, on_commit)
        except ValueError as error:
            raise StoreError(f"the URL of Redis cannot be read: {error}") from error
        try:
            await store._read(store._client.ping())
        except StoreError:
            await store.close()
            raise
        return store

    async def create(self, key: SessionKey, session: StoredSession, quota: Quota) -> Creation:
        """See ``SessionStore``."""
        limit = "" if quota.tenant is None else str(quota.tenant)
        keys = (_session(key), _EXPIRIES, _ids(key.tenant))
        made: bytes = await self._write(
            (
                redis_scripts.CREATE,
                keys,
                (*_fields(session), _member(key), key.id, quota.total, limit),
            )
        )
        return Creation(made.decode())

    async def read(self, key: SessionKey) -> StoredSession | None:
        """See ``SessionStore``."""
        names = ["revision", "expires_at", "data"]
        revision, expires_at, data = await self._read(self._client.hmget(_session(key), names))
        return (
            None if revision is None else StoredSession(revision.decode(), float(expires_at), data)
        )

    async def write(self, key: SessionKey, session: StoredSession, expected: str) -> bool:
        """See ``SessionStore``."""
        keys = (_session(key), _EXPIRIES)
        values = (*_fields(session), _member(key), expected)
        return bool(await self._write((redis_scripts.WRITE, keys, values)))

    async def touch(self, key: SessionKey, expires_at: float) -> bool:
        """See ``SessionStore``."""
        keys = (_session(key), _EXPIRIES)
        values = (repr(expires_at), _member(key))
        return bool(await self._write((redis_scripts.TOUCH, keys, values)))

    async def delete(
        self, key: SessionKey, closure: Closure, *, expired_by: float | None = None
    ) -> bool:
        """See ``SessionStore``."""
        limit = "" if expired_by is None else repr(expired_by)
        return await self._remove(key, closure, (limit, ""), ())

    async def quarantine(self, key: SessionKey, revision: str, closure: Closure) -> bool:
        """See ``SessionStore``."""
        aside = (f"{_ASIDE}:{_member(key)}:{revision}", _ASIDE)
        return await self._remove(key, closure, ("", revision), aside)

    async def closure(self, key: SessionKey) -> Closure | None:
        """See ``SessionStore``."""
        text = await self._read(self._client.get(_CLOSURE + _member(key)))
        return None if text is None else Closure(**json.loads(text))

    async def count(self, tenant: str | None = None) -> int:
        """See ``SessionStore``."""
        name = _EXPIRIES if tenant is None else _ids(tenant)
        return int(await self._read(self._client.zcard(name)))

    async def quarantined(self) -> int:
        """See ``SessionStore``."""
        return int(await self._read(self._client.zcard(_ASIDE)))

    async def page(self, tenant: str, after: str, limit: int) -> list[str]:
        """See ``SessionStore``."""
        found = self._client.zrangebylex(_ids(tenant), f"({after}", "+", start=0, num=limit)
        return [name.decode() for name in await self._read(found)]

    async def expired(self, now: float, limit: int) -> list[SessionKey]:
        """See ``SessionStore``."""
        due = self._client.zrangebyscore(_EXPIRIES, "-inf", repr(now), start=0, num=limit)
        return [SessionKey(*name.decode().split("/", 1)) for name in await self._read(due)]

    async def close(self) -> None:
        """See ``SessionStore``."""
        if self._sender is not None:
            await asyncio.wait({self._sender})
        await self._client.aclose()
        await self._pool.disconnect()

    async def _remove(
        self, key: SessionKey, closure: Closure, only: tuple[str, str], aside: tuple[str, ...]
    ) -> bool:
        member = _member(key)
        keys = (_session(key), _EXPIRIES, _ids(key.tenant), _CLOSURE + member, _CLOSURES, *aside)
        values = (
            *only,
            member,
            key.id,
            json.dumps(asdict(closure)),
            repr(closure.at),
            int(CLOSURES_KEPT_S),
            CLOSURES_KEPT,
            _CLOSURE,
            QUARANTINED_KEPT,
        )
        return bool(await self._write((redis_scripts.REMOVE, keys, values)))

    async def _read(self, asked: Any) -> Any:
        try:
            return await asked
        except _FAULTS as error:
            raise _store_error(error) from error

    async def _write(self, command: _Command) -> Any:
        """Sends a command with the next pipeline, and gives its answer."""
        answer: asyncio.Future[Any] = asyncio.get_running_loop().create_future()
        self._waiting.append((command, answer))
        if self._sender is None or self._sender.done():
            self._sender = asyncio.create_task(self._send(), name="redis-store")
        return await answer

    async def _send(self) -> None:
        """Sends pipelines of whatever waits, one after the other, until nothing does."""
        while self._waiting:
            group, self._waiting = self._waiting[:_GROUP], self._waiting[_GROUP:]
            pipeline = self._client.pipeline(transaction=False)
            for (script, keys, values), _ in group:
                pipeline.eval(script, len(keys), *keys, *values)
            try:
                answers = await pipeline.execute(raise_on_error=False)
            except Exception as error:  # noqa: BLE001  whatever it is, somebody waits for it
                answers = [error] * len(group)
            self._on_commit(len(group))
            for (_, future), answer in zip(group, answers, strict=True):
                if future.done():  # cancelled: nobody waits any more
                    continue
                if isinstance(answer, _FAULTS):
                    future.set_exception(_store_error(answer))
                elif isinstance(answer, Exception):
                    future.set_exception(answer)
                else:
                    future.set_result(answer)

    async def _greet(self, connection: Any) -> None:
        """On every new connection: what the server promises, before anything is written."""
        await connection.on_connect()
        names = ("appendonly", "appendfsync", "maxmemory", "maxmemory-policy")
        try:
            await connection.send_command("CONFIG", "GET", *names)
            flat = [word.decode() for word in await connection.read_response()]
            given, reason = _durability(dict(zip(flat[::2], flat[1::2], strict=True)))
        except exceptions.ResponseError as error:
            # Some hosts hide it; then nothing is known, and nothing is promised.
            given, reason = Durability.NONE, f"CONFIG GET is refused: {error}"
        if _ORDER.index(given) < _ORDER.index(self._asked):
            raise exceptions.ConnectionError(
                f"this Redis keeps writes at level {given.value!r} ({reason}), and "
                f"{self._asked.value!r} is asked for: set appendonly yes and appendfsync always "
                "on the server, or name the weaker level as store_durability"
            )
        self.durability = given


def _durability(config: Mapping[str, str]) -> tuple[Durability, str]:
    """What a server of this configuration promises, and why."""
    told = ", ".join(f"{name} {value}" for name, value in config.items())
    evicts = config["maxmemory"] != "0" and config["maxmemory-policy"] != "noeviction"
    if config["appendonly"] != "yes" or evicts:
        return Durability.NONE, told
    return (Durability.DISK if config["appendfsync"] == "always" else Durability.OS), told


def _store_error(error: BaseException) -> StoreError:
    told = StoreError(f"Redis: {str(error) or type(error).__name__}")
    told.__cause__ = error
    return told


def _session(key: SessionKey) -> str:
    return f"{_PREFIX}session:{_member(key)}"


def _ids(tenant: str) -> str:
    return f"{_PREFIX}ids:{tenant}"


def _member(key: SessionKey) -> str:
    return f"{key.tenant}/{key.id}"


def _fields(session: StoredSession) -> tuple[str, str, bytes]:
    return session.revision, repr(session.expires_at), session.data
