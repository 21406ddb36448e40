"""Files of a reconstruction: the mesh as OBJ and glTF, a turntable, and the table of views."""

from __future__ import annotations

import csv
import json
import os
import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from PIL import Image
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

import rts
from rts_reconstruct.light import decoded
from rts_reconstruct.measures import Measured
from rts_reconstruct.model import Model
from rts_reconstruct.pictures import Pictures
from rts_reconstruct.texturing import seen_texels

FRAMES, FPS, TURNTABLE = 36, 12, 256
TEXTURE_FILES = ("mesh.mtl", "texture.png")


def write_mesh(folder: Path, model: Model, pictures: Pictures) -> list[Path]:
    """Write `mesh.obj`, with `mesh.mtl` and `texture.png` if there is one, and `mesh.glb`, in the data set's world.

    Earlier files of these names stay until all new ones are whole, so that a full disk leaves the last mesh.
    """
    with tempfile.TemporaryDirectory(prefix=".new-", dir=folder) as beside:
        names = _write_mesh(Path(beside), model, pictures)
        for name in names:
            os.replace(Path(beside) / name, folder / name)
    for name in TEXTURE_FILES:
        if name not in names:  # Of an earlier run, whose mesh had a texture.
            (folder / name).unlink(missing_ok=True)
    return [folder / name for name in names]


def _write_mesh(folder: Path, model: Model, pictures: Pictures) -> list[str]:
    """Write the files into an empty folder. Returns their names."""
    vertices = pictures.world.outside(model.vertices)
    colors = np.clip(model.colors, 0, 1)
    if model.atlas is None:
        (folder / "mesh.obj").write_text(_obj(vertices, model, colors), encoding="utf-8")
        linear = _bytes(decoded(colors))  # glTF's colours are linear, OBJ's are as pictures have them.
        mesh = trimesh.Trimesh(vertices, model.faces, vertex_colors=linear, process=False)
        mesh.export(folder / "mesh.glb", tree_postprocessor=_lit_already if model.light is None else None)
        return ["mesh.obj", "mesh.glb"]
    picture = Image.fromarray(_bytes(model.atlas.texture))
    picture.save(folder / "texture.png")
    (folder / "mesh.mtl").write_text(
        "newmtl surface\nKa 0 0 0\nKd 1 1 1\nKs 0 0 0\nmap_Kd texture.png\n", encoding="utf-8"
    )
    (folder / "mesh.obj").write_text(_obj(vertices, model, None), encoding="utf-8")
    # glTF has one row a vertex for both positions and map.
    rows, corners = _rows(model)
    material = PBRMaterial(baseColorTexture=picture, metallicFactor=0.0, roughnessFactor=1.0)
    visual = TextureVisuals(uv=model.atlas.uv[rows[:, 1]], material=material)
    mesh = trimesh.Trimesh(vertices[rows[:, 0]], corners, visual=visual, process=False)
    mesh.export(folder / "mesh.glb", tree_postprocessor=_lit_already if model.light is None else None)
    return ["mesh.obj", "mesh.glb", *TEXTURE_FILES]


