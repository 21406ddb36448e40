"""The base of all energies: a sum of squares of residuals, which are functions of a mesh's vertices."""

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

    Vertices (V, 3) are float32 or float64 arrays. NumPy's give the value; those of torch and jax have derivatives too,
    compiled and in batches (`vmap`). The result is of their engine, dtype and device. What is known of the mesh is kept
    as NumPy arrays. Vertices that are not finite give an energy that is not.

    The energy is a sum, as in the papers, and grows with the number of vertices; `energy(vertices) / energy.terms` is a
    mean.

    Attributes:
        faces: (T, 3) int32, read-only.
        terms: how many terms the sum has: edges, vertices or pairs of faces, as each class says.
    """

    faces: np.ndarray
    terms: int

    def __call__(self, vertices: Array) -> Array:
        """The energy, a scalar.

        Args:
            vertices: (V, 3) float32 or float64.

        Raises:
            InputError: vertices of another number, shape or dtype.
        """
        found = self.residuals(vertices)
        return namespace(found).sum(found * found)

    @uncompiled
    def residuals(self, vertices: Array) -> Array:
        """Residuals whose sum of squares is the energy, such as `rts.fit(method="lm")` takes; see the class.

        Args:
            vertices: (V, 3) float32 or float64.

        Raises:
            InputError: vertices of another number, shape or dtype.
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
        """`residuals` of vertices that have been checked."""


class OfRestShape(Regularizer):
    """An energy that is told a mesh at rest.

    Args:
        vertices: (V, 3) finite numbers, an array of any engine; copied, without derivatives.
        faces: (T, 3) integers into vertices; copied.

    Raises:
        InputError: one of these is something else.
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
    """A copy (V, 3) float64 of the values of vertices at rest, refused where faces name others."""
    shape = shape_of(vertices := from_numbers(vertices, name))
    if len(shape) != 2 or shape[1] != 3 or not shape[0]:
        raise InputError(f"{name} is {quoted(vertices)}; expected (V, 3) numbers, at least one row")
    known = check_numbers(name, vertices, shape)
    if known is None:
        raise InputError(f"{name} is traced; make the energy outside of jit and vmap, or give it NumPy arrays")
    if faces.max() >= len(known):
        raise InputError(
            f"faces name vertex {faces.max()}, but there are {len(known)} vertices; check the indices (they count from "
            f"0)"
        )
    return np.array(known, np.float64)


def combined(rows: Array, ids: np.ndarray, weights: np.ndarray) -> Array:
    """(N, C): Σᵢ wᵢ rowᵢ of rows (V, C), with ids and weights (N, I) that are the mesh's own."""
    engine = engine_of(rows)
    weights_, ids_ = engine.constant(weights, rows), engine.constant(ids, rows)
    return COMBINE(rows, weights_, ids_, column=0, count=ids.shape[1], affine=False)
