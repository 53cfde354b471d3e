"""Finds the library for this processor, once; says why there is none."""

from __future__ import annotations

import ctypes
import functools
import os
import platform
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from trajectron_model.kernels import build

SWITCH = "TRAJECTRON_KERNELS"
"""Environment variable: ``off`` does without kernels, a path names a library to take."""


_here = threading.local()


@dataclass(frozen=True)
class Kernels:
    """A loaded library.

    Attributes:
        variant: its instruction set.
        library: the functions; each binding states the types of its own.
        lanes: float32 numbers in a vector.
        tile_rows: rows that a product takes at a time.
    """

    variant: str
    library: ctypes.CDLL
    lanes: int
    tile_rows: int


@dataclass(frozen=True)
class Unavailable:
    """Why torch does the work."""

    reason: str


def kernels() -> Kernels | None:
    """The library for this processor, or None where torch does the work."""
    if getattr(_here, "without", False):
        return None
    found = _found()
    return found if isinstance(found, Kernels) else None


@contextmanager
def without() -> Iterator[None]:
    """Torch does the work inside, in this thread: for comparing the two."""
    _here.without = True
    try:
        yield
    finally:
        _here.without = False


def in_use() -> str:
    """What does the work: an instruction set's name, or ``torch`` and why."""
    found = _found()
    return found.variant if isinstance(found, Kernels) else f"torch: {found.reason}"


@functools.cache
def _found() -> Kernels | Unavailable:
    asked = os.environ.get(SWITCH, "")
    if asked.lower() in ("off", "0", "false", "no"):
        return Unavailable(f"{SWITCH}={asked}")
    if asked and asked.lower() not in ("on", "1", "true", "yes", "auto"):
        return _load(Path(asked), Path(asked).stem)
    able = _processor_flags()
    wanted = [variant for variant in build.variants() if variant.needs <= able]
    for variant in wanted:
        path = build.LIBRARIES / variant.file_name
        if path.exists():
            return _load(path, variant.name)
    if not wanted:
        return Unavailable(f"none for this processor ({platform.machine()})")
    return Unavailable("not compiled: see docs/kernels.md")


def _load(path: Path, variant: str) -> Kernels | Unavailable:
    try:
        library = ctypes.CDLL(str(path))
        library.trajectron_fingerprint.restype = ctypes.c_char_p
        made_from = library.trajectron_fingerprint().decode()
    except (OSError, AttributeError) as error:
        return Unavailable(f"{path.name} cannot be loaded: {error}")
    if made_from != build.fingerprint():
        # Arguments might have changed: calling it could crash.
        return Unavailable(f"{path.name} is older than its sources: make install")
    return Kernels(variant, library, library.trajectron_lanes(), library.trajectron_tile_rows())


def _processor_flags() -> frozenset[str]:
    """As Linux names them: of the first core; nothing elsewhere."""
    try:
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8")
    except OSError:
        return frozenset()
    for line in text.splitlines():
        name, _, value = line.partition(":")
        if name.strip().lower() in ("flags", "features"):
            return frozenset(value.split())
    return frozenset()
