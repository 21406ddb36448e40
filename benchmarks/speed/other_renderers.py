"""The pose iteration by other renderers.

- DEODR, in two ways. By its own classes, as its examples do: `Scene3D`, `ColoredTriMesh`, `PerspectiveCamera`; one
  colour channel. And at its compiled functions, with arrays made once and no checks of them, NumPy for projection and
  chain rule, and the sparse matrix of its adjacency converted once to the form that multiplies fastest.
- Mitsuba 3, `direct_projective`, `llvm_ad_rgb`, 4 samples a pixel: the mesh is a white emitter.
"""

from __future__ import annotations

import abc
import tempfile
from collections.abc import Callable, Sequence

import numpy as np

from benchmarks.camera import DISTANCE, FOV
from benchmarks.speed.pose_iteration import Task
from benchmarks.timing import RATE, START
from rts_compare.other_renderers.mitsuba_renderer import (
    emitter,
    integrator,
    mitsuba,
    positions_of,
    sensor,
    set_flat,
)

SIGMA = 1.0
"""Width of DEODR's anti-aliased edges, pixels."""
SAMPLES = 4
"""A pixel, of Mitsuba."""


class Adam:
    """Adam (Kingma and Ba 2015) on one NumPy array."""

    def __init__(self, rate: float):
        self.rate, self.count, self.mean, self.square = rate, 0, 0.0, 0.0

    def step(self, x: np.ndarray, gradient: np.ndarray) -> np.ndarray:
        self.count += 1
        self.mean = 0.9 * self.mean + 0.1 * gradient
        self.square = 0.999 * self.square + 0.001 * gradient**2
        mean, square = self.mean / (1 - 0.9**self.count), self.square / (1 - 0.999**self.count)
        return x - self.rate * mean / (np.sqrt(square) + 1e-8)


