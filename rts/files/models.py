"""Models from files as parts: pieces of a file welded, their colours made linear, their shaders chosen.

Each format has a reader of its own, which refuses what is damaged, and gives the file's tables as they are; formats
without one go through trimesh.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from rts import registry
from rts.arrays.argument_checks import quoted
from rts.errors import FileWarning, InputError, warn
from rts.files.damaged_files import contents, gathered, warn_once
from rts.files.gltf_reader import read_gltf
from rts.files.model_pieces import WIDTHS, Piece, check_cull, check_piece, cull_of
from rts.files.obj_reader import read_obj
from rts.files.off_reader import read_off
from rts.files.paths import as_path, beside
from rts.files.ply_reader import read_ply
from rts.files.srgb import decode_srgb
from rts.files.stl_reader import read_stl
from rts.files.trimesh_reader import read_with_trimesh
from rts.files.windings import Tally, wound_alike
from rts.scene.parts import Part
from rts.shading.pbr import Pbr
from rts.shading.shaders import Lambert, Textured, Unlit
from rts.shading.textures import own_uv


def load(path: Any, *, merge: bool = False, weld: bool = True, surface: str = "mesh", cull: str = "none") -> list[Part]:
    """The parts of a model file: OBJ with MTL and textures, PLY, STL, GLB, glTF, OFF, and others that trimesh reads.

    There is one part for each mesh of the scene or, in an OBJ, for each material; in a PLY, for each texture of faces;
    in an STL as text, for each solid;
    `merge=True` makes them one. θ holds NumPy float32 arrays: "vertices", and where the file has them "uv",
    "normals", "colors", "texture" and "color". Vertices are in the order of the file; those that no face refers to
    are left out, and those that coincide exactly are welded: where uv or normals differ between the faces around a
    vertex they have an index table of their own, so that moving vertices opens no seams. Vertices are float64 where
    float32 is too coarse, as of map coordinates, and so is what is rendered. Normals of the file do not
    follow moving vertices: drop them from θ, and smooth ones are computed that do; likewise "tangents". The shader is
    `pbr` where the material of a glTF or MTL tells more than its base colour: θ then has "metallic", "roughness",
    "normal_map", "occlusion" and "emissive", as far as the file has them, and "uv_occlusion" or the like where a map
    has coordinates of its own. Else it is `textured` where there are uv and
    a texture, `unlit` where a glTF says that there is no light, or `lambert`.

    Polygons of n corners, as OBJ, PLY and OFF have them, are cut into n − 2 triangles: convex ones into the fan
    about their first corner, concave ones so that the triangles do not overlap. Faces that have the corners of
    another one are left out, also if they go the opposite way, unless `cull` has each seen from its own side only.
    Where the file has no normals, faces that share edges are wound alike: as the outside of what is closed is, else as
    most of them are. A warning says how many were changed; what is wound alike with the inside out stays so.

    A material of an OBJ is as opaque as `d` says, and where that is missing as 1 − `Tr`; but where `Tr` is 1 or more,
    or the comments of the MTL say that MeshLab wrote it, `Tr` is taken for `d`, as MeshLab does. So `Tr 1` is opaque,
    and `d 0` transparent. Heights of `map_Bump` become "normal_map", and so does a picture there that has the colours
    of a normal map. Maps whose pictures are not there are left out, with a warning.

    Parts of a glTF are at rest: joints, morph targets, clips, lights and cameras are left out, with a warning, and
    `rts.load_model` reads them.

    Welding may make vertices fewer than the file's. For data of your own, one row for each vertex of the
    file, load with `weld=False`. So do for hard edges of a file without normals, as of an STL: welded, it is shaded
    smooth.

    Args:
        path: the file. It may refer to files in its own folder only.
        merge: join everything into one part, in the coordinates of the scene. Refused where textures differ.
        weld: leave out vertices without faces, and weld those that coincide; False keeps the vertices of the file,
            their number and order. (All parts of an OBJ share one table of vertices; each then holds all of it.)
        cull: "back" to leave out all triangles seen from behind; "file" to do so where a material of a glTF is not
            double-sided; "none", the default, infers nothing. Nodes that mirror keep their outside.
        surface: the name of a registered surface that reads the file, in a format of its own; "bezier" reads patches
            (text as Newell's teapot is in, or .npz), "subdivision" the cage in an OBJ. The text above is about "mesh".

    Raises:
        InputError: the file is missing, damaged, of unknown kind, empty, holds other than it promises, or refers to
            what is missing or elsewhere; something in it is not finite or too large for float32, colours as linear
            ones included; `merge` or `weld` is neither True nor False, or given with another surface than "mesh"; or
            there is no such surface.

    Warns:
        FileWarning: something was left out or guessed, such as a library of materials that is not there, a statement or
            property that is not known, or positions that are not within the bounds that a glTF gives them. There is
            one warning for all of this.
    """
    path = as_path(path)
    for name, flag in (("merge", merge), ("weld", weld)):
        if not isinstance(flag, (bool, np.bool_)):
            raise InputError(f"{name} is {quoted(flag)}; expected True or False")
    check_cull(cull)
    if not isinstance(surface, str):
        raise InputError(f"surface is {quoted(surface)}; expected a name, such as 'mesh' or 'bezier'")
    if surface != "mesh":
        plugin = registry.plugin("rts.surfaces", surface)
        if merge or not weld:
            raise InputError(f"merge and weld are for meshes; the surface {surface!r} reads its files without them")
        check_exists(path)
        return [part.replace(cull="back") if cull == "back" else part for part in plugin.load(path)]
    with gathered(path) as notes, np.errstate(over="ignore", invalid="ignore"):  # Checks refuse overflow by name.
        parts = parts_of(path, read_pieces(path), merge, weld, cull)
    warn_once(path, notes)
    return parts


def parts_of(path: Path, pieces: list[Piece], merge: bool = False, weld: bool = True, cull: str = "none") -> list[Part]:
    """The parts of the meshes among pieces, which are checked; `merge`, `weld` and `cull` as of `load`.

    Raises:
        InputError: there is no mesh with faces, or one is damaged; or pieces cannot be merged.
    """
    meshes = [piece for piece in pieces if len(piece.faces)]
    if not meshes:
        points = sum(len(piece.vertices) for piece in pieces)
        what = f"{points} points but no faces" if points else "no geometry"
        raise InputError(f"{path} holds {what}; expected a mesh with triangles or polygons")
    for piece in meshes:
        check_piece(path, piece)
    meshes = [linear(piece) for piece in meshes]
    if merge and (len(meshes) > 1 or meshes[0].transform is not None):
        meshes = [_merged(path, meshes)]
    tally = Tally()
    parts = [part_of(path, piece, weld, cull_of(piece, cull), tally) for piece in meshes]
    tally.warn(path)
    return parts


def linear(piece: Piece) -> Piece:
    """The piece with linear colours; textures are sRGB in every format."""
    attributes, color = dict(piece.attributes), piece.color
    if not piece.linear:
        color = None if color is None else decode_srgb(color)
        if "colors" in attributes:
            rows, table = attributes["colors"]
            attributes["colors"] = (decode_srgb(rows), table)
    texture = None if piece.texture is None else decode_srgb(piece.texture)
    return piece._replace(attributes=attributes, color=color, texture=texture)


EXACT = 1e-5
"""The largest rounding of vertices, as a share of the box around them, at which they become float32."""


def _as_exact_as_needed(vertices: np.ndarray) -> np.ndarray:
    """Vertices (V, 3) in float32; in float64, where that has them and float32 is too coarse, as of map coordinates."""
    if vertices.dtype == np.float64 and len(vertices):
        largest, extent = np.abs(vertices).max(), np.ptp(vertices, axis=0).max()
        if largest < np.finfo(np.float32).max and np.spacing(np.float32(largest)) > EXACT * extent > 0:
            return vertices
    with np.errstate(over="ignore"):  # What is too large is refused later.
        return vertices.astype(np.float32)


def part_of(
    path: Path,
    piece: Piece,
    weld: bool,
    cull: str,
    tally: Tally,
    surface: Callable[[np.ndarray, dict[str, Any]], Any] | None = None,
) -> Part:
    """The part of a piece; a mesh, or the `surface` (faces, indices of attributes) → surface.

    `tally` is told which of its faces are left out or turned over.
    """
    vertices, faces = _as_exact_as_needed(piece.vertices), piece.faces
    if weld:
        rows, faces = used_rows(vertices, faces)
        vertices, place = welded_rows(rows)
        faces = place[faces]
    attributes = piece.attributes
    wound = wound_alike(vertices, faces, tally, both_sides=cull == "back", has_normals="normals" in attributes)
    if wound is not None:
        faces = wound.table(faces)
        attributes = {name: (rows, wound.table(table)) for name, (rows, table) in attributes.items()}
    theta, indices = {"vertices": vertices}, {}
    for name, (rows, table) in attributes.items():
        theta[name], indices[name] = _settled(rows.astype(np.float32), table, faces, len(vertices))
    if theta.get("colors", np.zeros((0, 0))).shape[1] == 4 and (theta["colors"][:, 3] >= 1).all():
        theta["colors"] = np.ascontiguousarray(theta["colors"][:, :3])
    textured = piece.texture is not None and "uv" in theta
    if piece.texture is not None and textured:
        theta["texture"] = piece.texture.astype(np.float32)
    if piece.entries is not None:
        theta |= {name: x for name, x in piece.entries.items() if x.ndim < 3 or {"uv", own_uv(name)} & {*theta}}
    if piece.color is not None and (piece.color < 1).any():
        theta["color"] = piece.color[: 3 if (piece.color[3:] >= 1).all() else 4].astype(np.float32)
    for name, values in theta.items():
        wrong = np.flatnonzero(~np.isfinite(values))
        if len(wrong):
            first = int(wrong[0]) // (values.shape[-1] if values.ndim > 1 else values.size)
            what = "linear " if name in ("colors", "color", "texture") else ""
            raise InputError(
                f"{path}: row {first} of {name}, as {what}float32, is NaN or infinite; expected smaller numbers: "
                "repair the file"
            )
    translucent = any(name in theta and theta[name].shape[-1] == 4 for name in ("color", "texture", "colors"))
    shader = Pbr if piece.entries is not None else Textured if textured else Unlit if piece.unlit else Lambert
    return Part(
        (surface or registry.plugin("rts.surfaces", "mesh"))(faces, indices),
        theta,
        shader(opaque=not translucent, **piece.options),
        piece.transform,
        cull=cull,
    )


def used_rows(rows: np.ndarray, table: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows that a table refers to, and the table with indices into these rows."""
    used, inverse = np.unique(table, return_inverse=True)
    return rows[used], inverse.reshape(table.shape)


def welded_rows(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distinct rows in order of first occurrence, and for each given row its index among them."""
    _, first, inverse = np.unique(rows + 0.0, axis=0, return_index=True, return_inverse=True)  # −0 + 0 is 0.
    order = np.argsort(first)
    place = np.empty(len(order), np.int64)
    place[order] = np.arange(len(order))
    return rows[first[order]], place[inverse.reshape(-1)]


def _settled(
    rows: np.ndarray, table: np.ndarray, faces: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray | None]:
    """Rows of an attribute for a mesh: one for each vertex and no table, if the faces around each vertex agree.

    Otherwise the rows that faces refer to, and their table.

    Args:
        rows: (A, C), values of the attribute.
        table: (T, 3), the row of each corner.
        faces: (T, 3), the vertex of each corner.
        count: the number of vertices.
    """
    if len(rows) == count and np.array_equal(table, faces):
        return rows, None
    by_vertex = np.zeros((count, rows.shape[1]), rows.dtype)
    by_vertex[faces] = rows[table]
    return (by_vertex, None) if np.array_equal(by_vertex[faces], rows[table]) else used_rows(rows, table)


def _merged(path: Path, pieces: list[Piece]) -> Piece:
    """All pieces as one, transforms applied, material colours moved to the vertices.

    Attributes that only some pieces have are dropped; so are entries for `pbr`, unless all pieces have one material.
    Pieces with different textures are refused.
    """
    first = pieces[0].texture
    for piece in pieces[1:]:
        other = piece.texture
        alike = first is None or piece.options == pieces[0].options
        if not alike or not (other is None if first is None else other is not None and np.array_equal(other, first)):
            raise InputError(
                f"{path} has {len(pieces)} parts with different textures, which cannot be merged; load it without merge"
            )
    tables: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {}
    for piece in pieces:
        moved = _in_scene(piece)
        for name, pair in {"vertices": (moved.vertices, moved.faces), **moved.attributes}.items():
            tables.setdefault(name, []).append(pair)
    whole = {}
    for name, pairs in tables.items():
        if len(pairs) == len(pieces):  # Attributes that only some pieces have are dropped.
            if all(rows is pairs[0][0] for rows, _ in pairs):
                whole[name] = pairs[0][0], np.concatenate([table for _, table in pairs])
                continue
            offsets = np.cumsum([0, *(len(rows) for rows, _ in pairs)])
            rows = np.concatenate([rows for rows, _ in pairs])
            whole[name] = rows, np.concatenate([t + o for (_, t), o in zip(pairs, offsets, strict=False)])
    vertices, faces = whole.pop("vertices")
    same = all(piece.entries is pieces[0].entries for piece in pieces)
    if not same:
        warn(f"{path}: its parts have different materials; merged, they keep base colours alone", FileWarning)
    options = pieces[0].options
    if not same:  # Without the maps, nothing reads how they are looked up.
        options = {name: value for name, value in options.items() if name != "samplers"}
        whole = {name: pair for name, pair in whole.items() if name in WIDTHS}
    return pieces[0]._replace(
        vertices=vertices,
        faces=faces,
        attributes=whole,
        color=None,
        linear=True,
        transform=None,
        options=options,
        entries=pieces[0].entries if same else None,
        unlit=all(piece.unlit for piece in pieces),
        one_sided=all(piece.one_sided for piece in pieces),
    )


def _in_scene(piece: Piece) -> Piece:
    """The piece in the scene's coordinates; "colors" (A, 4) are its own, white if none, times its material's."""
    rows, table = piece.attributes.get("colors", (np.ones((len(piece.vertices), 3)), piece.faces))
    colors = np.ones((len(rows), 4))
    colors[:, : rows.shape[1]] = rows
    if piece.color is not None:
        colors[:, : len(piece.color)] *= piece.color
    attributes = {**piece.attributes, "colors": (colors, table)}
    vertices, faces, m = piece.vertices, piece.faces, piece.transform
    if m is not None:
        vertices = vertices @ m[:3, :3].T + m[:3, 3]
        mirrored = np.linalg.det(m[:3, :3]) < 0
        if "normals" in attributes:
            rows, table = attributes["normals"]
            attributes["normals"] = (rows @ np.linalg.inv(m[:3, :3]), table)
        if "tangents" in attributes:
            rows, table = attributes["tangents"]
            moved = rows[:, :3] @ m[:3, :3].T
            attributes["tangents"] = (np.column_stack([moved, -rows[:, 3] if mirrored else rows[:, 3]]), table)
        if mirrored:  # Mirrored triangles would be inside out.
            faces = faces[:, ::-1]
            attributes = {name: (rows, table[:, ::-1]) for name, (rows, table) in attributes.items()}
    return piece._replace(vertices=vertices, faces=faces, attributes=attributes, transform=None)


def check_exists(path: Path) -> None:
    """Refuse paths other than regular files."""
    if not path.exists():
        raise InputError(f"no file {path}; check the path (relative paths start at {Path.cwd()})")
    if path.is_dir():
        raise InputError(f"{path} is a folder; expected a model file inside it, such as {path / 'model.obj'}")
    if not path.is_file():
        raise InputError(f"{path} is no regular file, and may never end; copy what it gives into one")


def read_pieces(path: Path) -> list[Piece]:
    """The pieces of a file; an InputError where it cannot be read."""
    check_exists(path)
    extension = path.suffix.lower().removeprefix(".")
    data = b"" if extension == "obj" else contents(path)
    file = functools.partial(beside, path)
    match extension:
        case "obj":
            return read_obj(path)
        case "ply":
            return read_ply(path, data, file)
        case "off":
            return [read_off(path, data)]
        case "stl" | "stl_ascii":
            return read_stl(path, data)
        case "glb" | "gltf":
            return read_gltf(path, data, file)
        case _:
            return read_with_trimesh(path, data, file)
