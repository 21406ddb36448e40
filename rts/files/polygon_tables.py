"""Meshes of polygons as PLY and OFF have them, in tables of vertices and of faces; and the pieces that they make."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from rts.files import polygons
from rts.files.damaged_files import Fail, warn
from rts.files.model_pieces import Piece

Lists = tuple[np.ndarray, np.ndarray]
"""Lists of different lengths: the length of each, and the entries of all, one list after the other."""
COLORS: tuple[str, ...] = ("red", "green", "blue", "alpha")
UV = (("texture_u", "texture_v"), ("u", "v"), ("s", "t"))
"""Names that columns of texture coordinates have."""


class PolygonTables(NamedTuple):
    """The tables of a file of polygons.

    Attributes:
        vertices: columns (V,) by name, "x", "y" and "z" among them.
        faces: corners of polygons, integers into the vertices.
        per_face: columns (F,) by name.
        texcoord: two numbers for each corner of each face, (C, 2), or None.
    """

    vertices: dict[str, np.ndarray]
    faces: Lists
    per_face: dict[str, np.ndarray]
    texcoord: np.ndarray | None = None


def piece_of(path: Path, tables: PolygonTables, fail: Fail) -> Piece:
    """The triangles of a mesh of polygons; none, where it has no faces.

    Args:
        path: the path of its file, for warnings.
        tables: the mesh.
        fail: text → error.

    Raises:
        InputError: a face has less than 3 corners, or refers to a missing vertex; colours are no colours.
    """
    columns, (sizes, corners) = tables.vertices, tables.faces
    points, count = _stacked(columns, "xyz"), len(columns["x"])
    if (sizes < 3).any():
        raise fail(f"face {int(np.argmax(sizes < 3))} has {int(sizes[sizes < 3][0])} corners; expected at least 3")
    strange = (corners < 0) | (corners >= count)
    if strange.any():
        face = int(np.searchsorted(np.cumsum(sizes), np.argmax(strange), side="right"))
        raise fail(f"face {face} refers to vertex {int(corners[strange][0])} of {count}, which count from 0")
    triangles, owner, forced = polygons.cut(points, corners, sizes)
    if forced:
        warn(f"{path}: {forced} polygons cross themselves and may be cut wrongly; export triangles to be sure")
    faces = corners[triangles].astype(np.int64)
    attributes = {}
    if {"nx", "ny", "nz"} <= set(columns):
        attributes["normals"] = _stacked(columns, ("nx", "ny", "nz")), faces
    if tables.texcoord is not None:
        attributes["uv"] = tables.texcoord, triangles
    else:
        for names in UV:
            if set(names) <= set(columns):
                attributes.setdefault("uv", (_stacked(columns, names), faces))
    colors, of_faces = _colors(columns, "vertex", fail), _colors(tables.per_face, "face", fail)
    if colors is not None:
        attributes["colors"] = colors, faces
    elif of_faces is not None:
        attributes["colors"] = of_faces[owner], np.repeat(np.arange(len(faces))[:, None], 3, axis=1)
    return Piece(points, faces, attributes)


def _stacked(columns: dict[str, np.ndarray], names: tuple[str, ...] | str) -> np.ndarray:
    return np.stack([columns[name].astype(np.float64) for name in names], axis=1)


def _colors(columns: dict[str, np.ndarray], element: str, fail: Fail) -> np.ndarray | None:
    """Colours (R, 3 or 4) from 0 to 1, in steps of 1/255; None if red, green or blue is missing.

    Integers are from 0 to 255 or, of 16 bits, to 65535; floating numbers from 0 to 1, or to 255. Others are refused.
    """
    if not {"red", "green", "blue"} <= set(columns):
        return None
    names = [name for name in COLORS if name in columns]
    rows = []
    for name in names:
        values, kind = np.asarray(columns[name], np.float64), columns[name].dtype.kind
        # Alpha may be of another kind than the others.
        top = max(columns[other].max(initial=0) for other in names if columns[other].dtype.kind == kind)
        limit = 65535.0 if columns[name].dtype == np.uint16 and top > 255 else 255.0
        wrong = ~((values >= 0) & (values <= limit))
        if wrong.any():
            row = int(np.argmax(wrong))
            raise fail(
                f"row {row} of {element} has {name} = {values[row]:g}; expected colours from 0 to 1, or from 0 to 255"
            )
        rows.append(np.round(values * (255.0 if kind == "f" and top <= 1 else 255 / limit)) / 255)
    return np.stack(rows, axis=1)
