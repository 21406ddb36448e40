"""Claims about surfaces that find their own points: by `refine`, or by intersecting rays."""

from __future__ import annotations

from typing import Any

import numpy as np

from rts import Camera, Engine, Part, RaySurface, TriangleSurface
from rts.errors import InputError
from rts.plugin_api.arrays import Array, Tree, map_leaves
from rts.plugin_api.records import Proxy
from rts.tool_api.plugins import check_sampler
from rts.tool_api.scenes import pack_fragments, refined
from rts_testing import derivatives, scenes
from rts_testing.claims import claim, claim_finite, no_error
from rts_testing.proxy_claims import inputs_of
from rts_testing.sample_claims import FEW, REPROJECTION, RESIDUAL
from rts_testing.scenes import GRID, LAYERS

DEEP = 5
"""Layers of rays that are cast in both directions."""

BEYOND, NOWHERE = 6.0, 1e3
"""Distance behind the last hit at which the ray back begins, beyond everything; and a distance that means no hit."""

SHORT = 2e-3
"""Distance before a hit at which the second ray begins, in units of depth."""

GROWN = 1.15
"""The factor by which triangles are enlarged, so that rays at outlines miss the surface inside."""

MISSED = 0.01
"""The share of hits that the second ray may miss: those where rays touch the surface."""


def claim_refined(part: Part, surface: TriangleSurface, camera: Camera, view: str) -> None:
    """Fail unless `refine` drops each sample, or leaves it at its depth on its ray, to within `RESIDUAL` pixels."""
    local = camera.within(part.transform).map(lambda m: np.asarray(m, np.float64))
    inputs = inputs_of(part, surface)
    off = _off_rays(part, surface, inputs, surface.proxy(inputs, local, GRID), local, view)
    allowed = FEW if surface.centered else 1.0
    claim(
        off.max() <= RESIDUAL and np.mean(off > REPROJECTION) <= allowed,
        f"{view}: refine leaves samples up to {off.max():.3g} px, {np.median(off):.3g} px in the middle, from "
        f"the point of their ray at their depth; move params and depth together, or set rows to −1 where a ray misses",
    )


def _off_rays(part: Part, surface: TriangleSurface, inputs: Tree, proxy: Proxy, local: Camera, view: str) -> np.ndarray:
    """Distances (M,) of refined samples from their rays, pixels, each at the sample's depth; [0] if none are left.

    Args:
        part: the part.
        surface: its surface.
        inputs: the result of `proxy_inputs`.
        proxy: the triangles to start from.
        local: the camera, in the part's local space.
        view: the name of the view, for messages.
    """
    sampler: Any = check_sampler("reference")
    unrefined = pack_fragments(sampler.rasterize(proxy, local, GRID, LAYERS, part.cull), proxy)
    try:
        samples, rays = refined(surface, inputs, unrefined, local, surface.table_specs(len(unrefined.ids), None))
    except InputError as error:
        raise AssertionError(f"{view}: {error}") from error
    cells = samples.row >= 0
    row, depth = samples.row[cells], samples.depth[cells].astype(np.float64)
    if not len(row):
        return np.zeros(1)
    position = np.asarray(surface.evaluate(part.theta, samples)["position"], np.float64)[row]
    claim_finite(position, f"{view}: the surface where refine has put samples")
    point = rays.origins[row] + depth[:, None] * rays.directions[row]
    return np.linalg.norm(position - point, axis=1) / (rays.spread[0] + rays.spread[1] * depth)


def claim_misses_dropped(part: Part, surface: TriangleSurface) -> None:
    """Fail unless `refine` drops samples whose rays meet triangles, enlarged by `GROWN`, but miss the surface."""
    local = scenes.CAMERA.within(part.transform).map(lambda m: np.asarray(m, np.float64))
    inputs = inputs_of(part, surface)
    proxy = surface.proxy(inputs, local, GRID)
    middle = (proxy.vertices.max(axis=0) + proxy.vertices.min(axis=0)) / 2
    grown = proxy._replace(vertices=np.asarray(middle + GROWN * (proxy.vertices - middle), np.float32))
    off = _off_rays(part, surface, inputs, grown, local, "with triangles that are too large")
    claim(
        off.max() <= RESIDUAL and np.mean(off > REPROJECTION) <= (FEW if surface.centered else 1.0),
        f"refine keeps {np.sum(off > REPROJECTION)} of {len(off)} samples up to {off.max():.3g} px off their "
        f"rays where triangles are {GROWN - 1:.0%} too large; set rows to -1 where a ray misses the surface",
    )


