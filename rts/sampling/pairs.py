"""Pairs of samples that tell how outlines of fields move which are sampled by triangles."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from rts.arrays.trees import Tree
from rts.contracts.records import ArraySpec, Samples
from rts.contracts.surface import TriangleSurface
from rts.sampling.layer_order import rays_of, steps_of
from rts.scene.camera import Camera
from rts.scene.rays import Rays

NEIGHBOURS = np.array([(u, v) for v in (-1, 0, 1) for u in (-1, 0, 1) if (u, v) != (0, 0)])
"""Steps (x, y) from a cell to those around it, line by line."""


def with_pairs(
    samples: Samples,
    surface: TriangleSurface,
    inputs: Tree,
    camera: Camera,
    size: tuple[int, int],
    points: np.ndarray,
    specs: Mapping[str, ArraySpec],
) -> Samples:
    """Samples with `Samples.pair`, and further rows for the pairs of a surface's `refine_outlines`.

    There are no pairs if its tables exceed their specs.

    Args:
        samples: refined samples of points, on the host.
        surface: the surface.
        inputs: the result of its `proxy_inputs`, on the host.
        camera: host matrices.
        size: (height, width) of the grid of cells.
        points: (1, M, 2).
        specs: the result of the surface's `table_specs`.
    """
    row, count = samples.row[0, 0], len(samples.ids)
    seen, pair = np.flatnonzero(row >= 0), np.full((2, len(row)), -1, np.int32)
    if not len(seen):
        return samples.replace(pair=pair)
    rays, steps = rays_of(samples, camera, size, points), steps_of(camera, size)
    pair_rays = Rays(rays.origins[row[seen]], rays.directions[row[seen]], rays.spread)
    changed = [x[:, None] + NEIGHBOURS @ step for x, step in zip(pair_rays[:2], steps[:2], strict=True)]
    beside = Rays(changed[0], changed[1], rays.spread)
    result = surface.refine_outlines(inputs, pair_rays, beside, samples.depth[0, 0, seen], samples.tables)
    if result is None or any(len(x) > specs[name].shape[0] for name, x in result[3].items()):
        return samples.replace(pair=pair)
    ids, params, there, tables = result
    more = 2 * np.count_nonzero(there)
    pair[:, seen[there]] = np.arange(count, count + more, dtype=np.int32).reshape(-1, 2).T
    ids, params = (x[there].reshape(more, x.shape[2]) for x in (ids, params))
    both = np.concatenate([samples.ids, ids]), np.concatenate([samples.params, params])
    return samples.replace(ids=both[0], params=both[1], tables=tables, pair=pair)
