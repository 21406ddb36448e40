"""Light apart from colours: one environment, and the colours that a surface would show in even light."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from scipy.spatial import KDTree

import rts
from rts.shading import irradiance as irradiance_of_harmonics

EVEN = math.sqrt(4 * math.pi)
"""The first coefficient of light of mean 1."""
DARK = 0.05
"""The least irradiance, so that colours can be divided by it."""
PAIRS, REACH, LEAST = 30_000, 0.2, 2.5
"""The most pairs of vertices that are compared; how far apart they may be, in radii of the object; or if that is more,
in distances of nearest ones. Of very near ones normals are too noisy, which makes the light too even.
"""
SCALE = 0.03
"""The difference of log colours from which on a pair's own counts less, as one of two materials."""
BLACK, WHITE = 0.05, 0.98
"""Encoded colours beyond which a picture tells nothing of the light."""


def irradiance(normals: Any, light: Any) -> Any:
    """The irradiance / π (N, 3), of `DARK` at least, of surfaces with unit normals (N, 3), world space.

    Args:
        normals: (N, 3).
        light: (9, 3), coefficients of radiance as in θ["light"]["sh"]; light whose first row is `EVEN` has a mean of 1.
    """
    return rts.namespace(normals).clip(irradiance_of_harmonics(light, normals), DARK, None)


class Lit(rts.Shader):
    """The base colour of another shader, encoded, in the light θ["irradiance"] (9, 3); see `irradiance`."""

    opaque = True

    def __init__(self, base: rts.Shader):
        self.base, self.reads = base, (*(base.reads or ()), "normal", "irradiance")

    def __call__(self, theta: Mapping[str, Any], gbuffer: rts.GBuffer, camera: Any) -> Any:
        """See `rts.Shader`."""
        color = self.base(theta, gbuffer, camera)
        xp = rts.namespace(color)
        normal = gbuffer["normal"]
        normal = normal / xp.clip(xp.sqrt(xp.sum(normal * normal, axis=1, keepdims=True)), 1e-6, None)
        lit = encoded(decoded(color[:, :3]) * irradiance(normal, theta["irradiance"]))
        return xp.concat([xp.clip(lit, 0, 1), color[:, 3:]], axis=1)


def fitted(points: np.ndarray, normals: np.ndarray, colors: np.ndarray) -> np.ndarray:
    """The light (9, 3), of mean irradiance 1, that tells most differences of colours between near points.

    A picture alone cannot tell a colour from its light. Most near points are taken to be of one material: then the
    difference of their log colours is that of their log irradiances. Pairs that differ by more count little.

    Args:
        points: (V, 3).
        normals: (V, 3), of unit length.
        colors: (V, 3), encoded, as seen.
    """
    first, second = _pairs(points)
    seen = np.log(np.clip(decoded(colors), 1e-4, None))
    sure = ((colors > BLACK) & (colors < WHITE)).astype(np.float32)
    weights, difference = (
        torch.tensor(np.float32(x)) for x in (sure[first] * sure[second], seen[first] - seen[second])
    )
    way = torch.tensor(np.float32(normals))

    def residuals(p: Any) -> Any:
        shade = torch.log(irradiance(way, torch.cat([torch.full((1, 3), EVEN), p["light"]])))
        return weights * (difference - (shade[first] - shade[second]))

    loss = rts.Loss("soft_l1", f_scale=SCALE)
    fit = rts.fit(residuals, {"light": torch.zeros(8, 3)}, method="lm", loss=loss, progress=False)
    return np.concatenate([np.full((1, 3), EVEN, np.float32), fit.parameters["light"].numpy()])


def _pairs(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Numbers of points that are near others, and of these."""
    tree = KDTree(points)
    radius = REACH * np.linalg.norm(points - points.mean(axis=0), axis=1).max()
    radius = max(radius, LEAST * np.median(tree.query(points, k=2)[0][:, 1]))
    pairs = tree.query_pairs(float(radius), output_type="ndarray")
    chosen = np.random.default_rng(0).permutation(len(pairs))[:PAIRS]
    return pairs[chosen, 0], pairs[chosen, 1]


def even(colors: np.ndarray, normals: np.ndarray, light: np.ndarray) -> np.ndarray:
    """Encoded colours (N, 3) in a light of irradiance 1, of surfaces that show these in another light."""
    return np.clip(encoded(decoded(colors) / irradiance(normals, light)), 0, 1).astype(np.float32)


def decoded(values: Any) -> Any:
    """Linear values of sRGB-encoded ones (IEC 61966-2-1)."""
    xp = rts.namespace(values)
    return xp.where(values <= 0.04045, values / 12.92, ((xp.clip(values, 0, None) + 0.055) / 1.055) ** 2.4)


def encoded(values: Any) -> Any:
    """The sRGB encoding of linear values."""
    xp = rts.namespace(values)
    return xp.where(values <= 0.0031308, 12.92 * values, 1.055 * xp.clip(values, 0.0031308, None) ** (1 / 2.4) - 0.055)
