"""Records of what is seen at centres, of the gaps between these, and of the crossings in gaps.

A crossing is a place between neighbouring centres where a layer that is seen ends, or two intersect. Of opaque surfaces
there is one layer, that of first hits.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rts.outlines import spans_loops


class Hits(NamedTuple):
    """The surfaces seen at M points of the image. Host arrays, (M,) for first hits, (K, M) for K layers, front to back.

    Attributes:
        part: int32, −1 where nothing is seen.
        triangle: int32, −1 where nothing is seen, or where no triangle is known.
        depth: float64, linear; 0 where nothing is seen.
    """

    part: np.ndarray
    triangle: np.ndarray
    depth: np.ndarray

    def at(self, index: np.ndarray) -> Hits:
        """Hits at the points with some indices."""
        return Hits(*(x[..., index] for x in self))

    def of_layer(self, layer: np.ndarray) -> Hits:
        """The layers (M,) with a number of its own at each point."""
        return Hits(*(x[layer, np.arange(len(layer))] for x in self))

    @classmethod
    def of(cls, several: Sequence[Hits]) -> Hits:
        """Hits at several sets of points, one after the other."""
        return cls(*(np.concatenate(x, axis=-1) for x in zip(*several, strict=True)))


class Gaps(NamedTuple):
    """Gaps to look at: those of each row of centres, one row after the other, then those of each column.

    Attributes:
        gap: (M, 3) int32, y and x of the first centre; 1 for a gap along a row, 0 along a column.
        rows: (H, W) int32, how many of them come before each centre of a row.
        columns: (W, H) int32, and of a column.
        around: (H, W) int8, the cells of gaps and those before; see `spans_loops.around`.
    """

    gap: np.ndarray
    rows: np.ndarray
    columns: np.ndarray
    around: np.ndarray

    @classmethod
    def of(cls, marks: np.ndarray) -> Gaps:
        """The gaps that are marked (2, H, W), along rows and along columns."""
        (height, width), gap = marks.shape[1:], np.empty((np.count_nonzero(marks), 3), np.int32)
        rows, columns = np.empty((height, width), np.int32), np.empty((width, height), np.int32)
        spans_loops.number(marks, gap, rows, columns)
        cells = np.zeros((height, width), np.int8)
        spans_loops.around(gap, cells)
        return cls(gap, rows, columns, cells)


class Crossings(NamedTuple):
    """Crossings, those of a gap in order along it. Host arrays; see `rts.outlines.found.Outlines`.

    Attributes:
        gap: (B, 3) int32.
        place: (B, 2) float64.
        kind: (B,) int32; see `edge_kinds`.
        slope: (B, 2, 2) float64.
        ends: (B, 2) bool.
        points: (B, 2, 2) float64, x and y of the last samples before and behind each crossing.
        inner: (B, 2, 2) float64, x and y of the samples that tell colours.
        parts: (B, 2) int32, their parts, or −1.
        joined: (2, H, W) bool: does the surface of each cell's first hit go on to the next cell's, along x and along y?
        triangles: (B, 4) int32, the triangles of these samples, in order; −1 where none is known.
        tangent: (B, 2) float64, the outline's unit direction in the image, either way; 0 where it is unknown.
        cells_away: (B,) float64, how many cells, each as deep as it is wide, the surface that ends is away, but for a
            constant; NaN where it is unknown.
    """

    gap: np.ndarray
    place: np.ndarray
    kind: np.ndarray
    slope: np.ndarray
    ends: np.ndarray
    points: np.ndarray
    inner: np.ndarray
    parts: np.ndarray
    joined: np.ndarray
    triangles: np.ndarray
    tangent: np.ndarray
    cells_away: np.ndarray


class Stacks(NamedTuple):
    """The stacks beside crossings. Host arrays.

    Attributes:
        last: (B, 2) int32, the parts of the last samples before and behind each crossing; −1 on sides that do not move
            it.
        parts: (B, K + 1) int32, the parts of the layers at each crossing, front to back, or −1.
        triangles: (B, K + 1) int32, their triangles; −1 where none is known.
        points: (B, K + 1, 2) float64, x and y of their samples.
        sides: (B, 2, K) int32, the stacks before and behind each crossing, as indices of these samples, or −1.
        numbers: (B, 2 + K + 1) int32, of the last samples and of these: how many layers of the same part are in front.
    """

    last: np.ndarray
    parts: np.ndarray
    triangles: np.ndarray
    points: np.ndarray
    sides: np.ndarray
    numbers: np.ndarray
