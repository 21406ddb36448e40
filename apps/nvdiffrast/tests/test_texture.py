"""Textures with mipmaps, against formulas for one pixel in NumPy."""

import numpy as np
import pytest
import torch
from rts_nvdiffrast.mipmaps import texture_construct_mip
from rts_nvdiffrast.texture import texture

import rts

FILTERS = ["nearest", "linear", "linear-mipmap-nearest", "linear-mipmap-linear"]
BOUNDARIES = ["wrap", "clamp", "zero"]
TOLERANCE = {torch.float32: 1e-5, torch.float64: 1e-10}


def mipmaps(tex):
    """A texture (H, W, C) and its mipmaps."""
    levels = [tex]
    while max(tex.shape[:2]) > 1:
        for axis in (0, 1):
            even, odd = (np.take(tex, range(i, tex.shape[axis], 2), axis) for i in (0, 1))
            tex = (even + odd) / 2 if tex.shape[axis] > 1 else tex
        levels.append(tex)
    return levels


def texel(tex, column, row, boundary):
    height, width = tex.shape[:2]
    if boundary == "wrap":
        return tex[row % height, column % width]
    if boundary == "clamp":
        return tex[min(max(row, 0), height - 1), min(max(column, 0), width - 1)]
    return tex[row, column] if 0 <= row < height and 0 <= column < width else np.zeros(tex.shape[2])


def bilinear(tex, s, t, boundary):
    x, y = s * tex.shape[1] - 0.5, t * tex.shape[0] - 0.5
    column, row = int(np.floor(x)), int(np.floor(y))
    total = 0
    for i in (column, column + 1):
        for j in (row, row + 1):
            total = total + (1 - abs(x - i)) * (1 - abs(y - j)) * texel(tex, i, j, boundary)
    return total


def one_pixel(levels, uv, uv_da, bias, filter_mode, boundary, last=None):
    """The sample at coordinates (2,), with derivatives (4,) and a bias."""
    height, width = levels[0].shape[:2]
    if filter_mode == "nearest":
        return texel(levels[0], int(np.floor(uv[0] * width)), int(np.floor(uv[1] * height)), boundary)
    if filter_mode == "linear":
        return bilinear(levels[0], *uv, boundary)
    footprint = np.array(uv_da).reshape(2, 2) * [[width], [height]]
    level = np.log2(np.linalg.svd(footprint, compute_uv=False)[0]) + bias
    level = np.clip(level, 0, len(levels) - 1)
    if filter_mode == "linear-mipmap-nearest":
        return bilinear(levels[int(np.floor(level))], *uv, boundary)
    lower, upper = int(np.floor(level)), int(np.ceil(level))
    share = level - lower
    return (1 - share) * bilinear(levels[lower], *uv, boundary) + share * bilinear(levels[upper], *uv, boundary)


def inputs(dtype=torch.float64, shape=(8, 16), seed=0, size=(5, 6)):
    """A texture for each of two images, coordinates, footprints of all sizes, and biases."""
    rng = np.random.default_rng(seed)
    tex = rng.uniform(size=(2, *shape, 3))
    uv = rng.uniform(-1.2, 2.2, size=(2, *size, 2))
    uv_da = rng.normal(size=(2, *size, 4)) * 2.0 ** -rng.uniform(0, 5, size=(2, *size, 1))
    bias = rng.uniform(-1, 1, size=(2, *size))
    return [torch.tensor(x, dtype=dtype) for x in (tex, uv, uv_da, bias)]


