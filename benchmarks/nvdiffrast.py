"""nvdiffrast's interface on rts beside its own antialiasing, and beside rts used directly.

The experiments are those of nvdiffrast's samples, written anew: a cube with unknown corners and colours in images of
few pixels, and the pose of a cube whose sides have colours of their own. Three methods: `rts_nvdiffrast`; its
rasterization with nvdiffrast's analytic antialiasing (`analytic_antialias`); and `rts.render` with one sample a pixel.
Each method makes its own targets. Fits that results/nvdiffrast.json has are not repeated.

    python -m benchmarks.nvdiffrast
    python -m benchmarks.nvdiffrast --only pose --seeds 20
    python -m benchmarks.nvdiffrast --only cube --sizes 4 --methods rts_nvdiffrast --seeds 2
"""

from __future__ import annotations

import argparse
import json
import statistics
from collections.abc import Callable
from itertools import product
from pathlib import Path

import numpy as np
import torch
import trimesh
from scipy.spatial.transform import Rotation

import rts
from benchmarks import analytic_antialias
from benchmarks.report import table

FILE = Path(__file__).parent / "results/nvdiffrast.json"
PARTS = ("outlines", "gradients", "cube", "pose")
SIZES, STEPS, POSE_STEPS, POSE_SIZE = (4, 8, 16), 1000, 1000, 64
POSES = 6
"""Poses in which gradients are compared."""
GRADIENT_STEP = 2e-4
"""The step of their differences, in radians and units of space; a unit is some 90 pixels."""
CLOSE = 1.0
"""Degrees within which a pose counts as found."""
CORNERS = np.array([(x, y, z) for z in (0, 1) for y in (0, 1) for x in (0, 1)], np.float32) - 0.5
QUADS = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
FACES = torch.tensor([t for a, b, c, d in QUADS for t in ((a, b, c), (a, c, d))], dtype=torch.int32)
SIDES = torch.arange(24, dtype=torch.int32).reshape(6, 4)[:, [0, 1, 2, 0, 2, 3]].reshape(12, 3)
"""(12, 3) rows of a table of colours that has four for each side."""
NEAR, FAR, ACROSS = 1.0, 50.0, 0.4
PROJECTION = torch.tensor(
    [
        [NEAR / ACROSS, 0, 0, 0],
        [0, NEAR / ACROSS, 0, 0],
        [0, 0, -(FAR + NEAR) / (FAR - NEAR), -2 * FAR * NEAR / (FAR - NEAR)],
        [0, 0, -1, 0],
    ]
)
Render = Callable[[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor, int], torch.Tensor]
"""Vertices (V, 3), colours, rows of colours (T, 3), modelview (4, 4), size → image (size, size, 3)."""


def clip(vertices: torch.Tensor, modelview: torch.Tensor) -> torch.Tensor:
    """(1, V, 4) in clip space."""
    return (torch.cat([vertices, torch.ones_like(vertices[:, :1])], dim=1) @ (PROJECTION @ modelview).T)[None]


def by_module(faces: torch.Tensor = FACES) -> Render:
    """`rts_nvdiffrast`."""
    import rts_nvdiffrast.torch as dr

    context = dr.RasterizeCudaContext()

    def render(vertices, colors, rows, modelview, size):
        pos = clip(vertices, modelview)
        rast, _ = dr.rasterize(context, pos, faces, (size, size))
        color, _ = dr.interpolate(colors, rast, rows)
        return dr.antialias(color, rast, pos, faces)[0]

    return render


def by_pairs(faces: torch.Tensor = FACES) -> Render:
    """Rasterization by `rts_nvdiffrast`, with nvdiffrast's antialiasing."""
    import rts_nvdiffrast.torch as dr

    context, beyond = dr.RasterizeCudaContext(), analytic_antialias.opposites(faces)

    def render(vertices, colors, rows, modelview, size):
        pos = clip(vertices, modelview)
        rast, _ = dr.rasterize(context, pos, faces, (size, size))
        color, _ = dr.interpolate(colors, rast, rows)
        return analytic_antialias.antialias(color, rast, pos, faces, beyond)[0]

    return render


