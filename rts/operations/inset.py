"""Insets: images in which some pixels are means of a finer image; others are given, or have one colour or zeros."""

from __future__ import annotations

import numpy as np

from rts.arrays.engines import namespace
from rts.arrays.trees import Array
from rts.compiling.threads import parallel, read_only
from rts.operations.operation import Arrays, Operation, Some


def with_inset(image: Array, fine: Array, pixel: Array, side: int) -> Array:
    """A copy (H, W, C) of an image, with means of `side`² cells of a finer image where `pixel` is not negative.

    Differentiable in both images.

    Args:
        image: (H, W, C).
        fine: (h · side, w · side, C), of the dtype of the image.
        pixel: (H, W) integers, the index of a pixel among the h × w of the finer image, counted row by row; negative
            for none. No index appears twice.
        side: cells along each side of a pixel.
    """
    return INSET(image, fine, pixel, side=side)


def painted_inset(color: Array, fine: Array, pixel: Array, row: Array, settled: Array, side: int) -> Array:
    """`with_inset` for an image (H, W, C) that has one colour on covered pixels, and zeros elsewhere.

    Differentiable in `color` and `fine`.

    Args:
        color: (C,).
        fine: as in `with_inset`.
        pixel: as in `with_inset`.
        row: (H', W') integers, for pixels of the image and of a border around it; covered where not negative.
        settled: (H', W') integers; pixels where it is not negative are covered, too.
        side: as in `with_inset`.
    """
    return PAINTED(color, fine, pixel, row, settled, side=side)


def averaged(image: Array, side: int) -> Array:
    """An image (h, w, C) of (h · side, w · side, C): each pixel is the mean of `side`² cells."""
    # One axis after the other: over both at once, torch takes three times as long.
    xp, (height, width), channels = namespace(image), (n // side for n in image.shape[:2]), image.shape[2]
    rows = xp.mean(xp.reshape(image, (height, side, width * side * channels)), axis=1)
    return xp.mean(xp.reshape(rows, (height, width, side, channels)), axis=2)


def _specification(image: Array, fine: Array, pixel: Array, *, side: int) -> Array:
    xp = namespace(image, fine)
    rows = xp.reshape(averaged(fine, side), (-1, fine.shape[2]))
    taken = xp.take(rows, xp.reshape(xp.where(pixel >= 0, pixel, 0), (-1,)), axis=0)
    return xp.where((pixel >= 0)[..., None], xp.reshape(taken, image.shape), image)


def _painted(color: Array, fine: Array, pixel: Array, row: Array, settled: Array, *, side: int) -> Array:
    rows, columns = (slice(*_inside(n, wide)) for n, wide in zip(pixel.shape, row.shape, strict=True))
    there = (row[rows, columns] >= 0) | (settled[rows, columns] >= 0)
    return _specification(namespace(color).astype(there[..., None], color.dtype) * color, fine, pixel, side=side)


def _inside(size: int, wide: int) -> tuple[int, int]:
    """Start and end of an image of `size` pixels in one of `wide` pixels, with the same border on both sides."""
    return (wide - size) // 2, (wide + size) // 2


def _shape(image: tuple[int, ...], fine: tuple[int, ...], pixel: tuple[int, ...], *, side: int) -> tuple[int, ...]:
    return image


def _painted_shape(
    color: tuple[int, ...], fine: tuple[int, ...], pixel: tuple[int, ...], *beside: tuple[int, ...], side: int
) -> tuple[int, ...]:
    return *pixel, *color


def _no_colors(like: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Empty arrays in place of color, row and settled; the first in the dtype of `like`."""
    return (
        read_only(np.empty(0, like.dtype)),
        read_only(np.empty((0, 0), np.int32)),
        read_only(np.empty((0, 0), np.int8)),
    )


def _forward(operands: Arrays, out: np.ndarray, *, side: int) -> None:
    image, fine, pixel = map(read_only, operands)
    _put(image, *_no_colors(out), fine, pixel, side, out)


def _forward_painted(operands: Arrays, out: np.ndarray, *, side: int) -> None:
    color, fine, pixel, row, settled = map(read_only, operands)
    image = read_only(np.empty((0, 0, len(color)), out.dtype))
    _put(image, color, read_only(row, np.int32), settled, fine, pixel, side, out)


def _put(
    image: np.ndarray,
    color: np.ndarray,
    row: np.ndarray,
    settled: np.ndarray,
    fine: np.ndarray,
    pixel: np.ndarray,
    side: int,
    out: np.ndarray,
) -> None:
    """Fill `out` (H, W, C) by `inset_loops.put`, on all cores."""
    from rts.operations import inset_loops

    parallel(inset_loops.put, len(out), image, color, row, settled, fine, pixel, side, out, work=out.size)


def _push(operands: Arrays, tangents: Some, out: np.ndarray, *, side: int) -> None:
    moved = [np.zeros_like(x) if t is None else t for x, t in zip(operands[:2], tangents, strict=True)]
    _forward((*moved, *operands[2:]), out, side=side)


def _push_painted(operands: Arrays, tangents: Some, out: np.ndarray, *, side: int) -> None:
    moved = [np.zeros_like(x) if t is None else t for x, t in zip(operands[:2], tangents, strict=True)]
    _forward_painted((*moved, *operands[2:]), out, side=side)


def _pull(operands: Arrays, g: np.ndarray, results: Some, *, side: int) -> None:
    image, fine = (np.empty((0, 0, g.shape[2]), g.dtype) if x is None else x for x in results)
    _pulled(g, operands[2], *_no_colors(g)[1:], side, image, np.empty((0, 0), g.dtype), fine)


def _pull_painted(operands: Arrays, g: np.ndarray, results: Some, *, side: int) -> None:
    color, fine = results
    # Each line has its own sum, so that the total does not depend on the number of threads.
    sums, none = np.zeros((0 if color is None else len(g), g.shape[2]), g.dtype), np.empty((0, 0, g.shape[2]), g.dtype)
    row, settled = read_only(operands[3], np.int32), read_only(operands[4])
    _pulled(g, operands[2], row, settled, side, none, sums, none if fine is None else fine)
    if color is not None:
        color[:] = sums.sum(axis=0)


def _pulled(
    g: np.ndarray,
    pixel: np.ndarray,
    row: np.ndarray,
    settled: np.ndarray,
    side: int,
    image: np.ndarray,
    sums: np.ndarray,
    fine: np.ndarray,
) -> None:
    """Pull back `g` (H, W, C) to `image`, `sums` and `fine` by `inset_loops.pull`, on all cores."""
    from rts.operations import inset_loops

    given = read_only(g), read_only(pixel), row, settled, side
    parallel(inset_loops.pull, len(g), *given, image, sums, fine, work=g.size)


INSET = Operation("rts.inset", _specification, (3, 3, 2), _shape, _forward, _push, _pull, differentiable=2)
PAINTED = Operation(
    "rts.painted_inset",
    _painted,
    (1, 3, 2, 2, 2),
    _painted_shape,
    _forward_painted,
    _push_painted,
    _pull_painted,
    differentiable=2,
)
