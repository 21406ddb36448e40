"""Capabilities of registered plugins, for `rts plugins` and `rts.plugins(…, details=True)`."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from typing import Any

from rts.errors import PluginError
from rts.plugin_base import PROMISES, overrides, promised

BASES = {
    "rts.surfaces": "Surface",
    "rts.samplers": "Sampler",
    "rts.shaders": "Shader",
    "rts.splatters": "Splatter",
    "rts.engines": "Engine",
}
"""Group → name of the base class in `rts`."""

METHODS: Mapping[str, Mapping[str, tuple[str, str]]] = {
    "rts.surfaces": {
        "triangles": ("TriangleSurface", "proxy"),
        "rays": ("RaySurface", "intersect"),
        "refines": ("TriangleSurface", "refine"),
        "depends_on_view": ("TriangleSurface", "proxy_key"),
    },
    "rts.splatters": {
        "prunes": ("Splatter", "needed"),
        "sums": ("SummingSplatter", "normal_equations"),
    },
}
"""Group → capability → base class, and its method that a plugin with this capability overrides."""

VARIABLES: Mapping[str, tuple[str, ...]] = {
    "rts.engines": ("differentiates",),
    "rts.samplers": ("concurrent",),
    "rts.shaders": ("opaque", "uniform", "takes_views", "reads"),
    "rts.splatters": ("layers", "reach", "reads", "translucent"),
}
"""Group → class variables of its base class that are reported as capabilities."""


def capabilities(group: str, plugin: Any) -> dict[str, Any]:
    """Capabilities by name: values of `VARIABLES`, and for each of `METHODS` True if the plugin overrides it.

    Empty for groups without a base class, such as "rts.commands".

    Args:
        group: such as "rts.samplers".
        plugin: the object that the entry point names.

    Raises:
        PluginError: the plugin does not subclass the group's base, and is no function as a shader.
    """
    if group not in BASES:
        return {}
    kind = plugin if isinstance(plugin, type) else type(plugin)
    bases = {c.__name__: c for c in kind.__mro__ if c.__module__.partition(".")[0] == "rts"}
    if BASES[group] not in bases:
        if group == "rts.shaders" and callable(plugin) and plugin is not kind:  # A function.
            return {name: getattr(plugin, name, None if name == "reads" else False) for name in VARIABLES[group]}
        raise PluginError(f"{plugin!r}, which is registered in {group}, does not subclass rts.{BASES[group]}")
    values: dict[str, Any] = {
        name: base in bases and overrides(plugin, method, bases[base])
        for name, (base, method) in METHODS.get(group, {}).items()
    }
    # Values that depend on settings are read off an instance with default settings.
    declared = [getattr(kind, name) for name in VARIABLES.get(group, ())]
    by_settings = any(isinstance(value, (property, functools.cached_property)) for value in declared)
    instance = kind() if by_settings and plugin is kind else plugin
    for name in VARIABLES.get(group, ()):
        values[name] = promised(instance, name) if name in PROMISES else getattr(instance, name)
    return values
