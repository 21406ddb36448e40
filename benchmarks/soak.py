"""Memory of a long fit: 1,000 pictures of 512², which are read from disk by turns.

    python -m benchmarks.soak --minutes 10

Prints the memory of the process each minute. 100 MB of pictures are kept, of 4 GB.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from pathlib import Path

import numpy as np
import torch
import trimesh

import rts

COUNT, SIZE, KEPT, BATCH = 1000, 512, 100 * 2**20, 4


def resident() -> float:
    """Memory of this process in RAM, MB (Linux)."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20


def views(folder: Path, part: rts.Part, count: int) -> list[rts.View]:
    """Pictures of a part from all around, written to a folder, and not kept."""
    made = []
    for i, direction in enumerate(np.random.default_rng(0).normal(size=(count, 3))):
        camera = rts.Camera.look_at(3 * direction / np.linalg.norm(direction), (0, 0, 0))
        path = folder / f"{i}.png"
        rts.save_image(path, rts.render(part, camera, (SIZE, SIZE)))
        made.append(rts.View(camera, lambda path=path: rts.load_image(path), (SIZE, SIZE), name=path.name))
    return made


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=10)
    parser.add_argument("--count", type=int, default=COUNT)
    options = parser.parse_args()
    ball = trimesh.creation.icosphere(4)
    start = np.asarray(ball.vertices, np.float32)
    surface, light = rts.Mesh(ball.faces), {"direction": np.float32([0.3, 0.8, 0.5])}

    def scene(p: dict) -> rts.Part:
        return rts.Part(surface, {"vertices": p["vertices"], "light": light}, "lambert")

    with tempfile.TemporaryDirectory() as folder:
        pictures = views(Path(folder), scene({"vertices": start * np.float32([1.1, 0.9, 1])}), options.count)
        residuals = rts.ViewResiduals(scene, pictures, batch=BATCH, memory=KEPT)
        begin, notes = time.perf_counter(), []

        def report(step: int, parameters: dict, loss: float) -> bool:
            minutes = (time.perf_counter() - begin) / 60
            if minutes >= len(notes):
                notes.append(resident())
                print(f"{minutes:.1f} min, step {step}, loss {loss:.2e}: {notes[-1]:.0f} MB", flush=True)
            return minutes > options.minutes

        rts.fit(
            residuals,
            {"vertices": torch.tensor(start)},
            learning_rate=1e-4,
            steps=10**6,
            validation=rts.ViewResiduals(scene, pictures[:8]),
            validate_every=1000,
            patience=10**6,
            callback=report,
        )
    print(f"from minute 1 to the end: {notes[-1] - notes[1]:+.0f} MB, at most {max(notes[1:]) - notes[1]:+.0f} MB")


if __name__ == "__main__":
    main()
