"""Compiled loops on all cores.

A pool of plain Python threads runs kernels that release the interpreter lock. numba's own parallel loops are not used:
their OpenMP threads spin against torch's for milliseconds after every loop, and its other layers must not be entered
by two threads at once.
"""

from __future__ import annotations

import itertools
import os
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

TASKS_PER_THREAD = 4
"""More tasks than threads, so that one that gets the heavy rows does not keep the others waiting."""

LITTLE_WORK = 20_000
"""Below so many steps a loop stays on the thread that asks for it."""

_pools: dict[tuple[int, int], ThreadPoolExecutor] = {}
_lock = threading.Lock()
if hasattr(os, "register_at_fork"):  # No child is to find it held by a thread that it does not have.
    os.register_at_fork(before=_lock.acquire, after_in_parent=_lock.release, after_in_child=_lock.release)


def thread_count() -> int:
    """Threads to use: the variable RTS_NUM_THREADS, or the cores this process may run on."""
    wanted = os.environ.get("RTS_NUM_THREADS", "")
    if wanted.isdigit() and int(wanted) > 0:
        return int(wanted)
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def parallel(kernel: Callable, count: int, *args: Any, work: int = LITTLE_WORK) -> None:
    """Call `kernel(start, stop, *args)` so that the ranges cover [0, count); the kernel must release the lock.

    Args:
        kernel: the loop.
        count: the end of the range.
        *args: handed on.
        work: steps of some nanoseconds in all; where they are few, waking threads would take longer.
    """
    threads = thread_count()
    tasks = min(count, threads * TASKS_PER_THREAD)
    if threads == 1 or tasks <= 1 or work < LITTLE_WORK:
        kernel(0, count, *args)
        return
    bounds = [count * i // tasks for i in range(tasks + 1)]
    numbers = itertools.count()

    def work() -> None:
        while (task := next(numbers)) < tasks:
            kernel(bounds[task], bounds[task + 1], *args)

    # The caller works too, so that only its helpers have to be woken.
    futures = [_pool(threads - 1).submit(work) for _ in range(threads - 1)]
    try:
        work()
    finally:
        for future in futures:
            future.result()


def _pool(threads: int) -> ThreadPoolExecutor:
    key = os.getpid(), threads  # A forked child has none of its parent's threads.
    with _lock:
        if key not in _pools:
            _pools[key] = ThreadPoolExecutor(threads, thread_name_prefix="rts")
        return _pools[key]
