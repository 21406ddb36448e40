"""Vertices of subdivision cages from images: a pawn becomes a rook, a rook a pawn, and a bent cow is straightened.

Chess pieces are fitted to three silhouettes of the other piece, area-sampled with 8 × 8 samples a pixel; a fourth view
is kept back and only measured. The cow has its texture, with seams, and is fitted to three coloured images. The
unknowns are all vertices of the cage, by Adam in torch and jax. Written are a figure, animations and the numbers:

    python -m benchmarks.paper.subdivision -o out/subdivision
    python -m benchmarks.paper.subdivision --quick       # 80² instead of 160², one engine
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import rts
from benchmarks.meshes import DATA
from rts.arrays.engines import engine_named

AZIMUTHS, HELD_BACK, ELEVATION = (0.0, 120.0, 240.0), 90.0, 15.0
"""Degrees. A view and the one from behind have almost the same outline: as lines, these three are 60° apart, and the
view that is kept back is 30° from the nearest two, as far as it can be."""
PIECE_STAGES = ((50.0, 0.02, 60), (10.0, 0.01, 60), (2.0, 0.004, 70), (0.5, 0.002, 60))
COW_STAGES = ((10.0, 0.02, 60), (2.0, 0.005, 60), (0.5, 0.002, 40))
"""Smoothness, rate of Adam and number of steps, coarse to fine; each stage starts where the one before was best."""
UPRIGHT = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])
BEND = 0.4
TEXTURE = 256
WRONG, MISSING, RIGHT = (0.85, 0.15, 0.1), (0.1, 0.6, 0.2), (0.01, 0.01, 0.012)


class Cage(NamedTuple):
    """A cage: its surface, vertices (V, 3) in float64, and what else is in θ."""

    surface: Any
    vertices: np.ndarray
    others: dict[str, np.ndarray]

    def part(self, vertices: Any, shader: str = "lambert") -> rts.Part:
        if isinstance(vertices, np.ndarray):
            vertices = vertices.astype(np.float32)
        return rts.Part(self.surface, {**self.others, "vertices": vertices}, shader)


class Task(NamedTuple):
    """A fit: the surface, its start and its target.

    Attributes:
        name: of the task.
        cage: where it starts.
        truth: what the targets are images of.
        shader: of the images.
        stages: see PIECE_STAGES.
    """

    name: str
    cage: Cage
    truth: Cage
    shader: str
    stages: tuple[tuple[float, float, int], ...]


class Outcome(NamedTuple):
    """Vertices (V, 3) at each step, the last being the result; losses; seconds; why each stage stopped."""

    trail: list[np.ndarray]
    history: list[float]
    seconds: float
    reasons: list[str]


def camera(azimuth: float) -> rts.Camera:
    a, e = np.radians((azimuth, ELEVATION))
    eye = 4.2 * np.array([np.sin(a) * np.cos(e), np.sin(e), np.cos(a) * np.cos(e)])
    return rts.Camera.look_at(eye, (0, 0, 0), fov_y=32)


def loaded(path: str, turn: np.ndarray, top: float = 1.0) -> Cage:
    """The cage in a file of the test data, about the origin, from −top to top in height."""
    if not (DATA / path).exists():
        raise SystemExit(f"{DATA / path} is missing; set RTS_DATA to the folder of the test data")
    (part,) = rts.load(DATA / path, surface="subdivision")
    vertices = np.asarray(part.theta["vertices"], np.float64) @ turn.T
    vertices -= (vertices.min(0) + vertices.max(0)) / 2
    others = {name: x for name, x in part.theta.items() if name != "vertices"}
    return Cage(part.surface, vertices * (top / vertices[:, 1].max()), others)


def bent(vertices: np.ndarray) -> np.ndarray:
    """Vertices turned about the upright axis by an angle that grows along z, and swollen above."""
    angle = BEND * vertices[:, 2]
    x, y, z = vertices.T
    turned = np.stack([np.cos(angle) * x + np.sin(angle) * z, y, np.cos(angle) * z - np.sin(angle) * x], axis=1)
    return turned * (1 + 0.1 * y)[:, None]


def tasks() -> list[Task]:
    pawn, rook = (loaded(f"cages/catmark_{name}.obj", UPRIGHT) for name in ("pawn", "rook"))
    cow = loaded("meshes/spot/spot_control_mesh.obj", np.eye(3), top=0.8)
    texture = np.asarray(rts.load_image(DATA / "meshes/spot/spot_texture.png"), np.float32)[..., :3]
    # Mean over blocks: a pixel then sees about a texel.
    block = len(texture) // TEXTURE
    texture = texture.reshape(TEXTURE, block, TEXTURE, block, 3).mean((1, 3))
    cow = cow._replace(others={**cow.others, "texture": texture})
    return [
        Task("pawn to rook", pawn, rook, "lambert", PIECE_STAGES),
        Task("rook to pawn", rook, pawn, "lambert", PIECE_STAGES),
        Task("bent cow", cow._replace(vertices=bent(cow.vertices)), cow, "textured", COW_STAGES),
    ]


def smoothing(cage: Cage, smoothness: float) -> np.ndarray:
    """(I + λ L)⁻¹ (V, V), where L is the Laplacian of the cage's edges.

    Vertices are start + this · unknowns, as in Nicolet et al. 2021, "Large Steps in Inverse Rendering of Geometry". A
    silhouette moves few vertices; thus the others follow.
    """
    faces, count = cage.surface.cage, len(cage.vertices)
    joined = np.zeros((count, count))
    joined[faces.indices, faces.indices[faces.next()]] = 1
    joined = np.maximum(joined, joined.T)
    return np.linalg.inv(np.eye(count) + smoothness * (np.diag(joined.sum(1)) - joined))


def image(cage: Cage, vertices: np.ndarray, azimuth: float, side: int, supersample: int, shader: str) -> np.ndarray:
    part = cage.part(vertices, shader)
    return rts.render(part, camera(azimuth), (side, side), splatter="none", supersample=supersample)


def silhouette(cage: Cage, vertices: np.ndarray, azimuth: float, side: int, supersample: int) -> np.ndarray:
    return image(cage, vertices, azimuth, side, supersample, "lambert")[..., 3]


def overlap(mask: np.ndarray, target: np.ndarray) -> float:
    """Intersection over union of two silhouettes, as areas."""
    return float(np.minimum(mask, target).sum() / np.maximum(mask, target).sum())


def target_images(task: Task, side: int) -> list[np.ndarray]:
    """An image for each azimuth: coverage (H, W), or colours and coverage (H, W, 4)."""
    found = [image(task.truth, task.truth.vertices, a, side, 8, task.shader) for a in AZIMUTHS]
    return found if task.shader == "textured" else [x[..., 3] for x in found]


def fitted(engine: str, task: Task, side: int) -> Outcome:
    """Vertices found by Adam, stage after stage."""
    chosen, cage, begun = engine_named(engine), task.cage, time.perf_counter()
    views = [
        rts.ImageResiduals(
            lambda vertices: cage.part(vertices, task.shader),
            camera(azimuth),
            (side, side),
            target.astype(np.float32),
            supersample=2,
        )
        for azimuth, target in zip(AZIMUTHS, target_images(task, side), strict=True)
    ]
    trail, history, reasons = [], [], []
    at = cage.vertices
    for smoothness, rate, steps in task.stages:
        host = smoothing(cage, smoothness)
        start, matrix = (chosen.constant(x.astype(np.float32)) for x in (at, host))

        def residuals(unknowns: Any, start: Any = start, matrix: Any = matrix) -> Any:
            vertices = start + matrix @ unknowns
            return rts.namespace(unknowns).stack([view(vertices) for view in views])

        def moved(unknowns: Any, at: np.ndarray = at, host: np.ndarray = host) -> np.ndarray:
            return at + host @ np.array(chosen.to_numpy(unknowns), np.float64)

        found = rts.fit(
            residuals,
            chosen.constant(np.zeros_like(at, dtype=np.float32)),
            steps=steps,
            learning_rate=rate,
            callback=lambda _step, unknowns, _loss, moved=moved: trail.append(moved(unknowns)) and False,
            progress=False,
            jit=False,
        )
        at = moved(found.parameters)
        history += found.history
        reasons.append(found.reason)
    # The best of the last stage, which need not be its last.
    return Outcome([*trail, at], history, time.perf_counter() - begun, reasons)


def difference(task: Task, vertices: np.ndarray, azimuth: float, side: int) -> float:
    """Root mean square difference of images from the truth's, over the image."""
    off = image(task.cage, vertices, azimuth, side, 8, task.shader) - image(
        task.truth, task.truth.vertices, azimuth, side, 8, task.shader
    )
    return float(np.sqrt((off**2).mean()))


