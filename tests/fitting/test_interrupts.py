"""Ctrl-C in a fit: always a KeyboardInterrupt, after which all works as before."""

import _thread
import os
import signal
import threading
import time

import numpy as np
import pytest
from helpers import DIFFERENTIABLE, arrays, icosphere, to_numpy

import rts

pytestmark = pytest.mark.fitting

COUNT = int(os.environ.get("RTS_INTERRUPTS", "6"))
"""How many interrupts each fit gets at random moments."""

targets = pytest.mark.parametrize("target", DIFFERENTIABLE)
methods = pytest.mark.parametrize("method", ["lm", "adam"])
CAMERA = rts.Camera.look_at((1, 2, 3), (0, 0, 0), fov_y=50)
MESH = rts.plugin("surfaces", "mesh")


@pytest.fixture(autouse=True)
def handled():
    """The usual handler, which is there afterwards, too."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    after = signal.signal(signal.SIGINT, before)
    assert after is signal.default_int_handler


def silhouette(target):
    """Residuals of a tiny image, of a pose, and where to start."""
    vertices, faces = icosphere(1)
    surface, vertices = MESH(faces), vertices.astype(np.float32)

    def image(pose):
        part = rts.Part(surface, {"vertices": vertices}, "silhouette", transform=rts.rigid(pose))
        return rts.render(part, CAMERA, (12, 12))

    goal = arrays(target, image(np.zeros(6, np.float32)))
    return lambda pose: image(pose) - goal, arrays(target, np.float32([0.1, 0.1, -0.1, 0.1, 0.1, 0.1]))


@methods
@targets
def test_an_interrupt_at_any_moment_ends_a_fit(target, method):
    residuals, start = silhouette(target)

    def fit():
        return to_numpy(rts.fit(residuals, start, method=method, steps=12, tolerance=0, progress=False).parameters)

    expected, begun = fit(), time.perf_counter()
    fit()
    length, random = time.perf_counter() - begun, np.random.default_rng(COUNT)
    for delay in random.uniform(0, length, COUNT):
        sent = threading.Event()

        def interrupt(delay=delay, sent=sent):
            time.sleep(delay)
            sent.set()
            _thread.interrupt_main()

        thread = threading.Thread(target=interrupt)
        with pytest.raises(KeyboardInterrupt):
            thread.start()
            while True:
                before = sent.is_set()
                fit()
                assert not before, "a whole fit went by after the interrupt"
        thread.join()
    np.testing.assert_array_equal(fit(), expected)


@targets
def test_a_step_is_done_before_its_interrupt(target):
    done = []

    def residuals(p):
        signal.raise_signal(signal.SIGINT)
        done.append(1)
        return p

    with pytest.raises(KeyboardInterrupt):
        rts.fit(residuals, arrays(target, np.ones(2)), callback=lambda *_: pytest.fail("went on"), progress=False)
    assert done


@pytest.mark.parametrize("replaced", [True, False])
@targets
def test_a_second_interrupt_comes_at_once(target, replaced):
    def residuals(p):
        signal.raise_signal(signal.SIGINT)
        try:
            signal.raise_signal(signal.SIGINT)
        except KeyboardInterrupt:  # As a framework that replaces it by an error of its own, or that goes on.
            raised.append(1)
            if replaced:
                raise ValueError("INTERNAL") from None
        return p

    raised = []
    with pytest.raises(KeyboardInterrupt):
        rts.fit(residuals, arrays(target, np.ones(2)), progress=False)
    assert raised == [1]


@targets
def test_a_handler_of_ones_own_decides(target):
    calls = []

    def residuals(p):
        if not calls:
            signal.raise_signal(signal.SIGINT)
        return p

    before = signal.signal(signal.SIGINT, lambda number, frame: calls.append(number))
    try:
        fit = rts.fit(residuals, arrays(target, np.ones(2)), steps=3, progress=False)
    finally:
        signal.signal(signal.SIGINT, before)
    assert fit.steps == 3 and calls == [signal.SIGINT]


@targets
def test_fits_in_other_threads_leave_interrupts_alone(target):
    found = []

    def work():
        found.append(rts.fit(lambda p: p, arrays(target, np.ones(2)), steps=3, progress=False).steps)

    thread = threading.Thread(target=work)
    thread.start()
    thread.join(60)
    assert found == [3]
