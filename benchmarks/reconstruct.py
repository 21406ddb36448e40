"""`rts reconstruct` on pictures of known shapes: chamfer, PSNR of views that are held out, faces that meet others.

The pictures are those of `benchmarks.many_views`, 24 to fit and 8 held out, written as PNG with alpha; and Lego's
photographs, 100 to fit and 25 held out:

    python -m benchmarks.reconstruct --shapes spot bunny lego -o out/reconstruct
    python -m benchmarks.reconstruct --shapes spot --surface isosurface -o out/isosurface
    python -m benchmarks.reconstruct --shapes spot bunny --quick --light -o out/light # how far off the albedo

Needs the models of the folder that RTS_DATA names, `rts-reconstruct` (`make apps`), and, to count the faces that meet
others, pymeshlab.
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from PIL import Image

import rts
from benchmarks.many_views import chamfer, shape, subject

EVERY, EVERY_LEGO = 4, 5
"""Every so many views, one is held out."""


def written(name: str, folder: Path) -> trimesh.Trimesh:
    """Write a data set of Blender's form with pictures of a shape; returns the shape."""
    known = subject(name)
    fitted, held_out = iter(known.views), iter(known.held_out)
    views = []
    for i in range(len(known.views) + len(known.held_out)):
        view = next(held_out if i % EVERY == EVERY - 1 else fitted)
        views.append(rts.View(view.camera.for_size(view.size), view.image, name=f"{i}.png"))
        rts.save_image(folder / f"{i}.png", view.image)
    rts.save_views(folder / "transforms.json", views)
    return known.mesh


def written_lego(folder: Path) -> None:
    """Write the photographs of Lego, 400², with alpha: 100 to fit, and after every four of them one of 25 for tests."""
    data = Path(os.environ["RTS_DATA"]) / "nerf"
    known = {kind: np.load(data / f"lego_{kind}_400.npz") for kind in ("train", "test")}
    fov = float(known["train"]["camera_angle_x"])
    views = []
    for i in range(125):
        held_out = i % EVERY_LEGO == EVERY_LEGO - 1
        table, row = known["test" if held_out else "train"], i // EVERY_LEGO if held_out else i - i // EVERY_LEGO
        alpha = table["alpha"][row].astype(np.float32) / 255
        on_white = table["rgb"][row].astype(np.float32) / 255
        color = (on_white - (1 - alpha[..., None])) / np.maximum(alpha[..., None], 1e-3)
        pixels = np.concatenate([color.clip(0, 1), alpha[..., None]], axis=-1)
        folder.mkdir(parents=True, exist_ok=True)
        Image.fromarray(np.rint(255 * pixels).astype(np.uint8)).save(folder / f"{i}.png")
        turn = np.asarray(table["c2w"][row], np.float64)
        camera = rts.Camera.look_at(turn[:3, 3], turn[:3, 3] - turn[:3, 2], turn[:3, 1], fov_y=np.degrees(fov))
        views.append(rts.View(camera.for_size(alpha.shape), pixels, name=f"{i}.png"))
    rts.save_views(folder / "transforms.json", views)


def inverted(mesh: trimesh.Trimesh) -> float:
    """Percent of the faces whose outside is not outside: of winding number other than 0, as libigl has it."""
    from gpytoolbox import fast_winding_number

    points = mesh.triangles_center + 1e-3 * np.median(mesh.edges_unique_length) * mesh.face_normals
    numbers = fast_winding_number(points, np.asarray(mesh.vertices), np.asarray(mesh.faces))
    return 100 * float((np.round(numbers) != 0).mean())


def crossing(mesh: trimesh.Trimesh) -> float:
    """Percent of the faces that meet another one they do not share a corner with, as pymeshlab finds them."""
    import pymeshlab

    meshes = pymeshlab.MeshSet()
    meshes.add_mesh(pymeshlab.Mesh(np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces)))
    meshes.compute_selection_by_self_intersections_per_face()
    return 100 * meshes.current_mesh().selected_face_number() / len(mesh.faces)


def albedo_off(found: Any, name: str) -> float:
    """Percent by which the colours of a reconstruction are off a shape's albedo, in views that were held out.

    It is the mean absolute difference of linear colours over the mean of the albedo. The scale of each channel, which
    no picture tells, is that of the median.
    """
    truth = shape(name)
    theta = {**truth.theta, "vertices": found.pictures.world.inside(truth.theta["vertices"]).astype(np.float32)}
    parts = [truth.replace(theta=theta, shader="unlit"), found.model._replace(light=None).part]
    colors = []
    for view in found.pictures.held_out:
        pair = [np.asarray(rts.render(part, view.camera, view.size, splatter="none")) for part in parts]
        colors.append(np.stack([x[(pair[0][..., 3] == 1) & (pair[1][..., 3] == 1)][:, :3] for x in pair]))
    known, own = np.concatenate(colors, axis=1)
    own = np.where(own <= 0.04045, own / 12.92, ((own + 0.055) / 1.055) ** 2.4)
    own *= np.median(known, axis=0) / np.median(own, axis=0)
    return 100 * float(np.abs(own - known).mean() / known.mean())


def run(name: str, folder: Path, options: dict[str, Any]) -> None:
    """Reconstruct a shape, and print a line."""
    import rts_reconstruct

    views = folder / name / "views"
    if name == "lego":
        truth, every = written_lego(views), EVERY_LEGO
    else:
        truth, every = written(name, views), EVERY
    light = options.pop("light")
    found = rts_reconstruct.reconstruct(views, folder / name, held_out=every, **options)
    if light:
        apart = rts_reconstruct.reconstruct(views, folder / name, held_out=every, light=True, resume=True, **options)
        assert apart.model.light is not None
        print(f"{name}: albedo off by {albedo_off(found, name):.1f} % as seen, {albedo_off(apart, name):.1f} % apart;")
        print(f"the light:\n{np.round(apart.model.light, 2)}\nPSNR {apart.psnr:.1f} dB")
    vertices = found.pictures.world.outside(found.model.vertices)
    mesh = trimesh.Trimesh(vertices, found.model.faces, process=False)
    away = "" if truth is None else f", chamfer {chamfer(mesh, truth):.3f} %"
    print(f"{name}: {found}{away}, faces: crossing {crossing(mesh):.3f} %, inverted {inverted(mesh):.3f} %", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--shapes", nargs="*", default=["spot", "bunny", "lego"])
    parser.add_argument("--start", default="ball")
    parser.add_argument("--surface", default="mesh")
    parser.add_argument("--light", action="store_true")
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("-o", "--output", type=Path, default=Path("out/reconstruct"))
    options = parser.parse_args()
    for each in options.shapes:
        run(each, options.output, {name: getattr(options, name) for name in ("start", "surface", "light", "quick")})
