"""Comparisons of settings as one interactive page, which needs no network."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from importlib.resources import files
from pathlib import Path
from typing import Any

from rts.errors import InputError, PluginError
from rts.tool_api.files import writing
from rts_compare.chart_style import (
    OTHER_COLORS,
    PEER_COLORS,
    PEER_SYMBOL,
    SPLATTER_COLORS,
    Looks,
    arguments,
    drawn,
    environment_line,
    label,
    samples_label,
    side_length,
)
from rts_compare.pareto_front import LEVELS, Row, best_within


def write_page(comparisons: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Write comparisons as one HTML file: a chart to hover over and click on, with menus for scene and mode.

    `path#scene=…&mode=…` is a link to one scene and mode.

    Args:
        comparisons: `Comparison.data` of each, also as read from its JSON file; one a scene.
        path: of the HTML.

    Raises:
        PluginError: plotly is missing.
        InputError: there is no comparison, or the file cannot be written.
    """
    try:
        from plotly.offline import get_plotlyjs
    except ModuleNotFoundError as error:
        raise PluginError("interactive charts need plotly: pip install 'rasterize-then-splat[plots]'") from error
    if not comparisons:
        raise InputError("there is no comparison to write a page of; expected at least one")
    template = (files("rts_compare") / "page.html").read_text(encoding="utf-8")
    # In JSON "<" only occurs in strings: escaped, no name can end the HTML script.
    data = json.dumps(_data(comparisons), separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    inserted = {"plotly": get_plotlyjs(), "data": data}
    with writing(path):
        path.write_text(re.sub("@@([a-z]+)@@", lambda m: inserted[m[1]], template), encoding="utf-8")


def _data(comparisons: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """The data of the page. Settings are listed once, and rows refer to them by index."""
    rows = [row for comparison in comparisons for row in comparison["rows"] if drawn(row)]
    settings: dict[str, int] = {}
    descriptions = []
    for row in rows:
        if arguments(row) not in settings:
            settings[arguments(row)] = len(settings)
            descriptions.append(_settings(row))
    return {
        "looks": {
            **asdict(Looks.of(rows)),
            "peer_symbol": PEER_SYMBOL,
            "colors": [*SPLATTER_COLORS.values(), *PEER_COLORS.values(), *OTHER_COLORS],
        },
        "settings": descriptions,
        "scenes": [_scene(comparison, settings) for comparison in comparisons],
    }


def _settings(row: Row) -> dict[str, Any]:
    """The settings of a row as texts, with the size of its symbol."""
    given = row["settings"]
    shown = {"text": arguments(row), "label": label(row), "size": side_length(given.get("supersample", 1))}
    if "peer" in row:
        return {**shown, "peer": row["peer"]}
    return {
        **shown,
        **{name: given[name] for name in ("splatter", "sampler", "engine")},
        "layers": f"K={given['layers']}",
        "samples": samples_label(given["supersample"]).replace("×", " × "),
        "rate": given["rate"] or "as given",
    }


def _scene(comparison: Mapping[str, Any], settings: Mapping[str, int]) -> dict[str, Any]:
    """The page's data of one comparison: texts on the scene, and its modes as `_mode` returns them."""
    scene = comparison["scene"]
    return {
        "name": scene["name"],
        "note": scene.get("note", ""),
        "size": " × ".join(map(str, scene["size"])),
        "environment": environment_line(comparison["environment"]),
        "left_out": comparison["left_out"],
        "untimed": len({_key(row) for row in comparison["rows"] if row["ms"] is None}),
        "modes": {
            mode: _mode(found["truth_error"], [row for row in comparison["rows"] if row["mode"] == mode], settings)
            for mode, found in comparison["modes"].items()
        },
    }


def _key(row: Row) -> str:
    return json.dumps(row["settings"], sort_keys=True)


def _mode(truth_error: float, rows: Sequence[Row], settings: Mapping[str, int]) -> dict[str, Any]:
    """The rows of a mode as columns, and indices of rows: the front, the fastest within each of `LEVELS`, the best."""
    rows = [row for row in rows if drawn(row)]
    index = {id(row): i for i, row in enumerate(rows)}
    ours, peers = [row for row in rows if "peer" not in row], [row for row in rows if "peer" in row]

    def fastest(among: Sequence[Row], error: float) -> int | None:
        found = best_within(among, error)
        return None if found is None else index[id(found)]

    return {
        "truth_error": _short(truth_error),
        "settings": [settings[arguments(row)] for row in rows],
        "error": [_short(row["error"]) for row in rows],
        **{name: [_short(row["ms"][name]) for row in rows] for name in ("median", "low", "high")},
        "calls": [row["ms"]["calls"] for row in rows],
        "front": [i for i, row in enumerate(rows) if row.get("front")],
        "within": [[error, fastest(ours, error), fastest(peers, error)] for error in LEVELS],
        "least": index[id(min(ours, key=lambda row: row["error"]))] if ours else None,
    }


def _short(value: float) -> float | None:
    """The number in five digits; None for infinity and NaN, which JSON lacks."""
    return float(f"{value:.5g}") if math.isfinite(value) else None
