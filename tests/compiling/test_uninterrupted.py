"""Ctrl-C while numba is imported, and while loops are compiled or loaded; processes that begin with no loop kept."""

import ast
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("numba")

from rts.compiling import numba_internals as compiling
from rts.compiling.uninterrupted import uninterrupted

pytestmark = pytest.mark.core

ROOT = Path(__file__).resolve().parents[2]
LONG = 1800
"""Seconds that a process may take which takes a minute on two idle cores: a hang lasts for ever."""

needs_signals = pytest.mark.skipif(sys.platform == "win32", reason="no process there can send itself Ctrl-C alone")


@needs_signals
@pytest.mark.skipif(threading.current_thread() is not threading.main_thread(), reason="no thread but main is signalled")
def test_an_interrupt_is_raised_once_the_function_is_done():
    done = []

    def work(answer):
        signal.raise_signal(signal.SIGINT)
        assert threading.current_thread() is not threading.main_thread()
        done.append(answer)
        return answer

    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    with pytest.raises(KeyboardInterrupt):
        uninterrupted(work, 1)
    assert done == [1]


def test_results_and_errors_come_back():
    def divided(a, b):
        return a / b

    assert uninterrupted(divided, 6, 3) == 2
    with pytest.raises(ZeroDivisionError):
        uninterrupted(divided, 1, 0)


def test_numba_is_imported_after_the_module_that_does_so_uninterrupted():
    found = []
    for package in ("rts", "rts_backends", "rts_surfaces"):
        for path in sorted((ROOT / package).rglob("*.py")):
            names = []
            for node in ast.parse(path.read_text()).body:
                if isinstance(node, ast.Import):
                    names += [alias.name for alias in node.names]
                elif isinstance(node, ast.ImportFrom):
                    names.append(node.module or "")
            numba = [n for n, name in enumerate(names) if name.partition(".")[0] in ("numba", "llvmlite")]
            if numba and path.name != "numba_internals.py":  # `loops` imports this one.
                found.append(path.name)
                loops = [n for n, name in enumerate(names) if name in ("rts.compiling.loops", "rts.plugin_api.loops")]
                assert loops and loops[0] < numba[0], path
    assert found


def test_calls_for_types_that_are_compiled_stay_in_their_thread(monkeypatch, tmp_path):
    calls = []
    monkeypatch.setattr(compiling, "uninterrupted", lambda f, *args: calls.append(args) or f(*args))
    double = compiling.kept(lambda x: 2 * x, {})
    assert double(1.5) == 3 and double(2.5) == 5 and calls == [(1.5,)]
    assert double(np.float32(1.5)) == 3 and double(3.5) == 7 and len(calls) == 2


LOOP = """
from rts.compiling.loops import loop

@loop
def double(x):
    x *= 2
"""

INTERRUPTED = """
import os, signal, sys, threading
import numpy as np
moment, caught, folder = sys.argv[1], sys.argv[2] == "caught", sys.argv[3]
sys.path.insert(0, folder)
sent = False

def interrupt():
    global sent
    if not sent:
        sent = True
        os.kill(os.getpid(), signal.SIGINT)

def doubled(kind):
    from several import double
    x = np.ones(3, kind)
    double(x)
    return x.tolist()

class Finder:
    def find_spec(self, name, path, target=None):
        if name == "numba.core.dispatcher":
            interrupt()

if moment == "import":
    sys.meta_path.insert(0, Finder())
else:
    import several
    from numba.core.event import Listener, register
    from rts.compiling import numba_internals as compiling
    begun = False

    class Locked(Listener):  # LLVM's lock is held then, and an error here would leave it so.
        def on_start(self, event):
            if begun:
                interrupt()

        def on_end(self, event):
            pass

    register("numba:llvm_lock", Locked())
    rebuild = compiling._Checked.rebuild

    def rebuilt(*args):
        global begun
        begun = True
        return rebuild(*args)

    class Compiled(Locked):
        def on_start(self, event):
            global begun
            begun = True

    if moment == "load":
        compiling._Checked.rebuild = rebuilt
    elif moment == "compile":
        register("numba:compile", Compiled())

try:
    doubled("float32")
except KeyboardInterrupt:
    print("interrupted")
    if not caught:
        raise
found = [doubled("float32")]
thread = threading.Thread(target=lambda: found.append(doubled("int32")), daemon=True)
thread.start()
thread.join()
found.append(doubled("int64"))
print(found)
"""


