"""Spheres, metallic × roughness, and models of glTF beside Mitsuba's `principled`, in the light of a smooth sky.

Needs Mitsuba (`pip install mitsuba`), and for models the folder that RTS_DATA names. Pictures go to `out/materials`:
ours, Mitsuba's, and five times their difference.

    python -m benchmarks.materials.compare
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

import rts
from benchmarks.materials.mitsuba_scenes import Shape, pictures
from benchmarks.report import table

DATA = Path(os.environ.get("RTS_DATA", "../shared/data"))
COLUMNS = (0.2, 0.4, 0.6, 0.8, 1.0)
"""Roughnesses."""
MODELS = {
    "WaterBottle": "gltf/WaterBottle/WaterBottle.gltf",
    "DamagedHelmet": "gltf/DamagedHelmet.glb",
    "NormalTangentTest": "gltf/NormalTangentTest.glb",
}
EYE = (1.2, 0.5, 2.6)


def sky(side: float = 0.5, ground: float = 0.2) -> np.ndarray:
    """An environment (64, 128, 3) of contrast 10: a bright patch of sky, a dark ground, all without edges."""
    v, u = ((np.arange(n) + 0.5) / n for n in (64, 128))
    up, around = np.cos(np.pi * v)[:, None], 2 * np.pi * (u - 0.5)
    across, back = np.sin(np.pi * v)[:, None] * np.sin(around), -np.sin(np.pi * v)[:, None] * np.cos(around)
    sun = np.exp(4 * (side * across + 0.7 * up - np.sqrt(0.51 - side**2) * back - 1))
    ground = ground + 0.5 / (1 + np.exp(-6 * up)) + 0 * sun
    return (ground[..., None] * [0.8, 0.9, 1.0] + sun[..., None] * [1.4, 1.2, 1.0]).astype(np.float32)


def sphere(metallic: float, roughness: float) -> Shape:
    """A sphere of radius 1 with one colour. Each is alone, or Mitsuba's would shade one another."""
    ball = trimesh.creation.icosphere(5)
    normals = np.asarray(ball.vertices, np.float32)
    material = {"color": (0.9, 0.6, 0.35), "metallic": metallic, "roughness": roughness}
    material = {name: np.array(value, np.float32) for name, value in material.items()}
    return Shape(normals, np.asarray(ball.faces), normals, 0 * normals[:, :2], material)


def model(name: str, side: int = 1024) -> Shape:
    """A model of a file with radius 1 about the origin; its maps are averaged to `side`² texels."""
    mesh: Any = trimesh.load(DATA / MODELS[name], force="mesh", process=False)
    theta = rts.load(DATA / MODELS[name])[0].theta
    low, high = mesh.bounds
    vertices = (mesh.vertices - (low + high) / 2) / np.linalg.norm(high - low) * 2
    maps = {n: _smaller(np.asarray(theta[n]), side) for n in ("texture", "metallic", "roughness", "normal_map")}
    vertices, normals, uv = (np.asarray(x, np.float32) for x in (vertices, mesh.vertex_normals, mesh.visual.uv))
    return Shape(vertices, np.asarray(mesh.faces), normals, uv, maps)


def _smaller(image: np.ndarray, side: int) -> np.ndarray:
    while image.shape[0] > side:
        image = image.reshape(image.shape[0] // 2, 2, image.shape[1] // 2, 2, -1).mean(axis=(1, 3))
    return image.astype(np.float32)


def compared(shape: Shape, camera: rts.Camera, size: tuple[int, int], samples: int) -> list[np.ndarray]:
    """Our picture and Mitsuba's, (H, W, 4)."""
    part = shape.part.replace(theta={**shape.part.theta, "light": {"environment": sky()}})
    return [np.asarray(rts.render(part, camera, size)), *pictures([shape], sky(), [camera], size, samples)]


def saved(path: Path, pair: list[np.ndarray]) -> None:
    """Both pictures, and five times their difference."""
    ours, theirs = (p[..., :3] for p in pair)
    rows = [ours, theirs, 5 * abs(ours - theirs)]
    rts.save_image(
        path, np.concatenate(rows, axis=0 if ours.shape[1] > ours.shape[0] else 1).clip(0, 1).astype(np.float32)
    )


def off(pair: list[np.ndarray]) -> tuple[str, str]:
    """Inside of outlines, in percent: RMS of the difference of that of Mitsuba's picture, and the mean difference."""
    inside = (pair[0][..., 3] > 0.999) & (pair[1][..., 3] > 0.999)
    ours, theirs = (p[..., :3][inside] for p in pair)
    rms = np.sqrt(((ours - theirs) ** 2).mean() / (theirs**2).mean())
    return f"{100 * rms:.1f}", f"{100 * (ours - theirs).mean() / theirs.mean():+.1f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=Path("out/materials"))
    parser.add_argument("--models", nargs="*", choices=MODELS, default=list(MODELS))
    parser.add_argument("--samples", type=int, default=256)
    args = parser.parse_args()
    args.output.mkdir(parents=True, exist_ok=True)
    lines = []
    camera = rts.Camera.look_at((0, 0, 12), (0, 0, 0), fov_y=2 * np.degrees(np.arctan(1.05 / 12)))
    rows = []
    for metallic in (0.0, 1.0):
        pairs = [compared(sphere(metallic, r), camera, (96, 96), args.samples) for r in COLUMNS]
        rows.append([np.concatenate(column, axis=1) for column in zip(*pairs, strict=True)])
        for roughness, pair in zip(COLUMNS, pairs, strict=True):
            lines.append([f"sphere, metallic {metallic:g}, roughness {roughness:g}", *off(pair)])
    saved(args.output / "spheres.png", [np.concatenate(column) for column in zip(*rows, strict=True)])
    for name in args.models:
        camera = rts.Camera.look_at(EYE, (0, 0, 0), fov_y=38)
        pair = compared(model(name), camera, (256, 256), args.samples)
        saved(args.output / f"{name}.png", pair)
        lines.append([name, *off(pair)])
    text = table(["scene", "RMS, %", "mean, %"], lines)
    (args.output / "compare.md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
