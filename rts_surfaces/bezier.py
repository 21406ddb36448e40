"""Bicubic Bézier patches, such as those of Newell's teapot."""

from __future__ import annotations

from typing import Any

import numpy as np

from rts.interfaces import Part
from rts.trees import Array
from rts_surfaces.parametric import TOLERANCE, Patches, check_table


class Bezier(Patches):
    """Bicubic Bézier patches on control points that they may share.

    θ["points"] (m, 3) are the control points. "colors" (m, 1, 3 or 4) and "uv" (m, 2) are attributes of control points,
    interpolated as they are. The normal is that of the derivatives along u and v, in this order: it points outside
    where u, v and the outward normal are right-handed.

    Args:
        indices: (n, 16) integers into θ["points"]: the 4 × 4 points of each patch, first along u, then along v.
        tolerance: pixels that triangles may be off the surface near outlines.

    Raises:
        InputError: indices of another shape, or a tolerance that is not positive.
    """

    def __init__(self, indices: Any, tolerance: float = TOLERANCE):
        super().__init__(check_table("indices", indices), tolerance)
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

    def bezier_rows(self, values: Array) -> Array:
        """The control points themselves."""
        return values

    def control_shape(self, shape: tuple[int, ...]) -> str | None:
        """One row for each control point."""
        return None if len(shape) == 1 and shape[0] >= self._least else f"(m, C) with m of at least {self._least}"
