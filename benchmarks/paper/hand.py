"""A hand fitted to three photographs (section 4.2, "Hand mesh optimization"): who stands which learning rate.

Vertices, their colours and a pose a view are fitted by Adam, with an as-rigid-as-possible energy; a solid rectangle is
behind the hand. Cameras do not exist: poses begin at the values of `setup.json`, and each seed moves them. Every
splatter runs at eight learning rates; what it ends with is judged by the same hard, area-sampled images. DEODR's own
fitter is the outside judge: its energy, light and descent, one colour for all vertices. Written are a figure and the
numbers, which are printed as a table, too:

    python -m benchmarks.paper.hand -o out/hand
    python -m benchmarks.paper.hand --quick                      # one seed, four rates, few steps
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

import rts
from benchmarks.camera import regular_grid
from benchmarks.meshes import DATA
from benchmarks.report import table
from rts.files.srgb import encode_srgb
from rts_compare.failures import table_columns as failures
from rts_compare.kept_measurements import KeptMeasurements
from rts_diagnostics.example_shapes import QUAD

PHOTOGRAPHS = ("IMG-1842.jpg", "IMG-1843.jpg", "IMG-1844.jpg")
METHODS = {m.name: dict(m.options) for m in failures.METHODS if m.name in ("single", "multi, K = 2", "edges")}
"""Options of `rts.render`. The hand is culled, so that its second layer is what lies behind it."""
FACTORS = (0.1, 0.3, 1.0, 3.0, 10.0, 15.0, 20.0, 30.0)
QUICK_FACTORS = (0.3, 3.0, 10.0, 20.0)
RATE = 0.05
"""The learning rate that factors are of; units of the parameters are below."""
UNITS = {"offsets": 0.2, "poses": 0.3, "colors": 0.3}
"""How far one unit of a parameter moves a vertex (world), a pose (radians and world) and a colour."""
RIGIDITY = 20.0
"""Weight of the energy's mean over its terms beside the mean squared difference of images."""
STEPS, QUICK_STEPS, SEEDS = 100, 20, 3
GREY = 0.5
DIVERGED, STALLED = 1.0, 0.6
"""A final error that is so many times that at the start counts as diverged or as stalled."""
DEODR_STEPS = 300


@cache
def setup() -> dict[str, Any]:
    path = DATA / "hand" / "setup.json"
    if not path.exists():
        raise SystemExit(f"{path} is missing; set RTS_DATA to the folder of the test data")
    return json.loads(path.read_text())


@cache
def photographs() -> np.ndarray:
    """(3, H, W, 3) float32, the files' own sRGB values, every 2 × 2 pixels averaged."""
    found = [encode_srgb(rts.load_image(DATA / "hand" / name)[..., :3]) for name in PHOTOGRAPHS]
    images = np.stack(found)[:, :282]
    return images.reshape(3, 141, 2, 100, 2, 3).mean(axis=(2, 4)).astype(np.float32)


