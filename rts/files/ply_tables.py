"""The tables of PLY files: read strictly, polygons cut, and written as the plainest PLY there is, for trimesh.

trimesh knows what the columns mean. But it takes what rows there are for those that the header promises, cannot tell
polygons of different sizes in binary files, and cuts concave ones wrongly.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rts.errors import InputError
from rts.files import polygons
from rts.files.damaged_files import COUNT, is_plain, lines_of, unreadable, warn
from rts.files.images import is_image

Lists = tuple[np.ndarray, np.ndarray]
"""Lists of different lengths: the length of each, and the entries of all, one list after the other."""

TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float": "f4", "double": "f8", "float32": "f4", "float64": "f8"},
}
NAMES = {
    "i1": "char",
    "u1": "uchar",
    "i2": "short",
    "u2": "ushort",
    "i4": "int",
    "u4": "uint",
    "f4": "float",
    "f8": "double",
}
CODES = {"i1": "b", "u1": "B", "i2": "h", "u2": "H", "i4": "i", "u4": "I", "f4": "f", "f8": "d"}
COLORS = ("red", "green", "blue", "alpha")


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


class Mesh(NamedTuple):
    """The tables of a file of polygons.

    Attributes:
        vertices: columns (V,) by name, "x", "y" and "z" among them.
        faces: corners of polygons, indices into the vertices; None where the file has no faces.
        per_face: columns (F,) by name.
        texcoord: two numbers for each corner of each face, (C, 2), or None.
        texture: the name of a picture, or "".
    """

    vertices: dict[str, np.ndarray]
    faces: Lists | None
    per_face: dict[str, np.ndarray]
    texcoord: np.ndarray | None = None
    texture: str = ""


Fail = Callable[[str], InputError]


def plain_ply(path: Path, data: bytes, file: Callable[[str], bytes]) -> bytes:
    """A PLY of the same mesh that is binary, and of triangles only.

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

    mesh = _mesh(path, data, fail)
    if mesh.texture and not is_image(file(mesh.texture)):
        raise fail(f"its texture {mesh.texture} cannot be read as an image")
    return written(path, "PLY", mesh)


def written(path: Path, kind: str, mesh: Mesh) -> bytes:
    """A binary PLY of a mesh, its polygons cut into triangles; without faces, of its vertices alone.

    Args:
        path: the path of the mesh's file, for errors.
        kind: the name of its format, for errors.
        mesh: the mesh.

    Raises:
        InputError: a face has less than 3 corners, or refers to a missing vertex; colours are no colours.
    """

    def fail(what: str) -> InputError:
        return unreadable(path, kind, what)

    count = len(mesh.vertices["x"])
    lines = ["ply", "format binary_little_endian 1.0"]
    lines += [f"comment TextureFile {mesh.texture}"] if mesh.texture else []
    lines.append(f"element vertex {count}")
    vertices = _with_colors(mesh.vertices, "vertex", fail)
    lines += [f"property {NAMES[c.dtype.str[1:]]} {name}" for name, c in vertices.items()]
    table = np.empty(count, [(name, "<" + c.dtype.str[1:]) for name, c in vertices.items()])
    for name, column in vertices.items():
        table[name] = column
    blocks = [table.tobytes()]
    if mesh.faces is not None and len(mesh.faces[0]):
        more, block = _face_table(path, mesh, fail)
        lines += more
        blocks.append(block)
    return "\n".join([*lines, "end_header\n"]).encode() + b"".join(blocks)


