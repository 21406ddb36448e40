"""How a scene is to be rendered, besides the scene itself: the settings that all ways of rendering share."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import Any, Literal

from rts.contracts.checks import check_size, check_splatter
from rts.contracts.splatter import Splatter
from rts.sampling.adaptive import Adaptive
from rts.sampling.hidden import planned

BAND = 2**20
"""Cells, over all layers, that a supersampled image may have before it is rendered in bands of rows."""


@dataclass(frozen=True)
class RenderSettings:
    """Checked settings of a render.

    Attributes:
        splatter: the splatter that samples are for; None where they are for any, and none may be left out.
        layers: K, or "auto".
        supersample: samples along each side of a pixel, or an `Adaptive`.
        capacity: rows to allot for the samples of a part; None for as many as there are.
    """

    splatter: Splatter | None
    layers: int | Literal["auto"]
    supersample: int | Adaptive
    capacity: int | None

    @classmethod
    def checked(
        cls, size: Any, splatter: Any, layers: Any, supersample: Any, capacity: Any
    ) -> tuple[tuple[int, int], RenderSettings]:
        """(height, width) as integers, and the settings.

        Args:
            size: what the user gave for (height, width).
            splatter: name or object of a splatter.
            layers: as the user gave it, as are the others.
            supersample: see `layers`.
            capacity: see `layers`.

        Raises:
            InputError: one of them is of another kind, or makes no image.
        """
        finest = supersample.samples if isinstance(supersample, Adaptive) else supersample
        size = check_size(size, layers, capacity, finest)
        if not isinstance(supersample, Adaptive):
            supersample = int(supersample)
        return size, cls(check_splatter(splatter), layers if layers == "auto" else int(layers), supersample, capacity)

    @property
    def side(self) -> int | None:
        """Cells along each side of a pixel, where that is one number for the image; None for `Adaptive`."""
        return None if isinstance(self.supersample, Adaptive) else self.supersample

    @property
    def contrast(self) -> float | None:
        """The contrast from which on `Adaptive` takes more samples; None where it does not look."""
        return self.supersample.contrast if isinstance(self.supersample, Adaptive) else None

    @property
    def most_layers(self) -> int:
        """Layers to count with, before those of "auto" are known."""
        return planned(self.layers)

    @property
    def reader(self) -> Splatter:
        """The splatter that says what is to be found beside samples; the default one where there is none."""
        return self.splatter or check_splatter("auto")

    @property
    def apron(self) -> int:
        """How many cells to sample on each side beyond the image: as many as the splatter reaches, and one more.

        Samples within reach have an effect on the image, and pairing looks at one cell beside theirs.
        """
        return self.reader.reach + 1

    def bands(self, size: tuple[int, int]) -> list[tuple[int, int]]:
        """(first row, number of rows) of the bands in which an image (height, width) is rendered."""
        height, width = size
        if self.side is None or self.side == 1:
            return [(0, height)]
        rows = max(1, BAND // (self.most_layers * self.side**2 * width))
        count = math.ceil(height / rows)
        edges = [height * i // count for i in range(count + 1)]
        return [(top, end - top) for top, end in itertools.pairwise(edges)]
