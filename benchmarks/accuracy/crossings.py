"""Derivatives where surfaces pass through one another: lines that move as depths say, and as samples do.

Low-passed relative L2 / gain / error of random losses against differences of area-sampled renders; and how much
derivatives of all other scenes differ, where no surfaces cross:

    python -m benchmarks.accuracy.crossings
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

import rts
from benchmarks.accuracy import methods, scenes
from benchmarks.accuracy.crossing_scenes import CROSSING
from benchmarks.accuracy.figures import CONTRAST_LOW, show, signed
from benchmarks.report import table
from rts.diagnostics.smoothing import low_pass
from rts_compare.derivative_scores import all_scores
from rts_compare.failures.method_renderers import Own

FAILURES = "thin plate", "planes at two degrees", "three planes", "bar through card"
SHOWN = slice(40, 216)
"""Rows and columns of pictures."""
VISIBLE = rts.plugin("rts.splatters", "visible")
SETTINGS = ((2, 1), (4, 1), (2, 2), (4, 2))
"""K, and s for s² samples a pixel."""
OTHERS = (
    "A",
    "B",
    "C",
    "A unculled",
    "C unculled",
    "box over card",
    "turned box",
    "6 cards",
    "8 cards, alternating",
    "sheet",
    "disk",
    "spot",
)


def scene(name: str) -> scenes.Scene:
    return CROSSING[name](scenes.SIZE) if name in CROSSING else scenes.scene(name)


def derivative(chosen: scenes.Scene, layers: int, fine: int, crossings: bool) -> np.ndarray:
    """(H, W, 3) by forward mode."""
    options = {"splatter": VISIBLE(crossings=crossings), "layers": layers, "supersample": fine}
    return Own(chosen.moving, options).derivative(scenes.MOTION)


def cell(found: np.ndarray, true: np.ndarray) -> str:
    row = all_scores(found, true)
    return f"{row['low_relative_l2']:.3f} / {row['low_gain']:.3f} / {row['loss_error']:.3f}"


def crossing_lines(names: list[str], folder: Path, spp: int) -> list[list[str]]:
    lines = []
    for name in names:
        chosen = scene(name)
        against = chosen.truth(folder, chosen.step)
        noise = f"{against.noise['low_relative_l2']:.3f}"
        for layers, fine in SETTINGS:
            cells = [cell(derivative(chosen, layers, fine, on), against.derivative) for on in (False, True)]
            lines.append([name, methods.name_of("visible", layers, fine), *cells, noise])
            print(*lines[-1], sep=" | ", flush=True)
        for peer in methods.others(chosen, [spp])[0] if spp else ():
            lines.append([name, peer.name, "", cell(peer.derivative(0), against.derivative), noise])
            print(*lines[-1], sep=" | ", flush=True)
    return lines


def pictures(folder: Path, path: Path) -> None:
    """Pictures of the remaining errors at lines of crossing, with one sample a pixel."""
    from matplotlib.figure import Figure

    titles = "image", "derivative, truth", "as samples", "as depths", f"low-passed difference × {CONTRAST_LOW:g}"
    figure = Figure(figsize=(2.9 * 5, 2.9 * len(FAILURES) + 0.4), layout="constrained")
    for n, (line, name) in enumerate(zip(figure.subplots(len(FAILURES), 5), FAILURES, strict=True)):
        chosen = scene(name)
        against = chosen.truth(folder, chosen.step)
        before, found = (derivative(chosen, chosen.layers[0], 1, on) for on in (False, True))
        difference = signed(low_pass(found - against.derivative), CONTRAST_LOW)
        seen = chosen.image().clip(0, 1), *(signed(x) for x in (against.derivative, before, found)), difference
        for axes, picture, title in zip(line, seen, titles, strict=True):
            show(axes, picture[SHOWN, SHOWN], "" if n else title)
        line[0].set_ylabel(name, fontsize=13)
    figure.savefig(path, dpi=100)


def unchanged(name: str) -> list[str]:
    """By how much derivatives differ, in terms of the largest."""
    chosen, cells = scene(name), []
    for layers, fine in SETTINGS:
        with_lines, without = (derivative(chosen, layers, fine, on) for on in (True, False))
        off = np.abs(with_lines - without)
        share = off.max() / np.abs(without).max()
        cells.append("identical" if not off.any() else f"{share:.0e}, {int((off.max(axis=-1) > 0).sum())} pixels")
    return [name, *cells]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--truth", type=Path, default=Path("out/truth"), help="where truths are kept")
    parser.add_argument("--scenes", nargs="+", default=["spheres", *CROSSING], choices=["spheres", *CROSSING])
    parser.add_argument("--spp", type=int, default=0, help="samples a pixel of Mitsuba, 0 for without other renderers")
    parser.add_argument("--pictures", type=Path, help="a PNG of failures, to be written")
    parser.add_argument("--others", action="store_true", help="the scenes where no surfaces cross, too")
    args = parser.parse_args()
    lines = crossing_lines(args.scenes, args.truth, args.spp)
    print(table(["scene", "method", "as samples", "as depths", "noise"], lines))
    if args.pictures:
        pictures(args.truth, args.pictures)
    if args.others:
        print(table(["scene", *(methods.name_of("visible", *s) for s in SETTINGS)], map(unchanged, OTHERS)))


if __name__ == "__main__":
    main()
