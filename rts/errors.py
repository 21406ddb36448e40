"""Every error that the library raises on purpose.

Each message says what was given, what was expected, and what to do next.
"""


class RtsError(Exception):
    """Base class of all errors of this library."""


class InputError(RtsError, ValueError):
    """The input is at fault: a shape, a value, a file, a name."""


class EngineError(RtsError, TypeError):
    """Arrays of two frameworks, or of none that is known, met in one call."""


class PluginError(RtsError, ImportError):
    """A plugin is registered but cannot be used: a package is missing, or its import fails."""


class LayersWarning(UserWarning):
    """`layers="auto"` came to its limit."""
