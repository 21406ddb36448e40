"""The figures of docs/how-it-works.md, as SVG. Derivatives in them are the library's own.

Run `PYTHONPATH=. python docs/figures/how_it_works.py` for all, or with names of figures for some.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest import mock

import matplotlib
import numpy as np
import rts
import torch
from benchmarks.accuracy import area_rule
from matplotlib.figure import Figure
from matplotlib.patches import Circle, FancyArrowPatch, FancyBboxPatch, Rectangle
from matplotlib.path import Path as Outline
from rts.outlines.found import Outlines

IMAGES = Path(__file__).parents[1] / "images/how-it-works"
INK, PALE, GRID = "#1f2937", "#6b7280", "#d1d5db"
ORANGE, BLUE, GREEN, PINK, YELLOW = "#D55E00", "#0072B2", "#009E73", "#CC79A7", "#E69F00"


def figure(width: float, height: float, columns: int = 1, **options: Any) -> tuple[Figure, Any]:
    """A figure of `width` × `height` inches and its axes in one row."""
    matplotlib.rcParams.update({"svg.hashsalt": "rts", "font.family": "DejaVu Sans", "font.size": 9})
    made = Figure(figsize=(width, height), layout="constrained")
    axes = made.subplots(1, columns, squeeze=False, **options)[0]
    for one in axes:
        one.spines[["top", "right"]].set_visible(False)
    return made, axes


def bare(axes: Any, title: str = "") -> None:
    """Axes without frame and ticks."""
    axes.set(xticks=[], yticks=[])
    axes.spines[:].set_visible(False)
    axes.set_title(title, fontsize=9, color=INK)


def derivative(scene: Callable[[Any], Any], camera: Any, side: int, **options: Any) -> np.ndarray:
    """The image's derivative (side, side, 4) in a number at 0, of which `scene` makes the parts."""

    def image(x: Any) -> Any:
        return rts.render(scene(x), camera, (side, side), **options)

    return torch.func.jvp(image, (torch.zeros(()),), (torch.ones(()),))[1].numpy()


# ----------------------------------------------------------------------------------------------------- the pipeline


def pipeline() -> Figure:
    """The four steps, and which of them has derivatives."""
    made, (axes,) = figure(10, 2.7)
    bare(axes)
    axes.set(xlim=(0, 10), ylim=(0, 2.7))
    steps = (
        ("sample", "by a rasterizer or rays:\npoints that pixels see,\nand where outlines run", "#e5e7eb"),
        ("evaluate", "θ and U give positions,\nnormals, uv, colours", "#FBE3D0"),
        ("shade, project", "a colour for each sample,\na place in the image", "#FBE3D0"),
        ("splat", "each colour counts by\nits share of the pixel", "#FBE3D0"),
    )
    for n, (name, text, color) in enumerate(steps):
        x = 0.9 + 2.15 * n
        axes.add_patch(FancyBboxPatch((x, 0.95), 1.6, 1.25, boxstyle="round,pad=0.05", fc=color, ec=INK, lw=0.8))
        axes.text(x + 0.8, 1.98, name, ha="center", va="center", weight="bold", color=INK)
        axes.text(x + 0.8, 1.42, text, ha="center", va="center", fontsize=8, color=INK)
    arrow = {"arrowstyle": "-|>", "mutation_scale": 10, "color": INK}
    for x, text in ((0.3, "θ"), (2.55, "U"), (4.7, ""), (6.85, ""), (9.0, "image")):
        axes.add_patch(FancyArrowPatch((x, 1.57), (x + 0.42, 1.57), **arrow))
        axes.text(x + 0.22, 1.72, text, ha="center", color=INK)
    axes.plot((0.45, 0.45, 6.0), (1.95, 2.5, 2.5), color=INK, lw=0.8)
    for x in (3.85, 6.0):  # The numbers themselves go to these steps, too.
        axes.add_patch(FancyArrowPatch((x, 2.5), (x, 2.24), **arrow))
    back = {"arrowstyle": "-|>", "mutation_scale": 12, "color": ORANGE, "lw": 1.5}
    axes.add_patch(FancyArrowPatch((9.4, 0.7), (2.9, 0.7), **back))
    axes.text(6.2, 0.4, "derivatives, by the framework that owns θ", ha="center", color=ORANGE)
    axes.text(1.7, 0.55, "no derivative", ha="center", color=PALE)
    return made