@needs_signals
@pytest.mark.parametrize("caught", [True, False], ids=["caught", "ends"])
@pytest.mark.parametrize("moment", ["import", "compile", "load"])
@pytest.mark.thorough
def test_after_an_interrupt_everything_works(moment, caught, tmp_path):
    """In the process, and in another with the same folder."""
    (tmp_path / "several.py").write_text(LOOP)

    def run(moment, caught):
        command = [sys.executable, "-c", INTERRUPTED, moment, "caught" if caught else "ends", str(tmp_path)]
        environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "kept")}
        return subprocess.run(command, capture_output=True, text=True, timeout=LONG, env=environment)

    answer = "[[2.0, 2.0, 2.0], [2, 2, 2], [2, 2, 2]]"
    if moment == "load":
        assert run("never", True).stdout.split("\n")[0] == answer
    done = run(moment, caught)
    assert done.stdout.splitlines() == (["interrupted", answer] if caught else ["interrupted"]), done.stderr
    assert done.returncode == (0 if caught else -signal.SIGINT)
    done = run("never", True)
    assert done.stdout.splitlines() == [answer], done.stderr


ON_IMPORT = (
    LOOP
    + """
import numpy as np
from numba.core.compiler_lock import global_compiler_lock

x = np.ones(3)
double(x)
with global_compiler_lock:
    y = np.arange(3)
    double(y)
print(x.tolist(), y.tolist(), sum(double.stats.cache_hits.values()))
"""
)


@pytest.mark.thorough
def test_loops_run_while_their_module_is_imported_and_where_the_compiler_is_locked(tmp_path):
    """Another thread would wait there for this one."""
    (tmp_path / "early.py").write_text(ON_IMPORT)
    command = [sys.executable, "-c", f"import sys\nsys.path.insert(0, {str(tmp_path)!r})\nimport early"]
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "kept")}
    for hits in (0, 2):
        done = subprocess.run(command, capture_output=True, text=True, timeout=LONG, env=environment)
        assert done.stdout.split("\n")[0] == f"[2.0, 2.0, 2.0] [0, 2, 4] {hits}", done.stderr


RENDERS = """
import hashlib, os, signal, sys, threading, time
import numpy as np
import rts

wanted = int(sys.argv[1])
vertices = np.array([(-1, -1, 0), (1, -1, 0), (0, 1, 0.5), (-1, 0, -1)], np.float32)
part = rts.Part(rts.plugin("surfaces", "mesh")([(0, 1, 2), (1, 3, 2)]), {"vertices": vertices})
camera = rts.Camera.look_at((0, 0, 3), (0, 0, 0))
rendering, interrupts = False, 0

def interrupt(number, frame):
    global rendering, interrupts
    if rendering:
        rendering = False
        interrupts += 1
        raise KeyboardInterrupt

def send():
    while interrupts < wanted:
        time.sleep(0.2)
        if rendering:
            os.kill(os.getpid(), signal.SIGINT)

signal.signal(signal.SIGINT, interrupt)
threading.Thread(target=send, daemon=True).start()
image = None
while image is None or interrupts < wanted:
    try:
        rendering = True
        image = rts.render(part, camera, (40, 50), splatter='single')
        rendering = False
    except KeyboardInterrupt:
        pass

from numba.core.dispatcher import Dispatcher

modules = [m for name, m in sys.modules.items() if name.partition(".")[0] in ("rts", "rts_backends", "rts_surfaces")]
loops = {id(x): x for m in modules for x in vars(m).values() if isinstance(x, Dispatcher)}.values()
loops = [x for x in loops if x.stats.cache_path is not None]
counts = [sum(sum(getattr(x.stats, name).values()) for x in loops) for name in ("cache_hits", "cache_misses")]
print(hashlib.sha256(np.ascontiguousarray(image).tobytes()).hexdigest(), *counts)
"""


@needs_signals
@pytest.mark.thorough
def test_processes_that_begin_with_no_loop_kept_render_though_interrupted(tmp_path):
    """Two at once, one of which is interrupted ten times; then one that loads what they keep, interrupted, too.

    By the splatter of fewest loops, since all are compiled twice.
    """
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path), "RTS_NUM_THREADS": "2"}

    def started(interrupts):
        command = [sys.executable, "-c", RENDERS, str(interrupts)]
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
        return subprocess.Popen(command, text=True, env=environment, **pipes)

    def ended(*processes):
        try:
            outputs = [process.communicate(timeout=LONG) for process in processes]
        finally:
            for process in processes:
                process.kill()
        for process, (_, errors) in zip(processes, outputs, strict=True):
            assert not errors and process.returncode == 0, errors
        return [output.split() for output, _ in outputs]

    (image, *_, compiled), (other, *_) = ended(started(10), started(0))
    assert other == image
    again, hits, compiled = ended(started(5))[0]
    assert again == image and int(hits) > 5 and int(compiled) == 0
    assert not list(tmp_path.rglob("*.tmp.*"))
