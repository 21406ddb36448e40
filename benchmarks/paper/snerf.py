"""A radiance field as a surface light field (section 4.6 and table 2): one evaluation of its network a sample.

A NeRF's density on a lattice gives an isosurface, and its network the colours seen there. Compared with volume
rendering are the surface as it is found ("fixed"), the network finetuned on it ("finetuned"), and surface and network
refined jointly ("joint"): each step is one of Adam on the weights with the grid held, then one of gradient descent on
the grid with the weights held, on the square differences from a window of one posed photograph.

    python -m benchmarks.paper.snerf -o out/snerf                 # lego, all stages, then figure and tables
    python -m benchmarks.paper.snerf -o out/snerf --resume        # go on where it was interrupted
    python -m benchmarks.paper.snerf -o out/snerf100 --start out/snerf --finest 100 --steps 1000 --sides 100
    python -m benchmarks.paper.snerf -o out/fern --scene fern     # the surface lies in NDC
    python -m benchmarks.paper.snerf --quick                      # in some minutes

Ctrl-C ends a run after the step it is in, and keeps everything: a run that is resumed ends with the very numbers of one
that was not interrupted.

The grid holds log(1 + density), whose slope is more even than that of the density. Its gradient is smoothed over a cell
of the lattice: one view says little of a single value, and more of what its neighbours have in common. Windows are cut
from the finest photographs, in which a pixel is smaller than a cell; images are scored at other sizes, too, and a
second run (the third command) makes a field refined by these suit coarse pixels.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter

import rts
from benchmarks.paper.snerf_scenes import SHOWN, Scene, Shot, fern, lego, real
from rts.arrays.trees import leaves, map_leaves
from rts_surfaces.radiance_field.shader import RadianceShader

HIGHEST = 8.0
"""The grid lies between 0, no density, and this: log(1 + density) of 3,000, near the greatest of these fields."""
STAGES = ("baseline", "fixed", "finetuned", "joint")
TITLES = {
    "baseline": "NeRF (volume)",
    "fixed": "surface, fixed",
    "finetuned": "surface fixed, network finetuned",
    "joint": "surface and network, joint",
}
EDGES = rts.plugin("splatters", "edges")
SPLATTERS = {
    "edges": {"splatter": EDGES(), "layers": 1},
    "centers": {"splatter": EDGES(colors="centers"), "layers": 1},
    "multi": {"splatter": "multi", "layers": 2},
}
"""Name → options of a render."""
FINE = 128
"""Evaluations of the fine network for a ray of volume rendering."""


# --------------------------------------------------------------------------------------------------------------- scores


def psnr(image: np.ndarray, truth: np.ndarray) -> float:
    """Peak signal-to-noise ratio in decibels, of images from 0 to 1."""
    error = np.mean((np.clip(image, 0, 1).astype(np.float64) - truth) ** 2)
    return float(-10 * np.log10(max(error, 1e-12)))


def ssim(image: np.ndarray, truth: np.ndarray) -> float:
    """Structural similarity (Wang et al. 2004): Gaussian windows of 11 × 11 with σ = 1.5, mean over the channels."""
    x, y = np.clip(image, 0, 1).astype(np.float64), np.asarray(truth, np.float64)

    def mean(a: np.ndarray) -> np.ndarray:
        return gaussian_filter(a, (1.5, 1.5, 0), truncate=3.5)

    a, b = mean(x), mean(y)
    xx, yy, xy = mean(x * x) - a * a, mean(y * y) - b * b, mean(x * y) - a * b
    c, d = 0.01**2, 0.03**2
    found = (2 * a * b + c) * (2 * xy + d) / ((a * a + b * b + c) * (xx + yy + d))
    return float(found[5:-5, 5:-5].mean())  # Where windows lie within the image.


def rendered(scene: Scene, values: Any, weights: Any, shot: Shot, shader: Any = None, engine: str = "torch") -> Any:
    """The image (H, W, 3) of a surface light field."""
    return _image(scene.part(values, weights, shader), scene, shot.camera, shot.size, engine)


def _image(part: Any, scene: Scene, camera: rts.Camera, size: Any, engine: str = "torch", supersample: int = 1) -> Any:
    options = SPLATTERS[scene.splatter] | {"supersample": supersample}
    return rts.render(part, camera, size, background=scene.behind(), engine=engine, **options)[..., :3]


# ----------------------------------------------------------------------------------------------------------- refinement


class Settings(NamedTuple):
    """Settings by which a surface light field is refined.

    Attributes:
        joint: whether the grid is refined, too.
        steps: how many steps there are; rates fall to zero over them, as a cosine does.
        learning_rate: Adam's, for the weights.
        rate: of gradient descent on the grid.
        smoothing: standard deviation, in cells of the lattice, of the Gaussian that the grid's gradient is smoothed by.
        window: largest (height, width) of a photograph that a step looks at.
        seed: of the choice of photographs and windows.
    """

    joint: bool
    steps: int
    learning_rate: float = 1e-3
    rate: float = 5e4
    smoothing: float = 1.0
    window: tuple[int, int] = (64, 64)
    seed: int = 0


class Refinement:
    """A grid and a network on their way: everything that a further step depends on.

    Args:
        scene: the scene.
        settings: how to refine it.
        values: the grid to start from, (X, Y, Z).
        weights: likewise the network; None for the fine one of the field.
    """

    def __init__(self, scene: Scene, settings: Settings, values: np.ndarray, weights: Any = None):
        import torch

        self.scene, self.settings, self.step, self.seconds = scene, settings, 0, 0.0
        self.losses: list[float] = []
        self.values = torch.from_numpy(np.array(values, np.float32))
        weights = scene.field.weights["fine"] if weights is None else weights
        self.weights = map_leaves(lambda x: torch.from_numpy(np.array(x)).requires_grad_(True), weights)
        self.adam = torch.optim.Adam(leaves(self.weights), lr=settings.learning_rate)
        self.random = np.random.default_rng(settings.seed)

    def advance(self) -> None:
        """One step on the weights with the grid held, and one on the grid with the weights held."""
        import torch

        begun = time.perf_counter()
        decay = 0.5 + 0.5 * math.cos(math.pi * self.step / self.settings.steps)
        camera, photograph = self._chosen()
        self.adam.param_groups[0]["lr"] = self.settings.learning_rate * decay
        self.adam.zero_grad()
        loss = self._loss(self.values, self.weights, camera, photograph)
        if loss.requires_grad:  # Else nothing is seen in the window.
            loss.backward()
            self.adam.step()
        self.losses.append(float(loss.detach()))
        if self.settings.joint and loss.requires_grad:
            values = self.values.requires_grad_(True)
            weights = map_leaves(torch.Tensor.detach, self.weights)
            (slope,) = torch.autograd.grad(self._loss(values, weights, camera, photograph), values)
            slope = torch.from_numpy(gaussian_filter(slope.numpy(), self.settings.smoothing, truncate=2.5))
            self.values = (values.detach() - self.settings.rate * decay * slope).clamp_(0, HIGHEST)
        self.step += 1
        self.seconds += time.perf_counter() - begun

    def _chosen(self) -> tuple[rts.Camera, Any]:
        """Part of a photograph, and its camera: windows lie about pixels that are not background."""
        import torch

        shot = self.scene.train[self.random.integers(len(self.scene.train))]
        size = shot.size
        window = min(size[0], self.settings.window[0]), min(size[1], self.settings.window[1])
        background = self.scene.behind() * (255 if shot.image.dtype == np.uint8 else 1)
        rows, columns = np.nonzero((shot.image != background).any(axis=2))
        at = self.random.integers(len(rows))
        top, left = (
            int(np.clip(x[at] - n // 2, 0, m - n)) for x, n, m in zip((rows, columns), window, size, strict=True)
        )
        image = real(shot.image[top : top + window[0], left : left + window[1]])
        camera = shot.camera.window(size, (top, left), window)
        return camera, torch.from_numpy(np.ascontiguousarray(image))

    def _loss(self, values: Any, weights: Any, camera: rts.Camera, photograph: Any) -> Any:
        part = self.scene.part(values, weights)
        found = _image(part, self.scene, camera, tuple(photograph.shape[:2]))
        return ((found - photograph) ** 2).mean()

    # ------------------------------------------------------------------------------------------------- checkpoints

    def save(self, path: Path) -> None:
        """Write everything that further steps depend on, in one go: a file is whole, or the one before."""
        state = self.adam.state_dict()["state"]
        arrays = {"values": self.values.detach().numpy(), "losses": np.array(self.losses)}
        for i, x in enumerate(leaves(self.weights)):
            arrays[f"weights.{i}"] = x.detach().numpy()
            arrays |= {f"adam.{i}.{name}": np.asarray(x) for name, x in state.get(i, {}).items()}
        about = {
            "settings": self.settings,
            "step": self.step,
            "seconds": self.seconds,
            "random": self.random.bit_generator.state,
        }
        path.parent.mkdir(parents=True, exist_ok=True)
        draft = path.with_suffix(".draft")
        with draft.open("wb") as file:
            np.savez(file, about=np.array(json.dumps(about)), **arrays)
            file.flush()
            os.fsync(file.fileno())
        draft.replace(path)

    def restore(self, path: Path) -> None:
        """Go on from what `save` wrote.

        Raises:
            ValueError: it was written with other settings.
        """
        import torch

        with np.load(path, allow_pickle=False) as found:
            arrays = dict(found)
        about = json.loads(str(arrays["about"]))
        if about["settings"] != json.loads(json.dumps(self.settings)):
            raise ValueError(f"{path} was written with settings {about['settings']}; these are {self.settings}")
        self.step, self.seconds, self.losses = about["step"], about["seconds"], arrays["losses"].tolist()
        self.random.bit_generator.state = about["random"]
        self.values = torch.from_numpy(arrays["values"])
        state: dict[int, dict[str, Any]] = {}
        with torch.no_grad():
            for i, x in enumerate(leaves(self.weights)):
                x.copy_(torch.from_numpy(arrays[f"weights.{i}"]))
        for key, array in arrays.items():
            if key.startswith("adam."):
                _, i, name = key.split(".")
                state.setdefault(int(i), {})[name] = torch.from_numpy(array)
        self.adam.load_state_dict({**self.adam.state_dict(), "state": state})

    def found(self) -> tuple[np.ndarray, Any]:
        """Grid and weights, on the host."""
        return self.values.detach().numpy(), map_leaves(lambda x: x.detach().numpy(), self.weights)


@contextmanager
def interruptible() -> Iterator[Callable[[], bool]]:
    """A function that tells whether Ctrl-C was pressed; when it is pressed again, KeyboardInterrupt is raised."""
    asked = False
    before = signal.getsignal(signal.SIGINT)

    def note(number: int, frame: Any) -> None:
        nonlocal asked
        if asked:
            raise KeyboardInterrupt
        asked = True
        print("interrupted: ends after this step", flush=True)

    signal.signal(signal.SIGINT, note)
    try:
        yield lambda: asked
    finally:
        signal.signal(signal.SIGINT, before)


def refine(
    refinement: Refinement, path: Path, every: int = 250, watch: Callable[[Refinement], None] = lambda _: None
) -> bool:
    """All steps that are left, with checkpoints; False if Ctrl-C ended them early.

    Args:
        refinement: what is refined.
        path: the file of checkpoints.
        every: steps from one checkpoint to the next.
        watch: called before each checkpoint.
    """
    with interruptible() as asked:
        while refinement.step < refinement.settings.steps and not asked():
            refinement.advance()
            if refinement.step % every == 0:
                watch(refinement)
                refinement.save(path)
    refinement.save(path)
    return refinement.step == refinement.settings.steps


# --------------------------------------------------------------------------------------------------------------- stages


def scores(images: Sequence[np.ndarray], shots: Sequence[Shot]) -> dict[str, list]:
    """Scores of images beside photographs."""
    pairs = list(zip(images, shots, strict=True))
    return {
        "views": [shot.name for shot in shots],
        "psnr": [psnr(image, shot.truth()) for image, shot in pairs],
        "ssim": [ssim(image, shot.truth()) for image, shot in pairs],
    }


def baseline(scene: Scene, shots: Sequence[Shot], folder: Path, side: str) -> tuple[np.ndarray, dict[str, Any]]:
    """Volume rendering: images and numbers. Each image is kept in the folder, and found there."""
    kept: dict[str, list] = {"images": [], "seconds": [], "coarse": [], "fine": []}
    for shot in shots:
        path = folder / f"volume-{side}-{shot.name}.npz"
        if not path.is_file():
            begun = time.perf_counter()
            found = scene.field.volume_render(shot.camera, shot.size, background=scene.background, ndc=scene.ndc)
            seconds = time.perf_counter() - begun
            np.savez(path, images=found.image, seconds=seconds, coarse=found.coarse, fine=found.fine)
        with np.load(path) as file:
            for name in kept:
                kept[name].append(file[name] if name == "images" else file[name].item())
        score = psnr(kept["images"][-1], shot.truth())
        print(f"baseline, view {shot.name:>3} at {side}: {score:.2f} dB, {kept['seconds'][-1]:.1f} s", flush=True)
    images = np.stack(kept.pop("images"))
    height, width = shots[0].size
    return images, scores(images, shots) | kept | {"pixels": height * width}


def drawn(
    scene: Scene, values: np.ndarray, weights: Any, shots: Sequence[Shot], supersample: int = 1
) -> tuple[np.ndarray, dict[str, Any]]:
    """A surface light field: images and numbers."""
    images, seconds, evaluations, covered, shaded = [], [], [], [], []

    class Counted(RadianceShader):
        """The shader, which counts the samples that it is given."""

        takes_views, reads = True, RadianceShader.reads

        def __call__(self, theta: Any, gbuffer: Any, camera: Any) -> Any:
            shaded.append(int(gbuffer["position"].shape[0]))
            return super().__call__(theta, gbuffer, camera)

    part = rts.prepare(scene.part(values, weights, Counted(ndc=scene.ndc)))
    _image(part, scene, shots[0].camera, shots[0].size)  # The triangles are found once.
    for shot in shots:
        shaded.clear()
        begun = time.perf_counter()
        images.append(np.asarray(_image(part, scene, shot.camera, shot.size, supersample=supersample)))
        seconds.append(time.perf_counter() - begun)
        evaluations.append(sum(shaded))
        options = SPLATTERS[scene.splatter] | {"supersample": supersample}
        found = rts.sample(part, shot.camera, shot.size, **options)
        border, fine = found.border, supersample
        row = found.row[0, border:-border, border:-border] >= 0
        pixels = row.reshape(shot.size[0], fine, shot.size[1], fine).any(axis=(1, 3))
        covered.append(int(pixels.sum()))
    numbers = scores(images, shots) | {"seconds": seconds, "evaluations": evaluations, "covered": covered}
    return np.stack(images), numbers


def run(scene: Scene, folder: Path, stages: Sequence[str], options: argparse.Namespace) -> bool:
    """The stages, each into its own files; False if Ctrl-C ended one."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in stages:
        file, about = folder / f"{name}.json", {}
        if options.resume and file.is_file():
            continue
        values, weights = scene.grid(folder), scene.field.weights["fine"]
        if name in ("finetuned", "joint"):
            settings = Settings(name == "joint", options.steps, options.learning_rate, options.rate)
            before = {}
            if options.start is not None:
                values, weights, before = ended(scene, options.start, name)
            refinement, path = Refinement(scene, settings, values, weights), folder / f"{name}.npz"
            if options.resume and path.is_file():
                refinement.restore(path)
                print(f"{name}: goes on at step {refinement.step}", flush=True)
            if not refine(refinement, path, options.every, lambda r, name=name: told(name, r)):
                print(f"{name}: interrupted after step {refinement.step}; --resume goes on", flush=True)
                return False
            values, weights = refinement.found()
            about = {"steps": refinement.step, "training": refinement.seconds}
            about = {key: value + before.get(key, 0) for key, value in about.items()}
        sides = {}
        for side, shots in scene.tests.items():
            shots = shots[: options.views]
            if name == "baseline":
                images, sides[side] = baseline(scene, shots, folder, side)
            else:
                images, sides[side] = drawn(scene, values, weights, shots)
            np.savez(folder / f"{name}-{side}.npz", images=images)
            if name != "baseline":
                _, sides[f"{side}, 2 × 2 samples a pixel"] = drawn(scene, values, weights, shots, 2)
        file.write_text(json.dumps(about | {"sides": sides}, indent=2) + "\n")
        for side, numbers in sides.items():
            print(f"{name} at {side}: {np.mean(numbers['psnr']):.2f} dB, {np.mean(numbers['ssim']):.3f}", flush=True)
    return True


