"""Reading PLY: tables of the header's columns, as text or binary; and the mesh in them."""

from __future__ import annotations

import contextlib
import re
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rts.errors import InputError
from rts.files.damaged_files import COUNT, Fail, is_plain, lines_of, unreadable, warn
from rts.files.images import decoded
from rts.files.model_pieces import Piece
from rts.files.polygon_tables import COLORS, UV, Lists, PolygonTables, piece_of

TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float": "f4", "double": "f8", "float32": "f4", "float64": "f8"},
}

OTHER_COLORS = tuple(f"diffuse_{name}" for name in COLORS), ("r", "g", "b", "a")
"""Names that columns of red, green, blue and alpha have in some programs."""

KNOWN = {*"xyz", "nx", "ny", "nz", *COLORS, *(name for names in UV for name in names)}
KNOWN_OF_FACES = {"vertex_indices", "vertex_index", "texcoord", "texnumber", *COLORS}
"""Columns that are read."""


class Property(NamedTuple):
    """A column: its name, the type of its entries and, if entries are lists, the type of their lengths."""

    name: str
    type: str
    length_type: str | None = None


class Element(NamedTuple):
    """A table that the header promises: its name, number of rows, and columns."""

    name: str
    rows: int
    properties: list[Property]


Columns = dict[str, np.ndarray | Lists]
"""Property's name → column (R,), or lists."""


def read_ply(path: Path, data: bytes, file: Callable[[str], bytes]) -> list[Piece]:
    """The mesh of a PLY; of one with several textures, the faces of each, which share their vertices.

    Args:
        path: the path of the file.
        data: its bytes.
        file: name → bytes of a file that it refers to.

    Raises:
        InputError: there is no sound header; rows or entries of lists are not as many as promised, or are not numbers;
            x, y and z or the faces' lists are missing; a face has less than 3 corners, or refers to a vertex that is
            not there; colours are no colours; a texture is no image.
    """

    def fail(what: str) -> InputError:
        return unreadable(path, "PLY", what)

    elements, layout, textures, start = _header(data, fail)
    if layout == "ascii":
        tables = _text_tables(elements, len(lines_of(data[:start])) - 1, data[start:], fail)
    else:
        tables = _binary_tables(elements, data, start, ">" if "big" in layout else "<", fail)
    mesh = _mesh(path, tables, fail)
    piece = piece_of(path, mesh, fail)
    images = [decoded(file(name), f"its texture {name}", fail) for name in textures]
    if not images or not len(piece.faces):
        return [piece._replace(texture=images[0] if images else None)]
    numbers = _numbers_of_textures(path, mesh, textures)
    # Triangles are ordered by polygon, n - 2 for each of n corners.
    of_triangle = np.repeat(numbers, mesh.faces[0] - 2)
    pieces = []
    for number in np.unique(of_triangle):
        its = of_triangle == number
        attributes = {name: (rows, table[its]) for name, (rows, table) in piece.attributes.items()}
        image = images[number] if number < len(images) else None
        pieces.append(piece._replace(faces=piece.faces[its], attributes=attributes, texture=image))
    return pieces


def _numbers_of_textures(path: Path, mesh: PolygonTables, textures: list[str]) -> np.ndarray:
    """The number (F,) of each face's texture; for faces without one, how many textures there are."""
    count, faces = len(textures), len(mesh.faces[0])
    if "texnumber" not in mesh.per_face:
        if count > 1:
            warn(
                f"{path} has {count} textures, and no texnumber of faces: the first, {textures[0]!r}, is taken for all"
            )
        return np.zeros(faces, np.int64)
    numbers = mesh.per_face["texnumber"].astype(np.float64)
    wrong = ~((numbers >= 0) & (numbers < count) & (numbers == np.floor(numbers)))
    if wrong.any():
        first = int(np.argmax(wrong))
        warn(
            f"{path}: {int(wrong.sum())} of {faces} faces have a texnumber of none of its {count} textures, such as "
            f"face {first} with {numbers[first]:g}; they are loaded without"
        )
    return np.where(wrong, count, numbers).astype(np.int64)


def _mesh(path: Path, tables: dict[str, Columns], fail: Fail) -> PolygonTables:
    columns = _plainly_named(tables.get("vertex", {}))
    vertex = {n: c for n, c in columns.items() if isinstance(c, np.ndarray)}
    if not set("xyz") <= set(vertex):
        raise fail("it has no vertices with x, y and z")
    unread = [name for name in columns if name not in vertex or name not in KNOWN]
    none = np.zeros(0, np.int64)
    if "face" not in tables and "tristrips" in tables:
        raise fail("it has strips of triangles, which are not read")
    if "face" not in tables:
        return PolygonTables(vertex, (none, none), {})
    face = _plainly_named(tables["face"])
    lists = {name: column for name, column in face.items() if isinstance(column, tuple)}
    named = [n for n in ("vertex_indices", "vertex_index") if n in lists] or list(lists)
    if not named:
        raise fail("its faces have no list vertex_indices")
    unread += [name for name in face if name not in KNOWN_OF_FACES and name != named[0]]
    if unread:
        warn(f"{path} has properties that are not read: {', '.join(unread[:5])}{', …' if len(unread) > 5 else ''}")
    faces, (sizes, values) = lists[named[0]], lists.get("texcoord", (none, none))
    if faces[1].dtype.kind == "f":
        raise fail(f"the list {named[0]} is not of integers")
    whole = np.array_equal(sizes, 2 * faces[0])
    if "texcoord" in lists and not whole:
        warn(f"{path}: texcoord has not two numbers for each corner of each face; it is loaded without them")
    scalars = {name: column for name, column in face.items() if isinstance(column, np.ndarray)}
    return PolygonTables(vertex, faces, scalars, values.reshape(-1, 2) if len(values) and whole else None)


