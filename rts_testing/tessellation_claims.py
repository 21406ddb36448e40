"""Claims about meshes of surfaces, and about their coarser and finer forms."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from rts import Part, Surface, TriangleSurface
from rts.errors import InputError
from rts.plugin_api.arrays import map_leaves
from rts.plugin_api.records import Rate
from rts_testing import derivatives, scenes
from rts_testing.claims import claim, claim_finite, no_error

CUTS = 4, 8
"""Cuts along each side of a patch: twice as many make four times the triangles, at a quarter of the distance."""

FOURFOLD = 3.4, 5.0
"""Limits of the ratio of triangles, many cuts to few."""

NEARER, EXACT = 0.5, 2e-4
"""The share of the distance that may remain at twice the rate, and the distance that counts as none."""

OFF = 0.02
"""A rate that is not a number of cuts: the largest distance of a mesh from the surface, in the units of θ."""


def claim_tessellated(part: Part, surface: TriangleSurface, sampler: Any) -> None:
    """Fail unless `tessellate` gives sound meshes: at more cuts nearer to the surface, of more triangles or as many.

    Skipped for surfaces without a `tessellate` that refine samples or depend on the view.
    """
    own = type(surface).tessellate is not TriangleSurface.tessellate
    if not own and (surface.refines or surface.depends_on_view):
        pytest.skip("the surface has no tessellate")
    part = part.replace(theta=map_leaves(derivatives.single, part.theta))
    depths = _front(part, sampler)
    off, count = {}, {}
    for rate in (*CUTS, OFF):
        with no_error(f"tessellate at rate {rate}"):
            vertices, faces = surface.tessellate(part.theta, rate)
        _claim_mesh(vertices, faces, f"tessellate at rate {rate}")
        mesh = scenes.mesh(vertices, faces, transform=part.transform)
        off[rate], count[rate] = _apart(depths, _front(mesh, "auto")), len(faces)
    few, many = CUTS
    more = count[many] / count[few]
    claim(
        more == 1 or FOURFOLD[0] <= more <= FOURFOLD[1],
        f"tessellate gives {count[few]} triangles at rate {few}, {count[many]} at {many}; expected four times as many",
    )
    claim(
        off[many] <= max(NEARER * off[few], EXACT),
        f"meshes by tessellate are {off[few]:.2g} off the surface at rate {few}, {off[many]:.2g} at {many}; expected a "
        f"quarter: are their vertices on the surface, and more at a higher rate?",
    )
    claim(off[OFF] <= 2 * OFF, f"the mesh by tessellate at rate {OFF}, a distance, is {off[OFF]:.2g} off the surface")


def claim_rates(part: Part, sampler: Any) -> None:
    """Fail unless each of `rates` gives a form of the surface, and twice the work or more comes nearer to it."""
    part = part.replace(theta=map_leaves(derivatives.single, part.theta))
    depths, off = _front(part, sampler), []
    for rate in part.surface.rates(part.theta):
        _claim_rate(rate)
        with no_error(f"the rate {rate.setting}"):
            theta = part.theta if rate.theta is None else rate.theta(part.theta)
            other = part.replace(surface=rate.surface, theta=theta)
            off.append((rate.work, _apart(depths, _front(other, sampler)), rate.setting))
    off.sort()
    for i, (less, far, coarse) in enumerate(off):
        for more, near, fine in off[i + 1 :]:
            claim(
                more < 2 * less or near <= max(0.9 * far, EXACT),
                f"the rate {fine}, of work {more:.3g}, is {near:.2g} off the surface; {coarse}, of work {less:.3g}, is "
                f"{far:.2g} off; expected more work to come nearer",
            )


def _claim_rate(rate: Any) -> None:
    claim(isinstance(rate, Rate), f"rates gives {type(rate).__name__}; expected rts.contracts.surface.Rate")
    name, _, value = str(rate.setting).partition("=")
    claim(name.isidentifier() and value, f"a rate's setting is {rate.setting!r}; expected an argument: 'tolerance=0.4'")
    good = isinstance(rate.work, (int, float)) and 0 < rate.work < math.inf
    claim(good, f"the work of the rate {rate.setting} is {rate.work!r}; expected a positive number")
    claim(isinstance(rate.surface, Surface), f"the rate {rate.setting} holds {rate.surface!r}; expected a surface")


def _claim_mesh(vertices: Any, faces: Any, what: str) -> None:
    shapes = np.shape(vertices), np.shape(faces)
    ok = all(len(s) == 2 and s[1] == 3 for s in shapes)
    claim(ok, f"{what} gives arrays of shapes {shapes[0]} and {shapes[1]}; expected (V, 3) and (T, 3)")
    claim_finite(vertices, f"the vertices by {what}")
    low, high = faces.min(initial=0), faces.max(initial=0)
    claim(0 <= low and high < len(vertices), f"{what} gives faces of corners {low} to {high}, {len(vertices)} vertices")


def _front(part: Part, sampler: Any) -> np.ndarray:
    """Depths (H, W) of the front layer; NaN in empty cells."""
    try:
        sampled = scenes.find(part, sampler=sampler)
    except InputError as error:
        raise AssertionError(f"a coarser or finer form is refused: {error}") from error
    return np.where(np.asarray(sampled.row)[0] >= 0, np.asarray(sampled.depth)[0], np.nan)


def _apart(one: np.ndarray, other: np.ndarray) -> float:
    """The median difference of depths (H, W) where both are finite; fails if these are under 30 % of `one`'s cells."""
    difference = np.abs(one - other)
    both = np.isfinite(difference)
    claim(both.sum() >= 0.3 * np.isfinite(one).sum(), "a coarser or finer form is seen elsewhere than the surface")
    return float(np.median(difference[both]))
