"""Rigid pose from silhouettes: how often, how exactly and how fast each method finds it.

Each run starts 25° and 10 % of the object's size (the diameter of its bounding sphere) away from the truth, about a
random axis and along a random direction. Its targets are 128² silhouettes, hard and area-sampled (4 × 4 samples a
pixel), from three fixed views: all three at once, or with `--views single` one at a time. It succeeds where it ends
within 2° and 2 %. Written are the numbers, and for three views at once a figure. Run all, or a part:

    python -m benchmarks.pose_recovery -o out/pose
    python -m benchmarks.pose_recovery --meshes bunny --seeds 5 --methods lm --views single
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

import rts
from benchmarks.camera import DISTANCE, camera, supersampled
from benchmarks.meshes import mesh
from rts.arrays.engines import namespace

SIZE = (128, 128)
MESHES = ("teapot", "bunny", "nefertiti")
VIEWS = ((0.0, 10.0), (120.0, 25.0), (240.0, 40.0))
"""Azimuth and elevation of the camera, degrees."""
START_ANGLE, START_OFFSET = np.radians(25.0), 0.10
DONE_ANGLE, DONE_OFFSET = 2.0, 0.02
DIAMETER = 2.0
STEPS = {"adam": 300, "lm": 60}
ADAM_RATE = 0.01
AMBIGUOUS = 1.5
"""A failure whose loss is at most this many times the truth's fits the silhouettes as well as the truth does."""


def eye(azimuth: float, elevation: float) -> np.ndarray:
    a, e = np.radians([azimuth, elevation])
    return DISTANCE * np.array([np.sin(a) * np.cos(e), np.sin(e), np.cos(a) * np.cos(e)])


