"""Gradients of single vertices by found edges and by the paper's splatter, against area-sampled images.

A loss is the mean square between the image and that of a body whose vertices are displaced. Its derivatives by single
vertices, sideways and upward, are compared with central differences over ±0.15 pixels of the same loss's gradient in
images with 32 × 32 samples a pixel: relative L2 error over all vertices of a kind, and gain.

- *silhouette*: vertices of a ball of 162, of one colour, between faces that are seen and faces that are not;
- *crease*: vertices of a box with a colour for each face, between faces that are seen, of different colours;
- *inside*: vertices of a ball with a random colour for each vertex, all of whose faces are seen.

    python -m benchmarks.edges_vertices
    python -m benchmarks.edges_vertices crease
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
import trimesh

import rts
from benchmarks.edges import CAMERA, DEPTH, HALF, SAMPLES, mesh, tensor, turn
from benchmarks.report import table

SIZE = 40, 40
PIXEL = 2 * DEPTH * np.tan(np.radians(20)) / SIZE[0]
METHODS: dict[str, dict[str, Any]] = {
    f"{splatter} {n} × {n}": {"splatter": splatter, "supersample": n} for splatter in ("multi", "edges") for n in (1, 4)
}


class Body(NamedTuple):
    """A body with free vertices.

    Attributes:
        vertices: (V, 3).
        part: tensors like `vertices` → the part.
        chosen: numbers of the vertices to look at.
    """

    vertices: np.ndarray
    part: Callable[[torch.Tensor], rts.Part]
    chosen: np.ndarray


def bodies() -> dict[str, Body]:
    """The bodies by the kind of their vertices."""
    ball = trimesh.creation.icosphere(2)
    round_, faces = 0.7 * np.asarray(ball.vertices) @ turn(0.3, 0.2).T, np.asarray(ball.faces)
    colors = np.random.default_rng(0).random((len(round_), 3))
    seen = front(round_, faces)
    box = trimesh.creation.box((1, 0.9, 0.8)).subdivide().subdivide()
    corners, sides = np.asarray(box.vertices) @ turn(0.5, 0.6).T, np.asarray(box.faces)
    kinds = np.unique(np.round(np.asarray(box.face_normals), 3), axis=0, return_inverse=True)[1].ravel()
    palette = np.repeat(np.random.default_rng(1).random((6, 3))[kinds], 3, axis=0)
    own = np.arange(3 * len(sides)).reshape(-1, 3)
    edge = np.array([len({*kinds[(sides == v).any(axis=1)]}) > 1 for v in range(len(corners))])
    return {
        "silhouette": Body(
            round_, lambda v: mesh(v, faces, color=(0.2, 0.7, 1)), np.flatnonzero(seen[:, 0] & seen[:, 1])
        ),
        "crease": Body(
            corners,
            lambda v: mesh(v[torch.as_tensor(sides.ravel())], own, colors=palette),
            np.flatnonzero(edge & ~front(corners, sides)[:, 1]),
        ),
        "inside": Body(round_, lambda v: mesh(v, faces, colors=colors), np.flatnonzero(~seen[:, 1])),
    }


def front(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(V, 2) bool: whether a vertex has faces that the camera sees, and such that it does not."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    toward = (np.cross(b - a, c - a) * ([0, 0, DEPTH] - a)).sum(1) > 0
    found = np.zeros((len(vertices), 2), bool)
    for side, faces_of in enumerate((faces[toward], faces[~toward])):
        found[faces_of.ravel(), side] = True
    return found


def area(body: Body, vertices: np.ndarray, samples: int) -> np.ndarray:
    """The area-sampled image."""
    options = {"splatter": "none", "layers": 1, "supersample": samples}
    with torch.no_grad():
        return rts.render(body.part(tensor(vertices)), CAMERA, SIZE, **options).numpy().astype(np.float64)


def scores(kind: str, samples: int = SAMPLES) -> dict[str, tuple[float, float]]:
    """For each method the relative L2 error and the gain of the gradient of vertices of a kind."""
    body = bodies()[kind]
    noise = np.random.default_rng(2).normal(0, 0.4 * PIXEL, body.vertices.shape)
    weights = 2 * (area(body, body.vertices, samples) - area(body, body.vertices + noise, samples))
    true = np.zeros((len(body.chosen), 2))
    for row, vertex in enumerate(body.chosen):
        for axis in (0, 1):
            step = np.zeros_like(body.vertices)
            step[vertex, axis] = HALF * PIXEL
            ahead, behind = (area(body, body.vertices + sign * step, samples) for sign in (1, -1))
            true[row, axis] = (weights * (ahead - behind)).sum() / (2 * HALF)
    found = {}
    for name, options in METHODS.items():
        vertices = tensor(body.vertices).requires_grad_()
        image = rts.render(body.part(vertices), CAMERA, SIZE, **options)
        (gradient,) = torch.autograd.grad((image * tensor(weights)).sum(), vertices)
        own = gradient.numpy()[body.chosen, :2] * PIXEL
        error = np.linalg.norm(own - true) / np.linalg.norm(true)
        found[name] = float(error), float((own * true).sum() / (true**2).sum())
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kinds", nargs="*", default=["silhouette", "crease", "inside"])
    rows = []
    for kind in parser.parse_args().kinds:
        rows.append([kind, *("{:.3f} / {:.3f}".format(*s) for s in scores(kind).values())])
        print(rows[-1], flush=True)
    print(table(["error / gain", *METHODS], rows))


if __name__ == "__main__":
    main()
