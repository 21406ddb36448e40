"""The paper's claims about splines, isosurfaces and radiance fields, beside our numbers."""

from __future__ import annotations

import json
import statistics
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from benchmarks.paper.rows import Row, verdict

TORUS = 0.6, 0.25
"""The radii that the swept sphere is to find."""


def bspline_numbers(folder: Path) -> list[dict[str, Any]]:
    return json.loads((folder / "bspline.json").read_text())["runs"]


def bspline(numbers: list[dict[str, Any]]) -> list[Row]:
    adam = [r for r in numbers if r["method"] == "adam"]
    names = {"adam": "Adam", "lm": "Levenberg–Marquardt"}
    told = "; ".join(f"{names[r['method']]}, {r['engine']}: {r['iou']:.4f} in {r['iterations']}" for r in numbers)
    return [
        Row(
            "A cylinder becomes a chess piece by its silhouette, in 200 iterations",
            "200 iterations",
            f"IoU {told}",
            verdict(*(r["iou"] > 0.99 for r in adam)),
            f"by `edges`, 2 × 2 samples, at most 200 steps; images of {numbers[0]['side']}²; the paper's "
            "piece and camera are not given, ours are chosen",
        )
    ]


def implicit_numbers(section: str) -> Callable[[Path], list[dict[str, Any]]]:
    """A function that reads a section of `benchmarks.paper.implicit`, without the course of losses."""
    names = "task", "engine", "motion", "steps", "seconds", "loss_start", "loss", "iou", "radii"

    def numbers(folder: Path) -> list[dict[str, Any]]:
        rows = json.loads((folder / f"implicit_{section}.json").read_text())
        return [{name: row[name] for name in names if name in row} for row in rows]

    return numbers


def between(values: Sequence[float], digits: int = 3) -> str:
    """The range of some values."""
    low, high = (f"{x:.{digits}f}" for x in (min(values), max(values)))
    return low if low == high else f"{low} to {high}"


def fits(rows: list[dict[str, Any]]) -> str:
    """How many fits there are, and what they differ in."""
    ways = ", ".join(" and ".join(dict.fromkeys(r[key] for r in rows)) for key in ("motion", "engine"))
    return f"{len(rows)} fits: {ways}" if len(rows) > 1 else ways


def swept(numbers: list[dict[str, Any]]) -> list[Row]:
    def told(rows: list[dict[str, Any]]) -> str:
        circle, sphere = (between([r["radii"][i] for r in rows]) for i in (0, 1))
        return f"radii {circle} and {sphere}, of {TORUS[0]} and {TORUS[1]}, in {rows[0]['steps']} ({fits(rows)})"

    def found(row: dict[str, Any]) -> bool:
        return max(abs(a - b) for a, b in zip(row["radii"], TORUS, strict=True)) < 0.02

    aside = [r for r in numbers if r["task"].startswith("rotated")]
    front = [r for r in numbers if r["task"].startswith("front")]
    rows = [
        Row(
            "A swept sphere becomes a torus, through a change of topology, within 400 iterations",
            "400 iterations",
            told(aside),
            verdict(*(found(r) for r in aside)),
            "by `edges`; on 50³ points by the mean absolute error, as there; the camera is ours",
        )
    ]
    if front:
        rows.append(
            Row(
                "Seen along the axis it is trapped in a local minimum",
                "words",
                told(front),
                verdict(*(not found(r) for r in front)),
            )
        )
    return rows


def spheres(numbers: list[dict[str, Any]]) -> list[Row]:
    return [
        Row(
            "200 spheres become a torus within 400 iterations",
            "400 iterations",
            f"IoU {between([r['iou'] for r in numbers])} in {numbers[0]['steps']} ({fits(numbers)})",
            verdict(*(r["iou"] > 0.95 for r in numbers)),
            "by `edges`; spheres smaller than a cell of the lattice remain as specks: nothing shows them",
        )
    ]


# ---------------------------------------------------------------------------------------------------- radiance fields


PAPER_STEPS = 5000


