"""Silhouette fitting of a swept B-spline surface (section 4.4): a cylinder becomes a chess piece.

The unknowns are the 8 radii of the profile's control points. They start as a cylinder, and are fitted to one silhouette
of the piece, area-sampled with 8 × 8 samples a pixel. Written are a figure, an animation and the numbers, for Adam and
Levenberg–Marquardt in torch and jax:

    python -m benchmarks.paper.bspline -o out/bspline
    python -m benchmarks.paper.bspline --quick           # 128² instead of 256², one engine
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

import rts
from rts.arrays.engines import engine_named
from rts.fitting.fit import Fit

PIECE = np.array([0.80, 0.85, 0.30, 0.26, 0.22, 0.62, 0.55, 0.02])
CYLINDER = 0.45
HEIGHTS = np.linspace(-1, 1, len(PIECE))
CAMERA = rts.Camera.look_at((0, 0.7, 4.2), (0, -0.08, 0), fov_y=36)
STEPS = {"adam": 200, "lm": 200}
RATE = 0.02
WRONG, MISSING, RIGHT = (0.85, 0.15, 0.1), (0.1, 0.6, 0.2), (0.01, 0.01, 0.012)


def surface() -> Any:
    return rts.plugin("surfaces", "revolution")(HEIGHTS, count=16)


def silhouette(radii: Any, side: int, supersample: int) -> np.ndarray:
    part = rts.Part(surface(), {"radii": np.asarray(radii, np.float64)})
    return rts.render(part, CAMERA, (side, side), splatter="none", supersample=supersample)[..., 3]


def overlap(mask: np.ndarray, target: np.ndarray) -> float:
    """Intersection over union of two silhouettes, as areas."""
    return float(np.minimum(mask, target).sum() / np.maximum(mask, target).sum())


def fitted(engine: str, method: str, side: int, target: np.ndarray) -> tuple[Fit, list[np.ndarray]]:
    """The fit, and the radii at each step."""
    shape, trail = surface(), []
    residuals = rts.ImageResiduals(
        lambda radii: rts.Part(shape, {"radii": radii}), CAMERA, (side, side), target.astype(np.float32), supersample=2
    )
    chosen = engine_named(engine)
    start = chosen.constant(np.full(len(PIECE), CYLINDER, np.float32))
    rate = {} if method == "lm" else {"learning_rate": RATE}
    found = rts.fit(
        residuals,
        start,
        method=method,
        steps=STEPS[method],
        callback=lambda step, radii, loss: trail.append(np.array(chosen.to_numpy(radii))) and False,
        progress=False,
        jit=False,
        **rate,
    )
    return found, trail


def picture(radii: np.ndarray, target: np.ndarray, side: int) -> np.ndarray:
    """(H, W, 3): black where silhouettes agree, red where the surface is too wide, green where it is too narrow."""
    mask = silhouette(radii, side, 4)[..., None]
    target = target[..., None]
    both, wide, narrow = np.minimum(mask, target), np.maximum(mask - target, 0), np.maximum(target - mask, 0)
    return 1 - both - wide - narrow + both * RIGHT + wide * WRONG + narrow * MISSING


def run(folder: Path, side: int, engines: list[str]) -> list[dict[str, Any]]:
    target, rows, trails = silhouette(PIECE, side, 8), [], {}
    for engine in engines:
        for method in STEPS:
            begun = time.perf_counter()
            found, trail = fitted(engine, method, side, target)
            radii = np.array(engine_named(engine).to_numpy(found.parameters))
            trails[engine, method] = trail, found.history
            rows.append(
                {
                    "engine": engine,
                    "method": method,
                    "side": side,
                    "iterations": found.steps,
                    "seconds": time.perf_counter() - begun,
                    "loss": found.loss,
                    "iou_start": overlap(silhouette(np.full(len(PIECE), CYLINDER), side, 8), target),
                    "iou": overlap(silhouette(radii, side, 8), target),
                    "largest_error_of_a_radius": float(np.abs(radii - PIECE).max()),
                    "radii": radii.tolist(),
                    "reason": found.reason,
                }
            )
            print(
                f"{engine:6} {method:5} {found.steps:4} iterations {rows[-1]['seconds']:6.1f} s   IoU "
                f"{rows[-1]['iou_start']:.3f} -> {rows[-1]['iou']:.4f}   radii off by at most "
                f"{rows[-1]['largest_error_of_a_radius']:.4f}",
                flush=True,
            )
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "bspline.json").write_text(json.dumps({"truth": PIECE.tolist(), "runs": rows}, indent=2) + "\n")
    draw(folder / "bspline.png", rows, trails, target, side)
    trail = trails[engines[0], "adam"][0]
    frames = [picture(radii, target, side) for radii in trail[:60:2] + trail[60::8]]
    rts.save_animation(folder / "bspline.gif", frames + frames[-1:] * 10, fps=12)
    return rows


def draw(path: Path, rows: list[dict], trails: dict, target: np.ndarray, side: int) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12, 6.4), layout="constrained")
    grid = figure.subplots(2, 4)
    trail, _ = next(iter(trails.values()))
    for axes, (title, radii) in zip(
        grid[:, 0],
        (("cylinder, the start", trail[0]), ("fitted", np.array(rows[0]["radii"]))),
        strict=True,
    ):
        lit = rts.render(
            rts.Part(surface(), {"radii": np.asarray(radii, np.float32)}, "lambert"),
            CAMERA,
            (2 * side, 2 * side),
            background=(1.0, 1.0, 1.0),
            supersample=2,
        )
        axes.imshow(np.clip(lit[..., :3], 0, 1) ** (1 / 2.2))
        axes.set_title(title)
        axes.axis("off")
    steps = [0, 10, 25, len(trail) - 1]
    for axes, step in zip([*grid[0, 1:3], *grid[1, 1:3]], steps, strict=True):
        axes.imshow(np.clip(picture(trail[step], target, side), 0, 1) ** (1 / 2.2))
        axes.set_title(f"step {step}: IoU {overlap(silhouette(trail[step], side, 4), target):.3f}")
        axes.axis("off")
    for (engine, method), (_, history) in trails.items():
        grid[0, 3].semilogy(history, label=f"{method}, {engine}", linestyle="-" if method == "adam" else "--")
    grid[0, 3].set(xlabel="step", ylabel="mean square difference", title="loss")
    grid[0, 3].legend()
    grid[0, 3].grid(alpha=0.3)
    at = np.arange(len(PIECE))
    grid[1, 3].plot(at, PIECE, "k_", markersize=16, label="truth")
    for row in rows:
        grid[1, 3].plot(
            at, row["radii"], "o" if row["method"] == "adam" else "x", label=f"{row['method']}, {row['engine']}"
        )
    grid[1, 3].set(xlabel="control point of the profile", ylabel="radius", title="radii")
    grid[1, 3].set_ylim(-0.05, 1.5)
    grid[1, 3].legend(loc="upper center", ncols=2)
    figure.savefig(path, dpi=110)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=Path("out/bspline"))
    parser.add_argument("--engines", nargs="+", default=None, help="default torch and jax")
    parser.add_argument("--quick", action="store_true")
    args = parser.parse_args(arguments)
    engines = args.engines or (["torch"] if args.quick else ["torch", "jax"])
    run(args.output, 128 if args.quick else 256, engines)


if __name__ == "__main__":
    main()