@pytest.mark.parametrize("dtype", TOLERANCE)
@pytest.mark.parametrize("boundary", BOUNDARIES)
@pytest.mark.parametrize("filter_mode", FILTERS)
def test_equals_a_formula_for_one_pixel(filter_mode, boundary, dtype):
    tex, uv, uv_da, bias = inputs(dtype)
    got = texture(tex, uv, uv_da, bias, filter_mode=filter_mode, boundary_mode=boundary)
    assert got.dtype == dtype and got.shape == (2, 5, 6, 3)
    for b, y, x in np.ndindex(2, 5, 6):
        pixel = (a[b, y, x].double().numpy() for a in (uv, uv_da, bias))
        expected = one_pixel(mipmaps(tex[b].double().numpy()), *pixel, filter_mode, boundary)
        assert np.abs(got[b, y, x].numpy() - expected).max() < TOLERANCE[dtype]


def test_footprints_reach_all_mipmaps():
    tex, uv, uv_da, _ = inputs()
    levels = torch.log2(torch.linalg.matrix_norm(uv_da.reshape(2, 5, 6, 2, 2) * torch.tensor([[16.0], [8.0]]), 2))
    assert levels.min() < 0 and levels.max() > 4
    assert set(range(5)) <= set(levels.floor().long().flatten().tolist())


@pytest.mark.parametrize("shape", [(1, 8), (8, 1), (1, 1), (2, 2)])
def test_thin_textures(shape):
    tex, uv, uv_da, bias = inputs(shape=shape)
    for boundary in BOUNDARIES:
        got = texture(tex, uv, uv_da, bias, boundary_mode=boundary)
        for b, y, x in np.ndindex(2, 5, 6):
            pixel = (a[b, y, x].numpy() for a in (uv, uv_da, bias))
            expected = one_pixel(mipmaps(tex[b].numpy()), *pixel, "linear-mipmap-linear", boundary)
            assert np.abs(got[b, y, x].numpy() - expected).max() < 1e-10


def test_the_filter_that_auto_is():
    tex, uv, uv_da, bias = inputs()
    assert torch.equal(texture(tex, uv), texture(tex, uv, filter_mode="linear"))
    trilinear = texture(tex, uv, uv_da, filter_mode="linear-mipmap-linear")
    assert torch.equal(texture(tex, uv, uv_da), trilinear)
    assert not torch.allclose(trilinear, texture(tex, uv))


def test_a_bias_alone_is_the_mipmap():
    tex, uv, _, _ = inputs()
    for level, mipmap in enumerate([tex, *texture_construct_mip(tex).levels]):
        bias = torch.full(uv.shape[:3], float(level), dtype=tex.dtype)
        assert torch.allclose(texture(tex, uv, mip_level_bias=bias), texture(mipmap, uv), atol=1e-12)


def test_one_texture_for_all_images():
    tex, uv, uv_da, bias = inputs()
    both = texture(tex[:1].repeat(2, 1, 1, 1), uv, uv_da, bias)
    assert torch.equal(texture(tex[:1], uv, uv_da, bias), both)


@pytest.mark.parametrize("limit", [0, 1, 3])
def test_a_limit_of_mipmaps(limit):
    tex, uv, uv_da, _ = inputs(shape=(8, 24))
    got = texture(tex, uv, uv_da, max_mip_level=limit)
    assert len(texture_construct_mip(tex, limit).levels) == limit
    for given in (texture_construct_mip(tex, limit), texture_construct_mip(tex, 3)):
        assert torch.equal(texture(tex, uv, uv_da, mip=given, max_mip_level=limit), got)
    if limit == 0:
        assert torch.equal(got, texture(tex, uv))
    else:
        assert not torch.allclose(got, texture(tex, uv, uv_da, max_mip_level=limit - 1))


def test_sizes_of_mipmaps():
    def sizes(height, width, limit=None):
        return [tuple(x.shape[1:3]) for x in texture_construct_mip(torch.ones(1, height, width, 1), limit).levels]

    assert sizes(32, 8) == [(16, 4), (8, 2), (4, 1), (2, 1), (1, 1)]
    assert sizes(32, 160, 5) == [(16, 80), (8, 40), (4, 20), (2, 10), (1, 5)]
    with pytest.raises(rts.InputError, match="mipmap 5 of the texture has 1 × 5 texels.*max_mip_level=5"):
        sizes(32, 160)


