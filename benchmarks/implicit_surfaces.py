"""Isosurfaces: how fast, how much of the lattice they need, how stable their gradients are; and a mixed scene.

*Speed*: an iteration is render, loss, gradient in the values of a 128³ lattice (a torus), and a step of gradient
descent, with torch at 256², milliseconds of the processor; the values change in each. *Naive*: marching cubes by
scikit-image, the vertices computed again from the values at the ends of their edges, so that they have derivatives, and
drawn as a mesh.
*Band*: at how many points a function is evaluated, and the time of evaluations and triangles, in NumPy.
*Outlines*: derivatives of silhouettes against closed forms, and against differences of hard images.
*Network*: a small network as an `Sdf` and as an isosurface: how often it is called, at how many points, and the time.
*Stability*: norms of gradients while a surface passes through ties of lattice values. Contenders take turns:

    python -m benchmarks.implicit_surfaces -o out/implicit
    python -m benchmarks.implicit_surfaces --only band --quick
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

import rts
from benchmarks.camera import camera, supersampled
from benchmarks.meshes import DATA, normalised
from benchmarks.report import table
from benchmarks.speed.memory import growth
from benchmarks.timing import in_turn
from rts.files.srgb import encode_srgb
from rts_compare.environment import environment
from rts_surfaces.implicit.fields import smooth_union, swept_sphere
from rts_surfaces.implicit.narrow_band import NarrowBand

BOUNDS = ((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))
RING, TUBE = 0.6, 0.25
LEARNING_RATE = 1e-7
EYE = (0.0, 1.9, 2.6)
MOTIONS = ("normal", "edge")
SINGULAR = ("bound", "drop", "keep")
TILT = 1e-5
"""By how much the ends of edges across a plane of symmetry differ, for a unit of length."""


def isosurface(**options: Any) -> Any:
    return rts.plugin("surfaces", "isosurface")(BOUNDS, **options)


def on_lattice(field: Callable[[np.ndarray], np.ndarray], count: int) -> np.ndarray:
    axis = np.linspace(-1, 1, count)
    return field(np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)).astype(np.float32)


def torus(points: np.ndarray) -> np.ndarray:
    return np.hypot(np.hypot(points[..., 0], points[..., 2]) - RING, points[..., 1]) - TUBE


# --------------------------------------------------------------------------------------------------- speed


def library_triangles(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) in cells, and faces (F, 3), counterclockwise where values are above, by a library."""
    from skimage.measure import marching_cubes

    vertices, faces, _, _ = marching_cubes(values, 0.0, method="lorensen", gradient_direction="descent")
    return vertices, faces.astype(np.int64)


def naive_part(values: torch.Tensor, shader: str) -> rts.Part:
    """A mesh of the triangles of a library, whose vertices are differentiable functions of the values."""
    count = values.shape[0]
    vertices, faces = library_triangles(values.detach().numpy())
    low = np.floor(vertices)
    ends = torch.from_numpy(np.stack([low, np.ceil(vertices)], axis=1).astype(np.int64))
    numbers = (ends[..., 0] * count + ends[..., 1]) * count + ends[..., 2]
    a, b = values.reshape(-1)[numbers].T
    along = torch.where(a == b, 0.0, a / torch.where(a == b, 1.0, a - b))
    places = ends.to(torch.float32) * (2 / (count - 1)) - 1
    moved = places[:, 0] + along[:, None] * (places[:, 1] - places[:, 0])
    return rts.Part(rts.plugin("surfaces", "mesh")(faces), {"vertices": moved}, shader)


