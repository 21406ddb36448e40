"""Reading OFF, as text."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from rts.errors import InputError
from rts.files.damaged_files import COUNT, Fail, lines_of, text_of, unreadable, warn, without_comment
from rts.files.model_pieces import Piece
from rts.files.ply_reader import numbers_of
from rts.files.polygon_tables import COLORS, Lists, PolygonTables, piece_of


def read_off(path: Path, data: bytes) -> Piece:
    """The mesh of an OFF: vertices, their colours, and polygons.

    Raises:
        InputError: rows are not as many as promised, or not as long; something is no number; a face has less than 3
            corners, or refers to a vertex that is not there; a kind of OFF that is not read (binary, or not of 3 axes).
    """

    def fail(what: str) -> InputError:
        return unreadable(path, "OFF", what)

    text_of(path, "OFF", data)
    numbered = [
        (number, row)
        for number, line in enumerate(lines_of(data), start=1)
        if (row := without_comment(line).strip(" \t\f\v"))
    ]
    first = numbered.pop(0)[1].split() if numbered else [""]
    # The case of an n among capitals counts: nOFF is of n axes, NOFF has normals.
    # Files of ModelNet have no space after the word.
    kind = re.fullmatch(r"(ST)?(C)?(N)?OFF([0-9]*)", first[0].upper() if first[0].islower() else first[0])
    if kind is None or first[1:2] == ["BINARY"]:
        raise fail(
            f"it begins with {' '.join(first)[:40]!r}; expected OFF, perhaps with ST, C or N before it, and text"
        )
    counts = [kind[4], *first[1:]] if kind[4] else first[1:]
    counts = counts or (numbered.pop(0)[1].split() if numbered else [])
    if len(counts) not in (2, 3) or not all(COUNT.fullmatch(c) for c in counts):
        raise fail(f"{' '.join(counts)[:40]!r} are no counts; expected those of vertices, faces and edges")
    vertex_count, face_count = int(counts[0]), int(counts[1])
    if len(numbered) != vertex_count + face_count:
        raise fail(f"it promises {vertex_count} vertices and {face_count} faces, and has {len(numbered)} rows")
    table = _vertices(numbered[:vertex_count], fail)
    begin, width = 6 if kind[3] else 3, table.shape[1]
    colors = table[:, begin : min(begin + 4, width - 2 if kind[1] else width)] if kind[2] else table[:, :0]
    if kind[2] and colors.shape[1] < 3:
        raise fail(f"it promises colours, and the rows of vertices have {width} numbers")
    columns = dict(zip("xyz", table.T, strict=False)) | dict(zip(COLORS, colors.T, strict=False))
    return piece_of(path, PolygonTables(columns, _polygons(path, numbered[vertex_count:], fail), {}), fail)


def _vertices(rows: list[tuple[int, str]], fail: Fail) -> np.ndarray:
    if not rows:
        raise fail("it promises no vertices")
    numbers, bounds = numbers_of(rows, fail)
    lengths = np.diff(bounds)
    short = np.flatnonzero(lengths < max(lengths.max(), 3))
    if len(short):
        number, _ = rows[short[0]]
        raise fail(f"line {number} ought to be a vertex, and has not as many numbers as others, or less than 3")
    return numbers.reshape(len(rows), -1)


def _polygons(path: Path, rows: list[tuple[int, str]], fail: Fail) -> Lists:
    """The number of corners of each face (F,), and the corners of all faces, one after the other, (C,); int64 both."""
    numbers, bounds = numbers_of(rows, fail)
    begins, lengths = bounds[:-1], np.diff(bounds)
    sizes = numbers[begins]
    # The corners of a face, among what follows its size.
    places = np.arange(len(numbers)) - np.repeat(begins, lengths)
    inside = (places > 0) & (places <= np.repeat(sizes, lengths))
    whole = (numbers >= 0) & (numbers < 2**31) & (numbers == np.floor(numbers)) | ~inside
    bad = ~((sizes >= 3) & (sizes < lengths) & (sizes == np.floor(sizes)) & np.logical_and.reduceat(whole, begins))
    beyond = lengths - 1 - sizes
    for row in np.flatnonzero(bad | ~np.isin(beyond, (0, 1, 3, 4)))[:1]:  # Numbers of a colour may follow.
        number, line = rows[row]
        if bad[row]:
            raise fail(f"line {number}, {line[:60]!r}, is no face: how many corners, at least 3, and their indices")
        raise fail(f"line {number} promises a face of {sizes[row]:g} corners, and has {beyond[row]:g} numbers too many")
    if beyond.any():
        warn(
            f"{path}: {int((beyond > 0).sum())} faces have numbers after their corners; if those are colours, they are "
            "not loaded"
        )
    return sizes.astype(np.int64), numbers[inside].astype(np.int64)
