"""How long an iteration takes by `rts_nvdiffrast`, on programs like nvdiffrast's samples and on a mesh of 70,000 faces.

Processor time of one thread, so that other jobs beside it count little; medians.

    python -m benchmarks.nvdiffrast_times          # adds to results/nvdiffrast.json
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable

import numpy as np
import torch
import trimesh

from benchmarks import nvdiffrast as fits

REPEATS = 9


def ball(rows: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Vertices, faces and uv of a sphere of 4 · rows² triangles, with a seam."""
    v, u = np.meshgrid(np.linspace(0, 1, rows + 1), np.linspace(0, 1, 2 * rows + 1), indexing="ij")
    up, around = np.pi * (v - 0.5), 2 * np.pi * u
    points = np.stack([np.cos(up) * np.sin(around), np.sin(up), np.cos(up) * np.cos(around)], axis=-1)
    corner = np.arange(v.size).reshape(v.shape)
    a, b, c, d = corner[:-1, :-1], corner[:-1, 1:], corner[1:, 1:], corner[1:, :-1]
    faces = np.stack([a, b, c, a, c, d], axis=-1).reshape(-1, 3)
    arrays = points.reshape(-1, 3), faces, np.stack([u, v], axis=-1).reshape(-1, 2)
    points, faces, uv = (torch.tensor(x) for x in arrays)
    return points.float(), faces.int(), uv.float()


def turned(points: torch.Tensor, step: int) -> torch.Tensor:
    """Clip space (1, V, 4) of points, turned a little more at each step."""
    turn = fits.Rotation.from_rotvec([0.3, 0.1 * step, 0.2]).as_matrix()
    return fits.clip(points, fits.modelview(torch.tensor(turn, dtype=torch.float32)))


def iterations() -> dict[str, Callable[[int], None]]:
    """Name → one iteration, given its number."""
    import rts_nvdiffrast.torch as dr

    context = dr.RasterizeCudaContext()
    points, faces, uv = ball(24)
    many, fine, _ = ball(132)
    wide = torch.tensor([9 / 16, 1.0, 1.0, 1.0])
    texture = torch.rand((1, 512, 1024, 3), requires_grad=True)
    environment = torch.rand((1, 6, 128, 128, 3), requires_grad=True)
    module = fits.by_module()

    def small(size: int) -> Callable[[int], None]:
        corners, colors = torch.tensor(fits.CORNERS, requires_grad=True), torch.rand(24, 3)

        def step(number):
            turn = torch.tensor(fits.Rotation.from_rotvec([0.3, 0.1 * number, 0]).as_matrix(), dtype=torch.float32)
            module(corners, colors, fits.SIDES, fits.modelview(turn), size).square().mean().backward()

        return step

    def textured(number):
        rast, db = dr.rasterize(context, turned(points, number), faces, (512, 512))
        st, changes = dr.interpolate(uv, rast, faces, db, "all")
        dr.texture(texture, st, changes, filter_mode="linear-mipmap-linear").square().mean().backward()

    def reflected(number):
        rast, db = dr.rasterize(context, turned(points, number), faces, (512, 512))
        way, changes = dr.interpolate(points, rast, faces, db, "all")
        options = {"filter_mode": "linear-mipmap-linear", "boundary_mode": "cube"}
        dr.texture(environment, way, changes, **options).square().mean().backward()

    def forward(number):
        dr.rasterize(context, wide * turned(many, number), fine, (540, 960))

    def silhouette(number):
        vertices = many.clone().requires_grad_()
        pos = wide * turned(vertices, number)
        rast, _ = dr.rasterize(context, pos, fine, (540, 960))
        depth, _ = dr.interpolate(pos[..., 3:], rast, fine)
        mask = dr.antialias((rast[..., 3:] > 0).float(), rast, pos, fine)
        (mask.mean() + depth.mean()).backward()

    def antialiased(views: int) -> Callable[[int], None]:
        """`antialias` alone of a sphere of 1,280 faces in images of 256 × 256 pixels, forwards and backwards."""
        sphere = trimesh.creation.icosphere(3)
        vertices, faces = torch.tensor(np.array(sphere.vertices)).float(), torch.tensor(np.array(sphere.faces)).int()
        pos = torch.cat([turned(vertices, view) for view in range(views)]).requires_grad_()
        rast, _ = dr.rasterize(context, pos, faces, (256, 256))
        rast, color = rast.detach(), torch.rand((views, 256, 256, 3), requires_grad=True)

        def step(number):
            dr.antialias(color, rast, pos, faces).square().mean().backward()

        return step

    return {
        "antialias alone, sphere of 1,280 faces, 256²": antialiased(1),
        "antialias alone, 16 views of it": antialiased(16),
        "cube, 16²": small(16),
        "cube, 256²": small(256),
        "sphere with a texture of 512 × 1024 and mipmaps, 512²": textured,
        "sphere in an environment of 6 × 128² with mipmaps, 512²": reflected,
        "70,000 triangles, 540 × 960: rasterize": forward,
        "70,000 triangles, 540 × 960: rasterize, depth, mask, antialias, backward": silhouette,
    }


def main() -> None:
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    torch.set_num_threads(1)
    for name, step in iterations().items():
        step(0)
        times = []
        for number in range(REPEATS):
            start = time.process_time()
            step(number + 1)
            times.append(1e3 * (time.process_time() - start))
        fits.keep("time", name, round(statistics.median(times), 1))


if __name__ == "__main__":
    main()
