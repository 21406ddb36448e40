"""warmup: loops of ordinary renders and fits, compiled ahead by making such calls.

numba's compiler has one lock a process, so several processes share the calls (`rts.compiling.warmup_calls`).
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from rts.compiling.threads import thread_count
from rts.errors import InputError, RtsError

FIRST = ("picture",)
OTHERS = ("least_squares", "gradient_of_vertices", "gradient_of_crossing", "least_squares_of_mask")
"""Names of calls in `warmup_calls`. The first compiles what all share; then the others run together, longest first."""


def warmup(processes: int | None = None) -> float:
    """Compile ahead what ordinary renders and fits of meshes use, and keep it on disk.

    Loops are otherwise compiled when they are first called, once for each installation: the first render takes long.
    If all loops are compiled already, it takes seconds. Only loops for float32 are compiled; those of derivatives only
    if torch or jax is installed.

    Args:
        processes: number of processes at once; more than five change nothing. None for `RTS_NUM_THREADS` of the
            environment, or else the number of cores.

    Returns:
        Seconds that it took.

    Raises:
        InputError: `processes` is no positive integer.
        RtsError: a process failed; the last line of its errors is in the message.
    """
    count = thread_count() if processes is None else processes
    if not isinstance(count, (int, np.integer)) or isinstance(count, bool) or count < 1:
        shown = repr(processes) if isinstance(processes, (int, float)) else f"a {type(processes).__name__}"
        raise InputError(f"processes is {shown}; expected a positive integer, or None")
    start = time.perf_counter()
    with ThreadPoolExecutor(min(int(count), len(OTHERS))) as pool:
        for names in (FIRST, OTHERS):
            list(pool.map(_call, names))
    return time.perf_counter() - start


def _call(name: str) -> None:
    """Make one of the calls in a process of its own, with the modules and the folder of compiled loops of this one."""
    path = [p or os.getcwd() for p in sys.path if isinstance(p, str)]  # An empty entry is the working directory.
    environment = {"PYTHONPATH": os.pathsep.join(path), "RTS_NUM_THREADS": "1"}
    if kept := getattr(getattr(sys.modules.get("numba"), "config", None), "CACHE_DIR", ""):
        environment["NUMBA_CACHE_DIR"] = str(kept)
    command = [sys.executable, "-P", "-m", "rts.compiling.warmup_calls", name]
    done = subprocess.run(
        command, env=os.environ | environment, stdin=subprocess.DEVNULL, capture_output=True, text=True
    )
    if done.returncode:
        errors = done.stderr.strip().splitlines() or [f"exit code {done.returncode}"]
        raise RtsError(f"could not compile loops: {errors[-1]}")
