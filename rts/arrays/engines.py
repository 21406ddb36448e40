"""The base class of engines, which wrap array frameworks, and the lookup of an array's engine."""

from __future__ import annotations

import abc
import functools
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, ClassVar, NamedTuple, TypeVar

import numpy as np

from rts import registry
from rts.arrays.trees import STATIC_FIELDS, Array, Tree, collected, join_record, map_leaves, split_record
from rts.errors import EngineError, InputError, PluginError, RtsError
from rts.plugin_base import Plugin, check_members


class Engine(Plugin):
    """An array framework, chosen by the type of the arrays, never a global setting.

    The entry point's name must be the name of the framework's top-level module: only engines whose module has been
    imported are asked whether they own an array.

    Attributes:
        name: the name of its entry point.
        namespace: the array-API namespace of its arrays.
        differentiates: whether it has derivatives: `value_and_grad`, `jvp`, `jacobian` and `optimizer`.
    """

    name: ClassVar[str]
    namespace: ClassVar[Any]
    differentiates: ClassVar[bool] = True

    # ------------------------------------------------------------------------------------- methods of every framework

    @abc.abstractmethod
    def owns(self, x: Any) -> bool:
        """True for an array of the framework, traced ones included."""

    @abc.abstractmethod
    def constant(self, value: Any, like: Array | None = None) -> Array:
        """A NumPy array or number as an array without derivative, on the device of `like`.

        Floats take the dtype of `like`; without it the engine's default, such as float32.
        """

    @abc.abstractmethod
    def call_host(self, fn: Callable, specs: Sequence[Any], *args: Array) -> tuple[Array, ...]:
        """Call `fn` on NumPy views or copies of `args`; the results carry no derivative and live where `args` do.

        Args:
            fn: host arrays → as many host arrays as there are specs.
            specs: an `ArraySpec` for each result; where it says `packed`, the engine may append rows of zeros.
            *args: arrays.
        """

    @abc.abstractmethod
    def stop_gradient(self, x: Array) -> Array:
        """The values of an array, without derivatives."""

    @abc.abstractmethod
    def segment_sum(self, values: Array, segments: np.ndarray, count: int) -> Array:
        """Sums (count, C) of rows of `values` (M, C); `segments` (M,) integers say which sum each row goes to."""

    @abc.abstractmethod
    def to_numpy(self, x: Array) -> np.ndarray:
        """The value of an array as NumPy, on the host; not for traced arrays."""

    @staticmethod
    def records() -> Iterator[tuple[type, Callable[[Any], tuple], Callable[[Iterable[Any], tuple], Any]]]:
        """Classes to register as pytrees, with functions record → (arrays, others) and (arrays, others) → record."""
        for cls in STATIC_FIELDS:
            yield cls, split_record, functools.partial(join_record, cls)

    # --------------------------------------------------------------------------------------- methods with derivatives

    def value_and_grad(self, f: Callable) -> Callable:
        """Turn `f(tree) -> scalar` into `tree -> (value, gradient tree)`."""
        raise self._no_derivatives()

    def jvp(self, f: Callable, primal: Tree, tangent: Tree) -> tuple[Array, Array]:
        """The value `f(primal)` and its derivative along `tangent`, differentiable in arrays that `f` closes over."""
        raise self._no_derivatives()

    def jacobian(self, f: Callable) -> Callable:
        """Turn `f(vector) -> arrays` into `vector -> (arrays, derivatives)`, by forward mode.

        The derivatives of each array have a new first axis, that of the vector.
        """
        raise self._no_derivatives()

    def optimizer(
        self, method: Any, learning_rate: float | Sequence[float], parameters: Tree, given: Tree = None
    ) -> Callable[[Tree, Tree], Tree]:
        """A function `(parameters, gradient) -> new parameters`, a step of a first-order optimiser.

        It keeps state, perhaps the parameters too: call it with the parameters that it returned last. To be kept in
        checkpoints, the function is an object with two more methods: `state() -> bytes`, and `restore(state,
        parameters)`, which goes on from there, and raises an InputError for a state of another optimiser.

        Args:
            method: "adam", "sgd", or an optimiser object of the framework.
            learning_rate: the rate, or a list of one for each array of the parameters; for a method by name.
            parameters: where to start; never changed in place.
            given: a tree like `parameters` whose arrays an optimiser object may hold; None for `parameters`.

        Raises:
            InputError: another method.
        """
        raise self._no_derivatives()

    def traced(self, x: Array) -> bool:
        """True for an array that has a shape but not yet a value."""
        return False

    def known(self, x: Array) -> np.ndarray | None:
        """The value of an array on the host; None while it is traced.

        Under transforms of batches the value may have more axes than the array.
        """
        return None if self.traced(x) else self.to_numpy(self.stop_gradient(x))

    def repeat(self, body: Callable[[Tree], Tree], going: Callable[[Tree], Array], state: Tree, most: int) -> Tree:
        """Do `state = body(state)` as long as `going(state)`, () bool, is true, at most `most` times.

        The result has no derivative. Compiled programs keep the loop: unrolled, it would take minutes to compile.
        Arrays that `body` closes over must have no derivatives (`stop_gradient`); θ has none where rays are
        intersected.

        Args:
            body: tree of arrays → the same tree of other values; shapes and dtypes stay.
            going: tree → () bool, such as whether any ray is not done.
            state: arrays of this engine.
            most: the largest number of times.

        Returns:
            The last state.
        """
        for _ in range(most):
            if not bool(going(state)):
                break
            state = body(state)
        return state

    # -------------------------------------------------------------------------------- methods for speed and compilers

    def apply(self, operation: Any, operands: Sequence[Array], params: Mapping[str, Any]) -> Array:
        """The result of an operation. The default runs its array code (the specification), overrides compiled code."""
        return operation.specification(*operands, **params)

    def on_host(self, *arrays: Array) -> bool:
        """True if compiled loops on the host may work on these arrays, in place of array code."""
        return False

    def devices(self, arrays: Iterable[Array]) -> set[Any]:
        """The devices that these arrays are bound to; arrays without values, and other engines', count for nothing."""
        return set()

    def by_host(self, f: Callable, otherwise: Callable, *arrays: Array) -> tuple[Array, ...]:
        """Call `f` with the arrays if `on_host` holds for them, else `otherwise`; both return equal tuples of arrays.

        An engine may let a traced program choose when it runs, once its device is known.
        """
        return f(*arrays) if self.on_host(*arrays) else otherwise(*arrays)

    def exact_products(self, *arrays: Array) -> bool:
        """True if matrix products keep the arrays' precision. Matrix units of some devices round float32."""
        return False

    def plain(self, x: Array) -> bool:
        """True if `admitted` is known to return the array itself, and is not called then."""
        return False

    def admitted(self, x: Array, name: str) -> Array:
        """The array, or an equivalent one that the library can work with.

        Args:
            x: an array of this engine that a user gave.
            name: the name in error messages.

        Raises:
            InputError: the array cannot be used, such as a sparse one.
        """
        return x

    def padded(self, x: Array) -> bool:
        """True if packed arrays, which have a row for each sample, may have further rows that no cell refers to."""
        return False

    def room(self, rows: int, x: Array) -> int:
        """The number of rows to allot for `rows` rows that are computed from `x`, at least `rows`.

        An engine that compiles eager operations anew for each shape rounds up, so that arrays whose lengths vary from
        call to call, such as tables of meshes, have few shapes. The default returns `rows`.
        """
        return rows

    def fill_unused(self, x: Array, row: Array) -> Array:
        """Packed x (N, ·), with its first row in place of all rows behind the last that `row` (K, H, W) refers to.

        If it refers to none, all are ones. Only called if `padded(row)` is True; the default returns `x`.
        """
        return x

    def by_rows_in_use(
        self, f: Callable[[dict[str, Array]], Array], rows: Mapping[str, Array], row: Array, whole: Array
    ) -> Array:
        """The values `f(rows)` of a function that treats each row by itself; `whole` holds them already.

        The default returns `whole`. Compiled programs may allot more rows than are used. Their engine may call `f` with
        fewer rows instead, and so skip most of the unused ones.

        Args:
            f: packed arrays (n, ·) by name → (n, ·).
            rows: packed arrays (N, ·).
            row: (K, H, W) integers, the row of each cell, or −1; rows up to the largest are in use.
            whole: `f(rows)`, (N, ·).

        Returns:
            (N, ·), which may be anything in rows that are not in use.
        """
        return whole

    def block(self, x: Tree) -> Tree:
        """Wait until the arrays are computed, and return them."""
        return x

    def concurrent(self) -> bool:
        """True if other threads may now call host functions with the engine's arrays; False by default."""
        return False

    def split(self, x: Array, sizes: Sequence[int]) -> Sequence[Array]:
        """The array cut along its first axis into pieces of these sizes."""
        ends = np.cumsum(sizes)
        return [x[end - size : end, ...] for size, end in zip(sizes, ends.tolist(), strict=True)]

    def map_rows(self, f: Callable[[Array], Array], rows: Array, size: int) -> Array:
        """The values `f(rows)` of a function that treats each row by itself, `size` rows at a time.

        Use it for more rows than memory has room for at once. Engines need not differentiate it.

        Args:
            f: rows (size, ·) → (size, ·).
            rows: (M, ·).
            size: the number of rows of one call; the last call may have fewer, or be padded with zeros.
        """
        parts = [f(rows[i : i + size]) for i in range(0, rows.shape[0], size)]
        return parts[0] if len(parts) == 1 else self.namespace.concat(parts)

    def checkpoint(self, make: Callable[[], Tree], f: Callable[[Tree], Array]) -> Array:
        """The result of `f(make())`. For its gradient `f` may run again, so that no intermediate arrays are kept.

        `make` has no derivative. The engine runs it again, too, or keeps its tree.
        """
        return f(make())

    def gradient_of_rows(self, f: Callable[[Array], Array], rows: Array) -> Array:
        """The gradient (N, C) of a function of rows (N, C) of which each value (N,) depends on its own row alone.

        Differentiable in the rows and in arrays that `f` closes over. The default takes C derivatives in forward mode.
        """
        xp, zero, columns = self.namespace, self.namespace.zeros_like(rows), []
        for i in range(rows.shape[1]):
            along = xp.concat([zero[:, :i], xp.ones_like(rows[:, :1]), zero[:, i + 1 :]], axis=1)
            columns.append(self.jvp(f, rows, along)[1])
        return xp.stack(columns, axis=-1)

    def _no_derivatives(self) -> EngineError:
        if not self.differentiates:
            return EngineError(
                f"{self.name} arrays have no derivatives; pass arrays of an engine that has, such as torch or jax, for "
                f"what is to be differentiated"
            )
        return EngineError(f"the engine {self.name} lacks this function, though it says that it differentiates")

    def jit(self, f: Callable) -> Callable:
        """Compile `f` if the framework can, else return it."""
        return f

    def uncompiled(self, f: Callable) -> Callable:
        """A function like `f` that the framework's compiler of Python code calls without tracing it."""
        return f

    def take_error(self) -> RtsError | None:
        """The last error raised inside a host call, handed out once; None if there is none.

        It is for frameworks that wrap such errors in their own.
        """
        return None


