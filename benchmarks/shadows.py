"""Shadows: the places and derivatives of their edges against closed forms, and what a shadow costs.

A half-plane, a disk and a sphere, one unit above a floor, shade it in a distant and in a point light. *Place*: how far
the edge is off, a mean along it, in cells of the light's picture of 128². *Gain* and *error*: of the derivative image
on the floor, blurred by two cells, against the closed form's edge of the same width: their regression, and the norm of
their difference over that of the truth. *Ratio*: pictures of the light and a render in its shadow, over a render
without, for the gradient with torch; light and image have the same size.

    python -m benchmarks.shadows -o out/shadows
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
from pathlib import Path

import numpy as np
import torch
from scipy.ndimage import gaussian_filter

import rts
from benchmarks.report import table
from benchmarks.timing import in_turn
from rts_compare.environment import environment
from rts_diagnostics.example_shapes import icosphere

CELLS, POINTS = 128, 400
HALF = 1.6, 1.2
"""Half the extent of the points on the floor."""
RADIUS, START, ANGLE = 0.8, 0.013, math.radians(17)
"""The radius of disk and sphere; where the half-plane ends, and how it is turned."""
LIGHTS = {"distant": (0.3, 1.0, 0.2), "point": (0.8, 4.0, 0.5)}
SHAPES = ("half-plane", "disk", "sphere")
CHANGES = ("what casts it moves", "the light moves", "the floor moves", "what casts it grows")
SPREAD = 3**-0.5
"""Standard deviation of the cubic B-spline, cells."""
FLOOR = np.array([[-3, 0, -3], [3, 0, -3], [3, 0, 3], [-3, 0, 3]], float)
SQUARE = np.array([[0, 2, 1], [0, 3, 2]], np.int32)


def occluder(shape: str) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces."""
    if shape == "half-plane":
        c, s = math.cos(ANGLE), math.sin(ANGLE)
        corners = np.array([[-4, 1, -4], [START, 1, -4], [START, 1, 4], [-4, 1, 4]])
        return corners @ np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]]).T, SQUARE
    if shape == "disk":
        turn = np.linspace(0, 2 * np.pi, 400, endpoint=False)
        ring = RADIUS * np.stack([np.cos(turn), 0 * turn, np.sin(turn)], axis=1)
        faces = [[0, 1 + i, 1 + (i + 1) % 400] for i in range(400)]
        return np.concatenate([np.zeros((1, 3)), ring]) + [0, 1, 0], np.array(faces, np.int32)
    vertices, faces = icosphere(5)
    return RADIUS * vertices + [0, 1, 0], faces.astype(np.int32)


def floor_points() -> np.ndarray:
    """Points of the floor (400, 400, 3)."""
    x, z = np.meshgrid(np.linspace(-HALF[0], HALF[0], POINTS), np.linspace(-HALF[1], HALF[1], POINTS))
    return np.stack([x, 0 * x, z], axis=-1)


def camera_of(name: str, light: torch.Tensor) -> rts.Camera:
    if name == "point":
        return rts.Camera.look_at(light, (0, 0, 0), fov_y=50, aspect=1.0)
    eye = 6 * light / torch.linalg.norm(light)
    return rts.Camera.orthographic(eye, torch.zeros(3).double(), height=5.0, aspect=1.0, far=12.0)


def found(shape: str, name: str, change: str) -> tuple[np.ndarray, np.ndarray]:
    """Visibility (400, 400) of the floor, and its derivative."""
    vertices, faces = occluder(shape)
    x, y, above = (torch.tensor(v, dtype=torch.float64) for v in ((1, 0, 0), (0, 1, 0), (0, 1, 0)))

    def share(t: torch.Tensor) -> torch.Tensor:
        cast, floor, points = torch.tensor(vertices), torch.tensor(FLOOR), torch.tensor(floor_points()).reshape(-1, 3)
        light = torch.tensor(LIGHTS[name], dtype=torch.float64)
        if change == "what casts it moves":
            cast = cast + t * x
        elif change == "the light moves":
            light = light + t * x
        elif change == "the floor moves":
            floor, points = floor + t * y, points + t * y
        else:
            cast = (1 + t) * (cast - above) + above
        parts = [rts.Part(rts.Mesh(faces), {"vertices": cast}), rts.Part(rts.Mesh(SQUARE), {"vertices": floor})]
        seen = rts.shadows.seen_from(parts, camera_of(name, light), (CELLS, CELLS))
        return rts.shadows.visibility(seen, points).reshape(POINTS, POINTS)

    value, slope = torch.func.jvp(share, (torch.tensor(0.0).double(),), (torch.tensor(1.0).double(),))
    return value.numpy(), slope.numpy()


