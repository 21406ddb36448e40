"""`rts new`: a distribution with a plugin, its entry point and its test, written from templates."""

from __future__ import annotations

import keyword
import re
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any

from rts import __version__, registry
from rts.errors import InputError
from rts.files.paths import output_folder, writing

KINDS = ("surface",)
"""Kinds of plugins that have templates."""
PLACES = {
    "pyproject.toml.in": "pyproject.toml",
    "README.md.in": "README.md",
    "__init__.py.in": "{package}/__init__.py",
    "surface.py.in": "{package}/surface.py",
    "test_surface.py.in": "tests/test_{module}.py",
}
"""Template → file in the new folder."""


def write_plugin(kind: str, name: str, folder: Any = None) -> list[Path]:
    """Write a distribution that adds a plugin; its test passes as it is.

    Args:
        kind: one of `KINDS`.
        name: the name of the plugin, such as "height-field".
        folder: the new folder; by default "rts-" and the name, in the current folder.

    Returns:
        The files written.

    Raises:
        InputError: there is no such kind; the name is invalid or taken; the folder exists or cannot be written.
    """
    if kind not in KINDS:
        raise InputError(f"no template of {kind!r}; there is {', '.join(KINDS)}")
    names = _names(name)
    folder = Path(names["distribution"]) if folder is None else Path(folder)
    output_folder(folder)
    if folder.exists():
        raise InputError(f"{folder} exists; expected the name of a new folder")
    written = []
    for template, place in PLACES.items():
        text = (files("rts.cli") / "templates" / kind / template).read_text(encoding="utf-8")
        path = folder / place.format(**names)
        with writing(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(Template(text).substitute(names), encoding="utf-8")
        written.append(path)
    return written


def _names(name: str) -> dict[str, str]:
    """Values of the templates' placeholders, from a plugin's name."""
    module = name.replace("-", "_")
    if not re.fullmatch(r"[a-z][a-z0-9]*([-_][a-z0-9]+)*", name) or keyword.iskeyword(module):
        raise InputError(
            f"{name!r} is no name for a plugin; expected small letters, digits, and - or _ between them, beginning "
            f"with a letter, and no word of Python's"
        )
    if name in registry.plugins("rts.surfaces"):
        raise InputError(f"there is a surface {name!r} already; choose another name")
    major, minor = map(int, __version__.split(".")[:2])
    return {
        "name": name,
        "module": module,
        "distribution": f"rts-{name.replace('_', '-')}",
        "package": f"rts_{module}",
        "class_name": "".join(word.capitalize() for word in module.split("_")),
        "least": f"{major}.{minor}",
        "below": f"{major}.{minor + 1}",
    }
