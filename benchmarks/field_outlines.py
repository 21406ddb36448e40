"""Outlines of fields: derivatives of silhouettes against an independent marcher, field by field and way by way.

Truths are central differences of coverages, which rays find by steps along them. Surfaces on a lattice are compared
with the outline of the lattice's own triangles, too, since it differs from the field's. All are low-passed. Relative L2
error / gain:

    python -m benchmarks.field_outlines
    python -m benchmarks.field_outlines --fields "rounded box" --ways rays

`--time` times whole steps of Adam on 128³ values instead, with and without the samples that tell how outlines move.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

import rts
from benchmarks.report import table
from benchmarks.timing import in_turn
from rts import namespace
from rts_diagnostics.smoothing import low_pass
from rts_surfaces.implicit.narrow_band import NarrowBand

SIZE, FOV = 96, 36.0
EYE = np.array([0.9, 1.1, 3.7]) * 4 / np.linalg.norm([0.9, 1.1, 3.7])
CAMERA = rts.Camera.look_at(EYE, (0, 0, 0), fov_y=FOV)
PIXEL = 2 * 4 * np.tan(np.radians(FOV / 2)) / SIZE
"""Length that a pixel shows at the origin."""
BOUNDS, SHAPE = ((-1.35, -1.35, -1.35), (1.35, 1.35, 1.35)), (112, 112, 112)
RADIUS = 1.5
RAYS, REACH = 6, np.linspace(2.4, 5.6, 801)
"""The truth's rays along each side of a pixel, and its places along each ray."""
OWN_RAYS = 12
"""Rays along each side of a pixel through the triangles of a lattice."""


# -------------------------------------------------------------------------------------------------------- fields


def _length(x: Any) -> Any:
    xp = namespace(x)
    return xp.sqrt(xp.sum(x * x, axis=-1) + 1e-12)


def _stack(*columns: Any) -> Any:
    return namespace(columns[0]).stack(list(columns), axis=-1)


def torus(theta: Any, p: Any) -> Any:
    q = theta["q"]
    return _length(_stack(_length(_stack(p[:, 0], p[:, 2])) - q[0], p[:, 1])) - q[1]


def blended(theta: Any, p: Any) -> Any:
    """Two spheres with a wide fillet: the distance between them, and the radius of one."""
    q, xp = theta["q"], namespace(p)
    a = _length(_stack(p[:, 0] - q[0], p[:, 1], p[:, 2])) - q[1]
    b = _length(_stack(p[:, 0] + q[0], p[:, 1] - 0.1, p[:, 2])) - 0.5
    return -xp.log(xp.exp(-8 * a) + xp.exp(-8 * b)) / 8


def rounded_box(theta: Any, p: Any) -> Any:
    """Half extents along x and y; edges are rounded by two pixels."""
    q, xp = theta["q"], namespace(p)
    d = _stack(xp.abs(p[:, 0]) - q[0], xp.abs(p[:, 1]) - q[1], xp.abs(p[:, 2]) - 0.5)
    return _length(xp.clip(d, 0.0, None)) + xp.clip(xp.max(d, axis=-1), None, 0.0) - 0.05


def gyroid(theta: Any, p: Any) -> Any:
    """A shell of a gyroid within a ball: its thickness, and the ball's radius."""
    q, xp = theta["q"], namespace(p)
    x, y, z = (5.0 * p[:, i] for i in range(3))
    g = xp.sin(x) * xp.cos(y) + xp.sin(y) * xp.cos(z) + xp.sin(z) * xp.cos(x)
    return xp.maximum((xp.abs(g) - q[0]) / 8.0, _length(p) - q[1])


def thin_shell(theta: Any, p: Any) -> Any:
    """A shell of a sphere, cut open above: radius, and height of the cut."""
    q, xp = theta["q"], namespace(p)
    return xp.maximum(xp.abs(_length(p) - q[0]) - 0.03, p[:, 1] - q[1])


