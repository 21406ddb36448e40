"""The columns of the table of failures: methods, which are ways to render."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple


class Method(NamedTuple):
    """A way to render.

    Attributes:
        name: of the column.
        options: of `rts.render`; of a peer, its settings.
        peer: "DEODR" or "Mitsuba"; "" for the library itself.
    """

    name: str
    options: Mapping[str, Any]
    peer: str = ""


METHODS = (
    Method("none", {"splatter": "none", "layers": 1}),
    Method("single", {"splatter": "single", "layers": 1}),
    Method("multi, K = 2", {"splatter": "multi", "layers": 2}),
    Method("edges", {"splatter": "edges"}),
    Method("DEODR", {}, "DEODR"),
    Method("Mitsuba", {"spp": 16}, "Mitsuba"),
)
DEFAULT = "edges"
"""The column of the splatter that is the default."""
