"""warmup: what ordinary renders and fits have compiled, compiled ahead.

numba's compiler has one lock a process, so several processes share the work. Each finds out what ordinary calls need
(`rts.rehearsal`), and compiles what none has begun.
"""

from __future__ import annotations

import subprocess
import tempfile
import time
from contextlib import ExitStack

import numpy as np

from rts import companion
from rts.arrays.argument_checks import quoted
from rts.errors import InputError, RtsError
from rts.threads import thread_count

MOST = 8
"""Processes that are used unless more are asked for: there are some sixty loops."""


def warmup(processes: int | None = None) -> float:
    """Compile ahead what ordinary renders and fits of meshes use, and keep it on disk.

    Loops are otherwise compiled when they are first called, once for each installation: the first render takes long.
    Where all is compiled it takes seconds. Loops are for float32, and for derivatives as well.

    Args:
        processes: how many to use at once; None for as many as there are cores for this process, 8 at most. One where
            the system is Windows.

    Returns:
        Seconds that it took.

    Raises:
        InputError: `processes` is no positive integer.
        RtsError: a process failed; what it said last is in the message.
    """
    count = min(thread_count(), MOST) if processes is None else processes
    if not isinstance(count, (int, np.integer)) or isinstance(count, bool) or count < 1:
        raise InputError(f"processes is {quoted(processes)}; expected a positive integer, or None")
    start = time.perf_counter()
    with ExitStack() as stack:
        file = stack.enter_context(tempfile.TemporaryFile())
        claims = companion.Claims(file) if companion.SHARED else None
        # They end when this is left, whatever happens: so do their standard inputs.
        begun = [
            stack.enter_context(companion.process(claims, everything=True, stderr=subprocess.PIPE))
            for _ in range(count if companion.SHARED else 1)
        ]
        for process in begun:
            said = process.stderr.read().decode(errors="replace").strip() if process.stderr else ""
            if process.wait():
                said = said or f"exit code {process.returncode}"
                raise RtsError(f"could not compile loops: {said.splitlines()[-1]}")
    return time.perf_counter() - start
