"""Splatters against closed forms, and against plain loops written from the definition of the method."""

import math

import numpy as np
import pytest
from helpers import ALL, TORCH, arrays, derivative, finite_difference, gradient, icosphere, to_numpy

import rts
from rts.splatting import Multi, Plain, Single, exact_calibration

pytestmark = pytest.mark.splatting

PLAIN = ["numpy", *TORCH]
"""Closed forms are met in these; that array code is one for all engines is tried once, against the loops."""

E2 = math.exp(-2)
KERNELS = {"single": Single, "multi": Multi}


def dense(height, width, layers=1, depth=5.0):
    """Positions (N, 3) at the pixel centres, and row (K, H, W), of a grid whose first layer is full."""
    rows, columns = np.indices((height, width))
    positions = np.stack([columns + 0.5, rows + 0.5, np.full_like(rows, depth, np.float64)], -1).reshape(-1, 3)
    row = np.full((layers, height, width), -1, np.int32)
    row[0] = np.arange(height * width).reshape(height, width)
    return positions, row


def white(positions):
    return np.ones((len(positions), 4))


def along_x(target, splatter, positions, rgba, row):
    """The image and its derivative where every splat moves along +x."""
    where, color, cells = arrays(target, (positions, rgba, row))
    direction = arrays(target, np.broadcast_to([1.0, 0.0, 0.0], positions.shape))
    return derivative(target, lambda p: splatter.splat(p, color, cells), where, direction)


# -------------------------------------------------------------------------------- the method, in plain loops


def pairing(here, there):
    """The number s of a source with depths `here` at a target with depths `there`."""
    a = [abs(z - there[0]) for z in here]
    b = [abs(z - here[0]) for z in there]
    return -b.index(min(b)) if min(b) < min(a) else a.index(min(a))


def splat_by_loops(positions, rgba, row, sigma=0.5, epsilon=0.05, calibration=1.0):
    """Three accumulation buffers, one scalar at a time, from the definition."""
    layers, height, width = row.shape
    offsets = [(u, v) for v in (-1, 0, 1) for u in (-1, 0, 1)]
    total = sum(math.exp(-(u * u + v * v) / (2 * sigma**2)) for u, v in offsets)
    seen = [0.0, *(positions[i, 2] for i in row.ravel() if i >= 0)]
    beyond = 2 * (max(seen) - min(seen)) or 1.0
    buffers = np.zeros((3, height, width, 5))

    def depths(y, x):
        return [positions[i, 2] if i >= 0 else beyond for i in row[:, y, x]]

    for ty, tx in np.ndindex(height, width):
        for u, v in offsets:
            y, x = ty - v, tx - u
            if not (0 <= y < height and 0 <= x < width):
                continue
            s = pairing(depths(y, x), depths(ty, tx))
            for k, i in enumerate(row[:, y, x]):
                if i < 0:
                    continue
                dx, dy = (calibration * (positions[i, axis] - c - 0.5) for axis, c in enumerate((x, y)))
                w = (1 + epsilon) / total * math.exp(-((u - dx) ** 2 + (v - dy) ** 2) / (2 * sigma**2))
                buffers[0 if k < s else 1 if k == s else 2, ty, tx] += w * np.array([*rgba[i], 1.0])
    front, surface, behind = (b[..., :4] / np.maximum(1, b[..., 4:]) for b in buffers)
    back = surface + (1 - surface[..., 3:]) * behind
    return front + (1 - front[..., 3:]) * back


def random_scene(layers, height=5, width=6, seed=0, holes=0.3, middle_holes=False):
    """Positions, colours and rows with empty cells, equal depths and semi-transparent colours."""
    rng = np.random.default_rng(seed)
    depth = np.sort(rng.integers(4, 16, (layers, height, width)) / 4, axis=0)  # Quarters: ties are exact.
    depth = np.where(rng.random((height, width)) < 0.1, depth[:1], depth)
    filled = rng.random((layers, height, width)) >= holes
    if not middle_holes:
        filled = np.logical_and.accumulate(filled, axis=0)
    k, y, x = np.nonzero(filled)
    order = rng.permutation(len(k))
    row = np.full(filled.shape, -1, np.int32)
    row[k[order], y[order], x[order]] = np.arange(len(k))
    k, y, x = k[order], y[order], x[order]
    jitter = rng.uniform(-0.3, 0.3, (2, len(k)))
    positions = np.stack([x + 0.5 + jitter[0], y + 0.5 + jitter[1], depth[k, y, x]], axis=-1)
    alpha = np.where(rng.random(len(k)) < 0.3, 1.0, rng.random(len(k)))
    rgba = np.concatenate([rng.random((len(k), 3)), np.ones((len(k), 1))], axis=1) * alpha[:, None]
    return positions, rgba, row


