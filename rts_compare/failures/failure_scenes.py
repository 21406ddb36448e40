"""The scenes of the table's rows, most made by formulas. One unit along a direction moves parts by about a pixel."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from rts import Camera, Part, engine_of, rigid
from rts.plugin_api.arrays import Tree
from rts_compare import scene_shapes
from rts_compare.builtin_scenes import data_file, read_mesh
from rts_compare.moving_scenes import Scene, parts_of
from rts_compare.scene_shapes import CARD_DEPTH, DISTANCE, on_screen, pixel, rectangle
from rts_diagnostics import example_shapes
from rts_diagnostics.example_shapes import QUAD, unlit

SIZE = (96, 96)
SMALL = (64, 64)
WHITE, RED, GREEN, BLUE = (0.95, 0.95, 0.95), (0.85, 0.25, 0.15), (0.2, 0.75, 0.3), (0.2, 0.4, 0.9)
AXES = ("rx", "ry", "rz", "tx", "ty", "tz")
"""Names of motions: the components of a rotation vector, about the middle of what moves, and of a translation."""
ARM = 0.4
"""The distance from the middle at which a rotation of one unit moves by a pixel."""


class _Posed(NamedTuple):
    """Parts of which some have a pose.

    Attributes:
        parts: all of them.
        camera: the camera.
        moves: the indices of those that move.
        center: (3,), the point about which rotations turn.
    """

    parts: Sequence[Part]
    camera: Camera
    moves: Sequence[int]
    center: np.ndarray

    def __call__(self, parameters: Mapping[str, Any]) -> tuple[list[Part], Camera]:
        """All parts, with those that move at the pose (6,) in `parameters`, and the camera."""
        transform = rigid(parameters["pose"], self.center)
        return [p.replace(transform=transform) if i in self.moves else p for i, p in enumerate(self.parts)], self.camera


def posed(
    name: str,
    parts: Part | Sequence[Part],
    axes: Sequence[str] = ("tx",),
    *,
    moves: Sequence[int] = (0,),
    size: tuple[int, int] = SIZE,
    camera: Camera | None = None,
    depth: float | None = None,
    unit: float = 1.0,
) -> Scene:
    """Parts in world space, some of which a pose moves.

    Args:
        name: of the scene.
        parts: without transforms.
        axes: names of motions, out of `AXES`.
        moves: the indices of the parts that move.
        size: (height, width).
        camera: None for that of built-in scenes.
        depth: the depth at which a translation by one unit is a pixel; None for the middle of the moving parts.
        unit: the length of one unit in the world.
    """
    parts = [parts] if isinstance(parts, Part) else list(parts)
    points = np.concatenate([np.asarray(parts[i].theta["vertices"], np.float64) for i in moves])
    center = (points.min(axis=0) + points.max(axis=0)) / 2
    step = pixel(DISTANCE - center[2] / unit if depth is None else depth, size[0]) * unit
    lengths = {axis: step if axis[0] == "t" else step / (ARM * unit) for axis in AXES}
    directions: dict[str, Tree] = {a: {"pose": lengths[a] * np.eye(6)[AXES.index(a)]} for a in axes}
    at: Callable = _Posed(parts, scene_shapes.camera() if camera is None else camera, moves, center)
    return Scene(name, at, {"pose": np.zeros(6)}, directions, size)


def card(center: Sequence[float], half: Sequence[float], depth: float, color: Any, size: tuple[int, int]) -> Part:
    """A card parallel to the image plane, turned there by 0.05 radians.

    Args:
        center: its middle, pixels.
        half: half of its width and of its height, pixels.
        depth: its camera depth.
        color: its colour.
        size: (height, width) of the image, which is square.
    """
    c, s = np.cos(0.05), np.sin(0.05)
    corners = np.array([[-1, 1], [1, 1], [1, -1], [-1, -1]]) * half @ np.array([[c, s], [-s, c]])
    return unlit(on_screen(corners + center, depth, size[0]), QUAD, color)


def sphere(radius: float = 0.6, center: Any = (0, 0, 0), color: Any = GREEN, detail: int = 3, **options: Any) -> Part:
    """A sphere, brighter towards a light."""
    vertices, faces = example_shapes.icosphere(detail)
    shade = 0.35 + 0.6 * np.maximum(0, vertices @ [0.4, 0.5, 0.77])[:, None]
    return unlit(radius * vertices + center, faces, shade * color, **options)


def backdrop(depth: float = CARD_DEPTH + 1.0, color: Any = BLUE) -> Part:
    """A card that fills the image, at a camera depth."""
    return unlit(np.array([[-4, -4, 0], [4, -4, 0], [4, 4, 0], [-4, 4, 0.0]]) + [0, 0, DISTANCE - depth], QUAD, color)


# ----------------------------------------------------------------------------------------------------------- fits


def box_pose() -> Scene:
    """A box with a colour a face, in front of a card with a pattern."""
    return posed("box pose", scene_shapes.turned_box(), AXES, size=SMALL)


def colored_box() -> Scene:
    """The box of `box_pose` with a colour a corner. Its faces share eight corners, as other renderers need."""
    vertices, faces = example_shapes.box([-0.45, -0.35, -0.4], [0.45, 0.35, 0.4])
    corners, became = np.unique(vertices, axis=0, return_inverse=True)
    hues = 0.5 + 0.45 * np.cos(np.arange(8)[:, None] * [1.7, 2.6, 4.1] + [0, 2, 4])
    box = unlit(corners @ scene_shapes.rotation_xy(0.5, 0.6).T, became.reshape(-1)[faces], hues)
    return posed("box pose", [box, scene_shapes.turned_box()[1]], AXES, size=SMALL)


@cache
def _bunny() -> tuple[np.ndarray, np.ndarray]:
    vertices, faces = read_mesh(data_file("square behind bunny", "meshes/bunny_5k.obj"))
    return scene_shapes.normalised(vertices) @ scene_shapes.rotation_xy(0.1, 0.4).T, faces


def square_behind_bunny() -> Scene:
    """The square slides behind the bunny, closed enough to be culled."""
    bunny, square = scene_shapes.bunny_and_square(*_bunny())
    return posed("sliding square", [bunny.replace(cull="back"), square], ("tx",), moves=[1], size=SMALL)


def square_behind_open_bunny() -> Scene:
    """As `square_behind_bunny`, with the bunny's inside drawn, too: the square is the third layer."""
    return posed("sliding square", scene_shapes.bunny_and_square(*_bunny()), ("tx",), moves=[1], size=SMALL)