def speed(rounds: int, count: int = 128, side: int = 256) -> tuple[str, dict]:
    """Milliseconds of an iteration, and of the triangles alone."""
    start = on_lattice(torus, count)
    view, size = camera(EYE), (side, side)
    surfaces = {f"isosurface, {motion}": isosurface(motion=motion) for motion in MOTIONS}
    parts: dict[str, Callable[[torch.Tensor, str], rts.Part]] = {
        name: lambda values, shader, s=surface: rts.Part(s, {"values": values}, shader)
        for name, surface in surfaces.items()
    }
    parts["naive"] = naive_part
    results: dict[str, Any] = {}
    for shader in ("silhouette", "normals"):
        goal = torch.from_numpy(np.asarray(rts.render(parts["naive"](torch.from_numpy(start), shader), view, size)))

        def iteration(part: Callable, shader: str = shader, goal: torch.Tensor = goal) -> Callable[[], None]:
            values = torch.from_numpy(start.copy()).requires_grad_()
            optimizer = torch.optim.SGD([values], LEARNING_RATE)

            def run() -> None:
                optimizer.zero_grad(set_to_none=True)
                loss = ((rts.render(part(values, shader), view, size) - 0.9 * goal) ** 2).mean()
                loss.backward()
                optimizer.step()
                with torch.no_grad():  # Never twice the same values.
                    values.mul_(1 + 1e-6)

            return run

        runs = {name: iteration(part) for name, part in parts.items()}
        for name, times in in_turn(runs, rounds).items():
            image = np.asarray(rts.render(parts[name](torch.from_numpy(start), shader), view, size))
            off = float(np.quantile(np.abs(image - goal.numpy()).max(axis=-1), 0.999))
            results[f"{shader}, {name}"] = times | {"MiB": growth(runs[name]), "off": off}
    surface = surfaces["isosurface, normal"]
    changing = start.copy()

    def ours() -> None:
        surface.proxy({"values": changing}, None, (1, 1))

    extraction = in_turn({"ours": ours, "scikit-image": lambda: library_triangles(changing)}, rounds)
    part = rts.Part(surface, {"values": start})
    extraction["image, values changed"] = in_turn({"": lambda: _changed(part, changing, view, size)}, rounds)[""]
    extraction["image, values unchanged"] = in_turn({"": lambda: rts.render(part, view, size)}, rounds)[""]
    rows = []
    for name, r in results.items():
        ratio = results[f"{name.split(',')[0]}, naive"]["cpu"] / r["cpu"]
        rows.append([name, f"{r['cpu']:.1f}", f"{r['MiB']:.0f}", f"{r['off']:.1e}", f"{ratio:.1f} times"])
    head = ["iteration", "CPU ms", "MiB beyond the scene", "99.9 % of pixels differ by less", "naive takes"]
    text = table(head, rows) + "\n" + table(["", "CPU ms"], [[n, f"{r['cpu']:.1f}"] for n, r in extraction.items()])
    return text, {"iterations": results, "extraction": extraction}


def _changed(part: rts.Part, values: np.ndarray, view: rts.Camera, size: tuple[int, int]) -> None:
    values *= np.float32(1 + 1e-6)
    rts.render(part.replace(theta={"values": values}), view, size)


# ---------------------------------------------------------------------------------------------------- band


def band(counts: tuple[int, ...]) -> tuple[str, dict]:
    """Evaluations and seconds, of a band and of the whole lattice."""
    theta = {"radii": np.array([RING, TUBE], np.float32)}
    ways = {"Lipschitz bound": NarrowBand(lipschitz=1.0), "coarse signs": NarrowBand(), "whole lattice": None}
    rows, results = [], {}
    for name, narrow in ways.items():
        found = []
        for count in counts:
            if narrow is None and count > 300:
                continue
            surface = isosurface(f=swept_sphere, shape=(count,) * 3, band=narrow)
            surface.extract(theta)
            kept: list[Any] = []
            memory = growth(lambda s=surface, kept=kept: kept.append(s.extract(theta)))
            times = []
            for _ in range(3):
                start = time.perf_counter()
                extracted = surface.extract(theta)
                times.append(time.perf_counter() - start)
            seconds, evaluations = float(np.median(times)), extracted.evaluations
            found.append((count, evaluations))
            results[f"{name}, {count}"] = {"evaluations": evaluations, "seconds": seconds, "MiB": memory}
            share, triangles = f"{evaluations / count**3:.1%}", f"{len(extracted.faces):,}"
            rows.append([name, f"{count}³", f"{evaluations:,}", share, triangles, f"{seconds:.3f}", f"{memory:.0f}"])
        slope = np.polyfit(*np.log(np.array(found, np.float64).T), 1)[0]
        results[f"{name}, slope"] = slope
        rows.append([name, "slope", f"{slope:.2f}", "", "", "", ""])
    return table(["", "lattice", "evaluations", "of all", "triangles", "s", "MiB"], rows), results


