"""Installed packages that are newer than any that the library was run with."""

from __future__ import annotations

import re
import sys
from importlib.metadata import PackageNotFoundError, version

NEWEST = {
    "python": "3.13",
    "jax": "0.12",
    "numba": "0.68",
    "numpy": "2.5",
    "torch": "2.15",
    "trimesh": "5.2",
    "typer": "0.29",
}
"""Newest minor version of each package that was run: see the table of docs/start/install.md."""


def untried() -> str:
    """A line that names installed packages of a newer minor version than was tried; "" if there is none."""
    found = [f"{name} {now} (newest tried: {NEWEST[name]})" for name, now in installed().items() if _newer(name, now)]
    return f"untried, though nothing forbids it: {', '.join(found)}" if found else ""


def installed() -> dict[str, str]:
    """The version of Python, and of each package of `NEWEST` that is installed."""
    versions = {"python": ".".join(map(str, sys.version_info[:3]))}
    for name in NEWEST:
        if name != "python":
            try:
                versions[name] = version(name)
            except PackageNotFoundError:
                continue
    return versions


def _newer(name: str, now: str) -> bool:
    return _minor(now) > _minor(NEWEST[name])


def _minor(text: str) -> list[int]:
    """The first two numbers of a version."""
    return [int(number) for number in re.findall(r"\d+", text)[:2]]
