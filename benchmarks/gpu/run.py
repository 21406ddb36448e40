"""Install, test and time the library on a machine with a GPU that has no internet, by one command.

    python3 benchmarks/gpu/run.py --wheels .wheels --data DATA --out OUT --minutes 9

The machine has packages of its own, such as torch or jax with CUDA. The tree is installed beside them without its
dependencies, into a folder that is deleted afterwards; packages that the machine lacks come from a folder of wheels:

    python3 -m pip download --no-deps --only-binary=:all: --python-version 3.12 -d .wheels setuptools trimesh …

Under OUT are then `gpu.json` (versions, counts of tests, tables) and `gpu.log` (all that was printed). What does not
fit into the minutes is left out, and the JSON says so. This file imports the standard library alone.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import importlib.util
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any, TextIO

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("torch", "jax", "jaxlib", "numpy", "numba", "triton", "array-api-compat", "trimesh", "scipy", "optax")
NEEDED = ("array-api-compat", "mapbox-earcut", "trimesh", "typer", "rich", "numba", "scipy", "pillow", "hypothesis")
NEEDED += ("platformdirs", "xxhash")
"""Packages without which no test runs."""

MOST_WORKERS = 8
"""Processes that run tests, each with a context of its own on the GPU."""

LEAST = 30.0
"""Seconds that must be left for another step to begin."""


class Steps:
    """Commands one after the other, what they print, and their time.

    Args:
        log: a file that takes what they print.
        until: the moment by which all must have ended, as `time.monotonic` has it.
        variables: of the environment.
    """

    def __init__(self, log: TextIO, until: float, variables: dict[str, str]):
        self.log, self.until, self.variables = log, until, variables
        self.taken: list[dict[str, Any]] = []

    def run(self, name: str, *command: str, share: float = 1.0) -> bool:
        """Run a command for at most a share of the time that is left; True if it succeeded."""
        left = share * (self.until - time.monotonic())
        step: dict[str, Any] = {"step": name, "command": " ".join(command)}
        self.taken.append(step)
        if left < LEAST:
            step["result"] = "left out: no time"
            return False
        self.say(f"== {name}: {step['command']}")
        start = time.monotonic()
        with subprocess.Popen(
            command, cwd=ROOT, env=self.variables, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
        ) as process:
            try:
                printed, _ = process.communicate(timeout=left)
                step["result"] = process.returncode
            except subprocess.TimeoutExpired:
                process.kill()
                printed, _ = process.communicate()
                step["result"] = f"stopped after {left:.0f} s"
        step["seconds"] = round(time.monotonic() - start, 1)
        self.say(printed.rstrip())
        self.say(f"== {name}: {step['result']}, {step['seconds']} s")
        return step["result"] == 0

    def say(self, text: str) -> None:
        """Print a text, and keep it."""
        print(text, flush=True)
        self.log.write(text + "\n")
        self.log.flush()


def versions() -> dict[str, str]:
    """Versions of Python and of packages; "missing" for those that are."""
    found = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = "missing"
    return found


def counts(path: Path) -> dict[str, Any]:
    """Counts of tests, and names of those that failed, of pytest's XML; nothing if it was not written."""
    if not path.exists():
        return {}
    suite = next(ElementTree.parse(path).getroot().iter("testsuite"))
    failed = [
        f"{case.get('classname')}::{case.get('name')}"
        for case in suite.iter("testcase")
        if case.find("failure") is not None or case.find("error") is not None
    ]
    numbers = {key: int(suite.get(key, 0)) for key in ("tests", "failures", "errors", "skipped")}
    return {**numbers, "failed": failed, "seconds": float(suite.get("time", 0))}


def installed(steps: Steps, site: Path, wheels: Path | None) -> bool:
    """Install wheels and the tree into a folder, without dependencies; True if both succeeded."""
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-index", "--no-deps", "--upgrade", "--target"]
    files = sorted(map(str, wheels.glob("*.whl"))) if wheels else []
    if files and not steps.run("wheels", *pip, str(site), *files):
        return False
    return steps.run("tree", *pip, str(site), "--no-build-isolation", str(ROOT))


def main() -> int:
    """The command."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--wheels", type=Path, help="folder of wheels that the machine lacks")
    parser.add_argument("--data", type=Path, help="folder of the test data, with meshes/ in it")
    parser.add_argument("--out", type=Path, default=Path("out/gpu"), help="folder of gpu.json and gpu.log")
    parser.add_argument("--minutes", type=float, default=9.0, help="time for everything")
    parser.add_argument("--device", default="cuda", help="device of the tables; cpu tries this command elsewhere")
    parser.add_argument("--only", choices=("tests", "tables"), help="leave the other out")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    out = options.out.resolve()
    with tempfile.TemporaryDirectory() as folder, open(out / "gpu.log", "w", encoding="utf-8") as log:
        site = Path(folder) / "site"
        variables = {**os.environ, "PYTHONPATH": f"{site}{os.pathsep}{ROOT}", "PYTHONUNBUFFERED": "1"}
        variables |= {"NUMBA_CACHE_DIR": str(out / "numba"), "OMP_WAIT_POLICY": "PASSIVE"}
        # jax otherwise takes three quarters of the GPU's memory at once, and torch has none.
        variables["XLA_PYTHON_CLIENT_PREALLOCATE"] = "false"
        if options.data:
            variables["RTS_DATA"] = str(options.data.resolve())
        steps = Steps(log, time.monotonic() + 60 * options.minutes, variables)
        steps.run("gpu", "nvidia-smi") if options.device == "cuda" else None
        found: dict[str, Any] = {"machine": platform.platform(), "cores": os.cpu_count(), "versions": versions()}
        if installed(steps, site, options.wheels):
            missing = f"import importlib.metadata as m; [m.version(n) for n in {NEEDED!r}]"
            steps.run("packages", sys.executable, "-c", missing)
            steps.run("loops compiled", sys.executable, "-m", "rts", "warmup", share=0.3)
            if options.only != "tables":
                tests = [sys.executable, "-m", "pytest", "-q", "--tb=short", "-m", "devices"]
                tests += ["-p", "no:cacheprovider", "-p", "no:benchmark"]
                if importlib.util.find_spec("xdist"):
                    tests += ["-n", str(min(os.cpu_count() or 1, MOST_WORKERS))]
                steps.run(
                    "tests",
                    *tests,
                    f"--junitxml={out / 'tests.xml'}",
                    "tests/arrays",
                    share=1.0 if options.only else 0.55,
                )
                found["tests"] = counts(out / "tests.xml")
            if options.only != "tests":
                seconds = str(max(steps.until - time.monotonic() - LEAST, 0))
                tables = ["-m", "benchmarks.gpu.tables", str(out / "tables.json"), options.device, seconds]
                steps.run("tables", sys.executable, *tables)
                path = out / "tables.json"
                found["tables"] = json.loads(path.read_text()) if path.exists() else {}
        found["steps"] = steps.taken
        (out / "gpu.json").write_text(json.dumps(found, indent=1) + "\n")
    good = all(step["result"] == 0 for step in steps.taken if step["step"] != "gpu")
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
