"""Shapes of thin patches, each by its number, and the pixels of their pictures that lack the sheet in front."""

from typing import NamedTuple

import numpy as np
from helpers import rotation

import rts
from rts import Camera, Part

MESH, BEZIER, BSPLINE = (rts.plugin("surfaces", name) for name in ("mesh", "bezier", "bspline"))
KINDS = ("strips", "ring", "dome", "handle")
FINE, QUARTER = 9, 2
"""Cells along the side of a pixel that are looked at, and how many of them lie within a quarter of a pixel."""


class View(NamedTuple):
    """A part, a camera, and the size of the picture."""

    part: Part
    camera: Camera
    size: tuple[int, int]


def thin_patches(number, name="bezier"):
    """Patches of "bezier", "bspline" or "subdivision", most of them a tenth of a pixel to some pixels wide."""
    rng = np.random.default_rng(number)
    kind, size = KINDS[number % len(KINDS)], int(rng.choice([24, 48, 96]))
    pixel = 3 / size
    widths = pixel * 10 ** rng.uniform(-1, 0.7) * rng.uniform(0.5, 1.5, rng.integers(2, 12))
    a, b = np.r_[0, np.cumsum(widths)], np.linspace(0, 1, 5)
    bend, slope, wide = rng.uniform(0, 2), rng.uniform(-1, 1), a[-1]
    if kind == "ring":  # Two walls, and a thin rim between them.
        a = np.r_[-0.7, a, wide + 0.7]
    elif kind == "dome":  # Its top is a point.
        a = np.r_[a, wide + 0.8]
    elif kind == "handle":  # A thin tube, along an arc.
        a, b, wide = np.linspace(0, 1, 4), np.linspace(0, 1, rng.integers(5, 9)), pixel * 10 ** rng.uniform(-0.3, 0.7)

    def surface(a, b):
        turn = 2 * np.pi * b
        if kind == "strips":
            return a - wide / 2, 2 * b - 1, slope * a + bend * 0.2 * wide * np.sin(6 * a / wide + 3 * b)
        if kind == "dome":
            return a * np.cos(turn), a * np.sin(turn), slope * a - bend * a**2 / 2
        if kind == "handle":
            far = 0.8 + wide * np.cos(turn)
            return far * np.cos((1 + bend) * a), far * np.sin((1 + bend) * a), wide * np.sin(turn)
        over, beyond = np.pi * np.clip(a / wide, 0, 1), np.maximum(-a, 0) + np.maximum(a - wide, 0)
        radius = 0.9 - wide / np.pi * np.cos(over) - 0.3 * slope * beyond
        return radius * np.cos(turn), radius * np.sin(turn), (1 + bend) * wide / np.pi * np.sin(over) - beyond

    turn = rotation(rng.normal(size=3), rng.uniform(0, 360)).T
    crease = 0.1 * min(np.diff(a).min(), pixel) if rng.random() < 0.3 else 0.0
    made = _patches if name == "bezier" else _spline if name == "bspline" else _cage
    points, chosen = made(surface, a, b, kind, rng)
    points = (points + rng.normal(0, crease, points.shape)) @ turn
    camera = Camera.look_at((0, 0, 4), (0, 0, 0), fov_y=42)
    entry = "vertices" if name == "subdivision" else "points"
    return View(Part(chosen, {entry: points.astype(np.float32)}), camera, (size, size))


