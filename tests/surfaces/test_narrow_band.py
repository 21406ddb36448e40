"""The narrow band of implicit surfaces: against the whole lattice, and at how few evaluations."""

import numpy as np
import pytest
from helpers import quick, refused

from rts_surfaces.implicit.distinct_loops import distinct
from rts_surfaces.implicit.lattice import Lattice
from rts_surfaces.implicit.narrow_band import NarrowBand

pytestmark = pytest.mark.sampling

CUBE = ((-1, -1, -1), (1, 1, 1))
SHAPES = [(17, 30, 9), (33, 33, 33), (2, 2, 2), (3, 41, 2), (16, 18, 50)]


def torus(p):
    return np.hypot(np.hypot(p[:, 0], p[:, 1]) - 0.6, p[:, 2]) - 0.25


def sphere(center, radius):
    return lambda p: np.sqrt(((p - np.asarray(center)) ** 2).sum(axis=1)) - radius


def plane(normal, offset):
    normal = np.asarray(normal) / np.linalg.norm(normal)
    return lambda p: p @ normal - offset


def waves(seed, dtype=np.float64):
    """A random smooth field, and a Lipschitz bound of it."""
    rng = np.random.default_rng(seed)
    frequencies, phases, heights = rng.normal(0, 4, (5, 3)), rng.uniform(0, 6, 5), rng.uniform(0.2, 1, 5)
    bound = float((heights * np.linalg.norm(frequencies, axis=1)).sum())

    def level(p):
        p = p.astype(dtype)
        total = np.zeros(len(p), dtype)
        for f, phase, height in zip(frequencies.astype(dtype), phases, heights, strict=True):
            total += dtype(height) * np.sin(p[:, 0] * f[0] + p[:, 1] * f[1] + p[:, 2] * f[2] + dtype(phase))
        return total

    return level, bound


class Counted:
    """A level that counts what it is asked for."""

    def __init__(self, level):
        self.level, self.count, self.most = level, 0, 0
        self.seen = []

    def __call__(self, places):
        assert places.dtype == np.float64 and places.ndim == 2 and places.shape[1] == 3
        self.count, self.most = self.count + len(places), max(self.most, len(places))
        self.seen.append(places)
        return self.level(places)


def corners_of(array):
    """(8, X − 1, Y − 1, Z − 1): the values of an array (X, Y, Z) at the corners of cells."""
    x, y, z = array.shape
    return np.stack([array[i & 1 :, i >> 1 & 1 :, i >> 2 & 1 :][: x - 1, : y - 1, : z - 1] for i in range(8)])


def whole(level, lattice, closed):
    """The level at all points (X, Y, Z), and the cells (C, 3) that belong into the band."""
    values = level(lattice.points(np.arange(lattice.count))).reshape(lattice.shape)
    inside, border = values < 0, np.zeros(lattice.shape, bool)
    for axis in range(3):
        np.moveaxis(border, axis, 0)[[0, -1]] = True
    signs = corners_of(inside)
    wanted = signs.any(axis=0) & ~signs.all(axis=0)
    if closed:
        wanted |= corners_of(inside & border).any(axis=0)
    return values, np.argwhere(wanted)


def check_band(band, level, lattice, values):
    """Fail unless cells, corners, points and values of a band belong together."""
    assert band.cells.dtype == band.corners.dtype == np.int32 and band.numbers.dtype == np.int64
    assert band.cells.shape == (len(band.cells), 3) and band.corners.shape == (len(band.cells), 8)
    assert len(np.unique(band.numbers)) == len(band.numbers) == len(band.values)
    assert len(np.unique(band.cells, axis=0)) == len(band.cells)
    rows = np.concatenate([band.corners, band.inner])
    np.testing.assert_array_equal(np.unique(rows), np.arange(len(band.numbers)))
    offsets = [(i & 1, i >> 1 & 1, i >> 2 & 1) for i in range(8)]
    for i, offset in enumerate(offsets):
        number = np.ravel_multi_index(tuple((band.cells + offset).T), lattice.shape)
        np.testing.assert_array_equal(band.numbers[band.corners[:, i]], number)
    np.testing.assert_array_equal(band.values, values.ravel()[band.numbers])
    assert band.values.dtype == values.dtype


def rows(cells):
    return {tuple(c) for c in cells.tolist()}


