"""What `import rts` sets in the process: how threads of torch wait, and how much freed memory is kept."""

from __future__ import annotations

import os
import sys

import numpy as np

TORCH_SPINS = "torch" in sys.modules and "OMP_WAIT_POLICY" not in os.environ
"""Whether torch was imported before rts: its idle OpenMP threads then spin, on cores that loops could use."""

if "OMP_WAIT_POLICY" not in os.environ:
    # Read where torch is imported, or another user of OpenMP.
    os.environ["OMP_WAIT_POLICY"] = "PASSIVE"
    # GNU's threads spin for some microseconds all the same: to wake one for each operation of torch takes far longer.
    os.environ.setdefault("GOMP_SPINCOUNT", "1000")

# Freed memory then serves the next step, whose pages the system would clear anew. glibc learns from the largest block
# below 32 MB that is freed: smaller ones come from the heap, whose end goes back once twice as much of it is free.
# `MALLOC_TRIM_THRESHOLD_` of the environment turns this off.
np.empty(31 << 20, np.uint8)
