"""Found edges beside the paper's splatter: errors of images and of their derivatives, each against area-sampled images.

Truth is a central difference over ±0.15 pixels of images with 32 × 32 samples a pixel. A row has, for each method, the
relative L2 error of the derivative image, in each pixel and after a Gaussian of 2 pixels, its gain, and the error of
the image itself, root mean square.

    python -m benchmarks.edges                # all scenes
    python -m benchmarks.edges "cards 5°"     # some
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
import trimesh
from scipy.ndimage import gaussian_filter
from torch.autograd import forward_ad as forward

import rts
from benchmarks import meshes

SIZE = 96, 96
HALF = 0.15
SAMPLES = 32
DEPTH = 3.2
PIXEL = 2 * DEPTH * np.tan(np.radians(20)) / SIZE[0]
"""The width of a pixel in the plane through the origin."""
CAMERA = rts.Camera.look_at((0, 0, DEPTH), (0, 0, 0), fov_y=40)
TWO = np.array([[0, 1, 2], [0, 2, 3]])
QUAD = np.array([[-0.62, -0.55, 0], [0.55, -0.5, 0], [0.6, 0.47, 0], [-0.58, 0.5, 0]])

SceneAt = Callable[[torch.Tensor], Sequence[rts.Part]]

METHODS: dict[str, dict[str, Any]] = {
    "multi": {"splatter": "multi", "layers": 2},
    "edges": {"splatter": "edges"},
}


def mesh(vertices, faces, shader="unlit", cull="none", **theta) -> rts.Part:
    """A part of a mesh, whose vertices may be a tensor."""
    theta = {name: np.asarray(x, np.float32) for name, x in theta.items()}
    return rts.Part(rts.Mesh(np.asarray(faces)), {"vertices": vertices, **theta}, shader, cull=cull)


def tensor(x) -> torch.Tensor:
    return torch.as_tensor(np.asarray(x), dtype=torch.float32)


def turn(x: float, y: float, z: float = 0.0) -> np.ndarray:
    return trimesh.transformations.euler_matrix(x, y, z)[:3, :3]


def shifted(vertices, move=(1.0, 0.0, 0.0)) -> Callable[[torch.Tensor], torch.Tensor]:
    """Vertices as a function of t: moved by t pixels along a direction."""
    start, step = tensor(vertices), tensor(np.asarray(move) * PIXEL)
    return lambda t: start + t * step


def swung(vertices, axis=(0.0, 1, 0)) -> Callable[[torch.Tensor], torch.Tensor]:
    """Vertices as a function of t: turned about an axis, so that the farthest from it move by t pixels."""
    start = tensor(vertices)
    step = torch.linalg.cross(tensor(axis).expand_as(start), start)
    return lambda t: start + t * PIXEL * step / step.norm(dim=1).max()


def crossing_cards(degrees: float, one_part: bool = False) -> SceneAt:
    """Two cards that cross at an angle; one comes nearer, so that their line moves by a pixel."""
    half = np.radians(degrees) / 2
    a, b = (QUAD * 1.6 @ turn(0.1, sign * half + 0.13, 0.2).T for sign in (1, -1))
    to = shifted(b, (0, 0, 2 * np.tan(half)))
    colors = (0.9, 0.5, 0.2), (0.2, 0.5, 0.9)
    if not one_part:
        return lambda t: [mesh(tensor(a), TWO, color=colors[0]), mesh(to(t), TWO, color=colors[1])]
    faces, each = np.concatenate([TWO, TWO + 4]), np.repeat(colors, 4, axis=0)
    return lambda t: [mesh(torch.cat([tensor(a), to(t)]), faces, colors=each)]


def torus(t: torch.Tensor) -> torch.Tensor:
    """Vertices of a torus whose smaller radius grows by t pixels."""
    u, v = torch.meshgrid(torch.arange(96) * (2 * np.pi / 96), torch.arange(48) * (2 * np.pi / 48), indexing="ij")
    r = 0.22 + t * PIXEL
    ring = torch.stack([(0.6 + r * v.cos()) * u.cos(), (0.6 + r * v.cos()) * u.sin(), r * v.sin()], -1)
    return ring.reshape(-1, 3) @ tensor(turn(0.9, 0.4)).T


def sphere_of(theta, points):
    """The distance of points from a sphere."""
    return ((points - theta["center"]) ** 2).sum(-1) ** 0.5 - theta["radius"]


def scenes() -> dict[str, SceneAt]:
    """The scenes by name; t is a motion of about a pixel."""
    rng = np.random.default_rng(0)
    ball = trimesh.creation.icosphere(4)
    fine, sphere = np.asarray(ball.faces), np.asarray(ball.vertices)
    egg = sphere * [0.8, 0.5, 0.4]
    small = trimesh.creation.icosphere(2)
    places = np.concatenate([rng.uniform(-0.8, 0.8, (12, 2)), np.zeros((12, 1))], 1)
    dots = np.concatenate([np.asarray(small.vertices) * 0.5 * PIXEL + place for place in places])
    dot_faces = np.concatenate([np.asarray(small.faces) + k * len(small.vertices) for k in range(12)])
    noisy = 0.6 * sphere * (1 + 0.04 * rng.normal(size=(len(sphere), 1)))
    i, j = np.meshgrid(np.arange(96), np.arange(48), indexing="ij")
    quads = np.stack([i * 48 + j, (i + 1) % 96 * 48 + j, (i + 1) % 96 * 48 + (j + 1) % 48, i * 48 + (j + 1) % 48], -1)
    rings = quads.reshape(-1, 4)[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)
    box = trimesh.creation.box((0.9, 0.7, 0.6))
    corners, sides = np.asarray(box.vertices) @ turn(0.5, 0.6).T, np.asarray(box.faces)
    bunny, bunny_faces = meshes.mesh("bunny")
    little = bunny * 10 * PIXEL
    spot, spot_faces = meshes.mesh("spot/spot_triangulated")
    wall = QUAD * 3 - [0, 0, 0.8]
    shade = {"shader": "lambert"}
    blue, orange = {"color": (0.2, 0.7, 1)}, {"color": (1, 0.6, 0.2)}

    def one(move, faces, **options) -> SceneAt:
        return lambda t: [mesh(move(t), faces, **options)]

    half = sphere[:, 2] < 0.1
    bowl = fine[half[fine].all(axis=1)]
    return {
        "card": one(shifted(QUAD, (1, 0.3, 0)), TWO, **orange),
        "card turns": one(swung(QUAD, (0.1, 0.2, 1)), TWO, **orange),
        "box": one(shifted(corners), sides, **blue),
        "box, lambert": one(swung(corners), sides, **shade, **blue),
        "ball": one(shifted(0.6 * sphere), fine, **blue),
        "ellipsoid turns": one(swung(egg), fine, **blue),
        "ball, lambert": one(shifted(0.6 * sphere), fine, **shade, **blue),
        "torus grows": one(torus, rings, **blue),
        "torus grows, lambert": one(torus, rings, **shade, **blue),
        "twelve balls of 1 px": one(shifted(dots), dot_faces, **orange),
        "noisy ball, lambert": one(shifted(noisy), fine, **shade, **blue),
        "ball, random colours": one(shifted(0.6 * sphere), fine, colors=rng.random((len(sphere), 3))),
        "ellipsoid before card": lambda t: [
            mesh(shifted(egg)(t), fine, **blue),
            mesh(tensor(QUAD - [0.2, 0, 0.6]), TWO, **orange),
        ],
        "card behind ellipsoid": lambda t: [
            mesh(tensor(egg), fine, **blue),
            mesh(shifted(QUAD - [0.2, 0, 0.6])(t), TWO, **orange),
        ],
        "ellipsoids cross": lambda t: [
            mesh(shifted(egg, (0, 0, 1))(t), fine, **blue),
            mesh(tensor(egg @ turn(0.3, 0.9, 1.2).T + [0.2, 0, 0.1]), fine, **orange),
        ],
        "cards 30°": crossing_cards(30),
        "cards 12°": crossing_cards(12),
        "cards 5°": crossing_cards(5),
        "cards in one part": crossing_cards(60, one_part=True),
        "half hidden balls": lambda t: [
            mesh(tensor(0.5 * sphere + [-0.2, 0, 0.2]), fine, **blue),
            mesh(shifted(0.5 * sphere + [0.3, 0.1, -0.3])(t), fine, **orange),
        ],
        "bowl": one(shifted(0.7 * sphere @ turn(0.5, 0.3).T), bowl, **shade, **blue),
        "ball on a plane, lambert": lambda t: [
            mesh(shifted(0.4 * sphere)(t), fine, **shade, **blue),
            mesh(tensor(3 * QUAD @ turn(-1.3, 0).T - [0, 0.4, 0]), TWO, **shade, **orange),
        ],
        "ball before a wall, normals": lambda t: [
            mesh(shifted(0.5 * sphere)(t), fine, "normals"),
            mesh(tensor(wall), TWO, "normals"),
        ],
        "bunny": one(shifted(bunny), bunny_faces, **blue),
        "bunny, lambert": one(shifted(bunny), bunny_faces, **shade, **blue),
        "bunny, lambert, 20 px": one(shifted(little), bunny_faces, **shade, **blue),
        "spot turns, lambert": one(swung(spot), spot_faces, **shade, **blue),
        "ball of a field": lambda t: [
            rts.Part(
                rts.Sdf(sphere_of), {"radius": tensor(0.6) + t * PIXEL, "center": tensor([0.05, 0.02, 0])}, "lambert"
            )
        ],
    }


def derivative(render: Callable[[torch.Tensor], torch.Tensor]) -> tuple[np.ndarray, np.ndarray]:
    """The image and its derivative at t = 0."""
    with forward.dual_level():
        result = forward.unpack_dual(render(forward.make_dual(torch.zeros(()), torch.ones(()))))
    return result.primal.detach().numpy(), result.tangent.numpy()


def low(x: np.ndarray) -> np.ndarray:
    return gaussian_filter(x, (2, 2, 0))


def truth(scene: SceneAt, samples: int = SAMPLES, size: tuple[int, int] = SIZE) -> tuple[np.ndarray, np.ndarray]:
    """The area-sampled image, and the difference of two a pixel of motion."""

    def area(t: float) -> np.ndarray:
        options = {"splatter": "none", "layers": 1, "supersample": samples}
        with torch.no_grad():
            return rts.render(scene(torch.tensor(t)), CAMERA, size, **options).numpy()

    return area(0.0), (area(HALF) - area(-HALF)) / (2 * HALF)


def score(
    scene: SceneAt, known: tuple[np.ndarray, np.ndarray], size: tuple[int, int] = SIZE, **options: Any
) -> tuple[float, float, float, float]:
    """Errors in each pixel and low-passed, gain, and error of the image, beside a `truth` that is known."""
    (area, true), norm = known, np.linalg.norm
    image, own = derivative(lambda t: rts.render(scene(t), CAMERA, size, **options))
    return (
        norm(own - true) / norm(true),
        norm(low(own - true)) / norm(low(true)),
        float((low(own) * low(true)).sum() / (low(true) ** 2).sum()),
        float(np.sqrt(((image - area) ** 2).mean())),
    )


def scores(scene: SceneAt) -> dict[str, tuple[float, float, float, float]]:
    """Errors in each pixel and low-passed, gain, and error of the image, by method."""
    known = truth(scene)
    return {name: score(scene, known, **options) for name, options in METHODS.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scenes", nargs="*")
    chosen = parser.parse_args().scenes
    known = scenes()
    print("| scene | " + " | ".join(f"{m}: pixel / low / gain / image" for m in METHODS) + " |")
    print("| --- |" + " --- |" * len(METHODS))
    for name in chosen or known:
        row = scores(known[name])
        print(
            f"| {name} | " + " | ".join("{:.3f} / {:.3f} / {:.3f} / {:.4f}".format(*row[m]) for m in METHODS) + " |",
            flush=True,
        )


if __name__ == "__main__":
    main()
