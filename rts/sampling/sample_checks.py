"""Checks of cameras, proxies, fragments, samples and refined samples, on the host; "refused" means an InputError."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from rts.advice.coarse_coordinates import FAR
from rts.arrays.argument_checks import one_line
from rts.arrays.array_functions import shape_of
from rts.arrays.engines import namespace
from rts.arrays.trees import Tree
from rts.arrays.value_ranges import largest_absolute
from rts.contracts.records import Fragments, Proxy, Samples
from rts.contracts.surface import TriangleSurface
from rts.errors import InputError
from rts.sampling.packing import covered_cells
from rts.scene.topology import table_extent
from rts.splatting.cells import check_rows


def checked_proxy(surface: TriangleSurface, inputs: Tree, camera: Any, size: Any) -> Proxy:
    """The proxy of a surface for host inputs, in contiguous arrays of the right dtypes; refused if it cannot be drawn.

    Shapes, widths and indices must fit, and vertices be neither NaN nor infinite, nor larger than `LARGEST`.
    """
    proxy: Any = surface.proxy(inputs, camera, size)
    if not isinstance(proxy, Proxy):
        raise InputError(f"the proxy of {surface!r} is a {type(proxy).__name__}; expected a Proxy")
    faces, near, origin = _table(surface, "faces", proxy.faces, (3,), np.int32), proxy.vertices, None
    if getattr(near, "dtype", None) == np.float64:
        _check_size(largest_absolute(near), surface)  # In float32 they may be infinite.
        origin = _origin(near, faces)
        near = near if origin is None else near - origin
    vertices = _table(surface, "vertices", near, (3,), np.float32)
    if not np.isfinite(most := largest_absolute(vertices)):
        bad = np.flatnonzero(~np.isfinite(vertices).all(axis=1))
        raise InputError(
            f"{len(bad)} of the {len(vertices)} vertices of {surface!r} are NaN or infinite, the first is vertex "
            f"{bad[0]}; check the input, or lower the step size if an optimisation led here"
        )
    if most > LARGEST:
        _check_size(most, surface)
    check_faces(vertices, faces, surface)
    none = proxy.ids is None and not surface.refines and surface.sample_widths[0] == 0
    ids = np.zeros((len(faces), 0), np.int32) if none else proxy.ids
    ids = ids if ids is None or ids is faces else _table(surface, "ids", ids, (-1,), np.int32)
    corners = proxy.corner_params
    corners = None if corners is None else _table(surface, "corner_params", corners, (3, -1), np.float32)
    width = 3 if ids is None else ids.shape[1]
    if width != surface.sample_widths[0] and not surface.refines:
        raise InputError(
            f"the proxy of {surface!r} has {width} ids a triangle, but sample_widths says {surface.sample_widths[0]}"
        )
    width = 2 if corners is None else corners.shape[2]
    if width != surface.sample_widths[1] and not surface.refines:
        corner_text = (
            "no corner_params, and so 2 barycentrics" if corners is None else f"corner_params of {width} numbers"
        )
        raise InputError(
            f"the proxy of {surface!r} has {corner_text} a corner, but sample_widths says "
            f"{surface.sample_widths[1]}; make them agree"
        )
    numbers = None if proxy.corners is None else _table(surface, "corners", proxy.corners, (3,), np.int32)
    for name, array in (("ids", ids), ("corner_params", corners), ("corners", numbers)):
        if array is not None and (len(array) < len(faces) or (name == "corners" and len(array) > len(faces))):
            raise InputError(
                f"the proxy of {surface!r} has {len(faces)} faces, but {name} of shape {array.shape}; "
                f"expected a row a face"
            )
    return Proxy(vertices, faces, ids, corners, numbers, origin)


LOOKED_AT = 64
"""Triangles of which a corner tells that most meshes are not far from the origin, evenly spaced."""


def _origin(vertices: Any, faces: np.ndarray) -> np.ndarray | None:
    """A point (3,) near vertices (V, 3) of float64 that are `FAR` from the origin, to be subtracted; None for others.

    Vertices that no face has do not count. Its coordinates are multiples of a power of two no smaller than the box of
    the vertices, so that most meshes in one place get one origin, and vertices that coincide are rounded alike.
    """
    if vertices.shape[1:] != (3,) or not len(faces):
        return None
    some = faces[:: -(-len(faces) // LOOKED_AT), 0]
    if not 0 <= some.min() <= some.max() < len(vertices):
        return None  # They are refused later.
    some, most = vertices[some], largest_absolute(vertices)
    if not np.isfinite(most) or most <= FAR * (some.max(0) - some.min(0)).max():
        return None
    least, last = table_extent(faces)
    if not 0 <= least <= last < len(vertices):
        return None
    used = vertices[faces.reshape(-1)]
    low, high, most = used.min(0), used.max(0), largest_absolute(used)
    extent = float((high - low).max())
    if most <= FAR * extent:
        return None
    step = 2.0 ** math.ceil(math.log2(max(extent, 2**-20 * most)))
    return np.round((low / 2 + high / 2) / step) * step


def check_faces(vertices: np.ndarray, faces: np.ndarray, surface: Any = None) -> None:
    """Refuse faces with an index that is no vertex's, before compiled code reads there."""
    if not len(faces):
        return
    least, most = table_extent(faces)
    if not 0 <= least <= most < len(vertices):
        name = "the proxy" if surface is None else f"the proxy of {surface!r}"
        raise InputError(f"{name} has faces from {least} to {most}, but {len(vertices)} vertices")


