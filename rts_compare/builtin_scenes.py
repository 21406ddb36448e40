"""Scenes by name, for comparisons of settings: some made by formulas, some of files of the test data.

All have the same camera and 256 × 256 pixels; their parts move in the modes of `moving`.
"""

from __future__ import annotations

import copy
import difflib
import os
import unicodedata
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rts import Part, load, namespace, plugin
from rts.errors import InputError
from rts.plugin_api.arrays import Array, Tree
from rts_compare import scene_shapes
from rts_compare.moving_scenes import Scene, moving
from rts_compare.scene_shapes import normalised, rotation_xy, turned
from rts_diagnostics.example_shapes import mesh

SIZE = (256, 256)
VARIABLE, FOLDER = "RTS_DATA", Path("../shared/data")
"""The environment variable that names the folder of the test data, and the folder if it is not set."""
EXACT = 0.02
"""The largest distance between exact surfaces and their triangles at outlines, pixels; a fifth of the usual one."""


class Builtin(NamedTuple):
    """A scene that comes with the library.

    Attributes:
        make: () → the scene.
        note: what moves, and what is hard about it.
        data: the files that it needs, in the folder of the test data.
    """

    make: Callable[[], Scene]
    note: str
    data: tuple[str, ...] = ()


def names() -> list[str]:
    """The names of the built-in scenes."""
    return list(BUILTIN)


def builtin(name: str) -> Scene:
    """A built-in scene.

    Args:
        name: one of `names()`; case and accents do not matter; spaces may be hyphens or underscores.

    Raises:
        InputError: there is no such scene, or a file of the test data that it needs is missing.
        PluginError: a surface of it needs a package that is not installed.
    """
    plain = unicodedata.normalize("NFKD", str(name)).encode("ascii", "ignore").decode()
    known = " ".join(plain.lower().replace("-", " ").replace("_", " ").split())
    if known not in BUILTIN:
        close = difflib.get_close_matches(known, BUILTIN, n=1)
        hint = f"; did you mean {close[0]!r}?" if close else ""
        raise InputError(f"no scene named {str(name)!r}; there are {', '.join(BUILTIN)}{hint}")
    return BUILTIN[known].make()


def _scene(name: str, parts: Part | Sequence[Part], **options: Any) -> Scene:
    return moving(name, parts, scene_shapes.camera(), SIZE, note=BUILTIN[name].note, **options)


def data_file(scene: str, file: str) -> Path:
    """The path of a file of the test data; an InputError that names `scene` if it is missing."""
    path = Path(os.environ.get(VARIABLE) or FOLDER) / file
    if not path.is_file():
        formulas = ", ".join(name for name, found in BUILTIN.items() if not found.data)
        raise InputError(
            f"the scene {scene!r} needs {path}, which is missing; let the variable {VARIABLE} name the folder of the "
            f"test data, or take a scene made by formulas: {formulas}"
        )
    return path


def _with_exact(part: Part) -> tuple[Part, Part]:
    """A part of patches, and a copy with triangles so small that its outlines are off by at most `EXACT` pixels."""
    surface = copy.copy(part.surface)
    surface.tolerance = EXACT
    return part, part.replace(surface=surface)


def _upright(points: np.ndarray, ax: float, ay: float) -> np.ndarray:
    """Points (V, 3) float64 of an object upright along z: set upright along y, `normalised`, turned (`rotation_xy`)."""
    return normalised(np.asarray(points, np.float64)[:, [0, 2, 1]] * [1, 1, -1]) @ rotation_xy(ax, ay).T


# ------------------------------------------------------------------------------------------------------- meshes