def fields():
    yield "sphere", sphere((0.1, -0.2, 0.15), 0.55), 1.0
    yield "small sphere", sphere((0.31, 0.33, -0.38), 0.03), 1.0
    yield "sphere through the bounds", sphere((0.6, -0.3, 0.9), 0.7), 1.0
    yield "torus", torus, 1.0
    yield "plane", plane((0.3, -0.5, 0.8), 0.1), 1.0
    yield "plane of points", plane((0, 0, 1), 0.0), 1.0
    yield "plane through corners of blocks", plane((1, 1, 1), 0.0), 1.0
    yield "plane at the upper bound", plane((1, 0, 0), 1.0), 1.0
    yield "plane at the lower bound", plane((0, 1, 0), -1.0), 1.0
    yield "plane beyond the bounds", plane((0, 1, 0), 1.01), 1.0
    for seed in range(4):
        yield f"waves {seed}", *waves(seed)
    yield "waves in float32", *waves(7, np.float32)


FIELDS = {name: (level, bound) for name, level, bound in fields()}


@pytest.mark.parametrize("name", FIELDS)
@pytest.mark.parametrize("closed", quick([True, False]))
def test_with_a_lipschitz_bound_all_cells_are_found(name, closed):
    level, bound = FIELDS[name]
    for shape in SHAPES:
        lattice = Lattice(((-1, -0.9, -1.05), (1, 1, 0.95)) if "plane" not in name else CUBE, shape)
        values, wanted = whole(level, lattice, closed)
        for coarse in (1, 2, 16):
            counted = Counted(level)
            band = NarrowBand(bound, coarse=coarse).find(counted, lattice, closed)
            assert rows(band.cells) == rows(wanted), (shape, coarse)
            assert band.evaluations == counted.count
            check_band(band, level, lattice, values)


@pytest.mark.parametrize("bound", [True, False])
@pytest.mark.parametrize("name", FIELDS)
def test_cells_one_further_inside_come_beside_the_same_band(name, bound):
    level = FIELDS[name][0]
    narrow = NarrowBand(FIELDS[name][1] if bound else None, coarse=4)
    for shape, closed in zip(SHAPES, (True, False, True, False, True), strict=True):
        lattice = Lattice(CUBE, shape)
        values, _ = whole(level, lattice, closed)
        counted = Counted(level)
        plain, band = narrow.find(level, lattice, closed), narrow.find(counted, lattice, closed, inner=True)
        check_band(band, level, lattice, values)
        count = len(plain.numbers)
        assert plain.inner.shape == (0, 8) and band.inner.dtype == np.int32
        for a, b in zip(plain[:4], (band.numbers[:count], band.values[:count], *band[2:4]), strict=True):
            np.testing.assert_array_equal(a, b)
        # All other cells that have an inside corner of the band's.
        corners = np.zeros(lattice.count, bool)
        corners[plain.numbers[plain.values < 0]] = True
        wanted = np.any(corners_of(corners.reshape(shape)), axis=0)
        wanted[tuple(plain.cells.T)] = False
        lowest = np.stack(np.unravel_index(band.numbers[band.inner[:, 0]], shape), axis=1)
        assert rows(lowest) == rows(np.argwhere(wanted)) and len(lowest) == wanted.sum()
        for i in range(8):
            number = np.ravel_multi_index(tuple((lowest + [i & 1, i >> 1 & 1, i >> 2 & 1]).T), shape)
            np.testing.assert_array_equal(band.numbers[band.inner[:, i]], number)
        assert plain.evaluations <= band.evaluations == counted.count


@pytest.mark.parametrize("closed", [True, False])
@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_units_do_not_matter(closed, scale):
    for center in (0.0, 100.0):
        lattice = Lattice((np.array(CUBE) + center) * scale, (17, 24, 33))

        def level(p, center=center):
            return scale * torus(p / scale - center)

        values, wanted = whole(level, lattice, closed)
        band = NarrowBand(1.0).find(level, lattice, closed)
        assert rows(band.cells) == rows(wanted) and len(wanted)


def test_axes_may_have_different_steps():
    level, bound = waves(3)
    lattice = Lattice(((-1, -0.1, -3), (1, 0.2, 2)), (41, 11, 37))
    for closed in (True, False):
        values, wanted = whole(level, lattice, closed)
        band = NarrowBand(bound).find(level, lattice, closed)
        assert rows(band.cells) == rows(wanted)
        check_band(band, level, lattice, values)


@pytest.mark.parametrize(("size", "share"), [(65, 0.11), (129, 0.06)])
def test_few_points_are_evaluated(size, share):
    lattice = Lattice(CUBE, (size,) * 3)
    for bound in (1.0, None):
        counted = Counted(torus)
        band = NarrowBand(bound).find(counted, lattice, closed=True)
        assert band.evaluations == counted.count <= share * lattice.count
        if size == 65:
            _, wanted = whole(torus, lattice, closed=True)
            assert rows(band.cells) == rows(wanted)