def root(theta: Any, p: Any) -> Any:
    """The signed root of an ellipsoid's level: steep beside the surface."""
    q, xp = theta["q"], namespace(p)
    level = _length(_stack(p[:, 0] / q[0], p[:, 1] / q[1], p[:, 2] / 0.6)) - 1
    return xp.sign(level) * xp.sqrt(xp.abs(level) + 1e-6)


def capsule(theta: Any, p: Any) -> Any:
    """Half a length along x, and a radius."""
    q, xp = theta["q"], namespace(p)
    over = p[:, 0] - xp.maximum(-q[0], xp.minimum(q[0], p[:, 0]))
    return _length(_stack(over, p[:, 1], p[:, 2])) - q[1]


def metaballs(theta: Any, p: Any) -> Any:
    """Two balls that are about to merge: their distance, and how wide they are."""
    q, xp = theta["q"], namespace(p)
    a, b = (_length(_stack(p[:, 0] - s * q[0], p[:, 1] - 0.1 * s, p[:, 2])) for s in (1.0, -1.0))
    return 0.55 - xp.exp(-((a / q[1]) ** 2)) - xp.exp(-((b / q[1]) ** 2))


def displaced(theta: Any, p: Any) -> Any:
    """A slab whose upper side is displaced by waves: its height, and theirs."""
    q, xp = theta["q"], namespace(p)
    upper = p[:, 1] - q[0] - q[1] * xp.sin(6.0 * p[:, 0]) * xp.cos(5.0 * p[:, 2])
    sides = xp.max(xp.abs(_stack(p[:, 0], p[:, 2])), axis=-1) - 0.9
    return xp.maximum(xp.maximum(0.8 * upper, -0.5 - p[:, 1]), sides)


FIELDS: dict[str, tuple[Callable[[Any, Any], Any], tuple[float, float]]] = {
    "torus": (torus, (0.8, 0.3)),
    "blended spheres": (blended, (0.45, 0.4)),
    "rounded box": (rounded_box, (0.7, 0.45)),
    "gyroid": (gyroid, (0.35, 1.0)),
    "thin shell": (thin_shell, (0.8, 0.35)),
    "root": (root, (0.9, 0.5)),
    "capsule": (capsule, (0.6, 0.35)),
    "metaballs": (metaballs, (0.5, 0.6)),
    "displaced plane": (displaced, (0.2, 0.1)),
}
"""Each field, and its two parameters."""


# --------------------------------------------------------------------------------------------------------- truth


def depths(f: Callable, q: np.ndarray, xy: np.ndarray) -> np.ndarray:
    """The least value of a field along rays through image points (M, 2), in pixels."""
    ahead = -EYE / np.linalg.norm(EYE)
    right = np.cross(ahead, [0, 1, 0])
    right /= np.linalg.norm(right)
    up, focal = np.cross(right, ahead), SIZE / 2 / np.tan(np.radians(FOV / 2))
    along = (xy[:, :1] - SIZE / 2) / focal * right - (xy[:, 1:] - SIZE / 2) / focal * up + ahead
    least = np.full(len(xy), np.inf)
    for t in REACH:
        least = np.minimum(least, f({"q": q}, EYE + t * along))
    return least


