"""Compiled loops on all cores.

A pool of plain Python threads runs loops that release the interpreter lock. numba's own parallel loops are not used:
their OpenMP threads spin against torch's for milliseconds after every loop, and its other layers must not be entered
by two threads at once.
"""

from __future__ import annotations

import contextlib
import ctypes
import itertools
import os
import sys
import threading
from collections.abc import Callable, Sequence
from queue import SimpleQueue
from typing import Any, TypeVar

import numpy as np

TASKS_PER_THREAD = 4
"""Several tasks for each thread, so that one that gets the heavy rows does not keep the others waiting."""

LITTLE_WORK = 100_000
"""Nanoseconds, below which a loop stays on the thread that asks for it: to ask another takes tens of thousands."""

_In = TypeVar("_In")
_Out = TypeVar("_Out")


def _nothing() -> None:
    pass


def _core_of_caller() -> Callable[[], int] | None:
    """A function that tells on which core it is called; None where the system does not tell."""
    return getattr(ctypes.PyDLL(None), "sched_getcpu", None) if sys.platform == "linux" else None


_core = _core_of_caller()
_local = threading.local()


def cores() -> set[int]:
    """The cores that this thread may run on; a helper has those of the thread that asked it. Linux alone tells."""
    return getattr(_local, "cores", None) or os.sched_getaffinity(0)


class _Job:
    """Work that a helper is asked to join in; whoever claims it first, helper or caller, decides whether it does.

    Attributes:
        work: a function.
        cores: of the thread that asks, if the system tells.
        roams: whether it may run on all of these, also on that of this thread.
        error: what it raised.
    """

    def __init__(self, work: Callable[[], None], cores: set[int] | None, roams: bool):
        self.work, self.cores, self.roams = work, cores, roams
        self.error: BaseException | None = None
        self._unclaimed, self._going = threading.Lock(), threading.Lock()
        self._going.acquire()

    def claim(self) -> bool:
        """Whether nobody has claimed it before; it is the caller's then."""
        return self._unclaimed.acquire(blocking=False)

    def withdraw(self) -> bool:
        """Claim it so that nobody does it, and let go of what it would work on; False where it has been claimed."""
        mine = self.claim()
        if mine:
            self.work = _nothing
        return mine

    def run(self) -> None:
        """Do the work, and keep what it raises."""
        try:
            self.work()
        except BaseException as error:
            self.error = error

    def end(self) -> None:
        """Let go those that wait until it is done."""
        self._going.release()

    def wait(self) -> None:
        """Wait until it is done."""
        self._going.acquire()


class _Helpers:
    """Threads that wait for jobs."""

    def __init__(self) -> None:
        self.count = 0
        self._jobs: SimpleQueue[_Job] = SimpleQueue()
        self._under_way: set[_Job] = set()
        self._lock = threading.Lock()
        # Threads by the system's numbers, those of them that run anywhere now, and where the others run.
        self._threads: list[int] = []
        self._roaming: set[int] = set()
        self._placed: set[int] | None = None

    def free(self, count: int) -> int:
        """How many of so many helpers have nothing to do, or are not there yet."""
        return max(0, count - len(self._under_way))

    def start(self, count: int) -> None:
        """Start so many helpers, if there are fewer."""
        if self.count >= count:
            return
        with self._lock:
            while self.count < count:
                thread = threading.Thread(target=self._serve, name="rts", daemon=True)
                try:
                    thread.start()
                except RuntimeError:  # The system gives no more: those that there are, or the caller, do the work.
                    break
                self.count += 1
                if thread.native_id:
                    self._threads.append(thread.native_id)
                self._placed = None

    def keep_off(self, core: int, cores: set[int]) -> None:
        """Have helpers that have nothing to do run on other cores than one of these.

        Linux wakes a thread on the core of the one that wakes it, though others are idle, more often than not where
        there are two: it would wait there until the loop is over.
        """
        cores = cores - {core} or cores
        if self._under_way or cores == self._placed:
            return
        with self._lock:
            self._placed = cores
            for thread in self._threads:
                if thread not in self._roaming:
                    _place(thread, cores)

    def ask(self, job: _Job) -> None:
        """Hand a job to one of the helpers."""
        self._jobs.put(job)

    def _serve(self) -> None:
        while True:
            job = self._jobs.get()
            if job.claim():
                self._under_way.add(job)
                _local.cores = job.cores
                if job.roams and job.cores:
                    self._run_anywhere(job, job.cores)
                else:
                    job.run()
                self._under_way.discard(job)
                job.end()
            del job  # A thread that waits must not keep arrays alive.

    def _run_anywhere(self, job: _Job, cores: set[int]) -> None:
        """Run a job on any of some cores; where the helper runs afterwards is for the next that asks."""
        own = threading.get_native_id()
        with self._lock:
            self._roaming.add(own)
            _place(own, cores)
        job.run()
        with self._lock:
            self._roaming.discard(own)
            self._placed = None