@pytest.mark.parametrize("target", ALL)
@pytest.mark.parametrize("layers, middle_holes", [(1, False), (2, False), (3, False), (4, False), (3, True)])
def test_multi_is_the_loop_written_from_the_definition(target, layers, middle_holes):
    for seed in range(3):
        scene = random_scene(layers, seed=seed, middle_holes=middle_holes)
        found = to_numpy(Multi().splat(*arrays(target, scene)))
        np.testing.assert_allclose(found, splat_by_loops(*scene), rtol=0, atol=1e-5)


@pytest.mark.parametrize("target", TORCH)
def test_gradients_are_the_finite_differences_of_the_loop(target):
    positions, rgba, row = random_scene(2, 3, 4)
    weights = np.random.default_rng(1).normal(size=(3, 4, 4))
    given = {"xy": positions[:, :2], "rgba": rgba}

    def by_loops(tree):
        where = np.concatenate([tree["xy"], positions[:, 2:]], axis=1)
        return (splat_by_loops(where, tree["rgba"], row) * weights).sum()

    z, cells, w = arrays(target, (positions[:, 2:], row, weights))

    def f(tree):
        concat = rts.namespace(z).concat
        return (Multi().splat(concat([tree["xy"], z], axis=1), tree["rgba"], cells) * w).sum()

    found, expected = gradient(target, f, arrays(target, given)), finite_difference(by_loops, given)
    for name in given:
        np.testing.assert_allclose(found[name], expected[name], rtol=0, atol=2e-5, err_msg=name)


@pytest.mark.parametrize("target", PLAIN)
def test_two_cells_two_layers_by_hand(target):
    # Cell p has layers A at depth 2 and B at depth 3; its neighbour q has C at depth 3.
    # At q, p's second layer continues q's surface (A_1 = 0): A splats in front, B with C at the surface.
    # At p, q's front layer continues p's second layer (B_1 = 0 < A_0 = 1): C splats behind, with B.
    a, b, c = np.array([[1, 0, 0, 1], [0, 0.5, 0, 0.5], [0, 0, 1, 1]], np.float64)
    positions = np.array([(0.5, 0.5, 2), (0.5, 0.5, 3), (1.5, 0.5, 3)])
    row = np.array([[[0, 2]], [[1, -1]]], np.int32)
    near = 1.05 / (1 + 2 * E2) ** 2
    far = near * E2
    at_p = near * a + (1 - near) * (near * b + far * c)
    at_q = far * a + (1 - far) * (near * c + far * b)
    found = to_numpy(Multi().splat(*arrays(target, (positions, np.stack([a, b, c]), row))))
    np.testing.assert_allclose(found[0], [at_p, at_q], rtol=0, atol=1e-6)


# --------------------------------------------------------------------------------------------- closed forms


@pytest.mark.parametrize("sigma, reach", [(0.4, 1), (0.5, 1), (0.7, 1), (0.8, 2), (1.5, 3)])
def test_the_exact_calibration_is_the_first_moment_of_the_kernels_derivative(sigma, reach):
    # Moment of −u ∂w/∂P at P = c, by differences of the weights as written in the definition.
    cells = range(-reach, reach + 1)

    def weight(u, p):
        return math.exp(-((u - p) ** 2) / (2 * sigma**2)) / sum(math.exp(-(i**2) / (2 * sigma**2)) for i in cells)

    moment = sum(u * (weight(u, 1e-6) - weight(u, -1e-6)) / 2e-6 for u in cells)
    assert exact_calibration(sigma, reach) * moment == pytest.approx(1, abs=1e-8)
    assert exact_calibration(sigma) == exact_calibration(sigma, 1)


