"""Channels of an image as arrays of their own: values, and means over what is covered of each pixel."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple

from rts.arrays.engines import engine_of, namespace
from rts.arrays.trees import Array
from rts.operations.operation import Operation

LEAST_ALPHA = 1e-3
"""Pixels of a smaller alpha count as empty: what little is covered of them tells no mean."""


class Channels(NamedTuple):
    """Some channels of an image.

    Attributes:
        first: the index of the first.
        number: how many they are.
        kind: "value", as they are; "mean", divided by alpha; or "direction", three that are scaled to length one. The
            last two are 0 where the pixel is empty.
    """

    first: int
    number: int
    kind: Literal["value", "mean", "direction"]


def channels_of(image: Array, groups: Sequence[Channels]) -> list[Array]:
    """The groups of channels (..., number) of an image (..., C + 1), alpha last, each contiguous in memory.

    Computed in one pass, and cut from one array, since the derivative of a slice is an array as large as the image.
    """
    xp, (*grid, _) = namespace(image), image.shape
    count = math.prod(grid)
    found = MEANS(xp.reshape(image, (count, image.shape[-1])), groups=tuple(groups), least=LEAST_ALPHA)
    pieces = engine_of(found).split(found, [count * some.number for some in groups])
    return [xp.reshape(piece, (*grid, some.number)) for piece, some in zip(pieces, groups, strict=True)]


def _specification(image: Array, *, groups: tuple[Channels, ...], least: float) -> Array:
    # Cut once, at all ends of groups.
    xp, width = namespace(image), image.shape[1]
    ends = sorted({0, width - 1, width, *(at for first, number, _ in groups for at in (first, first + number))})
    sizes = [end - start for start, end in itertools.pairwise(ends)]
    pieces = engine_of(image).split(xp.permute_dims(image, (1, 0)), sizes)
    alpha = xp.permute_dims(pieces[-1], (1, 0))
    covered, found = alpha >= least, []
    for first, number, kind in groups:
        of_group = pieces[ends.index(first) : ends.index(first + number)]
        piece = xp.permute_dims(of_group[0] if len(of_group) == 1 else xp.concat(list(of_group)), (1, 0))
        if kind != "value":
            size = _length(piece) if kind == "direction" else alpha
            piece = piece * xp.where(covered, 1 / xp.where(covered, size, 1.0), 0.0)
        found.append(xp.reshape(piece, (-1,)))
    return xp.concat(found)


def _length(x: Array) -> Array:
    """The lengths (N, 1) of vectors (N, C); 1 for those that are zero."""
    xp = namespace(x)
    square = xp.sum(x * x, axis=-1, keepdims=True)
    return xp.sqrt(xp.where(square > 0, square, 1.0))


def _shape(image: tuple[int, ...], *, groups: tuple[Channels, ...], **_: object) -> tuple[int, ...]:
    return (image[0] * sum(some.number for some in groups),)


def _loops() -> tuple[Callable, Callable, Callable]:
    from rts.operations import means_loops as loops

    return loops.forward, loops.push, loops.pull


MEANS = Operation.of_loops("rts.means", _specification, (2,), _shape, _loops)
"""The operation of `channels_of`, on pixels (P, C + 1): the groups of channels, one after the other, in one array.

Parameters: `groups`, and `least`, the alpha below which a pixel counts as empty."""
