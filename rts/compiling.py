"""How loops are compiled: kernels, which Python calls, and helpers, which only other compiled loops call.

Kernels are kept on disk; helpers are not, since a helper that is loaded is not inlined. numba makes of every function
two wrappers beside its code, one for Python and one for C. Here each has the wrappers that something calls, which
shortens compilation by a fifth. Where much has to be compiled, a terminal is told.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import Any

import numba
from numba.core import event

TOLD_AFTER = 1.0
"""Seconds of compilation after which a terminal is told of it."""

PACKAGES = ("rts", "rts_backends", "rts_surfaces")


def kernel(function: Callable | None = None, **options: Any) -> Any:
    """Compile a loop that Python calls, without the interpreter lock, and keep it on disk; `options` are numba's."""
    options |= {"nogil": True, "cache": True, "no_cfunc_wrapper": True}
    decorate = numba.njit(**options)
    return decorate if function is None else decorate(function)


def compiled(function: Callable | None = None, **options: Any) -> Any:
    """Compile a function that only compiled loops call; Python cannot. `options` are numba's."""
    options |= {"nogil": True, "no_cpython_wrapper": True, "no_cfunc_wrapper": True}
    decorate = numba.njit(**options)
    return decorate if function is None else decorate(function)


class _Progress(event.Listener):
    """Lines on a terminal while kernels are compiled: how many, in which time; nothing where they are on disk.

    Each comes after twice the time of the one before, and is whole, since nobody knows which kernel is the last.
    """

    def __init__(self) -> None:
        self.count, self.seconds = 0, 0.0
        self._depth, self._since, self._next = 0, 0.0, TOLD_AFTER

    def on_start(self, event: Any) -> None:
        """Begin to count time, or go deeper; the lock of the compiler is held."""
        if self._depth == 0:
            self._since = time.perf_counter()
        self._depth += 1

    def on_end(self, event: Any) -> None:
        """Count a kernel that is done, and tell of it."""
        self._depth -= 1
        if self._depth == 0 and _is_ours(event.data["dispatcher"]):
            self.count, self.seconds = self.count + 1, self.seconds + time.perf_counter() - self._since
            stream = sys.stderr
            if self.seconds > self._next and stream is not None and stream.isatty():
                self._next = 2 * self.seconds
                stream.write(f"rts: compiling kernels (once): {self.count} in {self.seconds:.0f} s\n")
                stream.flush()


def _is_ours(dispatcher: Any) -> bool:
    module = getattr(getattr(dispatcher, "py_func", None), "__module__", None) or ""
    return module.partition(".")[0] in PACKAGES


event.register("numba:compile", _Progress())
