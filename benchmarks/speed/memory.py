"""Peak memory of pose iterations: each case in a process of its own.

The baseline is taken with the scene loaded and all code compiled: with torch after an iteration on an image of 16²,
with jax once the iteration is compiled. Then the peak of three iterations over it. `host` is the peak of NumPy's
allocations in sampling, by tracemalloc.
"""

from __future__ import annotations

import ctypes
import json
import re
import subprocess
import sys
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import numpy as np

import rts
from benchmarks.meshes import kept_mesh
from benchmarks.speed.pose_iteration import Task, jax_function, torch_iteration
from benchmarks.timing import START

MIB = 2**20
CASES = (
    ("torch", "pose", "raster"),
    ("torch", "pose", "embree"),
    ("jax", "pose", "raster"),
    ("torch", "full", "raster"),
    ("jax", "full", "raster"),
)
"""Engine, mode and sampler."""


def resident(peak: bool = False) -> float:
    """Resident memory of this process now, or the most since the peak was last reset, in MiB."""
    text = Path("/proc/self/status").read_text()
    return int(re.search(rf"{'VmHWM' if peak else 'VmRSS'}:\s+(\d+)", text)[1]) / 1024  # pyright: ignore


def growth(iteration: Callable[[], object]) -> float:
    """MiB that the process needs in three iterations beyond what it holds."""
    ctypes.CDLL(None).malloc_trim(0)  # What was freed before is not to be filled unseen.
    Path("/proc/self/clear_refs").write_text("5")
    before = resident()
    for _ in range(3):
        iteration()
    return resident(peak=True) - before


def torch_growth(task: Task, mode: str, sampler: str) -> float:
    torch_iteration(task.resized(16), mode, sampler)()
    return growth(torch_iteration(task, mode, sampler))


def jax_growth(task: Task, mode: str, sampler: str) -> float:
    import jax

    small, state = jax_function(task.resized(16), mode, sampler)
    jax.block_until_ready(jax.jit(small)(*state))  # Compiles what samples on the host.
    function, (variables, states) = jax_function(task, mode, sampler)
    compiled = jax.jit(function).lower(variables, states).compile()

    def iteration() -> None:
        nonlocal variables, states
        (moved, states), *_ = jax.block_until_ready(compiled(variables, states))
        variables = variables | moved

    return growth(iteration)


def host_peak(task: Task, sampler: str) -> float:
    """MiB that NumPy allocates at most while the task is sampled, once all is kept that is kept."""
    prepared = rts.prepare(task.posed(np.array(START)), sampler)
    rts.sample(prepared, task.view, task.size, splatter="auto")
    tracemalloc.start()
    rts.sample(prepared, task.view, task.size, splatter="auto")
    peak = tracemalloc.get_traced_memory()[1] / MIB
    tracemalloc.stop()
    return peak


def worker(name: str, folder: str, side: str, engine: str, mode: str, sampler: str) -> dict:
    """One case, in this process."""
    task = Task(name, *kept_mesh(name, Path(folder)), int(side))
    grown = (torch_growth if engine == "torch" else jax_growth)(task, mode, sampler)
    return {"mib": grown, "host": host_peak(task, sampler), "faces": len(task.faces)}


def measure(names: list[str], side: int, folder: Path, done: Callable[[], None]) -> list[dict]:
    """Rows of the results."""
    rows = []
    for name in names:
        for engine, mode, sampler in CASES:
            case = [name, str(folder), str(side), engine, mode, sampler]
            command = [sys.executable, "-m", "benchmarks.speed.memory", *case]
            found = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
            rows.append({"mesh": name, "side": side, "engine": engine, "mode": mode, "sampler": sampler} | found)
            done()
    return rows


if __name__ == "__main__":
    print(json.dumps(worker(*sys.argv[1:])))
