"""Layers put in order after a surface has refined its samples.

Refining moves depths: layers come out of order, two of them meet at one root, and some rays miss the surface after all.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from rts.camera import Camera
from rts.interfaces import TriangleSurface
from rts.records import ArraySpec, Rays, Samples
from rts.sampling.validation import checked_refined
from rts.threads import parallel, read_only
from rts.trees import Tree

SAME_ROOT_PIXELS, SAME_ROOT = 1e-2, 1e-6
"""Layers whose depths differ by less, in widths of a pixel and relative to the depth, are one root found twice."""


def refined(
    surface: TriangleSurface,
    inputs: Tree,
    lifted: Samples,
    camera: Camera,
    size: tuple[int, int],
    tables: Mapping[str, ArraySpec],
) -> tuple[Samples, Rays]:
    """What `refine` of a surface makes of samples on its triangles, checked; and their rays.

    Args:
        surface: the surface.
        inputs: what its `proxy_inputs` gave, on the host.
        lifted: the samples, a row for each covered cell.
        camera: host matrices.
        size: (height, width).
        tables: what the surface's `table_specs` allots.
    """
    by_sample = tuple(name for name, spec in tables.items() if spec.by_sample)
    allotted = {
        name: np.zeros((len(lifted.ids) if name in by_sample else spec.shape[0], *spec.shape[1:]), spec.dtype)
        for name, spec in tables.items()
    }
    lifted, rays = replace(lifted, tables=allotted, by_sample=by_sample), _rays_of(lifted, camera, size)
    # `refine` gets a copy of `row`, so that the check sees what it has changed.
    return checked_refined(surface.refine(inputs, replace(lifted, row=lifted.row.copy()), rays), lifted, surface), rays


def _rays_of(samples: Samples, camera: Camera, size: tuple[int, int]) -> Rays:
    """The ray of each packed sample (N, 3); where no cell has any, the first row gets the first pixel's."""
    from rts.sampling import settling_kernels

    matrices = np.ascontiguousarray(camera.projection, np.float64), np.linalg.inv(np.asarray(camera.view, np.float64))
    ends = np.empty((len(samples.ids), 3)), np.empty((len(samples.ids), 3))
    lines = read_only(samples.row, np.int32).reshape(-1, size[1])
    if len(samples.ids) == 1:
        first = np.full(lines.shape, -1, np.int32)
        first[0, 0] = 0
        settling_kernels.rays_of(0, 1, read_only(first), size[0], *matrices, *ends)
    parallel(settling_kernels.rays_of, len(lines), lines, size[0], *matrices, *ends, work=20 * len(samples.ids))
    return Rays(*ends, camera.spread(size))


def settle(samples: Samples, camera: Camera, spread: np.ndarray) -> Samples:
    """The samples with the layers of each cell in order, equal roots merged and gaps closed; packed rows stay.

    Args:
        samples: what a surface's `refine` gave; rows that are −1 are no samples.
        camera: host matrices.
        spread: the `spread` of `Rays`, local units.

    Returns:
        Samples with another `row` and `depth`. What lies before the near or beyond the far plane is gone.
    """
    from rts.sampling import settling_kernels

    row, depth = np.empty_like(samples.row), np.empty_like(samples.depth)
    # Depths are in the camera's units, the spread in the surface's: the view scales by this cube root.
    near, slope = SAME_ROOT_PIXELS * np.abs(np.linalg.det(camera.view[:3, :3])) ** (1 / 3) * spread
    limits = np.array([*_planes(camera), near, slope + SAME_ROOT])
    given = read_only(samples.row, np.int32), read_only(samples.depth, np.float32)
    parallel(settling_kernels.settle_lines, row.shape[1], *given, limits, row, depth, work=10 * row.size)
    return replace(samples, row=row, depth=depth)


def _planes(camera: Camera) -> tuple[float, float]:
    """Depths of the near and the far plane, a little wider for rounding; infinite where they are not straight on."""
    p = camera.projection
    if p[2, 0] or p[2, 1] or p[3, 0] or p[3, 1]:
        return -np.inf, np.inf
    near, far = (float(x) for x in camera.depth_range())
    return near - 1e-6 * abs(near), far + 1e-6 * abs(far)