# -------------------------------------------------------------------------------------------------- network


def network(sides: tuple[int, ...], counts: tuple[int, ...], rounds: int) -> tuple[str, dict]:
    """A silhouette of a network and its gradient in all weights, with torch: calls, points, milliseconds."""
    torch.manual_seed(0)
    smooth, width = torch.nn.Softplus(beta=20), 64
    layers = [torch.nn.Linear(3, width), smooth, torch.nn.Linear(width, width), smooth, torch.nn.Linear(width, 1)]
    net = torch.nn.Sequential(*layers)
    optimizer = torch.optim.Adam(net.parameters(), 1e-3)
    for _ in range(400):
        points = 0.6 * torch.randn(512, 3)
        loss = ((net(points)[:, 0] - points.norm(dim=1) + 0.7) ** 2).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    weights, asked = dict(net.named_parameters()), []

    def field(theta: Any, points: Any) -> Any:
        asked.append(len(points))
        return torch.func.functional_call(net, theta, (points,))[:, 0]

    surfaces = {"Sdf": rts.Sdf(field, radius=1.2)}
    bounds = ((-1.2,) * 3, (1.2,) * 3)
    for count in counts:
        surfaces[f"Isosurface, {count}³"] = rts.Isosurface(bounds, f=field, shape=(count,) * 3)
        surfaces[f"Isosurface, {count}³, band"] = rts.Isosurface(bounds, f=field, shape=(count,) * 3, band=NarrowBand())
    rows, results = [], {}
    for side in sides:

        def step(surface: Any, side: int = side) -> None:
            image = rts.render(rts.Part(surface, weights, "silhouette"), camera(EYE), (side, side))
            torch.autograd.grad(image[..., 3].sum(), tuple(weights.values()), allow_unused=True)

        times = in_turn({name: lambda s=surface, step=step: step(s) for name, surface in surfaces.items()}, rounds)
        for name, surface in surfaces.items():
            asked.clear()
            step(surface)
            results[f"{side}², {name}"] = times[name] | {"calls": len(asked), "points": sum(asked)}
            rows.append([f"{side}²", name, f"{len(asked):,}", f"{sum(asked):,}", f"{times[name]['cpu']:.0f}"])
    return table(["network", "surface", "calls", "points", "CPU ms"], rows), results


# ------------------------------------------------------------------------------------------------- outlines


