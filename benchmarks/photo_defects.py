"""Spot by `rts reconstruct` from pictures with the defects of photographs, each alone and all together.

    python -m benchmarks.photo_defects
    python -m benchmarks.photo_defects --defects exposure all -o out/defects

24 pictures of 256², all fitted, with `--quick` and without a texture. A shadow is a blurred half of the picture that
is 30 % darker; exposures are ±15 % of linear light; cameras are turned by .5° about themselves; focal lengths are 1 %
too long; a lens distorts by k1 = -.1, of which cameras tell nothing; masks are those of the object, displaced at
random, smoothly, by up to a seventh of the picture, which leaves a mean overlap of some .85. Pictures with masks, and
those kept as JPEG, are opaque and show something behind; the others have alpha. "All" are all but the lens. Chamfer
as the mesh lies, and once it is moved, turned and scaled onto the truth, which pictures do not tell. Needs the models
of the folder that RTS_DATA names, and `rts-reconstruct`.
"""

from __future__ import annotations

import argparse
import io
from pathlib import Path

import numpy as np
import scipy.ndimage
import trimesh
from PIL import Image

import rts
from benchmarks.many_views import chamfer, subject

EXPOSURE, SHADE, TURN, FOCAL, DISTORTION = 0.15, 0.3, 0.5, 0.01, -0.1
SHIFT, WIDTH = 55, 24
"""Pixels by which masks are displaced, and the width of the Gaussian that makes displacements smooth."""
ALONE = ("exposure", "jpeg", "shadow", "cameras", "focal", "masks")
FITTED = ("cameras", "focal")
"""Defects for which cameras are fitted, too."""


def taken(view: rts.View, number: int, defects: tuple[str, ...], rng: np.random.Generator) -> rts.View:
    """A view as a photograph with defects shows it."""
    image, camera = np.array(view.image), view.camera.for_size(view.size)
    colors = image[..., :3] / np.maximum(image[..., 3:], 1e-3)
    alpha = image[..., 3]
    if "shadow" in defects:
        way, (y, x) = rng.uniform(0, 2 * np.pi), np.mgrid[:256, :256] - 127.5
        colors = colors * (1 - SHADE / (1 + np.exp(-(np.cos(way) * x + np.sin(way) * y) / 8)))[..., None]
    if "exposure" in defects:
        linear = np.where(colors <= 0.04045, colors / 12.92, ((colors + 0.055) / 1.055) ** 2.4)
        linear = np.clip(linear * (1 + rng.uniform(-EXPOSURE, EXPOSURE)), 0, 1)
        colors = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055)
    before = bool({"jpeg", "masks"} & set(defects))
    if before:
        behind = scipy.ndimage.gaussian_filter(rng.random((256, 256, 3)), (6, 6, 0)) * 4 - 1.5
        colors = np.clip(alpha[..., None] * colors + (1 - alpha[..., None]) * behind, 0, 1)
    if "jpeg" in defects:
        buffer = io.BytesIO()
        Image.fromarray(np.uint8(255 * colors)).save(buffer, "JPEG", quality=70)
        colors = np.asarray(Image.open(buffer), np.float32) / 255
    if "masks" in defects:
        way = [SHIFT * WIDTH * scipy.ndimage.gaussian_filter(rng.normal(size=(256, 256)), WIDTH) / 3 for _ in range(2)]
        alpha = scipy.ndimage.map_coordinates(alpha, np.mgrid[:256, :256] + way, order=1, mode="nearest")
    if "cameras" in defects:
        axis = rng.normal(size=3)
        turn = np.radians(TURN) * axis / np.linalg.norm(axis)
        change = np.asarray(rts.rigid(np.concatenate([turn, np.zeros(3)])))
        camera = camera.replace(view=change @ camera.view)
    if "focal" in defects:
        scale = np.diag([1 + FOCAL, 1 + FOCAL, 1, 1])
        camera = camera.replace(projection=camera.projection @ scale, aspect=None)
    if "lens" in defects:
        colors, alpha = bent(colors * alpha[..., None], camera), bent(alpha, camera)
        colors = colors / np.maximum(alpha[..., None], 1e-3)
    name = f"{number}.png"
    if before:
        return rts.View(camera, colors.astype(np.float32), view.size, name=name, mask=alpha.astype(np.float32))
    picture = np.concatenate([colors * alpha[..., None], alpha[..., None]], axis=2).astype(np.float32)
    return rts.View(camera, picture, view.size, name=name)


