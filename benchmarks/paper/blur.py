"""Effect of blur (section 4.1): a sphere's texture from images, by sharp and by splatted renders, with mipmaps or not.

As in the experiment of nvdiffrast that the paper repeats, each step sees the sphere turned by chance and from a
distance by chance, from where a pixel is a quarter of a texel to where it is tens of texels. Its target is the true
texture with mipmaps, 4 × 4 samples a pixel. The loss is the mean square difference of images, and the result is judged
by its texels. All ways take the same steps. Written are a figure and the numbers:

    python -m benchmarks.paper.blur -o out/blur
    python -m benchmarks.paper.blur --quick              # fewer texels, pixels and steps
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import rts
from benchmarks.paper.implicit import Task, jax_steps, torch_steps
from rts.arrays.engines import engine_named
from rts.files.srgb import encode_srgb

NEAR_BY, FAR_OFF, FOV = 1.5, 50.0, 43.6
"""Least and greatest distance from the sphere's centre, of its radius; the field of view, degrees."""
SHIFT = 0.25
"""How far off its centre the camera may look."""
RATE, GREY = 0.01, 0.5
WAVES, FINEST = 600, 0.6
"""Waves that the texture is made of, and the highest wave number, of that of the rows: 1 has a wave in two texels."""
TRUSTED = np.radians(60.0)
"""Texels are judged up to this latitude: beyond, many of them share a place."""
WAYS = {
    "none": ("none", 1),
    "multi": ("multi", 1),
    "edges": ("edges", 1),
    "none, 2 × 2": ("none", 2),
    "edges, 2 × 2": ("edges", 2),
}
"""Name → splatter, and samples a pixel along each axis."""
COLORS = "black", "tab:blue", "tab:orange", "tab:gray", "tab:red"
"""The colours of their lines."""


class Size(NamedTuple):
    """A size of the experiment: rows of texels (twice as many columns), side of images, number of steps."""

    rows: int
    side: int
    steps: int


FULL, QUICK = Size(128, 64, 2500), Size(64, 32, 100)


def earth(rows: int) -> np.ndarray:
    """A texture (rows, 2 rows, 3) float32: seas, land with coasts, and detail down to the texel; waves in space."""
    rng = np.random.default_rng(1)
    wave = np.exp(rng.uniform(np.log(2.0), np.log(FINEST * rows), WAVES))
    ways = rng.normal(size=(WAVES, 3))
    ways *= (wave / np.linalg.norm(ways, axis=1))[:, None]
    around, up = np.meshgrid(2 * np.pi * (np.arange(2 * rows) + 0.5) / (2 * rows), latitudes(rows))
    points = np.stack([np.cos(up) * np.cos(around), np.sin(up), np.cos(up) * np.sin(around)], axis=-1)
    found = np.zeros((2, rows, 2 * rows))
    for k in range(WAVES):
        found[k % 2] += np.cos(points @ ways[k] + rng.uniform(0, 2 * np.pi)) / wave[k] ** 0.7
    height, detail = (x / x.std() for x in found)
    land = (height > 0.3)[..., None]
    shade = 0.5 + 0.12 * detail[..., None]
    colors = np.where(land, shade * [0.9, 1.1, 0.4], shade * [0.15, 0.5, 1.1])
    return np.where((np.abs(height) > 2.0)[..., None], [0.95, 0.95, 0.9], colors).clip(0.02, 0.98).astype(np.float32)


def latitudes(rows: int) -> np.ndarray:
    """The latitudes (rows,) of the rows of texels, from the upper one down, radians."""
    return np.pi / 2 - np.pi * (np.arange(rows) + 0.5) / rows


def sphere(rings: int = 48) -> tuple[Any, dict[str, np.ndarray]]:
    """A mesh of the unit sphere, and its θ without a texture: u goes around, v up."""
    u, v = np.meshgrid(np.linspace(0, 1, 2 * rings + 1), np.linspace(0, 1, rings + 1))
    around, up = 2 * np.pi * u, np.pi * (v - 0.5)
    vertices = np.stack([np.cos(up) * np.cos(around), np.sin(up), np.cos(up) * np.sin(around)], axis=-1)
    first = (np.arange(rings)[:, None] * (2 * rings + 1) + np.arange(2 * rings)).reshape(-1, 1)
    corners = first + [0, 2 * rings + 1, 1, 1, 2 * rings + 1, 2 * rings + 2]
    theta = {"vertices": vertices.reshape(-1, 3), "uv": np.stack([u, v], axis=-1).reshape(-1, 2)}
    surface = rts.plugin("surfaces", "mesh")(corners.reshape(-1, 3))
    return surface, {name: x.astype(np.float32) for name, x in theta.items()}


