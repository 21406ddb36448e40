"""Nine scenes with shadows, for this library and as triangles for Mitsuba: what casts is out of view, but for one."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import trimesh

import rts
from benchmarks.meshes import mesh
from rts_diagnostics.example_shapes import QUAD
from rts_surfaces.implicit.fields import swept_sphere

SIZE = (128, 128)
CAMERA = rts.Camera.look_at((0.3, 2.6, 2.2), (0, 0, 0), fov_y=36)
PIXEL = 2 * 3.35 * np.tan(np.radians(18)) / SIZE[0]
"""Length that a pixel shows at the origin."""
BOUNDS = ((-0.3, 0.3, 0.0), 2.25)
"""The sphere that the lights' pictures show."""
PLACE = np.array([-1.5, 1.5, 0.25])
"""Where what casts a shadow is: towards the light."""
AWAY = 30.0
"""Distance of lights from the origin."""
MAIN, OTHER = (-1.0, 1.0, 0.17), (-0.9, 1.1, -0.4)
"""Directions towards lights."""
SMALL, LARGE = 0.4, 3.0
"""Sides of square lights: one that blurs edges by two pixels, and stands for a point of ours; and the area light."""
ALPHA = 0.6


class Body(NamedTuple):
    """A surface with its place.

    Attributes:
        surface: the surface.
        theta: what shapes it.
        triangles: vertices (V, 3) and faces (F, 3) of the same shape, finely.
        offset: (3,), where its origin is.
    """

    surface: Any
    theta: dict[str, Any]
    triangles: tuple[np.ndarray, np.ndarray]
    offset: np.ndarray = np.zeros(3)


class Scene(NamedTuple):
    """What casts and receives shadows, and what moves along the direction of `motion`.

    Attributes:
        name: in tables.
        casts: out of view; None where a body shades itself.
        receives: in view.
        lights: directions towards lights.
        moves: "casts", "receives" or "light".
        motion: (3,) world, per unit of t.
        side: of square lights.
        alpha: of what casts.
    """

    name: str
    casts: Body | None
    receives: Body
    lights: tuple[tuple[float, float, float], ...] = (MAIN,)
    moves: str = "casts"
    motion: tuple[float, float, float] = (0.6, 0.0, 0.8)
    side: float = SMALL
    alpha: float = 1.0

    def parts(self, t: Any) -> list[rts.Part]:
        """The parts at t, a scalar of NumPy or torch."""
        glass = rts.plugin("shaders", "lambert")(opaque=False)
        found = [self._part(self.receives, t if self.moves == "receives" else None)]
        if self.casts is not None:
            part = self._part(self.casts, t if self.moves == "casts" else None)
            color = np.array([1, 1, 1, self.alpha])
            found.append(part if self.alpha == 1 else part.replace(theta={**part.theta, "color": color}, shader=glass))
        return found

    def _part(self, body: Body, t: Any) -> rts.Part:
        place = np.eye(4)
        place[:3, 3] = body.offset
        if t is not None:
            place = _constant(place, t) + t * _constant(self._step, t)
        return rts.Part(body.surface, body.theta, "lambert", transform=place)

    @property
    def _step(self) -> np.ndarray:
        step = np.zeros((4, 4))
        step[:3, 3] = self.motion
        return step

    def places(self, t: Any) -> list[list[Any]]:
        """For each light the positions (3,) by which it is drawn: one, or 16 of a square."""
        found = []
        for direction in self.lights:
            corners = square(direction, self.side)
            u, v = corners[1] - corners[0], corners[3] - corners[0]
            count = 4 if self.side == LARGE else 1
            middles = (np.arange(count) + 0.5) / count
            places = [corners[0] + a * u + b * v for a in middles for b in middles]
            if self.moves == "light":
                places = [_constant(p, t) + t * _constant(np.array(self.motion), t) for p in places]
            found.append(places)
        return found


def _constant(x: np.ndarray, like: Any) -> Any:
    return rts.engine_of(like).constant(x, like)


def square(direction: Sequence[float], side: float) -> np.ndarray:
    """Corners (4, 3) of a square light that faces the origin."""
    toward = np.array(direction) / np.linalg.norm(direction)
    u = np.cross([0.0, 0.0, 1.0], toward)
    u, middle = u / np.linalg.norm(u), AWAY * toward
    v = np.cross(toward, u)
    return np.array([middle + side / 2 * (a * u + b * v) for a, b in ((1, -1), (-1, -1), (-1, 1), (1, 1))])


# ------------------------------------------------------------------------------------------------------- bodies


def of_mesh(vertices: Any, faces: Any, offset: Any = (0, 0, 0)) -> Body:
    vertices, faces = np.asarray(vertices, np.float64), np.asarray(faces, np.int32)
    return Body(rts.Mesh(faces), {"vertices": vertices}, (vertices, faces), np.asarray(offset, float))