def ended(scene: Scene, folder: Path, name: str) -> tuple[np.ndarray, Any, dict[str, float]]:
    """Grid and weights that a run into another folder ended with, and what it took."""
    about = json.loads((folder / f"{name}.json").read_text())
    with np.load(folder / f"{name}.npz", allow_pickle=False) as file:
        values, count = file["values"], iter(range(len(file.files)))
        weights = map_leaves(lambda _: file[f"weights.{next(count)}"], scene.field.weights["fine"])
    return values, weights, {key: about[key] for key in ("steps", "training")}


def told(name: str, refinement: Refinement) -> None:
    """Print how far a refinement is."""
    (side, shots), *_ = refinement.scene.tests.items()
    shots, found = shots[::6], refinement.found()
    score = np.mean([psnr(np.asarray(rendered(refinement.scene, *found, shot)), shot.truth()) for shot in shots])
    loss = -10 * np.log10(np.mean(refinement.losses[-250:]))
    print(
        f"{name}: step {refinement.step:5}, {refinement.seconds:6.0f} s; windows {loss:.2f} dB, "
        f"{len(shots)} views held out {score:.2f} dB at {side}",
        flush=True,
    )


# -------------------------------------------------------------------------------------------------------------- reports


def timed(scene: Scene, values: np.ndarray, weights: Any, frames: int = 5) -> dict[str, Any]:
    """Seconds of a frame by volume and by surface, which take turns."""
    part, (side, shots) = rts.prepare(scene.part(values, weights)), next(iter(scene.tests.items()))
    volume, surface = [], []
    _image(part, scene, shots[0].camera, shots[0].size)
    for shot in shots[:frames]:
        for _ in range(3):
            begun = time.perf_counter()
            _image(part, scene, shot.camera, shot.size)
            surface.append(time.perf_counter() - begun)
        begun = time.perf_counter()
        scene.field.volume_render(shot.camera, shot.size, background=scene.background, ndc=scene.ndc)
        volume.append(time.perf_counter() - begun)
    return {"side": side, "volume": volume, "surface": surface}


