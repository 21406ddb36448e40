"""Triangles of subdivision surfaces, their shapes, and where rays meet the surface."""

import numpy as np
import pytest
from cages import CAGES, limit_of, somewhere
from helpers import open_edges
from scipy.spatial import cKDTree

import rts
from rts import Camera, InputError, Part

pytestmark = pytest.mark.sampling

try:
    Subdivision = rts.plugin("surfaces", "subdivision")
except rts.errors.PluginError as missing:
    pytest.skip(str(missing), allow_module_level=True)

from rts_surfaces.patches import tile_triangles as tiling  # noqa: E402
from rts_surfaces.subdivision.face_tiles import tiles_of  # noqa: E402
from rts_surfaces.subdivision.surface import BESIDE, LIMITS  # noqa: E402

CAMERA = Camera.look_at((1.5, 1.8, 4.0), (0, 0, 0), fov_y=40)
cages = pytest.mark.parametrize("name", CAGES)


# -------------------------------------------------------------------------------------------- triangles


@cages
@pytest.mark.parametrize("rate", [1, 2, 5, "random"])
def test_triangles_meet_without_cracks_whatever_their_rates(name, rate):
    vertices, limit = limit_of(name)
    points, tiles = limit.points(vertices), tiles_of(limit)
    if rate == "random":
        rng = np.random.default_rng(0)
        edges = rng.integers(1, 9, len(tiles.edge_tiles)).astype(np.int32)
        inner = rng.integers(3, 9, (len(tiles.patch), 2)).astype(np.int32)
    else:
        edges, inner = tiling.uniform(tiles, rate)
    proxy = tiling.triangles(tiles, points.evaluate, edges, inner)
    assert len(np.unique(proxy.faces)) == len(proxy.vertices)
    corners = proxy.corner_params.reshape(-1, 2)
    there = points.evaluate(np.repeat(proxy.ids[:, 0], 3), corners)[:, 0]
    np.testing.assert_allclose(proxy.vertices[proxy.faces].reshape(-1, 3), there, atol=1e-6)
    boundary = (limit.cage.twins < 0).sum()
    assert len(open_edges(proxy.faces)) == 0 if not boundary else len(open_edges(proxy.faces)) >= boundary
    # They cover each face once, turned as it is.
    a, b, c = (proxy.corner_params[:, i].astype(float) for i in range(3))
    area = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    assert area.min() > 0
    domain = {0: 1.0, 1: 0.5}
    sizes = limit.cage.sizes
    expected = [domain.get(k, n / 4) for k, n in zip(limit.kinds.tolist(), sizes.tolist(), strict=True)]
    np.testing.assert_allclose(np.bincount(proxy.ids[:, 0], area / 2), expected, atol=1e-5)


@cages
def test_shapes_are_those_of_finite_differences_in_tiles(name):
    vertices, limit = limit_of(name)
    points, tiles = limit.points(vertices), tiles_of(limit)
    normals, places, bends, curves = tiling.shapes(tiles, points.evaluate, BESIDE)
    assert curves.shape == (len(tiles.edge_tiles),) and bends.shape == (len(tiles.patch), 3)
    tile, step = np.arange(len(tiles.patch)), 1e-3

    def at(s, t):
        return points.evaluate(tiles.patch, tiles.params(tile, np.broadcast_to((s, t), (len(tile), 2))))[:, 0]

    middle, k = ((0.5, 0.5) if tiles.corners.shape[1] == 4 else (0.5, 0.25)), normals.shape[1] // 2
    np.testing.assert_allclose(places[:, k, k], at(*middle), atol=1e-12)
    s, t = middle
    along_s, along_t = (at(s + step, t) - at(s - step, t)), (at(s, t + step) - at(s, t - step))
    normal = np.cross(along_s, along_t)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    np.testing.assert_allclose(normals[:, k, k], normal, atol=1e-4)
    for i, (ds, dt) in enumerate(((step, 0), (0, step))):
        second = (at(s + ds, t + dt) - 2 * at(s, t) + at(s - ds, t - dt)) / step**2
        assert (np.abs((second * normal).sum(axis=1)) < bends[:, 2 * i] + 1e-2 * (1 + bends[:, 2 * i])).all()
    # The middle of the first side.
    chord = (at(0.5 + step, 0) - 2 * at(0.5, 0) + at(0.5 - step, 0)) / step**2
    tangent = (at(0.5 + step, 0) - at(0.5 - step, 0)) / (2 * step)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    across = np.linalg.norm(chord - (chord * tangent).sum(axis=1, keepdims=True) * tangent, axis=1)
    assert (across < curves[tiles.sides[:, 0]] * 1.01 + 1e-2).all()


