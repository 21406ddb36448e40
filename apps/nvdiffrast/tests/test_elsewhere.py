"""Tensors on another device: the stand-in of the library's own tests, whose tensors refuse the host as a GPU's do."""

import sys
from pathlib import Path

import pytest
import rts_nvdiffrast.torch as dr
import scenes
import torch

sys.path.append(str(Path(__file__).resolve().parents[3] / "tests"))
elsewhere = pytest.importorskip("elsewhere")


def results(device):
    """Outputs and gradients of the three functions, on the host, and the device of the image."""
    context = dr.RasterizeCudaContext()
    pos = scenes.clip(scenes.CUBE).to(device).requires_grad_()
    colors = (scenes.CUBE + 0.5).to(device).requires_grad_()
    tri = scenes.CUBE_FACES.to(device)
    rast, db = dr.rasterize(context, pos, tri, (16, 16))
    color, changes = dr.interpolate(colors[None], rast, tri, db, "all")
    image = dr.antialias(color, rast, pos, tri)
    (image.square().mean() + changes.square().mean()).backward()
    return [x.detach().to("cpu") for x in (rast, db, changes, image, pos.grad, colors.grad)], image.device


def test_results_are_on_the_device_and_those_of_the_cpu():
    expected, _ = results("cpu")
    with elsewhere.Device():
        found, device = results(elsewhere.DEVICE)
    assert device == elsewhere.DEVICE
    for own, other in zip(found, expected, strict=True):
        assert other.any()
        torch.testing.assert_close(own, other, atol=1e-6, rtol=1e-5)
