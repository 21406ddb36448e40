"""The compiled splatters against the specification, which test_splatting.py holds against the method's definition."""

import dataclasses
import itertools
import subprocess
import sys
import tracemalloc

import numpy as np
import pytest
from helpers import TORCH, arrays, gradient, quick, splats_of, to_numpy

import rts
from rts import splatting
from rts.arrays.array_functions import without_border
from rts_backends.fused import splatters as fused
from rts_backends.fused.cells import Cells, Settings, _reach
from rts_backends.fused.uniform_cells import BUSY, EMPTY, FLAT

pytestmark = pytest.mark.splatting

torch = pytest.importorskip("torch")

KINDS = {"single": fused.Single, "multi": fused.Multi, "visible": fused.Visible}
SETTINGS = [{}, {"sigma": 0.8, "epsilon": 0.2, "calibration": None}, {"sigma": 0.3, "epsilon": 0.001}]
TOLERANCE = {np.float32: (1e-5, 1e-4), np.float64: (1e-12, 1e-10)}


def cells(layers, size=(9, 11), seed=0, dtype=np.float64, holes=0.2, middle_holes=False, spare=5):
    """Positions, colours and row: off-centre samples, equal depths, cut-outs, empty cells and rows of no cell."""
    rng = np.random.default_rng(seed)
    depth = np.sort(rng.integers(4, 16, (layers, *size)) / 4, axis=0)  # Quarters: ties are exact.
    depth = np.where(rng.random(size) < 0.1, depth[:1], depth)
    filled = rng.random(depth.shape) >= holes
    if not middle_holes:
        filled = np.logical_and.accumulate(filled, axis=0)
    k, y, x = np.nonzero(filled)
    total = len(k) + spare
    place = rng.permutation(total)[: len(k)]
    row = np.full(filled.shape, -1, np.int32)
    row[k, y, x] = place
    positions = rng.normal(size=(total, 3))
    positions[place] = np.stack([x + 0.5, y + 0.5, depth[k, y, x]], axis=-1)
    positions[place, :2] += rng.uniform(-0.4, 0.4, (len(k), 2))
    alpha = rng.choice([0.0, 0.5, 1.0], total, p=[0.2, 0.2, 0.6])
    rgba = np.concatenate([rng.random((total, 3)), np.ones((total, 1))], axis=1) * alpha[:, None]
    return positions.astype(dtype), rgba.astype(dtype), row


class Compiled(Cells):
    """The loops, with results of their own."""

    def size(self):
        return tuple(max(0, n - 2 * self.border) for n in self.row.shape[1:])

    def image(self):
        out = np.empty((*self.size(), 4), self.positions.dtype)
        super().image(out)
        return out

    def vjp(self, g, wanted=(True, True)):
        found = [
            np.zeros(x.shape, x.dtype) if w else None for x, w in zip((self.positions, self.rgba), wanted, strict=True)
        ]
        super().vjp(g, *found)
        return found

    def jvp(self, t_positions, t_rgba):
        count = len(t_rgba if t_positions is None else t_positions)
        out = np.empty((count, *self.size(), 4), self.positions.dtype)
        super().jvp(t_positions, t_rgba, out)
        return out


def compiled(splatter, scene, border=0):
    return Compiled(splatter._settings(border), *scene)


def specification(splatter):
    """The class of `rts.splatting` with the same settings."""
    plain = getattr(splatting, type(splatter).__name__)
    return plain(**{field.name: getattr(splatter, field.name) for field in dataclasses.fields(splatter)})


def noise(*shape, dtype=np.float64, seed=7):
    return np.random.default_rng(seed).normal(size=shape).astype(dtype)


