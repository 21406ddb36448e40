"""Engines by which results are computed: NumPy, torch, and jax, eager and compiled."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np


def map_arrays(function: Callable, tree: Any) -> Any:
    """A tree of dicts and lists with `function` applied to its arrays."""
    if isinstance(tree, dict):
        return {key: map_arrays(function, value) for key, value in tree.items()}
    return [map_arrays(function, x) for x in tree] if isinstance(tree, list) else function(tree)


def named_arrays(tree: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """The arrays of a tree of dicts and lists, each with its path."""
    if not isinstance(tree, (dict, list)):
        yield prefix, tree
        return
    for key, value in tree.items() if isinstance(tree, dict) else enumerate(tree):
        yield from named_arrays(value, f"{prefix}.{key}" if prefix else str(key))


class NumPy:
    """The functions needed of an engine: arrays, samples, and images with their gradients."""

    name, key = "numpy", "numpy"

    def array(self, x: np.ndarray) -> Any:
        return x

    def host(self, x: Any) -> np.ndarray:
        return np.asarray(x)

    def pinned(self, x: Any, value: np.ndarray) -> Any:
        """The value with the derivatives of x."""
        return value

    def sampled(self, function: Callable, variables: Any) -> Any:
        """The function of arrays of the engine."""
        return function(map_arrays(self.array, variables))

    def image_and_gradient(self, function: Callable, variables: Any, weights: np.ndarray) -> tuple[Any, Any]:
        """Image (H, W, 4), and the gradient of Σ weights · image in the variables, None where there is none."""
        return function(variables), None


class Torch(NumPy):
    """Eager torch."""

    name, key = "torch", "torch"

    def array(self, x):
        import torch

        return torch.from_numpy(np.array(x))

    def host(self, x):
        return x.detach().cpu().numpy()

    def pinned(self, x, value):
        return self.array(value) + (x - x.detach())

    def image_and_gradient(self, function, variables, weights):
        import torch

        arrays = map_arrays(lambda x: self.array(x).requires_grad_(True), variables)
        image = function(arrays)
        (image * self.array(weights)).sum().backward()
        return image, map_arrays(lambda x: torch.zeros_like(x) if x.grad is None else x.grad, arrays)


class Jax(NumPy):
    """jax, operation by operation."""

    name, key = "jax", "jax eager"

    def array(self, x):
        import jax.numpy as jnp

        return jnp.asarray(x)

    def pinned(self, x, value):
        import jax

        return self.array(value) + (x - jax.lax.stop_gradient(x))

    def compiled(self, function: Callable) -> Callable:
        return function

    def sampled(self, function, variables):
        return self.compiled(function)(map_arrays(self.array, variables))

    def image_and_gradient(self, function, variables, weights):
        import jax

        def total(arrays):
            image = function(arrays)
            return (image * weights).sum(), image

        derived = self.compiled(jax.value_and_grad(total, has_aux=True))
        (_, image), gradient = derived(map_arrays(self.array, variables))
        return image, gradient


class JaxJit(Jax):
    """jax, compiled as a whole."""

    key = "jax jit"

    def compiled(self, function):
        import jax

        return jax.jit(function)


ENGINES = (NumPy(), Torch(), Jax(), JaxJit())
