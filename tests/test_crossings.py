"""Lines where surfaces pass through one another move as their depths say: closed forms, and decisions."""

import math

import numpy as np
import pytest
from helpers import DIFFERENTIABLE, arrays, derivative, gradient, icosphere, low_passed, mesh_part, quad, splats_of

import rts
from rts.arrays.engines import constants, engine_of
from rts.rendering import settings
from rts.splatting import Visible, crossings
from rts_backends.fused import splatters as fused
from rts_compare import scene_shapes
from rts_surfaces.implicit import fields

pytestmark = pytest.mark.splatting

BOTH = [Visible, fused.Visible]


class Sheets:
    """Sheets z = f(x, y) over the cells' centres, the nearest two or more of which are layers.

    Attributes:
        splats: opaque, in one colour and of one part a sheet.
        sheet: (N,), whose each sample is.
    """

    def __init__(self, size, *depths, colors=None, covered=None, dtype=np.float64, off=None):
        y, x = (i + 0.5 for i in np.indices(size))
        depth = np.stack([np.broadcast_to(z(x, y), size) for z in depths])
        sheet = np.argsort(depth, axis=0, kind="stable")
        depth = np.take_along_axis(depth, sheet, axis=0)
        covered = np.ones(depth.shape, bool) if covered is None else covered
        colors = np.random.default_rng(0).random((len(depths), 3)) if colors is None else np.array(colors)
        place = np.stack([np.broadcast_to(c, depth.shape) for c in (x, y)], axis=-1)
        place = place if off is None else place + off
        row = np.where(covered, np.cumsum(covered).reshape(covered.shape) - 1, -1).astype(np.int32)
        positions = np.concatenate([place, depth[..., None]], axis=-1)[covered].astype(dtype)
        rgba = np.concatenate([colors[sheet], np.ones((*depth.shape, 1))], axis=-1)[covered].astype(dtype)
        part = np.where(covered, sheet, -1).astype(np.int32)
        self.splats, self.sheet = splats_of(positions, rgba, row, part), sheet[covered]
        self.depth, self.covered = np.where(covered, depth, 0).astype(dtype), covered

    def pairs(self):
        two = self.covered[0] & self.covered[1]
        first, second = np.where(two, self.depth[:2], 0)
        return crossings.pairs(first, second, two, self.depth.dtype.type(np.abs(self.depth).max()))


def plane(slope_x, slope_y, depth):
    return lambda x, y: slope_x * x + slope_y * y + depth


def pushed(splatter, splats, t_positions, t_rgba=None, target="torch-cpu", dtype=np.float64):
    """The image and its derivative along tangents."""
    positions, rgba, tangent = arrays(target, (splats.positions, splats.rgba, t_positions), dtype)
    row, part = arrays(target, (splats.row, splats.part))
    t_rgba = arrays(target, np.zeros_like(splats.rgba) if t_rgba is None else t_rgba, dtype)
    image = lambda x: splatter.image(splats.replace(positions=x[0], rgba=x[1], row=row, part=part))  # noqa: E731
    return derivative(target, image, (positions, rgba), (tangent, t_rgba))


def pulled(splatter, splats, along, target="torch-cpu"):
    """The gradients of positions and colours from that of the image, in float64."""
    own, tables = (splats.positions, splats.rgba), (splats.row, splats.part)
    given, tables, along = arrays(target, (own, tables, along), np.float64)
    return gradient(target, lambda x: (splatter.image(splats_of(*x, *tables)) * along).sum(), given)


def rough(seed, size=(20, 23), layers=2):
    """Sheets that cross, bent, noisy and with holes, of samples that are off their cells' centres."""
    rng = np.random.default_rng(seed)
    slopes, bend = rng.normal(0, 0.5, (layers, 2)), rng.normal(0, 0.02, layers)
    cx, cy = rng.uniform(8, 14, 2)

    def sheet(i):
        depth = 10 + max(0, i - 1) * 3
        return lambda x, y: depth + slopes[i, 0] * (x - cx) + slopes[i, 1] * (y - cy) + bend[i] * (x - cx) ** 2

    covered = np.logical_and.accumulate(rng.random((layers, *size)) < [[[0.995]], *[[[0.98]]] * (layers - 1)], axis=0)
    off = rng.uniform(-0.1, 0.1, (layers, *size, 2))
    return Sheets(size, *map(sheet, range(layers)), covered=covered, off=off).splats


