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
from typing import Any

TASKS_PER_THREAD = 4
"""More tasks than threads, so that one that gets the heavy rows does not keep the others waiting."""

LITTLE_WORK = 20_000
"""Below so many steps a loop stays on the thread that asks for it."""


class _Helper:
    """A thread that does one job at a time, and in between waits for the next."""

    def __init__(self) -> None:
        self._wake = threading.Lock()
        self._wake.acquire()
        self._job: _Job
        threading.Thread(target=self._serve, name="rts", daemon=True).start()

    def begin(self, job: _Job) -> None:
        """Do this next."""
        self._job = job
        self._wake.release()

    def _serve(self) -> None:
        while True:
            self._wake.acquire()
            job = self._job
            try:
                job.work()
            except BaseException as error:
                job.error = error
            with _lock:
                _idle.append(self)
            job.done.release()


class _Job:
    """Work for one helper, its end and its error."""

    def __init__(self, work: Callable[[], None]):
        self.work, self.done = work, threading.Lock()
        self.error: BaseException | None = None
        self.done.acquire()

    def wait(self) -> None:
        """Until it is done; raises what it raised."""
        self.done.acquire()
        if self.error is not None:
            raise self.error


_idle: list[_Helper] = []
_made = 0
_lock = threading.Lock()


def _forget() -> None:
    """A forked child has none of its parent's threads."""
    global _made
    _idle.clear()
    _made = 0
    _lock.release()


if hasattr(os, "register_at_fork"):  # No child is to find the lock held by a thread that it does not have.
    os.register_at_fork(before=_lock.acquire, after_in_parent=_lock.release, after_in_child=_forget)


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
    jobs = []
    for helper in _helpers(threads - 1):
        jobs.append(_Job(work))
        helper.begin(jobs[-1])
    try:
        work()
    finally:
        for job in jobs:
            job.wait()


def _helpers(count: int) -> list[_Helper]:
    """So many idle helpers; fewer where some of those that there may be are busy for other threads."""
    global _made
    with _lock:
        missing = max(0, min(count - len(_idle), count - _made))
        _made += missing
        return [_idle.pop() for _ in range(min(count, len(_idle)))] + [_Helper() for _ in range(missing)]
