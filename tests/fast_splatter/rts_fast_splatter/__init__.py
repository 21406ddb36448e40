"""The splatter `single`, compiled, as a distribution of its own: made of public names of `rts` alone."""

import math

import numpy as np

from rts.plugin_api import splats as specification
from rts.plugin_api.operations import Operation
from rts.plugin_api.records import Cells, Splats
from rts.plugin_api.threads import parallel, read_only

WORK = 8
"""Nanoseconds that a cell takes, roughly."""


def _array_code(positions, rgba, row, *, numbers, border):
    return specification.Single(*numbers).cropped(Splats(positions, rgba, Cells(row), border=border))


def _shape(positions, rgba, row, *, numbers, border):
    return *(max(0, n - 2 * border) for n in row[1:]), 4


def _arguments(operands, numbers, border, checked=None):
    """Arguments of every loop after its range; rows that refer to no sample are refused."""
    positions, rgba, row = operands
    row = row[:1]
    if not checked:
        specification.check_rows(row, len(rgba))
    sigma, epsilon, gamma = numbers
    scale = 1 / (2 * sigma**2)
    peak = math.sqrt(1 + epsilon) / (1 + 2 * math.exp(-scale))
    reals = map(positions.dtype.type, (scale, peak, gamma))
    return positions, rgba, read_only(row[0], np.int32), *reals, border


def _forward(operands, out, *, numbers, border):
    none = (read_only(np.empty((0, 0, n), out.dtype)) for n in (3, 4))
    _splat(_arguments(operands, numbers, border), none, out[None])
    return True  # Kept: the operands have been checked.


def _push(operands, tangents, out, *, numbers, border, kept):
    none = (np.empty((len(out), 0, n), out.dtype) for n in (3, 4))
    along = [read_only(n if t is None else t) for n, t in zip(none, tangents, strict=True)]
    _splat(_arguments(operands, numbers, border, kept), along, out)


def _splat(given, along, out):
    from .bands import splat

    if out.size:
        parallel(splat, out.shape[1], *given, *along, out, work=WORK * out.size // 4)


def _pull(operands, g, results, *, numbers, border, kept):
    from .bands import pull, repeats

    given = _arguments(operands, numbers, border, kept)
    (rgba, row), g = given[1:3], read_only(g)
    none = (np.empty((0, n), g.dtype) for n in (3, 4))
    gradients = [n if x is None else x for n, x in zip(none, results, strict=True)]
    if repeats(row, np.zeros(len(rgba), np.bool_)):  # Threads would add to one sample at once.
        pull(0, len(row), *given, g, *gradients)
    else:
        parallel(pull, len(row), *given, g, *gradients, work=WORK * row.size)


def _used(operands):
    return 1 + int(operands[2].max(initial=0))


IMAGE = Operation(
    "rts_fast_splatter.image",
    _array_code,
    ranks=(2, 2, 3),
    shape=_shape,
    forward=_forward,
    push=_push,
    pull=_pull,
    differentiable=2,
    packed=(0, 1),
    used=_used,
    keeps=True,
    sweeps=True,
)


class FastSingle(specification.Single):
    """`rts.splatting.Single`, compiled."""

    def image(self, splats):
        """See `rts.Splatter`."""
        return _image(self, splats.replace(border=0)) if splats.rgba.shape[0] else super().image(splats)

    def cropped(self, splats):
        """See `rts.Splatter`."""
        return _image(self, splats) if splats.rgba.shape[0] else super().cropped(splats)


def _image(splatter, splats):
    """The image without the border."""
    numbers = splatter.sigma, splatter.epsilon, splatter.gamma
    return IMAGE(splats.positions, splats.rgba, splats.row, numbers=numbers, border=splats.border)
