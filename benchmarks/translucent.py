"""Translucent layers: errors of derivatives, fits, and how long glass takes beside what is opaque.

Derivatives are low-passed and compared with differences of area-sampled renders; relative L2 error / gain:

    python -m benchmarks.translucent
    python -m benchmarks.translucent --only time
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

import rts
from benchmarks.report import table
from rts_compare.other_renderers.mitsuba_renderer import emitter, flat, mitsuba, positions_of, sensor, set_flat
from rts_diagnostics.example_shapes import icosphere
from rts_diagnostics.smoothing import low_pass

CAMERA = rts.Camera.look_at((0.1, 0.2, 6), (0, 0, 0), (0.21, 1, 0), fov_y=30)
"""Edges of upright cards are aslant in its images."""
SIZE, LAYERS, AREA = (128, 128), 6, 16
"""AREA² samples a pixel make the truth."""
PIXEL = 3.2 / SIZE[0]
UNLIT = rts.plugin("shaders", "unlit")
METHODS = {"`edges`": ("edges", 1), "`edges`, 2 × 2": ("edges", 2), "`multi`": ("multi", 1), "`none`": ("none", 1)}
"""Name → splatter, and samples a pixel along each axis."""
MODES = "position", "colour", "alpha"


# ------------------------------------------------------------------------------------------------------- scenes


def card(z: float, color: Any, alpha: float, left=-1.0, right=1.0, bottom=-1.0, top=1.0) -> rts.Part:
    """A rectangle that faces +z, of one colour, or of one at each corner (4, 3)."""
    vertices = np.float32([(left, bottom, z), (right, bottom, z), (right, top, z), (left, top, z)])
    colors = np.concatenate([np.broadcast_to(np.float32(color), (4, 3)), np.full((4, 1), alpha, np.float32)], axis=1)
    theta = {"vertices": vertices, "colors": colors}
    return rts.Part(rts.Mesh(np.int32([(0, 1, 2), (0, 2, 3)])), theta, UNLIT(opaque=alpha == 1))


def ball(alpha: float, radius: float = 0.8, center: Any = (0, 0, 0), color: Any = (0.2, 0.9, 0.4)) -> rts.Part:
    vertices, faces = icosphere(4)
    colors = np.tile(np.float32([*color, alpha]), (len(vertices), 1))
    theta = {"vertices": (radius * vertices + np.float32(center)).astype(np.float32), "colors": colors}
    return rts.Part(rts.Mesh(faces), theta, UNLIT(opaque=alpha == 1))


def backdrop(z: float) -> rts.Part:
    colors = [(0.1, 0.2, 0.3), (0.9, 0.3, 0.2), (0.8, 0.9, 0.1), (0.2, 0.8, 0.9)]
    return card(z, colors, 1, -2, 2, -2, 2)


def stripes(z: float, count: int = 7) -> rts.Part:
    """Upright stripes of two colours."""
    edges, quads, colors = np.linspace(-2, 2, count + 1), [], []
    for i in range(count):
        quads += [(x, y, z) for x, y in ((edges[i], -2), (edges[i + 1], -2), (edges[i + 1], 2), (edges[i], 2))]
        colors += [(0.9, 0.8, 0.1, 1) if i % 2 else (0.1, 0.2, 0.8, 1)] * 4
    faces = np.concatenate([np.int32([(0, 1, 2), (0, 2, 3)]) + 4 * i for i in range(count)])
    return rts.Part(rts.Mesh(faces), {"vertices": np.float32(quads), "colors": np.float32(colors)}, UNLIT())


def cards() -> list[rts.Part]:
    upper, lower = card(0.5, (1, 0.1, 0.1), 0.5, right=0.13), card(0, (0.1, 1, 0.1), 0.5, left=-0.41)
    return [upper, lower, backdrop(-0.5)]


def through_a_ball() -> list[rts.Part]:
    return [ball(0.5), card(-1.2, (0.9, 0.2, 0.1), 1, -0.3, 0.5, -0.4, 0.3)]


SCENES: dict[str, tuple[Callable[[], list[rts.Part]], int]] = {
    "two panes over a card: the upper": (cards, 0),
    "two panes over a card: the lower": (cards, 1),
    "a glass ball before stripes": (lambda: [ball(0.5), stripes(-1)], 0),
    "stripes behind a glass ball": (lambda: [ball(0.5), stripes(-1)], 1),
    "a card behind a glass ball": (through_a_ball, 1),
    "two glass balls: the farther": (lambda: [ball(0.5), ball(0.6, 0.5, (0.5, 0.3, -1.6), (1, 0.2, 0.1))], 1),
}
"""Scenes, and the part that changes."""


# -------------------------------------------------------------------------------------------------- derivatives


class Change(NamedTuple):
    """A scene of which one part changes with a number.

    Attributes:
        parts: the scene.
        index: the part that changes.
        mode: one of MODES; the position changes by pixels, colours and alpha by their values.
    """

    parts: list[rts.Part]
    index: int
    mode: str

    def at(self, t: Any) -> list[rts.Part]:
        """The scene at a number of torch."""
        part = self.parts[self.index]
        if self.mode == "position":
            part = part.replace(transform=rts.rigid(t * torch.tensor([0, 0, 0, PIXEL, PIXEL / 2, 0])))
        else:
            along = torch.tensor([0.0, 0, 0, 1] if self.mode == "alpha" else [0.3, 0.2, 0.4, 0])
            part = part.replace(theta={**part.theta, "colors": torch.tensor(part.theta["colors"]) + t * along})
        return [part if i == self.index else other for i, other in enumerate(self.parts)]

    def image(self, t: Any, **options: Any) -> torch.Tensor:
        return rts.render(self.at(t), CAMERA, SIZE, layers=LAYERS, **options)

    def truth(self) -> np.ndarray:
        """(H, W, 3), a difference of area-sampled images."""
        step = 0.5 if self.mode == "position" else 0.05
        ends = [self.image(torch.tensor(s), splatter="none", supersample=AREA)[..., :3] for s in (-step, step)]
        return ((ends[1] - ends[0]) / (2 * step)).numpy()

    def derivative(self, splatter: str, supersample: int) -> np.ndarray:
        """(H, W, 3), by forward mode."""
        zero, one = torch.zeros(()), torch.ones(())
        return torch.func.jvp(
            lambda t: self.image(t, splatter=splatter, supersample=supersample)[..., :3], (zero,), (one,)
        )[1].numpy()


def score(derivative: np.ndarray, truth: np.ndarray) -> str:
    found, true = low_pass(derivative), low_pass(truth)
    error = np.linalg.norm(found - true) / np.linalg.norm(true)
    return f"{error:.3f} / {(found * true).sum() / (true**2).sum():.3f}"


def derivative_rows() -> Iterator[list[str]]:
    for name, (parts, index) in SCENES.items():
        translucent = not parts()[index].shader.opaque
        for mode in MODES if translucent else MODES[:2]:
            change = Change(parts(), index, mode)
            true = change.truth()
            yield [name, mode, *(score(change.derivative(*method), true) for method in METHODS.values())]


def edges_rows() -> Iterator[list[str]]:
    """As parts move, the error of the derivative low-passed, that in each pixel, and of the image, root mean square.

    Truth is of ±0.25 pixels: `Change.truth` of ±0.5 is itself blurred.
    """
    for name, (parts, index) in SCENES.items():
        change = Change(parts(), index, "position")
        area = [
            change.image(torch.tensor(s), splatter="none", supersample=AREA)[..., :3].numpy() for s in (-0.25, 0, 0.25)
        ]
        true, cells = (area[2] - area[0]) / 0.5, []
        for splatter in ("multi", "edges"):
            found = change.derivative(splatter, 1)
            image = change.image(torch.zeros(()), splatter=splatter)[..., :3].numpy()
            apart = np.linalg.norm(found - true) / np.linalg.norm(true)
            low = np.linalg.norm(low_pass(found) - low_pass(true)) / np.linalg.norm(low_pass(true))
            cells.append(f"{low:.3f} / {apart:.3f} / {np.sqrt(np.mean((image - area[1]) ** 2)):.4f}")
        yield [name, *cells]


def by_mitsuba(change: Change, samples: int, seed: int) -> np.ndarray:
    """The derivative (H, W, 3) in position by Mitsuba's `prb_projective`; parts emit on their fronts alone.

    A part emits its colours times alpha, and a mask lets the other light pass.
    """
    import drjit as dr

    mi, meshes = mitsuba(), {}
    view = np.asarray(CAMERA.view)
    with tempfile.TemporaryDirectory() as folder:
        for i, part in enumerate(change.parts):
            vertices, colors = part.theta["vertices"] @ view[:3, :3].T + view[:3, 3], part.theta["colors"]
            mesh = emitter(vertices, part.surface.faces, f"{folder}/{i}.ply", colors[:, :3] * colors[:, 3:])
            if colors[0, 3] < 1:
                mesh["bsdf"] = {"type": "mask", "opacity": float(colors[0, 3]), "nested": mesh["bsdf"]}
            meshes[f"part{i}"] = mesh
        scene = mi.load_dict({"type": "scene", "sensor": sensor(SIZE, 30.0, (0.1, 100.0)), **meshes})
    integrator = mi.load_dict({"type": "prb_projective", "max_depth": 8, "rr_depth": 50, "sppi": samples})
    parameters, t = mi.traverse(scene), mi.Float(0.0)
    key = positions_of(parameters, f"part{change.index}")
    rest = mi.Float(flat(parameters[key]))
    velocity = np.broadcast_to(view[:3, :3] @ [PIXEL, PIXEL / 2, 0], (len(rest) // 3, 3))
    dr.enable_grad(t)
    set_flat(parameters, key, rest + t * mi.Float(np.ravel(velocity).astype(np.float32)))
    parameters.update()
    dr.forward(t, dr.ADFlag.ClearEdges)
    image = mi.render(scene, parameters, integrator=integrator, spp=samples, seed=seed)
    return np.array(dr.forward_to(image))


def peer_rows(samples: int = 64) -> Iterator[list[str]]:
    for name, (parts, index) in SCENES.items():
        if parts is cards:
            change = Change(parts(), index, "position")
            yield [name, score(by_mitsuba(change, samples, 0), change.truth())]


# --------------------------------------------------------------------------------------------------------- time


def panes(layers: int, alpha: float) -> list[rts.Part]:
    """Panes of random sizes, one fewer than layers, before a backdrop."""
    rng, parts = np.random.default_rng(0), [backdrop(-1)]
    for i in range(layers - 1):
        color, sides = rng.random(3), (np.sort(rng.uniform(-1.3, 1.3, 2)) + [-0.3, 0.3] for _ in range(2))
        (left, right), (bottom, top) = sides
        parts.append(card(0.8 - 0.2 * i, color, alpha, left, right, bottom, top))
    return parts


def drawing(layers: int, alpha: float, backward: bool) -> Callable[[], object]:
    """The image of panes at 256², and the gradient of a sum of squares in all vertices and colours."""
    parts = panes(layers, alpha)
    leaves = [{name: torch.tensor(x, requires_grad=backward) for name, x in part.theta.items()} for part in parts]
    parts = [part.replace(theta=theta) for part, theta in zip(parts, leaves, strict=True)]
    # What is opaque needs one layer, which is the default.
    options: dict[str, Any] = {"layers": layers} if alpha < 1 else {}

    def call() -> None:
        image = rts.render(parts, CAMERA, (256, 256), **options)
        if backward:
            torch.autograd.grad(image.square().sum(), [x for theta in leaves for x in theta.values()])

    return call


def time_rows(rounds: int = 30) -> Iterator[list[str]]:
    """Medians of processor time, in milliseconds, of calls that take turns; for runs on one thread."""
    for layers in (4, 8):
        calls = {key: drawing(layers, *key) for key in product((1.0, 0.5), (False, True))}
        times: dict[tuple[float, bool], list[float]] = {key: [] for key in calls}
        for key, call in [*calls.items()] * (rounds + 2):
            begun = time.process_time()
            call()
            times[key].append(1e3 * (time.process_time() - begun))
        for backward, what in ((False, "image"), (True, "image and gradient")):
            # The first two calls compile and warm up.
            opaque, translucent = (statistics.median(times[alpha, backward][2:]) for alpha in (1.0, 0.5))
            yield [str(layers), what, f"{opaque:.1f}", f"{translucent:.1f}", f"{translucent / opaque:.2f}"]


# --------------------------------------------------------------------------------------------------------- fits


def curtain(numbers: Any) -> list[rts.Part]:
    """A curtain, moved by two of three numbers; the third is its alpha. Stripes hang behind."""
    part = card(0.5, (0.8, 0.2, 0.3), 0.5, -0.8, 0.5, -0.7, 0.9)
    colors = torch.tensor(part.theta["colors"][:, :3])
    alpha = numbers[2].expand(4, 1)
    shift = torch.cat([torch.zeros(3), numbers[:2], torch.zeros(1)])
    theta = {**part.theta, "colors": torch.cat([colors, alpha], dim=1)}
    return [part.replace(theta=theta, transform=rts.rigid(shift)), stripes(-0.5)]


CURTAIN_GOAL, CURTAIN_START = (0.11, -0.07, 0.45), (-0.05, 0.12, 0.8)

LEAF_COUNT, LEAF_SIZE = 8, 0.45
LEAF_VIEWS = [(4 * np.sin(a), 0.6, 4 * np.cos(a)) for a in np.linspace(-0.8, 0.8, 6)]


def leaf_texture() -> np.ndarray:
    """(32, 32, 4), a leaf: green, its alpha a smooth outline."""
    y, x = np.mgrid[-1:1:32j, -1:1:32j]
    inside = np.clip((0.55 * (1 - y**2) - np.abs(x)) * 12 + 0.5, 0, 1)
    shade = 0.7 + 0.3 * np.cos(9 * y)
    return np.stack([0.2 * shade, 0.8 * shade, 0.1 * shade, 0.85 * inside], axis=-1).astype(np.float32)


def leaves(places: Any) -> list[rts.Part]:
    """Leaves on cards, turned at random, at places (8, 3)."""
    rng, texture, parts = np.random.default_rng(3), leaf_texture(), []
    half = LEAF_SIZE / 2
    corners = np.float32([(-half, -half, 0), (half, -half, 0), (half, half, 0), (-half, half, 0)])
    uv = np.float32([(0, 0), (1, 0), (1, 1), (0, 1)])
    for place in places:
        pose = torch.cat([torch.tensor(rng.uniform(-0.7, 0.7, 3).astype(np.float32)), place])
        theta = {"vertices": corners, "uv": uv, "texture": texture}
        surface = rts.Mesh(np.int32([(0, 1, 2), (0, 2, 3)]))
        parts.append(rts.Part(surface, theta, rts.plugin("shaders", "textured")(opaque=False), rts.rigid(pose)))
    return parts


def fitted(scene: Callable, cameras: list[rts.Camera], goal: Any, start: Any, method: str, steps: int) -> np.ndarray:
    """The numbers found by Adam from area-sampled pictures of the goal."""
    splatter, supersample = METHODS[method]
    size, background = (64, 64), np.float32([1, 1, 1])
    with torch.no_grad():
        area = {"splatter": "none", "supersample": 8, "layers": LAYERS, "background": background}
        targets = [rts.render(scene(goal), camera, size, **area)[..., :3] for camera in cameras]

    def residuals(numbers: Any) -> Any:
        parts = scene(numbers)
        options = {"layers": LAYERS, "supersample": supersample, "background": background}
        images = [rts.render(parts, camera, size, splatter=splatter, **options)[..., :3] for camera in cameras]
        return torch.stack([image - target for image, target in zip(images, targets, strict=True)])

    found = rts.fit(residuals, start, steps=steps, learning_rate=0.01, progress=False, patience=steps)
    return found.parameters.numpy()


class Task(NamedTuple):
    """Numbers of a scene to be found.

    Attributes:
        scene: from the numbers to parts.
        cameras: one for each picture.
        goal: the numbers that the pictures are of.
        start: the numbers at first.
    """

    scene: Callable[[Any], list[rts.Part]]
    cameras: list[rts.Camera]
    goal: torch.Tensor
    start: torch.Tensor

    def found(self, method: str, steps: int) -> torch.Tensor:
        """The numbers that a fit by one of METHODS ends with."""
        return torch.tensor(fitted(self.scene, self.cameras, self.goal, self.start, method, steps))


def tasks() -> dict[str, Task]:
    cameras = [rts.Camera.look_at(eye, (0, 0, 0), (0, 1, 0), fov_y=30) for eye in LEAF_VIEWS]
    rng = np.random.default_rng(5)
    goal = torch.tensor(rng.uniform(-0.5, 0.5, (LEAF_COUNT, 3)).astype(np.float32))
    start = goal + torch.tensor(rng.uniform(-0.1, 0.1, goal.shape).astype(np.float32))
    return {
        "a curtain, one view": Task(curtain, [CAMERA], torch.tensor(CURTAIN_GOAL), torch.tensor(CURTAIN_START)),
        f"{LEAF_COUNT} leaves, 6 views": Task(leaves, cameras, goal, start),
    }


def off(task: Task, numbers: torch.Tensor) -> str:
    """The error of a task's numbers, in pixels of its pictures."""
    error = (numbers - task.goal).numpy()
    if error.ndim == 1:
        return f"place {np.linalg.norm(error[:2]) / 0.05:.2f} pixels, alpha {abs(error[2]):.3f} off"
    places = np.linalg.norm(error, axis=1) / (2.2 / 64)
    return f"places {np.median(places):.2f} pixels off, {places.max():.2f} at worst"


