"""A table of ways to fail against methods; each cell is an outcome with its figure.

The rows are those of `rts_compare.stability`, and the hand of the data folder (`benchmarks.paper.hand`). Written to
the output are stability.md, stability.json and stability.png. The hand's errors are in hand.json, its
pictures in hand.png. Copies go to benchmarks/results and docs/images.
A run that is interrupted goes on; rows can be run alone:

    python -m benchmarks.stability                                    # all of it
    python -m benchmarks.stability --rows "grazing sheet" pose -o /tmp/rows --no-results
"""

from __future__ import annotations

import argparse
import json
import shutil
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.paper import hand
from rts_compare import Stability, stability
from rts_compare.failures.table_cells import Context, Outcome, Row, cannot
from rts_compare.failures.table_columns import METHODS, Method
from rts_compare.failures.table_rows import ROWS
from rts_compare.kept_measurements import KeptMeasurements

RESULTS = Path(__file__).parent / "results"
IMAGES = Path(__file__).parent.parent / "docs/images/results"
COLORS = {"ok": "#CDE9D6", "degraded": "#FBE7A8", "failed": "#F4B6AB", "cannot": "#ECECEC"}
HAND = "hand, over learning rates"


def hand_row(kept: KeptMeasurements) -> Row:
    """The row of the hand."""
    note = (
        "Three photographs, as rigid as possible, rates ×0.1 to ×30, 3 seeds. Figure: the median RMS error (sRGB) at "
        f"the best rate; the highest rate at which no seed ends above {hand.STALLED} of the error at the start. "
        "Degraded where another method stands a higher one."
    )
    why = "`single` does not know what an outline that moves brings to light; `multi` and `edges` do."
    return Row(HAND, note, partial(_hand, kept), why)


def _hand(kept: KeptMeasurements, method: Method, context: Context) -> Outcome:
    """One cell of it; DEODR's is its own fitter's."""
    if method.peer == "Mitsuba":
        return cannot("a fit of 1,800 images of it takes an hour")
    found = hand.measured(kept, hand.FACTORS, hand.SEEDS, hand.STEPS)
    if method.peer == "DEODR":
        error = found["deodr"]["error"]
        return Outcome("ok", f"{error:.4f}, its own fitter", {"error": error, "nan": 0})
    if method.name not in found["fits"]:
        return cannot("not among the methods that the hand was fitted by")
    highest = {name: _highest(runs, found["start"]) for name, runs in found["fits"].items()}
    runs = found["fits"][method.name]
    best = min(float(np.median([r["error"] for r in rs])) for rs in runs.values())
    mine = highest[method.name]
    verdict = "failed" if not mine else "ok" if mine == max(highest.values()) else "degraded"
    nan = sum("not finite" in r["reason"] for rs in runs.values() for r in rs)
    return Outcome(verdict, f"{best:.4f}, ×{mine:g}", {"best": best, "highest": mine, "nan": nan})


def _highest(runs: dict[str, list[dict]], begun: list[float]) -> float:
    """The highest rate at which all seeds end well."""
    well = [
        f for f, rs in runs.items() if all(hand.verdict(r["error"], b) == "ok" for r, b in zip(rs, begun, strict=True))
    ]
    return max(map(float, well), default=0.0)


def draw(table: Stability, path: Path) -> None:
    """The table as a picture, cells coloured by verdict."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    rows, columns = len(table.rows), len(table.methods)
    figure, axes = plt.subplots(figsize=(3.2 + 1.75 * columns, 0.9 + 0.31 * rows))
    axes.set(xlim=(-1.75, columns), ylim=(rows, -1))
    axes.axis("off")
    for column, name in enumerate(table.methods):
        axes.text(column + 0.5, -0.35, name, ha="center", va="center", fontsize=9, weight="bold")
    for number, (row, cells) in enumerate(table.rows):
        axes.text(-0.05, number + 0.5, row.name, ha="right", va="center", fontsize=8.5)
        for column, cell in enumerate(cells):
            box = plt.Rectangle((column + 0.02, number + 0.05), 0.96, 0.9, color=COLORS[cell.verdict], lw=0)
            axes.add_patch(box)
            text = "–" if cell.verdict == "cannot" else cell.text
            axes.text(column + 0.5, number + 0.52, text, ha="center", va="center", fontsize=7 if len(text) < 26 else 5)
    for number, (verdict, color) in enumerate(COLORS.items()):
        axes.text(number * 0.9, rows - 0.05 + 0.4, verdict, fontsize=8, va="center",
                  bbox={"facecolor": color, "edgecolor": "none", "pad": 2}, clip_on=False)  # fmt: skip
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    plt.close(figure)


def options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=Path("out/stability"))
    names: Any = [HAND, *(row.name for row in ROWS)]
    parser.add_argument("--rows", nargs="+", choices=names, metavar="ROW", help="; ".join(names))
    parser.add_argument("--methods", nargs="+", choices=[m.name for m in METHODS], metavar="METHOD")
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--fresh", action="store_true", help="forget what earlier runs have measured")
    parser.add_argument("--no-results", action="store_true", help="leave benchmarks/results as it is")
    return parser.parse_args()


def main() -> None:
    args = options()
    args.output.mkdir(parents=True, exist_ok=True)
    kept = KeptMeasurements(args.output / ".hand.jsonl")
    more = [hand_row(kept)] if args.rows is None or HAND in args.rows else []
    rows = None if args.rows is None else [name for name in args.rows if name != HAND]
    table = stability(rows, args.methods, seeds=args.seeds, output=args.output, fresh=args.fresh, more=more)
    print(table)
    draw(table, args.output / "stability.png")
    if more:
        found = hand.measured(kept, hand.FACTORS, hand.SEEDS, hand.STEPS)
        print(hand.summary(found))
        hand.draw(found, args.output / "hand.png")
        (args.output / "hand.json").write_text(json.dumps(hand.errors(found), indent=1) + "\n")
    if args.rows is None and not args.no_results:
        for name in ("stability.md", "stability.json", "hand.json"):
            shutil.copy(args.output / name, RESULTS / name)
        shutil.copy(args.output / "stability.png", IMAGES / "stability.png")
        shutil.copy(args.output / "hand.png", IMAGES.parent / "paper" / "hand.png")
    print(f"wrote {args.output}")


if __name__ == "__main__":
    main()
