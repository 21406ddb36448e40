"""Fits from one view that only lines of crossing make possible: how deep a thing is, where nothing else tells.

*Card*: its edges are outside of the picture, and it cuts a sphere; the camera is orthographic. All that changes with
its depth is the circle. *Hand*: spheres in one rigid body, pressed into a box; its six numbers are sought, from starts
off by degrees and parts of its size. With lines of crossing that move as depths say, without, and by found edges:

    python -m benchmarks.crossing_fits -o out/crossing_fits
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.progress import track

import rts
from benchmarks.camera import camera, supersampled
from benchmarks.meshes import rotation_xy
from benchmarks.outline_fits import strip
from benchmarks.report import table
from rts.diagnostics.example_shapes import QUAD, box, icosphere, unlit

SIZE, STEPS = (128, 128), {"lm": 60, "adam": 300}
SPHERE, CARD_AT, CARD_STARTS = 0.8, 0.45, (0.2, 0.3, 0.55, 0.65)
"""The sphere's radius; the card's place along the view, and those that fits start from."""
FINGERS, JOINTS = 5, 3
HAND_SIZE, HAND_AT = 1.3, np.array([0.05, -0.04, 0.2, 0.05, -0.08, 0.0])
"""The hand's extent, and its pose beside that of the box: rotation vector, then place."""
PRESSED, TILT = 0.5, (-0.35, 0.1)
"""How far below the box's upper side centres of spheres are, in terms of their radii; and the box's turns, radians."""
TURN, SHIFT, RUNS = 6.0, 0.08, 10
"""How far off a start is: degrees, and share of the hand's size; and how many are tried."""
COLORS = np.array([[0.85, 0.6, 0.45], [0.25, 0.45, 0.7]])


WAYS: dict[str, Any] = {
    "as samples": rts.plugin("rts.splatters", "visible")(crossings=False),
    "as depths": "visible",
    "edges": "edges",
}
"""Splatters."""


def ball() -> rts.Part:
    """The sphere that the card cuts."""
    vertices, faces = icosphere(5)
    return unlit(SPHERE * vertices, faces, COLORS[0])


def cut_sphere(depth: Any) -> list[rts.Part]:
    """The sphere and the card, at a depth ()."""
    corners = 2.0 * np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    shift = np.eye(4)
    if isinstance(depth, torch.Tensor):
        along = torch.zeros(4, 4)
        along[2, 3] = 1.0
        return [ball(), unlit(corners, QUAD, COLORS[1]).replace(transform=torch.eye(4) + depth * along)]
    shift[2, 3] = depth
    return [ball(), unlit(corners, QUAD, COLORS[1]).replace(transform=shift)]


def hand() -> rts.Part:
    """Spheres in the box's upper side: a palm, and joints of fingers. All that is seen of them is caps."""
    vertices, faces = icosphere(3)
    spheres = [(0.0, -0.25, 0.34)]
    for i in range(FINGERS):
        angle = np.radians(np.linspace(-60, 60, FINGERS)[i])
        for j in range(JOINTS):
            reach, radius = 0.42 + 0.17 * j, 0.13 - 0.02 * j
            spheres.append((reach * np.sin(angle), -0.25 + reach * np.cos(angle), radius))
    count = len(vertices)
    points = np.concatenate([np.array([x, y, -PRESSED * r]) + r * vertices for x, y, r in spheres])
    triangles = np.concatenate([faces + i * count for i in range(len(spheres))])
    shades = np.repeat(np.linspace(0.8, 1.15, len(spheres)), count)[:, None]
    return unlit(points @ rotation_xy(*TILT).T, triangles, (COLORS[0] * shades).clip(0, 1), "back")


def pressed_hand(pose: Any) -> list[rts.Part]:
    """The hand at a pose (6,), and the box, whose upper side is seen slantwise."""
    vertices, faces = box((-1.0, -0.9, -0.7), (1.0, 0.9, 0.0))
    board = unlit(vertices @ rotation_xy(*TILT).T, faces, COLORS[1], "back")
    return [hand().replace(transform=rts.rigid(pose)), board]


