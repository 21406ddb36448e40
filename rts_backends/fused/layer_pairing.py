"""Pairing of layers where those of different surfaces meet.

A target is mixed where one of its sources is not paired front to front. Few targets are mixed. Each has a table of its
own: for every source and each of the buffers in front, at the surface and behind, a range of the source's layers.

Depths are compared in the dtype of the positions and in the order of `rts.splatting`, so that ties fall alike.
"""

from __future__ import annotations

import numpy as np

from rts.plugin_api.loops import compiled, loop
from rts.plugin_api.records import Cells
from rts_backends.fused.mixed_targets import sums_of
from rts_backends.fused.pairs import BLOCK, mark
from rts_backends.fused.uniform_cells import BUSY, EMPTY

MORE_BEHIND = Cells.MORE_BEHIND


@loop
def find(start, stop, positions, row, beyond, hidden, states, mixed, counts):
    """Mark mixed targets (H, W) of `Multi`, and count them by row. `survey` finds those of `Visible`.

    Args:
        start: first row.
        stop: end of the rows.
        positions: (N, 3).
        row: (K, H, W).
        beyond: depth of layers that are not covered; no two layers are farther apart than each is from it.
        hidden: (H, B) uint8, the blocks of columns in or beside which hidden layers are covered.
        states: (H, W) of `uniform_cells.py`.
        mixed: (H, W) uint8, to be filled.
        counts: (H,) zeros, to be filled.
    """
    layers, height, width = row.shape
    blocks, kind = hidden.shape[1], positions.dtype
    z, target = np.empty((3, layers, width + 2), kind), np.empty((layers, BLOCK), kind)
    asked, loaded = np.empty(blocks, np.uint8), np.full((3, blocks), -9, np.int64)
    for y in range(start, stop):
        for b in range(blocks):
            near = hidden[max(y - 1, 0), b] | hidden[y, b] | hidden[min(y + 1, height - 1), b]
            asked[b] = near | np.uint8(_any(states[y, b * BLOCK : (b + 1) * BLOCK]))
        counts[y] = mark(mixed[y], asked, positions, row, y, beyond, z, loaded, target)


@compiled
def _any(states):
    most = np.uint8(0)
    for state in states:
        most = max(most, state)
    return most == BUSY


@loop
def narrow(start, stop, mixed, wanted, kept, counts):
    """Copy the marks `mixed` of rows [start, stop) to `kept`, without targets that decide nothing for wanted ones.

    Those have no wanted target within two cells: the motion of an outline depends on pairs so far away.

    Args:
        start: first row.
        stop: end of the rows.
        mixed: (H, W) uint8, of `find` or `uniform_cells.survey`.
        wanted: (H, W) uint8, 1 for wanted targets.
        kept: (H, W) uint8, to be filled.
        counts: (H,), to be filled with the number of marks kept in each row.
    """
    height, width = mixed.shape
    for y in range(start, stop):
        counts[y] = 0
        for x in range(width):
            kept[y, x] = 0
            for v in range(max(y - 2, 0), min(y + 3, height) if mixed[y, x] else 0):
                for u in range(max(x - 2, 0), min(x + 3, width)):
                    kept[y, x] |= wanted[v, u]
            counts[y] += kept[y, x]


@loop
def choose(
    start,
    stop,
    grid,
    facing,
    visible,
    continued,
    beyond,
    mixed,
    offsets,
    columns,
    choices,
    sums,
    states,
    ends,
):
    """List each row's mixed targets: the arrays of `rts_backends.fused.cells.Choices` from `columns` to `sums`.

    Args:
        start: first row.
        stop: end of the rows.
        grid: the samples.
        facing: (K, H, W), `Cells.facing`, or no layers. Marks go by depths alone; with it more fronts may pair.
        visible: True for the splatter `Visible`, False for `Multi`.
        continued: `Visible.CONTINUED`.
        beyond: see `find`.
        mixed: (H, W), the marks of mixed targets.
        offsets: (H + 1,), where the targets of each row begin in the lists.
        columns: (M,), to be filled.
        choices: (M, 9, 3, 2), the ranges, to be filled.
        sums: (M, 3, 5), to be filled.
        states: (H, W); those of listed targets become EMPTY.
        ends: (H, W) of `survey`, or no rows: directions in which fronts end before other surfaces are added.
    """
    positions, row = grid.positions, grid.row
    layers, height, width = row.shape
    z, target = np.empty((layers, 9), positions.dtype), np.empty(layers, positions.dtype)
    sides = np.zeros((layers, 9), np.int64)
    shift = np.empty(9, np.int64)
    for y in range(start, stop):
        d = offsets[y]
        for x in range(width if d < offsets[y + 1] else 0):
            if not mixed[y, x]:
                continue
            columns[d], states[y, x] = x, EMPTY
            choices[d] = 0
            for n in range(9):  # A helper would have references to its arrays counted here.
                py, px, some = y + 1 - n // 3, x + 1 - n % 3, False
                inside = 0 <= py < height and 0 <= px < width
                for k in range(layers):
                    i = row[k, py, px] if inside else -1
                    some |= i >= 0
                    z[k, n] = positions[i, 2] if i >= 0 else beyond
                for k in range(0 if some else layers):
                    z[k, n] = z.dtype.type(np.nan)
            for k in range(layers):
                target[k] = z[k, 4] if z[k, 4] == z[k, 4] else beyond
            if len(facing) > 0:
                _sides(sides, facing, y, x)
            for n in range(9):
                shift[n], off = _pairing(z, n, target, sides)
                if visible and shift[n] != 0 and row[0, y, x] < 0:
                    shift[n] = 0
                if visible and shift[n] != 0 and _continues(positions, row, y, x, n, z[0], continued * off):
                    shift[n] = 0
            if visible:
                _choose_visible(choices[d], shift, z, row, y, x, target)
            else:
                for n in range(9):
                    s = shift[n]
                    choices[d, n, 0, 1] = max(s, 0)
                    choices[d, n, 1, 0], choices[d, n, 1, 1] = max(s, 0), max(s + 1, 0)
                    choices[d, n, 2, 0], choices[d, n, 2, 1] = max(s + 1, 0), layers
            sums_of(sums[d], grid, y, x, choices[d])
            if len(ends) > 0:
                ends[y, x] |= _ends_before_others(choices[d], row, y, x)
            d += 1


