"""Parameters of a mesh's vertices whose gradient steps are smooth: `LargeSteps`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from rts.arrays.argument_checks import check_positive, quoted
from rts.arrays.array_functions import described, from_numbers, shape_of
from rts.arrays.engines import engine_of, namespace, uncompiled
from rts.arrays.trees import Array
from rts.contracts.checks import is_count
from rts.errors import InputError, warn_deprecated
from rts.operations.operation import Arrays, Operation, Some
from rts.regularizers.laplacian import Laplacian
from rts.regularizers.regularizer import known_vertices
from rts.scene.topology import index_table

LARGEST = 1e5
"""The largest smoothness: steps reach some √λ edges far, and float32 keeps few digits beyond."""


class LargeSteps:
    """Parameters u = (I + λL) v of a mesh's vertices v, in which steps of a gradient are smooth.

    An image pulls at single vertices, so descent by vertices crumples a mesh. Descent by u moves each vertex along with
    its neighbours, some √λ edges far: start from `encode(vertices)`, and render `decode(u)` (Nicolet, Jacobson and
    Jakob 2021, *Large Steps in Inverse Rendering of Geometry*). Any shape can be reached, and nothing is added to the
    loss. Adam is the optimiser to take. L is the combinatorial Laplacian: (L v)ᵢ is the sum of vᵢ − vⱼ over the
    neighbours j of vertex i. A vertex of no face stays as it is, v = u.

    The matrix is factorised once, here, in float64 (SciPy). `decode` solves with it on the host. On other devices, and
    for second derivatives, array code takes Chebyshev's iteration, whose time and rounding grow with λ.

    Args:
        vertices: (V, 3) finite numbers, as for `rts.regularizers`; only their number is kept.
        faces: (T, 3) integers into vertices; copied. `LargeSteps(faces, count)`, the order of 0.2, warns until 0.4.
        smoothness: λ, positive, at most 1e5. The default is the paper's, 19; the paper's other form
            (1 − α) I + αL, but for a factor, has λ = α / (1 − α), here α = 0.95.

    Attributes:
        faces: (T, 3) int32, read-only.
        count: V.
        smoothness: λ.

    Raises:
        InputError: an argument is of another kind or shape; vertices are traced; faces name missing ones, or no edge;
            the smoothness is traced or out of range.
    """

    def __init__(self, vertices: Any = None, faces: Any = None, smoothness: float = 19.0, *, count: Any = None):
        if count is not None or is_count(faces):
            warn_deprecated("LargeSteps(faces, count)", "LargeSteps(vertices, faces)", until="0.4")
            count, faces = (faces, vertices) if count is None else (count, vertices if faces is None else faces)
            if not is_count(count):
                raise InputError(f"count is {quoted(count)}; expected the number of vertices, a positive integer")
            vertices = np.zeros((count, 3))
        self.faces = index_table("faces", faces, 3)
        self.count = len(known_vertices("vertices", vertices, self.faces))
        number = check_positive("smoothness", smoothness)
        if number is None or number > LARGEST:
            value = "traced" if number is None else quoted(smoothness)
            raise InputError(f"smoothness is {value}; expected a known number of at most {LARGEST:g}")
        self.smoothness = float(number)
        self._laplacian = Laplacian(np.zeros((self.count, 3)), self.faces)
        edges = self._laplacian.edges
        degrees = np.bincount(edges.reshape(-1), minlength=self.count)
        # `Laplacian` divides by the number of neighbours, and has the other sign.
        self._factors = -self.smoothness * degrees[:, None].astype(np.float64)
        # Anderson and Morley 1985: no eigenvalue of L is larger than the largest sum of degrees along an edge.
        self._spread = self.smoothness * float(degrees[edges].sum(axis=1).max())
        self._solve = _factorised(edges, 1 + self.smoothness * degrees, self.smoothness)

    def __repr__(self) -> str:
        return f"LargeSteps({self.count} vertices, smoothness {self.smoothness:g})"

    def __reduce__(self) -> tuple[type, tuple]:
        return type(self), (np.zeros((self.count, 3)), self.faces, self.smoothness)  # A factorisation cannot be copied.

    @uncompiled
    def encode(self, vertices: Array) -> Array:
        """Parameters u (V, 3) of vertices, for which `decode(u)` gives them back; see the class.

        Args:
            vertices: (V, 3) float32 or float64, in any units, an array of any engine. The result has the same units,
                engine, dtype and device.

        Raises:
            InputError: the number, shape or dtype of the vertices is wrong.
        """
        return self._times(self._checked("vertices", vertices))

    @uncompiled
    def decode(self, u: Array) -> Array:
        """Vertices (V, 3) of parameters, differentiable in both modes; see the class.

        Args:
            u: (V, 3) float32 or float64, as `encode` gives. The result has the same units, engine, dtype and device.

        Raises:
            InputError: the number, shape or dtype of the parameters is wrong.
        """
        return SOLVE(self._checked("u", u), steps=self)

    def _checked(self, name: str, rows: Any) -> Array:
        shape = shape_of(rows := from_numbers(rows, name))
        if shape != (self.count, 3):
            raise InputError(f"{name} {described(rows)}; expected ({self.count}, 3), a row for each vertex")
        xp = namespace(rows)
        if not xp.isdtype(rows.dtype, "real floating") or xp.finfo(rows.dtype).bits < 32:
            raise InputError(f"{name} has dtype {rows.dtype}; expected float32 or float64")
        return rows

    def _times(self, rows: Array) -> Array:
        """The product (I + λL) rows, (V, 3)."""
        return rows + engine_of(rows).constant(self._factors, rows) * self._laplacian.residuals(rows)

    def _solved(self, rows: np.ndarray) -> np.ndarray:
        """The inverse of I + λL times rows (…, V, 3), float64."""
        columns = np.moveaxis(rows, -2, 0)
        found = self._solve(columns.reshape(self.count, -1).astype(np.float64))
        return np.moveaxis(found.reshape(columns.shape), 0, -2)


def _factorised(edges: np.ndarray, diagonal: np.ndarray, smoothness: float) -> Any:
    """A function (V, C) → (V, C), float64, that solves with a symmetric positive definite matrix.

    Args:
        edges: (E, 2) integers, each edge once.
        diagonal: (V,), the matrix's diagonal.
        smoothness: λ; the matrix has −λ at both ends of an edge, and zeros elsewhere.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.linalg import splu

    vertices, ends = np.arange(len(diagonal)), np.concatenate([edges, edges[:, ::-1]])
    rows, columns = np.concatenate([np.stack([vertices, vertices], axis=-1), ends]).T
    values = np.concatenate([diagonal, np.full(len(ends), -smoothness)])
    matrix = coo_array((values, (rows, columns)), shape=(len(vertices), len(vertices))).tocsc()
    # The matrix is positive definite: an order made for symmetric matrices, and pivots from the diagonal.
    return splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}).solve


