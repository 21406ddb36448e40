"""Differences of the arrays of two commits, and limits for rounding."""

from __future__ import annotations

import json
from pathlib import Path
from typing import NamedTuple

import numpy as np

TOLERANCES = {"samples": None, "rigid": 1e-6, "images": 1e-6, "gradients": 1e-5}
TOLERANCES |= {"images, not pinned": 1e-4, "gradients, not pinned": 1e-3}
"""On differences, see `difference`, by kind or its first word; None where there are to be none."""


class Difference(NamedTuple):
    """One array of both sides compared: whether they are equal to the bit, and how much they are off, relatively."""

    key: str
    equal: bool
    size: float


def difference(key: str, a: np.ndarray, b: np.ndarray) -> Difference:
    """The largest difference over the largest value; of gradients, the norm of the difference over the norm."""
    if a.shape == b.shape and a.dtype == b.dtype and a.tobytes() == b.tobytes():
        return Difference(key, True, 0.0)
    if a.shape != b.shape or a.dtype != b.dtype or not np.array_equal(np.isfinite(a), np.isfinite(b)):
        return Difference(key, False, float("inf"))
    a, b = (np.where(np.isfinite(x), x, 0).astype(np.float64) for x in (a, b))
    measure = np.linalg.norm if key.startswith("gradients") else lambda x: np.abs(x).max(initial=0)
    off, scale = measure((a - b).reshape(-1)), measure(a.reshape(-1))
    return Difference(key, False, float(off / scale) if scale else float("inf") if off else 0.0)


class Group(NamedTuple):
    """All arrays of a kind and an engine.

    Attributes:
        kind: as "images, compiled".
        engine: by which they are computed.
        found: differences of those that both sides have.
        missing: keys that only the first side has.
    """

    kind: str
    engine: str
    found: list[Difference]
    missing: list[str]

    @property
    def equal(self) -> int:
        """The number of arrays that are equal to the bit."""
        return sum(d.equal for d in self.found)

    @property
    def largest(self) -> float:
        """Difference."""
        return max((d.size for d in self.found), default=0.0)

    @property
    def within(self) -> bool:
        """True if no difference is too large."""
        limit = TOLERANCES[self.kind if self.kind in TOLERANCES else self.kind.split(",")[0]]
        return all(d.equal or (limit is not None and d.size <= limit) for d in self.found)

    @property
    def good(self) -> bool:
        """True if the second side is as good as the first."""
        return self.within and not self.missing

    @property
    def suspect(self) -> bool:
        """True if arrays of array code, which are to be equal, differ within the limits."""
        return self.within and self.equal < len(self.found) and self.kind.endswith("array code")

    @property
    def verdict(self) -> str:
        """In words."""
        if self.equal == len(self.found):
            text = "equal"
        else:
            text = "not bitwise" if self.suspect else "rounding" if self.within else "different"
        return f"{text}, {len(self.missing):,} missing" if self.missing else text


def compare(before: Path, after: Path) -> tuple[list[Group], list[str]]:
    """The arrays in two folders, see `results`, by kind and engine; the keys that only the second has."""
    sides = [np.load(folder / "arrays.npz") for folder in (before, after)]
    groups: dict[tuple[str, str], Group] = {}
    for key in sides[0].files:
        kind, engine = key.split("|")[:2]
        group = groups.setdefault((kind, engine), Group(kind, engine, [], []))
        if key in sides[1]:
            group.found.append(difference(key, sides[0][key], sides[1][key]))
        else:
            group.missing.append(key)
    return [groups[name] for name in sorted(groups)], sorted(set(sides[1].files) - set(sides[0].files))


def left_out(before: Path, after: Path) -> dict[str, list[str]]:
    """The results without arrays in two folders, by the reason."""
    one, other = (json.loads((folder / "notes.json").read_text()) for folder in (before, after))
    reasons: dict[str, list[str]] = {}
    for key in one | other:
        a, b = one.get(key, "nothing"), other.get(key, "nothing")
        reasons.setdefault(a if a == b else f"{a} → {b}", []).append(key.strip("|"))
    return reasons