def check_against_specification(splatter, scene, dtype, border=0):
    positions, rgba, row = scene
    splats, reference = compiled(splatter, scene, border), specification(splatter)
    image, cells_ = splats.image(), torch.tensor(row)
    g = noise(*image.shape, dtype=dtype)
    variables = [torch.tensor(x, requires_grad=True) for x in (positions, rgba)]
    expected = reference.splat(*variables, cells_, border)
    gradients = torch.autograd.grad(expected, variables, torch.tensor(g))
    tangents = [noise(3, *x.shape, dtype=dtype) for x in (positions, rgba)]
    pushed = [
        torch.func.jvp(
            lambda p, c: reference.splat(p, c, cells_, border), tuple(map(torch.tensor, (positions, rgba))), t
        )[1]
        for t in zip(*map(torch.tensor, tangents), strict=True)
    ]
    in_image, in_derivative = TOLERANCE[dtype]
    np.testing.assert_allclose(image, expected.detach(), rtol=0, atol=in_image)
    alone = splats.jvp(tangents[0], None) + splats.jvp(None, tangents[1])
    derivatives = (*gradients, *[torch.stack(pushed)] * 2)
    for found, wanted in zip((*splats.vjp(g), splats.jvp(*tangents), alone), derivatives, strict=True):
        assert found.dtype == dtype
        np.testing.assert_allclose(found, wanted, rtol=0, atol=in_derivative * max(0.1, float(wanted.abs().max())))
    np.testing.assert_array_equal(splats.vjp(g)[0][:, 2], 0)


# ------------------------------------------------------------------------------------------- the specification


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("layers", quick([2, 1, 3, 4]))
@pytest.mark.parametrize("kind", KINDS)
def test_image_vjp_and_jvp_are_those_of_the_specification(kind, layers, dtype):
    for (seed, holes, middle_holes), settings in zip(
        [(0, 0.2, False), (1, 0.02, False), (2, 0.3, True)], SETTINGS, strict=True
    ):
        scene = cells(layers, seed=seed, dtype=dtype, holes=holes, middle_holes=middle_holes)
        check_against_specification(KINDS[kind](**settings), scene, dtype)


@pytest.mark.parametrize("size", quick([((2, 300),), ((1, 1),), ((1, 7),), ((6, 1),), ((40, 129),)], 2), ids=str)
@pytest.mark.parametrize("kind", KINDS)
def test_images_of_any_size_are_those_of_the_specification(kind, size):
    check_against_specification(KINDS[kind](), cells(2, size), np.float64)


@pytest.mark.parametrize("border", [1, 2, 5])
@pytest.mark.parametrize("kind", KINDS)
def test_cells_of_the_border_splat_into_the_image_but_are_no_part_of_it(kind, border):
    scene = cells(3, (17, 141), dtype=np.float32)
    check_against_specification(KINDS[kind](), scene, np.float32, border)
    whole, splatter = KINDS[kind]().splat(*scene), KINDS[kind]()
    np.testing.assert_array_equal(splatter.splat(*scene, border=border), without_border(whole, border))


@pytest.mark.parametrize("kind", KINDS)
def test_smooth_surfaces_over_each_other_are_those_of_the_specification(kind):
    # A dome before a tilted plane, with its far side between them: mostly plain, mixed along the outline and on slopes.
    size = 40, 50
    y, x = np.indices(size)
    square = 16.3**2 - (x - 24.2) ** 2 - (y - 19.6) ** 2
    plane = 30 + 0.3 * x + 0.1 * y
    bulge = np.sqrt(np.maximum(square, 0))
    depth = np.where(square > 0, [25 - bulge, 25 + 0.2 * bulge, plane], [plane, plane, plane])
    row = np.arange(3 * 40 * 50, dtype=np.int32).reshape(3, *size)
    row[1:, square <= 0] = -1
    positions = np.stack([np.broadcast_to(x + 0.5, depth.shape), np.broadcast_to(y + 0.5, depth.shape), depth], axis=-1)
    positions = positions.reshape(-1, 3) + noise(6000, 3) * (1e-3, 1e-3, 0)
    rgba = np.concatenate([np.random.default_rng(0).random((6000, 3)), np.ones((6000, 1))], axis=1)
    for dtype in TOLERANCE:
        scene = positions.astype(dtype), rgba.astype(dtype), row
        check_against_specification(KINDS[kind](), scene, dtype)
    if kind == "visible":
        assert 0.01 < compiled(fused.Visible(), scene).choices.mixed.mean() < 0.5


