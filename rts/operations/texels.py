"""Bilinear lookups in tables of texels, of one image or of several, one after the other, at points or over footprints.

The mean M of an image over a parallelogram with the sides a and b changes along a by the difference of its means over
the two sides along b, and likewise along b: so ∇M · a and ∇M · b are known without the image's own slopes, which of
texels smaller than the footprint say nothing of M.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from rts.arrays.engines import engine_of, namespace, stopped
from rts.arrays.trees import Array
from rts.errors import InputError
from rts.operations.operation import Operation

CORNERS = ((0, 0), (0, 1), (1, 0), (1, 1))
"""The four texels of a lookup: down and right."""


def texels(
    table: Array,
    uv: Array,
    sizes: Sequence[tuple[int, ...]],
    image: Array | None = None,
    wrap: tuple[str, str] = ("repeat", "repeat"),
    filter: str = "linear",
    footprint: Array | None = None,
) -> Array:
    """Bilinear lookups (N, C), differentiable in the table and in uv.

    Over a footprint they are the mean of lookups at one place along a side of up to half a texel, at two along one of
    up to three texels, at four up to six, and at eight beyond, if there are at most 16 of all. The derivative in uv is
    that of the footprint's mean, by as many lookups along each of its sides; where a side has one lookup, by the mean
    of the slopes there.

    Args:
        table: (M, C) float, the texels of all images, row by row, the uppermost first.
        uv: (N, 2) float, u to the right and v up; (0, 0) is the lower left corner of an image.
        sizes: (height, width) of each image, in their order in the table.
        image: (N,) integers, which image each lookup is of, from 0 on; None for the first.
        wrap: continuations outside [0, 1] along u and v: "repeat" or "mirror"; any other text is "clamp".
        filter: "nearest" takes the texel around a point, without derivative in uv; "linear" does not.
        footprint: (N, 4) float, the sides of the parallelogram around each place, in u and v: (∂u/∂x, ∂v/∂x, ∂u/∂y,
            ∂v/∂y); constant. None for points. One that is infinite or NaN is a point.
    """
    xp = namespace(table, uv)
    if not xp.isdtype(uv.dtype, "real floating"):
        uv = xp.astype(uv, table.dtype)
    number = uv[:0, 0] if image is None else image
    over = stopped(uv[:0, :]) if footprint is None else xp.astype(footprint, uv.dtype, copy=False)
    options: dict[str, Any] = {"sizes": tuple(sizes), "wrap": wrap, "filter": filter}
    return TEXELS(table, uv, xp.astype(number, xp.int32), over, **options)


def _specification(
    table: Array,
    uv: Array,
    image: Array,
    footprint: Array,
    *,
    sizes: tuple[tuple[int, ...], ...],
    wrap: tuple[str, str],
    filter: str,
) -> Array:
    options: dict[str, Any] = {"sizes": sizes, "wrap": wrap, "filter": filter}
    if not footprint.shape[0]:
        return _points(table, uv, image, **options)[0]
    from rts.operations.texels_means import means

    height, width = places(uv, image, sizes)[:2]

    def looked_up(place: Array, number: Array) -> tuple[Array, Array, Array]:
        return _points(table, place, number, **options)

    return means(looked_up, uv, image, footprint, height, width, filter == "nearest")


def places(uv: Array, image: Array, sizes: tuple[tuple[int, ...], ...]) -> tuple[Array, Array, Any, Any]:
    """Height, width, texels from row to row, and the first texel of the image of each lookup (N,)."""
    xp = namespace(uv)
    if not image.shape[0]:
        one = xp.ones_like(stopped(uv[:, 0]))
        return one * sizes[0][0], one * sizes[0][1], sizes[0][1], 0
    from rts.operations.texels_loops import places_of

    of_rows = xp.take(engine_of(uv).constant(places_of(sizes), uv), image, axis=0)
    height, width = (xp.astype(of_rows[:, i], uv.dtype) for i in range(2))
    return height, width, of_rows[:, 1], of_rows[:, 2]


def _points(
    table: Array,
    uv: Array,
    image: Array,
    *,
    sizes: tuple[tuple[int, ...], ...],
    wrap: tuple[str, str],
    filter: str,
) -> tuple[Array, Array, Array]:
    """Lookups (N, C) at points, and the slopes there, to the right and down, a texel each."""
    xp = namespace(table, uv)
    height, width, step, first = places(uv, image, sizes)
    x, y = uv[:, 0] * width - 0.5, (1 - uv[:, 1]) * height - 0.5
    if filter == "nearest":
        x, y = xp.floor(x + 0.5), xp.floor(y + 0.5)  # The centre of the texel.
    x0, y0 = xp.floor(x), xp.floor(y)
    fx, fy = (x - x0)[:, None], (y - y0)[:, None]
    rows, columns = (
        [_wrapped(a + i, n, w) for i in range(2)] for a, n, w in ((y0, height, wrap[1]), (x0, width, wrap[0]))
    )
    index = xp.concat([rows[dy] * step + columns[dx] + first for dy, dx in CORNERS])
    found = xp.reshape(xp.take(table, index, axis=0), (4, -1, table.shape[1]))
    rises = [found[i + 1, ...] - found[i, ...] for i in (0, 2)]
    upper, lower = (found[i, ...] + fx * rise for i, rise in zip((0, 2), rises, strict=True))
    return upper + fy * (lower - upper), rises[0] + fy * (rises[1] - rises[0]), lower - upper


def _wrapped(index: Array, count: Any, wrap: str) -> Array:
    """Whole-numbered floats as int32 in [0, count), by `wrap` where they lie outside; 0 for NaN."""
    xp = namespace(index)
    index = xp.where(index - index == 0, index, 0.0)  # NaN and infinity have no texel; they would be out of range.
    if wrap == "repeat":
        index = index - xp.floor(index / count) * count
        # Compilers divide by way of reciprocals, whose rounding would lead out of the row.
        index = xp.where(index >= count, index - count, index)
    elif wrap == "mirror":
        index = index - xp.floor(index / (2 * count)) * (2 * count)
        index = xp.where(index >= count, 2 * count - 1 - index, index)
    return xp.astype(xp.clip(xp.clip(index, 0.0, None), None, count - 1), xp.int32)


def _shape(table: tuple[int, ...], uv: tuple[int, ...], *_: tuple[int, ...], **__: Any) -> tuple[int, ...]:
    return uv[0], table[1]


def _check(
    table: np.ndarray,
    uv: np.ndarray,
    image: np.ndarray,
    footprint: np.ndarray,
    *,
    sizes: tuple[tuple[int, ...], ...],
    **_: object,
) -> None:
    few = 0 < len(image) < len(uv) or (len(footprint) and (len(footprint) < len(uv) or footprint.shape[1] != 4))
    if uv.shape[1] != 2 or few or sum(h * w for h, w in sizes) > len(table):
        shapes = ", ".join(str(x.shape) for x in (table, uv, image, footprint))
        raise InputError(
            f"table, uv, image and footprint have shapes {shapes}, for images of sizes {sizes}; expected (M, C), with "
            f"a row for each texel, (N, 2), (N,), (N, 4)"
        )
    if image.size and not 0 <= image.min() <= image.max() < len(sizes):
        raise InputError(f"images from {image.min()} to {image.max()} were asked for, of {len(sizes)}")


def _loops() -> tuple[Callable, Callable, Callable]:
    from rts.operations import texels_loops as loops

    return loops.forward, loops.push, loops.pull


TEXELS = Operation.of_loops(
    "rts.texels",
    _specification,
    (2, 2, 1, 2),
    _shape,
    _loops,
    _check,
    differentiable=2,
    packed=(1,),
    packed_result=True,
)
"""The operation of `texels`, on table (M, C), uv (N, 2), numbers of images (N,), or (0,) where all are the first, and
footprints (N, 4), or (0, ·) for points.

Parameters: `sizes`, `wrap` and `filter`, as there."""
