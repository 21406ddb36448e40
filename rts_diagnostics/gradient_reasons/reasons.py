"""Reasons why a derivative disagrees with the truth (finite differences), or vanishes, in words and as marks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rts.tool_api.parameters import names_in_words
from rts.tool_api.pictures import decode_srgb

KINDS = {
    "constant": ("orange", (255, 150, 0)),
    "unused": ("none", None),
    "outside": ("none", None),
    "hidden": ("blue", (60, 110, 255)),
    "culled": ("sky blue", (90, 200, 255)),
    "outlines": ("red", (255, 40, 40)),
    "transparent": ("cyan", (0, 255, 255)),
    "layers": ("magenta", (255, 60, 220)),
    "samples": ("olive", (150, 150, 30)),
    "bounded": ("violet", (150, 60, 255)),
    "steps": ("lime", (150, 255, 60)),
    "reach": ("brown", (170, 95, 30)),
    "infinite": ("gold", (200, 160, 0)),
    "undetermined": ("none", None),
    "unknown": ("white", (255, 255, 255)),
}
"""The kinds of reasons, each with the colour, 8-bit sRGB, of the pixels that it marks.

- constant: the number reaches the scene as NumPy, or cut off from derivatives.
- unused: nothing in the scene changes with the number.
- outside: the parts that it moves are outside of the view, or behind the near plane.
- hidden: the parts that it moves are behind others.
- culled: the parts that it moves are seen from behind, with cull="back".
- outlines: the splatter gives outlines no derivative.
- transparent: shaders are not opaque, and the splatter takes them to be.
- layers: surfaces lie deeper than K layers.
- samples: too few samples a pixel, such as for colours finer than pixels.
- bounded: near-singular crossings, whose derivatives the surface bounds.
- steps: colours of a shader step, such as by a comparison: a step has no derivative.
- reach: the loss is flat here, beyond the reach of a pixel.
- infinite: the derivative is NaN, or infinite.
- undetermined: the image does not determine the number, or a combination of several.
- unknown: no experiment tells.
"""

DIM = 0.35
"""Brightness of the scene under the marks."""


class Finding(NamedTuple):
    """The result of an experiment on one number.

    Attributes:
        kind: a key of `KINDS`.
        because: the cause; a sentence that goes on after "name: ".
        advice: what to do, a sentence; may be empty.
        mask: (H, W) bool, the pixels that show the cause; None for no pixels.
        share: the share of the disagreement that the cause explains; None if nothing disagrees.
    """

    kind: str
    because: str
    advice: str = ""
    mask: np.ndarray | None = None
    share: float | None = None


class Reason(NamedTuple):
    """A reason why derivatives disagree with the truth, or vanish.

    Attributes:
        kind: a key of `rts_diagnostics.gradient_reasons.reasons.KINDS`.
        parameters: the names of the numbers.
        text: the cause, its share and the remedy, in a plain sentence or two.
        pixels: (H, W) bool, the pixels that show it.
    """

    kind: str
    parameters: list[str]
    text: str
    pixels: np.ndarray

    @property
    def color(self) -> str:
        """The colour of its kind in the picture, in words; "none" for a kind that marks no pixels."""
        return KINDS[self.kind][0]


def merged(findings: Sequence[tuple[str, Finding]], size: tuple[int, int]) -> list[Reason]:
    """Reasons merged over the numbers with equal findings, the largest share first; no share counts as all.

    Args:
        findings: each with the name of its number.
        size: (height, width).
    """
    groups: dict[tuple[str, str, str], list[tuple[str, Finding]]] = {}
    for name, finding in findings:
        groups.setdefault((finding.kind, finding.because, finding.advice), []).append((name, finding))
    reasons = []
    for (kind, because, advice), members in groups.items():
        pixels = np.zeros(size, bool)
        for _, finding in members:
            if finding.mask is not None:
                pixels |= finding.mask
        shares = [finding.share for _, finding in members if finding.share is not None]
        names = [name for name, _ in members]
        figures = [f"{pixels.sum()} pixels"] if pixels.any() else []
        if shares:
            low, high = min(shares), max(shares)
            span = f"{high:.0%}" if f"{low:.0%}" == f"{high:.0%}" else f"{low:.0%} to {high:.0%}"
            figures.append(f"{span} of the disagreement")
        in_brackets = f" ({', '.join(figures)})" if figures else ""
        about = names_in_words(names) if names[0] else ""
        text = " ".join(filter(None, [f"{about}{': ' if about else ''}{because}{in_brackets}.", advice]))
        reasons.append((max(shares, default=1.0), Reason(kind, names if about else [], text, pixels)))
    return [reason for _, reason in sorted(reasons, key=lambda r: -r[0])]


def marked(image: np.ndarray, reasons: Sequence[Reason]) -> np.ndarray:
    """The image (H, W, 4), dark and grey, with the pixels of reasons in their colours: (H, W, 3) linear.

    Where two reasons mark a pixel, it has the colour of the first.
    """
    grey = np.clip(np.nan_to_num(image[..., :3].mean(axis=-1) + 0.15 * image[..., 3]), 0, 1)
    picture = np.repeat((DIM**2 * grey)[..., None], 3, axis=-1)
    for reason in reversed(reasons):
        color = KINDS[reason.kind][1]
        if color is not None and reason.pixels.any():
            picture[reason.pixels] = decode_srgb(np.array(color) / 255)
    return picture


def legend(reasons: Sequence[Reason]) -> str:
    """The legend of the picture, such as "red = outlines"; empty if no pixel is marked."""
    counts: dict[str, int] = {}
    for reason in reasons:
        if reason.pixels.any() and reason.color != "none":
            counts[reason.kind] = counts.get(reason.kind, 0) + int(reason.pixels.sum())
    return ", ".join(f"{KINDS[kind][0]} = {kind}" for kind in counts)
