"""Surfaces in NDC (see `ndc`), mapped to the world: so a camera draws a forward-facing radiance field.

The map between NDC and the world keeps planes and straight lines, so triangles stay triangles; but it does not keep the
middle of a side. If λ_k are barycentrics of a point in the world, and d_k the depths of the triangle's corners, its
barycentrics in NDC are λ_k d_k, divided by their sum.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from rts import GBuffer, InputError, Part, TriangleSurface, namespace
from rts.plugin_api.arrays import Array, Tree, unit
from rts.plugin_api.checks import quoted
from rts.plugin_api.records import ArraySpec, Proxy, Rays, Samples
from rts_surfaces.radiance_field.ndc import Ndc

DEEPEST = 1e4
"""Depth, in multiples of the near plane's, beyond which triangles are left out: rounding would move them too far."""


class Projected(TriangleSurface):
    """A surface in NDC, mapped to the world: its triangles, its points and its normals, differentiable in θ.

    The G-buffer has position and normal, if the surface in NDC has them, in the world; further entries are unchanged.

    Args:
        surface: a surface in NDC, such as an isosurface. Its triangles must not depend on the camera. Before `refine`
            its samples have two parameters, the barycentrics; `refine` must not move samples.
        ndc: the map between the world and NDC.

    Raises:
        InputError: the surface is not of this kind, or `ndc` is no `Ndc`.
    """

    refine_moves = False

    def __init__(self, surface: Any, ndc: Ndc):
        fits = isinstance(surface, TriangleSurface) and surface.refines
        if not fits or surface.depends_on_view or surface.refine_moves:
            raise InputError(
                f"surface is {quoted(surface)}; expected one of triangles that no camera changes, such as an isosurface"
            )
        if not isinstance(ndc, Ndc):
            raise InputError(f"ndc is {quoted(ndc)}; expected an rts.Ndc")
        self.surface, self.ndc = surface, ndc
        self.sample_widths, self.centered = surface.sample_widths, surface.centered
        self.proxy_is_cheap = surface.proxy_is_cheap

    def __repr__(self) -> str:
        return f"Projected({self.surface!r})"

    @classmethod
    def example(cls) -> Part:
        """A ball, as an isosurface in NDC: two units in front of the eye of NDC, and moved to the origin."""
        from rts_surfaces.implicit.isosurface import Isosurface

        ndc = Ndc((1.5, 1.5), near=1.0)
        axes = [np.linspace(-1, 1, 25), np.linspace(-1, 1, 25), np.linspace(-0.8, 0.6, 25)]
        points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        values = np.linalg.norm(ndc.to_world(points) + [0, 0, 2], axis=1) - 0.7
        surface = Isosurface(((-1, -1, -0.8), (1, 1, 0.6)))
        theta = {"values": values.reshape(25, 25, 25).astype(np.float32)}
        move = np.eye(4)
        move[2, 3] = 2
        return Part(cls(surface, ndc), theta, "normals", transform=move)

    def check(self, theta: Mapping[str, Tree]) -> None:
        """Refuse θ that the surface in NDC refuses."""
        self.surface.check(theta)

    def reads(self, theta: Mapping[str, Tree]) -> tuple[str, ...]:
        """The entries that the surface in NDC reads."""
        return self.surface.reads(theta)

    def proxy_inputs(self, theta: Mapping[str, Tree]) -> Tree:
        """The inputs of the surface in NDC."""
        return self.surface.proxy_inputs(theta)

    def proxy(self, inputs: Tree, camera: Any, size: tuple[int, int]) -> Proxy:
        """The surface's triangles in the world, without those with a corner deeper than `DEEPEST` near planes.

        Each triangle has three more ids: the depths of its corners, float32, their bits read as int32.
        """
        inner = self.surface.proxy(inputs, camera, size)
        vertices = np.asarray(inner.vertices, np.float64)
        world = self.ndc.to_world(vertices)
        # NDC are a mirror image of the world: z grows with depth.
        faces = np.ascontiguousarray(inner.faces[:, ::-1])
        depths = (-world[:, 2]).astype(np.float32)[inner.faces]
        assert inner.ids is not None, "surfaces that refine samples say what these carry"
        kept = (depths < DEEPEST * self.ndc.near).all(axis=1)
        ids = np.concatenate([inner.ids, depths.view(np.int32)], axis=1)
        return Proxy(world.astype(np.float32), faces[kept], np.ascontiguousarray(ids[kept]))

    def refine(self, inputs: Tree, samples: Samples, rays: Rays) -> Samples:
        """Samples refined by the surface in NDC, with its ids and its params.

        Before, the three depths are dropped from `ids`, and the barycentrics become those in NDC.
        """
        depths = np.ascontiguousarray(samples.ids[:, -3:]).view(np.float32).astype(np.float64)
        second, third = samples.params[:, 1].astype(np.float64), samples.params[:, 0].astype(np.float64)
        shares = np.stack([1 - second - third, second, third], axis=1) * np.maximum(depths, 1e-30)
        shares /= shares.sum(axis=1, keepdims=True)
        within = replace(
            samples,
            ids=np.ascontiguousarray(samples.ids[:, :-3]),
            params=shares[:, :2].astype(samples.params.dtype),
        )
        return self.surface.refine(inputs, within, rays)

    def table_specs(self, rows: int, capacity: int | None) -> Mapping[str, ArraySpec]:
        """The tables of the surface in NDC."""
        return self.surface.table_specs(rows, capacity)

    def why_no_triangles(self, inputs: Tree) -> str:
        """The reason that the surface in NDC gives."""
        return self.surface.why_no_triangles(inputs)

    def evaluate(self, theta: Mapping[str, Tree], samples: Samples) -> GBuffer:
        """The surface's points in the world, with their normals and further entries."""
        within = self.surface.evaluate(theta, samples)
        position = self.ndc.to_world(within["position"])
        gbuffer = GBuffer(position=position)
        for name in within:
            if name == "normal":
                gbuffer.defer(name, lambda: self._normals(position, within["normal"]))
            elif name != "position":
                gbuffer.defer(name, lambda name=name: within[name])
        return gbuffer

    def _normals(self, position: Array, normals: Array) -> Array:
        """Unit normals (N, 3) in the world, from those in NDC (N, 3), at positions (N, 3) in the world.

        They are multiplied by the transposed Jacobian of the map from the world to NDC.
        """
        xp, (x_scale, y_scale) = namespace(position), self.ndc.scale
        x, y, depth = position[:, 0], position[:, 1], -position[:, 2]
        a, b = x_scale * normals[:, 0], y_scale * normals[:, 1]
        along = (a * x + b * y - 2 * self.ndc.near * normals[:, 2]) / depth
        return unit(xp.stack([a, b, along], axis=1))
