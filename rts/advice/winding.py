"""Closed meshes that are wound inside out: culling leaves out the side of them that would be seen."""

from __future__ import annotations

import weakref
from collections.abc import Sequence
from typing import Any

import numpy as np

from rts.advice.what_to_look_at import is_new, known_tree
from rts.arrays.engines import stopped
from rts.contracts.checked_parts import CheckedPart
from rts.contracts.surface import TriangleSurface
from rts.errors import InputWarning, warn
from rts.scene.camera import Camera

FLAT = 1e-6
"""A mesh has no inside if its volume is below this share of area ** 1.5."""

_looked_at: weakref.WeakSet[Any] = weakref.WeakSet()


def warn_of_winding(parts: Sequence[CheckedPart], camera: Camera) -> None:
    """Warn of culled parts that are wound inside out; each surface is checked once, while it is not traced.

    Surfaces whose triangles are costly or depend on the view are left out.
    """
    for index, part in enumerate(parts):
        if part.cull != "back" or not is_new(part.surface, _looked_at):
            continue
        inside_out = is_inside_out(part, camera)
        if inside_out is None:
            _looked_at.discard(part.surface)
        if inside_out:
            warn(f"part {index} {INSIDE_OUT}; give it faces[:, ::-1]", InputWarning)


INSIDE_OUT = "is closed and wound inside out: cull='back' leaves out the side that faces the viewer"


def is_inside_out(part: CheckedPart, camera: Camera) -> bool | None:
    """True if a culled part is closed, seen from outside, and its triangles face its inside; None if it is traced.

    A part seen from within, such as a room, is right with triangles that face its inside. False for parts that
    `warn_of_winding` leaves out.
    """
    surface = part.surface
    if part.cull != "back" or not isinstance(surface, TriangleSurface):
        return False
    if surface.depends_on_view or not surface.proxy_is_cheap:
        return False
    known = known_tree((surface.proxy_inputs(stopped(part.theta)), camera.within(part.transform)))
    if known is None:
        return None
    inputs, local = known
    proxy = surface.proxy(inputs, local, (1, 1))
    if not len(proxy.faces):
        return False
    low, high = (f(proxy.vertices[proxy.faces], axis=(0, 1)) for f in (np.min, np.max))
    eye = np.linalg.inv(local.view)[:3, 3]
    return not ((low < eye) & (eye < high)).all() and _encloses_less_than_nothing(proxy.vertices, proxy.faces)


def _encloses_less_than_nothing(vertices: np.ndarray, faces: np.ndarray) -> bool:
    """True if a mesh is closed and has a negative volume."""
    points = vertices.astype(np.float64)
    points -= points[faces].mean(axis=(0, 1))
    a, b, c = (points[faces[:, i]] for i in range(3))
    doubled = np.cross(b - a, c - a)
    area = np.linalg.norm(doubled, axis=1).sum() / 2
    volume = np.einsum("ij,ij->", a, np.cross(b, c)) / 6
    # The areas of a closed mesh add up to nothing, as vectors; of most others they do not.
    if not volume < -FLAT * area**1.5 or np.linalg.norm(doubled.sum(axis=0)) > 1e-3 * area:
        return False
    # Vertices in one place, as along the seam of a texture, are one.
    places, at = np.unique(vertices, axis=0, return_inverse=True)
    start = at.reshape(-1)[faces].astype(np.int64)
    end = np.roll(start, -1, axis=1)
    forward, backward = start * len(places) + end, end * len(places) + start
    return np.array_equal(np.sort(forward, axis=None), np.sort(backward, axis=None))
