"""Subdivision surfaces: against plain subdivision and its limit masks, their derivatives, triangles, samples, files."""

import copy
import pickle

import numpy as np
import pytest
from helpers import DIFFERENTIABLE, arrays, gradient, to_numpy
from scipy.spatial import cKDTree
from subdivision_reference import Cage, limit_samples

import rts
from rts import Camera, InputError, Part, Samples

pytestmark = pytest.mark.sampling

try:
    Subdivision = rts.plugin("surfaces", "subdivision")
except rts.PluginError as missing:
    pytest.skip(str(missing), allow_module_level=True)

from rts_surfaces.subdivision import tessellation  # noqa: E402
from rts_surfaces.subdivision.binding import UV, Limit, Rules  # noqa: E402
from rts_surfaces.subdivision.cage import checked_cage  # noqa: E402

SIZE = (60, 80)
CAMERA = Camera.look_at((1.5, 1.8, 4.0), (0, 0, 0), fov_y=40)
LIMITS = 1e-4, 10, 0.25, 0.02, 4


def cube():
    vertices = np.array([(x, y, z) for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)], float)
    return vertices, [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [1, 3, 7, 5], [3, 2, 6, 7], [2, 0, 4, 6]]


def sheet(nu, nv, seed=0):
    """A wavy grid of quadrilaterals."""
    place = np.stack(np.meshgrid(np.arange(nu), np.arange(nv), indexing="ij"), axis=-1).reshape(-1, 2)
    first = np.add.outer(nv * np.arange(nu - 1), np.arange(nv - 1)).reshape(-1, 1)
    height = 0.3 * np.random.default_rng(seed).normal(size=len(place))
    return np.column_stack([place, height]), (first + [0, nv, nv + 1, 1]).tolist()


def ball():
    part = rts.plugin("surfaces", "mesh").example()
    return np.asarray(part.theta["vertices"], float), part.surface.faces.tolist()


def prism(corners):
    """Two polygons of so many corners, joined by quadrilaterals."""
    turn = np.arange(corners) * 2 * np.pi / corners
    ring = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    vertices = np.concatenate([np.column_stack([ring, np.full(corners, z)]) for z in (-0.7, 0.7)])
    around = [[i, (i + 1) % corners, corners + (i + 1) % corners, corners + i] for i in range(corners)]
    return vertices, [list(range(corners))[::-1], list(range(corners, 2 * corners)), *around]


CAGES = {
    "cube": (*cube(), "catmark", {}),
    "creased": (*cube(), "catmark", {"creases": [(4, 5, 10), (5, 7, 10), (7, 6, 10), (6, 4, 10), (0, 1, 2.5)]}),
    "soft creases": (*cube(), "catmark", {"creases": [(4, 5, 0.5), (5, 7, 1.5), (7, 6, 3), (0, 1, 2.25)]}),
    "corner": (*cube(), "catmark", {"corners": [(0, 10), (7, 1.5)]}),
    "sheet": (*sheet(5, 4), "catmark", {}),
    "sheet without corners": (*sheet(5, 4), "catmark", {"boundary": "edge_only"}),
    "five corners": (*prism(5), "catmark", {"creases": [(0, 1, 2)]}),
    "eleven corners": (*prism(11), "catmark", {}),
    "triangles": (*prism(3), "catmark", {}),
    "loop": (*ball(), "loop", {}),
    "loop creased": (ball()[0], ball()[1], "loop", {"creases": [(*ball()[1][0][:2], 2.5)], "corners": [(3, 1.5)]}),
    "loop open": (ball()[0], ball()[1][:15], "loop", {}),
    "loop open without corners": (ball()[0], ball()[1][:11], "loop", {"boundary": "edge_only"}),
}
cages = pytest.mark.parametrize("name", CAGES)


def limit_of(name, **levels):
    vertices, faces, scheme, tags = CAGES[name]
    cage = checked_cage(faces, scheme, tags.get("creases", ()), tags.get("corners", ()))
    return vertices, Limit(cage, Rules(tags.get("boundary", "edge_and_corner"), **levels))


