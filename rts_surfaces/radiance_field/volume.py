"""Volume rendering of radiance fields, with which surface light fields are compared."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from rts import Camera, InputError, Ndc, engine_of
from rts.plugin_api.arrays import constants, map_leaves
from rts.plugin_api.checks import is_count, quoted
from rts_surfaces.radiance_field.chunks import CHUNK, fast_engine, in_chunks, progress_bar
from rts_surfaces.radiance_field.field import RadianceField
from rts_surfaces.radiance_field.network import density_and_radiance

RAYS = 512
"""Rays at a time."""
LAST = 1e10
"""Length of the last interval of a ray, which has no end."""


class VolumeImage(NamedTuple):
    """A picture of a volume, and its cost.

    Attributes:
        image: (H, W, 3) RGB on the background, or (H, W, 4) premultiplied RGBA, in the encoding of the network.
        coarse: evaluations of the coarse network.
        fine: evaluations of the fine network.
    """

    image: np.ndarray
    coarse: int
    fine: int


def volume_render(
    field: RadianceField,
    camera: Camera,
    size: tuple[int, int],
    *,
    planes: tuple[float, float],
    samples: tuple[int, int],
    background: np.ndarray | None,
    ndc: Ndc | None,
    progress: bool | None,
) -> VolumeImage:
    """The image, and the evaluations of both networks; see `rts.radiance_fields.volume_render`, which checks the rest.

    Args:
        field: the field.
        camera: a perspective camera.
        size: (height, width).
        planes: the parameters of rays at which they begin and end.
        samples: of the coarse and the fine network, along each ray.
        background: a colour (3,), or None for transparency.
        ndc: the map to the field's space, or None.
        progress: True to show a progress bar.
    """
    if not isinstance(field, RadianceField):
        raise InputError(f"field is {quoted(field)}; expected what rts.load_radiance_field gives")
    if not isinstance(camera, Camera):
        raise InputError(f"camera is {quoted(camera)}; expected an rts.Camera")
    if camera.is_stacked:
        raise InputError("camera is of several views; expected that of one: camera.unstack() gives them one by one")
    counts = tuple(samples) if isinstance(samples, (tuple, list)) else ()
    if len(counts) != 2 or not all(map(is_count, counts)) or counts[0] < 3:
        raise InputError(f"samples is {quoted(samples)}; expected (coarse, fine), at least 3 and 1")
    (height, width), (near, far) = size, planes
    camera = map_leaves(engine_of(camera).to_numpy, camera)
    if camera.for_size((height, width)).projection[3, 2] == 0:
        raise InputError("the camera is orthographic; volumes are drawn by perspective ones")
    rays = camera.rays((height, width))
    origins, directions = (np.reshape(x, (-1, 3)) for x in (rays.origins, rays.directions))
    viewed = (directions / np.linalg.norm(directions, axis=1, keepdims=True)).astype(np.float32)
    if ndc is not None:
        origins, directions = ndc.rays(origins, directions)
    origins, directions = origins.astype(np.float32), directions.astype(np.float32)

    coarse, fine = (_evaluator(field, name) for name in ("coarse", "fine"))
    image = np.empty((height * width, 4), np.float32)
    done = {"coarse": 0, "fine": 0}
    with progress_bar(progress, "volume rendering", height * width) as advance:
        for start in range(0, height * width, RAYS):
            some = slice(start, min(start + RAYS, height * width))
            o, d, v = origins[some], directions[some], viewed[some]
            t = np.broadcast_to(np.linspace(near, far, counts[0], dtype=np.float32), (len(o), counts[0]))
            weights = _composited(coarse(o, d, v, t), t, d)[1]
            t = np.sort(np.concatenate([t, _placed(t, weights, counts[1])], axis=1), axis=1)
            image[some] = _composited(fine(o, d, v, t), t, d)[0]
            done["coarse"] += len(o) * counts[0]
            done["fine"] += t.size
            advance(len(o))
    image = image.reshape(height, width, 4)
    if background is not None:
        image = image[..., :3] + (1 - image[..., 3:]) * background
    return VolumeImage(image, done["coarse"], done["fine"])


def _evaluator(field: RadianceField, name: str) -> Callable[..., np.ndarray]:
    """A function of origins, directions, unit directions (R, 3) and depths (R, S): colours and density (R, S, 4)."""
    engine = fast_engine()
    weights = constants(field.on_host()[name], engine, None)
    xp = engine.namespace

    def rows(points: Any, directions: Any) -> Any:
        sigma, rgb = density_and_radiance(weights, points, directions)
        return xp.concat([rgb, sigma[:, None]], axis=1)

    def call(o: np.ndarray, d: np.ndarray, v: np.ndarray, t: np.ndarray) -> np.ndarray:
        points = (o[:, None] + t[..., None] * d[:, None]).reshape(-1, 3)
        directions = np.repeat(v, t.shape[1], axis=0)
        radiance = in_chunks(rows, CHUNK, engine.constant(points), engine.constant(directions))
        return engine.to_numpy(radiance).reshape(*t.shape, 4)

    return call


def _composited(radiance: np.ndarray, t: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Premultiplied RGBA (R, 4), and the weight of each sample (R, S)."""
    lengths = np.concatenate([np.diff(t, axis=1), np.full_like(t[:, :1], LAST)], axis=1)
    lengths = lengths * np.linalg.norm(directions, axis=1, keepdims=True)
    passed = np.exp(-radiance[..., 3] * lengths)
    before = np.cumprod(np.concatenate([np.ones_like(t[:, :1]), passed[:, :-1] + np.float32(1e-10)], axis=1), axis=1)
    weights = (1 - passed) * before
    rgb = np.sum(weights[..., None] * radiance[..., :3], axis=1)
    return np.concatenate([rgb, np.sum(weights, axis=1, keepdims=True)], axis=1), weights


def _placed(t: np.ndarray, weights: np.ndarray, count: int) -> np.ndarray:
    """Depths (R, count) at equal steps of the distribution that the weights (R, S) of samples at t (R, S) make."""
    edges = (t[:, 1:] + t[:, :-1]) / 2
    share = weights[:, 1:-1] + np.float32(1e-5)
    total = np.cumsum(share / share.sum(axis=1, keepdims=True), axis=1)
    total = np.concatenate([np.zeros_like(total[:, :1]), total], axis=1)
    wanted = np.linspace(0, 1, count, dtype=np.float32)
    above = np.sum(total[:, :, None] <= wanted, axis=1)
    low, high = np.maximum(above - 1, 0), np.minimum(above, total.shape[1] - 1)
    start, end = np.take_along_axis(total, low, 1), np.take_along_axis(total, high, 1)
    width = np.where(end - start < 1e-5, np.float32(1), end - start)
    a, b = np.take_along_axis(edges, low, 1), np.take_along_axis(edges, high, 1)
    return a + (wanted - start) / width * (b - a)
