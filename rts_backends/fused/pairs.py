"""Mixed targets, found by depths: cells of which one of the nine sources is not paired front to front."""

from __future__ import annotations

import numpy as np

from rts.plugin_api.loops import compiled

BLOCK = 16
"""Columns of cells that share one mark of nearby hidden layers."""


@compiled
def mark(mixed, asked, positions, row, y, beyond, z, loaded, target):
    """Mark the mixed targets of a row in `mixed`; return their number.

    Args:
        mixed: (W,) uint8, to be filled.
        asked: (B,) uint8, 1 for the blocks of columns to look at; targets in others are not mixed.
        positions: (N, 3).
        row: (K, H, W).
        y: the row.
        beyond: depth of layers that are not covered; no two layers are farther apart than each is from it.
        z: (3, K, W + 2), depths of rows y − 1 to y + 1, one more at each side; filled where `loaded` has another row.
        loaded: (3, B) int64, the row that z holds in each block; updated.
        target: (K, BLOCK), working memory.
    """
    layers, _, width = row.shape
    count = 0
    for b in range(len(asked)):
        left, right = b * BLOCK, min((b + 1) * BLOCK, width)
        marks = mixed[left:right]
        marks[:] = 0
        if not asked[b]:
            continue
        for v in range(y - 1, y + 2):
            if loaded[(v + 3) % 3, b] != v:
                loaded[(v + 3) % 3, b] = v
                _load(z[(v + 3) % 3, :, left:], positions, row, v, left - 1, right + 1, beyond)
        above, level, below = z[(y + 2) % 3, :, left:], z[y % 3, :, left:], z[(y + 1) % 3, :, left:]
        for k in range(layers):
            for x in range(right - left):
                d = level[k, x + 1]
                target[k, x] = d if d == d else beyond
        for k in range(1, layers):
            _mark(marks, above[0], level[0], below[0], above[k], level[k], below[k], target[0], target[k])
        for mark in marks:
            count += mark
    return count


@compiled
def _load(z, positions, row, y, first, last, beyond):
    """Load depths of cells [first, last) of row y to z (K, ·): NaN for an empty cell, `beyond` for a missing layer."""
    layers, height, width = row.shape
    nothing = z.dtype.type(np.nan)
    for x in range(first, last):
        some = False
        if 0 <= y < height and 0 <= x < width:
            for k in range(layers):
                some |= row[k, y, x] >= 0
        for k in range(layers):
            z[k, x - first] = nothing
            if some:
                i = row[k, y, x]
                z[k, x - first] = positions[i, 2] if i >= 0 else beyond


# Rows are passed once, not for each source: views of so few cells take as long to make as the work.


@compiled
def _mark(marks, front0, front1, front2, hidden0, hidden1, hidden2, target_front, target_hidden):
    """Add marks to targets where a hidden layer fits better than the fronts, for some source.

    That is: the hidden layer of target or source is nearer to the other's front than the two fronts are to each other.
    Fronts and hidden layers are depths of sources in three rows, which begin one cell left of the targets'.
    """
    for x in range(len(marks)):
        t, q = target_front[x], target_hidden[x]
        some = _nearer(front0, hidden0, x, t, q) | _nearer(front1, hidden1, x, t, q) | _nearer(front2, hidden2, x, t, q)
        marks[x] |= np.uint8(some)


@compiled
def _nearer(front, hidden, x, target_front, target_hidden):
    """True if `_mark` marks target x for one of three sources in a row; comparisons with NaN are false."""
    some = False
    for u in range(3):
        f, h = front[x + u], hidden[x + u]
        d = abs(f - target_front)
        some |= (abs(h - target_front) < d) | (abs(target_hidden - f) < d)
    return some
