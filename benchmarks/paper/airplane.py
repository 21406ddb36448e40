"""The toy airplane fitted to its photograph (section 4.2): Levenberg–Marquardt beside Adam, by each splatter.

Unknown are pose, field of view, colour of the background, and diffuse light; a matrix of colours is fitted along, and
the loss is robust, see `airplane_scene`. Both methods begin at the same five starts, which are 15°, 0.15 of the
airplane's radius and 15 % of the field of view off. Compared are the steps and the seconds to one loss: 5 % and 1 %
above the lowest that any fit by this splatter ends with. Seconds are those of the processor, which others on the
machine hardly change. Adam has the best of the rates 0.01, 0.02, 0.05, 0.1 and 0.2. Written are a figure, an animation
and the numbers:

    python -m benchmarks.paper.airplane -o out/airplane
    python -m benchmarks.paper.airplane --quick            # a quarter of the pixels, two starts, two splatters
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import rts
from benchmarks.paper import airplane_scene as scene
from rts.arrays.engines import engine_named
from rts.files.srgb import decode_srgb, encode_srgb

SPLATTERS = {"none": 1, "single": 1, "multi": 2, "edges": 1}
"""Splatter → layers."""
STEPS = {"lm": 50, "adam": 250}
RATE = 0.05
SAME, SEEDS = {"within 5 %": 1.05, "within 1 %": 1.01}, 5
"""Losses that count as the same, over the lowest; number of starts."""
FOUND = 0.9
"""The overlap of the airplane with its outline in the photograph, as intersection over union, at which it is found."""


class Course(NamedTuple):
    """A fit: losses; seconds of processor since its begin at each; unknowns at each; the best ones; why it stopped."""

    losses: list[float]
    seconds: list[float]
    trail: list[dict[str, np.ndarray]]
    best: dict[str, np.ndarray]
    reason: str


def fitted(residuals: Callable, engine: str, method: str, seed: int, steps: int | None = None) -> Course:
    """A fit from a start."""
    known, losses, seconds, trail = engine_named(engine), [], [], []

    def host(unknowns: Any) -> dict[str, np.ndarray]:
        return {name: np.array(known.to_numpy(x), np.float64) for name, x in unknowns.items()}

    def note(step: int, unknowns: Any, loss: float) -> None:
        seconds.append(time.process_time() - begun)
        losses.append(loss)
        trail.append(host(unknowns))

    # Adam's loss goes up and down, so it makes all of its steps.
    own: dict[str, Any] = {} if method == "lm" else {"learning_rate": RATE, "patience": STEPS["adam"]}
    begun = time.process_time()
    found = rts.fit(
        residuals, scene.arrays(engine, scene.start(seed)), method=method, steps=steps or STEPS[method],
        loss=scene.LOSS, tolerance=1e-5, callback=note, progress=False, **own,
    )  # fmt: skip
    return Course(losses, seconds, trail, host(found.parameters), found.reason)


def picture(unknowns: dict[str, np.ndarray], size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Hard images of 4 × 4 samples a pixel: colours (H, W, 3), and the coverage (H, W) of the airplane alone."""
    known = {name: x.astype(np.float32) for name, x in unknowns.items()}
    return scene.image(known, size, splatter="none", layers=1, supersample=4)


def overlap(unknowns: dict[str, np.ndarray], factor: int) -> float:
    """Intersection over union of the airplane with its outline in the photograph, as areas."""
    wanted = scene.outline(factor).astype(np.float64)
    found = picture(unknowns, wanted.shape)[1]
    return float(np.minimum(found, wanted).sum() / np.maximum(found, wanted).sum())


def measured(courses: dict[tuple[str, str, int], Course], factor: int) -> list[dict[str, Any]]:
    """A line for each fit, with the steps and seconds to losses that count as the same, None if not reached."""
    lines = []
    for (splatter, method, seed), course in courses.items():
        lowest = min(min(c.losses) for (other, *_), c in courses.items() if other == splatter)
        firsts = {n: next((i for i, x in enumerate(course.losses) if x <= s * lowest), None) for n, s in SAME.items()}
        lines.append(
            {
                "splatter": splatter, "method": method, "seed": seed, "lowest": lowest,
                "loss_start": course.losses[0], "loss": min(course.losses),
                **{n: None if i is None else [i, round(course.seconds[i], 3)] for n, i in firsts.items()},
                "all_steps": len(course.losses), "all_seconds": round(course.seconds[-1], 3),
                "iou_start": round(overlap(course.trail[0], factor), 4), "iou": round(overlap(course.best, factor), 4),
                "fov": round(float(scene.FOV * np.exp(course.best["zoom"][0])), 2), "reason": course.reason,
            }
        )  # fmt: skip
    return lines


