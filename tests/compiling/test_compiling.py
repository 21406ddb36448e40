"""Compilation: few loops, each once; a message on terminals alone."""

import gc
import importlib.util
import io
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from helpers import quick

import rts

pytest.importorskip("numba")
import numba

from rts.compiling import numba_internals as compiling
from rts.compiling import warmup
from rts.operations import take_loops

pytestmark = pytest.mark.core

ROOT = Path(__file__).resolve().parents[2]

FIRST_RENDER = """
import sys
import numpy as np
import rts
from numba.core.dispatcher import Dispatcher

def specialisations():
    ours = ("rts", "rts_backends", "rts_surfaces")
    modules = [m for name, m in sys.modules.items() if name.partition(".")[0] in ours]
    found = {id(x): x for m in modules for x in vars(m).values() if isinstance(x, Dispatcher)}
    kept = [x for x in found.values() if x.overloads and x._cache.cache_path is not None]
    return {f"{x.__module__}.{x.__name__}": len(x.overloads) for x in kept}

vertices = np.array([(-1, -1, 0), (1, -1, 0), (0, 1, 0.5), (-1, 0, -1)], np.float32)
part = rts.Part(rts.plugin("surfaces", "mesh")([(0, 1, 2), (1, 3, 2)]), {"vertices": vertices})
camera = rts.Camera.look_at((0, 0, 3), (0, 0, 0))
rts.render(part, camera, (40, 50))
first = specialisations()
vertices.flags.writeable = False
moved = part.replace(theta={"vertices": np.asfortranarray(vertices)}, transform=rts.rigid([0, 0.1, 0, 0, 0, 0]))
rts.render(moved, camera, (33, 40), sampler="raster")
rts.render(part, camera, (40, 50), sampler="raster")
again = specialisations()
assert all(again[name] == count for name, count in first.items()), (first, again)
print(len(first), max(first.values()), *sorted(first))
"""


def test_the_first_render_compiles_few_loops_each_once():
    done = subprocess.run([sys.executable, "-c", FIRST_RENDER], capture_output=True, text=True, check=True)
    count, most, *_ = done.stdout.split()
    assert 8 <= int(count) <= 42, done.stdout
    assert int(most) == 1, done.stdout
    assert not done.stderr  # It is no terminal.


class Terminal(io.StringIO):
    def isatty(self):
        return True


OURS, THEIRS = (type("", (), {"data": {"dispatcher": x}}) for x in (take_loops.put, numba.njit(lambda x: x)))
"""Events of a loop, and of another function that is compiled."""


@pytest.mark.parametrize(("stream", "told"), [(Terminal(), True), (io.StringIO(), False)], ids=["terminal", "pipe"])
def test_a_terminal_is_told_once_of_what_takes_long(stream, told, monkeypatch):
    monkeypatch.setattr(sys, "stderr", stream)
    watch = compiling._Watch()

    def compile_(event, seconds):
        monkeypatch.setattr(compiling.time, "perf_counter", lambda: 0.0)
        watch.on_start(event)
        watch.on_start(event)  # Helpers are compiled within.
        watch.on_end(event)
        monkeypatch.setattr(compiling.time, "perf_counter", lambda: seconds)
        watch.on_end(event)

    compile_(OURS, 0.5)
    compile_(THEIRS, 9.0)
    assert not stream.getvalue()
    for seconds in (2.5, 1.0, 4.0):
        compile_(OURS, seconds)
    lines = stream.getvalue().splitlines()
    assert len(lines) == told and all(line.startswith("rts: compiling loops (once") for line in lines)


def test_no_garbage_is_collected_while_loops_are_compiled():
    watch = compiling._Watch()
    for event, paused in ((OURS, True), (THEIRS, False)):
        watch.on_start(event)
        watch.on_start(OURS)
        watch.on_end(OURS)
        assert gc.isenabled() is not paused
        watch.on_end(event)
        assert gc.isenabled()


NEEDS_PYTHON = """
import sys
sys.path.insert(0, {folder!r})
import needy
import numpy as np
try:
    needy.checked(-3.0)
except ValueError as error:
    print(error)
print(needy.checked(3.0))
"""

NEEDY = """
from rts.compiling.loops import compiled, loop

@compiled
def check(x):
    if x < 0:
        raise ValueError("below zero", x)
    print("checked", x)

@loop
def checked(x):
    check(x)
    return 2 * x
"""


@pytest.mark.thorough
def test_helpers_may_print_and_raise_errors_with_values(tmp_path):
    (tmp_path / "needy.py").write_text(NEEDY)
    code = NEEDS_PYTHON.format(folder=str(tmp_path))
    for _ in range(2):  # Compiled, and from disk.
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=120)
        assert done.stdout.splitlines() == ["('below zero', -3.0)", "checked 3.0", "6.0"]


