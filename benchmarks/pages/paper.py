"""The tables of the page on the paper: each claim with its number, ours, and whether it holds."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

from benchmarks.pages.kept import PAGES, number, written
from benchmarks.pages.kept import kept as kept_file
from benchmarks.paper.registry import EXPERIMENTS
from benchmarks.paper.rows import Row, kept
from benchmarks.report import table


def derivatives_on_page() -> dict[str, dict[str, float]]:
    """Numbers of derivatives: low-passed errors of three scenes."""
    columns, lines = written("accuracy", "method", "A raw")
    found = {}
    for line, cells in lines.items():
        name = re.sub(r"[`*]", "", line)
        name += dict.fromkeys(("none", "single", "edges"), ", K = 1").get(name, "")
        at = dict(zip(columns, cells, strict=True))
        if at["A low-pass"]:
            found[name] = {scene: number(at[f"{scene} low-pass"]) for scene in "ABC"}
    return found


def swept_on_page() -> list[dict[str, Any]]:
    """Numbers of the swept sphere."""
    columns, lines = written("topology", "swept sphere, 150 steps", keys=2)
    found = []
    for line, cells in lines.items():
        task, motion = line.split(" | ")
        for engine in ("torch", "jax"):
            radii = [float(x) for x in cells[columns.index(f"radii, {engine}")].split(", ")]
            task = re.sub(r"( \(|:).*", "", task)
            found.append({"task": task, "motion": motion, "engine": engine, "steps": 150, "radii": radii})
    return found


def spheres_on_page() -> list[dict[str, Any]]:
    """Numbers of the spheres."""
    _, lines = written("topology", "200 spheres, 400 steps", keys=3)
    names = "task", "motion", "engine"
    return [
        dict(zip(names, line.split(" | "), strict=True)) | {"steps": 400, "iou": number(cells[1])}
        for line, cells in lines.items()
    ]


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


def field_on_page(head: str, side: str, views: int, names: dict[str, str]) -> dict[str, Any]:
    """Numbers of a radiance field at one size, from a table of its page.

    Args:
        head: the table's first cell.
        side: of the images.
        views: number of them.
        names: stage → the name of its line.
    """
    columns, lines = written("radiance-field", head)
    stages: dict[str, Any] = {}
    for stage, name in names.items():
        cells = dict(zip(columns, lines[name], strict=True))
        steps, used = cells["steps"].replace(",", ""), cells.get("fine evaluations a covered pixel")
        stages[stage] = {"psnr": number(cells["PSNR"]), "ssim": number(cells["SSIM"])}
        stages[stage]["steps"] = int(steps) if steps.isdigit() else 0
        if used and stage != "baseline":
            stages[stage]["evaluations"] = number(used)
    return {"side": side, "views": views, "stages": stages}


def lego_on_page() -> dict[str, Any]:
    """Numbers of lego at two sizes, with the times of a frame that the page's prose tells."""
    names = {"baseline": "NeRF, volume", "finetuned": "surface fixed, network finetuned"}
    coarse = field_on_page("lego at 100², 25 views", "100²", 25, names | {"joint": "surface and network, joint"})
    fine = field_on_page("lego at 400², 3 views", "400²", 3, FEW)
    times = re.search(r"([\d.]+) s by volume,.* (\d+) times less", (PAGES / "radiance-field.md").read_text())
    assert times is not None
    volume, ratio = float(times[1]), float(times[2])
    columns, lines = written("radiance-field", "lego at 100², 25 views")
    used, spared = (
        number(lines[f"surface, fixed, by `edges`{option}"][columns.index("fine evaluations a covered pixel")])
        for option in (", K = 1", " with colours of centres")
    )
    seconds = {"volume": volume, "surface": volume / ratio}
    return {"sizes": [coarse, fine], "seconds": seconds, "edges": used, "centers": spared}


def fern_on_page() -> dict[str, Any]:
    """Numbers of fern."""
    return {"sizes": [field_on_page("fern at 126 × 168, 3 views", "126 × 168", 3, FEW)]}