@pytest.mark.parametrize("target", TORCH)
@pytest.mark.parametrize("name", KERNELS)
def test_with_the_exact_calibration_a_ramp_is_felt_whole_and_an_edge_with_the_excess_of_weights(name, target):
    positions, row = dense(7, 16)
    rgba = white(positions)
    rgba[:, 0] = 0.1 + 0.05 * positions[:, 0]
    splatter = KERNELS[name](calibration=None)
    _, slope = along_x(target, splatter, positions, rgba, row)
    np.testing.assert_allclose(slope[3, 2:-2, 0] / -0.05, 1, atol=1e-4)
    row[0, :, 8:] = -1
    _, slope = along_x(target, splatter, positions, white(positions), row)
    assert slope[3, 5:11, 3].sum() == pytest.approx(1 + splatter.epsilon, abs=1e-4)


@pytest.mark.parametrize("target", TORCH)
@pytest.mark.parametrize("layers", [1, 2])
@pytest.mark.parametrize("name", KERNELS)
def test_a_translating_edge_is_felt_at_0_894_of_its_derivative(name, layers, target):
    positions, row = dense(7, 16, layers)
    row[0, :, 8:] = -1
    _, slope = along_x(target, KERNELS[name](), positions, white(positions), row)
    expected = 8 * 1.05 * E2 / (1 + 2 * E2)
    assert expected == pytest.approx(0.8947, abs=1e-4)
    assert slope[3, 5:11, 3].sum() == pytest.approx(expected, abs=1e-4)


@pytest.mark.parametrize("sigma, epsilon", [(0.4, 0.0), (0.5, 0.001), (0.7, 0.02)])
def test_the_edge_derivative_follows_sigma_and_epsilon(sigma, epsilon):
    positions, row = dense(7, 16)
    row[0, :, 8:] = -1
    _, slope = along_x(TORCH[0], Single(sigma, epsilon), positions, white(positions), row)
    e = math.exp(-1 / (2 * sigma**2))
    assert slope[3, 5:11, 3].sum() == pytest.approx(2 * (1 + epsilon) * e / (sigma**2 * (1 + 2 * e)), abs=1e-4)


@pytest.mark.parametrize("target, sigma", [*((t, 0.5) for t in TORCH), (TORCH[0], 0.4), (TORCH[0], 0.7)])
@pytest.mark.parametrize("name", KERNELS)
def test_a_translating_ramp_is_felt_at_the_first_moment_of_the_kernel(name, target, sigma):
    positions, row = dense(7, 16)
    rgba = white(positions) * [0.0, 0.5, 1.0, 1.0]
    rgba[:, 0] = 0.1 + 0.05 * positions[:, 0]
    image, slope = along_x(target, KERNELS[name](sigma=sigma), positions, rgba, row)
    e = math.exp(-1 / (2 * sigma**2))
    gain = 2 * e / (sigma**2 * (1 + 2 * e))
    if sigma == 0.5:
        assert gain == pytest.approx(0.852, abs=1e-4)
    np.testing.assert_allclose(image[3, 2:-2, 0], (0.1 + 0.05 * (np.arange(16) + 0.5))[2:-2], atol=1e-6)
    np.testing.assert_allclose(slope[3, 2:-2, 0] / -0.05, gain, atol=1e-4)
    np.testing.assert_allclose(slope[3, 2:-2, 1:], 0, atol=1e-6)


@pytest.mark.parametrize("target", PLAIN)
@pytest.mark.parametrize("name", KERNELS)
def test_cells_outside_the_array_emit_nothing(name, target):
    positions, row = dense(5, 6)
    image = to_numpy(KERNELS[name]().splat(*arrays(target, (positions, white(positions), row))))
    side = 1.05 * (1 + E2) / (1 + 2 * E2)
    np.testing.assert_allclose(image[0, 1:-1], side, atol=1e-6)
    np.testing.assert_allclose(image[1:-1, -1], side, atol=1e-6)
    corner = 1.05 * ((1 + E2) / (1 + 2 * E2)) ** 2
    np.testing.assert_allclose(image[[0, 0, -1, -1], [0, -1, 0, -1]], corner, atol=1e-6)


# ------------------------------------------------------------------------------------------------ robustness


