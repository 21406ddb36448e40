"""Where light of a room, or of a sun, is off that metals reflect: RMS on a sphere against many samples a point.

*Error* is that of `pbr`, in percent; *exact blur* has the same lobes, each with as many samples of the environment in
place of prefiltered levels; *levels* is their difference. What an exact blur leaves is the shape of the lobe. Of the
room 4,096 samples are taken, of the sun 65,536.

    python -m benchmarks.materials.lobes [--sun]
"""

from __future__ import annotations

import argparse
import runpy
from pathlib import Path

import numpy as np

from benchmarks.report import table
from rts.shading import irradiance, microfacets, prefiltered
from rts.shading.environment import _looked_up, reflected

POINTS, REFLECTANCE = 400, 0.9
ROUGHNESS = (0.2, 0.4, 0.6, 0.8, 1.0)
ROOM = Path(__file__).parents[2] / "docs/figures/lights_and_materials.py"
VIEWER = np.array([0.0, 0.0, 1.0])
SUN = np.array([0.5, 0.7, 0.5]) / np.linalg.norm([0.5, 0.7, 0.5])


def spread(samples: int) -> tuple[np.ndarray, np.ndarray]:
    """Heights in 0 to 1, and turns around the axis, of so many samples, each (samples,)."""
    number = np.arange(samples)
    return (number + 0.5) / samples, 2 * np.pi * ((number * 0.6180339887498949) % 1)


def sunny() -> np.ndarray:
    """An environment (256, 512, 3): an even sky of 1, and a disk of 3° radius whose light is 1,000 times as bright."""
    down, around = (np.arange(256)[:, None] + 0.5) / 256 * np.pi, (np.arange(512) + 0.5) / 256 * np.pi
    cosine = -np.sin(down) * np.sin(around) * SUN[0] + np.cos(down) * SUN[1] + np.sin(down) * np.cos(around) * SUN[2]
    return np.where(cosine > np.cos(np.radians(3)), 1000.0, 1.0)[..., None] * np.ones(3)


def unit(x: np.ndarray) -> np.ndarray:
    return x / np.linalg.norm(x, axis=-1, keepdims=True)


def frame(normal: np.ndarray) -> np.ndarray:
    """Rows (3, 3): two tangents and the unit normal (3,)."""
    first = unit(np.cross(normal, [1.0, 0, 0] if abs(normal[0]) < 0.9 else [0, 1.0, 0]))
    return np.stack([first, np.cross(normal, first), normal])


def truth(room: np.ndarray, normal: np.ndarray, roughness: float, samples: int) -> np.ndarray:
    """Radiance (3,) towards the viewer: half vectors as the viewer sees them (Dupuy and Benyoub 2023)."""
    (places, turns), alpha, axes = spread(samples), roughness**2, frame(normal)
    viewer = axes @ VIEWER
    stretched = unit(viewer * [alpha, alpha, 1])
    height = (1 - places) * (1 + stretched[2]) - stretched[2]
    flat = np.sqrt(np.clip(1 - height**2, 0, 1))
    half = np.stack([flat * np.cos(turns), flat * np.sin(turns), height], axis=1) + stretched
    half = unit(half * [alpha, alpha, 1])
    to_half = half @ viewer
    light = 2 * to_half[:, None] * half - viewer
    to_light = np.maximum(light[:, 2], 0)
    of_viewer, of_light = (np.sqrt(x**2 * (1 - alpha**2) + alpha**2) for x in (viewer[2], to_light))
    weight = to_light * (viewer[2] + of_viewer) / (to_light * of_viewer + viewer[2] * of_light + 1e-12)
    fresnel = (1 - np.clip(to_half, 0, 1)) ** 5
    weight = weight * (REFLECTANCE * (1 - fresnel) + fresnel)
    return (weight[:, None] * _looked_up(room, light @ axes)).mean(axis=0)


def blurred(room: np.ndarray, mean: np.ndarray, roughness: float, samples: int) -> np.ndarray:
    """The room (3,) about a direction, blurred as `prefiltered` does."""
    (places, turns), square = spread(samples), max(roughness, 1e-3) ** 4
    cosine = 2 * (1 - places) / (1 + (square - 1) * places) - 1
    light = np.maximum(cosine, 0)
    weight = light / (light + np.sqrt(light**2 * (1 - square) + square))
    sine = np.sqrt(np.clip(1 - cosine**2, 0, 1))
    ways = np.stack([sine * np.cos(turns), sine * np.sin(turns), cosine], axis=1) @ frame(mean)
    return (weight[:, None] * _looked_up(room, ways)).sum(axis=0) / weight.sum()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sun", action="store_true", help="a sun in an even sky, in place of the room")
    sun = parser.parse_args().sun
    room = sunny() if sun else runpy.run_path(str(ROOM))["room"]().astype(np.float64)
    samples = 65536 if sun else 4096
    environment = prefiltered(room)
    radius, turn = np.sqrt((np.arange(POINTS) + 0.5) / POINTS), np.arange(POINTS) * 2 * np.pi * 0.6180339887498949
    normals = np.stack([radius * np.cos(turn), radius * np.sin(turn), np.sqrt(1 - radius**2)], axis=1)
    diffuse, lines = irradiance(environment["sh"], normals), []
    for roughness in ROUGHNESS:
        true = np.stack([truth(room, normal, roughness, samples) for normal in normals])
        rough = np.full((POINTS, 1), roughness)
        towards = np.broadcast_to(VIEWER, normals.shape)
        (a, b, _), lobe = microfacets.around(normals, towards, normals[:, 2:], rough, True)
        assert lobe is not None
        levels = reflected(environment, lobe.mean, lobe.roughness)
        pairs = zip(lobe.mean, lobe.roughness[:, 0], strict=True)
        exact = np.stack([blurred(room, mean, float(r), samples) for mean, r in pairs])
        ours, best = ((REFLECTANCE * a + b) * (x + lobe.flat * (diffuse - x)) for x in (levels, exact))
        scale = 100 / np.sqrt((true**2).mean())
        off = [np.sqrt((x**2).mean()) * scale for x in (ours - true, best - true, ours - best)]
        lines.append([f"{roughness:g}", *(f"{x:.1f}" for x in off)])
        print(lines[-1], flush=True)
    print(table(["roughness", "error, %", "exact blur", "levels"], lines))


if __name__ == "__main__":
    main()