# -------------------------------------------------------------------------------------------------------------- gaps

SIDE, EYE = 6, 8.0
"""Pixels along each side of the scene of `gap`, and the camera's distance."""
VIEW = np.degrees(2 * np.arctan(SIDE / 2 / EYE))
"""Degrees of view with which a unit at the origin is a pixel."""
CARD = np.float32([(-4, -4, 0), (0.15, -4, 0), (1.35, 0.9, 0), (-4, 1.9, 0)])
BEHIND = np.float32([(-9, -9, -1.5), (9, -9, -1.5), (9, 9, -1.5), (-9, 9, -1.5)])


def cards() -> tuple[list[Any], Any]:
    """A card before another one, and a camera that sees a corner of it in 6 × 6 pixels."""
    faces = np.int32([(0, 1, 2), (0, 2, 3)])
    near, far = (
        rts.Part(rts.Mesh(faces), {"vertices": v, "color": np.float32(c)}, "unlit")
        for v, c in ((CARD, (1, 1, 1)), (BEHIND, (0, 0, 0)))
    )
    return [near, far], rts.Camera.look_at((0, 0, EYE), (0, 0, 0), fov_y=float(VIEW))


def sampled_cards() -> tuple[Any, Any, np.ndarray]:
    """Samples of the cards; the outlines that their stencil is made of, which nothing hands on; and cells."""
    found, whole = [], Outlines.stencil

    def stencil(self: Any, row: np.ndarray, *required: Any) -> Any:
        found.append((self, row))
        return whole(self, row, *required)

    parts, camera = cards()
    with mock.patch.object(Outlines, "stencil", stencil):
        sampled = rts.sample(parts, camera, (SIDE, SIDE), splatter="edges")
    return sampled, *found[0]


def chosen_crossing(found: Any, border: int, y: int, x: int) -> int:
    """The index of the crossing in the gap along the row from pixel (y, x)."""
    [(index,)] = np.argwhere((found.gap == (y + border, x + border, 1)).all(axis=1))
    return int(index)


def seen_from_the_eye(axes: Any, found: Any, border: int) -> None:
    """Centres, gaps, crossings and segments, as the library finds them."""
    bare(axes, "centres see the near card or the far one;\nbetween unlike neighbours lies a gap")
    corner = np.array([(x + SIDE / 2, SIDE / 2 - y) for x, y, _ in CARD])
    axes.fill(*corner.T, fc="#D55E0022", ec="none")
    for line in range(SIDE + 1):
        axes.plot((0, SIDE), (line, line), color=GRID, lw=0.6, zorder=0)
        axes.plot((line, line), (0, SIDE), color=GRID, lw=0.6, zorder=0)
    first = found.gap[:, 1::-1] - border + 0.5
    way = np.stack([found.gap[:, 2], 1 - found.gap[:, 2]], axis=1)
    place = first + found.place[:, None] * way
    inside = ((first >= 0.5) & (first + way <= SIDE - 0.5)).all(axis=1)
    for start, step in zip(first[inside], way[inside], strict=True):
        axes.plot(*zip(start, start + step, strict=True), color=PALE, lw=1.2, zorder=2)
    near = Outline(corner)
    for y, x in np.ndindex(SIDE, SIDE):
        shown = ORANGE if near.contains_point((x + 0.5, y + 0.5)) else BLUE
        axes.plot(x + 0.5, y + 0.5, "o", ms=4.5, color=shown, zorder=4)
    for square, endpoints, turn in zip(*found.segments[:2], found.segments.corner, strict=True):
        bend = square[::-1] - border + 0.5 + turn
        path = np.stack([place[endpoints[0]], bend, place[endpoints[1]]])
        axes.plot(*path.T, color=INK, lw=1.6, zorder=3)
    axes.plot(*place[inside].T, "D", ms=5, mfc="white", mec=INK, zorder=5)
    axes.set(xlim=(0, SIDE), ylim=(SIDE, 0), aspect="equal")


