"""Scenes of sheets that tie, cross or nearly do: compiled code, pruning and settling change neither image nor gradient.

A share of them is tried. `RTS_TIES=3000` tries that many, and `RTS_TIES=3000:6000` those between two numbers.
"""

import os
import warnings

import numpy as np
import pytest
from helpers import to_numpy
from ties import KINDS, ties_of

import rts
from rts import splatting
from rts.sampling.scenes import sample

pytestmark = pytest.mark.sampling

torch = pytest.importorskip("torch")

FIRST, LAST = map(int, ("0:" + os.environ.get("RTS_TIES", "150")).split(":")[-2:])
MESH = rts.plugin("rts.surfaces", "mesh")
SPECIFICATIONS = {"multi": splatting.Multi(), "visible": splatting.Visible()}
# On the same cells: with a wider apron, rays through edges are rounded to either side.
EVERY = {name: type("Every", (rts.plugin("splatters", name),), {"prunes": False})() for name in SPECIFICATIONS}
LIMIT = 1e-6
"""Of the largest gradient, in float64: what is left out adds zeros in another order."""


def parts_of(scene, number, vertices, shader):
    colors = np.random.default_rng(number).random
    return [
        rts.Part(MESH(f), {"vertices": v, "colors": colors((len(v), 3))}, shader, cull=scene.cull)
        for v, (_, f) in zip(vertices, scene.meshes, strict=True)
    ]


def rendered(scene, number, needed, splatter, shader="unlit", **options):
    """The image of what a splatter needs, and a gradient of all vertices."""
    vertices = [torch.tensor(v, dtype=torch.float64, requires_grad=True) for v, _ in scene.meshes]
    along = torch.tensor(np.random.default_rng(number).normal(size=(*scene.size, 4)))
    parts = parts_of(scene, number, vertices, shader)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", rts.EmptyImageWarning)
        options |= {"sampler": "raster", "layers": scene.layers}
        sampled = sample(parts, scene.camera, scene.size, splatter=needed, **options)
        image = rts.render_samples(sampled, parts, scene.camera, splatter=splatter)
    gradients = torch.autograd.grad((image * along).sum() + sum(0 * v.sum() for v in vertices), vertices)
    return to_numpy(image), np.concatenate([to_numpy(g).ravel() for g in gradients])


def differences(found, expected):
    """Words for how an image and a gradient differ from what they should be."""
    (image, gradient), (whole, slopes) = found, expected
    if not all(np.isfinite(x).all() for x in (*found, *expected)):
        return "not finite"
    off, largest = np.abs(gradient - slopes).max(), np.abs(slopes).max()
    if np.abs(image - whole).max() > LIMIT or off > LIMIT * max(largest, LIMIT):
        return f"image off by {np.abs(image - whole).max():.2g}, gradient by {off:.2g} of {largest:.2g}"
    return ""


def settings(scene, number, name):
    """Pairs of renders that should be equal, by what they differ in."""
    every, pruned = (rendered(scene, number, needed, name) for needed in (EVERY[name], name))
    yield "pruned", pruned, every
    yield "compiled", every, rendered(scene, number, EVERY[name], SPECIFICATIONS[name])
    for options in ({}, {"supersample": rts.Adaptive(2)}):
        settled, whole = (
            rendered(scene, number, name, name, "silhouette", settles=on, **options) for on in (True, False)
        )
        yield f"settled {options or ''}", settled, whole


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", SPECIFICATIONS)
def test_images_and_gradients_are_those_of_the_specification_pruned_settled_or_not(name, kind):
    wrong, steepest = {}, 0.0
    for number in range(FIRST, LAST):
        if KINDS[number % len(KINDS)] != kind:
            continue
        scene = ties_of(number)
        for setting, found, expected in settings(scene, number, name):
            steepest = max(steepest, np.abs(expected[1]).max())
            if said := differences(found, expected):
                wrong[number, setting] = said
    assert not wrong
    assert steepest > 0
