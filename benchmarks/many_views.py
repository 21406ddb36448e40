"""Shapes and textures from 24 pictures: chamfer, PSNR of views that are held out, time; and cameras that are off.

    python -m benchmarks.many_views
    python -m benchmarks.many_views --shapes bunny --quick --pictures out/

Needs the models of the folder that RTS_DATA names. A ball becomes spot, and the bunny, by `rts.LargeSteps`; colours are
those of vertices, with the light of the pictures in them.
"""

from __future__ import annotations

import argparse
import os
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import scipy.spatial
import torch
import trimesh

import rts

DATA = Path(os.environ.get("RTS_DATA", "../shared/data"))
LIGHT = {"direction": np.array([0.3, 0.8, 0.5], np.float32), "ambient": np.full(3, 0.35, np.float32)}
FOV = 40.0
CHAMFER_POINTS = 30_000


class Shape(NamedTuple):
    """A model, its views, and those that are held out."""

    part: rts.Part
    views: list[rts.View]
    held_out: list[rts.View]


def sphere(count: int, turn: float = 0.0) -> np.ndarray:
    """Directions (count, 3) spread evenly (Fibonacci)."""
    z = 1 - (2 * np.arange(count) + 1) / count
    angle = np.pi * (1 + 5**0.5) * np.arange(count) + turn
    return np.stack([np.cos(angle) * np.sqrt(1 - z * z), z, np.sin(angle) * np.sqrt(1 - z * z)], axis=1)


def shape(name: str, size: int, count: int) -> Shape:
    """Spot with its texture, or the bunny in a pattern of colours, within the unit ball, and pictures of it."""
    path = DATA / ("meshes/spot/spot_triangulated.obj" if name == "spot" else "meshes/bunny.obj")
    part = rts.load(path)[0]
    vertices = np.asarray(part.theta["vertices"], np.float64)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    vertices = (vertices - (low + high) / 2) / (np.linalg.norm(high - low) / 2)
    theta = {**part.theta, "vertices": vertices.astype(np.float32), "light": LIGHT}
    if name == "spot":
        theta["texture"] = rts.load_image(DATA / "meshes/spot/spot_texture.png")[..., :3]
    else:
        theta["colors"] = (0.5 + 0.35 * np.sin(9 * vertices + np.array([0, 2, 4]))).astype(np.float32)
    part = part.replace(theta=theta, shader="lambert")
    distance = 1.05 * np.linalg.norm(vertices, axis=1).max() / np.sin(np.radians(FOV / 2))
    return Shape(
        part,
        pictures(part, distance * sphere(count), size),
        pictures(part, distance * sphere(8, 1.0) * [1, -1, 1], size),
    )


def pictures(part: rts.Part, eyes: np.ndarray, size: int) -> list[rts.View]:
    """Pictures of a part from all around, 4 × 4 samples a pixel."""
    cameras = [rts.Camera.look_at(eye, (0, 0, 0), fov_y=FOV) for eye in eyes]
    return [
        rts.View(c, np.asarray(rts.render(part, c, (size, size), supersample=4)), name=f"{i}")
        for i, c in enumerate(cameras)
    ]


class Model(NamedTuple):
    """What is fitted: a ball's vertices by large steps, and their colours."""

    steps: rts.LargeSteps
    surface: Any

    def part(self, p: Any) -> rts.Part:
        """The part of parameters."""
        return rts.Part(self.surface, {"vertices": self.steps.decode(p["shape"]), "colors": p["colors"]}, "unlit")


