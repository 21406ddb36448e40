"""The rigid pose of a model from one silhouette."""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from rts import Camera, Engine, ImageResiduals, Part, Stage, engine_of, fit, namespace, plugin, plugins, pyramid, rigid
from rts.errors import InputError, PluginError
from rts.plugin_api.arrays import Array
from rts.results import Fit
from rts.tool_api.pictures import box_filtered, encode_srgb
from rts.tool_api.plugins import engine_named
from rts.tool_api.scenes import Bounds
from rts_cli.pose_file import ModelPose, posed

LARGEST_SIDE = 256
"""Number of pixels of the longer side of the fitted image."""


class PoseFit(NamedTuple):
    """A recovered pose.

    Attributes:
        rotation: (3,) axis times angle, radians, about `center`.
        translation: (3,) world units.
        center: (3,) world.
        trail: the best pose so far of its stage, at each step; then, as a last entry, the result.
        start: the pose of the model as loaded, with the given camera.
        first_loss: the loss of the start at full resolution.
        fit: the fit. Its losses are mean squares of the difference of silhouettes, or robust losses of it, each at its
            stage's resolution and blur; stages go from coarse to fine.
    """

    rotation: np.ndarray
    translation: np.ndarray
    center: np.ndarray
    trail: list[ModelPose]
    start: ModelPose
    first_loss: float
    fit: Fit

    @property
    def pose(self) -> ModelPose:
        """The recovered pose, and its camera."""
        return self.trail[-1]


def available_engine() -> str:
    """The name of an installed engine with derivatives, torch before jax; a PluginError if there is none."""
    preferred = ["torch", "jax"]
    others = [name for name in plugins("rts.engines") if name not in preferred]
    for name in (*preferred, *others):
        if importlib.util.find_spec(name) is not None and engine_named(name).differentiates:
            return name
    raise PluginError("fitting needs torch or jax: pip install 'rasterize-then-splat[torch]' (or '…[jax]')")


def silhouette_of(image: np.ndarray) -> np.ndarray:
    """The silhouette (H, W) float32 in [0, 1] of a picture (H, W, 4): its alpha, or, if it is opaque, its brightness.

    Brightness is of colours as files have them: 128 of 255 in a mask means that half of a pixel is inside.

    Raises:
        InputError: no pixel, or every pixel, is inside; above 0.5 is inside.
    """
    alpha = image[..., 3]
    luma = np.array([0.2126, 0.7152, 0.0722], np.float32)
    mask = alpha if (alpha < 1).any() else encode_srgb(image[..., :3]) @ luma
    if not mask.max() > 0.5 or not mask.min() < 0.5:
        raise InputError(
            f"the target's silhouette lies between {mask.min():.2g} and {mask.max():.2g}; expected a picture "
            f"with a transparent background, or a bright object on a dark one"
        )
    return np.ascontiguousarray(mask, np.float32)


def shrunk(mask: np.ndarray, largest: int) -> np.ndarray:
    """A mask (h, w), box-filtered so that its longer side is at most `largest`."""
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
    fit_fov: bool = False,
    loss: str = "linear",
    f_scale: float | None = None,
    progress: bool | None = None,
) -> PoseFit:
    """Fit rotation and translation of a model to a target silhouette, from coarse pixels to fine ones.

    The field of view is fitted as the logarithm of the focal length over that of `camera`.

    Args:
        parts: the model, NumPy arrays; its pose as loaded is the start.
        target: (H, W) silhouette.
        camera: the camera of the target, float64 NumPy and perspective, with its ratio of width to height.
        bounds: the bounds of the model; translations are fitted in units of their radius, to weigh like radians.
        engine: "torch" or "jax"; by default the one that is installed, torch before jax.
        method: as in `rts.fit`.
        steps: the largest number of steps at each resolution; by default that of `rts.fit`.
        fit_fov: whether the camera's field of view is fitted, too.
        loss: as in `rts.ImageResiduals`.
        f_scale: as in `rts.ImageResiduals`.
        progress: see `rts.fit`.
    """
    engine_object = _engine(engine or available_engine())
    weights = np.concatenate([np.repeat([1.0, bounds.radius], 3), np.ones(int(fit_fov))])
    visited: list[np.ndarray] = []

    def note(step: int, unknowns: Array, loss: float) -> None:
        visited.append(engine_object.to_numpy(unknowns).astype(np.float64) * weights)

    residuals = _residuals(parts, camera, target, bounds, weights, engine_object, loss=loss, f_scale=f_scale)
    start = engine_object.constant(np.zeros(len(weights), np.float32))
    schedule = pyramid(target.shape, largest=LARGEST_SIDE)
    result = fit(residuals, start, method=method, steps=steps, schedule=schedule, callback=note, progress=progress)
    solution = engine_object.to_numpy(result.parameters).astype(np.float64) * weights
    trail = [_pose(unknowns, bounds, camera, target.shape) for unknowns in (*_best_so_far(visited, result), solution)]
    return PoseFit(
        solution[:3],
        solution[3:6],
        bounds.center,
        trail,
        ModelPose(np.eye(4), camera, target.shape),
        float(residuals.loss(residuals.at_stage(schedule[-1])(start))),
        result,
    )


def _best_so_far(visited: list[np.ndarray], result: Fit) -> list[np.ndarray]:
    """For each step, the parameters, of those `visited` at each step, with the lowest loss so far at its stage.

    Levenberg–Marquardt reports rejected trials, too.
    """
    best, first = [], 0
    for count in result.stages:
        losses = result.history[first : first + count]
        best += [visited[first + min(range(k + 1), key=losses.__getitem__)] for k in range(count)]
        first += count
    return best


def _engine(name: str) -> Engine:
    """The engine with this name; it must have derivatives."""
    if name == "numpy":
        raise InputError("engine is 'numpy', which has no derivatives; expected torch or jax")
    return plugin("rts.engines", name)()


def _residuals(
    parts: Sequence[Part],
    camera: Camera,
    target: np.ndarray,
    bounds: Bounds,
    weights: np.ndarray,
    engine: Engine,
    **options: Any,
) -> ImageResiduals:
    def silhouettes(unknowns: Array) -> tuple[list[Part], Camera]:
        unknowns = unknowns * engine.constant(weights, unknowns)
        return posed(parts, rigid(unknowns[:6], bounds.center), "silhouette"), _zoomed(camera, unknowns[6:])

    return ImageResiduals(silhouettes, None, target.shape, target, layers=1, splatter="single", **options)


def _pose(unknowns: np.ndarray, bounds: Bounds, camera: Camera, size: tuple[int, int]) -> ModelPose:
    return ModelPose(np.asarray(rigid(unknowns[:6], bounds.center)), _zoomed(camera, unknowns[6:]), size)


def _zoomed(camera: Camera, focal: Array) -> Camera:
    """The camera with its focal length times exp(`focal`), for `focal` (1,); unchanged for (0,)."""
    if not len(focal):
        return camera
    xp = namespace(focal)
    factor, one = xp.exp(focal), xp.ones_like(focal)
    projection = engine_of(focal).constant(camera.projection, focal)
    return camera.replace(projection=projection * xp.concat([factor, factor, one, one]))
