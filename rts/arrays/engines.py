"""Owners of arrays: the engine that an array belongs to, and constants of that engine."""

from __future__ import annotations

import contextlib
import functools
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from itertools import repeat
from typing import Any, NamedTuple, TypeVar

import numpy as np

from rts import registry
from rts.arrays.engine_base import Engine
from rts.arrays.trees import Array, Tree, collected, map_leaves
from rts.errors import EngineError, InputError, PluginError
from rts.plugin_base import check_members

_F = TypeVar("_F", bound=Callable)
CONSTANT_TYPES = (np.ndarray, np.generic, bool, int, float)


def is_constant(tree: Tree) -> bool:
    """True if every leaf is a NumPy array or a Python number, which are never differentiated."""
    return type(tree) not in OWNERS and all(map(isinstance, collected(tree), repeat(CONSTANT_TYPES)))


# Plain dictionaries rather than functools caches: torch.compile looks through the latter, and warns.
_ENGINES: dict[str, Engine] = {}
OWNERS: dict[type, Engine] = {}
"""Engines by the array types met so far. NumPy is missing: its arrays are constants beside those of any engine."""
_BITS: dict[Any, int] = {}
_BROKEN: set[str] = set()
"""Names of engines that failed to load."""


def engine_named(name: str) -> Engine:
    """The only instance of a named engine, loaded on first use.

    Raises:
        InputError: no engine has this name.
        PluginError: the engine cannot be loaded, or is no `Engine`.
    """
    if name not in _ENGINES:
        engine = registry.plugin("rts.engines", name)()
        if not isinstance(engine, Engine):
            raise PluginError(f"the engine {name!r} is {engine!r}; expected a class that subclasses rts.Engine")
        check_members(type(engine))
        _ENGINES[name] = engine
    return _ENGINES[name]


@contextlib.contextmanager
def owning(engine: Engine) -> Iterator[None]:
    """Context in which arrays like those of an engine are its own, though it is not registered."""
    kind = type(engine.constant(np.ones(1)))
    if kind is np.ndarray:
        yield
        return
    before, OWNERS[kind] = OWNERS.get(kind), engine
    try:
        yield
    finally:
        if before is None:
            del OWNERS[kind]
        else:
            OWNERS[kind] = before


def _owner(x: Any) -> Engine:
    for name in registry.plugins("rts.engines"):
        if name != "numpy" and name in sys.modules and engine_named(name).owns(x):
            return engine_named(name)
    raise EngineError(
        f"an array of type {type(x).__module__}.{type(x).__qualname__} belongs to no engine; "
        f"expected NumPy, {', '.join(n for n in registry.plugins('rts.engines') if n != 'numpy')}"
    )


def engine_of(*trees: Tree) -> Engine:
    """The engine of the arrays in these trees. NumPy arrays and Python numbers go with any; alone, they have NumPy's.

    Raises:
        EngineError: arrays of two engines, or of an unknown type.
    """
    common: Engine | None = None
    for x in trees:
        engine = OWNERS.get(type(x))
        if engine is None:
            if type(x) is np.ndarray:
                continue
            return _engine_of_leaves(collected(trees))
        if common is not None and engine is not common:
            return _engine_of_leaves(trees)
        common = engine
    return common if common is not None else _ENGINES.get("numpy") or engine_named("numpy")


def _engine_of_leaves(arrays: Sequence[Any]) -> Engine:
    common: Engine | None = None
    for x in arrays:
        engine = OWNERS.get(type(x))
        if engine is None:
            if isinstance(x, CONSTANT_TYPES):
                continue
            engine = OWNERS[type(x)] = _owner(x)
        if common is not None and engine is not common:
            raise EngineError(
                f"arrays of {' and '.join(sorted((engine.name, common.name)))} met in one call; convert one side "
                f"(NumPy arrays may stand beside either, as constants)"
            )
        common = engine
    return common if common is not None else _ENGINES.get("numpy") or engine_named("numpy")


class Context(NamedTuple):
    """An engine to compute with, and an array that sets dtype and device of its constants, or None.

    The context is determined once for each call, and handed on.
    """

    engine: Engine
    like: Array | None

    def constants(self, tree: Tree) -> Tree:
        """The tree with every NumPy array and number made a constant of the engine."""
        if tree is None or type(tree) in OWNERS:  # The usual case.
            return tree
        if type(tree) is np.ndarray:
            return self.engine.constant(tree, self.like)
        return map_leaves(self._constant, tree)

    def _constant(self, x: Any) -> Array:
        owned = type(x) in OWNERS or not isinstance(x, CONSTANT_TYPES)
        return x if owned else self.engine.constant(x, self.like)


def context_of(*trees: Tree) -> Context:
    """The engine of these trees, and their `exemplar`.

    Raises:
        EngineError: arrays of two engines, of an unknown type, or on two devices.
    """
    arrays = collected(trees)
    engine = _engine_of_leaves(arrays)
    devices = engine.devices(arrays)
    if len(devices) > 1:
        raise EngineError(
            f"arrays on the devices {' and '.join(sorted(map(str, devices)))} met in one call; move them to one device "
            f"(NumPy arrays may stand beside any, as constants)"
        )
    return Context(engine, _widest(arrays))