@cache
def hand() -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) about their mean, and faces (T, 3)."""
    (part,) = rts.load(DATA / "hand" / "hand.obj")
    vertices = np.asarray(part.theta["vertices"], np.float64)
    return (vertices - vertices.mean(axis=0)).astype(np.float32), part.surface.faces


@cache
def camera() -> rts.Camera:
    given = setup()["camera"]
    rows, distance = photographs().shape[1], given["camera_center_multiview"][2]
    fov = 2 * np.degrees(np.arctan(rows / given["focal_px"]))  # Of half-size images, whose focal length is half.
    return rts.Camera.look_at((0, 0, distance), (0, 0, 0), fov_y=float(fov), near=0.5, far=20.0)


def turns() -> list[float]:
    """The turns of the views; `setup.json` leaves their order open, and fits come nearer in this one."""
    return setup()["initial_pose_per_view"]["euler_y_rad"][::-1]


def start(seed: int) -> dict[str, Any]:
    """Torch parameters; the poses of a seed are some degrees and hundredths off."""
    import torch

    rng = np.random.default_rng(seed)
    given = setup()["initial_pose_per_view"]
    poses = np.zeros((3, 6))
    poses[:, 1], poses[:, 3:] = turns(), given["translation"]
    poses += rng.normal(size=poses.shape) * np.repeat([0.04, 0.02], 3)
    count = len(hand()[0])
    arrays = {"offsets": np.zeros((count, 3)), "poses": poses, "colors": np.full((count, 3), GREY)}
    return {k: torch.tensor(v / UNITS[k], dtype=torch.float32) for k, v in arrays.items()}


def moved(offsets: Any) -> Any:
    """Vertices (V, 3) with offsets, an array of torch or NumPy."""
    vertices = hand()[0]
    return (vertices if isinstance(offsets, np.ndarray) else offsets.new_tensor(vertices)) + UNITS["offsets"] * offsets


def scene(parameters: dict[str, Any], view: int) -> tuple[rts.Part, rts.Part]:
    """The hand as a view sees it, and the rectangle behind it."""
    faces = hand()[1]
    theta = {
        "vertices": moved(parameters["offsets"]),
        "colors": UNITS["colors"] * parameters["colors"],
    }
    mesh = rts.plugin("rts.surfaces", "mesh")
    transform = rts.rigid(UNITS["poses"] * parameters["poses"][view])
    back = np.array([[-3, -3, -1.5], [3, -3, -1.5], [3, 3, -1.5], [-3, 3, -1.5]], np.float32)
    rectangle = {"vertices": back, "colors": np.broadcast_to(background(), (4, 3)).astype(np.float32)}
    return (
        rts.Part(mesh(faces), theta, "unlit", transform, cull="back"),
        rts.Part(mesh(QUAD), rectangle, "unlit"),
    )


def background() -> np.ndarray:
    """The colour (3,) of the photographs' corners."""
    images = photographs()
    return np.median(np.concatenate([images[:, :5, :5].reshape(-1, 3), images[:, :5, -5:].reshape(-1, 3)]), axis=0)


def judged(parameters: dict[str, Any]) -> np.ndarray:
    """Hard images (3, H, W, 3) of parameters, 3 × 3 samples a pixel."""
    still = {k: v.detach().numpy().astype(np.float64) for k, v in parameters.items()}
    size, found = photographs().shape[1:3], []
    for view in range(3):
        parts, total = scene(still, view), 0.0
        for dx, dy in regular_grid(3):
            shift = np.eye(4)
            shift[0, 3], shift[1, 3] = -2 * dx / size[1], 2 * dy / size[0]
            closed = camera().for_size(size)
            view_ = closed.replace(projection=shift @ np.asarray(closed.projection))
            total = total + rts.render(parts, view_, size, splatter="none", layers=1)[..., :3] / 9
        found.append(total)
    return np.stack(found)


def error(images: np.ndarray) -> float:
    """RMS difference to the photographs, sRGB."""
    return float(np.sqrt(np.mean((images - photographs()) ** 2)))


def run(method: str, factor: float, seed: int, steps: int) -> dict[str, Any]:
    """One fit: its losses, why it stopped, the error of what it ended with, and these parameters."""
    import torch

    vertices, faces = hand()
    rigidity = rts.regularizers.ARAP(vertices, faces)
    targets = torch.tensor(photographs())
    size, options = targets.shape[1:3], METHODS[method]

    def terms(parameters):
        images = [rts.render(scene(parameters, v), camera(), tuple(size), **options)[..., :3] for v in range(3)]
        stretched = rigidity(moved(parameters["offsets"])) / rigidity.terms
        return torch.stack([(torch.stack(images) - targets).square().mean(), RIGIDITY * stretched])

    last: dict[str, Any] = {}

    def keep(step, parameters, loss):
        last.update(parameters)

    fit = rts.fit(
        terms, start(seed), loss=torch.sum, steps=steps, learning_rate=RATE * factor, patience=steps, callback=keep,
        progress=False,
    )  # fmt: skip
    return {
        "error": error(judged(last)),
        "losses": [float(f"{x:.5g}") for x in fit.history],
        "reason": fit.reason,
        "parameters": {k: np.round(v.detach().numpy().astype(float), 5).tolist() for k, v in last.items()},
    }


# ----------------------------------------------------------------------------------------------------------- DEODR


