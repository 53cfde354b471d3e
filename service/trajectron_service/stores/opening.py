"""The store that the settings name."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from trajectron_service import logs
from trajectron_service.metrics import Metrics
from trajectron_service.settings import Settings, SettingsError
from trajectron_service.stores import Durability, SessionStore, StoreError
from trajectron_service.stores.guarded import GuardedStore
from trajectron_service.stores.memory import MemoryStore
from trajectron_service.stores.sqlite import SqliteStore

log = logs.get(__name__)

_FILE = "sessions.sqlite3"


async def open_store(settings: Settings, metrics: Metrics) -> SessionStore:
    """The store, ready; the caller closes it.

    Raises:
        SettingsError: it cannot be opened, or does not keep what is asked of it.
    """
    wanted = Durability(settings.store_durability)
    try:
        store = await _open(settings, wanted, metrics.store_group.observe)
    except StoreError as error:
        raise SettingsError(f"store: {error}") from error
    given = store.durability
    if store.durable and given is not Durability.DISK:
        log.warning(
            "acknowledged frames can be lost when the power fails: store_durability is not disk",
            kind=store.kind,
            durability=given.value,
        )
    metrics.store_info.labels(store.kind, given.value).set(1)
    metrics.quarantined.set(await store.quarantined())
    return GuardedStore(store, metrics, settings.store_timeout_s)


async def _open(
    settings: Settings, durability: Durability, on_commit: Callable[[int], None]
) -> SessionStore:
    chosen = settings.store or ("sqlite" if settings.state_dir else "memory")
    kind, _, place = chosen.partition(":")
    if kind == "memory":
        return MemoryStore()
    if kind == "sqlite":
        return SqliteStore.open(_file(place, settings.state_dir), durability, on_commit)
    try:
        from trajectron_service.stores.redis import RedisStore  # noqa: PLC0415  an extra
    except ImportError as error:
        raise SettingsError(
            "store: redis needs the package redis: pip install 'trajectron-service[redis]'"
        ) from error
    return await RedisStore.open(chosen, durability, settings.store_timeout_s, on_commit)


def _file(place: str, state_dir: Path | None) -> Path:
    if place:
        return Path(place)
    if state_dir is None:
        raise SettingsError("store: sqlite needs a path (sqlite:PATH) or a state_dir")
    return state_dir / _FILE
