"""Shapes and colours from 24 pictures: a ball becomes spot, and the bunny, by `rts.LargeSteps`.

Chamfer in percent of the bounds' diagonal, PSNR of views that are held out, time; with cameras that are known, or off
by 2° and 2 % of the diagonal, and fitted along:

    python -m benchmarks.many_views
    python -m benchmarks.many_views --shapes bunny --cameras --pictures out/

Needs the models of the folder that RTS_DATA names. Colours are those of vertices, with the light of the pictures in
them.
"""

from __future__ import annotations

import argparse
import os
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
import trimesh
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

import rts

DATA = Path(os.environ.get("RTS_DATA", "../shared/data"))
LIGHT = {"direction": np.array([0.3, 0.8, 0.5], np.float32), "ambient": np.full(3, 0.35, np.float32)}
SIZE, FOV, VIEWS, HELD_OUT, BATCH = 256, 40.0, 24, 8, 4
OFF = 2.0
"""Degrees, and percent of the diagonal, by which cameras are off."""
POINTS = 300_000
"""Points on each mesh for the chamfer. With a tenth of them it would be 0.2 % for two samples of one mesh."""


class Stage(NamedTuple):
    """Steps with one set of rates, from the mesh of the stage before; `finer` splits its faces first."""

    steps: int
    smoothness: float
    shape: float
    colors: float
    poses: float
    finer: bool = False


STAGES = (
    Stage(400, 40, 0.1, 0.02, 0.002),
    Stage(400, 40, 0.05, 0.02, 0.001, finer=True),
    Stage(500, 20, 0.01, 0.005, 0.0003),
)


class Subject(NamedTuple):
    """A model, views to fit, and views that are held out."""

    mesh: trimesh.Trimesh
    views: list[rts.View]
    held_out: list[rts.View]


def directions(count: int, turn: float = 0.0) -> np.ndarray:
    """Directions (count, 3) spread evenly (Fibonacci)."""
    z = 1 - (2 * np.arange(count) + 1) / count
    angle = np.pi * (1 + 5**0.5) * np.arange(count) + turn
    return np.stack([np.cos(angle) * np.sqrt(1 - z * z), z, np.sin(angle) * np.sqrt(1 - z * z)], axis=1)


def shape(name: str) -> rts.Part:
    """Spot with its texture, or the bunny in a pattern of colours; its bounds' diagonal is 2."""
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
    return part.replace(theta=theta, shader="lambert")


def subject(name: str) -> Subject:
    """A shape, and pictures of it."""
    part = shape(name)
    vertices = part.theta["vertices"]
    distance = 1.05 * np.linalg.norm(vertices, axis=1).max() / np.sin(np.radians(FOV / 2))
    mesh = trimesh.Trimesh(vertices, part.surface.faces, process=False)
    eyes, others = distance * directions(VIEWS), distance * directions(HELD_OUT, 1.0) * [1, -1, 1]
    return Subject(mesh, pictures(part, eyes), pictures(part, others))


def pictures(part: rts.Part, eyes: np.ndarray) -> list[rts.View]:
    """Pictures of a part from all around, 4 × 4 samples a pixel."""
    cameras = [rts.Camera.look_at(eye, (0, 0, 0), fov_y=FOV) for eye in eyes]
    return [rts.View(c, np.asarray(rts.render(part, c, (SIZE, SIZE), supersample=4))) for c in cameras]


def shifted(views: list[rts.View], rng: np.random.Generator) -> list[rts.View]:
    """The pictures with cameras that are turned by 2° about their own centre, and moved by 2 % of the diagonal."""
    others = []
    for view in views:
        axis, way = (x / np.linalg.norm(x) for x in rng.normal(size=(2, 3)))
        change = np.asarray(rts.rigid(np.concatenate([np.radians(OFF) * axis, 2 * OFF / 100 * way])))
        others.append(rts.View(view.camera.replace(view=change @ view.camera.view), view.image))
    return others


class Model(NamedTuple):
    """A mesh, its colours (V, 3), and poses (B, 6) of the world before each camera."""

    mesh: trimesh.Trimesh
    colors: np.ndarray
    poses: np.ndarray

    @property
    def part(self) -> rts.Part:
        """The mesh in its colours."""
        theta = {"vertices": np.asarray(self.mesh.vertices, np.float32), "colors": self.colors}
        return rts.Part(rts.Mesh(self.mesh.faces), theta, "unlit")

    def finer(self) -> Model:
        """The model with four faces for each."""
        both = np.concatenate([self.mesh.vertices, self.colors], axis=1)
        both, faces = trimesh.remesh.subdivide(both, self.mesh.faces)
        return self._replace(
            mesh=trimesh.Trimesh(both[:, :3], faces, process=False), colors=both[:, 3:].astype(np.float32)
        )

    def fitted(self, views: list[rts.View], stage: Stage, cameras: bool) -> Model:
        """The model after a stage."""
        steps = rts.LargeSteps(self.mesh.vertices, self.mesh.faces, stage.smoothness)
        surface = rts.Mesh(self.mesh.faces)
        p = {
            "shape": torch.tensor(np.asarray(steps.encode(np.asarray(self.mesh.vertices, np.float32)))),
            "colors": torch.tensor(self.colors),
        }
        rates = {"shape": stage.shape, "colors": stage.colors}
        moved = None
        if cameras:
            p["poses"], rates["poses"] = torch.tensor(self.poses), stage.poses
            moved = camera_of
        residuals = rts.ViewResiduals(
            lambda p: rts.Part(surface, {"vertices": steps.decode(p["shape"]), "colors": p["colors"]}, "unlit"),
            views,
            batch=BATCH,
            cameras=moved,
        )
        fit = rts.fit(residuals, p, steps=stage.steps, learning_rate=rates, validate_every=stage.steps)
        vertices = np.asarray(steps.decode(fit.parameters["shape"]))
        poses = fit.parameters["poses"].numpy() if cameras else self.poses
        return Model(trimesh.Trimesh(vertices, self.mesh.faces, process=False), fit.parameters["colors"].numpy(), poses)