def _face_table(path: Path, mesh: Mesh, fail: Fail) -> tuple[list[str], bytes]:
    """The lines of the header that promise the faces, and the rows of the faces, all triangles; there must be faces."""
    sizes, corners = mesh.faces or (np.zeros(0), np.zeros(0))
    count = len(mesh.vertices["x"])
    if sizes.min() < 3:
        raise fail(f"face {int(np.argmax(sizes < 3))} has {int(sizes[sizes < 3][0])} corners; expected at least 3")
    strange = (corners < 0) | (corners >= count)
    if strange.any():
        face = int(np.searchsorted(np.cumsum(sizes), np.argmax(strange), side="right"))
        raise fail(f"face {face} refers to vertex {int(corners[strange][0])} of {count}, which count from 0")
    points = np.stack([mesh.vertices[axis].astype(np.float64) for axis in "xyz"], axis=1)
    triangles, owner, forced = polygons.cut(points, corners, sizes)
    if forced:
        warn(f"{path}: {forced} polygons cross themselves and may be cut wrongly; export triangles to be sure")
    lines = [f"element face {len(triangles)}", "property list uchar int vertex_indices"]
    fields: list[Any] = [("3", "u1"), ("indices", "<i4", 3)]
    columns = {"3": 3, "indices": corners[triangles]}
    if mesh.texcoord is not None:
        lines.append("property list uchar float texcoord")
        fields += [("6", "u1"), ("texcoord", "<f4", 6)]
        columns |= {"6": 6, "texcoord": mesh.texcoord[triangles].reshape(-1, 6)}
    for name, column in _with_colors(mesh.per_face, "face", fail).items():
        lines.append(f"property {NAMES[column.dtype.str[1:]]} {name}")
        fields.append((f"own {name}", "<" + column.dtype.str[1:]))
        columns[f"own {name}"] = column[owner]
    table = np.empty(len(triangles), fields)
    with np.errstate(over="ignore"):  # Columns that are used are checked later.
        for name, column in columns.items():
            table[name] = column
    return lines, table.tobytes()


def _with_colors(columns: dict[str, np.ndarray], element: str, fail: Fail) -> dict[str, np.ndarray]:
    """The columns, those of colours as uint8; as they are if red, green or blue is missing.

    Floats may go to 1 or to 255, integers to 255, uint16 to 65535. Other colours are refused.
    """
    if not {"red", "green", "blue"} <= set(columns):
        return columns
    names = [name for name in COLORS if name in columns]
    converted = dict(columns)
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
        scale = 255.0 if kind == "f" and top <= 1 else 255 / limit
        converted[name] = np.round(values * scale).astype(np.uint8)
    return converted


# ------------------------------------------------------------------------------------------------ reading


def _mesh(path: Path, data: bytes, fail: Fail) -> Mesh:
    elements, layout, texture, start = _header(data, fail)
    if layout == "ascii":
        tables = _text_tables(elements, len(lines_of(data[:start])) - 1, data[start:], fail)
    else:
        tables = _binary_tables(elements, data, start, ">" if "big" in layout else "<", fail)
    vertex = {n: c for n, c in tables.get("vertex", {}).items() if isinstance(c, np.ndarray)}
    if not set("xyz") <= set(vertex):
        raise fail("it has no vertices with x, y and z")
    face = tables.get("face", {})
    scalars = {name: column for name, column in face.items() if isinstance(column, np.ndarray)}
    lists = {name: column for name, column in face.items() if isinstance(column, tuple)}
    if "face" not in tables:
        return Mesh(vertex, None, {})
    named = [n for n in ("vertex_indices", "vertex_index") if n in lists] or list(lists)
    if not named:
        raise fail("its faces have no list vertex_indices")
    faces, texcoord = lists[named[0]], None
    if faces[1].dtype.kind != "i":
        raise fail(f"the list {named[0]} is not of integers")
    if "texcoord" in lists:
        sizes, values = lists["texcoord"]
        if np.array_equal(sizes, 2 * faces[0]):
            texcoord = values.reshape(-1, 2)
        else:
            warn(f"{path}: texcoord has not two numbers for each corner of each face; it is loaded without them")
    return Mesh(vertex, faces, scalars, texcoord, texture)


def _header(data: bytes, fail: Fail) -> tuple[list[Element], str, str, int]:
    """The header's elements, layout and name of a texture, or ""; and the byte where the data begin.

    The layout is "ascii", "binary_little_endian" or "binary_big_endian".
    """
    # Lines of a Macintosh end in CR alone.
    newline = b"\r" if re.match(rb"ply[ \t]*\r(?!\n)", data) else b"\n"
    end = data.find(newline + b"end_header") + 1
    after = data.find(newline, end)
    if not data.startswith(b"ply") or end == 0 or after < 0 or data[end:after].strip() != b"end_header":
        raise fail("it does not begin with a header from 'ply' to 'end_header'")
    lines = lines_of(data[:end])
    elements: list[Element] = []
    layout = texture = ""
    for number, line in enumerate(lines[1:], start=2):
        match line.split():
            case ["comment", name, _, *_] if name.lower() == "texturefile":
                texture = line.strip()[len("comment") :].strip()[len(name) :].strip()
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
    return elements, layout, texture, after + 1