def field_numbers(folder: Path) -> dict[str, Any]:
    """Means of PSNR and SSIM by stage, for each size of images, with evaluations and steps; times of a frame."""
    names = "baseline", "fixed", "finetuned", "joint"
    stages = {name: json.loads((folder / f"{name}.json").read_text()) for name in names}
    sizes = []
    for side, scores in stages["baseline"]["sides"].items():
        found = {name: _scored(stage, side) for name, stage in stages.items()}
        sizes.append({"side": f"{side} pixels", "views": len(scores["views"]), "stages": found})
    numbers: dict[str, Any] = {"sizes": sizes}
    if (folder / "times.json").exists():
        times = json.loads((folder / "times.json").read_text())
        numbers["seconds"] = {key: round(statistics.median(times[key]), 4) for key in ("volume", "surface")}
    return numbers


def _scored(stage: dict[str, Any], side: str) -> dict[str, Any]:
    scores = stage["sides"][side]
    found = {key: round(statistics.fmean(scores[key]), 3) for key in ("psnr", "ssim")}
    if "evaluations" in scores:
        found["evaluations"] = round(sum(scores["evaluations"]) / sum(scores["covered"]), 3)
    return found | {"steps": stage.get("steps", 0)}


def field_rows(numbers: dict[str, Any], behind: float, gained: float, theirs: tuple[str, str, str]) -> list[Row]:
    """Rows of a scene: how far the surface is behind the volume, and what refining it gains, in the paper."""
    quality, refined, near, better = [], [], [], []
    for size in numbers["sizes"]:
        stages = size["stages"]
        views = f"{size['side']}, {size['views']} views, {stages['joint']['steps']:,} steps"
        volume, fixed, joint = (stages[name]["psnr"] for name in ("baseline", "finetuned", "joint"))
        ssim = " → ".join(f"{stages[name]['ssim']:.3f}" for name in ("baseline", "joint"))
        quality.append(f"{volume:.2f} → {joint:.2f} dB ({signed(joint - volume)}), SSIM {ssim} ({views})")
        refined.append(f"{fixed:.2f} → {joint:.2f} dB ({signed(joint - fixed)}) ({views})")
        near.append(volume - joint <= behind + 0.1)
        better.append(joint - fixed >= gained / 2)
    return [
        Row(
            "A surface light field nearly has the quality of the volume",
            f"{theirs[0]} dB (−{behind:.1f}), SSIM {theirs[2]}",
            "; ".join(quality),
            verdict(*near),
            f"{PAPER_STEPS:,} steps in the paper; networks half as wide: those of its size are not at hand",
        ),
        Row(
            "Refining the surface beside the network gains over a fixed surface",
            f"{theirs[1]} dB (+{gained:.1f})",
            "; ".join(refined),
            verdict(*better),
        ),
    ]


def signed(change: float) -> str:
    return f"{change:+.2f}".replace("-", "−")


def lego(numbers: dict[str, Any]) -> list[Row]:
    rows = field_rows(numbers, 0.3, 2.2, ("29.91 → 29.61", "27.44 → 29.61", "0.962 → 0.957"))
    used = numbers["sizes"][0]["stages"]["joint"]["evaluations"]
    told = f"{128 / used:.0f} times fewer evaluations a covered pixel ({used:.2f} of two layers)"
    ratio = 0.0
    if "seconds" in numbers:
        ratio = numbers["seconds"]["volume"] / numbers["seconds"]["surface"]
        told += f"; a frame takes {ratio:.0f} times less"
    if "edges" in numbers:
        told += f"; `edges`: {numbers['edges']:.2f} of one layer, on the surface as it is found"
        told += f", or {numbers['centers']:.2f} with colours of centres"
    rows.append(
        Row(
            "One evaluation a pixel instead of 128",
            "128 times fewer",
            told,
            verdict(used <= 1.05, ratio >= 128),
            "a second layer is evaluated, too, where outlines need it; background costs nothing",
        )
    )
    return rows


def fern(numbers: dict[str, Any]) -> list[Row]:
    return field_rows(numbers, 0.9, 0.1, ("24.38 → 23.52", "23.41 → 23.52", "0.864 → 0.813"))
