"""The basin of convergence: how far off a pose may start and still be found from silhouettes, by each schedule.

As in `benchmarks.pose_recovery`, the silhouettes of three views are fitted at once; here they have 64² pixels and come
from meshes of some thousand faces. A start is turned by 10° to 90° about a random axis and, for each degree, shifted by
0.4 % of the object's size (the diameter of its bounding sphere) along a random direction. It succeeds where it ends
within 2° and 1 %.

    python -m benchmarks.basin                     # all; basin.json keeps what it holds of other starts and methods
    python -m benchmarks.basin --angles 50 --methods plain pyramid --seeds 5 -o /tmp/basin
    python -m benchmarks.basin --draw              # only draw what basin.json holds
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import time
from collections import defaultdict
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import rts
from benchmarks.basin_peer import DeodrViews
from benchmarks.camera import camera, supersampled
from benchmarks.meshes import mesh
from benchmarks.pose_recovery import DIAMETER, VIEWS, Views, arrays, eye
from benchmarks.report import table
from rts.fitting.schedule import Stage
from rts_compare.chart_style import PEER_COLORS

RESULTS = Path(__file__).parent / "results"
IMAGES = Path(__file__).parent.parent / "docs/images/results"
SIZE = (64, 64)
MESHES = {"teapot": "teapot_2464", "bunny": "bunny_5k", "nefertiti": "nefertiti"}
FACES = 5000
"""Meshes of more are decimated to so many."""
ANGLES = (10, 30, 50, 70, 90)
SHIFT = 0.004
"""Share of the size that a start is shifted by for each degree: 10 % at 25°, as in `pose_recovery`."""
DONE_ANGLE, DONE_SHIFT = 2.0, 0.01
DEODR_STEPS, DEODR_RATE = 150, 0.02
SEEDS = 20


class Method(NamedTuple):
    """A way to fit, and what the figure calls and how it draws it."""

    label: str
    color: str
    schedule: Sequence[Stage] | None


METHODS = {
    "pyramid": Method("rts.pyramid: coarse, many samples, blurred; the default", "#D55E00", rts.pyramid(SIZE)),
    "wider": Method(
        "rts.pyramid after a stage of twice the blur",
        "#009E73",
        [Stage(0.25, 4, 2.0), *rts.pyramid(SIZE)],
    ),
    "sigma": Method(
        "σ continuation at full resolution: 8, 4, 2 pixels, none",
        "#0072B2",
        [Stage(sigma=8), Stage(sigma=4), Stage(sigma=2), Stage()],
    ),
    "resolutions": Method("resolutions alone: 16², 32², 64²", "#E69F00", [Stage(0.25), Stage(0.5), Stage()]),
    "plain": Method("plain: full resolution only", "#5C6068", None),
    "DEODR": Method(f"DEODR, Adam ({DEODR_STEPS} steps)", PEER_COLORS["DEODR"], None),
}


class Staged(Views):
    """Images of several views at once, which have stages."""

    def at_stage(self, stage: Stage) -> Staged:
        """See `rts.Residuals`."""
        return Staged([image.at_stage(stage) for image in self.images])


def start(seed: int, angle: float) -> np.ndarray:
    """(6,) the pose to start from; the truth is zero."""
    directions = np.random.default_rng(seed).normal(size=(2, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return np.concatenate([directions[0] * np.radians(angle), directions[1] * SHIFT * angle * DIAMETER])


def shape(name: str) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) float32 and faces (T, 3) of one of MESHES."""
    vertices, faces = mesh(MESHES[name])
    if len(faces) > 2 * FACES:
        import fast_simplification

        found: Any = fast_simplification.simplify(
            np.ascontiguousarray(vertices), faces.astype(np.int32), target_count=FACES
        )
        vertices, faces = found
    return vertices.astype(np.float32), faces


def solver(name: str, method: str) -> Callable[[np.ndarray], tuple[np.ndarray, float, int]]:
    """A function of the start: the pose that is found, its loss, and how many steps were made."""
    vertices, faces = shape(name)
    part = rts.Part(rts.plugin("rts.surfaces", "mesh")(faces), {"vertices": vertices}, "silhouette")
    cameras = [camera(eye(*angles)) for angles in VIEWS]
    if method == "DEODR":
        views = DeodrViews(vertices, faces, [np.asarray(seen.view) for seen in cameras], SIZE[0])
        return lambda first: views.fit(first, DEODR_STEPS, DEODR_RATE)
    goals = [supersampled(part, seen, SIZE, 4)[..., 3] for seen in cameras]

    def moved(pose):
        return part.replace(transform=rts.rigid(pose))

    pairs = zip(cameras, goals, strict=True)
    images = [rts.ImageResiduals(moved, seen, SIZE, goal, layers=1, splatter="single") for seen, goal in pairs]

    def found(first: np.ndarray) -> tuple[np.ndarray, float, int]:
        schedule = METHODS[method].schedule
        fit = rts.fit(Staged(images), arrays("torch", first), method="lm", schedule=schedule, progress=False)
        return np.asarray(fit.parameters, np.float64), fit.loss, fit.steps

    return found


def turn(pose: np.ndarray) -> float:
    """The angle of a pose, degrees, at most 180."""
    return float(np.degrees(abs((np.linalg.norm(pose[:3]) + np.pi) % (2 * np.pi) - np.pi)))


