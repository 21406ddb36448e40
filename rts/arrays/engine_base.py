"""The base class of engines, which wrap array frameworks."""

from __future__ import annotations

import abc
import functools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np

from rts.arrays.trees import STATIC_FIELDS, Array, Tree, join_record, split_record
from rts.errors import EngineError, RtsError
from rts.plugin_base import Plugin


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

    def arange(self, count: int, like: Array) -> Array:
        """The numbers (count,) from 0 on, in the dtype of `like`, float32 or float64, and on its device."""
        return self.constant(np.arange(float(count)), like)

    @abc.abstractmethod
    def call_host(self, fn: Callable, specs: Sequence[Any], *args: Array) -> tuple[Array, ...]:
        """Call `fn` on NumPy views or copies of `args`; the results carry no derivative and live where `args` do.

        Args:
            fn: host arrays → as many host arrays as there are specs. It may have a method `many`: the operands of each
                of several items → the results of each. Under `vmap` that is called, once for the whole batch.
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

    def program(self, f: Callable[..., Tree], varying: Callable[[Tree], Tree], options: Mapping[str, Any]) -> Callable:
        """A function like `f` that runs as one compiled program, for `rts.program`. The default returns `f` itself.

        Args:
            f: trees → a tree.
            varying: arguments → a tree like them, with the axis of each array that may have another length in a later
                call; −1 for none.
            options: of the compiler.
        """
        return f

    def jvp(self, f: Callable, primal: Tree, tangent: Tree) -> tuple[Array, Array]:
        """The value `f(primal)` and its derivative along `tangent`, differentiable in arrays that `f` closes over."""
        raise self._no_derivatives()

    def jacobian(self, f: Callable) -> Callable:
        """Turn `f(vector) -> arrays` into `vector -> (arrays, derivatives)`, by forward mode.

        The derivatives of each array have a new first axis, that of the vector.
        """
        raise self._no_derivatives()

    def optimizer(
        self, method: Any, learning_rate: float | Sequence[float], parameters: Tree, original: Tree = None
    ) -> Callable[[Tree, Tree], Tree]:
        """A function `(parameters, gradient) -> new parameters`, a step of a first-order optimiser.

        It keeps state, perhaps the parameters too: call it with the parameters that it returned last. To be kept in
        checkpoints, the function is an object with two more methods: `state() -> bytes`, and `restore(state,
        parameters)`, which goes on from there, and raises an InputError for a state of another optimiser.

        Args:
            method: "adam", "sgd", or an optimiser object of the framework.
            learning_rate: the rate, or a list of one for each array of the parameters; for a method by name.
            parameters: where to start; never changed in place.
            original: a tree like `parameters` whose arrays an optimiser object may hold; None for `parameters`.

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

    def at_hand(self, x: Array) -> np.ndarray | None:
        """The value of an array in the host's memory; None if it is on another device, or traced."""
        return self.known(x) if self.on_host(x) else None

    def are_known(self, arrays: Iterable[Array]) -> bool:
        """True if no array is traced, and no transform maps over several values of one."""
        for x in arrays:
            # On another device an empty part of it is looked at, so that nothing crosses.
            value = self.known(x[:0, ...] if len(x.shape) and not self.on_host(x) else x)
            if value is None or value.ndim != len(x.shape):
                return False
        return True

    def placed(self, arrays: Sequence[np.ndarray], like: Array | None) -> Sequence[Array]:
        """Arrays of the host, which nobody writes to any more, on the device of `like`; their dtypes stay."""
        specs = [SimpleNamespace(shape=x.shape, dtype=x.dtype, packed=False, by_sample=False) for x in arrays]
        # None of its numbers cross: it only says where to.
        place = [] if like is None else [self.namespace.reshape(like, (-1,))[:0]]
        return self.call_host(lambda *_: arrays, specs, *place)

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

    def product(self, a: Array, b: Array) -> Array:
        """The product (…, N, M) of matrices (…, N, K) and (…, K, M), in the arrays' own precision.

        Matrix units of some devices round float32 to fewer bits, unless an engine is told not to.
        """
        return a @ b

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

    def checkpoint(self, make: Callable[[], Tree], f: Callable[[Tree], Tree]) -> Any:
        """The result of `f(make())`: an array, or a tuple of arrays. For its gradient `f` may run again.

        So no intermediate arrays are kept. `make` has no derivative. The engine runs it again, too, or keeps its tree.
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
