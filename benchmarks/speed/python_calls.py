"""The number of Python functions that a render calls: each costs little, but small images cost nothing else.

Counts the calls of one torch render of a small silhouette, 48², with a pose that has a gradient, after a warm-up, and
those of its backward pass; C functions do not count. Prints totals and the functions that are called most:

    python -m benchmarks.speed.python_calls
    python -m benchmarks.speed.python_calls --against HEAD~1     # the same of another commit

Loops run on one thread, since it is chance which others join in.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

from rich.console import Console
from rich.table import Table

from benchmarks.commits.installs import check_origin, environment, folder_of, isolate, process, sides_of

os.environ["RTS_NUM_THREADS"] = "1"

SIZE = (48, 48)
POSE = (0.1, -0.1, 0.1, 0.02, 0.0, 0.03)
WARM_UP = 3
SHOWN = 25


def calls(function: Callable[[], Any]) -> tuple[Any, Counter[CodeType]]:
    """The function's result, and how often it, and all that it calls in this thread, enters each Python function.

    A generator counts each time it goes on. Comprehensions count where the interpreter makes functions of them.
    """
    found: Counter[CodeType] = Counter()

    def note(frame: FrameType, event: str, _: Any) -> None:
        if event == "call":
            found[frame.f_code] += 1

    sys.setprofile(note)
    try:
        result = function()
    finally:
        sys.setprofile(None)
    return result, found


def place(code: CodeType) -> str:
    """File and line, the file from the folder on that is on the path."""
    file = Path(code.co_filename)
    for folder in sorted(filter(None, sys.path), key=len, reverse=True):
        if file.is_relative_to(folder):
            file = file.relative_to(folder)
            break
    return f"{file}:{code.co_firstlineno}"


def measure() -> dict[str, list]:
    """Name, place and number of calls of each function, most often called first, of both passes."""
    import torch

    import rts

    part = rts.plugin("surfaces", "mesh").example().replace(shader="silhouette")
    part = part.replace(theta={"vertices": part.theta["vertices"]})
    camera = rts.Camera.look_at((0, 0.5, 3), (0, 0, 0), fov_y=40)
    pose = torch.tensor(POSE, requires_grad=True)

    def forward() -> Any:
        return rts.render(part.replace(transform=rts.rigid(pose)), camera, SIZE, layers=2)

    for _ in range(WARM_UP):
        forward().square().sum().backward()
    image, ahead = calls(forward)
    loss = image.square().sum()
    _, back = calls(loss.backward)
    passes = {"forward, with rigid": ahead, "backward": back}
    return {
        name: [(code.co_qualname, place(code), n) for code, n in found.most_common()] for name, found in passes.items()
    }


def show(found: dict[str, list], label: str, console: Console) -> None:
    for name, functions in found.items():
        table = Table("calls", "function", "at", title=f"{label}, {name}: {sum(f[-1] for f in functions):,} calls")
        for function, at, n in functions[:SHOWN]:
            table.add_row(str(n), function, at)
        if len(functions) > SHOWN:
            table.add_row(str(sum(f[-1] for f in functions[SHOWN:])), f"{len(functions) - SHOWN} others", "")
        console.print(table, markup=False)


def main() -> None:
    if sys.argv[1:2] == ["worker"]:  # For another commit: prints JSON.
        site = Path(sys.argv[2])
        isolate(site)
        print(json.dumps(measure()))
        return check_origin(site)
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--against", metavar="REVISION", help="also of another commit, installed into a folder")
    parser.add_argument("--folder", type=Path, help="keeps that install, with compiled loops")
    args = parser.parse_args()
    console = Console(width=None if sys.stdout.isatty() else 120)
    show(measure(), "installed", console)
    if args.against:
        with folder_of(args.folder) as folder:
            (side,) = sides_of([args.against], folder / "installs")
            command = process("benchmarks.speed.python_calls", "worker", side.site)
            done = subprocess.run(command, env=environment(side.site), stdout=subprocess.PIPE, text=True)
            if done.returncode:
                raise SystemExit(f"the worker of {side.label} failed")
            show(json.loads(done.stdout), side.label, console)


if __name__ == "__main__":
    main()
