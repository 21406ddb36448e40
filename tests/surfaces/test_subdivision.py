"""Subdivision surfaces: against plain subdivision and its limit masks, their derivatives, attributes, files."""

import pickle

import numpy as np
import pytest
from cages import CAGES, cube, limit_of, prism, samples_at, sheet, somewhere
from helpers import DIFFERENTIABLE, arrays, gradient, to_numpy
from scipy.spatial import cKDTree
from subdivision_reference import Cage, limit_samples

import rts
from rts import Camera, InputError, Part

pytestmark = pytest.mark.sampling

try:
    Subdivision = rts.plugin("surfaces", "subdivision")
except rts.errors.PluginError as missing:
    pytest.skip(str(missing), allow_module_level=True)

from rts_surfaces.subdivision.binding import UV, Limit, Rules  # noqa: E402
from rts_surfaces.subdivision.cage_checks import checked_cage  # noqa: E402
from rts_testing.compatibility import BORDER  # noqa: E402

SIZE = (60, 80)
CAMERA = Camera.look_at((1.5, 1.8, 4.0), (0, 0, 0), fov_y=40)
cages = pytest.mark.parametrize("name", CAGES)


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


@pytest.mark.parametrize("creases", [[], [(4, 5, 7)], [(4, 5, 7), (5, 7, 7), (5, 1, 7)]])
def test_limit_points_close_to_a_vertex_are_those_of_subdivision(creases):
    # Ten steps, of which faces at one vertex are kept; later than Bfr's defaults, and than semi-sharp creases end.
    vertices, faces = cube()
    cage, at = Cage(vertices, faces, "catmark", creases), 5
    for _ in range(10):
        cage, at = cage.refined().around(at)
    vertex, face, params = cage.samples(len(cage.vertices))
    beside = np.isin(vertex, [v for f in cage.faces if at in f for v in f])
    expected = cage.limit()[vertex[beside]]
    found = Limit(checked_cage(faces, "catmark", creases)).points(vertices).evaluate(face[beside], params[beside])[:, 0]
    assert len(expected) > 20
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-7)


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
    sampled = rts.sample(part, Camera.look_at((2, 2, 9), (2, 2, 0), up=(0, 1, 0)), SIZE, splatter=None).samples[0]
    inner = np.flatnonzero(surface.limit.kinds >= 0)
    assert np.isin(sampled.ids[np.unique(sampled.row[sampled.row >= 0]), 0], inner).all()
    gbuffer = surface.evaluate(part.theta, samples_at(np.arange(16), np.full((16, 2), 0.5)))
    assert np.isfinite(gbuffer["normal"]).all()
    with pytest.raises(InputError, match="no face of the cage has a surface"):
        Subdivision(faces[:1], boundary="none")


# -------------------------------------------------------------------------------------------- evaluation


def test_weights_of_samples_that_come_again_are_as_before():
    limit = limit_of("creased")[1]
    face, params = (np.repeat(x, 3, axis=0) for x in somewhere(limit, 20))
    face[1::3], params[2::3, 1] = (face[1::3] + 1) % 6, 0.25
    for found in (limit.stencils, limit.derivative_stencils):
        alone = [found(face[i : i + 1], params[i : i + 1], np.float32) for i in range(len(face))]
        np.testing.assert_array_equal(found(face, params, np.float32), np.concatenate(alone, axis=-2))


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


# ---------------------------------------------------------------------------------------------- files


def test_a_cage_from_a_file_has_its_tags_polygons_and_map(tmp_path):
    path = tmp_path / "cage.obj"
    vertices, faces = prism(5)
    lines = [f"v {x} {y} {z}" for x, y, z in vertices] + [f"vt {x} {y}" for x, y, _ in vertices]
    lines += ["f " + " ".join(f"{i + 1}/{i + 1}" for i in f) for f in faces]
    lines += ["t crease 2/1/0 0 1 2.5", "t crease 4/2/0 5 6 6 7 3.0 10.0", "t corner 1/1/0 3 1.5"]
    lines += ["t interpolateboundary 1/0/0 2", "t creasemethod 0/0/1 chaikin", "t hole 1/0/0 3"]
    lines += ["t smoothtriangles 0/0/0"]
    path.write_text("\n".join(lines))
    with pytest.warns(rts.errors.FileWarning, match="line 34: the tag 'smoothtriangles' is not followed"):
        (part,) = rts.load(path, surface="subdivision")
    cage = part.surface.cage
    assert cage.sizes.tolist() == [5, 5, 4, 4, 4, 4, 4]
    assert cage.creases.tolist() == [[0, 1], [5, 6], [6, 7]] and cage.crease_sharpness.tolist() == [2.5, 3, 10]
    assert cage.corners.tolist() == [3] and cage.corner_sharpness.tolist() == [1.5]
    assert cage.holes.tolist() == [3]
    assert part.surface._rules == Rules("edge_only", True)
    assert part.theta["uv"].shape == (10, 2)
    image = rts.render(part, CAMERA, SIZE)
    assert 0.05 < image[..., 3].mean() < 0.9


