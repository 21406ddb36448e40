"""The command `rts turntable`."""

import math
from pathlib import Path

import numpy as np

import rts
from rts.tool_api.scenes import default_camera


def turntable(model: Path, output: Path = Path("turntable.gif"), frames: int = 12) -> None:
    """Write an animation of a model that turns about its upright axis."""
    parts = rts.load(model)
    camera = default_camera(parts, (128, 128))
    turns = [rts.rigid(np.array([0.0, 2 * math.pi * i / frames, 0, 0, 0, 0])) for i in range(frames)]
    images = [rts.render([part.replace(transform=turn) for part in parts], camera, (128, 128)) for turn in turns]
    rts.save_animation(output, images)
