"""All figures and tables of the paper, made anew: one command, and a name for each.

    python -m benchmarks.paper all --quick          # all of them, small
    python -m benchmarks.paper airplane blur -o out/paper
    python -m benchmarks.paper hand --keep          # for docs/results/paper.md, which benchmarks.pages fills

Each experiment writes its pictures and numbers into a folder of its own, with `row.json`: the paper's claims and
numbers, ours, and whether they hold. An experiment whose data or packages are missing is left out, and says why.
"""

from __future__ import annotations

import argparse
import importlib
import json
import resource
import shutil
import sys
import time
from pathlib import Path
from typing import Any

from benchmarks.paper.registry import EXPERIMENTS, Experiment
from benchmarks.paper.rows import Row, path_of
from rts_compare.environment import environment

IMAGES = Path(__file__).parents[2] / "docs/images/paper"
PACKAGES = ("rasterize-then-splat", "numpy", "numba", "torch", "jax", "deodr")


class NotRun(Exception):
    """The reason why an experiment was not run, in one line."""


def arguments_of(experiment: Experiment, folder: Path, quick: bool, engine: str | None) -> list[str]:
    """The arguments of an experiment's script.

    Raises:
        NotRun: the script knows torch alone, and another engine is asked for.
    """
    found = [*(experiment.quick if quick else experiment.full), "-o", str(folder)]
    if engine is not None and experiment.engine is not None:
        found += [experiment.engine, engine]
    elif engine not in (None, "torch"):
        raise NotRun(f"{experiment.script} has no option for the engine {engine}")
    return found


def cpu_seconds() -> float:
    """User seconds of this process and of those that it has waited for."""
    return sum(resource.getrusage(who).ru_utime for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))


def run(name: str, folder: Path, quick: bool = False, engine: str | None = None) -> dict[str, Any]:
    """Run an experiment into a folder.

    Returns:
        "about", its conditions; "numbers".

    Raises:
        NotRun: its data or a package is missing, or its script does not know the engine.
    """
    experiment = EXPERIMENTS[name]
    arguments = arguments_of(experiment, folder, quick, engine)
    folder.mkdir(parents=True, exist_ok=True)
    wall, user = time.perf_counter(), cpu_seconds()
    try:
        importlib.import_module(experiment.script).main(arguments)
    except SystemExit as stop:
        if not stop.code:
            raise
        raise NotRun(str(stop.code)) from stop
    except ImportError as missing:
        raise NotRun(f"a package is missing: {missing}") from missing
    about = environment(PACKAGES) | {
        "command": f"python -m {experiment.script} {' '.join(arguments[:-2])}".strip(),
        "size": "quick" if quick else "full",
        "seconds": round(time.perf_counter() - wall, 1),
        "user_seconds": round(cpu_seconds() - user, 1),
    }
    return {"about": about, "numbers": experiment.numbers(folder)}


def told(name: str, rows: list[Row]) -> str:
    """The rows of an experiment, as text."""
    lines = [f"== {name}: {EXPERIMENTS[name].place}"]
    for row in rows:
        lines += [f"   {row.claim}", f"      paper: {row.number}   ours: {row.ours}", f"      {row.told()}"]
    return "\n".join(lines)


def keep(name: str, folder: Path, found: dict[str, Any]) -> None:
    """Copy numbers and pictures to where the page takes them from."""
    path_of(name).parent.mkdir(parents=True, exist_ok=True)
    path_of(name).write_text(json.dumps(found, indent=1, ensure_ascii=False) + "\n")
    IMAGES.mkdir(parents=True, exist_ok=True)
    for picture in EXPERIMENTS[name].pictures:
        source, target = folder / picture, IMAGES / f"{name}{Path(picture).suffix}"
        if source.exists():
            shutil.copyfile(source, target)


def options(arguments: list[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.paper", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="+", metavar="NAME", help=f"all, or some of {', '.join(EXPERIMENTS)}")
    parser.add_argument("-o", "--output", type=Path, default=Path("out/paper"))
    parser.add_argument("--quick", action="store_true", help="small versions")
    parser.add_argument("--engine", choices=("torch", "jax"), default=None, help="default: each script's own")
    parser.add_argument("--keep", action="store_true", help="keep the results for the page; full size only")
    args = parser.parse_args(arguments)
    unknown = [name for name in args.names if name not in (*EXPERIMENTS, "all")]
    if unknown:
        raise SystemExit(f"no experiment is called {unknown[0]!r}; expected all, or some of {', '.join(EXPERIMENTS)}")
    if args.keep and args.quick:
        raise SystemExit("--keep is for results of full size; leave --quick out")
    return args


def main(arguments: list[str] | None = None) -> None:
    args = options(arguments)
    names = list(EXPERIMENTS) if "all" in args.names else list(dict.fromkeys(args.names))
    texts, failed = [], False
    for name in names:
        folder = args.output / name
        try:
            found = run(name, folder, args.quick, args.engine)
        except NotRun as why:
            rows = [Row(EXPERIMENTS[name].place, "–", "–", "not run", str(why))]
            failed = failed or len(names) == 1
        else:
            rows = EXPERIMENTS[name].rows(found["numbers"])
            folder.joinpath("row.json").write_text(
                json.dumps(found | {"rows": [row._asdict() for row in rows]}, indent=1, ensure_ascii=False) + "\n"
            )
            if args.keep:
                keep(name, folder, found)
            rows.append(Row("time", "–", "{seconds} s, {user_seconds} s of user time".format(**found["about"]), "–"))
        texts.append(told(name, rows))
        print(texts[-1], flush=True)
    if len(names) > 1:
        print("\n".join(("", "All rows:", *texts)))
    sys.exit(int(failed))


if __name__ == "__main__":
    main()
