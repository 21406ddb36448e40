"""Loops: compiled by numba, kept on disk, run on all cores, and compiled ahead."""

from rts.compiling import process as process
