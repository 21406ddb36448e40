"""The scenes whose image derivatives are compared: parts as a function of one parameter t, in pixels of motion.

Colours are unlit, the background is black, the camera is that of all benchmarks. What moves goes along +x, at t = 1 by
one pixel at its own depth, unless the note says otherwise.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

import rts
from benchmarks.camera import DISTANCE, camera, regular_grid
from benchmarks.meshes import DATA, mesh, rotation_xy
from rts.plugin_api.arrays import constants, exemplar
from rts_compare import moving_scenes, scene_shapes
from rts_compare.scene_shapes import CARD_DEPTH, grid, on_screen, pixel, rectangle
from rts_compare.true_derivatives import SAMPLES, Truth, area_image, lattice, truth
from rts_diagnostics.example_shapes import QUAD, box, icosphere, unlit

SIZE = 256
MOTION = "motion"
"""The only mode of a scene here."""


def grids(samples: int) -> tuple[np.ndarray, np.ndarray]:
    """Two grids of points of a pixel that have nothing in common: a regular one, and a lattice."""
    return regular_grid(samples), lattice(samples)


@dataclass(frozen=True)
class Scene:
    """Parts that move with t.

    Attributes:
        name: of the scene.
        size: (height, width).
        rest: the parts at t = 0, NumPy, without transforms.
        directions: for each part the (4, 4) derivative of its transform in t, or None where it rests.
        layers: the numbers of layers K to try: the fewest that may do, and more.
        note: what moves, and what is hard about it.
        step: in t, of the difference that stands for the derivative; where outlines hardly move, a small one is noise.
    """

    name: str
    size: tuple[int, int]
    rest: tuple[rts.Part, ...]
    directions: tuple[np.ndarray | None, ...]
    layers: tuple[int, ...]
    note: str
    step: float = 0.25

    @property
    def camera(self) -> rts.Camera:
        return camera()

    @property
    def moving(self) -> moving_scenes.Scene:
        """The scene as it is measured, with `MOTION` for its only mode."""
        still, unit = {"t": np.zeros(())}, {"t": np.ones(())}
        return moving_scenes.Scene(
            self.name, lambda p: (self.at(p["t"]), self.camera), still, {MOTION: unit}, self.size, self.note
        )

    def truth(self, folder: Path, step: float = 1.0) -> Truth:
        """The image's true change with t, by differences over a step; kept in a folder."""
        return truth(self.moving, MOTION, 1.0, samples=SAMPLES, step=step, grids=grids, folder=folder)

    def image(self) -> np.ndarray:
        """The image (H, W, 3) at rest, area-sampled."""
        return area_image(self.at(0.0), self.camera, self.size, regular_grid(SAMPLES))[..., :3]

    def at(self, t: Any) -> list[rts.Part]:
        """The parts at t: a number, or a scalar of torch or jax, in which they are then differentiable."""
        engine, like = rts.engine_of(t), exemplar(t)
        parts = []
        for part, direction in zip(self.rest, self.directions, strict=True):
            if direction is not None:
                eye, direction = constants((np.eye(4), direction), engine, like)
                part = part.replace(transform=eye + t * direction)
            parts.append(part)
        return parts


def motion(depth: float, size: int, sign: float = 1.0) -> np.ndarray:
    """Derivative (4, 4) of a motion along +x by one pixel at a depth."""
    matrix = np.zeros((4, 4))
    matrix[0, 3] = sign * pixel(depth, size)
    return matrix


def turn(size: int, pixels: float = 1.0) -> np.ndarray:
    """Derivative (4, 4) of a turn about +y, by pixels at distance 1 from the axis; linear in t, as all motions."""
    matrix = np.zeros((4, 4))
    matrix[0, 2], matrix[2, 0] = pixels * pixel(DISTANCE, size), -pixels * pixel(DISTANCE, size)
    return matrix


@cache
def _bunny_and_square() -> tuple[rts.Part, rts.Part]:
    return scene_shapes.bunny_and_square(*mesh("bunny"))


def bunny_over_black(size: int, cull: str = "back") -> Scene:
    bunny = _bunny_and_square()[0].replace(cull=cull)
    return Scene(
        "A" if cull == "back" else "A unculled",
        (size, size),
        (bunny,),
        (motion(DISTANCE, size),),
        (1, 2) if cull == "back" else (2, 4),
        f"the bunny moves over black; cull {cull}",
    )


