"""Charts of tables that stand on the pages of results without JSON: what is drawn is what the table says."""

from __future__ import annotations

from typing import Any

from benchmarks.pages.drawing import OURS, PALE, logarithmic, panels
from benchmarks.pages.kept import number, written
from rts_compare.chart_style import PEER_COLORS

CASES = {"A": "bunny moves over black", "B": "square moves behind the bunny", "C": "bunny moves before the square"}
"""A scene's letter on the page → its name."""
EVERYWHERE = {"`visible`, K = 2": "1 × 1", "the same, `supersample=2`": "2 × 2", "the same, `supersample=4`": "4 × 4"}
ADAPTIVE = {"4 × 4 at outlines": "D", "4 × 4 around outlines": "P", "8 × 8 at outlines": "*"}
SAMPLER_LOOKS = {"raster": ("#D55E00", "o"), "embree": ("#0072B2", "D"), "opengl": ("#009E73", "^")}
KINDS = {"refined": ("#D55E00", "o"), "as found": ("#9467BD", "D"), "mesh": ("#0072B2", "s"),
         "mesh, a facet a pixel": ("#009E73", "^")}  # fmt: skip


def times() -> dict[str, Any]:
    """Seconds and errors of each method, by scene, of the page of accuracy."""
    columns, lines = written("accuracy", "method", "A s")
    found = {}
    for letter, name in CASES.items():
        s, e = columns.index(f"{letter} s"), columns.index(f"{letter} exact")
        found[name] = {line: [number(cells[s]), number(cells[e])] for line, cells in lines.items()}
    return found


def draw_times(found: dict[str, Any]) -> Any:
    """Error of the derivative image against time, a panel a scene."""
    figure, three = panels(3, 12, 4.6)
    for axes, (name, points) in zip(three, found.items(), strict=True):
        axes.set(xscale="log", yscale="log", title=name, xlabel="render and gradient, s", ylim=(0.006, 0.4))
        axes.set_xlim(0.004, 9)
        axes.grid(color="#e5e7eb")
        ours = [points[line] for line in EVERYWHERE]
        axes.plot(*zip(*ours, strict=True), "o-", color=OURS, label="rts, s × s samples a pixel")
        for text, point in zip(EVERYWHERE.values(), ours, strict=True):
            place = {"xytext": (7, -4)} if text == "4 × 4" else {"xytext": (-7, -10), "ha": "right"}
            axes.annotate(text, point, textcoords="offset points", color=OURS, fontsize=8, **place)
        for line, marker in ADAPTIVE.items():
            axes.plot(*points[line], marker, color="#7A3FF2", ms=8, label=f"rts, {line}", ls="none")
        mitsuba = {line.removeprefix("Mitsuba, "): p for line, p in points.items() if line.startswith("Mitsuba")}
        axes.plot(*zip(*mitsuba.values(), strict=True), "s-", color=PEER_COLORS["Mitsuba"], label="Mitsuba")
        for text, point in mitsuba.items():
            axes.annotate(text, point, (5, 5), textcoords="offset points", color=PALE, fontsize=8)
        axes.plot(*points["DEODR"], "X", color=PEER_COLORS["DEODR"], ms=9, label="DEODR", ls="none")
        logarithmic(axes.xaxis, lambda value: f"{value:g}", (1, 3))
        logarithmic(axes.yaxis, lambda value: f"{100 * value:g} %")
    three[0].set_ylabel("error of the derivative image")
    figure.legend(*three[0].get_legend_handles_labels(), loc="outside lower center", ncols=6, frameon=False)
    return figure


def samplers() -> dict[str, Any]:
    """Milliseconds of each sampler by faces, of both sizes and one to four layers, of the page of sampling."""
    columns, lines = written("samplers", "faces", "size", keys=3)
    found: dict[str, Any] = {}
    for name, cells in lines.items():
        faces, size, layers = name.split(" | ")
        for sampler in SAMPLER_LOOKS:
            place = found.setdefault(size, {}).setdefault(layers, {}).setdefault(sampler, [])
            place.append([number(faces), number(cells[columns.index(sampler)])])
    return found


def draw_samplers(found: dict[str, Any]) -> Any:
    """Time against faces: a row a size, a panel a number of layers."""
    figure, six = panels(3, 11, 6.2, rows=2)
    for line, (size, by_layers) in zip((six[:3], six[3:]), found.items(), strict=True):
        for axes, (layers, lines) in zip(line, by_layers.items(), strict=True):
            axes.set(xscale="log", yscale="log", ylim=(0.9, 1500), xlim=(1800, 6e6))
            axes.set_title(f"{size}, {layers} layer{'s' if layers != '1' else ''}", fontsize=9)
            axes.grid(color="#e5e7eb")
            for name, points in lines.items():
                color, marker = SAMPLER_LOOKS[name]
                axes.plot(*zip(*points, strict=True), marker=marker, color=color)
                higher = points[-1][1] > lines["raster" if name == "embree" else "embree"][-1][1]
                axes.annotate(name, points[-1], (6, 2 if higher else -8), textcoords="offset points", color=color)
            logarithmic(axes.xaxis, lambda value: f"{value / 1e3:g}K" if value < 1e6 else f"{value / 1e6:g}M", (1,))
            logarithmic(axes.yaxis, lambda value: f"{value:g}", (1,))
        line[0].set_ylabel("milliseconds to sample")
    for axes in six[3:]:
        axes.set_xlabel("triangles")
    return figure


def smooth() -> dict[str, Any]:
    """Milliseconds of a shaded iteration and the gradient's error, at 256², of the page of smooth surfaces."""
    found = {}
    for name, title in (("teapot", "teapot: Bézier patches"), ("rook", "rook: subdivision with creases")):
        columns, lines = written("smooth-surfaces", f"{name}, 256²", keys=2)
        ms, off = columns.index("lambert, ms"), columns.index("lambert, gradient")
        for line, cells in lines.items():
            kind = line.split(" | ")[0]
            point = [number(cells[ms]), number(cells[off])]
            found.setdefault(title, {}).setdefault(kind, []).append(point)
    return found


def draw_smooth(found: dict[str, Any]) -> Any:
    """Error of the gradient in control points against time, a panel a surface."""
    names = {"refined": "smooth surface", "as found": "the same, samples left on its triangles",
             "mesh": "mesh of the same control points", "mesh, a facet a pixel": "mesh, a facet a pixel"}  # fmt: skip
    figure, two = panels(2, 11, 4.3)
    for axes, (title, kinds) in zip(two, found.items(), strict=True):
        axes.set(xscale="log", yscale="log", title=title, xlabel="a shaded iteration at 256², ms")
        axes.grid(color="#e5e7eb")
        for kind, points in kinds.items():
            color, marker = KINDS[kind]
            axes.plot(*zip(*points, strict=True), marker=marker, color=color, label=names[kind])
        logarithmic(axes.xaxis, lambda value: f"{value:g}")
        logarithmic(axes.yaxis, lambda value: f"{100 * value:g} %")
    two[0].set_ylabel("error of the gradient in control points")
    figure.legend(*two[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False)
    return figure
