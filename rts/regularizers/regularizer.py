"""The base class of energies, which are sums of squares of functions of a mesh's vertices."""

from __future__ import annotations

import abc
from typing import Any

import numpy as np

from rts.arrays.argument_checks import check_numbers, quoted
from rts.arrays.array_functions import described, from_numbers, shape_of
from rts.arrays.engines import engine_of, namespace, uncompiled
from rts.arrays.trees import Array
from rts.errors import InputError
from rts.operations.combine import COMBINE
from rts.scene.topology import index_table


class Regularizer(abc.ABC):
    """An energy of a mesh's vertices: the sum of squares of its residuals.

    Vertices (V, 3) are float32 or float64 arrays. NumPy arrays give the value; torch and jax arrays have derivatives,
    too, compiled and in batches (`vmap`). The result has the engine, dtype and device of the vertices. Data of the mesh
    itself is kept as NumPy arrays. If vertices are not finite, neither is the energy.

    The energy is a sum, as in the papers, and grows with the number of vertices; `energy(vertices) / energy.terms` is a
    mean.

    Attributes:
        faces: (T, 3) int32, read-only.
        terms: number of terms of the sum: edges, vertices or pairs of faces, see each class.
    """

    faces: np.ndarray
    terms: int

    def __call__(self, vertices: Array) -> Array:
        """The energy, a scalar.

        Args:
            vertices: (V, 3) float32 or float64.

        Raises:
            InputError: the number, shape or dtype of the vertices is wrong.
        """
        residuals = self.residuals(vertices)
        return namespace(residuals).sum(residuals * residuals)

    @uncompiled
    def residuals(self, vertices: Array) -> Array:
        """Residuals whose sum of squares is the energy, for `rts.fit(method="lm")`; each class says of which shape.

        Args:
            vertices: (V, 3) float32 or float64.

        Raises:
            InputError: the number, shape or dtype of the vertices is wrong.
        """
        vertices = from_numbers(vertices, "vertices")
        shape = shape_of(vertices)
        if len(shape) != 2 or shape[1] != 3:
            raise InputError(f"vertices {described(vertices)}; expected (V, 3)")
        xp = namespace(vertices)
        if not xp.isdtype(vertices.dtype, "real floating") or xp.finfo(vertices.dtype).bits < 32:
            raise InputError(f"vertices have dtype {vertices.dtype}; expected float32 or float64")
        self._check_count(shape[0])
        return self._residuals(vertices)

    @abc.abstractmethod
    def _check_count(self, count: int) -> None:
        """Raise an InputError for another number of vertices than the mesh has."""

    @abc.abstractmethod
    def _residuals(self, vertices: Array) -> Array:
        """The residuals of checked vertices; see `residuals`."""


class OfRestShape(Regularizer):
    """An energy relative to a mesh at rest.

    Args:
        vertices: (V, 3) finite numbers, an array of any engine; copied, without derivatives.
        faces: (T, 3) integers into vertices; copied.

    Raises:
        InputError: an argument is of another kind or shape; vertices are traced; faces name missing vertices.
    """

    def __init__(self, vertices: Any, faces: Any):
        self.faces = index_table("faces", faces, 3)
        self._rest = known_vertices("vertices", vertices, self.faces)

    def _check_count(self, count: int) -> None:
        check_count(count, len(self._rest))


def check_count(count: int, expected: int) -> None:
    """Raise an InputError for another number of vertices than the mesh at rest has."""
    if count != expected:
        raise InputError(f"vertices have {count} rows; expected {expected}, as the mesh at rest has")


def known_vertices(name: str, vertices: Any, faces: np.ndarray) -> np.ndarray:
    """A copy (V, 3) float64 of vertices at rest.

    Raises:
        InputError: vertices are not (V, 3) finite numbers, or traced; faces name a vertex that does not exist.
    """
    shape = shape_of(vertices := from_numbers(vertices, name))
    if len(shape) != 2 or shape[1] != 3 or not shape[0]:
        raise InputError(f"{name} is {quoted(vertices)}; expected (V, 3) numbers, at least one row")
    values = check_numbers(name, vertices, shape)
    if values is None:
        raise InputError(f"{name} is traced; make it outside of jit and vmap, or give it NumPy arrays")
    if faces.max() >= len(values):
        raise InputError(
            f"faces name vertex {faces.max()}, but there are {len(values)} vertices; check the indices (they count "
            f"from 0)"
        )
    return np.array(values, np.float64)


def combined(rows: Array, ids: np.ndarray, weights: np.ndarray) -> Array:
    """(N, C): Σᵢ wᵢ rowᵢ of rows (V, C), with constant ids and weights (N, I)."""
    engine = engine_of(rows)
    weights_, ids_ = engine.constant(weights, rows), engine.constant(ids, rows)
    return COMBINE(rows, weights_, ids_, column=0, count=ids.shape[1], affine=False)