def deodr(steps: int) -> dict[str, Any]:
    """DEODR's own fitter on the three photographs, from the values of `setup.json`, by its own rates.

    Its multi-view class compares one row of an image with the photograph; here the image is compared.
    """
    from deodr.mesh_fitter import MeshRGBFitterWithPoseMultiFrame

    class Fitter(MeshRGBFitterWithPoseMultiFrame):
        def energy_data(self, vertices):
            self.vertices = vertices
            self.clear_gradients()
            images, differences, total = [], [], 0.0
            for frame, photograph in enumerate(self.mesh_images):
                image = self.render(idframe=frame)
                difference = image - photograph
                weight = self.cdata / len(self.mesh_images)
                total += weight * float((difference**2).sum())
                self.render_backward(2 * weight * difference)
                images.append(image)
                differences.append((difference**2).sum(axis=2))
            return total, images, differences

    given = setup()
    vertices, faces = hand()
    targets = photographs().astype(np.float64)
    shading = given["shading"]
    # The energy of images is a sum over pixels, of which there are a quarter, and so is rigidity.
    fitter = Fitter(
        vertices.astype(np.float64), faces, default_color=np.array(shading["uniform_colour"]),
        default_light_directional=np.array(shading["light_directional"]),
        default_light_ambient=shading["light_ambient"], cregu=given["laplacian_rigidity"] / 4,
        euler_init=np.array([[0, y, 0] for y in turns()]),
        translation_init=np.tile(given["initial_pose_per_view"]["translation"], (3, 1)),
    )  # fmt: skip
    for name in ("vertices", "quaternion", "translation"):
        setattr(fitter, f"step_factor_{name}", 4 * getattr(fitter, f"step_factor_{name}"))
    fitter.set_images(list(targets))
    fitter.set_background_color(background().astype(np.float64))
    errors, images = [], np.zeros_like(targets)
    for _ in range(steps):
        with contextlib.redirect_stdout(io.StringIO()):
            images = np.stack(fitter.step()[1])
        errors.append(error(images))
    return {"error": errors[-1], "errors": [float(f"{x:.5g}") for x in errors], "images": np.round(images, 3).tolist()}


# --------------------------------------------------------------------------------------------------------- reports


def verdict(found: float, begun: float) -> str:
    """The verdict on an error beside that at the start of its seed."""
    if not np.isfinite(found) or found > DIVERGED * begun:
        return "diverged"
    return "stalled" if found > STALLED * begun else "ok"


def as_arrays(parameters: dict[str, Any]) -> dict[str, Any]:
    import torch

    return {k: torch.tensor(v, dtype=torch.float32) for k, v in parameters.items()}


def measured(kept: KeptMeasurements, factors: tuple[float, ...], seeds: int, steps: int) -> dict[str, Any]:
    """All fits, and DEODR's; what is kept is not run again."""
    fits: dict[str, dict[str, list[dict]]] = {}
    for method in METHODS:
        for factor in factors:
            runs = []
            for seed in range(seeds):
                key = ("hand", method, factor, seed, steps)
                runs.append(kept.get(*key) or kept.put(run(method, factor, seed, steps), *key))
            fits.setdefault(method, {})[f"{factor:g}"] = runs
            print(f"{method} ×{factor:g}: " + ", ".join(f"{r['error']:.4f}" for r in runs), flush=True)
    key = ("hand", "DEODR", steps)
    try:
        judge = kept.get(*key) or kept.put(deodr(max(steps, DEODR_STEPS) if steps == STEPS else steps), *key)
    except ImportError as missing:
        judge = {"error": float("nan"), "why": str(missing)}
    return {"fits": fits, "deodr": judge, "start": [error(judged(start(s))) for s in range(seeds)], "steps": steps}


def summary(found: dict[str, Any]) -> str:
    fits = found["fits"]
    factors = list(next(iter(fits.values())))
    seeds = range(len(found["start"]))
    lines = []
    for method, runs in fits.items():
        cells = []
        for factor in factors:
            words = [verdict(runs[factor][s]["error"], found["start"][s]) for s in seeds]
            bad = [f"{words.count(w)} {w}" for w in ("stalled", "diverged") if w in words]
            note = f" ({', '.join(bad)})" if bad else ""
            cells.append(f"{np.median([runs[factor][s]['error'] for s in seeds]):.4f}{note}")
        lines.append([method, *cells])
    text = table(["median error, sRGB", *(f"×{f}" for f in factors)], lines)
    begun, judge = np.median(found["start"]), found["deodr"]["error"]
    return f"{text}\nAt the start {begun:.4f}; DEODR's fitter {judge:.4f}.\n"


