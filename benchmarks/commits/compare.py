"""A comparison of two commits: their numbers, and their times.

Each side is installed into a folder of its own, so that it finds its own plugins by its own entry points, and runs in
processes of its own. A side is any revision that git knows, or "." for the working tree with what is not committed.

    python -m benchmarks.commits.compare results               # HEAD~1 and the working tree
    python -m benchmarks.commits.compare results v0.1.0 HEAD --engines numpy torch --scenes mesh
    python -m benchmarks.commits.compare speed HEAD~5 . --meshes teapot bunny --sizes 256

`results` takes a matrix of surfaces, samplers, splatters, engines and layers, and compares samples, images and
gradients. It ends with exit code 1 if samples differ or anything else is off by more than rounding: 1e-6 of an image's
largest value, 1e-5 of a gradient's norm. All is posed by one matrix, pinned to the bit, with the derivatives of
`rts.rigid`; what each side's own matrices give stands in lines of its own, "not pinned", with wider limits. `speed`
times the iterations of a pose fit, both sides in turn.

With --folder what is installed stays, its compiled loops too, and is used again as long as its sources are the same.
The arrays of the last `results` stay too, in results/before and results/after.
"""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import sys
import time
from pathlib import Path

from rich.console import Console
from rich.table import Table

from benchmarks.commits.differences import Group, compare, left_out
from benchmarks.commits.engines import ENGINES
from benchmarks.commits.installs import WORKING_TREE, Side, environment, folder_of, sides_of, worker
from benchmarks.commits.speed import PROCESSES, Server, Times, in_turn
from benchmarks.meshes import MESHES
from benchmarks.timing import CONSECUTIVE, ROUNDS

SHOWN = 5
"""Arrays that are named where a line of the table differs."""

# -------------------------------------------------------------------------------------------------------- results


def run_results(args: argparse.Namespace, console: Console) -> bool:
    with folder_of(args.folder) as folder:
        outputs = [folder / "results" / name for name in ("before", "after")]
        for side, output in zip(sides_of((args.before, args.after), folder / "installs"), outputs, strict=True):
            console.print(f"{side.label}:", highlight=False)
            start = time.perf_counter()
            command = worker(side.site, "results", output, args.engines, args.scenes)
            done = subprocess.run(command, env=environment(side.site))
            if done.returncode:
                raise SystemExit(f"the worker of {side.label} failed")
            console.print(f"  {time.perf_counter() - start:.0f} s in all", highlight=False)
        groups, added = compare(*outputs)
        reasons = left_out(*outputs)
    show_results(groups, added, reasons, console)
    good = all(group.good for group in groups)
    console.print("nothing is off by more than rounding" if good else "[red]not the same")
    return good


def show_results(groups: list[Group], added: list[str], reasons: dict[str, list[str]], console: Console) -> None:
    """Print a table, a line a group, and below it what is behind those that differ.

    Args:
        groups: see `compare`.
        added: keys that only the second side has.
        reasons: see `left_out`.
        console: to print on.
    """
    table = Table("what", "engine", "arrays", "bitwise equal", "largest difference", "verdict")
    lines = []
    for group in groups:
        largest = f"{group.largest:.1e}" if group.largest else "0"
        style = "red" if not group.good else "yellow" if group.suspect else ""
        counts = f"{len(group.found):,}", f"{group.equal:,}"
        table.add_row(group.kind, group.engine, *counts, largest, group.verdict, style=style)
        if not group.good or group.suspect:
            worst = sorted((d for d in group.found if not d.equal), key=lambda d: -d.size)
            lines += [f"  {d.size:.1e}  {d.key}" for d in worst[:SHOWN]] + ["  …"] * (len(worst) > SHOWN)
        lines += [f"  missing  {key}" for key in group.missing[:SHOWN]]
    if added:
        combinations = sorted({tuple(key.split("|")[2:4]) for key in added})
        lines.append(f"only in the second: {len(added):,} arrays, of {'; '.join(map(', '.join, combinations))}")
    for reason, keys in reasons.items():
        lines.append(f"left out: {'; '.join(keys[:6])}{'; …' * (len(keys) > 6)}: {reason}")
    console.print(table)
    for line in lines:
        console.print(line, markup=False, highlight=False, soft_wrap=True)


# ---------------------------------------------------------------------------------------------------------- speed


def run_speed(args: argparse.Namespace, console: Console) -> bool:
    times = {(m, s, e): Times() for m in args.meshes for s in args.sizes for e in args.engines}
    missing = set()
    with folder_of(args.folder) as folder:
        sides = sides_of((args.before, args.after), folder / "installs")
        for n in range(args.processes):
            load = ", ".join(f"{x:.1f}" for x in os.getloadavg())
            console.print(f"processes {n + 1} of {args.processes}; load of the machine {load}", highlight=False)
            servers = [Server(side.site, folder / "meshes") for side in sides]
            for request, found in times.items():
                missing.add(in_turn(servers, request, args.rounds, found))
            for server in servers:
                server.close()
    show_speed(times, sides, console)
    count = args.processes * args.rounds * CONSECUTIVE
    console.print(f"medians (and quartiles) of {count} iterations; ratio: second over first (by pairs of processes)")
    for reason in sorted(missing - {None}):
        console.print(f"left out: {reason}", markup=False, highlight=False)
    return True


def show_speed(times: dict[tuple[str, int, str], Times], sides: list[Side], console: Console) -> None:
    """Print a table, a line for each mesh, size and engine that has times."""
    table = Table("mesh", "faces", "size", "engine", *(f"{side.label}, ms" for side in sides), "ratio")
    for (mesh, side, engine), found in times.items():
        if found.seconds:
            spreads = spread(found.side(0)), spread(found.side(1))
            table.add_row(mesh, f"{found.faces:,}", f"{side}²", engine, *spreads, found.ratios())
    console.print(table)


def spread(seconds: list[float]) -> str:
    """Median and quartiles, milliseconds."""
    low, middle, high = (1e3 * x for x in statistics.quantiles(seconds, n=4, method="inclusive"))
    return f"{middle:.2f} ({low:.2f} to {high:.2f})"


# --------------------------------------------------------------------------------------------------- command line


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    results = commands.add_parser("results", help="samples, images and gradients of both")
    speed = commands.add_parser("speed", help="iterations of a pose fit by both")
    for command in (results, speed):
        command.add_argument("before", nargs="?", default="HEAD~1")
        command.add_argument("after", nargs="?", default=WORKING_TREE)
        command.add_argument("--folder", type=Path, help="keeps installs, with compiled loops, arrays and meshes")
    keys = [engine.key for engine in ENGINES]
    results.add_argument("--engines", nargs="+", choices=keys, default=[], help="instead of all")
    results.add_argument("--scenes", nargs="+", default=[], help="names in commits/scenes.py, instead of all")
    speed.add_argument("--meshes", nargs="+", choices=MESHES, default=list(MESHES))
    speed.add_argument("--sizes", nargs="+", type=int, default=[256, 512])
    speed.add_argument("--engines", nargs="+", choices=("torch", "jax"), default=["torch", "jax"])
    speed.add_argument("--rounds", type=int, default=ROUNDS, help="turns of each process")
    speed.add_argument("--processes", type=int, default=PROCESSES, help="of each side, one after the other")
    args = parser.parse_args()
    run = {"results": run_results, "speed": run_speed}[args.command]
    raise SystemExit(0 if run(args, Console(width=None if sys.stdout.isatty() else 120)) else 1)


if __name__ == "__main__":
    main()