def outlines(counts: tuple[int, ...], side: int, samples: int) -> tuple[str, dict]:
    """The derivative of a silhouette's area, beside the truth: of a ball by its radius, of a torus by both."""
    sdf = rts.plugin("surfaces", "sdf")
    surfaces = {"sdf, by rays": lambda f: sdf(f, radius=1.2, reads=("radii",))}
    for count in counts:
        for motion in MOTIONS:
            surfaces[f"{count}³, {motion}"] = lambda f, c=count, m=motion: isosurface(f=f, shape=(c,) * 3, motion=m)
    above = rts.Camera.orthographic((0, 3, 0), (0, 0, 0), (0, 0, 1), height=2.2, near=0.5, far=10)
    per_area = (side / 2.2) ** 2
    closed_forms = {
        "ball": _disk_slope(0.7, side),
        # Seen along its axis its area is 4 π times the product of its radii.
        "ring above": 4 * np.pi * TUBE * per_area,
        "tube above": 4 * np.pi * RING * per_area,
    }
    scenes: dict[str, tuple] = {
        "ball": (_round, camera(), [0.7], 0),
        "ring above": (swept_sphere, above, [RING, TUBE], 0),
        "tube above": (swept_sphere, above, [RING, TUBE], 1),
        "ring aslant": (swept_sphere, camera(EYE), [RING, TUBE], 0),
        "tube aslant": (swept_sphere, camera(EYE), [RING, TUBE], 1),
    }
    results: dict[str, dict[str, float]] = {name: {} for name in surfaces}
    for scene, (f, view, radii, index) in scenes.items():
        true = closed_forms.get(scene) or _area_slope(f, view, radii, index, side, samples)
        for name, surface in surfaces.items():
            for fine in (1, 4):
                given = torch.tensor(radii, dtype=torch.float32, requires_grad=True)
                part = rts.Part(surface(f), {"radii": given})
                area = rts.render(part, view, (side, side), supersample=fine)[..., 3].sum()
                results[name][f"{scene}, {fine}"] = float(torch.autograd.grad(area, given)[0][index]) / true
    rows = [[name, *(f"{100 * (r - 1):+.1f} %" for r in found.values())] for name, found in results.items()]
    header = [f"off the truth, {side}²", *(f"{s}, s = {n}" for s in scenes for n in (1, 4))]
    return table(header, rows), results


def _round(theta: Any, points: Any) -> Any:
    """A ball."""
    xp = rts.namespace(points)
    return xp.sqrt(xp.sum(points * points, axis=-1) + 1e-12) - theta["radii"][0]


def _disk_slope(radius: float, side: int, distance: float = 3.2) -> float:
    """The derivative by its radius of a ball's area in pixels."""
    focal = side / 2 / np.tan(np.deg2rad(20))
    return 2 * np.pi * focal**2 * radius * distance**2 / (distance**2 - radius**2) ** 2


def _area_slope(f: Callable, view: rts.Camera, radii: list, index: int, side: int, samples: int) -> float:
    """The derivative of an area in pixels, by differences of images of samples² hard samples a pixel."""
    areas, step = [], 0.01
    for sign in (1, -1):
        moved = np.array(radii, np.float32)
        moved[index] += sign * step
        part = rts.Part(rts.plugin("surfaces", "sdf")(f, radius=1.2), {"radii": moved})
        areas.append(float(supersampled(part, view, (side, side), samples)[..., 3].sum(dtype=np.float64)))
    return (areas[0] - areas[1]) / (2 * step)


# ----------------------------------------------------------------------------------------------- stability


def gradient_norm(values: np.ndarray, weights: torch.Tensor, motion: str, singular: str) -> float:
    """The norm of the gradient of a weighted sum of an image in the values."""
    given = torch.from_numpy(values).requires_grad_()
    part = rts.Part(isosurface(motion=motion, near_singular=singular), {"values": given}, "normals")
    image = rts.render(part, camera(EYE), tuple(weights.shape[:2]))
    (image * weights).sum().backward()
    return float(given.grad.norm())


def stability(steps: int, output: Path) -> tuple[str, dict]:
    """Norms of gradients, of a ball that passes through ties, and of noise in and beside whole numbers."""
    weights = torch.from_numpy(np.random.default_rng(0).standard_normal((64, 64, 4)).astype(np.float32))

    def noise(seed: int) -> np.ndarray:
        return np.random.default_rng(seed).standard_normal((9, 9, 9)).astype(np.float32)

    ball = on_lattice(lambda p: np.linalg.norm(p, axis=-1) + TILT * p[..., 0], 32)
    # Edges across the plane x = 0 have ends of nearly the same distance; some lie on each of these balls.
    ties = 0.5 * (ball[15] + ball[16])[18:29, 18:27].reshape(-1)
    ties = np.sort(ties[(ties > 0.4) & (ties < 0.8)])
    ties = ties[np.linspace(0, len(ties) - 1, min(steps, len(ties))).astype(int)]
    scenes = {
        "a ball that grows": [ball - np.float32(r) for r in np.linspace(0.4, 0.8, steps)],
        "a ball in ties": [ball - np.float32(r) for r in ties],
        "noise": [noise(i) for i in range(steps)],
        "noise in whole numbers": [np.rint(2 * noise(i)) for i in range(steps)],
        "a hair beside them": [np.rint(2 * noise(i)) + np.float32(1e-5) * noise(steps + i) for i in range(steps)],
    }
    rows, results = [], {}
    for scene, frames in scenes.items():
        counted = [isosurface().extract({"values": values}).near_singular for values in frames]
        for motion in MOTIONS:
            norms = {s: np.array([gradient_norm(v, weights, motion, s) for v in frames]) for s in SINGULAR}
            results[f"{scene}, {motion}"] = {name: n.tolist() for name, n in norms.items()}
            cells = [f"{np.median(n):.3g} / {n.max():.3g}" for n in norms.values()]
            rows.append([scene, motion, f"{np.mean(counted):.2g}", *cells])
    _stability_chart(results, output / "stability.png")
    header = ["median / largest norm of the gradient", "motion", "near-singular edges", *SINGULAR]
    return table(header, rows), results


