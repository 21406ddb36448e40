"""Checks that every operation must pass."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import pytest

from rts import Engine
from rts.plugin_api.operations import Operation
from rts.plugin_api.threads import read_only
from rts_testing import derivatives
from rts_testing.claims import claim, claim_finite, no_error
from rts_testing.conformance import Conformance

TOLERANCES = {np.dtype(np.float32): 1e-4, np.dtype(np.float64): 1e-9}
"""The largest difference of results, relative to the largest expected number."""


class OperationConformance(Conformance):
    """Checks of an operation against its specification: its functions on NumPy arrays, and itself in every engine.

    Override the fixtures `operation`: an `Operation`; `operands`: NumPy arrays, floats of any dtype, at which the
    specification has derivatives; and, if it takes parameters, `params`: a dict.
    """

    @pytest.fixture
    def operation(self) -> Operation:
        """The operation."""
        raise NotImplementedError("override the fixture 'operation' with an Operation")

    @pytest.fixture
    def operands(self) -> Sequence[np.ndarray]:
        """Operands for the operation."""
        raise NotImplementedError("override the fixture 'operands' with NumPy arrays for the operation")

    @pytest.fixture
    def params(self) -> dict[str, Any]:
        """Parameters by name; none by default."""
        return {}

    @pytest.mark.parametrize("dtype", [np.float32, np.float64])
    def test_forward_is_the_specification(
        self, operation: Operation, operands: Sequence, params: dict, dtype: Any
    ) -> None:
        """`forward` fills `out`, whose shape is that of `shape`, with the specification's value."""
        arrays, value = _of(operands, dtype), _value(operation, _of(operands, dtype), params)[0]
        with no_error(f"the specification of {operation.name}"):
            expected = np.asarray(operation.specification(*arrays, **params))
        claim(expected.dtype == dtype, f"the specification gives {expected.dtype} for operands of {np.dtype(dtype)}")
        left = np.sum(np.isnan(value) & ~np.isnan(expected)) if value.shape == expected.shape else 0
        claim(not left, f"forward leaves {left} of {value.size} numbers of `out` unwritten, or NaN")
        _claim_close(value, expected, f"the value by forward in {np.dtype(dtype)}, of the shape that `shape` tells,")

    def test_push_is_the_derivative_of_the_specification(
        self, operation: Operation, operands: Sequence, params: dict
    ) -> None:
        """`push` fills `out` with derivatives along tangents of each operand, and of all, in two directions at once."""
        engine = _most_precise()
        at = [engine.to_numpy(x) for x in _constants(engine, _of(operands, np.float64))]
        varied, kept = at[: operation.differentiable], _value(operation, at, params)[1]
        for which in _choices(len(varied)):
            sweep = _tangents(varied, which, count=2)
            pushed = _pushed(operation, at, sweep, kept, params)
            for i, result in enumerate(pushed):
                along = [np.zeros_like(x) if t is None else t[i] for x, t in zip(varied, sweep, strict=True)]
                expected = _specified_slope(engine, operation, at, along, params)
                _claim_close(result, expected, f"push along {_named(which)}")

    @pytest.mark.parametrize("dtype", [np.float32, np.float64])
    def test_pull_is_the_transpose_of_push(
        self, operation: Operation, operands: Sequence, params: dict, dtype: Any
    ) -> None:
        """`pull` is the transpose of `push`: ⟨g, J t⟩ = ⟨Jᵀ g, t⟩ for each operand, and for all together."""
        at = _of(operands, dtype)
        varied, (value, kept) = at[: operation.differentiable], _value(operation, at, params)
        g = read_only(np.random.default_rng(2).standard_normal(value.shape).astype(dtype))
        for which in _choices(len(varied)):
            tangents = _tangents(varied, which)
            (pushed,) = _pushed(operation, at, tangents, kept, params)
            pulled = _pulled(operation, at, g, which, kept, params)
            forward = float(np.sum(g * pushed, dtype=np.float64))
            pairs = [(x, t[0]) for x, t in zip(pulled, tangents, strict=True) if x is not None and t is not None]
            reverse = sum(float(np.sum(x * t, dtype=np.float64)) for x, t in pairs)
            scale = float(np.linalg.norm(pushed) * np.linalg.norm(g)) + 1e-6
            claim(
                abs(forward - reverse) <= TOLERANCES[np.dtype(dtype)] * scale,
                f"in {np.dtype(dtype)} push gives {forward:.6g} for the derivative along {_named(which)}, and pull "
                f"{reverse:.6g}; expected the same",
            )

    def test_what_forward_keeps_changes_nothing(self, operation: Operation, operands: Sequence, params: dict) -> None:
        """Derivatives are the same with and without the data that `forward` keeps."""
        if not operation.keeps:
            pytest.skip("its forward keeps nothing")
        at = _of(operands, np.float64)
        varied, (value, kept) = at[: operation.differentiable], _value(operation, at, params)
        which, g = list(range(len(varied))), read_only(np.ones_like(value))
        pushed = [_pushed(operation, at, _tangents(varied, which), kept_data, params) for kept_data in (kept, None)]
        _claim_close(pushed[1], pushed[0], "push without what forward has kept, against with it,")
        with_it, without = (_pulled(operation, at, g, which, kept_data, params) for kept_data in (kept, None))
        for i in which:
            _claim_close(without[i], with_it[i], "pull without what forward has kept, against with it,")

    @pytest.mark.parametrize("share", [0.0, 0.5])
    def test_rows_are_computed_by_themselves(
        self, operation: Operation, operands: Sequence, params: dict, share: float
    ) -> None:
        """Half of the rows alone, or none, have the value that they have among all; without rows gradients are zero."""
        if not (operation.packed and operation.packed_result):
            pytest.skip("its result has no row for each sample")
        whole = _of(operands, np.float64)
        count = int(share * len(whole[operation.packed[0]]))
        at = [x[:count] if i in operation.packed else x for i, x in enumerate(whole)]
        varied, (value, kept) = at[: operation.differentiable], _value(operation, at, params)
        _claim_close(value, _value(operation, whole, params)[0][:count], f"the value of the first {count} rows")
        which = list(range(len(varied)))
        pushed = _pushed(operation, at, _tangents(varied, which), kept, params)
        claim(pushed.shape[1:] == value.shape, f"push along tangents of {count} rows gives shape {pushed.shape[1:]}")
        pulled = _pulled(operation, at, read_only(np.ones_like(value)), which, kept, params)
        if not count:
            claim(all(not np.any(x) for x in pulled), "the gradients of a result without rows are not zero")

    @pytest.mark.parametrize("name", derivatives.ENGINES)
    def test_every_engine_gives_the_value_and_derivatives_of_the_specification(
        self, operation: Operation, operands: Sequence, params: dict, name: str
    ) -> None:
        """The operation is its specification in every engine, compiled or not, and in both modes of derivatives."""
        engine, count = derivatives.engine_or_skip(name), operation.differentiable
        at = _of(operands, np.float32)
        expected = np.asarray(operation.specification(*at, **params))
        for how, call in (("", operation), (", compiled,", engine.jit(lambda *x: operation(*x, **params)))):
            with no_error(f"{operation.name} in {name}{how}"):
                constants = _constants(engine, at)
                result = engine.to_numpy(call(*constants, **params) if call is operation else call(*constants))
            _claim_close(result, expected, f"the value in {name}{how}")
        if not engine.differentiates:
            return
        weights = np.random.default_rng(4).standard_normal(expected.shape)
        along, fixed = derivatives.directions(at[:count]), _constants(engine, at[count:])
        with no_error(f"derivatives of {operation.name} in {name}"):
            computed, specified = (
                derivatives.compiled(engine, lambda x, f=f: f(*x, *fixed, **params), at[:count], along, weights)
                for f in (operation, operation.specification)
            )
        _claim_close(computed.along, specified.along, f"the derivative in forward mode in {name}")
        for result, gradient in zip(computed.gradient, specified.gradient, strict=True):
            _claim_close(result, gradient, f"the gradient in {name}")


