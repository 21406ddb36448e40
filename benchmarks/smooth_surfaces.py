"""Smooth surfaces fitted through their control points, beside the same shape as a mesh whose vertices they move.

Newell's teapot, in the benchmarks' camera. An iteration is render, loss, gradient in the control points and a step of
Adam, with torch and K = 2; the triangles are made anew in each. *Outline*: by how many pixels the outline is off, on
average along it, of samples 8 × 8 a pixel of the triangles that are used, against those 64 times as fine. *Gradient*:
the relative difference (L2) to the gradient with triangles 64 times as fine. Contenders take turns in one run:

    python -m benchmarks.smooth_surfaces -o out/smooth
    python -m benchmarks.smooth_surfaces --quick            # 256² only, fewer turns
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.sparse import csr_matrix

import rts
from benchmarks.camera import camera, supersampled
from benchmarks.meshes import DATA, normalised, rotation_xy
from benchmarks.report import environment, table
from benchmarks.timing import in_turn

SHADERS = ("silhouette", "lambert")
TOLERANCES = (0.8, 0.4, 0.2, 0.1, 0.05)
RATES = (6, 8, 12, 16, 20, 24, 32, 48)
FINER = 64
PART_OF_PIXEL = 8
"""Samples along a pixel, of outlines."""
LEARNING_RATE = 1e-7
"""So small that the shape stays what it is while time is taken."""
REFINED, AS_FOUND, MESH, PIXEL = "refined", "as found", "mesh", "mesh, a facet a pixel"
STYLES = {
    REFINED: {"color": "#c2410c", "marker": "o"},
    AS_FOUND: {"color": "#7c3aed", "marker": "D"},
    MESH: {"color": "#1d4ed8", "marker": "s"},
    PIXEL: {"color": "#15803d", "marker": "^"},
}

Bezier: Any = rts.plugin("surfaces", "bezier")


class AsFound(Bezier):
    """Patches whose samples stay where rays meet the triangles, so that they are not at the centres of pixels."""

    refines = False
    centered = False
    coarse = 1.0


class Contender(NamedTuple):
    """A way to render the shape.

    Attributes:
        kind: a key of `STYLES`.
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


def teapot() -> tuple[np.ndarray, np.ndarray]:
    """Table (32, 16) and control points (V, 3) float32."""
    part = rts.load(DATA / "bezier" / "teapot_patches.txt", surface="bezier")[0]
    upright = np.asarray(part.theta["points"], np.float64)[:, [0, 2, 1]] * [1, 1, -1]
    return part.surface.table, (normalised(upright) @ rotation_xy(0.35, 0.5).T).astype(np.float32)


def closed_over(size: tuple[int, int], kind: type) -> type:
    """Patches whose triangles are those of images of a size."""

    class Kept(kind):
        def proxy_key(self, inputs: Any, camera: Any, size: Any) -> int:
            return 0

        def proxy(self, inputs: Any, camera: Any, _: Any) -> Any:
            return super().proxy(inputs, camera, size)

    return Kept


def patches(kind: str, table: np.ndarray, points: np.ndarray, tolerance: float) -> Contender:
    cls = Bezier if kind == REFINED else AsFound
    surface = cls(table, tolerance=tolerance)

    def count(size: tuple[int, int]) -> int:
        return len(surface.proxy(points, camera().for_size(size), size).faces)

    def at(size: tuple[int, int]) -> rts.Part:
        return rts.Part(closed_over(size, cls)(table, tolerance=tolerance), {"points": points})

    return Contender(kind, tolerance, lambda p, shader: rts.Part(surface, {"points": p}, shader), count, at)


class Product(torch.autograd.Function):
    """A constant sparse matrix times (m, 3); its transpose is given, lest torch make it in each iteration."""

    @staticmethod
    def forward(ctx: Any, x: Any, matrix: Any, transposed: Any) -> Any:
        ctx.transposed = transposed
        return matrix @ x

    @staticmethod
    def backward(ctx: Any, *g: Any) -> Any:
        return ctx.transposed @ g[0], None, None