def run(engine: str, factor: int, splatters: Sequence[str], seeds: int) -> dict[tuple[str, str, int], Course]:
    """All fits; the methods take turns, so that others on the machine slow both."""
    courses = {}
    for splatter in splatters:
        residuals = scene.residuals(engine, factor, splatter, SPLATTERS[splatter])
        for method in STEPS:
            fitted(residuals, engine, method, 0, 2)  # Compiles.
        for seed in range(seeds):
            for method in STEPS:
                course = courses[splatter, method, seed] = fitted(residuals, engine, method, seed)
                print(
                    f"{splatter:8} {method:5} start {seed}: loss {course.losses[0]:.5f} -> {min(course.losses):.5f} in "
                    f"{len(course.losses)} steps, {course.seconds[-1]:.1f} s, IoU {overlap(course.best, factor):.3f}",
                    flush=True,
                )
    return courses


# ------------------------------------------------------------------------------------------------------------ pictures


def overlaid(unknowns: dict[str, np.ndarray], factor: int) -> np.ndarray:
    """The photograph, greyed, with the outline of the fit in red (H, W, 3), sRGB."""
    photograph = encode_srgb(scene.photograph(factor))
    inside = picture(unknowns, photograph.shape[:2])[1] > 0.5
    padded = np.pad(inside, 1)
    grown = padded[2:, 1:-1] | padded[:-2, 1:-1] | padded[1:-1, 2:] | padded[1:-1, :-2]
    pale = 0.35 + 0.65 * photograph
    return np.where((grown & ~inside)[..., None], [0.85, 0.0, 0.1], pale)


def drawn(unknowns: dict[str, np.ndarray], factor: int) -> np.ndarray:
    return encode_srgb(picture(unknowns, scene.photograph(factor).shape[:2])[0].clip(0, 1))


def show(axes: Any, title: str, pixels: np.ndarray) -> None:
    axes.imshow(pixels)
    axes.set_title(title, fontsize=9)
    axes.axis("off")


def draw(path: Path, courses: dict[tuple[str, str, int], Course], factor: int) -> None:
    """Start, fit and photograph; losses against steps and seconds; the fit of each splatter over the photograph."""
    from matplotlib.figure import Figure

    splatters = list(dict.fromkeys(s for s, *_ in courses))
    main = "multi" if "multi" in splatters else splatters[-1]
    seeds = sorted({seed for *_, seed in courses})
    best = {s: min((k for k in courses if k[0] == s), key=lambda k: min(courses[k].losses)) for s in splatters}
    course = courses[main, "lm", best[main][2]]
    figure = Figure(figsize=(14, 9.2), layout="constrained")
    grid = figure.subplots(3, 4)
    show(grid[0, 0], f"start {best[main][2]}", drawn(course.trail[0], factor))
    show(grid[0, 1], f"fitted, {main}, Levenberg–Marquardt", drawn(course.best, factor))
    show(grid[0, 2], "photograph", encode_srgb(scene.photograph(factor)))
    show(grid[0, 3], "the start's outline on it", overlaid(course.trail[0], factor))
    for axes, splatter in zip(grid[1], splatters, strict=False):
        at = best[splatter]
        show(axes, f"{splatter}, best fit: IoU {overlap(courses[at].best, factor):.3f}",
             overlaid(courses[at].best, factor))  # fmt: skip
    for axes, (title, x) in zip(grid[2], (("step", None), ("seconds of processor", "seconds")), strict=False):
        for method, color in (("lm", "C0"), ("adam", "C1")):
            for seed in seeds:
                found = courses[main, method, seed]
                lowest = np.minimum.accumulate(found.losses)
                along = range(len(lowest)) if x is None else found.seconds
                axes.semilogy(along, lowest, color=color, alpha=0.8, label=method if seed == seeds[0] else None)
        axes.set(xlabel=title, ylabel="lowest loss so far", title=f"{main}, {len(seeds)} starts")
        axes.legend(fontsize=8)
        axes.grid(alpha=0.3, which="both")
    for axes, method in zip(grid[2, 2:], STEPS, strict=True):
        for splatter in splatters:
            lowest = [np.minimum.accumulate(courses[splatter, method, seed].losses) for seed in seeds]
            length = max(map(len, lowest))
            middle = np.median([np.pad(x, (0, length - len(x)), mode="edge") for x in lowest], axis=0)
            axes.semilogy(middle, label=splatter)
        axes.set(xlabel="step", title=f"{method}: medians")
        axes.legend(fontsize=8)
        axes.grid(alpha=0.3, which="both")
    for axes in grid[1, len(splatters) :]:
        axes.axis("off")
    figure.savefig(path, dpi=62)


