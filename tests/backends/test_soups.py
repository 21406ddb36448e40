"""Random soups, nasty in many ways: samplers against the reference.

A share of them is tried. `RTS_SOUPS=10000` tries that many, and `RTS_SOUPS=5000:10000` those between two numbers.
"""

import os
import warnings

import numpy as np
import pytest
from helpers import quick
from soups import deepened, differences, hits_of, soup_of

import rts
from rts.plugin_api.records import Proxy

pytestmark = pytest.mark.sampling

pytest.importorskip("numba")

FIRST, LAST = map(int, ("0:" + os.environ.get("RTS_SOUPS", "120")).split(":")[-2:])
STEP = 30
groups = pytest.mark.parametrize("first", quick(range(FIRST, LAST, STEP)))
_samplers = {}


def rasterize(name, soup, layers):
    if name not in _samplers:
        try:
            _samplers[name] = rts.plugin("samplers", name)()
            rasterize(name, soup, 1)
        except rts.errors.PluginError as error:
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
