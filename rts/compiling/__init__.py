"""Loops: compiled by numba, kept on disk, run on all cores, and compiled ahead."""