@pytest.mark.parametrize("target", PLAIN)
@pytest.mark.parametrize("name", [*KERNELS, "none"])
@pytest.mark.parametrize("count", [0, 1])
def test_no_covered_cell_gives_zeros(name, target, count):
    splatter = rts.plugin("splatters", name)()
    given = np.ones((count, 3)), np.ones((count, 4)), np.full((2, 3, 5), -1, np.int32)
    image = to_numpy(splatter.splat(*arrays(target, given)))
    assert image.shape == (3, 5, 4) and image.dtype == np.float32
    np.testing.assert_array_equal(image, 0)


@pytest.mark.parametrize("target", TORCH)
@pytest.mark.parametrize("name", [*KERNELS, "none"])
def test_no_covered_cell_gives_zero_gradients(name, target):
    splatter = rts.plugin("splatters", name)()
    given = {"positions": np.ones((1, 3)), "rgba": np.ones((1, 4))}
    row = arrays(target, np.full((2, 3, 5), -1, np.int32))
    found = gradient(target, lambda t: splatter.splat(t["positions"], t["rgba"], row).sum(), arrays(target, given))
    np.testing.assert_array_equal(found["positions"], 0)
    np.testing.assert_array_equal(found["rgba"], 0)


@pytest.mark.parametrize("target", PLAIN)
@pytest.mark.parametrize("scale", [2.0**-40, 2.0**40])
def test_the_unit_of_depth_does_not_matter(target, scale):
    positions, rgba, row = random_scene(3)
    expected = Multi().splat(positions, rgba, row)
    found = to_numpy(Multi().splat(*arrays(target, (positions * (1, 1, scale), rgba, row))))
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-5)


@pytest.mark.parametrize("depth", [0.0, -3.0])
def test_depths_that_are_not_positive_give_finite_images(depth):
    positions, row = dense(4, 5, layers=2, depth=depth)
    row[0, :, 3:] = -1
    image = Multi().splat(positions, white(positions), row)
    assert np.isfinite(image).all() and image[1, 1, 3] == pytest.approx(1)


@pytest.mark.parametrize("target", TORCH)
def test_depth_has_no_derivative(target):
    positions, rgba, row = random_scene(2)
    where, color, cells = arrays(target, (positions, rgba, row))
    found = gradient(target, lambda p: (Multi().splat(p, color, cells) ** 2).sum(), where)
    np.testing.assert_array_equal(found[:, 2], 0)
    assert np.abs(found[:, :2]).max() > 0.1 and np.isfinite(found).all()


# --------------------------------------------------------------------------------------------------- plain


@pytest.mark.parametrize("target", PLAIN)
def test_none_composites_the_layers_front_to_back(target):
    positions, rgba, row = random_scene(3)
    expected = np.zeros((5, 6, 4))
    for y, x in np.ndindex(5, 6):
        through = 1.0
        for k in range(3):
            if row[k, y, x] >= 0:
                expected[y, x] += through * rgba[row[k, y, x]]
                through *= 1 - rgba[row[k, y, x], 3]
    found = to_numpy(Plain().splat(*arrays(target, (positions, rgba, row)), opaque=False))
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6)


@pytest.mark.parametrize("target", TORCH)
def test_none_has_a_gradient_in_colour_and_none_in_position(target):
    positions, row = dense(2, 3)
    cells = arrays(target, row)
    given = arrays(target, {"positions": positions, "rgba": white(positions)})
    found = gradient(target, lambda t: Plain().splat(t["positions"], t["rgba"], cells)[..., 0].sum(), given)
    np.testing.assert_array_equal(found["positions"], 0)
    np.testing.assert_array_equal(found["rgba"], np.broadcast_to([1, 0, 0, 0], (6, 4)))


# -------------------------------------------------------------------------------------------------- errors


@pytest.mark.parametrize("kernel", KERNELS.values(), ids=KERNELS)
@pytest.mark.parametrize(
    "name, value",
    [
        *(("sigma", x) for x in (0, -1.0, math.nan, math.inf)),
        *(("epsilon", x) for x in (-0.1, math.nan, math.inf)),
        *(("calibration", x) for x in (0, -1.0, math.nan, math.inf)),
    ],
)
def test_bad_settings_are_refused_by_name_and_value(kernel, name, value):
    with pytest.raises(rts.InputError, match=f"{name} is {value}; expected"):
        kernel(**{name: value})