def frames(courses: dict[tuple[str, str, int], Course], factor: int, count: int = 16) -> list[np.ndarray]:
    """Levenberg–Marquardt beside Adam from one start, at the same steps, over the photograph; linear colours."""
    splatter = "multi" if any(s == "multi" for s, *_ in courses) else next(iter(courses))[0]
    made = []
    for step in np.unique(np.round(np.linspace(0, 1, count) ** 2 * (STEPS["adam"] - 1)).astype(int)):
        pair = [courses[splatter, method, 0].trail for method in STEPS]
        seen = [overlaid(trail[min(step, len(trail) - 1)], factor) for trail in pair]
        made.append(decode_srgb(np.concatenate(seen, axis=1)))
    return made + made[-1:] * 6


# ------------------------------------------------------------------------------------------------------------- summary


def summary(lines: list[dict[str, Any]]) -> dict[str, Any]:
    """Splatter → method → how many starts reach each loss, and medians of steps and seconds.

    These are over the starts from which all methods reach the loss.
    """
    found: dict[str, Any] = {}
    for line in lines:
        found.setdefault(line["splatter"], {}).setdefault(line["method"], []).append(line)
    return {
        splatter: {method: _summed(group, list(groups.values())) for method, group in groups.items()}
        for splatter, groups in found.items()
    }


def _summed(group: list[dict[str, Any]], groups: list[list[dict[str, Any]]]) -> dict[str, Any]:
    found: dict[str, Any] = {
        "starts": len(group),
        "found": sum(line["iou"] >= FOUND for line in group),
        "iou": statistics.median(line["iou"] for line in group),
        "loss": statistics.median(line["loss"] for line in group),
        "step_ms": round(statistics.median(1e3 * line["all_seconds"] / line["all_steps"] for line in group), 1),
    }
    for name in SAME:
        reached = [{line["seed"] for line in lines if line[name] is not None} for lines in groups]
        common = set.intersection(*reached)
        there = [line[name] for line in group if line["seed"] in common]
        middle = [statistics.median(x) for x in zip(*there, strict=True)] or [None, None]
        count = sum(line[name] is not None for line in group)
        found[name] = {"reached": count, "common": len(common), "steps": middle[0], "seconds": middle[1]}
    return found


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=Path("out/airplane"))
    parser.add_argument("--engine", choices=("torch", "jax"), default="torch")
    parser.add_argument("--quick", action="store_true")
    args = parser.parse_args(arguments)
    factor, seeds = (8, 2) if args.quick else (4, SEEDS)
    courses = run(args.engine, factor, ("none", "multi") if args.quick else tuple(SPLATTERS), seeds)
    lines = measured(courses, factor)
    args.output.mkdir(parents=True, exist_ok=True)
    size = scene.photograph(factor).shape[:2]
    found = {"engine": args.engine, "size": size, "summary": summary(lines), "fits": lines}
    (args.output / "airplane.json").write_text(json.dumps(found, indent=1) + "\n")
    draw(args.output / "airplane.png", courses, factor)
    rts.save_animation(args.output / "airplane.gif", frames(courses, 8 if args.quick else 6), fps=4)


if __name__ == "__main__":
    main()
