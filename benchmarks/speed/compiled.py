"""The time of compiled jax beside that of torch, by samples a pixel: a render and gradient of built-in scenes.

The calls are those that `rts compare` times: `visible`, K = 2, `raster`, in turns. Processor time is of all threads.

    python -m benchmarks.speed.compiled
    python -m benchmarks.speed.compiled --scenes "stack of cards" --rounds 20
    python -m benchmarks.speed.compiled --room          # the share of all fine cells that the outlines of scenes need
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

import rts
from benchmarks.report import table
from rts.sampling.fine_samples import FEW
from rts.sampling.strips import FineGrid, lay_out
from rts_compare.builtin_scenes import BUILTIN
from rts_compare.compared_settings import Setting, engines
from rts_compare.kept_measurements import KeptMeasurements
from rts_compare.measurements import Measurements

SCENES = ("bunny over black", "square behind bunny", "nefertiti", "stack of cards", "card behind glass")
SAMPLES = {"1": 1, "4 × 4 at outlines": "adaptive:4", "4 × 4": 4}
ENGINES = ("torch", "jax")


class Times(NamedTuple):
    """Seconds of calls, one after the other."""

    wall: list[float]
    processor: list[float]

    def note(self, call: Callable[[], Any]) -> None:
        """Call a function, and note its times."""
        wall, processor = time.perf_counter(), time.process_time()
        call()
        self.wall.append(time.perf_counter() - wall)
        self.processor.append(time.process_time() - processor)


def measured(name: str, rounds: int, samples: Sequence[str]) -> list[list[str]]:
    """Lines of the table of a scene, one for each group of parameters and number of samples."""
    used, _ = engines(list(ENGINES))
    scene = Measurements(BUILTIN[name].make(), KeptMeasurements(), used)
    lines = []
    for group in sorted({scene.group(mode) for mode in scene.scene.directions}):
        calls = {
            (n, engine): scene.call(group, Setting("visible", 2, SAMPLES[n], "", "raster", engine))
            for n in samples
            for engine in ENGINES
        }
        times = {key: Times([], []) for key in calls}
        for call in calls.values():
            call()
        for _ in range(rounds):
            for key, call in calls.items():
                call()
                times[key].note(call)
        for n in samples:
            lines.append([name, group, n, *_cells(times[n, "torch"], times[n, "jax"])])
    return lines


def _cells(torch: Times, jax: Times) -> list[str]:
    """Medians of torch and jax, ms, and their ratio: of processor time, then of wall time."""
    cells = []
    for own, other in zip(torch[::-1], jax[::-1], strict=True):
        base, compiled = statistics.median(own), statistics.median(other)
        cells += [f"{1e3 * base:.0f}", f"{1e3 * compiled:.0f}", f"{compiled / base:.2f}"]
    return cells


def room(name: str) -> list[str]:
    """A line of the table of rooms: the share of fine cells that a scene needs, and whether the fast branch has it."""
    scene, (engine,) = BUILTIN[name].make(), engines(["torch"])[0]
    parts, camera = scene.at(scene.moved(next(iter(scene.directions)), 0.0, engine))
    fine = rts.sample(parts, camera, scene.size, supersample=rts.Adaptive(4), splatter="visible").fine
    assert fine is not None
    grid = FineGrid(scene.size, fine.supersample, fine.apron)
    active, whole = np.asarray(fine.pixel) >= 0, grid.room(None, 1)
    needed = np.count_nonzero(lay_out(active, grid).cells >= 0) / whole.cells
    fits = int(lay_out(active, grid, whole.share(FEW)).dropped) == 0
    return [name, f"{active.mean():.3f}", f"{needed:.3f}", "yes" if fits else "no"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", choices=BUILTIN, default=SCENES)
    parser.add_argument("--samples", nargs="+", choices=SAMPLES, default=list(SAMPLES))
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--room", action="store_true")
    args = parser.parse_args()
    if args.room:
        print(table(["scene", "active pixels", "fine cells", "few"], map(room, BUILTIN)))
        return
    lines = []
    for name in args.scenes:
        lines += measured(name, args.rounds, args.samples)
        print(*lines, sep="\n", flush=True)
    of_each = "torch, ms", "jax, ms", "ratio"
    print(table(["scene", "parameters", "samples a pixel", *of_each, *(f"wall: {x}" for x in of_each)], lines))


if __name__ == "__main__":
    main()
