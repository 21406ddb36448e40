"""Poses from a silhouette of which a part is hidden, by each loss: what robust losses are for.

A bunny of 5,000 faces, 96² pixels, one view. Its mask is an image of 4 × 4 samples a pixel, of which a part is set to
zero, as if something stood in front: columns at a side, a bar across, or a corner. A start is turned and shifted by up
to 0.15 along each axis (radians, and halves of the object's size). Errors are those of the vertices, root mean square,
in shares of the size: median, largest, and how many starts end beyond 2 %, after Levenberg–Marquardt with
`rts.pyramid`. Steps count those of all stages.

    python -m benchmarks.hidden_masks              # four minutes of the processor
"""

from __future__ import annotations

import argparse
import statistics

import numpy as np

import rts
from benchmarks.camera import camera, supersampled
from benchmarks.meshes import mesh
from benchmarks.report import table

SIZE = (96, 96)
LOSSES = ("linear", "soft_l1", "huber", "cauchy")
F_SCALE = 0.1
OFFSET = 0.15
SHARE = 0.15
"""What part of the silhouette is hidden."""
PLACES = {"nowhere": "nowhere", "side": "a side, cut straight", "bar": "a bar across the middle", "corner": "a corner"}


def hidden(mask: np.ndarray, place: str) -> np.ndarray:
    """The mask (H, W) with a share of it set to zero."""
    rows, columns = (np.flatnonzero((mask > 0.5).any(axis)) for axis in (1, 0))
    height, width = SIZE
    for n in range(max(SIZE)):
        cut = {
            "nowhere": np.s_[:0],
            "side": np.s_[:, max(0, columns[-1] + 1 - n) :],
            "bar": np.s_[:, max(0, (width - n) // 2) : (width + n) // 2],
            "corner": np.s_[max(0, rows[-1] + 1 - n) :, max(0, columns[-1] + 1 - 2 * n) :],
        }[place]
        found = mask.copy()
        found[cut] = 0
        if place == "nowhere" or found.sum() <= (1 - SHARE) * mask.sum():
            return found
    raise AssertionError(f"{place} hides less than {SHARE:.0%}")


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--seeds", type=int, default=8, help="starts of each place and loss")
    seeds = parser.parse_args().seeds
    import torch

    vertices, faces = mesh("bunny_5k")
    vertices = vertices.astype(np.float32)
    part = rts.Part(rts.plugin("rts.surfaces", "mesh")(faces), {"vertices": vertices}, "silhouette")
    view = camera()
    whole = supersampled([part], view, SIZE, 4)[..., 3].astype(np.float32)
    rows = []
    for place, title in PLACES.items():
        mask, cells = hidden(whole, place), []
        for loss in LOSSES:
            residuals = rts.ImageResiduals(
                lambda pose: part.replace(transform=rts.rigid(pose)), view, SIZE, mask, loss=loss, f_scale=F_SCALE
            )
            errors, steps = [], []
            for seed in range(seeds):
                start = np.random.default_rng(seed).uniform(-OFFSET, OFFSET, 6).astype(np.float32)
                found = rts.fit(residuals, torch.tensor(start), method="lm", schedule=rts.pyramid(SIZE), progress=False)
                moved = np.asarray(rts.rigid(found.parameters.numpy().astype(np.float64)))
                off = vertices @ moved[:3, :3].T + moved[:3, 3] - vertices
                errors.append(np.sqrt((off**2).sum(1).mean()) / 2)
                steps.append(found.steps)
            astray = sum(e > 0.02 for e in errors)
            cells.append(
                f"{statistics.median(errors):.2%} ({max(errors):.2%}; {astray}), {statistics.median(steps):.0f}"
            )
        rows.append([title, *cells])
    print(table(["hidden", *LOSSES], rows))


if __name__ == "__main__":
    main()
