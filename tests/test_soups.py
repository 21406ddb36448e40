"""Random soups, nasty in many ways: samplers against the reference, splatters and pruning against their specification.

A share of them is tried. `RTS_SOUPS=10000` tries that many, and `RTS_SOUPS=5000:10000` those between two numbers.
"""

import os
import warnings

import numpy as np
import pytest
from helpers import quick, to_numpy
from soups import deepened, differences, hits_of, soup_of

import rts
from rts import splatting
from rts.plugin_api.records import Proxy
from rts.rendering.samples import sample

pytestmark = pytest.mark.sampling

pytest.importorskip("numba")

FIRST, LAST = map(int, ("0:" + os.environ.get("RTS_SOUPS", "120")).split(":")[-2:])
STEP = 30
groups = pytest.mark.parametrize("first", quick(range(FIRST, LAST, STEP)))
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
    sampler, proxy = _samplers[name], Proxy(soup.vertices, soup.faces)
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
    assert seen > 3 * STEP or LAST - first < STEP


@groups
def test_hardware_finds_what_the_reference_finds_but_for_outlines(first):
    wrong = {}
    for number in list(numbers(first))[:: 3 if LAST < 1000 else 1]:
        soup = soup_of(number)
        if number % 2:
            soup = deepened(soup, number)
        known, count = hits_of(soup), len(soup.faces)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", rts.errors.SamplerWarning)
            found, every = rasterize("opengl", soup, count), rasterize("reference", soup, count)
        # Corners are snapped to fractions of a pixel, and planes cut in float32.
        planes = [np.abs(known.depth - z) <= 1e-4 * abs(z) for z in soup.camera.depth_range()]
        rough = known.open | (known.outline < 1) | planes[0] | planes[1]
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


def rendered(soup, number, needed, splatter, dtype):
    """The image of what a splatter needs, or of all samples, and a gradient of the vertices, by torch."""
    torch = pytest.importorskip("torch")
    vertices = torch.tensor(soup.vertices, dtype=getattr(torch, dtype), requires_grad=True)
    along = torch.tensor(np.random.default_rng(number).normal(size=(*soup.size, 4)), dtype=vertices.dtype)
    part = colored(soup, number, vertices)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", rts.errors.EmptyImageWarning)
        warnings.simplefilter("ignore", rts.errors.InputWarning)  # Some soups are closed, and wound inside out.
        # Exits take what room samples leave: all samples leave none.
        cells = np.prod([n + 2 * (splatting.Visible.reach + 1) for n in soup.size])
        options = {"layers": soup.layers, "capacity": int(cells) * (soup.layers + 1)}
        sampled = sample(part, soup.camera, soup.size, sampler="raster", splatter=needed, **options)
        image = rts.render_samples(sampled, part, soup.camera, splatter=splatter)
    return to_numpy(image), to_numpy(torch.autograd.grad((image * along).sum(), vertices)[0])


@groups
@pytest.mark.parametrize("name", ["multi", "visible"])
def test_images_are_finite_and_those_of_the_specification_pruned_or_not(name, first):
    wrong, seen = {}, 0
    specification = {"multi": splatting.Multi, "visible": splatting.Visible}[name]()
    # On the same cells: with a wider apron, rays through edges are rounded to either side.
    every = type("Every", (rts.plugin("splatters", name),), {"needed": rts.Splatter.needed})()
    for number in numbers(first):
        soup, said = soup_of(number), []
        specified, image, pruned = (
            rendered(soup, number, *how, "float32") for how in ((every, specification), (every, name), (name, name))
        )
        # Gradients are compared in float64, since what is dropped adds zeros in another order.
        exact = [rendered(soup, number, needed, name, "float64") for needed in (every, name)]
        if not all(np.isfinite(x).all() for pair in (specified, image, pruned, *exact) for x in pair):
            said.append("not finite")
        for what, found, expected, limit in (
            ("specification", image[0], specified[0], 1e-5),
            ("pruned", pruned[0], image[0], 1e-6),
            ("pruned, float64", exact[1][0], exact[0][0], 1e-6),
            ("gradients of what is pruned", exact[1][1], exact[0][1], 1e-6 * np.abs(exact[0][1]).max(initial=0)),
        ):
            if not np.abs(found - expected).max() <= limit:
                said.append(f"{what}: off by {np.abs(found - expected).max():.2g}")
        seen += (image[0] > 0).sum()
        if said:
            wrong[number] = said
    assert not wrong
    assert seen > 3 * STEP or LAST - first < STEP