def _table(surface: Any, name: str, table: Any, widths: tuple[int, ...], dtype: type) -> np.ndarray:
    """A table of a proxy, contiguous, as float32 or int32, whichever `dtype` is.

    Refused unless it holds floats for float32, or integers for int32, and its shape is (rows, *widths). A width of −1
    stands for any.
    """
    try:
        array = np.asarray(table)
    except (TypeError, ValueError, RuntimeError) as error:
        raise InputError(f"the proxy of {surface!r} has {name} that are no array: {one_line(error)}") from error
    if array.dtype == dtype and array.shape[1:] == widths and array.flags.c_contiguous:
        return array
    kind = np.floating if dtype is np.float32 else np.integer
    fits = array.ndim == 1 + len(widths) and all(w in (-1, n) for w, n in zip(widths, array.shape[1:], strict=True))
    if not fits or not np.issubdtype(array.dtype, kind):
        columns = ", ".join("any" if w < 0 else str(w) for w in widths)
        raise InputError(
            f"the proxy of {surface!r} has {name} of shape {array.shape} and dtype {array.dtype}; "
            f"expected (rows, {columns}) of {np.dtype(dtype)}"
        )
    with np.errstate(over="ignore"):  # What is too large becomes infinite, and is refused.
        return np.ascontiguousarray(array, dtype)


def check_samples(samples: Samples, grid: tuple[int, ...], sampler: Any) -> Samples:
    """A sampler's samples of a part, if arrays on cells fit the grid and refer to rows of `ids`; else an InputError.

    Args:
        samples: the samples; of traced ones only shapes and dtypes are checked.
        grid: (H, W) of the cells.
        sampler: the sampler.
    """
    count, shape = samples.ids.shape[-2], tuple(samples.row.shape)
    shapes = {"row": shape[:1] + tuple(grid), "depth": shape}
    try:
        for name, expected in shapes.items():
            array: Any = getattr(samples, name)
            if array is None:
                continue
            if tuple(array.shape) != expected:
                raise InputError(f"{name} has shape {tuple(array.shape)}; expected {expected}")
            if name == "row":
                if not namespace(array).isdtype(array.dtype, "signed integer"):
                    raise InputError(f"row is {array.dtype}; expected signed integers")
                check_rows(array, count)
    except InputError as error:
        raise InputError(f"sample of {sampler!r} gave samples that do not fit: {error}") from None
    return samples


def check_fragments(fragments: Any, shape: tuple[int, int, int], faces: int, sampler: Any) -> np.ndarray:
    """The covered cells (K, H, W) bool of a sampler's fragments; refused if shapes or triangle numbers do not fit.

    Args:
        fragments: the result of `rasterize`.
        shape: (K, H, W).
        faces: number of triangles.
        sampler: the sampler, for the error.
    """
    if isinstance(fragments, Fragments):
        ids, barycentrics, depth = fragments
        fits = [getattr(x, "shape", ()) for x in (ids, depth, barycentrics)] == [shape, shape, (*shape, 2)]
    else:
        fits = False
    if not fits:
        description = (
            tuple(shape_of(x) for x in fragments) if isinstance(fragments, Fragments) else type(fragments).__name__
        )
        raise InputError(
            f"rasterize of {type(sampler).__name__} returned {description}; expected Fragments of "
            f"{(shape, (*shape, 2), shape)}"
        )
    covered, last = covered_cells(fragments.triangle_ids)
    if last >= faces:
        raise InputError(f"rasterize of {type(sampler).__name__} returned triangle {last} of {faces}")
    return covered


LARGEST = 1e15
"""Coordinates that are larger, seen by the largest entries of a camera, have places in the image beyond float32."""


def _check_size(most: float, surface: Any) -> None:
    """Refuse vertices whose largest coordinate is finite, and larger than `LARGEST`."""
    if LARGEST < most < math.inf:
        raise InputError(
            f"the vertices of {surface!r} reach {most:.3g}; expected at most {LARGEST:g}, "
            f"beyond which places in the image overflow: check the input, choose larger units, or lower the step size "
            f"if an optimisation led here"
        )


