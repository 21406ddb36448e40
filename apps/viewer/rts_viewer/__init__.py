"""A live view in the browser: of a model by `rts view`, and of a fit while it runs by `Watch`."""

from rts_viewer.watch import Watch

__all__ = ["Watch"]
