"""The process that compiles beside another: what it finds out, in which order it goes, when it starts and ends."""

import json
import os
import signal
import subprocess
import sys
import tempfile
import time

import pytest

pytest.importorskip("numba")
from rts import accompanying, companion, compiling
from rts.compiling import Need

pytestmark = pytest.mark.core

ORDINARY_CALLS = """
import json, sys
import numpy as np
import torch
from numba.core.dispatcher import Dispatcher
import rts
from rts import compiling, rehearsal

def compiled():
    found = {id(x): x for x in compiling._globals() if isinstance(x, Dispatcher)}
    kept = [x for x in found.values() if isinstance(x._cache, compiling._Cache)]
    return {compiling._key(x.py_func, sig): f"{x.__name__} {sig}" for x in kept for sig in x.overloads}

# A ball, coarsely, since outlines and hidden layers are what most loops are for.
y, x = np.mgrid[:7, :12]
up, round = np.pi * y.ravel() / 6, np.pi * x.ravel() / 6
vertices = np.stack([np.sin(up) * np.cos(round), np.cos(up), np.sin(up) * np.sin(round)], 1).astype(np.float32)
a, b = (12 * y[:-1] + x[:-1]).ravel(), (12 * y[:-1] + (x[:-1] + 1) % 12).ravel()
faces = np.concatenate([np.stack([a, b, a + 12], 1), np.stack([b, b + 12, a + 12], 1)])
part = rts.Part(rts.plugin("surfaces", "mesh")(faces), {"vertices": vertices}, "lambert")
camera, size = rts.Camera.look_at((0, 0.5, 3), (0, 0, 0)), (40, 40)

def picture():
    rts.render(part, camera, size)

def gradient():
    vertices = torch.tensor(part.theta["vertices"], requires_grad=True)
    rts.render(part.replace(theta={"vertices": vertices}), camera, size).square().sum().backward()

def least_squares():
    posed = lambda pose: part.replace(transform=rts.rigid(pose))
    residuals = rts.ImageResiduals(posed, camera, size, np.zeros((*size, 4), np.float32))
    rts.fit(residuals, torch.full((6,), 0.01), method="lm", steps=1)

def fit_of_silhouette():
    posed = lambda pose: part.replace(transform=rts.rigid(pose), shader="silhouette")
    given = dict(layers=1, splatter="single")
    residuals = rts.ImageResiduals(posed, camera, size, np.zeros((*size, 1), np.float32), **given)
    rts.fit(residuals, torch.full((6,), 0.01), method="lm", steps=1)

needed = []
for call in (picture, gradient, least_squares, fit_of_silhouette):
    call()
    needed.append(compiled())
before = compiled()
batches = rehearsal.routes()
routes = next(batches) + next(batches)
assert compiled() == before  # Nothing was compiled for it, and all is back in its place.
picture()
kinds = ("picture", 0), ("gradient", 1), ("lm", 3), ("silhouette", 6)
route = {name: {k for k, need in routes[i].items() if need} for name, i in kinds}
known = route["gradient"] | route["lm"]
print(json.dumps({
    "picture missing": [needed[0][k] for k in needed[0].keys() - route["picture"]],
    "picture superfluous": len(route["picture"] - needed[0].keys()),
    "gradient missing": [needed[1][k] for k in needed[1].keys() - route["gradient"]],
    "gradient superfluous": len(route["gradient"] - needed[1].keys()),
    "missing": [needed[2][k] for k in needed[2].keys() - known],
    "silhouette missing": [needed[3][k] for k in needed[3].keys() - known - route["silhouette"]],
}))
"""


