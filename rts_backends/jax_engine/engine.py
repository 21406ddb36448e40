"""The engine of jax arrays: eager, `jit`, and every transform, on any device."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from rts import Engine, InputError, RtsError
from rts.plugin_api.arrays import Tree
from rts.plugin_api.checks import quoted
from rts.plugin_api.operations import Operation
from rts.plugin_api.records import ArraySpec
from rts_backends.jax_engine import host, operations, row_blocks
from rts_backends.jax_engine.used_rows import UsedRows

for _cls, _split, _join in Engine.records():
    jax.tree_util.register_pytree_node(_cls, _split, lambda static, arrays, join=_join: join(arrays, static))


_REAL_KINDS = ("f", "i", "u", "b", "V")
"""Kinds of NumPy's dtypes; "V" is that of bfloat16."""


def bucket(rows: int) -> int:
    """The least number of the form 2ⁿ or 3·2ⁿ that is at least `rows` and 1024.

    So arrays have few sizes, and eager operations stay compiled.
    """
    size = 1024
    while size < rows:
        size = size * 3 // 2 if size & (size - 1) == 0 else size * 4 // 3
    return size


SMALL = 64
"""The most numbers of an array, such as a camera's matrix, whose shape is one of few."""


def _on_device(x: jax.Array | np.ndarray) -> jax.Array:
    """A copy of `x` as a jax array.

    `jnp.asarray` takes half the time, but since jax 0.10 it compiles a program for each shape, and keeps it.
    """
    return jnp.asarray(x) if x.size <= SMALL else jax.device_put(x, may_alias=False)


def _pad(x: np.ndarray, rows: int) -> np.ndarray:
    return np.concatenate([x, np.zeros((rows - x.shape[0], *x.shape[1:]), x.dtype)])


