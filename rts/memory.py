"""Memory that arrays leave behind, kept for the next ones.

glibc, the C library of most Linux systems, gives memory at the end of its heap back when more than a limit is free. An
iteration of a fit frees all its arrays and allocates them again: at 512 × 512 pixels the system then clears a thousand
pages each time, a sixth of the iteration. The limit follows the largest array that was ever freed, up to 64 MiB;
elsewhere nothing changes.
"""

from __future__ import annotations

import numpy as np

LARGEST = (32 << 20) - (1 << 16)
"""Bytes of the largest array that glibc takes as an example, less some for what it notes beside it."""


def keep_freed() -> None:
    """Let up to 64 MiB of freed memory stay with the process; the array that this takes is never touched."""
    np.empty(LARGEST, np.uint8)
