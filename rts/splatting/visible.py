"""The splatter `Visible`: `Multi` with a calibrated derivative, where layers of one source hide each other."""

from __future__ import annotations

import functools
import operator
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from rts.arrays.engines import engine_of
from rts.arrays.trees import Array
from rts.contracts.records import Splats
from rts.splatting import crossings, rims, stacks
from rts.splatting.kernel import LEAST_EPSILON, Kernel
from rts.splatting.layers import NEIGHBOURS, Depths, Layers, all_of, nearest, normalised, over

CONTINUED = 0.8
"""Fronts also pair if one is off the other's line by less than this share of the smallest A or B of `Multi`."""

RIMS = rims.LEAST, rims.LARGEST, rims.FLAT, rims.CONVERGING, rims.HALF
CROSSINGS = crossings.LARGEST, crossings.DIRECT, crossings.FIT, crossings.SLACK, crossings.KEPT
"""Constants of `rims` and `crossings`, for compiled loops."""


@dataclass(frozen=True)
class Visible(Kernel):
    """`Multi` with a calibrated derivative, in which nearer opaque layers of a source hide its farther ones.

    Pairing is that of `Multi`, with an addition. Front layers also pair (s = 0) if one lies on the line through the
    other and its next cell, or off it by less than 0.8 of the smallest of A and B. Where depth changes fast, as on the
    sides of a box near its outline, a front is nearer to a back face than to its own continuation. If samplers record
    the sides of surfaces, a hidden layer does not pair with a front that is the other side of the same sheet.

    Each buffer gets at most one layer of a source. An empty target takes the source's front layer, at the surface. A
    covered target takes the source's front layer in front where s > 0, and layer s at the surface where s ≥ 0. The
    buffer behind holds only layers that a neighbouring cell shows. Let m be the least −s over the covered sources with
    s < 0. These sources give their front layer, the others the layer l > s whose depth is nearest to z_q[m]. Without
    such sources the buffer is empty.

    Closed surfaces need no culling, if K reaches through their back faces to the layers behind.

    If samples may be translucent (`Splats.opaque` is False), the same rule goes on behind each layer (`stacks.py`).
    Outlines and lines of crossing behind the first layer then move as samples do.

    Attributes:
        rims: whether coverage moves as outlines do, extrapolated from the samples inside of them (`rims.py`). Otherwise
            it moves as the samples, which are faster than the smooth rim of a turning surface. The image is the same.
        crossings: whether lines where two surfaces pass through one another move as their depths say (`crossings.py`).
            Otherwise they move as the samples beside them, which is hardly at all. The image is the same.
        facing: whether opposite sides of one sheet are kept from pairing, where samplers record sides
            (`Splats.facing`). Otherwise depths alone decide.
        exits: whether outlines of culled parts move as the middles of their chords, where samplers record the ends of
            chords (`Splats.exit`). Otherwise fronts alone decide. The image is the same.
    """

    epsilon: float = 1e-3
    calibration: float | None = None
    rims: bool = True
    crossings: bool = True
    facing: bool = True
    exits: bool = True
    CONTINUED: ClassVar[float] = CONTINUED
    RIMS: ClassVar[tuple[float, ...]] = RIMS
    CROSSINGS: ClassVar[tuple[float, ...]] = CROSSINGS
    translucent = True
    reach = 3  # Depths three cells away may decide how an outline or a line of crossing moves.

    @functools.cached_property
    def reads(self) -> frozenset[str]:  # pyright: ignore[reportIncompatibleVariableOverride]  # Assigned nowhere.
        """See `rts.Splatter`: "facing" if `facing` is True; "exit" if `rims` and `exits` are."""
        switches = {"facing": self.facing, "exit": self.rims and self.exits}
        return frozenset(name for name, read in switches.items() if read)

    @functools.cached_property
    def fills_interiors(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]  # Assigned nowhere.
        """See `rts.Splatter`: True if ε outweighs rounding, so that nine centred samples fill a cell."""
        return self.epsilon >= LEAST_EPSILON

    def accumulate(self, splats: Splats) -> Array:
        """See `Kernel`."""
        row = splats.row
        splats = splats if "exit" in self.reads else splats.replace(exit=None)
        layers = Layers(self.weights, splats, splats.facing if self.facing else None)
        xp, shift = layers.xp, {}
        for n in NEIGHBOURS:
            s, off = layers.pairing(*n)
            shift[n] = xp.where((row[0] < 0) | layers.continues(*n, CONTINUED * off), 0, s)
        shown = {n: (s < 0) & layers.covers(*n) for n, s in shift.items()}
        count = row.shape[0]
        m = xp.full_like(row[0], count)
        for n, s in shift.items():
            m = xp.where(shown[n] & (-s < m), -s, m)
        differentiates = engine_of(splats.positions).differentiates
        lines, crossed = None, None
        if self.crossings and count > 1 and differentiates:
            pairs = crossings.pairs_of(layers)
            lines, crossed = crossings.targets(layers, shift, pairs), functools.reduce(operator.or_, pairs.values())
        still = None if lines is None else lines.target
        revealed = sum(xp.where(m == k, z, 0.0) for k, z in enumerate(layers.target))

        def changes(totals: list[Array]) -> list[Array]:
            """Changes (H, W, 5) of the buffers with sums `totals`, as outlines move; 0.0 each without rims."""
            if not (self.rims and differentiates):
                return [0.0, 0.0]
            moved = rims.gains(self, layers, shift, splats.parts, crossed)
            moved = moved if still is None else [xp.where(still, 0.0, gain) for gain in moved]
            return [rims.spread(total, gain) for total, gain in zip(totals, moved, strict=True)]

        if not splats.opaque:
            image = stacks.image(layers, shift, self.sigma, changes, still)
            return image if lines is None else image + crossings.motion(self, layers, lines, stacks.composites(layers))
        front, surface, behind = 0.0, 0.0, 0.0
        for n, s in shift.items():
            hidden = xp.where(s < 0, 0, nearest(layers.source(*n), revealed, s, xp))
            hidden = xp.where(m < count, hidden, count)
            for k, own in enumerate(layers.splats(*n, still=still)):
                if k == 0:
                    front = front + xp.where((s > 0)[..., None], own, 0.0)
                surface = surface + xp.where((s == k)[..., None], own, 0.0)
                behind = behind + xp.where((hidden == k)[..., None], own, 0.0)
        colors = [normalised(b, xp) for b in (front, surface, behind)]
        for i, change in enumerate(changes([front, surface])):
            colors[i] = colors[i] + (change if isinstance(change, float) else change[..., :4])
        image = over(colors[0], over(*colors[1:]))
        return (
            image
            if lines is None
            else image + crossings.motion(self, layers, lines, functools.partial(layers.color, 0))
        )

    def needed(self, covered: np.ndarray, depth: np.ndarray) -> np.ndarray:
        """See `rts.Splatter`: as `Kernel`, possible ends of chords, and the first two layers near lines of crossing."""
        kept = super().needed(covered, depth)
        kept = kept | rims.chords(covered) if self.rims else kept
        return kept | crossings.sheets(covered, depth) if self.crossings else kept

    def plain(self, depths: Depths, margin: float) -> Array:
        """See `Kernel`: empty targets, and targets whose front pairs with the front of every covered source."""
        conditions = []
        for n in NEIGHBOURS:
            pair, off = depths.fronts_pair(*n, margin)
            conditions.append(~depths.covers(*n) | pair | depths.continues(*n, CONTINUED * off - margin))
        return ~depths.covers(0, 0) | all_of(conditions)
