"""Model files of every format but OBJ, read by trimesh."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np

from rts.errors import InputError
from rts.files.damaged_files import contents, unreadable
from rts.files.gltf_checks import sound_glb, sound_gltf
from rts.files.images import pixels
from rts.files.model_pieces import Piece
from rts.files.off_and_stl import plain_off, sound_stl
from rts.files.paths import inside
from rts.files.ply_tables import plain_ply

LINEAR_COLORS = {"glb", "gltf"}
"""Formats whose vertex and material colours are linear already; their textures are sRGB like all others."""


class _Folder:
    """Resolver of file names for trimesh, in the model's folder; keeps the errors, which trimesh only logs."""

    def __init__(self, path: Path):
        self.path, self.problem = path, None
        self.file_name = path.name

    def get(self, name: str) -> bytes:
        try:
            target = inside(self.path.parent, name.strip(), self.path)
            if not target.is_file():
                target = inside(self.path.parent, unquote(name.strip()), self.path)
            if not target.is_file():
                raise InputError(f"{self.path} refers to {name!r}, but there is no file {target}; put it there")
            return contents(target)
        except InputError as problem:
            self.problem = self.problem or problem
            raise

    __getitem__ = get


def read_with_trimesh(path: Path, extension: str) -> list[Piece]:
    """The meshes of a file. See `rts.files.models.read_pieces`."""
    import trimesh
    from trimesh.exchange.load import mesh_formats

    if extension not in mesh_formats():
        formats = ", ".join(sorted(mesh_formats() - {"obj", "ply", "stl", "glb", "gltf", "off"}))
        raise InputError(
            f"{path} has the extension {path.suffix!r}, which is not known; expected obj, ply, stl, glb, "
            f"gltf, off or another of trimesh's: {formats}"
        )
    folder: Any = _Folder(path)
    kind = extension.upper()
    try:
        form, data = _checked(path, extension, contents(path), folder)
        scene: Any = trimesh.load(io.BytesIO(data), file_type=form, resolver=folder, force="scene", process=False)
        pieces = _pieces(scene, trimesh.Trimesh, extension in LINEAR_COLORS)
    except InputError:
        raise
    except Exception as error:
        if isinstance(error, ModuleNotFoundError) and isinstance(error.__context__, UnicodeDecodeError):
            # trimesh takes anything but a sound binary file for text, and guesses its encoding with another package.
            raise InputError(
                f"{path} is not a valid {kind} file, neither as binary nor as text; the file may be cut short or of "
                "another format: export it again"
            ) from error.__context__
        said = " ".join(f"{type(error).__name__}: {error}".split())
        raise folder.problem or unreadable(path, kind, said) from error
    if folder.problem:
        raise folder.problem
    if not pieces:
        points = sum(len(_known(g, "vertices", ())) for g in scene.geometry.values())
        what = f"{points} points but no faces" if points else "no geometry"
        raise InputError(f"{path} holds {what}; expected a mesh with triangles or polygons")
    return pieces


def _checked(path: Path, extension: str, data: bytes, folder: _Folder) -> tuple[str, bytes]:
    """The format and the bytes for trimesh to read, after the checks of the file."""
    match extension:
        case "ply":
            return "ply", plain_ply(path, data, folder.get)
        case "off":
            return "ply", plain_off(path, data)
        case "stl" | "stl_ascii":
            return "stl", sound_stl(path, data)
        case "glb":
            return "glb", sound_glb(path, data, folder.get)
        case "gltf":
            return sound_gltf(path, data, folder.get)
    return extension, data


