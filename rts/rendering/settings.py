"""Settings of a render, beside the scene: splatter, layers, supersampling and capacity."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

from rts.compiling.threads import thread_count
from rts.contracts.checks import check_size, check_splatter
from rts.contracts.splatter import Splatter
from rts.outlines.required import Required
from rts.plugin_base import promised
from rts.sampling.layer_count import TRACED_LAYERS
from rts.sampling.scene import Grid, Scene
from rts.scene.camera import Camera

BAND = 2**20
"""Number of cells, over all layers, above which a supersampled image is rendered in bands of rows."""

BORDER = 2
"""Cells sampled beyond each side of the image where no splatter tells its reach."""

OUTLINES_BORDER = 1
"""How many more are sampled where outlines are found: how an outline turns within the dual cells of the outermost cells
is told by the two crossings that come next along it, the second of which is two dual cells farther out. So a window, or
a view beside others, shows of them what the whole image does."""


@dataclass(frozen=True)
class RenderSettings:
    """Checked settings of a render.

    Attributes:
        splatter: the splatter that samples are for; None for any splatter.
        layers: K, or "auto".
        supersample: samples along each side of a pixel.
        capacity: rows to allot for the samples of a part; None for as many as there are.
        fronts: whether outputs of the samples in front are asked for: each cell then has a sample of its own, and
            triangles are told, counted by part.
    """

    splatter: Splatter | None
    layers: int | Literal["auto"]
    supersample: int
    capacity: int | None
    fronts: bool = False

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
            InputError: an argument is of another kind, or makes no image; or RTS_NUM_THREADS is no positive integer.
        """
        thread_count()  # Refused here, before anything is sampled.
        size = check_size(size, layers, capacity, supersample)
        layers = layers if layers == "auto" else int(layers)
        return size, cls(check_splatter(splatter), layers, int(supersample), capacity)

    def of(self, scene: Scene) -> RenderSettings:
        """The settings with the number of layers that the splatter reads of a scene; "auto" where it is to be found."""
        layers, opaque, splatter, most = self.layers, all(scene.opaque), self.splatter, None
        if splatter is not None and (opaque or not promised(splatter, "translucent")):
            most = splatter.layers
        if layers == "auto" and most != 1 and scene.traced:
            layers = TRACED_LAYERS[opaque]
        if most is not None:
            layers = most if layers == "auto" else min(most, int(layers))
        given = self.supersample, self.capacity, self.fronts
        return self if layers == self.layers else RenderSettings(splatter, layers, *given)

    @property
    def finds_outlines(self) -> bool:
        """True if the splatter reads the outlines between centres."""
        return self.splatter is not None and "outlines" in self.splatter.reads

    def required(self, scenes: Sequence[Scene] | None) -> Required:
        """The tasks of samples beside outlines in views of a scene; with None, for any shaders and derivatives."""
        centers = self.splatter is not None and "colors at centers" in self.splatter.reads
        return Required(centers=centers) if scenes is None else Required.of(scenes, centers)

    @property
    def most_layers(self) -> int:
        """The number of layers to plan memory for; with "auto" that of traced values."""
        return TRACED_LAYERS[False] if self.layers == "auto" else self.layers

    @property
    def border(self) -> int:
        """Number of cells sampled beyond each side of the image: the splatter's reach plus one, and `OUTLINES_BORDER`.

        Samples within reach affect the image, and splatters may read one cell beside theirs.
        """
        if self.splatter is None:
            return BORDER
        return self.splatter.reach + 1 + (OUTLINES_BORDER if "outlines" in self.splatter.reads else 0)

    def grid(self, scene: Scene, camera: Camera, size: tuple[int, int]) -> Grid:
        """The cells of an image (height, width) of a scene, or of a window of it, through its camera."""
        cells = self.supersample * size[0], self.supersample * size[1]
        return Grid.of_parts(scene.parts, camera, cells, self.border, scene.context)

    def bands(self, size: tuple[int, int]) -> list[tuple[int, int]]:
        """(first row, number of rows) of each band of an image (height, width).

        A band is rendered at a time. With one sample a pixel there is one band.
        """
        height, width = size
        if self.supersample == 1:
            return [(0, height)]
        rows = max(1, BAND // (self.most_layers * self.supersample**2 * width))
        count = math.ceil(height / rows)
        edges = [height * i // count for i in range(count + 1)]
        return [(top, end - top) for top, end in itertools.pairwise(edges)]