def _lit_already(tree: dict[str, Any]) -> None:
    """Say in a glTF document that its colours have the light in them (KHR_materials_unlit)."""
    if not tree.get("materials"):
        plain: dict[str, Any] = {"pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0}}
        tree["materials"] = [plain]
        for mesh in tree["meshes"]:
            for primitive in mesh["primitives"]:
                primitive["material"] = 0
    for material in tree["materials"]:
        material.setdefault("extensions", {})["KHR_materials_unlit"] = {}
    tree["extensionsUsed"] = sorted({*tree.get("extensionsUsed", ()), "KHR_materials_unlit"})


def write_light(path: Path, model: Model) -> list[Path]:
    """Write the coefficients of the model's light, as θ["light"] has them; a model without leaves no file."""
    if model.light is None:
        path.unlink(missing_ok=True)  # Of an earlier run.
        return []
    rows = [[round(float(x), 5) for x in row] for row in model.light]
    about = (
        "theta['light'] of rts, in the world of the cameras: red, green, blue of real spherical harmonics of radiance"
    )
    path.write_text(json.dumps({"about": about, "sh": rows}, indent=1), encoding="utf-8")
    return [path]


def write_cameras(folder: Path, model: Model, pictures: Pictures) -> list[Path]:
    """Write fitted cameras, in the data set's world, as a model of COLMAP: `cameras/cameras.txt` and others."""
    moved, scale = [], np.ones((4, 4))
    scale[0, 0] = scale[1, 1] = np.exp(model.focal[0])
    for number, view, pose in zip(pictures.numbers, pictures.given, model.poses, strict=True):
        camera = view.camera.within(pictures.world.motion(np.asarray(rts.rigid(pose.astype(np.float64)))))
        camera = camera.replace(projection=camera.projection * scale, aspect=None)
        name = view.name or f"{number}.png"
        moved.append(rts.View(camera, lambda: np.zeros(0), view.size, name=name, path=view.path, lens=view.lens))
    rts.save_views(folder / "cameras", moved)
    return sorted((folder / "cameras").glob("*.txt"))


def _rows(model: Model) -> tuple[np.ndarray, np.ndarray]:
    """Pairs (M, 2) of a vertex and a row of the map, and the faces (T, 3) between them."""
    assert model.atlas is not None
    pairs = np.stack([model.faces, model.atlas.faces], axis=-1).reshape(-1, 2)
    rows, corners = np.unique(pairs, axis=0, return_inverse=True)
    return rows, corners.reshape(-1, 3)


def _obj(vertices: np.ndarray, model: Model, colors: np.ndarray | None) -> str:
    """The text of an OBJ file: positions once each, so that the surface is closed, and seams in the map alone."""
    lines = ["mtllib mesh.mtl", "usemtl surface"] if colors is None else []
    both = vertices if colors is None else np.concatenate([vertices, colors], axis=1)
    lines += ["v " + " ".join(f"{x:.7g}" for x in row) for row in both]
    if model.atlas is None:
        return "\n".join([*lines, *("f " + " ".join(map(str, face)) for face in model.faces + 1), ""])
    lines += [f"vt {u:.6f} {v:.6f}" for u, v in model.atlas.uv]
    faces = np.stack([model.faces, model.atlas.faces], axis=-1) + 1
    lines += ["f " + " ".join(f"{v}/{t}" for v, t in face) for face in faces]
    return "\n".join([*lines, ""])


def write_turntable(path: Path, model: Model, pictures: Pictures) -> None:
    """Write an animation of the model on white.

    It turns about the axis that is up in most pictures, and starts where the first camera is.
    """
    ups = np.array([np.linalg.inv(np.asarray(v.camera.view))[:3, 1] for v in pictures.views])
    up = ups.mean(axis=0)
    up = up / length if (length := np.linalg.norm(up)) > 0.2 else np.array([0.0, 1.0, 0.0])
    low, high = model.vertices.min(axis=0), model.vertices.max(axis=0)
    middle, radius = (low + high) / 2, float(np.linalg.norm(high - low) / 2)
    across = np.linalg.inv(np.asarray(pictures.views[0].camera.view))[:3, 3] - middle
    across -= (across @ up) * up
    if np.linalg.norm(across) < 0.1 * radius:  # It looks from above.
        across = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    across /= np.linalg.norm(across)
    frames = []
    for angle in 2 * np.pi * np.arange(FRAMES) / FRAMES:
        way = np.cos(angle) * across + np.sin(angle) * np.cross(up, across) + 0.4 * up
        eye = middle + 3.1 * radius * way / np.linalg.norm(way)
        camera = rts.Camera.look_at(eye, middle, up, fov_y=40)
        frame = np.asarray(rts.render(model.part, camera, (TURNTABLE, TURNTABLE), supersample=2, background=(1, 1, 1)))
        frames.append(decoded(np.clip(frame[..., :3], 0, 1)).astype(np.float32))
    rts.save_animation(path, frames, fps=FPS)


def write_table(path: Path, rows: Sequence[Measured]) -> None:
    """Write the measures of views as CSV, in the order of the data set."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["view", "name", "held_out", "psnr_db", "ssim", "iou", "camera"])
        for row in sorted(rows, key=lambda row: row.number):
            iou = "" if row.iou is None else f"{row.iou:.4f}"
            shares = f"{row.psnr:.2f}", f"{row.ssim:.4f}", iou
            writer.writerow([row.number, row.name, int(row.held_out), *shares, row.camera])


def forget_unfinished(folder: Path) -> None:
    """Remove folders of files that a run which was killed had not finished."""
    for beside in folder.glob(".new-*"):
        shutil.rmtree(beside, ignore_errors=True)


def write_unseen(path: Path, model: Model, known: np.ndarray) -> list[Path]:
    """Write a picture of the texture's size, white where no picture sees the surface; `known` (V,) tells the others."""
    assert model.atlas is not None
    picture = seen_texels(model, known, len(model.atlas.texture))
    hidden = (picture[..., 3] > 0.5) & (picture[..., 0] < 0.5)
    Image.fromarray(_bytes(hidden.astype(np.float32))).save(path)
    return [path]


def _bytes(values: np.ndarray) -> np.ndarray:
    return np.round(255 * np.clip(values, 0, 1)).astype(np.uint8)