def read_mesh(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) float64 and faces (T, 3) of a file with one mesh."""
    (part,) = load(path)
    vertices, faces = part.surface.tessellate(part.theta, 1)
    return vertices.astype(np.float64), faces


def _bunny_and_square(scene: str) -> list[Part]:
    vertices, faces = read_mesh(data_file(scene, BUILTIN[scene].data[0]))
    parts = scene_shapes.bunny_and_square(normalised(vertices) @ rotation_xy(0.1, 0.4).T, faces)
    return [part.replace(cull="back") for part in parts]


def bunny_over_black() -> Scene:
    """The bunny moves over black: case A of the table of derivatives."""
    name = "bunny over black"
    return _scene(name, _bunny_and_square(name)[0])


def square_behind_bunny() -> Scene:
    """A square that moves behind the bunny: case B of the table of derivatives."""
    name = "square behind bunny"
    return _scene(name, _bunny_and_square(name), moves=[1])


def bunny_before_square() -> Scene:
    """The bunny moves in front of the square: case C of the table of derivatives."""
    name = "bunny before square"
    return _scene(name, _bunny_and_square(name), moves=[0])


def textured_spot() -> Scene:
    """A cow with a texture."""
    name = "textured spot"
    obj, _ = (data_file(name, file) for file in BUILTIN[name].data)
    return _scene(name, scene_shapes.textured_spot(obj.parent))


def nefertiti() -> Scene:
    """A scanned bust."""
    vertices, faces = read_mesh(data_file("nefertiti", BUILTIN["nefertiti"].data[0]))
    color = np.array([0.9, 0.75, 0.55])
    return _scene("nefertiti", mesh(_upright(vertices, 0.1, 0.4), faces, "lambert", "back", color=color))


def thin_wires() -> Scene:
    """Seven wires, one pixel or half a pixel wide."""
    return _scene("thin wires", scene_shapes.wires(SIZE[0], [1.0, 0.5, 1.0, 0.5, 1.0, 0.5, 1.0]))


def stack_of_cards() -> Scene:
    """Six cards; the fourth moves."""
    parts, _ = scene_shapes.cards(6)
    return _scene("stack of cards", parts, moves=[len(parts) // 2])


def card_behind_glass() -> Scene:
    """A card that moves behind a glass ball and a glass pane."""
    return _scene("card behind glass", scene_shapes.behind_glass(), moves=[1])


def crossing_spheres() -> Scene:
    """Two spheres that pass through one another; the nearer moves."""
    return _scene("crossing spheres", scene_shapes.crossing_spheres(), moves=[1])


def turned_box() -> Scene:
    """A box that moves in front of a card."""
    return _scene("turned box", scene_shapes.turned_box(), moves=[0])


# ----------------------------------------------------------------------------------------------- smooth surfaces

VASE_RADII = np.array([0.0, 0.22, 0.4, 0.34, 0.55, 0.68, 0.6, 0.3, 0.2, 0.26, 0.42])
"""Radii of the vase at `VASE_HEIGHTS`, from its foot up."""
VASE_HEIGHTS = np.array([-0.9, -0.9, -0.88, -0.74, -0.5, -0.15, 0.22, 0.5, 0.68, 0.82, 0.9])
AROUND = 16
"""Control points around the vase."""


def vase() -> Scene:
    """A vase with a pattern, tilted; it is open above, and its inside is seen."""
    surface = plugin("rts.surfaces", "revolution")(VASE_HEIGHTS, AROUND)
    around, up = np.meshgrid(2 * np.pi * np.arange(AROUND) / AROUND, VASE_HEIGHTS)
    waves = [np.cos(3 * around + 4 * up), np.sin(2 * around - 3 * up), np.cos(around + 5 * up)]
    theta = {"radii": VASE_RADII, "colors": 0.6 + 0.35 * np.stack(waves, axis=-1)}
    part, exact = _with_exact(Part(surface, theta, "lambert", turned(0.45, 0.0)))
    return _scene("vase that turns", part, exact=exact)


def _standing(part: Part, entry: str, color: Sequence[float]) -> Part:
    """The part in one colour, shaded, with the points in `entry` of θ placed by `_upright`."""
    theta = {entry: _upright(part.theta[entry], 0.35, 0.5), "color": np.array(color)}
    return part.replace(theta=theta, shader="lambert")


def bezier_teapot() -> Scene:
    """Newell's teapot."""
    name = "bezier teapot"
    (part,) = load(data_file(name, BUILTIN[name].data[0]), surface="bezier")
    part, exact = _with_exact(_standing(part, "points", [0.9, 0.55, 0.3]))
    return _scene(name, part, exact=exact)


