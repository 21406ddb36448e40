"""Decorators that compile loops. This module imports numba: import it from modules of loops alone."""

from rts.compiling.loops import compiled, loop

__all__ = ["compiled", "loop"]
