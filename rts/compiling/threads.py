"""Compiled loops on all cores.

A pool of plain Python threads runs loops that release the interpreter lock. numba's own parallel loops are not used:
their OpenMP threads spin against torch's for milliseconds after every loop, and its other layers must not be entered
by two threads at once.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import itertools
import os
import sys
import threading
from collections.abc import Callable, Sequence
from queue import SimpleQueue
from typing import Any, TypeVar

import numpy as np

from rts.errors import InputError

TASKS_PER_THREAD = 4
"""Tasks for each thread: several, so that a thread with heavy rows does not keep the others waiting."""

LITTLE_WORK = 100_000
"""Nanoseconds of work for which one more thread is woken, which takes tens of thousands, and the interpreter lock."""

THREADS_PER_CORE = 4
"""Most threads for each of the machine's cores, however many are asked for: further ones would only take memory."""

_In = TypeVar("_In")
_Out = TypeVar("_Out")


_core = getattr(ctypes.PyDLL(None), "sched_getcpu", None) if sys.platform == "linux" else None
"""A function that returns the core that it is called on; None if the system does not know."""

_local = threading.local()


def cores() -> set[int]:
    """The cores that this thread may run on; for a helper, those of its caller's thread. Call it on Linux alone."""
    return getattr(_local, "cores", None) or os.sched_getaffinity(0)


class _Job:
    """Work offered to a helper thread, which does it unless the caller claims the job first.

    Attributes:
        work: the function to call.
        cores: the cores of the caller's thread; None if the system does not know them.
        roams: whether the work may run on all of these cores, the caller's current one included.
        error: the error that the work raised, or None.
    """

    def __init__(self, work: Callable[[], None], allowed: set[int] | None, roams: bool):
        self.work, self.cores, self.roams = work, allowed, roams
        self.error: BaseException | None = None
        self._unclaimed, self._going = threading.Lock(), threading.Lock()
        self._going.acquire()

    def claim(self) -> bool:
        """Claim the job; True for the first to do so, who owns it from then on."""
        return self._unclaimed.acquire(blocking=False)

    def withdraw(self) -> bool:
        """Claim the job so that nobody does it, and release its arrays. False if it is claimed already."""
        mine = self.claim()
        if mine:
            self.work = lambda: None
        return mine

    def run(self) -> None:
        """Do the work, and keep its error."""
        try:
            self.work()
        except BaseException as error:
            self.error = error

    def end(self) -> None:
        """Release the one thread that waits for the job, now or later."""
        self._going.release()

    def wait(self) -> None:
        """Wait until the job is done."""
        self._going.acquire()


class _Helpers:
    """Threads that wait for jobs."""

    def __init__(self) -> None:
        self.count = 0
        self._jobs: SimpleQueue[_Job] = SimpleQueue()
        self._under_way: set[_Job] = set()
        self._lock = threading.Lock()
        # The system's numbers of the threads; of those that run anywhere now; and the cores of the others.
        self._threads: list[int] = []
        self._roaming: set[int] = set()
        self._placed: set[int] | None = None

    def free(self, count: int) -> int:
        """The number of helpers, out of `count`, that are idle or not started yet; at least 0."""
        return max(0, count - len(self._under_way))

    def start(self, count: int) -> None:
        """Start helpers until there are `count`, or as many as the system gives."""
        if self.count >= count:
            return
        with self._lock:
            while self.count < count:
                thread = threading.Thread(target=self._serve, name="rts", daemon=True)
                try:
                    thread.start()
                except RuntimeError:  # The system gives no more threads: existing helpers, or the caller, do the work.
                    break
                self.count += 1
                if thread.native_id:
                    self._threads.append(thread.native_id)
                self._placed = None

    def keep_off(self, core: int, allowed: set[int]) -> None:
        """Have helpers run on `allowed` without `core`, if they have another; nothing changes while a helper works.

        On two cores Linux often wakes a thread on its waker's core, though the other is idle. The thread would
        wait there until the loop is over.
        """
        allowed = allowed - {core} or allowed
        if self._under_way or allowed == self._placed:
            return
        with self._lock:
            self._placed = allowed
            for thread in self._threads:
                if thread not in self._roaming:
                    _place(thread, allowed)

    def ask(self, job: _Job) -> None:
        """Queue a job for the next idle helper."""
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

    def _run_anywhere(self, job: _Job, allowed: set[int]) -> None:
        """Run a job on any of some cores; the next caller chooses the helper's cores anew."""
        thread = threading.get_native_id()
        with self._lock:
            self._roaming.add(thread)
            _place(thread, allowed)
        job.run()
        with self._lock:
            self._roaming.discard(thread)
            self._placed = None


def _place(thread: int, allowed: set[int]) -> None:
    """Have a thread, by the system's number, run on some cores alone. Does nothing without permission."""
    with contextlib.suppress(OSError):  # Without permission, threads run anywhere.
        os.sched_setaffinity(thread, allowed)


_helpers = _Helpers()


def _forget() -> None:
    """Start without helpers in a forked child, which has none of its parent's threads."""
    global _helpers
    _helpers = _Helpers()


if sys.platform != "win32":
    os.register_at_fork(after_in_child=_forget)