def measured(task: Task, vertices: np.ndarray, side: int) -> dict[str, Any]:
    """Scores of a fit beside the truth: in the views that are fitted, then in the one that is kept back."""
    azimuths = (*AZIMUTHS, HELD_BACK)
    overlaps = [
        overlap(
            silhouette(task.cage, vertices, azimuth, side, 8),
            silhouette(task.truth, task.truth.vertices, azimuth, side, 8),
        )
        for azimuth in azimuths
    ]
    found = {"iou": overlaps[:-1], "iou_held_back": overlaps[-1]}
    if task.shader == "textured":
        errors = [difference(task, vertices, azimuth, side) for azimuth in azimuths]
        off = np.linalg.norm(vertices - task.truth.vertices, axis=1)
        found |= {"image_error": errors[:-1], "image_error_held_back": errors[-1]}
        found |= {"mean_error_of_vertices": off.mean(), "largest_error_of_a_vertex": off.max()}
    return found


def run(folder: Path, side: int, engines: list[str]) -> list[dict[str, Any]]:
    rows, outcomes, known = [], {}, tasks()
    for task in known:
        start = measured(task, task.cage.vertices, side)
        for engine in engines:
            found = outcomes[task.name, engine] = fitted(engine, task, side)
            rows.append(
                {
                    "task": task.name,
                    "engine": engine,
                    "side": side,
                    "vertices": len(task.cage.vertices),
                    "iterations": len(found.history),
                    "seconds": found.seconds,
                    "loss_start": found.history[0],
                    "loss": min(found.history),
                    "start": start,
                    "end": measured(task, found.trail[-1], side),
                    "reasons": found.reasons,
                }
            )
            print(line(rows[-1]), flush=True)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "subdivision.json").write_text(json.dumps(rows, indent=2) + "\n")
    shown = {task.name: outcomes[task.name, engines[0]] for task in known}
    draw(folder / "subdivision.png", known, outcomes, rows, side)
    rts.save_animation(folder / "subdivision.gif", frames(known, shown, 128), fps=10)
    return rows


