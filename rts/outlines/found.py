"""The record of outlines as they are found on the host, before the samples of all parts are counted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace
from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np

from rts.arrays.engines import engine_of, namespace
from rts.arrays.trees import Array
from rts.contracts.records import ArraySpec, Outlines
from rts.sampling.entries import is_still
from rts.sampling.scene import Scene


class Found(NamedTuple):
    """Outlines as they are found; see `Outlines`. Rows of zeros have no effect.

    Attributes:
        rows: (B, 6) int32, for each break the two samples that tell motions, the two that tell colours (−1 if only one
            of both is told, see `Told`), and the pair, counted in their part. Of K layers (B, 2 + K + 1): the two last
            samples, and those of the stack there.
        parts: of the shape of `rows`, int32, their parts, or −1.
        sides: (B, 2, K) int32, the stacks before and behind, as indices in that stack, or −1; (B, 2, 0) for one layer.
        places: (B, K + 1) the places of the samples of the stack along the gap; (B, 0) for one layer.
        left: () int32, number of breaks left out for want of room.
    """

    rows: Array
    parts: Array
    sides: Array
    places: Array
    place: Array
    gap: Array
    points: Array
    near: Array
    slope: Array
    ends: Array
    square: Array
    ties: Array
    square_sides: Array
    hub: Array
    beyond: Array
    corner: Array
    pull: Array
    joined: Array
    left: Array

    @staticmethod
    def specs(most: int, size: tuple[int, int], real: Any, layers: int) -> list[ArraySpec]:
        """Specs of outlines with at most so many breaks, each of which ends at most two segments."""
        integers, ends, (width, entries, of_sides) = np.int32, 2 * most, columns(layers)
        breaks = [ArraySpec((most, width), integers, packed=True)] * 2
        breaks += [ArraySpec((most, 2, of_sides), integers, packed=True), ArraySpec((most, entries), real, packed=True)]
        breaks += [ArraySpec((most,), real, packed=True), ArraySpec((most, 3), integers, packed=True)]
        breaks += [ArraySpec((most, 2), real, packed=True), ArraySpec((most,), integers, packed=True)]
        breaks += [ArraySpec((most, 2, 2), real, packed=True), ArraySpec((most, 2), np.bool_, packed=True)]
        pairs = ArraySpec((ends, 2), integers, packed=True)
        segments = [pairs, pairs, pairs, ArraySpec((ends,), integers, packed=True), pairs]
        segments += [ArraySpec((ends, 2), real, packed=True), ArraySpec((ends, 4), real, packed=True)]
        return [*breaks, *segments, ArraySpec((2, *size), np.bool_), ArraySpec((), integers)]

    def outlines(self, rows: Array) -> Outlines:
        """The outlines, with `rows` counted over all parts."""
        last = rows[:, :2]
        named = {"rows": last, "inner": rows[:, 2:4], "pair": rows[:, 4:]}
        if self.sides.shape[-1]:
            named = {"rows": last, "inner": last, "pair": 0 * last - 1, **self._stacks(rows[:, 2:])}
        return Outlines(**dict(zip(_SHARED, _shared_of(self), strict=True)) | named)

    def _stacks(self, rows: Array) -> dict[str, Array]:
        """`Outlines.stack` and `Outlines.stack_points`; `rows` (B, K + 1) are the samples of each stack."""
        xp, shape, there = namespace(rows), self.sides.shape, self.sides >= 0
        first = engine_of(rows).constant(np.arange(shape[0], dtype=np.int32) * rows.shape[1], rows)[:, None, None]
        at = xp.reshape(xp.where(there, first + self.sides, 0), (-1,))
        stack, places = (xp.reshape(xp.take(xp.reshape(x, (-1,)), at), shape) for x in (rows, self.places))
        return {"stack": xp.where(there, stack, -1), "stack_points": xp.where(there, places, 0.0)}


_SHARED = tuple(f.name for f in fields(Outlines) if f.name in Found._fields)
_shared_of = attrgetter(*_SHARED)


class Told(NamedTuple):
    """The tasks of samples beside a break. Of one layer two samples tell colours or motions, and four tell both.

    Attributes:
        colors: False if each part has one colour, which any of its samples tells.
        motions: False if nothing moves (`is_still`) and colours are to be told.
        centers: True if samples at centres tell the colours of surfaces that reach these: see `colored_at_centers`.
    """

    colors: bool = True
    motions: bool = True
    centers: bool = False

    @classmethod
    def of(cls, scenes: Sequence[Scene], centers: bool) -> Told:
        """The tasks that the shaders of scenes, and derivatives in their values, set."""
        # Of one colour any two samples tell all, those of motions too.
        uniform = all(part.uniform for scene in scenes for part in scene.parts)
        return cls(not uniform, uniform or not all(map(is_still, scenes)), centers and not uniform)

    def samples(self, layers: int) -> int:
        """The largest number of samples of a break, but for a pair."""
        if layers > 1:
            return layers + 3
        return 4 if self.colors and self.motions and not self.centers else 2


def colored_at_centers(outlines: Outlines, row: Array, told: Told) -> Outlines:
    """Outlines whose colours are those of centres, on surfaces that reach these; of other pieces, one sample's.

    Outlines where light passes through are returned as they are.

    Args:
        outlines: those of `Found`, without samples that centres stand for.
        row: (K, H, W) int32, the samples at centres.
        told: what samples tell; with `centers`, or outlines are returned as they are.
    """
    if not told.centers or outlines.stack is not None:
        return outlines
    xp, width, ends, rows = namespace(row), row.shape[-1], outlines.ends, outlines.rows
    y, x, along = (outlines.gap[:, i] for i in range(3))
    flat = xp.reshape(row[0, ...], (-1,))
    first, last = (xp.take(flat, at) for at in (y * width + x, (y + 1 - along) * width + x + along))

    def beside(of_breaks: Array, at_first: Array, at_last: Array) -> Array:
        """Entries (B, 2) of the surfaces beside breaks: those at centres, or (B,) behind this break or the last one."""
        before = xp.where(ends[:, 0], at_first, xp.roll(of_breaks, 1))
        return xp.stack([before, xp.where(ends[:, 1], at_last, of_breaks)], axis=-1)

    colors = beside(rows[:, 1], first, last)
    if told.motions:
        return replace(outlines, inner=colors)
    behind = outlines.points[:, 1]
    return replace(outlines, rows=colors, points=beside(behind, xp.zeros_like(behind), xp.ones_like(behind)))


def columns(layers: int) -> tuple[int, int, int]:
    """The numbers of samples of a break, of those of its stack, and of layers on each side; see `Found`."""
    return (6, 0, 0) if layers == 1 else (layers + 3, layers + 1, layers)
