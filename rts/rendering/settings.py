"""Settings of a render, beside the scene: splatter, layers, supersampling and capacity."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace
from typing import Any, Literal

from rts.contracts.checks import check_size, check_splatter, is_auto, splatter_of
from rts.contracts.splatter import Splatter
from rts.errors import InputError
from rts.plugin_base import promised
from rts.registry import name_of
from rts.rendering.scene import Scene
from rts.sampling.adaptive import Adaptive
from rts.sampling.hidden import TRACED_LAYERS, planned

BAND = 2**20
"""Number of cells, over all layers, above which a supersampled image is rendered in bands of rows."""


@dataclass(frozen=True)
class RenderSettings:
    """Checked settings of a render.

    Attributes:
        splatter: the splatter that samples are for; "auto" until the scene is known, see `of`; None for any splatter,
            so that no sample may be left out.
        layers: K, or "auto".
        supersample: samples along each side of a pixel, or an `Adaptive`.
        capacity: rows to allot for the samples of a part; None for as many as there are.
    """

    splatter: Splatter | Literal["auto"] | None
    layers: int | Literal["auto"]
    supersample: int | Adaptive
    capacity: int | None

    @classmethod
    def checked(
        cls, size: Any, splatter: Any, layers: Any, supersample: Any, capacity: Any
    ) -> tuple[tuple[int, int], RenderSettings]:
        """(height, width) as integers, and the settings.

        Args:
            size: (height, width), as the user gave it.
            splatter: name or object of a splatter.
            layers: as in `rts.render`.
            supersample: as in `rts.render`.
            capacity: as in `rts.render`.

        Raises:
            InputError: an argument is of another kind, or makes no image; or a splatter that finds outlines is to have
                an `Adaptive`.
        """
        finest = supersample.samples if isinstance(supersample, Adaptive) else supersample
        size = check_size(size, layers, capacity, finest)
        if not isinstance(supersample, Adaptive):
            supersample = int(supersample)
        adaptive = isinstance(supersample, Adaptive)
        if is_auto(splatter) and not adaptive:
            return size, cls("auto", layers if is_auto(layers) else int(layers), supersample, capacity)
        splatter = splatter_of(splatter, outlines=False)
        if adaptive and "outlines" in splatter.reads:
            raise InputError(
                f"supersample is {supersample!r}, and splatter {name_of('rts.splatters', splatter)!r} finds outlines "
                f"without further samples; give 1, or a number of samples along each side of a pixel"
            )
        settings = cls(splatter, layers if is_auto(layers) else int(layers), supersample, capacity)
        return size, settings._of_most(None if promised(splatter, "translucent") else splatter.layers)

    def of(self, scene: Scene) -> RenderSettings:
        """The settings for a scene: with a splatter, and a number of layers where values are traced.

        "auto" is "edges", but "visible" where no samples can be added.
        """
        splatter, layers, opaque = self.splatter, self.layers, all(scene.opaque)
        if splatter == "auto":
            splatter = splatter_of("auto", outlines=scene.joinable)
        if layers == "auto" and scene.traced:
            layers = TRACED_LAYERS[opaque]
        settings = replace(self, splatter=splatter, layers=layers)
        return settings._of_most(splatter.layers) if splatter and opaque else settings

    def _of_most(self, most: int | None) -> RenderSettings:
        """The settings with no more layers than are read; None for all."""
        if most is None:
            return self
        return replace(self, layers=most if self.layers == "auto" else min(most, int(self.layers)))

    @property
    def side(self) -> int | None:
        """Number of cells along each side of a pixel; None for `Adaptive`."""
        return None if isinstance(self.supersample, Adaptive) else self.supersample

    @property
    def finds_outlines(self) -> bool:
        """True if the splatter reads the outlines between centres."""
        return "outlines" in self.reader.reads

    @property
    def contrast(self) -> float | None:
        """The contrast above which `Adaptive` takes more samples; None if contrast does not matter."""
        return self.supersample.contrast if isinstance(self.supersample, Adaptive) else None

    @property
    def thin(self) -> bool:
        """True if `Adaptive` looks for what falls between centres."""
        return isinstance(self.supersample, Adaptive) and self.supersample.thin

    @property
    def most_layers(self) -> int:
        """The number of layers to plan for; with "auto" an estimate."""
        return planned(self.layers)

    @property
    def reader(self) -> Splatter:
        """The splatter whose `reads` and `reach` guide sampling: the given one, or the one that reads most."""
        return self.splatter if isinstance(self.splatter, Splatter) else check_splatter("visible")

    @property
    def apron(self) -> int:
        """Number of cells sampled beyond each side of the image: the splatter's reach plus one.

        Samples within reach affect the image, and pairing reads one cell beside theirs.
        """
        return self.reader.reach + 1

    def bands(self, size: tuple[int, int]) -> list[tuple[int, int]]:
        """(first row, number of rows) of each band of an image (height, width).

        A band is rendered at a time. With one sample a pixel, or `Adaptive`, there is one band.
        """
        height, width = size
        if self.side is None or self.side == 1:
            return [(0, height)]
        rows = max(1, BAND // (self.most_layers * self.side**2 * width))
        count = math.ceil(height / rows)
        edges = [height * i // count for i in range(count + 1)]
        return [(top, end - top) for top, end in itertools.pairwise(edges)]
