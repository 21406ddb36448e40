"""The cost of sampling: milliseconds to prepare and to sample, by faces, layers and size of the image.

All samplers take turns in one run; beside them, embreex's own first-hit `run` of the same rays, and a bare K-buffer
loop (ids only, one thread and float32) over the same triangles, projected beforehand. Writes a table and a log–log
chart:

    python -m benchmarks.speed.samplers -o out/samplers
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import numba
import numpy as np

import rts
from benchmarks.camera import camera
from benchmarks.meshes import MESHES, mesh, subdivided
from rts.compiling.threads import thread_count
from rts.contracts.records import Proxy
from rts_backends.triangles import pixel_matrix

MEASURED = ("teapot_2464", "bunny", "spot", "nefertiti")
"""The meshes of `benchmarks.meshes.MESHES` that are sampled."""

SAMPLERS = ("raster", "embree", "opengl")
SIZES, LAYERS = (256, 512), (1, 2, 4)


def proxy_of(name: str) -> Proxy:
    """One of MESHES, with its seams."""
    file, times = MESHES[name]
    vertices, faces = subdivided(*mesh(file), times)
    return Proxy(np.ascontiguousarray(vertices, np.float32), np.ascontiguousarray(faces, np.int32))


def interleaved(functions: dict[str, Callable[[], object]], rounds: int) -> dict[str, float]:
    """Median milliseconds of each, taking turns, after two rounds to warm up."""
    times: dict[str, list[float]] = {name: [] for name in functions}
    for n in range(rounds + 2):
        for name, function in functions.items():
            start = time.perf_counter()
            function()
            if n >= 2:
                times[name].append(1e3 * (time.perf_counter() - start))
    return {name: statistics.median(t) for name, t in times.items()}


@numba.njit(nogil=True)
def bare_loop(faces, screen, depths, ids):
    """The least that a K-buffer does: screen (V, 3) is pixel x, y and depth."""
    height, width, layers = ids.shape
    for t in range(len(faces)):
        a, b, c = faces[t, 0], faces[t, 1], faces[t, 2]
        ax, ay, bx, by, cx, cy = screen[a, 0], screen[a, 1], screen[b, 0], screen[b, 1], screen[c, 0], screen[c, 1]
        i0, i1 = max(0, int(np.ceil(min(ax, bx, cx) - 0.5))), min(width - 1, int(np.floor(max(ax, bx, cx) - 0.5)))
        j0, j1 = max(0, int(np.ceil(min(ay, by, cy) - 0.5))), min(height - 1, int(np.floor(max(ay, by, cy) - 0.5)))
        if i0 > i1 or j0 > j1:
            continue
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if area == 0:
            continue
        for j in range(j0, j1 + 1):
            for i in range(i0, i1 + 1):
                x, y = i + 0.5, j + 0.5
                wa = ((bx - x) * (cy - y) - (by - y) * (cx - x)) / area
                wb = ((cx - x) * (ay - y) - (cy - y) * (ax - x)) / area
                if wa < 0 or wb < 0 or wa + wb > 1:
                    continue
                z = wa * screen[a, 2] + wb * screen[b, 2] + (1 - wa - wb) * screen[c, 2]
                if z >= depths[j, i, layers - 1]:
                    continue
                k = layers - 1
                while k > 0 and z < depths[j, i, k - 1]:
                    depths[j, i, k], ids[j, i, k] = depths[j, i, k - 1], ids[j, i, k - 1]
                    k -= 1
                depths[j, i, k], ids[j, i, k] = z, t


def bare(proxy: Proxy, view: rts.Camera, size: int, layers: int) -> Callable[[], object]:
    homogeneous = np.c_[proxy.vertices, np.ones(len(proxy.vertices))] @ pixel_matrix(view, (size, size)).T
    screen = homogeneous[:, [0, 1, 3]].copy()
    screen[:, :2] /= screen[:, 2:]
    screen = screen.astype(np.float32)

    def call() -> None:
        depths, ids = np.full((size, size, layers), np.inf, np.float32), np.full((size, size, layers), -1, np.int32)
        bare_loop(proxy.faces, screen, depths, ids)

    return call


def embreex_run(proxy: Proxy, view: rts.Camera, size: int) -> Callable[[], object]:
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene

    scene = EmbreeScene()
    TriangleMesh(scene, proxy.vertices, proxy.faces)
    rays = view.rays((size, size))
    origins, directions = (np.ascontiguousarray(x.reshape(-1, 3), np.float32) for x in (rays.origins, rays.directions))
    return lambda: scene.run(origins, directions)


def measure(name: str, proxy: Proxy, rounds: int) -> list[dict]:
    view = camera()
    part = rts.Part(rts.plugin("rts.surfaces", "mesh")(proxy.faces), {"vertices": proxy.vertices})
    samplers = {s: rts.plugin("rts.samplers", s)() for s in SAMPLERS}
    prepare = interleaved({s: lambda x=x: x.prepare(proxy) for s, x in samplers.items()}, 3)
    prepared = {s: x.prepare(proxy) for s, x in samplers.items()}
    structure = prepared["embree"]
    handles = {s: rts.prepare(part, s) for s in SAMPLERS}
    moved = interleaved({"embree refit": lambda: structure.move(proxy)}, 3)
    rows = []
    for size in SIZES:
        for layers in LAYERS:
            shape = (size, size)

            def one_thread(sampler, prepared, shape=shape, layers=layers) -> None:
                os.environ["RTS_NUM_THREADS"] = "1"
                sampler.rasterize(prepared, view, shape, layers, "none")
                del os.environ["RTS_NUM_THREADS"]

            functions: dict[str, Callable[[], object]] = {
                s: lambda s=s, x=x, shape=shape, layers=layers: x.rasterize(prepared[s], view, shape, layers, "none")
                for s, x in samplers.items()
            }
            functions |= {f"{s}, one thread": lambda s=s: one_thread(samplers[s], prepared[s]) for s in SAMPLERS[:2]}
            functions |= {
                f"{s}, rts.sample": lambda s=s, shape=shape, layers=layers: rts.sample(
                    handles[s], view, shape, layers=layers
                )
                for s in SAMPLERS
            }
            functions["bare loop"] = bare(proxy, view, size, layers)
            if layers == 1:
                functions["embreex run"] = embreex_run(proxy, view, size)
            row = {"mesh": name, "faces": len(proxy.faces), "size": size, "layers": layers}
            rows.append(row | {"prepare": prepare | moved, "sample": interleaved(functions, rounds)})
            print(line(rows[-1]), flush=True)
    return rows


COLUMNS = (
    *SAMPLERS,
    "raster, one thread",
    "embree, one thread",
    *(f"{s}, rts.sample" for s in SAMPLERS),
    "bare loop",
    "embreex run",
)


def line(row: dict) -> str:
    times = " | ".join(f"{row['sample'][c]:.1f}" if c in row["sample"] else "" for c in COLUMNS)
    return f"| {row['faces']:,} | {row['size']}² | {row['layers']} | {times} |"


def crossover(rows: list[dict], layers: int, size: int) -> float | None:
    """Faces from which embree samples faster than raster draws, interpolated in logarithms."""
    points = [(r["faces"], r["sample"]["raster"] / r["sample"]["embree"]) for r in rows]
    points = [p for r, p in zip(rows, points, strict=True) if r["layers"] == layers and r["size"] == size]
    for (f0, r0), (f1, r1) in zip(points, points[1:], strict=False):
        if r0 < 1 <= r1:
            s = -np.log(r0) / (np.log(r1) - np.log(r0))
            return float(np.exp(np.log(f0) + s * (np.log(f1) - np.log(f0))))
    return None


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=Path("out/samplers"))
    parser.add_argument("--rounds", type=int, default=11)
    args = parser.parse_args()
    args.output.mkdir(parents=True, exist_ok=True)
    print(f"{thread_count()} threads")
    print("| faces | size | K | " + " | ".join(COLUMNS) + " |")
    print("|---" * (3 + len(COLUMNS)) + "|")
    rows = []
    for name in MEASURED:
        rows += measure(name, proxy_of(name), args.rounds)
    print("\nprepare, milliseconds: | faces | " + " | ".join(rows[0]["prepare"]) + " |")
    for row in rows[:: len(SIZES) * len(LAYERS)]:
        print(f"| {row['faces']:,} | " + " | ".join(f"{t:.1f}" for t in row["prepare"].values()) + " |")
    for size in SIZES:
        for layers in LAYERS:
            at = crossover(rows, layers, size)
            print(f"{size}², K = {layers}: " + (f"embree ahead from {at:,.0f} faces" if at else "no crossover"))
    (args.output / "samplers.json").write_text(json.dumps(rows, indent=1))
    print(f"wrote {args.output}/samplers.json")


if __name__ == "__main__":
    main()