def mesh(kind: str, table: np.ndarray, points: np.ndarray, rate: int) -> Contender:
    """A mesh of so many cuts along each side of each patch; its vertices are a sparse matrix times control points."""
    proxy = meshed(table, points, rate)
    corners = proxy.faces.reshape(-1)
    _, first = np.unique(corners, return_index=True)
    patch, params = np.repeat(proxy.ids[:, 0], 3)[first], proxy.corner_params.reshape(-1, 2)[first].astype(np.float64)
    a, b = (np.stack([(1 - t) ** 3, 3 * t * (1 - t) ** 2, 3 * t * t * (1 - t), t**3], axis=-1) for t in params.T)
    weights = (a[:, :, None] * b[:, None, :]).astype(np.float32).reshape(-1)
    # The sum of what entries for one row and column have: at poles one control point is named four times.
    rows = np.repeat(np.arange(len(first)), 16)
    matrix = csr_matrix((weights, (rows, table[patch].reshape(-1))), (len(first), len(points)))
    both = [
        torch.sparse_csr_tensor(*(torch.from_numpy(x) for x in (m.indptr, m.indices, m.data)), m.shape)
        for m in (matrix, matrix.T.tocsr())
    ]
    made = rts.plugin("surfaces", "mesh")(proxy.faces)

    def part(p: Any, shader: str) -> rts.Part:
        return rts.Part(made, {"vertices": Product.apply(p, *both)}, shader)

    fixed = rts.Part(made, {"vertices": matrix @ points})
    return Contender(kind, rate, part, lambda size: len(proxy.faces), lambda size: fixed)


def meshed(table: np.ndarray, points: np.ndarray, rate: int) -> rts.Proxy:
    """All patches cut alike."""
    from rts_surfaces.tiles import triangles

    surface = Bezier(table)
    return triangles(surface.whole, surface.geometry(points.astype(np.float64)).points, *surface.uniform(rate))


def rate_of_a_pixel(table: np.ndarray, points: np.ndarray, size: tuple[int, int]) -> int:
    """The rate at which no side of a facet is longer than a pixel."""
    proxy = meshed(table, points, 64)
    pixels = np.asarray(camera().for_size(size).project(proxy.vertices.astype(np.float64), size))[:, :2]
    # Two sides of a triangle go along u or v, the longest is a diagonal.
    sides = np.linalg.norm(pixels[proxy.faces] - pixels[np.roll(proxy.faces, -1, axis=1)], axis=2)
    return int(np.ceil(64 * np.sort(sides, axis=1)[:, 1].max()))


# --------------------------------------------------------------------------------------------------- measured


def iteration(found: Contender, points: np.ndarray, size: tuple[int, int], shader: str, target: Any) -> Callable:
    view, parameters = camera(), torch.tensor(points, requires_grad=True)
    optimizer = torch.optim.Adam([parameters], lr=LEARNING_RATE)

    def step() -> None:
        optimizer.zero_grad()
        loss_of(found.part(parameters, shader), view, size, target).backward()
        optimizer.step()

    return step


def loss_of(part: rts.Part, view: rts.Camera, size: tuple[int, int], target: Any) -> Any:
    difference = rts.render(part, view, size, layers=2) - target
    return (difference * difference).mean()


def gradient(found: Contender, points: np.ndarray, size: tuple[int, int], shader: str, target: Any) -> np.ndarray:
    parameters = torch.tensor(points, requires_grad=True)
    loss_of(found.part(parameters, shader), camera(), size, target).backward()
    assert parameters.grad is not None
    return parameters.grad.numpy().astype(np.float64)


def covered(part: rts.Part, side: int) -> np.ndarray:
    return rts.sample(part, camera(), (side, side), layers=2).row[0] >= 0


def outline(mask: np.ndarray) -> float:
    """Its length, in cells: the sides of cells along it, of which a line of any direction has 4/π too many."""
    return ((mask[1:] != mask[:-1]).sum() + (mask[:, 1:] != mask[:, :-1]).sum()) * np.pi / 4