def line(row: dict[str, Any]) -> str:
    start, end = row["start"], row["end"]
    text = f"{row['task']:13}{row['engine']:6}{row['iterations']:4} iterations {row['seconds']:6.1f} s   IoU "
    text += f"{' '.join(f'{x:.3f}' for x in start['iou'])} -> {' '.join(f'{x:.4f}' for x in end['iou'])}   "
    text += f"kept back {start['iou_held_back']:.3f} -> {end['iou_held_back']:.4f}"
    if "image_error" in end:
        for name, values in (("images", "image_error"), ("vertices", "mean_error_of_vertices")):
            text += f"   {name} off by {np.mean(start[values]):.4f} -> {np.mean(end[values]):.4f}"
    return text


def lit(cage: Cage, vertices: np.ndarray, azimuth: float, side: int, shader: str = "lambert") -> np.ndarray:
    """(H, W, 3) on white."""
    made = image(cage, vertices, azimuth, side, 2, shader)
    return made[..., :3] + 1 - made[..., 3:]


def picture(task: Task, vertices: np.ndarray, azimuth: float, side: int) -> np.ndarray:
    """(H, W, 3): the coloured image; or black where silhouettes agree, red where too wide, green where too narrow."""
    if task.shader == "textured":
        return lit(task.cage, vertices, azimuth, side, task.shader)
    mask = silhouette(task.cage, vertices, azimuth, side, 4)[..., None]
    target = silhouette(task.truth, task.truth.vertices, azimuth, side, 4)[..., None]
    both, wide, narrow = np.minimum(mask, target), np.maximum(mask - target, 0), np.maximum(target - mask, 0)
    return 1 - both - wide - narrow + both * RIGHT + wide * WRONG + narrow * MISSING


