"""Layers put in order after a surface has refined its samples, compiled.

Refining moves depths: layers come out of order, two of them meet at one root, and some rays miss the surface after all.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from rts.camera import Camera
from rts.errors import InputError
from rts.records import Samples
from rts.threads import parallel, read_only

SAME_ROOT_PIXELS, SAME_ROOT = 1e-2, 1e-6
"""Layers whose depths differ by less, in widths of a pixel and relative to the depth, are one root found twice."""


def settle(samples: Samples, camera: Camera, spread: np.ndarray) -> Samples:
    """The samples with the layers of each cell in order, equal roots merged and gaps closed; packed rows stay.

    Args:
        samples: what a surface's `refine` gave; rows that are −1 are no samples.
        camera: host matrices.
        spread: of `Rays`.

    Returns:
        Samples with another `row` and `depth`. What lies before the near or beyond the far plane is gone.
    """
    row, depth = np.empty_like(samples.row), np.empty_like(samples.depth)
    limits = np.array([*_planes(camera), SAME_ROOT_PIXELS * spread[0], SAME_ROOT_PIXELS * spread[1] + SAME_ROOT])
    given = read_only(samples.row, np.int32), read_only(samples.depth, np.float32)
    parallel(_settle, row.shape[1], *given, limits, row, depth, work=10 * row.size)
    return Samples(samples.ids, samples.params, row, depth, samples.overflow, samples.tables)


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
    ids, params = (np.zeros((rows, x.shape[1]), x.dtype) for x in (samples.ids, samples.params))
    ids[: len(index)], params[: len(index)] = samples.ids[index[:rows]], samples.params[index[:rows]]
    depth = np.where(number >= 0, samples.depth, np.float32(0))
    overflow = np.asarray(samples.overflow + max(0, len(index) - rows), np.int32)
    return Samples(ids, params, number, depth, overflow, samples.tables)


def check_refined(found: Any, given: Samples, surface: Any) -> Samples:
    """What `refine` of a surface gave, with arrays of the right dtypes; refused where it breaks its contract."""
    who = f"refine of {surface!r}"
    if not isinstance(found, Samples):
        raise InputError(f"{who} gave a {type(found).__name__}; expected rts.Samples")
    rows, widths = len(given.ids), surface.sample_widths
    ids, params = np.ascontiguousarray(found.ids, np.int32), np.ascontiguousarray(found.params, np.float32)
    row, depth = np.asarray(found.row, np.int32), np.asarray(found.depth, np.float32)
    for name, array, shape in (
        ("ids", ids, (rows, widths[0])),
        ("params", params, (rows, widths[1])),
        ("row", row, given.row.shape),
        ("depth", depth, given.row.shape),
    ):
        if array.shape != shape:
            raise InputError(f"{who} gave {name} of shape {array.shape}; expected {shape}")
    if ((row != given.row) & (row != -1)).any():
        raise InputError(f"{who} gave another number to a row; expected what it was given, or −1 to drop a sample")
    covered = row >= 0
    bad = covered & ~np.isfinite(depth)
    if bad.any():
        raise InputError(f"{who} gave {bad.sum()} depths that are not finite; set their rows to −1 where a ray misses")
    used = params[row[covered]]
    if not np.isfinite(used).all():
        count = (~np.isfinite(used).all(axis=1)).sum()
        raise InputError(f"{who} gave {count} samples whose params are not finite; set their rows to −1")
    overflow = np.asarray(found.overflow, np.int32)
    return Samples(ids, params, row, depth, overflow, _checked_tables(found.tables, given.tables, who))


def _checked_tables(found: Any, given: Any, who: str) -> dict[str, np.ndarray]:
    """Tables that fit into those that were allotted."""
    tables = {}
    for name, allotted in given.items():
        if name not in found:
            raise InputError(f"{who} gave no table {name!r}, which table_specs declares")
        table = np.asarray(found[name], allotted.dtype)
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
