"""Errors of derivatives of images: splatters, layers and samples a pixel, over all scenes, beside other renderers.

Derivative images by forward mode are scored against differences of area-sampled renders over one pixel
(`Scene.truth`), and after its low-pass against the derivative itself: a closed form, or a difference over a quarter of
a pixel, or over more where outlines hardly move. Writes tables (accuracy.md), all numbers (accuracy.json) and three
figures:

    python -m benchmarks.accuracy.run -o out/accuracy
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rich.progress import Progress

from benchmarks.accuracy import figures, methods, scenes, tables
from benchmarks.accuracy.closed_forms import closed_form
from benchmarks.accuracy.methods import CASES, Method
from rts_compare.derivative_scores import all_scores, loss_weights
from rts_compare.environment import environment
from rts_compare.true_derivatives import Truth

SPP = (1, 4, 16, 64, 256)
QUICK = ("A", "half-plane")
PACKAGES = ("numpy", "torch", "numba", "deodr", "mitsuba", "drjit")
ROUNDS, BUDGET = 5, 40.0
"""How often a time is taken, and the seconds after which a slow method has had its turns."""


class References(NamedTuple):
    """The truths of derivatives: differences over a pixel, and the derivative itself as nearly as known."""

    pixel: Truth
    exact: Truth


def references(scene: scenes.Scene, folder: Path) -> References:
    closed = closed_form(scene)
    return References(scene.truth(folder), closed.truth() if closed else scene.truth(folder, scene.step))


def score(scene: str, method: Method, against: References) -> tuple[dict, np.ndarray]:
    """A row of the results, the mean of its seeds' scores, and the derivative image of the first seed."""
    images = [method.derivative(seed) for seed in range(method.seeds)]
    row: dict = {"scene": scene, "method": method.name}
    for name, reference in against._asdict().items():
        found = [all_scores(image, reference.derivative) for image in images]
        row[name] = {key: statistics.fmean(f[key] for f in found) for key in found[0]}
    row["seeds"] = [all_scores(image, against.exact.derivative)["low_relative_l2"] for image in images]
    return row, images[0]


def seconds(turns: dict[str, Callable[[], object]], done: Callable[[], None]) -> dict[str, list[float]]:
    """Times of each function, taking turns after a warm-up; a slow one has fewer turns."""
    times: dict[str, list[float]] = {name: [] for name in turns}
    for _ in range(ROUNDS):
        for name, function in turns.items():
            if sum(times[name]) < BUDGET:
                start = time.perf_counter()
                function()
                times[name].append(time.perf_counter() - start)
            done()
    return times


def timed(scene: scenes.Scene, others: list[Method], done: Callable[[], None]) -> list[dict]:
    """Render and gradient of a loss in the scalar motion, by each method."""
    weights = np.array(loss_weights(*scene.size)[0])
    chosen = [*(methods.ours(scene, "edges", 1, s) for s in (1, 2, 4)), *others]
    # The fewest samples compile the same loops as many.
    fewest = next((m for m in chosen if m.name.startswith("Mitsuba")), None)
    for method in chosen:
        if method is fewest or not method.name.startswith("Mitsuba"):
            method.gradient(weights)
    times = seconds({m.name: lambda m=m: m.gradient(weights) for m in chosen}, done)
    return [
        {"scene": scene.name, "method": name, "seconds": statistics.median(t), "turns": len(t)}
        for name, t in times.items()
    ]


def variants(names: list[str], folder: Path) -> Iterator[tuple[scenes.Scene, References]]:
    """The scenes, closed ones also with their back faces the other way, each with its references."""
    for name in names:
        scene = scenes.scene(name)
        against = references(scene, folder)
        yield scene, against
        other = methods.turned_over(scene)
        if other is not None:
            yield other, against


def options(arguments: Sequence[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=Path("out/accuracy"))
    parser.add_argument("--scenes", nargs="+", choices=scenes.SCENES, default=list(scenes.SCENES))
    parser.add_argument("--quick", action="store_true", help=f"only {' and '.join(QUICK)}, Mitsuba to 4 spp")
    parser.add_argument("--no-peers", action="store_true", help="without DEODR and Mitsuba")
    parser.add_argument("--spp", nargs="+", type=int, default=list(SPP), help="samples a pixel of Mitsuba")
    parser.add_argument("--truth", type=Path, default=Path("out/truth"), help="where truths are kept")
    args = parser.parse_args(arguments)
    if args.quick:
        args.scenes, args.spp = list(QUICK), [n for n in args.spp if n <= 4]
    return args


class Plan(NamedTuple):
    """The measurements on a scene; times are taken of the three cases only."""

    scene: scenes.Scene
    against: References
    ours: list[Method]
    others: list[Method]

    @property
    def steps(self) -> int:
        timing = ROUNDS * (3 + len(self.others)) if self.scene.name in CASES else 0
        return len(self.ours) + len(self.others) + timing


def plans(args: argparse.Namespace, skipped: set[str]) -> list[Plan]:
    found = []
    for scene, against in variants(args.scenes, args.truth):
        others: list[Method] = []
        if scene.name in CASES and not args.no_peers:
            others, left_out = methods.others(scene, args.spp)
            skipped.update(left_out)
        found.append(Plan(scene, against, methods.splatters(scene), others))
    return found


def measure(plan: list[Plan], say: Callable[[str], None], done: Callable[[], None]) -> tuple[dict, dict]:
    """The results, and the derivative images by scene and method."""
    results: dict = {**environment(PACKAGES), "scenes": {}, "rows": [], "times": []}
    images: dict[tuple[str, str], np.ndarray] = {}
    for scene, against, ours, others in plan:
        noise = {name: reference.noise for name, reference in against._asdict().items()}
        results["scenes"][scene.name] = {
            "note": scene.note,
            "closed_form": against.exact.error == 0,
            "noise": noise,
            "step": all_scores(against.pixel.derivative, against.exact.derivative)["low_relative_l2"],
        }
        for method in [*ours, *others]:
            say(f"{scene.name}: {method.name}")
            row, images[scene.name, method.name] = score(scene.name, method, against)
            results["rows"].append(row)
            done()
    for scene, _, _, others in plan:
        if scene.name in CASES:
            say(f"{scene.name}: times")
            results["times"] += timed(scene, others, done)
    return results, images


def main(arguments: Sequence[str] | None = None) -> None:
    args = options(arguments)
    args.output.mkdir(parents=True, exist_ok=True)
    skipped: set[str] = set()
    with Progress() as progress:
        task = progress.add_task("truths", total=None)
        plan = plans(args, skipped)
        progress.update(task, total=sum(p.steps for p in plan))
        say, done = partial(progress.update, task), partial(progress.advance, task)
        results, images = measure(plan, lambda text: say(description=text), done)
    print(*(f"left out: {reason}" for reason in sorted(skipped)), sep="\n")
    against = {p.scene.name: p.against for p in plan}
    (args.output / "accuracy.json").write_text(json.dumps(results, indent=1))
    (args.output / "accuracy.md").write_text(tables.document(results))
    figures.derivatives(images, against, args.output / "derivatives.png")
    figures.failures(images, against, args.output / "failures.png")
    print(tables.summary(results))
    print(f"wrote {args.output}/accuracy.md, .json and figures")


if __name__ == "__main__":
    main()
