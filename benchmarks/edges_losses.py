"""Losses near the truth, fits by L-BFGS and poses by Levenberg–Marquardt: found edges beside the paper's splatter.

*Lines*: the mean square between the image at the truth and at a distance from it, in steps of 1/1000 pixel up to
0.6 pixels on either side of it: for a card of 48², turned by 5°, and for spot and the teapot, lit, of 128², shifted
sideways.
*Jump* is the largest change of a pixel in 1/200 pixel; *wrong* is the share of steps of 1/80 pixel, on either side,
in which the loss falls as the distance grows.

*L-BFGS* (`torch.optim.LBFGS`, strong Wolfe) moves a card of 48² in the image onto its own image, from five starts
within 2 pixels; its error is in pixels.

*Poses* are those of `benchmarks.pose_recovery`, three views at once, with targets of as many samples as `--samples`
says.

    python -m benchmarks.edges_losses -o out/edges_losses
    python -m benchmarks.edges_losses --only lines lbfgs
    python -m benchmarks.edges_losses --only poses --meshes bunny_5k --seeds 5
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

import rts
from benchmarks import meshes, pose_recovery
from benchmarks.camera import camera, supersampled
from benchmarks.edges import CAMERA, DEPTH, QUAD, TWO, mesh, tensor, turn
from benchmarks.pages.drawing import PALE, panels
from benchmarks.pose_recovery import VIEWS, eye, line
from benchmarks.report import table
from rts_compare.chart_style import PEER_COLORS, SPLATTER_COLORS

SPLATTERS = {"multi": SPLATTER_COLORS["multi"], "edges": PEER_COLORS["Mitsuba"]}
REACH, FINE = 0.6, 1000
"""Pixels on either side of the truth, and steps a pixel."""
STARTS = np.array([[1.3, -0.7], [-1.6, 0.4], [0.3, 1.8], [-0.9, -1.1], [1.9, 0.6]])

Scene = Callable[[float], rts.Part]


def pixel(size: int) -> float:
    """The width of a pixel in the plane through the origin, of an image of size²."""
    return 2 * DEPTH * np.tan(np.radians(20)) / size


def lines() -> dict[str, tuple[int, Scene]]:
    """For each scene the height of its image, and the part by its distance to the truth in pixels."""
    card = QUAD @ turn(0, 0, np.radians(5)).T
    scenes: dict[str, tuple[int, Scene]] = {
        "card, 5°": (48, lambda t: mesh((card + [t * pixel(48), 0, 0]).astype(np.float32), TWO))
    }
    for name, file in (("spot", "spot/spot_triangulated"), ("teapot", "teapot")):
        vertices, faces = welded(*meshes.mesh(file))
        scenes[name] = (
            128,
            lambda t, v=vertices, f=faces: mesh((v + [t * pixel(128), 0, 0]).astype(np.float32), f, "lambert"),
        )
    return scenes


def welded(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A mesh without copies of vertices, which files have at seams of uv, and where smooth normals would have seams."""
    vertices, first = np.unique(vertices.round(7), axis=0, return_inverse=True)
    return vertices, first.reshape(-1)[faces]


def along(size: int, scene: Scene, splatter: str) -> dict[str, Any]:
    """The loss along a line, its largest change of a pixel, and the share of steps that go the wrong way."""

    def image(t: float) -> np.ndarray:
        return rts.render(scene(t), CAMERA, (size, size), splatter=splatter)

    count = round(REACH * FINE)
    places, truth = np.arange(-count, count + 1) / FINE, image(0.0)
    recent: list[np.ndarray] = []
    losses, jump = np.zeros(len(places)), 0.0
    for index, place in enumerate(places):
        recent.append(image(place))
        losses[index] = np.mean((recent[-1] - truth) ** 2)
        if len(recent) > FINE // 200:
            jump = max(jump, float(np.abs(recent[-1] - recent.pop(0)).max()))
    # Steps of 1/80 pixel, from each of the places, away from the truth.
    step = FINE / 80
    starts = np.arange(0, count - step)
    ahead = np.interp(starts + step, np.arange(count + 1), losses[count:]) - losses[count:][starts.astype(int)]
    behind = np.interp(starts + step, np.arange(count + 1), losses[count::-1]) - losses[count::-1][starts.astype(int)]
    wrong = float(np.mean(np.concatenate([ahead, behind]) < 0))
    return {"places": places.tolist(), "losses": losses.tolist(), "jump": jump, "wrong": wrong}


