"""Cost of `Watch.step` in the callback of a fit: `python apps/viewer/slowdown.py [STEPS]`.

First the processor time that a page takes by itself, which other programs on the machine disturb little. Then the time
of steps of one fit, of colours and positions of a sphere's vertices to pictures: in blocks of five, with and without,
which take turns. No browser is open, since one on the same machine takes time of its own.
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

BLOCK, SIZE = 5, (128, 128)


def sphere(cuts):
    """Vertices and faces."""
    mesh = trimesh.creation.icosphere(cuts)
    return np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces)


def occupied(watch, cuts, seconds=10.0):
    """The share of one core that a page takes while steps come 20 times a second, and a step's own processor time."""
    vertices, faces = sphere(cuts)
    watch.begin()
    start, before, own, number = time.perf_counter(), time.process_time(), 0.0, 0
    while (spent := time.perf_counter() - start) < seconds:
        called = time.thread_time()
        watch.step(number, 1 / (1 + number), vertices, faces, np.abs(vertices))
        own += time.thread_time() - called
        number += 1
        time.sleep(0.05)
    return (time.process_time() - before) / spent, own / number


def fitted(watch, steps):
    """Seconds of steps of a fit without and with a page, the first block left out."""
    vertices, faces = sphere(4)
    surface, colors = rts.Mesh(faces), 0.5 + 0.5 * vertices
    cameras = [rts.Camera.look_at(eye, (0, 0, 0)) for eye in ((3, 1, 0), (0, 1, 3), (-3, 1, 0), (0, 1, -3))]

    def images(parameters):
        part = rts.Part(surface, parameters, shader="unlit")
        return torch.stack([rts.render(part, camera, SIZE) for camera in cameras])

    target = images({"vertices": torch.tensor(0.8 * vertices), "colors": torch.tensor(colors)})
    start = {"vertices": torch.tensor(vertices), "colors": torch.full((len(vertices), 3), 0.5)}
    times, number = ([], []), [time.perf_counter()]

    def callback(step, parameters, loss):
        with_page = len(number) // BLOCK % 2
        if with_page:
            points, shades = (parameters[name].detach().numpy() for name in ("vertices", "colors"))
            watch.step(step, loss, points, faces, shades.clip(0, 1))
        number.append(time.perf_counter())
        if len(number) > BLOCK + 1:
            times[with_page].append(number[-1] - number[-2])

    watch.begin()
    options = {"steps": steps, "learning_rate": 1e-3, "callback": callback, "progress": False}
    rts.fit(lambda parameters: images(parameters) - target, start, **options)
    return times


def main(steps=200):
    """Print both."""
    with socket.socket() as tried:
        tried.bind(("127.0.0.1", 0))
        port = tried.getsockname()[1]
    watch = rts_viewer.Watch(port)
    for cuts in (4, 6):
        share, own = occupied(watch, cuts)
        triangles = 20 * 4**cuts
        print(
            f"{triangles} triangles: the page takes {100 * share:.1f} % of a core, Watch.step {1e3 * own:.2f} ms of it"
        )
    without, with_ = (1e3 * statistics.median(x) for x in fitted(watch, steps))
    print(f"a step of a fit takes {without:.1f} ms without and {with_:.1f} ms with a page: {with_ / without:.3f}")
    watch.close()


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
