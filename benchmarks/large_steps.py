"""Spheres that become the bunny and spot: Adam on vertices with a Laplacian energy beside Adam on `rts.LargeSteps`.

The sphere has 2,562 vertices, all of them free. The loss is the mean square of shaded pictures with their silhouettes,
128²: of the bunny from twelve views all around, of spot from six along the axes. The rate of each method falls to a
tenth in the end. *Uniform* is the optimiser of Nicolet et al.: Adam with one step size for all numbers. *Chamfer*
is the mean distance between points of each surface and the other surface, in shares of the diagonal of the target's
box. The best rate and weight of each method are shown, of those that were tried; all are in the JSON.

*Solvers*: seconds to make a `LargeSteps`, and milliseconds of a solve with three columns, float64; by SciPy, and by
cholespy where it is installed (no dependency of the library).

    python -m benchmarks.large_steps -o out/large_steps
    python -m benchmarks.large_steps --only solvers
    python -m benchmarks.large_steps --shapes spot --steps 50
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich.progress import track

import rts
from benchmarks.camera import camera
from benchmarks.meshes import mesh, welded
from benchmarks.pose_recovery import eye
from benchmarks.report import table
from benchmarks.timing import in_turn
from rts.compiling.threads import thread_count
from rts.fitting.large_steps import LargeSteps, _factorised
from rts.regularizers.connectivity import edges_of
from rts_compare.environment import environment

SIZE, STEPS = (128, 128), 200
POINTS, DENSE = 20_000, 500_000
"""Points of a surface whose distance is taken, and points that stand for the other surface."""

Fitted = Callable[[], np.ndarray]


class Shape(NamedTuple):
    """A target, and the cameras."""

    file: str
    views: list[rts.Camera]


def around(count: int, first: float) -> list[rts.Camera]:
    """Cameras all around, in turn above and below."""
    return [camera(eye(first + 360 * i / count, 30.0 * (-1) ** i)) for i in range(count)]


AXES = np.concatenate([np.eye(3), -np.eye(3)]) * 3 + 0.3
SHAPES = {
    "bunny": Shape("bunny_5k", around(12, 0.0)),
    "spot": Shape("spot/spot_triangulated", [camera(eye) for eye in AXES]),
}
SETTINGS: dict[str, list[dict[str, float]]] = {
    "vertices": [{"rate": 0.01, "weight": w} for w in (0.003, 0.03, 0.3)],
    "large steps": [{"rate": r, "smoothness": 19.0} for r in (0.03, 0.1, 0.3)],
    "large steps, uniform": [{"rate": r, "smoothness": 19.0} for r in (0.1, 0.3, 1.0)],
}


class Uniform:
    """Adam whose second moment is the largest of all numbers (Nicolet et al. 2021, section 4)."""

    def __init__(self, parameter: Any, rate: float):
        self.parameter, self.rate, self.steps, self.first, self.second = parameter, rate, 0, 0.0, 0.0

    def step(self) -> None:
        """Move the parameter by its gradient."""
        gradient, self.steps = self.parameter.grad, self.steps + 1
        self.first = 0.9 * self.first + 0.1 * gradient
        self.second = 0.999 * self.second + 0.001 * gradient**2
        mean = self.first / (1 - 0.9**self.steps)
        size = (self.second / (1 - 0.999**self.steps)).max().sqrt()
        self.parameter.data -= self.rate * mean / size


def part_of(vertices: Any, faces: np.ndarray) -> rts.Part:
    """A grey part, lit from above."""
    theta = {"vertices": vertices, "light": {"direction": np.array([0.3, 0.8, 0.5], np.float32)}}
    return rts.Part(rts.plugin("surfaces", "mesh")(faces), theta, "lambert")


def sphere() -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) float32 and faces (T, 3) of the start."""
    import trimesh

    found = trimesh.creation.icosphere(4, 0.6)
    return np.asarray(found.vertices, np.float32), np.asarray(found.faces, np.int32)