def context_of_scene(parts: Sequence[Any], *others: Tree, engine: str | None = None) -> Context:
    """The engine of a scene, and an array of its dtype: the one rule for dtypes.

    The dtype is the widest floating one of the torch or jax arrays. Without these, it is float64 if some θ holds a
    float64 array, else float32. NumPy cameras, transforms and backgrounds are constants, and widen nothing.

    Args:
        parts: the parts.
        *others: further arrays of the scene, such as cameras.
        engine: the name of an engine to use in any case; arrays of another one are refused.

    Raises:
        InputError: `engine` is no name of an engine.
        EngineError: arrays of two engines, of another one than `engine`, or on two devices.
    """
    scene_engine, like = context = context_of(parts, *others)
    if engine is not None:
        if not isinstance(engine, str):
            raise InputError(f"engine is a {type(engine).__name__}; expected a name, such as 'torch' or 'jax'")
        wanted = engine_named(engine)
        if scene_engine is not wanted and like is not None:
            raise EngineError(
                f"engine is {engine!r}, but the scene has {scene_engine.name} arrays; leave it out, or convert them"
            )
        scene_engine = wanted
    if like is not None:
        return context
    thetas = collected([part.theta for part in parts])
    is_wide = any(x.dtype == np.float64 for x in thetas if isinstance(x, (np.ndarray, np.generic)))
    if scene_engine.name == "numpy":
        return Context(scene_engine, _FLOAT64 if is_wide else _FLOAT32)
    return Context(
        scene_engine, scene_engine.constant(np.zeros((), np.float32)) if not is_wide else _float64(scene_engine)
    )


_FLOAT32, _FLOAT64 = np.zeros((), np.float32), np.zeros((), np.float64)


def _float64(engine: Engine) -> Array:
    """A zero in float64, or in the widest dtype that the engine is set to."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # jax warns that float64 is disabled.
        return engine.namespace.zeros((), dtype=engine.namespace.float64)


_names: list[str] = []


def load_engines() -> list[Engine]:
    """The engines whose framework has been imported, loaded now if need be; broken ones are left out.

    Once they are loaded, these frameworks accept the library's records.
    """
    if not _names:
        _names.extend(registry.plugins("rts.engines"))
    engines = []
    for name in _names:
        if sys.modules.get(name) is not None and name not in _BROKEN:
            if name not in _ENGINES:
                try:
                    engine_named(name)
                except PluginError:  # Reported once arrays of this engine are given.
                    _BROKEN.add(name)
                    continue
            engines.append(_ENGINES[name])
    return engines


def uncompiled(f: _F) -> _F:
    """A function like `f` that compilers of Python code, such as `torch.compile`, call without tracing it.

    Tracing would follow checks, caches and plugins for most of a minute, and gain little: the work is compiled
    already.
    """

    @functools.wraps(f)
    def call(*args: Any, **kwargs: Any) -> Any:
        outside = f
        for engine in load_engines():
            if type(engine).uncompiled is not Engine.uncompiled:
                outside = engine.uncompiled(outside)
        return outside(*args, **kwargs)

    return call  # pyright: ignore[reportReturnType]  # The wrapper has the type of `f`.


def is_traced(x: Array) -> bool:
    """True for an array that has a shape but not yet a value."""
    return engine_of(x).traced(x)


def value_of(x: Array) -> np.ndarray | None:
    """The value of an array, or of a list of scalars, as NumPy; None where it is traced."""
    owner = OWNERS.get(type(x))
    if owner is not None:
        return owner.known(x)
    if isinstance(x, CONSTANT_TYPES):
        return np.asarray(x)
    if isinstance(x, (list, tuple)):
        values = [value_of(item) for item in x]
        return None if any(v is None for v in values) else np.array(values)
    return engine_of(x).known(x)


def host_value(x: Array) -> np.ndarray:
    """The value of an array, which is not traced."""
    if type(x) is np.ndarray:
        return x
    owner = OWNERS.get(type(x))
    value = value_of(x) if owner is None else owner.known(x)
    assert value is not None
    return value


def exemplar(*trees: Tree) -> Array | None:
    """The widest floating array that is not NumPy's, or None. It sets dtype and device of constants."""
    return _widest(collected(trees))


def _widest(arrays: Sequence[Any]) -> Array | None:
    widest, bits = None, 0
    for x in arrays:
        if isinstance(x, CONSTANT_TYPES):
            continue
        width = _BITS.get(x.dtype) or floating_bits(x)
        if width > bits:
            widest, bits = x, width
    return widest


def floating_bits(x: Array) -> int:
    """Number of bits of an array's dtype if it is real and floating, else 0. Cached by dtype."""
    bits = _BITS.get(x.dtype)
    if bits is None:
        xp = namespace(x)
        bits = _BITS[x.dtype] = xp.finfo(x.dtype).bits if xp.isdtype(x.dtype, "real floating") else 0
    return bits


def namespace(*arrays: Array) -> Any:
    """The array-API namespace of these arrays; NumPy's if all are constants.

    Raises:
        EngineError: arrays of two engines, or of an unknown type.
    """
    engine = OWNERS.get(type(arrays[0])) if len(arrays) == 1 else None
    return (engine_of(*arrays) if engine is None else engine).namespace


def stopped(tree: Tree) -> Tree:
    """A copy of a tree without derivatives, so that results computed from it keep no graph."""
    if type(tree) is np.ndarray:
        return tree
    owner = OWNERS.get(type(tree))
    if owner is not None:
        return owner.stop_gradient(tree)
    return map_leaves(lambda x: x if isinstance(x, CONSTANT_TYPES) else engine_of(x).stop_gradient(x), tree)


def constants(tree: Tree, engine: Engine, like: Array | None) -> Tree:
    """The tree with every NumPy array and number made a constant of the engine; see `Engine.constant`."""
    return Context(engine, like).constants(tree)
