"""Installs of commits, each in a folder of its own, and processes that use one and nothing of another.

Nothing here imports rts but `isolate`, which a process calls before anything else does.
"""

from __future__ import annotations

import hashlib
import importlib
import importlib.metadata
import io
import json
import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = {"rts", "rts_backends", "rts_surfaces", "rts_plugin_example"}
"""What is installed of a commit: packages that are to be imported from there only."""
EXAMPLE = "tests/plugin_example"
WORKING_TREE = "."
SETUPTOOLS = 77
"""Builds take an installed setuptools from this version on; else pip fetches one."""


def git(*arguments: str) -> bytes:
    done = subprocess.run(["git", "-C", str(ROOT), *arguments], capture_output=True)
    if done.returncode:
        raise SystemExit(done.stderr.decode().strip())
    return done.stdout


class Side(NamedTuple):
    """One of the two that are compared.

    Attributes:
        label: of tables.
        site: the folder into which it is installed.
    """

    label: str
    site: Path


def sides_of(revisions: Sequence[str], folder: Path) -> list[Side]:
    """Installs of some revisions; all are made at once, lest one change while another is at work."""
    found = []
    for revision in revisions:
        if revision == WORKING_TREE:
            label = "working tree"
        else:
            short = git("rev-parse", "--short", f"{revision}^{{commit}}").decode().strip()
            label, revision = short if revision.startswith(short) else f"{revision} ({short})", short
        found.append(Side(label, install(revision, folder)))
    return found


def copy_of(revision: str, folder: Path) -> Path:
    """A folder with the files of a revision, or of the working tree: those that git knows or does not ignore."""
    folder.mkdir(parents=True)
    if revision != WORKING_TREE:
        with tarfile.open(fileobj=io.BytesIO(git("archive", "--format=tar", revision))) as archive:
            archive.extractall(folder, filter="data")
        return folder
    for name in git("ls-files", "-z", "--cached", "--others", "--exclude-standard").decode().split("\0"):
        if name and (ROOT / name).is_file():  # What is deleted, but not yet committed, is still listed.
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, folder / name)
    return folder


def digest(copy: Path) -> str:
    """A checksum of the sources that are installed."""
    found = hashlib.sha256(sys.version.encode())
    for path in sorted(copy.rglob("*")):
        name = path.relative_to(copy).as_posix()
        beside = name.startswith(("benchmarks/", "docs/", "tests/")) and not name.startswith(EXAMPLE)
        if path.is_file() and path.suffix != ".md" and not beside:
            found.update(f"{name}\0{path.stat().st_size}\0".encode() + path.read_bytes())
    return found.hexdigest()[:16]


def install(revision: str, folder: Path) -> Path:
    """The folder into which a revision, and its example of a plugin, are installed; those that it needs are not.

    Args:
        revision: what git knows, or "." for the working tree.
        folder: for installs of all revisions; one of the same sources is used again.
    """
    with tempfile.TemporaryDirectory() as scratch:
        copy = copy_of(revision, Path(scratch) / "copy")
        site = folder / digest(copy)
        if not site.exists():
            installed = Path(scratch) / "site"
            projects = [str(p) for p in (copy, copy / EXAMPLE) if (p / "pyproject.toml").exists()]
            command = [sys.executable, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--no-deps"]
            command += ["--no-build-isolation"] if _has_setuptools() else []
            subprocess.run([*command, "--target", str(installed), *projects], check=True)
            folder.mkdir(parents=True, exist_ok=True)
            shutil.move(installed, site)
    return site.resolve()


def _has_setuptools() -> bool:
    try:
        return int(importlib.metadata.version("setuptools").split(".")[0]) >= SETUPTOOLS
    except importlib.metadata.PackageNotFoundError:
        return False


def environment(site: Path) -> dict[str, str]:
    """Variables of a process that is to use an install, and modules of the benchmarks; see `isolate`."""
    paths = [str(site), *filter(None, [os.environ.get("PYTHONPATH")]), str(ROOT)]
    # Spinning threads of one side would take the other's cores.
    return {"OMP_WAIT_POLICY": "PASSIVE", **os.environ, "PYTHONPATH": os.pathsep.join(paths)}


def isolate(site: Path) -> None:
    """Make this process use an install, and nothing of others beside it; see `check_origin`."""
    # This checkout, and an editable install, would step in for modules that this side lacks.
    sys.path[:] = [folder for folder in sys.path if Path(folder).resolve() != ROOT]
    sys.meta_path[:] = [finder for finder in sys.meta_path if PACKAGES.isdisjoint(_mapping(finder))]
    # An install under another name would add its plugins to those of this side.
    found = importlib.metadata.distributions
    importlib.metadata.distributions = lambda **context: (d for d in found(**context) if not _is_other(d, site))
    importlib.import_module("rts")
    check_origin(site)


def _mapping(finder: object) -> dict[str, str]:
    """The packages of an editable install, by the finder that it puts on `sys.meta_path`."""
    return getattr(sys.modules.get(getattr(finder, "__module__", "")), "MAPPING", {})


def _is_other(distribution: importlib.metadata.Distribution, site: Path) -> bool:
    """True for a path that brings a package installed of a commit, but from elsewhere."""
    packages = (distribution.read_text("top_level.txt") or "").split()
    place = Path(str(distribution.locate_file(""))).resolve()
    return not PACKAGES.isdisjoint(packages) and not place.is_relative_to(site)


def check_origin(site: Path) -> None:
    """Exit if any module of rts, or of the example of a plugin, was imported from elsewhere."""
    for name, module in list(sys.modules.items()):
        file = getattr(module, "__file__", None)
        if name.split(".")[0] in PACKAGES and file:
            if not Path(file).resolve().is_relative_to(site):
                raise SystemExit(f"{name} is {file}; expected one in {site}: is another rts earlier on the path?")


@contextmanager
def folder_of(chosen: Path | None) -> Iterator[Path]:
    """The folder that was chosen, or one that is removed in the end."""
    if chosen is not None:
        chosen.mkdir(parents=True, exist_ok=True)
        yield chosen.resolve()
        return
    with tempfile.TemporaryDirectory(prefix="rts-commits-") as name:
        yield Path(name).resolve()


def process(module: str, *arguments: object) -> list[str]:
    """The command of a process that runs a module of the benchmarks; see `environment`."""
    # -P: else the folder that this is run from, with the rts in it, would come before the install.
    return [sys.executable, "-P", "-m", module, *map(str, arguments)]


def worker(site: Path, task: str, folder: Path, *options: list[str]) -> list[str]:
    """The command of a process that does a task with an install; see `commits.worker`."""
    return process("benchmarks.commits.worker", site, task, folder, *map(json.dumps, options))