_F = TypeVar("_F", bound=Callable)
CONSTANT_TYPES = (np.ndarray, np.generic, bool, int, float)


def is_constant(tree: Tree) -> bool:
    """True if every leaf is a NumPy array or a Python number, which are never differentiated."""
    if type(tree) in OWNERS:
        return False
    for x in collected(tree):
        if type(x) in OWNERS or not isinstance(x, CONSTANT_TYPES):
            return False
    return True


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
        return constants(tree, self.engine, self.like)


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
    own, like = context_of(parts, *others)
    if engine is not None:
        if not isinstance(engine, str):
            raise InputError(f"engine is a {type(engine).__name__}; expected a name, such as 'torch' or 'jax'")
        chosen = engine_named(engine)
        if own is not chosen and like is not None:
            raise EngineError(
                f"engine is {engine!r}, but the scene has {own.name} arrays; leave it out, or convert them"
            )
        own = chosen
    if like is not None:
        return Context(own, like)
    thetas = collected([part.theta for part in parts])
    is_wide = any(x.dtype == np.float64 for x in thetas if isinstance(x, (np.ndarray, np.generic)))
    if own.name == "numpy":
        return Context(own, _FLOAT64 if is_wide else _FLOAT32)
    return Context(own, own.constant(np.zeros((), np.float32)) if not is_wide else _float64(own))


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
            outside = engine.uncompiled(outside)
        return outside(*args, **kwargs)

    return call  # pyright: ignore[reportReturnType]  # The wrapper has the type of `f`.


