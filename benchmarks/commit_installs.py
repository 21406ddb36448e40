"""Installs of commits, each in a folder of its own, and processes that use one and nothing of another.

Nothing here imports rts but `isolate`.
"""

from __future__ import annotations

import hashlib
import importlib
import importlib.metadata
import io
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

ROOT = Path(__file__).resolve().parents[1]
EXAMPLE = "tests/plugin_example"
WORKING_TREE = "."
SETUPTOOLS = 77
"""Builds take an installed setuptools from this version on; else pip fetches one."""

WORKER = Path(__file__).with_name("commit_worker.py")


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
    """Of the sources that are installed."""
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
    """Variables of a process that is to use an install."""
    paths = [str(site), *filter(None, [os.environ.get("PYTHONPATH")])]
    # Spinning threads of one side would take the other's cores.
    return {"OMP_WAIT_POLICY": "PASSIVE", **os.environ, "PYTHONPATH": os.pathsep.join(paths)}


def isolate(site: Path) -> None:
    """Make this process use an install, and nothing of an editable one beside it; see `check_origin`."""
    # An editable install would step in for modules that this side lacks.
    sys.meta_path[:] = [f for f in sys.meta_path if not getattr(f, "__module__", "").startswith("__editable___rts")]
    importlib.import_module("rts")
    check_origin(site)


def check_origin(site: Path) -> None:
    """Exit if any module of rts, or of the example of a plugin, was imported from elsewhere."""
    for name, module in list(sys.modules.items()):
        file = getattr(module, "__file__", None)
        if name.split(".")[0] in ("rts", "rts_backends", "rts_surfaces", "rts_plugin_example") and file:
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


def worker(site: Path, task: str, folder: Path) -> list[str]:
    """The command of a process that uses an install; see `commit_worker`."""
    return [sys.executable, str(WORKER), str(site), task, str(folder)]