def subdivided_rook() -> Scene:
    """A chess rook."""
    name = "subdivided rook"
    (part,) = load(data_file(name, BUILTIN[name].data[0]), surface="subdivision")
    part, exact = _with_exact(_standing(part, "vertices", [0.75, 0.8, 0.9]))
    return _scene(name, part, exact=exact)


# ----------------------------------------------------------------------------------------------------- the torus


def torus(theta: Mapping[str, Tree], points: Array) -> Array:
    """The signed distance (M,) of points (M, 3) to a torus about the y axis: θ["radii"] (2,), ring and tube."""
    xp, radii = namespace(points), theta["radii"]

    def length(x: Array, y: Array) -> Array:
        return xp.sqrt(x * x + y * y + 1e-12)  # So that it has a derivative at zero.

    return length(length(points[:, 0], points[:, 2]) - radii[0], points[:, 1]) - radii[1]


def _torus(surface: Any) -> Part:
    theta = {"radii": np.array([0.62, 0.26]), "color": np.array([0.95, 0.6, 0.25])}
    return Part(surface, theta, "lambert", turned(0.9, 0.0) @ turned(0.0, 0.3))


def _torus_by_ray() -> Part:
    return _torus(plugin("rts.surfaces", "sdf")(torus, radius=1.0, reads=("radii",)))


def torus_by_lattice() -> Scene:
    """A torus of values on a lattice with steps of 0.05; its true derivative is that of the exact field, by rays."""
    bounds = (-1.0, -0.4, -1.0), (1.0, 0.4, 1.0)
    surface = plugin("rts.surfaces", "isosurface")(bounds, f=torus, shape=(41, 17, 41), lipschitz=1.0, reads=("radii",))
    return _scene("torus by lattice", _torus(surface), exact=_torus_by_ray())


def torus_by_ray() -> Scene:
    """The torus as a signed distance that rays are cast at."""
    return _scene("torus by ray", _torus_by_ray())


BUNNY = ("meshes/bunny.obj",)
SPOT = ("meshes/spot/spot_triangulated.obj", "meshes/spot/spot_texture.png")
BUILTIN: dict[str, Builtin] = {
    "bunny over black": Builtin(
        bunny_over_black, "69K small triangles, culled, unlit; one object and its outlines", BUNNY
    ),
    "square behind bunny": Builtin(square_behind_bunny, "the square moves, hidden in part; nothing else does", BUNNY),
    "bunny before square": Builtin(bunny_before_square, "the bunny moves; the square behind it comes to light", BUNNY),
    "textured spot": Builtin(textured_spot, "a cow whose texture has edges of its own; culled, unlit", SPOT),
    "nefertiti": Builtin(nefertiti, "a bust of 100K triangles, smaller than pixels, shaded", ("meshes/nefertiti.obj",)),
    "vase that turns": Builtin(vase, "a smooth surface with a pattern, seen outside and inside; it is made of radii"),
    "thin wires": Builtin(thin_wires, "seven slanted wires, one pixel wide or half a pixel, over black"),
    "stack of cards": Builtin(stack_of_cards, "six open cards that overlap; one in the middle moves"),
    "card behind glass": Builtin(
        card_behind_glass, "a card moves behind a pane and a ball of glass: up to four layers, all seen"
    ),
    "crossing spheres": Builtin(
        crossing_spheres, "two spheres that pass through one another, unculled; the nearer moves"
    ),
    "turned box": Builtin(turned_box, "a closed box, unculled, moves before a card with a pattern"),
    "bezier teapot": Builtin(
        bezier_teapot,
        "Newell's teapot of 32 patches, whose handle and spout overlap it",
        ("bezier/teapot_patches.txt",),
    ),
    "subdivided rook": Builtin(
        subdivided_rook, "a subdivision surface with creases and battlements", ("cages/catmark_rook.obj",)
    ),
    "torus by lattice": Builtin(torus_by_lattice, "a signed distance on a lattice, against its exact surface"),
    "torus by ray": Builtin(torus_by_ray, "a signed distance that rays are cast at"),
}
