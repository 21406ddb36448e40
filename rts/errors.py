"""Errors that the library raises on purpose, and its kinds of warnings; a public module, as `rts.errors`.

Each message says what was given, what was expected, and what to do next. Warnings say what an image lacks that was
rendered nevertheless, or what in the input looks like a mistake.
"""

from __future__ import annotations

import sys
import warnings


class RtsError(Exception):
    """Base class of all errors of this library."""


class InputError(RtsError, ValueError):
    """The input is at fault: a shape, a value, a file, a name."""


class EngineError(RtsError, TypeError):
    """Arrays of two frameworks, or of none that is known, met in one call."""


class PluginError(RtsError, ImportError):
    """A plugin is registered but cannot be used: a package is missing, or its import fails."""


class RtsWarning(UserWarning):
    """Base class of all warnings of this library."""


class LayersWarning(RtsWarning):
    """`layers="auto"` came to its limit."""


class SamplerWarning(RtsWarning):
    """Another sampler stands in for the one that was chosen."""


class AspectWarning(RtsWarning):
    """An image of another ratio of width to height than its camera is for: it is stretched."""


class EmptyImageWarning(RtsWarning):
    """An image in which nothing is seen."""


class ToleranceWarning(RtsWarning):
    """No setting is as accurate as was asked for."""


class InputWarning(RtsWarning):
    """Input that is allowed, and is likely to mean something else than was meant."""


class FileWarning(RtsWarning):
    """A file was read, but not all that it says could be followed."""


def warn(message: str, category: type[RtsWarning]) -> None:
    """Warn at the line that called the library."""
    level, frame = 1, sys._getframe(0)
    while frame is not None and frame.f_globals.get("__name__", "").partition(".")[0] in OWN_PACKAGES:
        level, frame = level + 1, frame.f_back
    warnings.warn(message, category, stacklevel=level)


OWN_PACKAGES = ("rts", "rts_backends", "rts_compare", "rts_surfaces")