def _patches(surface, a, b, kind, rng):
    """Control points (m, 3) and Bézier patches that pass through a surface at thirds of their sides, turned anyhow."""
    thirds, third = np.arange(4) / 3, np.arange(4)
    weights = np.stack([(1 - thirds) ** 3, 3 * thirds * (1 - thirds) ** 2, 3 * thirds**2 * (1 - thirds), thirds**3], -1)
    fine = [np.interp(np.arange(3 * len(x) - 2) / 3, np.arange(len(x)), x) for x in (a, b)]
    grid = np.stack(np.broadcast_arrays(*surface(fine[0][:, None], fine[1][None])), axis=-1)
    rows, columns = (3 * np.arange(len(x) - 1)[:, None] + third for x in (a, b))
    number = np.arange(grid[..., 0].size).reshape(grid.shape[:2])
    if kind != "strips":
        number[:, -1] = number[:, 0]
    if kind == "dome":
        number[0] = 0
    patches = (rows[:, None, :, None], columns[None, :, None, :])
    nets, table = grid[patches], number[patches].reshape(-1, 16)
    nets = np.einsum("ik,jl,mnklc->mnijc", *[np.linalg.inv(weights)] * 2, nets)
    points = np.zeros((grid[..., 0].size, 3))
    points[table] = nets.reshape(-1, 16, 3)
    mirrored = rng.random() < 0.5
    for n, net in enumerate(table.reshape(-1, 4, 4)):
        table[n] = np.rot90(net.T if mirrored else net, rng.integers(4)).reshape(-1)
    return points, BEZIER(table)


def _grid(surface, a, b, kind):
    """Points (A, B, 3) of a surface; those of a closed one once."""
    b = np.linspace(b[0], b[-1], 2 * len(b))
    return np.stack(np.broadcast_arrays(*surface(a[:, None], b[None, : None if kind == "strips" else -1])), axis=-1)


def _spline(surface, a, b, kind, rng):
    grid = _grid(surface, np.r_[a[0], a[0], a, a[-1]] if len(a) < 4 else a, b, kind)
    return grid, BSPLINE(grid.shape[:2], ("clamped", "clamped" if kind == "strips" else "periodic"))


def _cage(surface, a, b, kind, rng):
    grid = _grid(surface, a, b, kind)
    rows, columns = grid.shape[:2]
    number = np.arange(rows * columns).reshape(rows, columns)
    number = number if kind == "strips" else np.c_[number, number[:, :1]]
    if kind == "dome":
        number[0] = 0
    corners = np.stack([number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]], axis=-1).reshape(-1, 4)
    faces = [list(dict.fromkeys(face)) for face in corners.tolist()]
    return grid.reshape(-1, 3), rts.plugin("surfaces", "subdivision")(faces)


def lacking(view, samples):
    """Pixels (H, W) that lack the sheet in front, and the number of pixels where this can be decided.

    A mesh of fine triangles decides, unless an outline is within a quarter of a pixel.
    """
    part, camera, size = view
    spread = camera.for_size(size).spread(size)
    vertices, faces = part.surface.tessellate(part.theta, 0.01 * float(spread[0] + 4 * spread[1]))
    mesh = Part(MESH(faces), {"vertices": vertices})
    fine = _fronts(rts.sample(mesh, camera, (FINE * size[0], FINE * size[1]), layers=1, splatter=None), FINE * size[0])
    cells = fine.reshape(size[0], FINE, size[1], FINE).transpose(0, 2, 1, 3)
    inner = slice(FINE // 2 - QUARTER, FINE // 2 + QUARTER + 1)
    cells = cells[:, :, inner, inner]
    with np.errstate(invalid="ignore"):
        bends = [np.abs(np.diff(cells, 2, axis=axis)).max(axis=(2, 3)) for axis in (2, 3)]
        pixel = spread[0] + spread[1] * cells[:, :, QUARTER, QUARTER]
        known = np.maximum(*bends) < 0.3 * pixel
        fronts = _fronts(samples, size[0])
        off = np.abs(fronts - cells[:, :, QUARTER, QUARTER]) > np.ptp(cells, axis=(2, 3)) + 0.3 * pixel
    return known & (np.isnan(fronts) | off), int(known.sum())


def _fronts(samples, height):
    """Depths (H, W) of the samples in front, without the border; NaN where there is none."""
    border = (samples.row.shape[1] - height) // 2
    depth = np.where(samples.row[0] >= 0, samples.depth[0], np.nan).astype(np.float64)
    return depth[border : depth.shape[0] - border, border : depth.shape[1] - border]
