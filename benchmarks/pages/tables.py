"""The tables and lists of the pages of results that have JSON files."""

from __future__ import annotations

import re
import statistics
import textwrap
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping

from benchmarks import basin, nvdiffrast
from benchmarks.chart import fastest, own, recommended
from benchmarks.pages.kept import kept, scene, scenes
from benchmarks.paper import hand
from benchmarks.report import table
from rts_compare.comparison import file_name

MARKS = {"ok": "", "degraded": "~ ", "failed": "✗ "}
SAMPLES = {"1": "1 × 1", "2": "2 × 2", "adaptive:4": "4 × 4 at outlines", "4": "4 × 4"}
"""`Setting.supersample` → its name on the page."""
MODES = ("translation", "rotation", "shape", "camera")


def stability() -> str:
    """Ways to fail against methods."""
    found = kept("stability")
    lines = []
    for row in found["rows"]:
        cells = [MARKS[c["verdict"]] + c["text"] if c["verdict"] in MARKS else "–" for c in row["cells"]]
        lines.append([row["name"], *cells])
    return table(["", *found["methods"]], lines)


def hand_rates() -> str:
    """The hand's median errors by method and learning rate."""
    return hand.summary(kept("hand"))


def hand_seeds() -> str:
    """A list: where each seed of the hand ends at the two rates beyond which nothing holds."""
    fits = kept("hand")["fits"]
    lines = []
    for factor in list(next(iter(fits.values())))[-3:-1]:
        ends = {m: " ".join(f"{run['error']:.3f}" for run in runs[factor]) for m, runs in fits.items()}
        told = "; ".join(f"`{method}` {text}" for method, text in ends.items())
        lines.append(f"At ×{factor} the seeds end at: {told}.")
    return _items(*lines)


def why() -> str:
    """Why cells of the table of stability fail, row by row."""
    rows = kept("stability")["rows"]
    return table(["way to fail", "scene and figure", "why"], [[r["name"], r["note"], r["why"] or "–"] for r in rows])


def defects() -> str:
    """Planted mistakes, and the test that catches each."""
    lines = []
    for found in kept("defects"):
        place, _, test = (found["test"] or "").partition("::")
        name = re.sub(r"\[.*", "", test.replace("::", "."))
        caught = f"`{place.removeprefix('tests/').removesuffix('.py')}: {name}`" if test else "none"
        lines.append([found["name"], "yes" if found["loop"] else "", caught])
    return table(["defect", "in a loop", "caught by"], lines)


def medians() -> str:
    """Median errors over the scenes, `visible`, by samples a pixel; and the median time with two layers and torch."""
    lines = []
    for samples, name in SAMPLES.items():
        cells, times = [], []
        for mode in MODES:
            found = [_row(s, mode, samples) for s in scenes()]
            cells.append(f"{100 * statistics.median(e for e, _ in found):.1f} %")
            times = times or [ms for _, ms in found if ms is not None]
        lines.append([name, *cells, f"{statistics.median(times):.0f} ({len(times)} scenes)"])
    return table(["samples a pixel", *MODES, "ms"], lines)


def layers() -> str:
    """In how many scenes `visible` with one sample a pixel is off by at most 10 %, by the number of layers."""
    numbers = 1, 2, 4
    lines = [[mode, *(str(sum(_error(s, mode, n) <= 0.1 for s in scenes())) for n in numbers)] for mode in MODES]
    return table([f"of {len(scenes())} scenes", *(f"K = {n}" for n in numbers)], lines)


def _error(comparison: Mapping, mode: str, number: int) -> float:
    """The error of `visible` with so many layers and one sample a pixel, at the scene's own rate."""
    wanted = {"splatter": "visible", "layers": number, "supersample": 1, "rate": ""}
    return min(r["error"] for r in own(comparison, mode) if wanted.items() <= r["settings"].items())


def _row(comparison: Mapping, mode: str, samples: str) -> tuple[float, float | None]:
    """The error of `visible` with all layers that count, and its least time with two layers and torch."""
    rows = [r for r in own(comparison, mode) if str(r["settings"]["supersample"]) == samples]
    rows = [r for r in rows if r["settings"]["splatter"] == "visible" and not r["settings"]["rate"]]
    two = [r for r in rows if r["settings"]["layers"] == 2 and r["settings"]["engine"] == "torch" and r["ms"]]
    error = min(r["error"] for r in rows if r["settings"]["layers"] == "auto")
    return error, min((r["ms"]["median"] for r in two), default=None)


