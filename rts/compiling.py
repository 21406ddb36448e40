"""How loops are compiled: those that Python calls, and helpers, which only other loops call.

The former are on disk; helpers are not, since a helper that is loaded is not inlined. numba makes of every function
two wrappers beside its code, one for Python and one for C. Here each has the wrappers that something calls, which
shortens compilation by a fifth. What is not on disk is compiled here and, meanwhile, in another process
(`rts.companion`). Where much has to be compiled, a terminal is told.
"""

from __future__ import annotations

import functools
import gc
import inspect
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import FunctionType
from typing import IO, Any, NamedTuple, cast

import numba
from numba.core import event
from numba.core.caching import FunctionCache
from numba.core.dispatcher import Dispatcher

from rts import companion

try:
    import fcntl
except ImportError:  # Windows.
    fcntl = None

try:
    from rts.pipeline import LOOP, PART
except (ImportError, AttributeError):  # A numba that is built in another way compiles as it does.
    LOOP = {"no_cfunc_wrapper": True}
    PART = {"no_cfunc_wrapper": True, "no_cpython_wrapper": True}

TOLD_AFTER = 1.0
"""Seconds of compilation after which a terminal is told of it."""

PACKAGES = ("rts", "rts_backends", "rts_surfaces")

saving = threading.RLock()
"""Held while a loop is written to disk."""


def loop(function: Callable | None = None, **options: Any) -> Any:
    """Compile a loop that Python calls, without the interpreter lock, and keep it on disk; `options` are numba's."""
    options |= {"nogil": True} | LOOP

    def decorate(function: Callable) -> Any:
        made = cast(Any, numba.njit(**options)(function))
        if made is not function:  # As it is where compilation is switched off.
            made._cache = _Cache(function)
            if _is_ours(made):
                _foresee(made._cache.cache_path)
        return _interpreted(made)

    return decorate if function is None else decorate(function)


def compiled(function: Callable | None = None, **options: Any) -> Any:
    """Compile a function that only compiled loops call, not Python, nor itself. `options` are numba's."""
    options |= {"nogil": True} | PART

    def decorate(function: Callable) -> Any:
        return _interpreted(numba.njit(**options)(function))

    return decorate if function is None else decorate(function)


@functools.cache
def _foresee(folder: str) -> None:
    """Where a folder has no loops yet, the companion can begin before one is missed."""
    try:
        begun = any(name.endswith(".nbi") for name in os.listdir(folder))
    except OSError:
        begun = False
    if not begun:
        companion.prepare()


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
    """A loop's compiled code on disk, which another process may be about to write."""

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """What is on disk; None if it is to be compiled here."""
        found = self._loaded(sig, target_context)
        if found is None and companion.begin(key := _key(self._py_func, sig)):
            found = self._loaded(sig, target_context)
            if found is not None:
                companion.end(key)
        return found

    def _loaded(self, sig: Any, target_context: Any) -> Any:
        with alone(self.cache_path, writes=False):
            return super().load_overload(sig, target_context)

    def save_overload(self, sig: Any, data: Any) -> None:
        """Write what has been compiled."""
        with saving, alone(self.cache_path):
            super().save_overload(sig, data)
        companion.end(_key(self._py_func, sig))


def _key(function: Callable, types: Any) -> int:
    """A number for a function and the types of its arguments, the same in all processes."""
    return companion.number(f"{function.__module__}.{function.__qualname__} {types}")


# ------------------------------------------------------------------------------------- what would have to be compiled


class Need(NamedTuple):
    """A loop, and the types of arguments that it is called with.

    Attributes:
        loop: what compiles it.
        types: numba's.
        effort: how long it takes to compile, compared to others.
    """

    loop: Any
    types: tuple
    effort: float = 1


_needs: dict[int, Need] | None = None
_stand_ins: dict[Any, Any] = {}


@contextmanager
def interpreting() -> Iterator[dict[int, Need]]:
    """Have Python interpret all loops and helpers, which takes long but for the smallest pictures.

    Yields:
        What calls would have had compiled, in the order of the first calls; filled as they come, and with what effort
        once this is left. For a process that does nothing else.
    """
    global _needs
    _needs = needs = {}
    _exchange({x: _interpreted(x) for x in _globals() if isinstance(x, Dispatcher)})
    try:
        yield needs
    finally:
        _needs = None
        _exchange(_stand_ins)
        _stand_ins.clear()
    for key, need in needs.items():
        needs[key] = need._replace(effort=_effort(need.loop))


def _interpreted(made: Any) -> Any:
    """What stands for a compiled function: itself, or what Python runs if all are interpreted."""
    if _needs is None or not isinstance(made, Dispatcher):
        return made
    needs, function = _needs, made.py_func

    def noted(*args: Any) -> Any:
        types = tuple(map(made.typeof_pyval, args))
        needs.setdefault(_key(function, types), Need(made, types))
        return function(*args)

    stand_in = noted if isinstance(getattr(made, "_cache", None), _Cache) else function
    _stand_ins[stand_in] = made
    return stand_in


def _effort(made: Any) -> int:
    """The size of a compiled function and of all that it calls, each counted once."""
    found = [made]
    for each in found:  # It grows.
        function = each.py_func
        places = [function.__globals__, *map(vars, filter(inspect.ismodule, _named(function.__globals__, function)))]
        called = [x for place in places for x in _named(place, function) if isinstance(x, Dispatcher)]
        found += [x for x in dict.fromkeys(called) if x not in found]
    return sum(len(each.py_func.__code__.co_code) for each in found)


def _named(place: dict[str, Any], function: Any) -> list[Any]:
    """What a function may mean by the names that it uses, in a module."""
    return [place[name] for name in function.__code__.co_names if name in place]


def _globals() -> list[Any]:
    return [x for module in _modules() for x in vars(module).values()]


def _exchange(others: dict[Any, Any]) -> None:
    """Put others in place of globals of our modules."""
    for module in _modules():
        for name, value in list(vars(module).items()):
            if isinstance(value, (Dispatcher, FunctionType)) and value in others:
                setattr(module, name, others[value])


def _modules() -> list[Any]:
    return [module for name, module in list(sys.modules.items()) if name.partition(".")[0] in PACKAGES]


# ------------------------------------------------------------------------------------------------- while it goes on


class _Outermost(event.Listener):
    """Listens to what numba compiles, but for what is compiled within; the lock of the compiler is held."""

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
        """It is done."""


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
    """No garbage is collected while a loop is compiled, which makes many objects: it takes a tenth of the time."""

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
