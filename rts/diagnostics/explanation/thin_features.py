"""Masks of pixels with shapes thinner than a sample, and of pixels with outlines."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from rts.arrays.engines import engine_of
from rts.contracts.records import Sampled

FINE, CELLS = 8, 2**22
"""Cells along each side of a sample, fine enough to show thinner shapes; and the most cells in all."""
JUMP, FLAT = 0.05, 1e-3
"""A jump of depth: the least change from cell to cell, as a share of the span of all depths, and of the depth."""
CORNER = 0.1
"""The share of a pixel that disks may leave uncovered at corners without a thin shape."""


class Fineness(NamedTuple):
    """Two masks (H, W) bool.

    Attributes:
        thin: the pixels around shapes, and gaps between shapes, that are thinner than a sample.
        outlines: the pixels around outlines.
    """

    thin: np.ndarray
    outlines: np.ndarray


def fineness(sampled: Callable[..., Sampled], size: tuple[int, int], taken: int) -> Fineness:
    """Masks of the pixels around thin shapes, and thin gaps between shapes, and of those around outlines.

    Found by one finer sampling of the front layer, with 2 to 8 times `taken` samples along each axis of a pixel. The
    masks reach three pixels beyond thin places, and two beyond outlines.

    Args:
        sampled: calls `rts.sample` of the scene at this size with the options that it is given: layers and supersample.
        size: (height, width) in pixels.
        taken: samples along each axis of a pixel; thinner than one of these is thin.
    """
    from scipy.ndimage import binary_dilation

    height, width = size
    across = min(FINE, max(2, int((CELLS / (height * width)) ** 0.5 / taken)))  # Cells a sample.
    fine = across * taken
    samples = sampled(layers=1, supersample=fine)
    apron = samples.apron
    part, depth = (on_host(x)[0, apron:-apron, apron:-apron] for x in (samples.part, samples.depth))
    jump = max(JUMP * np.ptp(depth[part >= 0]), FLAT * depth.max()) if (part >= 0).any() else 0.0
    jumps = np.zeros(part.shape, bool)
    for axis in (0, 1):
        change = (np.diff(part, axis=axis) != 0) | (np.abs(np.diff(depth, axis=axis)) > jump)
        jumps |= np.pad(change, [(0, 1) if i == axis else (0, 0) for i in (0, 1)])

    def pixels(mask: np.ndarray, least: float) -> np.ndarray:
        return mask.reshape(height, fine, width, fine).mean(axis=(1, 3)) > least

    thin: Any = binary_dilation(pixels(_thinner(part, across), CORNER), iterations=3)
    outlines: Any = binary_dilation(pixels(jumps, 0), iterations=2)
    return Fineness(thin, outlines)


def _thinner(part: np.ndarray, across: int) -> np.ndarray:
    """Mask (h, w) bool of the cells in shapes, or in gaps between shapes, too thin to hold a disk.

    Args:
        part: (h, w) integers, the part that each cell shows; −1 in gaps.
        across: diameter of the disk, cells.
    """
    from scipy.ndimage import binary_opening, find_objects

    disk = np.hypot(*np.indices((across, across)) - (across - 1) / 2) <= across / 2 - 0.5
    thin, labels = np.zeros(part.shape, bool), part.astype(np.int32) + 2  # -1 where there is no part.
    for label, box in enumerate(find_objects(labels), 1):
        if box is None:
            continue
        window = tuple(slice(max(0, b.start - across), b.stop + across) for b in box)
        mask = np.pad(labels[window] == label, across, mode="edge")
        opened: Any = binary_opening(mask, disk)
        thin[window] |= (mask & ~opened)[across:-across, across:-across]
    return thin


def on_host(x: Any) -> np.ndarray:
    """An array of any engine as NumPy."""
    return engine_of(x).to_numpy(x)
