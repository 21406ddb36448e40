"""Things thinner than pixels: errors of derivatives by the number of samples a pixel, beside Mitsuba.

Errors are of `rts_compare.stability` (low-passed relative L2 of the derivative image), against derivatives of 24 × 24
points a pixel, since 8 × 8 of that table are themselves off by 0.08, 0.14 and 0.23 for wires. Times are processor time
of a render and its derivative.

    python -m benchmarks.thin
    python -m benchmarks.thin --mitsuba 4 16 64
    python -m benchmarks.thin --truths 8 16
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

import rts
from benchmarks.report import table
from rts_compare import scene_shapes
from rts_compare.failures import failure_scenes
from rts_compare.failures.method_renderers import renderer
from rts_compare.failures.row_measures import Derivative
from rts_compare.failures.table_cells import Context
from rts_compare.failures.table_columns import Method
from rts_compare.moving_scenes import Scene

SAMPLES = {"1": 1, "2 × 2": 2, "4 × 4": 4, "8 × 8": 8}
POINTS = 24
"""The square root of the number of points a pixel of true derivatives, on each of two grids."""
PIXEL = scene_shapes.pixel(scene_shapes.DISTANCE, failure_scenes.SIZE[0])
"""The width of a pixel in the plane through the origin."""


def tube(points: np.ndarray, radius: float, sides: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces of a tube around a line of points (N, 3)."""
    along = np.gradient(points, axis=0)
    across = np.cross(along, [0, 0, 1.0])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    other = np.cross(along / np.linalg.norm(along, axis=1, keepdims=True), across)
    angle = np.arange(sides) * 2 * np.pi / sides
    ring = np.cos(angle)[:, None] * across[:, None] + np.sin(angle)[:, None] * other[:, None]
    first = (np.arange(len(points) - 1)[:, None] * sides + np.arange(sides)).reshape(-1)
    second = (np.arange(len(points) - 1)[:, None] * sides + np.roll(np.arange(sides), -1)).reshape(-1)
    faces = [np.stack([first, second, second + sides], 1), np.stack([first, second + sides, first + sides], 1)]
    return (points[:, None] + radius * ring).reshape(-1, 3), np.concatenate(faces)


def together(pieces: list[tuple[np.ndarray, np.ndarray]], color: tuple[float, float, float]) -> rts.Part:
    """One part of several pieces."""
    firsts = np.cumsum([0, *(len(v) for v, _ in pieces)])
    faces = np.concatenate([f + n for (_, f), n in zip(pieces, firsts, strict=False)])
    return scene_shapes.unlit(np.concatenate([v for v, _ in pieces]), faces, color)


def cones() -> rts.Part:
    """Six slanted cones of twelve sides, four pixels wide at the base."""
    angle, pieces = np.arange(12) * np.pi / 6, []
    sides = [(k, 12, (k + 1) % 12) for k in range(12)] + [((k + 1) % 12, 13, k) for k in range(12)]
    for i in range(6):
        base = np.column_stack([0.06 * np.cos(angle), np.full(12, -0.6), 0.06 * np.sin(angle)])
        turn = np.radians(15 * (i - 2.5))
        matrix = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
        corners = np.vstack([base, [0, 0.6, 0], [0, -0.6, 0]]) @ matrix.T + [0.3 * i - 0.75, 0, 0]
        pieces.append((corners, np.array(sides)))
    return together(pieces, (0.3, 0.8, 1.0))


def hair() -> rts.Part:
    """Five hundred bent tubes, a fifth of a pixel wide."""
    rng, s, pieces = np.random.default_rng(0), np.linspace(0, 1, 9), []
    for _ in range(500):
        x, y, bend, depth = rng.uniform(-0.7, 0.7), rng.uniform(-0.2, 0.75), rng.normal(0, 0.25), 0.2 * rng.random()
        line = np.column_stack([x + bend * s**2 + 0.03 * np.sin(9 * s + 5 * x), y - 0.55 * s, depth + 0 * s])
        pieces.append(tube(line, 0.1 * PIXEL, 5))
    return together(pieces, (0.9, 0.7, 0.4))