def _stability_chart(results: dict, path: Path) -> None:
    import matplotlib

    matplotlib.use("agg")
    from matplotlib import pyplot

    scenes = list(dict.fromkeys(name.rsplit(", ", 1)[0] for name in results))
    figure, axes = pyplot.subplots(
        2, len(scenes), figsize=(3.6 * len(scenes), 6), sharex="col", sharey="col", squeeze=False
    )
    styles = {"keep": ("#c2410c", 2.4), "bound": ("#1d4ed8", 1.4), "drop": ("#15803d", 1.0)}
    for column, scene in enumerate(scenes):
        for row, motion in enumerate(MOTIONS):
            own = axes[row, column]
            for name, (color, width) in styles.items():
                own.semilogy(results[f"{scene}, {motion}"][name], color=color, lw=width, label=name)
            own.set_title(f"{scene}\nmotion along {'edges' if motion == 'edge' else 'the normal'}", fontsize=9)
            own.grid(alpha=0.3)
        axes[1, column].set_xlabel("image")
    axes[0, 0].set_ylabel("norm of the gradient")
    axes[1, 0].set_ylabel("norm of the gradient")
    axes[0, 0].legend()
    figure.tight_layout()
    figure.savefig(path, dpi=110)


# -------------------------------------------------------------------------------------------- a mixed scene


