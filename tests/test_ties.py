"""Scenes of sheets that tie, cross or nearly do: compiled code, pruning and settling change neither image nor gradient.

A share of them is tried. `RTS_TIES=3000` tries that many, and `RTS_TIES=3000:6000` the scenes of these numbers.
"""

import os
import warnings

import numpy as np
import pytest
from helpers import derivative, gradient, quick
from ties import KINDS, ties_of

import rts
from rts import splatting
from rts.rendering.samples import sample

pytestmark = pytest.mark.sampling

torch = pytest.importorskip("torch")

FIRST, LAST = map(int, ("0:" + os.environ.get("RTS_TIES", "42")).split(":")[-2:])
STEP = len(KINDS)
MESH = rts.plugin("rts.surfaces", "mesh")
SPECIFICATIONS = {"multi": splatting.Multi(), "visible": splatting.Visible()}
# On the same cells: with a wider apron, rays through edges are rounded to either side.
EVERY = {
    name: type("Every", (rts.plugin("splatters", name),), {"needed": rts.Splatter.needed})() for name in SPECIFICATIONS
}
LIMIT = 1e-6
"""Share of the largest gradient, in float64, that rounding may change: zeros are added in another order."""


def rendered(number, needed, splatter, shader="unlit", **options):
    """The image of what a splatter needs; a gradient of all vertices, and a derivative in forward mode."""
    scene, colors = ties_of(number), np.random.default_rng(number)
    meshes = [(MESH(f), {"colors": colors.random((len(v), 3))}) for v, f in scene.meshes]
    vertices = [torch.tensor(v, dtype=torch.float64, requires_grad=True) for v, _ in scene.meshes]
    along = [torch.tensor(colors.normal(size=v.shape)) for v in vertices]
    weights = torch.tensor(colors.normal(size=(*scene.size, 4)))

    def parts(vertices):
        pairs = zip(meshes, vertices, strict=True)
        return [rts.Part(mesh, {**theta, "vertices": v}, shader, cull=scene.cull) for (mesh, theta), v in pairs]

    def image(vertices):
        return rts.render_samples(sampled, parts(vertices), scene.camera, splatter=splatter)

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", rts.errors.EmptyImageWarning)
        options |= {"sampler": "raster", "splatter": needed, "layers": scene.layers}
        sampled = sample(parts(vertices), scene.camera, scene.size, **options)
        slopes = gradient("torch", lambda v: (image(v) * weights).sum(), vertices)
        value, push = derivative("torch", image, vertices, along)
    return value, np.concatenate([g.ravel() for g in slopes]), push


def differences(found, expected):
    """Words for how an image and its derivatives differ from what they should be."""
    said = [] if all(np.isfinite(x).all() for x in (*found, *expected)) else ["not finite"]
    for name, own, other, least in zip(("image", "gradient", "push"), found, expected, (1, LIMIT, LIMIT), strict=True):
        off, largest = np.abs(own - other).max(), np.abs(other).max()
        if off > LIMIT * max(largest, least):
            said.append(f"{name} off by {off:.2g} of {largest:.2g}")
    return said


def settings(number, name):
    """Pairs of renders that should be equal, by what they differ in."""
    every, pruned = (rendered(number, needed, name) for needed in (EVERY[name], name))
    yield "pruned", pruned, every
    yield "compiled", every, rendered(number, EVERY[name], SPECIFICATIONS[name])
    for options in ({}, {"supersample": rts.Adaptive(2)}):
        settled, whole = (rendered(number, name, name, "silhouette", settles=on, **options) for on in (True, False))
        yield f"settled {options or ''}", settled, whole


@pytest.mark.parametrize("first", quick(range(FIRST, LAST, STEP)))
@pytest.mark.parametrize("name", SPECIFICATIONS)
def test_images_and_derivatives_are_those_of_the_specification_pruned_settled_or_not(name, first):
    wrong, steepest = {}, 0.0
    for number in range(first, min(first + STEP, LAST)):
        for setting, found, expected in settings(number, name):
            steepest = max(steepest, np.abs(expected[1]).max())
            if said := differences(found, expected):
                wrong[number, setting] = said
    assert not wrong
    assert steepest > 0
