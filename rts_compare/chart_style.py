"""Looks and names of a comparison's rows in charts.

Colours are the palette of Okabe and Ito, which colour-blind readers can tell apart, and four others that they can tell
from it. Symbols have the names that plotly.js gives them.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from rts_compare.pareto_front import Row, milliseconds, timed

SPLATTER_COLORS = {
    "edges": "#D55E00",
    "multi": "#0072B2",
    "single": "#009E73",
    "none": "#5C6068",
    "auto": "#E69F00",
}
PEER_COLORS = {"DEODR": "#CC79A7", "Mitsuba": "#56B4E9"}
OTHER_COLORS = ("#7A3FF2", "#B10027", "#A8A85A", "#276262")
SAMPLER_SYMBOLS = {
    "raster": "circle",
    "reference": "square",
    "embree": "diamond",
    "opengl": "triangle-up",
    "rays": "triangle-down",
    "auto": "hexagon",
}
OTHER_SYMBOLS = ("pentagon", "star", "cross", "triangle-left", "triangle-right")
PEER_SYMBOL = "x"
ENGINE_FILLS = {"torch": "", "jax": "-open"}
OTHER_FILLS = ("-open-dot", "-dot")
"""Endings of a symbol's name: "" full, "-open" hollow, "-open-dot" hollow with a dot, "-dot" full with a dot."""
LIBRARY = "rasterize-then-splat"
"""The name of the distribution, as `environment` has it."""


def assigned(names: Iterable[str], fixed: Mapping[str, str], others: Sequence[str]) -> dict[str, str]:
    """The look (a colour or symbol) of each name: its fixed look if it has one, else the next of `others`.

    Args:
        names: any names; they may repeat.
        fixed: name → look.
        others: looks, used again and again where there are more names.

    Returns:
        Name → look, the fixed ones first.
    """
    given = set(names)
    foreign = sorted(given - fixed.keys())
    return {name: look for name, look in fixed.items() if name in given} | {
        name: others[index % len(others)] for index, name in enumerate(foreign)
    }


@dataclass(frozen=True)
class Looks:
    """The looks of all splatters, samplers, engines and other renderers in some comparisons.

    Attributes:
        splatters: name → colour.
        samplers: name → symbol.
        engines: name → ending of the symbol's name.
        peers: name of another renderer → colour.
    """

    splatters: dict[str, str]
    samplers: dict[str, str]
    engines: dict[str, str]
    peers: dict[str, str]

    @classmethod
    def of(cls, rows: Iterable[Row]) -> Looks:
        """The looks of all names in rows."""
        rows = list(rows)
        ours = [row["settings"] for row in rows if "peer" not in row]
        return cls(
            assigned((s["splatter"] for s in ours), SPLATTER_COLORS, OTHER_COLORS),
            assigned((s["sampler"] for s in ours), SAMPLER_SYMBOLS, OTHER_SYMBOLS),
            assigned((s["engine"] for s in ours), ENGINE_FILLS, OTHER_FILLS),
            assigned((row["peer"] for row in rows if "peer" in row), PEER_COLORS, OTHER_COLORS),
        )


def drawn(row: Row) -> bool:
    """True if a row's time and error are positive numbers, which logarithmic axes can show."""
    return timed(row) and milliseconds(row) > 0 and row["error"] > 0


def time_label(milliseconds: float) -> str:
    """The text of a time given in milliseconds, three digits or whole seconds: "0.25 ms", "47.5 ms", "4.75 s"."""
    if milliseconds < 999.5:
        return f"{milliseconds:.3g} ms"
    seconds = milliseconds / 1e3
    return f"{seconds:.3g} s" if seconds < 999.5 else f"{seconds:.0f} s"


def side_length(supersample: int) -> float:
    """The side of a row's symbol, screen pixels; it grows with samples along a pixel's side, up to 6 of these."""
    return 5.0 + 2.5 * min(supersample, 6)


def samples_label(supersample: int) -> str:
    """Samples a pixel: "4×4"."""
    return f"{supersample}×{supersample}"


def label(row: Row) -> str:
    """A row's settings in few words, such as "edges K=1 2×2 raster torch tolerance=0.4"; 1×1 is left out."""
    settings = row["settings"]
    if "peer" in row:
        return " ".join([row["peer"], *(f"{name}={value}" for name, value in settings.items())])
    samples = settings["supersample"]
    words = [settings["splatter"], f"K={settings['layers']}", samples_label(samples) if samples != 1 else ""]
    return " ".join(filter(None, [*words, settings["sampler"], settings["engine"], settings["rate"]]))


def arguments(row: Row) -> str:
    """A row's settings as keyword arguments of `rts.render` to copy; a comment names engine and rate, set elsewhere.

    For a row of another renderer, a comment alone.
    """
    settings = row["settings"]
    if "peer" in row:
        return "# " + ", ".join([row["peer"], *(f"{name}={value}" for name, value in settings.items())])
    names = ("sampler", "splatter", "layers", "supersample")
    given = ", ".join(f"{name}={json.dumps(settings[name], ensure_ascii=False)}" for name in names)
    return f"{given}  # " + ", ".join(filter(None, [settings["engine"], settings["rate"]]))


def environment_line(environment: Mapping[str, Any]) -> str:
    """The date, machine and versions of other packages of a comparison, in one line.

    The library's own version is left out: between releases its code changes, and the number does not.
    """
    others = {name: version for name, version in environment.get("versions", {}).items() if name != LIBRARY and version}
    versions = ", ".join(f"{name} {version}" for name, version in others.items())
    return "; ".join(filter(None, [environment.get("date"), environment.get("machine"), versions]))
