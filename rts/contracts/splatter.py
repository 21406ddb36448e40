"""The base classes of splatters, which turn `Splats` (see `records.py`) into an image."""

from __future__ import annotations

import abc
from typing import Any, final

import numpy as np

from rts.arrays.array_functions import described, from_numbers, shape_of, without_border
from rts.arrays.engines import constants, engine_of, exemplar, namespace
from rts.arrays.trees import Array
from rts.contracts.records import Cells, Splats
from rts.errors import InputError
from rts.plugin_base import Plugin


class Splatter(Plugin):
    """The step from shaded samples to an image that has derivatives at occlusion boundaries.

    Attributes:
        layers: the number of layers it reads, from the front; None for all. A `translucent` splatter reads all layers
            where light passes through some part.
        reach: the largest distance, in cells along either axis, at which a sample has an effect; at least 1.
        reads: "outlines", if it reads `Splats.stencil`: outlines are found for no other; and with it "colors at
            centers", if colours beside them may be those of centres nearby, which saves samples.
        translucent: a promise that samples behind others show as far as alpha lets light through, in all their layers,
            if `Splats.opaque` is False. Without it an image of translucent samples comes with a `LayersWarning`.
        any_channels: a promise that `image` takes any number of channels at once, alpha last. Without it, it is given
            three of them at a time, and alpha.
    """

    layers: int | None = None
    reach: int = 1
    reads: frozenset[str] = frozenset()
    translucent: bool = False
    any_channels: bool = False

    @abc.abstractmethod
    def image(self, splats: Splats) -> Array:
        """The image of all cells, those of the border included: (H, W, 4) premultiplied RGBA.

        For a splatter that takes `any_channels` (H, W, C + 1), as `Splats.rgba` is.
        """

    def cropped(self, splats: Splats) -> Array:
        """The result of `image` with the border cut off: (H − 2 border, W − 2 border, 4). Override to save a copy.

        What overrides it may give the image of pixels in place of cells, the means of `Splats.supersample`² each.
        """
        image = self.image(splats)
        if len(shape_of(image)) != 3:
            raise InputError(f"the image of {self!r} {described(image)}; expected (H, W, C), with the border")
        return without_border(image, splats.border)

    @final
    def splat(self, positions: Array, rgba: Array, row: Array, border: int = 0, opaque: bool = True) -> Array:
        """Splat packed samples; for direct calls, with arrays of any engine, lists and numbers.

        Args:
            positions: (N, 3) x and y in cells from the corner of the grid, border included, and linear depth.
            rgba: (N, 4) premultiplied.
            row: (K, H, W) int32, the index of the sample of each cell, front to back, or −1.
            border: cells at each side that splat into the image but are no part of it.
            opaque: a promise that alpha is 1. With False, light passes through samples, if the splatter is
                `translucent`.

        Returns:
            (H − 2 border, W − 2 border, 4) premultiplied RGBA.

        Raises:
            InputError: wrong shapes, or `row` holds no signed integers.
            EngineError: arrays of two engines.
        """
        return self.cropped(_checked_splats(positions, rgba, row, border).replace(opaque=opaque))


class SummingSplatter(Splatter):
    """A splatter that sums up the normal equations of an image without its Jacobian."""

    @abc.abstractmethod
    def normal_equations(
        self,
        splats: Splats,
        t_positions: Array,
        t_rgba: Array | None,
        target: Array,
        weights: Array | None = None,
        background: Array | None = None,
        loss: Any = None,
    ) -> tuple[Array, Array, Array] | None:
        """Normal equations of the n residuals weight · (image − target), without their Jacobian.

        Args:
            splats: the samples; without the border there are s h × s w cells, and a pixel is the mean of s × s.
            t_positions: (T, N, 3), tangents of positions along T directions.
            t_rgba: (T, N, 4), tangents of colours; None for zeros.
            target: (h, w, C), alpha (C = 1), colours (3) or both (4) of h × w pixels.
            weights: (h, w, 1) or (h, w, C); None for ones.
            background: (h, w, 4), composited under the image, or None.
            loss: of the residuals, an `rts.Loss`; None for the square.

        Returns:
            Mean loss (), JᵀSJ / n (T, T) and JᵀWr / n (T,), where W and S are diagonals of `loss.weights(r)`, ones for
            the square. None if this splatter cannot work on these arrays.
        """


def _checked_splats(positions: Any, rgba: Any, row: Any, border: int) -> Splats:
    """Splats of arrays, or of lists, all of one engine; wrong shapes and dtypes are refused."""
    floats = from_numbers(positions, "positions"), from_numbers(rgba, "rgba")
    row = np.asarray(from_numbers(row, "row"), np.int32) if isinstance(row, (list, tuple)) else from_numbers(row, "row")
    shapes = [shape_of(x) for x in (*floats, row)]
    ok = len(shapes[0]) == 2 and shapes[0][1] == 3 and shapes[1] == (shapes[0][0], 4) and len(shapes[2]) == 3
    if not ok or shapes[2][0] < 1:
        raise InputError(
            f"positions, rgba and row have shapes {shapes[0]}, {shapes[1]}, {shapes[2]}; "
            f"expected (N, 3), (N, 4), (K, H, W)"
        )
    if not namespace(row).isdtype(row.dtype, "signed integer"):
        raise InputError(f"row has dtype {row.dtype}; expected signed integers, -1 where a cell is empty")
    positions, rgba, row = constants((*floats, row), engine_of(floats, row), exemplar(floats))
    return Splats(positions, rgba, Cells(row), border=border)
