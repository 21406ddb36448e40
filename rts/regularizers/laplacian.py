"""Laplacian coordinates: how far vertices are from the mean of their neighbours."""

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
"""Neighbours in a row of a table of vertices; most have no more."""


class Laplacian(OfRestShape):
    """Smoothness by Laplacian coordinates: E = Σᵢ |δᵢ|², in squared units of the vertices.

    δᵢ = Σⱼ wᵢⱼ (vⱼ − vᵢ) / Σⱼ |wᵢⱼ| over the neighbours j of vertex i: how far it is from their mean (Sorkine et al.
    2004, *Laplacian Surface Editing*). The weights are 1, or ½ (cot α + cot β) of the two angles opposite the edge at
    rest (Pinkall and Polthier 1993); then δ has the direction of the normal, and that of any linear function on a flat
    sheet is zero inside of it, however uneven the triangles are. At obtuse angles such weights may be negative, hence
    the absolute values. Where more than two faces share an edge all of their angles count, at a border the only one.
    Cotangents are bounded: angles below a twentieth of a degree, and triangles without area, count as of that angle.

    Without `relative` it shrinks and flattens; borders are drawn inwards, too. With it, shifts cost nothing, but
    rotations do: for large ones take `ARAP`.

    `residuals` is (V, 3): δᵢ, or δᵢ − δᵢ at rest. There are V terms; those of vertices without edges are zero.

    Args:
        vertices: (V, 3) finite numbers, the mesh at rest; copied.
        faces: (T, 3) integers into vertices; copied.
        weights: "uniform" or "cotangent".
        relative: whether to compare with the coordinates at rest, which keeps details as they are.

    Attributes:
        edges: (E, 2) int32, the lower vertex first.
        weights: (E,) float64, wᵢⱼ.

    Raises:
        InputError: one of these is something else.
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
        found = combined(steps, self._ids, self._shares)
        if not len(self._further):
            return found
        rest = engine_of(vertices).segment_sum(found[self.terms :, :], self._further, self.terms)
        return found[: self.terms, :] + rest

    def _residuals(self, vertices: Array) -> Array:
        found = self._coordinates(vertices)
        return found if self._at_rest is None else found - engine_of(vertices).constant(self._at_rest, vertices)


def _table(
    vertex: np.ndarray, values: np.ndarray, shares: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What belongs to each vertex, as a table of few columns however many neighbours some vertices have.

    Args:
        vertex: (M,) integers, in order.
        values: (M,) integers that belong to them.
        shares: (M,) float.
        count: the number of vertices.

    Returns:
        Values and shares (count + F, WIDTH), filled up with zeros: a row for each vertex, then further ones; and (F,)
        whose these are.
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