@compiled
def _sides(sides, facing, y, x):
    """Fill `sides` (K, 9) with the sides that the layers of a target's nine sources show; 0 beyond the image."""
    layers, height, width = facing.shape
    for n in range(9):
        py, px = y + 1 - n // 3, x + 1 - n % 3
        inside = 0 <= py < height and 0 <= px < width
        for k in range(layers):
            sides[k, n] = facing[k, py, px] if inside else 0


@compiled
def _pairing(z, n, target, sides):
    """The number s of source n by depths and sides alone, and the distance of the depths that it pairs.

    For s ≥ 0, layer s of the source pairs with the target's front; for s < 0, its front with the target's layer −s.
    `z` (K, 9) are depths of all sources, `target` (K,) of the target; `sides` (K, 9) those of all sources' layers, 0 if
    unknown, and everywhere in `Multi`.
    """
    a, b = 0, 0
    front = z[0, n]
    best_a, best_b = abs(front - target[0]), abs(target[0] - front)
    for k in range(1, len(target)):
        distance = abs(z[k, n] - target[0])
        if distance < best_a and not opposite_sides(sides[k, n], sides[0, 4], target[0] > z[k, n]):
            best_a, a = distance, k
        distance = abs(target[k] - front)
        if distance < best_b and not opposite_sides(sides[k, 4], sides[0, n], front > target[k]):
            best_b, b = distance, k
    return (-b, best_b) if best_b < best_a else (a, best_a)


@compiled
def opposite_sides(hidden, front, behind):
    """True if a hidden layer shows the other side of a front's piece; both are entries of `Cells.facing`.

    The last of K covered layers may stand for layers behind it: False for it if the front lies `behind` it.
    """
    if front == 0 or (hidden > 0) == (front > 0):
        return False
    return hidden == -front or (not behind and abs(hidden) == abs(front) + MORE_BEHIND)


@compiled
def _continues(positions, row, y, x, n, fronts, limit):
    """True if a front, of source n or of the target, continues the other's line within a limit.

    The line leads through the other front and that of the cell beyond it.
    """
    _, height, width = row.shape
    v, u = n // 3 - 1, n % 3 - 1
    for steps, end, start in ((-1, fronts[n], fronts[4]), (2, fronts[4], fronts[n])):
        by, bx = y - steps * v, x - steps * u
        if 0 <= by < height and 0 <= bx < width and row[0, by, bx] >= 0:
            if abs(end - (start + start - positions[row[0, by, bx], 2])) < limit:
                return True
    return False


@compiled
def _choose_visible(choice, shift, z, row, y, x, target):
    """Fill the ranges `choice` (9, 3, 2), zeros before, that `rts.splatting.Visible` gives a target.

    `shift` (9,) are the numbers s of its sources, see `_pairing`; 0 for an empty target. `z` (K, 9) are depths of the
    sources, `target` (K,) those of the target (y, x).
    """
    layers, height, width = row.shape
    m = layers
    for n in range(9):
        py, px = y + 1 - n // 3, x + 1 - n % 3
        if shift[n] < 0 and 0 <= py < height and 0 <= px < width and row[0, py, px] >= 0:
            m = min(m, -shift[n])
    for n in range(9):
        s = shift[n]
        if s > 0:
            choice[n, 0, 1] = 1
        if s >= 0:
            choice[n, 1, 0], choice[n, 1, 1] = s, s + 1
        if m == layers:
            continue
        hidden, best = layers if s >= 0 else 0, z.dtype.type(np.inf)
        for k in range(s + 1 if s >= 0 else layers, layers):
            distance = abs(z[k, n] - target[m])
            if distance < best:
                best, hidden = distance, k
        if hidden < layers:
            choice[n, 2, 0], choice[n, 2, 1] = hidden, hidden + 1


@compiled
def _ends_before_others(choice, row, y, x):
    """Directions in which neighbours of a target are covered, and not paired front to front, as bits of DIRECTIONS."""
    _, height, width = row.shape
    bits = 0
    for n in range(9):
        py, px = y + 1 - n // 3, x + 1 - n % 3
        if n != 4 and 0 <= py < height and 0 <= px < width and row[0, py, px] >= 0:
            if not (choice[n, 1, 0] == 0 and choice[n, 1, 1] == 1):
                bits |= 1 << (8 - n)
    return np.uint16(bits)
