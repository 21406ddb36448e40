"""Helpers of the tests: arrays of every engine, small meshes, derivatives by the frameworks themselves."""

import contextlib
import importlib.util
import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

import rts
from rts import Camera, InputError, Part
from rts.arrays.engines import is_constant
from rts.arrays.trees import map_leaves
from rts.contracts.records import Cells, Samples, Splats


def _torch_targets():
    if importlib.util.find_spec("torch") is None:
        return ["torch-cpu"]
    import torch

    return ["torch-cpu", "torch-cuda"] if torch.cuda.is_available() else ["torch-cpu"]


TORCH = _torch_targets()
DIFFERENTIABLE = [*TORCH, "jax"]
ALL = ["numpy", *DIFFERENTIABLE]


def _sampler(name, package):
    missing = importlib.util.find_spec(package) is None
    return pytest.param(name, marks=pytest.mark.skipif(missing, reason=f"needs {package}"))


TRIANGLE_SAMPLERS = ["raster", "reference", _sampler("embree", "embreex"), _sampler("opengl", "moderngl")]
"""Samplers of triangles by name; those whose package is missing are skipped."""


def quick(values, count=1):
    """Parameters of a test, of which `make test` tries the first ones and `make test-all` the rest."""
    return [
        pytest.param(*(v if isinstance(v, tuple) else (v,)), marks=[pytest.mark.thorough] * (number >= count))
        for number, v in enumerate(values)
    ]


@contextlib.contextmanager
def refused(match):
    """An InputError of one line, in which the pattern is found."""
    with pytest.raises(InputError, match=match) as error:
        yield error
    assert "\n" not in str(error.value)


def together(work, count, seconds=120):
    """The results of a function of a number, from 0 on, in as many threads, which begin at once."""
    start = threading.Barrier(count)

    def begun(number):
        start.wait(60)
        return work(number)

    with ThreadPoolExecutor(count) as pool:
        return list(pool.map(begun, range(count), timeout=seconds))


# -------------------------------------------------------------------------------------------------- arrays


def arrays(target, tree, dtype=np.float32):
    """A tree with every leaf as an array of "numpy", "torch-<device>" or "jax"; floats become `dtype`."""
    if target == "numpy":
        convert = np.asarray
    elif target == "jax":
        convert = pytest.importorskip("jax").numpy.asarray
    else:
        torch = pytest.importorskip("torch")
        device = target.removeprefix("torch-")

        def convert(x):
            return torch.from_numpy(x.copy()).to(device)

    def leaf(x):
        x = np.asarray(x)
        return convert(x.astype(dtype) if np.issubdtype(x.dtype, np.floating) else x)

    return map_leaves(leaf, tree)


@contextlib.contextmanager
def precision(target, dtype=np.float64):
    """While it lasts, floats of "jax" may be float64, if that is the `dtype`; those of other engines always may."""
    if target != "jax" or dtype != np.float64:
        yield
        return
    config = pytest.importorskip("jax").config
    config.update("jax_enable_x64", True)
    try:
        yield
    finally:
        config.update("jax_enable_x64", False)


def to_numpy(tree):
    """The tree on the host."""
    return map_leaves(lambda x: x.detach().cpu().numpy() if hasattr(x, "detach") else np.asarray(x), tree)


def gradient(target, f, x, jit=True):
    """The gradient of a scalar function of a tree, on the host; by reverse mode, by jax in a program if `jit`."""
    if target == "jax":
        jax = pytest.importorskip("jax")
        return to_numpy((jax.jit if jit else lambda f: f)(jax.grad(f))(x))
    torch = pytest.importorskip("torch")
    variables = []

    def variable(leaf):
        variables.append(leaf.detach().clone().requires_grad_(True))
        return variables[-1]

    value = f(map_leaves(variable, x))
    it = iter(torch.autograd.grad(value, variables, materialize_grads=True))
    return to_numpy(map_leaves(lambda _: next(it), x))


