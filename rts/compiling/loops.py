"""Decorators that compile loops: functions that Python calls, and helpers, which only other loops call.

Compiled loops are kept on disk; helpers are not, since a helper loaded from disk is not inlined. If compilation takes
long, a message on the terminal says so.

numba counts references to arrays, one thread after the other: in a loop that is nothing but helpers and views, this can
be most of the time. A helper that is called for each item counts none if it takes few arrays, has one `return`, no
`break`, and uses all of them to its end. Views (`a[i]`, `a[b:e]`) and tuples of arrays are counted wherever they are
made; whole arrays with indices, numbers, and tuples of numbers are not. A helper with `inline="always"` becomes a part
of the loop: a tenth of the time of loops over outlines. Large ones take longer to compile. It counts none either, but
where it writes to an array in a branch alone, returns early, leaves a loop by `break`, or takes an item of a tuple by a
number known only at run time, as a loop over a tuple does. To choose one of two arrays (`a if x else b`), or to pass
arguments on as `*tuple`, is counted; to choose between their items is not. Arrays that a helper takes from a record, by
attribute, count as its arguments do. Whether one is None is known to the compiler of arguments alone, not of fields.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rts.compiling.uninterrupted import uninterrupted


def _numba() -> Any:
    """numba, imported, and what it makes for the first function: a target of LLVM."""
    import numba

    numba.njit()(lambda: None)
    return numba


numba = uninterrupted(_numba)

try:
    from rts.compiling.numba_internals import kept
except ImportError:  # Of a numba without its private names: kept without locks, and in silence.

    def kept(function: Callable, options: dict[str, Any]) -> Any:
        """The compiled function, kept on disk by numba's public means."""
        return numba.njit(cache=True, **options)(function)


LOOP = {"nogil": True, "no_cfunc_wrapper": True, "error_model": "numpy"}
"""numba's options of loops: no interpreter lock, no wrapper that C code could call, no error for a division by zero.

All loops have these options, since numba compiles its own functions, such as `min` and `np.empty`, once for each set
of options.
"""


def loop(function: Callable | None = None, **options: Any) -> Any:
    """Compile a loop that Python calls; kept on disk, and run without the interpreter lock. `options` are numba's."""
    options = LOOP | options

    def decorate(function: Callable) -> Any:
        return kept(function, options)

    return decorate if function is None else decorate(function)


def compiled(function: Callable | None = None, **options: Any) -> Any:
    """Compile a helper, which only compiled loops call; it must not call itself. `options` are numba's."""
    options = LOOP | {"no_cpython_wrapper": True} | options
    decorate = numba.njit(**options)
    return decorate if function is None else decorate(function)
