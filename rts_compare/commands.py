"""The commands `rts compare` and `rts tune`. Their modules are imported as they run, so that `rts --help` is quick."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from rts.tool_api.options import size_of, supersample_of

if TYPE_CHECKING:
    from rts_compare.comparison import Comparison

Scene = Annotated[
    str,
    typer.Argument(
        help="A model, a Python file (FILE.py or FILE.py:FUNCTION), or a built-in scene: see `rts compare list`.",
        show_default=False,
    ),
]
Surface = Annotated[
    str, typer.Option(help="Name of the surface that reads the model: mesh, or such as bezier for patches.")
]
Modes = Annotated[
    list[str] | None,
    typer.Option("--mode", help="translation, rotation, shape, color or camera; may be repeated. All by default."),
]
SceneSize = Annotated[str | None, typer.Option("--size", help="Pixels: 256, or WIDTHxHEIGHT; the scene's own.")]


def compare(
    scene: Scene,
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for the results.")] = Path("comparison"),
    quick: Annotated[
        bool, typer.Option("--quick", help="One mode, one engine, one sampler, at most 40 settings.")
    ] = False,
    modes: Modes = None,
    size: SceneSize = None,
    surface: Surface = "mesh",
    samplers: Annotated[list[str] | None, typer.Option("--sampler", help="May be repeated. All by default.")] = None,
    splatters: Annotated[list[str] | None, typer.Option("--splatter", help="May be repeated. All by default.")] = None,
    engines: Annotated[list[str] | None, typer.Option("--engine", help="May be repeated. All by default.")] = None,
    supersample: Annotated[
        list[str] | None, typer.Option(help="As in rts render. May be repeated. 1, 2 and 4 by default.")
    ] = None,
    peers: Annotated[bool, typer.Option(help="DEODR and Mitsuba, where they are installed.")] = True,
    fresh: Annotated[bool, typer.Option("--fresh", help="Forget what earlier runs have measured.")] = False,
) -> None:
    """Chart the error of derivatives against the time of a render and gradient, over all settings and plugins.

    Writes SCENE.json, SCENE.png and SCENE.html, which is interactive. A run that is interrupted goes on where it was.

    Example: rts compare bunny.obj --quick -o out/bunny && open out/bunny/bunny.html
    """
    from rts_compare.comparison import compare as measured

    if scene == "list":
        _print_scenes()
        return
    wanted: dict[str, Any] = dict(modes=modes, samplers=samplers, splatters=splatters, engines=engines)
    options: dict[str, Any] = {name: value or None for name, value in wanted.items()}
    options["supersample"] = [supersample_of(text) for text in supersample or []] or None
    shape = None if size is None else size_of(size)
    if (missing := _missing_charts()) is not None:
        _say(escape(missing))
    with _interrupted("what was measured is kept: the same command goes on from there"):
        found = measured(
            scene, size=shape, peers=peers, quick=quick, surface=surface, output=output, fresh=fresh, **options
        )
    Console().print(summary(found))
    for line in found.left_out:
        _say(escape(f"left out: {line}"))
    for file in found.files(output):
        _say(escape(f"  {file}"))


def tune(
    scene: Scene,
    tolerance: Annotated[float, typer.Option(help="The largest error of derivatives, a share of them.")] = 0.05,
    budget: Annotated[float, typer.Option(help="Seconds of measuring, after the truth.")] = 60.0,
    modes: Modes = None,
    size: SceneSize = None,
    surface: Surface = "mesh",
    engine: Annotated[str, typer.Option(help="torch or jax; auto is whichever is installed.")] = "auto",
) -> None:
    """Find the cheapest settings whose derivatives are accurate enough on a scene, and say why.

    Example: rts tune bunny.obj --tolerance 0.05 --mode translation --mode rotation
    """
    from rts_compare.chart_style import time_label
    from rts_compare.tuning import tune as tuned

    shape, chosen = None if size is None else size_of(size), None if engine == "auto" else engine
    options: dict[str, Any] = dict(tolerance=tolerance, budget_s=budget, modes=modes or None)
    with _interrupted("the truth is kept, other measurements are not"):
        found = tuned(scene, size=shape, engine=chosen, surface=surface, **options)
    _say(escape(f"rts.render(parts, camera, size, {', '.join(f'{k}={v!r}' for k, v in found.settings.items())})"))
    _say(f"error {100 * found.error:.2g} %, {time_label(1e3 * found.seconds)} for a render and gradient")
    if found.rate:
        _say(escape(f"with surfaces of {found.rate}: rts.tune(...).parts and .scene have them"))
    for reason in found.reasons:
        _say(escape(f"  {reason}"))


@contextlib.contextmanager
def _interrupted(what: str) -> Iterator[None]:
    """On Ctrl-C in the block, print `what`, which says what is kept, and exit with status 130."""
    try:
        yield
    except KeyboardInterrupt:
        typer.echo(f"rts: interrupted; {what}", err=True)
        raise typer.Exit(130) from None


def _print_scenes() -> None:
    """Print the built-in scenes."""
    from rts_compare.builtin_scenes import BUILTIN

    table = Table("scene", "what is hard about it", "data")
    for name, scene in BUILTIN.items():
        table.add_row(name, scene.note, ", ".join(scene.data) or "formulas")
    Console().print(table)


def summary(comparison: Comparison) -> Table:
    """A table of the fastest setting of each mode within each error of `LEVELS`."""
    from rts_compare.chart_style import label, time_label
    from rts_compare.pareto_front import LEVELS

    title = f"{comparison.scene['name']}: fastest settings by the error of derivatives"
    table = Table("mode", *(f"{error:.0%}" for error in LEVELS), title=title)
    for mode in comparison.modes:
        cells = []
        for error in LEVELS:
            row = comparison.best(mode, error)
            cells.append("none" if row is None else f"{label(row)}\n{time_label(row['ms']['median'])}")
        table.add_row(mode, *cells)
    return table


def _missing_charts() -> str | None:
    """A line that names the charts whose package is not installed; None if none is missing."""
    kinds = {"matplotlib": "PNG", "plotly": "HTML"}
    missing = [package for package in kinds if find_spec(package) is None]
    if not missing:
        return None
    return (
        f"no {' or '.join(kinds[package] for package in missing)}, which needs {' and '.join(missing)}: pip install "
        f"'rasterize-then-splat[plots]'. What is measured is kept: the same command draws it later"
    )


def _say(text: str) -> None:
    Console(soft_wrap=True, highlight=False).print(text)
