"""Compiled loops on all cores, and arrays as they take them."""

from rts.compiling.threads import parallel, read_only

__all__ = ["parallel", "read_only"]
