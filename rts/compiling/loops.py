"""Decorators that compile loops: functions that Python calls, and helpers, which only other loops call.

Compiled loops are kept on disk; helpers are not, since a helper loaded from disk is not inlined. If compilation takes
long, a message on the terminal says so.
"""

from __future__ import annotations

import gc
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import IO, Any, cast

import numba
from numba.core import event
from numba.core.caching import FunctionCache

try:
    import fcntl
except ImportError:  # Windows.
    fcntl = None

TOLD_AFTER = 1.0
"""Seconds of compilation, summed over a process, after which a message appears on the terminal."""

LOOP = {"nogil": True, "no_cfunc_wrapper": True, "error_model": "numpy"}
"""numba's options of loops: no interpreter lock, no wrapper that C code could call, no error for a division by zero.

All loops have these options, since numba compiles its own functions, such as `min` and `np.empty`, once for each set
of options.
"""


def loop(function: Callable | None = None, **options: Any) -> Any:
    """Compile a loop that Python calls; kept on disk, and run without the interpreter lock. `options` are numba's."""
    options = LOOP | options

    def decorate(function: Callable) -> Any:
        made = cast(Any, numba.njit(**options)(function))
        if made is not function:  # With compilation switched off, it is the function itself.
            made._cache = _Cache(function)
        return made

    return decorate if function is None else decorate(function)


def compiled(function: Callable | None = None, **options: Any) -> Any:
    """Compile a helper, which only compiled loops call; it must not call itself. `options` are numba's."""
    options = LOOP | {"no_cpython_wrapper": True} | options
    decorate = numba.njit(**options)
    return decorate if function is None else decorate(function)


@contextmanager
def alone(folder: str, writes: bool = True) -> Iterator[None]:
    """A context that holds the lock of a folder of loops: one process writes at a time, while nobody reads.

    Without effect where the system or the file system has no locks, or the lock cannot be opened. Not to be nested.

    numba reads a function's index, chooses a name for the code, and writes both, one after the other. Two processes
    that do so at once, for different types, may choose the same name: one type's calls would then run the other's code.

    Args:
        folder: the folder of the loops.
        writes: False to only read, and share the lock with other readers.
    """
    file = _lock_file(folder)
    if fcntl is None or file is None:
        yield
        return
    with file:
        with suppress(OSError):
            fcntl.flock(file, fcntl.LOCK_EX if writes else fcntl.LOCK_SH)
        try:
            yield
        finally:
            with suppress(OSError):
                fcntl.flock(file, fcntl.LOCK_UN)  # A child forked meanwhile has the file open, too.


def _lock_file(folder: str) -> IO[bytes] | None:
    for mode in ("ab", "rb"):  # Another user's file is readable only.
        with suppress(OSError):
            return open(os.path.join(folder, ".lock"), mode)
    return None


class _Cache(FunctionCache):
    """The compiled code of a loop on disk, safe while other processes write."""

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Load compiled code for some types of arguments; None if there is none yet."""
        with alone(self.cache_path, writes=False):
            return super().load_overload(sig, target_context)

    def save_overload(self, sig: Any, data: Any) -> None:
        """Save compiled code."""
        with alone(self.cache_path):
            super().save_overload(sig, data)


class _Watch(event.Listener):
    """Listener to the compilation of the library's loops and their helpers. The compiler holds its lock meanwhile.

    It prints one message once all compilations together have taken `TOLD_AFTER` seconds. It also pauses garbage
    collection, which would take a tenth of the time, since compilation makes many objects.
    """

    def __init__(self) -> None:
        self.seconds = 0.0
        self._depth, self._since, self._told, self._paused = 0, 0.0, False, False

    def on_start(self, event: Any) -> None:
        """Note that the compilation of a function starts, or of one that it calls."""
        if self._depth == 0:
            self._since = time.perf_counter()
            self._paused = _is_ours(event) and gc.isenabled()
            if self._paused:
                gc.disable()
        self._depth += 1

    def on_end(self, event: Any) -> None:
        """Note that the compilation of a function ends, in success or not."""
        self._depth -= 1
        if self._depth:
            return
        if self._paused:
            gc.enable()
        if _is_ours(event):
            self.seconds += time.perf_counter() - self._since
            if self.seconds > TOLD_AFTER and not self._told:
                self._told = True
                _tell("rts: compiling loops (once for each installation; `rts warmup` does it ahead) …")


def _is_ours(event: Any) -> bool:
    return isinstance(getattr(event.data["dispatcher"], "_cache", None), _Cache)


def _tell(line: str) -> None:
    stream = sys.stderr
    if stream is not None and stream.isatty():
        with suppress(UnicodeEncodeError):
            stream.write(line + "\n")
            stream.flush()


event.register("numba:compile", _Watch())
