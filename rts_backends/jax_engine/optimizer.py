"""Optimisers of optax as step functions, for `rts.fit`."""

from __future__ import annotations

import io
import itertools
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
import optax

from rts import InputError
from rts.plugin_api.arrays import Tree, map_leaves


class Optimizer:
    """A step function `(parameters, gradient) -> parameters` of an optax transformation.

    Args:
        method: "adam", "sgd", or an `optax.GradientTransformation`.
        rates: the learning rate, or a list of one for each array, for a method by name.
        parameters: where to start.

    Raises:
        InputError: the transformation needs more than parameters and gradients, such as the loss.
    """

    def __init__(self, method: str | optax.GradientTransformation, rates: float | Sequence[float], parameters: Tree):
        transform: Any = {"adam": optax.adam, "sgd": optax.sgd}[method](1.0) if isinstance(method, str) else method
        self._state = transform.init(parameters)
        try:
            jax.eval_shape(transform.update, parameters, self._state, parameters)
        except TypeError as error:
            if "keyword-only" not in str(error):
                raise
            raise InputError(
                f"method, an optax transformation, needs more than the gradient ({error}), as optax.lbfgs and "
                "optax.polyak_sgd do; give one that does not, such as optax.adam(1e-2), or 'lm'"
            ) from error

        @jax.jit
        def update(parameters: Tree, gradient: Tree, state: Any) -> tuple[Tree, Any]:
            updates, state = transform.update(gradient, state, parameters)
            if isinstance(method, str):
                scale = iter(rates) if isinstance(rates, Sequence) else itertools.repeat(rates)
                updates = map_leaves(lambda x: next(scale) * x, updates)
            return optax.apply_updates(parameters, updates), state

        self._update = update

    def __call__(self, parameters: Tree, gradient: Tree) -> Tree:
        """The parameters after a step."""
        parameters, self._state = self._update(parameters, gradient, self._state)
        return parameters

    def state(self) -> bytes:
        """The arrays of the transformation's state, as `numpy.savez` writes them."""
        file = io.BytesIO()
        np.savez(file, *map(np.asarray, jax.tree.leaves(self._state)))
        return file.getvalue()

    def restore(self, state: bytes, parameters: Tree) -> None:
        """Go on from a `state`; `parameters` are not read, since each step is given them.

        Raises:
            InputError: the state is damaged, or of another transformation.
        """
        expected = [*map(np.asarray, jax.tree.leaves(self._state))]
        try:
            with np.load(io.BytesIO(state), allow_pickle=False) as file:
                arrays = [file[f"arr_{i}"] for i in range(len(file.files))]
        except Exception:  # Of which damaged archives raise many kinds.
            arrays = []
        same = [(x.shape, x.dtype) for x in arrays] == [(x.shape, x.dtype) for x in expected]
        if not same or not all((np.isfinite(x) | ~np.isfinite(y)).all() for x, y in zip(arrays, expected, strict=True)):
            raise InputError("the state of its optimiser is damaged, or of another optimiser")
        self._state = jax.tree.unflatten(jax.tree.structure(self._state), [*map(jax.numpy.asarray, arrays)])
