"""`rts reconstruct` on pictures of known shapes: chamfer, PSNR of views that are held out, faces that meet others.

The pictures are those of `benchmarks.many_views`, 24 to fit and 8 held out, written as PNG with alpha:

    python -m benchmarks.reconstruct --shapes spot bunny -o out/reconstruct

Needs the models of the folder that RTS_DATA names, `rts-reconstruct` (`make apps`), and, to count the faces that meet
others, pymeshlab.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import trimesh

import rts
from benchmarks.many_views import chamfer, subject

EVERY = 4
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


def crossing(mesh: trimesh.Trimesh) -> float:
    """Percent of the faces that meet another one they do not share a corner with, as pymeshlab finds them."""
    import pymeshlab

    meshes = pymeshlab.MeshSet()
    meshes.add_mesh(pymeshlab.Mesh(np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces)))
    meshes.compute_selection_by_self_intersections_per_face()
    return 100 * meshes.current_mesh().selected_face_number() / len(mesh.faces)


def run(name: str, folder: Path) -> None:
    """Reconstruct a shape, and print a line."""
    import rts_reconstruct

    truth = written(name, folder / name / "views")
    found = rts_reconstruct.reconstruct(folder / name / "views", folder / name, held_out=EVERY)
    vertices = found.pictures.world.outside(found.model.vertices)
    mesh = trimesh.Trimesh(vertices, found.model.faces, process=False)
    print(f"{name}: {found}, chamfer {chamfer(mesh, truth):.3f} %, crossing faces {crossing(mesh):.3f} %", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--shapes", nargs="*", default=["spot", "bunny"])
    parser.add_argument("-o", "--output", type=Path, default=Path("out/reconstruct"))
    options = parser.parse_args()
    for shape in options.shapes:
        run(shape, options.output)
