"""Settings that are compared, the plugins that they may name, and the choice of settings worth timing."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

from rts import Engine, plugin, plugins
from rts.errors import InputError, PluginError
from rts.plugin_api.checks import quoted
from rts.tool_api.plugins import engine_named
from rts_compare.pareto_front import LEVELS

FIRST = "torch"
"""The engine that measures errors where it is installed: all engines give the same ones, and it compiles nothing."""

OTHER_NAMES = ("auto", "visible")
"""Names that stand for another plugin of their group; they take part where they are given."""

ALIKE = 1.1
"""A dearer setting is worth timing if its error is smaller by more than this factor, or within one more of `LEVELS`."""


class Setting(NamedTuple):
    """One way to render a scene.

    Attributes:
        splatter: its name.
        layers: K, or "auto".
        supersample: samples along each side of a pixel.
        rate: how finely surfaces are sampled, such as "tolerance=0.4" (`Surface.rates`); "" for surfaces as given.
        sampler: its name; in settings whose errors alone are measured "", unless errors differ from the usual ones.
        engine: its name; "" in settings whose errors alone are measured.
    """

    splatter: str
    layers: int | str
    supersample: int
    rate: str = ""
    sampler: str = ""
    engine: str = ""

    @property
    def options(self) -> dict[str, Any]:
        """Keyword arguments of `rts.render`: splatter, layers, supersample, and the sampler unless it is ""."""
        found = {"splatter": self.splatter, "layers": self.layers, "supersample": self.supersample}
        return {"sampler": self.sampler, **found} if self.sampler else found


def usable(group: str, chosen: Sequence[str] | None = None) -> tuple[list[str], list[str]]:
    """Names of plugins of a group that load, each class once; and a line on each that does not, with the reason.

    Args:
        group: such as "rts.splatters".
        chosen: names; None for all but `OTHER_NAMES`.

    Raises:
        InputError: `chosen` is empty, no list, or has a name that is unknown.
        PluginError: a chosen plugin cannot be loaded.
    """
    found: dict[str, Any] = {}
    left_out = []
    if chosen is not None and (not isinstance(chosen, (list, tuple)) or not chosen):
        raise InputError(f"{group.removeprefix('rts.')} is {quoted(chosen)}; expected a list of names, or None for all")
    for name in plugins(group) if chosen is None else chosen:
        if name in OTHER_NAMES and chosen is None:
            continue
        try:
            loaded = plugin(group, name)
        except PluginError as error:
            if chosen is not None:
                raise
            left_out.append(str(error))
            continue
        if not any(loaded is other for other in found.values()):
            found[name] = loaded
    return list(found), left_out


def engines(chosen: Sequence[str] | None = None) -> tuple[list[Engine], list[str]]:
    """Engines with derivatives, that which measures errors first; and lines on those that fail or are chosen in vain.

    Args:
        chosen: names, the one that measures errors first; None for all that are installed, `FIRST` first.

    Raises:
        InputError: `chosen` is empty, no list of known names, or names no engine with derivatives.
        PluginError: a chosen engine cannot be loaded, or no engine with derivatives is installed.
    """
    names, left_out = usable("rts.engines", chosen)
    loaded = [engine_named(name) for name in names]
    found = [engine for engine in loaded if engine.differentiates]
    if chosen is not None:
        left_out += [f"engine {engine.name!r}: it has no derivatives" for engine in loaded if not engine.differentiates]
    if not found and chosen is not None:
        installed = ", ".join(engine.name for engine in engines()[0])
        raise InputError(
            f"engines is {quoted(chosen)}, without derivatives, which are compared; expected some of {installed}"
        )
    if not found:
        raise PluginError(
            "no engine with derivatives is installed, and derivatives are compared: pip install "
            "'rasterize-then-splat[torch]', or [jax]"
        )
    return sorted(found, key=lambda e: e.name != FIRST if chosen is None else names.index(e.name)), left_out


def worth_timing(errors: Mapping[Setting, float], work: Callable[[Setting], tuple[float, ...]]) -> list[Setting]:
    """The settings worth timing: all but those beside which a chosen one costs no more and is no worse, see `ALIKE`.

    Args:
        errors: setting → error.
        work: setting → its costs, several numbers; settings of lesser costs are looked at, and chosen, first.
    """
    found: list[Setting] = []
    for setting in sorted(errors, key=lambda s: (work(s), errors[s])):
        mine = work(setting)
        if not any(
            _no_worse(errors[other], errors[setting]) and all(a <= b for a, b in zip(work(other), mine, strict=True))
            for other in found
        ):
            found.append(setting)
    return found


def _no_worse(error: float, other: float) -> bool:
    """True if an error is not much larger than another, and below all of `LEVELS` that the other is below."""
    return error <= ALIKE * other and not any(other <= level < error for level in LEVELS)
