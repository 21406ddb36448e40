"""Energies of a mesh's vertices and their gradients: time and memory, with torch and jax, float32.

The mesh is slightly deformed: noise of a thousandth of its size. *ms*: value and gradient, the energies in turn, jax
compiled. *MiB*: what three of these need beyond what the process holds, each case in a process of its own. *made*:
seconds that the constructor takes.

    python -m benchmarks.regularizers -o out/regularizers
    python -m benchmarks.regularizers --meshes teapot --rounds 2
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.meshes import MESHES, kept_mesh
from benchmarks.report import table
from benchmarks.speed.memory import growth
from benchmarks.timing import in_turn
from rts.arrays.engines import engine_named
from rts.regularizers import ARAP, EdgeLength, Laplacian, NormalConsistency, Regularizer
from rts_compare.environment import environment

ENERGIES: dict[str, Callable[[np.ndarray, np.ndarray], Regularizer]] = {
    "ARAP": ARAP,
    "Laplacian, uniform": Laplacian,
    "Laplacian, cotangent": lambda vertices, faces: Laplacian(vertices, faces, "cotangent"),
    "EdgeLength": EdgeLength,
    "NormalConsistency": lambda _, faces: NormalConsistency(faces),
}
ENGINES = ("torch", "jax")
NOISE = 1e-3


def iteration(energy: Callable, vertices: np.ndarray, engine: str) -> Callable[[], object]:
    """A call that computes value and gradient."""
    __import__(engine)
    library = engine_named(engine)
    noise = np.random.default_rng(0).normal(0, NOISE, vertices.shape)
    given = library.constant((vertices + noise).astype(np.float32))
    descend = library.jit(library.value_and_grad(energy))
    return lambda: library.block(descend(given))


def worker(mesh: str, folder: str, energy: str, engine: str) -> float:
    """Memory of one case, in this process; all is compiled before."""
    vertices, faces = kept_mesh(mesh, Path(folder))
    call = iteration(ENERGIES[energy](vertices, faces), vertices, engine)
    if engine == "torch":  # A small mesh is enough to compile all; jax compiles for the shapes of this one.
        iteration(ENERGIES[energy](vertices, faces[:1]), vertices, engine)()
    else:
        call()
    return growth(call)


def memory(mesh: str, folder: Path, energy: str, engine: str) -> float:
    """MiB of one case."""
    command = [sys.executable, "-m", "benchmarks.regularizers", "--worker", mesh, str(folder), energy, engine]
    return json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)


def measure(mesh: str, folder: Path, rounds: int) -> dict[str, Any]:
    """The results of a mesh: faces, and for each energy times by engine, memory by engine and seconds to make it."""
    vertices, faces = kept_mesh(mesh, folder)
    energies, made = {}, {}
    for name, make in ENERGIES.items():
        start = time.perf_counter()
        energies[name] = make(vertices, faces)
        made[name] = time.perf_counter() - start
    calls = {f"{n}|{e}": iteration(energy, vertices, e) for n, energy in energies.items() for e in ENGINES}
    times = in_turn(calls, rounds)
    rows = {
        name: {
            "made": made[name],
            "times": {engine: times[f"{name}|{engine}"] for engine in ENGINES},
            "memory": {engine: memory(mesh, folder, name, engine) for engine in ENGINES},
        }
        for name in ENERGIES
    }
    return {"faces": len(faces), "vertices": len(vertices), "rows": rows}


def written(mesh: str, found: dict[str, Any]) -> str:
    """A table in Markdown."""
    header = ["energy", *[f"{e}, ms" for e in ENGINES], *[f"{e}, MiB" for e in ENGINES], "made, s"]
    lines = [
        [
            name,
            *[f"{row['times'][e]['ms']:.1f}" for e in ENGINES],
            *[f"{row['memory'][e]:.0f}" for e in ENGINES],
            f"{row['made']:.2f}",
        ]
        for name, row in found["rows"].items()
    ]
    return f"{mesh}, {found['faces']:,} faces, {found['vertices']:,} vertices\n\n" + table(header, lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=Path("out/regularizers"))
    parser.add_argument("--meshes", nargs="+", choices=list(MESHES), default=["bunny"])
    parser.add_argument("--rounds", type=int, default=7)
    args = parser.parse_args()
    args.output.mkdir(parents=True, exist_ok=True)
    results = {mesh: measure(mesh, args.output, args.rounds) for mesh in args.meshes}
    about = environment(("numpy", "numba", "torch", "jax"))
    (args.output / "regularizers.json").write_text(json.dumps(about | {"results": results}, indent=2) + "\n")
    text = "\n".join(written(mesh, found) for mesh, found in results.items())
    (args.output / "regularizers.md").write_text(text)
    print(text)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--worker"]:
        print(json.dumps(worker(*sys.argv[2:])))
    else:
        main()
