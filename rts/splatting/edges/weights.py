"""The image of `rts.splatting.edges` by compiled loops: weights of colours and motions, and sums of what they weigh.

An image is linear in colours; and, with their values as constants, linear in the motions of samples. The weights follow
from outlines alone. They are computed once, for the value, and used again by the derivatives.
"""

from __future__ import annotations

from dataclasses import MISSING, fields, replace
from typing import Any, NamedTuple

import numpy as np

from rts.compiling.threads import parallel, read_only
from rts.contracts.records import OF_SEGMENTS, Outlines
from rts.operations.operation import Arrays, Some

BORDER = 1e-3
"""Width, in cells, of the strip along a border of two pixels in which an edge belongs to both."""

NOWHERE = np.empty((0, 2, 2))
"""In place of points, for tangents."""


OF_ROWS = tuple(field.name for field in fields(Outlines) if field.default is MISSING and field.name != "joined")
"""The fields of the outlines of one layer that have a row for each break, or for each segment."""


class _Weights(NamedTuple):
    """The weights of colours and motions in the image, from outlines alone; see `rts.splatting.edges.weights_loops`.

    Attributes:
        shown: (B, 2) int32, the samples that tell colours before and behind breaks, or −1.
        points: (B, 2, 2), x and y of the last samples.
        movers: (B, 2) int32, the samples that breaks move with, or −1: the last ones, or a pair.
        origins: (B, 2, 2), x and y of these.
        moves: (B, 2, 3, 2).
        share: (S, 4, 2).
        cell_side: (S, 4, 2) int8.
        lost: (S, 4, 2).
        flux: (S, 4, 2, 4, 2).
        cells: (B, 2, 3) int32.
        sides: (B, 2, 5).
    """

    shown: np.ndarray
    points: np.ndarray
    movers: np.ndarray
    origins: np.ndarray
    moves: np.ndarray
    share: np.ndarray
    cell_side: np.ndarray
    lost: np.ndarray
    flux: np.ndarray
    cells: np.ndarray
    sides: np.ndarray

    @classmethod
    def of(cls, outlines: Outlines) -> _Weights:
        """The weights of outlines on the host."""
        from rts.splatting.edges import weights_loops as loops

        count, segments, gap = len(outlines.place), len(outlines.square), outlines.gap
        shown, movers, near = np.empty((count, 2), np.int32), np.empty((count, 2), np.int32), outlines.near
        points, origins = np.empty((count, 2, 2)), np.empty((count, 2, 2))
        moves, cells, sides = np.empty((count, 2, 3, 2)), np.empty((count, 2, 3), np.int32), np.empty((count, 2, 5))
        share, flux = np.empty((segments, 4, 2)), np.empty((segments, 4, 2, 4, 2))
        cell_side, lost = np.empty((segments, 4, 2), np.int8), np.empty((segments, 4, 2))
        of_samples = outlines.rows, outlines.inner, outlines.pair, outlines.points
        loops.weigh_breaks(gap, near, outlines.slope, *of_samples, shown, points, movers, origins, moves)
        ties = outlines.ties
        geometry = ties, outlines.square_sides, outlines.hub, outlines.corner, outlines.pull
        known = outlines.square, *geometry, share, cell_side, lost, flux
        seen = outlines.rows >= 0
        at = outlines.place, gap, outlines.ends, seen
        parallel(loops.weigh_segments, segments, BORDER, *at, *known, work=250 * segments)
        normal = np.empty((count, 2))
        loops.weigh_sides(*at, ties, outlines.joined, normal, cells, sides)
        return cls(shown, points, movers, origins, moves, share, cell_side, lost, flux, cells, sides)


def forward(operands: Arrays, out: np.ndarray, border: int) -> _Weights:
    """The value, and the weights, which the derivatives use again."""
    from rts.splatting.edges import sums_loops as loops

    positions, rgba, row, *arrays = operands
    outlines = _effective(Outlines(*arrays))
    parallel(loops.inside, len(out), border, positions, rgba, row, outlines.joined, out, work=2 * out.size)
    weights = _Weights.of(outlines)
    steady, motion = _jumps(rgba, weights), np.empty((len(weights.shown), 2))
    loops.motions(positions, weights.movers, weights.origins, weights.moves, motion)
    _add(outlines, weights, row, (rgba, positions, weights.points), (rgba, steady, steady, motion), out, border)
    loops.settle(border, outlines.square, 8 * np.finfo(out.dtype).eps, out)
    return weights


