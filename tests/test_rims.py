"""Outlines that move as outlines do: closed forms, and plain loops written from the definition of the rules."""

import math

import numpy as np
import pytest
from helpers import (
    TORCH,
    arrays,
    derivative,
    gradient,
    icosphere,
    low_passed,
    mesh_part,
    quad,
    quick,
    splats_of,
    to_numpy,
)
from loops import STEPS, Pairing

import rts
from rts.rendering import settings
from rts.splatting import Visible, rims
from rts.splatting.layers import NEIGHBOURS, Layers
from rts_backends.fused import splatters as fused

pytestmark = pytest.mark.splatting

DISTANCE, RADIUS = 3.2, 0.7
"""Distance of the camera from the sphere's centre, and the sphere's radius."""


def pushed(splatter, splats, tangent, target="torch-cpu"):
    """The image and its derivative along a tangent of the positions, in float64."""
    positions, rgba, tangent = arrays(target, (splats.positions, splats.rgba, tangent), np.float64)
    known = cells(splats, target)
    return derivative(target, lambda p: splatter.image(splats_of(p, rgba, **known)), positions, tangent)


def cells(splats, target):
    """The tables of cells in splats, by name."""
    known = {name: getattr(splats, name) for name in ("row", "part", "exit")}
    return {name: arrays(target, x) for name, x in known.items() if x is not None}


def packed(covered, place, depth, rgba, part=None):
    """Splats of covered cells (K, H, W), with positions in the image (K, H, W, 2) and depths (K, H, W)."""
    row = np.where(covered, np.cumsum(covered).reshape(covered.shape) - 1, -1).astype(np.int32)
    positions = np.concatenate([place, depth[..., None]], axis=-1)[covered]
    part = None if part is None else np.where(covered, part, -1).astype(np.int32)
    return splats_of(positions, np.broadcast_to(rgba, (*covered.shape, 4))[covered], row, part)


def centres(layers, height, width):
    """Centres of cells (K, H, W, 2)."""
    rows, columns = np.indices((height, width))
    return np.broadcast_to(np.stack([columns + 0.5, rows + 0.5], axis=-1), (layers, height, width, 2))


# ------------------------------------------------------------------------------- the definition, in plain loops


def rule(pairing, cell, part, exits):
    """Name of the rule of a cell, β and the partner's rows."""
    (y, x), row = cell, pairing.row
    ends = {n: pairing.ends(cell, n) for n in STEPS if n != (0, 0)}
    inner = {n: (y - n[1], x - n[0]) for n in ends}
    outward = [sum(n[i] for n in ends if ends[n]) for i in (0, 1)]
    usable = [n for n in ends if ends[n] and pairing.covers(*inner[n]) and not ends[-n[0], -n[1]]]

    def gap(cell, ends):
        return pairing.positions[ends[cell], 2] - pairing.depth(0, *cell)

    def closes(ends):
        inside = [n for n in usable if ends[inner[n]] >= 0]
        return any(1.5 * gap(cell, ends) ** 2 <= gap(inner[n], ends) ** 2 for n in inside)

    def ratio(n):
        farther = y - 2 * n[1], x - 2 * n[0]
        if not pairing.covers(*farther) or pairing.ends(inner[n], (-n[0], -n[1])):
            return 0
        here, near, far = (pairing.depth(0, *c) for c in (cell, inner[n], farther))
        return (here - near) / (near - far) if near - far > 1e-5 * pairing.extent else 0

    if exits is not None and exits[1][cell] >= 0:
        if any(ends.values()):
            return "deepest", -1.0, exits[:, *cell]
    elif exits is not None and exits[0][cell] >= 0:
        if closes(np.where(exits[1] < 0, exits[0], -1)):
            return "exit", -0.5, exits[:1, *cell]
    elif part is not None and len(row) > 1 and row[1, y, x] >= 0 and part[0, y, x] == part[1, y, x] and closes(row[1]):
        return "chord", -0.5, row[1:2, y, x]
    deep = [n for n in usable if ratio(n) > 1.23]
    if not usable:
        return "none", 0.0, row[:1, y, x]
    best = max(deep or usable, key=lambda n: (n[0] * outward[0] + n[1] * outward[1]) / math.hypot(*n))
    if not deep:
        return "line", 0.5, row[:1, *inner[best]]
    r = ratio(best)
    return "root", min(max((1 + 2 * r - r * r) / (2 * r * (r - 1)), 0.0), 2.5), row[:1, *inner[best]]


