"""Names for errors and reports: leaves of parameters, and long texts in one line."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from rts.arrays.trees import Array, Tree, placed_leaves


def named_leaves(tree: Tree) -> Iterator[tuple[str, Array]]:
    """Leaves with names such as "light.direction", in the order of `leaves`; a single array is "parameters"."""
    for place, leaf in placed_leaves(tree):
        yield ".".join(map(str, place)) or "parameters", leaf


def one_line(text: str, longest: int = 200) -> str:
    """The text in one line, cut to at most `longest` characters."""
    text = " ".join(text.split())
    return text if len(text) <= longest else f"{text[: longest - 1]}…"


def names_in_words(names: Sequence[str], most: int = 3) -> str:
    """The first `most` names, separated by commas, and the number of the others."""
    more = [f"{len(names) - most} more"] if len(names) > most else []
    return ", ".join([*names[:most], *more])