def by_rts(samples: int = 1, splatter: str = "auto", faces: torch.Tensor = FACES) -> Render:
    """`rts.render`, by default with found outlines and one sample a pixel."""
    camera = rts.Camera(np.eye(4), PROJECTION.double().numpy())

    def unlit(theta, gbuffer, camera):
        return torch.cat([gbuffer["side"], torch.ones_like(gbuffer["side"][:, :1])], dim=1)

    unlit.opaque = True
    surfaces: dict[int, rts.Mesh] = {}

    def render(vertices, colors, rows, modelview, size):
        surface = surfaces.setdefault(id(rows), rts.Mesh(faces.numpy(), {"side": rows.numpy()}))
        part = rts.Part(surface, {"vertices": vertices, "side": colors}, unlit, transform=modelview)
        return rts.render(part, camera, (size, size), supersample=samples, splatter=splatter)[..., :3]

    return render


METHODS: dict[str, Callable[[], Render]] = {
    "rts_nvdiffrast": by_module,
    "analytic": by_pairs,
    "rts": by_rts,
}


def modelview(rotation: torch.Tensor, shift: tuple[float, float, float] = (0, 0, 0)) -> torch.Tensor:
    """(4, 4) of a rotation (3, 3), then a shift, seen from a distance of 3.5."""
    column = rotation.new_tensor([[shift[0]], [shift[1]], [shift[2] - 3.5]])
    return torch.cat([torch.cat([rotation, column], dim=1), rotation.new_tensor([[0, 0, 0, 1]])])


def cube(render: Render, size: int, seed: int, steps: int) -> float:
    """The mean distance of a cube's corners from the truth, in edges, after a fit; up to reflections of the cube."""
    rng = np.random.default_rng(seed)
    true, colors = torch.tensor(CORNERS), torch.tensor(CORNERS + 0.5)
    found = true + torch.tensor(rng.uniform(-0.5, 0.5, CORNERS.shape).astype(np.float32))
    guess = torch.tensor(rng.random(CORNERS.shape).astype(np.float32))
    optimizer = torch.optim.Adam([found.requires_grad_(), guess.requires_grad_()], lr=1e-2)
    falling = torch.optim.lr_scheduler.LambdaLR(optimizer, lambda step: max(0.01, 10 ** (-step * 0.0005)))
    errors = []
    for _ in range(steps):
        turn = torch.tensor(Rotation.random(random_state=rng).as_matrix(), dtype=torch.float32)
        view = modelview(turn, rng.uniform(-0.25, 0.25, 3))
        with torch.no_grad():
            target = render(true, colors, FACES, view, size)
            errors.append(float((found.abs() - 0.5).norm(dim=1).mean()))
        loss = (render(found, guess, FACES, view, size) - target).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        falling.step()
    return statistics.fmean(errors[-10:])


def rotation(q: torch.Tensor) -> torch.Tensor:
    """(3, 3) of a quaternion (4,), w first, of any length."""
    w, x, y, z = q / q.norm()
    rows = [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y), 2 * (x * y + w * z)]
    rows += [1 - 2 * (x * x + z * z), 2 * (y * z - w * x), 2 * (x * z - w * y), 2 * (y * z + w * x)]
    return torch.stack([*rows, 1 - 2 * (x * x + y * y)]).reshape(3, 3)


def product_of(p: torch.Tensor, q: Rotation) -> torch.Tensor:
    """The quaternion of p after q."""
    x, y, z, w = (float(v) for v in q.as_quat())
    a, b, c, d = p
    return torch.stack(
        [
            a * w - b * x - c * y - d * z,
            a * x + b * w + c * z - d * y,
            a * y + c * w + d * x - b * z,
            a * z + d * w + b * y - c * x,
        ]
    )