def rotation(r: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The rotation (3, 3) of a rotation vector, and its derivative (3, 3, 3), first axis along r."""
    crosses = np.array(
        [[[0, 0, 0], [0, 0, -1], [0, 1, 0]], [[0, 0, 1], [0, 0, 0], [-1, 0, 0]], [[0, -1, 0], [1, 0, 0], [0, 0, 0]]]
    )
    square = r @ r
    if square < 1e-12:
        return np.eye(3) + np.tensordot(r, crosses, 1), crosses.astype(float)
    angle, k = np.sqrt(square), np.tensordot(r, crosses, 1)
    matrix = np.eye(3) + np.sin(angle) / angle * k + (1 - np.cos(angle)) / square * k @ k
    # Gallego and Yezzi, A compact formula for the derivative of a 3-D rotation in exponential coordinates, 2015.
    turns = [r[i] * k + np.tensordot(np.cross(r, (np.eye(3) - matrix)[:, i]), crosses, 1) for i in range(3)]
    return matrix, np.stack([turn @ matrix / square for turn in turns])


class _Fit(abc.ABC):
    """Iterations from the start on, by the loss and gradient of a pose (6,) that a peer gives."""

    def __init__(self):
        self.pose, self.adam = np.array(START), Adam(RATE)

    @abc.abstractmethod
    def value_and_gradient(self, pose: np.ndarray) -> tuple[float, np.ndarray]:
        """Loss, and its gradient in the pose."""

    def step(self) -> float:
        """One iteration."""
        loss, gradient = self.value_and_gradient(self.pose)
        self.pose = self.adam.step(self.pose, gradient)
        return loss


# --------------------------------------------------------------------------------------------------------------- DEODR


class DeodrScene(_Fit):
    """The task by DEODR's own classes, which always give the gradient of the vertices too.

    Args:
        task: the task.
        lit: by a distant light towards this direction, in three channels. Vertices are shaded.
    """

    def __init__(self, task: Task, lit: Sequence[float] | None = None):
        from deodr.differentiable_renderer import PerspectiveCamera, Scene3D
        from deodr.triangulated_mesh import ColoredTriMesh

        channels = 1 if lit is None else 3
        self.vertices = task.vertices.astype(np.float64)
        self.target = task.target[..., :channels].astype(np.float64)
        # It looks along +z, y down.
        self.camera = PerspectiveCamera(task.side, task.side, FOV, np.zeros(3))
        self.mesh = ColoredTriMesh(task.faces, self.vertices, colors=np.ones((len(self.vertices), channels)))
        self.scene = Scene3D(sigma=SIGMA, integer_pixel_centers=False)
        # Its y and z point the other way, and its light is where it shines to.
        self.scene.set_light(None if lit is None else np.array(lit) * [-1, 1, 1], 1.0 if lit is None else 0.0)
        self.scene.set_mesh(self.mesh)
        self.scene.set_background_color([0.0] * channels)
        super().__init__()

    def value_and_gradient(self, pose: np.ndarray) -> tuple[float, np.ndarray]:
        """Loss, and its gradient in the pose."""
        matrix, slopes = rotation(pose[:3])
        flip = np.array([1.0, -1.0, -1.0])
        self.mesh.set_vertices(self.vertices @ (matrix.T * flip) + (pose[3:] * flip + [0, 0, DISTANCE]))
        difference = self.scene.render(self.camera) - self.target
        self.scene.clear_gradients()
        self.scene.render_backward(difference * (2 / difference.size))
        g_seen = self.mesh._vertices_b
        g_matrix = (g_seen.T @ self.vertices) * flip[:, None]
        gradient = np.concatenate([np.tensordot(slopes, g_matrix, 2), g_seen.sum(axis=0) * flip])
        return float((difference**2).mean()), gradient


class Deodr(_Fit):
    """The task at DEODR's compiled functions.

    Args:
        task: the task.
        full: also compute the gradient of the vertices.
    """

    def __init__(self, task: Task, full: bool):
        from deodr.differentiable_renderer import Scene2DBase
        from deodr.triangulated_mesh import TriMeshAdjacencies

        self.full, self.side = full, task.side
        self.vertices = task.vertices.astype(np.float64)
        self.target = task.target.astype(np.float64)
        self.focal = task.side / (2 * np.tan(np.radians(FOV / 2)))
        self.adjacencies = TriMeshAdjacencies(task.faces, nb_vertices=len(self.vertices))
        self.adjacencies.edges_faces_ones = self.adjacencies.edges_faces_ones.tocsr()
        self.adjacencies.faces_edges = np.asarray(self.adjacencies.faces_edges)
        count, faces = len(self.vertices), np.ascontiguousarray(task.faces, np.uint32)
        self.scene = Scene2DBase(
            faces=faces,
            faces_uv=np.zeros_like(faces),
            ij=np.zeros((count, 2)),
            depths=np.zeros(count),
            textured=np.zeros(len(faces), bool),
            uv=np.zeros((1, 2)),
            shade=np.zeros(count),
            colors=np.ones((count, 1)),
            shaded=np.zeros(len(faces), bool),
            edgeflags=np.zeros((len(faces), 3), bool),
            height=task.side,
            width=task.side,
            nb_colors=1,
            texture=np.zeros((0, 0)),
            background_color=np.zeros(1),
            integer_pixel_centers=False,
        )
        self.image, self.depth = np.empty((task.side, task.side, 1)), np.empty((task.side, task.side))
        super().__init__()

    def value_and_gradient(self, pose: np.ndarray) -> tuple[float, np.ndarray]:
        """Loss, and its gradient in the pose; that of the vertices is left in `vertex_gradient`."""
        matrix, slopes = rotation(pose[:3])
        flip = np.array([1.0, -1.0, -1.0])
        # The camera looks along +z, y down.
        seen = self.vertices @ (matrix.T * flip) + (pose[3:] * flip + [0, 0, DISTANCE])
        depths = np.ascontiguousarray(seen[:, 2])
        inverse = self.focal / depths
        projected = seen[:, :2] * inverse[:, None]
        image_gradient = self._render(projected + self.side / 2, depths)
        g_seen = np.empty_like(seen)
        g_projected = self.scene.ij_b
        np.multiply(g_projected, inverse[:, None], out=g_seen[:, :2])
        g_seen[:, 2] = -(g_projected * projected).sum(axis=1) / depths
        g_matrix = (g_seen.T @ self.vertices) * flip[:, None]
        if self.full:
            self.vertex_gradient = g_seen @ (matrix.T * flip).T
        translation = g_seen.sum(axis=0) * flip
        return image_gradient, np.concatenate([np.tensordot(slopes, g_matrix, 2), translation])

    def _render(self, ij: np.ndarray, depths: np.ndarray) -> float:
        """The loss, with its gradient in `ij` left in the scene."""
        from deodr.differentiable_renderer_cython import renderSceneBCpp, renderSceneCpp

        scene = self.scene
        scene.ij, scene.depths = ij, depths
        scene.edgeflags = self.adjacencies.edge_on_silhouette(ij)
        scene.ij_b, scene.uv_b, scene.texture_b = np.zeros_like(ij), np.zeros((1, 2)), np.zeros((0, 0))
        scene.shade_b, scene.colors_b = np.zeros_like(scene.shade), np.zeros_like(scene.colors)
        renderSceneCpp(scene, SIGMA, self.image, self.depth, False, None, None, False)
        difference = self.image - self.target
        slope = difference * (2 / difference.size)
        # It overwrites the image, which is not read again.
        renderSceneBCpp(scene, SIGMA, self.image, self.depth, slope, False, None, None, None, False)
        return float((difference**2).mean())


# ------------------------------------------------------------------------------------------------------------- Mitsuba


class Mitsuba(_Fit):
    """The task in Mitsuba.

    Args:
        task: the task.
        full: also compute the gradient of the vertices.
    """

    def __init__(self, task: Task, full: bool):
        mi = mitsuba()
        with tempfile.TemporaryDirectory() as folder:
            mesh = emitter(task.vertices, task.faces, f"{folder}/mesh.ply")
            camera = sensor(task.size, FOV, (0.5, 10.0), DISTANCE, "luminance")
            self.scene = mi.load_dict({"type": "scene", "sensor": camera, "mesh": mesh})
        self.integrator = integrator()
        self.parameters = mi.traverse(self.scene)
        self.vertices = mi.Point3f(task.vertices.T.astype(np.float32))
        self.target = mi.TensorXf(task.target)
        self.full, self.seed = full, 0
        super().__init__()

    def value_and_gradient(self, pose: np.ndarray) -> tuple[float, np.ndarray]:
        """Loss, and its gradient in the pose; that of the vertices is left in `vertex_gradient`."""
        import drjit as dr

        mi = mitsuba()
        matrix, slopes = rotation(pose[:3])
        turn, move = mi.Matrix3f(matrix.tolist()), mi.Point3f(pose[3:].tolist())
        vertices = mi.Point3f(self.vertices)
        dr.make_opaque(turn, move)  # Numbers that differ would be compiled into the loops each time.
        dr.enable_grad(turn, move)
        if self.full:
            dr.enable_grad(vertices)
        set_flat(self.parameters, positions_of(self.parameters, "mesh"), dr.ravel(turn @ vertices + move))
        self.parameters.update()
        self.seed += 1
        image = mi.render(self.scene, self.parameters, integrator=self.integrator, spp=SAMPLES, seed=self.seed)
        loss = dr.mean(dr.square(image - self.target), axis=None)
        dr.backward(loss)
        if self.full:
            self.vertex_gradient = dr.grad(vertices)
            dr.eval(self.vertex_gradient)
            dr.sync_thread()
        g_turn, g_move = np.array(dr.grad(turn)).reshape(3, 3), np.array(dr.grad(move)).reshape(3)
        return float(np.array(loss).item()), np.concatenate([np.tensordot(slopes, g_turn, 2), g_move])


def iterations(task: Task, with_mitsuba: bool) -> dict[str, Callable[[], object]]:
    """One call of each a turn."""
    kinds = {"DEODR's functions": Deodr} | ({"Mitsuba": Mitsuba} if with_mitsuba else {})
    found = {
        f"{name}, {mode}": kind(task, mode == "full").step for name, kind in kinds.items() for mode in ("pose", "full")
    }
    return {"DEODR": DeodrScene(task).step, **found}
