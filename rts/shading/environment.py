"""Light from an image of all that surrounds a scene: blurred once for each roughness, then looked up."""

from __future__ import annotations

import functools
from collections.abc import Mapping

import numpy as np

from rts.arrays.engines import engine_of, namespace
from rts.arrays.trees import Array
from rts.operations.texels import texels
from rts.shading.spherical_harmonics import harmonics
from rts.shading.theta_entries import check_entry, shape_of

ROWS = 128
"""Rows of each level; there are twice as many columns."""
ORDER = 64
"""The highest order of spherical harmonics of blurred levels: those of roughness 0.2 and more have little beyond."""
AROUND = "repeat", "clamp"
"""How an equirectangular image goes on: its columns repeat."""
STEPS = 16
"""Number of roughnesses above 0 in the table of `blurs`."""
ROUGHNESS = (0.0, 0.1, 0.2, 0.3, 0.4, 0.55, 0.75, 1.0)
"""Roughness of the image itself, and of each level. Level 0 is the image, averaged over equal areas of its pixels."""


def prefiltered(image: Array) -> dict[str, Array]:
    """An environment's image, blurred for each roughness, as `theta["light"]["environment"]`; differentiable in it.

    Shaders do this with an image in each render. An image that stays is prefiltered once, and given in this form.

    Args:
        image: (h, w, 3) linear radiance, equirectangular: the view from the origin along −z is in its middle, +x on its
            right half, +y on top.

    Returns:
        "sh" (9, 3), the image in spherical harmonics up to order 2; "image", itself; "levels" (K, 128, 256, 3), the
        image as surfaces of the roughnesses `ROUGHNESS[1:]` reflect it, seen along their normals (Karis 2013).

    Raises:
        InputError: the image has another shape, is not finite, or holds no floating numbers.
    """
    shape = shape_of(image)
    check_entry("['light']['environment']", image, "(h, w, 3)", len(shape) == 3 and shape[2] == 3 and 0 not in shape)
    xp, engine = namespace(image), engine_of(image)
    from rts.shading.mipmaps import mip_levels

    small = next(x for x in reversed(mip_levels(image)) if x.shape[0] >= ROWS or x.shape == image.shape)
    grid = engine.constant(_directions().reshape(-1, 3), image)
    middle = xp.reshape(_looked_up(small, grid), (ROWS, 2 * ROWS, 3))
    weights, waves, polynomials, blurs = (engine.constant(x, image) for x in _tables())
    sh = xp.sum(weights[:, :, None] * xp.reshape(middle, (1, -1, 3)), axis=1)
    # Each row in cosines and sines of the longitude, then each of these in Legendre functions of the latitude.
    rows = engine.product(xp.permute_dims(middle, (0, 2, 1)), waves) / (2 * ROWS)
    rows = xp.permute_dims(xp.reshape(rows, (ROWS, 3, 2, ORDER + 1)), (3, 0, 1, 2))
    flat, fejer = xp.reshape(rows, (ORDER + 1, ROWS, 6)), engine.constant(_fejer()[:, None], image)
    coefficients = engine.product(xp.permute_dims(polynomials, (0, 2, 1)), fejer * flat)
    blurred = engine.product(polynomials, blurs[:, None, :, None] * coefficients)
    blurred = xp.permute_dims(xp.reshape(blurred, (-1, ORDER + 1, ROWS, 3, 2)), (0, 2, 3, 4, 1))
    twice = xp.concat([waves[:, :1], 2 * waves[:, 1 : ORDER + 1], 2 * waves[:, ORDER + 1 :]], axis=1)
    levels = engine.product(xp.reshape(blurred, (-1, ROWS, 3, 2 * ORDER + 2)), xp.permute_dims(twice, (1, 0)))
    levels = xp.permute_dims(xp.where(levels > 0, levels, 0 * levels), (0, 1, 3, 2))
    return {"sh": sh, "image": image, "levels": xp.concat([middle[None], levels])}


def turned_environment(image: Array, rotation: Array) -> Array:
    """An environment's image (h, w, 3) as seen from a world whose directions d are `rotation` (3, 3) @ d in its own."""
    xp, engine, (height, width) = namespace(image), engine_of(image), image.shape[:2]
    grid = engine.constant(_directions(height, width).reshape(-1, 3), image)
    ways = sum(grid[:, i : i + 1] * rotation[:, i] for i in range(3))
    return xp.reshape(_looked_up(image, ways), image.shape)


def reflected(environment: Mapping[str, Array], directions: Array, roughness: Array) -> Array:
    """Blurred light (N, 3) from unit directions (N, 3), for surfaces of roughness (N, 1).

    Args:
        environment: see `prefiltered`.
        directions: world space.
        roughness: perceptual, 0 to 1.
    """
    xp, engine, levels = namespace(directions), engine_of(directions), environment["levels"]
    low, step = (engine.constant(x, roughness) for x in (np.array(ROUGHNESS[:-1]), np.diff(ROUGHNESS)))
    number = xp.sum(xp.clip((roughness - low) / step, 0.0, 1.0), axis=1, keepdims=True)
    finer = xp.clip(xp.floor(engine.stop_gradient(number)), 0.0, len(ROUGHNESS) - 2.0)
    images, share = [environment["image"], *(levels[i, ...] for i in range(levels.shape[0]))], number - finer
    index = xp.astype(xp.where(finer == finer, finer, 0.0)[:, 0], xp.int32)
    sizes, table = [shape_of(x)[:2] for x in images], xp.concat([xp.reshape(x, (-1, 3)) for x in images])
    # One lookup of both levels: engines make an array as large as the table for the gradient of each.
    uv, number = (xp.concat(x) for x in ([_places(directions)] * 2, [index, index + 1]))
    found = xp.reshape(texels(table, uv, sizes, number, AROUND), (2, -1, 3))
    return found[0, ...] + share * (found[1, ...] - found[0, ...])


