"""Arguments of residuals of views, refused where they are wrong."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from rts.arrays.argument_checks import check_numbers, check_pixels, quoted
from rts.contracts.checks import is_count
from rts.errors import InputError
from rts.scene.view import View


def checked_views(views: Any) -> list[View]:
    """A list of at least one view."""
    checked = list(views) if isinstance(views, (list, tuple)) else []
    if not checked or not all(isinstance(view, View) for view in checked):
        raise InputError(f"views is {quoted(views)}; expected a list of at least one view, such as of rts.load_views")
    return checked


def check_functions(scene: Any, cameras: Any, exposure: Any, target: Any) -> None:
    """Refuse what is to be called, and is no function."""
    if not callable(scene):
        raise InputError(f"scene is {quoted(scene)}; expected a function: parameters → part or parts")
    for name, value, what in (
        ("cameras", cameras, "parameters, camera and view → camera"),
        ("exposure", exposure, "parameters → gain and offset"),
        ("target", target, "view → picture"),
    ):
        if value is not None and not callable(value):
            raise InputError(f"{name} is {quoted(value)}; expected a function: {what}, or None")


def checked_weights(weights: Any, count: int) -> np.ndarray:
    """The weights (count,) float32 of views; ones for None."""
    if weights is None:
        return np.ones(count, np.float32)
    known = check_numbers("weights", weights, (count,))
    if known is None or known.min() < 0 or not known.max() > 0:
        raise InputError(f"weights is {quoted(weights)}; expected {count} numbers, none negative and not all zero")
    return known.astype(np.float32)


def checked_draws(batch: Any, window: Any, views: Sequence[View]) -> tuple[int | None, tuple[int, int] | None]:
    """The number of views of a step, and the size of a window in each; None for all."""
    if batch is not None and not (is_count(batch) and batch <= len(views)):
        raise InputError(f"batch is {quoted(batch)}; expected a number of views from 1 to {len(views)}, or None")
    if window is None:
        return None if batch is None else int(batch), None
    height, width = check_pixels(window)
    for view in views:
        if height > view.size[0] or width > view.size[1]:
            problem = f"window is {quoted(window)}, and the view {view.name} has {view.size} pixels"
            raise InputError(f"{problem}; expected a window within every view")
    return None if batch is None else int(batch), (height, width)
