"""The tables of the first page of results: tasks by this library and by others, and where it fails."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from benchmarks.pages.kept import kept, number, outcome, written
from benchmarks.report import table

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


def step(faces: str) -> list[str]:
    """A line: a step of a pose's fit, of the table on the page of speed."""
    columns, lines = written("speed", "256², ms")
    place = columns.index(faces)
    ours, deodr = (number(lines[name][place]) for name in ("RtS-pose, torch, auto", "DEODR"))
    task = f"a step of a pose's fit, {faces} faces ([table](speed.md#pose-iteration))"
    return [
        task,
        f"{ours:.3g} ms",
        f"{deodr:.3g} ms",
        LOST,
        ratio(ours, [deodr]),
        "the default, torch, 256²",
    ]


def poses() -> list[str]:
    """A line: how many poses are found from starts that are 50° off."""
    rows = [row for row in kept("basin")["rows"] if row["start"] == 50]

    def won(method: str) -> str:
        found = [row["success"] for row in rows if row["method"] == method]
        return f"{sum(found)} of {len(found)}"

    setting = "`single`, `rts.pyramid`, Levenberg–Marquardt; "
    setting += f"DEODR: Adam at full resolution (ours there: {won('plain')})"
    task = "poses from three silhouettes, starts 50° and 20 % off ([page](basin.md))"
    return [task, won("pyramid"), won("DEODR"), LOST, LOST, setting]


def failing(name: str, method: str, what: str, title: str = "") -> list[str]:
    """A line of the table of stability; `what` says what its figures are, `title` replaces the row's name."""
    cells = [outcome(name, column) for column in (method, *PEERS)]
    texts = [LOST if cell["verdict"] == "cannot" else cell["text"] for cell in cells]
    return [f"{title or name}: {what} ([table](stability.md))", *texts, LOST, f"`{method}`"]


def wins() -> str:
    """Tasks that this library is for, beside others."""
    error = "error of the derivative (largest of a pixel)"
    names = ("interpenetrating surfaces", "card behind glass", "coplanar surfaces", "slivers, triangles of no area")
    lines = [failing(name, "edges", error) for name in names]
    nearer = "slides through the near plane and comes nearer"
    lines.append(failing("… and comes nearer", "edges", error, nearer))
    fits = "starts that converge, pixels off"
    lines += [failing(name, "edges", fits) for name in ("pose of a box", "square slides behind bunny")]
    lines += [step(faces) for faces in FACES[1:]]
    return table(COLUMNS, [*lines, poses()])


def losses() -> str:
    """Tasks at which this library fails, or another is ahead."""
    lines = [failing("wires of 1, 0.5, 0.25 pixels", "edges", "errors of the derivative")]
    lines += [failing("stacks of 2, 4, 6, 8 cards", "edges", "errors of the derivative")]
    lines += [step(FACES[0])]
    lines += [failing("too far for overlap", "edges", "starts that converge, pixels off")]
    return table(COLUMNS, lines)


HEADLINES: dict[str, Callable[[], str]] = {"wins": wins, "losses": losses}
"""Name of a mark on the first page → a function that makes its table."""
