"""Outlines under motions that are no shifts: bodies that turn about their axis, thicken, come nearer, twist.

Derivative images by `edges` and by `multi`, beside differences of area-sampled images over a pixel:

    python -m benchmarks.accuracy.other_motions
"""

from __future__ import annotations

import argparse
from typing import Any, NamedTuple

import numpy as np
import torch

import rts
from benchmarks.accuracy.scenes import DISTANCE, grids, pixel
from benchmarks.camera import camera, supersampled
from benchmarks.meshes import mesh, rotation_xy
from benchmarks.report import table
from rts_compare.builtin_scenes import VASE_HEIGHTS, VASE_RADII
from rts_compare.derivative_scores import all_scores
from rts_diagnostics.example_shapes import icosphere
from rts_diagnostics.smoothing import low_pass

SIZE, POINTS = 256, 8
"""Pixels, and points of a pixel along x and y in each of the truth's two grids."""
METHODS: dict[str, dict[str, Any]] = {
    "multi": {"splatter": "multi", "layers": 2},
    "edges": {"splatter": "edges", "layers": 1},
}
"""Options of `rts.render`."""
UP = np.array([0.0, 1.0, 0.0])
TILT = (0.45, 0.3)
"""Turns of the vase about x and y, radians."""


class Motion(NamedTuple):
    """Vertices (V, 3) and faces (T, 3) of a body, velocities (V, 3), and whether its outline stands still."""

    vertices: np.ndarray
    faces: np.ndarray
    velocity: np.ndarray
    still: bool = False


def motions() -> dict[str, Motion]:
    """By name; velocities are a pixel or a few, a unit of t."""
    step, (points, triangles), (bunny, bunny_faces) = pixel(DISTANCE, SIZE), icosphere(6), mesh("bunny")
    vase_vertices, vase_faces = vase()
    heights = np.linspace(-0.8, 0.8, 200)
    tube, tube_faces = around_axis(0.3 + 0.05 * np.sin(5 * heights), heights, 96)
    outwards = tube * (1, 0, 1) / np.linalg.norm(tube * (1, 0, 1), axis=1, keepdims=True)
    tilt = rotation_xy(0.5, 0.3) @ rts.Camera.look_at((0, 0, 1), (0, 0, 0), up=(0.56, 0.83, 0)).view[:3, :3]
    long = points * (0.35, 0.8, 0.25) @ rotation_xy(0.3, 0.2).T
    flat = points * (0.8, 0.5, 0.08) @ rotation_xy(0.4, 0.5).T
    return {
        "vase turns about its axis": Motion(
            vase_vertices, vase_faces, step * np.cross(rotation_xy(*TILT)[:, 1], vase_vertices), still=True
        ),
        "tube thickens": Motion(tube @ tilt.T, tube_faces, step * outwards @ tilt.T),
        "bunny comes nearer": Motion(bunny, bunny_faces, np.broadcast_to((0.0, 0.0, 2 * step), bunny.shape)),
        "bunny twists": Motion(bunny, bunny_faces, 2 * step * bunny[:, 1:2] * np.cross(UP, bunny)),
        "ellipsoid twists": Motion(long, triangles, 3 * step * long[:, 1:2] * np.cross(UP, long)),
        "flat ellipsoid turns": Motion(flat, triangles, step * np.cross(UP, flat)),
        "flat ellipsoid turns, fast": Motion(flat, triangles, 4 * step * np.cross(UP, flat)),
    }


def vase() -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) and faces (T, 3) of a vase that is closed above, tilted."""
    from scipy.interpolate import BSpline

    count, degree = 64, 3
    ends = len(VASE_RADII) - degree
    spline = BSpline(
        np.clip(np.arange(len(VASE_RADII) + degree + 1) - degree, 0, ends),
        np.stack([VASE_RADII, VASE_HEIGHTS], axis=-1),
        degree,
    )
    profile = spline(np.linspace(0, ends, count - 1))
    radius, height = np.concatenate([profile, [[0.0, profile[-1, 1]]]]).T
    vertices, faces = around_axis(radius, height, 96)
    return vertices @ rotation_xy(*TILT).T, faces


def around_axis(radius: np.ndarray, height: np.ndarray, around: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) and faces (T, 3) that a profile, from below, sweeps around the y axis."""
    angle, count = 2 * np.pi * np.arange(around) / around, len(radius)
    x, z = radius[:, None] * np.cos(angle), radius[:, None] * np.sin(angle)
    vertices = np.stack([x, np.broadcast_to(height[:, None], x.shape), z], axis=-1).reshape(-1, 3)
    i, j = np.meshgrid(np.arange(count - 1), np.arange(around), indexing="ij")
    a, b = i * around + j, i * around + (j + 1) % around
    triangles = (a, a + around, b), (b, a + around, b + around)
    faces = np.concatenate([np.stack(t, axis=-1).reshape(-1, 3) for t in triangles])
    return vertices, faces.astype(np.int32)


class Body:
    """A body in one colour, not culled."""

    def __init__(self, motion: Motion):
        self.motion = motion
        self.surface = rts.plugin("rts.surfaces", "mesh")(motion.faces.astype(np.int32))
        self.colors = np.full((len(motion.vertices), 3), 0.8)

    def at(self, vertices) -> rts.Part:
        return rts.Part(self.surface, {"vertices": vertices, "colors": self.colors}, "unlit")

    def truth(self, velocity: np.ndarray) -> np.ndarray:
        """Difference of images (H, W, 3) half a unit of t before and after, the mean over two grids."""
        return np.mean(self.differences(velocity, 1.0, POINTS), axis=0)

    def differences(self, velocity: np.ndarray, step: float, points: int) -> list[np.ndarray]:
        """Differences of images (H, W, 3) over a step of t, per unit, by each of two grids."""
        ends = [self.at((self.motion.vertices + t * velocity).astype(np.float32)) for t in (-step / 2, step / 2)]
        images = [[supersampled(end, camera(), (SIZE, SIZE), grid)[..., :3] for end in ends] for grid in grids(points)]
        return [(after - before) / step for before, after in images]

    def forward(self, **options: Any) -> np.ndarray:
        """(H, W, 3) by forward mode."""
        start, velocity = (torch.tensor(x, dtype=torch.float32) for x in (self.motion.vertices, self.motion.velocity))

        def image(t: torch.Tensor) -> torch.Tensor:
            return rts.render(self.at(start + t * velocity), camera(), (SIZE, SIZE), **options)[..., :3]

        return torch.func.jvp(image, (torch.zeros(()),), (torch.ones(()),))[1].numpy()


def cells(motion: Motion) -> list[str]:
    """Low-passed relative L2, gain and error of random losses by each method.

    Where the outline stands still: the low-passed norm in that of the body moving by a pixel.
    """
    body = Body(motion)
    found = [body.forward(**how) for how in METHODS.values()]
    if motion.still:
        whole = body.truth(np.broadcast_to((pixel(DISTANCE, SIZE), 0.0, 0.0), motion.vertices.shape))
        unit = np.linalg.norm(low_pass(whole))
        return [f"{np.linalg.norm(low_pass(x)) / unit:.3f} of a pixel" for x in found]
    true = body.truth(motion.velocity)
    rows = [all_scores(x, true) for x in found]
    return [f"{r['low_relative_l2']:.3f} / {r['low_gain']:.3f} / {r['loss_error']:.3f}" for r in rows]


def main() -> None:
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    print(table(["motion", *METHODS], ([name, *cells(motion)] for name, motion in motions().items())))


if __name__ == "__main__":
    main()
