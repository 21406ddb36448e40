"""The energy `EdgeLength`, which holds the edges of a mesh to a length."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from rts.arrays.argument_checks import quoted
from rts.arrays.engines import engine_of, namespace
from rts.arrays.trees import Array
from rts.contracts.checks import is_real
from rts.errors import InputError
from rts.regularizers.connectivity import edges_of
from rts.regularizers.regularizer import OfRestShape, combined

NAMED = ("rest", "mean")


class EdgeLength(OfRestShape):
    """Lengths of edges: E = Σ (|eᵢⱼ| − lᵢⱼ)² over the edges, in squared units of the vertices.

    With a number for l it is the edge loss of Pixel2Mesh (Wang et al. 2018, §3.4, with l = 0) and of PyTorch3D
    (`mesh_edge_loss`, a mean). An edge counts once, even if several faces share it. The derivative of an edge of length
    zero is zero.

    `residuals` is (E,): |eᵢⱼ| − lᵢⱼ. There are E terms.

    Args:
        vertices: (V, 3) finite numbers, the mesh at rest; copied.
        faces: (T, 3) integers into vertices; copied.
        target: the lengths l: "rest", the length of each edge at rest; "mean", the present mean length of all edges,
            for even edges of any length; or a number.

    Attributes:
        edges: (E, 2) int32, the lower vertex first.

    Raises:
        InputError: an argument is of another kind or shape; vertices are traced; faces name missing ones, or no edge.
    """

    def __init__(self, vertices: Any, faces: Any, target: str | float = "rest"):
        super().__init__(vertices, faces)
        valid = target in NAMED if isinstance(target, str) else is_real(target) and 0 <= target < math.inf
        if not valid:
            raise InputError(f"target is {quoted(target)}; expected 'rest', 'mean' or a length, at least 0")
        self.edges, _ = edges_of(self.faces)
        self.terms = len(self.edges)
        self._ends = np.tile([1.0, -1.0], (self.terms, 1))
        self._target = None
        if target != "mean":
            at_rest = np.linalg.norm(self._rest[self.edges[:, 0]] - self._rest[self.edges[:, 1]], axis=1)
            self._target = at_rest if target == "rest" else np.full(self.terms, float(target))

    def __repr__(self) -> str:
        return f"EdgeLength({self.terms} edges)"

    def _residuals(self, vertices: Array) -> Array:
        lengths = norms(combined(vertices, self.edges, self._ends))
        if self._target is None:
            return lengths - namespace(lengths).mean(lengths)
        return lengths - engine_of(vertices).constant(self._target, vertices)


def norms(vectors: Array) -> Array:
    """(N,) lengths of vectors (N, 3); the derivative of a length of zero is zero."""
    xp = namespace(vectors)
    square = xp.sum(vectors * vectors, axis=-1)
    some = square != 0  # True for NaN, so that it stays.
    return xp.where(some, xp.sqrt(xp.where(some, square, xp.ones_like(square))), xp.zeros_like(square))
