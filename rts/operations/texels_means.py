"""Means of lookups over footprints, and their derivatives, in array code; see `rts.operations.texels`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rts.arrays.engines import namespace, stopped
from rts.arrays.trees import Array
from rts.operations.texels_loops import FAR, MOST, NARROW, ON_SIDES, SHEARED, WIDE

AT_ONCE = 1 << 20
"""Rows that are looked up in one call, which bounds memory."""


def means(
    looked_up: Callable[[Array, Array], tuple[Array, Array, Array]],
    uv: Array,
    image: Array,
    footprint: Array,
    height: Array,
    width: Array,
    nearest: bool,
) -> Array:
    """The means (N, C), differentiable in what is looked up and in uv.

    Args:
        looked_up: lookups at points (M, 2) of images (M,), and their slopes, to the right and down, a texel each.
        uv: (N, 2).
        image: (N,) integers, or (0,).
        footprint: (N, 4).
        height: (N,), of each image, in texels.
        width: (N,).
        nearest: whether there is no derivative in uv.
    """
    xp, still = namespace(uv), stopped(uv)
    a, b = ((footprint[:, i] * width, -footprint[:, i + 1] * height) for i in (0, 2))  # Right and down, in texels.
    lengths = [xp.sqrt(x * x + y * y) for x, y in (a, b)]
    known = lengths[0] + lengths[1] < FAR
    footprint = xp.where(known[:, None], footprint, 0.0)
    (ax, ay), (bx, by) = ([xp.where(known, x, 0.0)[:, None] for x in side] for side in (a, b))
    one = xp.ones_like(lengths[0])
    fit = [
        xp.where(x > NARROW, xp.where(x > WIDE, xp.where(x > 2 * WIDE, 3 * one, 2 * one), one), 0 * one)
        for x in lengths
    ]
    fit = [xp.where(other >= 2, xp.clip(own, None, 2), own) for own, other in (fit, fit[::-1])]
    count_a, count_b = (xp.where(known, 2**x, 1.0) for x in fit)

    def summed(places: list[tuple[Array, Array]], *weighings: list[Array]) -> list[list[Array]]:
        """For each weighing of lookups at places along both sides, sums of these and of their slopes."""
        totals: list[list[Any]] = [[0.0] * 3 for _ in weighings]
        step = max(1, AT_ONCE // max(1, still.shape[0]))
        for start in range(0, len(places), step):
            some = places[start : start + step]
            at = xp.concat([still + s[:, None] * footprint[:, :2] + t[:, None] * footprint[:, 2:] for s, t in some])
            found = looked_up(at, xp.concat([image] * len(some)))
            found = [xp.reshape(x, (len(some), *still.shape[:1], -1)) for x in found]
            for total, weights in zip(totals, weighings, strict=True):
                share = xp.stack(weights[start : start + step])[..., None]
                total[:] = [t + xp.sum(share * x, axis=0) for t, x in zip(total, found, strict=True)]
        return totals

    def along(i: Array, count: Array) -> Array:
        return (xp.clip(i, None, count - 1) + 0.5) / count - 0.5

    within = [(xp.floor(i / count_b), i - xp.floor(i / count_b) * count_b) for i in range(MOST)]
    ((mean, right, down),) = summed(
        [(along(i, count_a), along(j, count_b)) for i, j in within],
        [xp.where(i < count_a, 1 / (count_a * count_b), 0.0) for i, _ in within],
    )
    if nearest:
        return mean
    wide_a, wide_b = count_a > 1, count_b > 1
    of_a, places, shares = xp.where(wide_a, 2 * count_b, 0.0), [], []
    for i in range(ON_SIDES):  # Those on the two sides along b, then on those along a.
        on_a, j = i < of_a, xp.where(i < of_a, i * one, i - of_a)
        end, j = j - 2 * xp.floor(j / 2) - 0.5, xp.floor(j / 2)
        places.append((xp.where(on_a, end, along(j, count_a)), xp.where(on_a, along(j, count_b), end)))
        there = on_a | (wide_b & (j < count_a))
        shares.append(xp.where(there, 2 * end / xp.where(on_a, count_b, count_a), 0.0))
    chosen = [[xp.where((i < of_a) == first, s, 0.0) for i, s in enumerate(shares)] for first in (True, False)]
    (rise_a, *_), (rise_b, *_) = summed(places, *chosen)
    more_a, more_b = rise_a - right * ax - down * ay, rise_b - right * bx - down * by
    determinant, square_a, square_b = ax * by - ay * bx, ax * ax + ay * ay, bx * bx + by * by
    wide_a, wide_b = wide_a[:, None], wide_b[:, None]
    both = wide_a & wide_b & (determinant * determinant > SHEARED * square_a * square_b)
    by_a = wide_a & (both | ~wide_b | (square_a >= square_b))
    by_b = wide_b & (both | ~wide_a | (square_a < square_b))
    more_a = xp.where(by_a, more_a / xp.where(by_a, xp.where(both, determinant, square_a), 1.0), 0.0)
    more_b = xp.where(by_b, more_b / xp.where(by_b, xp.where(both, determinant, square_b), 1.0), 0.0)
    right = right + more_a * xp.where(both, by, ax) + more_b * xp.where(both, -ay, bx)
    down = down + more_a * xp.where(both, -bx, ay) + more_b * xp.where(both, ax, by)
    moved = uv - still
    return mean + right * (moved[:, :1] * width[:, None]) - down * (moved[:, 1:] * height[:, None])
