"""The parts of a pose iteration's time, and the least time that the machine's memory would allow.

An iteration with torch: the milliseconds of its compiled loops, by what they are for, and of the rest, which is
Python, torch and Adam; how many bytes the loops are handed; and how long two threads take to read so many.

    python -m benchmarks.speed.bound
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

import rts.compiling.threads
from benchmarks.meshes import MESHES, kept_mesh
from benchmarks.report import table
from benchmarks.speed.pose_iteration import Task, torch_iteration

LINE = 64
"""Bytes that memory hands over at once."""

STAGES = {
    "rasterize": ("raster",),
    "pack, find outlines": ("packing", "value_ranges", "merging", "sheets", "silhouettes", "spans", "segments"),
    "splat": ("edges",),
}
"""Loops by the beginnings of their modules' names; others are *the rest of the loops*."""


def bandwidth(size: int, rounds: int = 9) -> float:
    """Bytes a second that all threads read together, of an array of so many bytes that they read again and again."""
    shares = np.array_split(np.ones(size // 4, np.float32), rts.compiling.threads.thread_count())
    times, again = [], max(1, (1 << 28) // size)
    for _ in range(rounds):
        start = time.perf_counter()
        rts.compiling.threads.each(lambda share: [share.max() for _ in range(again)], shares)
        times.append(time.perf_counter() - start)
    return again * size / statistics.median(times)


class Loops:
    """Compiled loops of an iteration: how long they take, and what they are handed.

    Args:
        samples: of the image; of an array that is not one of the grid a loop other than the rasterizer's reads a line
            of memory for each at most.

    Attributes:
        seconds: by stage.
        bytes: by stage.
    """

    def __init__(self, samples: int):
        self._samples = samples
        self.seconds = dict.fromkeys((*STAGES, "the rest of the loops"), 0.0)
        self.bytes = dict.fromkeys(self.seconds, 0.0)

    def note(self, loop: Callable, seconds: float, arguments: tuple) -> None:
        """Take note of a call."""
        module = loop.__module__.rsplit(".", 1)[-1]
        stage = next((n for n, begin in STAGES.items() if module.startswith(begin)), "the rest of the loops")
        self.seconds[stage] += seconds
        most = sys.maxsize if stage == "rasterize" else LINE * self._samples
        self.bytes[stage] += sum(n if grid else min(n, most) for n, grid in _sizes(arguments))


def _sizes(arguments: Any) -> Iterator[tuple[int, bool]]:
    """Bytes of all arrays, and whether they have rows and columns as an image has."""
    for x in arguments:
        if isinstance(x, np.ndarray):
            yield x.nbytes, x.ndim > 1 and x.shape[-1] > 16
        elif isinstance(x, tuple):
            yield from _sizes(x)


@contextmanager
def listening(loops: Loops) -> Iterator[None]:
    """Have loops noted."""
    own = rts.compiling.threads.parallel

    def noted(loop: Callable, count: int, *arguments: Any, **options: Any) -> None:
        start = time.perf_counter()
        own(loop, count, *arguments, **options)
        loops.note(loop, time.perf_counter() - start, arguments)

    users: list[Any] = [m for m in list(sys.modules.values()) if getattr(m, "parallel", None) is own]
    for module in users:
        module.parallel = noted
    try:
        yield
    finally:
        for module in users:
            module.parallel = own


def measure(task: Task, rounds: int) -> tuple[float, Loops]:
    """Seconds of an iteration, the median, and its loops, of which seconds and bytes are those of one."""
    step = torch_iteration(task)
    samples = rts.sample(task.part, task.view, task.size, layers=task.layers)
    loops, times = Loops(samples.samples[0].ids.shape[0]), []
    for _ in range(6):
        step()
    for _ in range(rounds):
        start = time.perf_counter()
        step()
        times.append(time.perf_counter() - start)
        with listening(loops):
            step()
    for totals in (loops.seconds, loops.bytes):
        for stage in totals:
            totals[stage] /= rounds
    return statistics.median(times), loops


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--meshes", nargs="+", choices=MESHES, default=["teapot", "bunny", "spot", "nefertiti"])
    parser.add_argument("--sizes", nargs="+", type=int, default=[256, 512])
    parser.add_argument("--rounds", type=int, default=60)
    parser.add_argument("-o", "--output", type=Path, default=Path("out/speed"))
    args = parser.parse_args()
    memory, cache = bandwidth(1 << 28), bandwidth(1 << 22)
    print(f"read by all threads: {memory / 1e9:.0f} GB/s of memory, {cache / 1e9:.0f} of 4 MB that stay in caches\n")
    lines = []
    for name in args.meshes:
        mesh = kept_mesh(name, args.output / "meshes")
        for side in args.sizes:
            total, loops = measure(Task(name, *mesh, side), args.rounds)
            handed, spent = sum(loops.bytes.values()), sum(loops.seconds.values())
            stages = [f"{1e3 * loops.seconds[s]:.2f} ({loops.bytes[s] / 1e6:.1f})" for s in loops.seconds]
            rest = f"{1e3 * (total - spent):.2f}"
            bound = f"{1e3 * handed / memory:.2f}, {1e3 * handed / cache:.2f}"
            lines.append((f"{name}, {side}²", f"{1e3 * total:.2f}", *stages, rest, f"{handed / 1e6:.1f}", bound))
    header = ("mesh, side", "iteration, ms", *(f"{s}, ms (MB)" for s in Loops(0).seconds), "Python and torch, ms")
    print(table((*header, "handed to loops, MB", "to read so many from memory, caches, ms"), lines))


if __name__ == "__main__":
    main()