def tables(folder: Path) -> str:
    """The results, in Markdown."""
    found = {s: json.loads((folder / f"{s}.json").read_text()) for s in STAGES if (folder / f"{s}.json").is_file()}
    sides = list(dict.fromkeys(side for stage in found.values() for side in stage["sides"]))
    lines = []
    for side in sides:
        having = [stage["sides"][side]["views"] for stage in found.values() if side in stage["sides"]]
        count = min(map(len, having))  # All have the first ones in common.
        lines += [
            f"At {side} ({count} views held out):",
            "",
            "| | PSNR | SSIM | steps | training | fine evaluations a covered pixel |",
            "|---|---|---|---|---|---|",
        ]
        for name, stage in found.items():
            if side not in stage["sides"]:
                continue
            numbers = {k: v[:count] if isinstance(v, list) else v for k, v in stage["sides"][side].items()}
            training = f"{stage['training'] / 60:.0f} min" if "training" in stage else "–"
            if name == "baseline":
                coarse, fine = (np.mean(numbers[n]) / numbers["pixels"] for n in ("coarse", "fine"))
                used = f"{fine:.0f}, and {coarse:.0f} coarse"
            else:
                used = np.sum(numbers["evaluations"]) / np.sum(numbers["covered"])
                used = f"{used:.2f} ({FINE / used:.0f}× fewer)"
            lines.append(
                f"| {TITLES[name]} | {np.mean(numbers['psnr']):.2f} | {np.mean(numbers['ssim']):.3f} "
                f"| {stage.get('steps', '–')} | {training} | {used} |"
            )
        lines.append("")
    if (folder / "times.json").is_file():
        times = json.loads((folder / "times.json").read_text())
        volume, surface = np.median(times["volume"]), np.median(times["surface"])
        lines += [
            f"| seconds of a frame at {times['side']} | median | least |",
            "|---|---|---|",
            f"| volume | {volume:.2f} | {min(times['volume']):.2f} |",
            f"| surface | {surface:.4f} ({volume / surface:.0f}× less) | {min(times['surface']):.4f} |",
        ]
    return "\n".join(lines)


