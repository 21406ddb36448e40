"""Cages from OBJ files: polygons, uv, and the tags of OpenSubdiv's files, which are statements "t".

`t name i/f/s …` is followed by i integers, f floats and s words. Tags count vertices and faces from 0, "f" from 1.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rts import InputError, Shader, errors, plugin
from rts.plugin_api.arrays import Tree
from rts.plugin_api.files import read_polygons
from rts_surfaces.subdivision.binding import UV_RULES

_BOUNDARIES = ("none", "edge_and_corner", "edge_only")
"""Boundary rules of interpolateboundary 0, 1 and 2."""
_TAGS = ("crease", "corner", "hole", "interpolateboundary", "facevaryinginterpolateboundary", "creasemethod")


class CageFile(NamedTuple):
    """The content of a cage's file.

    Attributes:
        faces: for each face the list of its vertices.
        options: keywords of `Subdivision`.
        theta: "vertices" (V, 3) and, if the file has them, "uv", "colors", "texture" and "color", float32, linear.
        shader: a shader suited to θ.
    """

    faces: list[list[int]]
    options: dict[str, Any]
    theta: dict[str, Tree]
    shader: Shader


def read_cage(path: Path) -> CageFile:
    """The cage of an OBJ file.

    Raises:
        InputError: the file is no OBJ file, or damaged.

    Warns:
        FileWarning: a statement, or the choice among several materials, is ignored.
    """
    if path.suffix.lower() != ".obj":
        raise InputError(f"{path} is no OBJ file; cages of subdivision surfaces are read from .obj")
    mesh = read_polygons(path)
    if mesh.materials > 1:
        errors.warn(
            f"{path} has {mesh.materials} materials, of which a cage can have but one; none is taken",
            errors.FileWarning,
        )
    with np.errstate(over="ignore"):  # What overflows is refused.
        theta: dict[str, Any] = {"vertices": mesh.vertices.astype(np.float32)}
        options = _tagged(path, mesh.tags)
        if (mesh.corners[:, 1] >= 0).all():
            theta["uv"] = mesh.uv.astype(np.float32)
            options["indices"] = {"uv": _lists(mesh.corners[:, 1], mesh.sizes)}
        if mesh.colors is not None:
            theta["colors"] = mesh.colors.astype(np.float32)
    opaque = _material(mesh, theta)
    for name, values in theta.items():
        bad = np.argwhere(~np.isfinite(values))
        if len(bad):
            raise InputError(
                f"{path}: row {bad[0][0]} of {name} is NaN, infinite or too large for float32; repair the file"
            )
    shader = plugin("shaders", "textured" if "texture" in theta else "lambert")(opaque=opaque)
    return CageFile(_lists(mesh.corners[:, 0], mesh.sizes), options, theta, shader)


def _lists(indices: np.ndarray, sizes: np.ndarray) -> list[list[int]]:
    return [part.tolist() for part in np.split(indices, np.cumsum(sizes)[:-1])]


def _material(mesh: Any, theta: dict[str, Any]) -> bool:
    """Add texture and colour of the material to θ: a texture only beside uv, a colour only if it is not white.

    Returns True if neither can be transparent.
    """
    color = mesh.color
    opaque = color is None or len(color) < 4 or color[3] >= 1
    if mesh.texture is not None and "uv" in theta:
        theta["texture"] = mesh.texture.astype(np.float32)
        opaque = opaque and mesh.texture.shape[-1] < 4
    if color is not None and (color < 1).any():
        theta["color"] = color[: 3 if (color[3:] >= 1).all() else 4].astype(np.float32)
    return bool(opaque)


def _tagged(path: Path, tags: list[tuple[int, str]]) -> dict[str, Any]:
    """Keywords of `Subdivision` from tags, which are (line of the file, text).

    Raises:
        InputError: a known tag is malformed.

    Warns:
        FileWarning: a tag is unknown.
    """
    options: dict[str, Any] = {"creases": [], "corners": [], "holes": []}
    for number, text in tags:
        name, whole, real, words = _split(path, number, text)
        if name == "crease" and len(whole) >= 2 and len(whole) % 2 == 0 and len(real) in (1, len(whole) // 2):
            pairs = zip(whole[::2], whole[1::2], strict=True)
            sharp = real * (len(whole) // 2 // len(real))
            options["creases"] += [(a, b, max(s, 0.0)) for (a, b), s in zip(pairs, sharp, strict=True)]
        elif name == "corner" and whole and len(real) in (1, len(whole)):
            sharp = real * (len(whole) // len(real))
            options["corners"] += [(v, max(s, 0.0)) for v, s in zip(whole, sharp, strict=True)]
        elif name == "hole" and whole:
            options["holes"] += whole
        elif name == "interpolateboundary" and len(whole) == 1 and 0 <= whole[0] < 3:
            options["boundary"] = _BOUNDARIES[whole[0]]
        elif name == "facevaryinginterpolateboundary" and len(whole) == 1 and 0 <= whole[0] < len(UV_RULES):
            options["uv_rule"] = list(UV_RULES)[whole[0]]
        elif name == "creasemethod" and words in (["normal"], ["chaikin"]):
            options["chaikin"] = words == ["chaikin"]
        elif name in _TAGS:
            raise _damaged(path, number, text)
        else:
            errors.warn(f"{path}, line {number}: the tag {name[:40]!r} is not followed", errors.FileWarning)
    return options


def _split(path: Path, number: int, text: str) -> tuple[str, list[int], list[float], list[str]]:
    """Name, integers, floats and words of a tag; an InputError unless their numbers are as the tag says."""
    name, counts, *rest = [*text.split(), "", ""][: max(2, len(text.split()))]
    try:
        i, f, s = (int(x) for x in counts.split("/"))
        kinds: list[tuple[int, Callable[[str], Any]]] = [(i, int), (f, float), (s, str)]
        if min(i, f, s) < 0 or i + f + s != len(rest):
            raise ValueError
        values = iter(rest)
        whole, real, words = ([kind(next(values)) for _ in range(count)] for count, kind in kinds)
    except ValueError:
        raise _damaged(path, number, text) from None
    if not np.isfinite(real).all():
        raise _damaged(path, number, text)
    return name, whole, real, words


def _damaged(path: Path, number: int, text: str) -> InputError:
    return InputError(
        f"{path}, line {number}: {' '.join(text.split())[:60]!r} is no tag; expected a name, numbers of integers, "
        f"floats and words as 2/1/0, and these: repair the file"
    )
