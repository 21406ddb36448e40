"""Adaptive sampling: one sample in most pixels, many near outlines. One sample a pixel tells where outlines are."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from rts.arrays.argument_checks import quoted
from rts.compiling.threads import parallel, read_only
from rts.contracts.checks import CheckedPart, is_count, is_real
from rts.errors import InputError

MOST = 64
"""The most samples along each side of an active pixel. All fine samples are in memory at once."""


@dataclass(frozen=True)
class Adaptive:
    """A value for `supersample`: s² samples in pixels near outlines, one in every other pixel.

    It is for splatters that spread samples: `splatter="auto"` is then "visible", and "edges" refuses it.

    A pixel with s² samples is called active. In samples of one a pixel, its front ends towards a neighbour that shows
    nothing or another surface, or a neighbour's front ends towards it; behind translucent layers, the next layer does.
    Active pixels look as with `supersample=samples`, the others as with `supersample=1`.

    A wire, a hair or a far object that is thinner than pixels may lie between all samples, so that none tells of it.
    With `thin` the triangles themselves are asked, by samplers that tell (`Cells.between`): "raster" does.

    Attributes:
        samples: s, along each side of an active pixel; from 2 to 64.
        dilated: True if the eight neighbours of active pixels are active too. Colours that change near outlines need
            that. None for True if `contrast` is set or some part's shader is not `uniform`.
        contrast: threshold for the second difference of any colour channel along any of four directions, above which
            pixels are active too: at edges of colour on surfaces. Needs colours, which are missing in `rts.sample`,
            compiled programs and derivatives of several directions at once. None to ignore colours; 0.2 suits.
        thin: True if pixels are active, too, where triangles lie between samples: once more through all triangles.
            Triangles that the near or far plane cuts, and those at depths of at most 0, are not looked for.
    """

    samples: int
    dilated: bool | None = None
    contrast: float | None = None
    thin: bool = False

    def __post_init__(self):
        if not is_count(self.samples) or self.samples < 2:
            raise InputError(
                f"samples of Adaptive is {quoted(self.samples)}; expected an integer of at least 2, such as 4"
            )
        if self.samples > MOST:
            raise InputError(
                f"samples of Adaptive is {quoted(self.samples)}; expected at most {MOST}, with which a thousand "
                f"pixels at outlines take about 1 GB; take 4 or 8, or a number in place of Adaptive, rendered in bands"
            )
        if self.dilated is not None and not isinstance(self.dilated, bool):
            raise InputError(f"dilated of Adaptive is {quoted(self.dilated)}; expected True, False or None")
        if self.contrast is not None and not (is_real(self.contrast) and 0 < self.contrast < math.inf):
            raise InputError(
                f"contrast of Adaptive is {quoted(self.contrast)}; expected a positive finite number, such as 0.2, "
                f"or None"
            )
        if not isinstance(self.thin, bool):
            raise InputError(f"thin of Adaptive is {quoted(self.thin)}; expected True or False")
        object.__setattr__(self, "samples", int(self.samples))

    def dilates(self, parts: Sequence[CheckedPart]) -> bool:
        """True if the neighbours of a scene's active pixels are active, too."""
        if self.dilated is None:
            return self.contrast is not None or not all(part.uniform for part in parts)
        return self.dilated

    @staticmethod
    def of_text(text: str) -> int | Adaptive:
        """The `supersample` written as a text: "4", "adaptive:4:thin=True", or "adaptive:8:dilated=False:contrast=0.2".

        Raises:
            InputError: the text has none of these forms, or a number of `Adaptive` is out of range.
        """
        kind, *rest = (word.strip().lower() for word in text.split(":"))
        number, *further = rest if rest and kind == "adaptive" else [kind]
        if not number.isdecimal() or (rest and kind != "adaptive"):
            raise InputError(f"{text!r} is no supersample; expected a number such as 4, or adaptive:4")
        values = {f"{name}={value}".lower(): (name, value) for name in ("dilated", "thin") for value in (True, False)}
        options: dict[str, Any] = {}
        for word in further:
            name, _, value = word.partition("=")
            if word in values:
                options.update([values[word]])
            elif name == "contrast" and (least := _number(value)) is not None:
                options[name] = least
            else:
                raise InputError(f"{word!r} of {text!r} is none of dilated=True, contrast=0.2 and thin=True")
        return Adaptive(int(number), **options) if rest else int(number)