def test_warmup_says_what_failed(monkeypatch):
    monkeypatch.setattr(warmup, "FIRST", ("nothing",))
    with pytest.raises(rts.RtsError, match="could not compile loops: KeyError: 'nothing'"):
        rts.warmup(1)


ORDINARY_CALLS = """
import sys
from numba.core.dispatcher import Dispatcher
from benchmarks.cold_start import TASKS
from rts.compiling import warmup_calls, warmup

def compiled():
    ours = ("rts", "rts_backends", "rts_surfaces")
    modules = [m for name, m in sys.modules.items() if name.partition(".")[0] in ours]
    found = {id(x): x for m in modules for x in vars(m).values() if isinstance(x, Dispatcher)}
    return {f"{x.__module__}.{x.__name__} {sig}" for x in found.values() for sig in x.overloads}

for name in warmup.FIRST + warmup.OTHERS:
    getattr(warmup_calls, name)()
before = compiled()
assert len(before) > 40
for task in TASKS.values():
    task()()
print(*(compiled() - before), sep="\\n")
"""


@pytest.mark.thorough
def test_warmup_makes_all_that_ordinary_calls_need():
    for package in ("torch", "jax"):
        pytest.importorskip(package)
    done = subprocess.run(
        [sys.executable, "-c", ORDINARY_CALLS], capture_output=True, text=True, check=True, timeout=600, cwd=ROOT
    )
    assert not done.stdout.split()


@pytest.mark.parametrize("processes", [0, -1, 1.5, "two", True])
def test_a_wrong_number_of_processes_is_refused(processes):
    with pytest.raises(rts.InputError, match="processes is .*; expected a positive integer, or None"):
        rts.warmup(processes)


DOUBLE = "from rts.compiling.loops import loop\n\n\n@loop\ndef double(x):\n    x *= 2\n"

SAVING = """
import sys
sys.path.insert(0, {folder!r})
import numpy as np
from several import double
print("called", flush=True)
double(np.zeros(3, np.{kind}))
"""


@pytest.mark.skipif(compiling.fcntl is None, reason="the system has no such locks")
@pytest.mark.thorough
def test_loops_are_written_by_one_process_at_a_time(tmp_path):
    (tmp_path / "several.py").write_text(DOUBLE)
    kept = tmp_path / "__pycache__"
    kept.mkdir()

    def started(kind):
        code = SAVING.format(folder=str(tmp_path), kind=kind)
        variables = {k: v for k, v in os.environ.items() if k != "NUMBA_CACHE_DIR"}
        process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, env=variables)
        assert process.stdout is not None and process.stdout.readline() == "called\n"
        return process

    with compiling.alone(str(kept)):
        processes = [started(kind) for kind in ("float32", "int64")]
        with pytest.raises(subprocess.TimeoutExpired):
            processes[0].wait(3)  # To compile this takes a tenth of a second.
        assert not list(kept.glob("several.double*"))
    for process in processes:
        process.communicate(timeout=60)
    assert [process.returncode for process in processes] == [0, 0]
    assert len(list(kept.glob("several.double*.nbc"))) == 2 and len(list(kept.glob("several.double*.nbi"))) == 1


@pytest.mark.skipif(compiling.fcntl is None, reason="the system has no such locks")
def test_a_process_that_waits_long_for_the_lock_says_so_once_and_compiles(tmp_path, monkeypatch, capsys):
    (tmp_path / "several.py").write_text(DOUBLE)
    kept, *counts = called(tmp_path)
    assert counts == [0, 2]
    monkeypatch.setattr(compiling, "LOCK_SECONDS", 0.1)
    monkeypatch.setattr(compiling, "_left", set())
    with open(Path(kept) / ".lock", "ab") as file:
        compiling.fcntl.flock(file, compiling.fcntl.LOCK_EX)
        for _ in range(2):
            assert called(tmp_path) == (kept, 0, 2)
    line = f"rts: another process holds the lock of compiled loops in {kept}; compiling without them …\n"
    assert capsys.readouterr().err == line
    monkeypatch.setattr(compiling, "_left", set())
    assert called(tmp_path) == (kept, 2, 0) and not capsys.readouterr().err


@pytest.mark.skipif(compiling.fcntl is None, reason="the system has no such locks")
def test_the_lock_is_not_held_where_others_are_awaited(tmp_path, monkeypatch):
    """While code is made from bytes, and bytes from code, which waits for LLVM's lock."""
    free = []

    def watched(name):
        whole = getattr(compiling._Checked, name)

        def call(*args):
            with open(Path(folder) / ".lock", "ab") as file:
                compiling.fcntl.flock(file, compiling.fcntl.LOCK_EX | compiling.fcntl.LOCK_NB)  # Raises if it is held.
            free.append(name)
            return whole(*args)

        return call

    (tmp_path / "several.py").write_text(DOUBLE)
    folder = called(tmp_path)[0]
    for path in Path(folder).glob("several*"):
        path.unlink()
    for name in ("reduce", "rebuild"):
        monkeypatch.setattr(compiling._Checked, name, watched(name))
    assert called(tmp_path)[1:] == (0, 2) and called(tmp_path)[1:] == (2, 0)
    assert free == ["reduce"] * 2 + ["rebuild"] * 2