def inside(shape: str, name: str, change: str, t: float) -> np.ndarray:
    """A function of points of the floor (400, 400) that is positive in the closed form's shadow."""
    points, light = floor_points(), np.array(LIGHTS[name])
    shift, size = t * (change == "what casts it moves"), 1 + t * (change == "what casts it grows")
    light = light + np.array([t, 0, 0]) * (change == "the light moves")
    points[..., 1] += t * (change == "the floor moves")
    toward = light - points if name == "point" else np.broadcast_to(light, points.shape)
    if shape == "sphere":
        way, offset = toward / np.linalg.norm(toward, axis=-1, keepdims=True), np.array([shift, 1, 0]) - points
        return RADIUS * size - np.linalg.norm(offset - (offset * way).sum(-1, keepdims=True) * way, axis=-1)
    hit = points + ((1 - points[..., 1]) / toward[..., 1])[..., None] * toward
    x, z = hit[..., 0] - shift, hit[..., 2]
    if shape == "disk":
        return RADIUS * size - np.hypot(x, z)
    return START - x * math.cos(ANGLE) - z * math.sin(ANGLE)


def figures(shape: str, name: str, change: str) -> dict[str, float]:
    """Place, gain and error."""
    value, slope = found(shape, name, change)
    step, small = (2 * HALF[0] / (POINTS - 1), 2 * HALF[1] / (POINTS - 1)), 1e-5
    cell = 5 / CELLS if name == "distant" else 2 * math.tan(math.radians(25)) * LIGHTS["point"][1] / CELLS
    f = inside(shape, name, change, 0.0)
    speed = (inside(shape, name, change, small) - inside(shape, name, change, -small)) / (2 * small)
    steep = np.maximum(np.hypot(*np.gradient(f, step[1], step[0])), 1e-9)
    edge = np.exp(-((f / steep / (SPREAD * cell)) ** 2) / 2) / (SPREAD * cell * math.sqrt(2 * math.pi))
    truth, kept = -edge * speed / steep, np.zeros_like(f)
    kept[20:-20, 20:-20] = 1
    lit = 0.5 - 0.5 * torch.erf(torch.tensor(f / steep / (SPREAD * cell * math.sqrt(2)))).numpy()
    place = ((value - lit) * kept).sum() / (edge * kept).sum() / cell
    blurred = [gaussian_filter(image * kept, (2 * cell / step[1], 2 * cell / step[0])) for image in (slope, truth)]
    norm = np.linalg.norm(blurred[1])
    gain = (blurred[0] * blurred[1]).sum() / norm**2
    return {"place": place, "gain": gain, "error": np.linalg.norm(blurred[0] - blurred[1]) / norm}


def times(rounds: int) -> dict[str, dict]:
    """Milliseconds of gradients without and with a shadow."""
    vertices, faces = icosphere(4)
    cast = torch.tensor(RADIUS * vertices + [0, 1, 0], dtype=torch.float32, requires_grad=True)
    parts = [
        rts.Part(rts.Mesh(SQUARE), {"vertices": FLOOR.astype(np.float32)}, "lambert"),
        rts.Part(rts.Mesh(faces.astype(np.int32)), {"vertices": cast}, "lambert"),
    ]
    light = {"direction": np.array(LIGHTS["distant"], np.float32)}
    plain = [part.replace(theta={**part.theta, "light": light}) for part in parts]
    camera, bounds = rts.Camera.look_at((2.5, 3.0, 5.0), (0, 0.4, 0), fov_y=40), ((0, 0, 0), 4.3)
    calls = {}
    for size in (256, 512):
        calls[f"{size} without"] = lambda n=size: rts.render(plain, camera, (n, n)).sum().backward()
        calls[f"{size} with"] = lambda n=size: (
            rts.render(rts.shadows.with_shadows(parts, light, size=n, bounds=bounds), camera, (n, n)).sum().backward()
        )
    return in_turn(calls, rounds)


def written(rows: list[dict], timed: dict[str, dict]) -> str:
    """Both tables."""
    header = ["shadow of", "light", "change", "place, cells", "gain", "error"]
    lines = [[*row["case"], f"{row['place']:+.2f}", f"{row['gain']:.3f}", f"{row['error']:.3f}"] for row in rows]
    costs = []
    for size in (256, 512):
        without, with_one = timed[f"{size} without"]["ms"], timed[f"{size} with"]["ms"]
        costs.append([f"{size}²", f"{without:.0f}", f"{with_one:.0f}", f"{with_one / without:.1f}"])
    cost = table(["image and light", "without, ms", "with a shadow, ms", "ratio"], costs)
    return table(header, lines) + "\n" + cost


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=Path("out/shadows"))
    parser.add_argument("--rounds", type=int, default=7)
    args = parser.parse_args()
    args.output.mkdir(parents=True, exist_ok=True)
    rows = [
        {"case": (shape, name, change), **figures(shape, name, change)}
        for shape, name, change in itertools.product(SHAPES, LIGHTS, CHANGES)
        if not (shape == "half-plane" and change == CHANGES[3])
    ]
    timed = times(args.rounds)
    about = environment(("numpy", "numba", "torch"))
    (args.output / "shadows.json").write_text(json.dumps(about | {"edges": rows, "times": timed}, indent=2) + "\n")
    text = written(rows, timed)
    (args.output / "shadows.md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
