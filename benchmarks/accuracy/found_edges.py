"""Found edges beside the paper's splatter on the scenes of other measurements: errors of derivatives.

Errors are in each pixel and low-passed.

The scenes are those of `accuracy.run`, `accuracy.crossing_scenes`, `accuracy.other_motions` and `thin`, the derivative
images of `rts_compare.stability`, and those of `benchmarks.edges`. All have as many layers as a scene asks for, `edges`
one where all is opaque. Truths are closed forms, or differences over ±0.15 pixels of area-sampled renders. Rows are
kept in a file, from which a run that is interrupted goes on, and of which the summary is made:

    python -m benchmarks.accuracy.found_edges -o out/found_edges
    python -m benchmarks.accuracy.found_edges --suites thin crossings
    python -m benchmarks.accuracy.found_edges --summary benchmarks/results/found_edges.json
"""

from __future__ import annotations

import argparse
import json
import statistics
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import rts
from benchmarks import edges, thin
from benchmarks.accuracy import closed_forms, crossing_scenes, methods, other_motions, scenes
from benchmarks.report import table
from rts_compare.derivative_scores import all_scores
from rts_compare.failures.method_renderers import Own, quiet
from rts_compare.failures.row_measures import Derivative, Several, pixel_of
from rts_compare.failures.table_rows import ROWS
from rts_compare.moving_scenes import Scene
from rts_compare.true_derivatives import truth

SIZE = 128
"""Pixels along each side of the scenes of `accuracy.run` and `accuracy.crossing_scenes`."""
STEP = 0.3
"""Length of the truth's central difference, pixels."""
LOW, GAIN, WORSE = 0.08, 0.03, 0.02
"""The largest low-passed error and difference of the gain from 1 of a scene within; the least that counts as worse."""
METHODS: dict[str, dict[str, Any]] = {
    "multi": {"splatter": "multi"},
    "edges": {"splatter": "edges"},
}


class Row(NamedTuple):
    """A scene's derivative, by all methods.

    Attributes:
        suite: the measurement that the scene is of.
        scene: its name.
        noise: estimated errors of the truth, in each pixel and low-passed; 0 for a closed form.
        found: method → relative L2 error in each pixel, low-passed, and the low-passed gain.
    """

    suite: str
    scene: str
    noise: tuple[float, float]
    found: dict[str, tuple[float, float, float]]


class Case(NamedTuple):
    """A derivative to measure: the true one and its two halves (H, W, 3), and functions that give it by method."""

    true: np.ndarray
    halves: tuple[np.ndarray, np.ndarray]
    ways: dict[str, Callable[[], np.ndarray]]


def measured(suite: str, name: str, case: Case) -> Row:
    """Score a case by all of its methods."""
    apart = all_scores(case.true + (case.halves[0] - case.halves[1]) / 2, case.true)
    found = {}
    for method, derivative in case.ways.items():
        row = all_scores(derivative(), case.true)
        found[method] = (row["relative_l2"], row["low_relative_l2"], row["low_gain"])
    return Row(suite, name, (apart["relative_l2"], apart["low_relative_l2"]), found)


def options(layers: int) -> dict[str, dict[str, Any]]:
    """Options of `rts.render` by method, with a number of layers."""
    return {name: {"layers": layers, **given} for name, given in METHODS.items()}


def of_scene(scene: Scene, mode: str, pixel: float, layers: int, samples: int, folder: Path, **more: Any) -> Case:
    """The case of a scene along a mode; see `truth`. `more`: `reference`, another scene of the same image; `dtype`."""
    reference, dtype = more.get("reference", scene), more.get("dtype", np.float32)
    step = pixel if reference is scene else pixel_of(reference, mode)
    with quiet():
        true, _, halves = truth(reference, mode, step, samples=samples, step=STEP, folder=folder)
    ways = {
        name: partial(lambda given: Own(scene, given, dtype).derivative(mode) * pixel, given)
        for name, given in options(layers).items()
    }
    return Case(true, (halves[0], halves[1]), ways)


def of_accuracy(name: str, folder: Path, turned_over: bool = False) -> Case:
    """A scene of `accuracy.run` or `accuracy.crossings`; with back faces the other way if `turned_over`."""
    crossing = crossing_scenes.CROSSING
    scene = crossing[name](SIZE) if name in crossing else scenes.scene(name, SIZE)
    closed, true = closed_forms.closed_form(scene), scene
    if turned_over:
        other = methods.turned_over(scene)
        assert other is not None
        scene = other
    exact = (
        closed.truth()
        if closed
        else truth(true.moving, scenes.MOTION, 1.0, samples=8, step=STEP, grids=scenes.grids, folder=folder)
    )
    ways = {
        name: partial(lambda given: Own(scene.moving, given).derivative(scenes.MOTION), given)
        for name, given in options(scene.layers[-1]).items()
    }
    return Case(exact.derivative, (exact.grids[0], exact.grids[1]), ways)


def of_motion(motion: other_motions.Motion) -> Case:
    """A body of `accuracy.other_motions`."""
    body = other_motions.Body(motion)
    halves = body.differences(motion.velocity, STEP, points=16)
    ways = {name: partial(body.forward, **given) for name, given in options(2).items()}
    return Case((halves[0] + halves[1]) / 2, (halves[0], halves[1]), ways)


def of_edges(scene: edges.SceneAt) -> Case:
    """A scene of `benchmarks.edges`."""
    first, second = (edges.truth(scene, samples)[1][..., :3] for samples in (20, 23))
    ways = {
        name: partial(
            lambda given: edges.derivative(lambda t: rts.render(scene(t), edges.CAMERA, edges.SIZE, **given)[..., :3])[
                1
            ],
            given,
        )
        for name, given in options(2).items()
    }
    return Case((first + second) / 2, (first, second), ways)


