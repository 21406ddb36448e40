"""The record of outlines as they are found on the host, and the stencil that follows from them."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from rts.arrays.trees import collected
from rts.compiling.threads import read_only
from rts.contracts.records import ArraySpec, Stencil
from rts.outlines import segments_loops
from rts.outlines import stencil_loops as loops
from rts.outlines.gaps import Crossings
from rts.outlines.required import Required
from rts.outlines.segments import Segments, joined


class Outlines(NamedTuple):
    """Outlines between the centres of cells: places where an edge crosses, joined into segments. Host arrays.

    A gap lies between two neighbouring centres, along a row or a column. Each place in a gap where the first hit
    changes to another surface, or across a seam, is a crossing. Four neighbouring centres are the corners of a dual
    cell; crossings on its sides are joined into segments.

    Attributes:
        rows: (B, 6) int32, for each crossing two samples that tell motions, before and behind it along its gap; two
            that tell colours (−1 if only one of both is told, see `Required`), since in the last hair before an outline
            normals may turn away, and colours with them; and a pair on the ray of the last sample of the surface that
            ends, beside its deepest point, whose mean moves as the outline (`RaySurface.deepest`): a single sample does
            not tell how a kink of a field moves. −1 stands for none. Of K layers (B, 2 + K + 1): the two last samples,
            only where the layer that ends is, or two where layers intersect; and those of the stack there.
        sides: (B, 2, K) int32, the stacks before and behind, as indices in that stack, or −1; (B, 2, 0) for one layer.
        place: (B,) float64, the place of each crossing along its gap: 0 at the first centre, 1 at the second.
        gap: (B, 3) int32: the cell (y, x) of the gap's first centre, and 1 for a gap along a row, 0 along a column.
        kind: (B,) int32, `edge_kinds.BEFORE_ENDS`, BEHIND_ENDS or INTERSECT; BEFORE_ENDS at seams, where a surface goes
            on and its colours may change. Of several layers it is about the one that ends there.
        slope: (B, 2, 2) float64, slopes of depth along x and y of both samples, where `kind` is INTERSECT; of the one
            that ends, where the near or the far plane cuts it; else 0.
        ends: (B, 2) bool: is this the gap's first crossing, and its last?
        segments: see `Segments`.
        joined: (2, H, W) bool, see `Stencil`.
        left_out: number of crossings left out for want of room.
    """

    rows: np.ndarray
    sides: np.ndarray
    place: np.ndarray
    gap: np.ndarray
    kind: np.ndarray
    slope: np.ndarray
    ends: np.ndarray
    segments: Segments
    joined: np.ndarray
    left_out: int

    @classmethod
    def of(cls, crossings: Crossings, rows: np.ndarray, sides: np.ndarray | None = None, left_out: int = 0) -> Outlines:
        """Outlines of crossings whose samples are `rows`; `sides` are there if light passes through, see `joined`."""
        count = len(rows)
        place, kind = np.empty(count), np.empty(count, np.int32)
        segments_loops.places(crossings.gap, crossings.place, crossings.kind, place, kind)
        layered = sides is not None
        sides = np.empty((count, 2, 0), np.int32) if sides is None else np.ascontiguousarray(sides, np.int32)
        of_crossings = place, crossings.gap, kind, crossings.slope, crossings.ends
        return cls(rows, sides, *of_crossings, joined(crossings, layered), crossings.joined, left_out)

    def stencil(self, row: np.ndarray, required: Required, real: Any) -> Stencil:
        """The areas and boundary terms beside outlines, whose `rows` are counted over all parts.

        Args:
            row: (K, H, W) int32, the samples in cells, counted likewise.
            required: what samples tell.
            real: the dtype of weights.
        """
        rows = self.rows
        last, none = rows[:, :2], np.full((len(rows), 2), -1, np.int32)
        if self.sides.shape[2]:
            stack = np.take_along_axis(rows[:, None, 2:], np.maximum(self.sides, 0), axis=2)
            stack = np.where(self.sides >= 0, stack, np.int32(-1))
            samples = last, last, none, stack
        else:
            samples = *self._colored(rows, row[0], required), rows[:, 4:], self.sides
        beside = loops.BesideRows(*map(np.ascontiguousarray, samples))
        found: Any = loops.entries(self, beside, read_only(row, np.int32), real)
        (cell, sample, weight), (moved_cell, mover, rates, jumps), stacks = found
        stacks = stacks if self.sides.shape[2] else None
        return Stencil(self.joined, cell, sample, weight, moved_cell, mover, rates, jumps, stacks)

    def _colored(self, rows: np.ndarray, at_centres: np.ndarray, required: Required) -> tuple[np.ndarray, np.ndarray]:
        """The samples (B, 2) that tell motions, and those that tell colours, or −1 for the former.

        Colours may be those of centres (H, W), on surfaces that reach these; of other pieces, one sample's.
        """
        last, inner = rows[:, :2], rows[:, 2:4]
        if not required.centers:
            return last, inner
        y, x, along = self.gap.T
        first, second = at_centres[y, x], at_centres[y + 1 - along, x + along]
        # Behind the last crossing, or before this one.
        before = np.where(self.ends[:, 0], first, np.roll(last[:, 1], 1))
        colors = np.stack([before, np.where(self.ends[:, 1], second, last[:, 1])], axis=1)
        return (last, colors) if required.motions else (colors, inner)


COLORS, MOTIONS = 16, 32
"""Entries of colours and of motions, for each crossing, for which programs of fixed shapes have room. Of a ball, a
teapot and a bunny 3 and 13 are in use; of three balls of glass 5 and 28, for which there is twice the room."""


def specs(most: int, size: tuple[int, int], real: Any, layers: int) -> list[ArraySpec]:
    """Specs of the fields of a stencil with room for at most so many crossings."""
    colors, motions = COLORS * most, MOTIONS * most * (1 if layers == 1 else 2)
    shapes = [((2, *size), np.bool_, False), ((colors,), np.int32, True), ((colors,), np.int32, True)]
    shapes += [((colors,), real, True), ((motions,), np.int32, True), ((motions,), np.int32, True)]
    shapes += [((motions, 3), real, True), ((motions, 2), np.int32, True)]
    if layers > 1:
        shapes.append((((2 + layers) * most, layers), np.int32, True))
    return [ArraySpec(*one) for one in shapes]


def fits(stencil: Stencil, most: int | None) -> bool:
    """True if a stencil has room in `specs` of so many crossings; None for any."""
    if most is None:
        return True
    layers = 1 if stencil.stacks is None else stencil.stacks.shape[1]
    room = specs(most, stencil.joined.shape[1:], None, layers)
    return all(x.shape[0] <= spec.shape[0] for x, spec in zip(collected(stencil), room, strict=True))