def _joined(sizes: Any, entries: list[np.ndarray], dtype: str) -> Lists:
    """`Lists` of these lengths, with these entries one list after the other; integers as int64."""
    kind = np.int64 if dtype[0] in "iu" else dtype
    flat = np.concatenate(entries) if entries else np.zeros(0)
    return np.asarray(sizes, np.int64), flat.astype(kind)


# ------------------------------------------------------------------------------------------------ as text


def _text_tables(elements: list[Element], before: int, data: bytes, fail: Fail) -> dict[str, dict[str, Any]]:
    """The tables of a file in text, one row a line; blank lines do not count.

    Args:
        elements: the tables that the header promises, in order.
        before: the number of lines before `data`, for errors.
        data: the bytes after the header.
        fail: text → error.

    Returns:
        Element's name → property's name → column (R,), or `Lists` of R lists.
    """
    lines = enumerate(lines_of(data), start=before + 1)
    numbered = [(number, line) for number, line in lines if line.strip(" \t\f\v")]
    if len(numbered) != sum(element.rows for element in elements):
        counts = " + ".join(f"{e.rows} ({e.name})" for e in elements)
        raise fail(f"its header promises {counts} rows, and it has {len(numbered)}")
    tables, begin = {}, 0
    for element in elements:
        rows = numbered[begin : begin + element.rows]
        tables[element.name] = _text_table(element, rows, fail)
        begin += element.rows
    return tables


def numbers_of(rows: list[tuple[int, str]], fail: Fail) -> np.ndarray | list[list[float]]:
    """The numbers in each of `rows` (line number, line), at least one: (R, C) float64, or lists of unequal lengths.

    A line of other than numbers is refused.
    """
    try:
        lines = [line for _, line in rows]
        if is_plain("".join(lines)):
            return np.loadtxt(lines, comments=None, ndmin=2)
    except ValueError:
        pass
    numbers = []
    for number, line in rows:
        try:
            if "_" in line or not is_plain(line):  # Python takes 1_0 for 10.
                raise ValueError
            numbers.append([float(word) for word in line.split()])
        except ValueError:
            raise fail(f"line {number}, {' '.join(line.split())[:60]!r}, is not of numbers") from None
    return numbers


def _text_table(element: Element, rows: list[tuple[int, str]], fail: Fail) -> dict[str, Any]:
    properties = element.properties
    if not rows:
        return {p.name: np.zeros(0, p.type) if p.length_type is None else _joined([], [], p.type) for p in properties}
    values = numbers_of(rows, fail)
    numbers = np.array([number for number, _ in rows])
    columns: dict[str, Any] = {}
    # The places of columns in the rows, where those are all alike.
    places = _places(properties, values[0])
    table = values if isinstance(values, np.ndarray) else np.zeros((0, 0))
    if places and len(table) and all((table[:, i - 1] == j - i).all() for p, i, j in places if p.length_type):
        for p, begin, end in places:
            block = _typed(element, p, table[:, begin:end], numbers, fail)
            lengths = [end - begin] * len(rows)
            columns[p.name] = block[:, 0] if p.length_type is None else _joined(lengths, [block.ravel()], p.type)
        return columns
    parts: dict[str, list[Any]] = {p.name: [] for p in properties}
    for number, row in zip(numbers, values, strict=True):
        places = _places(properties, row)
        if places is None:
            raise fail(f"line {number} has {len(row)} numbers, which do not make a row of {element.name}")
        for p, begin, end in places:
            parts[p.name].append(row[begin:end])
    for p in properties:
        sizes = np.array([len(part) for part in parts[p.name]])
        flat = np.array([x for part in parts[p.name] for x in part])
        block = _typed(element, p, flat[:, None], np.repeat(numbers, sizes), fail)[:, 0]
        columns[p.name] = block if p.length_type is None else _joined(sizes, [block], p.type)
    return columns


def _places(properties: list[Property], row: Any) -> list[tuple[Property, int, int]] | None:
    """Each property with start and end of its entries in a row of numbers; those of a list follow its length.

    None if the row is too long or too short.
    """
    places, at = [], 0
    for p in properties:
        length = 1
        if p.length_type is not None:
            if at >= len(row) or not (0 <= row[at] <= len(row) and row[at] == int(row[at])):
                return None
            length = int(row[at])
            at += 1
        places.append((p, at, at + length))
        at += length
    return places if at == len(row) else None