def found_by_lbfgs(splatter: str, start: np.ndarray) -> tuple[float, int]:
    """Pixels that a card ends away from the truth, and images drawn."""
    card = tensor(QUAD @ turn(0, 0, np.radians(5)).T)
    drawn = 0

    def image(shift: torch.Tensor) -> torch.Tensor:
        nonlocal drawn
        drawn += 1
        moved = card + torch.cat([shift * pixel(48), torch.zeros(1)])
        return rts.render(mesh(moved, TWO), CAMERA, (48, 48), splatter=splatter)

    truth = image(torch.zeros(2)).detach()
    shift = torch.tensor(start, dtype=torch.float32, requires_grad=True)
    optimizer = torch.optim.LBFGS([shift], max_iter=60, line_search_fn="strong_wolfe", tolerance_change=1e-12)

    def closure() -> torch.Tensor:
        optimizer.zero_grad()
        loss = (image(shift) - truth).square().mean()
        loss.backward()
        return loss

    optimizer.step(closure)
    return float(shift.detach().norm()), drawn


class Task(pose_recovery.Task):
    """A mesh whose silhouettes have some number of samples a pixel."""

    def __init__(self, part: rts.Part, views: list[rts.Camera], splatter: str, samples: int):
        size = pose_recovery.SIZE

        def moved(pose: Any) -> rts.Part:
            return part.replace(transform=rts.rigid(pose))

        self.engine = "torch"
        targets = [supersampled(part, v, size, samples)[..., 3] for v in views]
        self.residuals = pose_recovery.Views(
            [
                rts.ImageResiduals(moved, v, size, target, layers=1, splatter=splatter)
                for v, target in zip(views, targets, strict=True)
            ]
        )


def poses(names: list[str], seeds: int, samples: int) -> dict[str, list[dict]]:
    """Fits by Levenberg–Marquardt from each seed, by mesh and splatter, with a line of a table each."""
    views, found = [camera(eye(*angles)) for angles in VIEWS], {}
    print("| mesh | samples | splatter | success | local minimum | ambiguous | angle | offset | steps | s | ms/step |")
    print("|---|---|---|---|---|---|---|---|---|---|---|", flush=True)
    for name in names:
        for splatter in SPLATTERS:
            task = Task(pose_recovery.silhouette_part(name), views, splatter, samples)
            rows = [task.run(seed, "lm") for seed in range(seeds)]
            found[f"{name}, {splatter}"] = rows
            print(line(name, f"{samples} × {samples}", splatter, rows), flush=True)
            done = [r for r in rows if r["outcome"] == "success"]
            angle, offset = (np.median([r[k] for r in done]) for k in ("angle", "offset"))
            print(f"  medians: {angle:.5f}°, {100 * offset:.5f} % of the size", flush=True)
    return found


def draw(path: Path, found: dict[str, dict[str, Any]]) -> None:
    """A chart a scene: the root of the loss along the line, near the truth."""
    figure, axes = panels(len(found), 3.3 * len(found), 2.9)
    for one, (name, rows) in zip(axes, found.items(), strict=True):
        for splatter, color in SPLATTERS.items():
            places, losses = (np.array(rows[splatter][key]) for key in ("places", "losses"))
            one.plot(places, np.sqrt(losses), color=color, lw=1.4, label=splatter)
        one.set_title(name, fontsize=10)
        one.set_xlabel("pixels from the truth")
        one.grid(color=PALE, alpha=0.2)
        one.set_ylim(0)
    axes[0].set_ylabel("error, root mean square")
    axes[0].legend(frameon=False)
    figure.savefig(path, dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=Path("out/edges_losses"))
    parser.add_argument("--only", nargs="+", choices=["lines", "lbfgs", "poses"], default=["lines", "lbfgs", "poses"])
    parser.add_argument("--meshes", nargs="+", default=["teapot", "bunny_5k"])
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--samples", type=int, default=16)
    args = parser.parse_args()
    args.output.mkdir(parents=True, exist_ok=True)
    if "lines" in args.only:
        found = {name: {s: along(*scene, s) for s in SPLATTERS} for name, scene in lines().items()}
        rows = [[name, *(f"{x['jump']:.4f} / {x['wrong']:.2%}" for x in r.values())] for name, r in found.items()]
        print(table(["jump / wrong", *SPLATTERS], rows), flush=True)
        draw(args.output / "edges_losses.png", found)
    if "lbfgs" in args.only:
        rows = []
        for start in STARTS:
            ends = [found_by_lbfgs(s, start) for s in SPLATTERS]
            rows.append([str(start.tolist()), *(f"{off:.5f} px, {drawn} images" for off, drawn in ends)])
        print(table(["start", *SPLATTERS], rows), flush=True)
    if "poses" in args.only:
        found = poses(args.meshes, args.seeds, args.samples)
        (args.output / f"poses_{args.samples}.json").write_text(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
