"""Charts of tables that stand on the pages of results without JSON: what is drawn is what the table says."""

from __future__ import annotations

from typing import Any

from benchmarks.pages.drawing import logarithmic, panels
from benchmarks.pages.kept import number, written

SAMPLER_LOOKS = {"raster": ("#D55E00", "o"), "embree": ("#0072B2", "D"), "opengl": ("#009E73", "^")}
KINDS = {"refined": ("#D55E00", "o"), "as found": ("#9467BD", "D"), "mesh": ("#0072B2", "s"),
         "mesh, a facet a pixel": ("#009E73", "^")}  # fmt: skip


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
    """Milliseconds of an iteration and the gradient's error, at 256², of the page of smooth surfaces."""
    found: dict[str, Any] = {}
    columns, lines = written("smooth-surfaces", "teapot, 256²", keys=2)
    for shader in ("silhouette", "lambert"):
        ms, off = columns.index(f"{shader}, ms"), columns.index(f"{shader}, gradient")
        for line, cells in lines.items():
            kind = line.split(" | ")[0]
            point = [number(cells[ms]), number(cells[off])]
            found.setdefault(f"teapot, {shader}", {}).setdefault(kind, []).append(point)
    return found


def draw_smooth(found: dict[str, Any]) -> Any:
    """Error of the gradient in control points against time, a panel a surface."""
    names = {"refined": "smooth surface", "as found": "the same, samples left on its triangles",
             "mesh": "mesh of the same control points", "mesh, a facet a pixel": "mesh, a facet a pixel"}  # fmt: skip
    figure, two = panels(2, 11, 4.3)
    for axes, (title, kinds) in zip(two, found.items(), strict=True):
        axes.set(xscale="log", yscale="log", title=title, xlabel="an iteration at 256², ms of the processor")
        axes.grid(color="#e5e7eb")
        for kind, points in kinds.items():
            color, marker = KINDS[kind]
            axes.plot(*zip(*points, strict=True), marker=marker, color=color, label=names[kind])
        logarithmic(axes.xaxis, lambda value: f"{value:g}")
        logarithmic(axes.yaxis, lambda value: f"{100 * value:g} %")
    two[0].set_ylabel("error of the gradient in control points")
    figure.legend(*two[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False)
    return figure