def corrections_by_loops(splatter, splats, tangent):
    """The share of rims in the derivative along a tangent, from the buffers' sums; and the names of the rules."""
    row, rgba, positions = splats.row, splats.rgba, splats.positions
    pairing = Pairing(positions, row, visible=True)
    rules = {cell: rule(pairing, cell, splats.part, splats.exit) for cell in pairing.cells if pairing.covers(*cell)}
    own = {cell: tangent[row[0, *cell], :2] for cell in rules}
    outline = {
        c: own[c] + beta * (own[c] - tangent[partner, :2].mean(axis=0)) for c, (_, beta, partner) in rules.items()
    }
    total = sum(math.exp(-(u * u + v * v) / (2 * splatter.sigma**2)) for u, v in STEPS)
    added = np.zeros((*row.shape[1:], 4))
    for target in pairing.cells:
        sums, gains = np.zeros((2, 5)), np.zeros(2)
        for u, v in STEPS:
            source = target[0] - v, target[1] - u
            if not pairing.covers(*source):
                continue
            covered = pairing.covers(*target)
            s = pairing.shift(source, target) if covered else 0
            for k in (0, s) if s > 0 else (0,) if s == 0 else ():
                i, center = row[k, *source], np.array([source[1] + 0.5, source[0] + 0.5])
                if i < 0:
                    continue
                off = np.array([u, v]) - splatter.gamma * (positions[i, :2] - center)
                w = (1 + splatter.epsilon) / total * math.exp(-(off @ off) / (2 * splatter.sigma**2))
                front = k == 0 and s > 0
                sums[0 if front else 1] += w * np.array([*rgba[i], 1])
                if k == 0:
                    alike = covered and (splats.part is None or splats.part[0, *target] == splats.part[0, *source])
                    moves = outline[target] if alike and s == 0 else outline[source]
                    slope = w * splatter.gamma / splatter.sigma**2 * off
                    gains[0 if front else 1] += slope @ (moves - own[source])
        added[target] = composited(sums, gains, splatter, splats, target)
    return added, [name for name, _, _ in rules.values()]


def composited(sums, gains, splatter, splats, target):
    """The change of a pixel by gains in coverage of its buffers in front and at the surface."""
    # Behind them is what the image without these two holds: found from the image itself.
    pixel = splatter.splat(splats.positions, splats.rgba, splats.row)[target]
    front, surface = (s[:4] / max(1, s[4]) for s in sums)
    behind = np.zeros(4)
    through = (1 - front[3]) * (1 - surface[3])
    if through > 1e-9:
        behind = (pixel - front - (1 - front[3]) * surface) / through
    under = surface + (1 - surface[3]) * behind
    change = np.zeros(4)
    if 0 < sums[0, 4] < 1:
        mean = sums[0, :4] / sums[0, 4]
        change += gains[0] * (mean - mean[3] * under)
    if 0 < sums[1, 4] < 1:
        mean = sums[1, :4] / sums[1, 4]
        change += (1 - front[3]) * gains[1] * (mean - mean[3] * behind)
    return change