def _plainly_named(columns: Columns) -> Columns:
    """Columns by name, those of colours by the names of `COLORS`."""
    for names in OTHER_COLORS:
        if "red" not in columns and set(names[:3]) <= set(columns):
            plain = dict(zip(names, COLORS, strict=True))
            return {plain.get(name, name): column for name, column in columns.items()}
    return columns


def _header(data: bytes, fail: Fail) -> tuple[list[Element], str, list[str], int]:
    """The header's elements, layout and names of textures; and the byte where the data begin.

    The layout is "ascii", "binary_little_endian" or "binary_big_endian".
    """
    # Lines of a Macintosh end in CR alone.
    newline = b"\r" if re.match(rb"ply[ \t]*\r(?!\n)", data) else b"\n"
    end = data.find(newline + b"end_header") + 1
    after = data.find(newline, end)
    if not data.startswith(b"ply") or end == 0 or after < 0 or data[end:after].strip() != b"end_header":
        raise fail("it does not begin with a header from 'ply' to 'end_header'")
    elements: list[Element] = []
    layout, textures = "", []
    for number, line in enumerate(lines_of(data[:end])[1:], start=2):
        match line.split():
            case ["comment", name, _, *_] if name.lower() == "texturefile":
                textures.append(line.strip()[len("comment") :].strip()[len(name) :].strip())
            case [] | ["obj_info" | "comment", *_]:
                pass
            case ["format", ("ascii" | "binary_little_endian" | "binary_big_endian") as layout, "1.0"]:
                pass
            case ["element", name, count] if COUNT.fullmatch(count) and name not in {e.name for e in elements}:
                elements.append(Element(name, int(count), []))
            case ["property", "list", length, kind, name] if (
                elements and TYPES.get(length, "f")[0] != "f" and kind in TYPES
            ):
                elements[-1].properties.append(Property(name, TYPES[kind], TYPES[length]))
            case ["property", kind, name] if elements and kind in TYPES:
                elements[-1].properties.append(Property(name, TYPES[kind]))
            case _:
                raise fail(f"line {number} of its header, {line.strip()[:60]!r}, is no part of one")
    if not layout:
        raise fail("its header names no format")
    for element in elements:
        if len({p.name for p in element.properties}) < len(element.properties) or not element.properties:
            raise fail(f"its header gives {element.name!r} no properties, or one of them twice")
    return elements, layout, textures, after + 1


