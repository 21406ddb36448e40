"""Claims about the samples of one part, for surfaces and for samplers."""

from __future__ import annotations

import numpy as np

from rts import Camera, Part
from rts.results import Sampled
from rts_testing.claims import claim
from rts_testing.compatibility import BORDER
from rts_testing.scenes import GRID, SIZE

REPROJECTION = 0.02
"""The largest distance of a sample from its pixel's centre, pixels: rounding of float32 positions."""

RESIDUAL = 0.25
"""The limit, pixels, for the few samples at edges of curved surfaces that no refinement can move to the centre."""

FEW = 0.03
"""The share of samples that may be beyond a stricter limit."""


def claim_reprojected(part: Part, sampled: Sampled, camera: Camera, view: str) -> None:
    """Fail unless the part, evaluated at its samples, lies at the centres of their pixels, at their depth.

    `FEW` may be off by more than `REPROJECTION`, none by more than `RESIDUAL`. Samples that are not centred pass.
    """
    samples = sampled.samples[0]
    if not samples.centered:
        return
    row = np.asarray(samples.row)
    k, y, x = np.nonzero(row >= 0)
    if not len(k):
        return
    position = np.asarray(part.surface.evaluate(part.theta, samples)["position"], np.float64)
    seen = camera.within(part.transform).with_border(SIZE, BORDER).project(position, GRID)[row[k, y, x]]
    off = np.linalg.norm(seen[:, :2] - np.stack([x + 0.5, y + 0.5], -1), axis=1)
    claim(
        off.max() <= RESIDUAL and np.mean(off > REPROJECTION) <= FEW,
        f"{view}: samples are off the centres of their pixels by up to {off.max():.3g} px, {np.median(off):.3g} px in "
        f"the middle; are rows flipped, or shifted by half a pixel, ids those of other triangles, or parameters not "
        f"corrected for perspective?",
    )
    depth = np.asarray(samples.depth)[k, y, x]
    wrong = np.abs(seen[:, 2] - depth) > 1e-4 * np.abs(depth) + RESIDUAL * (off > REPROJECTION)
    claim(
        np.mean(wrong) <= FEW,
        f"{view}: the depth of {wrong.sum()} of {len(wrong)} samples is not that of the surface; expected the distance "
        f"along the camera's axis",
    )


def claim_ordered(sampled: Sampled, view: str) -> None:
    """Fail unless the layers of every pixel are front to back, without gaps."""
    samples = sampled.samples[0]
    covered, depth = np.asarray(samples.row) >= 0, np.asarray(samples.depth)
    claim(not (covered[1:] & ~covered[:-1]).any(), f"{view}: a pixel has a layer behind an empty one")
    both = covered[1:] & covered[:-1]
    wrong = both & (depth[1:] < depth[:-1] * (1 - 1e-4))
    claim(not wrong.any(), f"{view}: {wrong.sum()} pixels have a layer before the one in front of it")


def claim_empty_where_empty(sampled: Sampled, view: str) -> None:
    """Fail unless no two cells share a row, empty cells have row −1 and depth 0, and samples a positive depth."""
    samples = sampled.samples[0]
    row, depth = np.asarray(samples.row), np.asarray(samples.depth)
    claim(row.min() >= -1, f"{view}: row holds {row.min()}; expected −1 where a cell is empty")
    claim(row.max() < len(samples.ids), f"{view}: row holds {row.max()}, but there are {len(samples.ids)} samples")
    used = row[row >= 0]
    claim(len(np.unique(used)) == len(used), f"{view}: cells share a sample; expected one row for each")
    claim((depth[row < 0] == 0).all(), f"{view}: depth is not 0 where cells are empty")
    claim((depth[row >= 0] > 0).all(), f"{view}: a sample is at or behind the camera")
