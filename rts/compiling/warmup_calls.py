"""Ordinary calls on small pictures, each made by `python -m rts.compiling.warmup_calls NAME` to compile loops."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

import numpy as np

import rts

SIZE = (24, 32)


def camera() -> rts.Camera:
    """A camera that sees both octahedra."""
    return rts.Camera.look_at((0.3, 0.8, 3), (0, 0, 0), fov_y=40)


def octahedra() -> list[rts.Part]:
    """Two octahedra that pass through one another; one is shaded, the other a silhouette."""
    corners = np.concatenate([np.eye(3), -np.eye(3)]).astype(np.float32)
    faces = [(0, 1, 2), (1, 3, 2), (3, 4, 2), (4, 0, 2), (1, 0, 5), (3, 1, 5), (4, 3, 5), (0, 4, 5)]
    surface = rts.Mesh(np.array(faces))
    color = np.array([0.2, 0.5, 0.8], np.float32)
    theta = [{"vertices": corners * 0.9, "color": color}, {"vertices": corners[:, ::-1] * 0.7 + 0.3, "color": color}]
    return [rts.Part(surface, each, shader) for each, shader in zip(theta, ("lambert", "silhouette"), strict=True)]


def engine() -> Any:
    """A function that makes arrays of torch, or else jax, and one (f, x) → ∂f/∂x; None where neither is installed."""
    try:
        import torch
    except ImportError:
        try:
            import jax
        except ImportError:
            return None
        return jax.numpy.asarray, lambda function, x: jax.grad(function)(x)

    def gradient(function: Callable, x: Any) -> Any:
        x = x.clone().requires_grad_()
        return torch.autograd.grad(function(x), x)

    return torch.as_tensor, gradient


def picture() -> None:
    """Render without derivatives."""
    rts.render(octahedra()[0], camera(), SIZE)


def gradient_of_vertices() -> None:
    """Differentiate a picture of one part in its vertices, and another in its pose, by torch, or else by jax.

    Does nothing if neither is installed.
    """
    part = octahedra()[0]
    if (found := engine()) is not None:
        array, gradient = found
        gradient(
            lambda v: rts.render(part.replace(theta={**part.theta, "vertices": v}), camera(), SIZE).mean(),
            array(part.theta["vertices"]),
        )
        _gradient_of_poses([part])


def gradient_of_crossing() -> None:
    """Differentiate a picture of two parts, and one of a silhouette, in the parts' pose."""
    for parts in (octahedra(), [octahedra()[1]]):
        _gradient_of_poses(parts)


def least_squares() -> None:
    """Make a step of Levenberg–Marquardt for a pose."""
    _step(octahedra()[0], np.zeros((*SIZE, 4), np.float32))


def least_squares_of_mask() -> None:
    """Make a step of Levenberg–Marquardt for a silhouette."""
    _step(octahedra()[1], np.zeros(SIZE, np.float32))


def _gradient_of_poses(parts: list[rts.Part]) -> None:
    if (found := engine()) is not None:
        array, gradient = found

        def mean(pose: Any) -> Any:
            return rts.render([part.replace(transform=rts.rigid(pose)) for part in parts], camera(), SIZE).mean()

        gradient(mean, array(np.zeros(6, np.float32)))


def _step(part: rts.Part, target: np.ndarray) -> None:
    if (found := engine()) is not None:
        residuals = rts.ImageResiduals(lambda pose: part.replace(transform=rts.rigid(pose)), camera(), SIZE, target)
        rts.fit(residuals, found[0](np.full(6, 0.01, np.float32)), method="lm", steps=1, progress=False)


if __name__ == "__main__":
    globals()[sys.argv[1]]()