def rough(layers, seed, height=6, width=7, exits=False):
    """Random scenes, where all rules apply to some cells: bumps with rims, steps, holes and layers that close.

    With exits, the layer that would be the second is where rays leave, in most cells; some have a second exit.
    """
    if exits:
        splats = rough(layers + 1, seed, height, width)
        random = np.random.default_rng(seed)
        leaves = np.where(random.random((height, width)) < 0.8, splats.row[1], -1)
        leaves = np.stack([leaves, np.where(random.random(leaves.shape) < 0.3, leaves[::-1], -1)])
        leaves[1] = np.where(leaves[0] < 0, -1, leaves[1])
        row, part = (np.delete(x, 1, axis=0) for x in (splats.row, splats.part))
        return splats.replace(row=row, part=part, exit=leaves.astype(np.int32))
    rng = np.random.default_rng(seed)
    y, x = np.indices((height, width))
    far = (x - rng.uniform(1, 5)) ** 2 + (y - rng.uniform(1, 5)) ** 2
    bulge = 2 * np.sqrt(np.clip(14 - far, 0, None))
    front = np.where(rng.random((height, width)) < 0.1, rng.integers(4, 16, (height, width)) / 4, 10 - bulge)
    depth = np.sort([front, *(10 + k + bulge * (-1) ** k for k in range(layers - 1))], axis=0)
    covered = np.logical_and.accumulate(rng.random(depth.shape) < [[[0.98]], *[[[0.8]]] * (layers - 1)], axis=0)
    covered &= (far < 14) | (rng.random((height, width)) < 0.3)
    place = centres(*depth.shape) + rng.uniform(-0.2, 0.2, (*depth.shape, 2))
    rgba = np.concatenate([rng.random((*depth.shape, 3)), np.ones((*depth.shape, 1))], axis=-1)
    return packed(covered, place, depth, rgba, rng.integers(0, 2, depth.shape) * (rng.random() < 0.5))


@pytest.fixture
def double():
    """Double precision in jax, too."""
    jax = pytest.importorskip("jax")
    jax.config.update("jax_enable_x64", True)
    yield
    jax.config.update("jax_enable_x64", False)


RULES = (1, "root"), (2, "chord"), (3, "line"), (1, "exit"), (2, "exit"), (2, "deepest")
CASES = [*[(target, *rule) for target in TORCH for rule in RULES], ("jax", 1, "deepest")]


@pytest.mark.parametrize("target, layers, name", CASES)
def test_derivatives_change_as_the_loops_say(target, layers, name, double):
    seen = []
    for seed in range(4 if target in TORCH else 1):
        splats = rough(layers, seed, exits=name in ("exit", "deepest"))
        tangent = np.random.default_rng(seed).normal(size=splats.positions.shape)
        expected, names = corrections_by_loops(Visible(), splats, tangent)
        image, found = pushed(Visible(crossings=False), splats, tangent, target)
        same, without = pushed(Visible(rims=False, crossings=False), splats, tangent, target)
        np.testing.assert_array_equal(image, same)
        np.testing.assert_allclose(found - without, expected, rtol=0, atol=1e-9)
        seen += names
    assert seen.count(name) > 1 and seen.count("none") > 1


@pytest.mark.parametrize("target", TORCH)
@pytest.mark.parametrize("splatter", [Visible, fused.Visible])
def test_the_image_is_the_same_bit_for_bit(splatter, target):
    splats = rough(2, 7, exits=True)
    given, known = arrays(target, (splats.positions, splats.rgba)), cells(splats, target)
    splatters = splatter(), splatter(exits=False), splatter(rims=False)
    images = [to_numpy(s.image(splats_of(*given, **known))) for s in splatters]
    np.testing.assert_array_equal(images[1:], images[:1] * 2)


@pytest.mark.parametrize("layers, exits", [(1, False), (2, False), (3, False), (1, True), (2, True)])
def test_forward_and_reverse_mode_are_adjoint(layers, exits):
    splats, rng = rough(layers, layers, exits=exits), np.random.default_rng(layers)
    tangent, along = rng.normal(size=splats.positions.shape), rng.normal(size=(*splats.row.shape[1:], 4))
    _, change = pushed(Visible(), splats, tangent)
    found = pulled(Visible(), splats, along)["positions"]
    np.testing.assert_allclose((found * tangent).sum(), (along * change).sum(), rtol=1e-12)


