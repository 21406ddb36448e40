"""The tables of the first page of results: tasks by this library and by others, and where it fails."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from benchmarks.pages.kept import kept, number, outcome, scene, written
from benchmarks.report import table
from rts_compare.chart_style import label
from rts_compare.pareto_front import best_within

COLUMNS = ("task", "ours", "DEODR", "Mitsuba", "ratio", "our setting")
PEERS = ("DEODR", "Mitsuba")
FACES = ("6,320", "69,451", "374,784", "1,599,008")
LOST = "–"


def ratio(ours: float | None, others: Sequence[float | None]) -> str:
    """How many times as fast we are as the fastest of the others; text for where one side has no time."""
    known = [ms for ms in others if ms is not None]
    if ours is None:
        return "others alone" if known else LOST
    return f"×{min(known) / ours:.2g}" if known else "ours alone"


def derivative(name: str, mode: str, level: float) -> list[str]:
    """A line: the fastest setting of each whose derivative image is within an error; else its least error."""
    rows = [row for row in scene(name)["rows"] if row["mode"] == mode]
    groups = {"ours": [row for row in rows if "peer" not in row]}
    groups |= {peer: [row for row in rows if row.get("peer") == peer] for peer in PEERS}
    best = {who: best_within(found, level) for who, found in groups.items()}
    times = {who: None if row is None else row["ms"]["median"] for who, row in best.items()}
    cells = [_time(best[who], found) for who, found in groups.items()]
    setting = f"`{label(best['ours'])}`" if best["ours"] else LOST
    page = "[chart](speed-against-accuracy.md#" + name.replace(" ", "-") + ")"
    task = f"{name}: derivative in {mode} within {level:.0%} ({page})".replace("%", " %")
    return [task, *cells, ratio(times["ours"], [times[peer] for peer in PEERS]), setting]


def _time(best: Mapping | None, rows: Sequence[Mapping]) -> str:
    """A cell: the time of the best row and its error, or the least error of all."""
    if best is not None:
        return f"{best['ms']['median']:.3g} ms ({percent(best['error'])})"
    return f"none ({percent(min(row['error'] for row in rows))} at best)" if rows else LOST


def percent(error: float) -> str:
    """An error in percent, two digits or whole numbers."""
    return f"{100 * error:.1f} %" if error < 0.1 else f"{100 * error:.0f} %"


def step(faces: str) -> list[str]:
    """A line: a step of a pose's fit, of the table on the page of speed."""
    columns, lines = written("speed", "256², ms")
    place = columns.index(faces)
    ours, deodr = (number(lines[name][place]) for name in ("RtS-pose, torch, auto", "DEODR"))
    task = f"a step of a pose's fit, {faces} faces ([table](speed.md#pose-iteration))"
    return [task, f"{ours:.3g} ms", f"{deodr:.3g} ms", LOST, ratio(ours, [deodr]), "torch, K = 2, 256²"]


def poses() -> list[str]:
    """A line: how many poses are found from starts that are 50° off."""
    rows = [row for row in kept("basin")["rows"] if row["start"] == 50]

    def won(method: str) -> str:
        found = [row["success"] for row in rows if row["method"] == method]
        return f"{sum(found)} of {len(found)}"

    setting = f"`rts.pyramid`, Levenberg–Marquardt; DEODR: Adam at full resolution (ours there: {won('plain')})"
    task = "poses from three silhouettes, starts 50° and 20 % off ([page](basin.md))"
    return [task, won("pyramid"), won("DEODR"), LOST, LOST, setting]


def failing(name: str, method: str, what: str, title: str = "") -> list[str]:
    """A line of the table of stability; `what` says what its figures are, `title` replaces the row's name."""
    cells = [outcome(name, column) for column in (method, *PEERS)]
    texts = [LOST if cell["verdict"] == "cannot" else cell["text"] for cell in cells]
    return [f"{title or name}: {what} ([table](stability.md))", *texts, LOST, f"`{method}`, K = 2, 1 × 1"]


def wins() -> str:
    """Tasks that this library is for, beside others."""
    error = "error of the derivative (largest of a pixel)"
    names = ("bunny over black", "bunny before square", "square behind bunny", "crossing spheres")
    lines = [derivative("bunny over black", "translation", 0.03)]
    lines += [derivative(name, "translation", 0.1) for name in names]
    lines += [failing("interpenetrating surfaces", "visible", error)]
    lines += [step(faces) for faces in FACES[1:]]
    lines += [poses(), failing("hand, over learning rates", "visible", "error of the picture, highest stable rate")]
    return table(COLUMNS, lines)


def losses() -> str:
    """Tasks at which this library fails, or another is ahead."""
    error = "error of the derivative (largest of a pixel)"
    lines = [derivative("square behind bunny", "translation", 0.03)]
    lines += [derivative("crossing spheres", "rotation", 0.1), derivative("stack of cards", "color", 0.1)]
    lines += [derivative("thin wires", "translation", 0.03), step(FACES[0])]
    lines += [failing("wires of 1, 0.5, 0.25 pixels", "visible", "errors of the derivative")]
    lines += [failing(name, "visible", error) for name in ("coplanar surfaces", "1e5 away from the origin")]
    nearer = "slides through the near plane and comes nearer"
    lines += [failing("… and comes nearer", "visible", error, nearer)]
    lines += [failing("too far for overlap", "visible", "starts that converge, pixels off")]
    return table(COLUMNS, lines)


HEADLINES: dict[str, Callable[[], str]] = {"wins": wins, "losses": losses}
"""Name of a mark on the first page → a function that makes its table."""