def floor() -> Body:
    return of_mesh([[-1.3, 0, -1.3], [-1.3, 0, 1.3], [1.3, 0, 1.3], [1.3, 0, -1.3]], QUAD)


def bunny(scale: float, offset: Any) -> Body:
    vertices, faces = mesh("bunny")
    return of_mesh(scale * vertices, faces, offset)


def star() -> Body:
    """A flat star, which light meets once."""
    turn = np.linspace(0, 2 * np.pi, 240, endpoint=False)
    radius = 0.33 + 0.12 * np.cos(5 * turn)
    ring = radius[:, None] * np.stack([np.cos(turn), 0.3 * np.cos(turn), np.sin(turn)], axis=1)
    faces = [[0, 1 + (i + 1) % 240, 1 + i] for i in range(240)]
    return of_mesh(np.concatenate([np.zeros((1, 3)), ring]), faces, PLACE)


def sheet(extent: float, height: float, offset: Any) -> Body:
    """A wavy B-spline."""
    u, v = np.meshgrid(np.linspace(-1, 1, 8), np.linspace(-1, 1, 8), indexing="ij")
    points = np.stack([extent * u, height * np.sin(2.5 * u + 1) * np.cos(2 * v), -extent * v], axis=-1)
    surface, theta = rts.BSpline((8, 8)), {"points": points}
    return Body(surface, theta, surface.tessellate(theta, 24), np.asarray(offset, float))


def torus(radii: tuple[float, float], offset: Any) -> Body:
    """The signed distances of a torus, which stands upright to the light."""
    theta = {"radii": np.array(radii)}
    surface = rts.Sdf(swept_sphere, sum(radii) + 0.05, reads=("radii",))
    ring = trimesh.creation.torus(*radii, major_sections=300, minor_sections=150)
    vertices, faces = np.asarray(ring.vertices)[:, [1, 2, 0]], np.asarray(ring.faces)
    return Body(surface, theta, (vertices, faces), np.asarray(offset, float))


def blobs(scale: float, offset: Any) -> Body:
    """Values of three blobs that run together, on a lattice."""
    count = 64
    axes = np.linspace(-1.2, 1.2, count)
    p = np.stack(np.meshgrid(axes, axes, axes, indexing="ij"), axis=-1)
    centers = np.array([[-0.45, 0.1, 0.1], [0.4, 0.25, -0.2], [0.1, -0.35, 0.3]])
    values = 1 - sum(np.exp(-((p - c) ** 2).sum(-1) / 0.22) for c in centers) * 1.9
    surface, theta = rts.Isosurface(((-1.2 * scale,) * 3, (1.2 * scale,) * 3)), {"values": scale * values}
    return Body(surface, theta, surface.tessellate(theta, 1), np.asarray(offset, float))


@cache
def scenes() -> tuple[Scene, ...]:
    """All of them."""
    ground = (0.0, -0.35, 0.0)
    return (
        Scene("mesh on mesh", bunny(0.5, PLACE), floor()),
        Scene("spline on mesh", sheet(0.4, 0.25, PLACE), floor()),
        Scene("mesh on spline", bunny(0.5, PLACE), sheet(1.3, 0.25, (0, 0, 0))),
        Scene("sdf on isosurface", torus((0.32, 0.11), PLACE), blobs(0.9, ground)),
        Scene("isosurface on sdf", blobs(0.42, PLACE), torus((0.5, 0.45), ground)),
        Scene("self-shadow", None, bunny(0.9, (0, 0, 0)), moves="light", motion=(20.0, 0.0, -20.0)),
        Scene("two lights", torus((0.32, 0.11), PLACE), floor(), lights=(MAIN, OTHER)),
        Scene("area light", bunny(0.5, PLACE), floor(), side=LARGE),
        Scene("alpha", star(), floor(), alpha=ALPHA),
    )


def lights_of(scene: Scene, size: int, t: Any, parts: Sequence[rts.Part]) -> dict[str, Any]:
    """θ["light"] of a scene, with its shadows in pictures of size²."""
    found = []
    for places in scene.places(t):
        lights = [rts.shadows.with_shadows(parts, {"position": p}, size=size, bounds=BOUNDS) for p in places]
        found.append([lit[0].theta["light"]["shadow"][0] for lit in lights])
    middles = [sum(places) / len(places) for places in scene.places(t)]
    stack = rts.namespace(middles[0]).stack
    return {"position": stack(middles), "intensity": np.full(3, intensity(scene)), "shadow": found}


def intensity(scene: Scene) -> float:
    """The intensity by which all lights give an irradiance / π of 1 at the origin."""
    return AWAY**2 / len(scene.lights)


def image(scene: Scene, t: Any, size: int, supersample: int) -> Any:
    """Our image (H, W) of a grey scene at t; the lights' pictures have size² cells."""
    parts = scene.parts(t)
    light = lights_of(scene, size, t, parts)
    lit = [part.replace(theta={**part.theta, "light": light}) for part in parts]
    return rts.render(lit, CAMERA, SIZE, supersample=supersample)[..., 0]
