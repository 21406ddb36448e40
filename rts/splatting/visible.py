"""The former splatter `visible`, a name of `edges` until the next minor version."""

from __future__ import annotations

from typing import Any

from rts.errors import InputError, warn_deprecated
from rts.splatting.edges import Edges


class Visible(Edges):
    """`Edges`, under the name of a splatter that is gone; goes in rts 0.4."""

    def __init__(self, *settings: Any, **options: Any):
        """Warn; settings of the former splatter are an InputError."""
        if settings or options:
            raise InputError(
                f"splatter 'visible' is now 'edges', which has no settings; it was given "
                f"{', '.join([*map(repr, settings), *options])}; take splatter='edges', or 'multi'"
            )
        warn_deprecated("splatter 'visible'", "'edges', which it now is", until="0.4")