def discs(off=0.0, alpha=1.0, dtype=np.float64):
    """A red disc before a green one, over nothing; samples that lie off their cells' centres by at most so much."""
    y, x = np.indices((70, 90))
    near, far = np.hypot(x - 40, y - 30) < 22.3, np.hypot(x - 52, y - 40) < 24.8
    row = np.full((2, 70, 90), -1, np.int32)
    row[0, near | far] = np.arange((near | far).sum())
    row[1, near & far] = np.arange((near & far).sum()) + row.max() + 1
    k, y, x = np.nonzero(row >= 0)
    red = (k == 0) & near[y, x]
    places = np.stack([x + 0.5, y + 0.5], axis=1) + np.random.default_rng(3).uniform(-off, off, (len(x), 2))
    positions = np.concatenate([places, np.where(red, 2.0, 5.0)[:, None]], axis=1)
    rgba = np.where(red[:, None], (1, 0, 0, 1), (0, 0.5, 0, 1)) * alpha
    return positions.astype(dtype), rgba.astype(dtype), row


@pytest.mark.parametrize("alpha", [1.0, 0.5])
@pytest.mark.parametrize("off", quick([1e-4, 0.2]))
@pytest.mark.parametrize("kind", quick(KINDS, 2))
def test_plain_colours_are_those_of_the_specification(kind, off, alpha):
    for dtype in TOLERANCE:
        scene = discs(off, alpha, dtype)
        splatter = KINDS[kind]()
        check_against_specification(splatter, scene, dtype)
        check_against_specification(splatter, scene, dtype, border=2)
        # Without the colours' derivatives, which leave nothing to be done inside.
        splats, g = compiled(splatter, scene), noise(70, 90, 4, dtype=dtype)
        np.testing.assert_allclose(splats.vjp(g, (True, False))[0], splats.vjp(g)[0], rtol=0, atol=1e-5)
        moved, still = noise(1, *scene[0].shape, dtype=dtype), np.zeros((1, *scene[1].shape), dtype)
        np.testing.assert_allclose(splats.jvp(moved, None), splats.jvp(moved, still), rtol=0, atol=1e-5)


def test_amid_one_colour_nothing_is_computed_for_positions():
    scene = discs()
    for kind in KINDS:
        states = compiled(KINDS[kind](), scene).choices.states
        assert 0.3 < (states == FLAT).mean() < 0.5 and 0.4 < (states == EMPTY).mean() < 0.7
    # Where layers show through, only the front one alone is the same all around.
    states = {kind: compiled(KINDS[kind](), discs(alpha=0.5)).choices.states for kind in KINDS}
    assert (states["multi"] == FLAT).sum() == 0 < (states["visible"] == FLAT).sum()
    # Weights of samples far off the centres may add up to less than one; those of no ε may, too.
    assert not (compiled(fused.Visible(), discs(off=0.01)).choices.states == FLAT).any()
    assert not (compiled(fused.Visible(epsilon=0.0), scene).choices.states == FLAT).any()
    for sigma in (1.0, 3.0, 10.0):
        # Off by as much as goes for flat, all in the worst way for one target, weights still add up to one.
        splatter = fused.Visible(sigma=sigma, epsilon=0.05, calibration=1.0)
        reach = 0.999 * _reach(Settings("visible", sigma, 0.05, 1.0))
        y, x = np.indices((3, 3)) - 1.0
        places = np.stack([x, y], axis=-1).reshape(-1, 2) * (1 + reach) + 1.5
        ninefold = np.concatenate([places, np.ones((9, 1))], axis=1), np.ones((9, 4)), np.arange(9).reshape(1, 3, 3)
        assert compiled(splatter, ninefold).choices.states[1, 1] == FLAT and reach > 0.01
        assert specification(splatter).splat(*ninefold)[1, 1, 3] == 1
    # NaN is no colour.
    positions, rgba, row = scene
    broken = np.where(np.arange(len(rgba))[:, None] == row[0, 30, 40], np.nan, rgba)
    around = compiled(fused.Visible(), (positions, broken, row)).choices.states[29:32, 39:42]
    np.testing.assert_array_equal(around, BUSY)