def push(operands: Arrays, tangents: Some, out: np.ndarray, border: int, kept: _Weights | None) -> None:
    """The derivative of the value along tangents of positions and colours."""
    from rts.splatting.edges import sums_loops as loops

    positions, rgba, row, *arrays = operands
    outlines = _effective(Outlines(*arrays))
    weights = kept or _Weights.of(outlines)
    t_positions, t_rgba = (read_only(np.empty((0, 3), out.dtype) if t is None else t) for t in tangents)
    of_cells = rgba, row, outlines.joined, t_positions, t_rgba
    parallel(loops.push_inside, len(out), border, *of_cells, out, work=2 * out.size)
    _push_outlines(operands, (t_positions, t_rgba), outlines, weights, out, border)


def _push_outlines(
    operands: Arrays, tangents: Some, outlines: Outlines, weights: _Weights, out: np.ndarray, border: int
) -> None:
    """Add to a derivative (h, w, C) what changes at outlines; arguments as of `push`."""
    from rts.splatting.edges import sums_loops as loops

    _, rgba, row, *_ = operands
    t_positions, t_rgba = (read_only(np.empty((0, 3), out.dtype) if t is None else t) for t in tangents)
    steady, motion = _jumps(rgba, weights), np.empty((len(weights.shown) if len(t_positions) else 0, 2))
    if len(t_positions):
        loops.motions(t_positions, weights.movers, NOWHERE, weights.moves, motion)
    jump = _jumps(t_rgba, weights) if len(t_rgba) else np.empty((0, out.shape[2]))
    _add(outlines, weights, row, (t_rgba, t_positions, NOWHERE), (rgba, jump, steady, motion), out, border)


def _add(
    outlines: Outlines, weights: _Weights, row: np.ndarray, samples: Arrays, jumps: Arrays, out: np.ndarray, border: int
) -> None:
    """Add the changes at outlines to an image.

    Args:
        outlines: on the host.
        weights: of these outlines.
        row: (H, W).
        samples: colours and positions, or their tangents, and points, or none; see `sums_loops.add_sides`.
        jumps: constant colours; jumps, constant jumps and motions, see `sums_loops.add_segments`.
        out: (h, w, C).
        border: cells around the image.
    """
    from rts.splatting.edges import sums_loops as loops

    (rgba, positions, points), (steady, *at_breaks) = samples, jumps
    loops.add_segments(border, *_segments(outlines, weights, row), rgba, *at_breaks, out)
    sides = border, row, outlines.rows, weights.shown, weights.cells, weights.sides
    loops.add_sides(*sides, steady, rgba, positions, points, out)


def pull(operands: Arrays, g: np.ndarray, results: Some, border: int, kept: _Weights | None) -> None:
    """The gradients of positions and colours."""
    from rts.splatting.edges import sums_loops as loops

    positions, rgba, row, *arrays = operands
    outlines, g = _effective(Outlines(*arrays)), read_only(g)
    weights = kept or _Weights.of(outlines)
    g_positions, g_rgba = (np.empty((0, 3), g.dtype) if x is None else x for x in results)
    loops.pull_inside(border, rgba, row, outlines.joined, g, g_positions, g_rgba)
    count, steady = len(weights.shown), _jumps(rgba, weights)
    g_jump, g_motion = np.zeros((count if len(g_rgba) else 0, g.shape[2])), np.zeros((len(g_positions) and count, 2))
    loops.pull_segments(border, *_segments(outlines, weights, row), steady, g, g_rgba, g_jump, g_motion)
    if len(g_positions):
        loops.pull_motions(weights.movers, weights.moves, g_motion, g_positions)
    if len(g_rgba):
        loops.pull_jumps(weights.shown, g_jump, g_rgba)
    sides = border, row, outlines.rows, weights.shown, weights.cells, weights.sides
    loops.pull_sides(*sides, rgba, g, g_rgba, g_positions)