# -------------------------------------------------------------------------------------------------- closed forms


def lengths(size, normal, offset):
    """Length of the line normal · (x, y) + offset = 0 in each pixel (H, W)."""
    y, x = np.indices(size)
    start = -offset * np.array(normal) / np.dot(normal, normal)
    along = np.array([-normal[1], normal[0]]) / math.hypot(*normal)
    first, last = np.full(size, -np.inf), np.full(size, np.inf)
    for low, origin, step in ((x, start[0], along[0]), (y, start[1], along[1])):
        if abs(step) < 1e-12:
            last = np.where((low <= origin) & (origin < low + 1), last, -np.inf)
            continue
        ends = np.sort(np.stack([(low - origin) / step, (low + 1 - origin) / step]), axis=0)
        first, last = np.maximum(first, ends[0]), np.minimum(last, ends[1])
    return np.clip(last - first, 0, None)


SLANTED = (0.5, 0.2, 20.0), (-0.3, -0.3, 61.37)
UPRIGHT = (0.5, 0.0, 20.0), (-0.3, 0.0, 45.8)
ALIKE = (0.9, 0.5, 10.0), (0.3, 0.1, 41.73)
STEEP = (5.0, 2.0, 20.0), (-0.3, -1.2, 290.7)
UP, RIGHT, NONE = (0, 0, 1), (1, 0, 0), (0, 0, 0)
CASES = {
    "one rises": (SLANTED, UP, NONE, 0.04),
    "one rises, upright line": (UPRIGHT, UP, NONE, 0.19),
    "one rises, slopes of one sign": (ALIKE, UP, NONE, 0.04),
    "one rises, steep": (STEEP, UP, NONE, 0.045),
    "one moves sideways": (SLANTED, RIGHT, NONE, 0.04),
    "both move sideways": (SLANTED, RIGHT, RIGHT, 0.04),
    "both move, one falls": (SLANTED, (1.0, 0.5, 0.0), (0.0, 0.3, -2.0), 0.04),
}


def errors(splatter, sheets, moves_a, moves_b, fine=1, size=64):
    """Low-passed error of the derivative, in that of the line, and its gain; `fine`² samples a pixel."""
    (ax, ay, ac), (bx, by, bc) = sheets
    colors = np.array([[0.9, 0.3, 0.1], [0.2, 0.5, 0.9]])
    depths = plane(ax / fine, ay / fine, ac), plane(bx / fine, by / fine, bc)
    scene = Sheets((fine * size, fine * size), *depths, colors=colors)
    moves = np.array([moves_a, moves_b], float) * [fine, fine, 1]
    _, found = pushed(splatter, scene.splats, moves[scene.sheet])
    rate = moves_a[2] - ax * moves_a[0] - ay * moves_a[1] - (moves_b[2] - bx * moves_b[0] - by * moves_b[1])
    normal = ax - bx, ay - by
    edge = lengths((size, size), normal, ac - bc) / math.hypot(*normal)
    true = (rate * edge)[..., None] * (colors[1] - colors[0])
    found = found[..., :3].reshape(size, fine, size, fine, 3).mean(axis=(1, 3))
    found, true = (low_passed(x)[10:-10, 10:-10] for x in (found, true))
    unit = low_passed(edge[..., None] * (colors[1] - colors[0]))[10:-10, 10:-10]
    return np.linalg.norm(found - true) / np.linalg.norm(unit), (found * unit).sum() / (unit**2).sum(), rate


@pytest.mark.parametrize("splatter", BOTH)
@pytest.mark.parametrize("name", CASES)
def test_the_line_of_two_planes_moves_as_their_depths_say(name, splatter):
    sheets, moves_a, moves_b, most = CASES[name]
    error, gain, rate = errors(splatter(), sheets, moves_a, moves_b)
    assert abs(rate) > 0.1 and error < most * abs(rate)
    assert abs(gain / rate - 1) < 0.035


