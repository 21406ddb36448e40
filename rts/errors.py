"""Errors that the library raises on purpose, and its kinds of warnings; a public module, as `rts.errors`.

Each message says what was given, what was expected, and what to do next, in one line: line breaks and other characters
that no terminal shows, as names of files may have them, are escaped. A warning names a defect of an image that was
rendered nevertheless, or a likely mistake in the input.
"""

from __future__ import annotations

import sys
import warnings


class RtsError(Exception):
    """Base class of all errors of this library."""

    def __init__(self, *args: object):
        super().__init__(*(in_one_line(x) if isinstance(x, str) else x for x in args))


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


def warn(message: str, category: type[RtsWarning] | type[DeprecationWarning]) -> None:
    """Warn, in one line, and name the line outside of the library that called it."""
    level, frame = 1, sys._getframe(0)
    while frame is not None and frame.f_globals.get("__name__", "").partition(".")[0] in OWN_PACKAGES:
        level, frame = level + 1, frame.f_back
    warnings.warn(in_one_line(message), category, stacklevel=level)


def warn_deprecated(old: str, new: str, *, until: str) -> None:
    """Warn that a name or argument goes in a later minor version; until then it works as before.

    Args:
        old: the name, or how it is called: "rts.Fragments".
        new: the replacement.
        until: the version without it, at least one minor version after the first that warns: "0.4".
    """
    warn(f"{old} is deprecated and goes in rts {until}; take {new}", DeprecationWarning)


def in_one_line(text: str) -> str:
    """The text with line breaks, control characters and halves of surrogate pairs as Python's literals write them."""
    return text if text.isprintable() else "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)


OWN_PACKAGES = ("rts", "rts_backends", "rts_cli", "rts_compare", "rts_diagnostics", "rts_surfaces", "rts_testing")
