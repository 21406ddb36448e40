"""Speed against accuracy on all built-in scenes: what `rts compare` measures, as files to keep.

Writes a JSON a scene to benchmarks/results, and a picture of each to docs/images/results. summary.md says which
settings stay within 10 %, 3 % and 1 % of error. chart.html, a page of all scenes, is not kept: `--draw` makes it of the
JSON files. Measurements are kept in a folder of their own, and a run that is interrupted goes on:

    python -m benchmarks.chart                                 # most of two hours on two cores
    python -m benchmarks.chart --scenes "thin wires" -o /tmp/wires
"""

from __future__ import annotations

import argparse
import json
import statistics
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.report import table
from rts_compare import compare
from rts_compare.builtin_scenes import BUILTIN
from rts_compare.chart_style import label, samples_label, side_length
from rts_compare.comparison import file_name
from rts_compare.html_page import write_page
from rts_compare.moving_scenes import MODES
from rts_compare.pareto_front import LEVELS, best_within, timed
from rts_compare.png_chart import draw

RESULTS = Path(__file__).parent / "results"
IMAGES = Path(__file__).parent.parent / "docs/images/results"


def options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=RESULTS)
    parser.add_argument("--images", type=Path, help="folder of the pictures; by default docs/images/results, or OUTPUT")
    parser.add_argument("--scenes", nargs="+", choices=BUILTIN, default=list(BUILTIN))
    parser.add_argument("--kept", type=Path, default=Path("out/chart"), help="where measurements and truths are kept")
    parser.add_argument("--draw", action="store_true", help="only draw what the JSON files of the output hold")
    return parser.parse_args()


def main() -> None:
    args = options()
    images = args.images or (IMAGES if args.output == RESULTS else args.output)
    for folder in (args.output, images):
        folder.mkdir(parents=True, exist_ok=True)
    found = []
    for scene in args.scenes:
        path = args.output / f"{file_name(scene)}.json"
        if not args.draw:
            print(scene, flush=True)
            data = compare(scene, output=args.kept, truths=args.kept).data
            path.write_text(json.dumps(rounded(data), separators=(",", ":")) + "\n")
        found.append(json.loads(path.read_text()))
        draw(found[-1], images / f"{path.stem}.png")
    write_page(found, args.output / "chart.html")
    (args.output / "summary.md").write_text(summary(found))
    print(f"wrote {args.output}")


def rounded(value: Any) -> Any:
    """Numbers to four digits, which is more than what was measured means."""
    if isinstance(value, float):
        return float(f"{value:.4g}")
    if isinstance(value, Mapping):
        return {key: rounded(v) for key, v in value.items()}
    return [rounded(v) for v in value] if isinstance(value, (list, tuple)) else value


def own(comparison: Mapping, mode: str) -> list[Mapping]:
    """The library's own rows of a mode."""
    return [row for row in comparison["rows"] if row["mode"] == mode and "peer" not in row]


def summary(comparisons: Sequence[Mapping]) -> str:
    """The recommended settings: over all scenes, and for each of them."""
    count = len(comparisons)
    opening = (
        f"The least setting within an error in three quarters of {count} scenes, and its median time where it was "
        "timed;\n256². Where no setting stays within the error so often, *at best* says in how many scenes one does.\n"
    )
    parts = [f"### {c['scene']['name']}\n\n{fastest(c)}" for c in comparisons]
    return "\n".join([opening, recommended(comparisons), *parts])


def recommended(comparisons: Sequence[Mapping]) -> str:
    """The table of the least settings over all scenes, a line a mode and a column an error."""
    modes = [mode for mode in MODES if any(mode in c["modes"] for c in comparisons)]
    lines = [[mode, *(advice(comparisons, mode, level) for level in LEVELS)] for mode in modes]
    return table(["mode", *(f"{level:.0%}" for level in LEVELS)], lines)


def fastest(comparison: Mapping) -> str:
    """The table of the fastest settings of one scene; in brackets another renderer that is faster."""
    lines = []
    for mode in comparison["modes"]:
        cells = []
        for level in LEVELS:
            rows = [row for row in comparison["rows"] if row["mode"] == mode]
            best, peer = best_within(own(comparison, mode), level), best_within(rows, level)
            text = "none" if best is None else f"{label(best)}: {best['ms']['median']:.3g} ms"
            if peer is not None and "peer" in peer:
                text += f" (**{label(peer)}: {peer['ms']['median']:.3g} ms**)"
            cells.append(text)
        lines.append([mode, *cells])
    return table(["mode", *(f"{level:.0%}" for level in LEVELS)], lines)


def advice(comparisons: Sequence[Mapping], mode: str, level: float) -> str:
    """A cell of `recommended`; the least setting has the fewest samples a pixel, then the fewest layers."""
    scenes = [c for c in comparisons if mode in c["modes"]]
    within: dict[tuple, set[int]] = defaultdict(set)
    times: dict[tuple, dict[int, float]] = defaultdict(dict)
    for number, comparison in enumerate(scenes):
        for row in own(comparison, mode):
            s = row["settings"]
            key = s["splatter"], s["layers"], s["supersample"]
            if row["error"] > level or s["rate"]:
                continue
            within[key].add(number)
            if timed(row):
                times[key][number] = min(row["ms"]["median"], times[key].get(number, float("inf")))
    known = [key for key in within if times[key]]
    if not known:
        return "no setting in any scene"
    enough = [key for key in known if 4 * len(within[key]) >= 3 * len(scenes)]
    if enough:
        best = min(enough, key=lambda key: (side_length(key[2]), key[1], -len(within[key])))
    else:
        best = max(known, key=lambda key: (len(within[key]), -statistics.median(times[key].values())))
    splatter, layers, supersample = best
    asked = f"`{splatter}`, K = {layers}, {samples_label(supersample)}"
    text = f"{len(within[best])} of {len(scenes)}, {statistics.median(times[best].values()):.3g} ms"
    return f"{asked}: {text}" if enough else f"{asked}: at best {text}"


if __name__ == "__main__":
    main()