def derivative(target, f, x, dx, jit=True):
    """The value of `f` and its derivative along `dx`, on the host; by forward mode, by jax in a program if `jit`."""
    if target == "jax":
        jax = pytest.importorskip("jax")
        return to_numpy((jax.jit if jit else lambda f: f)(lambda x, dx: jax.jvp(f, (x,), (dx,)))(x, dx))
    return to_numpy(pytest.importorskip("torch").func.jvp(f, (x,), (dx,)))


def pushed(f):
    """Image and derivative of a function of a number, at 0, by forward mode, as NumPy."""
    import torch
    from torch.autograd import forward_ad as forward

    with forward.dual_level():
        result = forward.unpack_dual(f(forward.make_dual(torch.zeros(()), torch.ones(()))))
    return result.primal.detach().numpy(), result.tangent.numpy()


def finite_difference(f, x, step=1e-6):
    """The gradient of a scalar function of a tree of NumPy arrays, by central differences in float64."""
    assert is_constant(x)
    flat = []
    map_leaves(lambda leaf: flat.append(np.array(leaf, np.float64)), x)

    def value():
        it = iter(flat)
        return float(f(map_leaves(lambda _: next(it), x)))

    slopes = []
    for leaf in flat:
        slope = np.zeros_like(leaf)
        for index in np.ndindex(leaf.shape):
            center = leaf[index]
            leaf[index] = center + step
            above = value()
            leaf[index] = center - step
            slope[index] = (above - value()) / (2 * step)
            leaf[index] = center
        slopes.append(slope)
    it = iter(slopes)
    return map_leaves(lambda _: next(it), x)


def relative_error(actual, expected):
    """The norm of the difference of two arrays over the norm of the second."""
    actual, expected = np.asarray(actual, np.float64), np.asarray(expected, np.float64)
    return np.linalg.norm(actual - expected) / np.linalg.norm(expected)


# -------------------------------------------------------------------------------------------------- meshes


def icosphere(subdivisions=2, radius=1.0, center=(0.0, 0.0, 0.0)):
    """Vertices (V, 3) float32 and faces (T, 3) of a sphere, counter-clockwise seen from outside."""
    golden = (1 + 5**0.5) / 2
    vertices = [v for a in (-1.0, 1.0) for b in (-golden, golden) for v in ((a, b, 0.0), (0.0, a, b), (b, 0.0, a))]
    vertices = np.array(vertices)
    edge = 2.0
    faces = []
    for i in range(12):
        for j in range(i + 1, 12):
            for k in range(j + 1, 12):
                a, b, c = vertices[[i, j, k]]
                if all(abs(np.linalg.norm(d) - edge) < 1e-9 for d in (a - b, b - c, c - a)):
                    outward = np.dot(np.cross(b - a, c - a), a + b + c) > 0
                    faces.append((i, j, k) if outward else (i, k, j))
    faces = np.array(faces)
    for _ in range(subdivisions):
        edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        unique, inverse = np.unique(edges, axis=0, return_inverse=True)
        middle = inverse.reshape(-1, 3) + len(vertices)
        vertices = np.concatenate([vertices, vertices[unique].sum(axis=1) / 2])
        (a, b, c), (ab, bc, ca) = faces.T, middle.T
        corners = [(a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca)]
        faces = np.concatenate([np.stack(t, axis=1) for t in corners])
    vertices = vertices / np.linalg.norm(vertices, axis=1, keepdims=True) * radius + np.asarray(center)
    return vertices.astype(np.float32), faces.astype(np.int32)


def box(half=1.0, center=(0.0, 0.0, 0.0)):
    """Vertices (8, 3) and faces (12, 3) of a cube, counter-clockwise seen from outside."""
    vertices = np.array([(x, y, z) for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)], np.float32)
    quads = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
    faces = [t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))]
    return vertices * np.float32(half) + np.asarray(center, np.float32), np.array(faces, np.int32)


