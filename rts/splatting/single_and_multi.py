"""The splatters of the paper, `Single` for one layer and `Multi` for several; and `Plain`, which does not splat."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np

from rts.arrays.engines import namespace
from rts.arrays.trees import Array
from rts.contracts.records import Splats
from rts.contracts.splatter import Splatter
from rts.splatting.kernel import LEAST_EPSILON, Kernel
from rts.splatting.layers import (
    NEIGHBOURS,
    Depths,
    Layers,
    all_of,
    check_rows,
    fronts,
    normalised,
    nothing,
    over,
    unpack,
)


class Plain(Splatter):
    """No splatting: layers are composited front to back, without derivative at occlusion boundaries."""

    translucent = True

    def image(self, splats: Splats) -> Array:
        """See `rts.Splatter`."""
        positions, rgba, row = splats.positions, splats.rgba, splats.row
        if rgba.shape[0] == 0:
            return nothing(rgba, row)
        check_rows(row, rgba.shape[0])
        xp = namespace(rgba)
        # Zero, but connected to the positions, so that their derivative exists and is zero.
        image = 0 * xp.sum(positions)
        for k in reversed(range(row.shape[0])):
            layer = xp.where((row[k] >= 0)[..., None], unpack(rgba, row[k]), 0.0)
            image = over(layer, image)
        return image

    def needed(self, covered: np.ndarray, depth: np.ndarray) -> np.ndarray:
        """See `rts.Splatter`: the fronts, since an opaque front hides all layers behind it."""
        return fronts(covered)


@dataclass(frozen=True)
class Single(Kernel):
    """Splatting of one layer (paper eq. 1–3): only the front layer of `row`, as if nothing hid anything."""

    layers = 1

    @functools.cached_property
    def fills_interiors(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]  # Assigned nowhere.
        """See `rts.Splatter`: True if ε outweighs rounding, so that nine centred samples fill a cell."""
        return self.epsilon >= LEAST_EPSILON

    def accumulate(self, splats: Splats) -> Array:
        """See `Kernel`."""
        layers = Layers(self.weights, splats.replace(row=splats.row[:1]))
        total = sum(layers.splats(u, v)[0] for u, v in NEIGHBOURS)
        return normalised(total, layers.xp)

    def plain(self, depths: Depths, margin: float) -> Array:
        """See `Kernel`: every target, since hidden layers are not splatted."""
        return depths.covers(0, 0) | True


@dataclass(frozen=True)
class Multi(Kernel):
    """Three accumulation buffers (paper §3.3.2): in front of the target, at its surface, and behind it.

    Layers of the source p and the target q are paired on linear depth z: with A_l = |z_p[l] − z_q[0]| and
    B_l = |z_q[l] − z_p[0]|, s = −argmin B where min B < min A, else argmin A. Layer l of p is in front where l < s, at
    the surface where l = s, behind where l > s. B finds sources whose front layer continues a hidden layer of the
    target. Back faces of a closed surface pair with layers behind them: cull them (`Part.cull`).
    """

    def accumulate(self, splats: Splats) -> Array:
        """See `Kernel`."""
        layers = Layers(self.weights, splats)
        xp = layers.xp
        buffers = [0.0, 0.0, 0.0]
        for u, v in NEIGHBOURS:
            s, _ = layers.pairing(u, v)
            for k, splats in enumerate(layers.splats(u, v)):
                for i, chosen in enumerate((s > k, s == k, s < k)):
                    buffers[i] = buffers[i] + xp.where(chosen[..., None], splats, 0.0)
        front, surface, behind = (normalised(b, xp) for b in buffers)
        return over(front, over(surface, behind))

    def plain(self, depths: Depths, margin: float) -> Array:
        """See `Kernel`: targets that the surface fills, so that it hides all layers behind it."""
        full = self.epsilon >= LEAST_EPSILON
        return full & all_of([depths.covers(*n) & depths.fronts_pair(*n, margin)[0] for n in NEIGHBOURS])
