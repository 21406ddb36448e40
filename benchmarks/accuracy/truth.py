"""Ground truth for derivatives of images.

It is a difference of area-sampled hard renders over a step of t, on two grids of points in the pixel that have nothing
in common: what they disagree on is noise. `closed_forms` has the truth from geometry alone, for some scenes.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.accuracy import scenes
from benchmarks.camera import regular_grid, supersampled
from rts.diagnostics.smoothing import low_pass
from rts_compare.derivative_scores import relative_l2
from rts_compare.true_derivatives import lattice

SAMPLES = 16
"""Points a pixel, along x and along y."""


GRIDS: dict[str, Callable[[int], np.ndarray]] = {"regular": regular_grid, "lattice": lattice}


@dataclass(frozen=True)
class Truth:
    """Change of an image with t.

    Attributes:
        image: (H, W, 3) area-sampled, at t = 0.
        derivative: (H, W, 3) a pixel of motion, the mean of the two grids'.
        grids: (2, H, W, 3) the derivative on each of the grids.
        step: in t, of the central difference; 0 for the exact derivative.
    """

    image: np.ndarray
    derivative: np.ndarray
    grids: np.ndarray
    step: float

    @property
    def noise(self) -> dict[str, float]:
        """What the grids disagree on, as relative L2: raw, and after the low-pass."""
        return {
            "relative_l2": relative_l2(self.grids[0], self.grids[1], self.derivative),
            "low_relative_l2": relative_l2(*(low_pass(i) for i in (*self.grids, self.derivative))),
        }


def fingerprint(scene: scenes.Scene) -> str:
    """Hash of every array of the scene and its camera."""
    digest = hashlib.sha256(repr([(p.shader, p.cull, repr(p.surface)) for p in scene.rest]).encode())
    tables = [t for p in scene.rest for t in (p.surface.faces, *(p.theta[k] for k in sorted(p.theta)))]
    directions = [np.zeros(0) if d is None else d for d in scene.directions]
    for array in (*tables, *directions, *scene.camera.for_size(scene.size)):
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()[:16]


def area_image(scene: scenes.Scene, t: float, points: np.ndarray) -> np.ndarray:
    """Mean of the hard image over points of each pixel (H, W, 3)."""
    return supersampled(scene.at(t), scene.camera, scene.size, points)[..., :3]


def truth(scene: scenes.Scene, folder: Path | str, step: float = 1.0, samples: int = SAMPLES) -> Truth:
    """The truth of a scene by differences over `step`, with `samples`² points a pixel; kept in a folder as .npz."""
    name = f"{scene.name.replace(' ', '_')}-{scene.size[0]}-{samples}-{step:g}-{fingerprint(scene)}.npz"
    path = Path(folder) / name
    if path.exists():
        with np.load(path) as kept:
            return Truth(kept["image"], kept["grids"].mean(axis=0), kept["grids"], step)
    points = [grid(samples) for grid in GRIDS.values()]
    grids = np.stack([(area_image(scene, step / 2, p) - area_image(scene, -step / 2, p)) / step for p in points])
    image = area_image(scene, 0.0, points[0])
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(path, image=image, grids=grids)
    return Truth(image, grids.mean(axis=0), grids, step)