def test_given_mipmaps_are_used_and_have_gradients_of_their_own():
    tex, uv, uv_da, _ = inputs()
    levels = [torch.rand_like(x).requires_grad_() for x in texture_construct_mip(tex).levels]
    tex.requires_grad_()
    got = texture(tex, uv, uv_da, mip=levels)
    for b, y, x in np.ndindex(2, 5, 6):
        own = [level[b].detach().numpy() for level in [tex, *levels]]
        expected = one_pixel(own, uv[b, y, x].numpy(), uv_da[b, y, x].numpy(), 0, "linear-mipmap-linear", "wrap")
        assert np.abs(got[b, y, x].detach().numpy() - expected).max() < 1e-10
    got.sum().backward()
    # The shares of all texels of all mipmaps are one for each pixel and channel.
    assert np.isclose(sum(float(x.grad.sum()) for x in [tex, *levels]), got.numel())
    assert all(x.grad.abs().sum() > 0 for x in [tex, *levels])


def test_gradients_of_a_stack_flow_to_its_texture():
    tex, uv, uv_da, _ = inputs()
    tex.requires_grad_()
    (expected,) = torch.autograd.grad(texture(tex, uv, uv_da).square().sum(), tex)
    stack = texture_construct_mip(tex)
    for _ in range(2):  # The stack outlives a step.
        (got,) = torch.autograd.grad(texture(tex, uv, uv_da, mip=stack).square().sum(), tex)
        assert torch.allclose(got, expected)


@pytest.mark.parametrize("boundary", BOUNDARIES)
@pytest.mark.parametrize("filter_mode", FILTERS)
def test_gradients_are_those_of_finite_differences(filter_mode, boundary):
    tex, uv, uv_da, bias = inputs(shape=(4, 4), size=(2, 3))
    tex = tex[..., :2].contiguous().requires_grad_()
    needed = {"nearest": [], "linear": [uv], "linear-mipmap-nearest": [uv], "linear-mipmap-linear": [uv, uv_da, bias]}
    for x in needed[filter_mode]:
        x.requires_grad_()
    chosen = [tex, *needed[filter_mode]]
    sample = lambda *_: texture(tex, uv, uv_da, bias, filter_mode=filter_mode, boundary_mode=boundary)  # noqa: E731
    assert torch.autograd.gradcheck(sample, chosen, atol=1e-6)


def test_gradients_where_a_footprint_is_round_or_empty():
    tex, uv, _, _ = inputs()
    uv_da = torch.zeros(2, 5, 6, 4, dtype=tex.dtype)
    uv_da[0, ..., 0], uv_da[0, ..., 3] = 2 / 16, 2 / 8  # Circles of two texels: mipmap 1.
    uv_da.requires_grad_()
    got = texture(tex, uv, uv_da)
    assert torch.allclose(got[0], texture(texture_construct_mip(tex).levels[0], uv)[0])
    assert torch.allclose(got[1], texture(tex, uv)[1])
    got.sum().backward()
    assert uv_da.grad.isfinite().all() and (uv_da.grad[1] == 0).all() and uv_da.grad[0].abs().sum() > 0


@pytest.mark.parametrize("filter_mode", FILTERS)
def test_a_constant_texture_is_constant(filter_mode):
    _, uv, uv_da, bias = inputs(torch.float32)
    tex = torch.full((1, 8, 8, 2), 0.7)
    for boundary in ("wrap", "clamp"):
        got = texture(tex, uv, uv_da, bias, filter_mode=filter_mode, boundary_mode=boundary)
        assert (got - 0.7).abs().max() < 1e-6


