"""Models from files as parts, and pictures to and from files.

Inside the library colours are linear and images premultiplied; files hold sRGB and straight alpha. The
conversion (IEC 61966-2-1, exactly) happens here and nowhere else.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from rts import registry
from rts.engines import engine_of
from rts.errors import InputError, PluginError
from rts.interfaces import Part
from rts.model_files import Piece, read_image, read_pieces
from rts.paths import as_path, output_file
from rts.shading import Lambert, Textured
from rts.trees import Array


def load(path: Any, *, merge: bool = False, weld: bool = True) -> list[Part]:
    """The parts of a model file: OBJ with MTL and textures, PLY, STL, GLB, glTF, OFF, what trimesh reads.

    There is one part for each mesh of the scene, for each material of an OBJ. θ holds NumPy float32 arrays:
    "vertices", and where the file has them "uv", "normals", "colors", "texture" and "color". Vertices are in
    the order of the file; those that no face refers to are left out, and those that coincide exactly are
    welded: where uv or normals differ between the faces around a vertex they have an index table of their
    own, so that moving vertices opens no seams. Normals of the file do not follow moving vertices: drop them
    from θ, and smooth ones are computed that do. Polygons are cut into triangles. The shader is `textured`
    where there are uv and a texture, else `lambert`.

    So the number of vertices may be less than the file's. For data of your own, one row for each vertex of the
    file, load with `weld=False`.

    Args:
        path: the file. It may refer to files in its own folder only.
        merge: join everything into one part, in the coordinates of the scene. Refused where textures differ.
        weld: leave out vertices without faces, and weld those that coincide; False keeps the vertices of the file,
            their number and order. (All parts of an OBJ share one table of vertices; each then holds all of it.)

    Raises:
        InputError: the file is missing, damaged, of unknown kind, empty, or refers to what is missing or
            elsewhere.
    """
    path = as_path(path)
    pieces = [_linear(piece) for piece in read_pieces(path)]
    return [_part(piece, weld) for piece in ([_merged(path, pieces)] if merge and len(pieces) > 1 else pieces)]


def _linear(piece: Piece) -> Piece:
    """The piece with linear colours; textures are sRGB in every format."""
    attributes, color = dict(piece.attributes), piece.color
    if not piece.linear:
        color = None if color is None else decode_srgb(color)
        if "colors" in attributes:
            rows, table = attributes["colors"]
            attributes["colors"] = (decode_srgb(rows), table)
    texture = None if piece.texture is None else decode_srgb(piece.texture)
    return piece._replace(attributes=attributes, color=color, texture=texture)


def _part(piece: Piece, weld: bool) -> Part:
    vertices, faces = piece.vertices.astype(np.float32), piece.faces
    if weld:
        rows, faces = _used(vertices, faces)
        vertices, place = _welded(rows)
        faces = place[faces]
    theta, indices = {"vertices": vertices}, {}
    for name, (rows, table) in piece.attributes.items():
        theta[name], indices[name] = _settled(rows.astype(np.float32), table, faces, len(vertices))
    if theta.get("colors", np.zeros((0, 0))).shape[1] == 4 and (theta["colors"][:, 3] >= 1).all():
        theta["colors"] = np.ascontiguousarray(theta["colors"][:, :3])
    textured = piece.texture is not None and "uv" in theta
    if piece.texture is not None and textured:
        theta["texture"] = piece.texture.astype(np.float32)
    if piece.color is not None and (piece.color < 1).any():
        theta["color"] = piece.color[: 3 if (piece.color[3:] >= 1).all() else 4].astype(np.float32)
    translucent = any(
        name in theta and theta[name].shape[-1] == 4 for name in ("color", "texture" if textured else "colors")
    )
    return Part(
        registry.plugin("rts.surfaces", "mesh")(faces, indices),
        theta,
        (Textured if textured else Lambert)(opaque=not translucent),
        piece.transform,
    )


def _used(rows: np.ndarray, table: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows without those that the table does not refer to, and the table into them."""
    used, inverse = np.unique(table, return_inverse=True)
    return rows[used], inverse.reshape(table.shape)