def fitted(
    start: trimesh.Trimesh, colors: np.ndarray, shape: Shape, steps: int, batch: int, smoothness: float, rates: dict
) -> tuple[trimesh.Trimesh, np.ndarray, Any]:
    """The mesh and its colours after some steps."""
    large = rts.LargeSteps(start.faces, len(start.vertices), smoothness)
    model = Model(large, rts.Mesh(start.faces))
    p = {
        "shape": torch.tensor(np.asarray(large.encode(np.asarray(start.vertices, np.float32)))),
        "colors": torch.tensor(colors),
    }
    residuals = rts.ViewResiduals(model.part, shape.views, batch=batch)
    fit = rts.fit(residuals, p, steps=steps, learning_rate=rates, patience=10_000, validate_every=steps)
    vertices = large.decode(fit.parameters["shape"]).numpy()
    return trimesh.Trimesh(vertices, start.faces, process=False), fit.parameters["colors"].numpy(), fit


def finer(mesh: trimesh.Trimesh, colors: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices, faces and colours of a mesh with four faces for each."""
    both = np.concatenate([mesh.vertices, colors], axis=1)
    both, faces = trimesh.remesh.subdivide(both, mesh.faces)
    return both[:, :3], faces, both[:, 3:].astype(np.float32)


def chamfer(a: trimesh.Trimesh, b: trimesh.Trimesh) -> float:
    """The mean distance of points of each mesh to the other, over the diagonal of b's bounds."""
    p, q = (trimesh.sample.sample_surface(m, CHAMFER_POINTS, seed=0)[0] for m in (a, b))
    ways = scipy.spatial.cKDTree(p).query(q)[0].mean(), scipy.spatial.cKDTree(q).query(p)[0].mean()
    return float(sum(ways) / 2 / np.linalg.norm(b.bounds[1] - b.bounds[0]))


def psnr(part: rts.Part, views: list[rts.View]) -> float:
    """The PSNR of colours over views, dB."""
    errors = [
        np.mean((np.asarray(rts.render(part, v.camera, v.size, supersample=2)) - v.image)[..., :3] ** 2) for v in views
    ]
    return float(-10 * np.log10(np.mean(errors)))


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--shapes", nargs="*", default=["spot", "bunny"])
    parser.add_argument("--size", type=int, default=256)
    parser.add_argument("--views", type=int, default=24)
    parser.add_argument("--steps", type=int, nargs="*", default=[400, 400, 300])
    parser.add_argument("--smooth", type=float, nargs="*", default=[40, 40, 20])
    parser.add_argument("--rate", type=float, nargs="*", default=[0.1, 0.05, 0.01])
    parser.add_argument("--batch", type=int, default=4)
    parser.add_argument("--pictures", type=Path)
    options = parser.parse_args()
    for name in options.shapes:
        known = shape(name, options.size, options.views)
        truth = trimesh.Trimesh(known.part.theta["vertices"], known.part.surface.faces, process=False)
        start = time.perf_counter()
        ball = trimesh.creation.icosphere(4)
        ball.apply_scale(0.6)
        mesh, colors = ball, np.full((len(ball.vertices), 3), 0.5, np.float32)
        for stage, (steps, smooth, rate) in enumerate(zip(options.steps, options.smooth, options.rate, strict=True)):
            if stage == 1:
                vertices, faces, colors = finer(mesh, colors)
                mesh = trimesh.Trimesh(vertices, faces, process=False)
            rates = {"shape": rate, "colors": 0.02 if stage < 2 else 0.005}
            mesh, colors, fit = fitted(mesh, colors, known, steps, options.batch, smooth, rates)
            part = rts.Part(
                rts.Mesh(mesh.faces),
                {"vertices": np.asarray(mesh.vertices, np.float32), "colors": colors},
                "unlit",
            )
            print(
                name,
                stage,
                len(mesh.vertices),
                f"{time.perf_counter() - start:.0f} s",
                f"chamfer {100 * chamfer(mesh, truth):.3f} %",
                f"PSNR {psnr(part, known.held_out):.2f} dB",
                fit.loss,
                flush=True,
            )
        if options.pictures:
            shown = [
                np.concatenate([np.asarray(rts.render(part, v.camera, v.size, supersample=2)), v.image], axis=0)
                for v in known.held_out[:4]
            ]
            rts.save_image(options.pictures / f"{name}.png", np.concatenate(shown, axis=1))
