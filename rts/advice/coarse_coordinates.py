"""Coordinates in float32 that are too large for it: map coordinates, of which it keeps no more than half a metre."""

from __future__ import annotations

import weakref
from collections.abc import Sequence
from typing import Any

import numpy as np

from rts.advice.empty_images import known_tree
from rts.arrays.engines import Context, floating_bits, is_constant, stopped
from rts.arrays.trees import Array, leaves
from rts.contracts.checked_parts import CheckedPart
from rts.contracts.records import Proxy
from rts.contracts.surface import TriangleSurface
from rts.errors import InputWarning, warn
from rts.scene.camera import Camera

LOOKED_AT = 4096
"""Triangles of a part of which a corner is looked at, evenly spaced."""

LARGE = 2.0**13
"""Numbers in which float32 is a thousandth apart: below, the triangles of a costly surface are not made to look at."""

_looked_at: weakref.WeakSet[Any] = weakref.WeakSet()


LARGEST_SIDE = 1 << 20
"""Pixels along a side of an image, above which nothing is looked at."""


def warn_of_coarse_coordinates(
    parts: Sequence[CheckedPart], camera: Camera, size: tuple[int, int], context: Context
) -> None:
    """Warn of parts whose places in the image are rounded to more than a pixel, as coordinates are float32.

    Each surface is checked once, while it is not traced; those whose triangles are costly only with numbers of `LARGE`.

    Args:
        parts: the parts.
        camera: the camera for images of `size`.
        size: (height, width).
        context: the engine that computes, in whose dtype constants are.
    """
    if max(size) > LARGEST_SIDE:
        return  # It is refused later: no memory holds such an image.
    for index, part in enumerate(parts):
        surface = part.surface
        if not isinstance(surface, TriangleSurface):
            continue
        try:
            if surface in _looked_at:
                continue
            _looked_at.add(surface)
        except TypeError:  # A surface that cannot be hashed, or referred to weakly, is not looked at.
            continue
        inputs = surface.proxy_inputs(stopped(part.theta))
        transform = np.eye(4) if part.transform is None else part.transform
        known = known_tree((inputs, transform, camera))
        if known is None:
            _looked_at.discard(surface)
            continue
        single = [
            any(_is_single(x, context) for x in leaves(inputs)),
            part.transform is not None and _is_single(transform, context),
            _is_single(camera.view, context),
        ]
        if not surface.proxy_is_cheap and _largest(known) < LARGE:
            continue
        found = _coarsest(surface, known, single, size) if any(single) else None
        if found is not None:
            what, largest, apart, pixel = found
            warn(
                f"{what.format(index)} in float32, with coordinates up to {largest:.3g}: there its numbers are "
                f"{apart:.2g} apart, and a pixel is {pixel:.2g} wide, so that image and gradient are of rounded places;"
                f" in float64, subtract an origin near the part from its vertices and from the camera's eye and target",
                InputWarning,
            )


def _largest(known: Any) -> float:
    """The largest number of inputs, transform and camera, in NumPy."""
    inputs, transform, camera = known
    arrays = [x for x in (*leaves(inputs), transform, camera.view) if np.asarray(x).dtype.kind == "f"]
    return max(float(np.abs(x).max(initial=0)) for x in arrays)


def _is_single(x: Array, context: Context) -> bool:
    """True if an array is computed with in float32, or in less.

    A constant becomes an array of the engine that differentiates, if there is one; NumPy widens the others instead.
    """
    like = context.like if context.engine.differentiates and is_constant(x) else None
    return 0 < floating_bits(x) < 64 or (like is not None and 0 < floating_bits(like) < 64)


@np.errstate(all="ignore")  # What is not finite is refused later.
def _coarsest(
    surface: TriangleSurface, known: Any, single: Sequence[bool], size: tuple[int, int]
) -> tuple[str, float, float, float] | None:
    """What is rounded to more than a pixel for most corners in view: a text with {} for the part's number.

    Also the largest coordinate, the spacing of float32 there, and the width of a pixel, both in units of the camera.

    Args:
        surface: the surface.
        known: its inputs, its transform and the camera, in NumPy.
        single: which of vertices, transform and view are float32.
        size: (height, width).
    """
    inputs, transform, camera = known
    transform, view = (np.asarray(x, np.float64) for x in (transform, camera.view))
    local = Camera(view @ transform, np.asarray(camera.projection, np.float64))
    proxy = surface.proxy(inputs, local, size)
    if not isinstance(proxy, Proxy) or not np.size(proxy.faces):
        return None
    if not np.issubdtype(np.asarray(proxy.faces).dtype, np.integer):
        return None  # It is refused later.
    corners = np.asarray(proxy.faces)[:: -(-len(proxy.faces) // LOOKED_AT)].reshape(-1)[::3]
    points = np.asarray(proxy.vertices)
    if points.shape[1:] != (3,) or not 0 <= corners.min() <= corners.max() < len(points):
        return None  # It is refused later.
    points = np.asarray(points[corners], np.float64)
    seen = points @ local.view[:3, :3].T + local.view[:3, 3]
    clip = seen @ local.projection[:, :3].T + local.projection[:, 3]
    inside = (np.abs(clip[:, :2]) <= clip[:, 3:]).all(axis=1)
    if not inside.any():
        return None
    start, growth = Camera(np.eye(4), local.projection).spread(size)
    pixel = start - growth * seen[inside, 2]
    if not (pixel > 0).all():
        return None  # A camera that makes no image is refused later.
    # Only what is beside the axis of the camera moves in the image.
    candidates = (
        ("the vertices of part {} are", points[inside], local.view),
        ("the transform of part {} is", transform[:3, 3][None], view),
        ("the camera's view, by which part {} is seen, is", view[:3, 3][None], np.eye(4)),
    )
    for (what, numbers, to_camera), coarse in zip(candidates, single, strict=True):
        apart = (np.spacing(np.abs(numbers).astype(np.float32)) @ np.abs(to_camera[:2, :3]).T).max(axis=1)
        if coarse and (apart > pixel).mean() > 0.5:
            return what, float(np.abs(numbers).max()), float(np.median(apart)), float(np.median(pixel))
    return None
