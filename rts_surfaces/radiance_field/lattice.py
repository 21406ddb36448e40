"""The density of a radiance field on a lattice: computed once, and kept on disk."""

from __future__ import annotations

import contextlib
import hashlib
import os
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rts.arguments import check_numbers, quoted
from rts.checks import is_count
from rts.engines import constants
from rts.errors import InputError
from rts.files.paths import as_path
from rts.trees import placed_leaves
from rts_surfaces.radiance_field.chunks import CHUNK, fast_engine, progress_bar
from rts_surfaces.radiance_field.network import density
from rts_surfaces.subdivision.library import cache_folder

if TYPE_CHECKING:
    from rts_surfaces.radiance_field.field import RadianceField

VERSION = b"rts density lattice 1"
"""Changes when lattices that are kept no longer hold."""
MOST_POINTS = 2**31 - 1


def lattice(
    field: RadianceField,
    bounds: Any,
    shape: tuple[int, int, int],
    *,
    network: str = "fine",
    keep: Any = True,
    progress: bool | None = None,
) -> np.ndarray:
    """Densities at points at equal distances along three axes of a box.

    Args:
        field: the field.
        bounds: two corners ((x0, y0, z0), (x1, y1, z1)) of the box, in the field's space; both are points of the
            lattice.
        shape: (X, Y, Z), at least 2 each.
        network: "fine" or "coarse".
        keep: where to keep the lattice, and to look for it: True for the user's cache, a folder, or False for nowhere.
            It goes by weights, bounds and shape. What is damaged there is computed anew.
        progress: whether to show a progress bar; None to do so in a terminal.

    Returns:
        (X, Y, Z) float32, per unit of length in the field's space; [i, j, k] is at step i of x, j of y, k of z.

    Raises:
        InputError: there is no such lattice or network.
    """
    if network not in field.weights:
        raise InputError(f"network is {quoted(network)}; expected 'fine' or 'coarse'")
    low, high = _checked_bounds(bounds)
    shape = _checked_shape(shape)
    weights = field.on_host()[network]
    folder = None if keep is False else cache_folder() if keep is True else as_path(keep)
    path = folder / f"density-{_key(weights, low, high, shape)}.npz" if folder is not None else None
    kept = _kept(path, shape) if path is not None else None
    if kept is not None:
        return kept
    values = _computed(weights, low, high, shape, progress)
    if path is not None:
        _keep(path, values)
    return values


def _computed(
    weights: Any, low: np.ndarray, high: np.ndarray, shape: tuple[int, int, int], progress: bool | None
) -> np.ndarray:
    engine = fast_engine()
    weights = constants(weights, engine, None)
    values = np.empty(shape[0] * shape[1] * shape[2], np.float32)
    step = (high - low) / (np.array(shape) - 1)
    with progress_bar(progress, "density", len(values)) as advance:
        for start in range(0, len(values), CHUNK):
            numbers = np.arange(start, min(start + CHUNK, len(values)))
            points = low + step * np.stack(np.unravel_index(numbers, shape), axis=-1)
            found = density(weights, engine.constant(points.astype(np.float32)))
            values[numbers] = engine.to_numpy(found)
            advance(len(numbers))
    return values.reshape(shape)


def _key(weights: Any, low: np.ndarray, high: np.ndarray, shape: tuple[int, int, int]) -> str:
    """A name that changes with any of these."""
    found = hashlib.sha256(VERSION + repr(shape).encode() + low.tobytes() + high.tobytes())
    for place, array in placed_leaves(weights):
        found.update(repr((place, array.shape, str(array.dtype))).encode() + np.ascontiguousarray(array).tobytes())
    return found.hexdigest()[:32]


def _kept(path: Path, shape: tuple[int, int, int]) -> np.ndarray | None:
    """The lattice in a file; None where there is none, or it is damaged (zip files hold checksums)."""
    try:
        with path.open("rb") as opened, np.load(opened, allow_pickle=False) as file:
            values = file["density"]
    except Exception:  # NumPy and zipfile raise many kinds.
        return None
    return values if values.shape == shape and values.dtype == np.float32 else None


def _keep(path: Path, values: np.ndarray) -> None:
    """Write a lattice, in one step: readers find it whole or not at all. Where nothing can be written, nothing is."""
    draft = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, draft = tempfile.mkstemp(suffix=".npz", dir=path.parent)
        with os.fdopen(handle, "wb") as file:
            np.savez(file, density=values)
        os.replace(draft, path)
    except OSError:
        if draft is not None:
            Path(draft).unlink(missing_ok=True)
    except BaseException:
        with contextlib.suppress(OSError):
            Path(str(draft)).unlink(missing_ok=True)
        raise


def _checked_bounds(bounds: Any) -> tuple[np.ndarray, np.ndarray]:
    known = check_numbers("bounds", bounds, (2, 3))
    if known is None or not (known[0] < known[1]).all():
        raise InputError(f"bounds are {quoted(bounds)}; expected ((x0, y0, z0), (x1, y1, z1)) with each x0 < x1")
    low, high = np.asarray(known, np.float64)
    return low, high


def _checked_shape(shape: Any) -> tuple[int, int, int]:
    given = tuple(shape) if isinstance(shape, (tuple, list)) else ()
    if len(given) != 3 or not all(is_count(n) and 2 <= n for n in given):
        raise InputError(f"the lattice has shape {quoted(shape)}; expected (X, Y, Z), at least 2 each")
    x, y, z = map(int, given)
    if x * y * z > MOST_POINTS:
        raise InputError(f"the lattice has {x} × {y} × {z} points; expected at most 2**31 − 1, 1290 along each axis")
    return x, y, z