class JaxEngine(Engine):
    """Engine of jax arrays."""

    name = "jax"
    namespace = jnp
    _error: RtsError | None = None

    def __init__(self):
        self._used = UsedRows()

    def owns(self, x: Any) -> bool:
        """True for a jax array or a tracer."""
        return isinstance(x, jax.Array)

    def constant(self, value: Any, like: jax.Array | None = None) -> jax.Array:
        """`value` as a jax array: floats as float64 if `like` is, else as float32; int64 as int32; others stay."""
        array = np.asarray(value)
        if np.issubdtype(array.dtype, np.floating):
            array = array.astype(np.float64 if like is not None and like.dtype == np.float64 else np.float32)
        elif array.dtype == np.int64:
            array = array.astype(np.int32)
        return _on_device(array)

    def call_host(self, fn: Callable, specs: Sequence[ArraySpec], *args: Any) -> tuple[jax.Array, ...]:
        """Call `fn` without derivative. Packed results are padded with zeros.

        They are padded to a `bucket` if values are known, to the shape in `specs` under a trace. There, `take_error`
        hands out an `RtsError` of `fn`.
        """
        # Under grad and jvp this yields the plain value; only jit and vmap leave a tracer.
        args = tuple(jax.lax.stop_gradient(a) if isinstance(a, jax.Array) else a for a in args)
        if not any(isinstance(a, Tracer) for a in args):
            results = fn(*map(np.asarray, args))
            return tuple(
                _on_device(_pad(r, bucket(r.shape[0])) if spec.packed else np.asarray(r))
                for r, spec in zip(results, specs, strict=True)
            )

        packed = [i for i, spec in enumerate(specs) if spec.packed]

        def noticed(call: Callable, *operands: Any) -> Any:
            try:
                return call(*operands)
            except RtsError as error:
                self._error = error
                raise

        def counted(results: Sequence) -> list[np.ndarray | np.generic]:
            return [*results, np.array([len(results[i]) for i in packed], np.int32)]

        def one(*operands: Any) -> list[np.ndarray | np.generic]:
            return counted(noticed(fn, *operands))

        def together(items: Any) -> list[Any]:
            return [counted(results) for results in noticed(many, items)]

        many: Any = getattr(fn, "many", None)
        shapes = tuple(jax.ShapeDtypeStruct(spec.shape, spec.dtype) for spec in specs)
        counts = jax.ShapeDtypeStruct((len(packed),), np.int32)
        *results, used = host.call(one, (*shapes, counts), *args, many=many and together)
        for number, i in enumerate(packed):
            self._used.note(results[i], used[number])
        return tuple(results)

    def traced(self, x: jax.Array) -> bool:
        """True for a tracer."""
        return isinstance(x, Tracer)

    def plain(self, x: jax.Array) -> bool:
        """True for an array of real numbers."""
        return getattr(x.dtype, "kind", None) in _REAL_KINDS

    def admitted(self, x: jax.Array, name: str) -> jax.Array:
        """`x` itself.

        Raises:
            InputError: `x` holds complex numbers, or keys of random numbers.
        """
        if getattr(x.dtype, "kind", None) not in _REAL_KINDS:
            raise InputError(f"{name} has dtype {x.dtype}; expected real numbers")
        return x

    def known(self, x: jax.Array) -> np.ndarray | None:
        """The value of `x`, also under an eager `grad` or `jvp`; None if a trace hides it, as under `jit`."""
        x = jax.lax.stop_gradient(x) if isinstance(x, Tracer) else x
        return None if isinstance(x, Tracer) else np.asarray(x)

    def on_host(self, *arrays: jax.Array) -> bool:
        """True if all arrays are on CPUs. A tracer's device is not known yet, and taken to be a CPU."""
        return all(isinstance(x, Tracer) or all(d.platform == "cpu" for d in x.devices()) for x in arrays)

    def devices(self, arrays: Iterable[Any]) -> set[Any]:
        """The devices of arrays that `jax.device_put` bound to one; jax moves the others as need be."""
        bound = [x.devices() for x in arrays if isinstance(x, jax.Array) and not isinstance(x, Tracer) and x.committed]
        return set().union(*(found for found in bound if len(found) == 1))

    def by_host(self, f: Callable, otherwise: Callable, *arrays: jax.Array) -> tuple[jax.Array, ...]:
        """See `Engine.by_host`. A traced program chooses between `f` and `otherwise` once its device is known."""
        if any(isinstance(x, Tracer) for x in arrays):
            return jax.lax.platform_dependent(*arrays, cpu=f, default=otherwise)
        return super().by_host(f, otherwise, *arrays)

    def take_error(self) -> RtsError | None:
        """The `RtsError` of the latest host call under a trace, handed out once; None if there is none.

        jax itself raises another error in its place.
        """
        error, self._error = self._error, None
        return error

    def product(self, a: jax.Array, b: jax.Array) -> jax.Array:
        """See `Engine.product`: with the precision "highest"."""
        return jnp.matmul(a, b, precision="highest")

    def program(self, f: Callable[..., Tree], varying: Callable[[Tree], Tree], options: Mapping[str, Any]) -> Callable:
        """See `Engine.program`: by `jax.jit`, which compiles anew for another number of samples."""
        return jax.jit(f, **options)

    def stop_gradient(self, x: jax.Array) -> jax.Array:
        """`jax.lax.stop_gradient`."""
        return jax.lax.stop_gradient(x)

    def apply(self, operation: Operation, operands: Sequence[jax.Array], params: Mapping[str, Any]) -> jax.Array:
        """The result by compiled code on CPUs, if all floats are float32 or all float64; else by the array code."""
        if not operations.fits(operation, operands):
            return operation.specification(*operands, **params)
        used = self._used.used([operands[i] for i in operation.packed])
        result = operations.apply(operation, operands, params, used)
        if operation.packed_result and isinstance(used, Tracer):
            self._used.note(result, used)
        return result

    def padded(self, x: jax.Array) -> bool:
        """True: packed arrays may be padded to a bucket, or to the capacity."""
        return True

    def room(self, rows: int, x: jax.Array) -> int:
        """See `Engine.room`: a `bucket`, or `rows` while `x` is traced, since a program has its shapes anyway."""
        return rows if isinstance(jax.lax.stop_gradient(x), Tracer) else bucket(rows)

    def fill_unused(self, x: jax.Array, row: jax.Array) -> jax.Array:
        """See `Engine.fill_unused`: by selection, which XLA can fuse with later code; all ones if no row is in use."""
        used = jnp.max(row) + 1
        index = jnp.arange(x.shape[0]).reshape(-1, *[1] * (x.ndim - 1))
        return jnp.where(index < used, x, jnp.where(used > 0, x[:1], 1))

    def by_rows_in_use(
        self, f: Callable[[dict[str, jax.Array]], jax.Array], rows: Mapping[str, jax.Array], row: jax.Array, whole: Any
    ) -> jax.Array:
        """See `Engine.by_rows_in_use`: a traced program on the CPU calls `f` piece by piece.

        Otherwise, or where pieces would gain nothing (`row_blocks.apply`), the result is `whole`.
        """
        if not isinstance(row, Tracer) or jax.default_backend() != "cpu":
            return whole
        used = jnp.max(row) + 1

        def few(*arrays: jax.Array) -> jax.Array:
            # For small pieces array code takes less time than a call to the host.
            with operations.by_specification():
                return f(dict(zip(rows, arrays, strict=True)))

        result = row_blocks.apply(few, used, list(rows.values()))
        return whole if result is None else result

    def segment_sum(self, values: jax.Array, segments: jax.Array | np.ndarray, count: int) -> jax.Array:
        """(count, n) sums of the rows of `values` (N, n) that have the same number in `segments` (N,)."""
        return jax.ops.segment_sum(values, _on_device(segments), num_segments=count)

    def to_numpy(self, x: jax.Array) -> np.ndarray:
        """The value on the host."""
        return np.asarray(x)

    def repeat(self, body: Callable[[Tree], Tree], going: Callable[[Tree], jax.Array], state: Tree, most: int) -> Tree:
        """See `Engine.repeat`: a Python loop, which compiles nothing; `jax.lax.while_loop` once values are unknown."""
        state = jax.lax.stop_gradient(state)
        for count in range(most):
            on = going(state)
            if isinstance(on, Tracer):
                return jax.lax.stop_gradient(self._looped(body, going, state, most - count))
            if not bool(on):
                break
            state = jax.lax.stop_gradient(body(state))
        return state

    def map_rows(self, f: Callable[[jax.Array], jax.Array], rows: jax.Array, size: int) -> jax.Array:
        """See `Engine.map_rows`; the last call is padded with zeros to `size`, so that a program holds `f` once."""
        count = rows.shape[0]
        if count <= size:
            return f(rows)
        pieces = jnp.pad(rows, ((0, -count % size), *[(0, 0)] * (rows.ndim - 1))).reshape(-1, size, *rows.shape[1:])
        first = f(pieces[0])
        traced = isinstance(first, Tracer)
        mapped = jax.lax.map(f, pieces) if traced else jnp.stack([first, *[f(piece) for piece in pieces[1:]]])
        return mapped.reshape(-1, *mapped.shape[2:])[:count]

    @staticmethod
    def _looped(body: Callable, going: Callable, state: Tree, most: int) -> Tree:
        def step(counted: tuple) -> tuple:
            count, state = counted
            return count + 1, body(state)

        def on(counted: tuple) -> jax.Array:
            count, state = counted
            return (count < most) & going(state)

        # A loop needs constant dtypes; numbers in the state may be weakly typed.
        state = jax.tree.map(lambda x: jnp.asarray(x, jnp.result_type(x)), state)
        return jax.lax.while_loop(on, step, (jnp.int32(0), state))[1]

    def block(self, x: Tree) -> Tree:
        """Wait until the arrays of `x` are computed, and return it."""
        return jax.block_until_ready(x)

    def value_and_grad(self, f: Callable) -> Callable:
        """`jax.value_and_grad`."""
        return jax.value_and_grad(f)

    def checkpoint(self, make: Callable[[], Tree], f: Callable[[Tree], Tree]) -> Any:
        """`jax.checkpoint` of `f`. The result of `make` is kept, since tracing `make` would fix its arrays' shapes."""
        operand = make()
        return jax.checkpoint(lambda: f(operand))()

    def jvp(self, f: Callable, primal: Tree, tangent: Tree) -> tuple[jax.Array, jax.Array]:
        """`jax.jvp`."""
        return jax.jvp(f, (primal,), (tangent,))

    def jacobian(self, f: Callable) -> Callable:
        """See `Engine.jacobian`: by forward-mode autodiff, all unknowns in one vectorised pass."""

        def call(vector: jax.Array) -> tuple[jax.Array, jax.Array]:
            along = jnp.eye(vector.size, dtype=vector.dtype)
            return jax.vmap(lambda t: jax.jvp(f, (vector,), (t,)), out_axes=(None, 0))(along)

        return call

    def jit(self, f: Callable) -> Callable:
        """`jax.jit`."""
        return jax.jit(f)

    def optimizer(self, method: Any, learning_rate: Any, parameters: Tree, original: Tree = None) -> Any:
        """See `Engine.optimizer`: optax's `adam` or `sgd`, or an `optax.GradientTransformation`."""
        from rts_backends.jax_engine.optimizer import Optimizer

        if not isinstance(method, str) and not (callable(getattr(method, "init", None)) and hasattr(method, "update")):
            raise InputError(
                f"method is {quoted(method)}; expected one of adam, sgd, lm, or an optax.GradientTransformation, such "
                f"as optax.adam(0.01), for jax arrays"
            )
        return Optimizer(method, learning_rate, parameters)