def _typed(element: Element, p: Property, values: np.ndarray, numbers: Any, fail: Fail) -> np.ndarray:
    """Values (R, C) as the type that the header promises, refused if that has no such integer. `numbers` are lines'."""
    with np.errstate(over="ignore", invalid="ignore"):
        typed = values.astype(p.type)
    wrong = (typed != values).any(axis=1) if p.type[0] != "f" else np.zeros(len(values), bool)
    if wrong.any():
        at = int(np.argmax(wrong))
        value = values[at][typed[at] != values[at]][0]
        raise fail(f"line {numbers[at]} has {value:g} for {p.name} of {element.name}, which is no {NAMES[p.type]}")
    return typed


# ------------------------------------------------------------------------------------------------ binary


def _binary_tables(elements: list[Element], data: bytes, at: int, order: str, fail: Fail) -> dict[str, dict[str, Any]]:
    tables = {}
    for element in elements:
        least = sum(np.dtype(p.length_type or p.type).itemsize for p in element.properties)
        short = fail(
            f"its header promises {element.rows} rows of {element.name}, for which {len(data) - at} bytes are too few"
        )
        if element.rows * least > len(data) - at:
            raise short
        try:
            tables[element.name], at = _alike(element, data, at, order) or _different(element, data, at, order)
        except struct.error:
            raise short from None
    if data[at:].strip():
        raise fail(f"after all that its header promises there are {len(data) - at} bytes more")
    return tables


def _alike(element: Element, data: bytes, at: int, order: str) -> tuple[dict[str, Any], int] | None:
    """The table at byte `at`, by columns, and the byte where it ends, if all rows have lists as long as the first.

    None otherwise, or where the file would end before. `order` is "<" for little-endian numbers, else ">".
    """
    fields: list[Any] = []
    place = at
    for p in element.properties:
        if p.length_type is None:
            fields.append((p.name, order + p.type))
            place += np.dtype(p.type).itemsize
            continue
        if element.rows == 0:
            length = 0
        else:
            [length] = struct.unpack_from(order + CODES[p.length_type], data, place)
        place += np.dtype(p.length_type).itemsize + length * np.dtype(p.type).itemsize
        if length < 0 or place > len(data):
            return None
        fields += [(f"length of {p.name}", order + p.length_type), (p.name, order + p.type, (length,))]
    row = np.dtype(fields)
    if element.rows * row.itemsize > len(data) - at:
        return None
    table = np.frombuffer(data, row, element.rows, at)
    columns: dict[str, Any] = {}
    for p in element.properties:
        column = table[p.name].astype(p.type)
        if p.length_type is not None:
            lengths = table[f"length of {p.name}"]
            if not (lengths == column.shape[1]).all():
                return None
            column = _joined(lengths, [column.ravel()], p.type)
        columns[p.name] = column
    return columns, at + element.rows * row.itemsize


def _different(element: Element, data: bytes, at: int, order: str) -> tuple[dict[str, Any], int]:
    """The result of `_alike` for rows of any lengths, read row by row; a struct.error if the file ends before."""
    parts: dict[str, list[tuple[Any, ...]]] = {p.name: [] for p in element.properties}
    steps = [
        (parts[p.name], CODES[p.type], np.dtype(p.type).itemsize, struct.Struct(order + CODES[p.length_type or "u1"]))
        for p in element.properties
    ]
    of_lists = [p.length_type is not None for p in element.properties]
    for _ in range(element.rows):
        for (entries, code, size, lengths), is_list in zip(steps, of_lists, strict=True):
            length = 1
            if is_list:
                [length] = lengths.unpack_from(data, at)
                at += lengths.size
                if not 0 <= length * size <= len(data) - at:
                    raise struct.error
            entries.append(struct.unpack_from(f"{order}{length}{code}", data, at))
            at += length * size
    columns: dict[str, Any] = {}
    for p in element.properties:
        flat = np.array([x for part in parts[p.name] for x in part], p.type)
        lengths = [len(part) for part in parts[p.name]]
        columns[p.name] = flat if p.length_type is None else _joined(lengths, [flat], p.type)
    return columns, at
