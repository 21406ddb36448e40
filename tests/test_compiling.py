"""What is compiled, and when: few loops, each once; a line on terminals alone."""

import gc
import io
import os
import re
import subprocess
import sys
from types import FunctionType

import numpy as np
import pytest

import rts

pytest.importorskip("numba")
import numba

from rts import companion, compiling

pytestmark = pytest.mark.core

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
    assert 8 <= int(count) <= 20, done.stdout
    assert int(most) == 1, done.stdout
    assert not done.stderr  # It is no terminal.


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.mark.parametrize(("stream", "told"), [(Terminal(), True), (io.StringIO(), False)], ids=["terminal", "pipe"])
def test_a_terminal_is_told_of_what_takes_long(stream, told, monkeypatch):
    monkeypatch.setattr(sys, "stderr", stream)
    progress = compiling._Progress()
    ours, theirs = (type("", (), {"py_func": f}) for f in (rts.render, np.linalg.norm))

    def compile_(dispatcher, seconds):
        happened = type("", (), {"data": {"dispatcher": dispatcher}})
        monkeypatch.setattr(compiling.time, "perf_counter", lambda: 0.0)
        progress.on_start(happened)
        progress.on_start(happened)  # Helpers are compiled within.
        progress.on_end(happened)
        monkeypatch.setattr(compiling.time, "perf_counter", lambda: seconds)
        progress.on_end(happened)

    compile_(ours, 0.5)
    compile_(theirs, 9.0)
    assert not stream.getvalue()
    for seconds in (2.5, 1.0, 4.0):
        compile_(ours, seconds)
    lines = ["rts: compiling loops (once): 2 in 3 s", "rts: compiling loops (once): 4 in 8 s"]
    assert stream.getvalue().splitlines() == (lines if told else [])


def test_no_garbage_is_collected_while_our_loops_are_compiled():
    ours, theirs = (type("", (), {"data": {"dispatcher": type("", (), {"py_func": f})}}) for f in (rts.render, np.dot))
    listener = compiling._NoCollection()
    for event, paused in ((ours, True), (theirs, False)):
        listener.on_start(event)
        listener.on_start(ours)
        listener.on_end(ours)
        assert gc.isenabled() is not paused
        listener.on_end(event)
        assert gc.isenabled()


def _doubled(x):
    return x + x if x > 0 else -x


def _total(values):
    """By a helper and by functions of numba's own."""
    kept = np.empty(len(values), np.float64)
    for n in range(len(values)):
        kept[n] = min(_doubled(values[n]), 7.0)
    return kept[1:].sum()


def compiled_total(loop, helper):
    names = {"np": np, "_doubled": numba.njit(_doubled, nogil=True, **helper), "__name__": __name__}
    made = numba.njit(FunctionType(_total.__code__, names), nogil=True, **loop)
    assert made(np.array([9, -2, 3, 8])) == 2 + 6 + 7
    return made, names["_doubled"]


def instructions(made):
    """The machine code, without names."""
    (text,) = made.inspect_asm().values()
    names = {}
    text = re.sub(r"_ZN[\w.$]+|\.const\.[\w.$<>]+", lambda m: names.setdefault(m.group(), f"name {len(names)}"), text)
    lines = (x for x in text.splitlines() if not re.match(r"\s*\.(asci|file|globl|section|size|type|weak)", x))
    return [line.split(maxsplit=1)[0] for line in lines if line.strip()]  # Which registers it takes may differ.


def test_what_only_loops_call_has_no_machine_code_and_loops_are_those_that_numba_makes():
    plain, helper = compiled_total({"no_cfunc_wrapper": True}, {"no_cfunc_wrapper": True})
    ours, part = compiled_total(compiling.LOOP, compiling.PART)
    assert instructions(ours) == instructions(plain)
    for each, running in ((plain, True), (helper, True), (ours, True), (part, False)):
        ((types, compiled),) = each.overloads.items()
        assert (compiled.library.get_pointer_to_function(compiled.fndesc.llvm_func_name) != 0) is running, each


ANOTHER_BUILD = """
from numba.core import compiler

class Compiler(compiler.Compiler):
    def __init__(self, *everything):
        super().__init__(*everything)

compiler.Compiler = Compiler
"""

ANOTHER_VERSION = """
import numba

numba.version_info = numba.version_info._replace(short=(9, 0))
"""

DOUBLED = """
from rts import compiling
helper = compiling.compiled(lambda x: x + x)
made = compiling.numba.njit(lambda x: helper(x), **compiling.LOOP)
print(made(3.0), "pipeline_class" in compiling.LOOP | compiling.PART)
"""


@pytest.mark.parametrize("numba", [ANOTHER_BUILD, ANOTHER_VERSION], ids=["build", "version"])
def test_another_numba_compiles_as_it_does(numba):
    done = subprocess.run([sys.executable, "-c", numba + DOUBLED], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["6.0", "False"]


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
from rts.compiling import compiled, loop

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


def test_helpers_may_print_and_raise_errors_with_values(tmp_path):
    (tmp_path / "needy.py").write_text(NEEDY)
    code = NEEDS_PYTHON.format(folder=str(tmp_path))
    for _ in range(2):  # Compiled, and from disk.
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=120)
        assert done.stdout.splitlines() == ["('below zero', -3.0)", "checked 3.0", "6.0"]


