"""Plugins as objects of their bases: objects of other classes are wrapped, and misspelt members refused."""

from __future__ import annotations

import abc
from collections.abc import Callable, Mapping
from operator import attrgetter
from types import FunctionType
from typing import Any, ClassVar

from rts.errors import PluginError


class Plugin(abc.ABC):  # noqa: B024
    """What all bases share: class variables that follow from the methods of a class.

    Attributes:
        FLAGS: method → class variable, which is True in a subclass that has such a method of its own, unless it says
            otherwise.
        STAND_INS: method → (name, function): an object of a foreign class may have a method of that name instead, by
            which `function(object, ...)` does what the method is to do. Subclasses of the base must not override it.
        DECLARES: whether the class is itself a base for plugins, though a subclass of one, as `TriangleSampler` is: its
            methods are members of plugins, too.
    """

    FLAGS: ClassVar[Mapping[str, str]] = {}
    STAND_INS: ClassVar[Mapping[str, tuple[str, Callable]]] = {}
    DECLARES: ClassVar[bool] = False

    def __init_subclass__(cls, **options: Any) -> None:
        """Set the class variables that `FLAGS` names."""
        super().__init_subclass__(**options)
        for base in cls.__mro__:
            for method, flag in base.__dict__.get("FLAGS", {}).items():
                derived = cls.__mro__[: cls.__mro__.index(base)]
                own = any(method in c.__dict__ for c in derived)
                if own and not any(flag in c.__dict__ for c in derived):
                    setattr(cls, flag, True)


class _Wrapped:
    """Wrapper that makes an object an instance of a base which its class does not inherit from."""

    def __init__(self, given: Any):
        object.__setattr__(self, "_given", given)

    @property
    def __class__(self) -> type:  # pyright: ignore[reportIncompatibleMethodOverride]  # Assigned nowhere.
        """The object's class: so `isinstance` holds for it as for the base."""
        return type(self._given)

    def __getattr__(self, name: str) -> Any:
        if name == "_given":  # Asked of a copy that is still being made.
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


def unwrapped(plugin: Any) -> Any:
    """The plugin as the user gave it: the object in a wrapper, or the plugin itself. Caches go by it."""
    return plugin._given if issubclass(type(plugin), _Wrapped) else plugin


_known: set[tuple[type, type]] = set()
_wrappers: dict[tuple, type] = {}


def adapted(given: Any, *bases: type[Plugin]) -> Any:
    """A plugin as an instance of its base: as it is, or wrapped if its class does not inherit from it.

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
    stood_in = {
        method: by
        for base in bases
        for method, (other, by) in base.STAND_INS.items()
        if other in present and method not in present
    }
    present |= frozenset(stood_in)
    # The most special first, as Python wants them.
    fitting = tuple(base for base in reversed(bases) if base.__abstractmethods__ <= present)
    if bases[0] not in fitting or isinstance(given, type):
        return None
    key = kind, fitting, present
    if key not in _wrappers:
        _check_names(kind, fitting)
        _wrappers[key] = _wrapper(kind, fitting, present, stood_in)
        _wrappers[key]._bases = bases
    return _wrappers[key](given)


def _wrapper(
    kind: type, bases: tuple[type[Plugin], ...], present: frozenset[str], stood_in: Mapping[str, Callable]
) -> type:
    """The class of wrappers for objects of a class that have these members, `stood_in` for by others where missing."""
    own = present - {"__call__"} - stood_in.keys() - {name for base in bases for name in _final(base)}
    namespace: dict[str, Any] = {name: property(lambda self, get=attrgetter(name): get(self._given)) for name in own}
    for method, by in stood_in.items():
        namespace[method] = lambda self, *args, by=by: by(self._given, *args)
    if "__call__" in present:
        namespace["__call__"] = lambda self, *args, **kwargs: self._given(*args, **kwargs)
    for method, flag in (pair for base in bases for pair in base.FLAGS.items() if pair[1] not in present):
        namespace[flag] = method in present
    return type(kind.__name__, (_Wrapped, *bases), namespace)


def _final(base: type[Plugin]) -> set[str]:
    """The methods that a base keeps for itself, which it marks by `typing.final`."""
    return {name for c in base.__mro__ for name, value in c.__dict__.items() if getattr(value, "__final__", False)}


def _members(base: type[Plugin]) -> list[str]:
    """What a base declares: names of methods and class variables."""
    names = [n for c in base.__mro__ if c not in (Plugin, abc.ABC, object) for n in c.__dict__]
    return [n for n in dict.fromkeys(names) if not n.startswith("_") and n not in Plugin.__annotations__] + ["__call__"]


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
        if isinstance(value, FunctionType)
        and not name.startswith("_")
        and name not in required
        and not getattr(value, "__final__", False)
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
    for base in (b for b in bases if issubclass(kind, b)):
        for method, (other, _) in base.STAND_INS.items():
            if other in there:
                raise PluginError(
                    f"{there[other].__qualname__} overrides {other!r}, which is for direct calls; write {method!r} "
                    f"instead, as rts.{base.__name__} says"
                )


def _one_edit(a: str, b: str) -> bool:
    """Whether one character added, left out or exchanged makes one name of the other."""
    if abs(len(a) - len(b)) > 1 or a == b:
        return False
    short, long = sorted((a, b), key=len)
    start = next((i for i, c in enumerate(short) if c != long[i]), len(short))
    return short[start + (len(short) == len(long)) :] == long[start + 1 :]
