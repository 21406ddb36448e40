"""The true derivative of an image, by differences of area-sampled renders without splatting.

The differences are central, over a quarter of a pixel. They are taken on two grids of points in the pixel: the
disagreement of both results measures the error. Derivatives are kept on disk by a key of the scene.
"""

from __future__ import annotations

import hashlib
import os
import tempfile
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rts import Camera, Engine, Part, engine_of, render_views
from rts.errors import InputError
from rts.plugin_api.checks import fingerprint
from rts.plugin_api.files import cache_folder
from rts.tool_api.files import output_folder, writing
from rts_compare.derivative_scores import relative_l2
from rts_compare.measurement_keys import layers_of, state_key
from rts_compare.moving_scenes import Scene, parts_of
from rts_diagnostics.smoothing import low_pass

SAMPLES = 16
"""The square root of the number of points a pixel, on each grid."""
STEP = 0.25
"""Length of the central difference, pixels of motion."""
AT_ONCE = 8
"""Number of points of each pixel that one call renders."""

Grids = Callable[[int], tuple[np.ndarray, np.ndarray]]
"""The square root of the number of points a pixel → two grids of points (S, 2)."""


class Truth(NamedTuple):
    """The true derivative of an image along one mode.

    Attributes:
        derivative: (H, W, 3), change of colour per pixel of motion, the mean over both grids.
        error: estimated error of `derivative`, relative L2 through `low_pass`: half the difference of the grids, as if
            both erred equally and independently.
        grids: (2, H, W, 3) the derivative on each of the grids.
    """

    derivative: np.ndarray
    error: float
    grids: np.ndarray

    @property
    def noise(self) -> dict[str, float]:
        """Relative L2 of the difference of the grids' derivatives: as they are, and through `low_pass`."""
        return {
            "relative_l2": relative_l2(self.grids[0], self.grids[1], self.derivative),
            "low_relative_l2": 2 * self.error,
        }


def lattice(samples: int) -> np.ndarray:
    """`samples`² points (S, 2) of a pixel, from its centre, in pixels: a rank-1 lattice of the golden ratio.

    No two points share a row or a column, so upright edges are resolved to 1/S of a pixel.
    """
    count = samples**2
    return np.column_stack([(np.arange(count) + 0.5) / count, (np.arange(count) * (5**0.5 - 1) / 2 + 0.25) % 1]) - 0.5


def lattices(samples: int) -> tuple[np.ndarray, np.ndarray]:
    """Two grids of points (S, 2) of a pixel: `lattice`, and the same with x and y exchanged."""
    points = lattice(samples)
    return points, points[:, ::-1]


def area_image(
    parts: list[Part],
    camera: Camera,
    size: tuple[int, int],
    points: np.ndarray,
    done: Callable[[], None] = lambda: None,
) -> np.ndarray:
    """Mean of the hard image (H, W, 4) float64 over points (S, 2) of each pixel; nothing is splatted.

    Args:
        parts: without derivatives.
        camera: the camera.
        size: (height, width).
        points: offsets from the pixel's centre, x right and y down, pixels.
        done: called once for each point.
    """
    total, layers, seen = np.zeros((*size, 4)), layers_of(parts, camera), camera.for_size(size)
    projection = np.asarray(engine_of(seen.projection).to_numpy(seen.projection), np.float64)

    def through(point: np.ndarray) -> Camera:
        shift = np.eye(4)
        # Moving the image by −dx pixels puts the point at +dx under the pixel's centre.
        shift[0, 3], shift[1, 3] = -2 * point[0] / size[1], 2 * point[1] / size[0]
        return seen.replace(projection=shift @ projection)

    for first in range(0, len(points), AT_ONCE):
        cameras = [through(point) for point in points[first : first + AT_ONCE]]
        images = render_views(parts, cameras, size, splatter="none", layers=layers)
        total += engine_of(images).to_numpy(images).sum(axis=0)
        for _ in cameras:
            done()
    return total / len(points)


