"""Layers put in order after a surface has refined its samples.

Refining moves depths: layers come out of order, two of them meet at one root, and some rays miss the surface after all.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from rts.arrays.trees import Tree
from rts.compiling.threads import parallel, read_only
from rts.contracts.records import ArraySpec, Fragments, Proxy, Samples
from rts.contracts.surface import TriangleSurface
from rts.sampling.packing import pack_fragments
from rts.sampling.sample_checks import checked_refined
from rts.scene.camera import Camera
from rts.scene.rays import Rays

SAME_ROOT_PIXELS, SAME_ROOT = 1e-2, 1e-6
"""Least difference of the depths of two roots: widths of a pixel, plus a share of the depth."""


def on_surface(
    surface: TriangleSurface,
    inputs: Tree,
    fragments: Fragments,
    proxy: Proxy,
    camera: Camera,
    layers: int,
    tables: Mapping[str, ArraySpec],
    *,
    size: tuple[int, int],
    cells: np.ndarray | None = None,
) -> Samples:
    """Samples on a surface where rays meet its nearest triangles: refined, and in order.

    Rays that meet triangles may miss the surface. Cells that are left with fewer than `layers` layers get more from
    the fragments behind these. Dropped samples keep rows in `ids` and `params` that no cell names; `repack` removes
    them.

    Args:
        surface: the surface.
        inputs: the result of its `proxy_inputs`, on the host.
        fragments: where rays meet the triangles, in `layers` layers or more.
        proxy: the triangles.
        camera: host matrices.
        layers: K.
        tables: the result of the surface's `table_specs`.
        size: (height, width) of the grid of cells.
        cells: (L, C), the cells of the samples, as flat indices in the grid, or points (L, C, 2); None for all.
    """
    first = Fragments(*(x[:layers] for x in fragments))
    moved, rays = refined(surface, inputs, pack_fragments(first, proxy), camera, tables, size, cells)
    ordered = settle(moved, camera, rays.spread)
    if len(fragments.depth) == layers:
        return ordered
    places = np.nonzero((ordered.row[-1] < 0) & (fragments.triangle_ids[layers] >= 0))
    if not len(places[0]):
        return ordered
    indices = np.ravel_multi_index(places, size) if cells is None else cells[places]
    # The cells where layers are missing, as the only line of an image.
    behind = Fragments(*(np.ascontiguousarray(x[layers:, *places])[:, None] for x in fragments))
    more, _ = refined(surface, inputs, pack_fragments(behind, proxy), camera, tables, size, indices[None])
    added = np.where(more.row >= 0, more.row + np.int32(len(ordered.ids)), -1)
    pairs = (ordered.row, added), (ordered.depth, more.depth)
    row, depth = (np.concatenate([a[:, *places], b[:, 0]])[:, None] for a, b in pairs)
    both = settle(ordered.replace(row=row, depth=depth), camera, rays.spread)
    row, depth = ordered.row, ordered.depth
    row[:, *places], depth[:, *places] = both.row[:layers, 0], both.depth[:layers, 0]
    ids, params = (np.concatenate(x) for x in ((ordered.ids, more.ids), (ordered.params, more.params)))
    overflow = np.asarray(ordered.overflow + more.overflow, np.int32)
    return ordered.replace(ids=ids, params=params, row=row, depth=depth, overflow=overflow)


def refined(
    surface: TriangleSurface,
    inputs: Tree,
    unrefined: Samples,
    camera: Camera,
    tables: Mapping[str, ArraySpec],
    size: tuple[int, ...] | None = None,
    cells: np.ndarray | None = None,
) -> tuple[Samples, Rays]:
    """Samples moved from triangles onto the surface by its `refine`, checked; and their rays.

    Args:
        surface: the surface.
        inputs: the result of its `proxy_inputs`, on the host.
        unrefined: the samples, a row for each covered cell.
        camera: host matrices.
        tables: the result of the surface's `table_specs`.
        size: (height, width) of the grid of cells; None for that of the samples.
        cells: (L, C), the cells of the samples, as flat indices in the grid, or points (L, C, 2); None for all.
    """
    by_sample = tuple(name for name, spec in tables.items() if spec.by_sample)
    allotted = {
        name: np.zeros((len(unrefined.ids) if name in by_sample else spec.shape[0], *spec.shape[1:]), spec.dtype)
        for name, spec in tables.items()
    }
    rays = rays_of(unrefined, camera, size or unrefined.row.shape[1:], cells)
    unrefined = unrefined.replace(tables=allotted, by_sample=by_sample)
    # `refine` gets a copy of `row`, so that the check sees what it has changed.
    return checked_refined(
        surface.refine(inputs, unrefined.replace(row=unrefined.row.copy()), rays), unrefined, surface
    ), rays


def rays_of(samples: Samples, camera: Camera, size: tuple[int, ...], cells: np.ndarray | None = None) -> Rays:
    """The rays (N, 3) of packed samples, of listed `cells` or points; those of rows that no cell names are undefined.

    A single row that no cell names gets the ray of the first cell.
    """
    from rts.sampling import layer_order_loops

    matrices = np.ascontiguousarray(camera.projection, np.float64), np.linalg.inv(np.asarray(camera.view, np.float64))
    ends = np.empty((len(samples.ids), 3)), np.empty((len(samples.ids), 3))
    height, width = size
    arguments = (height, width), *matrices, *ends
    if len(samples.ids) == 1:
        none = np.zeros(1, np.int64)
        layer_order_loops.rays_of_cells(np.zeros((1, 1), np.int32), none, none, *arguments)
    if cells is not None:
        lines, columns = _lines_and_columns(cells, width)
        layer_order_loops.rays_of_cells(samples.row.reshape(len(samples.row), -1), lines, columns, *arguments)
    else:
        lines = read_only(samples.row, np.int32).reshape(-1, width)
        parallel(layer_order_loops.rays_of, len(lines), lines, *arguments, work=20 * len(samples.ids))
    return Rays(*ends, camera.spread((height, width)))


def _lines_and_columns(cells: np.ndarray, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Lines and columns (M,) of listed cells (L, C) of a grid; of points (L, C, 2), as fractions of cells."""
    if cells.ndim == 3:
        x, y = cells.reshape(-1, 2).T - 0.5
        return np.ascontiguousarray(y), np.ascontiguousarray(x)
    return np.divmod(cells.reshape(-1), width)