def _place(thread: int, cores: set[int]) -> None:
    with contextlib.suppress(OSError):  # Where that may not be said, they run anywhere.
        os.sched_setaffinity(thread, cores)


_helpers = _Helpers()


def _forget() -> None:
    """Start without helpers in a forked child, which has none of its parent's threads."""
    global _helpers
    _helpers = _Helpers()


if sys.platform != "win32":
    os.register_at_fork(after_in_child=_forget)


def thread_count() -> int:
    """Threads to use: the variable RTS_NUM_THREADS, or the cores this process may run on."""
    wanted = os.environ.get("RTS_NUM_THREADS", "")
    if wanted.isdigit() and int(wanted) > 0:
        return int(wanted)
    return len(cores()) if sys.platform == "linux" else os.cpu_count() or 1


def read_only(x: np.ndarray, dtype: Any = None) -> np.ndarray:
    """A contiguous view, copied only if it has to be; always read-only, so that loops are compiled but once."""
    view = np.asarray(x, dtype, order="C").view()
    view.flags.writeable = False
    return view


def parallel(loop: Callable, count: int, *args: Any, work: int = LITTLE_WORK, apart: bool = True) -> None:
    """Call `loop(start, stop, *args)` so that the ranges cover [0, count); it must release the lock.

    Args:
        loop: a function of (start, stop, *args).
        count: the end of the range.
        *args: handed on.
        work: nanoseconds that it takes on one thread, roughly.
        apart: whether helpers are to keep off the caller's core all the time. What they call must not start threads
            then, which would have to keep off as well.
    """
    # In a task of another loop there may be no helper left, and to ask takes time.
    if work < LITTLE_WORK or count <= 1 or (threads := thread_count()) == 1 or not (free := _helpers.free(threads - 1)):
        loop(0, count, *args)
        return
    tasks = min(count, threads * TASKS_PER_THREAD)
    bounds = [count * i // tasks for i in range(tasks + 1)]
    numbers, failed = itertools.count(), False

    def share() -> None:
        nonlocal failed
        try:
            while not failed and (task := next(numbers)) < tasks:
                loop(bounds[task], bounds[task + 1], *args)
        except BaseException:
            failed = True  # What has not begun is left, by all.
            raise

    # The caller works too. A helper that has not woken by the time all is begun is not waited for.
    jobs: list[_Job] = []
    _helpers.start(threads - 1)
    own = cores() if _core else None
    if _core and own:
        _helpers.keep_off(_core(), own)
    try:
        for _ in range(free):
            jobs.append(_Job(share, own, not apart))
            _helpers.ask(jobs[-1])
        share()
    finally:
        # Whatever happens, none is to be left that writes to arrays which the caller may give away.
        begun = [job for job in jobs if not job.withdraw()]
        for job in begun:
            job.wait()
    for job in jobs:
        if job.error is not None:
            raise job.error


def each(f: Callable[[_In], _Out], items: Sequence[_In]) -> list[_Out]:
    """The results of a function for each of some items, on all cores; loops inside of it take what cores are idle then.

    Where it fails for several items, the error is that of the first; items after it may be left out.

    Args:
        f: a function that several threads may call at once.
        items: what to call it with, in this order.
    """
    found: list[Any] = [None] * len(items)
    errors: dict[int, Exception] = {}
    first = len(items)

    def some(start: int, stop: int) -> None:
        nonlocal first
        for i in range(start, stop):
            if i > first:
                return
            try:
                found[i] = f(items[i])
            except Exception as error:
                errors[i] = error
                first = min(first, i)

    parallel(some, len(items), apart=False)
    if errors:
        raise errors[min(errors)]
    return found
