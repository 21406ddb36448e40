"""Model files of one shape, a wavy sheet, in every format; their damages are in files beside this one."""

import copy
import json
import re
import struct
from typing import NamedTuple

import numpy as np

_ROWS, _COLUMNS = np.indices((3, 3)).reshape(2, -1)
VERTICES = np.stack([1.25 * _COLUMNS, 0.75 * _ROWS, 0.25 + 0.5 * ((_ROWS + _COLUMNS) % 3)], axis=1)
_FIRST = np.array([0, 1, 3, 4])[:, None]
FACES = np.concatenate([_FIRST + [0, 1, 4], _FIRST + [0, 4, 3]])
TRIANGLES = VERTICES[FACES]

BROKEN, GONE, MORE = (
    "a flipped bit makes another number",
    "what is gone leaves no trace",
    "what is more is sound as well",
)


class Case(NamedTuple):
    """A damaged model.

    Attributes:
        name: what was done to which file.
        files: bytes by name; the first one is the model.
        reason: why another shape cannot be told from a sound one; "" where it can.
    """

    name: str
    files: dict[str, bytes]
    reason: str = ""


def _rows(values):
    return "".join(" ".join(f"{x:g}" for x in row) + "\n" for row in values)


def _obj():
    lines = ["# a wavy sheet", "o sheet", "g one two", *("v " + row for row in _rows(VERTICES).splitlines())]
    lines += ["vt 0 0.5", "vn 0 0 1", "s off"]
    return "\n".join([*lines, *("f " + " ".join(f"{i + 1}/1/1" for i in face) for face in FACES)]) + "\n"


def _plain_obj():
    return re.sub(r"/1/1|v[tn].*\n", "", _obj())


def _ply_header(layout):
    return (
        f"ply\nformat {layout} 1.0\ncomment a sheet\nelement vertex 9\nproperty float x\nproperty float y\n"
        "property float z\nelement face 8\nproperty list uchar int vertex_indices\nend_header\n"
    )


def _counted(order="<"):
    return b"".join(struct.pack(f"{order}B3i", 3, *map(int, face)) for face in FACES)


def _stl():
    a, b, c = np.moveaxis(TRIANGLES, 1, 0)
    normals = np.cross(b - a, c - a)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    records = np.concatenate([normals[:, None], TRIANGLES], axis=1).astype("<f4").reshape(-1, 12)
    return b"a sheet".ljust(80) + struct.pack("<I", 8) + b"".join(record.tobytes() + b"\0\0" for record in records)


def _stl_text(name="sheet"):
    facets = "".join(
        "  facet normal 0 0 1\n    outer loop\n"
        + "".join(f"      vertex {' '.join(f'{x:g}' for x in corner)}\n" for corner in triangle)
        + "    endloop\n  endfacet\n"
        for triangle in TRIANGLES
    )
    return f"solid {name}\n{facets}endsolid {name}\n"


def gltf_tree():
    """A glTF of two halves of the sheet, positions and normals interleaved, one half in a place of its own."""
    packed = np.concatenate([VERTICES, np.tile([0.0, 0, 1], (9, 1))], axis=1)
    moved = packed - [1, 2, 3, 0, 0, 0]
    indices = FACES.astype("<u2").reshape(2, -1)
    blocks = [packed.astype("<f4").tobytes(), moved.astype("<f4").tobytes(), indices[0].tobytes(), indices[1].tobytes()]
    ends = np.cumsum([len(block) for block in blocks]).tolist()
    views = [{"buffer": 0, "byteOffset": e - len(b), "byteLength": len(b)} for e, b in zip(ends, blocks, strict=True)]
    accessors, meshes = [], []
    for i, rows in enumerate((packed, moved)):
        views[i]["byteStride"] = 24
        bounds = {"min": rows[:, :3].min(axis=0).tolist(), "max": rows[:, :3].max(axis=0).tolist()}
        accessors += [
            {"bufferView": i, "componentType": 5126, "count": 9, "type": "VEC3", **bounds},
            {"bufferView": i, "byteOffset": 12, "componentType": 5126, "count": 9, "type": "VEC3"},
            {"bufferView": 2 + i, "componentType": 5123, "count": 12, "type": "SCALAR", "min": [0], "max": [8]},
        ]
        attributes = {"POSITION": 3 * i, "NORMAL": 3 * i + 1}
        meshes.append({"primitives": [{"attributes": attributes, "indices": 3 * i + 2, "mode": 4}]})
    nodes = [
        {"children": [1, 2], "translation": [0.5, 0, 0]},
        {"mesh": 0, "matrix": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, -0.5, 0, 0, 1]},
        {"mesh": 1, "translation": [0.5, 2, 3], "rotation": [0, 0, 0, 1], "scale": [1, 1, 1]},
    ]
    tree = {
        "asset": {"version": "2.0"},
        **{"scene": 0, "scenes": [{"nodes": [0]}], "nodes": nodes, "meshes": meshes, "accessors": accessors},
        **{"bufferViews": views, "buffers": [{"byteLength": ends[-1]}]},
    }
    return tree, b"".join(blocks)


def glb(tree, data, text=None):
    """A GLB of a tree, or of its text, and its data."""
    text = json.dumps(tree).encode() if text is None else text
    text += b" " * (-len(text) % 4)
    data += bytes(-len(data) % 4)
    head = struct.pack("<4sIII4s", b"glTF", 2, 28 + len(text) + len(data), len(text), b"JSON")
    return head + text + struct.pack("<I4s", len(data), b"BIN\0") + data


def gltf(tree, data):
    """A glTF of a tree, and its data in a file beside it."""
    tree = copy.deepcopy(tree)
    if tree.get("buffers"):
        tree["buffers"][0]["uri"] = "m.bin"
    return {"m.gltf": json.dumps(tree).encode(), "m.bin": data}


TEXTS = {
    "obj": _obj(),
    "plain.obj": _plain_obj(),
    "ply": _ply_header("ascii") + _rows(VERTICES) + _rows(np.insert(FACES, 0, 3, axis=1)),
    "off": f"OFF\n9 8 0\n{_rows(VERTICES)}{_rows(np.insert(FACES, 0, 3, axis=1))}",
    "stl": _stl_text(),
}
BINARIES = {
    "little.ply": _ply_header("binary_little_endian").encode() + VERTICES.astype("<f4").tobytes() + _counted(),
    "big.ply": _ply_header("binary_big_endian").encode() + VERTICES.astype(">f4").tobytes() + _counted(">"),
    "binary.stl": _stl(),
    "glb": glb(*gltf_tree()),
}


def model(kind, data):
    """The files of a model of one file."""
    return {f"m.{kind.rpartition('.')[2]}": data if isinstance(data, bytes) else data.encode()}


def sound():
    """Every sound model by its name."""
    return {kind: model(kind, data) for kind, data in (TEXTS | BINARIES).items()} | {"gltf": gltf(*gltf_tree())}