def somewhere(limit, count, seed=0, margin=0.0):
    """Random faces and parameters within them, away from their edges."""
    rng = np.random.default_rng(seed)
    tiles = tessellation.tiles_of(limit)
    tile, local = rng.integers(0, len(tiles.faces), count), margin + (1 - 2 * margin) * rng.random((count, 2))
    if tiles.corners.shape[1] == 3:
        local = np.sort(local, axis=1)
        local = np.stack([local[:, 0], 1 - local[:, 1]], axis=1)
    return tiles.faces[tile], tiles.params(tile, local)


# ------------------------------------------------------------------------------------------- the limit itself


@pytest.mark.parametrize("name", ["cube", "cube_corner0", "cube_creases0", "pyramid_creases0", "tent_creases0"])
def test_the_reference_gives_the_known_refinements(name, data):
    (part,) = rts.load(data / "cages" / f"catmark_{name}.obj", surface="subdivision")
    own = part.surface.cage
    faces = np.split(own.indices, own.first[1:-1])
    creases = np.column_stack([own.creases, own.crease_sharpness])
    corners = np.column_stack([own.corners, own.corner_sharpness])
    cage = Cage(part.theta["vertices"], [f.tolist() for f in faces], "catmark", creases, corners)
    for level in (1, 2, 3):
        cage = cage.refined()
        lines = (data / "cages" / "baseline" / f"catmark_{name}_refined{level}.obj").read_text().splitlines()
        known = np.array([line.split()[1:4] for line in lines if line.startswith("v ")], float)
        assert len(known) == len(cage.vertices)
        for one, other in ((known, cage.vertices), (cage.vertices, known)):
            assert cKDTree(one).query(other)[0].max() < 1e-6


@cages
def test_limit_points_are_those_of_subdivision(name):
    vertices, faces, scheme, tags = CAGES[name]
    face, params, expected = limit_samples(vertices, faces, scheme, **tags)
    limit = limit_of(name)[1]
    found = limit.points(vertices).evaluate(face, params)[:, 0]
    known = np.isfinite(expected).all(axis=1)
    assert known.mean() > 0.99
    np.testing.assert_allclose(found[known], expected[known], rtol=0, atol=1e-6)
    # Weights give the points too.
    weights = limit.stencils(face, params)
    np.testing.assert_allclose(np.einsum("nw,nwc->nc", weights, vertices[limit.table[face]]), found, atol=1e-12)


@pytest.mark.parametrize("name", ["torus", "tent_creases0", "chaikin0", "nonquads"])
def test_limit_points_of_real_cages_are_those_of_subdivision(name, data):
    (part,) = rts.load(data / "cages" / f"catmark_{name}.obj", surface="subdivision")
    cage, vertices = part.surface.cage, part.theta["vertices"].astype(float)
    tags = {
        "creases": np.column_stack([cage.creases, cage.crease_sharpness]),
        "corners": np.column_stack([cage.corners, cage.corner_sharpness]),
    }
    faces = [f.tolist() for f in np.split(cage.indices, cage.first[1:-1])]
    face, params, expected = limit_samples(vertices, faces, "catmark", **tags)
    found = part.surface.limit.points(vertices).evaluate(face, params)[:, 0]
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6)


@cages
def test_derivatives_are_differences(name):
    vertices, limit = limit_of(name)
    face, params = somewhere(limit, 300, margin=0.1)
    points, step = limit.points(vertices), 1e-4
    found = points.evaluate(face, params, 2)
    size = np.linalg.norm(found[:, 1:3], axis=2).max()
    for i, offset in enumerate(((step, 0), (0, step))):
        after, before = (points.evaluate(face, params + sign * np.array(offset), 2) for sign in (1, -1))
        # Across a line where patches meet the third derivative jumps: the error is of the step's first order there.
        slope = (after[:, 0] - before[:, 0]) / (2 * step)
        assert np.linalg.norm(slope - found[:, 1 + i], axis=1).max() < 1e-6 * size
        bend = (after[:, 1:3] - before[:, 1:3]) / (2 * step)
        # Nor are the signs right for triangles in 3.5.0: see `Points.evaluate`.
        signs = (1, -1) if CAGES[name][2] == "loop" else (1,)
        error = [np.linalg.norm(bend - sign * found[:, (3 + i, 4 + i)], axis=2) for sign in signs]
        assert np.median(np.min(error, axis=0)) < 1e-6 * size
    along_u, along_v = limit.derivative_stencils(face, params)
    for weights, known in ((along_u, found[:, 1]), (along_v, found[:, 2])):
        np.testing.assert_allclose(np.einsum("nw,nwc->nc", weights, vertices[limit.table[face]]), known, atol=1e-10)