def fence() -> rts.Part:
    """A chain-link fence of wires a quarter of a pixel wide."""
    along, pieces = np.linspace(-0.7, 0.7, 29), []
    turns = np.arange(29)
    for i in range(-8, 9):
        for side in (1, -1):
            x = 0.1 * i + 0.05 * side * np.where(turns % 2, 1, -1)
            depth = 0.01 * side * np.cos(np.pi * turns / 2)
            pieces.append(tube(np.column_stack([x, along, depth]), 0.125 * PIXEL, 4))
    return together(pieces, (0.8, 0.8, 0.85))


def posed(make: Callable[[], rts.Part]) -> Scene:
    """A part that is moved to the right."""
    return failure_scenes.posed(make.__name__, make(), ("tx",))


SCENES: dict[str, Callable[[], Scene]] = {
    **{f"wires of {width:g} px": partial(failure_scenes.wires, width) for width in (1.0, 0.5, 0.25)},
    **{make.__name__: partial(posed, make) for make in (cones, hair, fence)},
}


def cell(scene: Scene, method: Method, context: Context) -> str:
    """The error of a method, and its time."""
    numbers, drawn, times = Derivative(lambda: scene).numbers(method, context), renderer(scene, method), []
    for _ in range(5):
        start = time.process_time()
        drawn.derivative(next(iter(scene.directions)))
        times.append(time.process_time() - start)
    return f"{numbers['error']:.3f}, {1e3 * statistics.median(times):.0f} ms"


def errors(output: Path, spp: list[int]) -> str:
    """The table of errors; `spp` are Mitsuba's samples a pixel."""
    context = Context(samples=POINTS, folder=output / "truths")
    methods = {name: Method(name, {"splatter": "edges", "supersample": s}) for name, s in SAMPLES.items()}
    methods |= {f"Mitsuba, {n} spp": Method("Mitsuba", {"spp": n}, "Mitsuba") for n in spp}
    made = {name: make() for name, make in SCENES.items()}
    rows = [[name, *(cell(scene, m, context) for scene in made.values())] for name, m in methods.items()]
    return table(["samples", *made], rows)


def noise(output: Path, points: list[int]) -> str:
    """The table of estimated errors of true derivatives, of so many points a pixel along each side."""
    plain, rows = Method("1", {"splatter": "edges"}), []
    for n in points:
        context = Context(samples=n, folder=output / "truths")
        found = [Derivative(make).numbers(plain, context)["truth_error"] for make in SCENES.values()]
        rows.append([f"{n} × {n}", *(f"{x:.2f}" for x in found)])
    return table(["points", *SCENES], rows)


def draw(path: Path) -> None:
    """The scenes as pictures, by what is sampled."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    shown = list(SAMPLES)
    parts = [scene_shapes.wires(failure_scenes.SIZE[0], [0.25] * 7), cones(), hair(), fence()]
    figure, axes = plt.subplots(len(parts), len(shown), figsize=(12, 12))
    for row, part in zip(axes, parts, strict=True):
        for place, name in zip(row, shown, strict=True):
            image = np.asarray(rts.render(part, scene_shapes.camera(), failure_scenes.SIZE, supersample=SAMPLES[name]))
            place.imshow(image[..., :3].clip(0, 1) ** (1 / 2.2), interpolation="nearest")
            place.set(title=name, xticks=[], yticks=[])
    figure.tight_layout()
    figure.savefig(path, dpi=80)
    plt.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=Path("out/thin"))
    parser.add_argument("--mitsuba", type=int, nargs="*", default=[], metavar="SPP")
    parser.add_argument(
        "--truths", type=int, nargs="*", default=[], metavar="POINTS", help="errors of the truth itself"
    )
    given = parser.parse_args()
    (given.output / "truths").mkdir(parents=True, exist_ok=True)
    if given.truths:
        print(noise(given.output, given.truths))
        return
    print(errors(given.output, given.mitsuba))
    draw(given.output / "thin.png")


if __name__ == "__main__":
    main()