def test_four_samples_a_pixel_know_the_line_better():
    assert errors(fused.Visible(), SLANTED, UP, NONE, fine=2)[0] < 0.012


def test_without_crossings_the_line_stands_still():
    error, gain, _ = errors(Visible(crossings=False, rims=False), SLANTED, UP, NONE)
    assert error > 0.99 and abs(gain) < 0.01


@pytest.mark.parametrize("splatter", BOTH)
@pytest.mark.parametrize("moves", [((1, 0.5, 0.6), NONE), (UP, UP), ((0, 0, 2), (0, 0, 2))])
def test_what_leaves_the_line_where_it_is_changes_nothing(moves, splatter):
    # A plane that slides within itself, and two that rise alike.
    error, _, rate = errors(splatter(), SLANTED, *moves)
    assert abs(rate) < 1e-12 and error < 1e-10


def circle_cut(c, zs, distance=4.0, radius=0.8, focal=1.0):
    """Area of the image of the circle where a card z = c cuts a sphere about (0, 0, zs), from a distance, and its
    derivatives in c and zs."""
    square, depth = radius**2 - (c - zs) ** 2, distance - c
    area = math.pi * focal**2 * square / depth**2
    moves = 2 * math.pi * focal**2 * (c - zs) / depth**2
    return area, -moves + 2 * area / depth, moves


SURFACES = {
    "mesh": lambda: mesh_part(icosphere(4, 0.8)),
    "sdf": lambda: rts.Part(
        rts.plugin("rts.surfaces", "sdf")(fields.sphere, radius=1.0),
        {"center": np.zeros(3), "radius": np.array(0.8)},
        "unlit",
    ),
}


@pytest.mark.parametrize("surface, target", [*(("mesh", target) for target in DIFFERENTIABLE), ("sdf", "torch-cpu")])
def test_depths_have_a_gradient_through_surfaces_cameras_and_engines(surface, target):
    size, cut = 80, 0.55
    camera, part = rts.Camera.look_at((0, 0, 4), (0, 0, 0), fov_y=30), SURFACES[surface]()

    def shading(value):
        def shader(theta, gbuffer, camera):
            rgba = np.array([[value, value, value, 1.0]], np.float32)
            return 0 * gbuffer["position"][:, :1] + constants(rgba, engine_of(gbuffer["position"]), gbuffer["position"])

        shader.opaque = True
        return shader

    card = mesh_part(quad(-3, 3, -3, 3))
    start = arrays(target, {"card": np.array([0, 0, 0, 0.01, -0.01, cut]), "sphere": np.zeros(6)})

    def area(shift):
        parts = [
            part.replace(shader=shading(1.0), transform=rts.rigid(shift["sphere"])),
            card.replace(shader=shading(0.0), transform=rts.rigid(shift["card"])),
        ]
        return rts.render(parts, camera, (size, size), layers=3)[..., 0].sum()

    focal = size / (2 * math.tan(math.radians(15)))
    value, by_card, by_sphere = circle_cut(cut, 0.0, focal=focal)
    assert abs(float(area(start)) / value - 1) < 0.02
    found = gradient(target, area, start)
    np.testing.assert_allclose(found["card"][3:], [0, 0, by_card], rtol=0.04, atol=0.04 * abs(by_card))
    np.testing.assert_allclose(found["sphere"][3:], [0, 0, by_sphere], rtol=0.04, atol=0.04 * abs(by_sphere))


# ------------------------------------------------------------------------------------------------------ decisions


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("slopes", [(0.5, -0.3), (0.9, 0.3), (5.0, -0.3), (0.02, 0.01)])
def test_one_pair_a_row_wherever_the_line_runs_between_centres(slopes, dtype):
    for share in (1e-6, 1e-3, 0.1, 0.37, 0.5, 0.82, 0.999, 1 - 1e-6):
        sheets = [plane(a, 0, 10 - a * (6.5 + share)) for a in slopes]
        found = Sheets((9, 14), *sheets, dtype=dtype).pairs()
        for m in ((1, 0), (1, 1), (1, -1)):
            inner = slice(2, -2) if m[1] else slice(None)
            assert (found[m][inner].sum(axis=1) == 1).all()
        if dtype is np.float64:
            assert found[1, 0][:, 6].all() and found[-1, 0][:, 7].all()
        assert not (found[0, 1] | found[0, -1]).any()