@cages
def test_deeper_levels_change_nothing_but_at_extraordinary_vertices(name):
    vertices, limit = limit_of(name)
    face, params = somewhere(limit, 20_000)
    extent = np.ptp(vertices, axis=0).max()

    def off(one, other):
        found = (limit_of(name, smooth=s, sharp=s)[1].points(vertices).evaluate(face, params) for s in (one, other))
        return np.linalg.norm(np.subtract(*found)[:, 0], axis=1) / extent

    assert np.quantile(off(8, 10), 0.999) < 1e-6 and off(8, 10).max() < 1e-4
    assert off(6, 10).max() >= off(8, 10).max()
    np.testing.assert_array_equal(limit.points(vertices).evaluate(face, params).shape, (20_000, 1, 3))


def test_the_smooth_level_is_the_one_that_is_asked_for():
    vertices, faces = cube()
    cage = checked_cage(faces, "catmark")
    face, params = np.zeros(1000, int), np.geomspace(1e-4, 0.1, 1000)[:, None] * [1, 0.7]
    best, default, six = (
        Limit(cage, rules).points(vertices).evaluate(face, params)
        for rules in (Rules(smooth=10, sharp=10), Rules(), Rules(smooth=6, sharp=6))
    )
    assert np.abs(default - best).max() < 0.3 * np.abs(six - best).max()


def test_chaikins_rule_smooths_sharpness_along_creases_alone():
    vertices, faces = cube()
    around = [(4, 5), (5, 7), (7, 6), (6, 4)]
    for sharp, same in (((3, 3, 3, 3), True), ((1, 2, 3, 4), False)):
        creases = [(a, b, s) for (a, b), s in zip(around, sharp, strict=True)]
        one, other = (Limit(checked_cage(faces, "catmark", creases), Rules(chaikin=c)) for c in (False, True))
        face, params = somewhere(one, 200)
        found = [x.points(vertices).evaluate(face, params) for x in (one, other)]
        assert np.allclose(*found, atol=1e-9) == same


def test_at_a_corner_of_a_smooth_boundary_there_is_a_normal():
    vertices, faces = sheet(2, 2)
    vertices[:, 2] = 0
    surface = Subdivision(faces, boundary="edge_only")
    params = np.array([(0, 0), (1, 0), (1, 1), (0, 1), (0.5, 0.5)], float)
    gbuffer = surface.evaluate({"vertices": vertices}, samples_at(np.zeros(5, int), params))
    np.testing.assert_allclose(gbuffer["normal"], np.tile([0.0, 0, 1], (5, 1)), atol=1e-6)


def test_faces_at_a_boundary_that_is_not_interpolated_have_no_surface():
    vertices, faces = sheet(5, 5)
    surface = Subdivision(faces, boundary="none")
    assert (surface.limit.kinds >= 0).sum() == 4
    part = Part(surface, {"vertices": vertices.astype(np.float32)}, "lambert")
    sampled = rts.sample(part, Camera.look_at((2, 2, 9), (2, 2, 0), up=(0, 1, 0)), SIZE).samples[0]
    inner = np.flatnonzero(surface.limit.kinds >= 0)
    assert np.isin(sampled.ids[np.unique(sampled.row[sampled.row >= 0]), 0], inner).all()
    gbuffer = surface.evaluate(part.theta, samples_at(np.arange(16), np.full((16, 2), 0.5)))
    assert np.isfinite(gbuffer["normal"]).all()
    with pytest.raises(InputError, match="no face of the cage has a surface"):
        Subdivision(faces[:1], boundary="none")


# -------------------------------------------------------------------------------------------- evaluation


