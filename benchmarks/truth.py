"""Ground truth for derivatives of images, and how derivatives are scored against it.

The truth is a difference of area-sampled hard renders over a step of t, on two grids of points in the pixel that have
nothing in common: what they disagree on is noise. Where a scene has a closed form, that is here too, from geometry
alone. Compare the two:

    python benchmarks/truth.py
"""

from __future__ import annotations

import argparse
import hashlib
import os
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # Spinning threads of two libraries take each other's cores.

import derivative_scenes as ds
import numpy as np
from scenes import DISTANCE, FOV, regular_grid, supersampled
from scipy.ndimage import binary_dilation, gaussian_filter

SAMPLES = 16
STEPS = (1.0, 0.25)
"""Lengths of the central differences, pixels."""
LOW_PASS, RADIUS = 2.0, 6
"""Standard deviation and cut-off of the Gaussian that errors are looked at through, pixels."""
LOSSES, LOSS_SCALE = 16, 8.0
"""How many random losses, and the standard deviation of the Gaussian that smooths their weights, pixels."""

# --------------------------------------------------------------------------------------------- differences of renders


def lattice(samples: int) -> np.ndarray:
    """`samples`² points (S, 2) of a pixel, from its centre, in pixels: a rank-1 lattice of the golden ratio.

    No two points share a row or a column, so upright edges are resolved to 1/S of a pixel.
    """
    count = samples**2
    return np.column_stack([(np.arange(count) + 0.5) / count, (np.arange(count) * (5**0.5 - 1) / 2 + 0.25) % 1]) - 0.5


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
            "relative_l2": _relative(self.grids[0], self.grids[1], self.derivative),
            "low_relative_l2": _relative(*(low_pass(i) for i in (*self.grids, self.derivative))),
        }


def fingerprint(scene: ds.Scene) -> str:
    """Hash of every array of the scene and its camera."""
    digest = hashlib.sha256(repr([(p.shader, p.cull, repr(p.surface)) for p in scene.rest]).encode())
    tables = [t for p in scene.rest for t in (p.surface.faces, *(p.theta[k] for k in sorted(p.theta)))]
    for array in (*tables, *(np.zeros(0) if d is None else d for d in scene.directions), *scene.camera):
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()[:16]


def area_image(scene: ds.Scene, t: float, points: np.ndarray) -> np.ndarray:
    """Mean of the hard image over points of each pixel (H, W, 3)."""
    return supersampled(scene.at(t), scene.camera, scene.size, points)[..., :3]


def truth(scene: ds.Scene, folder: Path | str, step: float = 1.0, samples: int = SAMPLES) -> Truth:
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


# -------------------------------------------------------------------------------------------------------- closed forms


@dataclass(frozen=True)
class ClosedForm:
    """An image that geometry alone gives.

    Attributes:
        image: t → (H, W, 3), the exact mean over each pixel.
        derivative: (H, W, 3) exact, at t = 0.
    """

    image: Callable[[float], np.ndarray]
    derivative: np.ndarray

    def difference(self, step: float) -> np.ndarray:
        """The exact central difference (H, W, 3) over a step."""
        return (self.image(step / 2) - self.image(-step / 2)) / step

    def truth(self, step: float = 0.0) -> Truth:
        """As a truth without noise: the derivative, or the difference over a step."""
        derivative = self.difference(step) if step else self.derivative
        return Truth(self.image(0.0), derivative, np.stack([derivative] * 2), step)


def closed_form(scene: ds.Scene) -> ClosedForm | None:
    """The closed form of a scene, or None where there is none."""
    return _CLOSED_FORMS[scene.name](scene.size[0]) if scene.name in _CLOSED_FORMS else None