def _specification(u: Array, *, steps: LargeSteps) -> Array:
    """Vertices v (V, 3) with (I + λL) v = u (V, 3), up to the dtype's rounding; array code, linear in u.

    Chebyshev's iteration (Saad 2003, *Iterative Methods for Sparse Linear Systems*, algorithm 12.1).
    """
    half = steps._spread / 2
    middle, root = 1 + half, math.sqrt(1 + 2 * half)  # Eigenvalues are from 1 to 1 + 2 · half.
    eps = float(namespace(u).finfo(u.dtype).eps)
    shrinking = max((root - 1) / (root + 1), eps)  # Of the error, in each round.
    vertices, rest = u, u - steps._times(u)
    step, ratio = rest / middle, half / middle
    for _ in range(math.ceil(math.log(eps / 2) / math.log(shrinking))):
        vertices, rest = vertices + step, rest - steps._times(step)
        following = 1 / (2 * middle / half - ratio)
        step, ratio = following * ratio * step + 2 * following / half * rest, following
    return vertices


def _shape(u: tuple[int, ...], **_: object) -> tuple[int, ...]:
    return u


def _forward(operands: Arrays, out: np.ndarray, *, steps: LargeSteps) -> None:
    out[...] = steps._solved(operands[0])


def _push(operands: Arrays, tangents: Sequence[np.ndarray], out: np.ndarray, *, steps: LargeSteps) -> None:
    # Only this operand has a derivative, so its tangent is always there.
    out[...] = steps._solved(tangents[0])


def _pull(operands: Arrays, g: np.ndarray, results: Some, *, steps: LargeSteps) -> None:
    if results[0] is not None:
        results[0][...] = steps._solved(g)  # The matrix is symmetric.


SOLVE = Operation("rts.large_steps", _specification, (2,), _shape, _forward, _push, _pull, sweeps=True)
"""The operation of `LargeSteps.decode`, on u. The parameter `steps` is the `LargeSteps`."""
