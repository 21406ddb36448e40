"""New numbers for the samples that stay when others are left out, compiled."""

from __future__ import annotations

import numpy as np

from rts.compiling.loops import loop
from rts.compiling.threads import parallel, read_only


class Numbering:
    """New numbers for the used rows of samples of several parts.

    Args:
        sizes: the number of rows of each part.
    """

    def __init__(self, sizes: list[int]):
        self._firsts = np.cumsum([0, *sizes])
        self._used = np.zeros(self._firsts[-1], bool)
        self._numbers, self._index = (np.empty(self._firsts[-1], np.int32) for _ in range(2))

    def use(self, row: np.ndarray, kept: np.ndarray) -> None:
        """Mark as used the rows, counted over all parts, that kept cells (K, H, W) name; −1 names none."""
        row, kept = (read_only(x, kind).reshape(-1, x.shape[-1]) for x, kind in ((row, np.int32), (kept, bool)))
        parallel(_mark, len(row), row, kept, self._used, work=row.size)

    def indices(self) -> list[np.ndarray]:
        """For each part, its used rows (n,) int32, counted within the part.

        They stay in order, so that neighbours are neighbours in memory. Numbers them for `renumbered`.
        """
        counts = np.zeros(len(self._firsts) - 1, np.int64)
        parallel(
            _number, len(counts), self._used, self._firsts, self._numbers, self._index, counts, work=len(self._used)
        )
        return [self._index[first : first + n] for first, n in zip(self._firsts, counts, strict=False)]

    def renumbered(self, row: np.ndarray, part: int | None = None) -> np.ndarray:
        """Cells (…, W) with the new number of each row within its part, −1 where it is not used. Call `indices` first.

        Args:
            row: rows counted over all parts, or of one part; −1 for none.
            part: the part whose rows `row` names; None for rows counted over all parts.
        """
        given = read_only(row, np.int32).reshape(-1, row.shape[-1])
        found, first = np.empty(given.shape, np.int32), self._firsts[part or 0]
        parallel(_renumber, len(given), given, self._numbers[first:], found, work=given.size)
        return found.reshape(row.shape)


@loop
def _mark(start, stop, row, kept, used):
    """Set `used` (N,) bool for rows that kept cells of lines [start, stop) name; other entries stay."""
    for y in range(start, stop):
        for x in range(row.shape[1]):
            if kept[y, x] and 0 <= row[y, x] < len(used):
                used[row[y, x]] = True


@loop
def _number(start, stop, used, firsts, numbers, index, counts):
    """Number the used rows of parts [start, stop) anew, each part from 0 on.

    Args:
        start: first part.
        stop: end of the parts.
        used: (N,) bool, rows of all parts.
        firsts: (P + 1,), where the rows of each part begin, and N.
        numbers: (N,) int32, to be filled: the new number of each row, or −1.
        index: (N,) int32. From where a part begins, its used rows are written, counted within the part.
        counts: (P,), to be filled: the number of used rows.
    """
    for part in range(start, stop):
        first, count = firsts[part], 0
        for i in range(first, firsts[part + 1]):
            numbers[i] = -1
            if used[i]:
                numbers[i], index[first + count] = count, i - first
                count += 1
        counts[part] = count


@loop
def _renumber(start, stop, row, numbers, found):
    """Fill lines [start, stop) of `found` with the `numbers` (N,) of the rows in `row`; −1 for rows that are none."""
    for y in range(start, stop):
        for x in range(row.shape[1]):
            i = row[y, x]
            found[y, x] = numbers[i] if 0 <= i < len(numbers) else -1