def seen_from_above(axes: Any, place: float, inner: tuple[float, float]) -> None:
    """A section along a gap: the samples that it has."""
    bare(axes, "one gap from above, the eye on top:\nits crossing, and samples beside it")
    axes.plot((-0.45, place), (0.6, 0.6), color=ORANGE, lw=2)
    axes.plot((-0.45, 1.45), (1.5, 1.5), color=BLUE, lw=2)
    for x in (0, 1):
        axes.plot((x, x), (0.1, 0.6 if x < place else 1.5), color=GRID, lw=1, zorder=0)
    axes.plot((place, place), (0.1, 1.5), color=PALE, lw=1, ls=":", zorder=0)
    axes.plot((0, place), (0.6, 0.6), "o", ms=7, color=ORANGE, mec=INK)
    axes.plot((place, 1), (1.5, 1.5), "o", ms=7, color=BLUE, mec=INK)
    axes.plot(inner[0], 0.6, "o", ms=5, mfc="white", mec=ORANGE)
    axes.plot(inner[1], 1.5, "o", ms=5, mfc="white", mec=BLUE)
    axes.plot(place, 0.1, "D", ms=5, mfc="white", mec=INK)
    axes.text(0, 0.0, "centre", ha="center", va="bottom", fontsize=8, color=PALE)
    axes.text(1, 0.0, "centre", ha="center", va="bottom", fontsize=8, color=PALE)
    axes.text(place + 0.06, 0.1, "crossing", va="center", fontsize=8, color=INK)
    axes.annotate("", (place + 0.3, 0.6), (place + 0.05, 0.6), arrowprops={"arrowstyle": "-|>", "color": ORANGE})
    axes.text(
        place + 0.07, 0.72, "the last sample:\nthe crossing moves\nas it does", va="top", fontsize=8, color=ORANGE
    )
    axes.text(-0.4, 1.62, "hollow: samples a little farther in tell the colours", va="top", fontsize=8, color=PALE)
    axes.set(xlim=(-0.5, 1.5), ylim=(1.85, -0.2))


def share_of_a_pixel(axes: Any, y: int, x: int, image: float) -> None:
    """A pixel that an edge of the card cuts: both shares, and the strip that the segment sweeps."""
    (x0, y0), (x1, y1) = (CARD[i, :2] * (1, -1) + SIDE / 2 for i in (1, 2))
    top, bottom = (x0 + (x1 - x0) * (line - y0) / (y1 - y0) - x for line in (y, y + 1))
    share = (top + bottom) / 2
    axes.fill((0, top, bottom, 0), (0, 0, 1, 1), fc="#F2BE99", ec="none")
    axes.fill((top, 1, 1, bottom), (0, 0, 1, 1), fc="#99C7E0", ec="none")
    step = 0.1
    axes.fill((top, top + step, bottom + step, bottom), (0, 0, 1, 1), fc="#FBE3D0", ec=ORANGE, hatch="////", lw=0)
    axes.plot((top, bottom), (0, 1), color=INK, lw=1.8)
    axes.add_patch(Rectangle((0, 0), 1, 1, fc="none", ec=INK, lw=1))
    middle = np.array([(top + bottom) / 2, 0.5])
    axes.annotate("", middle + (0.3, 0), middle, arrowprops={"arrowstyle": "-|>", "color": ORANGE, "lw": 1.5})
    axes.text(0.05, 0.1, f"share {share:.3f}", va="top", fontsize=9, color=INK)
    axes.text(0.5, 1.04, "hatched: what the segment sweeps is the derivative", ha="center", va="top", fontsize=8)
    bare(axes, f"a pixel is the mean of its parts: near card 1,\nfar card 0; the library's pixel is {image:.3f}")
    axes.set(xlim=(-0.05, 1.05), ylim=(1.12, -0.05), aspect="equal")


