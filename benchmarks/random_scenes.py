"""Scenes drawn by chance: how many have derivatives within limits, beside area-sampled images.

A scene has one or two bodies, each with a shader, before the camera, perhaps before a wall; one of them moves, turns,
grows or comes nearer by about a pixel, or its texture shifts. Truth and errors are those of `benchmarks.inside`. A
scene is within limits if the error after a blur of 2 pixels is at most 0.08 more than the truth's own noise, and the
gain within 0.03 of 1. The noise is the difference from a truth of half as many samples.

    python -m benchmarks.random_scenes                  # 80 scenes, ten minutes
    python -m benchmarks.random_scenes --seeds 3 17     # some, by number
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
import trimesh

import rts
from benchmarks import meshes
from benchmarks.edges import PIXEL, SceneAt, low, mesh, score, tensor, truth, turn
from benchmarks.inside import checkers, text

LIMIT, OFF = 0.08, 0.03
SIZES = (48, 64, 96, 128)
MOTIONS = ("shifts", "turns", "grows", "comes nearer", "shears")
LOOKS = ("unlit", "lambert", "normals", "vertex colours", "texture", "pbr")


class Drawn(NamedTuple):
    """A scene: its name, its parts as a function of t, and the side of its image."""

    name: str
    scene: SceneAt
    side: int


def bodies() -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Vertices and faces by name, the farthest vertex at distance 1."""
    found = {
        "ball": trimesh.creation.icosphere(4),
        "coarse ball": trimesh.creation.icosphere(2),
        "box": trimesh.creation.box((1, 0.8, 0.6)),
        "capsule": trimesh.creation.capsule(1.0, 0.4),
        "ring": trimesh.creation.annulus(0.5, 0.8, 0.4),
        "cone": trimesh.creation.cone(0.6, 1.2, sections=48),
        "torus": trimesh.creation.torus(0.7, 0.25, 64, 32),
    }
    named = {name: (np.asarray(x.vertices), np.asarray(x.faces)) for name, x in found.items()}
    for name in ("bunny_5k", "spot/spot_triangulated", "teapot"):
        named[name.split("/")[0]] = meshes.mesh(name)
    return {name: (meshes.normalised(v), f) for name, (v, f) in named.items()}


def moved(vertices: np.ndarray, motion: str, rng: np.random.Generator, pixel: float) -> Callable:
    """Vertices as a function of t, a motion whose farthest point goes about a pixel."""
    start, direction = tensor(vertices), rng.normal(size=3)
    direction /= np.linalg.norm(direction)
    if motion == "turns":
        step = torch.linalg.cross(tensor(direction).expand_as(start), start - start.mean(0))
    elif motion == "grows":
        step = start - start.mean(0)
    elif motion == "shears":
        step = tensor(direction * [1, 1, 0]) * start[:, 1:2]
    else:
        step = tensor([0, 0, 4.0] if motion == "comes nearer" else direction * [1, 1, 0.3]).expand_as(start)
    most = 1.0 if motion == "comes nearer" else float(step.norm(dim=1).max())
    return lambda t: start + t * pixel * step / most


def part_of(body: tuple, look: str, rng: np.random.Generator, move: Callable) -> Callable[[torch.Tensor], rts.Part]:
    """A part of a body with a look."""
    vertices, faces = body
    color = rng.uniform(0.2, 1, 3)
    if look == "vertex colours":
        smooth = 0.5 + 0.4 * np.sin(3 * vertices @ rng.normal(size=(3, 3)) + rng.uniform(0, 6, 3))
        return lambda t: mesh(move(t), faces, "unlit", colors=smooth)
    if look == "texture":
        image, uv = (text() if rng.random() < 0.4 else checkers(4, 64)), 0.5 + 0.45 * vertices[:, :2]
        return lambda t: mesh(move(t), faces, "textured", texture=image, uv=uv)
    if look == "pbr":
        rough, metal = rng.uniform(0.3, 1), rng.uniform()
        return lambda t: mesh(move(t), faces, "pbr", color=color, roughness=rough, metallic=metal)
    theta: dict[str, Any] = {} if look == "normals" else {"color": color}
    return lambda t: mesh(move(t), faces, look, **theta)


def drawn(seed: int, known: dict) -> Drawn:
    """The scene with a number."""
    rng = np.random.default_rng(1000 + seed)
    side = int(rng.choice(SIZES))
    pixel, names, made = PIXEL * 96 / side, [], []
    count = 1 + int(rng.random() < 0.4)
    for i in range(count):
        name, look = str(rng.choice(list(known))), str(rng.choice(LOOKS))
        vertices, faces = known[name]
        place = np.append(rng.uniform(-0.35, 0.35, 2), -0.5 * i)
        placed = rng.uniform(0.35, 0.75) * vertices @ turn(*rng.uniform(0, 6, 3)).T + place
        motion = str(rng.choice(MOTIONS)) if i == 0 else "stays"
        names.append(f"{name}, {look}, {motion}")
        still = tensor(placed)
        move = moved(placed, motion, rng, pixel) if i == 0 else lambda t, v=still: v
        made.append(part_of((vertices, faces), look, rng, move))
    if rng.random() < 0.3:
        wall = np.array([[-3, -3, -1.2], [3, -3, -1.6], [3, 3, -1.4], [-3, 3, -1.0]])
        names.append("wall")
        made.append(lambda t: mesh(tensor(wall), np.array([[0, 1, 2], [0, 2, 3]]), "lambert", color=(0.4, 0.5, 0.3)))
    return Drawn("; ".join(names), lambda t: [make(t) for make in made], side)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="*", default=range(80))
    parser.add_argument("--samples", type=int, default=24, help="of the truth, a pixel and axis")
    arguments = parser.parse_args()
    known, within, looks = bodies(), [], Counter()
    print("| number | scene | side | pixel / low / gain / image | noise | |\n| --- | --- | --- | --- | --- | --- |")
    for seed in arguments.seeds:
        name, scene, side = drawn(seed, known)
        size = side, side
        true = truth(scene, arguments.samples, size)
        rough = truth(scene, arguments.samples // 2, size)[1]
        noise = np.linalg.norm(low(rough - true[1])) / np.linalg.norm(low(true[1]))
        pixel, blurred, gain, image = score(scene, true, size)
        good = blurred <= LIMIT + noise and abs(gain - 1) <= OFF + noise
        within.append(good)
        if not good:
            looks.update(look for look in LOOKS if f" {look}," in name)
        figures = f"{pixel:.3f} / {blurred:.3f} / {gain:.3f} / {image:.4f}"
        print(f"| {seed} | {name} | {side} | {figures} | {noise:.3f} | {'' if good else 'outside'} |", flush=True)
    print(f"\n{sum(within)} of {len(within)} scenes are within limits; looks of others: {dict(looks)}")


if __name__ == "__main__":
    main()
