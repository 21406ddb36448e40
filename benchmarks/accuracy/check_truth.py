"""The errors of the ground truth itself: its noise, and the error of differences over a step beside closed forms.

Prints a line for each scene and step:

    python -m benchmarks.accuracy.check_truth
"""

from __future__ import annotations

import argparse
from pathlib import Path

from benchmarks.accuracy import scenes
from benchmarks.accuracy.closed_forms import CLOSED_FORMS, closed_form
from rts_compare.derivative_scores import all_scores

STEPS = (1.0, 0.25)
"""Lengths of the central differences, pixels."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=Path("out/truth"), help="where truths are kept")
    parser.add_argument("--scenes", nargs="+", choices=scenes.SCENES, default=list(CLOSED_FORMS))
    args = parser.parse_args()
    print(
        "Relative L2, raw and low-passed: between the grids; of their mean against the closed form over the same step;"
    )
    print("and of that difference against the exact derivative, which is what the step itself costs.")
    print(f"{'scene':22} step    noise          closed form    step")
    for name in args.scenes:
        scene = scenes.scene(name)
        closed = closed_form(scene)
        for step in STEPS:
            measured = scene.truth(args.output, step)
            line = f"{name:22} {step:4g}  {_pair(measured.noise)}"
            if closed:
                exact = closed.truth(step)
                line += f"  {_pair(all_scores(measured.derivative, exact.derivative))}"
                line += f"  {_pair(all_scores(exact.derivative, closed.derivative))}"
            print(line, flush=True)


def _pair(values: dict[str, float]) -> str:
    return f"{values['relative_l2']:.4f} {values['low_relative_l2']:.4f}"


if __name__ == "__main__":
    main()