def _pieces(scene: Any, mesh_type: type, linear: bool) -> list[Piece]:
    pieces = []
    for node in scene.graph.nodes_geometry:
        matrix, name = scene.graph[node]
        mesh = scene.geometry[name]
        if not isinstance(mesh, mesh_type) or len(mesh.faces) == 0:
            continue
        transform = None if np.array_equal(matrix, np.eye(4)) else np.array(matrix, np.float64)
        faces = np.asarray(mesh.faces)
        attributes, texture, color = _visual(mesh, faces, linear)
        # trimesh computes normals on access and keeps them beside those of the file; before any access only
        # the latter.
        if "vertex_normals" in mesh._cache:
            attributes["normals"] = (np.asarray(mesh._cache["vertex_normals"]), faces)
        pieces.append(Piece(np.asarray(mesh.vertices), faces, attributes, texture, color, linear, transform))
    return pieces


def _visual(mesh: Any, faces: np.ndarray, gltf: bool) -> tuple[dict, np.ndarray | None, np.ndarray | None]:
    """Attributes "uv" and "colors", the texture and the material's colour, as in `Piece`.

    Of GLB and glTF, `gltf`, alpha counts as the material's alphaMode says.
    """
    visual, attributes, texture, color = mesh.visual, {}, None, None
    if visual.kind == "texture":
        if visual.uv is not None and len(visual.uv) == len(mesh.vertices):
            attributes["uv"] = (np.asarray(visual.uv), faces)
        if "color" in visual.vertex_attributes:
            attributes["colors"] = (_unit_range(visual.vertex_attributes["color"]), faces)
        material = visual.material
        image = _known(material, "baseColorTexture") or _known(material, "image")
        texture = None if image is None else pixels(image)
        if _known(material, "baseColorFactor") is not None:
            color = _unit_range(material.baseColorFactor)
    elif visual.kind == "vertex":
        attributes["colors"] = (_unit_range(visual.vertex_colors), faces)
    elif visual.kind == "face":
        one_a_face = np.repeat(np.arange(len(faces))[:, None], 3, axis=1)
        attributes["colors"] = (_unit_range(visual.face_colors), one_a_face)
    if not gltf:
        return attributes, texture, color
    rows = attributes["colors"][0] if "colors" in attributes else None
    rows, texture, color = _as_alpha_mode_says(rows, texture, color, _known(visual, "material"), "uv" in attributes)
    return attributes | ({} if rows is None else {"colors": (rows, faces)}), texture, color


def _as_alpha_mode_says(
    rows: np.ndarray | None, texture: np.ndarray | None, color: np.ndarray | None, material: Any, mapped: bool
) -> tuple[np.ndarray | None, ...]:
    """Vertex colours (A, 4), a texture and a factor with the alpha that a material of glTF gives them.

    It is none where the mode is OPAQUE, as it is without a material. Where the mode is MASK, the product of alpha is 1
    from the cutoff on, and 0 below. A texture hides the colours, unless it is not `mapped`. Arrays of three components
    have no alpha, and stay as they are, as None does.
    """
    mode = _known(material, "alphaMode") or "OPAQUE"
    if mode == "BLEND":
        return rows, texture, color
    plain = [None if x is None else x[..., :3] for x in (rows, texture, color)]
    if mode != "MASK":
        return tuple(plain)
    cutoff = _known(material, "alphaCutoff")
    at, shown = (1, texture) if mapped and texture is not None else (0, rows)
    cutoff = 0.5 if cutoff is None else cutoff
    alpha = float(color[3]) if color is not None and len(color) == 4 else 1.0
    if shown is not None and shown.shape[-1] == 4:
        opaque = shown[..., 3:] * alpha >= cutoff
        plain[at] = np.concatenate([shown[..., :3], opaque], axis=-1, dtype=shown.dtype)
    elif color is not None and len(color) == 4:
        plain[2] = np.append(color[:3], float(alpha >= cutoff))
    return tuple(plain)


def _known(thing: Any, name: str, default: Any = None) -> Any:
    """An attribute that one of trimesh's many classes may have, or the default."""
    return getattr(thing, name, default)


def _unit_range(colors: Any) -> np.ndarray:
    colors = np.asarray(colors)
    return colors / np.iinfo(colors.dtype).max if np.issubdtype(colors.dtype, np.integer) else colors
