"""Reading STL, binary and as text."""

from __future__ import annotations

import re
import struct
from pathlib import Path

import numpy as np

from rts.files.damaged_files import lines_of, text_of, unreadable
from rts.files.model_pieces import Piece

_NUMBER = r"[-+]?(?:\d+\.?\d*(?:e[-+]?\d+)?|\.\d+(?:e[-+]?\d+)?|nan|inf(?:inity)?)"
_VERTEX = rf"vertex((?:[ \t]+{_NUMBER}){{3}})[ \t]*\n\s*"
_FACET = re.compile(
    rf"facet(?:\s+normal(?:[ \t]+\S+){{3}})?\s+outer\s+loop\s+{_VERTEX * 3}endloop\s+endfacet\b\s*",
    re.IGNORECASE | re.ASCII,
)
_SOLID = re.compile(r"\s*solid\b([^\n]*)\n\s*", re.IGNORECASE | re.ASCII)
_END = re.compile(r"endsolid\b[^\n]*\n?\s*", re.IGNORECASE | re.ASCII)
_RECORD = np.dtype([("normal", "<f4", 3), ("corners", "<f4", 9), ("more", "<u2")])
TRIANGLE = _RECORD.itemsize
"""Bytes of a triangle of a binary STL. Triangles follow a header of 84 bytes, which ends in their number."""


def read_stl(path: Path, data: bytes) -> list[Piece]:
    """The mesh of a binary STL, or the solids of one in text. Each triangle has three vertices of its own.

    Raises:
        InputError: the file is longer or shorter than its header says, its numbers are misplaced, or its text departs
            from the format.
    """
    promised = struct.unpack_from("<I", data, 80)[0] if len(data) >= 84 else 0
    if len(data) >= 84 and len(data) == 84 + TRIANGLE * promised:
        records = np.frombuffer(data, _RECORD, offset=84)
        _check_records(path, records)
        return [_piece(records["corners"])]
    if b"\0" in data:
        raise unreadable(
            path,
            "STL",
            f"its header promises {promised} triangles, {84 + TRIANGLE * promised} bytes, and it has {len(data)}",
        )
    text_of(path, "STL", data)
    text = "\n".join([*lines_of(data), ""])
    pieces, at = [], 0
    while opening := _SOLID.match(text, at):
        corners, at = [], opening.end()
        while facet := _FACET.match(text, at):
            corners += " ".join(facet.groups()).split()
            at = facet.end()
        end = _END.match(text, at)
        if end is None:
            break
        pieces.append(_piece(np.array(corners, np.float64)))
        at = end.end()
    if at < len(text.rstrip()) or not text.strip():
        line = text.count("\n", 0, at) + 1
        excerpt = " ".join(text[at : at + 200].split())[:40]
        raise unreadable(path, "STL", f"line {line}, {excerpt!r}, is no solid, facet of three vertices, or endsolid")
    return pieces


def _piece(corners: np.ndarray) -> Piece:
    vertices = corners.reshape(-1, 3).astype(np.float64)
    return Piece(vertices, np.arange(len(vertices)).reshape(-1, 3), {})


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