def _looked_up(image: Array, directions: Array) -> Array:
    """Bilinear lookup (N, 3) of unit directions (N, 3) in an equirectangular image (h, w, 3)."""
    table = namespace(image).reshape(image, (-1, 3))
    return texels(table, _places(directions), [shape_of(image)[:2]], None, AROUND)


def _places(directions: Array) -> Array:
    """Where in an equirectangular image directions (N, 3) are seen: u and v (N, 2), v from below."""
    xp = namespace(directions)
    x, y, z = (directions[:, i] for i in range(3))
    # At the poles all longitudes are one.
    pole = x * x + z * z < 1e-12
    x, z = xp.where(pole, 0 * x, x), xp.where(pole, 0 * z - 1e-6, z)
    down = xp.atan2(xp.sqrt(x * x + z * z), y) / np.pi
    return xp.stack([0.5 + xp.atan2(x, -z) / (2 * np.pi), 1 - down], axis=1)


@functools.cache
def _directions(height: int = ROWS, width: int = 2 * ROWS) -> np.ndarray:
    """The unit directions (height, width, 3) of the centres of an image's texels; by default those of a level."""
    down = (np.arange(height)[:, None] + 0.5) / height * np.pi
    around = (np.arange(width) + 0.5) / width * 2 * np.pi
    x, z = -np.sin(down) * np.sin(around), np.sin(down) * np.cos(around)
    return np.stack([x, np.cos(down) + 0 * x, z], axis=-1)


def _fejer() -> np.ndarray:
    """Weights (ROWS,) with which a sum over the rows is an integral over the cosine of the polar angle (Fejér)."""
    k, down = np.arange(1, ROWS // 2), (np.arange(ROWS) + 0.5) / ROWS * np.pi
    return 2 / ROWS * (1 - 2 * (np.cos(2 * down[:, None] * k) / (4 * k * k - 1)).sum(axis=1))


@functools.cache
def _tables() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Constant tables of `prefiltered`.

    Integrals against the first harmonics (9, texels); cosines and sines of the longitude (2 ROWS, 2 (ORDER + 1)); the
    Legendre functions (ORDER + 1, ROWS, ORDER + 1) of each of these, by latitude and order, orthonormal in the cosine
    of the polar angle; and factors (K, ORDER + 1) of each order by which a level is blurred.
    """
    integral = np.repeat(_fejer(), 2 * ROWS) * np.pi / ROWS
    first = harmonics(_directions().reshape(-1, 3), 9).T * integral
    m, around = np.arange(ORDER + 1), (np.arange(2 * ROWS) + 0.5) / ROWS * np.pi
    waves = np.concatenate([np.cos(around[:, None] * m), np.sin(around[:, None] * m)], axis=1)
    down = (np.arange(ROWS) + 0.5) / ROWS * np.pi
    functions = np.zeros((ORDER + 1, ROWS, ORDER + 1))
    functions[0, :, 0] = np.sqrt(0.5)
    for order in range(1, ORDER + 1):
        lower, k = functions[:order, :, order - 1], m[:order, None]
        two_lower = functions[:order, :, order - 2] if order > 1 else 0
        ratio = np.sqrt(((order - 1) ** 2 - k**2).clip(0) / (4 * (order - 1) ** 2 - 1))
        scale = np.sqrt((4 * order**2 - 1) / (order**2 - k**2))
        functions[:order, :, order] = scale * (np.cos(down) * lower - ratio * two_lower)
        functions[order, :, order] = np.sqrt(1 + 1 / (2 * order)) * np.sin(down) * functions[order - 1, :, order - 1]
    return first, waves, functions, np.stack([blur(roughness, ORDER) for roughness in ROUGHNESS[2:]])


def blurs(roughness: Array) -> Array:
    """`blur` (N, 4) of the orders 0 to 3, for roughnesses (N, 1); differentiable."""
    xp, engine = namespace(roughness), engine_of(roughness)
    table = engine.constant(np.stack([blur(i / STEPS, 3) for i in range(STEPS + 1)]), roughness)
    at = xp.clip(roughness, 0.0, 1.0) * STEPS
    low = xp.clip(xp.floor(engine.stop_gradient(at)), 0.0, STEPS - 1.0)
    index = xp.astype(xp.where(low == low, low, 0 * low)[:, 0], xp.int32)
    first = xp.take(table, index, axis=0)
    return first + (at - low) * (xp.take(table, index + 1, axis=0) - first)


@functools.cache
def blur(roughness: float, order: int) -> np.ndarray:
    """Factors (order + 1,) of the orders of spherical harmonics in light that a rough surface reflects to its normal.

    Light is weighted by GGX and the cosine (Karis 2013), which is a blur around the mirrored direction.
    """
    alpha, u = max(roughness, 1e-3) ** 2, (np.arange(20000) + 0.5) / 20000
    cosine = 2 * (1 - u) / (1 + (alpha**2 - 1) * u) - 1
    light = np.maximum(cosine, 0)
    weight = light / (light + np.sqrt(light**2 * (1 - alpha**2) + alpha**2))
    lower, here = np.ones_like(cosine), cosine
    factors = [1.0]
    for k in range(1, order + 1):
        factors.append(float((weight * here).sum() / weight.sum()))
        lower, here = here, ((2 * k + 1) * cosine * here - k * lower) / (k + 1)
    return np.array(factors)