def gap() -> Figure:
    """A gap, its samples, and the area: outlines between centres, as the library finds them."""
    made, (eye, above, area) = figure(10, 3.5, 3)
    parts, camera = cards()
    sampled, found, _ = sampled_cards()
    border, (y, x) = sampled.border, (4, 3)
    index = chosen_crossing(found, border, y, x)
    seen_from_the_eye(eye, found, border)
    eye.add_patch(Rectangle((x + 0.3, y + 0.3), 1.4, 0.4, fc="none", ec=PINK, lw=1.3))
    place = float(found.place[index])
    seen_from_above(above, place, (place - 0.1, place + 0.1))
    image = rts.render(parts, camera, (SIDE, SIDE), splatter="edges")
    eye.add_patch(Rectangle((x, y), 1, 1, fc="none", ec=GREEN, lw=1.3))
    share_of_a_pixel(area, y, x, float(image[y, x, 0]))
    return made


# --------------------------------------------------------------------------------------------------------- a matrix


def inside_cell(polygon: list, corner: int, right: int, down: int) -> np.ndarray:
    """A polygon of a square, cut off at the quarter at a corner, from the upper left of that cell."""
    low = area_rule.CORNERS[corner] / 2
    return np.clip(np.array(polygon), low, low + 0.5) + np.array([0.5 - right, 0.5 - down])


def matrix() -> Figure:
    """A pixel at the corner of the near card: its regions, and its row of the matrix."""
    made, (pixel, table) = figure(8.4, 3.4, 2)
    sampled, found, row = sampled_cards()
    stencil, owners = sampled.stencil, np.repeat((0, 1), [len(one.ids) for one in sampled.samples])
    corner = CARD[2, :2] * (1, -1) + SIDE / 2
    cell = tuple((np.floor(corner).astype(int) + sampled.border)[::-1])
    shades = ("#F2BE99", "#99C7E0")
    pixel.add_patch(Rectangle((0, 0), 1, 1, fc=shades[int(owners[row[0][cell]])], ec="none"))
    for quarter, (right, down) in enumerate(area_rule.CORNERS.astype(int)):
        rays = area_rule.rays_of(found, (cell[0] - down, cell[1] - right))
        for polygon, beside in area_rule.regions_of(rays):
            endpoint, side = rays[beside[0][0]].endpoint, beside[0][1]
            shown = owners[found.rows[endpoint, side]] if found.rows[endpoint, side] >= 0 else 1
            pixel.fill(*inside_cell(polygon, quarter, right, down).T, fc=shades[int(shown)], ec="none")
        for ray in rays:
            path = np.array(ray.path) + np.array([0.5 - right, 0.5 - down])
            pixel.plot(*path.T, color=INK, lw=1.8)
            pixel.plot(*path[0], "D", ms=5, mfc="white", mec=INK, zorder=5)
    pixel.add_patch(Rectangle((0, 0), 1, 1, fc="none", ec=GREEN, lw=1.3))
    pixel.plot(0.5, 0.5, "o", ms=6, color=(ORANGE, BLUE)[int(owners[row[0][cell]])], zorder=6)
    bare(pixel, "outlines cut the pixel into regions;\nits centre shows one of them")
    pixel.set(xlim=(-0.3, 1.3), ylim=(1.3, -0.3), aspect="equal")
    here = stencil.color_cell == cell[0] * row.shape[2] + cell[1]
    weights = {int(row[0][cell]): 1.0}
    for sample, weight in zip(stencil.color_sample[here], stencil.color_weight[here], strict=True):
        weights[int(sample)] = weights.get(int(sample), 0.0) + float(weight)
    order = sorted(weights, key=lambda sample: (owners[sample], -weights[sample]))
    for place, sample in enumerate(order):
        table.barh(place, weights[sample], color=(ORANGE, BLUE)[int(owners[sample])], height=0.7)
        name = (
            "centre" if sample == row[0][cell] else "centre nearby" if (row[0] == sample).any() else "beside a crossing"
        )
        table.text(weights[sample] + 0.02, place, f"{weights[sample]:.3f}   {name}", va="center", fontsize=8)
    table.set(xlim=(0, 1.15), ylim=(len(order) - 0.4, -0.6), yticks=range(len(order)))
    table.set_yticklabels([f"sample {sample}" for sample in order], fontsize=8)
    near = sum(w for sample, w in weights.items() if owners[sample] == 0)
    table.set_title(
        f"its row of A: weights of samples' colours, of the near\ncard (orange) {near:.3f} in all, of both"
        f" {sum(weights.values()):.3f}", fontsize=9, color=INK,
    )  # fmt: skip
    return made


