"""The rigid pose of a model from one silhouette."""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from rts import registry
from rts.camera import Camera
from rts.cli.views import Bounds
from rts.engines import Engine, engine_named
from rts.errors import InputError, PluginError
from rts.fitting.fit import Fit, fit
from rts.fitting.image_residuals import ImageResiduals
from rts.fitting.least_squares import mean_square
from rts.fitting.schedule import Stage, box_filtered, pyramid
from rts.interfaces import Part
from rts.operations.linear import matmul
from rts.operations.rigid import rigid
from rts.trees import Array

LARGEST_SIDE = 256
"""Pixels of the longer side of the image that is fitted."""


class PoseFit(NamedTuple):
    """A recovered pose.

    Attributes:
        rotation: (3,) axis times angle, radians, about `center`.
        translation: (3,) world units.
        center: (3,) world.
        matrix: (4, 4), world from the model as loaded.
        trail: the best matrix so far, at each step.
        history: the loss at each step: mean square of the difference of silhouettes, at that step's resolution and
            blur.
        levels: how many steps were made at each stage, from coarse to fine.
        first_loss: the loss of the start at full resolution.
        loss: the lowest loss at full resolution.
        reason: why it stopped there.
        seconds: wall time.
    """

    rotation: np.ndarray
    translation: np.ndarray
    center: np.ndarray
    matrix: np.ndarray
    trail: list[np.ndarray]
    history: list[float]
    levels: list[int]
    first_loss: float
    loss: float
    reason: str
    seconds: float


def available_engine() -> str:
    """The name of an engine with derivatives that is installed, torch before jax."""
    preferred = ["torch", "jax"]
    others = [name for name in registry.plugins("rts.engines") if name not in preferred]
    for name in (*preferred, *others):
        if importlib.util.find_spec(name) is not None and engine_named(name).differentiates:
            return name
    raise PluginError("fitting needs torch or jax: pip install 'rasterize-then-splat[torch]' (or '…[jax]')")


def silhouette_of(image: np.ndarray) -> np.ndarray:
    """(H, W) float32 in [0, 1] of a picture (H, W, 4): its alpha, or its luminance where it is opaque.

    Raises:
        InputError: nothing, or everything, is inside.
    """
    alpha = image[..., 3]
    mask = alpha if (alpha < 1).any() else image[..., :3] @ np.array([0.2126, 0.7152, 0.0722], np.float32)
    if not mask.max() > 0.5 or not mask.min() < 0.5:
        raise InputError(
            f"the target's silhouette lies between {mask.min():.2g} and {mask.max():.2g}; expected a picture "
            f"with a transparent background, or a bright object on a dark one"
        )
    return np.ascontiguousarray(mask, np.float32)


def shrunk(mask: np.ndarray, largest: int) -> np.ndarray:
    """(h, w) box-filtered so that the longer side is at most `largest`."""
    size = Stage(min(1.0, largest / max(mask.shape))).size(mask.shape)
    return box_filtered(mask[..., None], size)[..., 0]


def fit_pose(
    parts: Sequence[Part],
    target: np.ndarray,
    camera: Camera,
    bounds: Bounds,
    *,
    engine: str | None = None,
    method: str = "lm",
    steps: int | None = None,
    progress: bool | None = None,
) -> PoseFit:
    """Turn and move a model until its silhouette is the target's, from coarse pixels to fine ones.

    Args:
        parts: the model, NumPy arrays; its pose as loaded is the start.
        target: (H, W) silhouette.
        camera: the camera of the target.
        bounds: those of the model; translations are fitted in units of its radius, so that they weigh like radians.
        engine: "torch" or "jax"; default whichever is installed.
        method: as in `rts.fit`.
        steps: at most so many at each resolution; default that of `rts.fit`.
        progress: see `rts.fit`.
    """
    chosen = _engine(engine or available_engine())
    weights = np.repeat([1.0, bounds.radius], 3)
    met: list[np.ndarray] = []

    def note(step: int, pose: Array, loss: float) -> None:
        met.append(chosen.to_numpy(pose).astype(np.float64) * weights)

    residuals = _residuals(parts, camera, target, bounds, weights, chosen)
    start, schedule = chosen.constant(np.zeros(6, np.float32)), pyramid(target.shape, largest=LARGEST_SIDE)
    result = fit(
        residuals,
        start,
        method=method,
        steps=steps,
        schedule=schedule,
        callback=note,
        progress=progress,
    )
    found = chosen.to_numpy(result.parameters).astype(np.float64) * weights
    trail = [_matrix(pose, bounds) for pose in (*_best_so_far(met, result), found)]
    levels = list(result.stages)
    return PoseFit(
        found[:3],
        found[3:],
        bounds.center,
        trail[-1],
        trail,
        result.history,
        levels,
        float(mean_square(residuals.at_stage(schedule[-1])(start))),
        result.loss,
        result.reason,
        result.seconds,
    )


def _best_so_far(met: list[np.ndarray], result: Fit) -> list[np.ndarray]:
    """The parameters with the lowest loss of each step and those before it at its stage.

    Levenberg–Marquardt reports rejected trials too.
    """
    found, first = [], 0
    for count in result.stages:
        losses = result.history[first : first + count]
        found += [met[first + min(range(k + 1), key=losses.__getitem__)] for k in range(count)]
        first += count
    return found


def _engine(name: str) -> Engine:
    """The engine of this name, which must have derivatives."""
    if name == "numpy":
        raise InputError("engine is 'numpy', which has no derivatives; expected torch or jax")
    return registry.plugin("rts.engines", name)()


def _residuals(
    parts: Sequence[Part], camera: Camera, target: np.ndarray, bounds: Bounds, weights: np.ndarray, engine: Engine
) -> ImageResiduals:
    def silhouettes(pose: Array) -> list[Part]:
        transform = rigid(pose * engine.constant(weights, pose), bounds.center)
        return posed(parts, transform, "silhouette")

    return ImageResiduals(silhouettes, camera, target.shape, target, layers=1, splatter="single")


def _matrix(pose: np.ndarray, bounds: Bounds) -> np.ndarray:
    return np.asarray(rigid(np.asarray(pose, np.float64), bounds.center))


def posed(parts: Sequence[Part], transform: Array, shader: Any = None) -> list[Part]:
    """The parts moved by a transform of the world, perhaps with another shader."""
    return [
        part.replace(
            transform=transform if part.transform is None else matmul(transform, part.transform),
            shader=shader or part.shader,
        )
        for part in parts
    ]