def pose(render: Render, seed: int, steps: int, size: int) -> float:
    """Degrees by which the pose of a cube with coloured sides is off after a search at random and then descent."""
    rng = np.random.default_rng(seed)
    symmetries = Rotation.create_group("O")
    side_colors = torch.tensor(
        np.repeat(np.random.default_rng(0).uniform(0.1, 1, (6, 3)), 4, axis=0).astype(np.float32)
    )
    corners = torch.tensor(CORNERS)

    def image(q):
        return render(corners, side_colors, SIDES, modelview(rotation(q)), size)

    def random_quaternion():
        return torch.tensor(np.roll(Rotation.random(random_state=rng).as_quat(), 1), dtype=torch.float32)

    truth, found = random_quaternion(), random_quaternion().requires_grad_()
    with torch.no_grad():
        target = image(truth)
    optimizer = torch.optim.Adam([found], lr=0.01)
    best, least = found.detach().clone(), np.inf
    for step in range(steps):
        searching = step < steps // 2
        noise = Rotation.identity()
        if searching:
            turn = Rotation.random(random_state=rng).as_rotvec() * 1e-4 ** (step / steps)
            noise = Rotation.from_rotvec(turn) * symmetries[rng.integers(24)]
        with torch.set_grad_enabled(not searching):
            tried = product_of(found, noise)
            loss = torch.tanh(5 * (image(tried) - target).square().amax(dim=-1)).mean()
        if 0 < loss.item() < least:
            best, least = tried.detach().clone(), loss.item()
            if searching:
                found.data = best.clone()
        if not searching:
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
        found.data /= found.data.norm()
    a, b = (q.double().numpy() / np.linalg.norm(q.double().numpy()) for q in (best, truth))
    return float(np.degrees(4 * np.arcsin(min(np.linalg.norm(a - b), np.linalg.norm(a + b)) / 2)))


def outlines(size: int = 128, count: int = 20) -> dict[str, float]:
    """How images differ at outlines: by method and beside the truth, of cubes in random poses.

    Shares of pixels are in percent. Differences are means over pixels where two images differ by 0.001 in a channel.
    """
    rng, colors = np.random.default_rng(1), torch.tensor(np.random.default_rng(0).uniform(0.1, 1, (24, 3))).float()
    compared = ("rts_nvdiffrast", "analytic", "none")
    sums, corners = dict.fromkeys(("pixels", "apart", *compared), 0.0), torch.tensor(CORNERS)
    methods = {name: METHODS[name]() for name in compared[:2]} | {"truth": by_rts(16, "none")}
    for _ in range(count):
        view = modelview(torch.tensor(Rotation.random(random_state=rng).as_matrix(), dtype=torch.float32))
        images = {name: render(corners, colors, SIDES, view, size) for name, render in methods.items()}
        images["truth"] = images["truth"].flip(0)
        images["none"] = by_rts(1, "none")(corners, colors, SIDES, view, size).flip(0)
        apart = (images["rts_nvdiffrast"] - images["analytic"]).abs().amax(dim=2)
        off = (images["none"] - images["truth"]).abs().amax(dim=2) > 1e-3
        sums["pixels"] += 100 * (apart > 1e-3).float().mean().item() / count
        sums["apart"] += apart[apart > 1e-3].mean().item() / count
        for name in compared:
            sums[name] += (images[name] - images["truth"]).abs().amax(dim=2)[off].mean().item() / count
    return sums


def gradient(shape: trimesh.Trimesh, colored: bool, seed: int, size: int = 256) -> float:
    """Percent by which the gradient of a loss in a pose is off differences of `rts.render` with 8 × 8 samples a pixel.

    The loss is the squared distance from the image of another pose, of a mask, or of normals as colours. Steps move
    edges by a fiftieth of a pixel: over half a pixel, the derivative of an edge that is almost level changes much.
    """
    import rts_nvdiffrast.torch as dr

    context, rng = dr.RasterizeCudaContext(), np.random.default_rng(seed)
    points, faces = torch.tensor(np.array(shape.vertices)).float(), torch.tensor(np.array(shape.faces)).int()
    normals = torch.tensor(np.array(shape.vertex_normals)).float()
    colors = 0.5 + 0.5 * normals if colored else torch.ones(len(points), 3)
    areas = by_rts(samples=8, faces=faces)

    def image(pose):
        pos = clip(points, rts.rigid(pose).float())
        rast, _ = dr.rasterize(context, pos, faces, (size, size))
        return dr.antialias(dr.interpolate(colors, rast, faces)[0], rast, pos, faces)[0].double()

    def truth_of(pose):
        return areas(points, colors, faces, rts.rigid(pose).float(), size).flip(0).double()

    turn, shift = Rotation.random(random_state=rng).as_rotvec(), rng.uniform(-0.2, 0.2, 3) - [0, 0, 3.5]
    pose = torch.tensor(np.concatenate([turn, shift]), requires_grad=True)
    with torch.no_grad():
        target = truth_of(pose + torch.tensor(rng.normal(0, 0.05, 6)))
        here, steps = truth_of(pose), GRADIENT_STEP * torch.eye(6).double()
        changes = torch.stack([truth_of(pose + e) - truth_of(pose - e) for e in steps]) / (2 * GRADIENT_STEP)
    truth = (2 * (here - target) * changes).flatten(1).sum(dim=1)
    (image(pose) - target).square().sum().backward()
    assert pose.grad is not None
    return 100 * ((pose.grad - truth).norm() / truth.norm()).item()