def square_behind_bunny(size: int, cull: str = "back") -> Scene:
    parts = tuple(p.replace(cull=cull) for p in _bunny_and_square())
    return Scene(
        "B" if cull == "back" else "B unculled",
        (size, size),
        parts,
        (None, motion(CARD_DEPTH, size)),
        (1, 2) if cull == "back" else (2, 4),
        f"the square moves behind the bunny; cull {cull}",
    )


def bunny_before_square(size: int, cull: str = "back") -> Scene:
    parts = tuple(p.replace(cull=cull) for p in _bunny_and_square())
    return Scene(
        "C" if cull == "back" else "C unculled",
        (size, size),
        parts,
        (motion(DISTANCE, size), None),
        (1, 2) if cull == "back" else (2, 4),
        f"the bunny moves before the square; cull {cull}",
    )


BOX = tuple(i / 256 for i in (88.3, 81.9, 159.4, 168.7))
"""Left, top, right and bottom of the box's front face, share of the image's side; at 256 off pixel boundaries."""
CARD = tuple(i / 256 for i in (43.6, 64.4, 129.2, 222.8))
"""Left, top, right and bottom of the card; its right edge passes behind the box."""
BOX_FRONT, BOX_BACK = 2.9, 3.6
BOX_COLOR, CARD_COLOR = (0.2, 0.5, 0.9), (0.9, 0.3, 0.1)


def box_over_card(size: int, moves: str = "box") -> Scene:
    """The box is seen from straight in front: its outline is its front face, so the derivative has a closed form."""
    front = rectangle(*(size * i for i in BOX), BOX_FRONT, size)
    vertices, faces = box([*front[0, :2], DISTANCE - BOX_BACK], front[2])
    return Scene(
        "box over card" if moves == "box" else "card behind box",
        (size, size),
        (
            unlit(vertices, faces, BOX_COLOR),
            unlit(rectangle(*(size * i for i in CARD), CARD_DEPTH, size), QUAD, CARD_COLOR),
        ),
        (motion(BOX_FRONT, size), None) if moves == "box" else (None, motion(CARD_DEPTH, size)),
        (2, 4),
        f"a closed, unculled box before a card, edges upright; the {moves} moves",
    )


def turned_box(size: int) -> Scene:
    return Scene(
        "turned box",
        (size, size),
        scene_shapes.turned_box(),
        (motion(DISTANCE, size), None),
        (2, 4),
        "a closed, unculled box with a colour a face moves before a card with a pattern",
    )