def _of(operands: Sequence, dtype: Any) -> list[np.ndarray]:
    """Read-only operands with floats of a dtype, as operations get them."""
    arrays = [np.asarray(x) for x in operands]
    return [read_only(x.astype(dtype) if x.dtype.kind == "f" else x) for x in arrays]


def _constants(engine: Engine, arrays: Sequence[np.ndarray]) -> list[Any]:
    """Arrays of an engine; float64 stays float64 if the engine has it."""
    like = _float64(engine) if any(x.dtype == np.float64 for x in arrays) else None
    return [engine.constant(x, like) for x in arrays]


def _float64(engine: Engine) -> Any:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # jax says that it is not set to float64.
        return engine.namespace.astype(engine.constant(np.zeros(1)), engine.namespace.float64)


def _most_precise() -> Engine:
    """An engine with derivatives; one with float64 if installed."""
    return max(derivatives.installed(), key=lambda engine: engine.namespace.finfo(_float64(engine).dtype).bits)


def _value(operation: Operation, operands: Sequence[np.ndarray], params: Mapping) -> tuple[np.ndarray, Any]:
    """The value that `forward` writes, NaN where it writes nothing; and what it keeps."""
    with no_error(f"forward of {operation.name}"):
        out = np.full(operation.result_shape(*(x.shape for x in operands), **params), np.nan, operands[0].dtype)
        return out, operation.forward(operands, out, **params)


