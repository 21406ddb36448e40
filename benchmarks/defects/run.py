"""Plant defects one at a time, and note which test catches each, and in which command.

    python -m benchmarks.defects.run [NAME ...] [--likely] [--output FILE]

For each: the tests that `make test` runs in the files that are likely to notice, then all that it runs, then the
likely files and all others as `make test-all` runs them. The first that fails is noted. The tree is copied, with its
compiled loops, and only the copy is changed.
"""

from __future__ import annotations

import ast
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Annotated

import typer

from benchmarks.defects.planted import DEFECTS, LOOPS, Defect

ROOT = Path(__file__).resolve().parents[2]
QUICK, THOROUGH = ["-m", "not thorough"], ["-m", "thorough or hypothesis", "--hypothesis-profile", "many"]
LIMIT_S = 1200


def copied(folder: Path) -> Path:
    """A copy of the repository's files, with the caches of compiled loops."""
    copy = folder / "rts"
    names = subprocess.check_output(["git", "ls-files"], cwd=ROOT, text=True).splitlines()
    caches = [
        path.relative_to(ROOT)
        for top in ("rts", "rts_backends", "rts_surfaces")
        for path in (ROOT / top).rglob("*.nb[ic]")
    ]
    for name in [*names, *caches]:
        if (ROOT / name).is_file():
            (copy / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, copy / name)
    return copy


def imports(path: Path) -> set[str]:
    """Full names of the modules that a file imports, and of what it imports from them."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module:
            names |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
        elif isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
    return names


def forget(copy: Path, path: str) -> None:
    """Remove compiled loops of a file and of all that import it: numba looks at each file's own source alone."""
    files = [p for top in ("rts", "rts_backends", "rts_surfaces") for p in (copy / top).rglob("*.py")]
    module = {p: ".".join(p.relative_to(copy).with_suffix("").parts) for p in files}
    known = {p: imports(p) for p in files}
    stale, new = set(), {copy / path}
    while new:
        stale |= new
        names = {module[p] for p in new}
        new = {p for p in files if known[p] & names} - stale
    for p in stale:
        for kept in (p.parent / "__pycache__").glob(f"{p.stem}.*.nb[ic]"):
            kept.unlink()


def verdict(code: int, output: str) -> str | None:
    """The first test that fails, by pytest's exit status and output; None if all pass.

    Raises:
        RuntimeError: pytest ended without a verdict. That shows nothing about the defect.
    """
    # Identifiers may contain spaces; lines of captured logs have several after "ERROR".
    found = re.search(r"^(?:FAILED|ERROR) (\S.*?)(?: - |$)", output, re.MULTILINE)
    if found:
        return found[1]
    if code in (0, 5):
        return None
    raise RuntimeError(f"pytest ended with {code}, and names no test that fails:\n{output[-2000:]}")


def failing(copy: Path, arguments: list[str]) -> str | None:
    """The first test that fails; None if all pass."""
    environment = {**os.environ, "PYTHONPATH": str(copy), "OMP_WAIT_POLICY": "PASSIVE"}
    environment.setdefault("RTS_DATA", str(ROOT.parent / "shared" / "data"))
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", "--no-header", *arguments]
    done = subprocess.run(command, cwd=copy, env=environment, capture_output=True, text=True, timeout=LIMIT_S)
    return verdict(done.returncode, done.stdout)


def catch(defect: Defect, copy: Path, likely_only: bool) -> dict[str, str | None]:
    """The test that catches a defect, and the command that runs it; the copy is as before afterwards."""
    path = copy / defect.path
    text, times = path.read_text(), (path.stat().st_atime, path.stat().st_mtime)
    assert text.count(defect.before) == 1, f"{defect.name}: the text occurs {text.count(defect.before)} times"
    likely = [
        str(found.relative_to(copy))
        for name in defect.tests.split()
        for found in (copy / "tests").glob(f"*/test_{name}.py")
    ]
    stages = [("make test", [*likely, *QUICK]), ("make test", [*QUICK, "-n", "2"])]
    stages += [("make test-all", [*likely, *THOROUGH]), ("make test-all", [*THOROUGH, "-n", "2"])]
    path.write_text(text.replace(defect.before, defect.after))
    forget(copy, defect.path)
    try:
        for command, arguments in stages[:: 2 if likely_only else 1]:
            if test := failing(copy, arguments):
                return {"name": defect.name, "test": test, "command": command}
        return {"name": defect.name, "test": None, "command": None}
    finally:
        path.write_text(text)
        os.utime(path, times)
        forget(copy, defect.path)


def main(
    names: Annotated[list[str] | None, typer.Argument(help="Defects to plant; all without.")] = None,
    likely: Annotated[bool, typer.Option(help="Run only the files that are likely to notice.")] = False,
    output: Annotated[Path, typer.Option(help="Rows as JSON, one a line; rows that are there are kept.")] = Path(
        "defects.jsonl"
    ),
) -> None:
    """Plant defects, and note what catches each."""
    rows = [json.loads(line) for line in output.read_text().splitlines()] if output.exists() else []
    done = {row["name"] for row in rows}
    with tempfile.TemporaryDirectory() as folder:
        copy = copied(Path(folder))
        for defect in DEFECTS:
            if defect.name in done or (names and defect.name not in names):
                continue
            row = catch(defect, copy, likely)
            rows.append(row)
            with output.open("a") as file:
                print(json.dumps(row), file=file)
            print(f"{defect.name}: {row['command'] or 'not caught'} {row['test'] or ''}", flush=True)
        caught = [row for row in rows if row["command"]]
        if caught and (test := failing(copy, [*THOROUGH[2:], *sorted({row["test"] for row in caught})])):
            sys.exit(f"{test} fails without a defect, too: it catches nothing")
    loops = {defect.name for defect in LOOPS}
    print(f"{len(caught)} of {len(rows)} are caught, {sum(row['name'] in loops for row in caught)} of them in loops")


if __name__ == "__main__":
    typer.run(main)
