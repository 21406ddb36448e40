"""Samples that are right, and how far others may be off."""

from __future__ import annotations

import inspect
from typing import Any, NamedTuple

import numpy as np

from rts import Camera, Part, TriangleSurface
from rts.results import Sampled
from rts.tool_api.plugins import check_sampler
from rts_testing import scenes
from rts_testing.claims import claim

DEEPER = 4
"""Layers of the reference beyond those compared, which show where silhouettes are."""


class Expected(NamedTuple):
    """Samples to compare with.

    Attributes:
        sampled: the samples.
        edge: (H, W) bool, pixels at silhouettes, where other samples may be right, too.
        source: name of their sampler, in words.
    """

    sampled: Sampled
    edge: np.ndarray
    source: str


class Silhouettes(NamedTuple):
    """The number of pixels at silhouettes, and of those among them that differ from the expected ones."""

    pixels: int = 0
    different: int = 0

    def __add__(self, other: Any) -> Silhouettes:
        """The sums of both counts."""
        return Silhouettes(self.pixels + other[0], self.different + other[1])

    def claim_few(self, what: str) -> None:
        """Fail if more than one pixel in a hundred differs."""
        claim(
            self.different <= 0.01 * self.pixels,
            f"{what}{self.different} of {self.pixels} pixels at silhouettes differ from what they should be; expected "
            f"at most 1 %",
        )


def reference(part: Part, camera: Camera, layers: int = scenes.LAYERS) -> Expected:
    """The samples of the sampler `reference`."""
    exact = check_sampler("reference")
    deep = scenes.find(part, camera, exact, layers=layers + DEEPER)
    return Expected(scenes.find(part, camera, exact, layers=layers), _edges(deep), "the reference")


def again(part: Part, camera: Camera, sampler: Any) -> Expected:
    """The samples of a new object of the sampler's class, or of the reference if none can be made."""
    new = _new(sampler)
    if new is None and is_of_triangles(part):
        return reference(part, camera)
    sampled = scenes.find(part, camera, sampler if new is None else new)
    return Expected(sampled, _edges(sampled), "a new object of the sampler's class")


def right(part: Part, camera: Camera, sampler: Any) -> Expected:
    """The samples of the reference; for a surface without triangles, those of a new object of the sampler."""
    return reference(part, camera) if is_of_triangles(part) else again(part, camera, sampler)


def _new(sampler: Any) -> Any:
    """A new sampler of the same class; None if that fails, or if the class of a given object takes arguments."""
    kind = type(check_sampler(sampler))
    plain = kind.__init__ is object.__init__ or len(inspect.signature(kind.__init__).parameters) == 1
    if not (isinstance(sampler, str) or plain):
        return None
    try:
        return kind()
    except Exception:  # A plugin's class may raise anything.
        return None


def claim_like(actual: Sampled, expected: Expected, what: str) -> Silhouettes:
    """Fail unless samples have the expected ids and depths; at silhouettes ids may differ. Returns counts of these."""
    sampled, edge, source = expected
    different = (_ids(actual) != _ids(sampled)).any(axis=(0, -1)) | (_covered(actual) != _covered(sampled)).any(axis=0)
    inside = different & ~edge
    claim(
        not inside.any(),
        f"{what}: {inside.sum()} of {(~edge).sum()} pixels inside have other triangles than {source}, the first at "
        f"{tuple(np.argwhere(inside)[0].tolist()) if inside.any() else ()} of the grid",
    )
    off = _off(actual, sampled) & ~different
    claim(not off.any(), f"{what}: the depth of {off.sum()} samples is not that of {source}, by more than 1e-5 of it")
    return Silhouettes(int(edge.sum()), int((different & edge).sum()))


def is_of_triangles(part: Part) -> bool:
    """True if the part's surface has triangles."""
    return isinstance(scenes.checked(part).surface, TriangleSurface)


def _edges(sampled: Sampled) -> np.ndarray:
    """Mask (H, W) bool of pixels whose number of layers differs from a neighbour's."""
    count = np.pad(_covered(sampled).sum(axis=0), 1, mode="edge")
    height, width = scenes.GRID
    around = np.stack([count[i : i + height, j : j + width] for i in range(3) for j in range(3)])
    return (around != around[4]).any(axis=0)


def _covered(sampled: Sampled) -> np.ndarray:
    return np.asarray(sampled.row) >= 0


def _off(actual: Sampled, expected: Sampled) -> np.ndarray:
    """Mask (K, H, W) bool of cells whose depths differ by more than 1e-5 of the expected depth."""
    depth, other = np.asarray(actual.depth), np.asarray(expected.depth)
    return np.abs(depth - other) > 1e-5 * other


def differing(actual: Sampled, expected: Sampled) -> np.ndarray:
    """Mask (K, H, W) bool of cells with different ids or depths."""
    return (_ids(actual) != _ids(expected)).any(axis=-1) | _off(actual, expected)


def _ids(sampled: Sampled) -> np.ndarray:
    """Ids (K, H, W, I) in each cell; −1 in empty ones."""
    row = np.asarray(sampled.row)
    return np.where((row >= 0)[..., None], np.asarray(sampled.samples[0].ids)[row], -1)
