"""Scenes of surfaces that pass through one another: the line between them moves as neither of them does.

What moves goes along the view or across it by as much as moves the line by about a pixel a unit of t.
"""

from __future__ import annotations

import numpy as np

import rts
from benchmarks.accuracy.scenes import DISTANCE, Scene, motion, pixel, turn
from benchmarks.meshes import rotation_xy
from rts_compare import scene_shapes
from rts_diagnostics.example_shapes import QUAD, box, unlit

PLANE_COLORS = (0.9, 0.5, 0.2), (0.2, 0.5, 0.9)


def nearer(amount: float) -> np.ndarray:
    """Derivative (4, 4) of a motion towards the eye."""
    matrix = np.zeros((4, 4))
    matrix[2, 3] = amount
    return matrix


def plane(slope_x: float, slope_y: float, height: float, color, half: float = 2.0) -> rts.Part:
    """A square card about the origin in x and y, whose z is linear in these."""
    xy = half * np.array([[-1.0, -1], [1, -1], [1, 1], [-1, 1]])
    return unlit(np.column_stack([xy, xy @ [slope_x, slope_y] + height]), QUAD, color)


def planes(size: int, alike: bool = False) -> Scene:
    """Two cards, larger than the image, whose slopes are of opposite signs or of one."""
    slopes = ((0.9, 0.35), (0.3, -0.1)) if alike else ((0.35, 0.2), (-0.3, -0.15))
    parts = [plane(*s, h, c) for s, h, c in zip(slopes, (0.02, 0.0), PLANE_COLORS, strict=True)]
    rise = float(np.linalg.norm(np.subtract(*slopes))) * pixel(DISTANCE, size)
    return Scene(
        "planes of like slopes" if alike else "planes",
        (size, size),
        tuple(parts),
        (nearer(rise), None),
        (2, 4),
        "two planes that cross, " + ("both turned the same way" if alike else "turned apart") + "; one comes nearer",
    )


def spheres_in_depth(size: int) -> Scene:
    return Scene(
        "spheres in depth",
        (size, size),
        scene_shapes.crossing_spheres(),
        (None, nearer(pixel(DISTANCE - 0.1, size))),
        (2, 4),
        "two spheres that pass through one another, unculled; one comes nearer",
    )


def box_through_plane(size: int, sideways: bool = False) -> Scene:
    """A turned box of which a half is behind a slanted plane."""
    vertices, faces = box((-0.55, -0.45, -0.5), (0.55, 0.45, 0.5))
    part = unlit(vertices @ rotation_xy(0.5, 0.6).T + [0.03, -0.02, 0.1], faces, PLANE_COLORS[1])
    return Scene(
        "box through plane" if sideways else "box through plane in depth",
        (size, size),
        (part, plane(0.25, -0.3, 0.05, PLANE_COLORS[0])),
        (motion(DISTANCE, size) if sideways else nearer(pixel(DISTANCE, size)), None),
        (2, 4),
        "a closed, unculled box that a plane cuts; the box " + ("moves" if sideways else "comes nearer"),
    )


def bar_through_card(size: int) -> Scene:
    vertices, faces = box((-0.9, -0.12, -0.12), (0.9, 0.12, 0.12))
    bar = unlit(vertices @ rotation_xy(0.2, 0.7).T, faces, PLANE_COLORS[1])
    return Scene(
        "bar through card",
        (size, size),
        (bar, plane(-0.2, 0.15, 0.01, PLANE_COLORS[0], half=0.7)),
        (turn(size, 2.0), None),
        (2, 4),
        "a bar that goes through a card turns about +y, two pixels at distance 1 from the axis",
        1.0,
    )


def plate(size: int, cull: str = "none") -> Scene:
    """A thin closed plate: beside the line its back lies between the two sheets."""
    vertices, faces = box((-0.7, -0.7, -0.001), (0.7, 0.7, 0.001))
    part = unlit(vertices @ rotation_xy(0.15, 0.35).T, faces, PLANE_COLORS[1], cull)
    return Scene(
        "thin plate" if cull == "none" else "thin plate, culled",
        (size, size),
        (part, plane(0.3, 0.15, 0.02, PLANE_COLORS[0])),
        (nearer(0.5 * pixel(DISTANCE, size)), None),
        (2, 4),
        f"a closed plate, 700 times as wide as it is thick, through a plane comes nearer; cull {cull}",
    )


def nearly_one(size: int) -> Scene:
    """Over a pixel the depths of the planes differ by less than rounding may."""
    slopes = (0.3, 0.1), (0.27, 0.08)
    parts = [plane(*s, h, c) for s, h, c in zip(slopes, (0.002, 0.0), PLANE_COLORS, strict=True)]
    rise = float(np.linalg.norm(np.subtract(*slopes))) * pixel(DISTANCE, size)
    note = "two planes that cross at two degrees; one comes nearer"
    return Scene("planes at two degrees", (size, size), tuple(parts), (nearer(rise), None), (2, 4), note)


def three_planes(size: int) -> Scene:
    angles, colors = np.radians([20, 145, 260]), (*PLANE_COLORS, (0.3, 0.8, 0.4))
    parts = [plane(0.4 * np.cos(a), 0.4 * np.sin(a), 0.01, c) for a, c in zip(angles, colors, strict=True)]
    moves = nearer(0.7 * pixel(DISTANCE, size)), None, None
    note = "three planes that meet in a point; one comes nearer"
    return Scene("three planes", (size, size), tuple(parts), moves, (2, 4), note)


CROSSING = {
    "planes": planes,
    "planes of like slopes": lambda size: planes(size, alike=True),
    "spheres in depth": spheres_in_depth,
    "box through plane in depth": box_through_plane,
    "box through plane": lambda size: box_through_plane(size, sideways=True),
    "bar through card": bar_through_card,
    "thin plate": plate,
    "thin plate, culled": lambda size: plate(size, "back"),
    "planes at two degrees": nearly_one,
    "three planes": three_planes,
}
