"""Claims about normals: they are perpendicular to the surface, or in the mean to its triangles."""

from __future__ import annotations

from typing import Any

import numpy as np

from rts import Part, TriangleSurface
from rts.plugin_api.arrays import map_leaves
from rts.plugin_api.records import Samples
from rts_testing import derivatives, scenes
from rts_testing.claims import claim
from rts_testing.sample_claims import FEW

STEP = 2**-8
"""The step of the two parameters of samples."""

SHIFT = 0.1
"""The shift of images, pixels, for samples that do not have two parameters."""

UPRIGHT, LARGEST = 3.0, 10.0
"""Degrees by which normals may lean: the median, and the ninth decile."""

NEAR = 0.3
"""The largest distance of two samples of one sheet."""

SPREAD, TILT = 0.6, 0.1
"""The lean allowed to normals of triangles: as a share of the angle between neighbours, and of their unit mean."""


def claim_upright(part: Part, sampler: Any) -> None:
    """Fail if normals, but for `FEW`, are zero, or not perpendicular to a surface that is not made of triangles.

    Surfaces without normals pass.
    """
    surface = scenes.checked(part).surface
    flat = isinstance(surface, TriangleSurface) and not (surface.refines and surface.refine_moves)
    part = part.replace(theta=map_leaves(derivatives.single if flat else wide, part.theta))
    sampled = scenes.find(part, sampler=sampler)
    samples, front = sampled.samples[0], np.asarray(sampled.row)
    gbuffer = part.surface.evaluate(part.theta, samples)
    if "normal" not in gbuffer:
        return
    rows = np.sort(front[front >= 0])
    normal = np.asarray(gbuffer["normal"], np.float64)[rows]
    length = np.linalg.norm(normal, axis=1)
    zero = ~(length > 0)
    claim(zero.mean() <= FEW, f"{zero.sum()} of {len(zero)} normals are zero, or not finite, where the surface is seen")
    if flat:
        return
    true = _perpendicular(part, sampler, samples)
    if true is None:
        return
    comparable = ~zero & (np.linalg.norm(true[rows], axis=1) > 0)
    lean = angles(normal[comparable], true[rows][comparable])
    middle, most = np.quantile(lean, (0.5, 0.9))
    claim(
        middle <= UPRIGHT and most <= LARGEST,
        f"normals lean by {middle:.2g}° in the middle, and a tenth of them by {most:.2g}° or more, against what is "
        f"perpendicular to the surface as `position` changes from sample to sample; see 'normal' in evaluate",
    )


def claim_upright_on_triangles(normals: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> None:
    """Fail if the mean normals of triangles' corners lean too far, in the median, from the triangles' own normals.

    They may lean by a share `SPREAD` of the angle between neighbours.

    Args:
        normals: (3, T, 3), at the corners of the triangles; of any length.
        vertices: (V, 3).
        faces: (T, 3).
    """
    corners = vertices[faces].astype(np.float64)
    outward = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    smooth = np.zeros(vertices.shape)
    for i in range(3):
        np.add.at(smooth, faces[:, i], outward)
    normal, seen = unit(normals.astype(np.float64)), np.linalg.norm(outward, axis=1) > 0
    zero = (normal == 0).all(axis=-1)
    claim(zero.mean() <= FEW, f"{zero.sum()} of {zero.size} normals at the corners of triangles are zero")
    curvature = np.median([angles(smooth[faces[seen, i]], outward[seen]) for i in range(3)])
    lean = np.median(angles(normal.mean(axis=0)[seen], outward[seen]))
    tilt = np.linalg.norm((normal.mean(axis=0) - unit(outward))[seen].mean(axis=0))
    claim(
        lean <= max(UPRIGHT, SPREAD * curvature) and tilt <= TILT,
        f"normals of triangles lean by {lean:.2g}°, where those of neighbours differ by {curvature:.2g}°, and by "
        f"{tilt:.2g} to one side; see 'normal' in evaluate",
    )


def normals_at(part: Part, samples: Samples) -> np.ndarray | None:
    """Unit normals (N, 3) at samples: by slopes in their two parameters, else the surface's own, if any, or None."""
    if samples.params.shape[1] == 2:
        return _by_parameters(part, samples)
    gbuffer = part.surface.evaluate(part.theta, samples)
    return unit(np.asarray(gbuffer["normal"], np.float64)) if "normal" in gbuffer else None


def wide(x: Any) -> np.ndarray:
    """An array of floats as float64; anything else as it is."""
    x = np.asarray(x)
    return x.astype(np.float64) if np.issubdtype(x.dtype, np.floating) else x


def angles(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Degrees between lines along vectors (N, 3), from 0 to 90."""
    return np.degrees(np.arccos(np.clip(np.abs(np.sum(unit(one) * unit(other), axis=-1)), 0, 1)))


def unit(x: np.ndarray) -> np.ndarray:
    """Vectors scaled to unit length; zeros stay zero."""
    length = np.linalg.norm(x, axis=-1, keepdims=True)
    return x / np.where(length > 0, length, 1)


def _by_parameters(part: Part, samples: Samples) -> np.ndarray:
    """∂position/∂u × ∂position/∂v, of unit length; zero where it is degenerate."""
    tangents = []
    for i in range(2):
        step = STEP * np.eye(2)[i]
        ends = [samples.replace(params=np.asarray(samples.params, np.float64) + sign * step) for sign in (1, -1)]
        plus, minus = (np.asarray(part.surface.evaluate(part.theta, s)["position"], np.float64) for s in ends)
        tangents.append(plus - minus)
    return unit(np.cross(*tangents))


def _perpendicular(part: Part, sampler: Any, samples: Samples) -> np.ndarray | None:
    """Unit normals (N, 3) by `_by_parameters` or, without two parameters, of fronts in slightly shifted images.

    Zero where unknown; None for samples that have neither two parameters nor the centres of pixels.
    """
    if samples.params.shape[1] == 2:
        return _by_parameters(part, samples)
    if not samples.centered:
        return None
    rows, tangents = np.asarray(samples.row), []
    good = np.ones(rows.shape[1:], bool)
    for axis in range(2):
        ends = []
        for sign in (1, -1):
            moved = scenes.find(part, scenes.shifted(scenes.CAMERA, sign * SHIFT, axis), sampler).samples[0]
            row = np.asarray(moved.row)[0]
            position = np.asarray(part.surface.evaluate(part.theta, moved)["position"], np.float64)
            good &= row >= 0
            ends.append(position[np.maximum(row, 0)])
        tangents.append(ends[0] - ends[1])
        # A pair on two sheets does not count.
        good &= np.linalg.norm(tangents[-1], axis=-1) < NEAR
    normals, good = np.zeros((len(samples.ids), 3)), good & (rows[0] >= 0)
    normals[rows[0][good]] = unit(np.cross(*tangents))[good]
    return normals