def thread_count() -> int:
    """Number of threads to use: RTS_NUM_THREADS of the environment, or THREADS_PER_CORE for each core if that is less.

    If that is not set, or empty: the number of cores that this thread may run on (Linux), or of all cores (elsewhere).

    Raises:
        InputError: RTS_NUM_THREADS is no positive integer.
    """
    if wanted := os.environ.get("RTS_NUM_THREADS"):
        return _limited(wanted)
    return len(cores()) if sys.platform == "linux" else os.cpu_count() or 1


@functools.cache
def _limited(wanted: str) -> int:
    """The number of threads that RTS_NUM_THREADS asks for, limited."""
    try:
        count = int(wanted)
    except ValueError:
        count = 0
    if count < 1:
        raise InputError(
            f"the environment variable RTS_NUM_THREADS is {wanted[:40]!r}; expected a positive integer, such as 4; "
            "unset it for one thread on each core"
        )
    return min(count, THREADS_PER_CORE * (os.cpu_count() or 1))


def read_only(x: np.ndarray, dtype: Any = None) -> np.ndarray:
    """A C-contiguous, read-only view of `x`, in `dtype` if given; of a copy if need be. Loops take such arrays."""
    view = np.asarray(x, dtype, order="C").view()
    view.flags.writeable = False
    return view


def parallel(loop: Callable, count: int, *args: Any, work: int | None = None, off_caller_core: bool = True) -> None:
    """Call `loop(start, stop, *args)` on all cores, in ranges that together cover [0, count); return when all are done.

    The caller's thread alone runs a loop of little `work`, as one range, and one for which no helper is free. An error
    in a range ends the loop and is raised.

    Args:
        loop: a function of (start, stop, *args) that releases the interpreter lock.
        count: the end of the range.
        *args: passed on.
        work: rough time of all ranges on one thread, nanoseconds; one helper is asked for each LITTLE_WORK of it. None
            asks all.
        off_caller_core: whether helpers must stay off the caller's core all the time. The loop must then start no
            threads, which would have to stay off as well.
    """
    # Inside a task of another loop no helper may be free, and asking takes time.
    little = work is not None and work < LITTLE_WORK
    if little or count <= 1 or (threads := thread_count()) == 1 or not (free := _helpers.free(threads - 1)):
        loop(0, count, *args)
        return
    free = min(free, count - 1)
    if work is not None:
        free = min(free, int(work // LITTLE_WORK))  # To wake more would take longer than they save.
    tasks = min(count, (free + 1) * TASKS_PER_THREAD)
    bounds = [count * i // tasks for i in range(tasks + 1)]
    numbers, failed = itertools.count(), False

    def share() -> None:
        nonlocal failed
        try:
            while not failed and (task := next(numbers)) < tasks:
                loop(bounds[task], bounds[task + 1], *args)
        except BaseException:
            failed = True  # No thread begins another range.
            raise

    # The caller works too. It does not wait for helpers that have not woken when the last range begins.
    jobs: list[_Job] = []
    _helpers.start(threads - 1)
    own_cores = cores() if _core else None
    if _core and own_cores:
        _helpers.keep_off(_core(), own_cores)
    try:
        for _ in range(free):
            jobs.append(_Job(share, own_cores, not off_caller_core))
            _helpers.ask(jobs[-1])
        share()
    finally:
        # Whatever happens, no helper may still write to arrays when the caller returns.
        begun = [job for job in jobs if not job.withdraw()]
        for job in begun:
            job.wait()
    for job in jobs:
        if job.error is not None:
            raise job.error


def each(f: Callable[[_In], _Out], items: Sequence[_In]) -> list[_Out]:
    """A function's results for all items, computed on all cores; loops that the function calls use idle cores.

    If the function fails for several items, the error is that of the first; items after it may be left out.

    Args:
        f: a function that several threads may call at once.
        items: its arguments, in this order.
    """
    results: list[Any] = [None] * len(items)
    errors: dict[int, Exception] = {}
    first = len(items)

    def some(start: int, stop: int) -> None:
        nonlocal first
        for i in range(start, stop):
            if i > first:
                return
            try:
                results[i] = f(items[i])
            except Exception as error:
                errors[i] = error
                first = min(first, i)

    parallel(some, len(items), off_caller_core=False)
    if errors:
        raise errors[min(errors)]
    return results


class OnAllCores:
    """A function of arrays on the host whose calls for the items of a batch share all cores; see `Engine.call_host`.

    Args:
        function: a function that several threads may call at once.
        together: the operands of each item → the results of each, found in another way; None for items that it cannot
            do.
    """

    def __init__(self, function: Callable, together: Callable[[Sequence[Sequence[Any]]], list[Any]] | None = None):
        self._function, self._together = function, together

    def __call__(self, *operands: Any) -> Any:
        """The function's results."""
        return self._function(*operands)

    def many(self, items: Sequence[Sequence[Any]]) -> list[Any]:
        """The function's results for the operands of each item."""
        results = [None] * len(items) if self._together is None else self._together(items)
        left = [index for index, found in enumerate(results) if found is None]
        for index, found in zip(left, each(lambda i: self._function(*items[i]), left), strict=True):
            results[index] = found
        return results