def test_evaluations_grow_with_the_surface():
    counts = [NarrowBand(1.0).find(torus, Lattice(CUBE, (n + 1,) * 3), True).evaluations for n in (64, 128, 256)]
    assert np.polyfit(np.log([64, 128, 256]), np.log(counts), 1)[0] < 2.1


@pytest.mark.parametrize("bound", [1.0, None])
@pytest.mark.parametrize("shape", [(65, 65, 65), (50, 66, 41)])
def test_no_point_is_evaluated_twice(bound, shape):
    counted = Counted(torus)
    # With a bound, levels at centres of blocks that are dropped are forgotten; cells further inside may need them.
    NarrowBand(bound).find(counted, Lattice(CUBE, shape), closed=True, inner=bound is None)
    places = np.concatenate(counted.seen)
    assert len(np.unique(places, axis=0)) == len(places)


@pytest.mark.parametrize("bound", [1.0, None])
def test_chunks_change_nothing(bound):
    lattice = Lattice(CUBE, (33, 30, 27))
    one = NarrowBand(bound).find(torus, lattice, closed=True)
    counted = Counted(torus)
    other = NarrowBand(bound, chunk=100).find(counted, lattice, closed=True)
    assert counted.most == 100 and other.evaluations == counted.count == one.evaluations
    for a, b in zip(one, other, strict=True):
        np.testing.assert_array_equal(a, b)


# ----------------------------------------------------------------------------------------- without a bound


def seen_coarsely(values, coarse, closed):
    """The coarse cells (C, 3) whose corners differ in sign, or have a corner inside on the boundary."""
    at = [np.unique(np.append(np.arange(0, n - 1, coarse), n - 1)) for n in values.shape]
    inside = values[np.ix_(*at)] < 0
    border = np.zeros(inside.shape, bool)
    for axis in range(3):
        np.moveaxis(border, axis, 0)[[0, -1]] = True
    signs = corners_of(inside)
    wanted = signs.any(axis=0) & ~signs.all(axis=0)
    return np.argwhere(wanted | (corners_of(inside & border).any(axis=0) & closed))


