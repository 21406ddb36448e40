"""The definition of `Multi` and `Visible` in plain loops: how the layers of two cells pair, and where fronts end."""

import itertools

STEPS = [(u, v) for v in (-1, 0, 1) for u in (-1, 0, 1)]
"""Offsets (u, v) of columns and rows."""


class Pairing:
    """Pairing of cells, each given as (y, x)."""

    def __init__(self, positions, row, visible):
        self.positions, self.row, self.visible = positions, row, visible
        self.beyond = 2 * self._extent(row) or 1.0
        self.extent = self._extent(row[0])
        self.cells = list(itertools.product(*map(range, row.shape[1:])))

    def _extent(self, row):
        seen = [0.0, *(self.positions[i, 2] for i in row.ravel() if i >= 0)]
        return max(seen) - min(seen)

    def inside(self, y, x):
        return 0 <= y < self.row.shape[1] and 0 <= x < self.row.shape[2]

    def covers(self, y, x):
        return self.inside(y, x) and self.row[0, y, x] >= 0

    def depth(self, k, y, x):
        return self.positions[self.row[k, y, x], 2] if self.row[k, y, x] >= 0 else self.beyond

    def depths(self, y, x):
        return [self.depth(k, y, x) for k in range(len(self.row))]

    def _nearest(self, here, there):
        a = [abs(z - there[0]) for z in here]
        b = [abs(z - here[0]) for z in there]
        return -b.index(min(b)) if min(b) < min(a) else a.index(min(a)), min(*a, *b)

    def _continues(self, start, end, limit):
        before = 2 * start[0] - end[0], 2 * start[1] - end[1]
        if not self.covers(*before):
            return False
        return abs(self.depth(0, *end) - (2 * self.depth(0, *start) - self.depth(0, *before))) < limit

    def shift(self, source, target):
        """The number s of a source at a target."""
        s, off = self._nearest(self.depths(*source), self.depths(*target))
        joined = self._continues(target, source, 0.8 * off) or self._continues(source, target, 0.8 * off)
        return 0 if self.visible and joined else s

    def ends(self, cell, n):
        """True if the front of a cell ends in a direction (u, v); false where the next cell is outside of the array."""
        beyond = cell[0] + n[1], cell[1] + n[0]
        if not (self.covers(*cell) and self.inside(*beyond)):
            return False
        return not self.covers(*beyond) or self.shift(cell, beyond) != 0
