"""Surfaces of fields, found by casting rays: of signed distances, and of any other function of space."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial

import numpy as np
from numpy.typing import ArrayLike

from rts import GBuffer, InputError, Part, RaySurface, namespace
from rts.plugin_api.arrays import Array, Tree
from rts.plugin_api.checks import check_numbers, check_positive, is_count, quoted
from rts.plugin_api.records import RayHits, Samples
from rts_surfaces.implicit.casting import cast, moving
from rts_surfaces.implicit.deepest import deepest
from rts_surfaces.implicit.field import Field, Function, Implicit, known_number
from rts_surfaces.implicit.fields import swept_sphere
from rts_surfaces.implicit.regions import ball


class Sdf(Implicit, RaySurface):
    """The surface of a field within a ball, found by rays: of a signed distance, or of any other function of space.

    A sample is the point x₀ where a ray meets the surface, and it moves along the surface's normal as θ changes: its
    position is x₀ − f(θ, x₀) w, with f the field and w = ∇f / |∇f|² at x₀. If it moved along the ray, it would never
    leave its pixel, and outlines would have no derivative.

    The ball cuts off parts of the surface outside of it; it should enclose the surface tightly.

    Args:
        f: (θ, points (M, 3)) → (M,), in array code; see `Field`. `rts_surfaces.implicit.fields` has ready-made ones.
        radius: the radius of the ball, in the units of the points.
        center: (3,), the centre of the ball.
        isovalue: the value of `f` on the surface.
        inside: which values are inside, "below" the isovalue or "above" it.
        lipschitz: a number that the slope of `f` nowhere exceeds, 1 for distances. If it is too small, rays miss parts
            of the surface. None if unknown: rays then take steps of one length, and cost more.
        reads: the names of the entries of θ that `f` reads; None for all.
        attributes: name → g(θ, positions (N, 3)) → (N, C), further entries of the G-buffer; see `Implicit`.
        steps: the number of shortest steps across the ball: parts thinner than one step may be missed, so that sharp
            edges are cut off by some hundredths of a pixel (0.05 at 256², with bounds). More steps cost little; twice
            as many halve it. None for 256 without `lipschitz`, 1024 with it.

    Raises:
        InputError: wrong arguments.
    """

    sample_widths = (0, 7)
    concurrent = False

    def __init__(
        self,
        f: Function,
        radius: float = 2.0,
        center: ArrayLike = (0.0, 0.0, 0.0),
        isovalue: float = 0.0,
        inside: str = "below",
        *,
        lipschitz: float | None = 1.0,
        reads: Sequence[str] | None = None,
        attributes: Mapping[str, Function] | None = None,
        steps: int | None = None,
    ):
        super().__init__(Field(f, isovalue, inside, reads), attributes)
        self.radius = known_number("radius", check_positive("radius", radius))
        known = check_numbers("center", center, (3,))
        if known is None:
            raise InputError("center is traced; expected known numbers: surfaces do not change with theta")
        self.center = known.astype(np.float64)
        self.lipschitz = None
        if lipschitz is not None:
            self.lipschitz = known_number("lipschitz", check_positive("lipschitz", lipschitz))
        if steps is not None and not is_count(steps):
            raise InputError(f"steps is {quoted(steps)}; expected how many there are across the ball, or None")
        self.steps = steps

    def __repr__(self) -> str:
        return f"Sdf({self.field.name}, radius={self.radius:g})"

    @classmethod
    def example(cls) -> Part:
        """A torus."""
        theta = {"radii": np.array([0.9, 0.35], np.float32)}
        return Part(cls(swept_sphere, 1.3, reads=("radii",)), theta, "normals")

    def intersect(self, theta: Mapping[str, Tree], origins: Array, directions: Array, layers: int) -> RayHits:
        """The nearest hits within the ball, in θ's dtype; see `rts.RaySurface`."""
        level = partial(self.field.level, theta)
        return cast(
            level,
            partial(moving, level),
            self.field.in_theta_dtype(theta, origins),
            self.field.in_theta_dtype(theta, directions),
            layers,
            within=ball(self.center, self.radius),
            lipschitz=self.lipschitz,
            steps=self.steps,
        )

    def evaluate(self, theta: Mapping[str, Tree], samples: Samples) -> GBuffer:
        """Positions, "normal" of unit length, outwards, and the attributes."""
        return self.at_hits(theta, samples)

    def deepest(self, theta: Mapping[str, Tree], points: Array, directions: Array, reach: Array) -> tuple[Array, Array]:
        """See `rts.RaySurface`; in θ's dtype."""
        points, directions, reach = (self.field.in_theta_dtype(theta, x) for x in (points, directions, reach))
        level, xp = partial(self.field.level, theta), namespace(points)
        return deepest(level, lambda x: xp.ones_like(x[:, 0], dtype=xp.bool), points, directions, reach)