def _pushed(operation: Operation, operands: Sequence, tangents: Sequence, kept: Any, params: dict) -> np.ndarray:
    count = len(next(t for t in tangents if t is not None))
    shape = operation.result_shape(*(x.shape for x in operands), **params)
    out = np.full((count, *shape), np.nan, operands[0].dtype)
    with no_error(f"push of {operation.name}"):
        operation.push_on_host(operands, tangents, out, kept, params)
    claim_finite(out, "the derivative by push, where what it does not write is NaN,")
    return out


def _pulled(operation: Operation, operands: Sequence, g: np.ndarray, which: Sequence, kept: Any, params: dict) -> list:
    varied = operands[: operation.differentiable]
    results = [np.zeros(x.shape, x.dtype) if i in which else None for i, x in enumerate(varied)]
    with no_error(f"pull of {operation.name}"):
        operation.pull_on_host(operands, g, results, kept, params)
    return results


def _choices(count: int) -> Iterator[list[int]]:
    """Lists of operands' indices: each alone, then all together."""
    yield from ([i] for i in range(count))
    if count > 1:
        yield list(range(count))


def _tangents(varied: Sequence[np.ndarray], which: Sequence[int], count: int = 1) -> list[np.ndarray | None]:
    """Random tangents (count, ·) of the chosen operands, and None for the others."""
    rng = np.random.default_rng(1)
    drawn = [read_only(rng.standard_normal((count, *x.shape)).astype(x.dtype)) for x in varied]
    return [t if i in which else None for i, t in enumerate(drawn)]


def _specified_slope(engine: Engine, operation: Operation, at: list, along: list, params: dict) -> np.ndarray:
    """The derivative of the specification, by the engine's forward mode."""
    count, constants = operation.differentiable, _constants(engine, at)
    f: Callable = lambda x: operation.specification(*x, *constants[count:], **params)  # noqa: E731
    with no_error(f"the derivative of the specification of {operation.name} in {engine.name}"):
        return engine.to_numpy(engine.jvp(f, constants[:count], _constants(engine, along))[1])


def _claim_close(actual: Any, expected: Any, what: str) -> None:
    """Fail unless two arrays of one shape agree within the tolerance of the coarser dtype."""
    claim(actual.shape == expected.shape, f"{what} has shape {actual.shape}; expected {expected.shape}")
    claim_finite(actual, what)
    coarse = max(TOLERANCES[x.dtype] for x in (actual, expected))
    worst = float(np.abs(np.subtract(actual, expected, dtype=np.float64)).max(initial=0))
    most = coarse * max(float(np.abs(expected).max(initial=0)), 1e-3)
    claim(worst <= most, f"{what} is off by {worst:.3g}; expected the specification's, to {most:.2g}")


def _named(which: Sequence[int]) -> str:
    return f"operand {which[0]}" if len(which) == 1 else "all operands"
