"""Two threads at once with every sampler, and hundreds of renders that leave nothing behind."""

import gc
import multiprocessing
import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from analytic import Ellipsoid
from helpers import icosphere, quick, soup, together

import rts
from rts import Camera, Part
from rts.errors import PluginError

pytestmark = pytest.mark.core

Mesh = rts.plugin("surfaces", "mesh")
CAMERA = Camera.look_at((1, 2, 3), (0, 0, 0), fov_y=50)
TRIANGLE_SAMPLERS = ("raster", "reference", "embree", "opengl")
SAMPLERS = (*TRIANGLE_SAMPLERS, "rays")


def made(name):
    """A sampler, or the test is skipped where it cannot work."""
    try:
        sampler = rts.plugin("samplers", name)()
        rts.sample(scene(name, 0), CAMERA, (4, 5), sampler=sampler, splatter=None)
        return sampler
    except PluginError as error:
        pytest.skip(str(error))


def scene(name, kind):
    if name == "rays":
        radii = [(1, 0.6, 0.8), (0.5, 1.1, 0.7)][kind]
        return Part(Ellipsoid(), {"center": np.zeros(3, np.float32), "radii": np.float32(radii)}, "normals")
    vertices, faces = icosphere(2) if kind == 0 else soup(120, size=0.4)
    return Part(Mesh(faces), {"vertices": vertices}, "normals")


@pytest.fixture(params=SAMPLERS)
def name(request):
    return request.param


# ------------------------------------------------------------------------------------------------- threads


def pictures(name, sampler, kind, count, size, moving):
    """Renders of one scene from many poses, its vertices moved too if `moving`."""
    part, found = scene(name, kind), []
    for step in range(count):
        part = part.replace(transform=rts.rigid(np.float32([0.1 * step, 0, 0, 0, 0.02 * kind, 0])))
        if moving and name != "rays":
            part.theta["vertices"][:, kind] *= np.float32(0.99)
        found.append(rts.render(part, CAMERA, size, sampler=sampler, layers=2 + kind))
    return found


@pytest.mark.parametrize("moving", [False, True], ids=["poses", "vertices"])
@pytest.mark.parametrize("shared", quick([True, False]), ids=["one sampler", "two samplers"])
def test_two_threads_render_what_one_does_after_the_other(name, shared, moving):
    first = made(name)
    samplers = (first, first if shared else made(name))
    sizes = ((24, 30), (33, 20))
    expected = [pictures(name, made(name), kind, 24, sizes[kind], moving) for kind in (0, 1)]

    def work(kind):
        return pictures(name, samplers[kind], kind, 24, sizes[kind], moving)

    for kind, found in enumerate(together(work, 2)):
        np.testing.assert_array_equal(found, expected[kind])


def test_threads_may_share_a_part_and_a_handle(name):
    sampler, part = made(name), scene(name, 1)
    handle = rts.prepare(part, sampler)
    moves = [rts.rigid(np.float32([0, 0.2 * i, 0, 0, 0, 0])) for i in range(12)]
    expected = [rts.render(part.replace(transform=m), CAMERA, (20, 25), sampler=sampler) for m in moves]

    def work(who):
        if who % 2:
            return [rts.render(part.replace(transform=m), CAMERA, (20, 25), sampler=sampler) for m in moves]
        return [rts.render(handle.replace(transform=m), CAMERA, (20, 25)) for m in moves]

    for found in together(work, 3):
        np.testing.assert_array_equal(found, expected)


@pytest.fixture
def helpers(monkeypatch):
    """The helpers of `rts.compiling.threads`, as if nothing had been run yet."""
    from rts.compiling import threads

    monkeypatch.setattr(threads, "_helpers", threads._Helpers())
    return threads._helpers


def test_threads_that_start_together_share_few_helpers(monkeypatch, helpers):
    from rts.compiling import threads

    done = []

    def loop(start, stop):
        time.sleep(0.001)
        done.append(stop - start)

    def work(_):
        for _ in range(20):
            threads.parallel(loop, 9)

    monkeypatch.setenv("RTS_NUM_THREADS", "3")
    together(work, 8)
    assert helpers.count == 2
    assert sum(done) == 8 * 20 * 9


