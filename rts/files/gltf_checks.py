"""GLB and glTF files checked before trimesh reads them: that what they promise is there, and colours are colours."""

from __future__ import annotations

import base64
import binascii
import importlib.util
import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from rts.errors import InputError
from rts.files.damage import unreadable, warn
from rts.files.images import is_image

TYPES = {5120: "i1", 5121: "u1", 5122: "i2", 5123: "u2", 5125: "u4", 5126: "f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
ATTRIBUTES = {
    **{"POSITION": ("VEC3",), "NORMAL": ("VEC3",), "TEXCOORD_0": ("VEC2",), "COLOR_0": ("VEC3", "VEC4")},
    "indices": ("SCALAR",),
}
MOST = 2**24
"""Rows of an accessor without data, all zero, which a damaged file could otherwise have any number of."""


def sound_glb(path: Path, data: bytes, file: Callable[[str], bytes]) -> bytes:
    """The GLB, without what may follow its end; or one of the same, with numbers that trimesh reads rightly.

    Args:
        path: its path.
        data: its bytes.
        file: the bytes of a file that it refers to.

    Raises:
        InputError: it is shorter than it promises; accessors reach beyond the data; colours are not finite or far off.
    """

    def fail(what: str) -> InputError:
        return unreadable(path, "GLB", what)

    if len(data) < 20 or data[:4] != b"glTF":
        raise fail("it does not begin with 'glTF' and a header of 20 bytes")
    length = struct.unpack_from("<I", data, 8)[0]
    if length > len(data):
        raise fail(f"its header promises {length} bytes, and it has {len(data)}")
    if length < len(data):
        warn(f"{path}: the {len(data) - length} bytes after the end that its header gives are not read")
    data = data[:length]
    at, chunks = 12, []
    while at < length:
        size, kind = struct.unpack_from("<I4s", data, at) if at + 8 <= length else (length, b"")
        if at + 8 + size > length:
            raise fail(f"a part of it promises {size} bytes, and {max(length - at - 8, 0)} are left")
        chunks.append((kind, data[at + 8 : at + 8 + size]))
        at += 8 + size
    if chunks[0][0] != b"JSON":
        raise fail("its first part is no JSON")
    binary = next((content for kind, content in chunks[1:] if kind == b"BIN\0"), None)
    return _checked(path, chunks[0][1], binary, file, fail) or data


def sound_gltf(path: Path, data: bytes, file: Callable[[str], bytes]) -> tuple[str, bytes]:
    """The glTF itself, or a GLB of the same; arguments and errors are those of `sound_glb`."""

    def fail(what: str) -> InputError:
        return unreadable(path, "GLTF", what)

    found = _checked(path, data, None, file, fail)
    return ("gltf", data) if found is None else ("glb", found)


def _checked(path: Path, text: bytes, binary: bytes | None, file: Callable[[str], bytes], fail: Any) -> bytes | None:
    """Refuse what is not sound. A GLB of the same, if there are numbers that trimesh would misread."""
    try:
        tree = json.loads(text)
        if not isinstance(tree, dict):
            raise ValueError("the whole is no object")
        buffers = [_buffer(b, binary if i == 0 else None, file, fail) for i, b in enumerate(tree.get("buffers", []))]
        views = [_view(i, v, buffers, fail) for i, v in enumerate(tree.get("bufferViews", []))]
        for index, accessor in enumerate(tree.get("accessors", [])):
            _check_accessor(index, accessor, tree.get("bufferViews", []), views, fail)
        changes: dict[int, str] = {}
        for m, mesh in enumerate(tree.get("meshes", [])):
            for primitive in mesh["primitives"]:
                changes |= _check_primitive(path, f"mesh {m}", primitive, tree, views, fail)
        for m, material in enumerate(tree.get("materials", [])):
            _check_material(path, f"material {m}", material, tree, views, file, fail)
        _check_nodes(tree.get("nodes", []), fail)
        return _changed(tree, views, changes) if changes else None
    except InputError:
        raise
    except Exception as error:  # Anything may be missing, or of another kind.
        raise fail(f"{type(error).__name__}: {error}") from error


def _changed(tree: dict[str, Any], views: list[bytes], changes: dict[int, str]) -> bytes:
    """A GLB in which these accessors hold colours of 8 bits ("u1"), or the fractions that integers stand for ("f4")."""
    blocks = [content + bytes(-len(content) % 4) for content in views]
    descriptions = [dict(view, buffer=0) for view in tree["bufferViews"]]
    for index, kind in sorted(changes.items()):
        accessor = tree["accessors"][index]
        values = _rows(accessor, tree["bufferViews"], views)
        if values.dtype.kind != "f":
            values = np.maximum(values / np.float32(np.iinfo(values.dtype).max), -1)
        if kind == "u1":
            values = np.round(255 * np.clip(values, 0, 1))
        content = values.astype("<" + kind).tobytes()
        kept = {key: value for key, value in accessor.items() if key not in ("byteOffset", "normalized", "min", "max")}
        types = {name: number for number, name in TYPES.items()}
        tree["accessors"][index] = {**kept, "componentType": types[kind], "bufferView": len(blocks)}
        blocks.append(content + bytes(-len(content) % 4))
        descriptions.append({"buffer": 0, "byteLength": len(content)})
    ends = np.cumsum([len(block) for block in blocks]).tolist()
    tree["bufferViews"] = [
        {**view, "byteOffset": end - len(block)} for view, end, block in zip(descriptions, ends, blocks, strict=True)
    ]
    tree["buffers"] = [{"byteLength": ends[-1]}]
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    return b"".join(
        [
            struct.pack("<4sIII4s", b"glTF", 2, 28 + len(text) + ends[-1], len(text), b"JSON"),
            text,
            struct.pack("<I4s", ends[-1], b"BIN\0"),
            *blocks,
        ]
    )


def _count(value: Any) -> int:
    if not isinstance(value, int) or isinstance(value, bool) or value < 0:
        raise ValueError(f"{value!r} is no count")
    return value


def _buffer(buffer: dict[str, Any], binary: bytes | None, file: Callable[[str], bytes], fail: Any) -> bytes:
    uri = buffer.get("uri")
    content = (binary or b"") if uri is None else _content(uri, file, fail)
    promised = _count(buffer["byteLength"])
    if promised > len(content):
        raise fail(f"a buffer promises {promised} bytes, and has {len(content)}")
    return content


def _content(uri: str, file: Callable[[str], bytes], fail: Any) -> bytes:
    if not uri.startswith("data:"):
        return file(uri)
    try:
        return base64.b64decode(uri.partition("base64,")[2], validate=True)
    except binascii.Error as error:
        raise fail(f"there are data that are not base64: {error}") from None


def _view(index: int, view: dict[str, Any], buffers: list[bytes], fail: Any) -> bytes:
    start, length = _count(view.get("byteOffset", 0)), _count(view["byteLength"])
    content = buffers[_count(view["buffer"])]
    if start + length > len(content):
        raise fail(f"bufferView {index} ends at byte {start + length} of {len(content)}")
    return content[start : start + length]


def _layout(accessor: dict[str, Any], descriptions: list[dict[str, Any]]) -> tuple[int, int, int]:
    """Where the rows of an accessor begin in its view, from one to the next, and the bytes of one."""
    row = np.dtype(TYPES[accessor["componentType"]]).itemsize * WIDTHS[accessor["type"]]
    stride = descriptions[accessor["bufferView"]].get("byteStride", row)
    return _count(accessor.get("byteOffset", 0)), _count(stride), row


def _check_accessor(
    index: int, accessor: dict[str, Any], descriptions: list[dict[str, Any]], views: list[bytes], fail: Any
) -> None:
    count = _count(accessor["count"])
    if "bufferView" not in accessor:
        if count > MOST:
            raise fail(f"accessor {index} promises {count} rows, and has no data")
        return
    content = views[_count(accessor["bufferView"])]
    start, stride, row = _layout(accessor, descriptions)
    end = start + max(count - 1, 0) * stride + row
    if count and end > len(content):
        raise fail(f"accessor {index} promises {count} rows, which end at byte {end} of {len(content)}")


def _rows(accessor: dict[str, Any], descriptions: list[dict[str, Any]], views: list[bytes]) -> np.ndarray:
    """The rows (N, C) of an accessor that has data, in its own type."""
    start, stride, row = _layout(accessor, descriptions)
    content = np.frombuffer(views[accessor["bufferView"]], np.uint8)[start:]
    rows = np.lib.stride_tricks.as_strided(content, (accessor["count"], row), (stride, 1))
    return np.ascontiguousarray(rows).view("<" + TYPES[accessor["componentType"]])


def _check_primitive(
    path: Path, name: str, primitive: dict[str, Any], tree: dict[str, Any], views: list[bytes], fail: Any
) -> dict[int, str]:
    """Refuse attributes that do not fit; which accessors trimesh would misread, and as what it would not."""
    attributes = primitive["attributes"]
    used = {**attributes, **({"indices": primitive["indices"]} if "indices" in primitive else {})}
    found = {kind: tree["accessors"][_count(index)] for kind, index in used.items()}
    sparse = [kind for kind, accessor in found.items() if "sparse" in accessor]
    if sparse:
        raise fail(f"{sparse[0]} of {name} is sparse, which is not read")
    for kind, accessor in found.items():
        if accessor["type"] not in ATTRIBUTES.get(kind, WIDTHS):
            raise fail(f"{kind} of {name} is of {accessor['type']}; expected {' or '.join(ATTRIBUTES[kind])}")
    count = found["POSITION"]["count"]
    different = [kind for kind in attributes if found[kind]["count"] != count]
    if different:
        raise fail(f"{different[0]} of {name} has {found[different[0]]['count']} rows, and POSITION {count}")
    if "bufferView" not in found["POSITION"] and not importlib.util.find_spec("DracoPy"):
        extensions = ", ".join(primitive.get("extensions", {})) or "none is named"
        raise fail(f"{name} has no data of its own, and the extension that has them is not read: {extensions}")
    read = {kind: a for kind, a in found.items() if kind in ATTRIBUTES and "bufferView" in a and count > 0}
    colors = read.get("COLOR_0")
    if colors is not None and colors["componentType"] == 5126:
        _check_colors(path, f"COLOR_0 of {name}", _rows(colors, tree["bufferViews"], views), fail)
    changes = {}
    for kind, accessor in read.items():
        if kind == "COLOR_0":
            if accessor["componentType"] != 5121:
                changes[used[kind]] = "u1"
        elif kind != "indices" and accessor.get("normalized") and accessor["componentType"] != 5126:
            changes[used[kind]] = "f4"
    return changes


def _check_material(
    path: Path,
    name: str,
    material: dict[str, Any],
    tree: dict[str, Any],
    views: list[bytes],
    file: Callable[[str], bytes],
    fail: Any,
) -> None:
    """Refuse a colour or a texture that is none; trimesh leaves out what it cannot read."""
    look = material.get("pbrMetallicRoughness", {})
    factor = np.array(look.get("baseColorFactor", [1.0] * 4), np.float64)
    if factor.shape != (4,):
        raise fail(f"the baseColorFactor of {name} is {factor.tolist()}; expected four numbers")
    _check_colors(path, f"baseColorFactor of {name}", factor[None], fail)
    if "baseColorTexture" not in look:
        return
    reference = look["baseColorTexture"]
    if "KHR_texture_transform" in reference.get("extensions", {}) or reference.get("texCoord", 0) != 0:
        warn(f"{path}: the texture of {name} has a transform or coordinates of its own, which are not read")
    texture = tree["textures"][_count(reference["index"])]
    webp = texture.get("extensions", {}).get("EXT_texture_webp", {})
    source = webp.get("source", texture.get("source"))
    if source is None:
        warn(f"{path}: the texture of {name} is of a kind that is not read; it is loaded without")
        return
    image = tree["images"][_count(source)]
    content = views[_count(image["bufferView"])] if "bufferView" in image else _content(image["uri"], file, fail)
    if not is_image(content):
        raise fail(f"the texture of {name} cannot be read as an image")


def _check_colors(path: Path, name: str, colors: np.ndarray, fail: Any) -> None:
    """Refuse colours (N, C) that are none; warn of those that trimesh brings into range."""
    wrong = ~(np.abs(colors) <= 255).all(axis=1)
    if wrong.any():
        at = int(np.argmax(wrong))
        raise fail(f"row {at} of {name} is {colors[at].tolist()}; expected colours from 0 to 1")
    if ((colors < 0) | (colors > 1)).any():
        warn(f"{path}: {name} has colours that are not from 0 to 1, which are clipped")


def _check_nodes(nodes: list[dict[str, Any]], fail: Any) -> None:
    """Refuse nodes that are not of a forest: whoever walks among them would never end, or go to one many times."""
    children = [_count(child) for node in nodes for child in node.get("children", [])]
    if len(set(children)) < len(children) or any(child >= len(nodes) for child in children):
        raise fail("a node is the child of two, or there is no such node")
    inner, reached = set(children), 0
    ahead = [i for i in range(len(nodes)) if i not in inner]
    while ahead:
        reached += 1
        ahead += nodes[ahead.pop()].get("children", [])
    if reached < len(nodes):
        raise fail("a node is among its own children")
