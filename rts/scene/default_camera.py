"""The bounding sphere of parts, and a camera that sees all of it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rts.arrays.array_functions import described
from rts.errors import InputError
from rts.scene.camera import Camera
from rts.scene.parts import Part

ROUGHLY = 16
"""Number of cuts along each side of a patch, for a rough mesh that shows a surface's extent."""
MARGIN = 1.05
"""Radius of the default view over the radius of the object."""

FARTHEST = 1e9
"""Distance of a camera over the radius of the object beyond which float32 cannot tell the object from a point."""


class Bounds(NamedTuple):
    """A sphere around parts, world space.

    Attributes:
        center: (3,) middle of the bounding box.
        radius: largest distance of a vertex from the centre, of a rough mesh where the surface is curved.
    """

    center: np.ndarray
    radius: float


def bounds_of(parts: Sequence[Part]) -> Bounds:
    """The bounding sphere of parts of NumPy arrays, whose surfaces can become meshes.

    Raises:
        InputError: all vertices are in one point, or a surface cannot become a mesh.
    """
    points = []
    for index, part in enumerate(parts):
        if not hasattr(part.surface, "tessellate"):
            raise InputError(f"the extent of part {index}, {part.surface!r}, is not known: it cannot become a mesh")
        vertices = np.asarray(part.surface.tessellate(part.theta, ROUGHLY)[0], np.float64)
        if vertices.shape[1:] != (3,) or not np.isfinite(vertices).all():
            raise InputError(f"the vertices of part {index}: {described(vertices)}; expected finite numbers (V, 3)")
        m = part.transform
        points.append(vertices if m is None else vertices @ m[:3, :3].T + m[:3, 3])
    everything = np.concatenate(points)
    center = (everything.min(axis=0) + everything.max(axis=0)) / 2
    radius = float(np.linalg.norm(everything - center, axis=1).max())
    if radius == 0:
        raise InputError("all vertices of the model are in one point; expected an object with an extent")
    return Bounds(center, radius)


def default_camera(parts: Sequence[Part], size: tuple[int, int]) -> Camera:
    """The default camera of commands: it sees all parts, from 30° to the right and 20° above.

    Args:
        parts: parts of NumPy arrays, whose surfaces can become meshes.
        size: (height, width) of the image.
    """
    return orbit(bounds_of(parts), size, 30, 20)


def orbit(
    bounds: Bounds,
    size: tuple[int, int],
    azimuth: float,
    elevation: float,
    distance: float | None = None,
    fov: float = 45.0,
    up: str = "y",
) -> Camera:
    """A camera on a sphere around an object, looking at its centre.

    Args:
        bounds: the sphere around the object.
        size: (height, width) of the image.
        azimuth: degrees about the upright axis; at 0 the camera is on the side of +z (−y if z is up), at 90 of +x.
        elevation: degrees above the horizon, −90 to 90.
        distance: the camera's distance from the centre; None for one from which the whole object is seen.
        fov: vertical field of view, degrees.
        up: "y" or "z", the upright axis.

    Raises:
        InputError: `up` is another axis; an angle is not finite or out of its range; the distance is not positive, or
            more than 10⁹ times the radius of the object, or less than 10⁻⁹ times.
    """
    if up not in ("y", "z"):
        raise InputError(f'up is {up!r}; expected "y" or "z"')
    if not 0 < fov < 180:
        raise InputError(f"fov is {fov}; expected degrees, more than 0 and less than 180")
    if not (math.isfinite(azimuth) and -90 <= elevation <= 90):
        raise InputError(f"azimuth is {azimuth} and elevation {elevation}; expected degrees, the second from -90 to 90")
    aspect = size[1] / size[0]
    if distance is None:
        narrower = math.atan(math.tan(math.radians(fov / 2)) * min(aspect, 1.0))
        distance = MARGIN * bounds.radius / math.sin(narrower)
    if not (math.isfinite(distance) and distance > 0):
        raise InputError(f"the camera's distance is {distance}; expected a positive number")
    if not 1 / FARTHEST < distance / bounds.radius < FARTHEST:
        raise InputError(
            f"the camera's distance is {distance:g}, and the object's radius {bounds.radius:g}; expected at most "
            f"{FARTHEST:g} times as much or as little: give another distance, or a wider field of view"
        )
    a, e = math.radians(azimuth), math.radians(elevation)
    back = np.array([math.cos(e) * math.sin(a), math.sin(e), math.cos(e) * math.cos(a)])
    # Perpendicular to `back` at every elevation, the poles included.
    upright = np.array([-math.sin(e) * math.sin(a), math.cos(e), -math.sin(e) * math.cos(a)])
    if up == "z":
        back, upright = (np.array([v[0], -v[2], v[1]]) for v in (back, upright))
    eye = bounds.center + distance * back
    return Camera.look_at(eye, bounds.center, upright, fov_y=fov, aspect=aspect, far=100 * (distance + bounds.radius))
