"""rts.show: pictures in notebooks, of images, parts and fits."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from rts.arrays.array_functions import is_finite
from rts.arrays.engines import value_of
from rts.arrays.trees import Array, map_leaves
from rts.errors import InputError, PluginError
from rts.files.images import pixels_of, png_of
from rts.fitting.fit import Fit
from rts.rendering.image import render
from rts.sampling.prepared import Prepared
from rts.scene.default_camera import default_camera
from rts.scene.parts import Part

SIZE = (320, 320)
"""Pixels of a picture of parts."""


@dataclass(frozen=True, repr=False)
class Shown:
    """A picture that Jupyter, and whatever else asks for `_repr_png_`, displays.

    Attributes:
        png: the bytes of the PNG.
    """

    png: bytes

    def _repr_png_(self) -> bytes:
        return self.png

    def __repr__(self) -> str:
        return f"Shown({len(self.png)} bytes of PNG, which a notebook displays)"


def show(thing: Array | Part | Sequence[Part] | Prepared | Fit, over: Array | None = None) -> Shown:
    """Make a picture for a notebook: as the last line of a cell, it is displayed.

    Args:
        thing: an image of `render`, (H, W), (H, W, 1), (H, W, 3) or (H, W, 4), an array of any engine, as `save_image`
            writes it; without alpha, numbers beyond [0, 1], such as depths and normals, are scaled to that range. Or a
            part, parts or the result of `prepare`: one frame of 320 × 320 pixels, by a camera that sees all. Or the
            result of `fit`: its losses, a line for each stage.
        over: (H, W, 3) or (H, W, 4), the picture that an image (H, W, 4) is fitted to: the image is laid over it, half
            transparent, so that one sees where outlines differ.

    Raises:
        InputError: the thing is none of these, or is traced, or there is something to lay it over, and it is no image
            of the same size.
        PluginError: losses without matplotlib.
    """
    if over is not None:
        return Shown(png_of(_laid_over(thing, over)))
    if isinstance(thing, Fit):
        return Shown(losses_png(thing.history, thing.stages))
    if isinstance(thing, Prepared):
        thing = thing.parts
    if isinstance(thing, Part):
        thing = [thing]
    if isinstance(thing, (list, tuple)) and thing and all(isinstance(part, Part) for part in thing):
        parts = [_on_the_host(part) for part in thing]
        return Shown(png_of(render(parts, default_camera(parts, SIZE), SIZE)))
    if not hasattr(thing, "shape"):
        raise InputError(f"{type(thing).__name__} cannot be shown; expected an image, parts, or the result of rts.fit")
    return Shown(png_of(_in_range(thing)))


def _laid_over(image: Any, picture: Any) -> Array:
    """A premultiplied image (H, W, 4), half transparent, over a picture of the same size."""
    image, picture = pixels_of(image, "the image"), pixels_of(picture, "the picture that it is laid over")
    if image.shape[2:] != (4,) or picture.shape[2:] not in ((3,), (4,)) or image.shape[:2] != picture.shape[:2]:
        raise InputError(
            f"an image {image.shape} over a picture {picture.shape}; expected (H, W, 4) over (H, W, 3 or 4)"
        )
    channels = picture.shape[2]
    return image[..., :channels] / 2 + picture * (1 - image[..., 3:] / 2)


def _on_the_host(part: Part) -> Part:
    """The part with NumPy arrays alone."""

    def host(x: Any) -> np.ndarray:
        value = value_of(x)
        if value is None:
            raise InputError("the part holds traced arrays; show it outside of jit and vmap")
        return value

    transform = None if part.transform is None else host(part.transform)
    return part.replace(theta=map_leaves(host, part.theta), transform=transform)


def _in_range(image: Array) -> Array:
    """The image; one without alpha, scaled to [0, 1] if numbers are beyond."""
    value = value_of(image)
    numbers = value is not None and value.dtype.kind in "fib" and value.size > 0  # Not bytes, which are encoded.
    if value is None or not numbers or value.shape[2:] == (4,) or not is_finite(value):
        return image  # `png_of` refuses what is wrong.
    least, largest = min(value.min(), 0), max(value.max(), 1)
    return (value - least) / (largest - least)


def losses_png(history: Sequence[float], stages: Sequence[int]) -> bytes:
    """A PNG of losses over the steps, a line for each stage: losses of two stages are of different images.

    Args:
        history: the losses of all stages, one after the other.
        stages: the number of losses of each.

    Raises:
        PluginError: matplotlib is missing.
    """
    try:
        from matplotlib.figure import Figure
    except ModuleNotFoundError:
        raise PluginError("a plot of losses needs matplotlib: pip install 'rasterize-then-splat[plots]'") from None
    figure = Figure(figsize=(6, 3.5), layout="constrained")
    axes = figure.subplots()
    first = 0
    for number, count in enumerate(stages):
        steps, losses = range(first, first + count), history[first : first + count]
        axes.semilogy(steps, losses, ".-", linewidth=1, markersize=4, label=f"stage {number + 1}")
        first += count
    axes.set(xlabel="step", ylabel="loss")
    axes.grid(alpha=0.3)
    if len(stages) > 1:
        axes.legend(frameon=False, fontsize=8)
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=100)
    return file.getvalue()