FEW = {"baseline": "NeRF, volume", "finetuned": "finetuned", "joint": "joint"}
"""Stage → line, in the smaller tables of the page of radiance fields."""
ON_PAGES: dict[str, tuple[str, Callable[[], Any]]] = {
    "derivatives": ("accuracy", derivatives_on_page),
    "silhouettes": ("poses", poses_on_page),
    "pose-speed": ("speed", times_on_page),
    "hand": ("stability", lambda: kept_file("hand")),
    "swept": ("topology", swept_on_page),
    "spheres": ("topology", spheres_on_page),
    "lego": ("radiance-field", lego_on_page),
    "fern": ("radiance-field", fern_on_page),
}
"""Experiments whose measurements stand on a page of their own: that page, and their numbers."""


def found(name: str) -> tuple[list[Row], str]:
    """The rows of an experiment, and when it was run, at what size; a row "not run" where there is no result."""
    experiment, result = EXPERIMENTS[name], kept(name)
    if result is not None:
        about = result["about"]
        return experiment.rows(result["numbers"]), f"{about['size']}, {about['date']}"
    if name in ON_PAGES:
        page, numbers = ON_PAGES[name]
        return experiment.rows(numbers()), f"see [its page]({page}.md)"
    return [Row(experiment.place, "–", "–", "not run", f"`python -m benchmarks.paper {name} --keep`")], "–"


def claims() -> str:
    """All claims."""
    lines = []
    for name, experiment in EXPERIMENTS.items():
        rows, when = found(name)
        for row in rows:
            place = f"{experiment.place} (`{name}`)"
            lines.append([place, row.claim, row.number, row.ours, f"*{row.verdict}*", row.because or "–", when])
    head = ["in the paper", "claim", "its number", "ours", "holds?", "because, beside", "size, date"]
    return table(head, lines)


def counted() -> str:
    """A line: how many claims hold."""
    verdicts = [row.verdict for name in EXPERIMENTS for row in found(name)[0]]
    words = {"holds": "hold", "in part": "hold in part", "does not": "do not hold", "not run": "were not run"}
    told = "; ".join(f"{word}: {verdicts.count(verdict)}" for verdict, word in words.items())
    return f"Of {len(verdicts)} claims, {told}.\n"


def conditions() -> str:
    """The command of each result that is kept, with its time."""
    lines = []
    for name in EXPERIMENTS:
        if (result := kept(name)) is not None:
            about = result["about"]
            lines.append([f"`{name}`", f"`{about['command']}`", about["date"], f"{about['user_seconds']:.0f}",
                          f"{about['seconds']:.0f}"])  # fmt: skip
    return table(["result", "its script", "date", "user seconds", "seconds"], lines)


def airplane() -> str:
    """The airplane's fits, by splatter and method."""
    result = kept("airplane")
    if result is None:
        return "Not run yet.\n"
    lines = []
    for splatter, by in result["numbers"]["summary"].items():
        for method, one in by.items():
            cells = [f"{one['found']} of {one['starts']}", f"{one['iou']:.3f}", f"{one['loss']:.5f}"]
            for level in ("within 5 %", "within 1 %"):
                at = one[level]
                middle = f"{at['steps']:.0f} / {at['seconds']:.2f}" if at["common"] else "–"
                cells.append(f"{middle} ({at['reached']}; {at['common']})")
            title = {"lm": "Levenberg–Marquardt", "adam": "Adam"}[method]
            lines.append([f"`{splatter}`", title, *cells, f"{one['step_ms']:.0f}"])
    levels = [f"steps / s to {level} (starts; common)" for level in ("within 5 %", "within 1 %")]
    return table(["splatter", "method", "found", "IoU", "loss", *levels, "ms a step"], lines)


def blur() -> str:
    """PSNR of textures by the way they were fitted, with mipmaps and without."""
    result = kept("blur")
    if result is None:
        return "Not run yet.\n"
    psnr = result["numbers"]["psnr"]
    ways = list(psnr["mipmaps"])
    lines = [[title, *(f"{psnr[kind][way]:.1f}" for way in ways), *theirs]
             for kind, title, theirs in (("mipmaps", "with mipmaps", ("33.7", "33.2")),
                                         ("none", "without", ("25.4", "28.3")))]  # fmt: skip
    return table(["PSNR, dB", *(f"`{way}`" for way in ways), "the paper, sharp", "the paper, blurred"], lines)


PAPER: dict[str, Callable[[], str]] = {
    "paper": claims,
    "paper-count": counted,
    "paper-conditions": conditions,
    "paper-airplane": airplane,
    "paper-blur": blur,
}
"""Name of a mark → a function that makes its table."""