def is_traced(x: Array) -> bool:
    """True for an array that has a shape but not yet a value."""
    return engine_of(x).traced(x)


def value_of(x: Array) -> np.ndarray | None:
    """The value of an array, or of a list of scalars, as NumPy; None where it is traced."""
    if isinstance(x, CONSTANT_TYPES):
        return np.asarray(x)
    if isinstance(x, (list, tuple)):
        values = [value_of(item) for item in x]
        return None if any(v is None for v in values) else np.array(values)
    return engine_of(x).known(x)


def exemplar(*trees: Tree) -> Array | None:
    """The widest floating array that is not NumPy's, or None. It sets dtype and device of constants."""
    return _widest(collected(trees))


def _widest(arrays: Sequence[Any]) -> Array | None:
    widest, bits = None, 0
    for x in arrays:
        if isinstance(x, CONSTANT_TYPES):
            continue
        width = floating_bits(x)
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
    return map_leaves(lambda x: x if isinstance(x, CONSTANT_TYPES) else engine_of(x).stop_gradient(x), tree)


def constants(tree: Tree, engine: Engine, like: Array | None) -> Tree:
    """The tree with every NumPy array and number made a constant of the engine; see `Engine.constant`."""
    if tree is None or type(tree) in OWNERS:
        return tree
    if type(tree) is np.ndarray:
        return engine.constant(tree, like)

    def constant(x: Any) -> Array:
        return x if type(x) in OWNERS or not isinstance(x, CONSTANT_TYPES) else engine.constant(x, like)

    return map_leaves(constant, tree)
