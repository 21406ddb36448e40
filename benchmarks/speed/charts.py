"""The charts of `run`."""

from __future__ import annotations

from pathlib import Path

from benchmarks.speed.stages import STAGES
from benchmarks.speed.tables import FULL, OURS, by_side

LINES = {
    OURS: {"color": "#c2410c", "marker": "o"},
    "RtS-pose, jax, auto": {"color": "#c2410c", "marker": "o", "linestyle": "--", "markerfacecolor": "white"},
    FULL: {"color": "#7c3aed", "marker": "D"},
    "full RtS, jax, auto": {"color": "#7c3aed", "marker": "D", "linestyle": "--", "markerfacecolor": "white"},
    "DEODR": {"color": "#15803d", "marker": "^"},
    "DEODR's functions, pose": {"color": "#15803d", "marker": "^", "linestyle": "--", "markerfacecolor": "white"},
    "Mitsuba, pose": {"color": "#1d4ed8", "marker": "s"},
}
"""What the chart shows, and how."""
STAGE_COLORS = (
    *("#111827", "#1d4ed8", "#3b82f6", "#c7d2fe"),
    *("#15803d", "#86efac", "#4ade80", "#eab308", "#c2410c", "#fb923c", "#9ca3af"),
)
"""What samples is blue, what goes forward green, what goes back orange."""


def pose_chart(rows: list[dict], path: Path) -> None:
    """Time of an iteration against faces, both axes logarithmic; one panel a size."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator, NullFormatter

    sides = by_side(rows)
    figure = Figure(figsize=(5.4 * len(sides), 5.6), layout="constrained")
    for axes, (side, found) in zip(figure.subplots(1, len(sides), sharey=True, squeeze=False)[0], sides, strict=True):
        for name, style in LINES.items():
            points = [(row["faces"], row["times"][name]["ms"]) for row in found if name in row["times"]]
            if points:
                axes.loglog(*zip(*points, strict=True), label=name, markersize=5, linewidth=1.5, **style)
        axes.set(title=f"{side}²", xlabel="faces")
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_locator(LogLocator(subs=(1, 2, 5) if axis is axes.yaxis else (1,)))
            axis.set_major_formatter("{x:,g}" if axis is axes.yaxis else "{x:,.0f}")
            axis.set_minor_formatter(NullFormatter())
        axes.grid(alpha=0.3, which="both")
    figure.axes[0].set_ylabel("milliseconds an iteration")
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, fontsize=9)
    figure.suptitle("Pose from a silhouette: render, loss, gradient and step", fontsize=11)
    figure.savefig(path, dpi=120)


def stages_chart(rows: list[dict], path: Path) -> None:
    """Stacked bars; one panel a size."""
    from matplotlib.figure import Figure

    sides = by_side(rows)
    count = max(len(found) for _, found in sides)
    figure = Figure(figsize=(6 * len(sides) + 1, 1.6 + 0.34 * count), layout="constrained")
    for axes, (side, found) in zip(figure.subplots(1, len(sides), sharey=True, squeeze=False)[0], sides, strict=True):
        labels = [f"{row['faces']:,} faces, {row['mode']}, {row['sampler']}" for row in found]
        left = [0.0] * len(found)
        for name, color in zip(STAGES, STAGE_COLORS, strict=True):
            values = [row["ms"][name] for row in found]
            axes.barh(labels, values, left=left, label=name, color=color, edgecolor="white", linewidth=0.3)
            left = [a + b for a, b in zip(left, values, strict=True)]
        axes.set(title=f"{side}²", xlabel="milliseconds")
        axes.grid(alpha=0.3, axis="x")
        axes.set_axisbelow(True)
    figure.axes[0].invert_yaxis()
    figure.legend(
        *figure.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3 * len(sides), fontsize=8
    )
    figure.suptitle("Stages of a pose iteration with torch", fontsize=11)
    figure.savefig(path, dpi=120)


CHARTS = {"pose": pose_chart, "stages": stages_chart}