def measure(name: str, method: str, angle: float, seeds: int) -> list[dict]:
    """A row for each start of one mesh."""
    import torch

    torch.set_num_threads(1)
    solve, rows = solver(name, method), []
    for seed in range(seeds):
        begun = time.process_time()
        pose, loss, steps = solve(start(seed, angle))
        seconds = time.process_time() - begun
        off, shift = turn(pose), float(np.linalg.norm(pose[3:]) / DIAMETER)
        rows.append(
            {
                "mesh": name,
                "method": method,
                "start": angle,
                "seed": seed,
                "success": off <= DONE_ANGLE and shift <= DONE_SHIFT,
                "angle": off,
                "shift": shift,
                "loss": loss,
                "steps": steps,
                "seconds": seconds,
            }
        )
    return rows


# ------------------------------------------------------------------------------------------------------- results


def counted(rows: list[dict]) -> dict[tuple[str, float], list[dict]]:
    """The rows of each method and start."""
    groups = defaultdict(list)
    for row in rows:
        groups[row["method"], row["start"]].append(row)
    return groups


def summary(rows: list[dict]) -> str:
    """A table in Markdown: how many succeeded, by method and start; and the median of steps."""
    groups, angles = counted(rows), sorted({row["start"] for row in rows})
    lines = []
    for method in [m for m in METHODS if any(row["method"] == m for row in rows)]:
        own = [row for row in rows if row["method"] == method]
        found = [groups.get((method, angle), []) for angle in angles]
        cells = [f"{sum(r['success'] for r in group)} of {len(group)}" if group else "" for group in found]
        lines.append([METHODS[method].label, *cells, f"{statistics.median(r['steps'] for r in own):.0f}"])
    heads = [f"{a:g}°, {100 * SHIFT * a:g} %" for a in angles]
    return table(["method", *heads, "steps"], lines)


def draw(rows: list[dict], path: Path) -> None:
    """The successes against the start, a curve a method."""
    from matplotlib.figure import Figure

    groups, angles = counted(rows), sorted({row["start"] for row in rows})
    figure = Figure(figsize=(8, 4.6), layout="constrained")
    axes = figure.subplots()
    for name, method in METHODS.items():
        known = [a for a in angles if (name, a) in groups]
        wins = [100 * statistics.mean(row["success"] for row in groups[name, a]) for a in known]
        style = "x--" if name == "DEODR" else "o-"
        width = 5 if name == "wider" else 1.8  # Others may lie upon it.
        axes.plot(known, wins, style, color=method.color, label=method.label, linewidth=width)
    axes.set(
        xticks=angles,
        xticklabels=[f"{a:g}°\n{100 * SHIFT * a:g} %" for a in angles],
        ylim=(-2, 104),
        xlabel="offset of the start: turn, and shift over the object's size",
        ylabel="starts that lead to the pose, %",
        title=f"Poses from three silhouettes of {SIZE[1]}²; Levenberg–Marquardt where nothing else is said",
    )
    axes.axvline(50, color="#9aa0a8", linewidth=0.8, linestyle=":")
    axes.grid(alpha=0.25)
    axes.legend(frameon=False)
    figure.savefig(path, dpi=130)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=RESULTS)
    parser.add_argument("--meshes", nargs="+", choices=MESHES, default=list(MESHES))
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=list(METHODS))
    parser.add_argument("--angles", nargs="+", type=float, default=ANGLES)
    parser.add_argument("--seeds", type=int, default=SEEDS)
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--draw", action="store_true", help="only draw what basin.json of the output holds")
    args = parser.parse_args()
    args.output.mkdir(parents=True, exist_ok=True)
    path = args.output / "basin.json"
    rows = json.loads(path.read_text())["rows"] if path.exists() else []
    if not args.draw:
        rows = run(args, rows, path)
    text = summary(rows)
    path.with_suffix(".md").write_text(text + "\n")
    draw(rows, (IMAGES if args.output == RESULTS else args.output) / "basin.png")
    print(text)


def run(args: argparse.Namespace, rows: list[dict], path: Path) -> list[dict]:
    """All rows, those that there were of others included, by several processes of one thread each."""
    os.environ |= {"RTS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}  # Before the processes begin.
    jobs = [(name, method, a, args.seeds) for a in args.angles for name in args.meshes for method in args.methods]
    with ProcessPoolExecutor(args.processes, get_context("spawn")) as pool:
        futures = {pool.submit(measure, *job): job[:3] for job in jobs}
        for future in as_completed(futures):
            (name, method, angle), found = futures[future], future.result()
            rows = [r for r in rows if (r["mesh"], r["method"], r["start"]) != (name, method, angle)] + found
            rows.sort(key=order)
            text = json.dumps({"size": SIZE, "shift": SHIFT, "rows": rows}, separators=(",", ":"))
            path.write_text(text.replace("},{", "},\n{") + "\n")
            wins, seconds = (sum(row[key] for row in found) for key in ("success", "seconds"))
            print(f"{name} {method} {angle:g}°: {wins} of {len(found)}, {seconds:.0f} s", flush=True)
    return rows


def order(row: dict) -> tuple:
    """The key by which rows are sorted."""
    return list(METHODS).index(row["method"]), row["start"], row["mesh"], row["seed"]


if __name__ == "__main__":
    main()