def draw(path: Path, scene: Scene, folder: Path, side: str, chosen: Sequence[int]) -> None:
    """Photographs beside the stages, and the surfaces as normals before and after."""
    from matplotlib.figure import Figure

    shots, columns = scene.tests[side], []
    columns.append(("photograph", [shots[i].truth() for i in chosen], [f"view {shots[i].name}" for i in chosen]))
    for name in STAGES:
        if (folder / f"{name}-{side}.npz").is_file():
            numbers = json.loads((folder / f"{name}.json").read_text())["sides"][side]
            images = np.load(folder / f"{name}-{side}.npz")["images"]
            notes = [f"{numbers['psnr'][i]:.2f} dB, {numbers['ssim'][i]:.3f}" for i in chosen if i < len(images)]
            columns.append((TITLES[name], [images[i] for i in chosen if i < len(images)], notes))
    grids = {"surface before": scene.grid(folder)}
    if (folder / "joint.npz").is_file():
        grids["surface after"] = np.load(folder / "joint.npz")["values"]
    for title, values in grids.items():
        pictures = [np.asarray(rendered(scene, values, {}, shots[i], "normals")) for i in chosen]
        columns.append((title, pictures, [""] * len(chosen)))
    height, width = shots[0].size
    figure = Figure(figsize=(2.6 * len(columns), (2.6 * height / width + 0.3) * len(chosen)), layout="constrained")
    grid = figure.subplots(len(chosen), len(columns), squeeze=False)
    for axes in grid.ravel():
        axes.axis("off")
    for column, (title, pictures, notes) in zip(grid.T, columns, strict=True):
        for k, (axes, picture, note) in enumerate(zip(column, pictures, notes, strict=False)):
            axes.imshow(np.clip(picture, 0, 1), interpolation="antialiased")
            axes.set_title(f"{title}\n{note}" if k == 0 else note, fontsize=9)
    figure.savefig(path, dpi=130)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=Path("out/snerf"))
    parser.add_argument("--scene", choices=("lego", "fern"), default="lego")
    parser.add_argument("--splatter", choices=SPLATTERS, default="edges")
    parser.add_argument("--sides", nargs="+", type=int, choices=(100, 200, 400), default=[100, 400], help="of lego")
    parser.add_argument("--factor", type=int, default=3, help="of fern: 378 × 504 pixels over this")
    parser.add_argument("--fineness", type=float, default=1.0, help="of the lattice")
    parser.add_argument("--stages", nargs="*", choices=STAGES, default=list(STAGES))
    parser.add_argument("--finest", type=int, choices=(100, 200, 400), default=400, help="side of lego's photographs")
    parser.add_argument("--start", type=Path, default=None, help="folder of a run to start from")
    parser.add_argument("--steps", type=int, default=5000)
    parser.add_argument("--learning-rate", type=float, default=Settings._field_defaults["learning_rate"])
    parser.add_argument("--rate", type=float, default=Settings._field_defaults["rate"], help="of the grid")
    parser.add_argument("--views", type=int, default=None, help="number of photographs held out to draw, of each side")
    parser.add_argument("--every", type=int, default=250, help="steps between checkpoints")
    parser.add_argument("--resume", action="store_true", help="go on from checkpoints, keep stages that are done")
    parser.add_argument("--times", action="store_true", help="measure frames, too")
    parser.add_argument("--quick", action="store_true", help="few steps and views, a coarse lattice")
    args = parser.parse_args(arguments)
    if args.quick:
        args.steps, args.views, args.fineness, args.every, args.sides = 100, 2, 0.5, 50, [100]
    scene = lego(args.sides, args.fineness, args.finest) if args.scene == "lego" else fern(args.factor, args.fineness)
    scene = scene._replace(splatter=args.splatter)
    if not run(scene, args.output, args.stages, args):
        raise SystemExit(130)
    if args.times or args.quick:
        with np.load(args.output / "joint.npz") as file:
            values = file["values"]
        found = timed(scene, values, scene.field.weights["fine"], 1 if args.quick else 5)
        (args.output / "times.json").write_text(json.dumps(found) + "\n")
    for side, shots in scene.tests.items():
        chosen = SHOWN if len(shots) > max(SHOWN) else (0, 1, 2)
        count = len(shots[: args.views])
        draw(args.output / f"snerf-{side}.png", scene, args.output, side, [i for i in chosen if i < count])
    print(tables(args.output))


if __name__ == "__main__":
    main()
