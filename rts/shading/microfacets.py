"""The reflection of rough surfaces by glTF 2.0, Appendix B: GGX, Smith's shadowing and Schlick's Fresnel term.

A surface of reflectance f₀ at normal incidence reflects f₀ a + b, and its base colour shows through by (1 − f₀) c:
`Response`. The three numbers depend on the directions of light and viewer and on roughness, not on colours.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import numpy as np

from rts.arrays.array_functions import dot
from rts.arrays.engines import engine_of, namespace
from rts.arrays.trees import Array
from rts.operations.unit import unit
from rts.shading.environment import blur
from rts.shading.spherical_harmonics import DIFFUSE, harmonics

SMOOTHEST = 0.045
"""The least roughness: float32 holds the highlights of smoother surfaces badly (Filament)."""
FAINT = 0.02
"""A term that keeps the share of a cosine small where a blur alone is nearly as good, so that the table is smooth."""
TABLE = 32
"""Number of cosines, and of roughnesses, of `around`'s table."""


class Response(NamedTuple):
    """The answer of a surface to light: reflected f₀ a + b, shown through (1 − f₀) c.

    Each is (N, 1) or (N, 3), light included.
    """

    a: Array
    b: Array
    c: Array


def of_light(normal: Array, toward: Array, facing: Array, direction: Array, roughness: Array) -> Response:
    """The response (N, 1) to light of irradiance π from one direction.

    Args:
        normal: (N, 3) unit vectors.
        toward: (N, 3) unit vectors to the viewer.
        facing: (N, 1), their scalar products.
        direction: (N, 3) or (3,), unit vectors to the light.
        roughness: (N, 1) or (), perceptual, from `SMOOTHEST` to 1.
    """
    xp, square = namespace(normal), roughness**4
    half = direction + toward
    length = xp.sqrt(xp.clip(dot(half, half), 1e-12, None))
    to_light, to_viewer = dot(normal, direction), xp.clip(facing, 1e-4, 1.0)
    to_light = xp.where(to_light > 0, to_light, 0 * to_light)
    # sin² of the angle between normal and half vector, by the chord: 1 − cos² would lose the highlights' digits.
    chord = normal - half / length
    versine = 0.5 * dot(chord, chord)
    spread = versine * (2 - versine) * (1 - square) + square
    smith = to_light * xp.sqrt(to_viewer * to_viewer * (1 - square) + square)
    smith = smith + to_viewer * xp.sqrt(to_light * to_light * (1 - square) + square)
    # π D V times the cosine.
    specular = 0.5 * to_light * square / (spread * spread * smith)
    # The cosine between viewer and half vector is half the length of the sum of both directions.
    fresnel = _fifth(1 - xp.clip(0.5 * length, 0.0, 1.0))
    return Response(specular * (1 - fresnel), specular * fresnel, to_light * (1 - fresnel))


class Lobe(NamedTuple):
    """The average of light that a surface reflects: a blur about a direction, mixed with diffuse light.

    Attributes:
        mean: the directions (N, 3) of blurs.
        roughness: of surfaces that blur as much along their normals, (N, 1).
        flat: the shares (N, 1) of diffuse light, irradiance / π.
    """

    mean: Array
    roughness: Array
    flat: Array


def around(
    normal: Array, toward: Array, facing: Array, roughness: Array, directed: bool
) -> tuple[Response, Lobe | None]:
    """The response (N, 1) to light from all directions: the split-sum approximation (Karis 2013).

    The first two numbers are of light of radiance 1. For other light they are factors of its average over directions
    that a surface reflects, its lobe.

    Args:
        normal: (N, 3) unit vectors.
        toward: (N, 3) unit vectors to the viewer.
        facing: (N, 1), their scalar products.
        roughness: (N, 1) or (), perceptual.
        directed: whether light depends on its direction; if not, there is no lobe.
    """
    engine = engine_of(facing, roughness)
    xp, last = engine.namespace, TABLE - 1
    table = engine.constant(_table() if directed else _table()[:, :3], facing)

    def place(value: Array) -> tuple[Array, Array]:
        at = xp.clip(value, 0.0, 1.0) * last
        cell = xp.clip(xp.floor(engine.stop_gradient(at)), 0, last - 1)
        return xp.astype(xp.where(cell == cell, cell, 0 * cell), xp.int32), at - cell

    row, down = place(roughness + 0 * facing)
    column, right = place(xp.sqrt(xp.clip(facing, 1e-6, 1.0)))
    first = row[:, 0] * TABLE + column[:, 0]

    def at(offset: int) -> Array:
        return xp.take(table, first + offset, axis=0)

    upper = at(0) + right * (at(1) - at(0))
    lower = at(TABLE) + right * (at(TABLE + 1) - at(TABLE))
    numbers = upper + down * (lower - upper)
    a, b, c, *lobe = (numbers[:, i : i + 1] for i in range(numbers.shape[1]))
    if not directed:
        return Response(a, b, c), None
    along, upright, blurred, flat = lobe
    return Response(a, b, c), Lobe(unit(along * (facing * normal - toward) + upright * normal), blurred, flat)


