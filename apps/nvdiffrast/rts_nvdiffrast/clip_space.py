"""Clip space as the space of a camera of rts.

A perspective matrix makes z an affine function of w: z = a w + b. Then (x, −y, −w) is the space of a pinhole camera
that looks along −z, and a and b tell its near and far plane. Y is negated because row 0 of nvdiffrast's images is the
bottom. Everything else (orthographic matrices, in which w is constant, z that is made by hand) is seen after the
division: (x, −y, −z) / w in front of an orthographic camera. Triangles with a corner at w ≤ 0 are then left out, since
a plane through the eye has no place there.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch

from rts import Camera

ROUNDING = 1e-4
"""The largest deviation of z from a w + b, relative to the largest |w|."""
AWAY = 3.0
"""Distance of the orthographic camera from z/w = 0, so that depths are positive."""


class Seen(NamedTuple):
    """Vertices as a camera sees them.

    Attributes:
        vertices: (V, 3), in the space of the camera; differentiable in clip space.
        camera: the camera, at the origin.
        behind: (V,) bool, vertices whose triangles are left out; None for none.
    """

    vertices: torch.Tensor
    camera: Camera
    behind: np.ndarray | None


def seen(pos: torch.Tensor, tri: np.ndarray) -> Seen:
    """Vertices `pos` (V, 4) in clip space as a camera sees them; `tri` (T, 3) tells which of them count."""
    z, w = _used(pos, tri)
    slope = _slope(z, w)
    projection = np.eye(4)
    if slope is not None:
        projection[2:] = [0, 0, -slope[0], slope[1]], [0, 0, -1, 0]
        return Seen(torch.stack([pos[:, 0], -pos[:, 1], -pos[:, 3]], dim=1), _camera(projection), None)
    projection[2] = 0, 0, -1, -AWAY
    behind = (pos[:, 3] <= 0).detach()
    x, y, z, w = torch.where(behind[:, None], torch.ones_like(pos), pos).unbind(dim=1)
    vertices = torch.stack([x / w, -y / w, -z / w - AWAY], dim=1)
    return Seen(vertices, _camera(projection), behind.cpu().numpy() if len(w) and bool(behind.any()) else None)


def _camera(projection: np.ndarray) -> Camera:
    return Camera(np.eye(4), projection)


def _used(pos: torch.Tensor, tri: np.ndarray) -> np.ndarray:
    """Clip z and w (2, U) of the vertices that triangles name, in float64."""
    used = np.zeros(len(pos), bool)
    used[tri.reshape(-1)] = True
    return np.ascontiguousarray(pos[:, 2:].detach().cpu().numpy()[used].T, np.float64)


def _slope(z: np.ndarray, w: np.ndarray) -> tuple[float, float] | None:
    """The a and b of z = a w + b with b < 0, where depth grows with w; None if there are none."""
    if not len(w) or np.ptp(w) <= ROUNDING * np.abs(w).max():
        return None
    off = w - w.mean()
    a = float(off @ z / (off @ off))
    b = float(z.mean() - a * w.mean())
    affine = np.abs(a * w + b - z).max() <= ROUNDING * np.abs(w).max()
    return (a, b) if affine and b < 0 and a > -1 else None