def _number(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None


def finest(supersample: Any) -> Any:
    """The most samples along a side of a pixel: `samples` of an `Adaptive`, else the argument itself."""
    return supersample.samples if isinstance(supersample, Adaptive) else supersample


def visible_outlines(
    row: np.ndarray,
    depth: np.ndarray,
    sizes: Sequence[int],
    settled: np.ndarray | None = None,
    opaque: Sequence[bool] | None = None,
) -> np.ndarray:
    """Cells (H, W) bool at `outlines` of fronts, and of layers behind translucent ones.

    Args:
        row: see `outlines`.
        depth: see `outlines`.
        sizes: see `outlines`.
        settled: see `outlines`.
        opaque: for each part, whether its shader promises to be opaque; None if all do.
    """
    marks = outlines(row, depth, sizes, settled)
    if opaque is None or all(opaque):
        return marks
    ends = np.cumsum(sizes)
    for k in range(1, len(row)):
        before, rest = row[k - 1], row[k:]
        clear = (before >= 0) & ~np.asarray(opaque)[np.searchsorted(ends[:-1], before, side="right")]
        if not clear.any():
            break
        # Layers behind as a scene of their own, empty where light does not reach them.
        row = np.concatenate([row[:k], np.where(clear, rest, -1).astype(row.dtype)])
        marks |= outlines(row[k:], np.where(row[k:] >= 0, depth[k:], 0), sizes)
    return marks


def outlines(row: np.ndarray, depth: np.ndarray, sizes: Sequence[int], settled: np.ndarray | None = None) -> np.ndarray:
    """Cells (H, W) bool at outlines: their front ends towards a neighbour, or a neighbour's front towards them.

    Cells are included where only rounding could make a front end.

    Args:
        row: (K, H, W), the sample of each cell, counted over all parts, or −1; one cell a pixel.
        depth: (K, H, W), 0 in empty cells.
        sizes: the number of rows of each part.
        settled: (H, W) int8, 0 at cells that the only part covers, even where they have no sample, −1 at others;
            None if no cell is settled.
    """
    from rts.sampling import adaptive_loops

    settled = np.empty((0, row.shape[2]), np.int8) if settled is None else settled
    depth, kind = read_only(depth), depth.dtype.type
    least, largest = depth.min(initial=0), depth.max(initial=0)
    beyond = 2 * (largest - least) or 1
    marks = np.empty(row.shape[1:], np.uint8)
    arguments = (
        read_only(row, np.int32),
        read_only(settled, np.int8),
        depth,
        np.cumsum(sizes)[:-1],
        *map(kind, (beyond, 1.5e-4 * max(largest, -least), 0.8)),
    )
    parallel(adaptive_loops.mark, len(marks), *arguments, marks, work=4 * row.size)
    return marks.view(bool)


def missed(row: np.ndarray, depth: np.ndarray, between: np.ndarray, settled: np.ndarray | None = None) -> np.ndarray:
    """Cells (H, W) bool in which something lies between the centres, in front of what all parts show there.

    Args:
        row: (H, W), the front's row; −1 in empty cells.
        depth: (H, W), its depth.
        between: (H, W), see `Cells.between`.
        settled: (H, W) int8, see `outlines`; cells that are settled keep their colour, whatever lies in them.
    """
    found = (between > 0) & ((row < 0) | (between < depth))
    return found if settled is None else found & (settled < 0)


def contrasts(row: np.ndarray, rgba: np.ndarray, least: float) -> np.ndarray:
    """Cells (H, W) bool where the front's colour has a second difference above `least` along any of four directions.

    A difference is of three covered cells in a line.

    Args:
        row: (H, W), the row of each front in `rgba`; −1 in empty cells.
        rgba: (N, 4).
        least: the threshold, for each channel.
    """
    covered = np.pad(row >= 0, 1)
    color = np.pad(rgba[np.maximum(row, 0)], ((1, 1), (1, 1), (0, 0)))
    height, width = row.shape

    def at(x: np.ndarray, v: int, u: int) -> np.ndarray:
        return x[1 + v : 1 + v + height, 1 + u : 1 + u + width]

    contrasting = np.zeros(row.shape, bool)
    for v, u in ((0, 1), (1, 0), (1, 1), (1, -1)):
        second = np.abs(at(color, v, u) - 2 * at(color, 0, 0) + at(color, -v, -u)).max(axis=-1)
        contrasting |= (second > least) & at(covered, v, u) & at(covered, -v, -u) & at(covered, 0, 0)
    return contrasting
