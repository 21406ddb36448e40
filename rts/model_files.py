"""Reading model files into pieces: arrays as the file has them, before welding and colour decoding.

OBJ has a reader of its own (`rts.obj_files`), since its separate tables of positions, uv and normals are
exactly what a `Mesh` takes; every other format goes through trimesh. A file may refer to others (materials,
textures, buffers): only to those inside its own folder, so that a model from elsewhere cannot read the rest
of the disk.
"""

from __future__ import annotations

import json
from pathlib import Path, PureWindowsPath
from typing import Any, NamedTuple
from urllib.parse import unquote

import numpy as np

from rts.errors import InputError

LINEAR_COLORS = {"glb", "gltf"}
"""Formats whose vertex and material colours are linear already; their textures are sRGB like all others."""


class Piece(NamedTuple):
    """One mesh of a model file.

    Attributes:
        vertices: (V, 3) float, local space.
        faces: (T, 3) int into `vertices`.
        attributes: "uv", "normals", "colors" → rows (A, C) and (T, 3) int into them, each where the file has
            it. Colours are in [0, 1], as encoded in the file.
        texture: (h, w, 3 or 4) float32 in [0, 1], sRGB, alpha straight; or None.
        color: (3,) or (4,) factor of the material, as encoded in the file; or None.
        linear: whether `color` and the attribute "colors" are linear rather than sRGB.
        transform: (4, 4) scene-from-local, or None.
    """

    vertices: np.ndarray
    faces: np.ndarray
    attributes: dict[str, tuple[np.ndarray, np.ndarray]]
    texture: np.ndarray | None = None
    color: np.ndarray | None = None
    linear: bool = False
    transform: np.ndarray | None = None


def read_pieces(path: Path) -> list[Piece]:
    """The meshes of a file, at least one, each with at least one face; indices and values are checked.

    Raises:
        InputError: the file cannot be read, or what it holds is not a sound mesh.
    """
    extension = path.suffix.lower().removeprefix(".")
    if not path.exists():
        raise InputError(f"no file {path}; check the path (relative paths start at {Path.cwd()})")
    if path.is_dir():
        raise InputError(f"{path} is a folder; expected a model file inside it, such as {path / 'model.obj'}")
    if extension == "obj":
        from rts.obj_files import read_obj

        pieces = read_obj(path)
    else:
        pieces = _read_with_trimesh(path, extension)
    for piece in pieces:
        _check(path, piece)
    return pieces


def inside(folder: Path, name: str, referrer: Path) -> Path:
    """The path of a file that `referrer` names; refused if outside `folder`.

    Args:
        folder: the model's folder.
        name: as written in the file, relative to `referrer`; either slash.
        referrer: the file that names it.

    Raises:
        InputError: an absolute path, or one that leads out of the folder, symbolic links followed.
    """
    plain = name.replace("\\", "/")
    absolute = plain.startswith("/") or PureWindowsPath(plain).drive or "\0" in plain
    target = folder if absolute else (referrer.parent / plain).resolve()
    if absolute or not target.is_relative_to(folder.resolve()):
        raise InputError(
            f"{referrer} refers to {name!r}, outside its own folder, which is refused; copy that file beside "
            f"the model and name it without a path"
        )
    return target


def read_texture(path: Path, referrer: Path) -> np.ndarray:
    """Pixels of the image that `referrer` names; see `pixels`."""
    if not path.is_file():
        raise InputError(
            f"{referrer} refers to the texture {path.name!r}, but there is no file {path}; put it there, or "
            f"remove the reference to load without it"
        )
    return read_image(path)


def read_image(path: Path) -> np.ndarray:
    """Pixels of an image file; see `pixels`."""
    from PIL import Image

    try:
        with Image.open(path) as image:
            return pixels(image)
    except Exception as error:  # Pillow's decoders raise many kinds, SyntaxError and struct.error among them.
        raise InputError(f"{path} cannot be read as an image ({error}); export it again, as PNG for example") from error


def pixels(image: Any) -> np.ndarray:
    """(h, w, 3) float32 in [0, 1] of a Pillow image as encoded, (h, w, 4) where some alpha is below one."""
    if image.mode.startswith("I"):  # 16 bits of grey, which Pillow would clip to 8.
        grey = np.asarray(image, np.float32) / 65535
        return np.repeat(np.clip(grey, 0, 1)[..., None], 3, axis=2)
    rgba = np.asarray(image.convert("RGBA"), np.float32) / 255
    return rgba if (rgba[..., 3] < 1).any() else np.ascontiguousarray(rgba[..., :3])


