"""Measuring derivatives and their time: settings compared on one chart, tuned for a scene, and where they break.

A user of `rts` like any other: it imports public names alone. `compare`, `stability` and `tune` are loaded when they
are first used, so that `rts --help` is quick.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rts_compare.comparison import Comparison, compare
    from rts_compare.failures.stability_table import Stability, stability
    from rts_compare.tuning import Tuned, tune

_PLACES = {
    "Comparison": "comparison",
    "Stability": "failures.stability_table",
    "Tuned": "tuning",
    "compare": "comparison",
    "stability": "failures.stability_table",
    "tune": "tuning",
}


def __getattr__(name: str) -> Any:
    if name not in _PLACES:
        raise AttributeError(f"module 'rts_compare' has no attribute {name!r}; there are {', '.join(_PLACES)}")
    return getattr(import_module(f"rts_compare.{_PLACES[name]}"), name)


__all__ = ["Comparison", "Stability", "Tuned", "compare", "stability", "tune"]
