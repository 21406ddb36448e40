"""What a step of a fit moves between host and device, and the operators that it runs there.

    python -m benchmarks.gpu.crossings [--device cuda] [--meshes bunny] [--sides 256 512]

A step is that of `benchmarks.gpu.tables` with torch: the shaded image of a mesh, one layer, its loss, the gradient of
the pose, a step of Adam. Counts need no GPU: by default the device is the stand-in of the tests, whose memory no host
code can read. Kernels are no more than operators there, since one kernel is launched for most of them.
"""

from __future__ import annotations

import argparse
import contextlib
import sys
import traceback
from collections import Counter
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch.utils import _pytree
from torch.utils._python_dispatch import TorchDispatchMode

from benchmarks.gpu.tables import torch_step
from benchmarks.meshes import MESHES, kept_mesh
from benchmarks.report import table
from benchmarks.speed.pose_iteration import Task

ROOT = Path(__file__).resolve().parents[2]
FREE = frozenset(
    "prim.device aten.alias aten.as_strided aten.detach aten.diagonal aten.expand aten.permute aten.select aten.slice "
    "aten.split aten.split_with_sizes aten.squeeze aten.t aten.transpose aten.unbind aten.unsqueeze aten.view "
    "aten._unsafe_view".split()
)
"""Operators that launch nothing: views, and a question."""


class Crossing(NamedTuple):
    """An array that crosses: "to the host" or "to the device", its bytes, shape, and the line that asked for it."""

    way: str
    bytes: int
    shape: tuple[int, ...]
    line: str


class Counted(TorchDispatchMode):
    """Counts crossings and operators on a device while it is entered.

    Attributes:
        device: the type of the device.
        crossings: in their order.
        operators: how often each operator that is no view ran on the device.
    """

    def __init__(self, device: str):
        super().__init__()
        self.device = device
        self.crossings: list[Crossing] = []
        self.operators: Counter[str] = Counter()

    def __torch_dispatch__(self, func: Any, types: Any, args: tuple = (), kwargs: dict | None = None) -> Any:
        out = func(*args, **(kwargs or {}))
        before = [x for x in _pytree.tree_leaves((args, kwargs)) if isinstance(x, torch.Tensor)]
        there = [x.device.type == self.device for x in before]
        after = [x for x in _pytree.tree_leaves(out) if isinstance(x, torch.Tensor)]
        now = [x.device.type == self.device for x in after]
        if func is torch.ops.aten._local_scalar_dense.default and any(there):
            self._cross("to the host", before[0])
        elif func.overloadpacket in (torch.ops.aten._to_copy, torch.ops.aten.copy_) and there[-1] != now[0]:
            self._cross("to the device" if now[0] else "to the host", after[0])
        elif any(there) and str(func.overloadpacket) not in FREE:
            self.operators[str(func.overloadpacket)] += 1
        return out

    def _cross(self, way: str, x: torch.Tensor) -> None:
        self.crossings.append(Crossing(way, x.numel() * x.element_size(), tuple(x.shape), _line()))


def _line() -> str:
    """The innermost line on the stack of the library, the engine's own left out."""
    for frame in reversed(traceback.extract_stack()):
        path = Path(frame.filename)
        if path.is_relative_to(ROOT) and path.relative_to(ROOT).parts[0] in ("rts", "rts_surfaces"):
            return f"{path.relative_to(ROOT)}:{frame.lineno} {frame.name}"
    return "outside"


def names(crossings: list[Crossing]) -> list[str]:
    """What each crossing holds."""
    found: Counter[tuple[str, str]] = Counter()
    known: list[str] = []
    for crossing in crossings:
        call = crossing.way, crossing.line.rpartition(" ")[2]
        if not crossing.bytes or crossing.shape in ((), (1,), (3,), (6,), (4, 4)):
            known.append(NUMBERS)
            continue
        known.append(ORDER[call][found[call]] if call in ORDER else call[1])
        found[call] += 1
    return known


NUMBERS = "matrices and single numbers"
_OF_SAMPLES = ("ids", "barycentrics", "row", "depth")
_OF_STENCIL = ("joined", "cells of colours", "colours", "weights of colours")
_OF_STENCIL += ("cells of motions", "motions", "weights of motions", "colours of motions")
ORDER = {
    ("to the device", "in_engine"): (*_OF_SAMPLES, *_OF_STENCIL),
    ("to the host", "value_of"): ("vertices",),
    ("to the device", "table_of"): ("faces",),
}
"""The arrays that cross in a call, in their order, numbers and matrices left out."""


def counted(task: Task, device: str) -> tuple[list[Crossing], dict[str, int]]:
    """The crossings of the second step of a fit, and the operators of its stages on the device."""
    stages = torch_step(task, "pose", device)
    crossings: list[Crossing] = []
    operators = {}
    for step in range(2):
        for name, stage in stages.items():
            with Counted(device) as counts:
                stage()
            if step:
                crossings += counts.crossings
                operators[name] = sum(counts.operators.values())
    return crossings, operators


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--device", default="stand-in", help="cuda, or the stand-in of the tests")
    parser.add_argument("--meshes", nargs="*", default=["bunny"], choices=list(MESHES), help="by name")
    parser.add_argument("--sides", nargs="*", type=int, default=[256, 512], help="of the images, pixels")
    options = parser.parse_args()
    entered: Any = contextlib.nullcontext()
    if options.device == "stand-in":
        sys.path.append(str(ROOT / "tests"))
        import elsewhere  # pyright: ignore[reportMissingImports]  # It lies among the tests.

        entered, options.device = elsewhere.Device(), elsewhere.DEVICE.type
    columns, found = [], []
    for mesh in options.meshes:
        vertices, faces = kept_mesh(mesh, Path("out/meshes"))
        for side in options.sides:
            task = Task(mesh, vertices, faces, side, "lambert", 1)
            with entered:
                found.append(counted(task, options.device))
            columns.append(f"{len(faces):,} faces, {side}²")
    each = [Counter[tuple[str, str]]() for _ in found]
    for sums, (crossings, _) in zip(each, found, strict=True):
        for crossing, name in zip(crossings, names(crossings), strict=True):
            sums[crossing.way, name] += crossing.bytes
    lines = [[way, name, *(f"{sums[way, name]:,}" for sums in each)] for way, name in each[0] if each[0][way, name]]
    for way in ("to the host", "to the device"):
        lines.append([way, "all", *(f"{sum(n for (w, _), n in sums.items() if w == way):,}" for sums in each)])
    print(table(["way", "bytes of a step", *columns], lines))
    lines = [["arrays that cross, " + way] for way in ("to the host", "to the device")]
    for line, way in zip(lines, ("to the host", "to the device"), strict=True):
        line += [str(sum(c.way == way and c.bytes > 0 for c in crossings)) for crossings, _ in found]
    lines += [[f"operators, {stage}", *(f"{ops[stage]:,}" for _, ops in found)] for stage in found[0][1]]
    print(table(["counts of a step", *columns], lines))


if __name__ == "__main__":
    main()
