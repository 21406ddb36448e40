"""Checks of accessors of GLB and glTF files: their data are present, in layouts and types that the format allows."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

import numpy as np

from rts.files.damaged_files import warn

TYPES = {5120: "i1", 5121: "u1", 5122: "i2", 5123: "u2", 5125: "u4", 5126: "f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
ATTRIBUTES = {
    **{"POSITION": ("VEC3",), "NORMAL": ("VEC3",), "TEXCOORD_0": ("VEC2",), "COLOR_0": ("VEC3", "VEC4")},
    "indices": ("SCALAR",),
}
QUANTIZATION = "KHR_mesh_quantization"
COMPONENTS = {
    "POSITION": ("f4",),
    "NORMAL": ("f4",),
    "TEXCOORD_0": ("f4", "u1 fraction", "u2 fraction"),
    "COLOR_0": ("f4", "u1", "u2", "u1 fraction", "u2 fraction"),
    "indices": ("u1", "u2", "u4"),
}
"""Types of components; integers that stand for fractions of their largest value are `normalized`."""
_INTEGERS = tuple(kind + more for kind in ("i1", "u1", "i2", "u2") for more in ("", " fraction"))
QUANTIZED = COMPONENTS | {
    "POSITION": ("f4", *_INTEGERS),
    "NORMAL": ("f4", "i1 fraction", "i2 fraction"),
    "TEXCOORD_0": ("f4", *_INTEGERS),
}
"""Component types that KHR_mesh_quantization adds."""
MOST = 2**24
"""Rows of an accessor without data, all zero, which a damaged file could otherwise have any number of."""
BOUNDS_TOLERANCE = 1e-3
"""Tolerance of `min` and `max`, as a share of the range that they bound; some writers round them."""


def count_of(value: Any) -> int:
    """The value if it is a whole number of at least zero; else a ValueError."""
    if not isinstance(value, int) or isinstance(value, bool) or value < 0:
        raise ValueError(f"{value!r} is no count")
    return value


def _layout(accessor: dict[str, Any], descriptions: list[dict[str, Any]]) -> tuple[int, int, int]:
    """Counts of bytes of an accessor that has a view: to its first row, from one row to the next, and in one row.

    `descriptions` are the file's bufferViews, as JSON.
    """
    row = np.dtype(TYPES[accessor["componentType"]]).itemsize * WIDTHS[accessor["type"]]
    stride = descriptions[accessor["bufferView"]].get("byteStride", row)
    return count_of(accessor.get("byteOffset", 0)), count_of(stride), row


def check_accessor(
    index: int, accessor: dict[str, Any], descriptions: list[dict[str, Any]], views: list[bytes], fail: Any
) -> None:
    """Refuse an accessor whose rows are not in its view, or overlap, or begin where numbers of its type cannot.

    An accessor without a view stands for zeros; it may promise up to `MOST` rows.

    Args:
        index: the accessor's number, for errors.
        accessor: its JSON.
        descriptions: the JSON of the bufferViews.
        views: the bytes of each bufferView.
        fail: text → error.
    """
    count = count_of(accessor["count"])
    if count_of(accessor["componentType"]) not in TYPES:
        raise fail(f"accessor {index} has componentType {accessor['componentType']}; expected one of {list(TYPES)}")
    if accessor["type"] not in WIDTHS:
        raise fail(f"accessor {index} has type {accessor['type']!r}; expected one of {', '.join(WIDTHS)}")
    if "bufferView" not in accessor:
        if count > MOST:
            raise fail(f"accessor {index} promises {count} rows, and has no data")
        return
    content = views[count_of(accessor["bufferView"])]
    start, stride, row = _layout(accessor, descriptions)
    size = np.dtype(TYPES[accessor["componentType"]]).itemsize
    if stride < row or stride % size or start % size:
        raise fail(
            f"accessor {index} begins at byte {start} and has rows of {row} bytes, {stride} bytes apart; expected "
            f"multiples of {size}, and no overlap"
        )
    end = start + max(count - 1, 0) * stride + row
    if count and end > len(content):
        raise fail(f"accessor {index} promises {count} rows, which end at byte {end} of {len(content)}")


def rows_of(accessor: dict[str, Any], descriptions: list[dict[str, Any]], views: list[bytes]) -> np.ndarray:
    """The rows (N, C) of an accessor that has data, in its own type."""
    start, stride, row = _layout(accessor, descriptions)
    content = np.frombuffer(views[accessor["bufferView"]], np.uint8)[start:]
    rows = np.lib.stride_tricks.as_strided(content, (accessor["count"], row), (stride, 1))
    return np.ascontiguousarray(rows).view("<" + TYPES[accessor["componentType"]])


def check_attributes(
    path: Path, name: str, primitive: dict[str, Any], tree: dict[str, Any], views: list[bytes], fail: Any
) -> dict[str, int]:
    """Refuse attributes and indices that do not fit.

    Returns:
        For the attributes that are read (`ATTRIBUTES`, "indices" among them) and have data, the index of the accessor.
    """
    attributes = primitive["attributes"]
    used = {**attributes, **({"indices": primitive["indices"]} if "indices" in primitive else {})}
    accessors = {kind: tree["accessors"][count_of(index)] for kind, index in used.items()}
    sparse = [kind for kind, accessor in accessors.items() if "sparse" in accessor]
    if sparse:
        raise fail(f"{sparse[0]} of {name} is sparse, which is not read")
    quantized = QUANTIZATION in (*tree.get("extensionsUsed", []), *tree.get("extensionsRequired", []))
    for kind, accessor in accessors.items():
        if accessor["type"] not in ATTRIBUTES.get(kind, WIDTHS):
            raise fail(f"{kind} of {name} is of {accessor['type']}; expected {' or '.join(ATTRIBUTES[kind])}")
        _check_components(f"{kind} of {name}, accessor {used[kind]},", kind, accessor, quantized, fail)
    count = accessors["POSITION"]["count"]
    different = [kind for kind in attributes if accessors[kind]["count"] != count]
    if different:
        raise fail(f"{different[0]} of {name} has {accessors[different[0]]['count']} rows, and POSITION {count}")
    if "bufferView" not in accessors["POSITION"] and not importlib.util.find_spec("DracoPy"):
        extensions = ", ".join(primitive.get("extensions", {})) or "none is named"
        raise fail(f"{name} has no data of its own, and the extension that has them is not read: {extensions}")
    read = {kind: used[kind] for kind, a in accessors.items() if kind in ATTRIBUTES and "bufferView" in a and count > 0}
    _check_overlap(name, {kind: index for kind, index in read.items() if kind != "indices"}, tree, fail)
    _check_bounds(path, name, read, tree, views)
    if "bufferView" in accessors["POSITION"]:
        _check_corners(name, primitive, count, used.get("indices"), tree, views, fail)
    return read


def _check_components(name: str, kind: str, accessor: dict[str, Any], quantized: bool, fail: Any) -> None:
    """Refuse a type of numbers that the format does not allow for an attribute.

    Args:
        name: of the attribute and its primitive, for errors.
        kind: of the attribute, such as "POSITION", or "indices"; kinds not in `COMPONENTS` may have any type.
        accessor: its JSON.
        quantized: True if the file uses KHR_mesh_quantization, which allows more.
        fail: text → error.
    """
    component = TYPES[accessor["componentType"]]
    if accessor.get("normalized", False) not in (True, False):
        raise fail(f"{name} has normalized = {accessor['normalized']!r}; expected true or false")
    known = component + (" fraction" if accessor.get("normalized") and component not in ("u4", "f4") else "")
    if known not in (QUANTIZED if quantized else COMPONENTS).get(kind, (known,)):
        raise fail(
            f"{name} is of numbers {accessor['componentType']} ({np.dtype(component).name}"
            f"{', normalized' if accessor.get('normalized') else ''}), which glTF does not allow there"
            f"{'' if quantized or known not in QUANTIZED[kind] else f' without the extension {QUANTIZATION}'}"
        )


def _check_overlap(name: str, read: dict[str, int], tree: dict[str, Any], fail: Any) -> None:
    """Refuse attributes of one primitive that share bytes of a view, where their rows are equally far apart."""
    places = []
    for kind, index in read.items():
        accessor = tree["accessors"][index]
        start, stride, row = _layout(accessor, tree["bufferViews"])
        places.append((accessor["bufferView"], stride, start, row, accessor["count"], f"{kind} (accessor {index})"))
    places.sort(key=lambda place: place[:3])
    for (view, stride, a, row, count, first), (other, step, b, width, _, second) in zip(
        places, places[1:], strict=False
    ):
        if view != other or stride != step or b >= a + (count - 1) * stride + row:
            continue
        if not row <= (b - a) % stride <= stride - width:
            raise fail(f"{first} and {second} of {name} share bytes, with rows {stride} bytes apart")


def _check_bounds(path: Path, name: str, read: dict[str, int], tree: dict[str, Any], views: list[bytes]) -> None:
    """Warn of positions or indices not between the bounds that their accessor gives, or that do not reach these."""
    for kind in ("POSITION", "indices"):
        accessor = tree["accessors"][read[kind]] if kind in read else {}
        if "min" not in accessor or "max" not in accessor or not accessor["count"]:
            continue
        rows = rows_of(accessor, tree["bufferViews"], views).astype(np.float64)
        bounds = np.stack([rows.min(axis=0), rows.max(axis=0)])
        try:
            declared = np.array([accessor["min"], accessor["max"]], np.float64)
            slack = BOUNDS_TOLERANCE * np.ptp(bounds, axis=0) + 1e-5 * np.abs(bounds).max()
            wrong = declared.shape != bounds.shape or not (np.abs(bounds - declared) <= slack).all()
        except (TypeError, ValueError):
            wrong = True
        if wrong:
            warn(
                f"{path}: {kind} of {name} go from {bounds[0].tolist()} to {bounds[1].tolist()}, but min and max of "
                f"accessor {read[kind]} are {accessor['min']} and {accessor['max']}; the file may be damaged"
            )


def _check_corners(
    name: str,
    primitive: dict[str, Any],
    count: int,
    indices: int | None,
    tree: dict[str, Any],
    views: list[bytes],
    fail: Any,
) -> None:
    """Refuse corners that make no triangles, or refer to vertices that are not there.

    `indices` is the accessor of a primitive's table of corners; None where its `count` vertices are the corners.
    """
    corners, owner = count, f"POSITION of {name}"
    if indices is not None:
        accessor = tree["accessors"][indices]
        corners, owner = accessor["count"], f"accessor {indices}, the indices of {name},"
        if "bufferView" not in accessor:
            raise fail(f"{owner} has no data")
        _, stride, row = _layout(accessor, tree["bufferViews"])
        if stride != row:
            raise fail(f"{owner} has rows {stride} bytes apart; expected them one after the other")
        largest = rows_of(accessor, tree["bufferViews"], views).max(initial=0)
        if largest >= count:
            raise fail(f"{owner} refers to vertex {largest} of {count}, which count from 0")
    if corners == 0 or (primitive.get("mode", 4) == 4 and corners % 3):
        raise fail(f"{owner} has {corners} corners of triangles; expected a multiple of 3")