def _columns(
    element: Element, bounds: np.ndarray, size_of: Callable[[str], int], take: Callable[[np.ndarray, str, str], Any]
) -> tuple[Columns, np.ndarray]:
    """The columns of an element; and (R,), True for rows whose entries do not end where the next row begins.

    Args:
        element: the element, of R rows.
        bounds: (R + 1,) places of the rows, and of their end.
        size_of: type → how many places an entry takes.
        take: (N,) places, type, property's name → the entries there; they may be a row's end.
    """
    at, ends = bounds[:-1], bounds[1:]
    wrong, columns = np.zeros(len(at), bool), {}
    for p in element.properties:
        size, lengths = size_of(p.type), np.ones(len(at), np.int64)
        if p.length_type is not None:
            lengths = take(np.minimum(at, ends), p.length_type, p.name).astype(np.int64)
            at = at + size_of(p.length_type)
        wrong |= (lengths < 0) | (lengths > (ends - at) // size)
        lengths[wrong] = 0
        before = np.arange(lengths.sum()) - np.repeat(np.cumsum(lengths) - lengths, lengths)
        entries = take(np.repeat(at, lengths) + size * before, p.type, p.name)
        columns[p.name] = entries if p.length_type is None else (lengths, entries)
        at = at + size * lengths
    return columns, wrong | (at != ends)


# ------------------------------------------------------------------------------------------------ as text


def _text_tables(elements: list[Element], before: int, data: bytes, fail: Fail) -> dict[str, Columns]:
    """Element's name → columns of a file in text, one row a line; blank lines do not count.

    Args:
        elements: the tables that the header promises, in order.
        before: the number of lines before `data`, for errors.
        data: the bytes after the header.
        fail: text → error.
    """
    lines = enumerate(lines_of(data), start=before + 1)
    numbered = [(number, line) for number, line in lines if line.strip(" \t\f\v")]
    if len(numbered) != sum(element.rows for element in elements):
        counts = " + ".join(f"{e.rows} ({e.name})" for e in elements)
        raise fail(f"its header promises {counts} rows, and it has {len(numbered)}")
    tables, begin = {}, 0
    for element in elements:
        tables[element.name] = _text_table(element, numbered[begin : begin + element.rows], fail)
        begin += element.rows
    return tables


def numbers_of(rows: list[tuple[int, str]], fail: Fail) -> tuple[np.ndarray, np.ndarray]:
    """The numbers in `rows` (line number, line), float64, one row after the other; and (R + 1,) where rows begin.

    A line of other than numbers is refused.
    """
    bounds = np.cumsum([0, *(len(line.split()) for _, line in rows)])
    text = " ".join(line for _, line in rows)
    with warnings.catch_warnings(), contextlib.suppress(ValueError, DeprecationWarning):
        warnings.simplefilter("error")  # Of text that is no number, where NumPy stops.
        numbers = np.fromstring(text if is_plain(text) else "", sep=" ")
        if len(numbers) == bounds[-1]:
            return numbers, bounds
    numbers = []
    for number, line in rows:
        try:
            if "_" in line or not is_plain(line):  # Python takes 1_0 for 10.
                raise ValueError
            numbers += map(float, line.split())
        except ValueError:
            raise fail(f"line {number}, {' '.join(line.split())[:60]!r}, is not of numbers") from None
    return np.array(numbers, np.float64), bounds


def _text_table(element: Element, rows: list[tuple[int, str]], fail: Fail) -> Columns:
    numbers, bounds = numbers_of(rows, fail)
    padded = np.append(numbers, 0)

    def take(at: np.ndarray, kind: str, name: str) -> np.ndarray:
        values = padded[at]
        typed = values.astype(kind)
        wrong = np.flatnonzero(typed != values) if kind[0] != "f" else np.zeros(0, np.int64)
        if len(wrong):
            number, _ = rows[int(np.searchsorted(bounds, at[wrong[0]], side="right")) - 1]
            what = f"{values[wrong[0]]:g} for {name} of {element.name}, which is no {np.dtype(kind).name}"
            raise fail(f"line {number} has {what}")
        return typed

    with np.errstate(over="ignore", invalid="ignore"):
        columns, wrong = _columns(element, bounds, lambda kind: 1, take)
    if wrong.any():
        row = int(np.argmax(wrong))
        length = bounds[row + 1] - bounds[row]
        raise fail(f"line {rows[row][0]} has {length} numbers, which do not make a row of {element.name}")
    return columns


# ------------------------------------------------------------------------------------------------ binary


def _binary_tables(elements: list[Element], data: bytes, at: int, order: str, fail: Fail) -> dict[str, Columns]:
    """Element's name → columns of a file whose data begin at byte `at`; `order` is "<" or ">", as NumPy has them."""
    content = np.frombuffer(data + bytes(8), np.uint8)

    def take(at: np.ndarray, kind: str, name: str) -> np.ndarray:
        windows = np.lib.stride_tricks.sliding_window_view(content, np.dtype(kind).itemsize)
        return np.ascontiguousarray(windows[at]).view(order + kind)[:, 0].astype(kind)

    def size_of(kind: str) -> int:
        return np.dtype(kind).itemsize

    tables = {}
    for element in elements:
        short = fail(
            f"its header promises {element.rows} rows of {element.name}, for which {len(data) - at} bytes are too few"
        )
        if element.rows * sum(size_of(p.length_type or p.type) for p in element.properties) > len(data) - at:
            raise short
        # Nearly always, all lists are as long as those of the first row.
        step = next(_ends(element, data, at, order), at) - at
        bounds = np.minimum(at + step * np.arange(element.rows + 1), len(data))
        tables[element.name], wrong = _columns(element, bounds, size_of, take)
        if wrong.any():
            bounds = np.array([at, *_ends(element, data, at, order)])
            if bounds[-1] > len(data):
                raise short
            tables[element.name], _ = _columns(element, bounds, size_of, take)
        at = int(bounds[-1])
    if data[at:].strip():
        raise fail(f"after all that its header promises there are {len(data) - at} bytes more")
    return tables


def _ends(element: Element, data: bytes, at: int, order: str) -> Iterator[int]:
    """The byte where each row ends, of those from byte `at` on; the last one that is given may be beyond the data."""
    for _ in range(element.rows):
        for p in element.properties:
            length = 1
            if p.length_type is not None:
                start, at = at, at + np.dtype(p.length_type).itemsize
                signed = p.length_type[0] == "i"
                length = int.from_bytes(data[start:at], "little" if order == "<" else "big", signed=signed)
            at = at + length * np.dtype(p.type).itemsize if length >= 0 else len(data) + 1
        yield at
        if at > len(data):
            return
