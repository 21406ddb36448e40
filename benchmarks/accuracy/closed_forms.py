"""Derivatives of images that geometry alone gives: disk, sphere, half-plane, ramp, and an upright box over a card."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from benchmarks.accuracy import scenes
from benchmarks.camera import DISTANCE, FOV
from rts_compare.true_derivatives import Truth


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
        """A truth without noise: the derivative, or the difference over a step."""
        derivative = self.difference(step) if step else self.derivative
        return Truth(derivative, 0.0, np.stack([derivative] * 2))


def closed_form(scene: scenes.Scene) -> ClosedForm | None:
    """The closed form of a scene, or None where there is none."""
    return CLOSED_FORMS[scene.name](scene.size[0]) if scene.name in CLOSED_FORMS else None


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
    x, y = size * np.array(scenes.DISK_CENTER)
    return _moving_circle(x, y, size * scenes.DISK_RADIUS, 1.0, scenes.DISK_COLOR, size)


def _sphere(size: int) -> ClosedForm:
    """The outline of a sphere seen from distance d is a circle of radius f r / √(d² − r²), that of the tangent cone.

    It moves as what is at the depth d − r²/d of its rim; that it turns into an ellipse is of second order in t.
    """
    focal = size / (2 * np.tan(np.radians(FOV / 2)))
    square = DISTANCE**2 - scenes.SPHERE_RADIUS**2
    radius = focal * scenes.SPHERE_RADIUS / np.sqrt(square)
    return _moving_circle(size / 2, size / 2, radius, DISTANCE**2 / square, scenes.SPHERE_COLOR, size)


def _upright(image: Callable[[float], np.ndarray]) -> ClosedForm:
    """The derivative of upright edges: linear in t within a pixel, so that a small difference is exact."""
    small = 1e-3
    return ClosedForm(image, (image(small) - image(-small)) / (2 * small))


def _half_plane(size: int) -> ClosedForm:
    def image(t):
        return np.broadcast_to(
            span(0, size * scenes.EDGE + t, size)[:, None] * np.array(scenes.EDGE_COLOR), (size, size, 3)
        )

    return _upright(image)


def _box_over_card(size: int, moves: str) -> ClosedForm:
    def image(t):
        front, card = size * np.array(scenes.BOX), size * np.array(scenes.CARD)
        moving = front if moves == "box" else card
        moving[[0, 2]] += t
        overlap = np.concatenate([np.maximum(front, card)[:2], np.minimum(front, card)[2:]])
        seen = rectangle(card, size) - rectangle(overlap, size)
        return rectangle(front, size) * np.array(scenes.BOX_COLOR) + seen * np.array(scenes.CARD_COLOR)

    return _upright(image)


def _ramp(size: int) -> ClosedForm:
    def image(t):
        center = (np.arange(size) + 0.5) / size - 0.5
        x, y = np.broadcast_arrays(center[None, :, None] - t / size, center[:, None, None])
        return 0.5 + x * scenes.RAMP_SLOPE + y * scenes.RAMP_SLOPE_Y

    return _upright(image)


CLOSED_FORMS: dict[str, Callable[[int], ClosedForm]] = {
    "half-plane": _half_plane,
    "disk": _disk,
    "sphere": _sphere,
    "sphere rolls": _sphere,
    "sphere rolls back": _sphere,
    "ramp": _ramp,
    "box over card": lambda size: _box_over_card(size, "box"),
    "card behind box": lambda size: _box_over_card(size, "card"),
}
