"""Normal equations of the difference between a splatted image and a target, without its Jacobian.

A sweep goes over bands of rows. The derivatives of a row of a tile along all unknowns are computed as in `stencil.py`
and `mixed_targets.py`, multiplied with one another and with the residuals, and dropped. Bands have a fixed height and
are added in order, so results do not depend on the number of threads.

In a supersampled image several rows of cells make one row of pixels. Their derivatives are averaged to those of the
pixels first, and only these are multiplied.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from rts import Engine, Loss
from rts.plugin_api.arrays import Array
from rts.plugin_api.records import ArraySpec
from rts.plugin_api.threads import parallel, read_only
from rts_backends.fused.cells import Cells, Settings
from rts_backends.fused.crossings import change_of
from rts_backends.fused.image import rows_of
from rts_backends.fused.losses import LINEAR, NUMBERS, cost_and_weight, curvature, in_numbers
from rts_backends.fused.mixed_targets import changes_of, composited
from rts_backends.fused.outlines import gain
from rts_backends.fused.rows import (
    PITCH,
    SOURCE,
    SUMS,
    TILE,
    busy,
    compiled,
    composite,
    fill,
    loop,
    normalised_sums,
)
from rts_backends.fused.stencil import ALPHA, COLORS, TANGENT, change_row, load_tangents
from rts_backends.fused.uniform_cells import BUSY, FLAT

BAND = 16
"""Rows of the image whose products are added up together."""

FINEST = TILE
"""The most cells a pixel, along each axis, that fit into a tile."""

OPACITY = 3 * PITCH
"""Index at which alpha begins among the planes of a row."""


def equations(settings: Settings, engine: Engine, loss: Loss, *given: Any) -> tuple[Array, ...] | None:
    """`normal_equations` of arrays of any engine on the host, traced or not.

    None for arrays on other devices, for positions and rgba that are not both float32 or both float64, for losses that
    are not compiled, or if a pixel has more cells than a tile along an axis.

    Args:
        settings: the splatter, as numbers.
        engine: the engine of the arrays.
        loss: the loss of the residuals.
        *given: positions, rgba, row, part, facing, wanted, settled, exit and the arguments of `normal_equations` from
            `t_positions`, arrays or None.
    """
    positions, rgba, row, _, _, _, _, _, t_positions, _, target = given[:11]
    kind = {32: np.float32, 64: np.float64}.get(engine.namespace.finfo(positions.dtype).bits)
    there = [x for x in given if x is not None]
    if kind is None or rgba.dtype != positions.dtype or loss.name not in NUMBERS or not engine.on_host(*there):
        return None
    if _cells_a_pixel(row.shape, settings.border, target.shape) > FINEST:
        return None
    present = [x is not None for x in given]

    def host(*arrays: Any) -> tuple[np.ndarray, ...]:
        it = iter(arrays)
        whole: list[Any] = [next(it) if there else None for there in present]
        positions, rgba, row, *known = whole[:8]
        used = rows_of(row, *known[3:])  # Under `jit` many more rows may be allotted.
        cells = Cells(settings, positions[:used], rgba[:used], row, None, *known)
        return tuple(np.asarray(x, kind) for x in normal_equations(cells, *whole[8:], loss=loss))

    count = t_positions.shape[0]
    specs = ArraySpec((), kind), ArraySpec((count, count), kind), ArraySpec((count,), kind)
    return engine.call_host(host, specs, *there)


def normal_equations(
    cells: Cells,
    t_positions: np.ndarray,
    t_rgba: np.ndarray | None,
    target: np.ndarray,
    weights: np.ndarray | None,
    background: np.ndarray | None,
    loss: Loss,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean loss of the n residuals r = weight · (image − target); JᵀSJ / n (T, T); and JᵀWr / n (T,), float64.

    Args:
        cells: the samples, s · H times s · W without their border; a pixel of the image is the mean of s² of them.
        t_positions: (T, N, 3), tangents of their positions along T directions.
        t_rgba: (T, N, 4) of their colours; None for zeros.
        target: (H, W, C), of alpha (C = 1), colours (3) or both (4); n = H · W · C.
        weights: (H, W, 1) or (H, W, C); None for ones.
        background: (H, W, 4), the image that this one is composited onto, or None.
        loss: the loss of the residuals; W and S are diagonal matrices of its `weights`.
    """
    count, dtype = len(t_positions), cells.positions.dtype
    if t_rgba is None or not _any(t_rgba):
        t_rgba = np.empty((count, 0, 4), dtype)
    tangents = read_only(t_positions, dtype), read_only(t_rgba, dtype)
    fields = (read_only(np.empty((0, 0, 0)) if x is None else x, dtype) for x in (target, weights, background))
    bands, fine = -(-len(target) // BAND), _cells_a_pixel(cells.row.shape, cells.border, target.shape)
    sums = np.zeros((bands, count + 1, count + 1))
    drawn = cells.plain_grid, cells.grid, cells.choices, cells.outlines, cells.crossings, cells.settled
    given = *drawn, tangents, tuple(fields), in_numbers(loss, dtype), cells.border, fine
    parallel(_accumulate, bands, ALPHA if target.shape[2] == 1 else COLORS, *given, sums)
    total = sums.sum(axis=0) / max(target.size, 1)
    matrix = total[:count, :count]
    return total[count, count], matrix + np.tril(matrix, -1).T, total[count, :count]


def _cells_a_pixel(row: tuple[int, ...], border: int, target: tuple[int, ...]) -> int:
    """The cells of a pixel along each axis, from the shapes of `row` (K, ·, ·) and of the target (H, W, C)."""
    return max(1, (row[1] - 2 * border) // max(target[0], 1))


def _any(tangents: np.ndarray) -> bool:
    """True if any tangent is not zero; tangents of constants may be one array, repeated by a stride of 0."""
    return bool((tangents[:1] if tangents.strides[0] == 0 else tangents).any())


@loop
def _accumulate(
    start, stop, planes, plain, grid, choices, outlines, crossings, settled, tangents, fields, loss, border, fine, sums
):
    """Add to `sums` (B, T + 1, T + 1), zeros, for bands [start, stop): products of T tangents and, last, the residuals.

    Only lower triangles are filled; their last number is the sum of losses.

    Args:
        start: first band, of BAND rows of pixels.
        stop: end of the bands.
        planes: COLORS, or ALPHA for a target of alpha alone.
        plain: `Cells.plain_grid`.
        grid: `Cells.grid`; the next four are attributes of `Cells`, too.
        choices: the mixed targets.
        outlines: the motions of outlines.
        crossings: the targets beside lines of crossing.
        settled: (H, W), or no rows.
        tangents: of positions (T, N, 3), and of rgba (T, N, 4) or, for zeros, (T, 0, 4).
        fields: target, weights and background of `normal_equations`; an absent one has no rows.
        loss: see `in_numbers`.
        border: the border of the cells.
        fine: cells a pixel along each axis; a pixel is their mean.
        sums: to be added to.
    """
    positions, rgba, row = grid.positions, grid.rgba, grid.row
    t_positions, t_rgba = tangents
    target, layers, many = fields[0], len(plain.row), len(t_positions)
    height, width, channels = target.shape
    kind = positions.dtype.type
    sources, value = np.empty(3 * layers * SOURCE, positions.dtype), np.empty(SUMS, positions.dtype)
    moving, change = (
        np.empty((many, 3 * layers * TANGENT), positions.dtype),
        np.empty((many, SUMS), positions.dtype),
    )
    # One for each unknown, one for the residuals, and one for the weights of their loss.
    products = np.empty((many + 2, channels * PITCH), positions.dtype)
    changes = np.empty((many, 3, 5), positions.dtype)
    loaded, least = np.empty(3, np.int64), FLAT if t_rgba.shape[1] > 0 else BUSY
    mean, mean_change = (value, change) if fine == 1 else (np.empty_like(value), np.empty_like(change))
    tiles = (width + TILE // fine - 1) // (TILE // fine)
    for band in range(start, stop):
        top, bottom = band * BAND, min(height, (band + 1) * BAND)
        for t in range(tiles):
            # Columns of pixels, and of cells.
            own, pixels = width * t // tiles, width * (t + 1) // tiles - width * t // tiles
            left, count = own * fine, pixels * fine
            loaded[:] = -9
            changing = False
            for y in range(top * fine, bottom * fine):
                if len(fields[1]) > 0 and not _counts(fields[1][y // fine, own : own + pixels]):
                    continue
                down, right = y + border, left + border
                # Arguments are written out, since numba inlines no calls with *arguments.
                moving_row = busy(choices.states, down, right, count, least)
                moving_row |= busy(choices.mixed, down, right, count, 1)
                if moving_row:
                    window = left + border - 1, count + 2
                    load_tangents(moving, sources, loaded, plain, *tangents, y + border, *window, planes)
                    _change(change, value, sources, moving, layers, y + border, count, planes)
                    _mix(change, value, grid, choices, tangents, border, y, left, count, changes)
                    _move_outlines(change, row, outlines, t_positions, border, y, left, count)
                    _move_lines(change, grid, choices, crossings, tangents, border, y, left, count)
                else:
                    fill(value, rgba, row[0, y + border, border:], choices.states[y + border, border:], left, count)
                if len(settled) > 0:
                    cells = settled[y + border, border + left : border + left + count]
                    moving_row |= _settle(change, value, rgba, t_rgba, cells, moving_row)
                if fine > 1 and y % fine == 0:
                    mean[:] = kind(0)
                    mean_change[:] = kind(0)
                    changing = False
                if fine > 1:
                    _add_means(mean, value, fine, pixels)
                for n in range(many if moving_row and fine > 1 else 0):
                    _add_means(mean_change[n], change[n], fine, pixels)
                changing = moving_row or (fine > 1 and changing)
                if (y + 1) % fine == 0:
                    _multiply(sums[band], products, mean_change, mean, fields, loss, y // fine, own, pixels, changing)


@compiled
def _change(change, value, sources, moving, layers, y, count, planes):
    """Fill `value` and `change`, a row of a tile of the image and its tangents (T, ·), by the stencil.

    `sources` and `moving` (T, ·) are slots that `load_tangents` has filled around row y of the cells.
    """
    normalised_sums(value, sources, layers, y, count)
    for n in range(len(change)):
        change_row(change[n], moving[n], sources, value, layers, y, count, planes)
    composite(value, layers, count)


@compiled
def _add_means(to, row, fine, count):
    """Add a row of cells to `to`, the means of the `count` pixels that it belongs to, `fine` cells to a pixel."""
    share = to.dtype.type(1 / fine**2)
    for c in range(4):
        for j in range(count):
            total, at = to.dtype.type(0), c * PITCH + j * fine
            for i in range(fine):
                total += row[at + i]
            to[c * PITCH + j] += share * total


@compiled
def _mix(change, value, grid, choices, tangents, border, y, left, count, changes):
    """Replace the stencil's `value` and `change` at the mixed targets of a row of a tile.

    `y` and `left`, the row and its first column, do not count the border. `changes` (T, 3, 5) is working memory.
    """
    offsets, columns = choices.offsets, choices.columns
    one = value.dtype.type(1)
    for d in range(offsets[y + border], offsets[y + border + 1]):
        j = columns[d] - border - left
        if not 0 <= j < count:
            continue
        total = choices.sums[d]
        changes_of(changes, total, grid, y + border, columns[d], choices.ranges[d], *tangents)
        for c in range(4):
            back = total[1, c] + (one - total[1, 3]) * total[2, c]
            value[c * PITCH + j] = total[0, c] + (one - total[0, 3]) * back
            for n in range(len(change)):
                change[n, c * PITCH + j] = composited(total, changes[n], c)


@compiled
def _move_outlines(change, row, outlines, t_positions, border, y, left, count):
    """Add the changes by moving outlines to `change` in a row of a tile."""
    for d in range(outlines.offsets[y + border], outlines.offsets[y + border + 1]):
        j = outlines.columns[d] - border - left
        if not 0 <= j < count:
            continue
        for n in range(len(change)):
            front, surface = gain(d, t_positions[n], row, outlines, y + border)
            for c in range(4):
                change[n, c * PITCH + j] += front * outlines.changes[d, 0, c] + surface * outlines.changes[d, 1, c]


@compiled
def _move_lines(change, grid, choices, crossings, tangents, border, y, left, count):
    """Replace `change` at targets beside lines of crossing in a row of a tile."""
    t_positions, t_rgba = tangents
    pixel = np.empty(4, change.dtype)
    for d in range(crossings.offsets[y + border], crossings.offsets[y + border + 1]):
        j = crossings.columns[d] - border - left
        if not 0 <= j < count:
            continue
        for n in range(len(change)):
            change_of(pixel, d, crossings, grid, choices.ranges, choices.sums, y + border, t_positions[n], t_rgba[n])
            for c in range(4):
                change[n, c * PITCH + j] = pixel[c]


@compiled
def _counts(weights):
    """True if any of `weights` (·, C) is not zero."""
    some = False
    for j in range(len(weights)):
        for c in range(weights.shape[1]):
            some |= weights[j, c] != 0
    return some


@compiled
def _settle(change, value, rgba, t_rgba, settled, moving):
    """Fill `value` and `change` at targets of a row of a tile that show a sample's colour: `settled`, its index, or −1.

    Unless `moving`, `change` is cleared before, if colours have tangents. Returns True if the filled tangents may
    differ from zero.
    """
    some, colored = False, t_rgba.shape[1] > 0
    for j in range(len(settled)):
        some |= settled[j] >= 0
    if not some:
        return False
    if colored and not moving:
        change[:] = change.dtype.type(0)
    for j in range(len(settled)):
        i = settled[j]
        if i >= 0:
            for c in range(4):
                value[c * PITCH + j] = rgba[i, c]
                for n in range(len(change) if colored or moving else 0):
                    change[n, c * PITCH + j] = t_rgba[n, i, c] if colored else change.dtype.type(0)
    return colored


@compiled
def _multiply(sums, products, change, value, fields, loss, y, left, count, changing):
    """Add the products of a row of a tile, `count` pixels, to `sums` (T + 1, T + 1).

    Unless `changing`, `change` counts as zeros. `products` (T + 2, ·) is working memory.
    """
    target, weights, background = fields
    channels, many = target.shape[2], len(change)
    first, one = 3 if channels == 1 else 0, value.dtype.type(1)
    for c in range(channels):
        p, own = (first + c) * PITCH, c * count
        for n in range(0 if changing else many, many + 1):
            to, shown = products[n, own : own + count], len(background) > 0
            if n < many:
                # A loop, since for assigned arrays numba also compiles an error about their shapes: a second.
                for j in range(count):
                    to[j] = change[n, p + j]
                for j in range(count if shown else 0):
                    to[j] -= change[n, OPACITY + j] * background[y, left + j, first + c]
            else:
                for j in range(count):
                    to[j] = value[p + j] - target[y, left + j, c]
                for j in range(count if shown else 0):
                    to[j] += (one - value[OPACITY + j]) * background[y, left + j, first + c]
            if len(weights) > 0:
                w = min(c, weights.shape[2] - 1)
                for j in range(count):
                    to[j] *= weights[y, left + j, w]
    start, stop = 0 if changing else many, many + 1
    if loss[0] != LINEAR:
        sums[many, many] += _weigh(products[start:], many - start, loss, channels * count)
        stop = many
    for a in range(start, many + 1):
        for b in range(start, min(a + 1, stop)):
            sums[a, b] += _dot(products[a], products[b], channels * count)


@compiled
def _weigh(products, many, loss, count):
    """Scale tangents and residuals, in place, to those of a loss's normal equations; return the sum of losses.

    Args:
        products: (many + 2, ·), tangents, residuals, and a row that is overwritten.
        many: number of tangents.
        loss: see `in_numbers`.
        count: numbers in each row.
    """
    total, residuals, roots = 0.0, products[many], products[many + 1]
    for j in range(count):
        cost, weight = cost_and_weight(residuals[j], loss)
        total += cost
        roots[j] = math.sqrt(curvature(weight, loss))
        # A weight too small for the dtype is zero: the residual counts in the loss alone.
        residuals[j] *= weight / roots[j] if roots[j] > 0 else roots[j]
    for n in range(many):
        for j in range(count):
            products[n, j] *= roots[j]
    return total


@compiled(fastmath={"contract", "reassoc"})
def _dot(a, b, count):
    """The sum of products, in an order that suits vector instructions."""
    total = a.dtype.type(0)
    for j in range(count):
        total += a[j] * b[j]
    return total