@pytest.mark.parametrize("bent", [0.0, 0.03])
def test_pairs_are_the_same_from_both_sides(bent):
    found = Sheets((20, 20), plane(0.4, 0.3, 8), lambda x, y: 15 - 0.2 * x + bent * (y - 10) ** 2).pairs()
    assert found[1, 0].any() and found[0, 1].any()
    for m in crossings.HALF:
        np.testing.assert_array_equal(found[m], crossings.ahead(found[-m[0], -m[1]], m, False))


def test_sheets_that_hide_one_another_without_meeting_do_not_cross():
    step = lambda x, y: np.where(x < 9.3, 5 + 0.1 * y, 30.0)  # noqa: E731
    scenes = [
        (plane(0.3, 0.2, 5), plane(0.3, 0.2, 9)),
        (step, plane(0.2, -0.1, 12)),
        (plane(0.3, 0.2, 5), plane(-0.2, 0.1, 40)),
        # A crease: two planes that meet, and go no farther.
        (lambda x, y: 10 + np.abs(x - 9.3), lambda x, y: 10 + 3 * np.abs(x - 9.3) + 1),
    ]
    for sheets in scenes:
        assert not np.logical_or.reduce(list(Sheets((20, 20), *sheets).pairs().values())).any()


@pytest.mark.parametrize(
    "parts, alike", [(scene_shapes.turned_box(), 200), (scene_shapes.cards(6)[0], 0)], ids=["box", "cards"]
)
def test_faces_that_hide_one_another_do_not_cross(parts, alike, monkeypatch):
    camera = rts.Camera.look_at((0, 0, scene_shapes.DISTANCE), (0, 0, 0), fov_y=40)
    samples = rts.sample(list(parts), camera, (64, 64), layers=4, splatter=None)
    covered, depth = np.asarray(samples.row) >= 0, np.asarray(samples.depth)
    assert covered[1].sum() > 500
    assert not crossings.sheets(covered, depth).any()
    without = Visible(crossings=False).needed(covered, depth)
    np.testing.assert_array_equal(fused.Visible().needed(covered, depth), without)
    # Where faces of the box end it is the comparison with what changes if they do not cross that tells.
    monkeypatch.setattr(crossings, "DIRECT", 1e9)
    assert crossings.sheets(covered, depth).sum() >= alike


def test_sheets_that_nearly_coincide_are_left_alone():
    slight, clear = (Sheets((20, 20), plane(0.0, 0.0, 230), plane(a, 0, 230 - 9.7 * a)).pairs() for a in (2e-3, 0.2))
    assert not slight[1, 0].any() and clear[1, 0].all(axis=0).any()


# ---------------------------------------------------------------------------------------------------- derivatives


def test_the_image_is_the_same_bit_for_bit():
    for splatter in BOTH:
        for layers in (2, 3):
            splats = rough(layers, layers=layers)
            given = arrays("torch-cpu", (splats.positions, splats.rgba, splats.row))
            images = [splatter(crossings=on).image(splats_of(*given)).numpy() for on in (True, False)]
            np.testing.assert_array_equal(*images)


@pytest.mark.parametrize("splatter", BOTH)
def test_forward_and_reverse_mode_are_adjoint(splatter):
    deep = 0
    for seed in range(3):
        splats, rng = rough(seed, layers=2 + seed % 2), np.random.default_rng(seed)
        tangents = rng.normal(size=splats.positions.shape), rng.normal(size=splats.rgba.shape)
        along = rng.normal(size=(*splats.row.shape[1:], 4))
        _, change = pushed(splatter(), splats, *tangents)
        found = pulled(splatter(), splats, along)
        products = sum((f * t).sum() for f, t in zip(found, tangents, strict=True))
        np.testing.assert_allclose(products, (along * change).sum(), rtol=1e-11)
        deep += (found[0][:, 2] != 0).sum()
    assert deep > 60