# ------------------------------------------------------------------------------------------------- trimesh


class _Folder:
    """Resolves names for trimesh in the model's folder; keeps what went wrong, which trimesh only logs."""

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
            return target.read_bytes()
        except InputError as problem:
            self.problem = self.problem or problem
            raise

    __getitem__ = get


def _read_with_trimesh(path: Path, extension: str) -> list[Piece]:
    import trimesh
    from trimesh.exchange.load import mesh_formats

    if extension not in mesh_formats():
        others = ", ".join(sorted(mesh_formats() - {"obj", "ply", "stl", "glb", "gltf", "off"}))
        raise InputError(
            f"{path} has the extension {path.suffix!r}, which is not known; expected obj, ply, stl, glb, "
            f"gltf, off or another of trimesh's: {others}"
        )
    folder: Any = _Folder(path)
    try:
        if extension == "gltf":
            json.loads(path.read_bytes())  # Of a damaged file trimesh only says that it found no "model.gltf".
        with open(path, "rb") as file:
            scene: Any = trimesh.load(file, file_type=extension, resolver=folder, force="scene", process=False)
        pieces = _pieces(scene, trimesh.Trimesh, extension in LINEAR_COLORS)
    except InputError:
        raise
    except Exception as error:
        kind, again = extension.upper(), "the file may be cut short or of another format: export it again"
        if isinstance(error, ModuleNotFoundError) and isinstance(error.__context__, UnicodeDecodeError):
            # What is no sound binary file trimesh takes for text, and would guess its encoding with another package.
            raise InputError(
                f"{path} is not a valid {kind} file, neither as binary nor as text; {again}"
            ) from error.__context__
        raise folder.problem or InputError(
            f"{path} cannot be read as {kind} ({type(error).__name__}: {error}); {again}"
        ) from error
    if folder.problem:
        raise folder.problem
    if not pieces:
        points = sum(len(_known(g, "vertices", ())) for g in scene.geometry.values())
        what = f"{points} points but no faces" if points else "no geometry"
        raise InputError(f"{path} holds {what}; expected a mesh with triangles or polygons")
    return pieces


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
    """Attributes "uv" and "colors", the texture and the material's colour."""
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
        if gltf and _known(material, "alphaMode") in (None, "OPAQUE"):
            texture, color = (None if x is None else x[..., :3] for x in (texture, color))
    elif visual.kind == "vertex":
        attributes["colors"] = (_unit_range(visual.vertex_colors), faces)
    elif visual.kind == "face":
        one_a_face = np.repeat(np.arange(len(faces))[:, None], 3, axis=1)
        attributes["colors"] = (_unit_range(visual.face_colors), one_a_face)
    return attributes, texture, color


def _known(thing: Any, name: str, default: Any = None) -> Any:
    """What trimesh's classes, which are of many kinds, may have: an attribute, or the default."""
    return getattr(thing, name, default)


def _unit_range(colors: Any) -> np.ndarray:
    colors = np.asarray(colors)
    return colors / np.iinfo(colors.dtype).max if np.issubdtype(colors.dtype, np.integer) else colors


# -------------------------------------------------------------------------------------------------- checks


def _check(path: Path, piece: Piece) -> None:
    """Refuse indices that refer to nothing, and values that are not finite in float32."""
    tables = {"vertices": (piece.vertices, piece.faces), **piece.attributes}
    for name, (rows, table) in tables.items():
        if table.min() < 0 or table.max() >= len(rows):
            bad = table.max() if table.max() >= len(rows) else table.min()
            raise InputError(f"{path}: a face refers to row {bad} of {name}, which has {len(rows)}; repair the file")
        with np.errstate(over="ignore"):
            wrong = np.flatnonzero(~np.isfinite(np.asarray(rows, np.float32)).all(axis=1))
        if len(wrong):
            raise InputError(
                f"{path}: {len(wrong)} of {len(rows)} rows of {name} are NaN, infinite or too large for "
                f"float32, the first is row {wrong[0]}; repair the file"
            )
    if piece.transform is not None and not np.isfinite(piece.transform).all():
        raise InputError(f"{path}: a transform of its scene holds NaN or infinity; repair the file")
