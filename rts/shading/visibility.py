"""How much of a point is seen from a camera: pictures of depth, compared with points of any surface.

Pictures are of samples without derivative, evaluated with derivatives: see `rts.operations.coverage`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rts.arrays.argument_checks import quoted
from rts.arrays.array_functions import described, from_numbers, shape_of
from rts.arrays.engines import context_of, namespace, stopped
from rts.arrays.trees import Array, record
from rts.contracts.checks import is_real
from rts.errors import InputError
from rts.operations.coverage import coverage, even_depth, is_inside
from rts.operations.depth_planes import depth_planes
from rts.scene.camera import Camera


@record(static=("size",))
class Picture:
    """The samples that a camera sees in front, and their planes; with `REACH` cells around the picture.

    Attributes:
        camera: the camera. Differentiable.
        cells: (K, H · W, 2 or 3), see `rts.operations.coverage`, of K layers. Differentiable.
        planes: (K, H, W, 8), likewise.
        lens: (4,), see `rts.operations.coverage`.
        size: (height, width) of the picture.
    """

    camera: Camera
    cells: Array
    planes: Array
    lens: Array
    size: tuple[int, int]


@record()
class Seen:
    """A scene as it is seen from a place: the result of `rts.shadows.seen_from`, and a pytree of every engine.

    Attributes:
        pictures: what is seen, in one picture or several. A point is seen if no picture hides it.
    """

    pictures: tuple[Picture, ...]


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
    share, inside = xp.ones_like(points[:, 0]), xp.zeros_like(points[:, 0], dtype=xp.bool)
    for picture in seen.pictures:
        placed = xp.astype(picture.camera.project(points, picture.size), picture.cells.dtype, copy=False)
        for layer in range(picture.cells.shape[0]):
            hidden = coverage(picture.cells[layer, ...], placed, picture.planes[layer, ...], picture.lens)
            share = share * (1 - hidden[:, 0])
        if outside != 1:
            inside = inside | is_inside(stopped(placed), picture.size, picture.lens)
    return share if outside == 1 else xp.where(inside, share, outside)


def mean_visibility(seen: Seen | Sequence[Seen] | None, points: Array) -> Any:
    """The visibility (N, 1) of a lamp at points: the mean over several records; 1.0 for None. Outside all is seen."""
    if seen is None:
        return 1.0
    records = [seen] if isinstance(seen, Seen) else seen
    total: Any = sum(visibility(one, points, outside=1.0) for one in records)
    return total[:, None] / len(records)


def picture_of(
    depth: Array, moving: Array | None, alpha: Array | None, row: Array, camera: Camera, size: tuple[int, int]
) -> Picture:
    """The picture of samples in their cells.

    Args:
        depth: (K, H, W) linear depth, without derivative; anything where a cell has no sample.
        moving: (K, H, W, 2) x and y of samples, of which only derivatives count; None if nothing moves.
        alpha: (K, H, W, 1) of samples, differentiable; None if they are opaque.
        row: (K, H, W) the sample of each cell and layer, or −1; with `REACH` cells around the picture.
        camera: the camera, in arrays of the engine; differentiable.
        size: (height, width) of the picture.
    """
    xp, there, still = namespace(depth), row >= 0, stopped(camera)
    count = xp.sum(xp.astype(there, depth.dtype))
    middle = xp.where(count > 0, xp.sum(xp.where(there, depth, 0.0)) / xp.where(count > 0, count, 1.0), 1.0)
    lens = _lens(still, middle)
    depth = xp.where(there, depth, middle)
    even, unit = even_depth(depth, lens), _even_width(depth, still, lens, size)
    unit, layers = xp.where(there, unit, 0.0), range(row.shape[0])
    of_layers = [depth_planes(even[k, ...], unit[k, ...]) for k in layers]
    planes = of_layers[0][None, ...] if len(of_layers) == 1 else xp.stack(of_layers)
    cells: Array = xp.zeros_like(planes[..., :2]) if moving is None else moving
    cells = cells if alpha is None else xp.concat([cells, alpha], axis=-1)
    return Picture(camera, xp.reshape(cells, (row.shape[0], -1, cells.shape[-1])), planes, lens, size)


def _lens(camera: Camera, middle: Array) -> Array:
    """See `rts.operations.coverage`; `middle` is the depth that even depths count from."""
    xp, p, (near, _) = namespace(middle), camera.projection, camera.depth_range()
    return xp.astype(xp.stack([p[3, 3], -p[3, 2], middle, near]), middle.dtype, copy=False)


def _even_width(depth: Array, camera: Camera, lens: Array, size: tuple[int, int]) -> Array:
    """The even depth of a cell's width at depths."""
    p, xp = camera.projection, namespace(depth)
    width = 2 / xp.sqrt(size[0] * size[1] * xp.abs(p[0, 0] * p[1, 1] - p[0, 1] * p[1, 0]))
    return width * (lens[0] + lens[1] * lens[2]) / (lens[0] + lens[1] * depth)
