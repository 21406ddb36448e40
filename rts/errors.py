"""Errors that the library raises on purpose, and its kinds of warnings; a public module, as `rts.errors`.

Each message says what was given, what was expected, and what to do next. A warning names a defect of an image that was
rendered nevertheless, or a likely mistake in the input.
"""

from __future__ import annotations

import sys
import warnings


class RtsError(Exception):
    """Base class of all errors of this library."""


class InputError(RtsError, ValueError):
    """The input is at fault: a shape, a value, a file, a name."""


class EngineError(RtsError, TypeError):
    """Arrays of two frameworks met in one call, or arrays of an unknown framework, or of one without derivatives."""


class PluginError(RtsError, ImportError):
    """A plugin cannot be used: a package is missing, its import fails, or its class breaks a rule of its base."""


class RtsWarning(UserWarning):
    """Base class of all warnings of this library."""


class LayersWarning(RtsWarning):
    """Layers that contribute to an image are missing from it."""


class SamplerWarning(RtsWarning):
    """Another sampler replaces the chosen one."""


class AspectWarning(RtsWarning):
    """An image is stretched: its ratio of width to height is not its camera's."""


class EmptyImageWarning(RtsWarning):
    """Nothing is seen in an image."""


class ToleranceWarning(RtsWarning):
    """No setting that was tried is as accurate as required."""


class InputWarning(RtsWarning):
    """Input is allowed, but is probably a mistake."""


class FileWarning(RtsWarning):
    """A file was read, but some of its content was ignored."""


def warn(message: str, category: type[RtsWarning]) -> None:
    """Warn, and name the line outside of the library that called it."""
    level, frame = 1, sys._getframe(0)
    while frame is not None and frame.f_globals.get("__name__", "").partition(".")[0] in OWN_PACKAGES:
        level, frame = level + 1, frame.f_back
    warnings.warn(message, category, stacklevel=level)


OWN_PACKAGES = ("rts", "rts_backends", "rts_compare", "rts_surfaces")
