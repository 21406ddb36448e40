"""Decorators that compile loops: functions that Python calls, and helpers, which only other loops call.

Compiled loops are kept on disk; helpers are not, since a helper that is loaded is not inlined. Where much has to be
compiled, a terminal is told.
"""

from __future__ import annotations

import gc
import os
import sys
import threading
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
"""Seconds of compilation after which a terminal is told of it."""

LOOP = {"nogil": True, "no_cfunc_wrapper": True, "error_model": "numpy"}
"""numba's options of loops. It makes two wrappers beside a function's code, one for Python and one for C.

Divisions by zero are not looked for. All loops have these options, since numba compiles its own functions, such as
`min` and `np.empty`, once for each set of options.
"""

PACKAGES = ("rts", "rts_backends", "rts_surfaces")

saving = threading.RLock()
"""Held while a loop is written to disk."""


def loop(function: Callable | None = None, **options: Any) -> Any:
    """Compile a loop that Python calls, without the interpreter lock, and keep it on disk; `options` are numba's."""
    options = LOOP | options

    def decorate(function: Callable) -> Any:
        made = cast(Any, numba.njit(**options)(function))
        if made is not function:  # As it is where compilation is switched off.
            made._cache = _Cache(function)
        return made

    return decorate if function is None else decorate(function)


def compiled(function: Callable | None = None, **options: Any) -> Any:
    """Compile a helper, which only compiled loops call, not Python, nor itself. `options` are numba's."""
    options = LOOP | {"no_cpython_wrapper": True} | options
    decorate = numba.njit(**options)
    return decorate if function is None else decorate(function)


@contextmanager
def alone(folder: str, writes: bool = True) -> Iterator[None]:
    """Hold a folder of loops as the only process that writes, where the system and the file system know such locks.

    numba reads a function's index, chooses a name for the code, and writes both, one after the other. Two processes
    that do so at once, for different types, may choose the same name: one type's calls would then run the other's code.

    Args:
        folder: where the loops are.
        writes: False to hold it together with others that read.
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
                fcntl.flock(file, fcntl.LOCK_UN)  # A child that was forked meanwhile has the file, too.


def _lock_file(folder: str) -> IO[bytes] | None:
    for mode in ("ab", "rb"):  # It may be another user's.
        with suppress(OSError):
            return open(os.path.join(folder, ".lock"), mode)
    return None


class _Cache(FunctionCache):
    """The compiled code of a loop on disk, where another process may be writing."""

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Compiled code for some types of arguments; None if there is none yet."""
        with alone(self.cache_path, writes=False):
            return super().load_overload(sig, target_context)

    def save_overload(self, sig: Any, data: Any) -> None:
        """Write code that has been compiled."""
        with saving, alone(self.cache_path):
            super().save_overload(sig, data)


class _Outermost(event.Listener):
    """Listens to numba's compiler, but not to compilations within others; the lock of the compiler is held."""

    def __init__(self) -> None:
        self._depth = 0

    def on_start(self, event: Any) -> None:
        """Go deeper."""
        if self._depth == 0:
            self.begun(_is_ours(event.data["dispatcher"]))
        self._depth += 1

    def on_end(self, event: Any) -> None:
        """Come back."""
        self._depth -= 1
        if self._depth == 0:
            self.ended(_is_ours(event.data["dispatcher"]))

    def begun(self, ours: bool) -> None:
        """Compilation of a function, ours or not, begins."""

    def ended(self, ours: bool) -> None:
        """Compilation of it is done."""


class _Progress(_Outermost):
    """Lines on a terminal while loops are compiled: how many, in which time; nothing where they are on disk.

    Each comes after twice the time of the one before, and is whole, since nobody knows which loop is the last.
    """

    def __init__(self) -> None:
        super().__init__()
        self.count, self.seconds = 0, 0.0
        self._since, self._next = 0.0, TOLD_AFTER

    def begun(self, ours: bool) -> None:
        """Begin to count time."""
        self._since = time.perf_counter()

    def ended(self, ours: bool) -> None:
        """Count a loop that is done, and tell of it."""
        if ours:
            self.count, self.seconds = self.count + 1, self.seconds + time.perf_counter() - self._since
            stream = sys.stderr
            if self.seconds > self._next and stream is not None and stream.isatty():
                self._next = 2 * self.seconds
                stream.write(f"rts: compiling loops (once): {self.count} in {self.seconds:.0f} s\n")
                stream.flush()


class _NoCollection(_Outermost):
    """Stops the collection of garbage while a loop is compiled, which makes many objects: a tenth of the time."""

    def __init__(self) -> None:
        super().__init__()
        self._paused = False

    def begun(self, ours: bool) -> None:
        """Stop, if it is on."""
        self._paused = ours and gc.isenabled()
        if self._paused:
            gc.disable()

    def ended(self, ours: bool) -> None:
        """Go on."""
        if self._paused:
            gc.enable()


def _is_ours(dispatcher: Any) -> bool:
    module = getattr(getattr(dispatcher, "py_func", None), "__module__", None) or ""
    return module.partition(".")[0] in PACKAGES


event.register("numba:compile", _Progress())
event.register("numba:compile", _NoCollection())
