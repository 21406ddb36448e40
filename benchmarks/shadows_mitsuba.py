"""Nine scenes with shadows beside Mitsuba's `direct_projective`: errors of derivative images, and times of gradients.

Truths are differences over a pixel of Mitsuba's images, with `--truth` samples a pixel. All images of derivatives are
low-passed. Mitsuba has its number of samples for the inside and for the edges of shadows; nothing else moves. Of
`--samples`, the fewest with which it errs no more than ours are compared in time. Its shadow rays stop at any surface:
where what casts is translucent, its image is mixed of one with it and one without.

Needs Mitsuba, and a shared library of LLVM that it can use (Debian's libllvm19), see DRJIT_LIBLLVM_PATH.

    python -m benchmarks.shadows_mitsuba -o out/shadows
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Callable, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import torch

import rts
from benchmarks.report import table
from benchmarks.shadow_scenes import CAMERA, PIXEL, SIZE, Body, Scene, image, intensity, scenes, square
from rts_compare.environment import environment
from rts_compare.other_renderers.mitsuba_renderer import flat, mitsuba, positions_of, set_flat
from rts_diagnostics.smoothing import low_pass

TRUTH_PASS = 256
"""Samples a pixel of one image of a truth; several are averaged, which takes less memory."""
SETTINGS = {"1 sample": (256, 1), "2 × 2": (512, 2)}
"""Height and width of the lights' pictures, whose cells are about as large as samples at the origin; `supersample`."""