@pytest.mark.parametrize("name", FIELDS)
@pytest.mark.parametrize("closed", [True, False])
def test_without_a_bound_what_is_seen_coarsely_comes_whole(name, closed):
    level, _ = FIELDS[name]
    for shape in SHAPES:
        lattice = Lattice(CUBE, shape)
        values, wanted = whole(level, lattice, closed)
        inside, border = values < 0, np.zeros(shape, bool)
        for axis in range(3):
            np.moveaxis(border, axis, 0)[[0, -1]] = True
        counted = Counted(level)
        band = NarrowBand(coarse=4).find(counted, lattice, closed)
        check_band(band, level, lattice, values)
        found = rows(band.cells)
        assert band.evaluations == counted.count and found <= rows(wanted)
        assert rows(seen_coarsely(values, 4, closed)) <= rows(band.cells // 4)
        # No holes: whatever goes on in a neighbour goes on in the band.
        for axis in range(3):
            across = [i for i in range(8) if i >> axis & 1]
            signs, capped = corners_of(inside)[across], corners_of(inside & border)[across]
            crossed = signs.any(axis=0) & ~signs.all(axis=0) | (capped.any(axis=0) & closed)
            for cell in np.argwhere(np.delete(crossed, -1, axis=axis)).tolist():
                neighbour = list(cell)
                neighbour[axis] += 1
                assert (tuple(cell) in found) == (tuple(neighbour) in found)


@pytest.mark.parametrize("name", ["sphere", "torus", "plane", "sphere through the bounds"])
def test_without_a_bound_large_surfaces_are_found_whole(name):
    level, _ = FIELDS[name]
    for closed in (True, False):
        lattice = Lattice(CUBE, (65, 50, 42))
        _, wanted = whole(level, lattice, closed)
        assert rows(NarrowBand().find(level, lattice, closed).cells) == rows(wanted)


def test_a_surface_is_followed_far_from_where_it_is_seen():
    # A thin rod, of which only one end, a ball, is seen at coarse corners.
    def level(p):
        rod = np.maximum(np.hypot(p[:, 1] - 0.07, p[:, 2] - 0.07) - 0.05, np.abs(p[:, 0]) - 0.9)
        return np.minimum(rod, sphere((-0.7, 0, 0), 0.25)(p))

    lattice = Lattice(CUBE, (65, 65, 65))
    values, wanted = whole(level, lattice, closed=True)
    seen = seen_coarsely(values, 8, closed=True)
    assert len(seen) and seen[:, 0].max() < 4
    band = NarrowBand(margin=0).find(level, lattice, closed=True)
    assert rows(band.cells) == rows(wanted) and band.cells[:, 0].max() > 55


def test_the_margin_finds_what_lies_near():
    def level(p):  # The small ball shows at no coarse corner, and at one half between them.
        return np.minimum(sphere((-0.5, 0, 0), 0.3)(p), sphere((0.125, 0.125, 0.125), 0.06)(p))

    lattice = Lattice(CUBE, (65, 65, 65))
    _, wanted = whole(level, lattice, closed=True)
    assert rows(NarrowBand(margin=1).find(level, lattice, True).cells) == rows(wanted)
    assert len(NarrowBand(margin=0).find(level, lattice, True).cells) < len(wanted)


# ------------------------------------------------------------------------------------- nothing, NaN, refusals


@pytest.mark.parametrize("bound", [1.0, None])
@pytest.mark.parametrize("closed", [True, False])
def test_nothing_may_remain(bound, closed):
    for value, dtype in ((3.0, np.float32), (-3.0, np.float64)):
        lattice = Lattice(CUBE, (17, 12, 9))
        band = NarrowBand(bound).find(lambda p, v=value, d=dtype: np.full(len(p), v, d), lattice, closed)
        if closed and value < 0:
            assert len(band.cells) == 16 * 11 * 8 - 14 * 9 * 6
            continue
        assert [x.shape for x in band[:4]] == [(0,), (0,), (0, 8), (0, 3)]
        assert band.values.dtype == dtype and band.evaluations < 400


@pytest.mark.parametrize("bound", [1.0, None])
def test_nan_shows_in_the_values(bound):
    def nowhere(p):
        return np.full(len(p), np.nan)

    def beyond(p):
        return np.where(p[:, 0] > 0.3, np.nan, torus(p))

    for level in (nowhere, beyond):
        for shape in ((2, 2, 2), (17, 18, 12), (1025, 1025, 1025)):
            if level is nowhere or shape[0] == 17:
                counted = Counted(level)
                lattice = Lattice(CUBE, shape)
                band = NarrowBand(bound, coarse=64 if shape[0] > 100 else 8).find(counted, lattice, closed=True)
                assert np.isnan(band.values).any() and len(band.cells) == 1
                assert band.evaluations == counted.count < 100_000
                np.testing.assert_array_equal(band.values, level(lattice.points(band.numbers)))


def test_nan_shows_one_cell_further_inside():
    lattice, counted = Lattice(CUBE, (33, 33, 33)), Counted(torus)
    NarrowBand().find(counted, lattice, True, inner=True)
    last = counted.seen[-1][-1]  # Evaluated for the sake of inner cells.

    def level(p):
        return np.where((p == last).all(axis=1), np.nan, torus(p))

    assert not np.isnan(NarrowBand().find(level, lattice, True).values).any()
    band = NarrowBand().find(level, lattice, True, inner=True)
    assert np.isnan(band.values).any() and len(band.cells) == 1 and len(band.inner) == 0


BAD = {
    "lipschitz": [0, -1.0, np.nan, np.inf, "1", (1, 2), True, 1j],
    "coarse": [0, 3, -4, 2.0, "16", True],
    "margin": [-1, 0.5, None, True, "1"],
    "chunk": [0, -1, 1e5, None, False],
}


@pytest.mark.parametrize(("name", "value"), [(n, v) for n, values in BAD.items() for v in values])
def test_bad_arguments_are_refused(name, value):
    with refused(name):
        NarrowBand(**{name: value})


def test_equal_bands_are_equal():
    assert NarrowBand(np.float32(2)) == NarrowBand(2) and hash(NarrowBand(2)) == hash(NarrowBand(2.0))


# ------------------------------------------------------------------------------------------------- distinct


@pytest.mark.parametrize("count", [0, 1, 2, 1000, 40_000])
def test_distinct_numbers_are_found_in_order(count):
    rng = np.random.default_rng(count)
    for keys in (
        rng.integers(-(2**63), 2**63 - 1, count),
        rng.integers(0, max(count // 3, 1), count),
        np.arange(count)[::-1] * 2**40,
        np.zeros(count, np.int64),
    ):
        found, inverse = distinct(np.ascontiguousarray(keys))
        assert found.dtype == np.int64 and inverse.dtype == np.int32
        np.testing.assert_array_equal(found[inverse], keys)
        _, first = np.unique(keys, return_index=True)
        np.testing.assert_array_equal(found, keys[np.sort(first)])
