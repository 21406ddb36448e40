"""Smooth surfaces fitted through their control points, beside the same shape as a mesh whose vertices they move.

Newell's teapot of Bézier patches, and cages of subdivision, in the benchmarks' camera. An iteration is render, loss,
gradient in the control points and a step of Adam, with torch; the triangles are made anew in each. *ms*: of the
processor, all threads together. *Outline*: by how many pixels the outline is off, on average along it, of samples 8 × 8
a pixel of the triangles that are used, against those 64 times as fine. *Gradient*: the relative difference (L2) to the
gradient with those, whose samples stay on them. *Memory*: what three iterations need beyond what the process holds.
Contenders take turns in one run:

    python -m benchmarks.smooth_surfaces -o out/smooth
    python -m benchmarks.smooth_surfaces --quick --only teapot       # 256², fewer turns
"""

from __future__ import annotations

import argparse
import copy
import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.sparse import csr_matrix

import rts
from benchmarks.camera import camera, supersampled
from benchmarks.meshes import DATA, normalised, rotation_xy
from benchmarks.report import table
from benchmarks.speed.memory import growth
from benchmarks.timing import in_turn
from rts.plugin_api.records import Proxy
from rts_compare.environment import environment

SHADERS = ("silhouette", "lambert")
TOLERANCES = (0.8, 0.4, 0.2, 0.1, 0.05)
FINER = 64
PART_OF_PIXEL = 8
"""Samples along a pixel, of outlines."""
LEARNING_RATE = 1e-7
"""So small that the shape stays what it is while time is taken."""
BUDGET = 20.0
"""Seconds of timed calls after which a contender has had enough turns."""
MOST_FACETS = 6_000_000
"""Beyond this there is no mesh with a facet a pixel."""
COLUMNS = {"ms": ("cpu", ".1f"), "gradient": ("gradient", ".2g"), "MiB": ("memory", ".0f")}
REFINED, AS_FOUND, MESH, PIXEL = "refined", "as found", "mesh", "mesh, a facet a pixel"


class Scene(NamedTuple):
    """A shape.

    Attributes:
        surface: (tolerance) → the surface.
        entry: the name of the control points in θ.
        points: (V, 3) float32.
        weights: (patches (N,), parameters (N, 2)) → columns and weights (N, W) of control points.
        rates: of the meshes, cuts along each side of a patch.
    """

    surface: Callable[[float], Any]
    entry: str
    points: np.ndarray
    weights: Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]
    rates: tuple[int, ...]


