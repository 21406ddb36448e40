"""Derivatives of images by other renderers, on scenes of unlit vertex colours.

- DEODR (de La Gorce, Paragios and Fleet 2011): anti-aliased edges drawn over a rasterized image. It differentiates in
  reverse mode only; a derivative image is here the central difference of its own float64 image over a step so small
  that no pixel changes the triangle it sees, which its reverse mode agrees with to five digits.
- Mitsuba 3, `direct_projective` (Zhang et al. 2023), forward mode: Monte Carlo, noisier the fewer samples a pixel.
  Every mesh is an area emitter of its vertex colours on a black material, which gives flat colours.

Both see the fronts of triangles only. They come with the extra `bench`; of Mitsuba see `mitsuba_scenes`.
"""

from __future__ import annotations

import tempfile
from typing import Any

import numpy as np

from benchmarks.accuracy import scenes
from benchmarks.camera import DISTANCE, FOV
from benchmarks.mitsuba_scenes import emitter, integrator, mitsuba, sensor

STEP = 1e-6
"""Length of DEODR's difference, pixels."""


def displacement(scene: scenes.Scene) -> list[np.ndarray]:
    """Derivative in t of each part's vertices (V, 3)."""
    return [
        np.zeros_like(part.theta["vertices"]) if d is None else part.theta["vertices"] @ d[:3, :3].T + d[:3, 3]
        for part, d in zip(scene.rest, scene.directions, strict=True)
    ]


# --------------------------------------------------------------------------------------------------------------- DEODR


class Deodr:
    """A scene in DEODR: all parts as one mesh."""

    def __init__(self, scene: scenes.Scene):
        import deodr
        from deodr.differentiable_renderer import Camera, Scene3D

        parts = [part.theta for part in scene.rest]
        first = np.cumsum([0, *(len(p["vertices"]) for p in parts)])
        faces = np.concatenate([p.surface.faces + f for p, f in zip(scene.rest, first, strict=False)])
        self.vertices = np.concatenate([p["vertices"] for p in parts])
        self.displacement = np.concatenate(displacement(scene))
        # Gradients are refused with perspective-correct interpolation, and where back faces are drawn.
        self.scene = Scene3D(sigma=1.0, perspective_correct=False, integer_pixel_centers=False)
        colors = np.concatenate([p["colors"] for p in parts])
        self.scene.set_mesh(deodr.ColoredTriMesh(faces.astype(np.int32), self.vertices, colors=colors))
        self.scene.set_light(None, 1.0)
        self.scene.set_background_color(np.zeros(3))
        height, width = scene.size
        focal = height / (2 * np.tan(np.radians(FOV / 2)))
        view = np.array([[1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, DISTANCE]])
        self.camera = Camera(view, np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]), height, width)

    def render(self, t: float) -> np.ndarray:
        """The image (H, W, 3) at t."""
        self.scene.mesh.set_vertices(self.vertices + t * self.displacement)
        return self.scene.render(self.camera)

    def derivative(self) -> np.ndarray:
        """The derivative image (H, W, 3) a pixel of motion."""
        return (self.render(STEP / 2) - self.render(-STEP / 2)) / STEP

    def gradient(self, weights: np.ndarray) -> float:
        """Reverse mode: the slope dL/dt of L = Σ weights · image, by the gradient in every vertex."""
        self.render(0.0)
        self.scene.clear_gradients()
        self.scene.render_backward(np.array(weights))  # It overwrites what it is given.
        return float((self.scene.mesh._vertices_b * self.displacement).sum())


# ------------------------------------------------------------------------------------------------------------- Mitsuba


class Mitsuba:
    """A scene in Mitsuba: each part a mesh that emits its colours."""

    def __init__(self, scene: scenes.Scene):
        mi = mitsuba()
        with tempfile.TemporaryDirectory() as folder:
            meshes = {
                f"part{i}": emitter(p.theta["vertices"], p.surface.faces, f"{folder}/{i}.ply", p.theta["colors"])
                for i, p in enumerate(scene.rest)
            }
            self.scene = mi.load_dict({"type": "scene", "sensor": sensor(scene.size, "rgb"), **meshes})
        self.integrator = integrator()
        self.parameters = mi.traverse(self.scene)
        self.displacement = [mi.Float(np.ravel(d).astype(np.float32)) for d in displacement(scene)]
        self.keys = [f"part{i}.vertex_positions" for i, d in enumerate(scene.directions) if d is not None]
        self.moves = [d for d, moves in zip(self.displacement, scene.directions, strict=True) if moves is not None]
        self.vertices = [mi.Float(self.parameters[key]) for key in self.keys]

    def render(self, vertices: list, spp: int, seed: int) -> Any:
        """The image (H, W, 3), with the parts that move at these vertices."""
        for key, value in zip(self.keys, vertices, strict=True):
            self.parameters[key] = value
        self.parameters.update()
        return mitsuba().render(self.scene, self.parameters, integrator=self.integrator, spp=spp, seed=seed)

    def derivative(self, spp: int, seed: int) -> np.ndarray:
        """Forward mode (H, W, 3)."""
        import drjit as dr

        t = mitsuba().Float(0.0)
        dr.enable_grad(t)
        image = self.render([v + t * d for v, d in zip(self.vertices, self.moves, strict=True)], spp, seed)
        dr.forward(t)
        return np.array(dr.grad(image))

    def gradient(self, weights: np.ndarray, spp: int, seed: int) -> float:
        """Reverse mode: the slope dL/dt of L = Σ weights · image, by the gradient in every vertex that moves."""
        import drjit as dr

        vertices = [v + 0 for v in self.vertices]
        dr.enable_grad(vertices)
        image = self.render(vertices, spp, seed)
        dr.backward(dr.sum(image * mitsuba().TensorXf(weights.astype(np.float32)), axis=None))
        return float(sum(np.sum(np.array(dr.grad(v)) * np.array(d)) for v, d in zip(vertices, self.moves, strict=True)))
