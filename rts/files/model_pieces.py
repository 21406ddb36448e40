"""Pieces: the arrays of a model file as the file has them, before welding and colour decoding."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from rts.arrays.argument_checks import quoted
from rts.errors import InputError

WIDTHS = {"vertices": (3,), "uv": (2,), "normals": (3,), "tangents": (4,), "colors": (3, 4)}
"""Numbers in a row of each table; other tables are coordinates of maps, as "uv" is."""
LARGEST = float(np.finfo(np.float32).max)
CULLS = ("none", "back", "file")
SINGULAR = 1e-9
"""Least volume of a transform's parallelepiped, as a share of the product of its edges."""


class Piece(NamedTuple):
    """One mesh of a model file.

    Attributes:
        vertices: (V, 3) float, local space.
        faces: (T, 3) int into `vertices`.
        attributes: "uv", "normals", "tangents", "colors", and `own_uv` of maps with coordinates of their own → rows
            (A, C) and (T, 3) int into them, each where the file has it. Colours are in [0, 1], as encoded in the file.
        texture: (h, w, 3 or 4) float32 in [0, 1], sRGB, alpha straight; or None.
        color: (3,) or (4,) factor of the material, as encoded in the file; or None.
        linear: True if `color` and the attribute "colors" are linear rather than sRGB.
        transform: (4, 4) scene-from-local, or None.
        entries: further entries of θ, for the shader `pbr`; None for other shaders.
        options: of the shader, "wrap", "filter" and "samplers"; empty for its defaults.
        unlit: True if it has no light.
        one_sided: True if the file says that it is not seen from behind.
    """

    vertices: np.ndarray
    faces: np.ndarray
    attributes: dict[str, tuple[np.ndarray, np.ndarray]]
    texture: np.ndarray | None = None
    color: np.ndarray | None = None
    linear: bool = False
    transform: np.ndarray | None = None
    entries: dict[str, np.ndarray] | None = None
    options: Mapping[str, Any] = MappingProxyType({})
    unlit: bool = False
    one_sided: bool = False


def check_piece(path: Path, piece: Piece) -> None:
    """Refuse a piece, of at least one face, by an InputError.

    Refused are indices that refer to no row, tables of other widths than `WIDTHS`, values not finite in float32, and
    transforms with a fault (`fault_of`) or that take vertices beyond float32.
    """
    tables = {"vertices": (piece.vertices, piece.faces), **piece.attributes}
    for name, (rows, table) in tables.items():
        widths = WIDTHS.get(name, WIDTHS["uv"])
        if rows.ndim != 2 or rows.shape[1] not in widths:
            raise InputError(
                f"{path}: {name} has shape {rows.shape}; expected {widths[0]} numbers a row: repair the file"
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
    if piece.transform is not None:
        fault = fault_of(piece.transform)
        with np.errstate(over="ignore", invalid="ignore"):
            reach = np.abs(piece.transform[:3]) @ np.append(np.abs(piece.vertices).max(axis=0), 1)
        if not fault and not reach.max() <= LARGEST:
            fault = "takes vertices beyond float32"
        if fault:
            raise InputError(f"{path}: a transform of its scene {fault}; repair the file")


def fault_of(matrix: np.ndarray) -> str:
    """The fault of a transform (4, 4), as the end of a sentence; "" if it can be applied, and undone."""
    if not np.isfinite(matrix).all():
        return "holds NaN or infinity"
    if np.abs(matrix[3] - [0, 0, 0, 1]).max() > 1e-5:
        return f"has the last row {matrix[3].tolist()}; expected 0, 0, 0, 1"
    linear = matrix[:3, :3]
    lengths = np.linalg.norm(linear, axis=0)
    if np.abs(matrix).max() > LARGEST or 0 < lengths.min() < 1 / LARGEST:
        return "is too large or too small for float32"
    if not abs(np.linalg.det(linear)) > SINGULAR * np.prod(lengths):
        return "is singular: it makes things flat"
    return ""


def check_cull(cull: str) -> None:
    """Refuse what is none of `CULLS`."""
    if not isinstance(cull, str) or cull not in CULLS:
        raise InputError(f"cull is {quoted(cull)}; expected {', '.join(CULLS)}")


def cull_of(piece: Piece, cull: str) -> str:
    """`Part.cull` of a piece, for an argument of `load`."""
    return "back" if cull == "back" or (cull == "file" and piece.one_sided) else "none"
