"""Checks of GLB and glTF files before trimesh reads them: promised data are present, and colours are in range."""

from __future__ import annotations

import base64
import binascii
import importlib.util
import json
import re
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from rts.errors import InputError
from rts.files.damaged_files import unreadable, warn
from rts.files.gltf_accessors import QUANTIZATION, TYPES, check_accessor, check_attributes, count_of, rows_of
from rts.files.gltf_scenes import check_scenes
from rts.files.images import is_image

APPEARANCE = re.compile(r"[A-Z]+_(materials|lights|texture|xmp|animation)")
"""Names of extensions that do not concern shapes begin like this."""
TOLD = "EXT_mesh_gpu_instancing"
"""An extension of which `check_scenes` warns."""
PROPERTIES = {
    "accessors": "bufferView byteOffset componentType normalized count type max min sparse",
    "bufferViews": "buffer byteOffset byteLength byteStride target",
    "meshes": "primitives weights",
    "primitives": "attributes indices material mode targets",
    "nodes": "camera children skin matrix mesh rotation scale translation weights",
    "scenes": "nodes",
}
"""Properties of each kind of object, beside a name, extensions and extras."""
ATTRIBUTE = re.compile(r"POSITION|NORMAL|TANGENT|(TEXCOORD|COLOR|JOINTS|WEIGHTS)_[0-9]+|_.*")
MODES = {0: "points", 1: "lines", 2: "lines", 3: "lines"}


def sound_glb(path: Path, data: bytes, file: Callable[[str], bytes]) -> bytes:
    """The GLB, without bytes after its end; or an equal one with numbers that trimesh reads rightly.

    Args:
        path: its path.
        data: its bytes.
        file: name → bytes of a file that it refers to.

    Raises:
        InputError: it is shorter than it promises, a part is missing or unsound, accessors reach beyond the data, or
            colours are not finite or far off.
    """

    def fail(what: str) -> InputError:
        return unreadable(path, "GLB", what)

    if len(data) < 20 or data[:4] != b"glTF":
        raise fail("it does not begin with 'glTF' and a header of 20 bytes")
    version, length = struct.unpack_from("<II", data, 4)
    if version != 2:
        raise fail(f"its header says version {version}; expected 2")
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
    """The glTF itself, or an equal GLB; arguments and errors as for `sound_glb`."""

    def fail(what: str) -> InputError:
        return unreadable(path, "GLTF", what)

    rewritten = _checked(path, data, None, file, fail)
    return ("gltf", data) if rewritten is None else ("glb", rewritten)


def _checked(path: Path, text: bytes, binary: bytes | None, file: Callable[[str], bytes], fail: Any) -> bytes | None:
    """Refuse a damaged file, of JSON `text` and, in a GLB, the `binary` part for its first buffer.

    Returns:
        The file as a GLB that trimesh reads rightly, if it holds numbers that trimesh would misread; else None.
    """
    place = "its tree"
    try:
        tree = json.loads(text, parse_constant=_no_number, object_pairs_hook=_unique)
        if not isinstance(tree, dict):
            raise ValueError("the whole is no object")
        _check_extensions(path, tree, fail)
        buffers, views, changes = [], [], {}
        for i, buffer in enumerate(tree.get("buffers", [])):
            place = f"buffer {i}"
            buffers.append(_buffer(i, buffer, binary if i == 0 else None, file, fail))
        for i, view in enumerate(tree.get("bufferViews", [])):
            place = f"bufferView {i}"
            views.append(_view(i, view, buffers, fail))
        for i, accessor in enumerate(tree.get("accessors", [])):
            place = f"accessor {i}"
            check_accessor(i, accessor, tree.get("bufferViews", []), views, fail)
        for i, mesh in enumerate(tree.get("meshes", [])):
            place = f"mesh {i}"
            for primitive in mesh["primitives"]:
                changes |= _check_primitive(path, place, primitive, tree, views, fail)
        for i, material in enumerate(tree.get("materials", [])):
            place = f"material {i}"
            _check_material(path, place, material, tree, views, file, fail)
        place = "its scene"
        check_scenes(path, tree, fail)
        _check_names(path, tree)
        return _changed(tree, views, changes) if changes else None
    except InputError:
        raise
    except Exception as error:  # Anything may be missing, or of another kind.
        said = f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"
        raise fail(f"{place}: {f'{error} is missing' if isinstance(error, KeyError) else said}") from error