def _rays_of(part: Part, camera: Camera) -> tuple[Tree, np.ndarray, np.ndarray]:
    """θ in float32; and origins on the near plane and directions (R, 3) of a part's rays, local space."""
    local = camera.within(part.transform)
    rays = local.rays(GRID)
    directions = rays.directions.reshape(-1, 3).astype(np.float32)
    origins = (rays.origins.reshape(-1, 3) + float(local.depth_range()[0]) * directions).astype(np.float32)
    return map_leaves(derivatives.single, part.theta), origins, directions


def claim_compiled(part: Part, surface: RaySurface, engine: Engine) -> None:
    """Fail unless a compiled call hits with the same rays, all but a share `FEW`."""
    theta, origins, directions = _rays_of(part, scenes.CAMERA)
    expected = np.asarray(surface.intersect(theta, origins, directions, LAYERS).hit)
    values, join = derivatives.split(part.theta)

    def hit(x: list, start: Array, way: Array) -> Array:
        return surface.intersect(derivatives.joined(engine, join, x), start, way, LAYERS).hit

    with no_error(f"intersect compiled by {engine.name}"):
        found = engine.to_numpy(engine.jit(hit)(*derivatives.on(engine, (values, origins, directions))))
    wrong = int((found != expected).sum())
    claim(
        wrong <= FEW * expected.size, f"intersect compiled by {engine.name} differs at {wrong} of {expected.size} hits"
    )


def claim_found_again(part: Part, surface: RaySurface, camera: Camera, view: str) -> None:
    """Fail unless rays that begin just before hits hit there again, all but a share `MISSED`."""
    theta, origins, directions = _rays_of(part, camera)
    hits = surface.intersect(theta, origins, directions, LAYERS)
    hit, distance = np.asarray(hits.hit), np.asarray(hits.distance)
    claim_finite((distance, np.asarray(hits.params)), f"{view}: what intersect gives, also where nothing is hit,")
    missed, total, worst = 0, 0, 0.0
    for k in range(len(hit)):
        # Hits with another one just before them are left out.
        distinct = distance[k] - (distance[k - 1] if k else 0) > 2 * SHORT
        rays_hit = np.flatnonzero(hit[k] & distinct)
        if not len(rays_hit):
            continue
        start = origins[rays_hit] + (distance[k, rays_hit] - SHORT)[:, None] * directions[rays_hit]
        again = surface.intersect(theta, start.astype(np.float32), directions[rays_hit], 1)
        off = np.abs(np.where(np.asarray(again.hit)[0], np.asarray(again.distance)[0] - SHORT, np.inf))
        missed, total = missed + int((off > SHORT / 2).sum()), total + len(rays_hit)
        worst = max(worst, float(off.max()))
    claim(
        missed <= MISSED * total,
        f"{view}: from {SHORT:g} before them, intersect misses {missed} of {total} hits; does it step through the "
        f"surface, or leave out what is near the origin of a ray?",
    )


def claim_found_from_behind(part: Part, surface: RaySurface, camera: Camera, view: str) -> None:
    """Fail unless rays cast back, from behind all hits, hit at the same places, all but a share `FEW`."""
    theta, origins, directions = _rays_of(part, camera)
    hits = surface.intersect(theta, origins, directions, DEEP)
    hit, distance = np.asarray(hits.hit), np.where(hits.hit, hits.distance, -np.inf)
    # Rays whose hits are all known: the last layer is empty.
    rays_hit = np.flatnonzero(hit[0] & ~hit[-1])
    last = distance.max(axis=0)[rays_hit] + BEYOND
    back = surface.intersect(
        theta, origins[rays_hit] + last[:, None] * directions[rays_hit], -directions[rays_hit], DEEP
    )
    there = np.where(hit[:, rays_hit], distance[:, rays_hit], NOWHERE)
    again = np.where(np.asarray(back.hit), last - np.asarray(back.distance), NOWHERE)
    again = np.where(again < 0, NOWHERE, again)  # Hits nearer than the near plane, where the first rays began.
    wrong = np.any(np.abs(np.sort(there, axis=0) - np.sort(again, axis=0)) > 1e-2, axis=0)
    claim(
        wrong.sum() <= FEW * len(wrong),
        f"{view}: {wrong.sum()} of {len(wrong)} rays hit other places when they come from behind; does intersect miss "
        f"some?",
    )
