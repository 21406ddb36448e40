"""Derivatives by every installed engine, on the host."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import pytest

from rts import Engine, plugins
from rts.errors import PluginError
from rts.plugin_api.arrays import Tree, constants, map_leaves
from rts.tool_api.plugins import engine_named
from rts_testing.claims import claim, claim_close, claim_finite, no_error
from rts_testing.compatibility import single

ENGINES = plugins("rts.engines")
DIFFERENTIABLE = sorted((name for name in ENGINES if name != "numpy"), key=lambda name: name == "jax")
"""Names of the engines with derivatives; jax comes last, since its programs take seconds to compile."""


def engine_or_skip(name: str) -> Engine:
    """The engine of this name; skip the test, with the reason, if it is not installed."""
    try:
        engine = engine_named(name)
        importlib.import_module(name)
    except (PluginError, ImportError) as error:
        pytest.skip(str(error))
    return engine


def differentiating(name: str) -> Engine:
    """The engine of this name; skip the test, with the reason, if it is not installed or does not differentiate."""
    engine = engine_or_skip(name)
    if not engine.differentiates:
        pytest.skip(f"the engine {name} does not differentiate")
    return engine


def installed() -> list[Engine]:
    """The installed engines with derivatives; skip the test if there is none."""
    engines = []
    for name in DIFFERENTIABLE:
        try:
            engine = engine_named(name)
        except PluginError:
            continue
        if engine.differentiates:
            engines.append(engine)
    if not engines:
        pytest.skip(f"none of {', '.join(DIFFERENTIABLE)} is installed")
    return engines


def on(engine: Engine, tree: Tree) -> Tree:
    """A tree of NumPy arrays as arrays of the engine, floats in float32."""
    return map_leaves(lambda x: engine.constant(single(x)), tree)


def host(engine: Engine, tree: Tree) -> Tree:
    """A tree of the engine's arrays as NumPy arrays."""
    return map_leaves(lambda x: x if isinstance(x, np.ndarray) else engine.to_numpy(x), tree)


def split(tree: Tree) -> tuple[list[np.ndarray], Callable[[Sequence[Any]], Tree]]:
    """The floating leaves of a tree of NumPy arrays, and a function from new values for them to the whole tree."""
    floating: list[np.ndarray] = []

    def collect(x: Any) -> Any:
        x = np.asarray(x)
        if np.issubdtype(x.dtype, np.floating):
            floating.append(x)
        return x

    tree = map_leaves(collect, tree)

    def join(values: Sequence[Any]) -> Tree:
        it = iter(values)
        return map_leaves(lambda x: next(it) if np.issubdtype(x.dtype, np.floating) else x, tree)

    return floating, join


def names(tree: Tree) -> list[str]:
    """For each leaf of `split`, in order, the name of its entry of θ, "theta['a']", however deep the leaf lies."""
    return [f"theta[{key!r}]" for key in sorted(tree) for _ in split(tree[key])[0]]


def joined(engine: Engine, join: Callable, values: Sequence[Any]) -> Tree:
    """The tree of `split` with new values for its leaves; all other arrays become constants of the engine."""
    return constants(join(values), engine, None)


def directions(values: Sequence[np.ndarray], seed: int = 1) -> list[np.ndarray]:
    """A random direction: an array of each value's shape."""
    rng = np.random.default_rng(seed)
    return [rng.standard_normal(v.shape) for v in values]


def claim_slope(gradient: np.ndarray, along: np.ndarray, slope: float, what: str, exact: float = 2e-3) -> None:
    """Fail unless a float32 gradient, times the direction `along`, is `slope`, a finite difference in float64.

    They may differ by the share `exact`.
    """
    product = float(np.sum(gradient * along))
    scale = max(abs(slope), np.linalg.norm(gradient) * np.linalg.norm(along) / np.sqrt(along.size), 1e-3)
    claim(
        abs(product - slope) <= exact * scale,
        f"{what} is {product:.6g}, but {slope:.6g} by finite differences; is something detached, or taken elsewhere?",
    )


class Derivatives(NamedTuple):
    """A function's value, the gradient of its product with given weights, and its derivative along a direction."""

    value: np.ndarray
    gradient: list[np.ndarray]
    along: np.ndarray


def derivatives(engine: Engine, f: Callable, at: list, along: list, weights: np.ndarray) -> Derivatives:
    """Value and derivatives, in both modes, of `f`, from a list of arrays to an array: float32, as NumPy arrays."""
    at, along, weights = on(engine, at), on(engine, along), on(engine, weights)
    xp = engine.namespace
    _, gradient = engine.value_and_grad(lambda x: xp.sum(f(x) * weights))(at)
    value, slope = engine.jvp(f, at, along)
    return Derivatives(*host(engine, (value, gradient, slope)))


def compiled(engine: Engine, f: Callable, at: Sequence, along: Sequence, weights: np.ndarray) -> Derivatives:
    """The result of `derivatives`, compiled as a whole if the engine compiles."""
    at, along, weights = on(engine, list(at)), on(engine, list(along)), on(engine, weights)
    xp = engine.namespace

    def both(x: list, d: list, w: Any) -> tuple:
        return engine.jvp(f, x, d), engine.value_and_grad(lambda y: xp.sum(f(y) * w))(x)[1]

    (value, slope), gradient = engine.jit(both)(at, along, weights)
    return Derivatives(*host(engine, (value, gradient, slope)))


def claim_consistent(result: Derivatives, along: list, weights: np.ndarray, what: str) -> None:
    """Fail unless forward and reverse mode agree: ⟨w, J d⟩ = ⟨Jᵀ w, d⟩."""
    claim_finite(result, f"{what} or its derivative")
    forward = float(np.sum(weights * result.along))
    reverse = float(sum(np.sum(g * d) for g, d in zip(result.gradient, along, strict=True)))
    scale = max(np.linalg.norm(result.along) * np.linalg.norm(weights), 1e-6)
    claim(
        abs(forward - reverse) <= 1e-4 * scale,
        f"forward mode gives {forward:.6g} for the derivative of {what}, reverse mode {reverse:.6g}",
    )


def claim_engines_agree(f: Callable, at: list, value: np.ndarray, what: str, way: Callable = compiled) -> None:
    """Fail unless every installed engine gives this value and the same derivatives, in both modes.

    Args:
        f: from a list of arrays to an array, in any engine.
        at: NumPy arrays.
        value: the value of `f`, by NumPy.
        what: name of the result, in words.
        way: `compiled`, which takes a fraction of the time in jax, or `derivatives`.
    """
    weights = np.random.default_rng(0).standard_normal(value.shape)
    along, first = directions(at), None
    for engine in installed():
        with no_error(f"{what} in {engine.name}"):
            result = way(engine, f, at, along, weights)
        claim_close(result.value, value, 1e-5, f"{what} in {engine.name}, against NumPy,")
        claim_consistent(result, along, weights, f"{what} in {engine.name}")
        first = first or result
        pairs = zip([result.along, *result.gradient], [first.along, *first.gradient], strict=True)
        for here, there in pairs:
            scale = 1e-4 * max(np.linalg.norm(there), 1e-3)
            claim(
                np.linalg.norm(here - there) <= scale,
                f"the derivative of {what} in {engine.name} differs from the other engine's by "
                f"{np.linalg.norm(here - there):.3g}, its norm is {np.linalg.norm(there):.3g}",
            )
