"""The triangles of isosurfaces: closed, on the edges that change sign, and where the surface is."""

from collections import Counter

import numpy as np
import pytest
from lattices import BALL, TORUS, on_lattice

import rts
from rts_surfaces.implicit import marching_cubes
from rts_surfaces.implicit.lattice import Lattice
from rts_surfaces.implicit.narrow_band import NarrowBand

pytestmark = pytest.mark.sampling

UNIT = ((0, 0, 0), (1, 1, 1))


def directed_edges(faces):
    return Counter(map(tuple, faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).tolist()))


def is_closed(faces):
    """True if equally many triangles use every edge in either direction."""
    edges = directed_edges(faces)
    return all(edges[b, a] == count for (a, b), count in edges.items())


def volume(vertices, faces):
    a, b, c = (vertices[faces[:, i]].astype(np.float64) for i in range(3))
    return np.einsum("ij,ij->", a, np.cross(b, c)) / 6


def random_values(seed):
    """White noise on a lattice of any shape; every other time in whole numbers, many of which are the isovalue."""
    rng = np.random.default_rng(seed)
    values = rng.standard_normal(rng.integers(2, 9, 3)).astype(np.float32)
    return np.rint(values) if seed % 2 else values


def test_the_cases_cut_the_edges_that_change_sign():
    counts, edges, _ = marching_cubes.cases()
    assert counts[0] == counts[255] == 0 and counts.sum() == 820
    for case in range(256):
        inside = np.array([case >> i & 1 for i in range(8)])
        used = edges[case, : counts[case]].reshape(-1)
        ends = inside[marching_cubes.EDGES[used]]
        assert (ends[:, 0] != ends[:, 1]).all()
        assert set(used) == set(np.flatnonzero(np.diff(inside[marching_cubes.EDGES], axis=1)))
        assert (edges[case, counts[case] :] == -1).all()


@pytest.mark.parametrize("seed", range(40))
def test_noise_has_closed_surfaces_whose_vertices_lie_on_edges(seed):
    values = random_values(seed)
    lattice = Lattice(UNIT, values.shape)
    found = marching_cubes.of_lattice(values, lattice, 0.0, 1.0, True)
    assert is_closed(found.faces)
    flat = values.reshape(-1)
    a, b = flat[found.ends].T
    capped = found.ends[:, 0] == found.ends[:, 1]
    assert ((a < 0) != (b < 0))[~capped].all() and (a[capped] < 0).all()
    at = (found.vertices - lattice.low) / lattice.step
    whole = np.abs(at - np.rint(at)) < 1e-5
    assert (whole.sum(axis=1) >= 2).all() and (at >= -1e-5).all() and (at <= np.array(values.shape) - 1 + 1e-5).all()
    # Linear interpolation along the edge is zero at each vertex.
    low, high = (lattice.points(found.ends[~capped, i]) for i in range(2))
    along = np.linalg.norm(found.vertices[~capped] - low, axis=1) / np.linalg.norm(high - low, axis=1)
    np.testing.assert_allclose(a[~capped] * (1 - along) + b[~capped] * along, 0, atol=1e-5)
    np.testing.assert_allclose(found.differences[~capped], np.abs(b - a)[~capped], rtol=1e-6)


@pytest.mark.parametrize("seed", range(40))
def test_open_surfaces_end_at_the_bounds_only(seed):
    values = random_values(seed)
    lattice = Lattice(UNIT, values.shape)
    found = marching_cubes.of_lattice(values, lattice, 0.0, 1.0, False)
    assert not found.caps.any() and (found.ends[:, 0] != found.ends[:, 1]).all()
    edges = directed_edges(found.faces)
    rim = np.array([e for e, count in edges.items() if edges[e[::-1]] != count]).reshape(-1, 2)
    on_side = (found.vertices == 0) | (np.abs(found.vertices - 1) < 1e-6)
    assert (on_side[rim[:, 0]] & on_side[rim[:, 1]]).any(axis=1).all()
    capped = marching_cubes.of_lattice(values, lattice, 0.0, 1.0, True)
    assert (capped.caps == 0).sum() == len(found.faces)


@pytest.mark.parametrize("seed", range(20))
@pytest.mark.parametrize("closed", [True, False])
def test_a_band_has_the_triangles_of_the_lattice(seed, closed):
    values = random_values(seed)
    lattice = Lattice(UNIT, values.shape)
    whole = marching_cubes.of_lattice(values, lattice, 0.0, 1.0, closed)

    def level(places):
        index = np.rint((places - lattice.low) / lattice.step).astype(int)
        return values[tuple(index.T)]

    banded = marching_cubes.of_band(NarrowBand(coarse=1).find(level, lattice, closed), lattice, closed)
    assert is_closed(banded.faces) or not closed
    assert triangles(banded) == triangles(whole) and len(banded.vertices) == len(whole.vertices)


def triangles(found):
    """The triangles as a multiset of corners, whatever their order."""
    corners = np.round(found.vertices[found.faces].astype(np.float64), 5)
    first = np.lexsort(corners.transpose(2, 0, 1)[::-1], axis=1)[:, 0]
    turned = np.stack([corners[np.arange(len(corners)), (first + i) % 3] for i in range(3)], axis=1)
    return Counter(map(tuple, turned.reshape(-1, 9).tolist()))


@pytest.mark.parametrize("inside", ["below", "above"])
def test_a_ball_has_its_volume_and_faces_outwards(inside):
    values, bounds = on_lattice(BALL, 40)
    surface = rts.plugin("surfaces", "isosurface")(bounds, inside=inside)
    found = surface.extract({"values": values if inside == "below" else -values})
    assert volume(found.vertices, found.faces) == pytest.approx(4 / 3 * np.pi * 0.7**3, rel=5e-3)


@pytest.mark.parametrize("field", [BALL, TORUS], ids=["ball", "torus"])
def test_positions_are_of_second_order(field):
    errors = []
    for n in (24, 48, 96):
        values, bounds = on_lattice(field, n)
        found = rts.plugin("surfaces", "isosurface")(bounds).extract({"values": values})
        middles = found.vertices[found.faces].astype(np.float64).mean(axis=1)
        errors.append(np.abs(field(np.concatenate([found.vertices, middles]))).max())
    assert errors[0] < 1e-2
    assert np.log2(errors[0] / errors[1]) > 1.7 and np.log2(errors[1] / errors[2]) > 1.7