def _no_number(name: str) -> float:
    raise ValueError(f"{name} is no number in JSON")


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    members = dict(pairs)
    if len(members) < len(pairs):
        raise ValueError(f"one of {', '.join(members)[:60]} is there twice")
    return members


def _changed(tree: dict[str, Any], views: list[bytes], changes: dict[int, str]) -> bytes:
    """A GLB with some accessors converted; `tree` is changed in place.

    Args:
        tree: the JSON.
        views: the bytes of each bufferView.
        changes: accessor's index → "u1", to colours of 8 bits, or "f4", from integers to the fractions they stand for.
    """
    blocks = [content + bytes(-len(content) % 4) for content in views]
    descriptions = [dict(view, buffer=0) for view in tree["bufferViews"]]
    for index, kind in sorted(changes.items()):
        accessor = tree["accessors"][index]
        values = rows_of(accessor, tree["bufferViews"], views)
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


def _buffer(index: int, buffer: dict[str, Any], binary: bytes | None, file: Callable[[str], bytes], fail: Any) -> bytes:
    uri, extensions = buffer.get("uri"), buffer.get("extensions", {})
    # A buffer of compression's may stand for data that are nowhere.
    absent = any(extension.get("fallback") for extension in extensions.values())
    content = (b"" if absent else binary or b"") if uri is None else _content(uri, file, fail)
    promised = count_of(buffer["byteLength"])
    if promised > len(content):
        unread = f", and the extension that has them is not read: {', '.join(extensions)}" if extensions else ""
        raise fail(f"buffer {index} promises {promised} bytes, and has {len(content)}{unread}")
    return content


def _content(uri: str, file: Callable[[str], bytes], fail: Any) -> bytes:
    if not uri.startswith("data:"):
        return file(uri)
    try:
        return base64.b64decode(uri.partition("base64,")[2], validate=True)
    except binascii.Error as error:
        raise fail(f"there are data that are not base64: {error}") from None


def _view(index: int, view: dict[str, Any], buffers: list[bytes], fail: Any) -> bytes:
    start, length = count_of(view.get("byteOffset", 0)), count_of(view["byteLength"])
    content = buffers[count_of(view["buffer"])]
    if start + length > len(content):
        raise fail(f"bufferView {index} ends at byte {start + length} of {len(content)}")
    return content[start : start + length]


def _check_primitive(
    path: Path, name: str, primitive: dict[str, Any], tree: dict[str, Any], views: list[bytes], fail: Any
) -> dict[int, str]:
    """Refuse an unfit mode, material or attribute; warn of points and lines.

    Returns:
        Indices of the accessors that trimesh would misread, with the types to convert them to; see `_changed`.
    """
    mode = count_of(primitive.get("mode", 4))
    if mode > 5:
        raise fail(f"{name} has mode {mode}{', a fan' if mode == 6 else ''}; expected triangles (4) or a strip (5)")
    if mode in MODES:
        warn(f"{path}: {name} is of {MODES[mode]}, which are left out")
    if "material" in primitive and count_of(primitive["material"]) >= len(tree.get("materials", [])):
        raise fail(f"{name} has material {primitive['material']}, which is not there")
    read = check_attributes(path, name, primitive, tree, views, fail)
    accessors = {kind: tree["accessors"][index] for kind, index in read.items()}
    colors = accessors.get("COLOR_0")
    if colors is not None and colors["componentType"] == 5126:
        _check_colors(path, f"COLOR_0 of {name}", rows_of(colors, tree["bufferViews"], views), fail)
    changes = {}
    for kind, accessor in accessors.items():
        if kind == "COLOR_0":
            if accessor["componentType"] != 5121:
                changes[read[kind]] = "u1"
        elif kind != "indices" and accessor.get("normalized") and accessor["componentType"] != 5126:
            changes[read[kind]] = "f4"
    return changes


