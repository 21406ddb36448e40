"""Plugins as tools see them: listed, found by name, checked, asked for promises; engines that are not registered."""

from rts.arrays.engines import engine_named, owning
from rts.contracts.checks import check_sampler, check_shader, check_splatter
from rts.plugin_base import promised
from rts.registry import distributions_of, survey

__all__ = [
    "check_sampler",
    "check_shader",
    "check_splatter",
    "distributions_of",
    "engine_named",
    "owning",
    "promised",
    "survey",
]
