"""How much of a point is seen from a camera: pictures of depth, compared with points of any surface.

Pictures are of samples without derivative, evaluated with derivatives: see `rts.operations.coverage`.
"""

from __future__ import annotations

import functools
import operator
from collections.abc import Sequence
from typing import Any

from rts.arrays.argument_checks import quoted
from rts.arrays.array_functions import described, from_numbers, shape_of
from rts.arrays.engines import context_of, namespace, stopped
from rts.arrays.trees import Array, record
from rts.contracts.checks import is_real
from rts.errors import InputError
from rts.operations.coverage import coverage, is_inside
from rts.operations.depth_planes import depth_planes
from rts.scene.camera import Camera


@record(static=("size", "opaque"))
class DepthPicture:
    """The samples that a camera sees in front, and their planes; with `REACH` cells around the picture.

    Attributes:
        camera: the camera. Differentiable.
        samples: (M, 3), see `rts.operations.coverage`. Differentiable.
        row: (K, H, W), likewise, of K layers.
        planes: (K, 9, H, W), likewise.
        lens: (5,), likewise.
        size: (height, width) of the picture.
        opaque: whether the samples let no light through.
    """

    camera: Camera
    samples: Array
    row: Array
    planes: Array
    lens: Array
    size: tuple[int, int]
    opaque: bool


@record()
class Seen:
    """A scene as it is seen from a place: the result of `rts.shadows.seen_from`, and a pytree of every engine.

    Attributes:
        pictures: what is seen, in one picture or several. A point is seen if no picture hides it.
    """

    pictures: tuple[DepthPicture, ...]


def visibility(seen: Seen, points: Array, outside: float = 0.0) -> Array:
    """The share of each point that is seen, 0 to 1: of its surroundings, a few pixels of `seen` wide.

    It is differentiable in the points, and in all that `seen` was made of. Derivatives are of first order.

    Args:
        seen: the result of `rts.shadows.seen_from`.
        points: (N, 3) world.
        outside: the result for points outside of all pictures, or behind the camera.

    Returns:
        (N,) of the engine of `seen` and points.

    Raises:
        InputError: an argument is of another kind or shape.
    """
    if not isinstance(seen, Seen):
        raise InputError(f"seen is {quoted(seen)}; expected what rts.shadows.seen_from gave")
    points = from_numbers(points, "points")
    if len(shape_of(points)) != 2 or shape_of(points)[1] != 3:
        raise InputError(f"points {described(points)}; expected (N, 3)")
    if not is_real(outside) or not 0 <= outside <= 1:
        raise InputError(f"outside is {quoted(outside)}; expected a number from 0 to 1")
    context = context_of(seen, points)
    seen, points = context.constants((seen, points))
    xp = namespace(points)
    shares, inside = [], xp.zeros_like(points[:, 0], dtype=xp.bool)
    for picture in seen.pictures:
        placed = xp.astype(picture.camera.project(points, picture.size), picture.samples.dtype, copy=False)
        for layer in range(picture.row.shape[0]):
            layers = picture.row[layer, ...], picture.planes[layer, ...]
            shares.append(1 - coverage(picture.samples, placed, *layers, picture.lens, picture.opaque))
        if outside != 1:
            inside = inside | is_inside(stopped(placed), picture.size, picture.lens)
    share = functools.reduce(operator.mul, shares)[:, 0] if shares else xp.ones_like(points[:, 0])
    share = xp.astype(share, xp.result_type(share, points), copy=False)
    return share if outside == 1 else xp.where(inside, share, outside)


def mean_visibility(seen: Seen | Sequence[Seen] | None, points: Array) -> Any:
    """The visibility (N, 1) of a lamp at points: the mean over several records; 1.0 for None. Outside all is seen."""
    if seen is None:
        return 1.0
    records = [seen] if isinstance(seen, Seen) else seen
    several = [visibility(one, points, outside=1.0)[:, None] for one in records]
    return several[0] if len(several) == 1 else functools.reduce(operator.add, several) / len(several)


def picture_of(
    depth: Array, samples: Array, row: Array, camera: Camera, size: tuple[int, int], opaque: bool
) -> DepthPicture:
    """The picture of samples in their cells.

    Args:
        depth: (K, H, W) linear depth of the samples, without derivative.
        samples: see `DepthPicture`; one row may stand for all.
        row: (K, H, W) the sample of each cell and layer, or −1; with `REACH` cells around the picture.
        camera: the camera, in arrays of the engine; differentiable.
        size: (height, width) of the picture.
        opaque: see `DepthPicture`.
    """
    xp, lens = namespace(depth), _lens(stopped(camera), depth, size)
    of_layers = [depth_planes(depth[k, ...], row[k, ...], lens) for k in range(row.shape[0])]
    planes = of_layers[0][None, ...] if len(of_layers) == 1 else xp.stack(of_layers)
    if samples.shape[0] == 1:
        row = xp.clip(row, None, 0)
    return DepthPicture(camera, samples, row, planes, lens, size, opaque)


def _lens(camera: Camera, depth: Array, size: tuple[int, int]) -> Array:
    """See `depth_planes`; even depths count from the farthest sample."""
    xp, p, (near, _) = namespace(depth), camera.projection, camera.depth_range()
    origin = xp.clip(xp.max(depth), near, None)  # Empty cells have a depth of 0.
    width = 2 / xp.sqrt(size[0] * size[1] * xp.abs(p[0, 0] * p[1, 1] - p[0, 1] * p[1, 0]))
    lens = p[3, 3], -p[3, 2], origin, near, width * (p[3, 3] - p[3, 2] * origin)
    return xp.astype(xp.stack(lens), depth.dtype, copy=False)