def mixed(output: Path, side: int) -> tuple[str, dict]:
    """A mesh, Bézier patches, a cage, an isosurface and a field that rays are cast at, in one image."""
    from matplotlib.figure import Figure

    view = rts.Camera.look_at((0.0, 1.6, 6.6), (0, 0.0, 0), fov_y=22)
    parts = mixed_parts()
    torch_parts = [
        p.replace(theta={k: torch.from_numpy(np.asarray(v)).requires_grad_() for k, v in p.theta.items()})
        for p in parts
    ]
    size = side, side * 5 // 2
    image = rts.render(torch_parts, view, size, layers=2, background=(1.0, 1.0, 1.0))
    image[..., :3].square().mean().backward()
    fine = rts.render(parts, view, size, layers=2, supersample=3, background=(1.0, 1.0, 1.0))
    picture = encode_srgb(fine[side // 5 : -side // 6, :, :3].clip(0, 1))
    figure = Figure(figsize=(10, 10 * picture.shape[0] / picture.shape[1]))
    axes = figure.add_axes((0, 0, 1, 1))
    axes.imshow(picture, interpolation="antialiased")
    axes.set_axis_off()
    names = ("mesh", "bezier", "subdivision", "isosurface", "sdf")
    labels = ("triangle mesh", "Bézier patches", "subdivision", "isosurface on a lattice", "field met by rays")
    for part, label in zip(parts, labels, strict=True):
        x = float(view.project(np.asarray(part.transform)[:3, 3][None], size)[0, 0])
        axes.text(x, picture.shape[0] - 6, label, ha="center", va="bottom", fontsize=10, color="#1f2937")
    figure.savefig(output / "mixed.png", dpi=120)
    results = {
        name: {k: float(v.grad.norm()) for k, v in part.theta.items() if v.grad is not None}
        for name, part in zip(names, torch_parts, strict=True)
    }
    rows = [[n, ", ".join(f"{k}: {v:.3g}" for k, v in found.items())] for n, found in results.items()]
    return table(["part", "norms of gradients"], rows), results


def mixed_parts() -> list[rts.Part]:
    bunny = rts.load(DATA / "meshes" / "bunny.obj")[0]
    teapot = rts.load(DATA / "bezier" / "teapot_patches.txt", surface="bezier")[0]
    rook = rts.load(DATA / "cages" / "catmark_rook.obj", surface="subdivision")[0]
    blob = smooth_union(12.0, _ball(0.0, 0.55, 0.0, 0.4), swept_sphere)
    values = on_lattice(lambda p: blob({"radii": np.array([0.6, 0.22])}, p.reshape(-1, 3)).reshape(p.shape[:-1]), 65)
    sdf = rts.plugin("surfaces", "sdf")(swept_sphere, radius=1.0)
    made = [
        bunny.replace(theta={"vertices": normalised(bunny.theta["vertices"]).astype(np.float32)}, shader="lambert"),
        teapot.replace(theta={"points": _upright(teapot.theta["points"])}, shader="lambert"),
        rook.replace(theta={"vertices": _upright(rook.theta["vertices"])}, shader="lambert"),
        rts.Part(isosurface(), {"values": values}, "normals"),
        rts.Part(sdf, {"radii": np.array([0.6, 0.25], np.float32)}, "normals"),
    ]
    placed = []
    for i, part in enumerate(made):
        transform = np.eye(4, dtype=np.float32)
        transform[:3, :3] *= 0.75
        transform[:3, 3] = (-2.3 + 1.15 * i, 0.12 * (-1) ** i, 0.35 * (-1) ** i)
        placed.append(part.replace(transform=transform))
    return placed


def _upright(points: np.ndarray) -> np.ndarray:
    """Points of a shape that stands along z, normalised and turned to stand along y."""
    return normalised(np.asarray(points, np.float64)[:, [0, 2, 1]] * [1, 1, -1]).astype(np.float32)


def _ball(x: float, y: float, z: float, radius: float) -> Callable[[Any, Any], Any]:
    def field(theta: Any, points: Any) -> Any:
        xp = rts.namespace(points)
        square = (points[:, 0] - x) ** 2 + (points[:, 1] - y) ** 2 + (points[:, 2] - z) ** 2
        return xp.sqrt(square + 1e-12) - radius

    return field


def main() -> None:
    sections = ("speed", "band", "network", "outlines", "stability", "mixed")
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=Path("out/implicit"))
    parser.add_argument("--only", nargs="+", choices=sections, default=sections)
    parser.add_argument("--quick", action="store_true")
    args = parser.parse_args()
    args.output.mkdir(parents=True, exist_ok=True)
    runs: dict[str, Callable[[], tuple[str, dict]]] = {
        "speed": lambda: speed(2 if args.quick else 7),
        "band": lambda: band((65, 129) if args.quick else (65, 129, 257, 513)),
        "network": lambda: network((64, 256), (48,) if args.quick else (48, 128), 2 if args.quick else 7),
        "outlines": lambda: outlines((33,) if args.quick else (33, 65, 128), 256, 2 if args.quick else 6),
        "stability": lambda: stability(12 if args.quick else 120, args.output),
        "mixed": lambda: mixed(args.output, 128 if args.quick else 400),
    }
    results, texts = {}, []
    for name in args.only:
        text, results[name] = runs[name]()
        print(text, flush=True)
        texts.append(text)
    about = environment(("numpy", "numba", "torch", "scikit-image"))
    (args.output / "implicit.json").write_text(json.dumps(about | results, indent=2) + "\n")
    (args.output / "implicit.md").write_text("\n".join(texts))


if __name__ == "__main__":
    main()