def test_only_as_many_threads_are_asked_as_there_is_work_for(monkeypatch, helpers):
    from rts.compiling import threads

    monkeypatch.setenv("RTS_NUM_THREADS", "4")
    asked = []
    monkeypatch.setattr(helpers, "ask", lambda job: asked.append(job))
    little = threads.LITTLE_WORK
    for work, expected in ((little - 1, 0), (little, 1), (2.0 * little + 1, 2), (100 * little, 3), (None, 3)):
        asked.clear()
        ranges = []
        threads.parallel(lambda start, stop, ranges=ranges: ranges.append((start, stop)), 1000, work=work)
        assert len(asked) == expected
        assert [a for a, _ in ranges[1:]] == [b for _, b in ranges[:-1]] and ranges[0][0] == 0 and ranges[-1][1] == 1000
        assert len(ranges) == (1 if expected == 0 else threads.TASKS_PER_THREAD * (expected + 1))
    asked.clear()
    threads.parallel(lambda start, stop: None, 2)
    assert len(asked) == 1  # The caller's thread has the other range.


@pytest.mark.parametrize("wanted", ["²", "0", "-1", "1.5", "two", " ", "9" * 5000])
def test_a_wrong_number_of_threads_is_refused_before_work_starts(monkeypatch, wanted):
    def sample(*_, **__):
        raise AssertionError("work has begun")

    monkeypatch.setattr(rts.plugin("samplers", "reference"), "sample", sample)
    monkeypatch.setenv("RTS_NUM_THREADS", wanted)
    with pytest.raises(rts.InputError, match="RTS_NUM_THREADS is '.{1,40}'; expected a positive integer, such as 4"):
        rts.render(scene("reference", 0), CAMERA, (4, 5), sampler="reference")
    with pytest.raises(rts.InputError, match="RTS_NUM_THREADS is"):
        rts.warmup()


def test_few_threads_a_core_are_used_of_many(monkeypatch):
    from rts.compiling import threads

    most = threads.THREADS_PER_CORE * (os.cpu_count() or 1)
    for wanted, count in (("1", 1), (" 3 ", min(3, most)), (str(most), most), (str(most + 1), most), ("100000", most)):
        monkeypatch.setenv("RTS_NUM_THREADS", wanted)
        assert threads.thread_count() == count
    for unset in (lambda: monkeypatch.setenv("RTS_NUM_THREADS", ""), lambda: monkeypatch.delenv("RTS_NUM_THREADS")):
        unset()
        assert threads.thread_count() == (len(threads.cores()) if sys.platform == "linux" else os.cpu_count())


def cores_of_helper(monkeypatch, run):
    """The core of the caller of `run`, given a function of a range, and the cores on which its helper may run."""
    from rts.compiling import threads

    monkeypatch.setenv("RTS_NUM_THREADS", "2")
    caller, both, seen = threading.get_ident(), threading.Barrier(2), {}

    def loop(start, stop):
        if start in (0, 1):  # Each of the two threads has one of these.
            both.wait(30)
            seen[threading.get_ident() == caller] = os.sched_getaffinity(0)

    core = threads._core
    assert core is not None
    asked = core()
    run(loop)
    assert len(seen) == 2 and seen[True] == os.sched_getaffinity(0)
    return asked, core(), seen[False]


needs_cores = pytest.mark.skipif(
    sys.platform != "linux" or len(os.sched_getaffinity(0)) < 2, reason="needs Linux and two cores"
)


@needs_cores
def test_helpers_keep_off_the_core_of_the_thread_that_asks(monkeypatch, helpers):
    from rts.compiling import threads

    found = [cores_of_helper(monkeypatch, lambda loop: threads.parallel(loop, 9)) for _ in range(20)]
    cores = os.sched_getaffinity(0)
    assert all(len(allowed) == len(cores) - 1 for _, _, allowed in found)
    # The system may move this thread between any two of its steps.
    assert any(allowed == cores - {before} for before, after, allowed in found if before == after)


