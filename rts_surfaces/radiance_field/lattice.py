"""The density of a radiance field on a lattice: computed once, and kept on disk."""

from __future__ import annotations

import contextlib
import hashlib
import os
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from rts import InputError
from rts.plugin_api.arrays import constants
from rts.plugin_api.checks import quoted
from rts.plugin_api.files import cache_folder
from rts_surfaces.implicit.lattice import Lattice
from rts_surfaces.radiance_field.chunks import CHUNK, fast_engine, progress_bar
from rts_surfaces.radiance_field.network import density, placed

VERSION = b"rts density lattice 1"
"""Part of the names of kept files: to be changed when densities would be computed differently."""


def lattice(
    field: Any,
    bounds: Any,
    shape: tuple[int, int, int],
    *,
    network: str = "fine",
    keep: Any = True,
    progress: bool | None = None,
) -> np.ndarray:
    """Densities at points at equal distances along three axes of a box.

    Args:
        field: a `RadianceField`.
        bounds: two corners ((x0, y0, z0), (x1, y1, z1)) of the box, in the field's space; both are points of the
            lattice.
        shape: (X, Y, Z), at least 2 each.
        network: "fine" or "coarse".
        keep: where to keep the densities, and to look for them: True for the user's cache, a folder, or False for
            nowhere. Weights, bounds and shape make the file's name. A damaged file is computed anew. If the folder
            cannot be written to, nothing is kept.
        progress: True to show a progress bar, None to do so in a terminal, False for none.

    Returns:
        (X, Y, Z) float32, per unit of length in the field's space; [i, j, k] is at step i of x, j of y, k of z.

    Raises:
        InputError: there is no such lattice or network.
    """
    if network not in field.weights:
        raise InputError(f"network is {quoted(network)}; expected 'fine' or 'coarse'")
    points = Lattice(bounds, shape)
    weights = field.on_host()[network]
    folder = None if keep is False else cache_folder() if keep is True else Path(keep)
    path = folder / f"density-{_key(weights, points)}.npz" if folder is not None else None
    kept = _kept(path, points.shape) if path is not None else None
    if kept is not None:
        return kept
    values = _computed(weights, points, progress)
    if path is not None:
        _keep(path, values)
    return values


def _computed(weights: Any, points: Lattice, progress: bool | None) -> np.ndarray:
    engine = fast_engine()
    weights = constants(weights, engine, None)
    values = np.empty(points.count, np.float32)
    with progress_bar(progress, "density", len(values)) as advance:
        for start in range(0, len(values), CHUNK):
            numbers = np.arange(start, min(start + CHUNK, len(values)))
            densities = density(weights, engine.constant(points.points(numbers).astype(np.float32)))
            values[numbers] = engine.to_numpy(densities)
            advance(len(numbers))
    return values.reshape(points.shape)


def _key(weights: Any, points: Lattice) -> str:
    """A hash of the weights, the lattice and `VERSION`, for the name of a kept file."""
    digest = hashlib.sha256(VERSION + repr(points.shape).encode() + points.low.tobytes() + points.step.tobytes())
    for place, array in placed(weights):
        digest.update(repr((place, array.shape, str(array.dtype))).encode() + np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()[:32]


def _kept(path: Path, shape: tuple[int, int, int]) -> np.ndarray | None:
    """The densities in a file; None if it is missing or damaged (zip files hold checksums), or of another shape."""
    try:
        with path.open("rb") as opened, np.load(opened, allow_pickle=False) as file:
            values = file["density"]
    except Exception:  # NumPy and zipfile raise many kinds.
        return None
    return values if values.shape == shape and values.dtype == np.float32 else None


def _keep(path: Path, values: np.ndarray) -> None:
    """Write densities, in one step: readers find them whole or not at all. If writing fails, no error and no file."""
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