def _welded(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distinct rows in order of first occurrence, and for each given row its place among them."""
    _, first, inverse = np.unique(rows + 0.0, axis=0, return_index=True, return_inverse=True)  # -0 + 0 is 0.
    order = np.argsort(first)
    place = np.empty(len(order), np.int64)
    place[order] = np.arange(len(order))
    return rows[first[order]], place[inverse.reshape(-1)]


def _settled(
    rows: np.ndarray, table: np.ndarray, faces: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray | None]:
    """One row a vertex (and no table) where the faces around each vertex agree, else rows and their table."""
    if len(rows) == count and np.array_equal(table, faces):
        return rows, None
    by_vertex = np.zeros((count, rows.shape[1]), rows.dtype)
    by_vertex[faces] = rows[table]
    return (by_vertex, None) if np.array_equal(by_vertex[faces], rows[table]) else _used(rows, table)


def _merged(path: Path, pieces: list[Piece]) -> Piece:
    """All pieces as one, transforms applied, material colours moved to the vertices."""
    first = pieces[0].texture
    for piece in pieces[1:]:
        other = piece.texture
        if not (other is None if first is None else other is not None and np.array_equal(other, first)):
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
        if len(pairs) == len(pieces):  # What only some of them have is dropped.
            if all(rows is pairs[0][0] for rows, _ in pairs):
                whole[name] = pairs[0][0], np.concatenate([table for _, table in pairs])
                continue
            offsets = np.cumsum([0, *(len(rows) for rows, _ in pairs)])
            rows = np.concatenate([rows for rows, _ in pairs])
            whole[name] = rows, np.concatenate([t + o for (_, t), o in zip(pairs, offsets, strict=False)])
    vertices, faces = whole.pop("vertices")
    return Piece(vertices, faces, whole, first, linear=True)


def _in_scene(piece: Piece) -> Piece:
    """The piece in the scene's coordinates, its colours (A, 4) in "colors"."""
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
        if mirrored:  # Keep the outside outside.
            faces = faces[:, ::-1]
            attributes = {name: (rows, table[:, ::-1]) for name, (rows, table) in attributes.items()}
    return piece._replace(vertices=vertices, faces=faces, attributes=attributes, transform=None)


# ------------------------------------------------------------------------------------------------ pictures


def save_image(path: Any, image: Array) -> None:
    """Write a PNG.

    Args:
        path: a name ending in .png; folders that do not exist are made.
        image: (H, W, 4) premultiplied linear RGBA, (H, W, 3), (H, W, 1) or (H, W); values outside [0, 1] are
            clipped.

    Raises:
        InputError: another shape, integers, NaN or infinity, another extension, or a path that cannot be.
    """
    from PIL import Image

    path = output_file(path, "picture", (".png",))
    encoded = _bytes(image)
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(encoded).save(path)


def load_image(path: Any) -> np.ndarray:
    """(H, W, 4) float32 premultiplied linear RGBA of a picture of any kind that Pillow reads."""
    path = as_path(path)
    if not path.is_file():
        raise InputError(f"there is no picture {path}; check the path (relative paths start at {Path.cwd()})")
    encoded = read_image(path)
    straight = decode_srgb(encoded)
    alpha = straight[..., 3:] if straight.shape[2] == 4 else np.ones_like(straight[..., :1])
    return np.concatenate([straight[..., :3] * alpha, alpha], axis=2)


def save_animation(path: Any, frames: Iterable[Array], fps: float = 20.0) -> None:
    """Write an animated .gif or .png, or an .mp4 where imageio-ffmpeg is installed.

    Args:
        path: a name with one of these extensions; folders that do not exist are made.
        frames: images as for `save_image`, all of one size; transparent ones are put on white.
        fps: frames a second.

    Raises:
        InputError: no frames, a wrong or changing shape, NaN or infinity, another extension, or a path that cannot be.
        PluginError: .mp4 without imageio-ffmpeg.
    """
    from PIL import Image

    path = output_file(path, "animation", (".gif", ".png", ".mp4"))
    kind = path.suffix.lower()
    if not (np.isfinite(fps) and fps > 0):
        raise InputError(f"fps is {fps}; expected a positive number of frames a second")
    pictures = [_bytes(_on_white(_host(frame))) for frame in frames]
    if not pictures or len({p.shape for p in pictures}) > 1:
        shapes = ", ".join(sorted({str(p.shape) for p in pictures})) or "nothing"
        raise InputError(f"the frames are {shapes}; expected at least one, and all of one shape")
    path.parent.mkdir(parents=True, exist_ok=True)
    if kind == ".mp4":
        _write_mp4(path, pictures, fps)
        return
    images = [Image.fromarray(p) for p in pictures]
    if kind == ".gif":
        images = [i.convert("RGB").quantize(256, dither=Image.Dither.NONE) for i in images]
    images[0].save(path, save_all=True, append_images=images[1:], duration=1000 / fps, loop=0)


def _write_mp4(path: Path, pictures: list[np.ndarray], fps: float) -> None:
    import imageio.v2 as imageio

    try:
        import imageio_ffmpeg  # noqa: F401  # pyright: ignore[reportMissingImports]
    except ModuleNotFoundError:
        raise PluginError("mp4 needs the package imageio-ffmpeg: pip install imageio-ffmpeg; or write a .gif") from None
    # The usual pixel format of mp4 halves the resolution of colour: sides must be even.
    even: list[Any] = [p if p.ndim == 3 else np.repeat(p[..., None], 3, axis=2) for p in pictures]
    even = [np.pad(p, ((0, p.shape[0] % 2), (0, p.shape[1] % 2), (0, 0)), mode="edge") for p in even]
    imageio.mimwrite(path, even, fps=fps, macro_block_size=2)  # pyright: ignore[reportCallIssue]


def _host(image: Array) -> np.ndarray:
    """A checked image as NumPy floats, (H, W, 3 or 4) or (H, W)."""
    array = np.asarray(engine_of(image).to_numpy(image))
    if array.ndim == 3 and array.shape[2] == 1:
        array = array[..., 0]
    if array.ndim not in (2, 3) or array.size == 0 or (array.ndim == 3 and array.shape[2] not in (3, 4)):
        raise InputError(f"the image has shape {array.shape}; expected (H, W, 4), (H, W, 3), (H, W, 1) or (H, W)")
    if not np.issubdtype(array.dtype, np.floating):
        raise InputError(f"the image has dtype {array.dtype}; expected linear floats in [0, 1]")
    wrong = array.size - int(np.isfinite(array).sum())
    if wrong:
        raise InputError(f"{wrong} of the image's {array.size} values are NaN or infinite; check what made it")
    return array


def _bytes(image: Array) -> np.ndarray:
    """8-bit sRGB with straight alpha of a premultiplied linear image."""
    array = _host(image).astype(np.float64)
    if array.ndim == 3 and array.shape[2] == 4:
        alpha = np.clip(array[..., 3:], 0, 1)
        straight = np.divide(array[..., :3], alpha, out=np.zeros_like(array[..., :3]), where=alpha > 0)
        array = np.concatenate([encode_srgb(np.clip(straight, 0, 1)), alpha], axis=2)
    else:
        array = encode_srgb(np.clip(array, 0, 1))
    return np.round(array * 255).astype(np.uint8)


def _on_white(image: np.ndarray) -> np.ndarray:
    return image[..., :3] + (1 - image[..., 3:]) if image.ndim == 3 and image.shape[2] == 4 else image


def encode_srgb(linear: np.ndarray) -> np.ndarray:
    """The sRGB curve."""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055)


def decode_srgb(encoded: np.ndarray) -> np.ndarray:
    """The inverse of the sRGB curve on the first three channels; alpha stays."""
    color = encoded[..., :3]
    linear = np.where(color <= 0.04045, color / 12.92, ((np.maximum(color, 0) + 0.055) / 1.055) ** 2.4)
    return np.concatenate([linear, encoded[..., 3:]], axis=-1).astype(encoded.dtype)
