"""The tables of the page on the paper: each claim with its number, ours, and whether it holds."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

from benchmarks.pages.kept import kept as kept_file
from benchmarks.pages.kept import number, written
from benchmarks.paper.airplane import SPLATTERS
from benchmarks.paper.blur import WAYS
from benchmarks.paper.registry import EXPERIMENTS
from benchmarks.paper.rows import kept
from benchmarks.report import table


def poses_on_page() -> dict[str, Any]:
    """Numbers of the silhouettes, from the table of their page."""
    _, lines = written("poses", "mesh", "views", "method", keys=3)
    found: dict[str, Any] = {}
    for key, cells in lines.items():
        mesh, views, method = key.split(" | ")
        if views == "all":
            won, runs = (int(x) for x in cells[0].split(" of "))
            steps = number(cells[5])
            found.setdefault(mesh, {})[method] = {"success": won, "runs": runs, "steps": steps}
    return found


def times_on_page() -> dict[str, Any]:
    """Numbers of the times of poses, from the table of the page of speed."""
    columns, lines = written("speed", "256², ms")
    return {
        "faces": [int(number(c)) for c in columns],
        "ms": {name: [number(c) for c in cells] for name, cells in lines.items()},
    }


def field_on_page(side: str, views: int, head: str, names: dict[str, str]) -> dict[str, Any]:
    """Numbers of a radiance field, from a table of its page.

    Args:
        side: of the images, pixels, as text.
        views: number of them.
        head: the first cell of the table.
        names: stage → the name of its line.
    """
    columns, lines = written("radiance-field", head)
    stages: dict[str, Any] = {}
    for stage, name in names.items():
        cells = dict(zip(columns, lines[name], strict=True))
        steps = cells["steps"].replace(",", "")
        stages[stage] = {"psnr": number(cells["PSNR"]), "ssim": number(cells["SSIM"])}
        stages[stage]["steps"] = int(steps) if steps.isdigit() else 0
        used = cells.get("fine evaluations a covered pixel")
        if used and stage != "baseline":
            stages[stage]["evaluations"] = number(used)
    return {"side": side, "views": views, "stages": stages}


def lego_on_page() -> dict[str, Any]:
    names = {
        "baseline": "NeRF, volume",
        "fixed": "surface, fixed",
        "finetuned": "surface fixed, network finetuned",
        "joint": "surface and network, joint",
    }
    text = (written.__globals__["PAGES"] / "radiance-field.md").read_text()
    volume, surface = re.search(r"(\d\.\d+) s by volume, (\d\.\d+) s by surface", text).groups()
    found = field_on_page("100²", 25, "lego at 100², 25 views", names)
    return found | {"seconds": {"volume": float(volume), "surface": float(surface)}}


def fern_on_page() -> dict[str, Any]:
    names = {
        "baseline": "fern at 126 × 168, 3 views: volume",
        "fixed": "surface, fixed (161 × 145 × 128 in NDC)",
        "finetuned": "finetuned",
        "joint": "joint",
    }
    return field_on_page("126 × 168", 3, "", names)


ON_PAGES: dict[str, tuple[str, Callable[[], dict[str, Any]]]] = {
    "silhouettes": ("poses", poses_on_page),
    "pose-speed": ("speed", times_on_page),
    "hand": ("stability", lambda: kept_file("hand")),
    "lego": ("radiance-field", lego_on_page),
    "fern": ("radiance-field", fern_on_page),
}
"""Experiments whose measurements at full size stand on a page of their own: that page, and their numbers."""
