"""Compiled loops on all cores, and arrays in the form that loops take."""

from rts.compiling.threads import parallel, read_only

__all__ = ["parallel", "read_only"]
