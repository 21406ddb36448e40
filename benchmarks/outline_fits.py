"""Fits by `visible` with outlines that move as outlines do, or not: whether they find more, or break something.

*Samples*: outlines move as the samples inside of them; *fronts*: as fronts alone tell; *visible*: also by where rays
leave culled bodies, the default.

*Poses* are those of `pose_recovery`, and those of a vase, which looks the same however it is turned about its axis: its
angle is that of the axis. *Vertices*: a sphere becomes the bunny, every vertex free, by Adam, from eight shaded
pictures with their silhouettes, and a Laplacian energy; judged by the distance between the two surfaces (chamfer: the
mean over points of each of the distance to the other, in thousandths of the bunny's size) and by pictures from
elsewhere.

    python -m benchmarks.outline_fits -o out/outline_fits
    python -m benchmarks.outline_fits --only poses --meshes bunny --seeds 3 --cull back --motions fronts visible
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from rich.progress import track

import rts
from benchmarks import pose_recovery
from benchmarks.camera import camera, supersampled
from benchmarks.meshes import mesh, rotation_xy
from benchmarks.pose_recovery import DIAMETER, MESHES, VIEWS, Task, eye, line
from benchmarks.report import table
from rts_compare.builtin_scenes import VASE_HEIGHTS, VASE_RADII

MOTIONS: dict[str, dict] = {"samples": {"rims": False}, "fronts": {"exits": False}, "visible": {}}
"""Options of the splatter."""
TILT = (0.45, 0.3)
"""Turns of the vase about x and y, radians."""
SIZE, STEPS, RATE = (128, 128), 250, 0.01
WEIGHTS = (0.003, 0.03)
"""Weights of the Laplacian energy, a mean over vertices in squares of the sphere's edges, beside the mean
square of pixels."""
COLOR = (0.85, 0.75, 0.6)


def visible(motion: str) -> Any:
    """The splatter whose outlines move so."""
    return rts.plugin("rts.splatters", "visible")(**MOTIONS[motion])


# ------------------------------------------------------------------------------------------------------------ poses


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


def between_axes(pose: np.ndarray) -> float:
    """Degrees between the vase's axis at a pose (6,) and at zero."""
    axis = rotation_xy(*TILT)[:, 1]
    moved = np.asarray(rts.rigid(np.asarray(pose, np.float64)))[:3, :3] @ axis
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(axis, moved)), axis @ moved)))


def poses(args: argparse.Namespace) -> Iterator[tuple[str, list[dict]]]:
    """A line of the table, and its runs."""
    surface = rts.plugin("rts.surfaces", "mesh")
    for name in args.meshes:
        vertices, faces = vase() if name == "vase" else mesh(name)
        part = rts.Part(surface(faces), {"vertices": vertices.astype(np.float32)}, "silhouette", cull=args.cull)
        views = [camera(eye(*angles)) for angles in VIEWS]
        tasks = {motion: Task(part, views, "torch", visible(motion), args.layers) for motion in args.motions}
        for method in args.methods:
            runs: dict[str, list[dict]] = {motion: [] for motion in tasks}
            for seed in track(range(args.seeds), description=f"{name}, {method}", transient=True):
                for motion, task in tasks.items():
                    runs[motion].append(task.run(seed, method))
            for motion, rows in runs.items():
                if name == "vase":
                    for row in rows:
                        row["angle"] = between_axes(np.array(row["pose"]))
                        row["outcome"] = pose_recovery.outcome(row)
                yield line(name, motion, method, rows), rows


# --------------------------------------------------------------------------------------------------------- vertices


def shaded(surface: Any, vertices: Any, cull: str) -> rts.Part:
    """A part lit from the upper right."""
    return rts.Part(surface, {"vertices": vertices, "color": np.array(COLOR)}, "lambert", cull=cull)


def around(count: int, first: float) -> list[rts.Camera]:
    """Cameras all around, in turn above and below."""
    return [camera(eye(first + 360 * i / count, 30.0 * (-1) ** i)) for i in range(count)]


