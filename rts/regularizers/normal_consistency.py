"""The energy `NormalConsistency`, which grows with the angles between normals of faces that share an edge."""

from __future__ import annotations

from typing import Any

import numpy as np

from rts.arrays.engines import engine_of, namespace
from rts.arrays.trees import Array
from rts.errors import InputError
from rts.regularizers.connectivity import pairs_of
from rts.regularizers.regularizer import Regularizer, check_count, combined, known_vertices
from rts.scene.topology import index_table

FLAT = 8.0
"""Least height of a triangle that has a normal, in roundings of its longest side."""


class NormalConsistency(Regularizer):
    """Normals of faces that share an edge: E = Σ (1 − cos θ) over the pairs, without unit; θ is 0 on a flat sheet.

    PyTorch3D (Ravi et al. 2020) takes the mean of these terms in `mesh_normal_consistency`. Where more than two faces
    share an edge, all pairs count. Faces of opposite orientation are compared as if oriented alike. A triangle
    whose height is lost in rounding has no normal, and its pairs add nothing.

    `residuals` is (P, 3): (n₁ − n₂) / √2, of squared length 1 − cos θ. There are P terms, perhaps none.

    Args:
        vertices: (V, 3), as for the other energies; only their number is kept. `NormalConsistency(faces)` will do,
            too, since the energy has no shape at rest.
        faces: (T, 3) integers; copied.

    Attributes:
        pairs: (P, 2) int32 into faces.

    Raises:
        InputError: an argument is of another kind or shape; vertices are traced; faces name missing ones, or no edge.
    """

    def __init__(self, vertices: Any = None, faces: Any = None):
        vertices, faces = (None, vertices) if faces is None else (vertices, faces)
        self.faces = index_table("faces", faces, 3)
        self._count = None if vertices is None else len(known_vertices("vertices", vertices, self.faces))
        self.pairs, alike = pairs_of(self.faces)
        self.terms = len(self.pairs)
        self._least = int(self.faces.max()) + 1
        self._differences = np.stack([np.ones(self.terms), -alike], axis=-1) / np.sqrt(2)
        self._sides = np.concatenate([self.faces[:, [1, 0]], self.faces[:, [2, 0]]])
        self._ends = np.tile([1.0, -1.0], (len(self._sides), 1))

    def __repr__(self) -> str:
        return f"NormalConsistency({self.terms} pairs of faces)"

    def _check_count(self, count: int) -> None:
        if self._count is not None:
            check_count(count, self._count)
        if count < self._least:
            raise InputError(f"vertices have {count} rows; expected {self._least} or more, as faces name them")

    def _residuals(self, vertices: Array) -> Array:
        engine, xp = engine_of(vertices), namespace(vertices)
        normals, lost = self._normals(vertices)
        differences = combined(normals, self.pairs, self._differences)
        first, second = (xp.take(lost, engine.constant(self.pairs[:, i], vertices), axis=0) for i in range(2))
        return xp.where((first | second)[:, None], xp.zeros_like(differences), differences)

    def _normals(self, vertices: Array) -> tuple[Array, Array]:
        """(T, 3) unit normals, zero for triangles without one; and a mask (T,) of these triangles."""
        engine, xp = engine_of(vertices), namespace(vertices)
        sides = combined(vertices, self._sides, self._ends)
        # In units of the longest side, so that neither squares nor their inverses leave the range of float32.
        still = engine.stop_gradient(sides)
        reach = xp.max(xp.abs(still), axis=-1)
        reach = xp.maximum(reach[: len(self.faces)], reach[len(self.faces) :])
        scale = 1 / xp.where(reach > 0, reach, xp.ones_like(reach))[:, None]
        a, b = sides[: len(self.faces)] * scale, sides[len(self.faces) :] * scale
        normals = xp.linalg.cross(a, b)
        square = xp.sum(normals * normals, axis=-1)
        lost = square <= (FLAT * xp.finfo(vertices.dtype).eps) ** 2  # False for NaN, so that it stays.
        length = xp.sqrt(xp.where(lost, xp.ones_like(square), square))
        return xp.where(lost[:, None], xp.zeros_like(normals), normals / length[:, None]), lost