def fit_rows(steps: int) -> Iterator[list[str]]:
    for name, task in tasks().items():
        yield [name, "at first", off(task, task.start)]
        for method in METHODS:
            yield [name, method, off(task, task.found(method, steps))]


# ----------------------------------------------------------------------------------------------------- pictures


def pictures(folder: Path) -> None:
    """`translucent.png`: scenes, their true derivatives in position, and those of two splatters."""
    from matplotlib.figure import Figure

    chosen = list(SCENES)[0], list(SCENES)[2], list(SCENES)[4]
    titles = "image", "derivative, truth", "'edges'", "'multi'", "'none'"
    figure = Figure(figsize=(2.6 * 5, 2.6 * len(chosen) + 0.3), layout="constrained")
    for n, (axes, name) in enumerate(zip(figure.subplots(len(chosen), 5), chosen, strict=True)):
        parts, index = SCENES[name]
        change = Change(parts(), index, "position")
        shown = [change.image(torch.zeros(()), splatter="none", supersample=4)[..., :3].numpy()]
        shown += [0.5 + 3 * x for x in (change.truth(), *(change.derivative(s, 1) for s in ("edges", "multi", "none")))]
        for axis, picture, title in zip(axes, shown, titles, strict=True):
            axis.imshow(picture.clip(0, 1))
            axis.set(xticks=[], yticks=[], title="" if n else title)
        axes[0].set_ylabel(name.partition(":")[0])
    figure.savefig(folder / "translucent.png", dpi=100)


