"""Memory that is kept for the next call."""

from __future__ import annotations

import functools

import numpy as np

LARGEST = 31 << 20
"""Bytes of the largest block that glibc may keep; of twice as many free ones it gives none back."""


@functools.cache
def keep_memory() -> None:
    """Have the allocator keep what is freed, for the next arrays of some megabytes; done once.

    By default glibc hands a few megabytes that are free back to the system, which gives them again as pages that are
    cleared one by one: longer than it takes to fill them. What it keeps grows with the largest block that was ever
    freed (`M_MMAP_THRESHOLD` in mallopt(3)), so one is freed that nobody touched. Where the environment sets a
    threshold, or with another allocator, it has no effect.
    """
    np.empty(LARGEST, np.uint8)
