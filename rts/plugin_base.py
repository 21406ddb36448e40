"""The common base class of plugins, with checks of overridden methods, promises and misspelt members."""

from __future__ import annotations

import abc
import functools
import inspect
from collections.abc import Mapping
from types import FunctionType
from typing import Any

from rts.errors import PluginError


class Plugin(abc.ABC):  # noqa: B024
    """The common base of `Surface`, `Sampler` and the like; a plugin subclasses the base class of its kind."""

    def __repr__(self) -> str:
        """The name of the class, as errors tell it: the address of an object helps nobody."""
        return type(self).__name__


PROMISES: Mapping[str, tuple[str, ...]] = {
    "uniform": ("__call__",),
    "takes_views": ("__call__",),
    "reads": ("__call__", "base_color"),
    "translucent": ("image", "accumulate"),
    "any_channels": ("image", "accumulate"),
}
"""Promise → the methods whose behaviour it describes; a class may lack some of them."""


is_subclass = functools.lru_cache(maxsize=4096)(issubclass)
"""`issubclass`, kept: Python searches abstract bases in Python code, each time."""


def overrides(plugin: Any, method: str, base: type) -> bool:
    """True if a plugin, or a class of plugins, subclasses the base and overrides a method of the base."""
    return _overrides(plugin if isinstance(plugin, type) else type(plugin), method, base)


@functools.lru_cache(maxsize=4096)
def _overrides(kind: type, method: str, base: type) -> bool:
    return is_subclass(kind, base) and getattr(kind, method, None) is not getattr(base, method, None)


def promised(plugin: Any, name: str) -> Any:
    """The value of a promise that holds for a plugin, or for a class of plugins.

    A promise holds for the class that states it. If a subclass overrides a method listed in `PROMISES`, the value is
    the default of the base. If the class itself defines no such method, the promise holds for its subclasses, too. A
    value set on the object itself always holds.
    """
    holds, default = _holds(plugin if isinstance(plugin, type) else type(plugin), name)
    return getattr(plugin, name) if holds or name in getattr(plugin, "__dict__", ()) else default


@functools.lru_cache(maxsize=4096)
def _holds(kind: type, name: str) -> tuple[bool, Any]:
    """True if a promise `name` holds for a class; also the default value, that of the base class."""
    stated = [c for c in kind.__mro__ if name in vars(c)]
    stating, base = stated[0], stated[-1]
    there = {m for c in stating.__mro__ if not issubclass(base, c) for m in PROMISES[name] if m in vars(c)}
    return not any(overrides(kind, m, stating) for m in there), vars(base)[name]


@functools.lru_cache(maxsize=1024)
def check_members(kind: type[Plugin]) -> None:
    """Refuse a class that overrides a final method, has a value for a method, or a function named almost like one.

    Names are almost alike if one letter is added, left out or exchanged; functions of bases in other packages may have
    such names. Optional methods belong to the library's abstract classes. Each class is checked once.

    Raises:
        PluginError: the class has such a value or function.
    """
    bases = [c for c in kind.__mro__ if inspect.isabstract(c) and c.__module__.partition(".")[0] == "rts"]
    members = {n: f for c in reversed(bases) for n, f in vars(c).items() if isinstance(f, FunctionType) and n[0] != "_"}
    for c in (c for c in kind.__mro__ if c not in bases):
        for name, value in vars(c).items():
            if name in members and not callable(value) and not hasattr(value, "__get__"):
                raise PluginError(f"{c.__qualname__} has the value {value!r} for {name!r}; expected a method")
    functions = [(c, n) for c in kind.__mro__ if c not in bases for n, f in vars(c).items() if type(f) is FunctionType]
    there = {name for _, name in functions}
    lacked = [n for n, f in members.items() if n not in there and not getattr(f, "__isabstractmethod__", False)]
    package = kind.__module__.partition(".")[0]
    for where, name in functions:
        if getattr(members.get(name), "__final__", False):
            raise PluginError(f"{where.__qualname__} overrides {name!r}, which is final: {_line(members[name])}")
        if name in members or where.__module__.partition(".")[0] != package:
            continue
        meant = next((n for n in sorted(lacked) if _one_edit(name, n)), None)
        if meant is not None:
            raise PluginError(
                f"{where.__qualname__} has a function {name!r}, which rts never calls; did you mean {meant!r} of "
                f"{bases[0].__name__}? Rename it to that, or to something less alike"
            )


def _line(function: Any) -> str:
    """The first line of a function's docstring."""
    return inspect.getdoc(function).partition("\n")[0]  # pyright: ignore[reportOptionalMemberAccess]  # Methods of bases have docstrings.


def _one_edit(a: str, b: str) -> bool:
    """True if one name becomes the other by one character added, left out or exchanged."""
    if abs(len(a) - len(b)) > 1 or a == b:
        return False
    short, long = sorted((a, b), key=len)
    start = next((i for i, c in enumerate(short) if c != long[i]), len(short))
    return short[start + (len(short) == len(long)) :] == long[start + 1 :]
