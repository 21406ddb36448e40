"""Pieces: the arrays of a model file as the file has them, before welding and colour decoding."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from rts.errors import InputError

WIDTHS = {"vertices": (3,), "uv": (2,), "normals": (3,), "colors": (3, 4)}
"""How many numbers the rows of each table have."""


class Piece(NamedTuple):
    """One mesh of a model file.

    Attributes:
        vertices: (V, 3) float, local space.
        faces: (T, 3) int into `vertices`.
        attributes: "uv", "normals", "colors" → rows (A, C) and (T, 3) int into them, each where the file has
            it. Colours are in [0, 1], as encoded in the file.
        texture: (h, w, 3 or 4) float32 in [0, 1], sRGB, alpha straight; or None.
        color: (3,) or (4,) factor of the material, as encoded in the file; or None.
        linear: whether `color` and the attribute "colors" are linear rather than sRGB.
        transform: (4, 4) scene-from-local, or None.
    """

    vertices: np.ndarray
    faces: np.ndarray
    attributes: dict[str, tuple[np.ndarray, np.ndarray]]
    texture: np.ndarray | None = None
    color: np.ndarray | None = None
    linear: bool = False
    transform: np.ndarray | None = None


def check_piece(path: Path, piece: Piece) -> None:
    """Refuse indices that refer to nothing, rows of another width, and values that are not finite in float32."""
    tables = {"vertices": (piece.vertices, piece.faces), **piece.attributes}
    for name, (rows, table) in tables.items():
        if rows.ndim != 2 or rows.shape[1] not in WIDTHS[name]:
            raise InputError(
                f"{path}: {name} has shape {rows.shape}; expected {WIDTHS[name][0]} numbers a row: repair the file"
            )
        if table.min() < 0 or table.max() >= len(rows):
            bad = table.max() if table.max() >= len(rows) else table.min()
            raise InputError(f"{path}: a face refers to row {bad} of {name}, which has {len(rows)}; repair the file")
        with np.errstate(over="ignore"):
            wrong = np.flatnonzero(~np.isfinite(np.asarray(rows, np.float32)).all(axis=1))
        if len(wrong):
            raise InputError(
                f"{path}: {len(wrong)} of {len(rows)} rows of {name} are NaN, infinite or too large for "
                f"float32, the first is row {wrong[0]}; repair the file"
            )
    if piece.transform is not None and not np.isfinite(piece.transform).all():
        raise InputError(f"{path}: a transform of its scene holds NaN or infinity; repair the file")