def teapot() -> Scene:
    part = rts.load(DATA / "bezier" / "teapot_patches.txt", surface="bezier")[0]
    table = part.surface.table

    def weights(patch: np.ndarray, params: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        a, b = (np.stack([(1 - t) ** 3, 3 * t * (1 - t) ** 2, 3 * t * t * (1 - t), t**3], axis=-1) for t in params.T)
        return table[patch], (a[:, :, None] * b[:, None, :]).reshape(-1, 16)

    upright = np.asarray(part.theta["points"], np.float64)[:, [0, 2, 1]] * [1, 1, -1]
    surface = partial(rts.plugin("surfaces", "bezier"), table)
    return Scene(lambda t: surface(tolerance=t), "points", placed(upright), weights, (6, 8, 12, 16, 20, 24, 32, 48))


def cage(file: str, rates: tuple[int, ...]) -> Scene:
    part = rts.load(DATA / file, surface="subdivision")[0]
    limit = part.surface.limit

    def weights(patch: np.ndarray, params: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return limit.table[patch], limit.stencils(patch, params)

    def surface(tolerance: float) -> Any:
        made = copy.copy(part.surface)
        made.tolerance = tolerance
        return made

    return Scene(surface, "vertices", placed(np.asarray(part.theta["vertices"], np.float64)), weights, rates)


def placed(points: np.ndarray) -> np.ndarray:
    """A shape as all benchmarks have it: normalised, and turned."""
    return (normalised(points) @ rotation_xy(0.35, 0.5).T).astype(np.float32)


SCENES: dict[str, Callable[[], Scene]] = {
    "teapot": teapot,
    "spot": lambda: cage("meshes/spot/spot_control_mesh.obj", (2, 4, 6, 8, 12, 16)),
    "rook": lambda: cage("cages/catmark_rook.obj", (2, 4, 6, 8, 12, 16)),
}


class Contender(NamedTuple):
    """A way to render the shape.

    Attributes:
        kind: `REFINED`, `AS_FOUND`, `MESH` or `PIXEL`.
        setting: its tolerance, or its rate.
        part: (control points, shader) → the part, differentiable.
        triangles: (size) → how many there are.
        at: (size) → the part in NumPy, with the triangles that an image of this size has, at any size.
    """

    kind: str
    setting: float
    part: Callable[[Any, str], rts.Part]
    triangles: Callable[[tuple[int, int]], int]
    at: Callable[[tuple[int, int]], rts.Part]


def closed_over(surface: Any, size: tuple[int, int]) -> Any:
    """A surface whose triangles are those of images of a size."""
    cls = type(surface)

    class Kept(cls):
        def proxy_key(self, inputs: Any, camera: Any, size: Any) -> int:
            return 0

        def proxy(self, inputs: Any, camera: Any, _: Any) -> Any:
            return super().proxy(inputs, camera, size)

    return changed(surface, Kept)


def changed(surface: Any, cls: type) -> Any:
    """A copy of another class."""
    made = copy.copy(surface)
    made.__class__ = cls
    return made


def patches(kind: str, scene: Scene, tolerance: float) -> Contender:
    surface = scene.surface(tolerance)
    if kind == AS_FOUND:
        # Samples stay where rays meet the triangles, so that they are not at the centres of pixels.
        marks = {"refine": rts.TriangleSurface.refine, "centered": False, "coarse": 1.0}
        surface = changed(surface, type("AsFound", (type(surface),), marks))

    def count(size: tuple[int, int]) -> int:
        return len(surface.proxy(scene.points, camera().for_size(size), size).faces)

    def at(size: tuple[int, int]) -> rts.Part:
        return rts.Part(closed_over(surface, size), {scene.entry: scene.points})

    return Contender(kind, tolerance, lambda p, shader: rts.Part(surface, {scene.entry: p}, shader), count, at)


class Product(torch.autograd.Function):
    """A constant sparse matrix times (m, 3); its transpose is given, lest torch make it in each iteration."""

    @staticmethod
    def forward(ctx: Any, x: Any, matrix: Any, transposed: Any) -> Any:
        ctx.transposed = transposed
        return matrix @ x

    @staticmethod
    def backward(ctx: Any, *g: Any) -> Any:
        return ctx.transposed @ g[0], None, None


def mesh(kind: str, scene: Scene, rate: int) -> Contender:
    """A mesh of so many cuts along each side of each patch; its vertices are a sparse matrix times control points."""
    proxy = meshed(scene, rate)
    corners = proxy.faces.reshape(-1)
    _, first = np.unique(corners, return_index=True)
    assert proxy.ids is not None and proxy.corner_params is not None
    patch, params = np.repeat(proxy.ids[:, 0], 3)[first], proxy.corner_params.reshape(-1, 2)[first]
    columns, weights = scene.weights(patch, params.astype(np.float64))
    # The sum of what entries for one row and column have: at poles one control point is named four times.
    rows = np.repeat(np.arange(len(first)), columns.shape[1])
    entries = weights.astype(np.float32).reshape(-1), (rows, columns.reshape(-1))
    matrix = csr_matrix(entries, (len(first), len(scene.points)))
    both = [
        torch.sparse_csr_tensor(*(torch.from_numpy(x) for x in (m.indptr, m.indices, m.data)), m.shape)
        for m in (matrix, matrix.T.tocsr())
    ]
    made = rts.plugin("surfaces", "mesh")(proxy.faces)

    def part(p: Any, shader: str) -> rts.Part:
        return rts.Part(made, {"vertices": Product.apply(p, *both)}, shader)

    fixed = rts.Part(made, {"vertices": matrix @ scene.points})
    return Contender(kind, rate, part, lambda size: len(proxy.faces), lambda size: fixed)


def meshed(scene: Scene, rate: int) -> Proxy:
    """All patches cut alike."""
    from rts_surfaces.patches.tile_triangles import triangles

    surface = scene.surface(1.0)
    points = surface.geometry(scene.points.astype(np.float64)).points
    return triangles(surface.whole, points, *surface.uniform(rate))


def rate_of_a_pixel(scene: Scene, size: tuple[int, int]) -> int:
    """The rate at which hardly a side of a facet is longer than a pixel."""
    proxy = meshed(scene, 16)
    pixels = np.asarray(camera().for_size(size).project(proxy.vertices.astype(np.float64), size))[:, :2]
    # Two sides of a triangle go along u or v, the longest is a diagonal.
    sides = np.linalg.norm(pixels[proxy.faces] - pixels[np.roll(proxy.faces, -1, axis=1)], axis=2)
    return int(np.ceil(16 * np.quantile(np.sort(sides, axis=1)[:, 1], 0.99)))


# --------------------------------------------------------------------------------------------------- measured


def iteration(found: Contender, scene: Scene, size: tuple[int, int], shader: str, target: Any) -> Callable:
    view, parameters = camera(), torch.tensor(scene.points, requires_grad=True)
    optimizer = torch.optim.Adam([parameters], lr=LEARNING_RATE)

    def step() -> None:
        optimizer.zero_grad()
        loss_of(found.part(parameters, shader), view, size, target).backward()
        optimizer.step()

    return step


def loss_of(part: rts.Part, view: rts.Camera, size: tuple[int, int], target: Any) -> Any:
    difference = rts.render(part, view, size, layers=2) - target
    return (difference * difference).mean()


def gradient(found: Contender, scene: Scene, size: tuple[int, int], shader: str, target: Any) -> np.ndarray:
    parameters = torch.tensor(scene.points, requires_grad=True)
    loss_of(found.part(parameters, shader), camera(), size, target).backward()
    assert parameters.grad is not None
    return parameters.grad.numpy().astype(np.float64)


def covered(part: rts.Part, side: int) -> np.ndarray:
    return rts.sample(part, camera(), (side, side), splatter=None, layers=2).row[0] >= 0


def outline(mask: np.ndarray) -> float:
    """Its length, in cells: the sides of cells along it, of which a line of any direction has 4/π too many."""
    return ((mask[1:] != mask[:-1]).sum() + (mask[:, 1:] != mask[:, :-1]).sum()) * np.pi / 4


def measure(name: str, size: tuple[int, int], rounds: int) -> list[dict[str, Any]]:
    """Rows of the results of a scene."""
    scene = SCENES[name]()
    reference = patches(AS_FOUND, scene, TOLERANCES[-2] / FINER)  # Its outlines are those of triangles, so exact.
    contenders = [patches(kind, scene, t) for kind in (REFINED, AS_FOUND) for t in TOLERANCES]
    contenders += [mesh(MESH, scene, rate) for rate in scene.rates]
    rate = rate_of_a_pixel(scene, size)
    if 2 * rate**2 * int(scene.surface(1.0).whole.patch.max() + 1) <= MOST_FACETS:
        contenders.append(mesh(PIXEL, scene, rate))
    side = size[0] * PART_OF_PIXEL
    truth = covered(reference.at(size), side)
    length = outline(truth) * PART_OF_PIXEL
    rows = []
    for c in contenders:
        off = (covered(c.at(size), side) != truth).sum() / length
        rows.append({"kind": c.kind, "setting": c.setting, "triangles": c.triangles(size), "outline": float(off)})
    for shader in SHADERS:
        aim = rts.Part(scene.surface(0.1), {scene.entry: scene.points * np.float32(1.02) + np.float32(0.01)}, shader)
        target = torch.from_numpy(supersampled(aim, camera(), size, 2).astype(np.float32))
        true = gradient(reference, scene, size, shader, target)
        steps = {str(i): iteration(c, scene, size, shader, target) for i, c in enumerate(contenders)}
        times = in_turn(steps, rounds, budget=BUDGET)
        for i, (row, c) in enumerate(zip(rows, contenders, strict=True)):
            error = np.linalg.norm(gradient(c, scene, size, shader, target) - true) / np.linalg.norm(true)
            row[shader] = times[str(i)] | {"gradient": float(error), "memory": growth(steps[str(i)])}
            print(f"{name:8} {size[0]:4} {shader:10} {c.kind:22} {c.setting:6} {row[shader]}", flush=True)
    return rows


# ----------------------------------------------------------------------------------------------------- shown


def written(rows: list[dict[str, Any]], title: str) -> str:
    """The table of a scene and a size."""
    lines = []
    for row in rows:
        setting = f"{row['setting']:g} px" if row["kind"] in (REFINED, AS_FOUND) else f"{row['setting']:g} a side"
        numbers = [f"{row[s][x]:{form}}" for x, form in COLUMNS.values() for s in SHADERS]
        lines.append([row["kind"], setting, f"{row['triangles']:,}", f"{row['outline']:.4f}", *numbers])
    return table(
        [title, "setting", "triangles", "outline, px", *(f"{s}, {c}" for c in COLUMNS for s in SHADERS)], lines
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=Path("out/smooth"))
    parser.add_argument("--sizes", nargs="+", type=int, default=None, help="default 256 and 512")
    parser.add_argument("--only", nargs="+", choices=list(SCENES), default=list(SCENES))
    parser.add_argument("--rounds", type=int, default=None)
    parser.add_argument("--quick", action="store_true")
    args = parser.parse_args()
    sizes, rounds = args.sizes or ([256] if args.quick else [256, 512]), args.rounds or (2 if args.quick else 5)
    args.output.mkdir(parents=True, exist_ok=True)
    results = {f"{name}, {side}²": measure(name, (side, side), rounds) for name in args.only for side in sizes}
    about = environment(("numpy", "numba", "torch"))
    (args.output / "smooth.json").write_text(json.dumps(about | {"results": results}, indent=2) + "\n")
    text = "\n".join(written(rows, title) for title, rows in results.items())
    (args.output / "smooth.md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