@needs_cores
def test_helpers_that_call_any_function_run_on_all_cores(monkeypatch, helpers):
    """Though the caller has loops of its own meanwhile, for which idle helpers are to keep off."""
    from rts.compiling import threads

    monkeypatch.setenv("RTS_NUM_THREADS", "2")
    caller, cores, seen = threading.get_ident(), os.sched_getaffinity(0), []

    def item(i):
        threads.parallel(lambda start, stop: time.sleep(0.0005), 9)
        seen.append((threading.get_ident(), os.sched_getaffinity(0)))

    for _ in range(20):
        threads.each(item, range(8))
    assert len({thread for thread, _ in seen}) == 2
    assert all(allowed == cores for thread, allowed in seen if thread != caller)
    monkeypatch.delenv("RTS_NUM_THREADS")
    counts = []
    threads.parallel(lambda start, stop: (time.sleep(0.002), counts.append(threads.thread_count())), 9)
    assert set(counts) == {len(cores)}  # A helper knows those of the thread that asked.


def test_an_error_in_a_helper_reaches_the_caller_and_the_helper_lives_on(monkeypatch, helpers):
    from rts.compiling import threads

    monkeypatch.setenv("RTS_NUM_THREADS", "2")
    caller, both, seen = threading.get_ident(), threading.Barrier(2), []

    def loop(start, stop):
        if start == 0 or stop == 9:
            return
        both.wait(30)  # So that either has one of the two tasks in between.
        if threading.get_ident() != caller:
            raise ValueError("in a helper")

    monkeypatch.setattr(threads, "TASKS_PER_THREAD", 2)
    with pytest.raises(ValueError, match="in a helper"):
        threads.parallel(loop, 9)
    threads.parallel(lambda start, stop: seen.append((start, stop)), 9)
    assert sorted(seen) == [(0, 2), (2, 4), (4, 6), (6, 9)] and helpers.count == 1


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_after_an_error_what_has_not_begun_is_left(monkeypatch, helpers, error):
    from rts.compiling import threads

    monkeypatch.setenv("RTS_NUM_THREADS", "2")
    monkeypatch.setattr(threads, "TASKS_PER_THREAD", 20)
    caller, both, seen = threading.get_ident(), threading.Barrier(2), []

    def loop(start, stop):
        seen.append(start)
        if len(seen) <= 2:
            both.wait(30)  # Both have begun.
        if threading.get_ident() == caller:
            raise error
        time.sleep(0.01)

    with pytest.raises(error):
        threads.parallel(loop, 40)
    assert len(seen) < 10


def test_of_several_items_that_fail_the_error_is_that_of_the_first(monkeypatch, helpers):
    from rts.compiling import threads

    monkeypatch.setenv("RTS_NUM_THREADS", "2")

    def fail(i):
        if i > 5:
            raise ValueError(str(i))
        return i

    with pytest.raises(ValueError, match="^6$"):
        threads.each(fail, range(40))
    assert threads.each(fail, range(6)) == list(range(6))


# --------------------------------------------------------------------------------------------------- forks

FORK = """
import gc, multiprocessing
import numpy as np
import rts

vertices = np.array([(-1, -1, 0), (1, -1, 0), (0, 1, 0)], np.float32)
part = rts.Part(rts.plugin("surfaces", "mesh")([(0, 1, 2)]), {"vertices": vertices})
camera = rts.Camera.look_at((0, 0, 3), (0, 0, 0))
sampler = rts.plugin("samplers", "opengl")()

def render(sampler):
    return np.asarray(rts.render(part, camera, (12, 15), sampler=sampler))

def child():
    for used in (sampler, rts.plugin("samplers", "opengl")()):
        try:
            render(used)
        except rts.errors.PluginError as error:
            print(error, flush=True)
    np.testing.assert_allclose(render("raster"), expected, atol=1e-5)
    handles.clear()
    gc.collect()
    sampler._worker.close()

expected, handles = render("raster"), [rts.prepare(part, sampler)]
np.testing.assert_allclose(render(sampler), expected, atol=1e-5)
process = multiprocessing.get_context("fork").Process(target=child)
process.start()
process.join(60)
if process.exitcode is None:
    process.kill()
    raise SystemExit("the child hangs")
assert process.exitcode == 0, process.exitcode
np.testing.assert_allclose(render(sampler), expected, atol=1e-5)
np.testing.assert_allclose(np.asarray(rts.render(handles[0], camera, (12, 15))), expected, atol=1e-5)
"""