@functools.cache
def _table() -> np.ndarray:
    """Constants of `around` (TABLE², 7): rows of roughness, 0 to 1, in each the square roots of cosines, 0 to 1.

    Columns are a, b and c; a direction, in parts along the viewer's mirrored tangent and along the normal; a roughness;
    and a share of diffuse light.
    """
    step = np.linspace(0, 1, TABLE)
    cosine = np.maximum(step**2, 1e-4)[:, None]
    sine = np.sqrt(1 - np.minimum(cosine, 1 - 1e-6) ** 2)
    toward = np.stack([sine, 0 * cosine, cosine], axis=-1)
    n = 1024
    u, turn = (np.arange(n) + 0.5) / n, 2 * np.pi * ((np.arange(n) * 0.6180339887498949) % 1)
    # Light through the base: directions by their cosine.
    flat = np.sqrt(u)
    light = np.stack([flat * np.cos(turn), flat * np.sin(turn), np.sqrt(1 - u)], axis=-1)
    half = unit(light + toward)
    table = np.zeros((TABLE, TABLE, 7))
    table[..., 2] = 1 - _fifth(1 - (toward * half).sum(axis=-1)).mean(axis=1)
    for i, roughness in enumerate(step):
        alpha = max(roughness, SMOOTHEST) ** 2
        # Half vectors as the viewer sees them (Dupuy and Benyoub 2023).
        stretched = unit(toward * [alpha, alpha, 1])
        height = (1 - u) * (1 + stretched[..., 2]) - stretched[..., 2]
        flat = np.sqrt(np.clip(1 - height**2, 0, 1))
        half = np.stack([flat * np.cos(turn), flat * np.sin(turn), height], axis=-1) + stretched
        half = unit(half * [alpha, alpha, 1])
        to_half = (toward * half).sum(axis=-1)
        light = 2 * to_half[..., None] * half - toward
        to_light = np.maximum(light[..., 2], 0)
        of_viewer, of_light = (np.sqrt(x**2 * (1 - alpha**2) + alpha**2) for x in (cosine, to_light))
        weight = to_light * (cosine + of_viewer) / (to_light * of_viewer + cosine * of_light)
        fresnel = _fifth(1 - np.clip(to_half, 0, 1))
        table[i, :, 0], table[i, :, 1] = (weight * (1 - fresnel)).mean(axis=1), (weight * fresnel).mean(axis=1)
        weight = weight / weight.sum(axis=1, keepdims=True)
        angle, table[i, :, 5], table[i, :, 6] = _nearest_blur(light, weight)
        table[i, :, 3], table[i, :, 4] = np.sin(angle) / sine[:, 0], np.cos(angle)
    return np.ascontiguousarray(table.reshape(-1, 7), np.float32)


def _nearest_blur(light: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The blur, mixed with a cosine about the normal, that is nearest to reflected light.

    Distances are those of spherical harmonics up to order 3.

    Args:
        light: (C, n, 3) directions, about the plane of y = 0.
        weight: (C, n), of sum 1.

    Returns:
        The angles (C,) of blurs from the normal towards −x, their roughnesses (C,), and the shares (C,) of the cosine,
        below zero where light is spread more widely than by any blur.
    """
    angles, roughness, orders = np.linspace(-0.05, 1.6, 100), np.linspace(0, 1, 65), [0, 1, 4, 9]
    blurs, flat, norm = np.stack([blur(r, 3) for r in roughness.tolist()]), np.array([*DIFFUSE, 0]), [1, 3, 5, 7]
    basis = harmonics(light.reshape(-1, 3), 16).reshape(*light.shape[:2], 16)
    moments = 4 * np.pi * (weight[:, None] @ basis)[:, 0]
    ways, upright = harmonics(np.stack([-np.sin(angles), 0 * angles, np.cos(angles)], axis=1), 16), np.eye(3)[2:]
    # Scalar products of reflected light, each blur at each angle, and the cosine.
    light_blur = np.add.reduceat(moments[:, None] * ways, orders, axis=2) @ blurs.T
    light_flat = (np.add.reduceat(moments * harmonics(upright, 16), orders, axis=1) @ flat)[:, None, None]
    blur_flat = 4 * np.pi * (np.add.reduceat(ways * harmonics(upright, 16), orders, axis=1) * flat) @ blurs.T
    blur_blur = blurs**2 @ norm
    apart = flat**2 @ norm - 2 * blur_flat + blur_blur + FAINT
    rest = light_flat - blur_flat - light_blur + blur_blur
    share = np.clip(rest / apart, -1, 1)
    cost = blur_blur - 2 * light_blur - 2 * share * rest + share**2 * apart
    i, j = np.divmod(cost.reshape(len(cost), -1).argmin(axis=1), len(roughness))
    i, j, rows = np.clip(i, 1, len(angles) - 2), np.clip(j, 1, len(roughness) - 2), np.arange(len(cost))

    def refined(grid: np.ndarray, place: np.ndarray, near: np.ndarray) -> np.ndarray:
        """The place of the least value of a parabola."""
        low, mid, high = near
        bend = low - 2 * mid + high
        shift = np.where(bend > 0, (low - high) / (2 * np.where(bend > 0, bend, 1)), 0)
        return grid[place] + np.clip(shift, -1, 1) * (grid[1] - grid[0])

    return (
        refined(angles, i, np.stack([cost[rows, i + k, j] for k in (-1, 0, 1)])),
        refined(roughness, j, np.stack([cost[rows, i, j + k] for k in (-1, 0, 1)])),
        share[rows, i, j],
    )


def _fifth(x: Array) -> Array:
    square = x * x
    return square * square * x
