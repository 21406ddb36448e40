"""Shapes of built-in scenes and benchmarks, and their camera: cards placed on screen, wires, crossing spheres."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from rts import Camera, Part, load, load_image, plugin
from rts_diagnostics.example_shapes import QUAD, box, icosphere, unlit

FOV, DISTANCE = 40.0, 3.2
"""The camera's vertical field of view, degrees, and its distance from the origin."""
CARD_DEPTH = 4.3
"""Camera depth of cards behind the object in the middle."""
SLANTS = (4, -9, 17, -31, 44, 68, -83)
"""How wires are slanted, degrees from upright."""


# ------------------------------------------------------------------------------------------- places and turns


def camera() -> Camera:
    """The camera at (0, 0, 3.2), towards the origin, 40° from top to bottom, near 0.5, far 10."""
    return Camera.look_at((0.0, 0.0, DISTANCE), (0, 0, 0), fov_y=FOV, near=0.5, far=10.0)


def pixel(depth: float, size: int) -> float:
    """World width of one pixel at a camera depth, in a square image of `size` rows."""
    return 2 * depth * np.tan(np.radians(FOV / 2)) / size


def on_screen(xy: np.ndarray, depth: float, size: int) -> np.ndarray:
    """World points (N, 3) at a camera depth, seen at pixel coordinates (N, 2): y down, the top left corner (0, 0)."""
    xy = (np.asarray(xy, float) - size / 2) * pixel(depth, size)
    return np.column_stack([xy[:, 0], -xy[:, 1], np.full(len(xy), DISTANCE - depth)])


def normalised(points: np.ndarray) -> np.ndarray:
    """Points (V, 3) moved and scaled: the centre of their box is the origin, and the farthest is at distance 1."""
    points = points - (points.min(0) + points.max(0)) / 2
    return points / np.linalg.norm(points, axis=1).max()


def rotation_xy(ax: float, ay: float) -> np.ndarray:
    """The rotation R_x(ax) · R_y(ay) (3, 3), angles in radians."""
    cx, sx, cy, sy = np.cos(ax), np.sin(ax), np.cos(ay), np.sin(ay)
    return np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]]) @ np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])


def turned(ax: float, ay: float) -> np.ndarray:
    """The transform (4, 4) of `rotation_xy`."""
    transform = np.eye(4)
    transform[:3, :3] = rotation_xy(ax, ay)
    return transform


# --------------------------------------------------------------------------------------- vertices and triangles


def rectangle(left: float, top: float, right: float, bottom: float, depth: float, size: int) -> np.ndarray:
    """World corners (4, 3) of a card at a camera depth, facing the camera, seen between these pixel coordinates."""
    return on_screen(np.array([[left, bottom], [right, bottom], [right, top], [left, top]]), depth, size)


def grid(count_u: int, count_v: int) -> tuple[np.ndarray, np.ndarray]:
    """Parameters (V, 2) in [−1, 1]² and triangles (T, 3) of a sheet of count_u × count_v cells."""
    u, v = np.meshgrid(np.linspace(-1, 1, count_u + 1), np.linspace(-1, 1, count_v + 1), indexing="ij")
    index = np.arange(u.size).reshape(u.shape)
    a, b, c, d = (i.ravel() for i in (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]))
    return np.column_stack([u.ravel(), v.ravel()]), np.concatenate(
        [np.column_stack([a, b, c]), np.column_stack([a, c, d])]
    )


# -------------------------------------------------------------------------------------------------------- parts


def bunny_and_square(vertices: np.ndarray, faces: np.ndarray) -> tuple[Part, Part]:
    """The bunny, green and brighter towards a light, and the red square behind it.

    Args:
        vertices: (V, 3) of the bunny, normalised and turned.
        faces: (T, 3).
    """
    surface = plugin("rts.surfaces", "mesh")(faces)
    green = 0.25 + 0.7 * np.maximum(0, surface.vertex_normals(vertices) @ [0.4, 0.5, 0.77])
    colors = np.stack([np.zeros_like(green), green, np.zeros_like(green)], axis=-1)
    c, s = np.cos(0.03), np.sin(0.03)
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * 0.62 @ np.array([[c, s], [-s, c]])
    square = np.concatenate([corners + [0.35, 0.15], np.full((4, 1), -1.1)], axis=1)
    return Part(surface, {"vertices": vertices, "colors": colors}, "unlit"), unlit(square, QUAD, [0.8, 0.1, 0.1])


def textured_spot(folder: Path) -> Part:
    """The cow Spot with its texture, unlit and culled.

    Args:
        folder: the folder with spot_triangulated.obj and spot_texture.png.
    """
    (part,) = load(folder / "spot_triangulated.obj")
    if "texture" not in part.theta:
        image = load_image(folder / "spot_texture.png")
        part = part.replace(theta={**part.theta, "texture": image[..., :3]})
    vertices = normalised(part.theta["vertices"].astype(float)) @ rotation_xy(0.2, 0.4 + np.pi).T
    theta = {**part.theta, "vertices": vertices}
    return part.replace(theta={k: theta[k] for k in ("vertices", "uv", "texture")}, shader="unlit", cull="back")


