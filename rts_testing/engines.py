"""Checks that every engine must pass."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any
from unittest import mock

import numpy as np
import pytest

from rts import Engine, rigid
from rts.errors import EngineError
from rts.plugin_api.arrays import leaves, map_leaves
from rts.plugin_api.records import ArraySpec, Cells, Samples
from rts.tool_api.plugins import engine_named, owning
from rts_testing import derivatives, scenes
from rts_testing.claims import claim, claim_close, no_error
from rts_testing.conformance import Conformance
from rts_testing.engine_examples import IDS, NAMESPACE, OPERATIONS, N, numbers

TOLERANCE = 1e-5


class EngineConformance(Conformance):
    """Checks of an engine.

    Override the fixture `engine`: the name of a registered one, or an object. Checks of derivatives are skipped if the
    engine does not differentiate.
    """

    @pytest.fixture
    def engine(self) -> Any:
        """Name or object of the engine."""
        raise NotImplementedError("override the fixture 'engine' with the engine, or its name")

    # ------------------------------------------------------------------------------------------- arrays

    def test_it_owns_its_arrays_alone(self, engine: Any) -> None:
        """`owns` holds for results of `constant`, but not for lists, numbers, None or another engine's NumPy arrays."""
        instance = _instance(engine)
        claim(instance.owns(instance.constant(np.ones(3))), "it does not own the array that `constant` gives")
        strangers = [1.0, [1.0], None, *([] if instance.name == "numpy" else [np.ones(3)])]
        for x in strangers:
            claim(not instance.owns(x), f"it owns a {type(x).__name__}")

    def test_constants_keep_their_values(self, engine: Any) -> None:
        """`constant` keeps values; floats get the dtype of `like`, integers and booleans stay such."""
        instance = _instance(engine)
        single = instance.constant(np.ones(2, np.float32))
        for value in (np.array([1.5, -2.0]), np.arange(6, dtype=np.int32).reshape(2, 3), np.array([True, False]), 0.5):
            result = instance.constant(value, single)
            host = instance.to_numpy(result)
            claim(np.array_equal(host, value), f"the constant of {value!r} is {host!r}")
            kind = np.asarray(value).dtype.kind
            claim(host.dtype.kind == kind, f"the constant of {value!r} has dtype {host.dtype}")
            claim(kind != "f" or host.dtype == np.float32, f"beside float32, {value!r} became {host.dtype}")
        backwards = np.arange(12.0).reshape(3, 4)[::-1, ::2]
        claim_close(instance.to_numpy(instance.constant(backwards)), backwards, 0, "the constant of a strided array")

    @pytest.mark.parametrize("name", NAMESPACE)
    def test_its_namespace_is_that_of_the_array_api(self, engine: Any, name: str) -> None:
        """Functions of `namespace` return NumPy's results, to 1e-5."""
        instance, x, f = _instance(engine), numbers(N, 4, seed=4), NAMESPACE[name]
        from array_api_compat import numpy as xp

        with owning(instance), no_error(f"{name} in the namespace of {instance.name}"):
            result = instance.to_numpy(f(instance.namespace, instance.constant(x)))
        claim_close(result, f(xp, x), TOLERANCE, name)

    # ------------------------------------------------------------------------------------------ the host

    def test_host_functions_are_called_with_numpy(self, engine: Any) -> None:
        """`call_host` gives NumPy arrays to the function, and the engine's arrays back, compiled or not."""
        instance = _instance(engine)

        def host(x: np.ndarray, ids: np.ndarray) -> tuple[np.ndarray, ...]:
            claim(isinstance(x, np.ndarray) and isinstance(ids, np.ndarray), "a host function gets other than NumPy")
            return (np.asarray(x) * 2).astype(np.float32), np.asarray(ids.sum(), np.int32), x[:2].astype(np.float32)

        specs = ArraySpec((N, 3), np.float32), ArraySpec((), np.int32), ArraySpec((N, 3), np.float32, packed=True)
        x, ids = instance.constant(numbers(N, 3)), instance.constant(IDS)
        for how, f in _both_ways(instance, lambda x, i: instance.call_host(host, specs, x, i)):
            with owning(instance), no_error(f"a host function{how}"):
                twice, total, packed = (instance.to_numpy(r) for r in f(x, ids))
            claim_close(twice, 2 * numbers(N, 3), 0, f"the result of a host function{how}")
            claim(total.dtype.kind == "i" and total == IDS.sum(), f"an integer result{how} is {total!r}")
            claim_close(packed[:2], numbers(N, 3)[:2], 0, f"a packed result{how}")
            claim((packed[2:] == 0).all(), f"a packed result{how} is not padded with zeros")

    def test_host_functions_have_no_derivative(self, engine: Any) -> None:
        """The result of `call_host` is a constant for derivatives, in both modes."""
        instance = _differentiating(engine)
        xp, spec = instance.namespace, ArraySpec((N, 3), np.float32)

        def f(x: Any) -> Any:
            (constant,) = instance.call_host(lambda v: (np.asarray(v) * 2,), (spec,), x)
            return xp.sum(constant * x)

        with owning(instance), no_error("the gradient through a host function"):
            gradient = instance.to_numpy(instance.value_and_grad(f)(instance.constant(numbers(N, 3)))[1])
            along = instance.jvp(f, instance.constant(numbers(N, 3)), instance.constant(np.ones((N, 3))))[1]
        claim_close(gradient, 2 * numbers(N, 3), TOLERANCE, "the gradient of c x, c from the host,")
        claim_close(instance.to_numpy(along), 2 * numbers(N, 3).sum(), 1e-4, "its derivative in forward mode")

    def test_what_is_decided_by_the_device_is_the_same(self, engine: Any) -> None:
        """`by_host` returns the result of one of its functions, compiled or not."""
        instance = _instance(engine)
        for how, call in _both_ways(instance, lambda x: instance.by_host(lambda v: (v * 2,), lambda v: (v + v,), x)[0]):
            with owning(instance), no_error(f"by_host{how}"):
                result = instance.to_numpy(call(instance.constant(numbers(N))))
            claim_close(result, 2 * numbers(N), 0, f"the result of by_host{how}")

    # ------------------------------------------------------------------------------------------- sums, loops

    def test_segments_are_summed(self, engine: Any) -> None:
        """`segment_sum` returns the sums, zero for an empty segment, and has their gradient."""
        instance, values, segments = _instance(engine), numbers(N, 3), np.array([1, 1, 3, 0, 1, 3])
        expected = np.zeros((5, 3), np.float32)
        np.add.at(expected, segments, values)
        sums = instance.to_numpy(instance.segment_sum(instance.constant(values), segments, 5))
        claim_close(sums, expected, TOLERANCE, "segment_sum")
        if instance.differentiates:
            weights = instance.constant(numbers(5, 3, seed=2))
            f = lambda v: instance.namespace.sum(instance.segment_sum(v, segments, 5) * weights)  # noqa: E731
            gradient = instance.to_numpy(instance.value_and_grad(f)(instance.constant(values))[1])
            claim_close(gradient, numbers(5, 3, seed=2)[segments], TOLERANCE, "the gradient of segment_sum")

    def test_loops_end_early(self, engine: Any) -> None:
        """`repeat` stops when its condition fails, or after the most times, compiled or not."""
        instance = _instance(engine)
        xp = instance.namespace

        def halved(most: int) -> Callable:
            def f(x: Any) -> Any:
                state = {"x": x, "count": x[:1] * 0}
                body = lambda s: {"x": s["x"] / 2, "count": s["count"] + 1}  # noqa: E731
                state = instance.repeat(body, lambda s: xp.any(s["x"] > 1), state, most)
                return xp.concat([state["x"], state["count"]])

            return f

        for most, expected in ((50, [1.0, 0.125, 3]), (2, [2.0, 0.25, 2])):
            for how, call in _both_ways(instance, halved(most)):
                with owning(instance), no_error(f"repeat{how}"):
                    result = instance.to_numpy(call(instance.constant(np.array([8.0, 1.0], np.float32))))
                claim_close(result, np.array(expected), 0, f"what repeat of at most {most} times{how} gives")

    def test_loops_have_no_derivative(self, engine: Any) -> None:
        """The result of `repeat` is a constant for the gradient, compiled or not."""
        instance = _differentiating(engine)
        xp, x = instance.namespace, instance.constant(np.array([8.0, 1.0], np.float32))

        def f(v: Any) -> Any:
            halved = instance.repeat(lambda s: s / 2, lambda s: xp.any(s > 1), v, 50)
            return xp.sum(halved * v)

        for how, gradient in _both_ways(instance, lambda v: instance.value_and_grad(f)(v)[1]):
            with owning(instance), no_error(f"the gradient of what repeat gives{how}"):
                slopes = instance.to_numpy(gradient(x))
            claim_close(slopes, np.array([1.0, 0.125]), 0, f"the gradient of repeat(x) x{how}")

    def test_unused_rows_are_filled(self, engine: Any) -> None:
        """`fill_unused` replaces rows that no cell of `row` refers to by the first row, and leaves the others."""
        instance, x = _instance(engine), numbers(N, 3)
        row = np.array([[[0, 2, -1], [1, -1, -1]]], np.int32)
        with owning(instance):
            if not instance.padded(instance.constant(row)):
                pytest.skip("outside of transforms it allots no more rows than are used")
            filled = instance.to_numpy(instance.fill_unused(instance.constant(x), instance.constant(row)))
        claim_close(filled, np.concatenate([x[:3], x[[0, 0, 0]]]), 0, "fill_unused")

    def test_functions_of_rows_in_use_are_those_of_all_rows(self, engine: Any) -> None:
        """`by_rows_in_use` returns the function's result for rows that a cell refers to, compiled or not."""
        instance, x = _instance(engine), numbers(N, 3)
        row = np.array([[[0, 2, -1], [1, -1, -1]]], np.int32)

        def f(rows: Any) -> Any:
            return rows["x"] * 2

        def call(x: Any, row: Any) -> Any:
            return instance.by_rows_in_use(f, {"x": x}, row, f({"x": x}))

        for how, function in _both_ways(instance, call):
            with owning(instance), no_error(f"by_rows_in_use{how}"):
                result = instance.to_numpy(function(instance.constant(x), instance.constant(row)))
            claim_close(result[:3], 2 * x[:3], 0, f"what by_rows_in_use gives{how}")

    def test_compiled_functions_are_the_same(self, engine: Any) -> None:
        """`jit` of a function of a record returns the function's result; `block` returns its argument."""
        instance = _instance(engine)
        xp = instance.namespace

        def f(samples: Samples) -> Any:
            return xp.sum(samples.params, axis=1) + xp.astype(samples.ids[:, 0], samples.params.dtype)

        samples = Samples(IDS, numbers(N, 2), Cells(np.zeros((1, 1, 1), np.int32), numbers(1, 1, 1)), np.int32(0))
        with owning(instance), no_error("a compiled function of Samples"):
            constants = map_leaves(instance.constant, samples)
            result = instance.block(instance.jit(f)(constants))
        claim_close(instance.to_numpy(result), samples.params.sum(1) + IDS[:, 0], TOLERANCE, "a compiled function")

    # -------------------------------------------------------------------------------------- derivatives

    def test_without_derivatives_it_says_so(self, engine: Any) -> None:
        """An engine that does not differentiate raises an `rts.errors.EngineError`."""
        instance = _instance(engine)
        if instance.differentiates:
            pytest.skip("it differentiates")
        calls = {
            "value_and_grad": lambda: instance.value_and_grad(lambda x: x)(instance.constant(1.0)),
            "jvp": lambda: instance.jvp(lambda x: x, instance.constant(1.0), instance.constant(1.0)),
            "jacobian": lambda: instance.jacobian(lambda x: x)(instance.constant(np.ones(1))),
            "optimizer": lambda: instance.optimizer("adam", 0.1, instance.constant(1.0)),
        }
        for name, call in calls.items():
            try:
                call()
            except EngineError:
                continue
            except Exception as error:
                raise AssertionError(
                    f"{name} raises {type(error).__name__}; expected an rts.errors.EngineError"
                ) from error
            claim(False, f"{name} raises nothing, though the engine says that it does not differentiate")

    def test_gradients_are_those_of_closed_forms(self, engine: Any) -> None:
        """`value_and_grad` takes nested parameters, and returns zeros for unused ones."""
        instance = _differentiating(engine)
        xp = instance.namespace
        tree = {"a": numbers(3), "b": [numbers(2, seed=1), numbers(4, seed=2)]}
        with owning(instance):
            value, gradient = instance.value_and_grad(lambda t: xp.sum(t["a"] ** 2) + 3 * xp.sum(t["b"][0]))(
                map_leaves(instance.constant, tree)
            )
            gradients = derivatives.host(instance, gradient)
        claim_close(instance.to_numpy(value), (tree["a"] ** 2).sum() + 3 * tree["b"][0].sum(), TOLERANCE, "the value")
        claim_close(gradients["a"], 2 * tree["a"], TOLERANCE, "the gradient of a square")
        claim_close(gradients["b"][0], np.full(2, 3.0), TOLERANCE, "the gradient of a multiple")
        claim_close(gradients["b"][1], np.zeros(4), 0, "the gradient in what is not used")

    def test_forward_mode_can_be_differentiated(self, engine: Any) -> None:
        """`jvp` is right for x³ along d, and has a gradient in a captured factor."""
        instance = _differentiating(engine)
        xp, x, d = instance.namespace, numbers(4), numbers(4, seed=1)
        at, along = instance.constant(x), instance.constant(d)
        with owning(instance), no_error("the gradient of a derivative in forward mode"):
            value, slope = instance.jvp(lambda v: v**3, at, along)
            second = instance.value_and_grad(lambda k: xp.sum(instance.jvp(lambda v: k * v**3, at, along)[1]))(
                instance.constant(np.float32(2))
            )[1]
        claim_close(instance.to_numpy(value), x**3, TOLERANCE, "the value")
        claim_close(instance.to_numpy(slope), 3 * x**2 * d, TOLERANCE, "the derivative of x³")
        claim_close(instance.to_numpy(second), (3 * x**2 * d).sum(), TOLERANCE, "the gradient of a derivative")

    def test_rows_have_gradients(self, engine: Any) -> None:
        """`gradient_of_rows` is right for k |x|², and has a gradient in the factor k; within `checkpoint`, too."""
        instance = _differentiating(engine)
        xp, x = instance.namespace, numbers(N, 3)
        at = instance.constant(x)

        def slopes(k: Any, points: Any = at) -> Any:
            return instance.gradient_of_rows(lambda rows: k * xp.sum(rows**2, axis=1), points)

        def kept(k: Any) -> Any:
            return instance.checkpoint(lambda: instance.constant(x), lambda points: xp.sum(slopes(k, points)))

        with owning(instance), no_error("the gradient of rows"):
            gradient = instance.to_numpy(slopes(instance.constant(np.float32(2))))
            second = instance.value_and_grad(lambda k: xp.sum(slopes(k)))(instance.constant(np.float32(2)))[1]
            again = instance.value_and_grad(kept)(instance.constant(np.float32(2)))[1]
        claim_close(gradient, 4 * x, TOLERANCE, "the gradient of 2 |x|²")
        claim_close(instance.to_numpy(second), 2 * x.sum(), 1e-4, "the gradient of a gradient of rows")
        claim_close(instance.to_numpy(again), 2 * x.sum(), 1e-4, "the gradient of a gradient of rows within checkpoint")

    def test_jacobians_have_a_row_an_unknown(self, engine: Any) -> None:
        """`jacobian` of a function with two results gives the Jacobian of each."""
        instance = _differentiating(engine)
        xp, x = instance.namespace, numbers(3)
        with owning(instance), no_error("jacobian"):
            values, rows = instance.jacobian(lambda v: (v**2, xp.sum(v)))(instance.constant(x))
            values, rows = derivatives.host(instance, (values, rows))
        claim_close(values[0], x**2, TOLERANCE, "the first value of a function")
        claim_close(rows[0], np.diag(2 * x), TOLERANCE, "the Jacobian of squares")
        claim_close(rows[1], np.ones(3), TOLERANCE, "the Jacobian of a sum")

    def test_stop_gradient_stops_it(self, engine: Any) -> None:
        """`stop_gradient` keeps the value, without a derivative in either mode."""
        instance = _differentiating(engine)
        xp, x = instance.namespace, instance.constant(numbers(4))
        f = lambda v: xp.sum(instance.stop_gradient(v) * v)  # noqa: E731
        with owning(instance):
            value, gradient = instance.value_and_grad(f)(x)
            along = instance.jvp(f, x, instance.constant(np.ones(4)))[1]
        claim_close(instance.to_numpy(value), (numbers(4) ** 2).sum(), TOLERANCE, "the value")
        claim_close(instance.to_numpy(gradient), numbers(4), TOLERANCE, "the gradient of stop(x) x")
        claim_close(instance.to_numpy(along), numbers(4).sum(), TOLERANCE, "its derivative in forward mode")

    def test_checkpoints_have_the_same_gradient(self, engine: Any) -> None:
        """`checkpoint(make, f)` has the value and the gradient of `f(make())`."""
        instance = _differentiating(engine)
        xp, x = instance.namespace, instance.constant(numbers(4))
        constant = instance.constant(numbers(4, seed=1))
        f = lambda v: instance.checkpoint(lambda: constant, lambda c: xp.sum(c * v**2))  # noqa: E731
        with owning(instance), no_error("the gradient of a checkpoint"):
            value, gradient = instance.value_and_grad(f)(x)
        expected = numbers(4, seed=1)
        claim_close(instance.to_numpy(value), (expected * numbers(4) ** 2).sum(), TOLERANCE, "the value")
        claim_close(instance.to_numpy(gradient), 2 * expected * numbers(4), TOLERANCE, "the gradient of a checkpoint")

    def test_optimizers_step(self, engine: Any) -> None:
        """`optimizer` steps by rate × gradient (SGD), or first by the rate (Adam), and changes no array in place."""
        instance = _differentiating(engine)
        start = {"x": numbers(3), "y": [numbers(2, seed=1)]}
        slopes = map_leaves(lambda v: np.sign(v) * 2, start)
        with owning(instance):
            for name, expected in (("sgd", lambda v: v - 0.2 * np.sign(v)), ("adam", lambda v: v - 0.1 * np.sign(v))):
                parameters = map_leaves(instance.constant, start)
                step = instance.optimizer(name, 0.1, parameters)
                stepped = derivatives.host(instance, step(parameters, map_leaves(instance.constant, slopes)))
                for x, v in zip(leaves(stepped), leaves(start), strict=True):
                    claim_close(x, expected(v), 1e-4, f"the first step of {name}")
                for x, v in zip(leaves(derivatives.host(instance, parameters)), leaves(start), strict=True):
                    claim_close(x, v, 0, f"what {name} was given")

    def test_optimizers_go_on_from_their_state(self, engine: Any) -> None:
        """An optimiser restored from another one's `state` takes the same step; one array may have its own rate."""
        instance = _differentiating(engine)
        slopes = {"x": numbers(3, seed=2), "y": [numbers(2, seed=3)]}
        with owning(instance):
            for name in ("sgd", "adam"):
                parameters = map_leaves(instance.constant, {"x": numbers(3), "y": [numbers(2, seed=1)]})
                first: Any = instance.optimizer(name, [0.1, 0.3], parameters)
                if not hasattr(first, "state"):
                    pytest.skip("its optimisers have no state to keep")
                once = first(parameters, map_leaves(instance.constant, slopes))
                state = first.state()
                other = map_leaves(lambda v: instance.constant(-3 * v), slopes)
                expected = derivatives.host(instance, first(once, other))
                second: Any = instance.optimizer(name, [0.1, 0.3], parameters)
                second.restore(state, once)
                stepped = derivatives.host(instance, second(once, other))
                for x, v in zip(leaves(stepped), leaves(expected), strict=True):
                    claim_close(x, v, 0, f"the step of {name} after `restore`")

    # --------------------------------------------------------------------------------------- operations

    @pytest.mark.parametrize("name", OPERATIONS)
    def test_operations_are_their_specification(self, engine: Any, name: str) -> None:
        """Operations have the specification's value, compiled or not; derivatives in both modes and twice are right."""
        instance, (f, operands) = _instance(engine), OPERATIONS[name]
        with mock.patch.object(type(engine_named("numpy")), "apply", Engine.apply):
            expected = np.asarray(f(*operands))  # The value of the specification.
        for how, call in _both_ways(instance, lambda *x: f(*x)):
            with owning(instance), no_error(f"{name}{how}"):
                value = instance.to_numpy(call(*map(instance.constant, operands)))
            claim_close(value, expected, TOLERANCE, f"{name}{how}")
        if not instance.differentiates:
            return
        weights, along = numbers(*expected.shape, seed=3), derivatives.directions(operands)
        with owning(instance), no_error(f"the derivatives of {name}"):
            both = derivatives.derivatives(instance, lambda x: f(*x), operands, along, weights)
            curvature = _curvature(instance, f, operands, along, weights)
        derivatives.claim_consistent(both, along, weights, name)
        wide = [x.astype(np.float64) for x in operands]
        ends = [f(*(x + s * 1e-6 * d for x, d in zip(wide, along, strict=True))) for s in (1, -1)]
        slope = float(np.sum((ends[0] - ends[1]) / 2e-6 * weights))
        derivatives.claim_slope(both.along * weights, np.ones_like(weights), slope, f"the derivative of {name}")
        middle = f(*wide)
        second = [f(*(x + s * 1e-3 * d for x, d in zip(wide, along, strict=True))) for s in (1, -1)]
        expected = float(np.sum((second[0] - 2 * middle + second[1]) / 1e-6 * weights))
        scale = max(abs(expected), 0.1)
        claim(
            abs(curvature - expected) <= 1e-2 * scale,
            f"the second derivative of {name} is {curvature:.4g}, but {expected:.4g} by differences",
        )

    # ----------------------------------------------------------------------------------------- a render

    def test_a_render_is_numpys(self, engine: Any) -> None:
        """The image of an unlit ball is NumPy's, to 1e-4; forward and reverse mode agree, with a gradient in θ."""
        instance = _instance(engine)
        part = scenes.ball(transform=np.asarray(rigid([0.2, 0.3, 0.1, 0.05, 0.1, 0.0]), np.float32))
        expected = scenes.render(part, scenes.CAMERA, scenes.SIZE, sampler="reference")
        values, join = derivatives.split(part.theta)

        def image(x: list) -> Any:
            moved = part.replace(theta=join(x))
            return scenes.render(moved, scenes.CAMERA, scenes.SIZE, sampler="reference", capacity=scenes.CAPACITY)

        with owning(instance), no_error(f"a render in {instance.name}"):
            shown = instance.to_numpy(image([instance.constant(v) for v in values]))
            claim_close(shown, expected, 1e-4, "the image of a ball")
            if instance.differentiates:
                weights, along = numbers(*expected.shape, seed=5), derivatives.directions(values)
                both = derivatives.derivatives(instance, image, values, along, weights)
                derivatives.claim_consistent(both, along, weights, "the image of a ball")
                claim(any(np.abs(g).max() > 1e-3 for g in both.gradient), "the image has no gradient in theta")