DAMAGES = {
    "a bit of the code": (
        ".nbc",
        lambda data: data[: len(data) // 2] + bytes([data[len(data) // 2] ^ 1]) + data[len(data) // 2 + 1 :],
    ),
    "code cut short": (".nbc", lambda data: data[: len(data) // 2]),
    "empty code": (".nbc", lambda data: b""),
    "code of zeros": (".nbc", lambda data: bytes(len(data))),
    "index cut short": (".nbi", lambda data: data[: len(data) // 2]),
    "index of noise": (".nbi", lambda data: bytes(255 - i % 256 for i in range(len(data)))),
}


def called(folder):
    """The folder of kept loops, and hits and misses there, where a new process would call a loop with two types."""
    spec = importlib.util.spec_from_file_location("several", folder / "several.py")
    assert spec is not None and spec.loader is not None
    spec.loader.exec_module(module := importlib.util.module_from_spec(spec))
    for x, doubled in ((np.ones(3), [2, 2, 2]), (np.arange(3), [0, 2, 4])):
        module.double(x)
        assert x.tolist() == doubled
    stats = module.double.stats
    return stats.cache_path, sum(stats.cache_hits.values()), sum(stats.cache_misses.values())


@pytest.mark.parametrize("damage", quick(DAMAGES))
def test_damaged_loops_are_compiled_anew_and_told_once(damage, tmp_path, monkeypatch, capsys):
    (tmp_path / "several.py").write_text(DOUBLE)
    monkeypatch.setattr(compiling._Cache, "_told", False)
    kept, *counts = called(tmp_path)
    assert counts == [0, 2] and called(tmp_path) == (kept, 2, 0) and not capsys.readouterr().err
    kind, damaged = DAMAGES[damage]
    files = [path for path in Path(kept).glob("several.double*") if path.suffix == kind]
    assert len(files) == {".nbc": 2, ".nbi": 1}[kind]
    for path in files:
        path.write_bytes(damaged(path.read_bytes()))
    assert called(tmp_path) == (kept, 0, 2)
    line = f"rts: compiled loops in {kept} are damaged; what is damaged is compiled anew …\n"
    assert capsys.readouterr().err == line
    assert called(tmp_path) == (kept, 2, 0) and not capsys.readouterr().err


@pytest.mark.thorough
def test_loops_run_where_damage_cannot_be_mended(tmp_path, monkeypatch, capsys):
    (tmp_path / "several.py").write_text(DOUBLE)
    kept = called(tmp_path)[0]
    (index,) = Path(kept).glob("several.double*.nbi")
    index.unlink()
    index.mkdir()  # Neither to be read nor to be replaced.
    for _ in range(2):
        monkeypatch.setattr(compiling._Cache, "_told", False)
        assert called(tmp_path) == (kept, 0, 2)
        assert capsys.readouterr().err.count("\n") == 1


WITHOUT_PRIVATE_NAMES = """
import sys
import numpy as np
import numba
import numba.core.caching
numba.njit(lambda: None)()  # numba imports more of itself.
{change}
sys.path.insert(0, {folder!r})
import several
x = np.ones(3)
several.double(x)
assert x.tolist() == [2, 2, 2]
print(sum(several.double.stats.cache_hits.values()), "rts.compiling.numba_internals" in sys.modules)
"""


@pytest.mark.parametrize(
    "change, private",
    [
        ("", True),
        ("del numba.core.caching.FunctionCache", False),
        (
            "njit = numba.njit\nnumba.njit = lambda **o: njit(**o) if 'cache' in o else "
            "lambda f: type('Other', (), {'__slots__': ()})()",
            True,
        ),
        (
            "njit = numba.njit\nnumba.njit = lambda **o: njit(**o) if 'cache' in o else "
            "lambda f: type('Other', (), {'_cache': None})()",
            True,
        ),
    ],
    ids=["as it is", "no FunctionCache", "no cache of dispatchers", "another way to compile"],
)
@pytest.mark.thorough
def test_loops_are_kept_by_a_numba_without_private_names(change, private, tmp_path):
    (tmp_path / "several.py").write_text(DOUBLE)
    variables = {k: v for k, v in os.environ.items() if k != "NUMBA_CACHE_DIR"}
    code = WITHOUT_PRIVATE_NAMES.format(folder=str(tmp_path), change=change)
    for hits in (0, 1):
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=variables)
        assert done.returncode == 0, done.stderr
        assert done.stdout.split() == [str(hits), str(private)]