@pytest.mark.parametrize("target", TORCH)
@pytest.mark.parametrize("splatter", [Visible, fused.Visible])
@pytest.mark.parametrize("layers, exits", [(1, False), (2, False), (2, True)])
def test_splats_of_one_part_need_no_array_of_parts(splatter, layers, exits, target):
    splats = rough(layers, 7, exits=exits)
    along = arrays(target, np.random.default_rng(7).normal(size=(*splats.row.shape[1:], 4)))
    given = arrays(target, (splats.positions, splats.rgba), np.float64)

    def slope(**told):
        own = cells(splats.replace(part=told.pop("part", None)), target)
        return gradient(target, lambda x: (splatter().image(splats_of(*x, **own, **told)) * along).sum(), given)

    expected, found, unknown = slope(part=np.minimum(splats.row, 0)), slope(one_part=True), slope()
    for x, y in zip(found, expected, strict=True):
        np.testing.assert_array_equal(x, y)
    assert (np.abs(found[0] - unknown[0]).max() > 1e-3) == (layers > 1)
    apart = np.where(splats.row < 0, -1, np.arange(layers)[:, None, None])  # Parts that are told count.
    for x, y in zip(slope(part=apart, one_part=True), slope(part=apart), strict=True):
        np.testing.assert_array_equal(x, y)


# ----------------------------------------------------------------------------------------------- compiled code


def pulled(splatter, splats, along, target="torch-cpu"):
    """The image's gradients in positions and colours, in float64."""
    given = arrays(target, {"positions": splats.positions, "rgba": splats.rgba}, np.float64)
    along, known = arrays(target, along, np.float64), cells(splats, target)

    def loss(x):
        image = splatter.image(splats_of(x["positions"], x["rgba"], **known))
        return (image * along).sum()

    return gradient(target, loss, given)


@pytest.mark.parametrize("target", TORCH)
@pytest.mark.parametrize("layers, exits", quick([(1, False), (2, True), (2, False), (3, False), (1, True)], 2))
def test_compiled_derivatives_are_those_of_the_specification(target, layers, exits):
    for seed in range(6):
        splats, rng = rough(layers, seed, 9, 11, exits), np.random.default_rng(seed)
        tangent, along = rng.normal(size=splats.positions.shape), rng.normal(size=(9, 11, 4))
        for found, expected in zip(
            pushed(fused.Visible(), splats, tangent, target), pushed(Visible(), splats, tangent, target), strict=True
        ):
            np.testing.assert_allclose(found, expected, rtol=0, atol=1e-11)
        gradients = [pulled(s, splats, along, target) for s in (fused.Visible(), Visible())]
        for name, found in gradients[0].items():
            np.testing.assert_allclose(found, gradients[1][name], rtol=0, atol=1e-10)


def test_compiled_derivatives_are_the_same_with_jax(double):
    splats, rng = rough(2, 0, 9, 11, exits=True), np.random.default_rng(0)
    tangent, along = rng.normal(size=splats.positions.shape), rng.normal(size=(9, 11, 4))
    found, expected = (pushed(fused.Visible(), splats, tangent, t)[1] for t in ("jax", "torch-cpu"))
    np.testing.assert_array_equal(found, expected)
    found, expected = (pulled(fused.Visible(), splats, along, t) for t in ("jax", "torch-cpu"))
    for name in found:
        np.testing.assert_allclose(found[name], expected[name], rtol=0, atol=1e-14)


