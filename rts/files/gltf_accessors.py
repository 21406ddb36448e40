"""Accessors of GLB and glTF files, the tables of numbers, and what primitives may take of them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from rts.files.damaged_files import Fail, warn
from rts.files.gltf_tree import Gltf, count_of

TYPES = {5120: "i1", 5121: "u1", 5122: "i2", 5123: "u2", 5125: "u4", 5126: "f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
QUANTIZATION = "KHR_mesh_quantization"
_INTEGERS = "i1 u1 i2 u2 i1/ u1/ i2/ u2/"
ATTRIBUTES = {
    "POSITION": ("VEC3", "f4", _INTEGERS),
    "NORMAL": ("VEC3", "f4", "i1/ i2/"),
    "TANGENT": ("VEC4", "f4", "i1/ i2/"),
    **{f"TEXCOORD_{i}": ("VEC2", "f4 u1/ u2/", _INTEGERS) for i in range(4)},
    "COLOR_0": ("VEC3 VEC4", "f4 u1 u2 u1/ u2/", ""),
    "indices": ("SCALAR", "u1 u2 u4", ""),
}
"""Accessors that primitives may have: types of rows; types of numbers; and those that KHR_mesh_quantization adds.

Integers with "/" are `normalized`: they stand for fractions of their largest value."""
TABLES = {
    "joints": ("VEC4", "u1 u2", ""),
    "weights of joints": ("VEC4", "f4 u1/ u2/", ""),
    "displacements": ("VEC3", "f4", _INTEGERS),
    "inverseBindMatrices": ("MAT4", "f4", ""),
    "input": ("SCALAR", "f4", ""),
    "translation": ("VEC3", "f4", ""),
    "rotation": ("VEC4", "f4 i1/ u1/ i2/ u2/", ""),
    "scale": ("VEC3", "f4", ""),
    "weights": ("SCALAR", "f4 i1/ u1/ i2/ u2/", ""),
}
"""Types of rows and of numbers of other tables, for `read_table`."""
BOUNDS_TOLERANCE = 1e-3
"""Tolerance of `min` and `max`, as a share of the range that they bound; some writers round them."""


@dataclass(frozen=True)
class Accessor:
    """A table of numbers, whose rows are known to be there.

    Attributes:
        index: its number, for errors.
        json: its JSON.
        component: the NumPy type of a number.
        width: numbers in a row.
        count: how many rows there are.
        content: the bytes of its bufferView; None for rows of zeros, which have no data.
        start: the byte of the first row there.
        stride: bytes from one row to the next.
        others: for sparse accessors, the places (K,) of rows that differ from these, and these rows (K, C); or None.
    """

    index: int
    json: dict[str, Any]
    component: np.dtype
    width: int
    count: int
    content: bytes | None = None
    start: int = 0
    stride: int = 0
    others: tuple[np.ndarray, np.ndarray] | None = None

    @property
    def is_empty(self) -> bool:
        """True if it has no data of its own, neither for all rows nor for some."""
        return self.content is None and self.others is None

    @property
    def row(self) -> int:
        """Bytes of a row."""
        return self.component.itemsize * self.width

    def rows(self) -> np.ndarray:
        """(N, C) of its own type."""
        if self.content is None:
            rows = np.zeros((self.count, self.width), self.component)
        else:
            content = np.frombuffer(self.content, np.uint8)[self.start :]
            rows = np.lib.stride_tricks.as_strided(content, (self.count, self.row), (self.stride, 1))
            rows = np.ascontiguousarray(rows).view(self.component)
        if self.others is not None:
            rows = rows.copy()
            rows[self.others[0]] = self.others[1]
        return rows

    def numbers(self, fractions: bool = False) -> np.ndarray:
        """(N, C) float32; integers as the fractions they stand for, if they are `normalized` or `fractions` says so."""
        rows = self.rows()
        if rows.dtype.kind == "f" or not (fractions or self.json.get("normalized")):
            return rows.astype(np.float32)
        return np.maximum(rows / np.float32(np.iinfo(rows.dtype).max), -1)


def read_accessor(gltf: Gltf, index: int) -> Accessor:
    """An accessor; refused if its rows are not in its view, or overlap, or begin where its numbers cannot."""
    json, fail = gltf.tree["accessors"][index], gltf.fail
    count = count_of(json["count"])
    if count_of(json["componentType"]) not in TYPES:
        raise fail(f"accessor {index} has componentType {json['componentType']}; expected one of {list(TYPES)}")
    if json["type"] not in WIDTHS:
        raise fail(f"accessor {index} has type {json['type']!r}; expected one of {', '.join(WIDTHS)}")
    accessor = Accessor(index, json, np.dtype("<" + TYPES[json["componentType"]]), WIDTHS[json["type"]], count)
    if "sparse" in json:
        accessor = replace(accessor, others=_others(gltf, accessor, json["sparse"]))
    if "bufferView" not in json:
        return accessor
    view, row, size = count_of(json["bufferView"]), accessor.row, accessor.component.itemsize
    content, start = gltf.views[view], count_of(json.get("byteOffset", 0))
    stride = count_of(gltf.tree["bufferViews"][view].get("byteStride", row))
    if stride < row or stride % size or start % size:
        raise fail(
            f"accessor {index} begins at byte {start} and has rows of {row} bytes, {stride} bytes apart; expected "
            f"multiples of {size}, and no overlap"
        )
    end = start + max(count - 1, 0) * stride + row
    if count and end > len(content):
        raise fail(f"accessor {index} promises {count} rows, which end at byte {end} of {len(content)}")
    return replace(accessor, content=content, start=start, stride=stride)


def _others(gltf: Gltf, accessor: Accessor, sparse: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    """The places and rows of `Accessor.others`; refused if they are not in their views, or not in ascending order."""
    name, count, fail = f"the sparse rows of accessor {accessor.index}", count_of(sparse["count"]), gltf.fail
    kind = sparse["indices"]["componentType"]
    if count_of(kind) not in (5121, 5123, 5125):
        raise fail(f"indices of {name} have componentType {kind}; expected 5121, 5123 or 5125")
    tables = []
    for part, dtype, width in (
        ("indices", np.dtype("<" + TYPES[kind]), 1),
        ("values", accessor.component, accessor.width),
    ):
        content, start = gltf.views[count_of(sparse[part]["bufferView"])], count_of(sparse[part].get("byteOffset", 0))
        end = start + count * width * dtype.itemsize
        if end > len(content) or start % dtype.itemsize:
            raise fail(
                f"{part} of {name} go from byte {start} to {end} of {len(content)}; expected them inside, from a "
                f"multiple of {dtype.itemsize} on"
            )
        tables.append(np.frombuffer(content[start:end], dtype).reshape(count, width))
    places = tables[0][:, 0].astype(np.int64)
    if (np.diff(places) <= 0).any() or places.max(initial=0) >= max(accessor.count, 1):
        raise fail(f"indices of {name} are {places[:9].tolist()}; expected ascending ones below {accessor.count}")
    return places, tables[1]


def read_table(gltf: Gltf, name: str, kind: str, index: int, accessors: list[Accessor]) -> np.ndarray:
    """The numbers (N, C) float32 of an accessor of a kind in `TABLES`; refused if of another type, or not finite.

    `name` is for errors.
    """
    if count_of(index) >= len(accessors):
        raise gltf.fail(f"{name} is accessor {index}, and there are {len(accessors)}")
    accessor = accessors[index]
    _check_types(name, kind, accessor, gltf.uses(QUANTIZATION), gltf.fail)
    numbers = accessor.numbers()
    if not np.isfinite(numbers).all():
        raise gltf.fail(f"{name}, accessor {index}, has rows that are NaN or infinite")
    return numbers


def read_attributes(
    gltf: Gltf, name: str, primitive: dict[str, Any], accessors: list[Accessor]
) -> tuple[dict[str, Accessor], np.ndarray]:
    """The accessors of a primitive that are read (`ATTRIBUTES`), and its corners (N,) int64.

    Refuses what does not fit together, or is not allowed; warns of wrong bounds. `name` is for errors.
    """
    fail, attributes = gltf.fail, primitive["attributes"]
    used = {**attributes, **({"indices": primitive["indices"]} if "indices" in primitive else {})}
    used = {kind: accessors[count_of(index)] for kind, index in used.items()}
    for kind, accessor in used.items():
        _check_types(f"{kind} of {name}", kind, accessor, gltf.uses(QUANTIZATION), fail)
    count = used["POSITION"].count
    for kind in attributes:
        if used[kind].count != count:
            raise fail(f"{kind} of {name} has {used[kind].count} rows, and POSITION {count}")
    if used["POSITION"].is_empty:
        extensions = [*primitive.get("extensions", {})]
        named = ", ".join(extensions) or "none is named"
        raise gltf.compressed(
            f"{name} has no data of its own, and the extension that has them is not read: {named}", extensions
        )
    read = {kind: accessor for kind, accessor in used.items() if kind in ATTRIBUTES}
    _check_overlap(name, {k: a for k, a in read.items() if k != "indices" and a.content is not None and count}, fail)
    for kind in ("POSITION", "indices"):
        if kind in read and not read[kind].is_empty and read[kind].count:
            _check_bounds(gltf, f"{kind} of {name}", read[kind])
    return read, _corners(name, primitive.get("mode", 4), count, read.pop("indices", None), fail)


def _check_types(name: str, kind: str, accessor: Accessor, quantized: bool, fail: Fail) -> None:
    """Refuse types of rows or of numbers that the format does not allow for an attribute.

    Args:
        name: of the attribute and its primitive, for errors.
        kind: of the attribute, such as "POSITION", "indices", or one of `TABLES`; others may have any type.
        accessor: the attribute's.
        quantized: True if the file uses KHR_mesh_quantization, which allows more.
        fail: text → error.
    """
    json, normalized = accessor.json, accessor.json.get("normalized", False)
    if normalized not in (True, False):
        raise fail(f"{name}, accessor {accessor.index}, has normalized = {normalized!r}; expected true or false")
    if kind not in {**ATTRIBUTES, **TABLES}:
        return
    types, numbers, more = (words.split() for words in {**ATTRIBUTES, **TABLES}[kind])
    if json["type"] not in types:
        raise fail(f"{name} is of {json['type']}; expected {' or '.join(types)}")
    component = TYPES[json["componentType"]]
    component += "/" if normalized and component not in ("u4", "f4") else ""
    if component not in numbers and not (quantized and component in more):
        raise fail(
            f"{name}, accessor {accessor.index}, is of numbers {json['componentType']} ({accessor.component.name}"
            f"{', normalized' if normalized else ''}), which glTF does not allow there"
            f"{f' without the extension {QUANTIZATION}' if component in more else ''}"
        )


def _check_overlap(name: str, read: dict[str, Accessor], fail: Fail) -> None:
    """Refuse attributes of one primitive that share bytes of a view, where their rows are equally far apart."""
    places = sorted((a.json["bufferView"], a.stride, a.start, kind) for kind, a in read.items())
    for (view, stride, start, kind), (other_view, other_stride, other_start, other_kind) in zip(
        places, places[1:], strict=False
    ):
        first, second, apart = read[kind], read[other_kind], other_start - start
        if view != other_view or stride != other_stride or apart >= (first.count - 1) * stride + first.row:
            continue
        if not first.row <= apart % stride <= stride - second.row:
            raise fail(
                f"{kind} (accessor {first.index}) and {other_kind} (accessor {second.index}) of {name} share bytes, "
                f"with rows {stride} bytes apart"
            )


def _check_bounds(gltf: Gltf, name: str, accessor: Accessor) -> None:
    """Warn of rows not between the bounds that their accessor gives, or that do not reach these."""
    if not {"min", "max"} <= set(accessor.json):
        return
    low, high = accessor.json["min"], accessor.json["max"]
    rows = accessor.rows().astype(np.float64)
    bounds = np.stack([rows.min(axis=0), rows.max(axis=0)])
    try:
        declared = np.array([low, high], np.float64)
        slack = BOUNDS_TOLERANCE * np.ptp(bounds, axis=0) + 1e-5 * np.abs(bounds).max()
        wrong = declared.shape != bounds.shape or not (np.abs(bounds - declared) <= slack).all()
    except (TypeError, ValueError):
        wrong = True
    if wrong:
        warn(
            f"{gltf.path}: {name} go from {bounds[0].tolist()} to {bounds[1].tolist()}, but min and max of "
            f"accessor {accessor.index} are {low} and {high}; the file may be damaged"
        )


def _corners(name: str, mode: int, count: int, indices: Accessor | None, fail: Fail) -> np.ndarray:
    """The vertices (N,) int64 of a primitive's corners, refused if they make no triangles, or are not there.

    Without `indices`, the `count` vertices are the corners.
    """
    corners, owner = np.arange(count), f"POSITION of {name}"
    if indices is not None:
        owner = f"accessor {indices.index}, the indices of {name},"
        if indices.is_empty:
            raise fail(f"{owner} has no data")
        if indices.content is not None and indices.stride != indices.row:
            raise fail(f"{owner} has rows {indices.stride} bytes apart; expected them one after the other")
        corners = indices.rows().ravel().astype(np.int64)
        if corners.max(initial=0) >= count:
            raise fail(f"{owner} refers to vertex {corners.max()} of {count}, which count from 0")
    if len(corners) == 0 or (mode == 4 and len(corners) % 3):
        raise fail(f"{owner} has {len(corners)} corners of triangles; expected a multiple of 3")
    return corners
