"""Rows of the paper's claims beside our numbers, and the JSON files that these are kept in."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, NamedTuple

RESULTS = Path(__file__).parents[1] / "results/paper"
"""The results of full size that the page shows, a file an experiment."""


class Row(NamedTuple):
    """A claim of the paper.

    Attributes:
        claim: it, in our words.
        number: the paper's number, or "–" where it gives a picture or words.
        ours: what was measured here.
        verdict: "holds", "in part", "does not" or "not run".
        because: why it does not hold wholly, or what has to be known beside.
    """

    claim: str
    number: str
    ours: str
    verdict: str
    because: str = ""

    def told(self) -> str:
        """The verdict, with its reason."""
        return f"{self.verdict}: {self.because}" if self.because else self.verdict


def verdict(*held: bool) -> str:
    """The verdict on a claim that has parts, each of which held or not."""
    return "holds" if all(held) else "in part" if any(held) else "does not"


def path_of(name: str) -> Path:
    """The file of an experiment's kept result."""
    return RESULTS / f"{name}.json"


def kept(name: str) -> dict[str, Any] | None:
    """The kept result of an experiment: "about", its conditions, and "numbers"; None if there is none."""
    path = path_of(name)
    return json.loads(path.read_text()) if path.exists() else None
