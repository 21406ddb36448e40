"""The figures of docs/how-it-works.md, as SVG. Derivatives in them are the library's own.

Run `python docs/figures/how_it_works.py` for all, or with names of figures for some.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import torch
from matplotlib.figure import Figure
from matplotlib.patches import Circle, FancyArrowPatch, FancyBboxPatch, Rectangle

import rts

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


def splatter(name: str, **options: Any) -> Any:
    """A splatter with options."""
    return rts.plugin("splatters", name)(**options)


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
        ("sample", "a rasterizer or rays:\nwhich triangle, which\nbarycentrics, which depth", "#e5e7eb"),
        ("evaluate", "θ and U give positions,\nnormals, uv, colours", "#FBE3D0"),
        ("shade, project", "a colour for each sample,\na place in the image", "#FBE3D0"),
        ("splat", "a Gaussian over 3 × 3\ncells, sorted by depth", "#FBE3D0"),
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


# ---------------------------------------------------------------------------------------------------------- an edge


def edge_slope(chosen: Any) -> np.ndarray:
    """The derivative of alpha along a row of pixels as a half-plane's edge moves by a pixel, by a splatter."""
    height, width, edge = 7, 12, 6
    y, x = np.indices((height, edge))
    places = torch.tensor(np.stack([x + 0.5, y + 0.5, np.ones_like(x)], -1).reshape(-1, 3), dtype=torch.float64)
    row = torch.full((1, height, width), -1, dtype=torch.int32)
    row[0, :, :edge] = torch.arange(height * edge, dtype=torch.int32).reshape(height, edge)
    colors = torch.ones((height * edge, 4), dtype=torch.float64)
    along = torch.zeros_like(places)
    along[:, 0] = 1
    slope = torch.func.jvp(lambda p: chosen.splat(p, colors, row), (places,), (along,))[1]
    return slope[height // 2, :, 3].numpy()


def edge() -> Figure:
    """The derivative at a straight edge: the truth, no splat, the paper's constants, calibrated."""
    made, axes = figure(10, 2.9, 4, sharey=True)
    truth = np.zeros(12)
    truth[6] = 1
    found = {
        "truth: pixels average over their area": truth,
        "no splatting (`none`)": edge_slope(splatter("none")),
        "`multi`, the paper's constants": edge_slope(splatter("multi")),
        "`visible`, calibrated": edge_slope(splatter("visible")),
    }
    for one, (name, slope), color in zip(axes, found.items(), (INK, PALE, BLUE, ORANGE), strict=True):
        one.bar(np.arange(12), slope, color=color, width=0.8)
        one.axvline(5.7, color=PALE, ls=":", lw=1)
        one.set(xlim=(2.5, 9.5), ylim=(0, 1.15), xticks=[], xlabel="pixels across the edge")
        one.set_title(f"{name}\nsum {slope[3:].sum():.3f}", fontsize=9)
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


# ---------------------------------------------------------------------------------------------------------- outlines


def ball(camera_size: int = 64) -> tuple[Callable[[Any], Any], Any]:
    """A ball of one colour that turns about its upright axis, and its camera."""
    import trimesh

    mesh = trimesh.creation.icosphere(subdivisions=5)
    vertices = torch.tensor(mesh.vertices, dtype=torch.float32)
    part = rts.Part(rts.Mesh(mesh.faces), {"vertices": vertices}, "silhouette", cull="back")

    def scene(angle: Any) -> Any:
        zero = torch.zeros(())
        return part.replace(transform=rts.rigid(torch.stack([zero, angle, zero, zero, zero, zero])))

    return scene, rts.Camera.look_at((0, 0, 8), (0, 0, 0), fov_y=18)


def outlines() -> Figure:
    """A ball that turns: how fast samples move beside its rim, and the derivative with and without their own motion."""
    made, (chart, before, after) = figure(10, 3.2, 3, width_ratios=(1.5, 1, 1))
    radius = 24.0
    inside = np.linspace(0, 6, 200)
    chart.plot(inside, np.sqrt(np.maximum(0, 2 * radius * inside - inside**2)) / radius, color=BLUE)
    chart.axhline(0, color=INK, lw=1)
    chart.axvspan(0, 1, color="#FBE3D0", zorder=0)
    chart.text(1.1, 0.05, "first sample inside\nthe rim: anywhere here", fontsize=8, color=ORANGE)
    chart.set(
        xlabel="distance δ inside the rim, pixels", ylabel="speed of a sample across\nthe image, share of the largest"
    )
    chart.set(ylim=(-0.05, 0.8))
    chart.set_title("a ball of radius 24 pixels turns; its rim stands still", fontsize=9)
    scene, camera = ball()
    largest = 0.0
    pictures = []
    for rims in (False, True):
        slope = derivative(scene, camera, 64, splatter=splatter("visible", rims=rims), layers=1)[..., 3]
        pictures.append(slope)
        largest = max(largest, float(np.abs(slope).max()))
    for axes, slope, name in zip((before, after), pictures, ("as samples", "as outlines"), strict=True):
        bare(axes, f"coverage moves {name}:\nnorm {np.linalg.norm(slope):.1f} (truth: 0)")
        axes.imshow(slope, cmap="RdBu", vmin=-largest, vmax=largest, interpolation="nearest")
    return made


# --------------------------------------------------------------------------------------------------------- crossings


def planes() -> tuple[Callable[[Any], Any], Any]:
    """Two planes that cross in an upright line; one of them comes nearer."""
    corners = np.array([[-2, -2, 0], [2, -2, 0], [2, 2, 0], [-2, 2, 0]], np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    first, second = corners.copy(), corners.copy()
    first[:, 2] = 0.5 * corners[:, 0] + 0.13 * corners[:, 1]
    second[:, 2] = -0.4 * corners[:, 0]
    colors = ((0.85, 0.35, 0.1), (0.1, 0.45, 0.7))
    parts = [
        rts.Part(rts.Mesh(faces), {"vertices": torch.tensor(v), "color": torch.tensor(c)}, "unlit")
        for v, c in zip((first, second), colors, strict=True)
    ]

    def scene(nearer: Any) -> Any:
        zero = torch.zeros(())
        return [parts[0].replace(transform=rts.rigid(torch.stack([zero] * 5 + [nearer]))), parts[1]]

    return scene, rts.Camera.look_at((0, 0, 8), (0, 0, 0), fov_y=14)


def crossings() -> Figure:
    """Two planes that cross, as one of them comes nearer: a section, the picture, and both derivatives."""
    made, (section, picture, before, after) = figure(10, 2.9, 4, width_ratios=(1.5, 1, 1, 1))
    x = np.linspace(-1, 1, 50)
    section.plot(x, 0.5 * x, color=ORANGE)
    section.plot(x, 0.5 * x + 0.3, color=ORANGE, ls="--")
    section.plot(x, -0.4 * x, color=BLUE)
    section.plot([0, -1 / 3], [0, 0.4 / 3], "o", color=INK)
    section.annotate("", (-1 / 3, -0.5), (0, -0.5), arrowprops={"arrowstyle": "-|>", "color": INK})
    section.text(-0.17, -0.62, "the line moves sideways", ha="center", va="top", fontsize=8)
    section.annotate("", (0.75, 0.675), (0.75, 0.375), arrowprops={"arrowstyle": "-|>", "color": ORANGE})
    section.text(0.75, 0.02, "the plane\ncomes nearer", ha="center", va="center", fontsize=8, color=ORANGE)
    bare(section, "seen from above; the eye is on top")
    section.set_ylim(-0.85, 0.95)
    scene, camera = planes()
    image = rts.render(scene(torch.zeros(())), camera, (48, 48), layers=2).numpy()
    bare(picture, "picture")
    picture.imshow(image[..., :3].clip(0, 1), interpolation="nearest")
    shown = ((before, False, "as samples\n(`crossings=False`)"), (after, True, "as depths say"))
    for axes, moves, name in shown:
        chosen = splatter("visible", crossings=moves)
        slope = derivative(scene, camera, 48, splatter=chosen, layers=2)
        bare(axes, f"the line moves {name}")
        axes.imshow((0.5 + 0.04 * slope[..., :3]).clip(0, 1), interpolation="nearest")
    return made


# ---------------------------------------------------------------------------------------------------------- adaptive


def adaptive() -> Figure:
    """Where `Adaptive` takes more samples: the grid of pixels of a turned triangle."""
    made, (grid, coarse, fine) = figure(10, 3.5, 3)
    corners = np.array([[-0.9, -0.75, 0], [0.95, -0.35, 0], [-0.15, 0.9, 0]], np.float32)
    part = rts.Part(rts.Mesh(np.array([[0, 1, 2]])), {"vertices": corners}, "silhouette")
    camera = rts.Camera.look_at((0, 0, 8), (0, 0, 0), fov_y=17)
    side, s = 14, 4
    hard = rts.render(part, camera, (side, side), splatter="none")[..., 3] > 0.5
    fronts = np.pad(hard, 1)
    beside = [fronts[1 + v : side + 1 + v, 1 + u : side + 1 + u] for u in (-1, 0, 1) for v in (-1, 0, 1)]
    active = np.logical_or.reduce([x != hard for x in beside])
    bare(grid, f"{side} × {side} pixels: one sample each, and {s}² where\na front ends beside the pixel")
    for y, x in np.ndindex(side, side):
        grid.add_patch(Rectangle((x, y), 1, 1, fc="#FBE3D0" if active[y, x] else "white", ec=GRID, lw=0.6))
        for v, u in np.ndindex(*((s, s) if active[y, x] else (1, 1))):
            count = s if active[y, x] else 1
            place = x + (u + 0.5) / count, y + (v + 0.5) / count
            grid.plot(*place, ".", ms=1.5 if active[y, x] else 3, color=ORANGE if active[y, x] else PALE)
    clip = np.asarray(camera.project(corners, (side, side)))[:, :2]
    grid.fill(*clip.T, fc="#0072B233", ec=BLUE, lw=1)
    grid.set(xlim=(0, side), ylim=(side, 0), aspect="equal")
    for axes, value, name in ((coarse, 1, "1 sample a pixel"), (fine, rts.Adaptive(s), "`rts.Adaptive(4)`")):
        image = rts.render(part, camera, (side, side), supersample=value)[..., 3]
        bare(axes, f"image, {name}")
        axes.imshow(1 - image, cmap="gray", vmin=0, vmax=1, interpolation="nearest")
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


# ------------------------------------------------------------------------------------------------------------ hidden


def hidden() -> Figure:
    """A ball before a card: the second layer, and what of it reaches the image."""
    made, axes = figure(10, 3.2, 3)
    scene, camera = ball()
    card = np.array([[-3, -3, -2], [3, -3, -2], [3, 3, -2], [-3, 3, -2]], np.float32)
    keeps = rts.plugin("shaders", "unlit")(opaque=False)  # Behind samples that may be translucent none is left out.
    parts = [
        rts.Part(scene(torch.zeros(())).surface, {"vertices": scene(torch.zeros(())).theta["vertices"].numpy()},
                 keeps, cull="back"),
        rts.Part(rts.Mesh(np.array([[0, 1, 2], [0, 2, 3]])), {"vertices": card}, keeps),
    ]  # fmt: skip
    size = (32, 32)
    chosen = splatter("visible")
    cells = rts.sample(parts, camera, size, splatter=None, layers=2).cells
    row, depth = np.asarray(cells.row), np.asarray(cells.depth)
    covered = row >= 0
    kept = chosen.needed(covered, np.where(covered, depth, 0))
    apron = (covered.shape[1] - size[0]) // 2
    covered, kept = (x[:, apron:-apron, apron:-apron] for x in (covered, kept))
    for one, mask, name in zip(
        axes,
        (covered[0], covered[1], kept[1]),
        ("first layer", "second layer: all", "second layer: what the splatter needs"),
        strict=True,
    ):
        bare(one, f"{name}\n{int(mask.sum())} samples")
        one.imshow(np.where(mask, 0.35, 1.0), cmap="gray", vmin=0, vmax=1, interpolation="nearest")
        one.add_patch(Rectangle((-0.5, -0.5), mask.shape[1], mask.shape[0], fc="none", ec=GRID))
    return made


FIGURES = {f.__name__: f for f in (pipeline, edge, layers, outlines, crossings, adaptive, fields, hidden)}


def main() -> None:
    """Write the figures that the command line names, or all."""
    IMAGES.mkdir(parents=True, exist_ok=True)
    for name in sys.argv[1:] or FIGURES:
        FIGURES[name]().savefig(IMAGES / f"{name}.svg", metadata={"Date": None}, facecolor="white")
        print(IMAGES / f"{name}.svg", flush=True)


if __name__ == "__main__":
    main()
