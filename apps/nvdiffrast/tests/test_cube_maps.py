"""Cube maps: faces, filters across edges, mipmaps and derivatives, against formulas for one pixel in NumPy."""

from functools import cache

import numpy as np
import pytest
import torch
from rts_nvdiffrast.mipmaps import texture_construct_mip
from rts_nvdiffrast.texture import texture

import rts

FILTERS = ["nearest", "linear", "linear-mipmap-nearest", "linear-mipmap-linear"]
TOLERANCE = {torch.float32: 1e-5, torch.float64: 1e-10}

# Table 3.23 of the OpenGL 4.2 specification: s_c, t_c, |m_a| of each face.
ON_FACE = [
    lambda x, y, z: (-z, -y, x),
    lambda x, y, z: (z, -y, -x),
    lambda x, y, z: (x, z, y),
    lambda x, y, z: (x, -z, -y),
    lambda x, y, z: (x, -y, z),
    lambda x, y, z: (-x, -y, -z),
]
# The same, solved for a point of the cube's surface.
IN_SPACE = [
    lambda s, t: (1, -t, -s),
    lambda s, t: (-1, -t, s),
    lambda s, t: (s, 1, t),
    lambda s, t: (s, -1, -t),
    lambda s, t: (s, -t, 1),
    lambda s, t: (-s, -t, -1),
]


@cache
def centres(size):
    """Centres of texels on a cube's surface, (6, size, size, 3)."""
    line = (2 * np.arange(size) + 1) / size - 1
    t, s = np.meshgrid(line, line, indexing="ij")
    return np.stack([np.stack(np.broadcast_arrays(*place(s, t)), axis=-1) for place in IN_SPACE])


def texel(tex, face, column, row):
    """A texel of a cube map (6, n, n, C); beyond an edge the nearest of another face, beyond a corner a mean."""
    size = tex.shape[1]
    beyond = [not 0 <= i < size for i in (column, row)]
    if not any(beyond):
        return tex[face, row, column]
    point = np.array(IN_SPACE[face](*((2 * i + 1) / size - 1 for i in (column, row))))
    away = np.linalg.norm(centres(size) - point, axis=-1)
    if all(beyond):
        three = away.min((1, 2)).argsort()[:3]
        return np.mean([tex[f].reshape(size * size, -1)[away[f].argmin()] for f in three], axis=0)
    away[face] = np.inf
    return tex[np.unravel_index(away.argmin(), away.shape)]


def one_pixel(levels, uv, uv_da, bias, filter_mode):
    """The sample in a direction (3,), with derivatives (6,) and a bias."""
    face = int(np.argmax([place(*uv)[2] for place in ON_FACE]))

    def coordinates(direction):
        s, t, depth = ON_FACE[face](*direction)
        return np.array([s / depth + 1, t / depth + 1]) / 2

    def bilinear(tex):
        size = tex.shape[1]
        x, y = coordinates(uv) * size - 0.5
        total = 0
        for i in (int(np.floor(x)), int(np.floor(x)) + 1):
            for j in (int(np.floor(y)), int(np.floor(y)) + 1):
                total = total + (1 - abs(x - i)) * (1 - abs(y - j)) * texel(tex, face, i, j)
        return total

    size = levels[0].shape[1]
    if filter_mode == "nearest":
        column, row = np.floor(coordinates(uv) * size).astype(int)
        return levels[0][face, row, column]
    if filter_mode == "linear":
        return bilinear(levels[0])
    steps = np.array(uv_da).reshape(3, 2).T  # Derivatives by a step into the complex plane.
    footprint = np.stack([coordinates(uv + 1e-30j * step).imag / 1e-30 for step in steps]) * size
    level = np.clip(np.log2(np.linalg.svd(footprint, compute_uv=False)[0]) + bias, 0, len(levels) - 1)
    if filter_mode == "linear-mipmap-nearest":
        return bilinear(levels[int(np.floor(level))])
    lower, upper = int(np.floor(level)), int(np.ceil(level))
    return (1 - (level - lower)) * bilinear(levels[lower]) + (level - lower) * bilinear(levels[upper])