def of_failure(row: Derivative, folder: Path, samples: int) -> Case:
    """A derivative image of `rts_compare.stability`."""
    scene = row.scene()
    mode = next(iter(scene.directions)) if row.mode is None else row.mode
    pixel = pixel_of(scene, mode) if row.pixel is None else row.pixel
    more: dict[str, Any] = {"dtype": np.float64 if row.double else np.float32}
    if row.reference is not None:
        more["reference"] = row.reference()
    parts, _ = scene.at(scene.parameters)
    glass = any(not getattr(part.shader, "opaque", True) for part in parts)
    return of_scene(scene, mode, pixel, 6 if glass else 2, samples, folder, **more)


def failures(folder: Path) -> Iterator[tuple[str, Callable[[], Case]]]:
    """All derivative images of `rts_compare.stability` by name, but for wires, which `thin` has."""
    for row in ROWS:
        found = row.measure.derivatives if isinstance(row.measure, Several) else (row.measure,)
        for number, derivative in enumerate(found, 1):
            if isinstance(derivative, Derivative) and not row.name.startswith("wires"):
                name = row.name if len(found) == 1 else f"{row.name}: {number}"
                yield name, partial(of_failure, derivative, folder, 16)


def cases(folder: Path) -> dict[str, Mapping[str, Callable[[], Case]]]:
    """Suite → scene → the function that makes its case."""
    accuracy = {name: partial(of_accuracy, name, folder) for name in scenes.SCENES}
    for name in methods.CLOSED:
        other = methods.turned_over(scenes.scene(name, SIZE))
        assert other is not None
        accuracy[other.name] = partial(of_accuracy, name, folder, turned_over=True)
    moving = {name: motion for name, motion in other_motions.motions().items() if not motion.still}
    points = thin.POINTS
    return {
        "crossings": {name: partial(of_accuracy, name, folder) for name in crossing_scenes.CROSSING},
        "motions": {name: partial(of_motion, motion) for name, motion in moving.items()},
        "thin": {name: partial(of_failure, Derivative(make), folder, points) for name, make in thin.SCENES.items()},
        "stability": dict(failures(folder)),
        "accuracy": accuracy,
        "edges": {name: partial(of_edges, scene) for name, scene in edges.scenes().items()},
    }


def kept(path: Path) -> list[Row]:
    """The rows of a file, one a line; none if there is no such file."""
    if not path.exists():
        return []
    return [Row(**row) for row in json.loads(path.read_text())]


def write(path: Path, rows: list[Row]) -> None:
    """Write rows to a file, one a line."""
    lines = [json.dumps(row._asdict(), ensure_ascii=False) for row in rows]
    path.write_text("[\n" + ",\n".join(lines) + "\n]\n")


def within(found: tuple[float, float, float]) -> bool:
    """True if a low-passed error and a gain are small enough."""
    return found[1] <= LOW and abs(found[2] - 1) <= GAIN


def summary(rows: list[Row]) -> str:
    """Medians and shares by suite and method; then the rows where `edges` is worse than `multi`."""
    lines = []
    for suite in [*dict.fromkeys(row.suite for row in rows), "all"]:
        own = [row for row in rows if suite in ("all", row.suite)]
        cells = []
        for method in METHODS:
            found = [row.found[method] for row in own]
            medians = [statistics.median(x[i] for x in found) for i in range(3)]
            share = sum(map(within, found)) / len(found)
            cells.append("{:.3f} / {:.3f} / {:.3f} / {:.0f} %".format(*medians, 100 * share))
        lines.append([suite, str(len(own)), *cells])
    worse = [r for r in rows if r.found["edges"][1] > r.found["multi"][1] + WORSE]
    beyond = [r for r in rows if not within(r.found["edges"])]
    return "\n".join(
        [
            table(["scenes of", "scenes", *METHODS], lines),
            "Low-passed worse than `multi`:\n\n" + _listed(worse),
            "Not within:\n\n" + _listed(beyond),
        ]
    )


def _listed(rows: list[Row]) -> str:
    return table(["scenes of", "scene", *METHODS, "noise"], [[r.suite, r.scene, *texts(r)] for r in rows])


def texts(row: Row) -> list[str]:
    """Cells of a row: errors and gain by method, and the truth's noise."""
    found = ["{:.3f} / {:.3f} / {:.3f}".format(*row.found[method]) for method in METHODS]
    return [*found, "{:.3f} / {:.3f}".format(*row.noise)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=Path("out/found_edges"))
    parser.add_argument("--suites", nargs="+", help="all by default")
    parser.add_argument("--truth", type=Path, default=Path("out/truth"), help="where truths are kept")
    parser.add_argument("--fresh", action="store_true", help="measure anew what earlier runs have measured")
    parser.add_argument("--summary", type=Path, metavar="FILE", help="measure nothing, print the summary of a file")
    args = parser.parse_args()
    if args.summary:
        print(summary(kept(args.summary)))
        return
    args.output.mkdir(parents=True, exist_ok=True)
    path = args.output / "found_edges.json"
    rows = {} if args.fresh else {(row.suite, row.scene): row for row in kept(path)}
    for suite, found in cases(args.truth).items():
        for name, make in found.items():
            if (args.suites and suite not in args.suites) or (suite, name) in rows:
                continue
            rows[suite, name] = measured(suite, name, make())
            print(suite, name, *texts(rows[suite, name]), sep=" | ", flush=True)
            write(path, list(rows.values()))
    print(summary(list(rows.values())))


if __name__ == "__main__":
    main()