def bent(picture: np.ndarray, camera: rts.Camera) -> np.ndarray:
    """A picture (H, W, ...) as a lens whose radial coefficient is `DISTORTION` takes it."""
    height, width = picture.shape[:2]
    y, x = np.mgrid[:height, :width] + 0.5 - np.array([height, width])[:, None, None] / 2
    r = np.hypot(x, y) * 2 / (height * camera.for_size((height, width)).projection[1, 1])
    straight = r
    for _ in range(20):  # r = straight (1 + DISTORTION straight²)
        straight = r / (1 + DISTORTION * straight**2)
    scale = straight / np.maximum(r, 1e-9)
    places = [height / 2 - 0.5 + y * scale, width / 2 - 0.5 + x * scale]
    channels = picture.reshape(height, width, -1)
    found = [scipy.ndimage.map_coordinates(channels[..., i], places, order=1) for i in range(channels.shape[2])]
    return np.stack(found, axis=-1).reshape(picture.shape)


def onto(mesh: trimesh.Trimesh, truth: trimesh.Trimesh) -> trimesh.Trimesh:
    """The mesh, moved, turned and scaled onto the truth by iterated closest points."""
    points, _ = trimesh.sample.sample_surface(mesh, 5000, seed=0)
    matrix, _, _ = trimesh.registration.icp(points, truth, scale=True, reflection=False, max_iterations=50)
    return mesh.copy().apply_transform(matrix)


def run(defects: tuple[str, ...], fit: bool, folder: Path) -> None:
    """Reconstruct spot from pictures with defects, and print a line."""
    import rts_reconstruct

    known, rng = subject("spot"), np.random.default_rng(0)
    views = [taken(view, i, defects, rng) for i, view in enumerate(known.views)]
    alphas = [v.image[..., 3] if v.mask is None else v.mask for v in views]
    both = [(alpha > 0.5, view.image[..., 3] > 0.5) for alpha, view in zip(alphas, known.views, strict=True)]
    overlap = np.mean([(a & b).sum() / (a | b).sum() for a, b in both])
    found = rts_reconstruct.reconstruct(
        views, folder, quick=True, texture=0, held_out=0, fit_cameras=fit, progress=False
    )
    mesh = trimesh.Trimesh(found.pictures.world.outside(found.model.vertices), found.model.faces, process=False)
    away = chamfer(mesh, known.mesh), chamfer(onto(mesh, known.mesh), known.mesh)
    fitted = f", cameras fitted, focal × {np.exp(found.model.focal[0]):.4f}" if fit else ""
    print(
        f"{' '.join(defects) or 'none'}{fitted}: masks {overlap:.3f}, chamfer {away[0]:.3f} %, aligned "
        f"{away[1]:.3f} %; {found}; {found.verdict}",
        flush=True,
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--defects", nargs="*", default=["none", *ALONE, "lens", "all"])
    parser.add_argument("--fit-cameras", action="store_true", help="with all defects, too, that have them")
    parser.add_argument("-o", "--output", type=Path, default=Path("out/defects"))
    options = parser.parse_args()
    for name in options.defects:
        kinds = ALONE if name == "all" else tuple(name.split("+")) if name != "none" else ()
        run(kinds, options.fit_cameras and bool(set(kinds) & set(FITTED)), options.output / name)
