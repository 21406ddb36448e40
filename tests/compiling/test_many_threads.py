"""Eight threads with every surface, sampler and engine: bitwise what one thread computes, one after the other.

A single round pairs each surface with every other sampler. `RTS_THREAD_ROUNDS=10` has ten rounds, each of new scenes,
and leaves out nothing.
"""

import functools
import os
import warnings

import numpy as np
import pytest
from helpers import together

import rts
from rts.arrays.engines import constants, engine_named
from rts.arrays.trees import leaves, map_leaves
from rts.errors import EmptyImageWarning, RtsError
from rts_testing.compatibility import CAMERA, SIZE, example, single

pytestmark = pytest.mark.core

ROUNDS = int(os.environ.get("RTS_THREAD_ROUNDS", "1"))
THREADS = 8
VIEWS = [CAMERA, rts.Camera.look_at((-1.2, 0.7, 2.9), (0, 0, 0), aspect=SIZE[1] / SIZE[0])]
SURFACES = ["mesh", "bezier", "bspline", "revolution", "subdivision", "isosurface", "isosurface of f", "sdf"]
SAMPLERS = ["raster", "reference", "embree", "opengl", "rays"]
FEW = ["mesh"]
"""Surfaces in jax in a single round: it compiles long."""


def scene(name):
    """A new scene of a surface; None where it cannot work here."""
    if name == "isosurface of f":
        box = ((-1.3, -0.5, -1.3), (1.3, 0.5, 1.3))
        sdf = example("sdf")
        f = sdf.surface.field.f
        return rts.Part(rts.plugin("surfaces", "isosurface")(box, f=f, shape=(13, 7, 13)), sdf.theta, "normals")
    try:
        return example(name)
    except RtsError:
        return None


def images(engine, part, sampler):
    """Image, gradient of θ, and images of several views, as NumPy arrays."""
    options = {"sampler": sampler, "layers": 2}
    theta = constants(map_leaves(single, part.theta), engine, None)
    image = functools.partial(rts.render, camera=CAMERA, size=SIZE, **options)
    found = [image(part.replace(theta=theta))]
    if engine.differentiates:

        def loss(theta):
            return (image(part.replace(theta=theta)) ** 2).sum()

        found += leaves(engine.value_and_grad(loss)(theta)[1])
    if engine.name != "jax":
        found.append(rts.render_views(part.replace(theta=theta), VIEWS, SIZE, **options))
    return [np.array(engine.to_numpy(engine.stop_gradient(x))) for x in found]


def pairs(engine):
    """Scenes, each with its sampler, and what one thread computes of them."""
    found = []
    for i, name in enumerate(SURFACES):
        if engine.name == "jax" and ROUNDS == 1 and name not in FEW:
            continue
        for sampler in SAMPLERS if ROUNDS > 1 or name in FEW else SAMPLERS[i % 2 :: 2]:
            part = scene(name)
            if part is None or (engine.name == "jax" and sampler not in ("raster", "rays")):
                continue
            if sampler == "rays" and ROUNDS == 1 and name.startswith("isosurface"):
                continue  # They take as long as all others.
            try:
                expected = images(engine, part, sampler)
            except RtsError:  # They do not go together, or a package is missing.
                continue
            # New: what is kept of scenes is made anew, by whichever thread is first.
            found.append((f"{name} by {sampler}", scene(name), sampler, expected))
    assert {name.partition(" by ")[0] for name, *_ in found} >= set(FEW)
    return found


@pytest.mark.parametrize("name", ["numpy", "torch", "jax"])
@pytest.mark.thorough
def test_eight_threads_compute_what_one_does(name):
    if name != "numpy":
        pytest.importorskip(name)
    engine, wrong = engine_named(name), []
    for _ in range(ROUNDS):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", EmptyImageWarning)
            given = pairs(engine)

            def work(number, given=given):
                # Half of the threads begin with the same scene, the others where nobody else is.
                first = number // 2 * len(given) // THREADS if number % 2 else 0
                turn = given[first:] + given[:first]
                for label, part, sampler, expected in turn[: len(turn) // 3 + 1] if ROUNDS == 1 else turn:
                    try:
                        found = images(engine, part, sampler)
                        if not all(map(np.array_equal, found, expected)):
                            wrong.append(f"{label}: other values")
                    except Exception as error:
                        wrong.append(f"{label}: {type(error).__name__}: {error}")

            together(work, THREADS, 600)
        assert not wrong, sorted(set(wrong))