def samples_at(face, params):
    none = np.full((1, 1, 1), -1, np.int32)
    ids = np.asarray(face, np.int32).reshape(-1, 1)
    return Samples(ids, np.asarray(params, np.float32), none, none.astype(np.float32), np.int32(0))


@pytest.mark.parametrize("target", ["numpy", *DIFFERENTIABLE])
def test_attributes_that_are_affine_in_the_points_are_so_on_the_surface(target):
    vertices, faces = prism(5)
    surface = Subdivision(faces, creases=[(0, 1, 2)], indices={"weight": None})
    theta = {"vertices": vertices, "colors": 0.5 + 0.3 * vertices, "weight": vertices[:, :1], "uv": vertices[:, :2] * 2}
    samples = samples_at(*somewhere(surface.limit, 50))
    found = surface.evaluate(arrays(target, theta, np.float32), samples)
    gbuffer = {name: to_numpy(found[name]) for name in ("position", "color", "uv", "weight")}
    np.testing.assert_allclose(gbuffer["color"], 0.5 + 0.3 * gbuffer["position"], atol=1e-6)
    np.testing.assert_allclose(gbuffer["uv"], 2 * gbuffer["position"][:, :2], atol=1e-6)
    np.testing.assert_allclose(gbuffer["weight"], gbuffer["position"][:, :1], atol=1e-6)


@pytest.mark.parametrize("target", DIFFERENTIABLE)
@pytest.mark.parametrize("name", ["creased", "five corners", "loop open"])
def test_gradients_are_the_weights(target, name):
    vertices, faces, scheme, tags = CAGES[name]
    surface = Subdivision(faces, scheme, **tags)
    face, params = somewhere(surface.limit, 40)
    samples, like = samples_at(face, params), np.random.default_rng(0).normal(size=(40, 3))

    def loss(theta):
        position = surface.evaluate(theta, samples)["position"]
        return (position * rts.engine_of(position).constant(like, position)).sum()

    found = gradient(target, loss, arrays(target, {"vertices": vertices}))["vertices"]
    expected = np.zeros_like(vertices)
    weights = surface.limit.stencils(face, np.asarray(params, np.float32))
    np.add.at(expected, surface.limit.table[face], weights[:, :, None] * like[:, None])
    np.testing.assert_allclose(found, expected, atol=1e-5)


def test_compiled_gradients_of_images_are_those_of_numpy_and_torch():
    jax, torch = pytest.importorskip("jax"), pytest.importorskip("torch")
    part = Subdivision.example()

    def loss(vertices):
        image = rts.render(part.replace(theta={**part.theta, "vertices": vertices}), CAMERA, SIZE)
        return (image[..., :3] ** 2).mean()

    given = part.theta["vertices"]
    compiled = np.asarray(jax.jit(jax.grad(loss))(jax.numpy.asarray(given)))
    variable = torch.tensor(given, requires_grad=True)
    loss(variable).backward()
    assert np.abs(compiled).max() > 1e-3
    np.testing.assert_allclose(compiled, variable.grad.numpy(), atol=1e-3 * np.abs(compiled).max())
    along = np.random.default_rng(0).normal(size=given.shape).astype(np.float32)
    _, forward = jax.jvp(jax.jit(loss), (jax.numpy.asarray(given),), (jax.numpy.asarray(along),))
    np.testing.assert_allclose(float(forward), (compiled * along).sum(), rtol=1e-2, atol=1e-4)


def test_a_face_varying_map_keeps_its_seam():
    # A tube of four sides whose map goes once around, from 0 to 1, with a seam along one edge.
    vertices, faces = prism(4)
    around = faces[2:]
    uv = np.array([(x, y) for y in (0.0, 1.0) for x in np.linspace(0, 1, 5)])
    rows = [[i, i + 1, i + 6, i + 5] for i in range(4)]
    surface = Subdivision(around, indices={"uv": rows}, uv_rule="all")
    assert surface.limit.uv_table.max() == 9
    face = np.repeat(np.arange(4), 50)
    params = np.tile(np.random.default_rng(0).random((50, 2)), (4, 1))
    gbuffer = surface.evaluate({"vertices": vertices, "uv": uv}, samples_at(face, params))
    expected = np.stack([(face + params[:, 0]) / 4, params[:, 1]], axis=1)
    np.testing.assert_allclose(gbuffer["uv"], expected, atol=1e-6)
    smooth = Subdivision(around, indices={"uv": rows})
    np.testing.assert_allclose(
        smooth.limit.stencils(face, params, channel=UV).sum(axis=1), 1, atol=1e-12
    )  # Affine, whatever the rule.