def circle(x: float, y: float, radius: float, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Coverage of each pixel by a disk inside the image, and its derivative as the disk moves along +x, (H, W) both.

    By Green's theorem a piece of outline between the lines of the pixels' grid adds Δy to all pixels on its left and
    ∫ (x − left) dy to its own; as the disk moves its own pixel gains Δy.
    """
    crossings = [np.zeros(1)]
    for center, turn in ((x, 0.0), (y, np.pi / 2)):
        lines = np.arange(np.ceil(center - radius), np.floor(center + radius) + 1)
        angle = np.arccos(np.clip((lines - center) / radius, -1, 1))
        crossings += [turn + angle, turn - angle]
    start = np.unique(np.concatenate(crossings) % (2 * np.pi))
    end = np.append(start[1:], 2 * np.pi)
    middle = (start + end) / 2
    column = np.floor(x + radius * np.cos(middle)).astype(int)
    row = np.floor(y + radius * np.sin(middle)).astype(int)
    rise = radius * (np.sin(end) - np.sin(start))
    half_turns = (end - start) / 2 + (np.sin(2 * end) - np.sin(2 * start)) / 4
    coverage, derivative = np.zeros((size, size)), np.zeros((size, size))
    np.add.at(derivative, (row, column), rise)
    np.add.at(coverage, (row, column), (x - column) * rise + radius**2 * half_turns)
    coverage[:, :-1] += np.cumsum(derivative[:, :0:-1], axis=1)[:, ::-1]
    return coverage, derivative


def span(low: float, high: float, size: int) -> np.ndarray:
    """Length of an interval within each cell of a line (size,)."""
    cells = np.arange(size)
    return np.clip(np.minimum(high, cells + 1) - np.maximum(low, cells), 0, None)


def rectangle(bounds: np.ndarray, size: int) -> np.ndarray:
    """Coverage (H, W, 1) by an upright rectangle: left, top, right, bottom in pixels."""
    left, top, right, bottom = bounds
    return np.outer(span(top, bottom, size), span(left, right, size))[..., None]


def _moving_circle(x: float, y: float, radius: float, speed: float, color: tuple, size: int) -> ClosedForm:
    return ClosedForm(
        lambda t: circle(x + speed * t, y, radius, size)[0][..., None] * np.array(color),
        speed * circle(x, y, radius, size)[1][..., None] * np.array(color),
    )


def _disk(size: int) -> ClosedForm:
    x, y = size * np.array(ds.DISK_CENTER)
    return _moving_circle(x, y, size * ds.DISK_RADIUS, 1.0, ds.DISK_COLOR, size)


def _sphere(size: int) -> ClosedForm:
    """The outline of a sphere seen from distance d is a circle of radius f r / √(d² − r²), that of the tangent cone.

    It moves as what is at the depth d − r²/d of its rim; that it turns into an ellipse is of second order in t.
    """
    focal = size / (2 * np.tan(np.radians(FOV / 2)))
    square = DISTANCE**2 - ds.SPHERE_RADIUS**2
    radius = focal * ds.SPHERE_RADIUS / np.sqrt(square)
    return _moving_circle(size / 2, size / 2, radius, DISTANCE**2 / square, ds.SPHERE_COLOR, size)


def _upright(image: Callable[[float], np.ndarray]) -> ClosedForm:
    """Of upright edges: linear in t as long as no edge crosses a pixel's boundary, so a small difference is exact."""
    small = 1e-3
    return ClosedForm(image, (image(small) - image(-small)) / (2 * small))


def _half_plane(size: int) -> ClosedForm:
    def image(t):
        return np.broadcast_to(span(0, size * ds.EDGE + t, size)[:, None] * np.array(ds.EDGE_COLOR), (size, size, 3))

    return _upright(image)


def _box_over_card(size: int, moves: str) -> ClosedForm:
    def image(t):
        front, card = size * np.array(ds.BOX), size * np.array(ds.CARD)
        moving = front if moves == "box" else card
        moving[[0, 2]] += t
        overlap = np.concatenate([np.maximum(front, card)[:2], np.minimum(front, card)[2:]])
        seen = rectangle(card, size) - rectangle(overlap, size)
        return rectangle(front, size) * np.array(ds.BOX_COLOR) + seen * np.array(ds.CARD_COLOR)

    return _upright(image)


def _ramp(size: int) -> ClosedForm:
    def image(t):
        center = (np.arange(size) + 0.5) / size - 0.5
        x, y = np.broadcast_arrays(center[None, :, None] - t / size, center[:, None, None])
        return 0.5 + x * ds.RAMP_SLOPE + y * ds.RAMP_SLOPE_Y

    return _upright(image)


_CLOSED_FORMS: dict[str, Callable[[int], ClosedForm]] = {
    "half-plane": _half_plane,
    "disk": _disk,
    "sphere": _sphere,
    "ramp": _ramp,
    "box over card": lambda size: _box_over_card(size, "box"),
    "card behind box": lambda size: _box_over_card(size, "card"),
}

# ------------------------------------------------------------------------------------------------------------- metrics


def low_pass(x: np.ndarray) -> np.ndarray:
    """(H, W, 3) after the Gaussian."""
    return gaussian_filter(np.asarray(x, np.float64), (LOW_PASS, LOW_PASS, 0), radius=(RADIUS, RADIUS, 0))


@cache
def loss_weights(height: int, width: int) -> np.ndarray:
    """Weights (L, H, W, 3) of the random losses L = Σ w · image: smooth, of fixed seed and unit variance."""
    noise = np.random.default_rng(0).normal(size=(LOSSES, height, width, 3))
    smooth = gaussian_filter(noise, (0, LOSS_SCALE, LOSS_SCALE, 0))
    weights = smooth / smooth.std(axis=(1, 2, 3), keepdims=True)
    weights.setflags(write=False)
    return weights


def scores(x: np.ndarray, reference: Truth | np.ndarray) -> dict[str, float]:
    """How near a derivative image (H, W, 3) is to the truth.

    Returns:
        relative_l2, cosine, gain: raw; the gain is ⟨x, truth⟩ / ⟨truth, truth⟩.
        low_relative_l2, low_cosine, low_gain: the same after the low-pass.
        spurious: share of the derivative's energy farther than 3 pixels from where the truth is not zero.
        loss_error: over the random losses, RMS of the error of dL/dt relative to the RMS of dL/dt.
    """
    true = reference.derivative if isinstance(reference, Truth) else reference
    near = binary_dilation(np.abs(true).max(axis=-1) > 1e-6, iterations=3)
    weights = loss_weights(*true.shape[:2])
    slopes, true_slopes = (np.tensordot(weights, i, axes=3) for i in (x, true))
    return {
        **_compared(x, true, ""),
        **_compared(low_pass(x), low_pass(true), "low_"),
        "spurious": float((x[~near] ** 2).sum() / max((x**2).sum(), 1e-30)),
        "loss_error": _relative(slopes, true_slopes, true_slopes),
    }


def _compared(x: np.ndarray, true: np.ndarray, prefix: str) -> dict[str, float]:
    product, square = float((x * true).sum()), float((true**2).sum())
    return {
        f"{prefix}relative_l2": _relative(x, true, true),
        f"{prefix}cosine": product / max(float(np.linalg.norm(x) * np.linalg.norm(true)), 1e-30),
        f"{prefix}gain": product / square,
    }


def _relative(x: np.ndarray, y: np.ndarray, scale: np.ndarray) -> float:
    return float(np.linalg.norm(x - y) / np.linalg.norm(scale))


def main() -> None:
    """Differences against closed forms, and their noise."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=Path("out/truth"), help="where truths are kept")
    parser.add_argument("--scenes", nargs="+", choices=ds.SCENES, default=list(_CLOSED_FORMS))
    args = parser.parse_args()
    print(
        "Relative L2, raw and low-passed: between the grids; of their mean against the closed form over the same step;"
    )
    print("and of that difference against the exact derivative, which is what the step itself costs.")
    print(f"{'scene':22} step    noise          closed form    step")
    for name in args.scenes:
        scene = ds.scene(name)
        closed = closed_form(scene)
        for step in STEPS:
            measured = truth(scene, args.output, step)
            line = f"{name:22} {step:4g}  {_pair(measured.noise)}"
            if closed:
                exact = closed.truth(step)
                line += f"  {_pair(scores(measured.derivative, exact))}"
                line += f"  {_pair(scores(exact.derivative, closed.truth()))}"
            print(line, flush=True)


def _pair(values: dict[str, float]) -> str:
    return f"{values['relative_l2']:.4f} {values['low_relative_l2']:.4f}"


if __name__ == "__main__":
    main()
