"""The camera of all benchmarks, and hard images through it, averaged over the area of each pixel."""

from __future__ import annotations

from typing import Any

import numpy as np

import rts

FOV, DISTANCE = 40.0, 3.2


def camera(eye=(0.0, 0.0, DISTANCE)) -> rts.Camera:
    """40° at distance 3.2, near 0.5, far 10."""
    return rts.Camera.look_at(eye, (0, 0, 0), fov_y=FOV, near=0.5, far=10.0)


def regular_grid(samples: int) -> np.ndarray:
    """`samples`² points (S, 2) of a pixel, from its centre, in pixels: the centres of equal cells."""
    steps = (np.arange(samples) + 0.5) / samples - 0.5
    return np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)


def supersampled(parts, view: rts.Camera, size: tuple[int, int], samples: int | np.ndarray, **options) -> np.ndarray:
    """Hard render, the mean over points of each pixel (H, W, 4); NumPy parts only.

    `samples` are the points (S, 2), x right and y down of the pixel's centre in pixels, or the side of a regular grid.
    """
    total: Any = 0.0
    points = regular_grid(samples) if isinstance(samples, int) else samples
    for dx, dy in points:
        shift = np.eye(4)
        # Moving the image by −dx pixels puts the point at +dx under the pixel's centre.
        shift[0, 3], shift[1, 3] = -2 * dx / size[1], 2 * dy / size[0]
        moved = view.replace(projection=shift @ view.projection)
        total = total + rts.render(parts, moved, size, splatter="none", layers=1, **options)
    return total / len(points)
