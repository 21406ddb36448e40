"""Bicubic Bézier patches, such as those of Newell's teapot."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from rts import InputError, Part
from rts.plugin_api.arrays import Array
from rts.plugin_api.checks import index_table
from rts.plugin_api.threads import read_only
from rts_surfaces.patches.bicubic_patches import Patches
from rts_surfaces.patches.parametric import TOLERANCE


class Bezier(Patches):
    """Bicubic Bézier patches on control points that they may share.

    θ["points"] (m, 3) are the control points. "colors" (m, 1, 3 or 4) and "uv" (m, 2) are attributes of control points,
    interpolated as they are. The normal is the cross product of the derivatives along u and v, in this order: it points
    outside where u, v and the outward normal are right-handed.

    Args:
        indices: (n, 16) integers into θ["points"]: the 4 × 4 points of each patch, first along u, then along v.
        tolerance: the largest distance of triangles from the surface near outlines, pixels.

    Raises:
        InputError: indices of another shape, or a tolerance that is not positive.
    """

    def __init__(self, indices: ArrayLike, tolerance: float = TOLERANCE):
        table = index_table("indices", indices, 16)
        super().__init__(table, tolerance, read_only(np.unique(table)))
        self._least = int(self.table.max()) + 1

    def __repr__(self) -> str:
        return f"Bezier({len(self.table)} patches)"

    @classmethod
    def example(cls) -> Part:
        """A wavy sheet of two patches, and a dome above it whose top is a point."""
        heights = np.array([0.1, 0.35, -0.3, 0.2])
        sheet = [(-1.2 + 0.4 * i, -0.8 + 0.5 * j, 0.6 * heights[j] - 0.1 * i) for i in range(7) for j in range(4)]
        ring = [(0.0, 0.0), (0.55, 0.0), (0.6, -0.3), (0.6, -0.6)]
        dome = [
            (r * (1 - 2 * j / 3) * 1.4, r * (0.4 if j in (0, 3) else 1.3), 0.8 + z) for r, z in ring for j in range(4)
        ]
        points = np.array(sheet + dome, np.float32)
        indices = [np.arange(first, first + 16) for first in (0, 12, 28)]
        colors = 0.5 + 0.4 * np.sin(3 * points + [0, 1, 2])
        return Part(cls(indices), {"points": points, "colors": colors.astype(np.float32)}, "lambert")

    @classmethod
    def load(cls, path: Path) -> list[Part]:
        """Load patches as one part, from an .npz or from text in the format of Newell's teapot.

        A text begins with a line that holds the number of patches. A line for each follows: 16 indices of points, from
        1 on, separated by commas or spaces. Then come a line with the number of points, and a line of three coordinates
        for each. An .npz has "indices" (n, 16), from 0 on, and "points" (m, 3). In files of both kinds u × v is assumed
        to point inwards, so u and v are exchanged.

        Rows of θ["points"] are not those of the file: points are sorted, those that coincide exactly become one, and
        those that no patch names are left out.

        Raises:
            InputError: the file is damaged, or its indices refer to points that it lacks.
        """
        indices, points = _arrays(path) if path.suffix.lower() == ".npz" else _text(path)
        if indices.ndim != 2 or indices.shape[1:] != (16,) or points.ndim != 2 or points.shape[1:] != (3,):
            raise InputError(
                f"{path} has indices of shape {indices.shape} and points of shape {points.shape}; expected (n, 16) "
                f"and (m, 3)"
            )
        if not np.isfinite(points).all():
            raise InputError(f"{path} has points that are NaN or infinite; export it again")
        if indices.size == 0 or indices.min() < 0 or indices.max() >= len(points):
            raise InputError(f"{path} has {len(points)} points, but indices from {_range(indices)}; export it again")
        points, place = np.unique(points, axis=0, return_inverse=True)
        table = place.reshape(-1)[indices].reshape(-1, 4, 4).transpose(0, 2, 1).reshape(-1, 16)
        used, table = np.unique(table, return_inverse=True)
        return [Part(cls(table.reshape(-1, 16)), {"points": points[used].astype(np.float32)}, "lambert")]

    def bezier_rows(self, controls: Array) -> Array:
        """The values unchanged, since control points are those of Bézier patches already."""
        return controls

    def control_shape(self, shape: tuple[int, ...]) -> str | None:
        """See `Patches`: one axis, with at least as many rows as the indices need."""
        return None if len(shape) == 1 and shape[0] >= self._least else f"(m, C) with m of at least {self._least}"


def _range(indices: np.ndarray) -> str:
    return f"{indices.min()} to {indices.max()}" if indices.size else "none"


def _arrays(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """The arrays "indices" and "points", in float64, of an .npz, of any shape.

    Raises:
        InputError: it is no .npz with both, or its indices are no integers.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            indices, points = np.asarray(file["indices"]), np.asarray(file["points"], np.float64)
    except Exception as error:  # NumPy and zipfile raise many kinds.
        what = " ".join(str(error).split())[:80]
        raise InputError(f"{path} is no .npz with 'indices' and 'points' ({what}); expected numpy.savez's") from error
    if not np.issubdtype(indices.dtype, np.integer):
        raise InputError(f"{path} has indices of dtype {indices.dtype}; expected integers")
    return indices, points


def _text(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Indices (n, 16), from 0 on, and points (m, 3) float64 of a text in the format of `Bezier.load`.

    Raises:
        InputError: the text is cut short, or a line has other numbers than are expected; lines after the end are
            ignored.
    """
    lines = [(i, t) for i, t in enumerate(path.read_bytes().decode(errors="replace").splitlines(), 1) if t.strip()]
    at = 0

    def rows(kind: Callable, width: int, what: str) -> list[list]:
        nonlocal at
        count = numbers(int, 1, f"the number of {what}")[0]
        if count < 0 or count > len(lines) - at:
            raise InputError(
                f"{path}, line {lines[at - 1][0]}: {count} {what} are promised, {len(lines) - at} lines follow"
            )
        return [numbers(kind, width, what) for _ in range(count)]

    def numbers(kind: Callable, width: int, what: str) -> list:
        nonlocal at
        if at >= len(lines):
            raise InputError(f"{path} ends before {what}; the file may be cut short: export it again")
        (line, text), at = lines[at], at + 1
        try:
            values = [kind(x) for x in text.replace(",", " ").split()]
        except ValueError:
            values = []
        if len(values) != width:
            raise InputError(f"{path}, line {line}: {text.strip()[:40]!r} is not {width} numbers, for {what}")
        return values

    indices = np.array(rows(int, 16, "patches"), np.int64).reshape(-1, 16) - 1
    return indices, np.array(rows(float, 3, "points"), np.float64).reshape(-1, 3)