@pytest.mark.parametrize("kind", KINDS)
def test_a_sample_in_several_cells_gets_the_sum_of_their_gradients(kind):
    positions, rgba, row = cells(2)
    row[1, 3:5, 4:8] = row[0, 3, 4] = row[0, 0, 0]
    check_against_specification(KINDS[kind](), (positions, rgba, row), np.float64)


@pytest.mark.parametrize("kind", KINDS)
def test_samples_of_no_cell_have_zero_gradients(kind):
    scene = cells(2, spare=50)
    unused = np.setdiff1d(np.arange(len(scene[0])), scene[2])
    for found in compiled(KINDS[kind](), scene).vjp(noise(9, 11, 4)):
        np.testing.assert_array_equal(found[unused], 0)


@pytest.mark.parametrize("kind", KINDS)
def test_gradients_that_are_not_wanted_are_not_computed(kind):
    splats, g = compiled(KINDS[kind](), cells(2)), noise(9, 11, 4)
    both = splats.vjp(g)
    for wanted in ((True, False), (False, True)):
        for found, expected, wish in zip(splats.vjp(g, wanted), both, wanted, strict=True):
            assert found is None if not wish else np.array_equal(found, expected)


@pytest.mark.parametrize("kind", KINDS)
def test_any_layout_of_the_arrays_will_do(kind):
    positions, rgba, row = cells(3)
    splatter = KINDS[kind]()
    expected = splatter.splat(positions, rgba, row)
    strided = np.asfortranarray(row)[:, ::-1][:, ::-1]
    for other in (strided, row.astype(np.int64), row.astype(np.int16)):
        np.testing.assert_array_equal(splatter.splat(np.asfortranarray(positions), rgba[::-1][::-1], other), expected)


# ------------------------------------------------------------------------------------------------- robustness


@pytest.mark.parametrize("kind", KINDS)
def test_rows_beyond_the_samples_are_refused(kind):
    positions, rgba, row = cells(2)
    row[0, 0, 0] = len(positions)
    for scene in ((positions, rgba, row), tuple(map(torch.tensor, (positions, rgba, row)))):
        with pytest.raises(rts.InputError, match=f"row refers to sample {len(positions)} of {len(positions)}"):
            KINDS[kind]().splat(*scene)


@pytest.mark.parametrize("name", ["part", "facing", "exit", "wanted", "settled"])
def test_what_is_told_of_other_cells_is_refused(name):
    positions, rgba, row = cells(2)
    other = np.zeros(row.shape if name in ("part", "facing", "exit") else row.shape[1:], np.int32)[..., :-1]
    with pytest.raises(rts.InputError, match=rf"{name} has shape .*; expected .*, as row says"):
        KINDS["visible"]().image(splats_of(positions, rgba, row, **{name: other}))


@pytest.mark.parametrize("kind", KINDS)
def test_one_sample_that_is_nan_spoils_its_neighbourhood_alone(kind):
    positions, rgba, row = cells(2, holes=0)
    positions[row[0, 4, 5]] = np.nan
    splats = compiled(KINDS[kind](), (positions, rgba, row))
    spoiled = np.zeros((9, 11), bool)
    spoiled[3:6, 4:7] = True
    assert np.isfinite(splats.image()[~spoiled]).all()
    splats.vjp(noise(9, 11, 4))
    splats.jvp(noise(1, *positions.shape), None)