def camera_of(p: Any, camera: rts.Camera, view: Any) -> rts.Camera:
    """The camera of a view, with the world before it moved."""
    return camera.within(rts.rigid(p["poses"][view]))


def chamfer(a: trimesh.Trimesh, b: trimesh.Trimesh) -> float:
    """The mean distance of points of each mesh to the other, percent of the diagonal of b's bounds."""
    p, q = (trimesh.sample.sample_surface(m, POINTS, seed=0)[0] for m in (a, b))
    ways = KDTree(p).query(q)[0].mean(), KDTree(q).query(p)[0].mean()
    return 50 * float(sum(ways)) / float(np.linalg.norm(b.bounds[1] - b.bounds[0]))


def psnr(part: rts.Part, views: list[rts.View]) -> float:
    """The PSNR of colours over views, dB."""
    images = [np.asarray(rts.render(part, v.camera, v.size, supersample=2)) for v in views]
    return float(-10 * np.log10(np.mean([(i - v.image)[..., :3] ** 2 for i, v in zip(images, views, strict=True)])))


def aligned(model: Model, shifted: list[rts.View], views: list[rts.View]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The motion (4, 4) that takes the model's world to the truth's as cameras tell; their errors, ° and percent.

    Nobody can tell a world that moves from cameras that move alike.
    """
    own = [
        v.camera.view @ np.asarray(rts.rigid(np.float64(pose))) for v, pose in zip(shifted, model.poses, strict=True)
    ]
    true = [v.camera.view for v in views]
    turns = Rotation.from_matrix([(np.linalg.inv(t) @ o)[:3, :3] for t, o in zip(true, own, strict=True)])
    turn = turns.mean().as_matrix()
    centres = [np.array([np.linalg.inv(v)[:3, 3] for v in both]) for both in (own, true)]
    motion = np.eye(4)
    motion[:3, :3] = turn
    motion[:3, 3] = centres[1].mean(axis=0) - turn @ centres[0].mean(axis=0)
    angles = (Rotation.from_matrix(turn).inv() * turns).magnitude()
    away = np.linalg.norm(centres[0] @ turn.T + motion[:3, 3] - centres[1], axis=1)
    return motion, np.degrees(angles), 50 * away


def run(name: str, cameras: bool, folder: Path | None) -> None:
    """Fit a subject, and print a line for each stage."""
    known = subject(name)
    views = shifted(known.views, np.random.default_rng(0)) if cameras else known.views
    ball = trimesh.creation.icosphere(4, radius=0.6)
    model = Model(ball, np.full((len(ball.vertices), 3), 0.5, np.float32), np.zeros((VIEWS, 6), np.float32))
    start = time.perf_counter()
    for number, stage in enumerate(STAGES):
        model = (model.finer() if stage.finer else model).fitted(views, stage, cameras)
        seconds = time.perf_counter() - start
        motion, angles, away = aligned(model, views, known.views)
        mesh = model.mesh.copy().apply_transform(motion)
        off = (
            f", cameras {np.median(angles):.2f}° (most {angles.max():.2f}°), {np.median(away):.2f} %" if cameras else ""
        )
        moved = model._replace(mesh=mesh)
        good = f"chamfer {chamfer(mesh, known.mesh):.3f} %, PSNR {psnr(moved.part, known.held_out):.1f} dB"
        told = f"{name}, stage {number}: {seconds:.0f} s, {len(mesh.vertices)} vertices, {good}"
        print(told + off if cameras else told, flush=True)
    if folder:
        shown = [np.asarray(rts.render(moved.part, v.camera, v.size, supersample=2)) for v in known.held_out[:4]]
        rows = [np.concatenate(row, axis=1) for row in (shown, [v.image for v in known.held_out[:4]])]
        folder.mkdir(parents=True, exist_ok=True)
        rts.save_image(folder / f"{name}{'_cameras' if cameras else ''}.png", np.concatenate(rows))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--shapes", nargs="*", default=["spot", "bunny"])
    parser.add_argument("--cameras", action="store_true", help="cameras that are off, fitted along")
    parser.add_argument("--pictures", type=Path, help="the folder of pictures")
    options = parser.parse_args()
    for name in options.shapes:
        run(name, options.cameras, options.pictures)
