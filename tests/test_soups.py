"""Random soups, nasty in many ways: samplers against the reference, splatters and pruning against their specification.

A share of them is tried. `RTS_SOUPS=10000` tries that many, and `RTS_SOUPS=5000:10000` those between two numbers.
"""

import os
import warnings

import numpy as np
import pytest
from helpers import to_numpy
from soups import differences, hits_of, soup_of

import rts
from rts import splatting
from rts.rendering import sample

pytestmark = pytest.mark.sampling

pytest.importorskip("numba")

FIRST, LAST = map(int, ("0:" + os.environ.get("RTS_SOUPS", "240")).split(":")[-2:])
STEP = 30
groups = pytest.mark.parametrize("first", range(FIRST, LAST, STEP))
MESH = rts.plugin("rts.surfaces", "mesh")
_samplers = {}


def rasterize(name, soup, layers):
    if name not in _samplers:
        try:
            _samplers[name] = rts.plugin("samplers", name)()
            rasterize(name, soup, 1)
        except rts.PluginError as error:
            _samplers[name] = str(error)
    if isinstance(_samplers[name], str):
        pytest.skip(_samplers[name])
    sampler, proxy = _samplers[name], rts.Proxy(soup.vertices, soup.faces)
    return sampler.rasterize(sampler.prepare(proxy), soup.camera, soup.size, layers, soup.cull)


def numbers(first):
    return range(first, min(first + STEP, LAST))


@groups
@pytest.mark.parametrize("name", ["raster", "embree"])
def test_samplers_find_what_the_reference_finds(name, first):
    wrong, seen = {}, 0
    for number in numbers(first):
        soup = soup_of(number)
        known, count = hits_of(soup), len(soup.faces)
        found, every = rasterize(name, soup, soup.layers), rasterize("reference", soup, count)
        seen += (every.triangle_ids >= 0).sum()
        said = differences(soup, found, every, known, known.open)
        # Both decide by the same edge functions: rounding makes no difference.
        said += [f"{x} (raster)" for x in differences(soup, found, rasterize("raster", soup, count), known, known.flat)]
        if said:
            wrong[number] = said
    assert not wrong
    assert seen > 10 * STEP or LAST - first < STEP


@groups
def test_hardware_finds_what_the_reference_finds_but_for_outlines(first):
    wrong = {}
    for number in list(numbers(first))[::3]:
        soup = soup_of(number, 1e2)
        known, count = hits_of(soup), len(soup.faces)
        found, every = rasterize("opengl", soup, count), rasterize("reference", soup, count)
        rough = known.open | (known.outline < 1)
        said = differences(soup, found, every, known, known.open)
        said = [x for x in said if "missing" not in x]
        said += [x for x in differences(soup, found, every, known, rough) if "missing" in x]
        if said:
            wrong[number] = said
    assert not wrong


def colored(soup, number, vertices=None):
    colors = np.random.default_rng(number).random(soup.vertices.shape).astype(np.float32)
    theta = {"vertices": soup.vertices if vertices is None else vertices, "colors": colors}
    return rts.Part(MESH(soup.faces), theta, "unlit", cull=soup.cull)


@groups
@pytest.mark.parametrize("name", ["multi", "visible"])
def test_images_are_finite_and_those_of_the_specification_pruned_or_not(name, first):
    torch = pytest.importorskip("torch")
    wrong, seen = {}, 0
    specification = {"multi": splatting.Multi, "visible": splatting.Visible}[name]()
    for number in numbers(first):
        soup = soup_of(number)
        images, gradients = [], []
        along = torch.tensor(np.random.default_rng(number).normal(size=(*soup.size, 4)), dtype=torch.float32)
        for needed, splatter in ((None, specification), (None, name), (name, name)):
            vertices = torch.tensor(soup.vertices, requires_grad=True)
            part = colored(soup, number, vertices)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", rts.errors.EmptyImageWarning)
                sampled = sample(part, soup.camera, soup.size, sampler="raster", splatter=needed, layers=soup.layers)
                image = rts.render_samples(sampled, part, soup.camera, splatter=splatter)
            gradients.append(to_numpy(torch.autograd.grad((image * along).sum(), vertices)[0]))
            images.append(to_numpy(image))
        seen += (images[0] > 0).sum()
        size = max(1e-30, np.abs(gradients[1]).max(initial=0))
        said = []
        if not all(np.isfinite(x).all() for x in (*images, *gradients)):
            said.append("not finite")
        elif np.abs(images[1] - images[0]).max() > 1e-5:
            said.append(f"off the specification by {np.abs(images[1] - images[0]).max():.2g}")
        elif np.abs(images[2] - images[1]).max() > 1e-6:
            said.append(f"pruned off by {np.abs(images[2] - images[1]).max():.2g}")
        elif np.abs(gradients[2] - gradients[1]).max() > 1e-5 * size:  # Sums in float32.
            said.append(f"pruned gradients off by {np.abs(gradients[2] - gradients[1]).max() / size:.2g}")
        if said:
            wrong[number] = said
    assert not wrong
    assert seen > 10 * STEP or LAST - first < STEP