@pytest.mark.parametrize("size", [(0, 5), (5, 0)], ids=str)
@pytest.mark.parametrize("kind", KINDS)
def test_images_of_no_pixels(kind, size):
    positions, rgba = np.ones((3, 3)), np.ones((3, 4))
    splats = compiled(KINDS[kind](), (positions, rgba, np.zeros((2, *size), np.int32)))
    assert splats.image().shape == (*size, 4)
    assert splats.jvp(positions[None], None).shape == (1, *size, 4)
    np.testing.assert_array_equal(splats.vjp(np.zeros((*size, 4)))[0], 0)


# ------------------------------------------------------------------------------------------------ determinism


@pytest.mark.parametrize("kind", KINDS)
def test_results_are_bitwise_the_same_on_any_number_of_threads(kind, monkeypatch):
    scene = cells(3, (70, 150), dtype=np.float32)
    g, tangents = noise(70, 150, 4, dtype=np.float32), noise(2, *scene[0].shape, dtype=np.float32)

    def everything():
        splats = compiled(KINDS[kind](), scene)
        return *splats.vjp(g), splats.image(), splats.jvp(tangents, None)

    monkeypatch.setenv("RTS_NUM_THREADS", "1")
    expected = everything()
    for threads in "1222357":
        monkeypatch.setenv("RTS_NUM_THREADS", threads)
        for found, known in zip(everything(), expected, strict=True):
            np.testing.assert_array_equal(found, known)


def test_a_step_at_512_needs_little_memory():
    size, layers = (512, 512), 2
    positions, rgba, row = cells(layers, size, dtype=np.float32, holes=0, spare=0)
    g = np.ones((*size, 4), np.float32)
    compiled(fused.Visible(), (positions, rgba, row)).vjp(g)
    tracemalloc.start()
    splats = compiled(fused.Visible(), (positions, rgba, row))
    image, gradients = splats.image(), splats.vjp(g)
    results, (_, peak) = image.nbytes + sum(x.nbytes for x in gradients), tracemalloc.get_traced_memory()
    tracemalloc.stop()
    mixed = splats.choices.mixed.mean()
    print(f"{100 * mixed:.0f} % mixed: peak {peak / 2**20:.1f} MiB, of which results {results / 2**20:.1f} MiB")
    assert mixed > 0.9 and peak < 100 * 2**20  # The worst case: random depths.


# ------------------------------------------------------------------------------------------------------ torch


@pytest.fixture(scope="module")
def smooth():
    """A scalar and an image of six parameters that move and tint every sample, and their value."""
    positions, rgba, row = map(torch.tensor, cells(3, (4, 5), seed=1))
    moves, tints = torch.tensor(noise(6, *positions.shape)), torch.tensor(noise(6, *rgba.shape, seed=8))
    weights = torch.tensor(noise(4, 5, 4, seed=9))

    def image(splatter, x):
        return splatter.splat(
            positions + torch.einsum("i,ijk->jk", x, moves), rgba + torch.einsum("i,ijk->jk", x, tints), row
        )

    def loss(splatter, x):
        return (image(splatter, x) ** 2 * weights).sum()

    return image, loss, torch.tensor(noise(6, seed=3)) * 0.05


def batch(x):
    return x[:, None] * torch.eye(len(x), dtype=x.dtype)


def twice(loss):
    """The gradient of the gradient's square, by plain autograd."""

    def call(s, x):
        x = x.clone().requires_grad_()
        (slope,) = torch.autograd.grad(loss(s, x), x, create_graph=True)
        return torch.autograd.grad((slope**2).sum(), x)[0]

    return call


def forward_over_reverse(loss):
    """The gradient's tangent, by dual numbers over plain autograd."""

    def call(s, x):
        with torch.autograd.forward_ad.dual_level():
            dual = torch.autograd.forward_ad.make_dual(x.clone().requires_grad_(), x + 1)
            (slope,) = torch.autograd.grad(loss(s, dual), dual, create_graph=True)
            return torch.autograd.forward_ad.unpack_dual(slope).tangent.detach()

    return call


