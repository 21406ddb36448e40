"""Several views of one scene: a loop of `rts.render` against `rts.render_views`, in turns.

Eight views of a mesh: images alone with NumPy, torch and jax; gradients in vertices or in the pose with torch and jax.
Times are those of the processor.

    python -m benchmarks.speed.views
"""

from __future__ import annotations

import argparse
import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import rts
from benchmarks.meshes import kept_mesh
from benchmarks.report import table
from benchmarks.timing import in_turn

VIEWS = 8
KINDS = {
    "numpy": "images",
    "torch": "images",
    "torch pose": "gradient in the pose",
    "torch vertices": "gradient in the vertices",
    "jax jit pose": "gradient in the pose, compiled",
    "jax jit vertices": "gradient in the vertices, compiled",
    "jax vertices": "gradient in the vertices, as it is",
    "jax each pose": "gradient in the pose, the loop's of a view compiled",
    "jax each vertices": "gradient in the vertices, the loop's of a view compiled",
}


@functools.cache
def cameras() -> list[rts.Camera]:
    """Cameras around the middle."""
    angles = 2 * np.pi * np.arange(VIEWS) / VIEWS
    eyes = [(2.9 * np.sin(a), 0.8, 2.9 * np.cos(a)) for a in angles]
    return [rts.Camera.look_at(eye, (0, 0, 0), fov_y=45) for eye in eyes]


def images(parts: Any, side: int, together: bool) -> Any:
    """The views (B, side, side, 4)."""
    size = side, side
    if together:
        return rts.render_views(parts, cameras(), size)
    found = [rts.render(parts, camera, size) for camera in cameras()]
    return rts.namespace(*found).stack(found)


def call_of(kind: str, part: rts.Part, side: int, together: bool) -> Callable[[], object]:
    """The timed function: images, or the gradient of a weighted sum of them."""
    weights = np.random.default_rng(0).normal(size=(VIEWS, side, side, 4)).astype(np.float32)
    engine, *what = kind.split()
    if engine == "numpy":
        return lambda: images(part, side, together)
    if engine == "torch":
        import torch

        vertices, w = torch.tensor(part.theta["vertices"]), torch.tensor(weights)
        pose = torch.zeros(6)

        def of_torch() -> object:
            moved, leaf = _moved(part, vertices, pose, what, lambda x: x.clone().requires_grad_(bool(what)))
            found = images(moved, side, together)
            return torch.autograd.grad((found * w).sum(), leaf)[0] if what else found

        return of_torch
    import jax

    vertices, w = jax.numpy.asarray(part.theta["vertices"]), jax.numpy.asarray(weights)
    pose = jax.numpy.zeros(6)

    def loss(x: Any) -> Any:
        moved, _ = _moved(part, vertices if what[-1] == "pose" else x, x, what, lambda x: x)
        return (images(moved, side, together) * w).sum()

    at = pose if what[-1] == "pose" else vertices
    if what[0] == "each" and not together:

        def of_view(x: Any, camera: rts.Camera, w: Any) -> Any:
            moved, _ = _moved(part, vertices if what[-1] == "pose" else x, x, what, lambda x: x)
            return (rts.render(moved, camera, (side, side)) * w).sum()

        one = jax.jit(jax.grad(of_view))
        return lambda: jax.block_until_ready(sum(one(at, *view) for view in zip(cameras(), w, strict=True)))
    gradient = jax.grad(loss)
    gradient = jax.jit(gradient) if what[0] in ("jit", "each") else gradient
    return lambda: gradient(at).block_until_ready()


def _moved(part: rts.Part, vertices: Any, pose: Any, what: list[str], leaf: Callable) -> tuple[rts.Part, Any]:
    """The part with what is differentiated, and that."""
    if what and what[-1] == "pose":
        x = leaf(pose)
        return part.replace(transform=rts.rigid(x)), x
    x = leaf(vertices)
    return part.replace(theta={**part.theta, "vertices": x}), x


def part_of(mesh: tuple[np.ndarray, np.ndarray], shader: str) -> rts.Part:
    """A mesh with one of the built-in shaders."""
    return rts.Part(rts.Mesh(mesh[1]), {"vertices": np.asarray(mesh[0], np.float32)}, shader)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=Path("out/speed"), help="where meshes are kept")
    parser.add_argument("--side", type=int, default=128, help="of each view, pixels")
    parser.add_argument("--meshes", nargs="+", default=["teapot", "bunny"])
    parser.add_argument("--shaders", nargs="+", default=["silhouette", "lambert"])
    parser.add_argument("--kinds", nargs="+", default=list(KINDS), choices=list(KINDS))
    parser.add_argument("--rounds", type=int, default=7)
    args = parser.parse_args()
    lines = []
    for name in args.meshes:
        for shader in args.shaders:
            part = part_of(kept_mesh(name, args.output / "meshes"), shader)
            for kind in args.kinds:
                calls = {str(t): call_of(kind, part, args.side, t) for t in (False, True)}
                loop, views = (x["cpu"] for x in in_turn(calls, args.rounds).values())
                lines.append((f"{name}, {shader}", kind, f"{loop:.1f}", f"{views:.1f}", f"{loop / views:.2f}"))
                print(*lines[-1], sep=" | ", flush=True)
    print(table(("scene", "what", "loop [CPU ms]", "views [CPU ms]", "ratio"), lines))


if __name__ == "__main__":
    main()
