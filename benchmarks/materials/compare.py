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
SEVERAL = {
    "TextureSettingsTest": ("gltf/TextureSettingsTest.glb", (0.0, 0.0, 2.6)),
    "BoxVertexColors": ("gltf/BoxVertexColors.glb", EYE),
}
"""Models that are taken part by part, and from where they are seen."""
CONTINUED = {"repeat": "wrap", "mirror": "symmetric", "clamp": "edge"}
"""Continuation of a texture → that of `numpy.pad`."""


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


def part_by_part(path: str, eye: tuple[float, float, float]) -> list[Shape]:
    """The parts of a file with radius 1 about the origin, without what the file says is not seen from the eye.

    Textures are continued as far as uv reach, as Mitsuba's wrap alike along both axes.
    """
    parts, shapes = rts.load(DATA / path, weld=False, cull="file"), []
    places = [np.eye(4) if part.transform is None else np.asarray(part.transform, float) for part in parts]
    moved = [x.theta["vertices"] @ m[:3, :3].T + m[:3, 3] for x, m in zip(parts, places, strict=True)]
    low, high = (f([f(x, axis=0) for x in moved], axis=0) for f in (np.min, np.max))
    for part, vertices, place in zip(parts, moved, places, strict=True):
        theta, colors = part.theta, None
        normals = theta["normals"] @ np.linalg.inv(place[:3, :3])
        uv = theta["uv"] if "uv" in theta else np.zeros((len(vertices), 2))
        material = {name: theta[name] for name in ("metallic", "roughness")}
        if "texture" in theta:
            material["texture"], uv = _continued(theta["texture"], uv, part.shader.wrap)
        elif "colors" in theta:
            colors = theta["colors"] * theta.get("color", np.ones(3))
        else:
            material["color"] = theta["color"]
        vertices = (vertices - (low + high) / 2) / np.linalg.norm(high - low) * 2
        normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
        vertices, normals, uv = (np.asarray(x, np.float32) for x in (vertices, normals, uv))
        faces = part.surface.faces
        if part.cull == "back":
            a, b, c = (vertices[faces[:, i]] for i in range(3))
            faces = faces[((np.cross(b - a, c - a)) * (np.array(eye) - a)).sum(axis=1) > 0]
        if len(faces):
            shapes.append(Shape(vertices, faces, normals, uv, material, colors))
    return shapes


def _continued(texture: np.ndarray, uv: np.ndarray, wrap: Any) -> tuple[np.ndarray, np.ndarray]:
    """A texture that holds all of `uv` (N, 2), and these in it."""
    low, high = np.floor(uv.min(axis=0)).astype(int), np.ceil(uv.max(axis=0)).astype(int)
    for axis, name in enumerate((wrap, wrap) if isinstance(wrap, str) else wrap):
        across = 1 - axis  # Columns are along u, rows along v, upwards.
        before, after = np.array([-low[axis], high[axis] - 1]).clip(0) * texture.shape[across]
        pad = [(0, 0)] * 3
        pad[across] = (before, after) if across else (after, before)
        texture = np.pad(texture, pad, CONTINUED[name])
    first, last = np.minimum(low, 0), np.maximum(high, 1)
    return texture, (uv - first) / (last - first)


def _smaller(image: np.ndarray, side: int) -> np.ndarray:
    while image.shape[0] > side:
        image = image.reshape(image.shape[0] // 2, 2, image.shape[1] // 2, 2, -1).mean(axis=(1, 3))
    return image.astype(np.float32)


def compared(shapes: list[Shape], camera: rts.Camera, size: tuple[int, int], samples: int) -> list[np.ndarray]:
    """Our picture and Mitsuba's, (H, W, 4)."""
    parts = [x.part.replace(theta={**x.part.theta, "light": {"environment": sky()}}) for x in shapes]
    return [np.asarray(rts.render(parts, camera, size)), *pictures(shapes, sky(), [camera], size, samples)]


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
    parser.add_argument("--models", nargs="*", choices=[*MODELS, *SEVERAL], default=[*MODELS, *SEVERAL])
    parser.add_argument("--samples", type=int, default=256)
    args = parser.parse_args()
    args.output.mkdir(parents=True, exist_ok=True)
    lines = []
    camera = rts.Camera.look_at((0, 0, 12), (0, 0, 0), fov_y=2 * np.degrees(np.arctan(1.05 / 12)))
    rows = []
    for metallic in (0.0, 1.0):
        pairs = [compared([sphere(metallic, r)], camera, (96, 96), args.samples) for r in COLUMNS]
        rows.append([np.concatenate(column, axis=1) for column in zip(*pairs, strict=True)])
        for roughness, pair in zip(COLUMNS, pairs, strict=True):
            lines.append([f"sphere, metallic {metallic:g}, roughness {roughness:g}", *off(pair)])
    saved(args.output / "spheres.png", [np.concatenate(column) for column in zip(*rows, strict=True)])
    for name in args.models:
        path, eye = SEVERAL.get(name, (None, EYE))
        camera = rts.Camera.look_at(eye, (0, 0, 0), fov_y=38)
        pair = compared(part_by_part(path, eye) if path else [model(name)], camera, (256, 256), args.samples)
        saved(args.output / f"{name}.png", pair)
        lines.append([name, *off(pair)])
    text = table(["scene", "RMS, %", "mean, %"], lines)
    (args.output / "compare.md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