def steps_of(camera: Camera, size: tuple[int, int]) -> Rays:
    """Changes (2, 3) of rays from a cell to the next one, along x and along y: all over a grid of cells the same."""
    from rts.sampling import layer_order_loops

    matrices = np.ascontiguousarray(camera.projection, np.float64), np.linalg.inv(np.asarray(camera.view, np.float64))
    ends, rows = (np.empty((3, 3)), np.empty((3, 3))), np.arange(3, dtype=np.int32)[None]
    layer_order_loops.rays_of_cells(rows, np.array([0, 0, 1]), np.array([0, 1, 0]), size, *matrices, *ends)
    origins, directions = (x[1:] - x[0] for x in ends)
    return Rays(origins, directions, camera.spread(size))


def settle(samples: Samples, camera: Camera, spread: np.ndarray) -> Samples:
    """The samples with the layers of each cell in order, equal roots merged and gaps closed; packed rows stay.

    Args:
        samples: the result of a surface's `refine`; rows that are −1 are no samples.
        camera: host matrices.
        spread: the `spread` of `Rays`, local units.

    Returns:
        Samples with a new `row` and `depth`; samples nearer than the near plane or beyond the far plane are dropped.
    """
    from rts.sampling import layer_order_loops

    row, depth = np.empty_like(samples.row), np.empty_like(samples.depth)
    # Depths are in the camera's units, the spread in the surface's: the view scales by this cube root.
    near, slope = SAME_ROOT_PIXELS * np.abs(np.linalg.det(camera.view[:3, :3])) ** (1 / 3) * spread
    limits = np.array([*_planes(camera), near, slope + SAME_ROOT])
    arguments = read_only(samples.row, np.int32), read_only(samples.depth, np.float32)
    parallel(layer_order_loops.settle_lines, row.shape[1], *arguments, limits, row, depth, work=10 * row.size)
    return samples.replace(row=row, depth=depth)


def _planes(camera: Camera) -> tuple[float, float]:
    """Depths of the near and the far plane, widened for rounding; infinite if the planes are oblique."""
    p = camera.projection
    if p[2, 0] or p[2, 1] or p[3, 0] or p[3, 1]:
        return -np.inf, np.inf
    near, far = (float(x) for x in camera.depth_range())
    return near - 1e-6 * abs(near), far + 1e-6 * abs(far)