f = torch.func
TRANSFORMS = {
    "grad": lambda image, loss: lambda s, x: f.grad(lambda x: loss(s, x))(x),
    "vjp": lambda image, loss: lambda s, x: f.vjp(lambda x: image(s, x), x)[1](torch.ones(4, 5, 4, dtype=x.dtype))[0],
    "jvp": lambda image, loss: lambda s, x: f.jvp(lambda x: image(s, x), (x,), (x + 1,))[1],
    "jacfwd": lambda image, loss: lambda s, x: f.jacfwd(lambda x: image(s, x))(x),
    "jacrev": lambda image, loss: lambda s, x: f.jacrev(lambda x: image(s, x)[1])(x),
    "vmap": lambda image, loss: lambda s, x: f.vmap(lambda x: image(s, x))(batch(x)),
    "vmap of grad": lambda image, loss: lambda s, x: f.vmap(f.grad(lambda x: loss(s, x)))(batch(x)),
    "grad of vmap": lambda image, loss: lambda s, x: f.grad(lambda x: f.vmap(lambda x: loss(s, x))(batch(x)).sum())(x),
    "vmap of jacfwd": lambda image, loss: lambda s, x: f.vmap(f.jacfwd(lambda x: image(s, x)))(batch(x)),
    "hessian": lambda image, loss: lambda s, x: f.hessian(lambda x: loss(s, x))(x),
    "jacrev of jacrev": lambda image, loss: lambda s, x: f.jacrev(f.jacrev(lambda x: loss(s, x)))(x),
    "jacrev of jacfwd": lambda image, loss: lambda s, x: f.jacrev(f.jacfwd(lambda x: loss(s, x)))(x),
    "jacfwd of jacfwd": lambda image, loss: lambda s, x: f.jacfwd(f.jacfwd(lambda x: loss(s, x)))(x),
    "create_graph": lambda image, loss: twice(loss),
    "dual numbers of grad": lambda image, loss: forward_over_reverse(loss),
    "is_grads_batched": lambda image, loss: (
        lambda s, x: torch.autograd.functional.jacobian(lambda x: image(s, x), x, vectorize=True)
    ),
    "vectorized forward mode": lambda image, loss: (
        lambda s, x: torch.autograd.functional.jacobian(
            lambda x: image(s, x), x, vectorize=True, strategy="forward-mode"
        )
    ),
}


@pytest.mark.parametrize("name", TRANSFORMS)
@pytest.mark.parametrize("kind", quick(reversed(KINDS)))
def test_torch_transforms_are_those_of_the_specification(kind, name, smooth):
    image, loss, x = smooth
    splatter = KINDS[kind]()
    call = TRANSFORMS[name](image, loss)
    found, expected = call(splatter, x), call(specification(splatter), x)
    assert torch.isfinite(expected).all() and expected.abs().max() > 1e-3
    torch.testing.assert_close(found, expected, rtol=1e-10, atol=1e-10)


def test_vmap_over_rows_and_colors():
    positions, rgba, row = map(torch.tensor, cells(2))
    rows, tints = torch.stack([row, row.flip(1), row.flip(2)]), torch.linspace(0, 1, 3, dtype=rgba.dtype)
    splatter = fused.Visible()
    found = f.vmap(lambda r, t: splatter.splat(positions, rgba * t, r))(rows, tints)
    expected = [splatter.splat(positions, rgba * t, r) for r, t in zip(rows, tints, strict=True)]
    torch.testing.assert_close(found, torch.stack(expected), rtol=0, atol=0)


@pytest.mark.parametrize("kind", KINDS)
def test_finite_differences_agree(kind):
    positions, rgba, row = map(torch.tensor, cells(2, (4, 5)))
    where = positions[:, :2].clone().requires_grad_()

    # The derivative of coverage with rims is not that of the image's own weights.
    splatter = fused.Visible(rims=False) if kind == "visible" else KINDS[kind]()

    def image(where, rgba):
        return splatter.splat(torch.cat([where, positions[:, 2:]], dim=1), rgba, row)

    given = where, rgba.requires_grad_()
    assert torch.autograd.gradcheck(image, given, check_forward_ad=True, check_undefined_grad=False)


