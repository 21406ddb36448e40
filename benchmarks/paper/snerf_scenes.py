"""Scenes for refining radiance fields: pretrained networks, posed photographs, and the lattices of their surfaces."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

import rts
from benchmarks.meshes import DATA
from rts_surfaces.radiance_field.projected import Projected

THRESHOLD = 50.0
"""Density of the isosurface."""
LEGO = ((-0.705, -1.18, -0.53), (0.705, 1.18, 1.07)), (77, 128, 87)
FERN = ((-1.5, -1.35, -0.6), (1.5, 1.35, 0.98)), (161, 145, 128)
"""Bounds and shapes of lattices."""
SHOWN = (0, 5, 12)
"""Test views 0, 40 and 96 of lego, by number."""


class Shot(NamedTuple):
    """A posed photograph: camera of the whole image, image (H, W, 3) float32 or uint8 as it is encoded, and a name."""

    camera: rts.Camera
    image: np.ndarray
    name: str

    @property
    def size(self) -> tuple[int, int]:
        """(height, width)."""
        return self.image.shape[0], self.image.shape[1]

    def truth(self) -> np.ndarray:
        """The image as float32, from 0 to 1."""
        return real(self.image)


class Scene(NamedTuple):
    """A radiance field to be refined, and its photographs.

    Attributes:
        field: the radiance field.
        train: photographs to refine by.
        tests: photographs held out, by the number of pixels on their longer side.
        bounds: of the lattice, in the field's space.
        shape: of the lattice.
        ndc: the map from the world to the field's space, or None.
        background: what is behind.
        splatter: that of its images: "edges", "centers" (`edges` with colours of centres) or "multi".
    """

    field: Any
    train: Sequence[Shot]
    tests: Mapping[str, Sequence[Shot]]
    bounds: Any
    shape: tuple[int, int, int]
    ndc: rts.Ndc | None
    background: str
    splatter: str = "edges"

    def surface(self) -> Any:
        """The isosurface of a grid, in the world."""
        isovalue = math.log1p(THRESHOLD)
        found = rts.plugin("surfaces", "isosurface")(self.bounds, isovalue, inside="above", at_bounds="open")
        return found if self.ndc is None else Projected(found, self.ndc)

    def grid(self, keep: Any) -> np.ndarray:
        """The grid that refinement starts from, (X, Y, Z) float32."""
        return np.log1p(self.field.lattice(self.bounds, self.shape, keep=keep))

    def part(self, values: Any, weights: Any, shader: Any = None) -> rts.Part:
        """The surface light field of a grid and a network."""
        shader = shader or rts.plugin("shaders", "radiance")(ndc=self.ndc)
        return rts.Part(self.surface(), {"values": values, "weights": weights}, shader)

    def behind(self) -> np.ndarray:
        """The background as a colour."""
        return np.full(3, float(self.background == "white"), np.float32)


def lego(sides: Sequence[int] = (100, 400), fineness: float = 1.0, finest: int = 400) -> Scene:
    """Lego: photographs of `finest`² pixels to refine by, and some of each of the sides held out.

    Args:
        sides: 100, 200 or 400; means of pixels of 400².
        fineness: of the lattice.
        finest: likewise, of the photographs to refine by.
    """
    train = _lego("train", finest)
    tests = {str(side): _lego("test", side) for side in sides}
    tests = {side: [shots[i] for i in SHOWN] if int(side) > 100 else shots for side, shots in tests.items()}
    field = rts.load_radiance_field(DATA / "nerf/lego_lowres.npz")
    return Scene(field, train, tests, LEGO[0], _finer(LEGO[1], fineness), None, "white")


def _lego(split: str, side: int) -> list[Shot]:
    found, factor = np.load(DATA / f"nerf/lego_{split}_400.npz"), 400 // side
    focal, shots = float(found["focal"]), []
    for image, pose, index in zip(found["rgb"], found["c2w"], found["index"], strict=True):
        if factor > 1:
            image = (image / 255).reshape(side, factor, side, factor, 3).mean(axis=(1, 3)).astype(np.float32)
        shots.append(Shot(_camera(pose, (side, side), focal, factor), image, str(index)))
    return shots


def fern(factor: int = 3, fineness: float = 1.0) -> Scene:
    """Fern, with photographs of 378 × 504 pixels over a factor; every eighth is held out."""
    found = np.load(DATA / "nerf/fern_images_378.npz")
    height, width, focal = (float(x) for x in found["hwf"])
    size = int(height) // factor, int(width) // factor
    train, test = [], []
    for i, (image, pose) in enumerate(zip(found["rgb"], found["c2w"], strict=True)):
        image = (image.astype(np.float32) / 255).reshape(size[0], factor, size[1], factor, 3).mean(axis=(1, 3))
        shot = Shot(_camera(pose, size, focal, factor), image, str(i))
        (test if i in found["test_index"] else train).append(shot)
    ndc = rts.Ndc.of_images((int(height), int(width)), focal)
    field = rts.load_radiance_field(DATA / "nerf/fern_lowres.npz")
    return Scene(field, train, {str(size[1]): test}, FERN[0], _finer(FERN[1], fineness), ndc, "black")


def real(image: np.ndarray) -> np.ndarray:
    """An image as float32, from 0 to 1."""
    return image.astype(np.float32) / 255 if image.dtype == np.uint8 else image


def _camera(pose: np.ndarray, size: tuple[int, int], focal: float, factor: int) -> rts.Camera:
    """The camera of means of factor² pixels: the fields were trained on rays through pixels' upper left corners."""
    shift: Any = (factor - 1) / (2 * factor) - 0.5  # A window may lie between pixels.
    return rts.Camera.from_blender(pose, size, focal=focal / factor).window(size, (shift, shift), size)


def _finer(shape: tuple[int, int, int], fineness: float) -> Any:
    return tuple(max(2, round((n - 1) * fineness) + 1) for n in shape)