def target_of(shape: Shape) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) float32 and faces (T, 3) of the target, without seams."""
    vertices, faces = welded(*mesh(shape.file))
    return vertices.astype(np.float32), faces.astype(np.int32)


def chamfer(a: tuple[np.ndarray, np.ndarray], b: tuple[np.ndarray, np.ndarray]) -> float:
    """Mean distance between points of each surface and the other, in shares of the diagonal of the box of `b`."""
    import trimesh
    from scipy.spatial import KDTree

    meshes = [trimesh.Trimesh(v, f, process=False) for v, f in (a, b)]
    dense = [KDTree(m.sample(DENSE, seed=1)) for m in meshes]
    distances = [dense[1 - i].query(meshes[i].sample(POINTS, seed=2))[0].mean() for i in (0, 1)]
    return float(np.mean(distances) / np.linalg.norm(np.ptp(b[0], axis=0)))


def fitted(shape: Shape, pictures: Any, method: str, setting: dict[str, float], steps: int) -> tuple[np.ndarray, float]:
    """Vertices (V, 3) after all steps, and seconds."""
    import torch

    start, faces = sphere()
    energy = rts.regularizers.Laplacian(start, faces)
    edge = float(np.linalg.norm(start[faces[:, 0]] - start[faces[:, 1]], axis=1).mean())
    free = LargeSteps(start, faces, setting["smoothness"]) if "smoothness" in setting else None
    parameter = torch.tensor(start if free is None else free.encode(start), requires_grad=True)
    optimizer: Any = torch.optim.Adam([parameter], lr=setting["rate"])
    if method.endswith("uniform"):
        optimizer = Uniform(parameter, setting["rate"])
    began = time.perf_counter()
    for step in track(range(steps), description=f"{method} {setting}", transient=True):
        parameter.grad, rate = None, setting["rate"] * (1 - 0.9 * step / steps)
        if method.endswith("uniform"):
            optimizer.rate = rate
        else:
            optimizer.param_groups[0]["lr"] = rate
        vertices = parameter if free is None else free.decode(parameter)
        loss = (rts.render_views(part_of(vertices, faces), shape.views, SIZE) - pictures).square().mean()
        if free is None:
            loss = loss + setting["weight"] * energy(vertices) / (energy.terms * edge**2)
        loss.backward()
        optimizer.step()
    seconds = time.perf_counter() - began
    found = parameter if free is None else free.decode(parameter)
    return found.detach().numpy(), seconds


def fits(names: list[str], methods: list[str], steps: int, folder: Path) -> dict[str, Any]:
    """All fits of some shapes, with a table of the best ones and their picture."""
    import torch

    found: dict[str, Any] = {}
    lines, seen = [], []
    for name in names:
        shape = SHAPES[name]
        target, (start, faces) = target_of(shape), sphere()
        pictures = torch.tensor(rts.render_views(part_of(*target), shape.views, SIZE))
        shown, rows = [(start, faces)], []
        print(f"{name}: start {chamfer((start, faces), target):.4f}, target itself {chamfer(target, target):.4f}")
        for method in methods:
            runs = []
            for setting in SETTINGS[method]:
                vertices, seconds = fitted(shape, pictures, method, setting, steps)
                row = {"method": method, **setting, "chamfer": chamfer((vertices, faces), target), "seconds": seconds}
                print(name, row, flush=True)
                runs.append((row, vertices))
            best, vertices = min(runs, key=lambda run: run[0]["chamfer"])
            rows += [row for row, _ in runs]
            shown.append((vertices, faces))
            choice = ", ".join(f"{key} {best[key]:g}" for key in SETTINGS[method][0])
            lines.append([name, method, choice, f"{best['chamfer']:.4f}", f"{best['seconds']:.0f}"])
        found[name] = rows
        view = camera((1.3, 0.9, 2.8))
        seen.append([rts.render(part_of(*m), view, (160, 160), supersample=2) for m in (*shown, target)])
    strip([np.concatenate(column, axis=0) for column in zip(*seen, strict=True)], folder / "large_steps.png")
    text = table(["shape", "method", "best of those tried", "chamfer", "s"], lines)
    (folder / "fits.md").write_text(text)
    print(text)
    return found


def by_cholespy(edges: np.ndarray, diagonal: np.ndarray, smoothness: float) -> Callable[[np.ndarray], np.ndarray]:
    """What `_factorised` of `rts.LargeSteps` does, by cholespy."""
    from cholespy import CholeskySolverD, MatrixType  # pyright: ignore[reportMissingImports]

    own, ends = np.arange(len(diagonal)), np.concatenate([edges, edges[:, ::-1]])
    rows, columns = (np.concatenate([own, ends[:, i]]) for i in (0, 1))
    values = np.concatenate([diagonal, np.full(len(ends), -smoothness)])
    solver = CholeskySolverD(len(own), rows, columns, values, MatrixType.COO)

    def solve(given: np.ndarray) -> np.ndarray:
        out = np.zeros_like(given)
        solver.solve(given, out)
        return out

    return solve


def solvers() -> dict[str, Any]:
    """Times of both solvers, with a table."""
    ways = {"SciPy": _factorised} | ({"cholespy": by_cholespy} if importlib.util.find_spec("cholespy") else {})
    found, lines = {}, []
    for name in ("spot/spot_triangulated", "bunny"):
        vertices, faces = welded(*mesh(name))
        edges = edges_of(faces)[0]
        given = edges, 1 + 19.0 * np.bincount(edges.reshape(-1), minlength=len(vertices)), 19.0
        u = LargeSteps(vertices, faces).encode(vertices)
        made = in_turn({way: lambda f=f, given=given: f(*given) for way, f in ways.items()}, 3)
        solves = {way: f(*given) for way, f in ways.items()}
        for solve in solves.values():
            np.testing.assert_allclose(solve(u), vertices, atol=1e-10)
        times = in_turn({way: lambda f=f, u=u: f(u) for way, f in solves.items()}, 9)
        found[name] = {way: {"made": made[way], "solve": times[way]} for way in ways}
        for way in ways:
            lines.append([name, str(len(vertices)), way, f"{made[way]['ms']:.0f}", f"{times[way]['ms']:.2f}"])
    print(table(["mesh", "vertices", "solver", "factorised, ms", "solve, ms"], lines))
    return found


def strip(pictures: list[np.ndarray], path: Path) -> None:
    """Pictures side by side on white, as PNG."""
    from PIL import Image

    rgb = [p[..., :3] + 1 - p[..., 3:] for p in pictures]
    image = np.round(255 * np.concatenate(rgb, axis=1).clip(0, 1) ** (1 / 2.2)).astype(np.uint8)
    Image.fromarray(image).resize((2 * image.shape[1], 2 * image.shape[0])).save(path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=Path("out/large_steps"))
    parser.add_argument("--only", choices=["solvers", "fits"])
    parser.add_argument("--shapes", nargs="+", choices=SHAPES, default=list(SHAPES))
    parser.add_argument("--methods", nargs="+", choices=SETTINGS, default=list(SETTINGS))
    parser.add_argument("--steps", type=int, default=STEPS)
    args = parser.parse_args()
    args.output.mkdir(parents=True, exist_ok=True)
    results: dict[str, Any] = environment(("numpy", "scipy", "torch")) | {"threads": thread_count()}
    if args.only != "fits":
        results["solvers"] = solvers()
    if args.only != "solvers":
        results["fits"] = fits(args.shapes, args.methods, args.steps, args.output)
    (args.output / "large_steps.json").write_text(json.dumps(results, indent=1))


if __name__ == "__main__":
    main()