def inputs(dtype=torch.float64, size=4, shape=(6, 7)):
    """A cube map for each of two images, directions of all lengths, also near edges and corners, and footprints."""
    rng = np.random.default_rng(1)
    tex = rng.uniform(size=(2, 6, size, size, 3))
    uv = rng.normal(size=(2, *shape, 3))
    uv[1] = np.sign(uv[1]) * rng.uniform(0.8, 1, size=uv[1].shape)  # Near the corners of the cube.
    uv[1, ..., ::2, 0] *= 0.3  # Near edges.
    length = rng.uniform(0.1, 10, size=(2, *shape, 1))
    uv_da = rng.normal(size=(2, *shape, 6)) * 2.0 ** -rng.uniform(0, 4, size=(2, *shape, 1))
    bias = rng.uniform(-1, 1, size=(2, *shape))
    return [torch.tensor(x, dtype=dtype) for x in (tex, uv * length, uv_da * length, bias)]


def edges_and_corners():
    """Directions (1, 1, N, 3) exactly to corners, edges and centres of faces, and between."""
    line = np.array([-1, -0.5, 0, 0.125, 1])
    all_points = np.stack(np.meshgrid(line, line, line), axis=-1).reshape(-1, 3)
    return torch.tensor(all_points[np.abs(all_points).max(-1) == 1], dtype=torch.float32)[None, None]


@pytest.mark.parametrize("dtype", TOLERANCE)
@pytest.mark.parametrize("filter_mode", FILTERS)
def test_equals_a_formula_for_one_pixel(filter_mode, dtype):
    tex, uv, uv_da, bias = inputs(dtype)
    got = texture(tex, uv, uv_da, bias, filter_mode=filter_mode, boundary_mode="cube")
    assert got.dtype == dtype
    for b, y, x in np.ndindex(got.shape[:3]):
        levels = [tex[b].double().numpy()]
        while levels[-1].shape[1] > 1:
            tall = levels[-1][:, ::2] + levels[-1][:, 1::2]
            levels.append((tall[:, :, ::2] + tall[:, :, 1::2]) / 4)
        pixel = (a[b, y, x].double().numpy() for a in (uv, uv_da, bias))
        expected = one_pixel(levels, *pixel, filter_mode)
        assert np.abs(got[b, y, x].numpy() - expected).max() < TOLERANCE[dtype]


def test_each_texel_is_seen_in_its_direction():
    tex = torch.rand(1, 6, 4, 4, 2, dtype=torch.float64)
    uv = torch.tensor(centres(4)).reshape(1, 6, 16, 3)
    for filter_mode in ("nearest", "linear"):
        got = texture(tex, uv, filter_mode=filter_mode, boundary_mode="cube")
        assert torch.allclose(got.reshape(tex.shape), tex, atol=1e-12)


def test_a_function_of_the_direction_is_smooth_across_edges():
    def value(points):
        x, y, z = np.moveaxis(points / np.linalg.norm(points, axis=-1, keepdims=True), -1, 0)
        return np.stack([x, y, z, x * y - z, y * z + x], axis=-1)

    uv = np.concatenate([np.random.default_rng(0).normal(size=(1, 1, 2000, 3)), edges_and_corners().numpy()], axis=2)
    errors = []
    for size in (16, 32, 64):
        got = texture(torch.tensor(value(centres(size)))[None], torch.tensor(uv), boundary_mode="cube").numpy()
        errors.append(np.abs(got - value(uv)).max())
    # A folded edge is of first order: its two texels are as far apart as their depths differ.
    assert errors[0] < 0.04 and errors[1] < 0.55 * errors[0] and errors[2] < 0.55 * errors[1]


def test_no_step_at_edges_and_corners():
    tex, _, _, _ = inputs()
    uv = edges_and_corners().double()
    steps = torch.tensor(np.random.default_rng(0).normal(size=(40, 1, 1, 1, 3)))
    around = torch.stack([texture(tex[:1], uv + 1e-7 * step, boundary_mode="cube") for step in steps])
    assert (around - around[0]).abs().max() < 1e-5


@pytest.mark.parametrize("size", [1, 2, 8])
@pytest.mark.parametrize("filter_mode", FILTERS)
def test_a_constant_cube_map_is_constant(filter_mode, size):
    uv = edges_and_corners()
    uv_da = torch.randn(1, *uv.shape[1:3], 6, generator=torch.Generator().manual_seed(0)) * 0.2
    got = texture(torch.full((1, 6, size, size, 2), 0.7), uv, uv_da, filter_mode=filter_mode, boundary_mode="cube")
    assert (got - 0.7).abs().max() < 1e-6


