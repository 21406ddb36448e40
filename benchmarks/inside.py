"""What lies inside of outlines: errors of images and derivatives where colours vary, by settings of `edges`.

Truth is a central difference over ±0.15 pixels of images with 32 × 32 samples a pixel. A row has the relative L2 error
of the derivative image, in each pixel and after a Gaussian of 2 pixels, its gain, and the error of the image itself,
root mean square.

    python -m benchmarks.inside                 # all scenes
    python -m benchmarks.inside "text, uv"      # some
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
import trimesh
from PIL import Image, ImageDraw, ImageFont

import rts
from benchmarks import meshes
from benchmarks.edges import PIXEL, SAMPLES, SIZE, SceneAt, mesh, score, shifted, swung, tensor, truth, turn
from benchmarks.report import table

SMALL = 64, 64
METHODS: dict[str, dict[str, Any]] = {"edges": {}, "edges, 2 × 2": {"supersample": 2}}
PLANE = np.array([[-0.85, -0.8, 0.1], [0.82, -0.85, -0.1], [0.8, 0.83, -0.1], [-0.83, 0.8, 0.1]]) @ turn(0.4, 0.3).T
UV = np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]])
WORDS = "the image of a scene is a sparse matrix times the colours of samples "


def text(size: int = 256, margin: int = 24) -> np.ndarray:
    """A page of black letters on white, (size, size, 3), linear; without a margin letters are cut at its edges."""
    page = Image.new("L", (size, size), 255)
    draw, line, font = ImageDraw.Draw(page), 34, ImageFont.load_default(30)
    for i in range(size // line + 1):
        draw.text((3 - 7 * (i % 5), line * i - 4), WORDS[7 * i % 40 :] + WORDS, fill=0, font=font)
    grey = np.asarray(page, np.float32)[..., None] / 255
    inside = np.pad(np.ones((size - 2 * margin,) * 2), margin)[..., None]
    return np.repeat(np.where(inside, grey, 1), 3, axis=2).astype(np.float32)


def checkers(squares: int = 8, texels: int = 32) -> np.ndarray:
    """A checkerboard of squares of so many texels, (n, n, 3)."""
    i = np.arange(squares * texels) // texels
    board = (i[:, None] + i) % 2
    return np.where(board[..., None] == 1, [0.9, 0.8, 0.3], [0.1, 0.2, 0.5]).astype(np.float32)


def plane(texture: np.ndarray, shader: Any = "textured", slides: bool = True) -> SceneAt:
    """A plane with a texture whose coordinates shift by a pixel, or that moves itself by one."""
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    step = np.array([[0.8, 0.45]]) * PIXEL / 1.65

    def scene(t: torch.Tensor) -> list[rts.Part]:
        vertices, uv = tensor(PLANE), tensor(UV)
        theta = {"texture": texture, "uv": uv + t * tensor(step)} if slides else {"texture": texture, "uv": UV}
        theta["vertices"] = vertices if slides else shifted(PLANE, (0.8, 0.45, 0))(t)
        theta = {name: x if torch.is_tensor(x) else np.asarray(x, np.float32) for name, x in theta.items()}
        return [rts.Part(rts.Mesh(faces), theta, shader)]

    return scene


def box(theta: Mapping[str, Any], points: Any) -> Any:
    """The distance of points from a box with sharp edges, turned; the largest of three distances from slabs."""
    xp, rows, half = rts.namespace(points), turn(0.5, 0.6), theta["half"]
    slabs = [abs(sum(points[..., k] * float(rows[k, i]) for k in range(3))) - half[i] for i in range(3)]
    return xp.maximum(xp.maximum(slabs[0], slabs[1]), slabs[2])


def scenes() -> dict[str, tuple[SceneAt, tuple[int, int]]]:
    """The scenes and sizes of images by name; t is a motion of about a pixel."""
    ball = trimesh.creation.icosphere(4)
    fine, sphere = np.asarray(ball.faces), np.asarray(ball.vertices)
    coarse = trimesh.creation.icosphere(3)
    flat = 0.7 * np.asarray(coarse.vertices)[coarse.faces.ravel()] * [1, 0.9, 0.8]
    bunny, bunny_faces = meshes.mesh("bunny")
    colors = np.random.default_rng(0).random((162, 3))
    few = trimesh.creation.icosphere(2)
    lamp = {"ambient": 0.05, "direction": (0.3, 0.5, 1.0), "color": (3.0, 3.0, 3.0)}
    metal = {"color": (0.9, 0.7, 0.4), "metallic": 1.0, "roughness": 0.25}

    def shiny(t: torch.Tensor) -> list[rts.Part]:
        theta = {name: np.asarray(x, np.float32) for name, x in metal.items()}
        lamps = {name: np.asarray(x, np.float32) for name, x in lamp.items()}
        vertices = shifted(0.7 * sphere)(t)
        return [rts.Part(rts.Mesh(fine), {"vertices": vertices, "light": lamps, **theta}, "pbr")]

    def edged(surface: Any) -> SceneAt:
        def scene(t: torch.Tensor) -> list[rts.Part]:
            half = tensor([0.5, 0.45, 0.4]) + t * PIXEL * tensor([1.0, 0.5, 0.3])
            return [rts.Part(surface, {"half": half}, "lambert")]

        return scene

    each = np.arange(len(flat)).reshape(-1, 3)
    return {
        "text, uv shifts": (plane(text()), SIZE),
        "text without a margin, uv shifts": (plane(text(margin=0)), SIZE),
        "text of twice the texels, uv shifts": (plane(text(512)), SIZE),
        "checkers, uv shifts": (plane(checkers()), SIZE),
        "checkers, mip, uv shifts": (plane(checkers(), rts.plugin("shaders", "textured")(mip=True)), SIZE),
        "checkers, lambert, uv shifts": (plane(checkers(), "lambert"), SIZE),
        "checkers, pbr, uv shifts": (plane(checkers(), "pbr"), SIZE),
        "checkers move": (plane(checkers(), slides=False), SIZE),
        "text moves": (plane(text(), slides=False), SIZE),
        "bunny, lambert, turns, 64²": (lambda t: [mesh(swung(bunny)(t), bunny_faces, "lambert")], SMALL),
        "metal of roughness 0.25 moves": (shiny, SIZE),
        "sharp field, isosurface": (edged(rts.Isosurface([[-1.0] * 3, [1.0] * 3], f=box, shape=(64, 64, 64))), SIZE),
        "sharp field, Sdf": (edged(rts.Sdf(box)), SIZE),
        "1,280 flat faces, lambert, turn": (lambda t: [mesh(swung(flat)(t), each, "lambert")], SIZE),
        "ball of random colours moves": (
            lambda t: [mesh(shifted(0.7 * np.asarray(few.vertices))(t), few.faces, colors=colors)],
            SIZE,
        ),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scenes", nargs="*")
    parser.add_argument("--samples", type=int, default=SAMPLES, help="of the truth, a pixel and axis")
    arguments = parser.parse_args()
    known = scenes()
    rows = []
    for name in arguments.scenes or known:
        scene, size = known[name]
        true = truth(scene, arguments.samples, size)
        found = (score(scene, true, size, **options) for options in METHODS.values())
        rows.append([name, *("{:.3f} / {:.3f} / {:.3f} / {:.4f}".format(*row) for row in found)])
        print(*rows[-1], sep=" | ", flush=True)
    print(table(["scene", *METHODS], rows))


if __name__ == "__main__":
    main()