def normal_equations(
    operands: Arrays, others: Arrays, border: int, loss: Any
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """`SummingSplatter.normal_equations` on the host, by tangents of the pixels that may change.

    `operands` are those of `forward`; `others` are t_positions, t_rgba, target, weights and background, or None.
    """
    t_positions, t_rgba, *fields = others
    positions, rgba, row, *arrays = operands
    (height, width, channels), side = fields[0].shape, (row.shape[0] - 2 * border) // fields[0].shape[0]
    target, weights, background = (None if x is None else x.reshape(height * width, -1) for x in fields)

    def compared(image: np.ndarray, behind: float, at: Any) -> np.ndarray:
        """The channels of pixels `at` that are compared, over the background; `behind` is 0 for tangents."""
        if background is not None:
            image = image + (behind - image[:, -1:]) * background[at]
        image = image[:, -1:] if channels == 1 else image[:, :channels]
        return image if weights is None else image * weights[at]

    image = np.empty((*row.shape, rgba.shape[1]), rgba.dtype)
    kept = forward(operands, image, 0)
    whole = image[border : border + height * side, border : border + width * side]
    if side > 1:
        whole = whole.reshape(height, side, width, side, -1).mean((1, 3))
    whole = whole.reshape(height * width, -1)
    r = compared(whole, 1.0, slice(None)) - (target if weights is None else target * weights)
    # Derivatives are zero but in these cells, pixel after pixel.
    outlines = _effective(Outlines(*arrays))
    even = t_rgba is None and bool((rgba == rgba[:1]).all())
    cells, pixels, first = _reached(outlines, kept, row, (height, width, side, border), even)
    jacobian = np.empty((len(t_positions), len(first) * channels), rgba.dtype)
    flat = image.reshape(-1, rgba.shape[1])
    for i, tangent in enumerate(t_positions):
        tangents = tangent, None if t_rgba is None else t_rgba[i]
        if even:
            flat[cells] = 0.0
            _push_outlines(operands, tangents, outlines, kept, image, 0)
        else:
            push(operands, tangents, image, 0, kept)
        changes = flat[cells]
        if side > 1 and len(first):
            changes = np.add.reduceat(changes, first, axis=0) / side**2
        jacobian[i] = compared(changes, 0.0, pixels).reshape(-1)
    here, size = r[pixels].reshape(-1), r.size
    value = np.mean(r * r) if loss is None else loss(r.reshape(-1))
    if loss is not None and loss.robust and here.size:
        w, curvatures = loss.weights(here)
        return np.asarray(value), (jacobian * curvatures) @ jacobian.T / size, jacobian @ (w * here) / size
    return np.asarray(value), jacobian @ jacobian.T / size, jacobian @ here / size


def _reached(
    outlines: Outlines, weights: _Weights, row: np.ndarray, grid: tuple[int, int, int, int], even: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The cells whose colours may change, by pixels.

    Args:
        outlines: on the host.
        weights: of these outlines.
        row: (H, W) int32.
        grid: height and width of the image in pixels, cells along the side of a pixel, and cells of its border.
        even: True if all samples have one constant colour, so that nothing changes but at outlines.

    Returns:
        Flat indices (n,) of cells; the flat indices (m,) of their pixels; and for each pixel its first place in cells.
    """
    height, width, side, border = grid
    reached = np.zeros(row.shape, bool) if even else row >= 0
    y, x = outlines.square.T
    for down, right in ((0, 0), (0, 1), (1, 0), (1, 1)):
        reached[y + down, x + right] = True
    beside = weights.cells[weights.cells[:, :, 0] >= 0]
    reached.reshape(-1)[beside[:, :2]] = True
    y, x = reached[border : border + height * side, border : border + width * side].nonzero()
    pixel = (y // side) * width + x // side
    order = np.argsort(pixel, kind="stable")
    pixels, first = np.unique(pixel[order], return_index=True)
    cells = (y + border) * row.shape[1] + x + border
    return cells[order], pixels, first


def _effective(outlines: Outlines) -> Outlines:
    """Outlines without their last rows that have no effect, for which compiled programs have room."""
    from rts.splatting.edges import weights_loops as loops

    breaks, segments = loops.in_use(outlines.ends, outlines.ties, outlines.beyond)
    if breaks == len(outlines.ends) and segments == len(outlines.ties):
        return outlines
    cut = {name: getattr(outlines, name)[: segments if name in OF_SEGMENTS else breaks] for name in OF_ROWS}
    return replace(outlines, **cut)


def _segments(outlines: Outlines, weights: _Weights, row: np.ndarray) -> tuple[np.ndarray, ...]:
    """The first operands of `sums_loops.add_segments`."""
    ties = outlines.square, outlines.ties, outlines.beyond
    return *ties, weights.share, weights.cell_side, weights.lost, weights.flux, row, weights.shown


def _jumps(rgba: np.ndarray, weights: _Weights) -> np.ndarray:
    """(B, C) colours before breaks, less those behind."""
    from rts.splatting.edges import sums_loops as loops

    found = np.empty((len(weights.shown), rgba.shape[1]))
    loops.jumps(rgba, weights.shown, found)
    return found
