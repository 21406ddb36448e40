"""Time of a fit's steps with and without `Watch.step` in its callback: `python apps/viewer/slowdown.py [PAIRS]`.

Fits of the colours and positions of a sphere's vertices to pictures, with and without, take turns. No browser is open,
since a browser on the same machine takes time of its own.
"""

import socket
import statistics
import sys
import time

import numpy as np
import rts_viewer
import torch
import trimesh

import rts

STEPS, SIZE, CUTS = 40, (128, 128), 4


def fitted(watch):
    """Seconds of each step of a fit, the first five left out, and seconds of each call of `watch.step`."""
    sphere = trimesh.creation.icosphere(CUTS)
    vertices, faces = np.asarray(sphere.vertices, np.float32), np.asarray(sphere.faces)
    surface, colors = rts.Mesh(faces), 0.5 + 0.5 * vertices
    cameras = [rts.Camera.look_at(eye, (0, 0, 0)) for eye in ((3, 1, 0), (0, 1, 3), (-3, 1, 0), (0, 1, -3))]

    def images(parameters):
        part = rts.Part(surface, parameters, shader="unlit")
        return torch.stack([rts.render(part, camera, SIZE) for camera in cameras])

    target = images({"vertices": torch.tensor(0.8 * vertices), "colors": torch.tensor(colors)})
    start = {"vertices": torch.tensor(vertices), "colors": torch.full((len(vertices), 3), 0.5)}
    times, calls = [], []

    def callback(step, parameters, loss):
        times.append(time.perf_counter())
        if watch is None:
            return False
        points, shades = (parameters[name].detach().numpy() for name in ("vertices", "colors"))
        stopped = watch.step(step, loss, points, faces, shades.clip(0, 1))
        calls.append(time.perf_counter() - times[-1])
        return stopped

    if watch is not None:
        watch.begin()
    options = {"steps": STEPS, "learning_rate": 1e-3, "callback": callback, "progress": False}
    rts.fit(lambda parameters: images(parameters) - target, start, **options)
    return np.diff(times)[5:].tolist(), calls


def main(pairs=7):
    """Print medians of both, and their ratio."""
    with socket.socket() as tried:
        tried.bind(("127.0.0.1", 0))
        port = tried.getsockname()[1]
    watch = rts_viewer.Watch(port)
    fitted(None)  # Compiles.
    plain, watched, calls, ratios = [], [], [], []
    for _ in range(pairs):
        start = time.process_time()
        plain += fitted(None)[0]
        middle = time.process_time()
        steps, taken = fitted(watch)
        ratios.append((time.process_time() - middle) / (middle - start))
        watched, calls = watched + steps, calls + taken
    watch.close()
    medians = [1e3 * statistics.median(x) for x in (plain, watched)]
    print(
        f"a step takes {medians[0]:.1f} ms without and {medians[1]:.1f} ms with a page: {medians[1] / medians[0]:.3f}"
    )
    shown = ", ".join(f"{ratio:.3f}" for ratio in sorted(ratios))
    print(f"processor time of whole fits, with over without: median {statistics.median(ratios):.3f} of {shown}")
    print(f"Watch.step takes {1e3 * np.median(calls):.2f} ms, {1e3 * np.percentile(calls, 95):.2f} ms at most in 95 %")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