@pytest.mark.parametrize("rims", [True, False])
@pytest.mark.parametrize("layers", [2, 3])
def test_compiled_derivatives_are_those_of_the_specification(layers, rims):
    for seed in range(4):
        splats, rng = rough(10 * layers + seed, layers=layers), np.random.default_rng(seed)
        tangents = rng.normal(size=splats.positions.shape), rng.normal(size=splats.rgba.shape)
        along = rng.normal(size=(*splats.row.shape[1:], 4))
        known = Visible(rims=rims, crossings=False)
        results = [
            (pushed(s, splats, *tangents)[1], *pulled(s, splats, along))
            for s in (fused.Visible(rims=rims), Visible(rims=rims), known)
        ]
        for found, expected in zip(*results[:2], strict=True):
            np.testing.assert_allclose(found, expected, rtol=0, atol=1e-10)
        assert np.abs(results[1][0] - results[2][0]).max() > 0.1


@pytest.mark.parametrize("splatter", BOTH)
def test_colors_keep_the_derivative_of_the_image(splatter):
    for seed in range(2):
        splats, rng = rough(seed, layers=2 + seed), np.random.default_rng(seed)
        still, tint = np.zeros_like(splats.positions), rng.normal(size=splats.rgba.shape)
        along = rng.normal(size=(*splats.row.shape[1:], 4))
        results = []
        for s in (splatter(), splatter(crossings=False)):
            g_positions, g_rgba = pulled(s, splats, along)
            results.append((pushed(s, splats, still, tint)[1], g_rgba, g_positions))
        for found, expected in zip(results[0][:2], results[1][:2], strict=True):
            np.testing.assert_allclose(found, expected, rtol=0, atol=1e-13)
        assert np.abs(results[0][2] - results[1][2]).max() > 0.1


def test_what_is_kept_near_lines_is_what_the_specification_says():
    kept = 0
    for seed in range(8):
        # The last is larger than what compiled code looks at together.
        splats = rough(seed, (11 + seed, 17) if seed < 7 else (70, 81), 2 + seed % 3)
        covered = splats.row >= 0
        for dtype in (np.float32, np.float64):
            depth = np.where(covered, splats.positions[:, 2][splats.row], 0).astype(dtype)
            found, expected, without = (
                s.needed(covered, depth) for s in (fused.Visible(), Visible(), Visible(crossings=False))
            )
            np.testing.assert_array_equal(found, expected)
            kept += (expected & ~without).sum()
    assert kept > 20


def test_bitwise_the_same_on_any_number_of_threads(monkeypatch):
    splats, rng = rough(1, (90, 80)), np.random.default_rng(0)
    tangent, along = rng.normal(size=splats.positions.shape), rng.normal(size=(90, 80, 4))
    found = []
    for threads in "1235":
        monkeypatch.setenv("RTS_NUM_THREADS", threads)
        found.append((pushed(fused.Visible(), splats, tangent)[1], *pulled(fused.Visible(), splats, along)))
    for other in found[1:]:
        for one, known in zip(other, found[0], strict=True):
            np.testing.assert_array_equal(one, known)


def test_a_sample_in_several_cells_moves_all_of_their_lines():
    splats = Sheets((20, 23), plane(0.5, 0, 10), plane(-0.3, 0, 19.1)).splats
    # Every second row of cells has the samples of the one above.
    splats = splats.replace(row=np.repeat(splats.row[:, ::2], 2, axis=1))
    along = np.random.default_rng(0).normal(size=(20, 23, 4))
    results = [pulled(s, splats, along) for s in (fused.Visible(), Visible(), Visible(crossings=False))]
    for found, expected in zip(*results[:2], strict=True):
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-10)
    assert np.abs(results[1][0][:, 2]).max() > 0.1 and not results[2][0][:, 2].any()