def start(seed: int) -> np.ndarray:
    """(6,) the pose to start from; the truth is zero."""
    directions = np.random.default_rng(seed).normal(size=(2, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return np.concatenate([directions[0] * START_ANGLE, directions[1] * START_OFFSET * DIAMETER])


def arrays(engine: str, x: np.ndarray):
    if engine == "torch":
        import torch

        return torch.tensor(x, dtype=torch.float32)
    import jax.numpy as jnp

    return jnp.asarray(x, jnp.float32)


class Views:
    """The residuals of images of one size, all at once."""

    def __init__(self, images: list[rts.ImageResiduals]):
        self.images = images

    def __call__(self, pose):
        differences = [image(pose) for image in self.images]
        return namespace(*differences).stack(differences)

    def normal_equations(self, pose):
        """See `rts.Residuals`: means over images of means over pixels."""
        found = [image.normal_equations(pose) for image in self.images]
        return tuple(sum(terms) / len(found) for terms in zip(*found, strict=True))


class Task:
    """One mesh seen from some views."""

    def __init__(self, part: rts.Part, views: list[rts.Camera], engine: str, splatter: Any, layers: int = 1):
        self.engine = engine

        def moved(pose):
            return part.replace(transform=rts.rigid(pose))

        self.residuals = Views(
            [
                rts.ImageResiduals(
                    moved, v, SIZE, supersampled(part, v, SIZE, 4)[..., 3], layers=layers, splatter=splatter
                )
                for v in views
            ]
        )

    def run(self, seed: int, method: str) -> dict:
        """One fit."""
        options: dict[str, Any] = {"learning_rate": ADAM_RATE} if method == "adam" else {}
        first = arrays(self.engine, start(seed))
        fit = rts.fit(self.residuals, first, method=method, steps=STEPS[method], progress=False, **options)
        pose = np.asarray(fit.parameters, np.float64)
        truth = np.asarray(self.residuals(arrays(self.engine, np.zeros(6))), np.float64)
        result = {
            "seed": seed,
            "angle": float(np.degrees(np.linalg.norm(pose[:3]))),
            "offset": float(np.linalg.norm(pose[3:]) / DIAMETER),
            "loss": fit.loss,
            "truth_loss": float(np.mean(truth**2)),
            "steps": fit.steps,
            "seconds": fit.seconds,
            "reason": fit.reason,
            "pose": pose.tolist(),
        }
        result["outcome"] = outcome(result)
        return result


def outcome(r: dict) -> str:
    """Success, or why not: a loss clearly above the truth's is a local minimum of the silhouettes themselves."""
    if r["angle"] <= DONE_ANGLE and r["offset"] <= DONE_OFFSET:
        return "success"
    return "ambiguous" if r["loss"] <= AMBIGUOUS * r["truth_loss"] else "local minimum"


def line(name: str, view: str, method: str, rows: list[dict]) -> str:
    outcomes = [r["outcome"] for r in rows]
    found = [r for r in rows if r["outcome"] == "success"] or rows
    angle, offset, steps, seconds = (np.median([r[k] for r in found]) for k in ("angle", "offset", "steps", "seconds"))
    pace = np.median([1e3 * r["seconds"] / r["steps"] for r in rows])
    counts = " | ".join(str(outcomes.count(o)) for o in ("local minimum", "ambiguous"))
    return (
        f"| {name} | {view} | {method} | {outcomes.count('success')} of {len(rows)} | {counts} | {angle:.2f}° | "
        f"{100 * offset:.2f} % | {steps:.0f} | {seconds:.2f} | {pace:.1f} |"
    )


def shown(name: str, pose: np.ndarray) -> np.ndarray:
    """The first view (H, W, 3) of a mesh: black where it covers its target, red beside, green where it is missing."""
    part, view = silhouette_part(name), camera(eye(*VIEWS[0]))
    target = supersampled(part, view, SIZE, 4)[..., 3:]
    mask = supersampled(part.replace(transform=rts.rigid(pose)), view, SIZE, 4)[..., 3:]
    both, wide, narrow = np.minimum(mask, target), np.maximum(mask - target, 0), np.maximum(target - mask, 0)
    return 1 - both - wide - narrow + wide * (0.85, 0.15, 0.1) + narrow * (0.1, 0.6, 0.2)


def draw(path: Path, results: dict[str, list[dict]]) -> None:
    """A row a mesh: where the first seed starts, and where each method ends."""
    from matplotlib.figure import Figure

    meshes = list(dict.fromkeys(key.split(", ")[0] for key in results))
    methods = list(dict.fromkeys(key.split(", ")[2] for key in results))
    figure = Figure(figsize=(2.4 * (1 + len(methods)), 2.6 * len(meshes)), layout="constrained")
    grid = figure.subplots(len(meshes), 1 + len(methods), squeeze=False)
    for axes, name in zip(grid, meshes, strict=True):
        ends = {method: results[f"{name}, all, {method}"][0] for method in methods}
        poses = {f"{name}: start": start(0)}
        poses |= {f"{m}, {r['steps']} steps: {r['angle']:.2f}°": np.array(r["pose"]) for m, r in ends.items()}
        for one, (title, pose) in zip(axes, poses.items(), strict=True):
            one.imshow(shown(name, pose) ** (1 / 2.2))
            one.set_title(title, fontsize=9)
            one.axis("off")
    figure.savefig(path, dpi=90)


def silhouette_part(name: str) -> rts.Part:
    vertices, faces = mesh(name)
    surface = rts.plugin("rts.surfaces", "mesh")(faces)
    return rts.Part(surface, {"vertices": vertices.astype(np.float32)}, "silhouette")


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=Path("out/pose"))
    parser.add_argument("--meshes", nargs="+", default=MESHES)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--methods", nargs="+", default=["adam", "lm"])
    parser.add_argument("--views", choices=["joint", "single"], default="joint")
    parser.add_argument("--engine", default="torch")
    parser.add_argument("--splatter", default="multi")
    args = parser.parse_args(arguments)
    args.output.mkdir(parents=True, exist_ok=True)
    results: dict[str, list[dict]] = {}
    print("| mesh | views | method | success | local minimum | ambiguous | angle | offset | steps | s | ms/step |")
    print("|---|---|---|---|---|---|---|---|---|---|---|", flush=True)
    for name in args.meshes:
        part = silhouette_part(name)
        cameras = [camera(eye(*angles)) for angles in VIEWS]
        groups = {"all": cameras} if args.views == "joint" else {str(i): [c] for i, c in enumerate(cameras)}
        for view, group in groups.items():
            task = Task(part, group, args.engine, args.splatter)
            for method in args.methods:
                rows = [task.run(seed, method) for seed in range(args.seeds)]
                results[f"{name}, {view}, {method}"] = rows
                print(line(name, view, method, rows), flush=True)
    path = args.output / f"pose_{args.views}_{args.engine}_{args.splatter}.json"
    path.write_text(json.dumps(results, indent=1))
    if args.views == "joint":
        draw(args.output / "pose.png", results)
    print(f"wrote {path}")


if __name__ == "__main__":
    main()
