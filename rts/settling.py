"""Layers put in order after a surface has refined its samples, compiled.

Refining moves depths: layers come out of order, two of them meet at one root, and some rays miss the surface after all.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numba
import numpy as np

from rts.camera import Camera
from rts.errors import InputError
from rts.interfaces import TriangleSurface
from rts.records import ArraySpec, Rays, Samples
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
        inputs: of its proxy, on the host.
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
    # A copy of the rows, which tells what has been written to them.
    return _checked(surface.refine(inputs, replace(lifted, row=lifted.row.copy()), rays), lifted, surface), rays


def _rays_of(samples: Samples, camera: Camera, size: tuple[int, int]) -> Rays:
    """The ray of each packed sample (N, 3); samples that no cell refers to get the first pixel's."""
    rays = camera.rays(size)
    pixel = np.zeros(len(samples.ids), np.int64)
    flat = samples.row.reshape(-1)
    cells = np.flatnonzero(flat >= 0)
    pixel[flat[cells]] = cells % (size[0] * size[1])
    return rays._replace(origins=rays.origins.reshape(-1, 3)[pixel], directions=rays.directions.reshape(-1, 3)[pixel])


def settle(samples: Samples, camera: Camera, spread: np.ndarray) -> Samples:
    """The samples with the layers of each cell in order, equal roots merged and gaps closed; packed rows stay.

    Args:
        samples: what a surface's `refine` gave; rows that are −1 are no samples.
        camera: host matrices.
        spread: of `Rays`, local units.

    Returns:
        Samples with another `row` and `depth`. What lies before the near or beyond the far plane is gone.
    """
    row, depth = np.empty_like(samples.row), np.empty_like(samples.depth)
    # Depths are the camera's; of the view's units there are so many in one of the surface's.
    near, slope = SAME_ROOT_PIXELS * np.abs(np.linalg.det(camera.view[:3, :3])) ** (1 / 3) * spread
    limits = np.array([*_planes(camera), near, slope + SAME_ROOT])
    given = read_only(samples.row, np.int32), read_only(samples.depth, np.float32)
    parallel(_settle, row.shape[1], *given, limits, row, depth, work=10 * row.size)
    return replace(samples, row=row, depth=depth)


def repack(samples: Samples, kept: np.ndarray, capacity: int | None) -> Samples:
    """Those samples whose cells are kept (K, H, W), numbered layer by layer, in as many rows as there are.

    Args:
        samples: on the host.
        kept: bool, covered cells.
        capacity: rows to allot, zeros where they are not used; None for as many as are kept, at least one.
    """
    index = samples.row[kept]
    rows = max(1, len(index)) if capacity is None else capacity
    number = np.full(samples.row.shape, -1, np.int32)
    number[kept] = np.where(np.arange(len(index)) < rows, np.arange(len(index)), -1)
    index, overflow = index[:rows], np.asarray(samples.overflow + max(0, len(index) - rows), np.int32)

    def packed(x: np.ndarray) -> np.ndarray:
        found = np.zeros((rows, *x.shape[1:]), x.dtype)
        found[: len(index)] = x[index]
        return found

    return replace(
        samples,
        ids=packed(samples.ids),
        params=packed(samples.params),
        row=number,
        depth=np.where(number >= 0, samples.depth, np.float32(0)),
        overflow=overflow,
        tables={name: packed(x) if name in samples.by_sample else x for name, x in samples.tables.items()},
    )


