"""Plugins by (group, name), found through the entry points of installed distributions.

Groups: rts.surfaces, rts.samplers, rts.shaders, rts.splatters, rts.engines; rts.commands, the subcommands of `rts`;
and rts.functions, of which the library's own are attributes of `rts`. The library registers its own plugins in its
`pyproject.toml`, in the same way as anyone's. Only plugins that are asked for are imported.

A distribution whose entry points cannot be read is passed over, with a warning. So is a claim of another distribution
on a name that the library's own registers.
"""

from __future__ import annotations

import difflib
import inspect
import re
from collections.abc import Iterable, Mapping
from importlib.metadata import Distribution, EntryPoint, PackageNotFoundError, distribution, distributions
from typing import Any, Literal, NamedTuple, overload

from rts.capabilities import capabilities
from rts.errors import InputError, PluginError, RtsWarning, warn

GROUPS = (
    "rts.surfaces",
    "rts.samplers",
    "rts.shaders",
    "rts.splatters",
    "rts.engines",
    "rts.commands",
    "rts.functions",
)

OWN = "rasterize-then-splat"
"""The library's own distribution."""


class PluginInfo(NamedTuple):
    """One plugin: a line of `rts plugins`, and an item of `rts.plugins(group, details=True)`.

    Attributes:
        group: the entry-point group.
        name: the plugin's name.
        distribution: name and version of the distribution that registers it.
        error: the reason why the plugin does not load, or None.
        missing: packages that the extra of the plugin's name requires and that are not installed. A plugin may be
            ready without them, with fewer features.
        install: the requirement that brings the missing packages, such as "rasterize-then-splat[torch]". None if no
            package is missing.
        capabilities: the plugin's capabilities by name, see `rts.capabilities`. Empty if it does not load.
    """

    group: str
    name: str
    distribution: str
    error: str | None
    missing: tuple[str, ...] = ()
    install: str | None = None
    capabilities: Mapping[str, Any] = {}

    @property
    def ready(self) -> bool:
        """True if the plugin loads."""
        return self.error is None


_entry_points: dict[str, dict[str, list[EntryPoint]]] = {}
_defaults: dict[tuple[str, str | type], Any] = {}


def _entries(group: str) -> dict[str, list[EntryPoint]]:
    if group not in _entry_points:
        found, problems = _read()
        problems += _keep_own(found)
        _entry_points.update(found)
        for problem in problems:
            warn(problem, RtsWarning)
    return _entry_points[group]


def _read() -> tuple[dict[str, dict[str, list[EntryPoint]]], list[str]]:
    """Entry points by group and name, and a line for each distribution that is passed over."""
    found: dict[str, dict[str, list[EntryPoint]]] = {group: {} for group in GROUPS}
    seen, problems = set(), []
    for each in distributions():
        try:
            entries = [entry for entry in each.entry_points if entry.group in found]
            name = re.sub(r"[-_.]+", "-", each.name).lower() if entries else None  # To read all names would take long.
        except Exception as error:  # Its files are damaged, and each kind of damage has an error of its own.
            problems.append(f"{_described(each)} is broken, and passed over; reinstall it ({_reason(error)})")
            continue
        if name in seen:  # An older version, which Python would not import.
            continue
        for entry in entries:
            seen.add(name)
            found[entry.group].setdefault(entry.name, []).append(entry)
    return found, problems


def _keep_own(found: dict[str, dict[str, list[EntryPoint]]]) -> list[str]:
    """Drop others' claims on names of the library's own distribution. Returns a line for each such name."""
    problems = []
    for group, claims in found.items():
        for name, entries in claims.items():
            own_entries = [entry for entry in entries if _is_own(entry)] if len(entries) > 1 else []
            if own_entries:
                others = " and ".join(sorted(_distribution(entry) for entry in entries if not _is_own(entry)))
                problems.append(f"the {_kind(group)} {name!r} is the library's; the claim of {others} is passed over")
                claims[name] = own_entries
    return problems


def _described(broken: Distribution) -> str:
    """The name of a distribution, some of whose files may be damaged, and its folder."""
    try:
        name = broken.name
    except Exception:
        name = None
    return f"the distribution {name or 'without a name'} in {broken.locate_file('')}"


def _reason(error: BaseException) -> str:
    """An error in a line."""
    return ": ".join(filter(None, (type(error).__name__, " ".join(str(error).split()))))


