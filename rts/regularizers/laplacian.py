"""Laplacian coordinates: the offset of each vertex from the mean of its neighbours."""

from __future__ import annotations

from typing import Any

import numpy as np

from rts.arrays.argument_checks import quoted
from rts.arrays.engines import engine_of
from rts.arrays.trees import Array
from rts.errors import InputError
from rts.regularizers.connectivity import both_ways, edge_weights
from rts.regularizers.regularizer import OfRestShape, combined

WIDTH = 8
"""Number of neighbours in a row of a table of vertices; most vertices have no more."""


class Laplacian(OfRestShape):
    """Smoothness by Laplacian coordinates: E = Σᵢ |δᵢ|², in squared units of the vertices.

    δᵢ = Σⱼ wᵢⱼ (vⱼ − vᵢ) / Σⱼ |wᵢⱼ| over the neighbours j of vertex i is the offset from their mean (Sorkine et al.
    2004, *Laplacian Surface Editing*). Uniform weights are 1. Cotangent weights are ½ (cot α + cot β) of the two angles
    opposite the edge at rest (Pinkall and Polthier 1993). With these, δ of the mesh at rest points along the normal,
    and inside a flat sheet δ is zero, on uneven triangles, too. Cotangent weights may be negative at obtuse angles,
    hence the absolute values. Where more than two faces share an edge, all of their angles count; at a border the one.
    Cotangents are bounded: angles below a twentieth of a degree count as that, and so do triangles without area.

    Without `relative` the energy shrinks and flattens the mesh, and draws borders inwards. With `relative`, shifts cost
    nothing, but rotations do: for large ones take `ARAP`.

    `residuals` is (V, 3): δᵢ, or δᵢ − δᵢ at rest. There are V terms; terms of vertices without edges are zero.

    Args:
        vertices: (V, 3) finite numbers, the mesh at rest; copied.
        faces: (T, 3) integers into vertices; copied.
        weights: "uniform" or "cotangent".
        relative: whether to compare with the coordinates at rest, which keeps details.

    Attributes:
        edges: (E, 2) int32, the lower vertex first.
        weights: (E,) float64, wᵢⱼ.

    Raises:
        InputError: an argument is of another kind or shape; vertices are traced; faces name missing ones, or no edge.
    """

    def __init__(self, vertices: Any, faces: Any, weights: str = "uniform", relative: bool = False):
        super().__init__(vertices, faces)
        if not isinstance(relative, (bool, np.bool_)):
            raise InputError(f"relative is {quoted(relative)}; expected True or False")
        self.edges, self.weights = edge_weights(weights, self._rest, self.faces)
        self.terms = len(self._rest)
        self._steps = np.tile([-1.0, 1.0], (len(self.edges), 1))
        ends, number = both_ways(self.edges)
        total = np.bincount(ends[:, 0], np.abs(self.weights[number]), minlength=self.terms)[ends[:, 0]]
        share = np.divide(self.weights[number], total, out=np.zeros(len(number)), where=total > 0)
        share[ends[:, 0] > ends[:, 1]] *= -1  # An edge leads from its lower vertex to the other.
        self._ids, self._shares, self._further = _table(ends[:, 0], number, share, self.terms)
        self._at_rest = self._coordinates(self._rest) if relative else None

    def __repr__(self) -> str:
        return f"Laplacian({self.terms} vertices)"

    def _coordinates(self, vertices: Array) -> Array:
        # Differences of neighbours first: sums of whole positions would lose most digits of float32.
        steps = combined(vertices, self.edges, self._steps)
        sums = combined(steps, self._ids, self._shares)
        if not len(self._further):
            return sums
        rest = engine_of(vertices).segment_sum(sums[self.terms :, :], self._further, self.terms)
        return sums[: self.terms, :] + rest

    def _residuals(self, vertices: Array) -> Array:
        offsets = self._coordinates(vertices)
        return offsets if self._at_rest is None else offsets - engine_of(vertices).constant(self._at_rest, vertices)


def _table(
    vertex: np.ndarray, values: np.ndarray, shares: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Values of each vertex in a table of `WIDTH` columns; vertices with more values have further rows.

    Args:
        vertex: (M,) integers, sorted; a vertex occurs once for each of its values.
        values: (M,) integers, one of the values of each of these vertices.
        shares: (M,) float, the share of each value.
        count: the number of vertices.

    Returns:
        Values and shares (count + F, WIDTH), filled up with zeros: a row for each vertex, then F further rows; and (F,)
        the vertex of each further row.
    """
    rank = np.arange(len(vertex)) - np.searchsorted(vertex, vertex)
    column, row = rank % WIDTH, vertex.astype(np.int64)
    more = rank >= WIDTH
    keys, further = np.unique(row[more] + count * (rank[more] // WIDTH), return_inverse=True)
    row[more] = count + further.reshape(-1)
    table = np.zeros((count + len(keys), WIDTH), np.int32)
    weights = np.zeros(table.shape)
    table[row, column], weights[row, column] = values, shares
    return table, weights, keys % count
