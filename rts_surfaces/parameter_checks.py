"""Names, widths and checks of entries of θ."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence

from rts import InputError, namespace
from rts.plugin_api.arrays import Tree

G_BUFFER_NAMES = {"normals": "normal", "colors": "color", "tangents": "tangent"}
"""Entry of θ → its name in the G-buffer, where the two differ."""
WIDTHS = {"vertices": (3,), "points": (3,), "normals": (3,), "tangents": (4,), "uv": (2,), "colors": (1, 3, 4)}
"""Entry of θ → how many numbers a vertex or control point may have in it."""

RESERVED = ("vertices", "points", "position", "normal", "face_normal")
"""Names that attributes declared by users may not have."""


def check_names(names: Iterable[str], taken: Sequence[str] = ()) -> None:
    """Refuse names of declared attributes that are `RESERVED` or `taken`."""
    for name in names:
        if name in RESERVED or name in taken:
            raise InputError(f"indices declares {name!r}, which is no further attribute; expected another name")


def check_entry(
    who: str, theta: Mapping[str, Tree], name: str, expected: Callable[[tuple[int, ...]], str | None]
) -> None:
    """Refuse an entry that is missing, of another shape, or of no floating numbers.

    Args:
        who: the surface's name in errors.
        theta: θ; values may be traced.
        name: the name of the entry.
        expected: a function of the entry's shape: the expected shape, in words; None if the entry has it.
    """
    if name not in theta:
        raise InputError(f"theta of {who} has no {name!r}; it has {sorted(theta)}")
    value, wrong = theta[name], expected(tuple(getattr(theta[name], "shape", ())))
    if wrong is not None:
        what = f"has shape {tuple(value.shape)}" if hasattr(value, "shape") else f"is a {type(value).__name__}"
        raise InputError(f"theta[{name!r}] of {who} {what}; expected {wrong}")
    if not namespace(value).isdtype(value.dtype, "real floating"):
        raise InputError(f"theta[{name!r}] of {who} has dtype {value.dtype}; expected a floating one")


def check_rows(who: str, theta: Mapping[str, Tree], name: str, rows: int) -> None:
    """Refuse an entry that is not (V, C) with V of at least `rows`, and C as in `WIDTHS`; see `check_entry`.

    Names that are not in `WIDTHS` may have any C.
    """
    widths = WIDTHS.get(name)

    def expected(shape: tuple[int, ...]) -> str | None:
        fits = len(shape) == 2 and (widths is None or shape[1] in widths)
        return None if fits else f"(rows, {' or '.join(map(str, widths or 'C'))})"

    check_entry(who, theta, name, expected)
    if (count := theta[name].shape[0]) < rows:
        raise InputError(
            f"theta[{name!r}] of {who} has {count} rows, but its faces refer to row {rows - 1}; check the indices "
            f"(they count from 0)"
        )