SHAPES: dict[str, Callable[[], trimesh.Trimesh]] = {
    "sphere of 1,280 faces": lambda: trimesh.creation.icosphere(3),
    "box": lambda: trimesh.creation.box((1.0, 1.2, 0.8)),
    "torus": lambda: trimesh.creation.torus(0.8, 0.3),
    "capsule": lambda: trimesh.creation.capsule(0.8, 0.4),
}


def gradient_table(results: dict) -> str:
    """Medians and largest of the percents, by shape."""
    rows = []
    for name in SHAPES:
        cells = []
        for kind in ("mask", "colours"):
            found = [v for k, v in results["gradient"].items() if k.startswith(f"{name}, {kind} ")]
            cells.append(f"{statistics.median(found):.1f} % ({max(found):.1f} %)")
        rows.append([name, *cells])
    return table(["", "mask", "normals as colours"], rows)


def cube_table(results: dict) -> str:
    """Means over seeds, and the number of them."""
    rows = []
    for size in SIZES:
        cells = []
        for method in METHODS:
            found = [v for k, v in results["cube"].items() if k.startswith(f"{method} {size} ")]
            cells.append(f"{statistics.fmean(found):.4f} ({len(found)})" if found else "–")
        rows.append([f"{size}²", *cells])
    return table(["image", *METHODS], rows)


def pose_table(results: dict) -> str:
    """How many poses were found, and the median of those."""
    rows = []
    for method in METHODS:
        found = [v for k, v in results["pose"].items() if k.startswith(f"{method} ")]
        near = [v for v in found if v < CLOSE]
        if found:
            rows.append([method, f"{len(near)} of {len(found)}", f"{statistics.median(near):.3f}°" if near else "–"])
    return table(["method", f"within {CLOSE:g}°", "median of these"], rows)


def outline_table(results: dict) -> str:
    """Distances from the truth at outlines."""
    found = results["outlines"]
    methods = [name for name in METHODS if name in found]
    names = {"none": "no antialiasing"} | dict(zip(methods, methods, strict=True))
    return table(["method", "mean distance from the truth"], [[t, f"{found[n]:.3f}"] for n, t in names.items()])


def time_table(results: dict) -> str:
    """Milliseconds of each iteration."""
    return table(["iteration", "ms"], [[name, f"{ms:.0f}"] for name, ms in results["time"].items()])


def kept() -> dict:
    """Results so far."""
    return json.loads(FILE.read_text()) if FILE.exists() else {"cube": {}, "pose": {}, "time": {}, "outlines": {}}


def keep(kind: str, name: str, value: float) -> None:
    """Add a result to the file."""
    results = kept()
    results.setdefault(kind, {})[name] = value
    FILE.write_text(json.dumps(results, indent=1, sort_keys=True, ensure_ascii=False) + "\n")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", choices=PARTS, nargs="+", default=PARTS)
    parser.add_argument("--methods", choices=METHODS, nargs="+", default=tuple(METHODS))
    parser.add_argument("--sizes", type=int, nargs="+", default=SIZES)
    parser.add_argument("--seeds", type=int, default=3)
    given = parser.parse_args()
    torch.set_num_threads(1)
    if "outlines" in given.only:
        for name, value in outlines().items():
            keep("outlines", name, value)
    for (name, shape), colored, seed in product(SHAPES.items(), (False, True), range(POSES)):
        if "gradients" in given.only:
            keep("gradient", f"{name}, {'colours' if colored else 'mask'} {seed}", gradient(shape(), colored, seed))
    for seed in range(given.seeds):
        for size, method in product(given.sizes if "cube" in given.only else (), given.methods):
            name = f"{method} {size} {seed}"
            if name not in kept()["cube"]:
                keep("cube", name, cube(METHODS[method](), size, seed, STEPS))
        for method in given.methods if "pose" in given.only else ():
            name = f"{method} {seed}"
            if name not in kept()["pose"]:
                keep("pose", name, pose(METHODS[method](), seed, POSE_STEPS, POSE_SIZE))


if __name__ == "__main__":
    main()