def fitted(scene: Callable, view: rts.Camera, goal: Any, start: Any, method: str, way: str) -> np.ndarray:
    """The parameters that are found, from the picture of `goal`."""
    target = supersampled(scene(goal), view, SIZE, 8)[..., :3].astype(np.float32)
    residuals = rts.ImageResiduals(scene, view, SIZE, target, layers=3, splatter=WAYS[way])
    options: dict[str, Any] = {"learning_rate": 0.01} if method == "adam" else {}
    first = torch.tensor(start, dtype=torch.float32)
    found = rts.fit(residuals, first, method=method, steps=STEPS[method], progress=False, **options)
    return np.asarray(found.parameters, np.float64)


def card_rows(method: str, ways: list[str]) -> list[dict]:
    """The card's error of position, in diameters of the sphere."""
    view, rows = rts.Camera.orthographic((0, 0, 4), (0, 0, 0), height=2.2), []
    for start in track(CARD_STARTS, description=f"card, {method}", transient=True):
        for way in ways:
            found = fitted(cut_sphere, view, np.float64(CARD_AT), start, method, way)
            rows.append({"start": start, "way": way, "off": abs(float(found) - CARD_AT) / (2 * SPHERE)})
    return rows


def hand_rows(method: str, ways: list[str]) -> list[dict]:
    """Errors of the hand's last poses: degrees, and share of its size; and the poses."""
    rows = []
    for seed in track(range(RUNS), description=f"hand, {method}", transient=True):
        rng = np.random.default_rng(seed)
        turn, shift = (x / np.linalg.norm(x) for x in rng.normal(size=(2, 3)))
        start = HAND_AT + np.concatenate([np.radians(TURN) * turn, SHIFT * HAND_SIZE * shift])
        for way in ways:
            pose = fitted(pressed_hand, camera(), HAND_AT, start, method, way)
            rows.append({"seed": seed, "way": way, "start": start.tolist(), "pose": pose.tolist(), **off(pose)})
    return rows


def off(pose: np.ndarray) -> dict[str, float]:
    """The distance of a pose from the hand's."""
    a, b = (np.asarray(rts.rigid(x))[:3, :3] for x in (pose, HAND_AT))
    cosine = (np.trace(a.T @ b) - 1) / 2
    shift = pose[3:] - HAND_AT[3:]
    return {
        "angle": float(np.degrees(np.arccos(np.clip(cosine, -1, 1)))),
        "offset": float(np.linalg.norm(shift) / HAND_SIZE),
        "depth": float(abs(shift[2]) / HAND_SIZE),
    }


def pictures(rows: list[dict]) -> list[np.ndarray]:
    """The hand's target, the first start, and what was found from it in each way."""
    found = [row["pose"] for row in rows if row["seed"] == rows[0]["seed"]]
    poses = [HAND_AT, rows[0]["start"], *map(np.array, found)]
    return [supersampled(pressed_hand(np.asarray(pose)), camera(), SIZE, 4) for pose in poses]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=Path("out/crossing_fits"))
    parser.add_argument("--methods", nargs="+", default=["lm", "adam"])
    parser.add_argument("--ways", nargs="+", choices=list(WAYS), default=list(WAYS))
    args = parser.parse_args()
    args.output.mkdir(parents=True, exist_ok=True)
    results: dict[str, Any] = {}
    lines = []
    for method in args.methods:
        card, found = card_rows(method, args.ways), hand_rows(method, args.ways)
        results[method] = {"card": card, "hand": found}
        for name in args.ways:
            offs = [row["off"] for row in card if row["way"] == name]
            rows = [row for row in found if row["way"] == name]
            near = sum(row["angle"] < 1 and row["offset"] < 0.01 for row in rows)
            medians = (f"{np.median([row[key] for row in rows]):.4f}" for key in ("angle", "offset", "depth"))
            lines.append([method, name, *(f"{100 * x:.2f} %" for x in offs), f"{near} of {len(rows)}", *medians])
            print(*lines[-1], flush=True)
    starts = (f"card from {x:g}" for x in CARD_STARTS)
    print(table(["method", "lines move", *starts, "hand found", "angle, °", "offset", "depth"], lines))
    (args.output / "crossing_fits.json").write_text(json.dumps(results, indent=1))
    strip(pictures(results[args.methods[0]]["hand"]), args.output / "hand.png")


if __name__ == "__main__":
    main()