def far_card() -> Scene:
    """A card on black; fits start where the card's image does not overlap that of the target."""
    return posed("far card", card((32, 32), (8, 6), DISTANCE, WHITE, SMALL), ("tx", "ty"), size=SMALL)


def hidden_card() -> Scene:
    """A card that moves, beside a larger one that is nearer; fits start with the first behind the larger one."""
    near = card((20, 32), (14, 16), 2.6, RED, SMALL)
    far = card((48, 32), (6, 8), CARD_DEPTH, WHITE, SMALL)
    return posed("hidden card", [near, far], ("tx", "ty"), moves=[1], size=SMALL)


def turning_card() -> Scene:
    """A white card on black that is turned about its upright axis by 0.5 radians, and turns further."""
    flat = np.array([[-0.5, -0.3, 0], [0.5, -0.3, 0], [0.5, 0.3, 0], [-0.5, 0.3, 0]])
    return posed("turning card", unlit(flat @ scene_shapes.rotation_xy(0, 0.5).T, QUAD, WHITE), ("ry",), size=SMALL)


def facing_card() -> float:
    """The amount of the mode "ry" at which the card of `turning_card` faces the camera."""
    return -0.5 / (pixel(DISTANCE, SMALL[0]) / ARM)


# ------------------------------------------------------------------------------------------------ what lies behind


