"""GLB and glTF of the sheet whose trees or data are damaged."""

import json
import struct

import numpy as np
from sheets import BROKEN, GONE, VERTICES, Case, glb, gltf, gltf_tree
from text_damages import ARABIC

_SHARED = "data of the same kind that are there"


def _set(path, value):
    """A change of the tree: what a path leads to becomes a value; None takes it away."""

    def change(tree):
        *ways, last = path.split(".")
        there = tree
        for way in ways:
            there = there[int(way) if way.isdecimal() else way]
        last = int(last) if last.isdecimal() else last
        if value is None:
            there.pop(last)
        else:
            there[last] = value

    return change


def _quantized(kind, normalized, declared):
    """A change of tree and data: positions of the first mesh as integers."""

    def change(tree, data):
        accessor = tree["accessors"][0]
        scale = 8 if normalized is None else np.iinfo(kind).max
        values = np.round(VERTICES * 8 if normalized is None else VERTICES / 4 * scale).astype(kind)
        stored = np.zeros((9, 4), kind)
        stored[:, :3] = values
        accessor.update(componentType={"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123}[kind], bufferView=4)
        accessor.update(min=values.min(axis=0).tolist(), max=values.max(axis=0).tolist())
        if normalized is not None:
            accessor["normalized"] = normalized
        tree["bufferViews"].append(
            {"buffer": 0, "byteOffset": len(data), "byteLength": stored.nbytes, "byteStride": stored.itemsize * 4}
        )
        size = 1 / 8 if normalized is None else 4 if normalized else 4 / scale
        tree["nodes"][1] = {"mesh": 0, "translation": [-0.5, 0, 0], "scale": [size] * 3}
        tree["buffers"][0]["byteLength"] = len(data) + stored.nbytes
        for name in declared:
            tree[name] = ["KHR_mesh_quantization"]
        return data + stored.tobytes()

    return change


def tree_changes():
    """Changes of the tree of a glTF, by name, each with the reason why it cannot be told, or ""."""
    for i, kind in enumerate(("POSITION", "NORMAL", "indices")):
        of = f"accessors.{i}"
        for value in (5120, 5121, 5122, 5123, 5124, 5125, 5126, 5130, "5126", 5126.0, True, None):
            yield f"componentType of {kind} {value!r}", _set(f"{of}.componentType", value), ""
        for value in (True, False, "true", 1):
            yield f"normalized of {kind} {value!r}", _set(f"{of}.normalized", value), ""
        for value in (1, 2, 3, 4, 6, 8, 12, 16, 24, 100, 10**6, -4, -24, "4", 4.0, 2**63):
            yield f"byteOffset of {kind} {value!r}", _set(f"{of}.byteOffset", value), ""
        for value in (0, 1, 2, 3, 6, 8, 10, 11, 13, 27, 10**9, -1, "9", 9.0, None, True):
            yield f"count of {kind} {value!r}", _set(f"{of}.count", value), ""
        for value in ("SCALAR", "VEC2", "VEC3", "VEC4", "MAT2", "MAT4", "vec3", "", None, 3):
            yield f"type of {kind} {value!r}", _set(f"{of}.type", value), ""
        for value in (0, 1, 2, 3, 4, -1, -2, "0", 1.0, None, True):
            reason = _SHARED if (kind, value) == ("indices", 3) else ""
            yield f"bufferView of {kind} {value!r}", _set(f"{of}.bufferView", value), reason
        for value in ([0], [0, 0, 0], [9, 9, 9], [float("nan")] * 3, "x", None, [1e30] * 3, [float("inf")] * 3):
            for which in ("min", "max"):
                if kind != "NORMAL" or value is not None:
                    yield f"{which} of {kind} {value!r}", _set(f"{of}.{which}", value), ""
        yield f"{kind} sparse", _set(f"{of}.sparse", {"count": 1, "indices": {}, "values": {}}), ""
        yield (
            f"{kind} misspelt byteOffset",
            lambda tree, i=i: _rename(tree["accessors"][i], "byteOffset", "byteoffset"),
            "",
        )
    for i in (0, 2):
        of = f"bufferViews.{i}"
        for value in (
            *(0, 1, 2, 4, 8, 11, 12, 13, 16, 20, 22, 23, 24, 25, 26, 28, 32, 36, 256, 10**6),
            *(-24, "24", 24.0, None),
        ):
            if value is not None or i == 0:
                yield f"byteStride of view {i} {value!r}", _set(f"{of}.byteStride", value), ""
        for value in (0, 1, 2, 3, 4, 8, 24, 216, 432, 456, 10**6, -1, "0", 0.0, None):
            reason = _SHARED if (i, value) == (2, 456) else ""
            yield f"byteOffset of view {i} {value!r}", _set(f"{of}.byteOffset", value), reason
        for value in (0, 1, 12, 23, 24, 200, 215, 217, 480, 10**9, -1, "216", None):
            yield f"byteLength of view {i} {value!r}", _set(f"{of}.byteLength", value), ""
        for value in (1, -1, "0", 0.0, None):
            yield f"buffer of view {i} {value!r}", _set(f"{of}.buffer", value), ""
    for value in (0, 1, 479, 481, 10**9, -1, "480", None):
        yield f"byteLength of the buffer {value!r}", _set("buffers.0.byteLength", value), ""
    yield from node_changes()
    yield from structure_changes()


def node_changes():
    """Changes of the places of meshes."""
    unit = [1.0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, -0.5, 0, 0, 1]
    for at in range(16):
        for value in (float("nan"), float("inf"), 1e39, "1", None):
            matrix = [*unit]
            matrix[at] = value
            yield f"entry {at} of a matrix {value!r}", _set("nodes.1.matrix", matrix), ""
    moved = "a matrix that is sound"
    for name, matrix, reason in (
        ("transposed", np.reshape(unit, (4, 4)).T.ravel().tolist(), ""),
        ("zero", [0.0] * 16, ""),
        ("flat", [1.0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0, -0.5, 0, 0, 1], ""),
        ("singular", [1.0, 1, 0, 0, 1, 1, 0, 0, 0, 0, 1, 0, -0.5, 0, 0, 1], ""),
        ("nearly singular", [1.0, 1, 0, 0, 1, 1 + 1e-12, 0, 0, 0, 0, 1, 0, -0.5, 0, 0, 1], ""),
        ("with weight 2", [*unit[:15], 2.0], ""),
        ("with weight 0", [*unit[:15], 0.0], ""),
        ("in perspective", [1.0, 0, 0, 0.1, *unit[4:]], ""),
        ("of 1e30", [1e30, 0, 0, 0, 0, 1e30, 0, 0, 0, 0, 1e30, 0, 0, 0, 0, 1], moved),
        ("of 1e300", [1e300, 0, 0, 0, 0, 1e300, 0, 0, 0, 0, 1e300, 0, 0, 0, 0, 1], ""),
        ("that moves by 1e300", [*unit[:12], 1e300, 0, 0, 1], ""),
        ("of 15 numbers", unit[:15], ""),
        ("of 17 numbers", [*unit, 1.0], ""),
        ("of 4 rows", np.reshape(unit, (4, 4)).tolist(), ""),
        ("of 12 numbers", unit[:12], ""),
        ("that mirrors", [-1.0, *unit[1:]], moved),
        ("that shears", [1.0, 0.5, *unit[2:]], moved),
        ("of text", "unit", ""),
        ("of nothing", [], ""),
        ("of objects", {}, ""),
    ):
        yield f"a matrix {name}", _set("nodes.1.matrix", matrix), reason
    for name, value in (
        *(
            ("scale", value)
            for value in ([0, 0, 0], [1, 1, 0], [1, 1], [1], 1, [1, 1, 1, 1], [1e-300] * 3, [1e200] * 3)
        ),
        *(("scale", value) for value in (["1"] * 3, [float("nan")] * 3, [[1, 1, 1]], "111", {}, [1e-46] * 3)),
        *(("translation", value) for value in ([0.5, 2], [0.5, 2, 3, 0], 1, [1e39] * 3, [float("inf"), 0, 0], "abc")),
        *(("rotation", value) for value in ([0, 0, 0, 0], [0, 0, 0], [0, 0, 0, 2], [0, 0, 0, 1e-200], [0, 0, 0, 1, 0])),
        *(("rotation", value) for value in ([float("nan")] * 4, "0001", 1, [0, 0, 0, 0.9], [0, 0, 0, 1e200])),
        *(("rotation", value) for value in ([0, 0, 0, 1.0004], [0, 0, 0, -1])),
        *(("mesh", value) for value in (2, 7, -1, "1", 1.0, True)),
        *(("children", value) for value in ([7], [-1], ["1"], [2], [0], [1], 1, [1.0])),
        *(("matrix", value) for value in ([1.0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1],)),
        *((f"{key} ", [1, 1, 1]) for key in ("scale", "translation")),
    ):
        yield f"{name!r} of a node {value!r}", _set(f"nodes.2.{name}", value), ""
    for node, name, reason in (
        *((1, "matrix", GONE), (2, "translation", GONE), (2, "mesh", GONE)),
        *((0, "children", ""), (2, "scale", ""), (2, "rotation", "")),
    ):
        yield f"{name} of a node gone", _set(f"nodes.{node}.{name}", None), reason
        yield f"{name} of a node misspelt", lambda t, n=node, k=name: _rename(t["nodes"][n], k, k[:-1] + "x"), ""


def structure_changes():
    """Changes of meshes, scenes, extensions."""
    first = "meshes.0.primitives.0"
    for value in (0, 1, 2, 3, 5, 6, 7, -1, "4", 4.0, None):
        reason = "a strip, or a fan, of the same indices is sound" if value in (5, 6) else ""
        yield f"mode {value!r}", _set(f"{first}.mode", value), reason
    for value in (0, 1, 3, 4, 5, 6, -1, "2", 2.0, None, True):
        reason = {5: _SHARED, None: GONE}.get(value if value is not True else -9, "")
        yield f"indices {value!r}", _set(f"{first}.indices", value), reason
    for value in (1, 2, 3, 4, 5, 6, -1, "0", 0.0, None, True):
        reason = {3: _SHARED, 4: _SHARED}.get(value if value is not True else -9, "")
        yield f"POSITION {value!r}", _set(f"{first}.attributes.POSITION", value), reason
    for name in ("POSITION", "NORMAL", "indices", "attributes", "mode"):
        there = f"{first}.attributes" if name.isupper() else first
        yield f"{name} misspelt", lambda t, n=name, w=there: _rename(_at(t, w), n, n[:-1] + "x"), ""
    for name in ("buffers", "bufferViews", "accessors", "meshes", "nodes", "scenes", "scene", "asset"):
        yield f"{name} gone", _set(name, None), ""
        yield f"{name} misspelt", lambda t, n=name: _rename(t, n, n + "x"), ""
        for value in ([], {}, [{}], "x", 7, -1, True):
            if (name, value) != ("scene", True):
                yield f"{name} are {value!r}", _set(name, value), ""
    for i, name in enumerate(("bufferViews", "accessors", "meshes", "nodes")):
        for entry in range(3):
            if entry < 2 or name != "meshes":
                lost = GONE if (name, entry) == ("nodes", 0) else ""
                yield f"{name} without the one of number {entry}", _set(f"{name}.{entry}", None), lost
                yield (
                    f"{name} whose number {entry} is empty",
                    _set(f"{name}.{entry}", {}),
                    GONE if i > 2 and entry else "",
                )
    for value in ([1], [0, 0], [0, 1], [7], [-1], ["0"], [], 0, [True]):
        yield f"nodes of the scene {value!r}", _set("scenes.0.nodes", value), ""
    for version in ("1.0", "3.0", 2.0, "", "2", "x", None):
        yield f"version {version!r}", _set("asset.version", version), ""
    yield "a version that is needed", _set("asset.minVersion", "2.5"), ""
    for name in (
        "KHR_draco_mesh_compression",
        "EXT_meshopt_compression",
        "KHR_unknown",
        "X_shape",
        "KHR_Mesh_Quantization",
    ):
        yield f"{name} required", _set("extensionsRequired", [name]), ""
    for name in ("KHR_materials_unlit", "KHR_lights_punctual", "KHR_mesh_quantization"):
        yield f"{name} required", _set("extensionsRequired", [name]), ""
    for value in ("KHR_unknown", [1], {}, [None]):
        yield f"{value!r} required", _set("extensionsRequired", value), ""
    instances = {"EXT_mesh_gpu_instancing": {"attributes": {"TRANSLATION": 0}}}
    yield "a node that shows nothing, of no size", lambda tree: tree["nodes"].append({"scale": [0, 0, 0]}), ""
    yield "instances of a node", _set("nodes.1.extensions", instances), ""
    yield "a skin of a node", _set("nodes.1.skin", 0), ""
    yield "weights of a mesh", _set("meshes.0.weights", [1.0]), ""


def data_changes():
    """Changes of tree and data, each with the reason why it cannot be told, or ""."""
    both = ("extensionsUsed", "extensionsRequired")
    for kind in ("i1", "u1", "i2", "u2"):
        for normalized in (None, True):
            for declared in ((), ("extensionsUsed",), both):
                yield f"{kind} {normalized} {declared}", _quantized(kind, normalized, declared), ""
    for name, change in {
        "data a byte later": lambda tree, data: b"\0" + data[:-1],
        "data a byte earlier": lambda tree, data: data[1:] + b"\0",
        "data four bytes later": lambda tree, data: bytes(4) + data[:-4],
        "data a row later": lambda tree, data: data[-24:] + data[:-24],
        "data of the other endianness": lambda tree, data: np.frombuffer(data, "<u4").byteswap().tobytes(),
        "data backwards": lambda tree, data: data[::-1],
        "data all zero": lambda tree, data: bytes(len(data)),
        "data all one": lambda tree, data: b"\xff" * len(data),
        "data too short": lambda tree, data: data[:-4],
        "data too long": lambda tree, data: data + bytes(4),
        "no data": lambda tree, data: b"",
        "an index too large": lambda tree, data: data[:-2] + b"\x09\x00",
        "an index far too large": lambda tree, data: data[:-2] + b"\xff\xff",
    }.items():
        yield name, change, ""
    yield "another index", lambda tree, data: data[:-2] + b"\x06\x00", BROKEN
    yield "another coordinate", lambda tree, data: data[:96] + struct.pack("<f", 1) + data[100:], BROKEN


def _rename(there, old, new):
    there[new] = there.pop(old, 0)


def _at(tree, path):
    for way in path.split("."):
        tree = tree[int(way) if way.isdecimal() else way]
    return tree


def tree_cases():
    """GLB, and glTF with a file beside it, whose tree or data are changed."""
    for name, change, reason in (*tree_changes(), *data_changes()):
        tree, data = gltf_tree()
        if change.__code__.co_argcount - len(change.__defaults__ or ()) == 2:
            data = change(tree, data)
        else:
            change(tree)
        yield Case(f"glb: {name}", {"m.glb": glb(tree, data)}, reason)
        if isinstance(tree.get("buffers"), list) and all(isinstance(b, dict) for b in tree["buffers"]):
            yield Case(f"gltf: {name}", gltf(tree, data), reason)
    tree, data = gltf_tree()
    text = json.dumps(tree)
    for name, other in {
        "a mark": "\ufeff" + text,
        "arabic digits": text.translate(ARABIC),
        "no-break spaces": text.replace(" ", "\u00a0"),
        "single quotes": text.replace('"', "'"),
        "a comma at the end": text[:-1] + ",}",
        "an end that lacks": text[:-1],
        "NULs at the end": text + "\0" * 4,
        "twice": text + text,
        "a list": f"[{text}]",
        "empty": "",
        "deep": "[" * 100000,
        "a comment": "// glTF\n" + text,
        "count twice": text.replace('"count": 9', '"count": 9, "count": 6', 1),
        "UTF-16": text.encode("utf-16"),
    }.items():
        other = other if isinstance(other, bytes) else other.encode()
        yield Case(f"glb: a tree with {name}", {"m.glb": glb(None, data, other)})
    for place in range(3, len(text), 23):
        flipped = bytearray(text.encode())
        flipped[place] ^= 1 << place % 7
        yield Case(f"glb: bit {place % 7} of byte {place} of the tree", {"m.glb": glb(None, data, bytes(flipped))})