def _checked(found: Any, given: Samples, surface: TriangleSurface) -> Samples:
    """What `refine` of a surface gave, with arrays of the right dtypes; refused where it breaks its contract."""
    who = f"refine of {surface!r}"
    if not isinstance(found, Samples):
        raise InputError(f"{who} gave a {type(found).__name__}; expected rts.Samples")
    rows, grid, (i, p) = len(given.ids), given.row.shape, surface.sample_widths
    ids = _array(f"{who} gave ids", found.ids, (rows, i), np.integer, np.int32)
    params = _array(f"{who} gave params", found.params, (rows, p), np.floating, np.float32)
    row = _array(f"{who} gave row", found.row, grid, np.integer, np.int32)
    depth = _array(f"{who} gave depth", found.depth, grid, np.floating, np.float32)
    overflow = _array(f"{who} gave overflow", found.overflow, (), np.integer, np.int32)
    if ((row != given.row) & (row != -1)).any():
        raise InputError(f"{who} gave another number to a row; expected what it was given, or −1 to drop a sample")
    if overflow < given.overflow:
        raise InputError(f"{who} gave an overflow of {overflow}; expected at least the {given.overflow} it was given")
    covered = row >= 0
    bad = covered & ~np.isfinite(depth)
    if bad.any():
        raise InputError(f"{who} gave {bad.sum()} depths that are not finite; set their rows to −1 where a ray misses")
    used = params[row[covered]]
    if not np.isfinite(used).all():
        count = (~np.isfinite(used).all(axis=1)).sum()
        raise InputError(f"{who} gave {count} samples whose params are not finite; set their rows to −1")
    tables = _checked_tables(found.tables, given, who)
    return replace(given, ids=ids, params=params, row=row, depth=depth, overflow=overflow, tables=tables)


def _array(what: str, value: Any, shape: tuple[int, ...], kind: type, dtype: Any) -> np.ndarray:
    """A value as an array of a dtype, refused where it has another shape, or is of another kind."""
    try:
        array = np.asarray(value)
    except (TypeError, ValueError) as error:
        raise InputError(f"{what} that is no array ({error}); expected shape {shape}") from error
    if array.shape != shape or not np.issubdtype(array.dtype, kind):
        raise InputError(
            f"{what} of shape {array.shape} and dtype {array.dtype}; expected {shape} of {np.dtype(dtype)}"
        )
    with np.errstate(over="ignore"):  # Infinite then, which is refused where it is used.
        return np.ascontiguousarray(array, dtype) if array.ndim else array.astype(dtype)


def _checked_tables(found: Any, given: Samples, who: str) -> dict[str, np.ndarray]:
    """Tables that fit into those that were allotted."""
    if set(found) != set(given.tables):
        raise InputError(f"{who} gave the tables {sorted(found)}; table_specs declares {sorted(given.tables)}")
    tables = {}
    for name, allotted in given.tables.items():
        table = np.asarray(found[name], allotted.dtype)
        if name in given.by_sample and len(table) != len(given.ids):
            raise InputError(
                f"{who} gave a table {name!r} of {len(table)} rows; expected {len(given.ids)}, one a sample"
            )
        if table.shape[1:] != allotted.shape[1:] or len(table) > len(allotted):
            raise InputError(
                f"{who} gave a table {name!r} of shape {table.shape}, where table_specs allots {allotted.shape}; drop "
                f"the samples that do not fit and add their number to overflow"
            )
        tables[name] = table
    return tables


def _planes(camera: Camera) -> tuple[float, float]:
    """Depths of the near and the far plane, a little wider for rounding; infinite where they are not straight on."""
    p = camera.projection
    if p[2, 0] or p[2, 1] or p[3, 0] or p[3, 1]:
        return -np.inf, np.inf
    near, far = (float(x) for x in camera.depth_range())
    return near - 1e-6 * abs(near), far + 1e-6 * abs(far)


@numba.njit(cache=True, nogil=True)
def _settle(start, stop, row, depth, limits, out_row, out_depth):
    layers, _, width = row.shape
    near, far, apart, apart_by_depth = limits
    for y in range(start, stop):
        for x in range(width):
            count = 0
            for k in range(layers):
                i, z = row[k, y, x], depth[k, y, x]
                if i < 0 or z < near or z > far:
                    continue
                at = count
                while at > 0 and out_depth[at - 1, y, x] > z:
                    out_depth[at, y, x], out_row[at, y, x] = out_depth[at - 1, y, x], out_row[at - 1, y, x]
                    at -= 1
                out_depth[at, y, x], out_row[at, y, x] = z, i
                count += 1
            kept = 0
            for k in range(count):
                z = out_depth[k, y, x]
                if kept == 0 or z - out_depth[kept - 1, y, x] > apart + apart_by_depth * abs(z):
                    out_depth[kept, y, x], out_row[kept, y, x] = z, out_row[k, y, x]
                    kept += 1
            for k in range(kept, layers):
                out_depth[k, y, x], out_row[k, y, x] = 0, -1