def sphere() -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces of a sphere inside of the bunny."""
    import trimesh

    found = trimesh.creation.icosphere(4, 0.6)
    return np.asarray(found.vertices), np.asarray(found.faces, np.int32)


def chamfer(a: tuple, b: tuple) -> float:
    """Mean distance of points of each surface from those of the other, thousandths."""
    import trimesh
    from scipy.spatial import cKDTree

    points = [trimesh.Trimesh(v, f, process=False).sample(60000, seed=0) for v, f in (a, b)]
    distances = [cKDTree(points[1 - i]).query(points[i])[0].mean() for i in (0, 1)]
    return float(1e3 * np.mean(distances) / DIAMETER)


def fitted(motion: str, cull: str, weight: float, targets: list[np.ndarray], views: list[rts.Camera]) -> np.ndarray:
    """Vertices (V, 3) after Adam."""
    import torch

    from rts.regularizers import Laplacian

    start, faces = sphere()
    surface = rts.plugin("rts.surfaces", "mesh")(faces)
    energy = Laplacian(start, faces)
    edge = float(np.linalg.norm(start[faces[:, 0]] - start[faces[:, 1]], axis=1).mean())
    vertices = torch.tensor(start, dtype=torch.float32, requires_grad=True)
    optimizer = torch.optim.Adam([vertices], lr=RATE)
    schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, lambda step: 1 - 0.9 * step / STEPS)
    goals, splatter = [torch.tensor(t, dtype=torch.float32) for t in targets], visible(motion)
    for _ in track(range(STEPS), description=f"vertices, {cull}, {weight:g}, {motion}", transient=True):
        optimizer.zero_grad()
        loss = weight * energy(vertices) / (energy.terms * edge**2)
        for view, goal in zip(views, goals, strict=True):
            image = rts.render(shaded(surface, vertices, cull), view, SIZE, splatter=splatter, layers=LAYERS[cull])
            loss = loss + (image - goal).square().mean() / len(views)
        loss.backward()
        optimizer.step()
        schedule.step()
    return vertices.detach().numpy().astype(np.float64)


LAYERS = {"back": 1, "none": 2}


def vertices(args: argparse.Namespace) -> Iterator[tuple[list[str], dict, np.ndarray]]:
    """Cells of a row of the table, its numbers and the picture of what was found."""
    found, faces = mesh("bunny")
    surface = rts.plugin("rts.surfaces", "mesh")
    bunny = shaded(surface(faces.astype(np.int32)), found, "none")
    training, held_out = around(8, 0.0), around(6, 17.0)
    pictures, others = ([supersampled(bunny, v, SIZE, 4) for v in views] for views in (training, held_out))
    ball = surface(sphere()[1])
    for cull in LAYERS:
        for weight in args.weights:
            for motion in args.motions:
                at = fitted(motion, cull, weight, pictures, training)
                part = shaded(ball, at, "none")
                seen = [supersampled(part, v, SIZE, 4) for v in held_out]
                error = float(np.sqrt(np.mean([(a - b) ** 2 for a, b in zip(seen, others, strict=True)])))
                distance = chamfer((at, sphere()[1]), (found, faces))
                cells = [cull, f"{weight:g}", motion, f"{distance:.3f}", f"{error:.4f}"]
                yield (
                    cells,
                    {"cull": cull, "weight": weight, "motion": motion, "chamfer": distance, "rms": error},
                    seen[0],
                )


def strip(pictures: list[np.ndarray], path: Path) -> None:
    """Pictures side by side on white, as PNG."""
    from PIL import Image

    rgb = [p[..., :3] + 1 - p[..., 3:] for p in pictures]
    image = np.round(255 * np.concatenate(rgb, axis=1).clip(0, 1) ** (1 / 2.2)).astype(np.uint8)
    Image.fromarray(image).resize((2 * image.shape[1], 2 * image.shape[0])).save(path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=Path("out/outline_fits"))
    parser.add_argument("--only", choices=["poses", "vertices"])
    parser.add_argument("--meshes", nargs="+", default=[*MESHES, "vase"])
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--methods", nargs="+", default=["adam", "lm"])
    parser.add_argument("--layers", type=int, default=1, help="K of the poses")
    parser.add_argument("--motions", nargs="+", choices=MOTIONS, default=list(MOTIONS))
    parser.add_argument("--cull", choices=LAYERS, default="none", help="of the poses")
    parser.add_argument("--weights", nargs="+", type=float, default=list(WEIGHTS), help="of the Laplacian energy")
    args = parser.parse_args()
    args.output.mkdir(parents=True, exist_ok=True)
    results: dict[str, Any] = {"poses": {}, "vertices": []}
    if args.only != "vertices":
        print("| mesh | motion | method | success | local minimum | ambiguous | angle | offset | steps | s | ms/step |")
        print("|---|---|---|---|---|---|---|---|---|---|---|", flush=True)
        for text, rows in poses(args):
            results["poses"][text] = rows
            print(text, flush=True)
    if args.only != "poses":
        lines, pictures = [], []
        for cells, numbers, picture in vertices(args):
            print(*cells, flush=True)
            results["vertices"].append(numbers)
            lines.append(cells)
            pictures.append(picture)
        print(table(["cull", "weight", "motion", "chamfer", "other views, RMS"], lines))
        strip(pictures, args.output / "vertices.png")
    name = "-".join(["fits", *([args.only] if args.only else []), *(args.meshes if args.only == "poses" else [])])
    (args.output / f"{name}.json").write_text(json.dumps(results, indent=1))


if __name__ == "__main__":
    main()