def cards(size: int, count: int, alternating: bool = False) -> Scene:
    """Open cards: one in the middle moves, or neighbours in depth in opposite directions."""
    parts, depths = scene_shapes.cards(count)
    if alternating:
        directions = [motion(depth, size, (-1) ** i) for i, depth in enumerate(depths)]
    else:
        directions = [motion(depth, size) if i == count // 2 else None for i, depth in enumerate(depths)]
    return Scene(
        f"{count} cards" + (", alternating" if alternating else ""),
        (size, size),
        tuple(parts),
        tuple(directions),
        (2, 4, count),
        "overlapping open cards; "
        + ("neighbours in depth move in opposite directions" if alternating else "one in the middle moves"),
    )


def sheet(size: int) -> Scene:
    """A sheet in waves, twisted until it shows both of its sides, before a card with a pattern."""
    uv, faces = grid(96, 48)
    along, across, angle = 0.95 * uv[:, 0], 0.6 * uv[:, 1], 2.2 * uv[:, 0] + 1.3
    bulge = 0.12 * np.sin(5.5 * uv[:, 0] + 2.0 * uv[:, 1])
    twisted = np.column_stack([np.cos(angle) * across - np.sin(angle) * bulge, -along])
    wave = np.column_stack([twisted, np.sin(angle) * across + np.cos(angle) * bulge])
    colors = 0.5 + 0.45 * np.column_stack(
        [np.sin(6 * uv[:, 0]), np.cos(4 * uv[:, 0] + 2), -np.sin(3 * uv[:, 0] + uv[:, 1])]
    )
    back, order = grid(32, 32)
    card = np.column_stack([1.0 * back, np.full(len(back), DISTANCE - CARD_DEPTH)])
    waves = 0.5 + 0.4 * np.column_stack([np.sin(7 * back[:, 0]), np.sin(6 * back[:, 1] + 1), np.cos(5 * back.sum(1))])
    return Scene(
        "sheet",
        (size, size),
        (unlit(wave @ rotation_xy(0.15, 0.2).T, faces, colors), unlit(card, order, waves)),
        (motion(DISTANCE, size), None),
        (2, 4),
        "an open wavy sheet seen from both sides, its colours change along it, moves before a card with a pattern",
    )


def wires(size: int, width: float) -> Scene:
    return Scene(
        f"wires {width:g} px",
        (size, size),
        (scene_shapes.wires(size, [width] * 7),),
        (motion(DISTANCE, size),),
        (1, 2),
        f"seven slanted wires, {width:g} pixels wide, move over black",
    )


def spheres(size: int) -> Scene:
    return Scene(
        "spheres",
        (size, size),
        scene_shapes.crossing_spheres(),
        (None, motion(DISTANCE - 0.1, size)),
        (2, 4),
        "two spheres that pass through one another, unculled; the nearer moves",
    )


@cache
def _spot() -> rts.Part:
    return scene_shapes.textured_spot(DATA / "meshes" / "spot")


def spot(size: int, turns: bool = False) -> Scene:
    return Scene(
        "spot turns" if turns else "spot",
        (size, size),
        (_spot(),),
        (turn(size) if turns else motion(DISTANCE, size),),
        (1, 2),
        "textured spot, culled, " + ("turns about +y, a pixel at distance 1 from the axis" if turns else "moves"),
        1.0 if turns else 0.25,
    )


def bunny_turns(size: int, cull: str = "back") -> Scene:
    return Scene(
        "bunny turns" if cull == "back" else "bunny turns unculled",
        (size, size),
        (_bunny_and_square()[0].replace(cull=cull),),
        (turn(size),),
        (1, 2) if cull == "back" else (2, 4),
        f"the bunny turns about +y, a pixel at distance 1 from the axis; cull {cull}",
        1.0,
    )


def teapot_turns(size: int) -> Scene:
    """The teapot is open, and its parts pass through one another."""
    vertices, faces = mesh("teapot")
    return Scene(
        "teapot turns",
        (size, size),
        (scene_shapes.bunny_and_square(vertices, faces)[0],),
        (turn(size),),
        (2, 4),
        "the teapot, unculled, turns about +y, a pixel at distance 1 from the axis",
        1.0,
    )


FINGER_PLACE, FINGER_RADII, KNUCKLE = (0.1, -0.05, 1.05), (0.3, 0.14, 0.14), (0.36, -0.05, 0.91)


def finger_turns(size: int) -> Scene:
    """Most of the finger's outline is before the face."""
    vertices, faces = icosphere(6)
    away = np.eye(4)
    away[:3, 3] = -np.array(KNUCKLE)
    return Scene(
        "finger turns",
        (size, size),
        (
            unlit(SPHERE_RADIUS * vertices, faces, 0.5 + 0.3 * np.sin(4 * vertices)),
            unlit(vertices * FINGER_RADII @ rotation_xy(0.0, 0.5).T + FINGER_PLACE, faces, SPHERE_COLOR),
        ),
        (None, turn(size, 2.0) @ away),
        (2, 4),
        "a finger before a face, unculled: an ellipsoid turns about one of its ends before a sphere",
        1.0,
    )


SPHERE_RADIUS, SPHERE_COLOR = 0.7, (0.9, 0.7, 0.2)


def sphere(size: int, pixels: float = 0.0) -> Scene:
    """A turn about the centre, by pixels at distance 1, leaves the image of a sphere as it is."""
    vertices, faces = icosphere(6)
    return Scene(
        {0.0: "sphere", 2.0: "sphere rolls", -2.0: "sphere rolls back"}[pixels],
        (size, size),
        (unlit(SPHERE_RADIUS * vertices, faces, SPHERE_COLOR),),
        (motion(DISTANCE, size) + turn(size, pixels),),
        (1, 2),
        "a closed, unculled sphere in one colour moves over black"
        + (f", and turns by {pixels:g} pixels at distance 1 from its axis" if pixels else ""),
    )


def textured_sphere_turns(size: int) -> Scene:
    vertices, faces = icosphere(6)
    colors = 0.5 + 0.4 * np.sin(vertices @ np.array([[5.0, 1.0, -3.0], [2.0, 6.0, 1.0], [-4.0, 2.0, 5.0]]))
    return Scene(
        "textured sphere turns",
        (size, size),
        (unlit(SPHERE_RADIUS * vertices, faces, colors),),
        (turn(size),),
        (1, 2),
        "a closed, unculled sphere turns; its colours change along it and its outline stands still",
        1.0,
    )


EDGE, EDGE_COLOR = 0.5014140625, (0.9, 0.5, 0.2)  # The edge, share of the image's width: not on a pixel's boundary.


def half_plane(size: int) -> Scene:
    card = rectangle(-size, -size, EDGE * size, 2 * size, DISTANCE, size)
    return Scene(
        "half-plane",
        (size, size),
        (unlit(card, QUAD, EDGE_COLOR),),
        (motion(DISTANCE, size),),
        (1, 2),
        "the right edge of a card that covers the left half of the image, upright, moves",
    )


DISK_CENTER, DISK_RADIUS, DISK_COLOR = (0.4823, 0.5141), 0.1462, (0.3, 0.9, 0.6)


def disk(size: int) -> Scene:
    angle = np.linspace(0, 2 * np.pi, 4096, endpoint=False)
    rim = size * (np.array(DISK_CENTER) + DISK_RADIUS * np.column_stack([np.cos(angle), np.sin(angle)]))
    xy = np.concatenate([[size * np.array(DISK_CENTER)], rim])
    index = 1 + np.arange(4096)
    return Scene(
        "disk",
        (size, size),
        (unlit(on_screen(xy, DISTANCE, size), np.column_stack([0 * index, np.roll(index, -1), index]), DISK_COLOR),),
        (motion(DISTANCE, size),),
        (1, 2),
        "a flat disk moves over black",
    )


RAMP_SLOPE, RAMP_SLOPE_Y = np.array([1.0, -0.5, 0.25]), np.array([0.0, 0.1, -0.4])
"""Change of colour over the width and the height of the image."""


def ramp(size: int) -> Scene:
    card = rectangle(-size, -size, 2 * size, 2 * size, DISTANCE, size)
    share = np.array([[-1, 2], [2, 2], [2, -1], [-1, -1]])
    colors = 0.5 + (share[:, :1] - 0.5) * RAMP_SLOPE + (share[:, 1:] - 0.5) * RAMP_SLOPE_Y
    return Scene(
        "ramp",
        (size, size),
        (unlit(card, QUAD, colors),),
        (motion(DISTANCE, size),),
        (1, 2),
        "a card whose colours are linear, larger than the image, moves",
    )


SCENES: dict[str, Callable[[int], Scene]] = {
    "A": bunny_over_black,
    "B": square_behind_bunny,
    "C": bunny_before_square,
    "A unculled": lambda size: bunny_over_black(size, "none"),
    "B unculled": lambda size: square_behind_bunny(size, "none"),
    "C unculled": lambda size: bunny_before_square(size, "none"),
    "box over card": box_over_card,
    "card behind box": lambda size: box_over_card(size, "card"),
    "turned box": turned_box,
    "6 cards": lambda size: cards(size, 6),
    "8 cards": lambda size: cards(size, 8),
    "6 cards, alternating": lambda size: cards(size, 6, alternating=True),
    "8 cards, alternating": lambda size: cards(size, 8, alternating=True),
    "sheet": sheet,
    **{f"wires {w:g} px": (lambda size, w=w: wires(size, w)) for w in (0.3, 0.5, 1.0, 2.0)},
    "spheres": spheres,
    "spot": spot,
    "spot turns": lambda size: spot(size, turns=True),
    "bunny turns": bunny_turns,
    "bunny turns unculled": lambda size: bunny_turns(size, "none"),
    "teapot turns": teapot_turns,
    "finger turns": finger_turns,
    "sphere": sphere,
    "sphere rolls": lambda size: sphere(size, 2.0),
    "sphere rolls back": lambda size: sphere(size, -2.0),
    "textured sphere turns": textured_sphere_turns,
    "half-plane": half_plane,
    "disk": disk,
    "ramp": ramp,
}


def scene(name: str, size: int = SIZE) -> Scene:
    """A scene by name, for a square image."""
    return SCENES[name](size)