def _is_own(entry: EntryPoint) -> bool:
    return entry.dist is not None and entry.dist.name == OWN


def load_own(group: str, name: str) -> Any:
    """The object that the library's own distribution registers under a name in a group that holds no plugins.

    Args:
        group: such as "rts.testing".
        name: such as "SurfaceConformance".

    Raises:
        PluginError: the distribution was installed before it registered the name.
    """
    found = distribution(OWN).entry_points.select(group=group, name=name)
    if not found:
        raise PluginError(f"{group} has no entry point {name!r}; install {OWN} again (pip install .)")
    return found[name].load()


def _kind(group: str) -> str:
    return group.removeprefix("rts.").removesuffix("s")


def _group(group: str) -> str:
    if not isinstance(group, str):
        raise InputError(f"the group of plugins is a {type(group).__name__}; expected one of {', '.join(GROUPS)}")
    full = group if group.startswith("rts.") else f"rts.{group}"
    if full not in GROUPS:
        raise InputError(f"no plugin group {group!r}; expected one of {', '.join(GROUPS)}{_suggest(full, GROUPS)}")
    return full


def _suggest(name: str, names: Any) -> str:
    close = difflib.get_close_matches(name, list(names), n=1)
    return f"; did you mean {close[0]!r}?" if close else ""


def _distribution(entry: EntryPoint) -> str:
    return f"{entry.dist.name} {entry.dist.version}" if entry.dist else "an unknown distribution"


@overload
def plugins(group: str, *, details: Literal[False] = ...) -> list[str]: ...


@overload
def plugins(group: str, *, details: Literal[True]) -> list[PluginInfo]: ...


def plugins(group: str, *, details: bool = False) -> list[str] | list[PluginInfo]:
    """The names of the plugins registered in a group, sorted.

    Args:
        group: such as "rts.samplers" (or "samplers").
        details: whether to return a `PluginInfo` in place of each name, with distribution, state and capabilities.
            This imports every plugin of the group.

    Raises:
        InputError: no such group, or `details` is no bool.
    """
    group = _group(group)
    if not isinstance(details, bool):
        raise InputError(f"details is a {type(details).__name__}; expected True or False")
    return [_details(group, name) for name in sorted(_entries(group))] if details else sorted(_entries(group))


def _entry(group: str, name: str) -> EntryPoint:
    if name not in _entries(group):
        _entry_points.clear()  # A distribution may have been installed since the last look.
    claims = _entries(group).get(name)
    if not claims:
        names = plugins(group)
        hint = "; is its distribution installed, and was it again after its entry points changed (pip install .)?"
        hint = _suggest(name, names) or hint
        raise InputError(f"no {_kind(group)} named {name!r}; there are {', '.join(names)}{hint}")
    if len(claims) > 1:
        raise PluginError(
            f"the {_kind(group)} {name!r} is claimed by {distributions_of(group, name)}; uninstall one of them"
        )
    return claims[0]


def distributions_of(group: str, name: str) -> str:
    """Names and versions of the distributions that register a plugin, without importing it.

    Args:
        group: such as "rts.commands", in full.
        name: one of `plugins(group)`.
    """
    return " and ".join(sorted(map(_distribution, _entries(group)[name])))


def check_name(group: str, name: str) -> None:
    """Refuse a name that no plugin of a group has, or several have, without importing any.

    Args:
        group: such as "rts.shaders", in full.
        name: the name.

    Raises:
        InputError: no plugin has the name.
        PluginError: several distributions claim it.
    """
    if len(_entries(group).get(name, ())) != 1:
        _entry(group, name)


def plugin(group: str, name: str) -> Any:
    """Load one plugin: the object that its entry point names, usually a class.

    Args:
        group: such as "rts.samplers" (or "samplers").
        name: such as "raster".

    Raises:
        InputError: no such group or name.
        PluginError: two distributions claim the name, or it cannot be imported.
    """
    group = _group(group)
    if not isinstance(name, str):
        raise InputError(
            f"the name of a plugin is a {type(name).__name__}; expected one of {', '.join(plugins(group))}"
        )
    entry, kind = _entry(group, name), _kind(group)
    try:
        return entry.load()
    except ModuleNotFoundError as error:
        if entry.dist and name in (entry.dist.metadata.get_all("Provides-Extra") or []):
            command = f"pip install '{entry.dist.name}[{name}]'"
            raise PluginError(f"the {kind} {name!r} needs the package {error.name!r}: {command}") from error
        raise PluginError(
            f"the {kind} {name!r} of {_distribution(entry)} needs the module {error.name!r}, which is not installed"
        ) from error
    except (PluginError, KeyboardInterrupt):
        raise
    except BaseException as error:  # SystemExit, and panics of compiled code, would end the program.
        raise PluginError(f"the {kind} {name!r} of {_distribution(entry)} fails to import: {_reason(error)}") from error