def test_a_hole_of_a_flat_sheet_is_empty_and_all_else_as_without_it(tmp_path):
    # The limit of an even flat grid is the plane, and each face its own square.
    path, (vertices, faces) = tmp_path / "cage.obj", sheet(4, 4)
    vertices[:, 2] = 0.25 * vertices[:, 0]
    lines = [f"v {x} {y} {z}" for x, y, z in vertices] + ["f " + " ".join(str(i + 1) for i in f) for f in faces]
    path.write_text("\n".join([*lines, "t hole 1/0/0 4"]))
    (loaded,) = rts.load(path, surface="subdivision")
    camera, size = rts.Camera.orthographic((1.5, 1.5, 5), (1.5, 1.5, 0), height=4), (41, 41)
    rays = camera.with_border(size, BORDER).rays((41 + 2 * BORDER, 41 + 2 * BORDER))
    x, y = rays.origins[..., 0], rays.origins[..., 1]
    inside = (np.abs(x - 1.5) < 1.5) & (np.abs(y - 1.5) < 1.5)
    hole = (np.abs(x - 1.5) < 0.5) & (np.abs(y - 1.5) < 0.5)
    assert hole.sum() > 90
    for surface in (loaded.surface, Subdivision(faces, holes=[4]), Subdivision(faces, holes=np.array([4, 4]))):
        samples = rts.sample(loaded.replace(surface=surface), camera, size, layers=1, splatter=None)
        np.testing.assert_array_equal(samples.row[0] >= 0, inside & ~hole)
        np.testing.assert_allclose(samples.depth[0][inside & ~hole], (5 - 0.25 * x)[inside & ~hole], atol=1e-5)
    again = pickle.loads(pickle.dumps(loaded.surface))
    assert again.cage.holes.tolist() == [4]


def test_a_hole_leaves_the_surface_beside_it_as_it_is():
    vertices, faces = cube()
    part = rts.Part(Subdivision(faces), {"vertices": vertices.astype(np.float32)}, "normals")
    holed = part.replace(surface=Subdivision(faces, holes=[1]))
    found = []
    for given in (part, holed):
        samples = rts.sample(given, CAMERA, SIZE, layers=4, splatter=None).samples[0]
        layer, y, x = np.nonzero(samples.row >= 0)
        row = samples.row[layer, y, x]
        position = given.surface.evaluate(given.theta, samples)["position"][row]
        found.append({(*at, f): p for *at, f, p in zip(y, x, samples.ids[row, 0].tolist(), position, strict=True)})
    left = {key: p for key, p in found[0].items() if key[2] != 1}
    assert len(left) < len(found[0]) and len(found[1]) > 100
    # On edges either face may have the sample.
    same = left.keys() & found[1].keys()
    assert len(same) > 0.99 * len(left) and len(same) > 0.99 * len(found[1])
    assert not any(key[2] == 1 for key in found[1])
    np.testing.assert_allclose([left[k] for k in same], [found[1][k] for k in same], atol=1e-5)


@pytest.mark.parametrize(
    "holes, message",
    [
        ([6], "from 0 to 5"),
        ([-1], "from 0 to 5"),
        ([[0]], "expected numbers of faces"),
        ([0.5], "expected numbers of faces"),
        (3, "expected numbers of faces"),
        (list(range(6)), "all are holes"),
    ],
)
def test_holes_that_are_no_faces_are_refused(holes, message):
    with pytest.raises(InputError, match=message):
        Subdivision(cube()[1], holes=holes)


@pytest.mark.parametrize(
    "line, expected",
    [
        ("t crease 2/1/0 0 1", "is no tag"),
        ("t crease 2/1 0 1 2", "is no tag"),
        ("t crease 2/1/0 0 x 2", "is no tag"),
        ("t crease 2/1/0 0 1 nan", "is no tag"),
        ("t crease 1/1/0 0 2", "is no tag"),
        ("t", "is no tag"),
        ("t hole 0/0/0", "is no tag"),
        ("t hole 1/0/0 5", r"holes is \[5\]; expected numbers of faces, from 0 to 4"),
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