def measure(size: tuple[int, int], rounds: int) -> list[dict[str, Any]]:
    """Rows of the results."""
    shape, points = teapot()
    reference = patches(REFINED, shape, points, TOLERANCES[-2] / FINER)
    contenders = [patches(kind, shape, points, t) for kind in (REFINED, AS_FOUND) for t in TOLERANCES]
    contenders += [mesh(MESH, shape, points, rate) for rate in RATES]
    contenders.append(mesh(PIXEL, shape, points, rate_of_a_pixel(shape, points, size)))
    side = size[0] * PART_OF_PIXEL
    truth = covered(reference.at(size), side)
    length = outline(truth) * PART_OF_PIXEL
    rows = []
    for c in contenders:
        off = (covered(c.at(size), side) != truth).sum() / length
        rows.append({"kind": c.kind, "setting": c.setting, "triangles": c.triangles(size), "outline": float(off)})
    for shader in SHADERS:
        aim = rts.Part(Bezier(shape), {"points": points * np.float32(1.02) + np.float32(0.01)}, shader)
        target = torch.from_numpy(supersampled(aim, camera(), size, 2).astype(np.float32))
        true = gradient(reference, points, size, shader, target)
        times = in_turn({str(i): iteration(c, points, size, shader, target) for i, c in enumerate(contenders)}, rounds)
        for i, (row, c) in enumerate(zip(rows, contenders, strict=True)):
            error = np.linalg.norm(gradient(c, points, size, shader, target) - true) / np.linalg.norm(true)
            row[shader] = times[str(i)] | {"gradient": float(error)}
            print(f"{size[0]:4} {shader:10} {c.kind:22} {c.setting:6} {row[shader]}", flush=True)
    return rows


# ----------------------------------------------------------------------------------------------------- shown


def written(rows: list[dict[str, Any]], side: int) -> str:
    """The table of a size."""
    lines = []
    for row in rows:
        setting = f"{row['setting']:g} px" if row["kind"] in (REFINED, AS_FOUND) else f"{row['setting']:g} a side"
        numbers = [f"{row[s]['ms']:.1f}" for s in SHADERS] + [f"{row[s]['gradient']:.2g}" for s in SHADERS]
        lines.append([row["kind"], setting, f"{row['triangles']:,}", f"{row['outline']:.4f}", *numbers])
    header = [f"{side}²", "setting", "triangles", "outline, px", *(f"{s}, ms" for s in SHADERS)]
    return table([*header, *(f"{s}, gradient" for s in SHADERS)], lines)


def chart(results: dict[int, list[dict[str, Any]]], path: Path) -> None:
    """Errors against time; a row of panels a size."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(15, 4.2 * len(results)), layout="constrained")
    panels = figure.subplots(len(results), 4, squeeze=False)
    for line, (side, rows) in zip(panels, results.items(), strict=True):
        for axes, (shader, error) in zip(line, [(s, e) for e in ("outline", "gradient") for s in SHADERS], strict=True):
            for kind, style in STYLES.items():
                chosen = [row for row in rows if row["kind"] == kind]
                errors = [row["outline"] if error == "outline" else row[shader]["gradient"] for row in chosen]
                axes.loglog([row[shader]["ms"] for row in chosen], errors, label=kind, markersize=5, **style)
            what = "outline off, pixels" if error == "outline" else "gradient off, relative"
            axes.set(title=f"{shader}, {side}²", xlabel="milliseconds an iteration", ylabel=what)
            axes.grid(alpha=0.3, which="both")
    figure.legend(*panels[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=len(STYLES))
    figure.suptitle("A teapot of 32 patches, differentiated through its control points", fontsize=11)
    figure.savefig(path, dpi=100)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=Path("out/smooth"))
    parser.add_argument("--sizes", nargs="+", type=int, default=None, help="default 256 and 512")
    parser.add_argument("--rounds", type=int, default=None)
    parser.add_argument("--quick", action="store_true")
    args = parser.parse_args()
    sizes, rounds = args.sizes or ([256] if args.quick else [256, 512]), args.rounds or (2 if args.quick else 7)
    args.output.mkdir(parents=True, exist_ok=True)
    results = {side: measure((side, side), rounds) for side in sizes}
    about = environment(rts.threads.thread_count(), ("numpy", "numba", "torch"))
    (args.output / "smooth.json").write_text(json.dumps(about | {"sizes": results}, indent=2) + "\n")
    text = "\n".join(written(rows, side) for side, rows in results.items())
    (args.output / "smooth.md").write_text(text)
    print(text)
    chart(results, args.output / "smooth.png")


if __name__ == "__main__":
    main()
