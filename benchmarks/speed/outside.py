"""A pose iteration with the compiled splatter `single`, and with one made outside of the library, taking turns.

python -m benchmarks.speed.outside [rounds]
"""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path

import rts
from benchmarks import meshes
from benchmarks.speed.pose_iteration import Task, torch_iteration

sys.path.append(str(Path(__file__).resolve().parents[2] / "tests"))

from fast_splatter.rts_fast_splatter import FastSingle  # noqa: E402

CALLS = 5
"""Calls timed in a turn, after one that is not."""


def turn(step: Callable[[], object]) -> tuple[float, float]:
    """Milliseconds of wall clock and of all cores, of a call."""
    step()
    wall, cores = time.perf_counter(), time.process_time()
    for _ in range(CALLS):
        step()
    return 1e3 * (time.perf_counter() - wall) / CALLS, 1e3 * (time.process_time() - cores) / CALLS


def main(rounds: int) -> None:
    """Print a table."""
    vertices, faces = meshes.mesh("bunny")
    splatters = {"inside": rts.plugin("splatters", "single")(), "outside": FastSingle()}
    print(
        "| side | shader | inside: wall, cores (ms) | outside | ratio of wall | of cores |\n|---|---|---|---|---|---|"
    )
    for side in (256, 512):
        for shader in ("silhouette", "lambert"):
            given = vertices.astype("float32"), faces.astype("int32"), side, shader, 1
            steps = {name: torch_iteration(Task("bunny", *given, s)) for name, s in splatters.items()}
            times: dict[str, list[tuple[float, float]]] = {name: [] for name in steps}
            for n in range(rounds + 2):
                for name in sorted(steps, reverse=n % 2 == 1):
                    times[name].append(turn(steps[name]))
            pairs = list(zip(*(times[name][2:] for name in splatters), strict=True))
            inside, outside = ([statistics.median(x) for x in zip(*t[2:], strict=True)] for t in times.values())
            ratios = [statistics.median(o[k] / i[k] for i, o in pairs) for k in (0, 1)]
            shown = [f"{w:.2f}, {c:.2f}" for w, c in (inside, outside)] + [f"{r:.3f}" for r in ratios]
            print(f"| {side}² | {shader} | {' | '.join(shown)} |", flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 15)
