"""Coordinates that are too large for float32: map coordinates, of which it keeps no more than half a metre."""

from __future__ import annotations

import weakref
from collections.abc import Sequence
from typing import Any

import numpy as np

from rts.advice.what_to_look_at import is_new, known_tree
from rts.arrays.engines import Context, floating_bits, is_constant, stopped
from rts.arrays.trees import Array, leaves
from rts.contracts.checked_parts import CheckedPart
from rts.contracts.records import Proxy
from rts.contracts.surface import TriangleSurface
from rts.errors import InputWarning, warn
from rts.plugin_base import is_subclass
from rts.scene.camera import Camera

LOOKED_AT = 1 << 16
"""Triangles of a part of which a corner is looked at, evenly spaced."""

LARGE = 2.0**13
"""Numbers in which float32 is a thousandth apart: below, the triangles of a costly surface are not made to look at."""

FAR = 8.0
"""Vertices are far from the origin if some coordinate is so many times as large as the box of all vertices."""

EXACT = 0.1
"""The rounding, in pixels, from which vertices of float64 are warned of: samplers have them in float32, from a point
near them if they are `FAR`, and wide meshes are too large for that."""

ORIGIN = "in float64, subtract an origin near the part from its vertices and from the camera's eye and target"
"""The remedy for coordinates that are large because what is seen is far from the origin."""

_looked_at: weakref.WeakSet[Any] = weakref.WeakSet()

LARGEST_SIDE = 1 << 20
"""Pixels along a side of an image, above which nothing is looked at."""


def warn_of_coarse_coordinates(
    parts: Sequence[CheckedPart], camera: Camera, size: tuple[int, int], context: Context
) -> None:
    """Warn of parts whose places in the image are rounded to more than a pixel, as coordinates are float32, or `EXACT`.

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
        surface: Any = part.surface
        if not is_subclass(type(surface), TriangleSurface) or not is_new(surface, _looked_at):
            continue
        inputs = surface.proxy_inputs(stopped(part.theta))
        transform = np.eye(4) if part.transform is None else part.transform
        known = known_tree((inputs, transform, camera))
        if known is None:
            _looked_at.discard(surface)
            continue
        trees = inputs, part.transform, camera.view
        single = [any(_is_single(x, context) for x in leaves(tree)) for tree in trees]
        largest = max(float(np.abs(x).max(initial=0)) for x in map(np.asarray, leaves(known)) if x.dtype.kind == "f")
        text = _coarsest(surface, known, single, size) if surface.proxy_is_cheap or largest >= LARGE else None
        if text is not None:
            warn(text.format(index), InputWarning)


def _is_single(x: Array, context: Context) -> bool:
    """True if an array is computed with in float32, or in less.

    A constant becomes an array of the engine that differentiates, if there is one; NumPy widens the others instead.
    """
    like = context.like if context.engine.differentiates and is_constant(x) else None
    return 0 < floating_bits(x) < 64 or (like is not None and 0 < floating_bits(like) < 64)


@np.errstate(all="ignore")  # What is not finite is refused later.
def _coarsest(surface: TriangleSurface, known: Any, single: Sequence[bool], size: tuple[int, int]) -> str | None:
    """A warning where most corners in view are rounded too much, with {} for the part's number; None if they are not.

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
    faces = np.asarray(proxy.faces if isinstance(proxy, Proxy) else ())
    if not faces.size or not np.issubdtype(faces.dtype, np.integer):
        return None  # It is refused later.
    corners = faces[:: -(-len(faces) // LOOKED_AT)].reshape(-1)[::3]
    points = np.asarray(proxy.vertices)
    if points.shape[1:] != (3,) or not 0 <= corners.min() <= corners.max() < len(points):
        return None  # It is refused later.
    points = np.asarray(points[corners], np.float64)
    seen = points @ local.view[:3, :3].T + local.view[:3, 3]
    clip = seen @ local.projection[:, :3].T + local.projection[:, 3]
    inside = (np.abs(clip[:, :2]) <= clip[:, 3:]).all(axis=1)
    start, growth = Camera(np.eye(4), local.projection).spread(size)
    pixel = start - growth * seen[inside, 2]
    if not inside.any() or not (pixel > 0).all():
        return None  # A camera that makes no image is refused later.
    of_vertices = "the vertices of part {} are", ORIGIN, points[inside], local.view, 1.0
    if not single[0] and np.asarray(proxy.vertices).dtype == np.float64:
        low, high = points.min(0), points.max(0)
        middle = (np.abs(points).max() > FAR * (high - low).max()) * (low + high) / 2
        text = "the vertices of part {}, of float64, are sampled"
        of_vertices = text, "cut it into several parts", points[inside] - middle, local.view, EXACT
    # Only what is beside the axis of the camera moves in the image.
    candidates = (
        of_vertices,
        ("the transform of part {} is", ORIGIN, transform[:3, 3][None], view, 1.0),
        ("the camera's view, by which part {} is seen, is", ORIGIN, view[:3, 3][None], np.eye(4), 1.0),
    )
    for (what, remedy, numbers, to_camera, most), coarse in zip(candidates, (True, *single[1:]), strict=True):
        apart = (np.spacing(np.abs(numbers).astype(np.float32)) @ np.abs(to_camera[:2, :3]).T).max(axis=1)
        if coarse and (apart > most * pixel).mean() > 0.5:
            return (
                f"{what} in float32, with coordinates up to {np.abs(numbers).max():.3g}: there its numbers are "
                f"{np.median(apart):.2g} apart, and a pixel is {np.median(pixel):.2g} wide, so that image and gradient "
                f"are of rounded places; {remedy}"
            )
    return None