@pytest.mark.parametrize("name", ["creased", "five corners", "loop"])
def test_tessellated_triangles_are_off_by_no_more_than_was_asked(name):
    vertices, faces, scheme, tags = CAGES[name]
    surface = Subdivision(faces, scheme, **tags)
    for rate in (0.05, 0.005):
        found, triangles = surface.tessellate({"vertices": vertices}, rate)
        fine, _ = surface.tessellate({"vertices": vertices}, 200)
        middles = found[triangles].mean(axis=1)
        assert cKDTree(fine).query(middles)[0].max() < rate + 0.01
    coarse = surface.tessellate({"vertices": vertices}, 1)[1]
    assert len(triangles) > 4 * len(coarse)
    with pytest.raises(InputError, match="rate"):
        surface.tessellate({"vertices": vertices}, 0.0)


# ---------------------------------------------------------------------------------------------- rays


@cages
def test_newtons_method_finds_the_rays_and_crosses_edges(name):
    vertices, limit = limit_of(name)
    points, count = limit.points(vertices), 4000
    face, params = somewhere(limit, count, margin=0.02)
    known = points.evaluate(face, params, 1)
    normal = np.cross(known[:, 1], known[:, 2])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    tilt = 0.3 * np.random.default_rng(1).normal(size=normal.shape)
    directions = -(normal + tilt)
    origins = known[:, 0] - 3 * directions
    # Begin beside the root: at that place of the nearest triangle's corner which is not on the same face, if there is.
    tiles = tiles_of(limit)
    proxy = tiling.triangles(tiles, points.evaluate, *tiling.uniform(tiles, 8))
    corner = proxy.faces.reshape(-1)
    near = cKDTree(proxy.vertices[corner]).query(known[:, 0], 12)[1]
    owner = proxy.ids[near // 3, 0]
    other = (owner != face[:, None]).argmax(axis=1)[:, None]
    start = np.take_along_axis(near, other, 1)[:, 0]
    begin = proxy.ids[start // 3, 0], proxy.corner_params.reshape(-1, 2)[start]
    assert (begin[0] != face).sum() > 20
    found, at, depth, met = points.newton(*begin, origins, directions, np.array([1e-3, 0.0]), LIMITS)
    assert met.mean() > 0.97
    place = points.evaluate(found, at)[:, 0]
    off = np.linalg.norm(place - (origins + depth[:, None] * directions), axis=1)
    assert off[met].max() < 1e-6
    # What met is on the surface: within its face, but for a little beyond an open edge.
    inner = met & (np.abs(depth - 3) < 0.02)
    assert inner.mean() > 0.95
    crossed = inner & (begin[0] != found)
    assert crossed.sum() > 20
    np.testing.assert_array_equal(found[crossed], face[crossed])
    np.testing.assert_allclose(at[crossed], params[crossed], atol=2e-2)


@pytest.mark.parametrize("surface", ["cube", "five corners", "loop"])
def test_no_sample_is_lost_within_a_closed_surface(surface):
    vertices, faces, scheme, tags = CAGES[surface]
    part = Part(
        Subdivision(faces, scheme, tolerance=3.0, **tags), {"vertices": vertices.astype(np.float32)}, "silhouette"
    )
    rough = rts.render(part, CAMERA, (200, 200))[..., 3]
    fine = rts.render(part.replace(surface=Subdivision(faces, scheme, tolerance=0.02, **tags)), CAMERA, (200, 200))[
        ..., 3
    ]
    eroded = np.lib.stride_tricks.sliding_window_view(fine, (9, 9)).min(axis=(2, 3)) > 0.999
    hull = np.lib.stride_tricks.sliding_window_view(rough, (9, 9)).max(axis=(2, 3)) > 0.5
    core = np.pad(eroded & hull, 4)
    assert core.sum() > 2000
    assert fine[core].min() > 0.999
    # Triangles that are coarse lie within the outline; but where they are hit no sample is lost.
    inside = np.pad(np.lib.stride_tricks.sliding_window_view(rough, (5, 5)).mean(axis=(2, 3)) > 0.9, 2)
    assert rough[inside & core].min() > 0.999