# ---------------------------------------------------------------------------------------------------------- an edge

PLACE = 6.2
"""Pixels from the left to the upright edge of the card in `edge`."""


def edge_slope(chosen: Any) -> np.ndarray:
    """The derivative of alpha along a row of 12 pixels as an upright edge moves by a pixel, by a splatter."""
    right = PLACE - 6
    corners = np.float32([(-90, -90, 0), (right, -90, 0), (right, 90, 0), (-90, 90, 0)])
    part = rts.Part(rts.Mesh(np.int32([(0, 1, 2), (0, 2, 3)])), {"vertices": corners}, "silhouette")
    camera = rts.Camera.look_at((0, 0, 100), (0, 0, 0), fov_y=float(np.degrees(2 * np.arctan(6 / 100))))

    def scene(shift: Any) -> Any:
        zero = torch.zeros(())
        return part.replace(transform=rts.rigid(torch.stack([zero, zero, zero, shift, zero, zero])))

    return derivative(scene, camera, 12, splatter=chosen)[6, :, 3]


def edge() -> Figure:
    """The derivative at a straight edge: the truth, and by three splatters."""
    made, axes = figure(9, 2.7, 4, sharey=True)
    truth = np.zeros(12)
    truth[6] = 1
    found = {
        "truth:\npixels are means of areas": (truth, INK),
        "no derivative at edges:\n`none`": (edge_slope("none"), PALE),
        "the paper's:\n`multi`": (edge_slope("multi"), BLUE),
        "found:\n`edges`": (edge_slope("edges"), ORANGE),
    }
    for one, (name, (slope, color)) in zip(axes, found.items(), strict=True):
        one.bar(np.arange(12) + 0.5, slope, color=color, width=0.8)
        one.axvline(PLACE, color=PALE, ls=":", lw=1)
        one.set(xlim=(3, 10), ylim=(0, 1.15), xticks=[], xlabel="pixels across the edge")
        one.set_title(f"{name}; sum {slope[3:].sum():.3f}", fontsize=8)
    axes[0].set_ylabel("change of coverage\nper pixel of motion")
    return made


# -------------------------------------------------------------------------------------------------------- the layers


def pairing(source: tuple[float, ...], target: tuple[float, ...]) -> int:
    """The number s of `Multi` for the depths of a source's and a target's layers."""
    ahead = [abs(z - target[0]) for z in source]
    below = [abs(z - source[0]) for z in target]
    a, b = int(np.argmin(ahead)), int(np.argmin(below))
    return -b if min(below) < min(ahead) else a


def layers() -> Figure:
    """A cross-section: which buffer each sample of a neighbour goes to."""
    made, two = figure(10, 3.3, 2)
    colors = {"front": PINK, "surface": GREEN, "behind": BLUE}
    for axes, q, title in ((two[0], 5, "target on the card behind"), (two[1], 3, "target on the card in front")):
        bare(axes, title)
        axes.set(xlim=(-0.3, 9.2), ylim=(4.3, -0.7))
        depth = {i: ((1.0,) if i < 5 else ()) + (3.0 - 0.05 * i,) for i in range(9)}
        for i, stack in depth.items():
            axes.axvline(i + 0.5, color=GRID, lw=0.7, zorder=0)
            for k, z in enumerate(stack):
                kind = None
                if abs(i - q) <= 1:
                    s = pairing(stack, depth[q])
                    kind = "front" if k < s else "surface" if k == s else "behind"
                color = colors[kind] if kind else "white"
                axes.plot(i + 0.5, z, "o", ms=9, mfc=color, mec=INK, zorder=3)
        axes.plot([0, 5], [1, 1], color=INK, lw=1)
        axes.plot([0, 9], [3.0, 2.55], color=INK, lw=1)
        axes.add_patch(Rectangle((q - 1, -0.1), 3, 3.7, fc="none", ec=ORANGE, lw=1.2, ls="--"))
        axes.annotate("q", (q + 0.5, -0.1), (q + 0.5, -0.45), ha="center", color=ORANGE, weight="bold")
        axes.text(0, 4.05, "rays run downwards; the eye is above", color=PALE, fontsize=8)
    handles = [two[0].plot([], [], "o", ms=9, mfc=c, mec=INK)[0] for c in colors.values()]
    names = ["in front of q's surface", "at q's surface", "behind it"]
    made.legend(handles, names, loc="outside lower center", ncols=3, frameon=False)
    return made


