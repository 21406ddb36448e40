"""Budgets that are counts, and so the same on every machine: what a small step calls, and what there is to read.

A number is raised only with its reason beside it. Whoever lowers what is counted lowers the number, too.
"""

import ast
import subprocess
import sys
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import trimesh

import rts

torch = pytest.importorskip("torch")

pytestmark = pytest.mark.core

ROOT = Path(__file__).parents[2]
PACKAGES = ("rts", "rts_backends", "rts_surfaces", "rts_cli", "rts_diagnostics", "rts_testing")

CALLS = {"silhouette": 582, "lambert": 789}
"""The most Python calls of the library's own functions in a step of 48 x 48 pixels: a pose, an image, its gradient."""

LINES = 36_492
"""The most lines of code of these packages, without blank lines, comments and docstrings.

Of the last ones added, three keep functions of users, such as networks, to one thread at a time; 71 take a tenth off a
step of large meshes, whose triangles mostly lie between the lines of centres. 345 average textures over what a pixel
shows of them, with the derivative of the mean; before, that of a texel's slope was off by more than it was itself. 28
keep what the near plane cuts at the plane.
"""

LINES_OF_A_RENDER = 12_000
"""The most lines of code of the modules that a first render in torch, with light, imports."""


def lines_of_code(path):
    """Lines that hold code: neither blank, nor of a comment, nor of a docstring."""
    text = path.read_text(encoding="utf-8")
    docstrings = set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            docstrings.update(range(node.lineno, node.end_lineno + 1))
    lines = enumerate(text.splitlines(), 1)
    return sum(1 for n, line in lines if n not in docstrings and line.strip() and not line.strip().startswith("#"))


def own_calls(function):
    """A function's result, and how often functions of the packages are called meanwhile, by file and name."""
    counts, folders = Counter(), tuple(str(ROOT / package) for package in PACKAGES)

    def note(frame, event, _):
        code = frame.f_code
        if event == "call" and code.co_filename.startswith(folders):
            counts[f"{Path(code.co_filename).relative_to(ROOT)}:{code.co_name}"] += 1

    before = sys.getprofile()
    sys.setprofile(note)
    try:
        result = function()
    finally:
        sys.setprofile(before)
    return result, counts


@pytest.mark.parametrize("shader", CALLS)
def test_a_small_step_makes_few_calls(shader, monkeypatch):
    monkeypatch.setenv("RTS_NUM_THREADS", "1")
    ball = trimesh.creation.icosphere(2)
    mesh, camera = rts.Mesh(np.asarray(ball.faces)), rts.Camera.look_at((0, 0.5, 3), (0, 0, 0), fov_y=40)
    theta = {"vertices": torch.as_tensor(np.asarray(ball.vertices, np.float32))}

    def step():
        pose = torch.zeros(6, requires_grad=True)
        rts.render(rts.Part(mesh, theta, shader, transform=rts.rigid(pose)), camera, (48, 48)).sum().backward()
        return pose.grad

    step()
    gradient, counts = own_calls(step)
    assert torch.isfinite(gradient).all()
    assert counts.total() <= CALLS[shader], counts.most_common(20)
    # Gradients are made where torch calls, on this thread: they are counted as well.
    assert any("stencil.py:_pull" in name for name in counts)


def test_there_is_little_to_read():
    count = sum(lines_of_code(path) for package in PACKAGES for path in (ROOT / package).rglob("*.py"))
    assert LINES * 0.97 < count <= LINES


def test_a_render_imports_little():
    program = """
import sys, numpy as np, torch, rts
camera = rts.Camera.look_at((0, 0, 3), (0, 0, 0), fov_y=40)
points = torch.tensor([[-1.0, -1, 0], [1, -1, 0], [0, 1, 0]])
theta = {"vertices": points, "color": torch.ones(3)}
rts.render(rts.Part(rts.Mesh(np.array([[0, 1, 2]])), theta, "lambert"), camera, (16, 16))
for name, module in sorted(sys.modules.items()):
    if name.partition(".")[0] in ("rts", "rts_backends", "rts_surfaces") and getattr(module, "__file__", None):
        print(module.__file__)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, cwd=ROOT)
    files = [Path(line) for line in done.stdout.splitlines() if line.endswith(".py")]
    assert len(files) > 50
    assert sum(map(lines_of_code, files)) <= LINES_OF_A_RENDER
