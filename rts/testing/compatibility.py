"""Which surface goes with which sampler and engine: each tried on the example that the surface gives of itself."""

from __future__ import annotations

import re
import textwrap
import warnings
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from rts import registry
from rts.arrays.engines import Engine, constants, engine_named, is_constant
from rts.arrays.trees import leaves, map_leaves
from rts.contracts.checks import check_sampler, check_scene
from rts.contracts.surface import RaySurface, TriangleSurface
from rts.errors import EmptyImageWarning, InputError, RtsError
from rts.rendering.image import render
from rts.rendering.settings import RenderSettings
from rts.sampling.triangle_sampler import TriangleSampler
from rts.scene.camera import Camera
from rts.scene.parts import Part

SIZE = (14, 18)
CAMERA = Camera.look_at((0.9, 1.6, 3.2), (0, 0, 0), aspect=SIZE[1] / SIZE[0], principal_point=(0.1, -0.05))
"""Sees an example, which lies about the origin and within two units of it; nothing is symmetric."""

LAYERS = 2
APRON = RenderSettings(None, 1, 1, None).apron
CAPACITY = LAYERS * (SIZE[0] + 2 * APRON) * (SIZE[1] + 2 * APRON)
"""A row for every cell, so that engines that compile meet the same shapes again."""

DIFFERING, SHARE = 1e-3, 0.02
"""How far an image may be from the reference's, and in which share of the pixels farther."""

WIDTH = 120
"""How many characters tell an error that is not the library's."""


class Pair(NamedTuple):
    """A surface and a sampler, by name.

    Attributes:
        surface: the surface.
        sampler: the sampler; "" where the surface cannot be tried.
        problems: for each engine why it does not work, or None.
    """

    surface: str
    sampler: str
    problems: dict[str, str | None]


def example(surface: str) -> Part | None:
    """The example of a registered surface, or None where it gives none."""
    found = registry.plugin("rts.surfaces", surface)
    return found.example() if hasattr(found, "example") else None


def attempt(part: Part, sampler: Any, engine: str) -> np.ndarray:
    """The image of an example, after its gradient in θ has been taken where the engine has derivatives.

    Raises:
        RtsError: the image shows nothing, is not that of the sampler `reference` (of triangles), or a value or
            derivative is not finite; or whatever rendering raises.
    """
    chosen = engine_named(engine)
    theta = constants(map_leaves(single, part.theta), chosen, None)

    def image(theta: Any) -> Any:
        seen = part.replace(theta=theta)
        return render(seen, CAMERA, SIZE, sampler=sampler, splatter="single", layers=LAYERS, capacity=CAPACITY)

    found = np.asarray(chosen.to_numpy(image(theta)))
    if not (np.isfinite(found).all() and found.any()):
        raise RtsError("the image is empty or not finite; an example lies about the origin, within two units of it")
    if _is_of_triangles(part, sampler):
        _check_image(found, part)
    if chosen.differentiates and not is_constant(theta):
        _check_gradient(chosen, image, theta)
    return found


def _is_of_triangles(part: Part, sampler: Any) -> bool:
    """Whether a sampler can only show the part's triangles, not what it intersects."""
    surface = check_scene(part, CAMERA)[0][0].surface
    if not isinstance(surface, RaySurface):
        return isinstance(surface, TriangleSurface)
    return isinstance(check_sampler(sampler), TriangleSampler)


def _check_image(found: np.ndarray, part: Part) -> None:
    """Refuse an image that is not the one of the sampler `reference`, in NumPy."""
    part = part.replace(theta=map_leaves(single, part.theta))
    expected = render(part, CAMERA, SIZE, sampler="reference", splatter="single", layers=LAYERS, capacity=CAPACITY)
    differing = (np.abs(found - expected) > DIFFERING).any(axis=-1)
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
    """Every registered surface with every sampler, tried in every engine, one after the other.

    Args:
        only: names of surfaces, samplers and engines; of a kind that none is named of all are tried.

    Raises:
        InputError: nothing is registered by such a name.
    """
    kinds = {kind: registry.plugins(f"rts.{kind}") for kind in ("surfaces", "samplers", "engines")}
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
            found = {engine: _problem(part, sampler, engine) for engine in engines}
            own = repr(part.surface)  # The row names it already.
            yield Pair(surface, sampler, {e: p and p.replace(own, surface) for e, p in found.items()})


def _problem(part: Part, sampler: str, engine: str) -> str | None:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", EmptyImageWarning)  # It is what is asked.
            attempt(part, sampler, engine)
    except Exception as error:  # Other people's plugins may raise anything.
        return _reason(error)
    return None


def _reason(error: Exception) -> str:
    """The error in a line; of one that is not the library's, as much as tells what it is."""
    text = re.sub(r"<([\w.]+)[^<>]* at 0x[0-9a-fA-F]+>", r"\1", " ".join(str(error).split()))
    if isinstance(error, RtsError):
        return text
    return textwrap.shorten(f"{type(error).__name__}: {text}", WIDTH, placeholder=" …")
