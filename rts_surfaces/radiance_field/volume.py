"""Volume rendering of radiance fields, with which surface light fields are compared."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from rts import Camera, InputError, engine_of
from rts.plugin_api.arrays import constants, map_leaves
from rts.plugin_api.checks import check_numbers, is_count, quoted
from rts_surfaces.radiance_field.chunks import CHUNK, fast_engine, in_chunks, progress_bar
from rts_surfaces.radiance_field.ndc import Ndc, checked_size
from rts_surfaces.radiance_field.network import density_and_radiance

RAYS = 512
"""Number of rays rendered at a time."""
BACKGROUNDS = {"white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0)}
LAST = 1e10
"""Length of the last interval of a ray, which has no end."""


class VolumeImage(NamedTuple):
    """A picture of a volume, and its cost.

    Attributes:
        image: (H, W, 3) RGB on the background, or (H, W, 4) premultiplied RGBA, encoded like the images that the
            field was trained on.
        coarse: number of points at which the coarse network was evaluated.
        fine: number of points at which the fine network was evaluated.
    """

    image: np.ndarray
    coarse: int
    fine: int


def volume_image(
    field: Any,
    camera: Camera,
    size: tuple[int, int],
    *,
    near: float | None,
    far: float | None,
    samples: tuple[int, int],
    background: Any,
    ndc: Ndc | None,
    progress: bool | None,
) -> VolumeImage:
    """See `RadianceField.volume_render`."""
    height, width = checked_size(size)
    near, far = _planes(near, far, ndc)
    color = None if background is None else _color(background)
    if not isinstance(camera, Camera):
        raise InputError(f"camera is {quoted(camera)}; expected an rts.Camera")
    if camera.is_stacked:
        raise InputError("camera is of several views; expected that of one: camera.unstack() gives them one by one")
    counts = tuple(samples) if isinstance(samples, (tuple, list)) else ()
    if len(counts) != 2 or not all(map(is_count, counts)) or counts[0] < 3:
        raise InputError(f"samples is {quoted(samples)}; expected (coarse, fine), at least 3 and 1")
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
    if color is not None:
        image = image[..., :3] + (1 - image[..., 3:]) * color
    return VolumeImage(image, done["coarse"], done["fine"])


def _planes(near: float | None, far: float | None, ndc: Ndc | None) -> tuple[float, float]:
    """The ray parameters t at which rays begin and end: depths, 2 and 6 by default, or 0 and 1 with `ndc`.

    Raises:
        InputError: `ndc` is no `Ndc`, or depths come with it; or not 0 < near < far.
    """
    if ndc is not None and not isinstance(ndc, Ndc):
        raise InputError(f"ndc is {quoted(ndc)}; expected an Ndc, or None")
    if ndc is not None and not near is far is None:
        raise InputError("near and far are given with ndc, whose rays run from its near plane to infinity; leave them")
    if ndc is not None:
        return 0.0, 1.0
    near, far = 2.0 if near is None else near, 6.0 if far is None else far
    check_numbers("near", near, ())
    check_numbers("far", far, ())
    if not 0 < near < far:
        raise InputError(f"near is {quoted(near)} and far is {quoted(far)}; expected near > 0 and near < far")
    return float(near), float(far)


def _color(background: Any) -> np.ndarray:
    """The colour (3,) float32 of "white", "black" or three numbers in [0, 1]; an InputError for all else."""
    if isinstance(background, str) and background not in BACKGROUNDS:
        raise InputError(f"background is {quoted(background)}; expected 'white', 'black' or a colour (3,)")
    value = BACKGROUNDS[background] if isinstance(background, str) else background
    color = check_numbers("background", value, (3,))
    if color is None or color.min() < 0 or color.max() > 1:
        raise InputError(f"background is {quoted(background)}; expected a colour (3,) of numbers from 0 to 1")
    return color.astype(np.float32)


def _evaluator(field: Any, name: str) -> Callable[..., np.ndarray]:
    """A function that evaluates the network "coarse" or "fine" at S points along each of R rays.

    It takes origins, directions, and unit directions in the world (R, 3) each, and t (R, S): points are
    `origin + t direction`. It returns colours and density (R, S, 4).
    """
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
    """Premultiplied RGBA (R, 4) of rays, and each sample's weight (R, S) in it.

    Args:
        radiance: (R, S, 4), colours and density of samples.
        t: (R, S), the samples' places along their rays, in increasing order.
        directions: (R, 3), of the length of one unit of t.
    """
    lengths = np.concatenate([np.diff(t, axis=1), np.full_like(t[:, :1], LAST)], axis=1)
    lengths = lengths * np.linalg.norm(directions, axis=1, keepdims=True)
    passed = np.exp(-radiance[..., 3] * lengths)
    before = np.cumprod(np.concatenate([np.ones_like(t[:, :1]), passed[:, :-1] + np.float32(1e-10)], axis=1), axis=1)
    weights = (1 - passed) * before
    rgb = np.sum(weights[..., None] * radiance[..., :3], axis=1)
    return np.concatenate([rgb, np.sum(weights, axis=1, keepdims=True)], axis=1), weights


def _placed(t: np.ndarray, weights: np.ndarray, count: int) -> np.ndarray:
    """Places t (R, count) at equal steps of the cumulative distribution of the weights (R, S) of samples at t (R, S).

    The samples' t increase. The first and the last weight do not count: S is at least 3.
    """
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
