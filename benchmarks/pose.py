"""Rigid pose from one silhouette: how often, how exactly and how fast each method finds it.

Each run starts 25° and 10 % of the object's size (the diameter of its bounding sphere) away from the truth, about a
random axis and along a random direction, and has one 128² silhouette, hard and area-sampled (4 × 4 samples a pixel).
It succeeds where it ends within 2° and 2 %. Run all, or a part:

    python benchmarks/pose.py -o out/pose
    python benchmarks/pose.py --meshes bunny --seeds 5 --methods lm
"""

from __future__ import annotations

import argparse
import json
import time
from collections import defaultdict
from pathlib import Path

import numpy as np
from scenes import DISTANCE, camera, mesh, supersampled

import rts

SIZE = (128, 128)
MESHES = ("teapot", "bunny", "nefertiti")
VIEWS = ((0.0, 10.0), (120.0, 25.0), (240.0, 40.0))
"""Azimuth and elevation of the camera, degrees."""
START_ANGLE, START_OFFSET = np.radians(25.0), 0.10
DONE_ANGLE, DONE_OFFSET = 2.0, 0.02
DIAMETER = 2.0
STEPS = {"adam": 300, "lm": 60}
ADAM_RATE = 0.01


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


def run(
    part: rts.Part, view: rts.Camera, target: np.ndarray, seed: int, method: str, engine: str, splatter: str
) -> dict:
    """One fit."""
    goal = arrays(engine, target)

    def residuals(pose):
        image = rts.render(part.replace(transform=rts.rigid(pose)), view, SIZE, layers=1, splatter=splatter)
        return image[..., 3] - goal

    options = {"learning_rate": ADAM_RATE} if method == "adam" else {}
    began = time.perf_counter()
    fit = rts.fit(residuals, arrays(engine, start(seed)), method=method, steps=STEPS[method], progress=False, **options)
    pose = np.asarray(fit.parameters, np.float64)
    return {
        "seed": seed,
        "angle": float(np.degrees(np.linalg.norm(pose[:3]))),
        "offset": float(np.linalg.norm(pose[3:]) / DIAMETER),
        "loss": fit.loss,
        "truth_loss": float(np.mean(np.asarray(residuals(arrays(engine, np.zeros(6)))) ** 2)),
        "steps": fit.steps,
        "seconds": time.perf_counter() - began,
        "reason": fit.reason,
        "pose": pose.tolist(),
    }


def succeeded(r: dict) -> bool:
    return r["angle"] <= DONE_ANGLE and r["offset"] <= DONE_OFFSET


def kind(r: dict) -> str:
    """Why a run failed: another minimum has a clearly higher loss than the truth; an ambiguous silhouette has not."""
    return "ambiguous" if r["loss"] <= 1.5 * r["truth_loss"] else "local minimum"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=Path("out/pose"))
    parser.add_argument("--meshes", nargs="+", default=MESHES)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--methods", nargs="+", default=["adam", "lm"])
    parser.add_argument("--engine", default="torch")
    parser.add_argument("--splatter", default="multi")
    args = parser.parse_args()
    args.output.mkdir(parents=True, exist_ok=True)
    surface = rts.plugin("rts.surfaces", "mesh")
    results = defaultdict(list)
    print(
        f"{'mesh':10} view method  succeeded  failures (local minimum / ambiguous)  median steps  s   ms/step",
        flush=True,
    )
    for name in args.meshes:
        vertices, faces = mesh(name)
        part = rts.Part(surface(faces), {"vertices": vertices.astype(np.float32)}, "silhouette")
        for index, angles in enumerate(VIEWS):
            view = camera(eye(*angles))
            target = supersampled(part, view, SIZE, 4)[..., 3]
            for method in args.methods:
                key = f"{name} {index} {method} {args.engine} {args.splatter}"
                for seed in range(args.seeds):
                    results[key].append(run(part, view, target, seed, method, args.engine, args.splatter))
                rows = results[key]
                failures = [kind(r) for r in rows if not succeeded(r)]
                steps, seconds = (np.median([r[k] for r in rows]) for k in ("steps", "seconds"))
                pace = np.median([1e3 * r["seconds"] / r["steps"] for r in rows])
                print(
                    f"{name:10} {index:4} {method:6} {len(rows) - len(failures):3} of {len(rows):<3}   "
                    f"{failures.count('local minimum'):10} / {failures.count('ambiguous'):<24} {steps:8.0f}"
                    f" {seconds:8.2f} {pace:6.1f}",
                    flush=True,
                )
    path = args.output / f"pose_{args.engine}_{args.splatter}.json"
    path.write_text(json.dumps(results, indent=1))
    print(f"wrote {path}")


if __name__ == "__main__":
    main()
