"""Plugins as objects of their bases: objects of other classes are wrapped, and misspelt members refused."""

from __future__ import annotations

import abc
from operator import attrgetter
from types import FunctionType
from typing import Any

from rts.errors import PluginError
from rts.interfaces import Plugin, RaySurface, Splatter, Surface, TriangleSurface
from rts.records import Array, Splats


class _Wrapped:
    """An object that has the members of a base without being of it. It passes for the object, too."""

    def __init__(self, given: Any):
        object.__setattr__(self, "_given", given)

    @property
    def __class__(self) -> type:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Of the object, so that `isinstance` knows it by its own class as by the base's."""
        return type(self._given)

    def __getattr__(self, name: str) -> Any:
        if name == "_given":  # Of a copy that is being made.
            raise AttributeError(name)
        return getattr(self._given, name)

    def __reduce__(self) -> tuple:
        return adapted, (self._given, *self._bases)

    def __setattr__(self, name: str, value: Any) -> None:
        setattr(self._given, name, value)

    def __repr__(self) -> str:
        return repr(self._given)

    def __eq__(self, other: Any) -> bool:
        return self._given == unwrapped(other)

    def __hash__(self) -> int:
        return hash(self._given)


class _WrappedSplatter(_Wrapped):
    """A splatter that has `splat(positions, rgba, row)` in place of `image`."""

    def image(self, splats: Splats) -> Array:
        """See `Splatter`."""
        return self._given.splat(splats.positions, splats.rgba, splats.row)


def unwrapped(plugin: Any) -> Any:
    """What the user gave: the plugin itself or, of a wrapper, the object in it. Caches go by it."""
    return plugin._given if issubclass(type(plugin), _Wrapped) else plugin


def as_surface(given: Any) -> Any:
    """A surface with all members of its bases, or None where it is none; see `adapted`."""
    return adapted(given, Surface, TriangleSurface, RaySurface)


FINAL = {"splat"}
"""What a base keeps for itself."""

_known: set[tuple[type, type]] = set()
_wrappers: dict[tuple, type] = {}


def adapted(given: Any, *bases: type[Plugin]) -> Any:
    """A plugin as an object of its base: as it is, or wrapped where its class is not one of theirs.

    Args:
        given: the plugin: an object, or a function where the base has nothing but `__call__`.
        *bases: the first is what it must be; the others what it may be besides.

    Returns:
        The plugin, or None where it lacks what the first base requires.

    Raises:
        PluginError: a function of its class is named almost like an optional member.
    """
    kind = type(given)
    if (kind, bases[0]) in _known:
        return given
    if isinstance(given, bases[0]):
        for base in bases[1:]:
            if not issubclass(kind, base) and all(hasattr(kind, name) for name in base.__abstractmethods__):
                raise PluginError(f"{kind.__qualname__} has the methods of rts.{base.__name__}; subclass that")
        _check_names(kind, tuple(b for b in bases if issubclass(kind, b)))
        _known.add((kind, bases[0]))
        return given
    present = frozenset(name for base in bases for name in _members(base) if hasattr(given, name))
    by_arrays = bases[0] is Splatter and "splat" in present and "image" not in present
    if by_arrays:
        present |= {"image"}
    # The most special first, as Python wants them.
    fitting = tuple(base for base in reversed(bases) if base.__abstractmethods__ <= present)
    if bases[0] not in fitting or isinstance(given, type):
        return None
    key = kind, fitting, present, by_arrays
    if key not in _wrappers:
        _check_names(kind, fitting)
        _wrappers[key] = _wrapper(kind, fitting, present, _WrappedSplatter if by_arrays else _Wrapped)
        _wrappers[key]._bases = bases
    return _wrappers[key](given)


def _wrapper(kind: type, bases: tuple[type[Plugin], ...], present: frozenset[str], outer: type) -> type:
    """The class of wrappers for objects of a class that have these members."""
    own = present - {"__call__", "splat"} - outer.__dict__.keys()
    namespace: dict[str, Any] = {name: property(lambda self, get=attrgetter(name): get(self._given)) for name in own}
    if "__call__" in present:
        namespace["__call__"] = lambda self, *args, **kwargs: self._given(*args, **kwargs)
    for method, flag in (pair for base in bases for pair in base.FLAGS.items() if pair[1] not in present):
        namespace[flag] = method in present
    return type(kind.__name__, (outer, *bases), namespace)


def _members(base: type[Plugin]) -> list[str]:
    """What a base declares: names of methods and class variables."""
    names = [n for c in base.__mro__ if c not in (Plugin, abc.ABC, object) for n in c.__dict__]
    return [n for n in dict.fromkeys(names) if not n.startswith("_") and n != "FLAGS"] + ["__call__"]


def _check_names(kind: type, bases: tuple[type[Plugin], ...]) -> None:
    """Refuse a class with a function whose name is one letter from an optional method of its bases, which it lacks."""
    declared = {c for base in bases for c in base.__mro__}
    # Bases of the library that are themselves subclasses, as that of samplers of triangles, declare members, too.
    declared |= {c for c in kind.__mro__ if c.__dict__.get("DECLARES", False)}
    required = {name for c in declared for name in c.__dict__.get("__abstractmethods__", ())}
    optional = {
        name
        for c in declared - {Plugin, abc.ABC, object}
        for name, value in c.__dict__.items()
        if isinstance(value, FunctionType) and not name.startswith("_") and name not in required | FINAL
    }
    foreign = [c for c in kind.__mro__ if c not in declared]
    there = {n: c for c in foreign for n, value in c.__dict__.items() if isinstance(value, FunctionType)}
    package = kind.__module__.partition(".")[0]
    for name, where in there.items():
        if name in optional | required or where.__module__.partition(".")[0] != package:
            continue
        for member in sorted(optional - there.keys()):
            if _one_edit(name, member):
                raise PluginError(
                    f"{where.__qualname__} has a function {name!r}, which rts never calls; did you mean {member!r} of "
                    f"{bases[0].__name__}? Rename it to that, or to something less alike"
                )
    final = there.get("splat")
    if Splatter in bases and final is not None and issubclass(kind, Splatter):
        raise PluginError(
            f"{final.__qualname__} overrides 'splat', which is for direct calls; write 'image(splats)', which gives "
            f"(H, W, 4) for an rts.Splats"
        )


def _one_edit(a: str, b: str) -> bool:
    """Whether one character added, left out or exchanged makes one name of the other."""
    if abs(len(a) - len(b)) > 1 or a == b:
        return False
    short, long = sorted((a, b), key=len)
    start = next((i for i, c in enumerate(short) if c != long[i]), len(short))
    return short[start + (len(short) == len(long)) :] == long[start + 1 :]
