"""The energy `ARAP`, as rigid as possible: bending a mesh costs nothing, stretching it does."""

from __future__ import annotations

from typing import Any

import numpy as np

from rts.arrays.engines import engine_of
from rts.arrays.trees import Array
from rts.contracts.records import ArraySpec
from rts.regularizers.connectivity import both_ways, edge_weights
from rts.regularizers.regularizer import OfRestShape, combined


class ARAP(OfRestShape):
    """The energy of as-rigid-as-possible deformation (Sorkine and Alexa 2007, eq. 3), in squared units of the vertices.

    E = Σᵢ Σⱼ wᵢⱼ |(vᵢ − vⱼ) − Rᵢ (pᵢ − pⱼ)|² over the vertices i and their neighbours j, so that each edge counts from
    both of its ends. p are the vertices at rest. Rᵢ is the rotation that minimises the sum of vertex i: it brings
    the edges at rest nearest to the present edges. libigl calls this variant *spokes*.

    Rotations are computed anew at each call, and no derivative passes through them. The gradient is nevertheless exact:
    at the best rotation the derivative of the sum in R is zero (the envelope theorem). Rotations are not unique at
    vertices with one neighbour, or with edges in a line; one of the best is taken there, and the gradient stays finite.
    The Jacobian of `residuals` and second derivatives hold rotations fixed. A Gauss–Newton step is then the *global
    step* of the paper, which never raises the energy.

    Cotangent weights are ½ (cot α + cot β) of the two angles opposite the edge at rest. Negative ones, between obtuse
    angles, are set to 0, so that the energy is not negative. Where more than two faces share an edge, all of their
    angles count; at a border the only one. Cotangents are bounded: angles below a twentieth of a degree count as that,
    and so do triangles without area. Uniform weights are 1.

    `residuals` is (2E, 3): √wᵢⱼ ((vᵢ − vⱼ) − Rᵢ (pᵢ − pⱼ)), ordered by i. There are 2E terms.

    Args:
        vertices: (V, 3) finite numbers, the mesh at rest; copied.
        faces: (T, 3) integers into vertices; copied.
        weights: "cotangent" or "uniform".

    Attributes:
        edges: (E, 2) int32, the lower vertex first.
        weights: (E,) float64, wᵢⱼ, at least 0.

    Raises:
        InputError: an argument is of another kind or shape; vertices are traced; faces name missing ones, or no edge.
    """

    def __init__(self, vertices: Any, faces: Any, weights: str = "cotangent"):
        super().__init__(vertices, faces)
        self.edges, edge_values = edge_weights(weights, self._rest, self.faces)
        self.weights = np.maximum(edge_values, 0.0)
        self._ids, number = both_ways(self.edges)
        self.terms = len(self._ids)
        root = np.sqrt(self.weights[number])
        self._roots = np.stack([root, -root], axis=-1)
        self._at_rest = root[:, None] * (self._rest[self._ids[:, 0]] - self._rest[self._ids[:, 1]])
        self._starts = np.searchsorted(self._ids[:, 0], np.arange(len(self._rest) + 1))

    def __repr__(self) -> str:
        return f"ARAP({len(self._rest)} vertices, {len(self.edges)} edges)"

    def _residuals(self, vertices: Array) -> Array:
        engine = engine_of(vertices)
        spokes = combined(vertices, self._ids, self._roots)
        still = engine.stop_gradient(spokes)
        return spokes - engine.by_host(self._turned_by_host, self._turned, still)[0]

    def _turned_by_host(self, spokes: Array) -> tuple[Array, ...]:
        """A tuple of one: edges at rest (2E, 3), times roots of their weights, rotated to fit `spokes`; by a loop."""
        engine = engine_of(spokes)
        dtype = np.float64 if engine.namespace.finfo(spokes.dtype).bits == 64 else np.float32

        def host(array: np.ndarray) -> tuple[np.ndarray]:
            from rts.regularizers import arap_loops

            return (arap_loops.turned(array, self._at_rest, self._starts),)

        return engine.call_host(host, [ArraySpec((self.terms, 3), dtype)], spokes)

    def _turned(self, spokes: Array) -> tuple[Array, ...]:
        """The result of `_turned_by_host` in array code: rotations by singular values, as in the paper (eq. 6)."""
        engine, count = engine_of(spokes), len(self._rest)
        xp, rest = engine.namespace, engine.constant(self._at_rest, spokes)
        products = xp.reshape(spokes[:, :, None] * rest[:, None, :], (-1, 9))
        sums = xp.reshape(engine.segment_sum(products, self._ids[:, 0].copy(), count), (-1, 3, 3))
        u, _, v = xp.linalg.svd(sums, full_matrices=False)
        sign = (xp.linalg.det(u) * xp.linalg.det(v))[:, None, None]  # −1 for reflections.
        u = xp.concat([u[:, :, :2], u[:, :, 2:] * sign], axis=2)
        rotations = xp.sum(u[:, :, :, None] * v[:, None, :, :], axis=2)
        of_spokes = xp.take(rotations, engine.constant(self._ids[:, 0], spokes), axis=0)
        return (xp.sum(of_spokes * rest[:, None, :], axis=2),)
