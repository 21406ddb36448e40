"""Settings of the process that `import rts` makes: how threads of torch wait, and how much freed memory is kept."""

from __future__ import annotations

import ctypes
import os
import sys

TORCH_SPINS = "torch" in sys.modules and "OMP_WAIT_POLICY" not in os.environ
"""Whether torch was imported before rts: its idle OpenMP threads then spin, on cores that loops could use."""

if "OMP_WAIT_POLICY" not in os.environ:
    # Read where torch is imported, or another user of OpenMP.
    os.environ["OMP_WAIT_POLICY"] = "PASSIVE"
    # GNU's threads spin for some microseconds all the same: to wake one for each operation of torch takes far longer.
    os.environ.setdefault("GOMP_SPINCOUNT", "1000")

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3
"""The parameters' numbers in malloc.h."""
KEPT, HEAP = 128 << 20, 31 << 20
"""Bytes at a heap's end that stay when they are free; smaller blocks than the second number come from the heap."""


def _keep_freed_memory() -> None:
    """Have freed memory serve the next step, whose pages the system would clear anew; glibc alone.

    Settings of the environment go first.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform == "linux" else None
    given = {"MALLOC_TRIM_THRESHOLD_", "MALLOC_MMAP_THRESHOLD_"} & os.environ.keys()
    if mallopt is not None and not given and "glibc.malloc" not in os.environ.get("GLIBC_TUNABLES", ""):
        mallopt(M_TRIM_THRESHOLD, KEPT)
        mallopt(M_MMAP_THRESHOLD, HEAP)


_keep_freed_memory()
