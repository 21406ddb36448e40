"""Soups and ties drawn by found edges: compiled loops are their specification, and images stay in range.

A share of them is tried. `RTS_SOUPS=1500` tries as many of both, and `RTS_SOUPS=500:1500` those between two numbers.
"""

import os
import warnings

import numpy as np
import pytest
from helpers import quick
from soups import soup_of
from ties import ties_of

import rts
from rts.splatting import stencil

torch = pytest.importorskip("torch")

pytestmark = pytest.mark.splatting

FIRST, LAST = map(int, ("0:" + os.environ.get("RTS_SOUPS", "120")).split(":")[-2:])
STEP = 20
LIMIT = 1e-6
"""The largest difference of images, and of gradients as a share of the largest, in float64."""


def meshes_of(kind, number):
    """Meshes, camera, size and culling of a scene."""
    if kind == "ties":
        found = ties_of(number)
        return found.meshes, found.camera, found.size, found.cull
    found = soup_of(number)
    return [(found.vertices, found.faces)], found.camera, found.size, found.cull


def drawn(kind, number, sampler="raster"):
    """The image, and the gradient of all vertices, flat."""
    (meshes, camera, size, cull), rng = meshes_of(kind, number), np.random.default_rng(number)
    vertices = [torch.tensor(v, dtype=torch.float64, requires_grad=True) for v, _ in meshes]
    thetas = [{"vertices": v, "colors": rng.random((len(v), 3))} for v in vertices]
    pairs = zip(meshes, thetas, strict=True)
    parts = [rts.Part(rts.Mesh(faces), theta, "unlit", cull=cull) for (_, faces), theta in pairs]
    along = torch.tensor(rng.normal(size=(*size, 4)))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", rts.errors.EmptyImageWarning)
        warnings.simplefilter("ignore", rts.errors.InputWarning)  # Some soups are closed, and wound inside out.
        image = rts.render(parts, camera, size, sampler=sampler)
        slopes = torch.autograd.grad((image * along).sum(), vertices, materialize_grads=True)
    return image.detach().numpy(), np.concatenate([g.numpy().ravel() for g in slopes])


def assert_in_range(image):
    """Colours of samples are at least 0 and at most 1, and so are means of them."""
    assert np.isfinite(image).all()
    assert image.min(initial=0) > -1e-6 and image.max(initial=0) < 1 + 1e-6


@pytest.mark.parametrize("first", quick(range(FIRST, LAST, STEP)))
@pytest.mark.parametrize("kind", ["soup", "ties"])
def test_images_are_in_range_and_those_of_the_specification(kind, first, monkeypatch):
    for number in range(first, min(first + STEP, LAST)):
        image, slopes = drawn(kind, number)
        with monkeypatch.context() as patch:
            patch.setattr(stencil, "SPLAT", stencil._specification)
            expected, known = drawn(kind, number)
        assert_in_range(image)
        np.testing.assert_allclose(image, expected, rtol=0, atol=LIMIT, err_msg=str(number))
        largest = max(np.abs(known).max(), 1e-12)
        np.testing.assert_allclose(slopes, known, rtol=0, atol=LIMIT * largest, err_msg=str(number))


@pytest.mark.parametrize(("number", "sampler"), [(93, "raster"), (138, "reference"), (417, "raster")])
def test_sheets_that_lie_in_one_another_do_not_cross_where_the_next_centre_is_empty(number, sampler):
    # Their slopes differ by rounding: a line of crossing would move by 1e6 pixels and more.
    image, slopes = drawn("soup", number, sampler)
    assert_in_range(image)
    assert np.abs(slopes).max() < 10


def test_a_triangle_that_is_seen_edge_on_has_colours_of_its_edges():
    # The reference sees it at centres; its determinant on screen is 0.
    image, slopes = drawn("ties", 425, "reference")
    assert_in_range(image)
    assert np.isfinite(slopes).all()
