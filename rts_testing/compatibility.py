"""Compatibility of surfaces with samplers and engines, tried on the example of each surface."""

from __future__ import annotations

import re
import textwrap
import warnings
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from rts import Camera, Engine, Part, RaySurface, Surface, TriangleSampler, TriangleSurface, plugin, plugins, render
from rts.errors import EmptyImageWarning, InputError, RtsError
from rts.plugin_api.arrays import constants, leaves, map_leaves
from rts.tool_api.plugins import check_sampler, engine_named
from rts.tool_api.scenes import BORDER, check_scene

SIZE = (14, 18)
CAMERA = Camera.look_at((0.9, 1.6, 3.2), (0, 0, 0), aspect=SIZE[1] / SIZE[0], principal_point=(0.1, -0.05))
"""A view of an example, which lies about the origin, within two units of it. The view has no symmetry."""

LAYERS = 2
CAPACITY = LAYERS * (SIZE[0] + 2 * BORDER) * (SIZE[1] + 2 * BORDER)
"""A row of samples for every cell, so that all calls have the same shapes, and engines compile once."""

DIFFERING, SHARE = 1e-3, 0.02
"""The largest difference of a pixel from the reference's, and the share of pixels that may differ by more."""

WIDTH = 120
"""Characters shown of an error that is not the library's."""


class Pair(NamedTuple):
    """A surface and a sampler, by name.

    Attributes:
        surface: the surface.
        sampler: the sampler; "" if the surface cannot be tried.
        problems: for each engine the problem, or None.
    """

    surface: str
    sampler: str
    problems: dict[str, str | None]


def example(surface: str) -> Part | None:
    """The example of a registered surface; None if it has none."""
    kind = plugin("rts.surfaces", surface)
    return kind.example() if isinstance(kind, type) and issubclass(kind, Surface) else None


def attempt(part: Part, sampler: Any, engine: str) -> np.ndarray:
    """The image of an example; if the engine differentiates, the gradient in θ is checked, too.

    Raises:
        RtsError: the image is empty or not finite; one of triangles is not that of the sampler `reference`; or the
            gradient is zero or not finite. Errors of rendering pass through.
    """
    wanted = engine_named(engine)
    theta = constants(map_leaves(single, part.theta), wanted, None)

    def image(theta: Any) -> Any:
        seen = part.replace(theta=theta)
        return render(seen, CAMERA, SIZE, sampler=sampler, splatter="single", layers=LAYERS, capacity=CAPACITY)

    shown = np.asarray(wanted.to_numpy(image(theta)))
    if not (np.isfinite(shown).all() and shown.any()):
        raise RtsError("the image is empty or not finite; an example lies about the origin, within two units of it")
    if _is_of_triangles(part, sampler):
        _check_image(shown, part)
    if wanted.differentiates and list(leaves(theta)):
        _check_gradient(wanted, image, theta)
    return shown


def _is_of_triangles(part: Part, sampler: Any) -> bool:
    """True if a sampler shows the part's triangles, not the hits of the surface's own `intersect`."""
    surface = check_scene(part, CAMERA)[0][0].surface
    if not isinstance(surface, RaySurface):
        return isinstance(surface, TriangleSurface)
    return isinstance(check_sampler(sampler), TriangleSampler)


def _check_image(actual: np.ndarray, part: Part) -> None:
    """Refuse an image with more than `SHARE` of its pixels off those of the sampler `reference`, in NumPy."""
    part = part.replace(theta=map_leaves(single, part.theta))
    expected = render(part, CAMERA, SIZE, sampler="reference", splatter="single", layers=LAYERS, capacity=CAPACITY)
    differing = (np.abs(actual - expected) > DIFFERING).any(axis=-1)
    if differing.mean() > SHARE:
        raise RtsError(
            f"{differing.sum()} of the {differing.size} pixels are not those of the sampler 'reference', by more than "
            f"{DIFFERING:g}"
        )


def _check_gradient(engine: Engine, image: Any, theta: Any) -> None:
    """Refuse a gradient that is zero everywhere, or not finite."""
    xp = engine.namespace
    floating = [x for x in leaves(theta) if xp.isdtype(x.dtype, "real floating")]

    def total(values: list) -> Any:
        it = iter(values)
        moved = map_leaves(lambda x: next(it) if xp.isdtype(x.dtype, "real floating") else x, theta)
        return xp.sum(image(moved) ** 2)

    gradient = [engine.to_numpy(g) for g in engine.value_and_grad(total)(floating)[1]]
    if not all(np.isfinite(g).all() for g in gradient):
        raise RtsError("the gradient in theta is not finite")
    if not any(g.any() for g in gradient):
        raise RtsError("the gradient in theta is zero everywhere")


def single(x: Any) -> np.ndarray:
    """An array of floats as float32; anything else as it is."""
    x = np.asarray(x)
    return x.astype(np.float32) if np.issubdtype(x.dtype, np.floating) else x


def pairs(only: Sequence[str] = ()) -> Iterator[Pair]:
    """Try every registered surface with every sampler, in every engine.

    Args:
        only: names of surfaces, samplers and engines to try; all of a kind if none of it is named.

    Raises:
        InputError: a name is not registered.
    """
    kinds = {kind: plugins(f"rts.{kind}") for kind in ("surfaces", "samplers", "engines")}
    known = {name for names in kinds.values() for name in names}
    if unknown := [name for name in only if name not in known]:
        raise InputError(f"there is no surface, sampler or engine {unknown[0]!r}; expected {', '.join(sorted(known))}")
    return _tried(*([n for n in names if n in only] or names for names in kinds.values()))


def _tried(surfaces: Sequence[str], samplers: Sequence[str], engines: Sequence[str]) -> Iterator[Pair]:
    for surface in surfaces:
        part, problem = None, "no example"
        try:
            part = example(surface)
        except Exception as error:
            problem = _reason(error)
        if part is None:
            yield Pair(surface, "", dict.fromkeys(engines, problem))
            continue
        for sampler in samplers:
            problems = {engine: _problem(part, sampler, engine) for engine in engines}
            surface_name = repr(part.surface)  # The row names it already.
            yield Pair(surface, sampler, {e: p and p.replace(surface_name, surface) for e, p in problems.items()})


def _problem(part: Part, sampler: str, engine: str) -> str | None:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", EmptyImageWarning)  # Empty images are reported below.
            attempt(part, sampler, engine)
    except Exception as error:  # Other people's plugins may raise anything.
        return _reason(error)
    return None


def _reason(error: Exception) -> str:
    """The error in one line; one that is not the library's is cut short."""
    text = re.sub(r"<([\w.]+)[^<>]* at 0x[0-9a-fA-F]+>", r"\1", " ".join(str(error).split()))
    if isinstance(error, RtsError):
        return text
    return textwrap.shorten(f"{type(error).__name__}: {text}", WIDTH, placeholder=" …")