def coverage(f: Callable, q: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """(2, H, W) shares of pixels that are covered, of the marked ones, by each half of the rays."""
    offsets = (np.arange(RAYS) + 0.5) / RAYS
    places = np.stack(np.meshgrid(offsets, offsets), axis=-1).reshape(-1, 2)
    halves, image = np.indices((RAYS, RAYS)).sum(axis=0).reshape(-1) % 2, np.zeros((2, SIZE, SIZE))
    y, x = np.nonzero(pixels)
    xy = np.stack([x, y], axis=-1)[:, None] + places
    hit = depths(f, q, xy.reshape(-1, 2)).reshape(len(x), -1) < 0
    for half in range(2):
        image[half][pixels] = hit[:, halves == half].mean(axis=1)
    return image


def difference(q: tuple[float, float], index: int, image: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """The central difference of an image by a parameter, over a pixel or so."""
    step = np.zeros(2)
    step[index] = PIXEL / 2
    return (image(np.array(q) + step) - image(np.array(q) - step)) / PIXEL


def truth(f: Callable, q: tuple[float, float], index: int) -> tuple[np.ndarray, float]:
    """(H, W), the derivative of coverage by a parameter; and an estimate of its relative error, low-passed.

    The error is half of the difference between the results of either half of the rays.
    """
    grid = np.arange(SIZE) + 0.5
    centres = np.stack(np.meshgrid(grid, grid), axis=-1).reshape(-1, 2)
    hit = (depths(f, np.array(q), centres) < 0).reshape(SIZE, SIZE)
    near = np.zeros_like(hit)
    for v in range(-3, 4):
        for u in range(-3, 4):
            near |= np.roll(hit, (v, u), axis=(0, 1)) != hit
    halves = difference(q, index, lambda q: coverage(f, q, near))
    mean, apart = (low_pass(x[..., None]) for x in (halves.mean(axis=0), (halves[1] - halves[0]) / 2))
    return halves.mean(axis=0), float(np.linalg.norm(apart) / np.linalg.norm(mean))


def own_truth(f: Callable, q: tuple[float, float], index: int) -> np.ndarray:
    """(H, W), the like for the triangles that marching cubes make of the field's values on the lattice."""

    def triangles(q: np.ndarray) -> np.ndarray:
        part = rts.Part(isosurface(f=f, shape=SHAPE), {"q": torch.tensor(q)}, "silhouette")
        row = rts.sample(part, CAMERA, (OWN_RAYS * SIZE,) * 2, splatter=None, layers=1).row[0] >= 0
        border = (len(row) - OWN_RAYS * SIZE) // 2
        hit = row.numpy()[border:-border, border:-border] if border else row.numpy()
        return hit.reshape(SIZE, OWN_RAYS, SIZE, OWN_RAYS).mean(axis=(1, 3))

    return difference(q, index, triangles)


# ---------------------------------------------------------------------------------------------------------- ways


class Way(NamedTuple):
    """A way to give a field.

    Attributes:
        surface: f → the surface.
        sampler: its sampler.
        lattice: whether θ has values on a lattice.
        own: whether the surface is that of a lattice's triangles.
    """

    surface: Callable[[Callable], Any]
    sampler: str = "auto"
    lattice: bool = False
    own: bool = False


def isosurface(*args: Any, **options: Any) -> Any:
    return rts.plugin("surfaces", "isosurface")(BOUNDS, *args, **options)


WAYS: dict[str, Way] = {
    "lattice": Way(lambda f: isosurface(), lattice=True, own=True),
    "lattice, edge": Way(lambda f: isosurface(motion="edge"), lattice=True, own=True),
    "function": Way(lambda f: isosurface(f=f, shape=SHAPE), own=True),
    "band": Way(lambda f: isosurface(f=f, shape=SHAPE, band=NarrowBand()), own=True),
    "rays": Way(lambda f: isosurface(f=f, shape=SHAPE), sampler="rays"),
    "sdf": Way(lambda f: rts.plugin("surfaces", "sdf")(f, RADIUS, lipschitz=None)),
}


def derivative(name: str, way: Way, index: int, **options: Any) -> np.ndarray:
    """(H, W), the derivative of coverage by forward mode."""
    f, q = FIELDS[name]
    surface = way.surface(f)
    axes = [np.linspace(low, high, n, dtype=np.float32) for low, high, n in zip(*BOUNDS, SHAPE, strict=True)]
    points = torch.tensor(np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3))

    def image(q: Any) -> Any:
        theta = {"values": f({"q": q}, points).reshape(SHAPE)} if way.lattice else {"q": q}
        part = rts.Part(surface, theta, "silhouette")
        return rts.render(part, CAMERA, (SIZE, SIZE), sampler=way.sampler, **options)[..., 3]

    along = torch.zeros(2)
    along[index] = 1.0
    return torch.func.jvp(image, (torch.tensor(q),), (along,))[1].numpy()


def score(found: np.ndarray, true: np.ndarray) -> str:
    a, b = low_pass(found[..., None]), low_pass(true[..., None])
    return f"{np.linalg.norm(a - b) / np.linalg.norm(b):.3f} / {(a * b).sum() / (b * b).sum():.3f}"


def rows(fields: list[str], ways: list[str], options: dict[str, Any]) -> Iterator[list[str]]:
    """Lines of the table; see `head`."""
    for name in fields:
        for index in range(2):
            (true, error), line = truth(*FIELDS[name], index), [name, str(index)]
            own = own_truth(*FIELDS[name], index)
            line += [f"{error:.3f}", score(own, true)]
            for way in ways:
                found = derivative(name, WAYS[way], index, **options)
                line += [score(found, x) for x in ([true, own] if WAYS[way].own else [true])]
            yield line


def head(ways: list[str]) -> list[str]:
    """The columns: the truth's error, the outline of the lattice's triangles against it, and each way against both."""
    columns = [[way, f"{way}, against its triangles"] if WAYS[way].own else [way] for way in ways]
    return ["field", "parameter", "error of the truth", "triangles", *sum(columns, [])]


# ---------------------------------------------------------------------------------------------------------- time


class WithoutPairs(rts.Isosurface):
    """An isosurface whose outlines move as their samples do."""

    refine_outlines = rts.TriangleSurface.refine_outlines


def times(rounds: int) -> Iterator[list[str]]:
    """Lines: shader, CPU milliseconds of a step of Adam on a torus of 128³ values, 256², with and without pairs."""
    axis = np.linspace(-1, 1, 128, dtype=np.float32)
    x, y, z = np.meshgrid(axis, axis, axis, indexing="ij")
    start = torch.tensor(np.hypot(np.hypot(x, z) - 0.55, y) - 0.25)
    target = torch.rand((256, 256, 4), generator=torch.Generator().manual_seed(0))

    def steps(surface: rts.Isosurface, shader: str) -> Callable[[], None]:
        values = start.clone().requires_grad_(True)
        adam = torch.optim.Adam([values], lr=1e-6)  # The triangles are made anew, and look the same.

        def step() -> None:
            adam.zero_grad()
            image = rts.render(rts.Part(surface, {"values": values}, shader), CAMERA, (256, 256))
            (image - target).square().mean().backward()
            adam.step()

        return step

    bounds = ((-1, -1, -1), (1, 1, 1))
    for shader in ("silhouette", "lambert"):
        ways = {"with": rts.Isosurface(bounds), "without": WithoutPairs(bounds)}
        ms = {n: x["cpu"] for n, x in in_turn({n: steps(s, shader) for n, s in ways.items()}, rounds).items()}
        yield [shader, f"{ms['with']:.1f}", f"{ms['without']:.1f}", f"{ms['with'] / ms['without']:.3f}"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--fields", nargs="+", choices=list(FIELDS), default=list(FIELDS))
    parser.add_argument("--ways", nargs="+", choices=list(WAYS), default=list(WAYS))
    parser.add_argument("--time", type=int, metavar="ROUNDS", help="time steps with and without pairs, in turns")
    parser.add_argument("-o", "--output", type=Path, default=Path("out/field_outlines.md"))
    args = parser.parse_args()
    if args.time:
        print(table(["shader", "CPU ms with pairs", "without", "ratio"], times(args.time)))
        return
    lines = []
    for line in rows(args.fields, args.ways, {}):
        print(*line, sep=" | ", flush=True)
        lines.append(line)
    args.output.parent.mkdir(parents=True, exist_ok=True)
    args.output.write_text(table(head(args.ways), lines))


if __name__ == "__main__":
    main()