@pytest.mark.parametrize("name", [*KERNELS, "none"])
@pytest.mark.parametrize(
    "shapes",
    [
        ((5, 2), (5, 4), (1, 3, 3)),
        ((5, 3), (5, 3), (1, 3, 3)),
        ((5, 3), (4, 4), (1, 3, 3)),
        ((5, 3), (5, 4), (3, 3)),
        ((5, 3), (5, 4), (0, 3, 3)),
    ],
    ids=str,
)
def test_wrong_shapes_are_refused_with_those_expected(name, shapes):
    positions, rgba, row = (np.zeros(s) for s in shapes)
    with pytest.raises(rts.InputError) as error:
        rts.plugin("splatters", name)().splat(positions, rgba, row.astype(np.int32))
    for text in (*map(str, shapes), "(N, 3)", "(N, 4)", "(K, H, W)"):
        assert text in str(error.value)


def test_visible_is_a_name_of_edges_that_warns():
    part = rts.Mesh.example()
    with pytest.warns(DeprecationWarning, match="'visible' is deprecated and goes in rts 0.4; take 'edges'"):
        image = rts.render(part, rts.Camera.look_at((2, 1, 3), (0, 0, 0)), (8, 9), splatter="visible")
    np.testing.assert_array_equal(image, rts.render(part, rts.Camera.look_at((2, 1, 3), (0, 0, 0)), (8, 9)))


# ----------------------------------------------------------------------------------- curved silhouettes


def disk_motion(height, width, center, radius, scanlines=64):
    """The exact derivative (H, W) of a disk's coverage of each pixel as the disk moves along +x."""
    slope = np.zeros((height, width))
    for y in (np.arange(height * scanlines) + 0.5) / scanlines:
        half = radius**2 - (y - center[1]) ** 2
        if half > 0:
            slope[int(y), int(center[0] + math.sqrt(half))] += 1 / scanlines
            slope[int(y), int(center[0] - math.sqrt(half))] -= 1 / scanlines
    return slope


def gain_of_disk(splatter):
    """The share of a translating disk's derivative that a splatter has, both low-passed by 2 pixels."""
    from scipy.ndimage import gaussian_filter

    center, radius = (48.3, 47.9), 37.0
    positions, row = dense(96, 96)
    outside = np.hypot(positions[:, 0] - center[0], positions[:, 1] - center[1]) > radius
    row[0][outside.reshape(96, 96)] = -1
    _, slope = along_x(TORCH[0], splatter, positions, white(positions), row)
    splatted = gaussian_filter(slope[..., 3].astype(np.float64), 2)
    exact = gaussian_filter(disk_motion(96, 96, center, radius), 2)
    return (splatted * exact).sum() / (exact**2).sum()


@pytest.mark.parametrize("name", KERNELS)
def test_a_translating_disk_is_felt_at_about_0_87_of_its_derivative(name):
    gain = gain_of_disk(KERNELS[name]())
    print(f"{name}: gain {gain:.4f} of a disk of radius 37 px at sigma 0.5, epsilon 0.05")
    assert 0.84 < gain < 0.90


def test_the_gain_of_a_disk_depends_on_sigma_as_measured():
    gains = {sigma: gain_of_disk(Single(sigma=sigma)) for sigma in (0.35, 0.4, 0.6, 0.7)}
    print("gain by sigma:", {s: round(g, 4) for s, g in gains.items()})
    assert gains[0.35] < gains[0.4] < gain_of_disk(Single())


@pytest.mark.parametrize("target", TORCH)
@pytest.mark.parametrize("splatter, low, high", [("multi", 0.82, 0.89), ("edges", 0.99, 1.01)])
def test_the_area_of_a_sphere_grows_with_its_circumference(splatter, low, high, target):
    # Orthographic, one world unit a pixel: sum(alpha) is π r², its derivative 2 π r. Of it `multi` feels what it feels
    # of any edge, less a percent: the samples of the rim lie up to a pixel inside and grow less.
    vertices, faces = icosphere(4)
    mesh = rts.plugin("surfaces", "mesh")(faces)
    camera = rts.Camera.orthographic((0, 0, 100), (0, 0, 0), height=128)
    unit = arrays(target, vertices)

    def area(radius):
        part = rts.Part(mesh, {"vertices": unit * radius}, cull="back")
        return rts.render(part, camera, (128, 128), splatter=splatter)[..., 3].sum()

    slope = gradient(target, area, arrays(target, np.array(60.0)))
    assert low < slope / (2 * math.pi * 60) < high
