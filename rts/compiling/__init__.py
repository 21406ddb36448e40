"""Loops compiled by numba: how, kept where, run on all cores, and compiled ahead."""