def test_one_sweep_pushes_all_columns_of_a_jacobian(smooth, monkeypatch):
    image, loss, x = smooth
    calls = []
    for name in ("image", "vjp", "jvp"):
        method = getattr(Cells, name)
        monkeypatch.setattr(Cells, name, lambda *args, name=name, method=method: (calls.append(name), method(*args))[1])
    f.jacfwd(lambda x: image(fused.Visible(), x))(x)
    assert sorted(calls) == ["image", "jvp"]
    calls.clear()
    f.grad(lambda x: loss(fused.Visible(), x))(x)
    assert sorted(calls) == ["image", "vjp"]


def test_changing_samples_before_the_backward_pass_is_noticed():
    positions, rgba, row = map(torch.tensor, cells(2))
    moved = positions.requires_grad_() * 1
    image = fused.Visible().splat(moved, rgba, row)
    with torch.no_grad():
        moved += 1
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        image.sum().backward()


# ---------------------------------------------------------------------------------------- who computes, and where


@pytest.mark.parametrize("name, kind", [(k, k) for k in KINDS])
def test_the_splatters_by_name_are_the_compiled_ones(name, kind):
    assert rts.plugin("rts.splatters", name) is KINDS[kind]
    assert repr(KINDS[kind]()) == repr(specification(KINDS[kind]()))


@pytest.mark.parametrize("target", TORCH)
@pytest.mark.parametrize("kind", KINDS)
def test_torch_gets_the_gradient_of_the_specification(kind, target):
    positions, rgba, row = cells(2)
    weights = arrays(target, noise(9, 11, 4))
    row = arrays(target, row)
    given = arrays(target, {"positions": positions, "rgba": rgba})
    splatter = KINDS[kind]()
    found, expected = (
        gradient(target, lambda t, s=s: (s.splat(t["positions"], t["rgba"], row) * weights).sum(), given)
        for s in (splatter, specification(splatter))
    )
    for name in given:
        np.testing.assert_allclose(found[name], expected[name], rtol=0, atol=1e-4)


@pytest.mark.parametrize(
    "dtypes",
    [*itertools.product([torch.float16, torch.float32], [torch.float16, torch.float64]), (torch.bfloat16,) * 2],
    ids=str,
)
def test_other_dtypes_are_left_to_the_specification(dtypes):
    positions, rgba, row = map(torch.tensor, cells(2))
    scene = positions.to(dtypes[0]), rgba.to(dtypes[1]), row
    found, expected = fused.Visible().splat(*scene), splatting.Visible().splat(*scene)
    assert found.dtype == expected.dtype
    torch.testing.assert_close(found, expected, rtol=0, atol=0)


def test_other_devices_are_left_to_the_specification():
    # Tensors without values stand for those of a device that is not at hand.
    scene = (torch.tensor(x).to("meta") for x in cells(2))
    image = fused.Visible().image(splats_of(*scene))
    assert image.device.type == "meta" and image.shape == (9, 11, 4)


def test_numpy_of_two_dtypes_is_left_to_the_specification():
    positions, rgba, row = cells(2)
    found = fused.Multi().splat(positions, rgba.astype(np.float32), row)
    np.testing.assert_array_equal(found, splatting.Multi().splat(positions, rgba.astype(np.float32), row))


def test_no_torch_and_no_numba_is_loaded_in_vain():
    code = (
        "import sys, rts\nassert 'numba' not in sys.modules\nimport numpy as np\n"
        "scene = np.ones((1, 3)), np.ones((1, 4)), np.zeros((1, 2, 2), int)\n"
        "image = rts.plugin('splatters', 'visible')().splat(*scene)\n"
        "assert image.shape == (2, 2, 4) and 'numba' in sys.modules\n"
        "assert not {'torch', 'jax'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_the_image_of_numpy_is_that_of_torch():
    scene = cells(3, dtype=np.float32)
    found = fused.Visible().splat(*map(torch.tensor, scene))
    np.testing.assert_array_equal(to_numpy(found), fused.Visible().splat(*scene))
