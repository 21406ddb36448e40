"""Channels of an image and means over what is covered of each pixel, and their derivatives, as compiled loops.

Operands are those of `rts.operations.means.MEANS`. All groups of channels are read while a block of pixels is in the
cache, each kind by a loop of its own, since one loop of all kinds takes four times as long.
"""

from __future__ import annotations

import math

import numpy as np

from rts.compiling.loops import compiled, loop
from rts.compiling.threads import parallel, read_only

Groups = tuple[tuple[int, int, str], ...]
"""First channel, number of channels, and kind, of some groups of channels."""
MEAN, DIRECTION = 1, 2
KINDS = {"value": 0, "mean": MEAN, "direction": DIRECTION}
BLOCK = 512
"""Pixels in a block."""


def forward(image: np.ndarray, out: np.ndarray, *, groups: Groups, least: float) -> None:
    """Fill `out` with the groups of channels of `image` (P, C + 1), one after the other."""
    _parallel(_write, groups, least, image, out)


def push(image: np.ndarray, t: np.ndarray, out: np.ndarray, *, groups: Groups, least: float) -> None:
    """Fill `out` with the derivative of the groups of channels along `t` (P, C + 1)."""
    _parallel(_push, groups, least, image, t, out)


def pull(image: np.ndarray, g: np.ndarray, g_image: np.ndarray, *, groups: Groups, least: float) -> None:
    """Add the gradient of the image to `g_image` (P, C + 1), from that of the groups of channels, `g`."""
    _parallel(_pull, groups, least, image, g, g_image)


def _parallel(function, groups: Groups, least: float, image: np.ndarray, *arrays: np.ndarray) -> None:
    rows = np.array([(KINDS[kind], first, count) for first, count, kind in groups])
    parallel(function, len(image), image, read_only(rows), least, *arrays, work=3 * len(image) * int(rows[:, 2].sum()))


@loop
def _write(start, stop, image, groups, least, out):
    """Fill what `out` has of pixels [start, stop) with groups (kind, first, count) of channels."""
    for p in range(start, stop, BLOCK):
        end, place = min(p + BLOCK, stop), 0
        for kind, first, count in groups:
            array = out[place : place + len(image) * count].reshape((len(image), count))
            if kind == MEAN:
                _divide(p, end, image, first, least, array)
            elif kind == DIRECTION:
                _scale(p, end, image, first, least, array)
            else:
                _copy(p, end, image, first, array)
            place += len(image) * count


@loop
def _push(start, stop, image, groups, least, t, out):
    """Fill what `out` has of pixels [start, stop) with the derivative of groups of channels along `t` (P, C + 1)."""
    for p in range(start, stop, BLOCK):
        end, place = min(p + BLOCK, stop), 0
        for kind, first, count in groups:
            array = out[place : place + len(image) * count].reshape((len(image), count))
            if kind == MEAN:
                _divide_push(p, end, image, t, first, least, array)
            elif kind == DIRECTION:
                _scale_push(p, end, image, t, first, least, array)
            else:
                _copy(p, end, t, first, array)
            place += len(image) * count


@loop
def _pull(start, stop, image, groups, least, g, g_image):
    """Add to rows [start, stop) of `g_image` (P, C + 1) the gradient of pixels, from `g` of groups of channels."""
    for p in range(start, stop, BLOCK):
        end, place = min(p + BLOCK, stop), 0
        for kind, first, count in groups:
            array = g[place : place + len(image) * count].reshape((len(image), count))
            if kind == MEAN:
                _divide_pull(p, end, image, array, first, least, g_image)
            elif kind == DIRECTION:
                _scale_pull(p, end, image, array, first, least, g_image)
            else:
                _copy_pull(p, end, array, first, g_image)
            place += len(image) * count


@compiled
def _copy(start, stop, image, first, out):
    """Fill rows [start, stop) of `out` (P, n) with n channels of `image` (P, C + 1), from `first` on."""
    for p in range(start, stop):
        for i in range(out.shape[1]):
            out[p, i] = image[p, first + i]


