"""Times: iterations of a pose fit beside other renderers, stages, memory, second order.

Methods that are compared take turns in one run, so that noise of the machine hits all alike. Writes tables (speed.md),
all numbers (speed.json) and charts:

    python -m benchmarks.speed.run -o out/speed --mitsuba
    python -m benchmarks.speed.run --quick --only pose stages
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path

from rich.progress import MofNCompleteColumn, Progress, TimeElapsedColumn

from benchmarks.meshes import MESHES, kept_mesh
from benchmarks.speed import levenberg_marquardt, memory, shaded, stages, tables
from benchmarks.speed.charts import CHARTS
from benchmarks.speed.pose_iteration import ENGINES, MODES, Task, torch_iteration
from benchmarks.timing import ROUNDS, WARM_UP, in_turn
from rts_compare.environment import environment

QUICK_MESHES, QUICK_SIZES, QUICK_ROUNDS = ("teapot", "bunny"), (256,), 3
SOLVED, STAGED = ("bunny",), ("teapot", "bunny", "nefertiti")
MEASURED = ("teapot", "bunny", "spot", "nefertiti")
"""Meshes of the sections that do not take all."""
BUDGET = 30.0
"""Seconds of timed calls after which a method has had enough turns."""
PACKAGES = ("numpy", "torch", "jax", "numba", "deodr", "mitsuba", "drjit")
NAMES = {"pose": "RtS-pose", "full": "full RtS", "full, both": "full RtS, both"}


def iterations(task: Task, args: argparse.Namespace) -> dict[str, Callable[[], object]]:
    """All methods."""
    found = {}
    for mode in MODES:
        for engine, make in ENGINES.items():
            for sampler in ("auto", "embree") if mode == "pose" else ("auto",):
                found[f"{NAMES[mode]}, {engine}, {sampler}"] = make(task, mode, sampler)
    found[tables.PREPARED] = torch_iteration(task, prepared=True)
    if args.peers:
        from benchmarks.speed import other_renderers

        try:
            found |= other_renderers.iterations(task, args.mitsuba)
        except ImportError as error:
            advice = "install the extra `bench`, or leave the other renderers out by --no-peers"
            raise SystemExit(f"{error}: {advice}") from error
    return found


def pose_rows(tasks: Iterable[Task], args: argparse.Namespace, done: Callable[[], None]) -> list[dict]:
    rows = []
    for task in tasks:
        times = in_turn(iterations(task, args), args.rounds, done, BUDGET)
        rows.append({"mesh": task.name, "faces": len(task.faces), "side": task.side, "times": times})
    return rows


class Plan:
    """The measurements: sections by name, each with its number of steps and the function that measures it.

    Args:
        args: of the command line.
        done: called after each step.
    """

    def __init__(self, args: argparse.Namespace, done: Callable[[], None]):
        self.args, self.folder = args, args.output / "meshes"
        engines, rounds, largest = tuple(ENGINES), args.rounds, (max(args.sizes),)
        staged, solved = (self.chosen(names) for names in (STAGED, SOLVED))
        every, measured = self.chosen(MESHES), self.chosen(MEASURED)
        count = len(args.sizes)
        self.sections: dict[str, tuple[int, Callable[[], list[dict]]]] = {
            "pose": (
                len(every) * count * (rounds + WARM_UP),
                lambda: pose_rows(self.tasks(every), args, done),
            ),
            "shaded": (
                len(every) * count * (rounds + WARM_UP),
                lambda: shaded.measure(self.tasks(every), rounds, args.peers, done, BUDGET),
            ),
            "stages": (
                len(staged) * count * len(stages.KINDS),
                lambda: stages.measure(self.tasks(staged), rounds, done),
            ),
            "memory": (
                len(measured) * len(memory.CASES),
                lambda: memory.measure(measured, *largest, self.folder, done),
            ),
            "lm": (
                len(solved) * count * len(engines) * len(levenberg_marquardt.UNKNOWNS),
                lambda: levenberg_marquardt.measure(self.tasks(solved), engines, rounds, done),
            ),
        }

    def chosen(self, names: Iterable[str]) -> list[str]:
        """The sections that were asked for."""
        return [name for name in names if name in self.args.meshes]

    def tasks(self, names: list[str], sizes: tuple[int, ...] | None = None) -> Iterator[Task]:
        """Made when it is their turn: large meshes take seconds."""
        for name in names:
            for side in sizes or self.args.sizes:
                yield Task(name, *kept_mesh(name, self.folder), side)


def load_average() -> str:
    """Over 1 and 15 minutes."""
    one, _, fifteen = os.getloadavg()
    return f"{one:.1f} ({fifteen:.1f})"


def options(arguments: Sequence[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=Path("out/speed"))
    parser.add_argument("--only", nargs="+", choices=tables.SECTIONS, default=list(tables.SECTIONS))
    parser.add_argument("--meshes", nargs="+", choices=MESHES, default=None)
    parser.add_argument("--sizes", nargs="+", type=int, default=None, help="sides of the image, default 256 512")
    parser.add_argument("--quick", action="store_true", help=f"{' and '.join(QUICK_MESHES)}, 256², three turns")
    parser.add_argument("--no-peers", dest="peers", action="store_false", help="without DEODR and Mitsuba")
    parser.add_argument("--mitsuba", action="store_true", help="with Mitsuba, which takes most of the time")
    args = parser.parse_args(arguments)
    args.meshes = args.meshes or list(QUICK_MESHES if args.quick else MESHES)
    args.sizes = args.sizes or list(QUICK_SIZES if args.quick else (256, 512))
    args.rounds = QUICK_ROUNDS if args.quick else ROUNDS
    return args


def write(results: dict, folder: Path) -> None:
    """Write the results so far."""
    (folder / "speed.json").write_text(json.dumps(results, indent=1))
    (folder / "speed.md").write_text(tables.document(results))
    for name, chart in CHARTS.items():
        if results.get(name):
            chart(results[name], folder / f"{name}.png")


def main(arguments: Sequence[str] | None = None) -> None:
    args = options(arguments)
    args.output.mkdir(parents=True, exist_ok=True)
    results = environment(PACKAGES)
    told = sys.argv[1:] if arguments is None else arguments
    results["command"] = shlex.join(["python", "-m", "benchmarks.speed.run", *told])
    before = load_average()
    with Progress(*Progress.get_default_columns(), MofNCompleteColumn(), TimeElapsedColumn()) as progress:
        task = progress.add_task("", total=None)
        plan = Plan(args, partial(progress.advance, task))
        chosen = {name: section for name, section in plan.sections.items() if name in args.only}
        progress.update(task, total=sum(steps for steps, _ in chosen.values()))
        for name, (_, measure) in chosen.items():
            progress.update(task, description=name)
            results[name] = measure()
            results["load"] = [before, load_average()]
            write(results, args.output)
    print(tables.document(results))
    print(f"wrote {args.output}/speed.md, .json and charts")


if __name__ == "__main__":
    main()
