"""Breaks on the sides of a square of four centres, joined into segments that do not cross. Compiled."""

from __future__ import annotations

import numpy as np

from rts.compiling.loops import compiled, loop

LONE, ON_ONE_SIDE, OTHER_BEHIND, OTHER_KIND = 2.0, 1.5, 0.5, 1.0
"""Costs, in cells, beside the length of segments: a break that stays alone; a segment between two breaks on one side,
which may be the two edges of something thin; one between breaks with different parts behind them; one between an
outline and a line where surfaces cross."""


@loop
def join(begins, along, sign, front, back, place, partner):
    """Fill `partner` (E,): for each end the other end of its segment, or −1, at the least total cost of each square.

    Only ends with the same part in front are joined, one that leaves it with one that enters it. The least cost of
    ends i … j of a square is found from that of shorter runs, so that no two segments cross.

    Args:
        begins: (Q + 1,) where the ends of each square begin.
        along: (E,) places on the square's sides, clockwise from the upper left corner, 0 to 4, in order.
        sign: (E,) 1 where the way along the sides leaves the front, −1 where it enters it, 0 where surfaces cross.
        front: (E,) the part in front; where surfaces cross, that of the lower number.
        back: (E,) the part behind; where surfaces cross, that of the higher number.
        place: (E, 2) x and y.
        partner: (E,) int32, filled with −1.
    """
    for q in range(len(begins) - 1):
        first, n = begins[q], begins[q + 1] - begins[q]
        if n < 2:
            continue
        # least[i, m]: the cost of the m ends from i on; chosen[i, m]: the step from i to its partner, or −1.
        least, chosen = np.zeros((n + 2, n + 1)), np.full((n + 2, n + 1), -1, np.int32)
        for m in range(1, n + 1):
            for i in range(n - m + 1):
                best, choice = LONE + least[i + 1, m - 1], -1
                for k in range(1, m):
                    cost = _cost(first + i, first + i + k, along, sign, front, back, place)
                    cost += least[i + 1, k - 1] + least[i + k + 1, m - k - 1]
                    best, choice = (cost, k) if cost < best else (best, choice)
                least[i, m], chosen[i, m] = best, choice
        _read(first, n, chosen, partner)


@compiled
def _cost(a, b, along, sign, front, back, place):
    """The cost of a segment between two ends; infinite if they cannot be joined."""
    if front[a] != front[b] or sign[a] * sign[b] > 0:
        return np.inf
    cost = np.hypot(place[a, 0] - place[b, 0], place[a, 1] - place[b, 1])
    cost += ON_ONE_SIDE * (int(along[a]) == int(along[b])) + OTHER_BEHIND * (back[a] != back[b])
    return cost + OTHER_KIND * ((sign[a] == 0) != (sign[b] == 0))


@compiled
def _read(first, n, chosen, partner):
    """Fill in the partners of the n ends from `first` on, as `chosen` says of all runs of ends."""
    stack, top = np.empty((2 * n + 2, 2), np.int32), 1
    stack[0] = 0, n
    while top > 0:
        top -= 1
        i, m = stack[top]
        if m < 1:
            continue
        k = chosen[i, m]
        stack[top] = i + 1, m - 1 if k < 0 else k - 1
        top += 1
        if k >= 0:
            partner[first + i], partner[first + i + k] = first + i + k, first + i
            stack[top] = i + k + 1, m - k - 1
            top += 1
