"""Arrays of few lengths, for engines that compile eager operations anew for each shape."""

from __future__ import annotations

import numpy as np

from rts.arrays.engines import OWNERS, engine_of
from rts.arrays.trees import Array
from rts.operations.take import take


def with_room(rows: Array) -> Array:
    """Rows (V, C), with copies of the first one behind them, as many as `Engine.room` says: most engines add none.

    What is computed from the result has few shapes, however many lengths `rows` has from call to call. So an engine
    that compiles eager operations for each shape, as jax does, neither compiles nor keeps more programs.
    """
    engine, count = OWNERS.get(type(rows)) or engine_of(rows), rows.shape[0]
    size = engine.room(count, rows)
    if size == count or not count:
        return rows
    index = np.zeros(size, np.int32)
    index[:count] = np.arange(count, dtype=np.int32)
    return take(rows, engine.constant(index, rows))


def filled_up(table: np.ndarray, rows: int) -> np.ndarray:
    """A NumPy table (N, ·), with rows of zeros behind it if it has fewer than `rows` rows."""
    if len(table) >= rows:
        return table
    return np.concatenate([table, np.zeros((rows - len(table), *table.shape[1:]), table.dtype)])