def test_warmup_has_as_many_processes_share_the_work_and_says_what_failed(monkeypatch):
    given = []

    def process(claims, everything, **options):
        given.append((claims.file.fileno(), everything))
        said = "raise MemoryError('no more')" if len(given) == 3 else ""
        return subprocess.Popen([sys.executable, "-c", said], **options)

    monkeypatch.setattr(companion, "process", process)
    assert rts.warmup(2) < 60
    assert given[0] == given[1] and given[0][1]
    with pytest.raises(rts.RtsError, match="could not compile loops: MemoryError: no more"):
        rts.warmup(1)


@pytest.mark.parametrize("processes", [0, -1, 1.5, "two", True])
def test_a_wrong_number_of_processes_is_refused(processes):
    with pytest.raises(rts.InputError, match="processes is .*; expected a positive integer, or None"):
        rts.warmup(processes)


SAVING = """
import sys
sys.path.insert(0, {folder!r})
import numpy as np
from several import double
print("called", flush=True)
double(np.zeros(3, np.{kind}))
"""


@pytest.mark.skipif(compiling.fcntl is None, reason="the system has no such locks")
def test_loops_are_written_by_one_process_at_a_time(tmp_path):
    (tmp_path / "several.py").write_text("from rts.compiling import loop\n\n\n@loop\ndef double(x):\n    x *= 2\n")
    kept = tmp_path / "__pycache__"
    kept.mkdir()

    def started(kind):
        code = SAVING.format(folder=str(tmp_path), kind=kind)
        variables = {k: v for k, v in os.environ.items() if k != "NUMBA_CACHE_DIR"} | {"RTS_COMPILE_AHEAD": "0"}
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


def test_parts_that_make_no_arrays_count_no_references():
    """Those that make some, or hand some on, do: as many are freed as were made."""
    pytest.importorskip("rts.pipeline")
    memory, runtime = (pytest.importorskip(f"numba.core.runtime.{name}") for name in ("_nrt_python", "nrt"))

    @compiling.compiled
    def picked(a, b, i):
        row = a[i] if i % 2 else b[i]
        return row[1] if row[0] > 3 else last(b, i)

    @compiling.compiled
    def last(a, i):
        return a[i, -1] if i > 3 else a[0, 0]

    @compiling.compiled
    def rest(row, i):
        return row[i:]

    @compiling.compiled
    def doubled(a, b, i):
        made = rest(a[i], i % 2) + rest(b[i], i % 2)
        made[:1] = rest(a[i], 1)[:1]
        return made[0] if made[1] > 3 else made[2]

    def summed(part):
        def total(a, b):
            found = 0.0
            for i in range(len(a)):
                found += part(a, b, i)
            return found

        return numba.njit(total)

    a = np.arange(40.0).reshape(10, 4)
    b = a + 1
    reads, makes = summed(picked), summed(doubled)
    assert reads(a, b) == sum((a, b)[1 - i % 2][i, 1] if i > 0 else b[0, 0] for i in range(10))
    assert "call void @NRT_incref" not in next(iter(reads.inspect_llvm().values()))
    makes(a, b)
    memory.memsys_enable_stats()
    try:
        before = runtime.rtsys.get_allocation_stats()
        makes(a, b)
        after = runtime.rtsys.get_allocation_stats()
    finally:
        memory.memsys_disable_stats()
    made = after.mi_alloc - before.mi_alloc
    assert made >= 10 and made == after.mi_free - before.mi_free


IDS = np.array([2, 0, 1])


def part_with(f):
    """A function that hands its argument to a part of a loop."""
    part = compiling.compiled(f)
    return lambda v: part(v)


@pytest.mark.filterwarnings("ignore:.*is faster on contiguous arrays")
@pytest.mark.parametrize(
    "function",
    [
        lambda v: v[IDS][0],
        lambda v: v.imag[0] + v.real[1],
        lambda v: np.dot(v[::2], v[::2]),
        lambda v: (v[::2] @ v[::2]) + (v + v)[0],
        lambda v: np.linalg.norm(v) + np.sum(v) + v.max() + v.sum(),
        lambda v: sorted([v[1], v[0]])[0],
        lambda v: len({1: v}) + len([v, v]) + v[v > 1][0],
        lambda v: sum([x for x in v]),
        lambda v: float(len(str(len(v)))),
        lambda v: np.array([v[0], v[1]])[0] + (v, v)[len(v) % 2][1],
    ],
)
def test_parts_that_may_make_something_count_references(function):
    v = np.arange(6.0)
    assert numba.njit(part_with(function), **compiling.LOOP)(v) == pytest.approx(function(v))


def test_what_generators_read_lives_as_long_as_they_do():
    @compiling.compiled
    def items(v):
        for i in range(len(v)):
            yield v[i]

    def total(v):
        found = 0.0
        for x in items(v * 2.0):
            found += x + 0 * np.full(64, -1.0)[0]
        return found

    assert numba.njit(total, **compiling.LOOP)(np.arange(64.0)) == 4032


def test_loops_call_what_numba_has():
    """Its own functions count references, and may make arrays."""
    a = np.eye(3)
    for f in (
        lambda a: np.linalg.norm(a),
        lambda a: np.linalg.inv(a)[0, 0],
        lambda a: np.allclose(a, a),
        lambda a: hash((a[0, 0], 1)) * 0 + 1,
    ):
        numba.njit(f, **compiling.LOOP)(a)
