"""The picture and the animation of the demo, from a folder that `rts demo` has written.

Run `rts demo -o out`, then `python docs/figures/demo.py out`.
"""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import numpy as np
from PIL import Image

IMAGES = Path(__file__).parents[1] / "images"
GAP = 10


def main() -> None:
    """Write demo.png (start, result, target on white), demo.gif and demo_convergence.png to docs/images."""
    folder = Path(sys.argv[1])
    panels = [Image.open(folder / f"{name}.png").convert("RGBA") for name in ("before", "after", "target")]
    width, height = panels[0].size
    sheet = np.full((height, 3 * width + 2 * GAP, 4), 255, np.uint8)
    whole = Image.fromarray(sheet)
    for place, panel in enumerate(panels):
        whole.alpha_composite(panel, (place * (width + GAP), 0))
    whole.convert("RGB").save(IMAGES / "demo.png", optimize=True)
    shutil.copy(folder / "animation.gif", IMAGES / "demo.gif")
    shutil.copy(folder / "convergence.png", IMAGES / "demo_convergence.png")


if __name__ == "__main__":
    main()
