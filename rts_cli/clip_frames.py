"""The frames of a clip: rts render --clip."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import typer

import rts
from rts import Part
from rts.results import Model
from rts.tool_api.scenes import Bounds, bounds_of, is_invertible

ANIMATIONS = (".gif", ".mp4")
FPS = 20.0
"""Frames a second of an animation."""
SEEN = 24
"""Times of a clip at which the model is measured, so that a camera sees it in all of them."""


def check_animation(output: Path, clip: str | None, time: float | None, names: tuple[str, ...]) -> None:
    """Refuse an animation of no clip, or of more than colours; and a time of no clip."""
    if output.suffix.lower() in ANIMATIONS and (clip is None or time is not None or names != ("color",)):
        raise typer.BadParameter(f"{output.suffix} is for the colours of a whole clip; give --clip, and no --time")
    if time is not None and clip is None:
        raise typer.BadParameter("--time is for a clip; give --clip, too")


def frames_of(
    model: Path, clip: str, time: float | None, moving: bool, cull: str = "none"
) -> tuple[list[list[Part]], Bounds, Model]:
    """The parts of a model at one time of a clip, or, if `moving`, at each frame; bounds of the whole clip; the model.

    A frame has no parts where the clip hides them all.

    Args:
        model: a GLB or glTF.
        clip: the name of a clip, or its number.
        time: seconds; None for the start.
        moving: True for all frames.
        cull: as of `rts.load`.
    """
    loaded = rts.load_model(model, cull=cull)
    named = any(c.name == clip for c in loaded.clips)
    which = int(clip) if clip.isdecimal() and not named else clip
    duration = loaded.clip(which).duration

    def parts_at(seconds: float) -> list[Part]:
        parts = loaded.posed(loaded.pose(which, seconds))
        # Clips hide parts by scaling them to nothing.
        return [part for part in parts if part.transform is None or is_invertible(part.transform)]

    seen = [part for seconds in np.linspace(0, duration, SEEN) for part in parts_at(float(seconds))]
    times = np.arange(max(round(duration * FPS), 1)) / FPS if moving else [time or 0.0]
    frames = [parts_at(float(seconds)) for seconds in times]
    if not any(frames):
        raise rts.InputError(f"the clip {clip} of {model} hides all parts then; choose another time")
    return frames, bounds_of(seen), loaded