@pytest.mark.skipif("fork" not in multiprocessing.get_all_start_methods(), reason="no fork on this system")
@pytest.mark.thorough
def test_a_forked_child_is_told_that_opengl_was_in_use():
    made("opengl")
    environment = os.environ | {"RTS_NUM_THREADS": "2"}
    done = subprocess.run([sys.executable, "-c", FORK], capture_output=True, text=True, timeout=120, env=environment)
    assert done.returncode == 0, done.stderr[-3000:]
    lines = done.stdout.splitlines()
    assert len(lines) == 2 and all("forked" in x and "'spawn'" in x and "'raster'" in x for x in lines)


# --------------------------------------------------------------------------------------------------- leaks

LIMIT = 10e6


def resident():
    """Bytes of memory that this process occupies."""
    statm = Path("/proc/self/statm")
    if not statm.exists():
        pytest.skip("no /proc/self/statm on this system")
    gc.collect()
    return int(statm.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


@pytest.mark.parametrize("name", ["embree", "opengl"])
@pytest.mark.thorough
def test_hundreds_of_renders_leave_no_memory_behind(name):
    sampler, part = made(name), scene(name, 0)
    original = {key: value.copy() for key, value in part.theta.items()}
    angles = np.linspace(0, 3, 400).astype(np.float32)

    def render(angle):
        if angle > angles[200]:  # The surface changes, too.
            for key in original:
                part.theta[key][:] = original[key] * (1 + 0.1 * angle)
        rts.render(part.replace(transform=rts.rigid((0, float(angle), 0, 0, 0, 0))), CAMERA, (16, 16), sampler=sampler)

    for angle in angles[100:250]:
        render(angle)
    before = resident()
    for angle in angles:
        render(angle)
    assert resident() - before < LIMIT


@pytest.mark.parametrize("name", ["embree", "opengl"])
@pytest.mark.thorough
def test_hundreds_of_meshes_leave_no_memory_behind(name):
    # Each of 5120 triangles: without release, 100 of them would be seen.
    sampler, (vertices, faces) = made(name), icosphere(4)

    def render(count):
        for _ in range(count):
            part = Part(Mesh(faces), {"vertices": vertices}, "silhouette")
            rts.render(part, CAMERA, (16, 16), sampler=sampler)

    render(30)
    before = resident()
    render(100)
    assert resident() - before < LIMIT


class Counted:
    """A context that counts the objects made of it and released."""

    MADE = ("buffer", "vertex_array", "texture", "depth_renderbuffer", "framebuffer", "program", "query")

    def __init__(self, context):
        self._context, self.alive, self.most = context, [], 0

    def __getattr__(self, attribute):
        value = getattr(self._context, attribute)
        if attribute not in self.MADE:
            return value

        def make(*args, **kwargs):
            thing = value(*args, **kwargs)
            self.alive.append(thing)
            self.alive = [x for x in self.alive if type(x.mglo).__name__ != "InvalidObject"]
            self.most = max(self.most, len(self.alive))
            return thing

        return make

    def __setattr__(self, attribute, value):
        if attribute in ("_context", "alive", "most"):
            object.__setattr__(self, attribute, value)
        else:
            setattr(self._context, attribute, value)


@pytest.mark.thorough
def test_hundreds_of_renders_leave_no_opengl_object_behind(monkeypatch):
    made("opengl")
    from rts_backends.opengl import worker as opengl_worker

    create, contexts = opengl_worker._create, []

    def counted():
        contexts.append(Counted(create()))
        return contexts[-1]

    monkeypatch.setattr(opengl_worker, "_create", counted)
    sampler = made("opengl")
    parts, original = [scene("opengl", 0)], icosphere(2)[0]

    def render(steps):
        for step in steps:
            parts[0].theta["vertices"][:] = original * np.float32(1 - 1e-4 * step)
            rts.render(parts[0], CAMERA, (16, 16 + step % 9), sampler=sampler)

    def alive():
        gc.collect()
        sampler._worker.call(lambda context: None)
        (context,) = contexts
        return sum(type(x.mglo).__name__ != "InvalidObject" for x in context.alive)

    render(range(60))
    before = alive()
    render(range(60, 260))
    assert alive() == before
    assert contexts[0].most <= before + 12
    # Two meshes of three objects, four pairs of targets of three, programs and query.
    assert before <= 2 * 3 + 4 * 2 * 3 + 4
    parts.clear()
    assert alive() <= before - 6
    sampler._worker.close()