def fit_pictures(folder: Path, steps: int) -> None:
    """`translucent_fits.png`: the goal of each fit, its start, and scenes found with two splatters."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(2.6 * 4, 2.6 * 2 + 0.3), layout="constrained")
    for n, (axes, (name, task)) in enumerate(zip(figure.subplots(2, 4), tasks().items(), strict=True)):
        shown = {"picture": task.goal, "start": task.start}
        shown |= {method.replace("`", "'"): task.found(method, steps) for method in ("`edges`", "`none`")}
        options: dict[str, Any] = {"layers": LAYERS, "supersample": 2, "background": np.float32([1, 1, 1])}
        for axis, (title, numbers) in zip(axes, shown.items(), strict=True):
            picture = rts.render(task.scene(numbers), task.cameras[0], SIZE, **options)[..., :3]
            axis.imshow(picture.numpy().clip(0, 1))
            axis.set(xticks=[], yticks=[], title="" if n else title)
        axes[0].set_ylabel(name)
    figure.savefig(folder / "translucent_fits.png", dpi=100)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=["derivatives", "edges", "peers", "time", "fits", "pictures"])
    parser.add_argument("--steps", type=int, default=300, help="of each fit")
    parser.add_argument("-o", "--output", type=Path, default=Path("out/translucent"))
    args = parser.parse_args()
    args.output.mkdir(parents=True, exist_ok=True)
    warnings.simplefilter("ignore", rts.errors.LayersWarning)  # Of `multi`, which is measured on purpose.
    sections = {
        "derivatives": (["scene", "changes", *METHODS], derivative_rows()),
        "edges": (["what moves", "multi", "edges"], edges_rows()),
        "peers": (["scene", "Mitsuba, prb_projective, 64 spp"], peer_rows()),
        "time": (["K", "", "opaque, ms", "translucent, ms", "ratio"], time_rows()),
        "fits": (["fit", "splatter", "result"], fit_rows(args.steps)),
    }
    chosen = args.only or [name for name in (*sections, "pictures") if name != "peers" or find_spec("mitsuba")]
    for name, (header, rows) in sections.items():
        if name in chosen:
            lines = []
            for line in rows:
                print(*line, sep=" | ", flush=True)
                lines.append(line)
            (args.output / f"{name}.md").write_text(table(header, lines))
    if "pictures" in chosen:
        pictures(args.output)
        fit_pictures(args.output, args.steps)


if __name__ == "__main__":
    main()