def test_copies_are_as_good():
    part = Subdivision.example()
    expected = rts.render(part, CAMERA, SIZE)
    for again in (copy.deepcopy(part.surface), pickle.loads(pickle.dumps(part.surface))):
        np.testing.assert_array_equal(rts.render(part.replace(surface=again), CAMERA, SIZE), expected)


# -------------------------------------------------------------------------------------------- triangles


def open_edges(faces):
    directed = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    assert len(np.unique(directed, axis=0)) == len(directed)
    edges, counts = np.unique(np.sort(directed, axis=1), axis=0, return_counts=True)
    return edges[counts != 2]


@cages
@pytest.mark.parametrize("rate", [1, 2, 5, "random"])
def test_triangles_meet_without_cracks_whatever_their_rates(name, rate):
    vertices, limit = limit_of(name)
    points, tiles = limit.points(vertices), tessellation.tiles_of(limit)
    if rate == "random":
        rng = np.random.default_rng(0)
        edges = rng.integers(1, 9, len(tiles.edge_tiles)).astype(np.int32)
        inner = rng.integers(3, 9, (len(tiles.faces), 2)).astype(np.int32)
    else:
        edges, inner = tessellation.uniform(tiles, rate)
    proxy = tessellation.triangles(tiles, points, edges, inner)
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
    points, tiles = limit.points(vertices), tessellation.tiles_of(limit)
    normals, places, bends, curves = tessellation.shapes(tiles, points)
    assert curves.shape == tiles.corners.shape and bends.shape == (len(tiles.faces), 3)
    tile, step = np.arange(len(tiles.faces)), 1e-3

    def at(s, t):
        return points.evaluate(tiles.faces, tiles.params(tile, np.broadcast_to((s, t), (len(tile), 2))))[:, 0]

    middle = (0.5, 0.5) if normals.shape[1] and tiles.corners.shape[1] == 4 else (0.5, 0.25)
    np.testing.assert_allclose(places[:, 2, 2], at(*middle), atol=1e-12)
    s, t = middle
    along_s, along_t = (at(s + step, t) - at(s - step, t)), (at(s, t + step) - at(s, t - step))
    normal = np.cross(along_s, along_t)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    np.testing.assert_allclose(normals[:, 2, 2], normal, atol=1e-4)
    for i, (ds, dt) in enumerate(((step, 0), (0, step))):
        second = (at(s + ds, t + dt) - 2 * at(s, t) + at(s - ds, t - dt)) / step**2
        assert (np.abs((second * normal).sum(axis=1)) < bends[:, 2 * i] + 1e-2 * (1 + bends[:, 2 * i])).all()
    # The middle of the first side.
    chord = (at(0.5 + step, 0) - 2 * at(0.5, 0) + at(0.5 - step, 0)) / step**2
    tangent = (at(0.5 + step, 0) - at(0.5 - step, 0)) / (2 * step)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    across = np.linalg.norm(chord - (chord * tangent).sum(axis=1, keepdims=True) * tangent, axis=1)
    assert (across < curves[:, 0] * 1.01 + 1e-2).all()


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
    tiles = tessellation.tiles_of(limit)
    proxy = tessellation.triangles(tiles, points, *tessellation.uniform(tiles, 8))
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
    part = Part(Subdivision(faces, scheme, rate=3, **tags), {"vertices": vertices.astype(np.float32)}, "silhouette")
    rough = rts.render(part, CAMERA, (200, 200))[..., 3]
    fine = rts.render(part.replace(surface=Subdivision(faces, scheme, rate=24, **tags)), CAMERA, (200, 200))[..., 3]
    eroded = np.lib.stride_tricks.sliding_window_view(fine, (9, 9)).min(axis=(2, 3)) > 0.999
    hull = np.lib.stride_tricks.sliding_window_view(rough, (9, 9)).max(axis=(2, 3)) > 0.5
    core = np.pad(eroded & hull, 4)
    assert core.sum() > 2000
    assert fine[core].min() > 0.999
    # Triangles that are coarse lie within the outline; but where they are hit no sample is lost.
    inside = np.pad(np.lib.stride_tricks.sliding_window_view(rough, (5, 5)).mean(axis=(2, 3)) > 0.9, 2)
    assert rough[inside & core].min() > 0.999


