"""Claims about proxies, the triangles by which samplers find a surface."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from rts import Part, TriangleSurface
from rts.plugin_api.arrays import Tree, map_leaves
from rts.plugin_api.records import Cells, Proxy, Samples
from rts_testing import derivatives, scenes
from rts_testing.claims import claim, claim_close
from rts_testing.normal_claims import claim_upright_on_triangles

VIEWS = {"a view": scenes.CAMERA, "another": scenes.AXES[0], "one from afar": scenes.AFAR}


def triangles_of(part: Part) -> TriangleSurface:
    """The part's surface; skip the test if it has no triangles."""
    surface = scenes.checked(part).surface
    if not isinstance(surface, TriangleSurface):
        pytest.skip("the surface has no triangles")
    return surface


def inputs_of(part: Part, surface: TriangleSurface) -> Tree:
    """The result of `proxy_inputs` for a part's θ in float32."""
    return map_leaves(np.asarray, surface.proxy_inputs(map_leaves(derivatives.single, part.theta)))


def claim_corners(part: Part, surface: TriangleSurface, when: str) -> None:
    """Fail unless triangles' corners evaluate to themselves, most normals face as triangles do, and `face_count` holds.

    Skipped after `face_count` for surfaces whose `refine` makes samples of another form.
    """
    proxy = surface.proxy(inputs_of(part, surface), scenes.CAMERA, scenes.SIZE)
    count = surface.face_count
    claim(count in (None, len(proxy.faces)), f"face_count is {count}; proxy gives {len(proxy.faces)} triangles{when}")
    first = _at_corner(proxy, 0)
    widths = first.ids.shape[1], first.params.shape[1]
    if surface.refines and (widths != tuple(surface.sample_widths) or surface.table_specs(1, 1)):
        pytest.skip("refine makes samples of what the triangles carry")
    corners = proxy.vertices[proxy.faces].astype(np.float64)
    outward, normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), []
    for i in range(3):
        gbuffer = part.surface.evaluate(part.theta, _at_corner(proxy, i))
        off = 1e-5 * max(1, np.abs(proxy.vertices).max())
        position = np.asarray(gbuffer["position"])
        claim_close(position, corners[:, i], off, f"the surface at corner {i} of its triangles{when}")
        if "normal" in gbuffer:
            normals.append(np.asarray(gbuffer["normal"]))
            inward = np.sum(normals[i] * outward, axis=1) < 0
            claim(inward.mean() < 0.05, f"{inward.mean():.0%} of the normals face the inside of the triangles{when}")
    if normals and not surface.refines:
        claim_upright_on_triangles(np.stack(normals), proxy.vertices, proxy.faces)


def claim_keys_tell_views(part: Part, surface: TriangleSurface) -> None:
    """Fail if triangles differ between two of `VIEWS`, each in two sizes, with one key."""
    inputs = inputs_of(part, surface)
    views = {
        f"{view} of {scale * scenes.SIZE[0]} rows": (camera, (scale * scenes.SIZE[0], scale * scenes.SIZE[1]))
        for view, camera in VIEWS.items()
        for scale in (1, 4)
    }
    first: dict[Any, tuple[str, Proxy]] = {}
    for view, (camera, size) in views.items():
        key = surface.proxy_key(inputs, camera, size) if surface.depends_on_view else None
        proxy = surface.proxy(inputs, camera, size)
        other, before = first.setdefault(key, (view, proxy))
        entries: Any = zip(Proxy._fields, before, proxy, strict=True)
        differing = [name for name, one, two in entries if not np.array_equal(one, two)]
        claim(
            not differing,
            f"{' and '.join(differing)} of the triangles differ between {other} and {view}, but "
            + ("proxy_key is the same" if surface.depends_on_view else "there is no proxy_key"),
        )


def _at_corner(proxy: Proxy, i: int) -> Samples:
    """One sample for each triangle, at its corner i."""
    count = len(proxy.faces)
    weights = np.broadcast_to(np.eye(3, 2, dtype=np.float32)[i], (count, 2))
    row = np.arange(count, dtype=np.int32).reshape(1, 1, -1)
    return Samples(
        proxy.faces if proxy.ids is None else proxy.ids,
        weights if proxy.corner_params is None else proxy.corner_params[:, i],
        Cells(row, np.ones_like(row, dtype=np.float32)),
        np.int32(0),
    )