@compiled
def _copy_pull(start, stop, g, first, g_image):
    """Add rows [start, stop) of `g` (P, n), the gradient of `_copy`, to `g_image` (P, C + 1)."""
    for p in range(start, stop):
        for i in range(g.shape[1]):
            g_image[p, first + i] += g[p, i]


@compiled
def _divide(start, stop, image, first, least, out):
    """Fill rows [start, stop) of `out` (P, n) with n channels of `image` (P, C + 1), from `first` on, over alpha."""
    last = image.shape[1] - 1
    for p in range(start, stop):
        alpha = np.float64(image[p, last])
        scale = 1 / alpha if alpha >= least else 0.0
        for i in range(out.shape[1]):
            out[p, i] = scale * image[p, first + i]


@compiled
def _divide_push(start, stop, image, t, first, least, out):
    """Fill rows [start, stop) of `out` (P, n) with the derivative of `_divide` along `t` (P, C + 1)."""
    last = image.shape[1] - 1
    for p in range(start, stop):
        alpha = np.float64(image[p, last])
        scale = 1 / alpha if alpha >= least else 0.0
        along = scale * scale * t[p, last]
        for i in range(out.shape[1]):
            out[p, i] = scale * t[p, first + i] - along * image[p, first + i]


@compiled
def _divide_pull(start, stop, image, g, first, least, g_image):
    """Add to rows [start, stop) of `g_image` (P, C + 1) the gradient of `_divide`, whose result has `g` (P, n)."""
    last = image.shape[1] - 1
    for p in range(start, stop):
        alpha = np.float64(image[p, last])
        scale, along = 1 / alpha if alpha >= least else 0.0, 0.0
        for i in range(g.shape[1]):
            along += image[p, first + i] * g[p, i]
            g_image[p, first + i] += scale * g[p, i]
        g_image[p, last] -= scale * scale * along


@compiled
def _inverse_length(x, y, z):
    """One over the length of a vector; 1 for that of zero."""
    square = x * x + y * y + z * z
    return 1 / math.sqrt(square) if square > 0 else 1.0


@compiled
def _scale(start, stop, image, first, least, out):
    """Fill rows [start, stop) of `out` (P, 3) with three channels of `image` (P, C + 1), scaled to length one."""
    last = image.shape[1] - 1
    for p in range(start, stop):
        x, y, z = np.float64(image[p, first]), np.float64(image[p, first + 1]), np.float64(image[p, first + 2])
        scale = _inverse_length(x, y, z) if image[p, last] >= least else 0.0
        out[p, 0], out[p, 1], out[p, 2] = scale * x, scale * y, scale * z


@compiled
def _scale_push(start, stop, image, t, first, least, out):
    """Fill rows [start, stop) of `out` (P, 3) with the derivative of `_scale` along `t` (P, C + 1)."""
    last = image.shape[1] - 1
    for p in range(start, stop):
        x, y, z = np.float64(image[p, first]), np.float64(image[p, first + 1]), np.float64(image[p, first + 2])
        scale = _inverse_length(x, y, z) if image[p, last] >= least else 0.0
        along = x * t[p, first] + y * t[p, first + 1] + z * t[p, first + 2]
        along *= scale * scale
        out[p, 0] = scale * (t[p, first] - along * x)
        out[p, 1] = scale * (t[p, first + 1] - along * y)
        out[p, 2] = scale * (t[p, first + 2] - along * z)


@compiled
def _scale_pull(start, stop, image, g, first, least, g_image):
    """Add to rows [start, stop) of `g_image` (P, C + 1) the gradient of `_scale`, whose result has `g` (P, 3)."""
    last = image.shape[1] - 1
    for p in range(start, stop):
        x, y, z = np.float64(image[p, first]), np.float64(image[p, first + 1]), np.float64(image[p, first + 2])
        scale = _inverse_length(x, y, z) if image[p, last] >= least else 0.0
        along = scale * scale * (x * g[p, 0] + y * g[p, 1] + z * g[p, 2])
        g_image[p, first] += scale * (g[p, 0] - along * x)
        g_image[p, first + 1] += scale * (g[p, 1] - along * y)
        g_image[p, first + 2] += scale * (g[p, 2] - along * z)