# ---------------------------------------------------------------------------------------------- files


def test_a_cage_from_a_file_has_its_tags_polygons_and_map(tmp_path):
    path = tmp_path / "cage.obj"
    vertices, faces = prism(5)
    lines = [f"v {x} {y} {z}" for x, y, z in vertices] + [f"vt {x} {y}" for x, y, _ in vertices]
    lines += ["f " + " ".join(f"{i + 1}/{i + 1}" for i in f) for f in faces]
    lines += ["t crease 2/1/0 0 1 2.5", "t crease 4/2/0 5 6 6 7 3.0 10.0", "t corner 1/1/0 3 1.5"]
    lines += ["t interpolateboundary 1/0/0 2", "t creasemethod 0/0/1 chaikin", "t hole 1/0/0 3"]
    path.write_text("\n".join(lines))
    with pytest.warns(rts.FileWarning, match="line 33: the tag 'hole' is not followed"):
        (part,) = rts.load(path, surface="subdivision")
    cage = part.surface.cage
    assert cage.sizes.tolist() == [5, 5, 4, 4, 4, 4, 4]
    assert cage.creases.tolist() == [[0, 1], [5, 6], [6, 7]] and cage.crease_sharpness.tolist() == [2.5, 3, 10]
    assert cage.corners.tolist() == [3] and cage.corner_sharpness.tolist() == [1.5]
    assert part.surface._rules == Rules("edge_only", True)
    assert part.theta["uv"].shape == (10, 2)
    image = rts.render(part, CAMERA, SIZE)
    assert 0.05 < image[..., 3].mean() < 0.9


@pytest.mark.parametrize(
    "line, expected",
    [
        ("t crease 2/1/0 0 1", "is no tag"),
        ("t crease 2/1 0 1 2", "is no tag"),
        ("t crease 2/1/0 0 x 2", "is no tag"),
        ("t crease 2/1/0 0 1 nan", "is no tag"),
        ("t crease 1/1/0 0 2", "is no tag"),
        ("t", "is no tag"),
        ("t crease 2/1/0 0 7 2", "creases name the edge of vertices 0 and 7"),
        ("t interpolateboundary 1/0/0 7", "is no tag"),
        ("f 1 2", "a face has 2 corners"),
        ("f 1 2 3", "3 faces share the edge"),
        ("f 7 5 1 3", "both run"),
        ("v nan 0 0", "NaN"),
    ],
)
def test_a_damaged_cage_is_refused_in_one_line_that_names_the_file(tmp_path, line, expected):
    path = tmp_path / "cage.obj"
    vertices, faces = cube()
    lines = [f"v {x} {y} {z}" for x, y, z in vertices] + ["f " + " ".join(str(i + 1) for i in f) for f in faces[:5]]
    path.write_text("\n".join([*lines, line]))
    with pytest.raises(InputError, match=expected) as error:
        rts.load(path, surface="subdivision")
    assert "cage.obj" in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize("name", ["pawn", "rook", "nonquads", "chaikin0"])
def test_real_cages_are_drawn(name, data):
    (part,) = rts.load(data / "cages" / f"catmark_{name}.obj", surface="subdivision")
    vertices = part.theta["vertices"]
    middle, extent = vertices.mean(axis=0), np.ptp(vertices, axis=0).max()
    camera = Camera.look_at(middle + extent * np.array([0.7, 0.6, 1.3]), middle, near=0.1 * extent, far=10 * extent)
    image = rts.render(part, camera, SIZE)
    assert np.isfinite(image).all() and image[..., 3].mean() > 0.02
