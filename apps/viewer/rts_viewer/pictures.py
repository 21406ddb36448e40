"""Pictures for the page: encoded, made small, and the curve of the losses."""

from __future__ import annotations

import io
import math

import numpy as np
from PIL import Image, ImageDraw, ImageFont

SIZE = (320, 160)
"""Width and height of the curve, pixels."""
MARGIN = 18
INK, PAPER, LINE = (90, 90, 90), (255, 255, 255), (20, 110, 200)


def encoded(linear: np.ndarray) -> np.ndarray:
    """Linear values (H, W, 1, 3 or 4) as sRGB uint8; alpha is kept as it is. One channel becomes three."""
    linear = np.clip(np.asarray(linear, np.float32), 0, 1)
    color = np.repeat(linear, 3, axis=-1) if linear.shape[-1] == 1 else linear[..., :3]
    bent = np.where(color <= 0.0031308, 12.92 * color, 1.055 * np.maximum(color, 1e-9) ** (1 / 2.4) - 0.055)
    return np.rint(255 * np.concatenate([bent, linear[..., 3:4]], axis=-1)).astype(np.uint8)


def png(picture: np.ndarray) -> bytes:
    """A picture (H, W, 3 or 4) uint8 as the bytes of a PNG."""
    file = io.BytesIO()
    Image.fromarray(picture).save(file, "PNG")
    return file.getvalue()


def small(image: np.ndarray, side: int) -> np.ndarray:
    """A small copy of a view's picture, on white.

    Args:
        image: (H, W, 3) linear, or (H, W, 4) premultiplied.
        side: the most pixels along a side of the copy.

    Returns:
        (h, w, 3) uint8, sRGB.
    """
    over = image[..., :3] + (1 - image[..., 3:]) if image.shape[-1] == 4 else image
    picture = Image.fromarray(encoded(over))
    picture.thumbnail((side, side))
    return np.asarray(picture)


def loss_curve(steps: np.ndarray, losses: np.ndarray) -> np.ndarray:
    """The curve of losses over steps, logarithmic where all are positive.

    Args:
        steps: (N,) numbers of steps, in ascending order.
        losses: (N,) their losses; any that are not finite are left out.

    Returns:
        (160, 320, 3) uint8.
    """
    picture = Image.new("RGB", SIZE, PAPER)
    draw = ImageDraw.Draw(picture)
    draw.font = ImageFont.load_default(12)
    finite = np.isfinite(losses)
    steps, losses = steps[finite], losses[finite]
    if len(losses) == 0:
        return np.asarray(picture)
    few = np.linspace(0, len(losses) - 1, min(len(losses), SIZE[0])).astype(int)
    positive = bool((losses > 0).all())
    heights = np.log(losses[few]) if positive else losses[few]
    x = _spread(steps[few], MARGIN, SIZE[0] - MARGIN)
    y = _spread(heights, SIZE[1] - MARGIN, MARGIN)
    points = list(zip(x.tolist(), y.tolist(), strict=True))
    if len(points) > 1:
        draw.line(points, fill=LINE, width=2)
    right, down = points[-1]
    draw.ellipse((right - 3, down - 3, right + 3, down + 3), fill=LINE)
    draw.text((4, 2), f"loss {losses.max():.3g}" + (", logarithmic" if positive else ""), fill=INK)
    draw.text((4, SIZE[1] - MARGIN + 3), f"{losses.min():.3g}", fill=INK)
    last = f"step {int(steps[-1])}"
    draw.text((SIZE[0] - 4 - math.ceil(draw.textlength(last)), SIZE[1] - MARGIN + 3), last, fill=INK)
    return np.asarray(picture)


def _spread(values: np.ndarray, first: float, last: float) -> np.ndarray:
    """Values mapped linearly, their least to `first` and their greatest to `last`; to the middle if all are equal."""
    low, high = float(values.min()), float(values.max())
    share = (values - low) / (high - low) if high > low else np.full(len(values), 0.5)
    return first + share * (last - first)