def ratios() -> str:
    """A list: the time of each sampler beside `raster`, and of jax beside torch; medians over settings."""
    samplers, engines = defaultdict(list), defaultdict(list)
    for samples, times in _timed():
        for (sampler, engine), ms in times.items():
            if engine == "torch" and sampler != "raster" and ("raster", "torch") in times:
                samplers[sampler].append(ms / times["raster", "torch"])
            if engine == "jax" and samples.isdecimal() and (sampler, "torch") in times:
                engines[samples].append(ms / times[sampler, "torch"])
    ours = ", ".join(f"`{n}` {statistics.median(r):.2g} times" for n, r in sorted(samplers.items()))
    jax = ", ".join(f"{statistics.median(engines[s]):.2g} times with {n}" for s, n in SAMPLES.items() if s in engines)
    return _items(
        f"*Samplers*, beside the time of `raster`, medians over settings: {ours}. `toy` is an example plugin.",
        f"*jax*, compiled, beside the time of torch: {jax}. Samples at outlines: the table below.",
    )


def _items(*texts: str) -> str:
    """A list in Markdown, in lines of 120 characters."""
    return "\n".join(textwrap.fill(t, 120, initial_indent="- ", subsequent_indent="  ") for t in texts) + "\n"


def _timed() -> Iterator[tuple[str, dict[tuple[str, str], float]]]:
    """Samples a pixel of each setting, and its times by sampler and engine."""
    for comparison in scenes():
        found = defaultdict(dict)
        for row in comparison["rows"]:
            if "peer" not in row and row["ms"]:
                s = row["settings"]
                samples = str(s["supersample"])
                key = row["mode"], s["splatter"], s["layers"], samples, s["rate"]
                found[key][s["sampler"], s["engine"]] = row["ms"]["median"]
        yield from ((key[3], times) for key, times in found.items())


def faces() -> str:
    """A line: what fewer faces of the bunny save, and what error they bring."""
    rows = [r for r in own(scene("bunny over black"), "translation") if r["ms"]]
    rows = [r for r in rows if (r["settings"]["splatter"], r["settings"]["layers"]) == ("visible", 1)]
    at = {(r["settings"]["rate"], r["settings"]["supersample"], r["settings"]["sampler"], r["settings"]["engine"]): r
          for r in rows}  # fmt: skip
    whole, fewer, fewest = (at[rate, 1, "raster", "torch"] for rate in ("", "faces=17362", "faces=4339"))
    told = ", ".join(f"{100 * r['error']:.0f} % in {r['ms']['median']:.1f} ms" for r in (whole, fewer, fewest))
    return _items(f"*Fewer faces*: the bunny, all of its faces, a quarter and a sixteenth: {told}.")


def by_scene() -> str:
    """The chart and the fastest settings of each scene."""
    parts = []
    for found in scenes():
        name = found["scene"]["name"]
        picture = f"![{name}: error against time](../images/results/{file_name(name)}.png)"
        parts.append(f"### {name}\n\n{found['scene']['note']}.\n\n{fastest(found)}\n{picture}\n")
    return "\n".join(parts)


TABLES: dict[str, Callable[[], str]] = {
    "stability": stability,
    "why": why,
    "hand": hand_rates,
    "hand-seeds": hand_seeds,
    "defects": defects,
    "layers": layers,
    "medians": medians,
    "ratios": ratios,
    "faces": faces,
    "scenes": by_scene,
    "advice": lambda: recommended(scenes()),
    "nvdiffrast-cube": lambda: nvdiffrast.cube_table(kept("nvdiffrast")),
    "nvdiffrast-pose": lambda: nvdiffrast.pose_table(kept("nvdiffrast")),
    "nvdiffrast-outlines": lambda: nvdiffrast.outline_table(kept("nvdiffrast")),
    "nvdiffrast-time": lambda: nvdiffrast.time_table(kept("nvdiffrast")),
    "basin": lambda: basin.summary(kept("basin")["rows"]),
}
"""Name of a mark → a function that makes its table."""