@pytest.mark.parametrize("fine", [1, 2])
def test_normal_equations_are_products_of_tangents(fine):
    size, border, rng = (44, 52), 4, np.random.default_rng(5)
    splats = rough(5, size).replace(border=border)
    tangents, tints = (rng.normal(size=(3, *x.shape)) for x in (splats.positions, splats.rgba))
    inside = slice(border, size[0] - border), slice(border, size[1] - border)

    def mean(image):
        height, width = (n - 2 * border for n in size)
        return image[inside].reshape(height // fine, fine, width // fine, fine, 4).mean(axis=(1, 3)).ravel()

    changes = [pushed(fused.Visible(), splats, *t) for t in zip(tangents, tints, strict=True)]
    image, columns = mean(changes[0][0]), np.stack([mean(change) for _, change in changes])
    shape = ((size[0] - 2 * border) // fine, (size[1] - 2 * border) // fine, 4)
    given = arrays(
        "torch-cpu", (splats.positions, splats.rgba, splats.row, tangents, tints, np.zeros(shape)), np.float64
    )
    whole = splats_of(*given[:3], arrays("torch-cpu", splats.part), border=border)
    found = fused.Visible().normal_equations(whole, *given[3:])
    np.testing.assert_allclose(found[1], columns @ columns.T / image.size, rtol=1e-10)
    np.testing.assert_allclose(found[2], columns @ image / image.size, rtol=1e-10)
    still = fused.Visible(crossings=False).normal_equations(whole, *given[3:])
    assert np.abs(np.asarray(still[1]) - np.asarray(found[1])).max() > 0.01 * np.abs(np.asarray(found[1])).max()


# ------------------------------------------------------------------------------------------------------- sampling


def crossed_cards():
    vertices, faces = quad(-2, 2, -2, 2)
    leaning = [vertices @ [[1, 0, -s], [0, 1, 0], [0, 0, 1]] for s in (0.5, -0.4)]
    colors = np.eye(3)[:2]
    return [
        rts.Part(rts.plugin("rts.surfaces", "mesh")(faces), {"vertices": v, "colors": np.tile(c, (4, 1))}, "unlit")
        for v, c in zip(leaning, colors, strict=True)
    ]


@pytest.mark.parametrize("layers", [2, "auto"])
def test_hidden_layers_beside_lines_are_sampled(layers):
    camera, size = rts.Camera.orthographic((0.02, 0, 5), (0.02, 0, 0), height=3), (24, 24)
    cards = crossed_cards()
    samples = [rts.sample(cards, camera, size, layers=layers, splatter=Visible(crossings=on)) for on in (True, False)]
    hidden = [(np.asarray(s.row)[1:] >= 0).sum() for s in samples]
    # Both cells of a pair in each of the apron's rows, too, and two on either side.
    assert hidden[0] == 6 * 32 and hidden[1] == 0

    def red(splatter):
        def found(depth):
            pose = depth * arrays("torch-cpu", np.array([0, 0, 0, 0, 0, 1.0]))
            parts = [cards[0].replace(transform=rts.rigid(pose)), cards[1]]
            return rts.render(parts, camera, size, layers=layers, splatter=splatter)[..., 0].sum()

        return gradient("torch-cpu", found, arrays("torch-cpu", np.array(0.0)))

    # The line moves along x by the rise over the difference of slopes, in pixels of 3 / 24 of a unit.
    np.testing.assert_allclose(red("visible"), 24 * 24 / 3 / 0.9, rtol=0.02)
    np.testing.assert_allclose(red(Visible()), 24 * 24 / 3 / 0.9, rtol=0.02)


def test_bands_make_no_difference_to_lines(monkeypatch):
    cards, (zero, one) = crossed_cards(), arrays("torch-cpu", (np.zeros(()), np.ones(())))
    axis = arrays("torch-cpu", np.array([0.3, 0.1, 0.4, 0.1, 0.0, 1.0]))
    camera = rts.Camera.look_at((0.2, 0.3, 5), (0, 0, 0), fov_y=30)

    def image(t):
        return rts.render([cards[0].replace(transform=rts.rigid(t * axis)), cards[1]], camera, (20, 24), supersample=2)

    found = []
    for band in (settings.BAND, 500):
        monkeypatch.setattr(settings, "BAND", band)
        found.append(derivative("torch-cpu", image, zero, one)[1])
    assert len(settings.RenderSettings(None, 2, 2, None).bands((20, 24))) > 5 and np.abs(found[0]).max() > 1
    np.testing.assert_allclose(found[1], found[0], rtol=0, atol=1e-4)