def truth_key(
    scene: Scene, mode: str, step: float, samples: int, engine: Engine | None, grids: Grids = lattices
) -> str:
    """A hash of the exact scene at both ends of a step, `samples` and the grids; the library's code is not in it.

    Args:
        scene: the scene.
        mode: a mode of the scene.
        step: length of the central difference, a factor of the mode's direction.
        samples: as in `truth`.
        engine: as in `shown`.
        grids: as in `truth`.
    """
    states = [state_key(*shown(scene, mode, by, engine), scene.size) for by in (-step / 2, step / 2)]
    points = () if grids is lattices else (fingerprint(grids(samples)),)
    return hashlib.sha256(repr((samples, states, *points)).encode()).hexdigest()[:20]


def shown(scene: Scene, mode: str, by: float, engine: Engine | None) -> tuple[list[Part], Camera]:
    """The exact parts of a scene and its camera, moved along a mode.

    Args:
        scene: the scene.
        mode: a mode of the scene.
        by: the factor of the mode's direction.
        engine: the engine of the parameters; None for NumPy, if the scene is `separate`.
    """
    found = (scene.exact or scene.at)(scene.moved(mode, by, engine))
    return parts_of(found), found[1]


def truth(
    scene: Scene,
    mode: str,
    pixel: float,
    *,
    samples: int = SAMPLES,
    step: float = STEP,
    grids: Grids = lattices,
    engine: Engine | None = None,
    folder: Path | None = None,
    done: Callable[[], None] = lambda: None,
) -> Truth:
    """The derivative of a scene's area-sampled image along a mode; made once, then read from disk.

    Args:
        scene: the scene.
        mode: a mode of the scene.
        pixel: the factor of the mode's direction that moves the fastest point by one pixel.
        samples: the square root of the number of points a pixel, on each grid.
        step: length of the central difference, pixels of motion.
        grids: `samples` → two grids of points (S, 2) of a pixel.
        engine: as in `shown`.
        folder: the result is kept in its folder "truths"; None for the folder of caches.
        done: called once for each point of four images, also where they are read from disk: 4 `samples`² times.
    """
    length = step * pixel
    folder = (kept_folder() if folder is None else folder) / "truths"
    key = truth_key(scene, mode, length, samples, engine, grids)
    path = folder / f"{key}.npy"
    kept = _read(path)
    if kept is not None:
        for _ in range(4 * samples**2):
            done()
        return _of(kept)
    images = [
        [
            _kept_image(partial(shown, scene, mode, by, engine), scene.size, grid, folder / f"{key}-{i}{j}.npy", done)
            for j, by in enumerate((-length / 2, length / 2))
        ]
        for i, grid in enumerate(grids(samples))
    ]
    derivatives = np.stack([(after - before) / step for before, after in images]).astype(np.float32)
    _write(path, derivatives)
    for image in folder.glob(f"{key}-*.npy"):
        image.unlink(missing_ok=True)
    return _of(derivatives)


def _kept_image(
    seen: Callable[[], tuple[list[Part], Camera]],
    size: tuple[int, int],
    points: np.ndarray,
    path: Path,
    done: Callable[[], None],
) -> np.ndarray:
    """One of the four images (H, W, 3) of the differences, kept at `path` so that an interrupted run can go on.

    `seen` gives parts and camera; it is called only if there is no such file. For the others see `area_image`.
    """
    kept = _read(path)
    if kept is not None:
        for _ in points:
            done()
        return kept
    image = area_image(*seen(), size, points, done)[..., :3]
    _write(path, image)
    return image


def kept_folder() -> Path:
    """The folder of caches, or a temporary one of this process if that cannot be written."""
    try:
        return output_folder(cache_folder())
    except InputError:
        return Path(_own_folder().name)


@cache
def _own_folder() -> tempfile.TemporaryDirectory:
    """A temporary folder, removed when this process ends."""
    return tempfile.TemporaryDirectory(prefix="rts-truths-")


def _read(path: Path) -> np.ndarray | None:
    """The array in a file; None if the file is missing or damaged."""
    try:
        return np.load(path)
    except (OSError, ValueError, EOFError):
        return None


def _write(path: Path, array: np.ndarray) -> None:
    """Write an array to a file atomically, also if several processes write the same file."""
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=path.parent, suffix=".part", delete=False) as file:
            np.save(file, array)
        os.replace(file.name, path)


def _of(derivatives: np.ndarray) -> Truth:
    first, second = derivatives.astype(np.float64)
    mean = (first + second) / 2
    return Truth(mean, relative_l2(low_pass(first), low_pass(second), low_pass(mean)) / 2, np.stack([first, second]))
