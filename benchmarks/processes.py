"""Fits by one process and by two, started by torchrun: results, time of a step, and processes that end on the way.

    python -m benchmarks.processes
    python -m benchmarks.processes --ended 10

The fits are those of `tests/distributed_fit.py`. Steps are timed on spot, 24 pictures of 256², four a step.
Needs the models of the folder that RTS_DATA names.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

TESTS = Path(__file__).resolve().parent.parent / "tests"
LAUNCH = "-m", "torch.distributed.run", "--standalone"


def started(count: int, *words: object, restarts: int = 0, threads: int = 1) -> tuple[int, str]:
    """The exit code and output of a script in some processes."""
    launch = [*LAUNCH, "--nproc-per-node", str(count), "--max-restarts", str(restarts)] if count > 1 else []
    paths = [str(TESTS), *os.environ.get("PYTHONPATH", "").split(os.pathsep)]
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(filter(None, paths)),
        "OMP_NUM_THREADS": str(threads),
        "NUMBA_NUM_THREADS": str(threads),
        "TORCH_DISABLE_SHARE_RDZV_TCP_STORE": "1",  # Restarts may hang without, see docs/guides/many_views.md.
    }
    done = subprocess.run(
        [sys.executable, *launch, *map(str, words)], env=environment, capture_output=True, text=True, check=False
    )
    return done.returncode, done.stdout + done.stderr


def results(path: Path) -> dict[str, np.ndarray]:
    """The arrays that the script wrote."""
    with np.load(path) as known:
        return {name: known[name] for name in known.files}


def difference(a: Path, b: Path) -> float:
    """The largest relative difference of losses, and absolute one of parameters."""
    one, two = results(a), results(b)
    if one["history"].shape != two["history"].shape:
        return float("inf")
    return max(
        float(
            np.abs(two[name] / (one[name] if name == "history" else 1) - (1 if name == "history" else one[name])).max()
        )
        for name in one
    )


def compared(folder: Path) -> None:
    """Print how far two processes are from one, by each method."""
    script = TESTS / "distributed_fit.py"
    for method in ("adam", "lm"):
        for count in (1, 2):
            code, output = started(count, script, method, folder / f"{method}{count}.npz")
            if code:
                raise SystemExit(output)
        far = difference(folder / f"{method}1.npz", folder / f"{method}2.npz")
        count = len(results(folder / f"{method}1.npz")["history"])
        print(f"{method}: two processes against one after {count} losses: largest difference {far:.1e}", flush=True)


def ended(folder: Path, times: int) -> None:
    """End a process at random, some times for each method, and compare with the fit that was not broken."""
    rng, script = np.random.default_rng(0), TESTS / "distributed_fit.py"
    for method, most in (("adam", 70), ("lm", 40)):
        right = 0
        for k in range(times):
            rank, place = int(rng.integers(2)), int(rng.integers(2, most))
            result, checkpoint = folder / f"{method}_{k}.npz", folder / f"{method}_{k}.checkpoint"
            code, output = started(2, script, method, result, checkpoint, f"{rank}:{place}", restarts=2)
            broke = Path(f"{result}.ended").exists()
            same = not code and difference(folder / f"{method}2.npz", result) <= 1e-5
            left = sorted(p.name for p in folder.glob(f"{method}_{k}.*part"))
            right += same and broke and not left
            if not (same and broke) or left:
                print(method, rank, place, code, broke, left, output[-500:])
        print(f"{method}: {right} of {times} fits whose process ended were right after the restart", flush=True)


def worker(steps: int) -> None:
    """Fit spot, and print the median time of a step, in the first process."""
    import torch
    import torch.distributed.nn  # Before the group is made, see docs/guides/many_views.md.
    import trimesh

    import rts
    from benchmarks import many_views

    if "RANK" in os.environ:
        torch.distributed.init_process_group("gloo")
    known = many_views.subject("spot")
    ball = trimesh.creation.icosphere(4, radius=0.6)
    large = rts.LargeSteps(ball.vertices, ball.faces, 40)
    surface, times = rts.Mesh(ball.faces), []
    p = {
        "shape": torch.tensor(np.asarray(large.encode(np.asarray(ball.vertices, np.float32)))),
        "colors": torch.full((len(ball.vertices), 3), 0.5),
    }
    residuals = rts.ViewResiduals(
        lambda p: rts.Part(surface, {"vertices": large.decode(p["shape"]), "colors": p["colors"]}, "unlit"),
        known.views,
        batch=many_views.BATCH,
    )
    rts.fit(residuals, p, steps=steps, validate_every=steps, callback=lambda *_: times.append(time.perf_counter()))
    if int(os.environ.get("RANK", 0)) == 0:
        print(f"median step {1e3 * np.median(np.diff(times[5:-1])):.0f} ms")
    if torch.distributed.is_initialized():
        torch.distributed.destroy_process_group()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--worker", type=int, help="time so many steps, in this process")
    parser.add_argument("--ended", type=int, default=10, help="fits of each method whose process ends")
    options = parser.parse_args()
    if options.worker:
        worker(options.worker)
        raise SystemExit
    with tempfile.TemporaryDirectory() as folder:
        compared(Path(folder))
        ended(Path(folder), options.ended)
    for count, threads in ((1, 1), (1, 2), (2, 1)):
        code, output = started(
            count, "-m" if count == 1 else "--module", "benchmarks.processes", "--worker", 40, threads=threads
        )
        print(
            f"{count} processes of {threads} threads: {output.strip().splitlines()[-1] if not code else output}",
            flush=True,
        )
