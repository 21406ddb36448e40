"""Scenes of known values are sampled on the host, whatever their engine."""

import numpy as np
import pytest
from helpers import CAMERA, TORCH, arrays, icosphere, to_numpy

import rts
from rts.sampling.host_scenes import on_the_host
from rts.sampling.scene import Grid, Scene

pytestmark = pytest.mark.sampling

SIZE = 24, 30
BOX = (-1.3, -1.3, -1.3), (1.3, 1.3, 1.3)


def ball(theta, points):
    return theta["r"] - (points**2).sum(-1) ** 0.5


def field(radius):
    return rts.Part(rts.Isosurface(BOX, f=ball, shape=(12, 12, 12)), {"r": radius}, "lambert")


def mesh(**options):
    vertices, faces = icosphere(2, 0.7)
    return rts.Part(rts.Mesh(faces), {"vertices": vertices.astype(np.float32)}, "lambert", **options)


@pytest.mark.skipif(not TORCH, reason="torch is not installed")
@pytest.mark.parametrize("splatter", ["edges", "single", "none"])
@pytest.mark.parametrize("radius", [0.8, 1])
def test_numbers_are_known_values(splatter, radius):
    options = {"splatter": splatter, "engine": "torch"}
    found = to_numpy(rts.render(field(radius), CAMERA, SIZE, **options))
    expected = to_numpy(rts.render(field(np.float32(radius)), CAMERA, SIZE, **options))
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6)


def test_numbers_are_known_values_of_what_casts_shadows():
    seen = rts.shadows.seen_from(field(0.8), CAMERA, SIZE)
    assert rts.shadows.visibility(seen, np.zeros((1, 3), np.float32))[0] < 1e-6


@pytest.mark.parametrize("target", [*TORCH[:1], "jax"])
def test_triangles_are_made_once_a_render(target, monkeypatch):
    """Three parts share a surface: more than a sampler keeps."""
    shared, calls, proxy = field(0.8), [], rts.Isosurface.proxy
    monkeypatch.setattr(rts.Isosurface, "proxy", lambda *given: calls.append(1) or proxy(*given))
    parts = [shared.replace(theta={"r": np.float32(radius)}) for radius in (0.4, 0.6, 0.8)]
    rts.render(arrays(target, parts), CAMERA, SIZE)
    assert len(calls) == 3


@pytest.mark.parametrize("dtype", ["float32", "float64", "bfloat16"])
def test_samples_are_arrays_of_the_engine(dtype):
    torch = pytest.importorskip("torch")
    transform = torch.eye(4, dtype=getattr(torch, dtype))
    sampled = rts.sample(mesh(transform=transform), CAMERA, SIZE)
    (own,) = sampled.samples
    assert isinstance(own.ids, torch.Tensor) and isinstance(sampled.row, torch.Tensor)
    assert own.gbuffer["position"].dtype == (torch.float64 if dtype == "float64" else torch.float32)
    plain = rts.sample(mesh(), CAMERA, SIZE)
    np.testing.assert_array_equal(to_numpy(sampled.row), plain.row)


class Following(type(rts.plugin("samplers", "raster")())):
    """Triangles by "raster", by a sampler that adapts in place what it built."""

    def prepare(self, proxy):
        """The triangles themselves."""
        return super().prepare(proxy)

    def update(self, prepared, proxy):
        """Begin anew."""
        return None


@pytest.mark.parametrize(("sampler", "there"), [("auto", True), (Following(), False)])
def test_what_samplers_adapt_stays_in_their_hands(sampler, there):
    scene = Scene.of(mesh(), CAMERA, sampler, None).at(SIZE)
    here, _ = on_the_host(scene, Grid(scene.camera, SIZE))
    assert bool(here.cameras) is there
    found = rts.render(mesh(), CAMERA, SIZE, sampler=sampler)
    np.testing.assert_allclose(found, rts.render(mesh(), CAMERA, SIZE, sampler="reference"), rtol=0, atol=1e-4)
