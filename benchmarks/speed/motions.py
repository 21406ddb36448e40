"""The cost, in a pose iteration, of motions of outlines and of lines of crossing.

The default splatter with neither, with outlines alone and with both, in turns, with torch:

    python -m benchmarks.speed.motions
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

import rts
from benchmarks.accuracy.scenes import Scene, sheet, sphere
from benchmarks.meshes import kept_mesh
from benchmarks.report import table
from benchmarks.speed.pose_iteration import Task, torch_iteration
from benchmarks.timing import in_turn

VARIANTS = {
    "neither": {"rims": False, "crossings": False},
    "outlines": {"rims": True, "crossings": False},
    "both": {"rims": True, "crossings": True},
}


def cases(folder: Path) -> dict[str, tuple]:
    """Vertices and faces by name, with shader, layers and culling."""
    bunny, ball, leaf = kept_mesh("bunny", folder), mesh_of(sphere(256)), mesh_of(sheet(256))
    return {
        "bunny, culled, K = 1": (*bunny, "silhouette", 1, "back"),
        "bunny, K = 2": (*bunny, "silhouette", 2, "none"),
        "bunny, K = 2, lambert": (*bunny, "lambert", 2, "none"),
        "sphere, K = 2": (*ball, "silhouette", 2, "none"),
        "sheet, K = 2": (*leaf, "silhouette", 2, "none"),
        "spheres that cross, K = 2, lambert": (*through(ball), "lambert", 2, "none"),
    }


def mesh_of(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) float32 and faces (T, 3) of what moves in a scene."""
    part = scene.rest[0]
    return np.asarray(part.theta["vertices"], np.float32), part.surface.faces


def through(mesh: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """A mesh and another of its kind that passes through it, smaller and aside by a half of its size."""
    vertices, faces = mesh
    middle = vertices.mean(axis=0)
    other = middle + 0.7 * (vertices - middle) + 0.5 * (vertices[:, :1].max() - middle[0]) * np.ones(3, np.float32)
    return np.concatenate([vertices, other]).astype(np.float32), np.concatenate([faces, faces + len(vertices)])


def measure(case: tuple, side: int, rounds: int) -> dict[str, dict]:
    """Times of the iterations of each variant."""
    vertices, faces, shader, layers, cull = case
    steps = {}
    for name, fields in VARIANTS.items():
        splatter = rts.plugin("rts.splatters", "visible")(**fields)
        steps[name] = torch_iteration(Task("", vertices, faces, side, shader, layers, splatter, cull))
    return in_turn(steps, rounds)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=Path("out/speed"), help="where meshes are kept")
    parser.add_argument("--side", type=int, default=256, help="of the image, pixels")
    parser.add_argument("--rounds", type=int, default=40)
    parser.add_argument("--only", default="", help="cases whose name has this in it")
    args = parser.parse_args()
    lines = []
    for name, case in cases(args.output / "meshes").items():
        if args.only in name:
            base, outlines, both = (x["ms"] for x in measure(case, args.side, args.rounds).values())
            lines.append((name, f"{base:.2f}", f"{outlines - base:+.2f}", f"{both - outlines:+.2f}"))
    print(table(("case", "neither [ms]", "outlines", "lines of crossing, too"), lines))


if __name__ == "__main__":
    main()
