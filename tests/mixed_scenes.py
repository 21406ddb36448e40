"""Scenes of opaque and translucent parts, each by its number: tubes, soups and panes, in images of 5 to 40 pixels."""

from typing import Any, NamedTuple

import numpy as np
from helpers import rigid

import rts

AWKWARD = 10_000
"""From this number on, half of the cameras are among the parts, half of the parts that let light through have vertices
with an alpha of exactly 1, and half of the scenes have a part that begins at an edge of another one."""

UNLIT = rts.plugin("shaders", "unlit")
MESH = rts.plugin("surfaces", "mesh")


class Mixed(NamedTuple):
    """A scene, and how to look at it.

    Attributes:
        parts: NumPy float64, with `colors` (V, 4); alpha counts where the shader is not opaque.
        cameras: two views.
        size: (height, width) of each.
        layers: K, or "auto".
        supersample: as in `rts.render`.
        poses: True if poses of the parts move, and their vertices are constants; False if vertices and colours move.
    """

    parts: list[rts.Part]
    cameras: list[rts.Camera]
    size: tuple[int, int]
    layers: Any
    supersample: Any
    poses: bool

    @property
    def translucent(self):
        """True if some part lets light through."""
        return not all(part.shader.opaque for part in self.parts)


def mixed_of(number):
    """The scene of a number. Every fourth is opaque; of every ten two are of few triangles. See `AWKWARD`."""
    rng = np.random.default_rng(number)
    small = number % 5 == 0
    size = tuple(int(n) for n in np.round(5 * 8 ** rng.random(2)))
    opaque = _opaque(rng, int(rng.integers(2, 5)), number)
    parts = [_part(rng, x, small) for x in opaque]
    cameras = [_camera(rng, size) for _ in range(2)]
    layers = [2, 3, 2, 3, 1, 4, "auto", 6][rng.integers(8)]
    supersample = [1, 1, 1, 2, 2, 2, 3][rng.integers(7)]
    poses = rng.random() < 0.3
    if number >= AWKWARD:
        parts, cameras = _awkward(rng, parts, cameras, size)
    return Mixed(parts, cameras, size, layers, supersample, poses)


def _awkward(rng, parts, cameras, size):
    """The parts and cameras of a scene, made awkward; see `AWKWARD`."""
    for part in parts:
        if not part.shader.opaque and rng.random() < 0.5:
            alpha = part.theta["colors"][:, 3]
            alpha[rng.random(len(alpha)) < rng.choice([0.5, 1.0])] = 1.0
    if rng.random() < 0.5:
        parts = [*parts, _neighbour(rng, parts[-1])]
    inside = [rng.random() < 0.5 for _ in cameras]
    cameras = [_inner_camera(rng, size) if within else c for within, c in zip(inside, cameras, strict=True)]
    return parts, cameras


def _neighbour(rng, part):
    """A triangle that shares an edge with the first one of a part."""
    vertices = part.theta["vertices"][part.surface.faces[0]]
    vertices[2] = rng.uniform(-1, 1, 3)
    theta = {
        "vertices": vertices,
        "colors": rng.random((3, 4)) * [1, 1, 1, 0] + part.theta["colors"][:3] * [0, 0, 0, 1],
    }
    return part.replace(surface=MESH(np.array([(0, 1, 2)], np.int32)), theta=theta)


def _inner_camera(rng, size):
    """A camera among the parts, which may cut some of them with its near plane."""
    options = {"aspect": size[1] / size[0], "near": 0.1, "far": 20.0}
    eye = 0.5 * rng.normal(size=3)
    return rts.Camera.look_at(eye, eye + rng.normal(size=3), rng.normal(size=3), fov_y=rng.uniform(40, 90), **options)


def _opaque(rng, count, number):
    """Which of the parts are opaque: all in every fourth scene, some but not all in others."""
    opaque = np.ones(count, bool)
    if number % 4 != 3:
        opaque[rng.permutation(count)[: rng.integers(1, count)]] = False
    return opaque


def _part(rng, opaque, small):
    vertices, faces = _few(rng) if small else [_soup, _tube, _pane][rng.integers(3)](rng)
    alpha = np.ones(len(vertices)) if opaque else rng.uniform(0.1, 1, len(vertices) if rng.random() < 0.5 else 1)
    colors = rng.random((len(vertices), 4))
    colors[:, 3] = alpha
    theta = {"vertices": vertices, "colors": colors}
    return rts.Part(MESH(faces), theta, UNLIT(opaque=bool(opaque)), cull="back" if rng.random() < 0.25 else "none")


def _few(rng):
    """One or two large triangles, near the middle, which often cross others."""
    count = rng.integers(1, 3)
    return _triangles(0.3 * rng.normal(size=(count, 1, 3)) + rng.normal(size=(count, 3, 3)))


def _soup(rng):
    count, size = rng.integers(2, 12), rng.uniform(0.2, 0.9)
    return _triangles(rng.uniform(-0.8, 0.8, (count, 1, 3)) + size * rng.normal(size=(count, 3, 3)))


def _triangles(corners):
    return corners.reshape(-1, 3), np.arange(corners.size // 3, dtype=np.int32).reshape(-1, 3)


def _tube(rng):
    """A prism, open or closed at its ends, turned anyhow."""
    sides, radius, half = int(rng.integers(3, 9)), rng.uniform(0.1, 0.7), rng.uniform(0.3, 1.2)
    turn, i = 2 * np.pi * np.arange(sides) / sides, np.arange(sides)
    ring = radius * np.stack([np.cos(turn), np.sin(turn), 0 * turn], 1)
    vertices = np.concatenate([ring - [0, 0, half], ring + [0, 0, half]])
    j = (i + 1) % sides
    faces = [np.stack(t, 1) for t in ((i, j, j + sides), (i, j + sides, i + sides))]
    if rng.random() < 0.5:
        k = i[1:-1]
        faces += [np.stack(t, 1) for t in ((0 * k, k + 1, k), (0 * k + sides, k + sides, k + 1 + sides))]
    return _turned(rng, vertices), np.concatenate(faces).astype(np.int32)


def _pane(rng):
    """A rectangle."""
    corners = np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)]) * [*rng.uniform(0.3, 1.3, 2), 1]
    return _turned(rng, corners), np.array([(0, 1, 2), (0, 2, 3)], np.int32)


def _turned(rng, points):
    move = rigid(rng.normal(size=3), rng.uniform(-180, 180), 0.4 * rng.normal(size=3))
    return points @ move[:3, :3].T + move[:3, 3]


def _camera(rng, size):
    way = rng.normal(size=3)
    eye, up = rng.uniform(3, 6) * way / np.linalg.norm(way), rng.normal(size=3)
    options = {"aspect": size[1] / size[0], "near": 0.1, "far": 20.0}
    if rng.random() < 0.25:
        return rts.Camera.orthographic(eye, 0.2 * rng.normal(size=3), up, height=3.0, **options)
    return rts.Camera.look_at(eye, 0.2 * rng.normal(size=3), up, fov_y=rng.uniform(25, 50), **options)