def _curvature(engine: Engine, f: Callable, operands: list, along: list, weights: np.ndarray) -> float:
    """The second derivative of ⟨weights, f⟩ at the operands, along the direction `along`: a number."""
    xp, w = engine.namespace, engine.constant(weights)
    d = [engine.constant(x.astype(np.float32)) for x in along]

    def slope(t: Any) -> Any:
        moved = [engine.constant(x) + t * v for x, v in zip(operands, d, strict=True)]
        return engine.jvp(
            lambda s: xp.sum(f(*(m + s * v for m, v in zip(moved, d, strict=True))) * w), 0 * t, 0 * t + 1
        )[1]

    return float(engine.to_numpy(engine.value_and_grad(slope)(engine.constant(np.float32(0)))[1]))


def _both_ways(engine: Engine, f: Callable) -> list[tuple[str, Callable]]:
    return [("", f), (", compiled,", engine.jit(f))]


def _instance(engine: Any) -> Engine:
    instance = derivatives.engine_or_skip(engine) if isinstance(engine, str) else engine
    claim(isinstance(instance, Engine), f"the engine is {engine!r}; expected a name, or an object of rts.Engine")
    return instance


def _differentiating(engine: Any) -> Engine:
    instance = _instance(engine)
    if not instance.differentiates:
        pytest.skip("the engine says that it does not differentiate")
    return instance
