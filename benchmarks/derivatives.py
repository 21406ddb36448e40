"""The paper's figure 4: image derivatives of three moves, splatted with K = 1 and K = 2, against finite differences.

A: the bunny moves over black. B: the red square moves behind the bunny. C: the bunny moves before the square.
Writes a picture and a table:

    python benchmarks/derivatives.py -o out/derivatives
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
import torch
from scenes import DISTANCE, bunny_and_square, camera, pixel, supersampled, translation
from truth import scores

import rts

SIZE = 256
SAMPLES = 16


def cases() -> dict[str, tuple[list[rts.Part], int, float]]:
    """Name → parts, which of them moves, world length of one pixel at its depth."""
    bunny, square = (p.replace(cull="back") for p in bunny_and_square())
    return {
        "A": ([bunny], 0, pixel(DISTANCE, SIZE)),
        "B": ([bunny, square], 1, pixel(4.3, SIZE)),
        "C": ([bunny, square], 0, pixel(DISTANCE, SIZE)),
    }


def moved(parts, index, offset):
    return [p.replace(transform=offset) if i == index else p for i, p in enumerate(parts)]


def finite_difference(parts, index, step) -> np.ndarray:
    """Change of the area-sampled image per pixel of motion, by ±½ pixel (H, W, 3)."""
    ends = [
        supersampled(moved(parts, index, translation((s * step / 2, 0, 0))), camera(), (SIZE, SIZE), SAMPLES)
        for s in (-1, 1)
    ]
    return (ends[1] - ends[0])[..., :3]


def splatted(parts, index, step, splatter, layers) -> np.ndarray:
    """The same derivative by forward mode (H, W, 3)."""
    direction = torch.tensor(translation((step, 0, 0)) - np.eye(4), dtype=torch.float32)

    def image(t):
        transform = torch.eye(4) + t * direction
        return rts.render(moved(parts, index, transform), camera(), (SIZE, SIZE), splatter=splatter, layers=layers)

    return torch.func.jvp(image, (torch.zeros(()),), (torch.ones(()),))[1].numpy()[..., :3]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=Path("out/derivatives"))
    args = parser.parse_args()
    args.output.mkdir(parents=True, exist_ok=True)
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    methods = {"none": ("none", 1), "multi, K = 1": ("multi", 1), "multi, K = 2": ("multi", 2)}
    figure, axes = plt.subplots(3, 2 + len(methods), figsize=(3 * (2 + len(methods)), 9), layout="constrained")
    table: dict[str, dict] = {}
    for axis_row, (name, (parts, index, step)) in zip(axes, cases().items(), strict=True):
        image = rts.render(parts, camera(), (SIZE, SIZE))[..., :3]
        truth = finite_difference(parts, index, step)
        columns = {"image": image, "finite differences": truth}
        for label, (splatter, layers) in methods.items():
            columns[label] = splatted(parts, index, step, splatter, layers)
            table[f"{name}, {label}"] = scores(columns[label], truth)
        for axis, (label, picture) in zip(axis_row, columns.items(), strict=True):
            axis.imshow(picture.clip(0, 1) if label == "image" else (picture / 2 + 0.5).clip(0, 1))
            axis.set_title(f"{name}: {label}", fontsize=10)
            axis.set_axis_off()
    figure.savefig(args.output / "derivatives.png", dpi=110)
    (args.output / "derivatives.json").write_text(json.dumps(table, indent=2))
    print(f"{'':22} rel. L2  cosine  low-pass L2  gain   spurious energy")
    for label, s in table.items():
        print(
            f"{label:22} {s['relative_l2']:7.3f} {s['cosine']:7.3f} {s['low_relative_l2']:11.3f} {s['low_gain']:7.3f}"
            f" {100 * s['spurious']:10.3f} %"
        )
    print(f"wrote {args.output}/derivatives.png and .json")


if __name__ == "__main__":
    main()