def _check_extensions(path: Path, tree: dict[str, Any], fail: Any) -> None:
    """Refuse other versions, and extensions that are needed and not read; warn of those that are only used."""
    asset = tree.get("asset", {})
    if not str(asset.get("version", "2")).startswith("2") or str(asset.get("minVersion", "2.0")) != "2.0":
        raise fail(f"it is of version {asset.get('minVersion', asset.get('version'))!r} of glTF; expected 2.0")
    required = tree.get("extensionsRequired", [])
    read = {QUANTIZATION, *(["KHR_draco_mesh_compression"] if importlib.util.find_spec("DracoPy") else [])}
    unknown = [name for name in required if name not in read and not APPEARANCE.match(str(name))]
    if unknown or not isinstance(required, list):
        raise fail(f"it requires the extension {(unknown or [required])[0]!r}, which is not read")
    holders = [*tree.get("bufferViews", []), *(p for mesh in tree.get("meshes", []) for p in mesh["primitives"])]
    used = [*tree.get("extensionsUsed", []), *(name for holder in holders for name in holder.get("extensions", {}))]
    for name in dict.fromkeys(used):
        if name not in (*read, TOLD) and not APPEARANCE.match(name):
            warn(f"{path} uses the extension {name[:60]}, which is not read; it is loaded as it is without")


def _check_names(path: Path, tree: dict[str, Any]) -> None:
    """Warn of properties that the format does not know, which may be others misspelt."""
    lists = {kind: tree.get(kind, []) for kind in PROPERTIES}
    lists["primitives"] = [p for mesh in lists["meshes"] for p in mesh["primitives"]]
    unknown = []
    for kind, objects in lists.items():
        known = {*PROPERTIES[kind].split(), "name", "extensions", "extras"}
        unknown += [f"{name!r} of {kind} {i}" for i, entry in enumerate(objects) for name in entry if name not in known]
    for i, primitive in enumerate(lists["primitives"]):
        unknown += [f"{name!r} of primitives {i}" for name in primitive["attributes"] if not ATTRIBUTE.fullmatch(name)]
    if unknown:
        warn(f"{path} has properties that glTF does not know, and that are left out: {', '.join(unknown[:5])}")


def _check_material(
    path: Path,
    name: str,
    material: dict[str, Any],
    tree: dict[str, Any],
    views: list[bytes],
    file: Callable[[str], bytes],
    fail: Any,
) -> None:
    """Refuse an invalid colour or texture, which trimesh would leave out; warn of what is not read of a texture."""
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
    texture = tree["textures"][count_of(reference["index"])]
    webp = texture.get("extensions", {}).get("EXT_texture_webp", {})
    source = webp.get("source", texture.get("source"))
    if source is None:
        warn(f"{path}: the texture of {name} is of a kind that is not read; it is loaded without")
        return
    image = tree["images"][count_of(source)]
    content = views[count_of(image["bufferView"])] if "bufferView" in image else _content(image["uri"], file, fail)
    if not is_image(content):
        raise fail(f"the texture of {name} cannot be read as an image")


def _check_colors(path: Path, name: str, colors: np.ndarray, fail: Any) -> None:
    """Refuse colours (N, C) that are NaN or beyond ±255; warn of others not from 0 to 1, which trimesh clips."""
    wrong = ~(np.abs(colors) <= 255).all(axis=1)
    if wrong.any():
        at = int(np.argmax(wrong))
        raise fail(f"row {at} of {name} is {colors[at].tolist()}; expected colours from 0 to 1")
    if ((colors < 0) | (colors > 1)).any():
        warn(f"{path}: {name} has colours that are not from 0 to 1, which are clipped")