def test_directions_that_are_none_are_zero_and_have_no_gradients():
    tex, uv, uv_da, _ = inputs()
    good = texture(tex, uv, uv_da, boundary_mode="cube")
    uv[0, 0, 0], uv[0, 1, 0, 1], uv[1, 2, 0, 2] = 0, torch.nan, torch.inf
    uv_da[0, 0, 0, 1], uv_da[0, 1, 0] = torch.inf, torch.nan
    bad = [(0, 0, 0), (0, 1, 0), (1, 2, 0)]
    for x in (tex, uv, uv_da):
        x.requires_grad_()
    got = texture(tex, uv, uv_da, boundary_mode="cube")
    got.sum().backward()
    for pixel in bad:
        assert (got[pixel] == 0).all() and (uv.grad[pixel] == 0).all() and (uv_da.grad[pixel] == 0).all()
    rest = torch.ones(got.shape[:3], dtype=torch.bool)
    rest[tuple(zip(*bad, strict=True))] = False
    assert torch.allclose(got[rest], good[rest])
    assert np.isclose(float(tex.grad.sum()), 3 * int(rest.sum())) and uv.grad.isfinite().all()


@pytest.mark.parametrize("filter_mode", FILTERS)
def test_gradients_are_those_of_finite_differences(filter_mode):
    tex, uv, uv_da, bias = inputs(size=2, shape=(2, 2))
    tex = tex[..., :1].contiguous().requires_grad_()
    needed = {"nearest": [], "linear": [uv], "linear-mipmap-nearest": [uv], "linear-mipmap-linear": [uv, uv_da, bias]}
    for x in needed[filter_mode]:
        x.requires_grad_()
    sample = lambda *_: texture(tex, uv, uv_da, bias, filter_mode=filter_mode, boundary_mode="cube")  # noqa: E731
    assert torch.autograd.gradcheck(sample, [tex, *needed[filter_mode]], atol=1e-6)


def test_own_mipmaps_and_stacks():
    tex, uv, uv_da, _ = inputs()
    stack = texture_construct_mip(tex, cube_mode=True)
    assert [tuple(x.shape) for x in stack.levels] == [(2, 6, 2, 2, 3), (2, 6, 1, 1, 3)]
    expected = texture(tex, uv, uv_da, boundary_mode="cube")
    for mip in (stack, list(stack.levels)):
        assert torch.equal(texture(tex, uv, uv_da, mip=mip, boundary_mode="cube"), expected)
    doubled = [2 * x for x in stack.levels]
    assert not torch.allclose(texture(tex, uv, uv_da, mip=doubled, boundary_mode="cube"), expected)


def test_a_fit_of_a_cube_map():
    generator = torch.Generator().manual_seed(0)
    goal = torch.rand(1, 6, 4, 4, 3, generator=generator)
    uv = torch.randn(1, 20, 20, 3, generator=generator)
    uv_da = torch.randn(1, 20, 20, 6, generator=generator) * 0.1
    image = texture(goal, uv, uv_da, boundary_mode="cube")
    tex = torch.full_like(goal, 0.5).requires_grad_()
    optimizer = torch.optim.Adam([tex], lr=0.05)
    losses = []
    for _ in range(100):
        loss = (texture(tex, uv, uv_da, boundary_mode="cube") - image).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[0] > 1e-2 and losses[-1] < 1e-5


@pytest.mark.parametrize(
    ("tex", "uv", "message"),
    [
        (torch.ones(1, 4, 4, 3), torch.ones(1, 2, 2, 3), r"expected \(B, 6, H, H, C\), a cube map"),
        (torch.ones(1, 6, 4, 8, 3), torch.ones(1, 2, 2, 3), r"tex has the shape \(1, 6, 4, 8, 3\)"),
        (torch.ones(1, 6, 4, 4, 3), torch.ones(1, 2, 2, 2), r"expected \(B, h, w, 3\) with boundary_mode='cube'"),
    ],
)
def test_errors_say_what_is_wrong(tex, uv, message):
    with pytest.raises(rts.InputError, match=message):
        texture(tex, uv, boundary_mode="cube")
