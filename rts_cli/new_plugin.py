"""`rts new`: a distribution with a plugin, its entry point and its test, written from templates."""

from __future__ import annotations

import keyword
import re
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any

from rts import __version__, plugins
from rts.errors import InputError
from rts.tool_api.files import output_folder, writing

KINDS = ("surface", "sampler", "shader", "splatter")
"""Kinds of plugins that have templates."""
TRIANGLES = "surface_of_triangles"
"""The folder of templates of a surface that is sampled by triangles."""
PLACES = {
    "common/pyproject.toml.in": "pyproject.toml",
    "{template}/README.md.in": "README.md",
    "common/__init__.py.in": "{package}/__init__.py",
    "{template}/plugin.py.in": "{package}/{kind}.py",
    "{template}/test_plugin.py.in": "tests/test_{module}.py",
}
"""Template → file in the new folder."""


def write_plugin(kind: str, name: str, folder: Any = None, triangles: bool = False) -> list[Path]:
    """Write a distribution that adds a plugin; its test passes as it is.

    Args:
        kind: one of `KINDS`.
        name: the plugin's name, such as "height-field".
        folder: the new folder; by default "rts-" and the name, in the current folder.
        triangles: whether a surface is to be sampled by triangles, in place of rays.

    Returns:
        The files written.

    Raises:
        InputError: there is no such kind; the name is invalid or taken; the folder exists or cannot be written.
    """
    if kind not in KINDS:
        raise InputError(f"no template of {kind!r}; there is {', '.join(KINDS)}")
    if triangles and kind != "surface":
        raise InputError(f"a {kind} is not made of triangles; expected 'surface'")
    names = {**_names(kind, name), "template": TRIANGLES if triangles else kind}
    folder = Path(names["distribution"]) if folder is None else Path(folder)
    output_folder(folder)
    if folder.exists():
        raise InputError(f"{folder} exists; expected the name of a new folder")
    written = []
    for template, place in PLACES.items():
        text = (files("rts_cli") / "templates" / template.format(**names)).read_text(encoding="utf-8")
        path = folder / place.format(**names)
        with writing(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(Template(text).substitute(names), encoding="utf-8")
        written.append(path)
    return written


def _names(kind: str, name: str) -> dict[str, str]:
    """Values for the templates, by their names there, from a plugin's kind and name; bad or taken names are refused."""
    module = name.replace("-", "_")
    if not re.fullmatch(r"[a-z][a-z0-9]*([-_][a-z0-9]+)*", name) or keyword.iskeyword(module):
        raise InputError(
            f"{name!r} is no name for a plugin; expected small letters, digits, and - or _ between them, beginning "
            f"with a letter, and no word of Python's"
        )
    group = f"{kind}s"
    if name in plugins(f"rts.{group}"):
        raise InputError(f"there is a {kind} {name!r} already; choose another name")
    major, minor = map(int, __version__.split(".")[:2])
    least = __version__ if "dev" in __version__ else f"{major}.{minor}"  # 0.3.0.dev0 is before 0.3.
    return {
        "kind": kind,
        "group": group,
        "name": name,
        "module": module,
        "distribution": f"rts-{name.replace('_', '-')}",
        "package": f"rts_{module}",
        "class_name": "".join(word.capitalize() for word in module.split("_")),
        "least": least,
        "below": f"{major}.{minor + 1}",
    }