def errors(found: dict[str, Any]) -> dict[str, Any]:
    """The errors alone of what `measured` gives, in its form, as benchmarks/results/hand.json keeps them."""
    fits = {
        method: {
            factor: [{"error": float(f"{run['error']:.4g}")} for run in runs] for factor, runs in by_factor.items()
        }
        for method, by_factor in found["fits"].items()
    }
    deodr = {"error": float(f"{found['deodr']['error']:.4g}")}
    return {"fits": fits, "deodr": deodr, "start": [float(f"{e:.4g}") for e in found["start"]]}


def draw(found: dict[str, Any], path: Path) -> None:
    """Errors against learning rates, the course of losses, and pictures of the fits."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    from rts_compare.chart_style import PEER_COLORS, SPLATTER_COLORS

    fits, seeds = found["fits"], range(len(found["start"]))
    colors = {m: SPLATTER_COLORS[m.split(",")[0]] for m in fits}
    factors = list(next(iter(fits.values())))
    least = {m: min(factors, key=lambda f, m=m: np.median([r["error"] for r in fits[m][f]])) for m in fits}
    high, higher = factors[-3], factors[-2]
    figure = plt.figure(figsize=(13, 9))
    grid = figure.add_gridspec(3, 6, height_ratios=[1.25, 1, 1])
    axes = figure.add_subplot(grid[0, :3])
    for method, runs in fits.items():
        x = [float(f) for f in runs]
        every = np.array([[runs[f][s]["error"] for f in runs] for s in seeds])
        axes.plot(x, np.median(every, axis=0), color=colors[method], label=method, lw=2)
        for of_seed in every:
            axes.plot(x, of_seed, ".", color=colors[method], alpha=0.6)
    axes.axhline(found["deodr"]["error"], color=PEER_COLORS["DEODR"], ls="--", label="DEODR's fitter")
    axes.axhline(np.median(found["start"]), color="0.6", ls=":", label="start")
    axes.set(xscale="log", yscale="log", xlabel="learning rate × base", ylabel="RMS error of hard images, sRGB")
    axes.legend(fontsize=8)
    axes = figure.add_subplot(grid[0, 3:])
    for method, runs in fits.items():
        for s in seeds:
            axes.plot(runs[high][s]["losses"], color=colors[method], alpha=0.8, label=method if s == 0 else None)
    axes.set(yscale="log", xlabel="step", ylabel="loss", title=f"at ×{high}")
    axes.legend(fontsize=8)
    below: list[tuple[str, np.ndarray]] = []
    pictures = [("photograph", photographs()[0]), ("start", judged(start(0))[0])]
    pictures += [(f"{m}, ×{least[m]}", judged(as_arrays(fits[m][least[m]][0]["parameters"]))[0]) for m in fits]
    if "images" in found["deodr"]:
        pictures.append(("DEODR's fitter", np.array(found["deodr"]["images"])[0]))
    below = [(f"{m}, ×{f}", judged(as_arrays(fits[m][f][0]["parameters"]))[0]) for f in (high, higher) for m in fits]
    for row, shown in ((1, pictures), (2, below)):
        for column, (title, image) in enumerate(shown[:6]):
            axes = figure.add_subplot(grid[row, column])
            axes.imshow(np.clip(image, 0, 1))
            axes.set_title(title, fontsize=8)
            axes.axis("off")
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    plt.close(figure)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=Path("out/hand"))
    parser.add_argument("--seeds", type=int, default=SEEDS)
    parser.add_argument("--quick", action="store_true")
    args = parser.parse_args(arguments)
    args.output.mkdir(parents=True, exist_ok=True)
    factors, steps = (QUICK_FACTORS, QUICK_STEPS) if args.quick else (FACTORS, STEPS)
    found = measured(KeptMeasurements(args.output / ".hand.jsonl"), factors, 1 if args.quick else args.seeds, steps)
    print(summary(found))
    draw(found, args.output / "hand.png")
    (args.output / "hand.json").write_text(json.dumps(found, separators=(",", ":")))
    print(f"wrote {args.output}")


if __name__ == "__main__":
    main()
