"""Checks of OFF and STL files before trimesh reads them, which does not compare data with the header."""

from __future__ import annotations

import re
import struct
from pathlib import Path

import numpy as np

from rts.errors import InputError
from rts.files.damaged_files import COUNT, lines_of, unreadable, warn, without_comment
from rts.files.ply_tables import Fail, Mesh, numbers_of, written

_NUMBER = r"[-+]?(?:\d+\.?\d*(?:e[-+]?\d+)?|\.\d+(?:e[-+]?\d+)?|nan|inf(?:inity)?)"
_VERTEX = rf"vertex(?:[ \t]+{_NUMBER}){{3}}[ \t]*\n\s*"
_FACET = re.compile(
    rf"facet(?:\s+normal(?:[ \t]+\S+){{3}})?\s+outer\s+loop\s+{_VERTEX * 3}endloop\s+endfacet\b\s*",
    re.IGNORECASE | re.ASCII,
)
_SOLID = re.compile(r"\s*solid\b([^\n]*)\n\s*", re.IGNORECASE | re.ASCII)
_END = re.compile(r"endsolid\b[^\n]*\n?\s*", re.IGNORECASE | re.ASCII)
_RECORD = np.dtype([("normal", "<f4", 3), ("corners", "<f4", 9), ("more", "<u2")])
TRIANGLE = _RECORD.itemsize
"""Bytes of a triangle of a binary STL. Triangles follow a header of 84 bytes, which ends in their number."""


def text_of(path: Path, kind: str, data: bytes) -> str:
    """A file's text; an InputError if the bytes are no UTF-8."""
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(
            f"{path} is not a valid {kind} file, neither as binary nor as text; the file may be cut short or of "
            "another format: export it again"
        ) from error


# ---------------------------------------------------------------------------------------------------- OFF


def plain_off(path: Path, data: bytes) -> bytes:
    """A binary PLY of triangles with the content of an OFF: vertices, their colours, and polygons.

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
    columns = {name: table[:, i] for i, name in enumerate("xyz")}
    begin = 6 if kind[3] else 3
    colors = table[:, begin : begin + 4] if kind[2] else table[:, :0]
    if kind[2] and kind[1]:
        colors = colors[:, : table.shape[1] - begin - 2]
    if kind[2] and colors.shape[1] < 3:
        raise fail(f"it promises colours, and the rows of vertices have {table.shape[1]} numbers")
    columns |= {name: colors[:, i] for i, name in enumerate(("red", "green", "blue", "alpha")[: colors.shape[1]])}
    return written(path, "OFF", Mesh(columns, _polygons(path, numbered[vertex_count:], fail), {}))


def _vertices(rows: list[tuple[int, str]], fail: Fail) -> np.ndarray:
    if not rows:
        raise fail("it promises no vertices")
    numbers = numbers_of(rows, fail)
    if isinstance(numbers, np.ndarray) and numbers.shape[1] >= 3:
        return numbers
    usual = max(len(row) for row in numbers)
    number = next((n for (n, _), row in zip(rows, numbers, strict=True) if len(row) < max(usual, 3)), 0)
    raise fail(f"line {number} ought to be a vertex, and has not as many numbers as others, or less than 3")


def _polygons(path: Path, rows: list[tuple[int, str]], fail: Fail) -> tuple[np.ndarray, np.ndarray]:
    """The number of corners of each face (F,), and the corners of all faces, one after the other, (C,); int64 both."""
    numbers = numbers_of(rows, fail) if rows else []
    if isinstance(numbers, np.ndarray) and (numbers[:, 0] == numbers.shape[1] - 1).all() and numbers.shape[1] > 3:
        faces = numbers[:, 1:]
        if ((faces >= 0) & (faces < 2**31) & (faces == np.floor(faces))).all():
            return np.full(len(faces), faces.shape[1]), faces.astype(np.int64).ravel()
    sizes, corners, colored = [], [], 0
    for (number, line), row in zip(rows, numbers, strict=True):
        size = int(row[0]) if 3 <= row[0] < len(row) else 0
        face = row[: size + 1]
        if size == 0 or not all(0 <= x < 2**31 and x == int(x) for x in face):
            raise fail(f"line {number}, {line[:60]!r}, is no face: how many corners, at least 3, and their indices")
        beyond = len(row) - 1 - size
        if beyond not in (0, 1, 3, 4):  # Numbers of a colour may follow.
            raise fail(f"line {number} promises a face of {size} corners, and has {beyond} numbers too many")
        corners += [int(x) for x in face[1:]]
        sizes.append(size)
        colored += beyond > 0
    if colored:
        warn(f"{path}: {colored} faces have numbers after their corners; if those are colours, they are not loaded")
    return np.array(sizes, np.int64), np.array(corners, np.int64)


# ---------------------------------------------------------------------------------------------------- STL


def sound_stl(path: Path, data: bytes) -> bytes:
    """A binary STL as it is, if its length is right; an STL in text with numbers in place of the names of solids.

    Raises:
        InputError: the file is longer or shorter than its header says, its numbers are misplaced, or its text departs
            from the format.
    """
    if len(data) >= 84 and len(data) == 84 + TRIANGLE * struct.unpack_from("<I", data, 80)[0]:
        _check_records(path, np.frombuffer(data, _RECORD, offset=84))
        return data
    if b"\0" in data:
        promised = struct.unpack_from("<I", data, 80)[0] if len(data) >= 84 else 0
        raise unreadable(
            path,
            "STL",
            f"its header promises {promised} triangles, {84 + TRIANGLE * promised} bytes, and it has {len(data)}",
        )
    text_of(path, "STL", data)
    text = "\n".join([*lines_of(data), ""])
    solids, at = [], 0
    while opening := _SOLID.match(text, at):
        at = begin = opening.end()
        while facet := _FACET.match(text, at):
            at = facet.end()
        end = _END.match(text, at)
        if end is None:
            break
        # trimesh looks for words, in names too.
        solids.append(f"solid {len(solids)}\n{text[begin:at]}endsolid\n")
        at = end.end()
    if at < len(text.rstrip()) or not text.strip():
        line = text.count("\n", 0, at) + 1
        excerpt = " ".join(text[at : at + 200].split())[:40]
        raise unreadable(path, "STL", f"line {line}, {excerpt!r}, is no solid, facet of three vertices, or endsolid")
    return "".join(solids).encode()


def _check_records(path: Path, records: np.ndarray) -> None:
    """Refuse triangles whose bytes are misplaced.

    Numbers read from misplaced bytes are of any size: coordinates are far too small or too large, and the lengths of
    normals are neither 1 nor 0.
    """
    sizes = np.abs(records["corners"])
    strange = ((sizes > 0) & (sizes < 1e-30)) | (sizes > 1e30)
    odd = np.flatnonzero(strange.any(axis=1))
    lengths = np.linalg.norm(records["normal"][odd].astype(np.float64), axis=1)
    odd = odd[~((np.abs(lengths - 1) < 0.1) | (lengths == 0))]
    if len(odd):
        at = odd[0]
        raise unreadable(
            path,
            "STL",
            f"triangle {at} has the coordinate {records['corners'][at][strange[at]][0]:.3g}, and a normal that is "
            "none: bytes before it are missing, or are too many",
        )
