"""The toy airplane and its photograph: the scene of the fits, its unknowns, and where they start.

Neither the camera nor the light of the photograph is known, and the colours of scan and photograph differ: wings are
teal in one and blue in the other, and the propeller stands in another position. So the colours of the scan pass through
a matrix that is fitted along, and the loss is robust.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

import rts
from benchmarks.meshes import DATA, normalised
from rts.arrays.engines import engine_named
from rts.shading.shaders import Lambert

FOLDER = DATA / "ycb_airplane"
DISTANCE, FOV = 3.0, 32.0
"""From the camera to where poses are about, and the vertical field of view at the start, degrees."""
POSE = np.array([-0.39, -0.68, -2.21, 0.0, 0.2, 0.0])
"""Rotation vector and shift of the airplane in the photograph, roughly, from a search: what starts are off from."""
TURNED, SHIFTED, ZOOMED = np.radians(15.0), 0.15, 0.15
"""How far off starts are: an angle, a length (the airplane's radius is 1), and the logarithm of the field of view."""
AMBIENT = 0.5
TEXELS = 256
LOSS = rts.Loss("soft_l1", f_scale=0.1)
"""The robust loss of differences of linear colours."""


@dataclass(frozen=True)
class Recolored(Lambert):
    """Diffuse shading of a texture whose colours pass through the matrix θ["matrix"] (3, 3)."""

    takes_views = False
    reads = ("normal", "uv", "texture", "light", "matrix")

    def base_color(self, theta: Any, gbuffer: Any, *options: Any) -> Any:
        """See `rts.shading.shaders.Unlit`."""
        color, alpha = super().base_color(theta, gbuffer, *options)
        return color @ theta["matrix"].T, alpha


@cache
def photograph(factor: int) -> np.ndarray:
    """The photograph, linear, (632 / factor, 755 / factor, 3) float32: means over blocks of pixels."""
    if not (FOLDER / "photo.png").exists():
        raise SystemExit(f"{FOLDER} is missing; set RTS_DATA to the folder of the test data")
    image = np.asarray(rts.load_image(FOLDER / "photo.png"), np.float32)[..., :3]
    rows, columns = (n // factor for n in image.shape[:2])
    return image[: rows * factor, : columns * factor].reshape(rows, factor, columns, factor, 3).mean((1, 3))


def outline(factor: int) -> np.ndarray:
    """True (H, W) where the photograph shows the airplane: it is colourful or dark, the table is neither."""
    image = photograph(factor)
    return (image.max(-1) - image.min(-1) > 0.15) | (image.max(-1) < 0.25)


@cache
def airplane() -> tuple[Any, dict[str, np.ndarray]]:
    """The surface of the scan, and its θ: vertices about the centre, the farthest at distance 1; uv; texture."""
    (part,) = rts.load(FOLDER / "textured.obj")
    theta = {name: np.asarray(x) for name, x in part.theta.items()}
    texture = theta["texture"][..., :3]
    block = len(texture) // TEXELS
    texture = texture.reshape(TEXELS, block, TEXELS, block, 3).mean((1, 3))
    theta |= {"vertices": normalised(theta["vertices"].astype(np.float64)), "texture": texture}
    return part.surface, {
        name: theta[name].astype(np.float32) for name in ("vertices", "uv", "texture") if name in theta
    }


def start(seed: int) -> dict[str, np.ndarray]:
    """The unknowns to start from; pose and field of view of a seed are off by chance, the rest is neutral."""
    rng = np.random.default_rng(seed)
    turn, shift = rng.normal(size=(2, 3))
    off = np.concatenate([TURNED * turn / np.linalg.norm(turn), SHIFTED * shift / np.linalg.norm(shift)])
    return {
        "pose": POSE + off,
        "zoom": np.array([ZOOMED * rng.choice([-1.0, 1.0])]),
        "background": np.full(3, 0.5),
        "direction": np.array([0.3, 1.0, 0.6]),
        "brightness": np.array([0.5]),
        "matrix": np.eye(3),
    }


def scene(unknowns: dict[str, Any]) -> tuple[rts.Part, rts.Camera]:
    """The airplane and the camera, for unknowns of any engine."""
    surface, known = airplane()
    xp = rts.namespace(unknowns["pose"])
    light = {
        "ambient": np.full(3, AMBIENT, np.float32),
        "direction": unknowns["direction"],
        "color": xp.concat([unknowns["brightness"]] * 3),
    }
    theta = known | {"light": light, "matrix": unknowns["matrix"]}
    fov = FOV * xp.exp(unknowns["zoom"][0])
    camera = rts.Camera.look_at((0, 0, DISTANCE), (0, 0, 0), fov_y=fov, near=0.2, far=100.0)
    return rts.Part(surface, theta, Recolored(), rts.rigid(unknowns["pose"]), cull="back"), camera


def image(unknowns: dict[str, Any], size: tuple[int, int], **options: Any) -> Any:
    """The airplane over the colour of the background (H, W, 3), and its coverage (H, W)."""
    found = rts.render(*scene(unknowns), size, **options)
    return found[..., :3] + (1 - found[..., 3:]) * unknowns["background"], found[..., 3]


def residuals(engine: str, factor: int, splatter: str, layers: int) -> Callable[[dict[str, Any]], Any]:
    """The difference of images from the photograph, as a function of the unknowns."""
    target = engine_named(engine).constant(photograph(factor))
    size = photograph(factor).shape[:2]
    return lambda unknowns: image(unknowns, size, splatter=splatter, layers=layers)[0] - target


def arrays(engine: str, unknowns: dict[str, np.ndarray]) -> dict[str, Any]:
    """The unknowns as float32 of an engine."""
    return {name: engine_named(engine).constant(x.astype(np.float32)) for name, x in unknowns.items()}