class Traced:
    """A scene in Mitsuba."""

    def __init__(self, scene: Scene, casts: bool = True):
        mi = mitsuba()
        made: dict[str, Any] = {"type": "scene", "sensor": _sensor(mi)}
        with tempfile.TemporaryDirectory() as folder:
            white = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 1.0}}}
            for name, body in (("receives", scene.receives), ("casts", scene.casts)):
                if body is not None and (casts or name == "receives"):
                    made[name] = _ply(body, f"{folder}/{name}.ply") | {"bsdf": white}
            lights = [f"light{i}" for i in range(len(scene.lights))]
            for name, direction in zip(lights, scene.lights, strict=True):
                corners = Body(None, {}, (square(direction, scene.side), np.array([[0, 1, 2], [0, 2, 3]])))
                radiance = np.pi * intensity(scene) / scene.side**2
                emitter = {"type": "area", "radiance": {"type": "rgb", "value": radiance}}
                made[name] = _ply(corners, f"{folder}/{name}.ply") | {"emitter": emitter}
            self.scene = mi.load_dict(made, optimize=False)  # Or it would join meshes.
        self.parameters = mi.traverse(self.scene)
        moved = {"light": lights}.get(scene.moves, [scene.moves])
        keys = [positions_of(self.parameters, name) for name in moved if name in made]
        self.rest = {key: mi.Float(flat(self.parameters[key])) for key in keys}
        self.change = {key: mi.Float(np.tile(scene.motion, len(np.array(x)) // 3)) for key, x in self.rest.items()}
        self.integrator = mi.load_dict({"type": "direct_projective", "sppp": 0, "guiding": "grid"})
        self.plain = mi.load_dict({"type": "direct"})

    def image(self, t: Any, samples: int, seed: int, integrator: Any = None) -> Any:
        """The image (H, W, 3), a tensor of Mitsuba."""
        for key, value in self.rest.items():
            set_flat(self.parameters, key, value + t * self.change[key])
        self.parameters.update()
        integrator = self.integrator if integrator is None else integrator
        return mitsuba().render(self.scene, self.parameters, integrator=integrator, spp=samples, seed=seed)

    def values(self, t: float, samples: int, seed: int = 0) -> np.ndarray:
        """The image (H, W) at t, without derivatives."""
        total, passes = np.zeros(SIZE), max(samples // TRUTH_PASS, 1)
        for i in range(passes):
            drawn = self.image(t, min(samples, TRUTH_PASS), seed + i, self.plain)
            total += np.array(drawn, np.float64)[..., 0] / passes
        return total

    def derivative(self, samples: int, seed: int) -> np.ndarray:
        """The derivative image (H, W), by forward mode; zero where nothing moves."""
        if not self.rest:
            return np.zeros(SIZE)
        dr = import_module("drjit")
        t = dr.opaque(mitsuba().Float, 0.0)
        dr.enable_grad(t)
        drawn = self.image(t, samples, seed)
        dr.forward(t)
        return np.array(dr.grad(drawn), np.float64)[..., 0]

    def gradient(self, weights: np.ndarray, samples: int) -> Callable[[], None]:
        """A function that finds the gradient of a weighted sum of the image, by reverse mode."""
        dr, w = import_module("drjit"), mitsuba().TensorXf(np.repeat(weights[..., None], 3, axis=2).astype(np.float32))

        def call() -> None:
            t = dr.opaque(mitsuba().Float, 0.0)
            dr.enable_grad(t)
            dr.backward(dr.sum(self.image(t, samples, 0) * w, axis=None))
            dr.eval(dr.grad(t))
            dr.sync_thread()

        return call


def _sensor(mi: Any) -> dict[str, Any]:
    """The camera of all scenes."""
    film = {"type": "hdrfilm", "width": SIZE[1], "height": SIZE[0], "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    fov = 2 * np.degrees(np.arctan(1 / float(np.asarray(CAMERA.projection)[1, 1])))
    # Mitsuba's cameras look along +z, with +x to the left.
    to_world = np.linalg.inv(np.asarray(CAMERA.view, np.float64)) @ np.diag([-1.0, 1, -1, 1])
    place = {"near_clip": 0.01, "far_clip": 100.0, "to_world": mi.ScalarTransform4f(to_world)}
    return {"type": "perspective", "fov": fov, "fov_axis": "y", "film": film, **place}


def _ply(body: Body, path: str) -> dict[str, Any]:
    """The dict of a mesh in its place, with smooth normals; writes its file."""
    vertices, faces = body.triangles
    normals = np.asarray(rts.Mesh(faces).vertex_normals(np.asarray(vertices, np.float64)))
    names = ("x", "y", "z", "nx", "ny", "nz")
    rows = np.concatenate([vertices + body.offset, normals], axis=1).astype("<f4")
    records = np.zeros(len(faces), [("count", "u1"), ("corners", "<i4", 3)])
    records["count"], records["corners"] = 3, faces
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    lines += [f"property float {name}" for name in names]
    lines += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header\n"]
    Path(path).write_bytes("\n".join(lines).encode() + rows.tobytes() + records.tobytes())
    return {"type": "ply", "filename": path}


class Mixed:
    """A scene in Mitsuba, where what casts may be translucent."""

    def __init__(self, scene: Scene):
        self.alpha, self.with_it = scene.alpha, Traced(scene)
        self.without = None if scene.alpha == 1 else Traced(scene, casts=False)

    def values(self, t: float, samples: int, seed: int = 0) -> np.ndarray:
        """See `Traced`."""
        found = self.with_it.values(t, samples, seed)
        if self.without is None:
            return found
        return self.alpha * found + (1 - self.alpha) * self.without.values(t, samples, seed)

    def derivative(self, samples: int, seed: int) -> np.ndarray:
        """See `Traced`."""
        return self.alpha * self.with_it.derivative(samples, seed)


# ----------------------------------------------------------------------------------------------------- measuring


def ours(scene: Scene, setting: str) -> tuple[np.ndarray, np.ndarray]:
    """Our image and derivative image (H, W), per unit of t."""
    zero, one = torch.tensor(0.0).double(), torch.tensor(1.0).double()
    found = torch.func.jvp(lambda t: image(scene, t, *SETTINGS[setting]), (zero,), (one,))
    return found[0].numpy(), found[1].numpy()


def our_gradient(scene: Scene, weights: np.ndarray, setting: str) -> Callable[[], None]:
    """A function that finds the gradient of a weighted sum of our image, by reverse mode."""
    w = torch.tensor(weights)

    def call() -> None:
        t = torch.zeros((), dtype=torch.float64, requires_grad=True)
        (image(scene, t, *SETTINGS[setting]) * w).sum().backward()

    return call


def step_of(scene: Scene) -> float:
    """The t by which what is seen of shadows moves by half a pixel."""
    return PIXEL / 2 / (np.linalg.norm(scene.motion) if scene.moves != "light" else 1.0)


def error(found: np.ndarray, truth: np.ndarray) -> float:
    """Relative L2 of images (H, W), low-passed."""
    found, truth = low_pass(found[..., None]), low_pass(truth[..., None])
    return float(np.linalg.norm(found - truth) / np.linalg.norm(truth))


def truth_of(traced: Mixed, scene: Scene, samples: int, folder: Path) -> tuple[np.ndarray, np.ndarray, float]:
    """The image, its change with t by a difference, and how far two halves of the samples differ; kept in a file."""
    path = folder / f"truth {scene.name}, {samples}.npz"
    if not path.exists():
        step, half = step_of(scene), samples // 2
        slopes, values = [], []
        for seed in (1000, 2000):
            ends = [traced.values(t, half, seed) for t in (-step, step)]
            slopes.append((ends[1] - ends[0]) / (2 * step))
            values.append((ends[0] + ends[1]) / 2)
        np.savez(path, values=np.mean(values, axis=0), slopes=np.stack(slopes))
    kept = np.load(path)
    slopes = kept["slopes"]
    return kept["values"], slopes.mean(axis=0), error(slopes[0], slopes[1]) / 2


def timed(calls: Sequence[Callable[[], None]], rounds: int) -> list[float]:
    """Medians of milliseconds, the calls in turn."""
    found: list[list[float]] = [[] for _ in calls]
    for round_ in range(rounds + 1):
        for call, times in zip(calls, found, strict=True):
            start = time.perf_counter()
            call()
            if round_:
                times.append(1e3 * (time.perf_counter() - start))
    return [float(np.median(times)) for times in found]


def measured(scene: Scene, args: argparse.Namespace) -> dict[str, Any]:
    """All figures of a scene: errors and times by method, a setting of ours or a number of samples of Mitsuba."""
    traced = Mixed(scene)
    values, slopes, noise = truth_of(traced, scene, args.truth, args.output)
    true = low_pass(slopes[..., None])
    found: dict[str, Any] = {"scene": scene.name, "noise": noise, "errors": {}, "gains": {}, "images": {}}
    for setting in SETTINGS:
        value, slope = ours(scene, setting)
        found["errors"][setting], found["images"][setting] = error(slope, slopes), error(value, values)
        found["gains"][setting] = float((true * low_pass(slope[..., None])).sum() / (true * true).sum())
    for n in args.samples:
        found["errors"][n] = float(np.mean([error(traced.derivative(n, seed), slopes) for seed in range(2)]))
    weights = np.random.default_rng(0).standard_normal(SIZE)
    calls = [our_gradient(scene, weights, setting) for setting in SETTINGS]
    calls += [traced.with_it.gradient(weights, n) for n in args.samples]
    found["ms"] = dict(zip([*SETTINGS, *args.samples], timed(calls, args.rounds), strict=True))
    return found


def needed(row: dict[str, Any], setting: str, samples: list[int]) -> str:
    """The time that Mitsuba takes over ours, with the fewest samples with which it errs no more; > if more."""
    enough = [n for n in samples if row["errors"][n] <= row["errors"][setting]]
    n, sign = (enough[0], "") if enough else (samples[-1], "> ")
    return f"{sign}{row['ms'][n] / row['ms'][setting]:.0f}"


def written(rows: list[dict[str, Any]], samples: list[int]) -> str:
    """The table."""
    head = ["scene", *SETTINGS, *(f"Mitsuba, {n}" for n in samples), *(f"time over {name}" for name in SETTINGS)]
    lines = []
    for row in rows:
        cells = [f"{row['errors'][k]:.3f}, {row['ms'][k]:.0f} ms" for k in (*SETTINGS, *samples)]
        lines.append([row["scene"], *cells, *(needed(row, name, samples) for name in SETTINGS)])
    return table(head, lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=Path("out/shadows"))
    parser.add_argument("--samples", type=int, nargs="+", default=[16, 64])
    parser.add_argument("--truth", type=int, default=2048, help="samples a pixel of each end of a difference")
    parser.add_argument("--rounds", type=int, default=2)
    parser.add_argument("--scenes", nargs="*", help="names, all by default")
    args = parser.parse_args()
    args.output.mkdir(parents=True, exist_ok=True)
    rows = []
    for scene in scenes():
        if not args.scenes or scene.name in args.scenes:
            rows.append(measured(scene, args))
            print(rows[-1], flush=True)
    text = written(rows, args.samples)
    (args.output / "mitsuba.json").write_text(
        json.dumps(environment(("numpy", "torch", "mitsuba")) | {"rows": rows}, indent=1) + "\n"
    )
    (args.output / "mitsuba.md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
