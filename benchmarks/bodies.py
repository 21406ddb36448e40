"""The pose of a body from its silhouettes: CesiumMan, bent by its own skin, seen by two cameras.

Masks are images of 4 × 4 samples a pixel, of 256² pixels, of a pose of the clip. A start has every joint turned about
a random axis, and the body shifted. Unknown are a rotation vector for each joint and a shift, 60 numbers. Errors are
mean distances of vertices. The model is 1.5 m high.

    python -m benchmarks.bodies                    # two minutes
"""

from __future__ import annotations

import argparse
import time

import numpy as np

import rts
from benchmarks.camera import supersampled
from benchmarks.meshes import DATA
from benchmarks.report import table
from rts.scene.default_camera import bounds_of, orbit

SIZE = (256, 256)
STEPS = 150
TURN, SHIFT = 0.3, 0.05
"""Angles of joints, radians, and the shift of the body, metres: the standard deviations of a start's."""
REPEATS = 100
VIEWS = ((30, 10), (120, 10))
"""Azimuth and elevation of the cameras, degrees."""


def scene_of(model: rts.results.Model, rest: rts.results.Pose):
    """Parameters → parts: "turns" (J, 3), rotation vectors about the joints, and "shift" (3,) of the root."""
    import torch

    joints = model.skins[0].joints
    local = torch.tensor(rest.transforms, dtype=torch.float32)
    parents = np.array([node.parent for node in model.nodes])
    root = int(joints[[parents[j] not in joints for j in joints]][0])
    basis = torch.zeros(3, 4, 4)
    for i in range(3):
        basis[i, (i + 1) % 3, (i + 2) % 3], basis[i, (i + 2) % 3, (i + 1) % 3] = -1, 1
    shifted = torch.zeros(3, 4, 4)
    shifted[torch.arange(3), torch.arange(3), 3] = 1

    def scene(parameters: dict) -> list[rts.Part]:
        turned = local[joints] @ torch.linalg.matrix_exp(torch.einsum("jk,kab->jab", parameters["turns"], basis))
        transforms = local.index_copy(0, torch.as_tensor(joints), turned)
        moved = torch.eye(4) + torch.einsum("k,kab->ab", parameters["shift"], shifted)
        transforms = transforms.index_copy(0, torch.tensor([root]), (transforms[root] @ moved)[None])
        return [part.replace(shader="silhouette") for part in model.posed(rest._replace(transforms=transforms))]

    return scene


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--seeds", type=int, default=5, help="starts")
    parser.add_argument("--time", type=float, default=0.5, help="seconds of the clip")
    options = parser.parse_args()
    import torch

    torch.set_num_threads(2)
    model = rts.load_model(DATA / "gltf" / "CesiumMan.glb")
    truth = model.pose(0, options.time)
    parts = [part.replace(shader="silhouette") for part in model.posed(truth)]
    bounds = bounds_of(parts)
    cameras = [orbit(bounds, SIZE, *view) for view in VIEWS]
    masks = np.stack([supersampled(parts, camera, SIZE, 4)[..., 3].astype(np.float32) for camera in cameras])
    scene = scene_of(model, truth)
    surface = parts[0].surface
    vertices = surface.posed(parts[0].theta)

    def error(parameters: dict) -> float:
        with torch.no_grad():
            found = surface.posed(scene(parameters)[0].theta).numpy()
        return 1e3 * float(np.linalg.norm(found - vertices, axis=1).mean())

    rows, start = [], {}
    for seed in range(options.seeds):
        rng = np.random.default_rng(seed)
        axes = rng.standard_normal((len(model.skins[0].joints), 3)) * TURN / 3**0.5
        start = {"turns": torch.tensor(axes, dtype=torch.float32)}
        start["shift"] = torch.tensor(rng.standard_normal(3) * SHIFT, dtype=torch.float32)
        residuals = rts.ImageResiduals(scene, cameras, SIZE, masks, layers=1)
        for name, chosen in METHODS.items():
            begun = time.perf_counter(), time.process_time()
            found, steps = start, 0
            for options_of_fit in chosen:
                fit = rts.fit(residuals, found, progress=False, **options_of_fit)
                found, steps = fit.parameters, steps + len(fit.history)
            spent = [
                1e3 * (now - then) for now, then in zip((time.perf_counter(), time.process_time()), begun, strict=True)
            ]
            cells = [f"{error(start):.0f}", f"{error(found):.1f}", str(steps)]
            rows.append([str(seed), name, *cells, *(f"{ms / steps:.0f}" for ms in spent)])
    begun = time.process_time()
    for _ in range(REPEATS):
        at = {name: x.clone().requires_grad_() for name, x in start.items()}
        (surface.posed(scene(at)[0].theta) ** 2).sum().backward()
    print(f"posing the vertices, and its gradient: {1e3 * (time.process_time() - begun) / REPEATS:.1f} CPU ms")
    print(table(["start", "method", "mm before", "mm after", "steps", "ms a step", "CPU ms a step"], rows))


FAST, SLOW = {"turns": 0.03, "shift": 0.01}, {"turns": 0.01, "shift": 0.003}
"""Learning rates."""
METHODS: dict[str, list[dict]] = {
    "at full size": [{"steps": STEPS, "learning_rate": FAST}],
    "coarse to fine": [
        {"steps": 50, "learning_rate": FAST, "schedule": [rts.Stage(0.25, 2, 3.0)]},
        {"steps": STEPS - 50, "learning_rate": SLOW},
    ],
}
"""The options of each fit, by Adam, one after the other."""


if __name__ == "__main__":
    main()
