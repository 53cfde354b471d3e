"""Work on rows shared among threads.

Kernels are called through ctypes, which lets go of the interpreter: plain threads are enough.
As many as torch is set to. Around kernels torch itself is kept to one (`torch_alone`): what is
left to it is small, and its own threads, which wait by spinning, would take the processor from
the kernels' or stand in each other's way whenever the machine has something else to do.
"""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

import torch

from trajectron_model.kernels.loading import kernels

_here = threading.local()


@contextmanager
def torch_alone() -> Iterator[None]:
    """Torch works on one thread inside; `share` still on as many as it was set to.

    Without kernels nothing changes.
    """
    threads = torch.get_num_threads()
    if threads == 1 or kernels() is None:
        yield
        return
    _here.threads = threads
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
        del _here.threads


def share(rows: int, least: int, work: Callable[[int, int], None]) -> None:
    """Calls ``work(first, last)`` on runs of rows, at once, until all are done.

    Args:
        rows: how many there are.
        least: too few to be worth a thread.
        work: raises what it raises here.
    """
    threads = getattr(_here, "threads", 0) or torch.get_num_threads()
    parts = max(1, min(threads, rows // least))
    edges = [rows * part // parts for part in range(parts + 1)]
    if parts == 1:
        work(0, rows)
        return
    others = [_pool().submit(work, edges[i], edges[i + 1]) for i in range(1, parts)]
    try:
        work(edges[0], edges[1])
    finally:
        # The buffers that they write to live here: nobody leaves before all are done.
        for other in others:
            other.result()


@functools.cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(thread_name_prefix="kernels")
