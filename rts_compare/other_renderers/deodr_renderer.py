"""Derivatives by DEODR (de La Gorce, Paragios and Fleet 2011): anti-aliased edges drawn over a rasterized image.

DEODR differentiates in reverse mode only. A derivative image is therefore a difference of its own float64 images, over
a step so small that hardly a pixel changes its triangle. Its reverse mode agrees to five digits. DEODR draws only the
fronts of triangles.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np

from rts_compare.derivative_scores import loss_weights
from rts_compare.other_renderers.renderer_input import Peer, RendererInput, Unsuited

STEP = 1e-6
"""Step of a difference, pixels."""
TURN = 1e-8
"""Radians by which the camera is turned about its axis: DEODR does not draw exactly upright or level edges."""


class Deodr(Peer):
    """A scene in DEODR: all parts as one mesh.

    Args:
        given: the scene.

    Raises:
        ImportError: DEODR is not installed.
        Unsuited: a vertex is nearer than the near plane.
    """

    name = "DEODR"

    def __init__(self, given: RendererInput):
        import deodr
        from deodr.differentiable_renderer import Camera, Scene3D

        if any((-p.vertices[:, 2] < given.planes[0]).any() for p in given.parts):
            raise Unsuited("it clips no triangles, and some reach before the near plane")
        self.given, self.settings = given, {}
        self.vertices = np.concatenate([p.vertices for p in given.parts])
        self.colors = np.concatenate([p.colors for p in given.parts])
        # DEODR refuses gradients with perspective-correct interpolation, and with back faces drawn.
        self.scene: Any = Scene3D(sigma=1.0, perspective_correct=False, integer_pixel_centers=False)
        first = np.cumsum([0, *(len(p.vertices) for p in given.parts)])
        faces = np.concatenate([p.faces + f for p, f in zip(given.parts, first, strict=False)])
        self.scene.set_mesh(deodr.ColoredTriMesh(faces.astype(np.int32), self.vertices, colors=self.colors))
        self.scene.set_light(None, 1.0)
        self.scene.set_background_color(np.zeros(3))
        height, width = given.size
        intrinsic = np.array([[given.focal, 0, width / 2], [0, given.focal, height / 2], [0, 0, 1]])
        view = np.array([[1.0, TURN, 0, 0], [TURN, -1, 0, 0], [0, 0, -1, 0]])
        self.camera = Camera(view, intrinsic, height, width)

    def image(self) -> np.ndarray:
        """The image (H, W, 3) of the scene at rest."""
        return self._render(self.vertices, self.colors)

    def _render(self, vertices: np.ndarray, colors: np.ndarray) -> np.ndarray:
        """The image (H, W, 3) with these vertices (V, 3) and colours (V, 3), which the scene then keeps."""
        self.scene.mesh.set_vertices(vertices)
        self.scene.mesh.set_vertices_colors(colors)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # DEODR takes cross products of 2D vectors.
            return self.scene.render(self.camera)

    def derivative(self, mode: str, seed: int = 0) -> np.ndarray:
        """See `Peer`. Each value is the smaller one of two one-sided differences; `seed` has no effect."""
        move, change = self._velocity(mode)
        step = STEP / (self.given.fastest(mode) or 1.0)
        rest = self._render(self.vertices, self.colors)
        ahead = self._render(self.vertices + step * move, self.colors + step * change) - rest
        behind = rest - self._render(self.vertices - step * move, self.colors - step * change)
        # At ties of depth rounding decides which triangle is seen: a jump on one of the two sides.
        return np.where(np.abs(ahead) < np.abs(behind), ahead, behind) / step

    def gradient(self, mode: str, weights: np.ndarray | None = None) -> Callable[[], float]:
        """See `Peer`. DEODR computes the gradients of vertices and of colours in any mode."""
        move, change = self._velocity(mode)
        weights = np.array(loss_weights(*self.given.size)[0] if weights is None else weights, np.float64)

        def slope() -> float:
            self._render(self.vertices, self.colors)
            self.scene.clear_gradients()
            self.scene.render_backward(weights.copy())  # DEODR overwrites its argument.
            mesh = self.scene.mesh
            return float((mesh._vertices_b * move).sum() + (mesh.vertices_colors_b * change).sum())

        return slope

    def _velocity(self, mode: str) -> tuple[np.ndarray, np.ndarray]:
        """Velocities (V, 3) of all vertices, and velocities (V, 3) of their colours; zero at rest."""
        pairs = list(zip(self.given.parts, self.given.velocity(mode), strict=True))
        moves = [np.zeros_like(p.vertices) if v.vertices is None else v.vertices for p, v in pairs]
        changes = [np.zeros_like(p.colors) if v.colors is None else v.colors for p, v in pairs]
        return np.concatenate(moves), np.concatenate(changes)