def test_coordinates_far_away_and_not_finite_are_no_error():
    tex = torch.rand(1, 8, 8, 2)
    uv = torch.tensor([[[[1e30, 0.5], [-1e30, 0.5], [torch.nan, 0.5], [torch.inf, 0.5]]]])
    assert (texture(tex, uv, boundary_mode="zero")[0, 0, :2] == 0).all()
    assert texture(tex, uv, boundary_mode="clamp")[0, 0, :2].isfinite().all()
    for boundary in BOUNDARIES:
        for filter_mode in FILTERS:
            mipmap = torch.tensor([[[0.0, 1.0, 1.0, torch.nan]]])
            texture(tex, uv, mip_level_bias=mipmap, filter_mode=filter_mode, boundary_mode=boundary)


def test_a_fit_through_mipmaps():
    generator = torch.Generator().manual_seed(0)
    goal = torch.rand(1, 8, 8, 3, generator=generator)
    uv = torch.rand(4, 16, 16, 2, generator=generator)
    uv_da = torch.randn(4, 16, 16, 4, generator=generator) * torch.tensor([0.02, 0.05, 0.1, 0.2])[:, None, None, None]
    images = texture(goal, uv, uv_da)
    tex = torch.full_like(goal, 0.5).requires_grad_()
    optimizer = torch.optim.Adam([tex], lr=0.05)
    losses = []
    for _ in range(100):
        loss = (texture(tex, uv, uv_da) - images).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[0] > 1e-2 and losses[-1] < 1e-5
    assert (tex - goal).abs().max() < 0.02


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"tex": np.ones((1, 4, 4, 3))}, "tex is a ndarray; expected a torch tensor"),
        ({"tex": torch.ones(4, 4, 3)}, r"tex has the shape \(4, 4, 3\); expected \(B, H, W, C\)$"),
        ({"tex": torch.ones(1, 6, 4, 4, 3)}, "boundary_mode='cube'"),
        ({"tex": torch.ones(1, 4, 0, 3)}, "tex has the shape"),
        ({"tex": torch.ones(1, 4, 4, 3, dtype=torch.int32)}, "tex is torch.int32"),
        ({"tex": torch.ones(3, 4, 4, 3)}, "3 textures for 2 images"),
        ({"uv": torch.ones(2, 5, 6, 3)}, r"uv has the shape \(2, 5, 6, 3\); expected \(B, h, w, 2\)"),
        ({"uv": torch.ones(2, 5, 6, 2).double()}, "uv is torch.float64"),
        ({"uv_da": torch.ones(2, 5, 6, 2)}, r"uv_da is torch.float32 \(2, 5, 6, 2\); expected.*\(2, 5, 6, 4\)"),
        ({"mip_level_bias": torch.ones(2, 5, 6, 1)}, "mip_level_bias is"),
        ({"mip_level_bias": 1.0}, "mip_level_bias is a float"),
        ({"filter_mode": "cubic"}, "filter_mode is 'cubic'; expected one of auto, nearest"),
        ({"boundary_mode": "mirror"}, "boundary_mode is 'mirror'; expected one of cube, wrap"),
        ({"filter_mode": "linear-mipmap-linear"}, "needs uv_da or mip_level_bias"),
        ({"uv_da": torch.ones(2, 5, 6, 4), "max_mip_level": -1}, "max_mip_level is -1"),
        ({"uv_da": torch.ones(2, 5, 6, 4), "mip": torch.ones(1, 2, 2, 3)}, "mip is a Tensor; expected a list"),
        ({"uv_da": torch.ones(2, 5, 6, 4), "mip": [torch.ones(1, 4, 4, 3)]}, r"mip\[0\] is .*\(1, 2, 2, 3\)"),
        ({"uv_da": torch.ones(2, 5, 6, 4), "tex": torch.ones(1, 6, 4, 3)}, "3 × 2 texels.*max_mip_level=1"),
    ],
)
def test_errors_say_what_is_wrong(change, message):
    arguments = {"tex": torch.ones(1, 4, 4, 3), "uv": torch.ones(2, 5, 6, 2)}
    with pytest.raises(rts.InputError, match=message):
        texture(**{**arguments, **change})
