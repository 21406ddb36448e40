"""Bump maps of MTL, which hold heights, as normal maps."""

from __future__ import annotations

import numpy as np

LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)
"""Red, green and blue in the height of a coloured pixel; MTL takes the luminance, unless `-imfchan` says otherwise."""


def normals_of_heights(pixels: np.ndarray, multiplier: float) -> np.ndarray:
    """Unit normals (h, w, 3) float32 of a map of heights, as θ["normal_map"] has them.

    White is `multiplier` texels higher than black. A normal is (−∂h/∂x, −∂h/∂y, 1), made unit, where x and y count
    texels along u and v. Slopes are central differences, and heights repeat beyond the borders. MTL gives heights no
    unit; the texel is that of Godot's `Image.bump_map_to_normal_map`. So the result depends on the picture alone.

    Args:
        pixels: (h, w, 3) in [0, 1] as encoded: heights are data, not colours. The first row is the top, where v is 1.
        multiplier: the option `-bm` of MTL.
    """
    heights = multiplier * (pixels @ LUMINANCE)
    along_u = (np.roll(heights, -1, axis=1) - np.roll(heights, 1, axis=1)) / 2
    along_v = (np.roll(heights, 1, axis=0) - np.roll(heights, -1, axis=0)) / 2
    normals = np.stack([-along_u, -along_v, np.ones_like(heights)], axis=-1)
    return (normals / np.linalg.norm(normals, axis=-1, keepdims=True)).astype(np.float32)


def holds_normals(pixels: np.ndarray) -> bool:
    """True for a picture (h, w, 3) that must be a normal map, since its medians are near (0.5, 0.5, 1).

    Exporters such as Blender's write normal maps as `map_Bump`. Medians are those of the surface where the rest of an
    atlas is black. Grey pictures never have them.
    """
    red, green, blue = np.median(pixels, axis=(0, 1))
    return bool(abs(red - 0.5) < 0.1 and abs(green - 0.5) < 0.1 and blue > 0.75)
