"""Bars of progress on the terminal: where they are shown, and the package that draws them."""

from __future__ import annotations

import sys

from rts.errors import PluginError


def shows_bar(wanted: bool | None) -> bool:
    """True if a bar of progress is to be drawn on standard error, by the package rich.

    Args:
        wanted: True to show it, False for none; None to show it on a terminal, if rich is installed.

    Raises:
        PluginError: `wanted` is True, and rich is not installed.
    """
    if wanted is False or (wanted is None and not (sys.stderr and sys.stderr.isatty())):
        return False
    try:
        import rich  # noqa: F401
    except ModuleNotFoundError as error:
        if wanted is None:
            return False
        raise PluginError(
            "progress=True needs the package 'rich': pip install 'rasterize-then-splat[cli]', or give progress=False"
        ) from error
    return True
