"""Triangles as binary glTF, the form in which the browser is sent meshes.

Source: Khronos Group, glTF 2.0 specification.
"""

from __future__ import annotations

import json
import struct
from typing import Any, NamedTuple

import numpy as np

from rts_viewer.pictures import encoded, png

FLOAT, UNSIGNED = 5126, 5125
ARRAY, ELEMENTS = 34962, 34963
KINDS = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}
WRAPS = {"repeat": 10497, "mirror": 33648, "clamp": 33071}


class Triangles(NamedTuple):
    """A mesh to show. All attributes have one row a vertex.

    Attributes:
        vertices: (V, 3) positions, world space.
        faces: (T, 3) integers, counter-clockwise seen from outside.
        normals: (V, 3), of any length; None for smooth ones.
        colors: (V, 3 or 4) linear, in [0, 1]; None for white.
        uv: (V, 2), v upwards; None without a texture.
        texture: (h, w, 1, 3 or 4) linear, row 0 on top; None without one.
        wrap: continuation of the texture: "repeat", "mirror" or "clamp", or a pair, along u and along v.
        factor: linear colour of 3 or 4 numbers that multiplies the others.
    """

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray | None = None
    colors: np.ndarray | None = None
    uv: np.ndarray | None = None
    texture: np.ndarray | None = None
    wrap: str | tuple[str, str] = "repeat"
    factor: Any = (1.0, 1.0, 1.0, 1.0)


def smooth_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Area-weighted sums (V, 3) of the normals of the faces around each vertex."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    normals, corners = np.cross(b - a, c - a), faces.T.ravel()
    sums = [np.bincount(corners, np.tile(normals[:, i], 3), len(vertices)) for i in range(3)]
    return np.stack(sums, axis=-1)


def glb(mesh: Triangles) -> bytes:
    """The file of a mesh: one primitive, seen from both sides, lit, not metallic."""
    normals = smooth_normals(mesh.vertices, mesh.faces) if mesh.normals is None else mesh.normals
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.where(length > 0, normals / np.where(length > 0, length, 1), (0, 0, 1))
    body = _Body()
    attributes = {"POSITION": body.numbers(mesh.vertices, bounds=True), "NORMAL": body.numbers(normals)}
    if mesh.colors is not None:
        attributes["COLOR_0"] = body.numbers(np.clip(mesh.colors, 0, 1))
    factor = [float(x) for x in np.clip(mesh.factor, 0, 1)]
    coat: dict[str, Any] = {"metallicFactor": 0, "roughnessFactor": 1, "baseColorFactor": (factor + [1.0])[:4]}
    document: dict[str, Any] = {}
    if mesh.texture is not None and mesh.uv is not None:
        attributes["TEXCOORD_0"] = body.numbers(np.stack([mesh.uv[:, 0], 1 - mesh.uv[:, 1]], axis=-1))
        coat["baseColorTexture"] = {"index": 0}
        along_u, along_v = (mesh.wrap, mesh.wrap) if isinstance(mesh.wrap, str) else mesh.wrap
        document["samplers"] = [{"wrapS": WRAPS[along_u], "wrapT": WRAPS[along_v]}]
        document["images"] = [{"bufferView": body.add(png(encoded(mesh.texture))), "mimeType": "image/png"}]
        document["textures"] = [{"sampler": 0, "source": 0}]
    indices = body.numbers(mesh.faces.reshape(-1, 1), elements=True)
    document |= {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "materials": [
            {"pbrMetallicRoughness": coat, "doubleSided": True, "alphaMode": "BLEND" if _clear(mesh) else "OPAQUE"}
        ],
        "meshes": [{"primitives": [{"attributes": attributes, "indices": indices, "material": 0}]}],
        "accessors": body.accessors,
        "bufferViews": body.views,
        "buffers": [{"byteLength": body.length}],
    }
    text = json.dumps(document).encode()
    chunks = ((b"JSON", text + b" " * (-len(text) % 4)), (b"BIN\0", b"".join(body.pieces)))
    whole = b"".join(struct.pack("<I4s", len(data), kind) + data for kind, data in chunks)
    return struct.pack("<4sII", b"glTF", 2, 12 + len(whole)) + whole


def _clear(mesh: Triangles) -> bool:
    """True if something of the mesh lets light through."""
    tables = [np.asarray(x) for x in (mesh.colors, mesh.texture, mesh.factor) if x is not None]
    return any(table.shape[-1] == 4 and bool((table[..., 3] < 1).any()) for table in tables)


class _Body:
    """The binary part of a file, and the tables that say what is where in it."""

    def __init__(self):
        self.pieces: list[bytes] = []
        self.length = 0
        self.views: list[dict[str, int]] = []
        self.accessors: list[dict[str, Any]] = []

    def add(self, data: bytes, target: int | None = None) -> int:
        """Append bytes, padded to words. Returns the index of their view."""
        view = {"buffer": 0, "byteOffset": self.length, "byteLength": len(data)}
        self.views.append(view if target is None else {**view, "target": target})
        self.pieces.append(data + bytes(-len(data) % 4))
        self.length += len(self.pieces[-1])
        return len(self.views) - 1

    def numbers(self, rows: np.ndarray, bounds: bool = False, elements: bool = False) -> int:
        """Append rows of numbers. Returns the index of their accessor."""
        rows = np.ascontiguousarray(rows, "<u4" if elements else "<f4")
        kind, target = (UNSIGNED, ELEMENTS) if elements else (FLOAT, ARRAY)
        accessor: dict[str, Any] = {"bufferView": self.add(rows.tobytes(), target), "componentType": kind}
        accessor |= {"count": len(rows), "type": KINDS[rows.shape[1]]}
        if bounds:
            accessor |= {"min": rows.min(axis=0).tolist(), "max": rows.max(axis=0).tolist()}
        self.accessors.append(accessor)
        return len(self.accessors) - 1