def turned_box() -> tuple[Part, Part]:
    """A box with one colour on each face, and a card with a pattern behind it."""
    vertices, faces = box([-0.45, -0.35, -0.4], [0.45, 0.35, 0.4])
    hues = np.array(
        [[0.9, 0.3, 0.1], [0.2, 0.7, 0.3], [0.8, 0.8, 0.2], [0.5, 0.2, 0.7], [0.1, 0.4, 0.9], [0.3, 0.8, 0.8]]
    )
    back, order = grid(16, 16)
    card = np.column_stack([1.1 * back, np.full(len(back), DISTANCE - CARD_DEPTH)])
    waves = 0.5 + 0.3 * np.column_stack([np.sin(5 * back[:, 0]), np.sin(4 * back[:, 1]), np.cos(3 * back.sum(1))])
    return unlit(vertices @ rotation_xy(0.5, 0.6).T, faces, np.repeat(hues, 4, axis=0)), unlit(card, order, waves)


def cards(count: int) -> tuple[list[Part], list[float]]:
    """At least 2 cards one behind the other, tilted and turned at random, the nearest first; and their depths."""
    random = np.random.default_rng(count)  # A fixed seed.
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    parts, depths = [], []
    for i in range(count):
        depth = 2.6 + 2.0 * i / (count - 1)
        turn, tilt_x, tilt_y = random.uniform(-np.pi, np.pi), *random.uniform(-0.12, 0.12, 2)
        c, s = np.cos(turn), np.sin(turn)
        rotation = rotation_xy(tilt_x, tilt_y) @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        extent = np.append(random.uniform(0.15, 0.35, 2) + 0.3 * i / count, 1) * depth / DISTANCE
        place = np.append(random.uniform(-0.35, 0.35, 2) * depth / DISTANCE, DISTANCE - depth)
        color = 0.55 + 0.4 * np.cos(2.4 * i + np.array([0, 2.1, 4.2]))
        parts.append(unlit(corners * extent @ rotation.T + place, QUAD, color))
        depths.append(depth)
    return parts, depths


def of_glass(part: Part, alpha: float) -> Part:
    """A part with a colour for each vertex, made translucent with this alpha."""
    colors = np.asarray(part.theta["colors"])[:, :3]
    colors = np.concatenate([colors, np.full_like(colors[:, :1], alpha)], axis=1)
    return part.replace(theta={**part.theta, "colors": colors}, shader=plugin("rts.shaders", "unlit")(opaque=False))


def behind_glass() -> list[Part]:
    """A glass ball, an opaque card behind it, and a glass pane."""
    vertices, faces = icosphere(3)
    ball = of_glass(unlit(0.5 * vertices, faces, (0.2, 0.9, 0.4)), 0.5)
    corners = np.array([[-0.9, -0.5, -0.8], [0.3, -0.6, -0.8], [0.4, 0.35, -0.8], [-0.8, 0.45, -0.8]])
    pane = of_glass(unlit(corners * [0.8, 0.9, -1] + [0.35, 0.1, 0], QUAD, (0.3, 0.4, 1.0)), 0.4)
    return [ball, unlit(corners, QUAD, (0.9, 0.3, 0.1)), pane]


def wires(size: int, widths: Sequence[float]) -> Part:
    """Seven thin quads from nearly upright to nearly level.

    Args:
        size: height of the square image, pixels.
        widths: width of each wire, pixels.
    """
    vertices, faces = [], []
    for i, (slant, width) in enumerate(zip(np.radians(SLANTS), widths, strict=True)):
        along, across = np.array([np.sin(slant), np.cos(slant)]), np.array([np.cos(slant), -np.sin(slant)])
        center = size * np.array([0.5 + 0.085 * (i - 3), 0.5 + 0.05 * (i % 3 - 1)]) + 0.3
        ends = [
            center + a * 0.22 * size * along + b * width / 2 * across for a, b in ((-1, -1), (-1, 1), (1, 1), (1, -1))
        ]
        vertices.append(on_screen(np.array(ends), DISTANCE + 0.02 * i, size))
        faces += [[4 * i + j for j in f] for f in QUAD]
    colors = np.repeat(
        np.array([[1, 1, 1], [1, 0.6, 0.2], [0.3, 0.8, 1], [0.9, 0.9, 0.2]])[np.arange(7) % 4], 4, axis=0
    )
    return unlit(np.concatenate(vertices), faces, colors)


def crossing_spheres() -> tuple[Part, Part]:
    """Two spheres that pass through one another, the farther one first."""
    vertices, faces = icosphere(5)
    shade = 0.35 + 0.6 * np.maximum(0, vertices @ [0.4, 0.5, 0.77])[:, None]
    farther = unlit(0.6 * vertices + [-0.28, 0.05, -0.05], faces, shade * [1.0, 0.5, 0.15])
    return farther, unlit(0.5 * vertices + [0.32, -0.05, 0.1], faces, shade * [0.2, 0.6, 1.0])