def draw(path: Path, known: list[Task], outcomes: dict, rows: list[dict[str, Any]], side: int) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(17.5, 8), layout="constrained")
    grid = figure.subplots(len(known), 8)
    for axes, task in zip(grid, known, strict=True):
        first = next(row for row in rows if row["task"] == task.name)
        vertices, end = outcomes[task.name, first["engine"]].trail[-1], first["end"]
        colored = task.shader == "textured"
        told = [*(end["image_error"] if colored else end["iou"])]
        told.append(end["image_error_held_back" if colored else "iou_held_back"])
        called = "error" if colored else "IoU"
        pictures = [(f"{task.name}: start", lit(task.cage, task.cage.vertices, 0, side))]
        for azimuth, value in zip((*AZIMUTHS, HELD_BACK), told, strict=True):
            title = f"{azimuth:.0f}°{', kept back' if azimuth == HELD_BACK else ''}: {called} {value:.4f}"
            pictures.append((title, picture(task, vertices, azimuth, side)))
        pictures.append(("fitted, kept-back view", lit(task.cage, vertices, HELD_BACK, side)))
        pictures.append(("truth, kept-back view", lit(task.truth, task.truth.vertices, HELD_BACK, side)))
        for one, (title, pixels) in zip(axes, pictures, strict=False):
            one.imshow(np.clip(pixels, 0, 1) ** (1 / 2.2))
            one.set_title(title, fontsize=9)
            one.axis("off")
        for (name, engine), found in outcomes.items():
            if name == task.name:
                axes[-1].semilogy(found.history, label=engine, linestyle="-" if engine == "torch" else "--")
        axes[-1].set(xlabel="step", title="loss")
        axes[-1].legend()
        axes[-1].grid(alpha=0.3)
    figure.savefig(path, dpi=110)


def frames(known: list[Task], shown: dict[str, Outcome], side: int, count: int = 30) -> list[np.ndarray]:
    """A column a task: the first view above, the fitted surface from the view that was kept back below."""
    made = []
    for time_shown in np.linspace(0, 1, count):
        columns = []
        for task in known:
            trail = shown[task.name].trail
            # Most happens early.
            vertices = trail[round(time_shown**2 * (len(trail) - 1))]
            pair = picture(task, vertices, AZIMUTHS[0], side), lit(task.cage, vertices, HELD_BACK, side)
            columns.append(np.concatenate(pair))
        made.append(np.concatenate(columns, axis=1))
    return made + made[-1:] * 10


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=Path("out/subdivision"))
    parser.add_argument("--engines", nargs="+", default=None, help="default torch and jax")
    parser.add_argument("--quick", action="store_true")
    args = parser.parse_args()
    engines = args.engines or (["torch"] if args.quick else ["torch", "jax"])
    run(args.output, 80 if args.quick else 160, engines)


if __name__ == "__main__":
    main()
