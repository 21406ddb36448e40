"""The tables of `run`, as Markdown."""

from __future__ import annotations

from itertools import groupby

from benchmarks.report import table
from benchmarks.speed.stages import STAGES
from benchmarks.timing import CONSECUTIVE

OURS = "RtS-pose, torch, auto"
PREPARED = "RtS-pose, torch, prepared"
FULL = "full RtS, torch, auto"
RATIOS = (
    (OURS, "DEODR"),
    (PREPARED, "DEODR"),
    ("RtS-pose, jax, auto", "DEODR"),
    (FULL, "DEODR"),
    ("full RtS, jax, auto", "DEODR"),
    (OURS, "DEODR's functions, pose"),
    (FULL, "DEODR's functions, full"),
    (OURS, "Mitsuba, pose"),
    (FULL, "Mitsuba, full"),
)
"""Ours, and the peer that is divided by it."""


def number(ms: float) -> str:
    return f"{ms:.2f}" if ms < 10 else f"{ms:.1f}" if ms < 100 else f"{ms:,.0f}"


def faces_of(rows: list[dict]) -> dict[str, int]:
    """The number of faces of each mesh, in the order of the rows."""
    return {row["mesh"]: row["faces"] for row in rows}


def by_side(rows: list[dict]) -> list[tuple[int, list[dict]]]:
    return [(side, list(group)) for side, group in groupby(sorted(rows, key=lambda r: r["side"]), lambda r: r["side"])]


def pose(rows: list[dict]) -> str:
    """Methods down, meshes across; then peers over ours."""
    text = []
    for side, found in by_side(rows):
        methods = list(dict.fromkeys(name for row in found for name in row["times"]))
        header = [f"{side}², ms", *(f"{row['faces']:,}" for row in found)]
        text.append(table(header, ([m, *(cell(row, m) for row in found)] for m in methods)))
        lines = []
        for ours, peer in RATIOS:
            if peer in methods and ours in methods:
                ratios = (row["times"][peer]["ms"] / row["times"][ours]["ms"] for row in found)
                lines.append([f"{peer} / {ours}", *(f"**{ratio:.1f}**" for ratio in ratios)])
        if lines:
            text.append(table([f"{side}², ratio of times", *header[1:]], lines))
    return "\n".join(text)


def cell(row: dict, method: str) -> str:
    """Median and quartiles; the number of calls where it had not all of them."""
    found, most = row["times"][method], max(t["calls"] for t in row["times"].values())
    fewer = f", {found['calls']} calls" if found["calls"] < most else ""
    return f"{number(found['ms'])} ({number(found['low'])}–{number(found['high'])}{fewer})"


def shaded(rows: list[dict]) -> str:
    """Methods down, meshes across, for each size."""
    text = []
    for side, found in by_side(rows):
        header = [f"{side}², shaded, ms", *(f"{row['faces']:,}" for row in found)]
        methods = dict.fromkeys(name for row in found for name in row["times"])
        text.append(table(header, ([m, *(cell(row, m) for row in found)] for m in methods)))
    return "\n".join(text)


def stages(rows: list[dict]) -> str:
    header = ["mesh, side", "mode, sampler", "prepare, once", *STAGES, "total"]
    lines = (
        [
            f"{row['mesh']}, {row['side']}²",
            f"{row['mode']}, {row['sampler']}",
            *(f"{row['ms'][name]:.2f}" for name in ("prepare", *STAGES, "total")),
        ]
        for row in rows
    )
    return table(header, lines)


def memory(rows: list[dict]) -> str:
    keys = list(dict.fromkeys((r["engine"], r["mode"], r["sampler"]) for r in rows))
    faces = faces_of(rows)
    found = {(r["mesh"], r["engine"], r["mode"], r["sampler"]): r for r in rows}
    lines = [
        [
            ", ".join(key),
            *(f"{found[m, *key]['mib']:.0f}" for m in faces),
            *(f"{found[m, *key]['host']:.1f}" for m in faces),
        ]
        for key in keys
    ]
    header = ["MiB", *(f"{f:,}" for f in faces.values()), *(f"{f:,}, NumPy" for f in faces.values())]
    return table(header, lines)


def lm(rows: list[dict]) -> str:
    header = ["mesh, side", "engine", "unknowns", *rows[0]["times"], "step / gradient", "by the Jacobian / gradient"]
    lines = []
    for row in rows:
        gradient, step, jacobian = (t["cpu"] for t in row["times"].values())
        ratios = (f"{step / gradient:.2f}", f"{jacobian / gradient:.2f}")
        about = [f"{row['mesh']}, {row['side']}²", row["engine"], str(row["unknowns"])]
        lines.append([*about, *map(number, (gradient, step, jacobian)), *ratios])
    return table(header, lines)


SECTIONS = {
    "pose": (
        "Pose iteration",
        "One iteration: render, loss, gradient, step of Adam. Medians with quartiles, all methods in turn in one run, "
        f"{CONSECUTIVE} iterations after one that is not timed, by faces. *RtS-pose*: vertices constant. *Full RtS*: "
        "gradient of pose and vertices, a step in the pose; *both*: a step in both; *prepared*: by `rts.prepare`. "
        "DEODR draws one channel of front faces on one thread, by its own classes, which always give the gradient of "
        "the vertices, or called at its compiled functions; the others use all cores.",
        pose,
    ),
    "shaded": (
        "Shaded scenes",
        "The pose iteration as above, vertices constant, with colours: of a light, four channels; of a texture of "
        "256². DEODR shades vertices, three channels.",
        shaded,
    ),
    "stages": (
        "Stages",
        "Of an iteration with torch, milliseconds. *pose*: vertices constant and prepared; *full*: differentiated too. "
        "Constant surfaces are evaluated within *rest of sample*; *backward: splat* includes the loss's.",
        stages,
    ),
    "memory": (
        "Memory",
        "Peak of resident memory over that of the loaded scene with its code compiled, in three iterations, each case "
        "in a process of its own; by faces. *NumPy*: peak of its allocations in sampling.",
        memory,
    ),
    "lm": (
        "Levenberg–Marquardt",
        "A step that is accepted: a solution, and loss and normal equations at the trial; milliseconds of the "
        "processor, all threads together. *step*: by `ImageResiduals`.",
        lm,
    ),
}


def document(results: dict) -> str:
    """All as Markdown."""
    versions = ", ".join(f"{k} {v}" for k, v in results["versions"].items() if v)
    text = [
        "# Speed\n",
        f"{results['date']}, {results['machine']}; {versions}.",
        f"`{results['command']}`; load average {results['load'][0]} before, {results['load'][1]} after.\n",
    ]
    for name, (title, legend, make) in SECTIONS.items():
        if results.get(name):
            text += [f"## {title}\n", legend + "\n", make(results[name])]
    return "\n".join(text)
