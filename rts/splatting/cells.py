"""Packed samples as cells of an image: rows checked and looked up, layers composited."""

from __future__ import annotations

import numpy as np

from rts.arrays.engines import engine_of, namespace
from rts.arrays.trees import Array
from rts.errors import InputError
from rts.operations.operation import known_value


def check_rows(row: Array, count: int, name: str = "row") -> None:
    """Raise an InputError if `row` holds a number that is neither −1 nor an index below `count`; traced rows pass."""
    value = row if type(row) is np.ndarray else known_value(row)
    if value is None or not value.size:
        return
    low, high = int(np.minimum.reduce(value, None)), int(np.maximum.reduce(value, None))
    if high >= count:
        raise InputError(f"{name} refers to sample {high} of {count}; expected indices below, or -1 for an empty cell")
    if low < -1:
        raise InputError(f"{name} refers to sample {low}; expected indices of samples, or -1 for an empty cell")


def nothing(rgba: Array, row: Array) -> Array:
    """The image (H, W, C) of no samples: zeros. An InputError if `row` (K, H, W) names a sample."""
    check_rows(row, 0)
    xp = namespace(rgba, row)
    return xp.stack([xp.zeros_like(row[0], dtype=rgba.dtype)] * rgba.shape[1], axis=-1)


def centres(height: int, width: int, like: Array) -> Array:
    """Centres (H, W, 2) of cells, x and y, in the dtype of `like` and on its device."""
    xp, engine = namespace(like), engine_of(like)
    down, across = xp.meshgrid(engine.arange(height, like), engine.arange(width, like), indexing="ij")
    return xp.stack([across, down], axis=-1) + 0.5


def unpack(values: Array, cells: Array) -> Array:
    """(h, w, C) of packed values (N, C). An empty cell gets values of row 0, to be masked."""
    xp = namespace(values, cells)
    index = xp.reshape(xp.where(cells >= 0, cells, 0), (-1,))
    return xp.reshape(xp.take(values, index, axis=0), (*cells.shape, values.shape[1]))


def over(front: Array, back: Array) -> Array:
    """`front` composited over `back`, both premultiplied (…, C), alpha last (Porter and Duff 1984)."""
    return front + (1 - front[..., -1:]) * back
