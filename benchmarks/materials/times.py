"""What `pbr` costs beside `lambert`: a picture and its gradient, both shaders in turn in one run, at 256².

python -m benchmarks.materials.times
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch

import rts
from benchmarks.materials.compare import DATA, EYE, sky, sphere
from benchmarks.report import table
from rts.shading import prefiltered

SIZE, ROUNDS = (256, 256), 15
LIGHTS: dict[str, Callable[[], dict[str, Any]]] = {
    "none given": dict,
    "a lamp": lambda: {"light": {"direction": np.array([1.0, 1, 1]), "ambient": 0.2}},
    "spherical harmonics": lambda: {"light": {"sh": prefiltered(sky())["sh"]}},
    "an environment, prefiltered": lambda: {"light": {"environment": prefiltered(sky())}},
}


def scenes() -> dict[str, rts.Part]:
    """A sphere whose material is numbers, and the bottle, which has all maps, one unit in radius."""
    (bottle,) = rts.load(DATA / "gltf/WaterBottle/WaterBottle.gltf")
    vertices = np.asarray(bottle.theta["vertices"])
    vertices = (vertices - vertices.mean(axis=0)) / np.ptp(vertices, axis=0).max() * 2
    return {
        "sphere, numbers": sphere(0.5, 0.5).part,
        "bottle, all maps": bottle.replace(theta={**bottle.theta, "vertices": vertices.astype(np.float32)}),
    }


def step_of(part: rts.Part, camera: rts.Camera) -> Callable[[], None]:
    """A render with torch, and the gradient of its mean in the pose, as in a fit of known materials."""
    theta = {n: torch.as_tensor(np.asarray(x)) for n, x in part.theta.items() if n != "light"}
    pose = torch.full((6,), 0.01).requires_grad_()
    light = {"light": part.theta["light"]} if "light" in part.theta else {}

    def step() -> None:
        posed = part.replace(theta={**theta, **light}, transform=rts.rigid(pose))
        rts.render(posed, camera, SIZE).mean().backward()

    return step


def main() -> None:
    camera, lines = rts.Camera.look_at(EYE, (0, 0, 0), fov_y=38), []
    for scene, part in scenes().items():
        for name, light in LIGHTS.items():
            theta = {**part.theta, **light()}
            shaders = {"lambert": "lambert", "pbr": part.shader if scene.startswith("bottle") else "pbr"}
            ways: dict[str, dict[str, Callable[[], object]]] = {"picture": {}, "picture and gradient": {}}
            for shader, given in shaders.items():
                shaded = part.replace(theta=theta, shader=given)
                ways["picture"][shader] = lambda shaded=shaded: rts.render(shaded, camera, SIZE)
                ways["picture and gradient"][shader] = step_of(shaded, camera)
            row = [scene, name]
            for steps in ways.values():
                times: dict[str, list[float]] = {shader: [] for shader in steps}
                for _ in range(ROUNDS + 2):
                    for shader, step in steps.items():
                        start = time.perf_counter()
                        step()
                        times[shader].append(1e3 * (time.perf_counter() - start))
                lambert, pbr = (statistics.median(times[shader][2:]) for shader in ("lambert", "pbr"))
                row += [f"{lambert:.0f}", f"{pbr:.0f}", f"{pbr / lambert:.1f}"]
            lines.append(row)
            print(row, flush=True)
    print(
        table(
            ["scene", "light", "lambert", "pbr", "ratio", "lambert, gradient", "pbr, gradient", "ratio, gradient"],
            lines,
        )
    )


if __name__ == "__main__":
    main()