def view(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Eye, what it looks at, and what is up."""
    way, up, off = rng.normal(size=(3, 3))
    off *= SHIFT * rng.uniform() / np.linalg.norm(off)
    eye = way / np.linalg.norm(way) * rng.uniform(NEAR_BY, FAR_OFF)
    return tuple(x.astype(np.float32) for x in (eye + off, off, up))


def camera(eye: Any, target: Any, up: Any) -> rts.Camera:
    return rts.Camera.look_at(eye, target, up, fov_y=FOV, near=0.1, far=100.0)


def part(texture: Any, mip: bool) -> rts.Part:
    surface, theta = sphere()
    return rts.Part(surface, theta | {"texture": texture}, rts.plugin("shaders", "textured")(mip=mip), cull="back")


def psnr(texture: np.ndarray, truth: np.ndarray) -> float:
    """Peak signal-to-noise of texels up to the trusted latitude, each by its area on the sphere; decibels."""
    up = latitudes(len(truth))
    weights = np.where(np.abs(up) < TRUSTED, np.cos(up), 0)
    error = ((texture.clip(0, 1).astype(np.float64) - truth) ** 2).mean((1, 2))
    return float(-10 * np.log10((weights * error).sum() / weights.sum()))


def stepping(engine: str, way: tuple[str, int], mip: bool, size: Size) -> Any:
    """Takes a view and its target, gives a loss and θ after a step of Adam, whose rate falls to zero as a cosine."""
    start = {"texture": np.full((size.rows, 2 * size.rows, 3), GREY, np.float32)}
    splatter, supersample = way

    def loss(theta: Any, seen: Any, wanted: Any) -> Any:
        options: dict[str, Any] = {"splatter": splatter, "supersample": supersample, "layers": 1}
        if engine == "jax":
            options["capacity"] = 2 * (supersample * size.side + 4) ** 2
        found = rts.render(part(theta["texture"], mip), camera(*seen), (size.side, size.side), **options)
        return ((found[..., :3] - wanted) ** 2).mean()

    begin: Callable = {"torch": torch_steps, "jax": jax_steps}[engine]
    steps = begin(loss, Task("texture", None, start, "textured", (), "adam", RATE), size.steps)
    next(steps)
    return steps


def fitted(engine: str, truth: np.ndarray, size: Size) -> tuple[dict, dict, list[int]]:
    """Textures and the course of their PSNR, by way and mipmaps, all by the same views; the steps it was taken at."""
    known, rng, target = engine_named(engine), np.random.default_rng(0), part(truth, True)
    ways = {(name, mip): stepping(engine, way, mip, size) for mip in (True, False) for name, way in WAYS.items()}
    textures, courses, shown = {}, {key: [] for key in ways}, []
    for step in range(size.steps):
        seen = view(rng)
        wanted = rts.render(target, camera(*seen), (size.side, size.side), splatter="none", supersample=4)[..., :3]
        given = [known.constant(x) for x in seen], known.constant(np.asarray(wanted, np.float32))
        look = step + 1 == size.steps or (step + 1) % max(1, size.steps // 50) == 0
        shown += [step + 1] if look else []
        for key, steps in ways.items():
            _, theta = steps.send(given)
            if look:
                textures[key] = np.array(known.to_numpy(theta["texture"]))
                courses[key].append(psnr(textures[key], truth))
        if look:
            told = ", ".join(f"{n}{'' if m else ' without'} {x[-1]:.2f}" for (n, m), x in courses.items())
            print(f"step {step + 1}: {told}", flush=True)
    return textures, courses, shown


def draw(path: Path, truth: np.ndarray, textures: dict, courses: dict, shown: list[int]) -> None:
    """The course of PSNR, and a part of the textures."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13, 7.6), layout="constrained")
    grid = figure.add_gridspec(3, len(WAYS), height_ratios=(1.3, 1, 1))
    axes = figure.add_subplot(grid[0, :-1])
    for k, name in enumerate(WAYS):
        for mip, line in ((True, "-"), (False, "--")):
            axes.plot(shown, courses[name, mip], line, color=COLORS[k], label=name if mip else None)
    axes.set(xlabel="step", ylabel="PSNR of texels, dB", title="with mipmaps (lines), without (dashes)")
    axes.legend(fontsize=8)
    axes.grid(alpha=0.3)
    rows = len(truth)
    cut = slice(rows // 4, rows * 5 // 8), slice(rows // 2, rows)
    places = [((0, len(WAYS) - 1), "truth", truth)]
    for i, mip in enumerate((True, False)):
        for k, name in enumerate(WAYS):
            title = f"{name}, {'mipmaps' if mip else 'none'}: {courses[name, mip][-1]:.1f} dB"
            places.append(((1 + i, k), title, textures[name, mip]))
    for (row, column), title, texture in places:
        axes = figure.add_subplot(grid[row, column])
        axes.imshow(encode_srgb(texture[cut].clip(0, 1)))
        axes.set_title(title, fontsize=8)
        axes.axis("off")
    figure.savefig(path, dpi=72)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=Path("out/blur"))
    parser.add_argument("--engine", choices=("torch", "jax"), default="torch")
    parser.add_argument("--quick", action="store_true")
    args = parser.parse_args(arguments)
    size = QUICK if args.quick else FULL
    truth = earth(size.rows)
    textures, courses, shown = fitted(args.engine, truth, size)
    args.output.mkdir(parents=True, exist_ok=True)
    found: dict[str, Any] = size._asdict() | {"engine": args.engine, "psnr": {}}
    for (name, mip), course in courses.items():
        found["psnr"].setdefault("mipmaps" if mip else "none", {})[name] = round(course[-1], 3)
    (args.output / "blur.json").write_text(json.dumps(found, indent=1) + "\n")
    draw(args.output / "blur.png", truth, textures, courses, shown)


if __name__ == "__main__":
    main()
