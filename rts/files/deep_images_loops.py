"""Filters of PNG undone, as a compiled loop: each byte depends on the one before it."""

from __future__ import annotations

from rts.compiling.loops import loop


@loop
def unfilter(rows, step):
    """Undo filters in place.

    Args:
        rows: (R, 1 + L) uint8, rows of a picture, each with the number of its filter, from 0 to 4, before it.
        step: the bytes of a pixel.
    """
    for r in range(rows.shape[0]):
        kind = rows[r, 0]
        for i in range(1, rows.shape[1]):
            left = int(rows[r, i - step]) if i > step else 0
            above = int(rows[r - 1, i]) if r > 0 else 0
            corner = int(rows[r - 1, i - step]) if r > 0 and i > step else 0
            guess = 0
            if kind == 1:
                guess = left
            elif kind == 2:
                guess = above
            elif kind == 3:
                guess = (left + above) // 2
            elif kind == 4:  # Paeth's: the nearest of the three to left + above - corner.
                a, b, c = abs(above - corner), abs(left - corner), abs(left + above - 2 * corner)
                guess = left if a <= b and a <= c else above if b <= c else corner
            rows[r, i] = (int(rows[r, i]) + guess) & 255