# ------------------------------------------------------------------------------------------------------------ fields


def fields() -> Figure:
    """A ray beside a field's outline: the normal at the sample, and the deepest point of the ray."""
    made, (plan, along) = figure(10, 3.4, 2, width_ratios=(1.25, 1))
    radius, offset = 1.0, 0.86
    x, y = np.meshgrid(np.linspace(-1.5, 1.5, 200), np.linspace(-1.25, 1.6, 200))
    levels = plan.contour(
        x, y, np.hypot(x, y) - radius, levels=[-0.6, -0.4, -0.2, 0.2, 0.4], colors=GRID, linewidths=0.8
    )
    plan.clabel(levels, fontsize=6)
    plan.add_patch(Circle((0, 0), radius, fc="#0072B214", ec=BLUE, lw=1.5))
    front = np.sqrt(radius**2 - offset**2)
    plan.annotate("", (offset, -1.2), (offset, 1.5), arrowprops={"arrowstyle": "-|>", "color": INK})
    plan.text(offset + 0.04, 1.4, "ray", color=INK)
    normal = np.array([offset, front]) / radius
    plan.annotate("", (offset + 0.45 * normal[0], front + 0.45 * normal[1]), (offset, front),
                  arrowprops={"arrowstyle": "-|>", "color": PINK})  # fmt: skip
    plan.text(offset + 0.3, front + 0.38, "normal at the sample:\nleans to the viewer", color=PINK, fontsize=8)
    plan.annotate("", (offset + 0.45, 0), (offset, 0), arrowprops={"arrowstyle": "-|>", "color": GREEN})
    plan.text(offset + 0.22, -0.55, "gradient at the\ndeepest point:\nacross the ray", color=GREEN, fontsize=8)
    plan.plot([offset, offset], [front, 0], "o", color=INK, ms=5)
    plan.set(aspect="equal", xlim=(-1.2, 2.1), ylim=(-1.25, 1.6))
    bare(plan, "a ball's field and a ray just inside of its outline; the eye is on top")
    t = np.linspace(-1.2, 1.2, 200)
    for grown, style in ((0.0, "-"), (0.06, "--")):
        along.plot(t, np.hypot(offset, t) - radius - grown, style, color=BLUE, label=f"radius {radius + grown:.2f}")
        along.plot(0, offset - radius - grown, "o", color=GREEN)
    along.axhline(0, color=INK, lw=0.8)
    along.plot([-front], [0], "o", color=PINK)
    along.set(xlabel="place along the ray", ylabel="field", title="g, the least value, tells how far the outline is")
    along.title.set_fontsize(9)
    along.legend(frameon=False)
    return made


FIGURES = {f.__name__: f for f in (pipeline, gap, matrix, edge, fields, layers)}


def main() -> None:
    """Write the figures that the command line names, or all."""
    IMAGES.mkdir(parents=True, exist_ok=True)
    for name in sys.argv[1:] or FIGURES:
        FIGURES[name]().savefig(IMAGES / f"{name}.svg", metadata={"Date": None}, facecolor="white")
        print(IMAGES / f"{name}.svg", flush=True)


if __name__ == "__main__":
    main()
