"""Normal equations of an image: columns of its Jacobian, in pixels that change, and their products. On the host."""

from __future__ import annotations

from typing import Any

import numpy as np

from rts.compiling.threads import read_only
from rts.contracts.records import Stencil
from rts.splatting.stencil import SPLAT


def normal_equations(
    positions: np.ndarray,
    rgba: np.ndarray,
    row: np.ndarray,
    stencil: Stencil,
    t_positions: np.ndarray,
    t_rgba: np.ndarray | None,
    target: np.ndarray,
    weights: np.ndarray | None,
    background: np.ndarray | None,
    border: int,
    loss: Any,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """See `SummingSplatter.normal_equations`; `row` (H, W) are the samples of cells, and operands are host arrays."""
    from rts.splatting import stencil_loops as loops

    (height, width, channels), side = target.shape, (row.shape[0] - 2 * border) // target.shape[0]
    target = target.reshape(height * width, -1)
    weights, background = (None if x is None else x.reshape(height * width, -1) for x in (weights, background))

    def compared(image: np.ndarray, behind: float, at: Any) -> np.ndarray:
        """The channels of pixels `at` that are compared, over the background; `behind` is 0 for tangents."""
        if background is not None:
            image = image + (behind - image[..., -1:]) * background[at]
        image = image[..., -1:] if channels == 1 else image[..., :channels]
        return image if weights is None else image * weights[at]

    entries = [getattr(stencil, name) for name in loops.Matrix._fields[1:]]
    operands = tuple(map(read_only, (positions, rgba, row, *entries)))
    image, _ = SPLAT.value_on_host(operands, {"border": border, "supersample": side})
    image = image.reshape(height * width, -1)
    r = compared(image, 1.0, slice(None)) - (target if weights is None else target * weights)
    # Derivatives are zero but in these cells, pixel after pixel.
    even = t_rgba is None and bool((rgba == rgba[:1]).all())
    cells, pixels, first = _changing(stencil, row, (height, width, side, border), even)
    changes = np.empty((len(t_positions), len(cells), rgba.shape[1]), rgba.dtype)
    t_colors = np.empty((0, 0, rgba.shape[1]), rgba.dtype) if t_rgba is None else t_rgba
    loops.columns(cells, operands[1], loops.Matrix(*operands[2:]), read_only(t_positions), read_only(t_colors), changes)
    if side > 1 and len(first):
        changes = np.add.reduceat(changes, first, axis=1) / side**2
    jacobian = compared(changes, 0.0, pixels).reshape(len(t_positions), -1)
    here, size = r[pixels].reshape(-1), r.size
    value = np.mean(r * r) if loss is None else loss(r.reshape(-1))
    if loss is not None and loss.robust and here.size:
        w, curvatures = loss.weights(here)
        return np.asarray(value), (jacobian * curvatures) @ jacobian.T / size, jacobian @ (w * here) / size
    return np.asarray(value), jacobian @ jacobian.T / size, jacobian @ here / size


def _changing(
    stencil: Stencil, row: np.ndarray, grid: tuple[int, int, int, int], even: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The cells whose colours may change, by pixels.

    Args:
        stencil: on the host.
        row: (H, W) int32.
        grid: height and width of the image in pixels, cells along the side of a pixel, and cells of its border.
        even: True if all samples have one constant colour, so that nothing changes but at outlines.

    Returns:
        Flat indices (n,) of cells; the flat indices (m,) of their pixels; and for each pixel its first place in cells.
    """
    height, width, side, border = grid
    changing = np.zeros(row.shape, bool) if even else row >= 0
    changing.reshape(-1)[stencil.motion_cell] = True
    if not even:
        changing.reshape(-1)[stencil.color_cell] = True
    y, x = changing[border : border + height * side, border : border + width * side].nonzero()
    pixel = (y // side) * width + x // side
    order = np.argsort(pixel, kind="stable")
    pixels, first = np.unique(pixel[order], return_index=True)
    cells = (y + border) * row.shape[1] + x + border
    return cells[order], pixels, first