def crooked_box():
    """Vertices (8, 3) and faces (12, 3) of a box that no turn maps to itself."""
    vertices, faces = box(0.5)
    vertices = vertices * np.array([1.5, 0.9, 0.6], np.float32)
    vertices *= 1 + np.random.default_rng(3).uniform(-0.2, 0.2, vertices.shape).astype(np.float32)
    return vertices, faces


def quad(left=-1.0, right=1.0, bottom=-1.0, top=1.0, z=0.0):
    """Vertices (4, 3) and faces (2, 3) of a rectangle that faces +z."""
    vertices = np.array([(left, bottom, z), (right, bottom, z), (right, top, z), (left, top, z)], np.float32)
    return vertices, np.array([(0, 1, 2), (0, 2, 3)], np.int32)


def soup(count, seed=0, extent=1.0, size=0.7):
    """Vertices (3 count, 3) and faces (count, 3) of unconnected random triangles that interpenetrate."""
    rng = np.random.default_rng(seed)
    centers = rng.uniform(-extent, extent, (count, 1, 3))
    corners = centers + rng.normal(0.0, size, (count, 3, 3))
    return corners.reshape(-1, 3).astype(np.float32), np.arange(3 * count, dtype=np.int32).reshape(-1, 3)


def open_edges(faces):
    """The edges (E, 2) of triangles that not exactly two of them share; no two may run along one in one direction."""
    directed = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    assert len(np.unique(directed, axis=0)) == len(directed)
    edges, counts = np.unique(np.sort(directed, axis=1), axis=0, return_counts=True)
    return edges[counts != 2]


def samples_at(ids, params):
    """Samples of ids (N,) or (N, I) and parameters (N, Q), which no cell refers to."""
    cells = Cells(np.full((1, 1, 1), -1, np.int32), np.zeros((1, 1, 1), np.float32))
    return Samples(np.asarray(ids, np.int32).reshape(len(params), -1), params, cells, np.int32(0))


def moved(transform, points):
    """Points (N, 3) under an affine map (4, 4)."""
    return points @ np.asarray(transform)[:3, :3].T + np.asarray(transform)[:3, 3]


def rotation(axis, degrees):
    """(3, 3) rotation about an axis, by Rodrigues' formula."""
    x, y, z = np.asarray(axis, np.float64) / np.linalg.norm(axis)
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    angle = np.radians(degrees)
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k


def rigid(axis=(0.0, 1.0, 0.0), degrees=0.0, translation=(0.0, 0.0, 0.0)):
    """(4, 4) rotation about an axis, then a translation."""
    transform = np.eye(4)
    transform[:3, :3] = rotation(axis, degrees)
    transform[:3, 3] = translation
    return transform


# --------------------------------------------------------------------------------------------------- scenes

SIZE = (20, 24)
CAMERA = Camera.look_at((1, 1.5, 4), (0, 0, 0), fov_y=40, aspect=1.2)
FRONT = Camera.orthographic((0, 0, 5), (0, 0, 0), height=4, aspect=1.2, near=1, far=9)


def mesh_part(mesh, **options):
    """A part of (vertices, faces); `theta` holds what else belongs to it, `indices` those of corners."""
    vertices, faces = mesh
    theta = {"vertices": vertices, **options.pop("theta", {})}
    return Part(rts.plugin("surfaces", "mesh")(faces, options.pop("indices", None)), theta, **options)


def show(parts, camera=CAMERA, size=SIZE, **options):
    """The image, on the host."""
    return to_numpy(rts.render(parts, camera, size, **options))


def crooked_block(folder):
    """The file of a block that no turn maps to itself."""
    import trimesh

    path = folder / "model.ply"
    block = trimesh.creation.box((2, 1.2, 0.8))
    block.vertices *= 1 + np.random.default_rng(3).uniform(-0.3, 0.3, block.vertices.shape)
    block.export(path)
    return path


def splats_of(positions, rgba, row, **more):
    """Splats of arrays of samples and of cells."""
    return Splats(positions, rgba, Cells(row), **more)