@pytest.mark.parametrize("exits", [False, True])
def test_a_sample_in_several_cells_moves_all_of_their_outlines(exits):
    splats, rng = rough(2, 3, exits=exits), np.random.default_rng(0)
    row = np.where(splats.row >= 0, splats.row // 2, -1).astype(np.int32)
    along = rng.normal(size=(*row.shape[1:], 4))
    found, expected = (pulled(s, splats.replace(row=row), along) for s in (fused.Visible(), Visible()))
    for name in found:
        np.testing.assert_allclose(found[name], expected[name], rtol=0, atol=1e-10)


@pytest.mark.parametrize("border, exits", [(0, False), (2, False), (2, True)])
def test_normal_equations_are_products_of_tangents(border, exits):
    splats, rng = rough(2, 5, 40, 50, exits).replace(border=border), np.random.default_rng(5)
    tangents = rng.normal(size=(3, *splats.positions.shape))
    given, known = arrays("torch-cpu", (splats.positions, splats.rgba), np.float64), cells(splats, "torch-cpu")
    image = to_numpy(fused.Visible().cropped(splats_of(*given, **known, border=border)))
    jacobian = [pushed(fused.Visible(), splats, t)[1] for t in tangents]
    inside = slice(border, 40 - border), slice(border, 50 - border)
    columns = np.stack([change[inside].ravel() for change in jacobian])
    target, t_positions = arrays("torch-cpu", (np.zeros_like(image), tangents), np.float64)
    found = fused.Visible().normal_equations(splats_of(*given, **known, border=border), t_positions, None, target)
    np.testing.assert_allclose(found[1], columns @ columns.T / image.size, rtol=1e-10)
    np.testing.assert_allclose(found[2], columns @ image.ravel() / image.size, rtol=1e-10)


def test_compiled_derivatives_are_bitwise_the_same_on_any_number_of_threads(monkeypatch):
    splats, rng = rough(2, 2, 70, 60, exits=True), np.random.default_rng(0)
    tangent, along = rng.normal(size=splats.positions.shape), rng.normal(size=(70, 60, 4))
    found = []
    for threads in "1235":
        monkeypatch.setenv("RTS_NUM_THREADS", threads)
        change, slopes = pushed(fused.Visible(), splats, tangent)[1], pulled(fused.Visible(), splats, along)
        found.append((change, slopes["positions"], slopes["rgba"]))
    for other in found[1:]:
        for one, known in zip(other, found[0], strict=True):
            np.testing.assert_array_equal(one, known)


# --------------------------------------------------------------------------------------------------- decisions


def decided(covered, depth, part=None):
    """Chord, β and the direction from the partner of cells whose depths (K, H, W) are these."""
    splats = packed(covered, centres(*covered.shape), depth, np.ones(4), part)
    layers = Layers(Visible().weights, splats)
    shift = {n: np.where(splats.row[0] < 0, 0, layers.pairing(*n)[0]) for n in NEIGHBOURS}
    return rims.rules(layers, shift, splats.part)


@pytest.mark.parametrize("e", [0.05, 0.3, 0.7, 1.0, 1.45])
def test_the_root_of_a_smooth_rim_is_exact(e):
    # Depth is that of a parabola, whose rim lies e beyond the last column.
    depth = np.broadcast_to(9 - 2 * np.sqrt(e + np.arange(6)[::-1]), (1, 7, 6))
    covered = np.broadcast_to(np.arange(8) < 6, (1, 7, 8))
    _, beta, inward = decided(covered, np.pad(depth, ((0, 0), (0, 0), (0, 2))))
    expected = min(math.sqrt(e) / (math.sqrt(1 + e) - math.sqrt(e)), rims.LARGEST)
    np.testing.assert_allclose(beta[3, 5], expected, rtol=1e-12)
    assert rims.AROUND[inward[3, 5]] == (1, 0)
    assert (beta[:, :5] == 0).all() and (inward[:, :5] == -1).all()


@pytest.mark.parametrize(
    "fall", [lambda x: 0.0 * x, lambda x: 0.5 * x, lambda x: -0.5 * x, lambda x: 0.1 * (6 - x) ** 2]
)
def test_planes_and_valleys_go_along_lines(fall):
    depth = np.broadcast_to(9 + fall(np.arange(8.0)), (1, 7, 8))
    _, beta, _ = decided(np.broadcast_to(np.arange(8) < 6, (1, 7, 8)), depth)
    np.testing.assert_array_equal(beta[:, :6], np.broadcast_to(np.arange(6) == 5, (7, 6)) * rims.HALF)


def test_open_cards_that_turn_have_neither_roots_nor_chords():
    y, x = np.indices((9, 12))
    depth = np.stack([5 + 0.11 * x + 0.07 * y, 5.9 + 0.11 * x + 0.05 * y])
    covered = np.stack([(x > 1) & (x < 7) & (y > 1), (x > 3) & (x < 10) & (y < 8)])
    front = np.where(covered[0], depth[0], depth[1])
    both = np.stack([covered.any(axis=0), covered.all(axis=0)])
    chord, beta, _ = decided(both, np.stack([front, depth[1]]), np.zeros(both.shape))
    assert (chord < 0).all() and set(np.unique(beta)) == {0.0, rims.HALF}


def test_chords_are_of_layers_of_one_part_that_close():
    width = 12
    gap = np.sqrt(np.clip(9.4 - np.arange(width), 0, None))
    depth = np.broadcast_to(np.stack([5 - gap, 5 + gap])[:, None], (2, 7, width))
    covered = np.broadcast_to(np.arange(width) < 10, depth.shape)
    for parts, expected in (((0, 0), True), ((0, 1), False)):
        part = np.broadcast_to(np.array(parts)[:, None, None], depth.shape)
        chord, beta, _ = decided(covered, depth, part)
        assert (chord[3, 9] == 0) == expected and (chord[:, :9] < 0).all()
        assert (beta[3, 9] == -rims.HALF) == expected
    assert (decided(covered, depth)[0] < 0).all()
    slab = np.broadcast_to(np.array([5.0, 6.0])[:, None, None], depth.shape)
    assert (decided(covered, slab, np.zeros(depth.shape))[0] < 0).all()


# -------------------------------------------------------------------------------------------------- closed forms


def sphere(size, layers=1):
    """Points (K, H, W, 3) where rays through centres of cells meet a sphere at the origin, and which do."""
    focal = size / (2 * math.tan(math.radians(20)))
    x, y = np.moveaxis((centres(1, size, size)[0] - size / 2) / focal, -1, 0)
    ray = np.stack([x, -y, -np.ones_like(x)], axis=-1)
    square = (ray**2).sum(axis=-1)
    under = DISTANCE**2 - square * (DISTANCE**2 - RADIUS**2)
    root = np.sqrt(np.clip(under, 0, None)) * np.array([-1, 1])[:layers, None, None]
    points = ((DISTANCE + root) / square)[..., None] * ray + [0, 0, DISTANCE]
    return points, np.broadcast_to(under > 0, points.shape[:3])


EXITS = "exits"
"""In place of a number of layers: fronts, and where rays leave."""


def moved(size, velocity, layers=1, color=(1, 1, 1, 1), splatter=None):
    """Derivative (H, W, 4) of the sphere's image as its points move with a velocity, points → (…, 3) a unit of t."""
    leaves, layers = layers == EXITS, 2 if layers == EXITS else layers
    points, covered = sphere(size, layers)
    focal, depth, v = size / (2 * math.tan(math.radians(20))), DISTANCE - points[..., 2], velocity(points)
    place = size / 2 + focal * np.stack([points[..., 0], -points[..., 1]], axis=-1) / depth[..., None]
    speed = focal * np.stack([v[..., 0], -v[..., 1]], axis=-1) / depth[..., None]
    speed = speed + (place - size / 2) * (v[..., 2] / depth)[..., None]
    color = color(points) if callable(color) else color
    splats = packed(covered, place, depth, color, np.zeros(covered.shape) if layers > 1 else None)
    if leaves:
        splats = splats.replace(row=splats.row[:1], part=splats.part[:1], exit=splats.row[1:])
    tangent = np.concatenate([speed, -v[..., 2:]], axis=-1)[covered]
    return pushed(splatter or Visible(), splats, tangent)[1]


def step(size):
    """A pixel at the sphere's centre, in units of the world."""
    return 2 * DISTANCE * math.tan(math.radians(20)) / size


def turning(pixels):
    """A turn about +y, by a length at distance 1 from the axis."""
    return lambda p: pixels * np.stack([p[..., 2], 0 * p[..., 0], -p[..., 0]], axis=-1)


def moving(pixels):
    """A motion along +x."""
    return lambda p: np.broadcast_to([pixels, 0.0, 0.0], p.shape)


@pytest.mark.parametrize(
    "fine, layers, least, most",
    quick([(1, 1, 0.1, 0.02), (1, 2, 0.1, 0.008), (1, EXITS, 0.1, 0.008), (2, 1, 0.07, 0.01), (4, 1, 0.05, 0.005)], 2),
)
def test_the_outline_of_a_sphere_that_turns_stands_still(fine, layers, least, most):
    size, kind = 256, Visible if fine < 4 else fused.Visible  # Array code takes a minute, then.
    pixel = step(size)

    def norm(velocity, rims):
        image = moved(fine * size, velocity, layers, splatter=kind(rims=rims))[..., 3]
        return np.linalg.norm(low_passed(image.reshape(size, fine, size, fine).mean(axis=(1, 3))))

    unit = norm(moving(pixel), True)
    assert norm(turning(pixel), False) > least * unit
    assert norm(turning(pixel), True) < most * unit


def test_a_sphere_that_grows_gains_its_outline_times_its_growth():
    # The outline is a circle of radius f r / √(d² − r²).
    size, losses = 192, ((1, 0, 0), (0, 1, 0), (1, -2, 3))
    focal, square = size / (2 * math.tan(math.radians(20))), DISTANCE**2 - RADIUS**2
    radius, growth = focal * RADIUS / math.sqrt(square), focal * DISTANCE**2 / square**1.5
    found = moved(size, lambda p: 0.01 * p / RADIUS)[..., 3]
    angle = np.linspace(0, 2 * np.pi, 1000, endpoint=False)
    x, y = np.moveaxis(centres(1, size, size)[0] / size - 0.5, -1, 0)
    for a, b, c in losses:
        around = radius / size * np.array([np.cos(angle), np.sin(angle)])
        expected = 0.01 * growth * 2 * np.pi * radius * (a + b * around[0] + c * around[1] ** 2).mean()
        scale = 0.01 * growth * 2 * np.pi * radius
        assert abs((found * (a + b * x + c * y**2)).sum() - expected) < 0.015 * scale


@pytest.mark.parametrize("turns, layers, most", [(2.0, 1, 0.05), (-2.0, 1, 0.05), (2.0, 2, 0.02), (2.0, EXITS, 0.01)])
def test_a_sphere_that_rolls_changes_as_one_that_moves(turns, layers, most):
    # The outline is a circle, which moves by f d / (d² − r²) a unit.
    size = 192
    focal, square, pixel = size / (2 * math.tan(math.radians(20))), DISTANCE**2 - RADIUS**2, step(size)
    radius, speed = focal * RADIUS / math.sqrt(square), pixel * focal * DISTANCE / square
    angle = np.linspace(0, 2 * np.pi, 1000, endpoint=False)
    x, y = np.moveaxis(centres(1, size, size)[0] - size / 2, -1, 0) / radius

    def errors(rims):
        found = moved(size, lambda p: moving(pixel)(p) + turning(turns * pixel)(p), layers, splatter=Visible(rims=rims))
        for weigh in (lambda x, y: x, lambda x, y: x * y**2, lambda x, y: x**3):
            expected = speed * radius * 2 * np.pi * (weigh(np.cos(angle), np.sin(angle)) * np.cos(angle)).mean()
            yield abs((found[..., 3] * weigh(x, y)).sum() / expected - 1)

    assert max(errors(True)) < most and min(errors(False)) > 0.15


def opened(width, slope, splatter, size=64):
    """Pixels a row that open to the ground as one of two parts leaves the other, a gap of a width (pixels) between."""
    y, x = np.indices((size, size)) + 0.5
    edge = size / 2 + slope * (y - size / 2)
    covered = ((x < edge) | (x > edge + width))[None]
    part = (x > edge)[None].astype(int)
    splats = packed(covered, centres(1, size, size), np.full(covered.shape, 5.0), np.ones(4), part)
    tangent = np.where(splats.row[..., None] >= 0, part[..., None] * [1.0, 0.0, 0.0], 0.0)[covered]
    return -pushed(splatter, splats, tangent)[1][4:-4, 4:-4, 3].sum() / (size - 8)


@pytest.mark.parametrize("width", [1.0, 0.7, 0.5])
def test_a_gap_between_two_parts_opens_as_one_of_them_leaves(width):
    found = [opened(width, slope, s) for slope in (0.37, 0.8) for s in (Visible(), fused.Visible())]
    np.testing.assert_allclose(found, 1, atol=0.03)


AXIS = np.array([0.5, 1.0, 0.0, 0.1, 0.0, 0.2])
"""A pose's motion."""


def test_bands_make_no_difference_to_outlines(monkeypatch):
    # The same samples decide in each band, those of its apron included.
    sphere, (axis, angle, one) = mesh_part(icosphere(3, 1.3)), arrays("torch-cpu", (AXIS, np.zeros(()), np.ones(())))
    camera = rts.Camera.look_at((0, 0.5, 4), (0, 0, 0), fov_y=40)

    def image(t):
        return rts.render(sphere.replace(transform=rts.rigid(t * axis)), camera, (20, 24), supersample=2)

    found = []
    for band in (settings.BAND, 500):
        monkeypatch.setattr(settings, "BAND", band)
        found.append(derivative("torch-cpu", image, angle, one)[1])
    assert len(settings.RenderSettings(None, 2, 2, None).bands((20, 24))) > 5 and np.abs(found[0]).max() > 1
    np.testing.assert_allclose(found[1], found[0], rtol=0, atol=1e-3)


def test_texture_inside_of_an_outline_moves_as_before():
    def stripes(points):
        return np.concatenate([0.5 + 0.4 * np.sin(9 * points), np.ones_like(points[..., :1])], axis=-1)

    found, before = (moved(96, turning(0.02), 1, stripes, Visible(rims=rims)) for rims in (True, False))
    _, covered = sphere(96)
    inside = covered[0]
    for _ in range(2):
        wide = np.pad(inside, 1)
        inside = np.logical_and.reduce([wide[1 + v : 97 + v, 1 + u : 97 + u] for u, v in STEPS])
    assert inside.sum() > 1000 and np.abs(before[inside]).max() > 0.01
    np.testing.assert_array_equal(found[inside], before[inside])
    assert np.abs(found - before).max() > 0.01


@pytest.mark.parametrize("layers", [1, 2])
def test_cards_that_move_whole_are_as_before(layers):
    # What moves as one has the same motion at its outline.
    y, x = np.indices((12, 13))
    covered = np.stack([(x - 5.2) ** 2 + (y - 6.1) ** 2 < 16, x < 9])
    covered = np.stack([covered.any(axis=0), covered.all(axis=0)])[:layers]
    depth = np.where(covered, np.array([4.0, 6.0])[:layers, None, None], 0)
    rgba = np.concatenate([np.random.default_rng(0).random((*covered.shape, 3)), np.ones((*covered.shape, 1))], -1)
    splats = packed(covered, centres(*covered.shape), depth, rgba, np.zeros(covered.shape))
    tangent = np.broadcast_to([0.3, -1.0, 0.0], splats.positions.shape)
    found, before = (pushed(Visible(rims=rims), splats, tangent)[1] for rims in (True, False))
    np.testing.assert_allclose(found, before, rtol=0, atol=1e-12)


def test_depth_has_no_derivative():
    splats = rough(2, 0)
    tangent = np.zeros_like(splats.positions)
    tangent[:, 2] = 1
    np.testing.assert_array_equal(pushed(Visible(), splats, tangent)[1], 0)


def test_parts_reach_the_splatter():
    seen = []

    class Spy(Visible):
        def image(self, splats):
            seen.append(splats.part)
            return super().image(splats)

    parts = [mesh_part(quad(-1, 0, -1, 1)), mesh_part(quad(0, 1, -1, 1))]
    rts.render(parts, rts.Camera.orthographic((0, 0, 4), (0, 0, 0), height=4), (8, 8), splatter=Spy())
    np.testing.assert_array_equal(seen[0][0, 8, 4:12], [-1, -1, 0, 0, 1, 1, -1, -1])
