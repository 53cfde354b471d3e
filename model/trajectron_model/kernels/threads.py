"""Work on rows shared among threads.

Kernels are called through ctypes, which lets go of the interpreter: plain threads are enough.
As many as torch uses, since the two never work at once.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import torch


def share(rows: int, least: int, work: Callable[[int, int], None]) -> None:
    """Calls ``work(first, last)`` on runs of rows, at once, until all are done.

    Args:
        rows: how many there are.
        least: too few to be worth a thread.
        work: raises what it raises here.
    """
    parts = max(1, min(torch.get_num_threads(), rows // least))
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