def test_a_rehearsal_finds_what_ordinary_calls_need():
    """In the very types; of the gradient little more, which would be compiled in vain."""
    pytest.importorskip("torch")
    done = subprocess.run([sys.executable, "-c", ORDINARY_CALLS], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found == {
        "picture missing": [],
        "picture superfluous": 0,
        "gradient missing": [],
        "gradient superfluous": pytest.approx(0, abs=2),
        "missing": [],
        "silhouette missing": [],
    }


def route(letters):
    return {ord(x): Need(x, ()) for x in letters}


PICTURE, GRADIENT, POSE, FIT = map(route, ("abcd", "abcdef", "rabcdgh", "rabcij"))


@pytest.mark.parametrize(
    ("seen", "done", "expected"),
    [
        ("a", "", "d"),  # From the end of the most ordinary call.
        ("ab", "d", "c"),
        ("ab", "dc", None),
        ("abe", "dc", "f"),
        ("r", "", "c"),  # Either of two: what they share,
        ("r", "abc", "h"),  # and then what the first needs.
        ("ri", "", "j"),
        ("abei", "cdf", "j"),  # A call after another.
        ("x", "", None),
        ("xa", "", "d"),
    ],
)
def test_what_will_be_needed_last_is_compiled_first(seen, done, expected):
    key, need = accompanying.following([PICTURE, GRADIENT, POSE, FIT], [*map(ord, seen)], {*map(ord, done)})
    assert (need.loop if need else None) == expected
    assert key == (ord(expected) if expected else 0)


@pytest.mark.parametrize(
    ("efforts", "order"),
    [
        ((1, 1, 1, 1), "dcba"),
        ((1, 9, 5, 6), "dcba"),  # What is left shrinks, and the other process is at the front of it.
        ((3, 2, 4, 1), "cbda"),
        ((1, 1, 9, 1), "cdba"),
    ],
)
def test_of_the_last_half_of_what_is_left_the_largest_is_compiled_first(efforts, order):
    left = {ord(x): Need(x, (), effort) for x, effort in zip("abcd", efforts, strict=True)}
    done, found = set(), ""
    while (key := accompanying.following([left | {ord("s"): Need("s", ())}], [ord("s")], done))[1]:
        done.add(key[0])
        found += key[1].loop
    assert found == order


def test_an_expected_kind_of_call_counts_as_a_loop_but_is_none():
    name = companion.number(companion.LEAST_SQUARES)
    fit = {name: None, **FIT}
    assert accompanying.following([PICTURE, POSE, fit], [name], set())[1].loop == "j"
    assert accompanying.following([PICTURE, POSE, fit], [ord("r")], {*FIT, *POSE}) == (0, None)


CLAIM = """
import os, sys
from rts.companion import Claims
claims = Claims(os.fdopen(int(sys.argv[1]), "r+b", buffering=0))
print(claims.take(1), claims.take(2), flush=True)
sys.stdin.read()
"""


@pytest.mark.skipif(not companion.SHARED, reason="no locks that end with their process")
def test_a_claim_keeps_others_off_until_it_is_dropped_or_its_process_ends():
    with tempfile.TemporaryFile(buffering=0) as file:
        claims = companion.Claims(file)
        assert claims.take(1)
        number = file.fileno()
        command = [sys.executable, "-c", CLAIM, str(number)]
        with subprocess.Popen(command, pass_fds=[number], stdin=-1, stdout=-1, text=True) as other:
            assert other.stdout.readline() == "False True\n"
            assert claims.take(3) and not claims.take(2)
            other.kill()
            claims.wait(2)
        claims.drop(2)
        assert claims.take(2)


@pytest.fixture
def willing(monkeypatch):
    """A process that may start a companion, whatever runs these tests."""
    monkeypatch.delenv("PYTEST_XDIST_WORKER", raising=False)
    monkeypatch.delenv(companion.SWITCH, raising=False)
    monkeypatch.setenv("RTS_NUM_THREADS", "2")
    assert companion._may_start() is companion.SHARED


@pytest.mark.parametrize(
    ("name", "value"), [(companion.SWITCH, "0"), ("RTS_NUM_THREADS", "1"), ("PYTEST_XDIST_WORKER", "gw0")]
)
def test_a_variable_keeps_it_from_starting(name, value, monkeypatch, willing):
    monkeypatch.setenv(name, value)
    assert not companion._may_start()


def test_no_child_of_multiprocessing_and_no_program_but_python_starts_it(monkeypatch, willing):
    with monkeypatch.context() as m:
        m.setattr("multiprocessing.process.parent_process", lambda: "its parent")
        assert not companion._may_start()
    for executable in ("/usr/bin/uwsgi", "", None):
        monkeypatch.setattr(sys, "executable", executable)
        assert not companion._may_start()


FIRST_LOOP = """
import os, sys
import numpy as np
from rts import accompanying, companion
from rts.operations import take

def gradient():
    take.TAKE.pull([np.zeros((2, 3), np.float32), np.zeros(4, np.int32)], np.zeros((4, 3), np.float32), [out])

out = np.zeros((2, 3), np.float32)
gradient()
process = companion._state._process
if (child := os.fork()) == 0:
    sys.exit()
os.waitpid(child, 0)
assert process.poll() is None  # It is not the fork's to end.
print(process.pid, flush=True)
if sys.argv[1] == "killed":
    os.kill(os.getpid(), 9)
"""


@pytest.mark.skipif(not companion.SHARED, reason="there is no companion")
@pytest.mark.parametrize("how", ["ends", "killed"])
def test_it_starts_with_the_first_loop_that_is_missing_and_ends_with_its_process(how, tmp_path, willing):
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    command = [sys.executable, "-W", "error::ResourceWarning", "-c", FIRST_LOOP, how]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.returncode == (-signal.SIGKILL if how == "killed" else 0) and not done.stderr, done.stderr
    end = time.monotonic() + 20
    while is_running(int(done.stdout)) and how == "killed" and time.monotonic() < end:
        time.sleep(0.05)
    assert not is_running(int(done.stdout))


def is_running(pid):
    try:
        os.kill(pid, 0)
        with open(f"/proc/{pid}/stat") as file:
            return file.read().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


MISSED = """
import sys, time
from pathlib import Path
import numpy as np
from rts.threads import read_only
from rts_backends import raster

def kept():
    return {path.name for path in Path(sys.argv[1]).rglob("*.nbc")}

raster._project(0, 0, np.zeros(1, np.int32), read_only(np.zeros((1, 3), np.float32)), np.eye(4), np.zeros(1, np.int32))
own, end = kept(), time.monotonic() + 100
while kept() == own and time.monotonic() < end:
    time.sleep(0.05)
print(sorted(kept() - own), flush=True)
"""


@pytest.mark.skipif(not companion.SHARED, reason="there is no companion")
def test_it_compiles_what_nobody_has_asked_for_yet(tmp_path, willing):
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    done = subprocess.run(
        [sys.executable, "-c", MISSED, str(tmp_path)], env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0 and "nbc" in done.stdout, done.stderr + done.stdout


@pytest.mark.parametrize(("kept", "begun"), [(None, 1), ("__init__.pyc", 1), ("several.double-7.py311.nbi", 0)])
def test_it_starts_before_a_loop_is_missed_where_none_is_kept(kept, begun, tmp_path, monkeypatch):
    started = []
    monkeypatch.setattr(companion, "prepare", lambda: started.append(1))
    folder = tmp_path / "loops"
    if kept:
        folder.mkdir()
        (folder / kept).touch()
    for _ in range(2):
        compiling._foresee(str(folder))
    assert len(started) == begun


BROKEN_PIPE = """
import os, signal, sys
from pathlib import Path
from rts import companion

signal.signal(signal.SIGPIPE, signal.SIG_DFL)
sys.path.append(Path("of no importance"))
assert companion.begin(7)
companion.end(7)
process = companion._state._process
os.kill(process.pid, 9)
process.wait()
for _ in range(3):
    assert companion.begin(8)  # Alone.
    companion.end(8)
process.returncode = 0  # As if it had ended for want of work: another is started.
assert companion.begin(9) and companion._state._process.pid != process.pid
companion.end(9)
companion._state._process.kill()
companion._state._process.wait()
companion._state._process.returncode = 0

def no_more(*args, **options):
    raise BlockingIOError("no more processes")

companion.subprocess.Popen = no_more
assert not companion.begin(10) and companion._state is False
companion.expect(companion.LEAST_SQUARES)
companion.end(10)
print("alive")
"""


@pytest.mark.skipif(not companion.SHARED, reason="there is no companion")
def test_a_companion_that_dies_harms_nobody(tmp_path, willing):
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    done = subprocess.run([sys.executable, "-c", BROKEN_PIPE], env=environment, capture_output=True, text=True)
    assert done.stdout == "alive\n", (done.returncode, done.stderr)


def test_a_companion_that_cannot_start_is_done_without(monkeypatch, willing):
    def no_more(*args, **options):
        raise BlockingIOError("no more processes")

    monkeypatch.setattr(companion, "_state", None)
    monkeypatch.setattr(companion.subprocess, "Popen", no_more)
    assert not companion.begin(7)
    assert companion._state is False
    companion.end(7)