def checked_refined(refined: Any, unrefined: Samples, surface: TriangleSurface) -> Samples:
    """The result of a surface's `refine` in arrays of the right dtypes, refused where it breaks its contract.

    Args:
        refined: the result.
        unrefined: the samples that `refine` was given. Fields that `refine` may not change are taken from these.
        surface: the surface.
    """
    who = f"refine of {surface!r}"
    if not isinstance(refined, Samples):
        raise InputError(f"{who} gave a {type(refined).__name__}; expected Samples")
    rows, grid, (i, p) = len(unrefined.ids), unrefined.row.shape, surface.sample_widths
    ids = _array(f"{who} gave ids", refined.ids, (rows, i), np.integer, np.int32)
    params = _array(f"{who} gave params", refined.params, (rows, p), np.floating, np.float32)
    row = _array(f"{who} gave row", refined.row, grid, np.integer, np.int32)
    depth = _array(f"{who} gave depth", refined.depth, grid, np.floating, np.float32)
    overflow = _array(f"{who} gave overflow", refined.overflow, (), np.integer, np.int32)
    if ((row != unrefined.row) & (row != -1)).any():
        raise InputError(f"{who} gave another number to a row; expected what it was given, or −1 to drop a sample")
    if overflow < unrefined.overflow:
        raise InputError(
            f"{who} gave an overflow of {overflow}; expected at least the {unrefined.overflow} it was given"
        )
    covered = row >= 0
    bad = covered & ~np.isfinite(depth)
    if bad.any():
        raise InputError(f"{who} gave {bad.sum()} depths that are not finite; set their rows to −1 where a ray misses")
    if not np.isfinite(params).all() and not np.isfinite(used := params[row[covered]]).all():
        count = (~np.isfinite(used).all(axis=1)).sum()
        raise InputError(f"{who} gave {count} samples whose params are not finite; set their rows to −1")
    tables = _checked_tables(refined.tables, unrefined, who)
    shared = [name for name in tables if name not in unrefined.by_sample]
    if shared:
        lengths = {(len(tables[name]), len(unrefined.tables[name])) for name in shared}
        used, (count, _) = ids[row[covered]], next(iter(lengths))
        if len(lengths) > 1 or used.min(initial=0) < 0 or used.max(initial=0) >= max(1, count):
            raise InputError(
                f"{who} gave ids from {used.min(initial=0)} to {used.max(initial=0)}, and tables {sorted(shared)} of "
                f"{count} rows that samples share; expected tables of one length, and ids that are rows of them"
            )
    return unrefined.replace(ids=ids, params=params, row=row, depth=depth, overflow=overflow, tables=tables)


def _array(what: str, value: Any, shape: tuple[int, ...], kind: type, dtype: Any) -> np.ndarray:
    """A value as an array of `dtype`, refused unless its shape is `shape` and its own dtype a subtype of `kind`.

    `what` begins the error: "refine of … gave ids".
    """
    try:
        array = np.asarray(value)
    except (TypeError, ValueError) as error:
        raise InputError(f"{what} that is no array ({error}); expected shape {shape}") from error
    if array.shape != shape or not np.issubdtype(array.dtype, kind):
        raise InputError(
            f"{what} of shape {array.shape} and dtype {array.dtype}; expected {shape} of {np.dtype(dtype)}"
        )
    with np.errstate(over="ignore"):  # Too large a number becomes infinity, which is refused where it is used.
        return np.ascontiguousarray(array, dtype) if array.ndim else array.astype(dtype)


def _checked_tables(refined: Any, unrefined: Samples, who: str) -> dict[str, np.ndarray]:
    """The tables of refined samples, refused where they do not fit into the allotted ones."""
    if set(refined) != set(unrefined.tables):
        raise InputError(f"{who} gave the tables {sorted(refined)}; table_specs declares {sorted(unrefined.tables)}")
    tables = {}
    for name, allotted in unrefined.tables.items():
        table = np.asarray(refined[name], allotted.dtype)
        if name in unrefined.by_sample and len(table) != len(unrefined.ids):
            raise InputError(
                f"{who} gave a table {name!r} of {len(table)} rows; expected {len(unrefined.ids)}, one a sample"
            )
        if table.shape[1:] != allotted.shape[1:] or len(table) > len(allotted):
            raise InputError(
                f"{who} gave a table {name!r} of shape {table.shape}, where table_specs allots {allotted.shape}; drop "
                f"the samples that do not fit and add their number to overflow"
            )
        tables[name] = table
    return tables
