"""A step of a pose's fit to a sheet of many million triangles, and the memory that the process takes.

python -m benchmarks.large_mesh
python -m benchmarks.large_mesh --vertices 1000 --size 256
"""

from __future__ import annotations

import argparse
import resource
import time

import numpy as np
import torch

import rts
from benchmarks.report import table


def sheet(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (count², 3) float32 and faces int32 of a wavy sheet."""
    u, v = np.meshgrid(*2 * [np.linspace(-1, 1, count, dtype=np.float32)])
    number = np.arange(count * count, dtype=np.int32).reshape(count, count)
    a, b, c, d = number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]
    faces = np.concatenate([np.stack(corners, -1).reshape(-1, 3) for corners in ((a, b, c), (a, c, d))])
    return np.stack([u, v, 0.2 * np.sin(5 * u) * np.cos(4 * v)], -1).reshape(-1, 3).astype(np.float32), faces


def most_memory() -> float:
    """The most memory that the process has taken so far, MiB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--vertices", type=int, default=2880, help="of each side of the sheet")
    parser.add_argument("--size", type=int, default=512, help="pixels of each side of the image")
    options = parser.parse_args()
    vertices, faces = sheet(options.vertices)
    surface, theta = rts.Mesh(faces), {"vertices": torch.as_tensor(vertices)}
    camera, count = rts.Camera.look_at((0, -2, 3), (0, 0, 0), fov_y=40), len(faces)
    del faces
    print(
        f"{count:,} triangles, {vertices.nbytes / 2**20 + count * 12 / 2**20:.0f} MiB; process {most_memory():.0f} MiB"
    )
    rows = []
    for shader in ("silhouette", "lambert"):
        times = []
        for _ in range(6):
            start, pose = time.perf_counter(), torch.zeros(6, requires_grad=True)
            part = rts.Part(surface, theta, shader, transform=rts.rigid(pose))
            rts.render(part, camera, (options.size, options.size)).sum().backward()
            times.append(time.perf_counter() - start)
        rows.append([shader, f"{times[0]:.2f}", f"{np.median(times[1:]):.3f}", f"{most_memory():.0f}"])
    print(table(["shader", "first step, s", "step, s", "most memory, MiB"], rows))


if __name__ == "__main__":
    main()
