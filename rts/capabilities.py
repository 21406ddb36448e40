"""What plugins can do, read off their classes: what `rts.plugins(group, details=True)` says of each."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

METHODS: Mapping[str, Mapping[str, str]] = {
    "rts.surfaces": {"triangles": "proxy", "rays": "intersect"},
}
"""Group → capability → the method that a plugin with it has."""

VARIABLES: Mapping[str, Mapping[str, Any]] = {
    "rts.engines": {"differentiates": True},
    "rts.surfaces": {"refines": False, "depends_on_view": False},
    "rts.samplers": {"concurrent": False},
    "rts.shaders": {"opaque": False, "uniform": False, "takes_views": False, "reads": None},
    "rts.splatters": {
        "layers": None,
        "reach": 1,
        "reads_facing": False,
        "prunes": False,
        "sums_products": False,
        "takes_losses": False,
    },
}
"""Group → class variable of its base → its default, for plugins of other classes."""


def capabilities(group: str, plugin: Any) -> dict[str, Any]:
    """Name → value: of class variables of the group's base, and whether there are certain methods.

    Args:
        group: such as "rts.samplers".
        plugin: what the entry point names.
    """
    found: dict[str, Any] = {name: hasattr(plugin, method) for name, method in METHODS.get(group, {}).items()}
    return found | {name: getattr(plugin, name, default) for name, default in VARIABLES[group].items()}


def in_words(capabilities: Mapping[str, Any]) -> str:
    """Capabilities in a line: what is true by its name, what has a value with it."""
    words = []
    for name, value in capabilities.items():
        shown = name.replace("_", " ")
        if value is True:
            words.append(shown)
        elif isinstance(value, (tuple, list)):
            words.append(f"{shown} {' '.join(map(str, value)) or 'nothing'}")
        elif value is not False and value is not None:
            words.append(f"{shown} {value}")
    return ", ".join(words)
