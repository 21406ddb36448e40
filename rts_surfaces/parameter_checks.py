"""Names, widths and checks of entries of θ."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence

from rts import InputError, namespace
from rts.plugin_api.arrays import Tree, shape_of

G_BUFFER_NAMES = {"normals": "normal", "colors": "color"}
"""Names in the G-buffer of entries of θ that have another name there."""
WIDTHS = {"vertices": (3,), "points": (3,), "normals": (3,), "uv": (2,), "colors": (1, 3, 4)}
"""Numbers for each vertex or control point."""

RESERVED = ("vertices", "points", "position", "normal")
"""Names that no further attribute may have."""


def check_names(names: Iterable[str], taken: Sequence[str] = ()) -> None:
    """Refuse names of attributes that mean something else, or are taken."""
    for name in names:
        if name in RESERVED or name in taken:
            raise InputError(f"indices declares {name!r}, which is no further attribute; expected another name")


def check_entry(
    who: str, theta: Mapping[str, Tree], name: str, expected: Callable[[tuple[int, ...]], str | None]
) -> None:
    """Refuse an entry that is missing, of another shape, or of no floating numbers.

    Args:
        who: the surface, as an error calls it.
        theta: θ; values may be traced.
        name: of the entry.
        expected: (shape) → the shape that it is to have, in words; None if it has it.
    """
    if name not in theta:
        raise InputError(f"theta of {who} has no {name!r}; it has {sorted(theta)}")
    value, wrong = theta[name], expected(shape_of(theta[name]))
    if wrong is not None:
        what = f"has shape {tuple(value.shape)}" if hasattr(value, "shape") else f"is a {type(value).__name__}"
        raise InputError(f"theta[{name!r}] of {who} {what}; expected {wrong}")
    if not namespace(value).isdtype(value.dtype, "real floating"):
        raise InputError(f"theta[{name!r}] of {who} has dtype {value.dtype}; expected a floating one")


def check_rows(who: str, theta: Mapping[str, Tree], name: str, rows: int) -> None:
    """Refuse an entry that is not (V, C) with at least so many rows, C as in `WIDTHS`; see `check_entry`."""
    widths = WIDTHS.get(name)

    def expected(shape: tuple[int, ...]) -> str | None:
        fits = len(shape) == 2 and (widths is None or shape[1] in widths)
        return None if fits else f"(rows, {' or '.join(map(str, widths or 'C'))})"

    check_entry(who, theta, name, expected)
    if (count := shape_of(theta[name])[0]) < rows:
        raise InputError(
            f"theta[{name!r}] of {who} has {count} rows, but its faces refer to row {rows - 1}; check the indices "
            f"(they count from 0)"
        )
