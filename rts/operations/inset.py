"""An image of which some pixels are means of a finer one."""

from __future__ import annotations

import numpy as np

from rts.engines import namespace
from rts.operations.operation import Arrays, Operation, Some
from rts.threads import parallel, read_only
from rts.trees import Array


def with_inset(image: Array, fine: Array, pixel: Array, side: int) -> Array:
    """(H, W, C): where `pixel` is not negative, the mean of `side`² cells of a finer image.

    Args:
        image: (H, W, C).
        fine: (h · side, w · side, C), of the dtype of the image.
        pixel: (H, W) integers, which of the h × w pixels of the finer image to take, counted along its lines; negative
            for none. No two are the same.
        side: cells along each side of a pixel.
    """
    return INSET(image, fine, pixel, side=side)


def averaged(image: Array, side: int) -> Array:
    """(h, w, C) of (h · side, w · side, C): each pixel the mean of `side`² cells."""
    # One axis after the other: over both at once, torch takes three times as long.
    xp, (height, width), channels = namespace(image), (n // side for n in image.shape[:2]), image.shape[2]
    rows = xp.mean(xp.reshape(image, (height, side, width * side * channels)), axis=1)
    return xp.mean(xp.reshape(rows, (height, width, side, channels)), axis=2)


def _specification(image: Array, fine: Array, pixel: Array, *, side: int) -> Array:
    xp = namespace(image, fine)
    rows = xp.reshape(averaged(fine, side), (-1, fine.shape[2]))
    taken = xp.take(rows, xp.reshape(xp.where(pixel >= 0, pixel, 0), (-1,)), axis=0)
    return xp.where((pixel >= 0)[..., None], xp.reshape(taken, image.shape), image)


def _shape(image: tuple[int, ...], fine: tuple[int, ...], pixel: tuple[int, ...], *, side: int) -> tuple[int, ...]:
    return image


def _forward(operands: Arrays, out: np.ndarray, *, side: int) -> None:
    from rts.operations import inset_kernels

    image, fine, pixel = map(read_only, operands)
    parallel(inset_kernels.put, len(out), image, fine, pixel, side, out, work=out.size)


def _push(operands: Arrays, tangents: Some, out: np.ndarray, *, side: int) -> None:
    image, fine, pixel = operands
    moved = [np.zeros_like(x) if t is None else t for x, t in zip((image, fine), tangents, strict=True)]
    _forward((*moved, pixel), out, side=side)


def _pull(operands: Arrays, g: np.ndarray, results: Some, *, side: int) -> None:
    from rts.operations import inset_kernels

    image, fine = (np.empty((0, 0, g.shape[2]), g.dtype) if x is None else x for x in results)
    parallel(inset_kernels.pull, len(g), read_only(g), read_only(operands[2]), side, image, fine, work=g.size)


INSET = Operation("rts.inset", _specification, (3, 3, 2), _shape, _forward, _push, _pull, differentiable=2)