def stack(count: int) -> Scene:
    """`count` cards, at least 2, one behind the other; the one in the middle moves."""
    parts, depths = scene_shapes.cards(count)
    return posed(f"stack of {count}", parts, moves=[count // 2], depth=depths[count // 2])


def shells() -> Scene:
    """A closed sphere, both of its sides drawn, in front of a card that moves: the card is the third layer."""
    far = card((50, 46), (34, 24), CARD_DEPTH, RED, SIZE)
    return posed("card behind a shell", [sphere(0.45), far], moves=[1], depth=CARD_DEPTH)


def pane() -> Scene:
    """A pane of glass slides over a card."""
    panes = [scene_shapes.of_glass(card((56, 60), (30, 26), 2.8, RED, SIZE), 0.5)]
    return posed("pane of glass", [*panes, card((70, 66), (34, 24), CARD_DEPTH, GREEN, SIZE)], moves=[0], depth=2.8)


def behind_glass() -> Scene:
    """A card behind a pane and a ball of glass."""
    return posed("card behind glass", scene_shapes.behind_glass(), moves=[1], depth=DISTANCE + 0.8)


def coplanar(apart: float = 0.0) -> Scene:
    """Two cards that overlap, in one plane or `apart` in depth, world units; the farther one slides."""
    cards = [card((40, 44), (22, 18), DISTANCE, RED, SIZE), card((58, 54), (20, 22), DISTANCE + apart, GREEN, SIZE)]
    return posed("coplanar cards", [*cards, backdrop()], moves=[1])


def crossing() -> Scene:
    """Two spheres that pass through one another; the nearer one moves."""
    parts = sphere(0.5, (0.32, -0.05, 0.1), BLUE, 4), sphere(0.6, (-0.28, 0.05, -0.05), RED, 4)
    return posed("crossing spheres", parts, moves=[0])


# ------------------------------------------------------------------------------------------------------- thin things


def wires(width: float) -> Scene:
    """Seven slanted wires over black, `width` pixels wide."""
    return posed("wires", scene_shapes.wires(SIZE[0], [width] * 7), ("tx",))


def gap(width: float) -> Scene:
    """Two cards with a slanted gap of `width` pixels, in front of a card that shows through; the right one moves."""
    turn = np.array([[np.cos(0.3), np.sin(0.3)], [-np.sin(0.3), np.cos(0.3)]])

    def half(left: float, right: float) -> Part:
        corners = np.array([[left, 30], [right, 30], [right, -30], [left, -30.0]]) @ turn + 48
        return unlit(on_screen(corners, DISTANCE, SIZE[0]), QUAD, RED)

    return posed("gap", [half(width / 2, 30), half(-30, -width / 2), backdrop(color=WHITE)], moves=[0])


def comb() -> Scene:
    """Slanted teeth 0.7 pixels wide, one every 1.3 pixels: many pixels have several edges."""
    vertices, faces = [], []
    for i in range(40):
        x = 22 + 1.3 * i
        corners = np.array([[x, 75], [x + 0.7, 75], [x + 0.7 + 6, 25], [x + 6, 25]])
        vertices.append(on_screen(corners, DISTANCE, SIZE[0]))
        faces += [[4 * i + j for j in f] for f in QUAD]
    color = np.repeat(0.5 + 0.4 * np.cos(np.arange(40)[:, None] / 4 + [0, 2, 4]), 4, axis=0)
    return posed("comb", unlit(np.concatenate(vertices), faces, color))


def upright() -> Scene:
    """A card whose edges are exactly upright and level."""
    return posed("upright card", unlit(rectangle(30.3, 24.6, 66.7, 71.2, DISTANCE, SIZE[0]), QUAD, WHITE))


def grazing() -> Scene:
    """A striped sheet that is seen from three degrees above its plane."""
    at, faces = scene_shapes.grid(24, 24)
    sheet = np.column_stack([at[:, 0], np.zeros(len(at)), at[:, 1]]) @ scene_shapes.rotation_xy(0.05, 0).T
    color = 0.5 + 0.4 * np.column_stack([np.sin(9 * at[:, 0]), np.cos(7 * at[:, 0]), np.sin(5 * at[:, 0])])
    return posed("grazing sheet", unlit(sheet, faces, color), ("ty",))


# ------------------------------------------------------------------------------------------------------------- views


def leaving() -> Scene:
    """A sphere that reaches beyond two sides of the image, the upper and the right one."""
    return posed("leaving the image", sphere(0.95, (0.55, 0.35, 0), detail=4))


def through_near() -> Scene:
    """A slanted card of which the near plane cuts off a part. One mode moves it sideways, one towards the camera."""
    corners = np.array([[-0.15, -0.13, -0.35], [0.3, -0.13, -1.0], [0.3, 0.12, -1.0], [-0.15, 0.12, -0.35]])
    return posed("near plane", unlit(corners + [0, 0, DISTANCE], QUAD, RED), ("tx", "tz"), depth=0.6)


def past_camera() -> Scene:
    """A quadrilateral on the floor that goes on behind the camera."""
    points = np.array([[-0.18, -0.3, 6.0], [0.12, -0.3, 6.0], [0.2, -0.3, 0.0], [-0.25, -0.3, 0.0]])
    return posed("behind the camera", unlit(points, [(0, 1, 2), (0, 2, 3)], RED), depth=1.5)


def empty() -> Scene:
    """A sphere outside of the image."""
    return posed("empty view", sphere(0.3, (4.0, 0, 0)))


def covered() -> Scene:
    """A sphere wholly behind a card. The mode "hidden" moves the sphere, the mode "card" the card."""
    parts = [sphere(0.3, (0, 0, -1.0)), card((48, 48), (30, 30), 2.6, RED, SIZE)]
    hidden, both = posed("hidden", parts, moves=[0]), posed("hidden", parts, moves=[1])

    def at(parameters: Mapping[str, Any]) -> tuple[list[Part], Camera]:
        first = hidden.at({"pose": parameters["hidden"]})
        second = both.at({"pose": parameters["card"]})
        return [parts_of(first)[0], parts_of(second)[1]], first[1]

    zero, unit = np.zeros(6), np.eye(6)[3]
    directions = {
        "hidden": {"hidden": unit * pixel(4.2, SIZE[0]), "card": zero},
        "card": {"hidden": zero, "card": unit * pixel(2.6, SIZE[0])},
    }
    return Scene("hidden", at, {"hidden": zero, "card": zero}, directions, SIZE)


def turning_ball() -> Scene:
    """A sphere of one colour. The first mode turns it about its middle: nothing changes. The other moves it."""
    vertices, faces = example_shapes.icosphere(5)
    return posed("turning ball", unlit(0.6 * vertices, faces, GREEN), ("ry", "tx"))


# ----------------------------------------------------------------------------------------------------------- numbers


def plain() -> Scene:
    """A sphere, culled, that moves in front of a card."""
    return scaled(1.0)


def scaled(factor: float, away: float = 0.0) -> Scene:
    """The scene `plain` with all lengths times a factor, in float64, then moved by `away` along x, camera and all."""
    offset = np.array([away, 0.0, 0.0])

    def moved(part: Part) -> Part:
        theta = {**part.theta, "vertices": part.theta["vertices"] * factor + offset}
        return part.replace(theta=theta)

    parts = [moved(sphere(0.5, cull="back")), moved(card((56, 50), (26, 30), CARD_DEPTH, RED, SIZE))]
    camera = Camera.look_at(
        (away, 0.0, DISTANCE * factor), (away, 0, 0), fov_y=scene_shapes.FOV, near=0.5 * factor, far=10.0 * factor
    )
    return posed("sphere before a card", parts, camera=camera, unit=factor)


def offset(away: float) -> Scene:
    """The scene `plain`, camera and all, moved by `away` along x: by transforms, while vertices stay as they are."""
    scene, still = plain(), np.eye(4)
    still[0, 3] = away

    def at(parameters: Mapping[str, Any]) -> tuple[list[Part], Camera]:
        found = scene.at(parameters)
        moved, camera = [], found[1]
        for part in parts_of(found):
            own = np.eye(4) if part.transform is None else part.transform
            moved.append(part.replace(transform=engine_of(own).constant(still, own) @ own))
        view = np.asarray(camera.view, np.float64) @ np.linalg.inv(still)
        return moved, camera.replace(view=view)

    return replace(scene, at=at)


def with_slivers(shader: str = "unlit") -> Scene:
    """The scene `plain`, its sphere with additional triangles of no area, and needles of next to none."""
    sphere_, far = parts_of(plain().at(plain().parameters))
    vertices, faces = sphere_.theta["vertices"], np.asarray(sphere_.surface.faces)
    extra = [[i, i, j] for i, j in faces[:40, :2]] + [[i, i, i] for i in range(20)]
    count = len(vertices)
    needles = vertices[faces[100:140, 0]] * (1 + 1e-9)
    extra += [[a, b, count + k] for k, (a, b) in enumerate(faces[100:140, :2])]
    points = np.concatenate([vertices, needles])
    colors = np.concatenate([sphere_.theta["colors"], sphere_.theta["colors"][faces[100:140, 0]]])
    part = unlit(points, np.concatenate([faces, extra]), colors, cull="back").replace(shader=shader)
    return posed("slivers", [part, far])
