"""The splatted image as an operation: compiled loops beside their specification."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from rts.plugin_api import records
from rts.plugin_api.arrays import Array
from rts.plugin_api.operations import Operation
from rts.plugin_api.splats import Multi, Single, Visible
from rts_backends.fused.cells import Cells, Choices, Settings

_SPECIFICATIONS = {"single": Single, "multi": Multi, "visible": Visible}


def specification(
    positions: Array,
    rgba: Array,
    row: Array,
    part: Array,
    facing: Array,
    wanted: Array,
    settled: Array,
    exits: Array,
    *,
    settings: Settings,
) -> Array:
    """The image (H, W, 4) less the border, in array code; operands without rows are absent. `wanted` is not read."""
    given = settings.sigma, settings.epsilon, settings.gamma
    options = {"rims": settings.rims, "crossings": settings.crossings} if settings.kind == "visible" else {}
    part, facing, settled, exits = (x if x.shape[0] else None for x in (part, facing, settled, exits))
    cells = records.Cells(row, facing=facing, exit=exits, settled=settled)
    splats = records.Splats(positions, rgba, cells, part, border=settings.border, one_part=settings.one_part)
    splats = splats.replace(opaque=settings.opaque)
    return _SPECIFICATIONS[settings.kind](*given, **options).cropped(splats)


def _shape(
    positions: tuple,
    rgba: tuple,
    row: tuple,
    part: tuple,
    facing: tuple,
    wanted: tuple,
    settled: tuple,
    exits: tuple,
    *,
    settings: Settings,
) -> tuple[int, ...]:
    return *(max(0, n - 2 * settings.border) for n in row[1:]), 4


def _cells(settings: Settings, operands: Sequence[np.ndarray], kept: Choices | None) -> Cells:
    positions, rgba, row, *known = operands
    return Cells(settings, positions, rgba, row, kept, *known)


def _forward(operands: Sequence[np.ndarray], out: np.ndarray, *, settings: Settings) -> Choices | None:
    cells = _cells(settings, operands, None)
    cells.image(out)
    return cells.choices if out.size else None


def _push(
    operands: Sequence[np.ndarray],
    tangents: Sequence[np.ndarray | None],
    out: np.ndarray,
    *,
    settings: Settings,
    kept: Choices | None,
) -> None:
    t_positions, t_rgba = tangents
    _cells(settings, operands, kept).jvp(t_positions, t_rgba, out)


def _pull(
    operands: Sequence[np.ndarray],
    g: np.ndarray,
    results: Sequence[np.ndarray | None],
    *,
    settings: Settings,
    kept: Choices | None,
) -> None:
    g_positions, g_rgba = results
    _cells(settings, operands, kept).vjp(g, g_positions, g_rgba)


def used(operands: Sequence[np.ndarray]) -> int:
    """The number of rows in use: one more than the last row that cells refer to, at least 1."""
    return rows_of(operands[2], *operands[6:8])


def rows_of(*cells: np.ndarray | None) -> int:
    """One more than the largest number in arrays of cells, the last row of samples that they refer to; at least 1."""
    return 1 + max(int(x.max(initial=0)) for x in cells if x is not None)


_OPTIONS: dict[str, Any] = {"differentiable": 2, "packed": (0, 1), "used": used, "even": (1,)}
IMAGE = Operation(
    "rts.image",
    specification,
    (2, 2, 3, 3, 3, 2, 2, 3),
    _shape,
    _forward,
    _push,
    _pull,
    keeps=True,
    sweeps=True,
    **_OPTIONS,
)
"""The image of positions (N, 3), rgba (N, 4), row (K, H, W), part, facing, wanted, settled and exit: (H, W, 4), less
the border, which is cut off.

The last five are fields of `Splats`; absent ones have no rows: (0, H, W), or (0, W) of `wanted` and `settled`."""