def built_in_attributes() -> dict[str, tuple[str, str]]:
    """Attribute of `rts` → group and name of a surface or function that the library's own distribution registers.

    Such as "Mesh" → ("rts.surfaces", "mesh"), and "tune" → ("rts.functions", "tune").
    """
    return {
        entry.attr: (group, name)
        for group in ("rts.surfaces", "rts.functions")
        for name, entries in _entries(group).items()
        for entry in entries
        if _is_own(entry)
    }


def attribute(name: str, known: Iterable[str]) -> Any:
    """The built-in surface or function that is an attribute of `rts`, such as `rts.Mesh` or `rts.tune`.

    Args:
        name: the attribute's name.
        known: `rts.__all__`; other names in lower case are refused, and errors suggest the nearest.

    Raises:
        AttributeError: `rts` has no such attribute, or it cannot be imported.
    """
    # Python also asks for submodules, in lower case; for their sake entry points need not be read.
    found = built_in_attributes() if name[:1].isupper() or name in known else {}
    if name not in found:
        raise AttributeError(f"module 'rts' has no attribute {name!r}{_suggest(name, [*known, *found])}")
    try:
        return plugin(*found[name])
    except PluginError as error:
        raise AttributeError(f"rts.{name} cannot be loaded: {error}") from error


def instance(group: str, value: Any) -> Any:
    """A usable plugin from a name, a class or a ready object.

    A name or a class gives one instance with default settings, shared by all calls. An object is returned as it is; so
    is the object that a name stands for if it is no class, such as a function.

    Raises:
        InputError: no such group or name.
        PluginError: the plugin cannot be loaded.
    """
    if not isinstance(value, (str, type)):
        return value
    if (group, value) not in _defaults:
        loaded = plugin(group, value) if isinstance(value, str) else _made(group, value)
        _defaults[group, value] = instance(group, loaded)
    return _defaults[group, value]


def _made(group: str, kind: type) -> Any:
    """An instance of a plugin's class with default settings."""
    try:
        inspect.signature(kind).bind()
    except TypeError as error:
        raise PluginError(
            f"the {_kind(group)} {kind.__qualname__} cannot be made without arguments ({error}); give each a default, "
            "or pass an instance in place of its name"
        ) from None
    except ValueError:  # A class of C has no signature.
        pass
    return kind()


def name_of(group: str, value: Any) -> str:
    """The name under which `instance` made a plugin, such as "raster"; the name of its class for any other object."""
    names = (name for (of_group, name), made in _defaults.items() if of_group == group and made is value)
    return next((name for name in names if isinstance(name, str)), type(value).__qualname__)


def survey() -> list[PluginInfo]:
    """The details of every registered plugin, in order of group and name."""
    return [info for group in GROUPS for info in plugins(group, details=True)]


def _details(group: str, name: str) -> PluginInfo:
    entries, able, error = _entries(group)[name], {}, None
    try:
        able = capabilities(group, plugin(group, name))
    except PluginError as problem:
        error = str(problem)
    missing = _missing(entries[0])
    install = f"{entries[0].dist.name}[{name}]" if missing and entries[0].dist else None
    return PluginInfo(group, name, distributions_of(group, name), error, missing, install, able)


def _missing(entry: EntryPoint) -> tuple[str, ...]:
    """Packages that the extra of the plugin's name requires, and that are not installed."""
    missing = []
    for requirement in (entry.dist.requires if entry.dist else None) or ():
        wanted, _, marker = requirement.partition(";")
        if re.search(rf"""extra\s*==\s*["']{re.escape(entry.name)}["']""", marker):
            package = re.split(r"[^\w.-]", wanted.strip(), maxsplit=1)[0]
            try:
                distribution(package)
            except PackageNotFoundError:
                missing.append(package)
    return tuple(missing)
