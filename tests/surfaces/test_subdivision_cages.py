"""Cages that have no limit surface are refused in one line; random ones never end the process.

A share of random cages is tried. `RTS_CAGES=10000` tries that many.
"""

import os
import resource
import sys
import weakref

import numpy as np
import pytest
from cages import ball, cube, prism, sheet, somewhere
from helpers import quick, refused

import rts
from rts import InputError

pytestmark = pytest.mark.sampling

try:
    Subdivision = rts.plugin("surfaces", "subdivision")
except rts.errors.PluginError as missing:
    pytest.skip(str(missing), allow_module_level=True)

from rts_surfaces.subdivision.binding import Limit, Rules  # noqa: E402
from rts_surfaces.subdivision.cage_checks import checked_cage  # noqa: E402

COUNT = int(os.environ.get("RTS_CAGES", "600"))
STEP = 200
CUBE, BALL = cube()[1], ball()[1]
FAN = [[0, 1, 2, 3], [0, 4, 5, 6]]


def spider(corners, legs):
    """A polygon with a fan of triangles about each corner."""
    free = iter(range(corners, 10**6))
    faces = [list(range(corners))]
    for i in range(corners):
        tips = [next(free) for _ in range(legs + 1)]
        faces += [[a, i, b] for a, b in zip(tips, tips[1:], strict=False)]
        faces.append([(i + 1) % corners, i, tips[0]])
    return faces


def changed(faces, place, face):
    return [face if i == place else f for i, f in enumerate(faces)]


@pytest.mark.parametrize(
    "faces, options, expected",
    [
        ([], {}, "faces is empty"),
        ([[]], {}, "faces without corners"),
        ("abc", {}, "faces is 'abc'; expected lists of integers"),
        ([[0, 1, 2], 7], {}, "expected lists of integers"),
        ([[0, 1, 2.5]], {}, "expected integers"),
        ([[0, 1, "a"]], {}, "expected integers|expected lists"),
        (np.zeros(3, int), {}, r"has shape \(3,\)"),
        (np.zeros((2, 4)), {}, "expected integers"),
        ([[0, 1, -2]], {}, "holds the index -2; indices count from 0"),
        ([[0, 1, 2**31]], {}, r"less than 2\*\*27"),
        ([[0, 1], *CUBE], {}, "face 0 of the cage has 2 corners"),
        ([[0, 1, 2, 1]], {}, "face 0 of the cage has the vertex 1 at two corners"),
        (CUBE, {"scheme": "loop"}, "Loop needs triangles"),
        (CUBE, {"scheme": "bilinear"}, "scheme is 'bilinear'"),
        ([*CUBE, [0, 2, 9, 8]], {}, "3 faces share the edge of vertices"),
        (changed(CUBE, 2, CUBE[2][::-1]), {}, "both run from vertex"),
        ([[0, 1, 2], [2, 1, 0]], {}, "faces 0 and 1 share 3 edges|which is inside"),
        ([[0, 1, 2, 3], [2, 1, 4, 0], [3, 2, 0, 4]], {}, "only faces|share"),
        ([[0, 1, 5, 4], [1, 0, 4, 5]], {}, "share|which is inside"),
        ([[0, 1, 3, 2], [1, 0, 2, 3]], {}, "share|which is inside"),
        (FAN, {}, "vertex 0 joins 2 fans of faces"),
        ([*CUBE, [0, 8, 9, 10], [0, 10, 11, 12]], {}, "vertex 0 joins 2 fans"),
        (prism(3000)[1], {}, "face 0 has 3000 corners; expected at most 256"),
        ([[i, (i + 1) % 3000, 3000] for i in range(3000)], {}, "3000 faces meet at vertex 3000; expected at most 256"),
        (spider(120, 40), {}, "the faces that touch face 0 have [0-9]+ corners; expected at most 2000"),
        (CUBE, {"creases": [(0, 3, 1)]}, "creases name the edge of vertices 0 and 3, but no face has it"),
        (CUBE, {"creases": [(0, 99, 1)]}, "creases name the edge of vertices 0 and 99"),
        (CUBE, {"creases": [(0, 1, np.nan)]}, "finite"),
        (CUBE, {"creases": [(0, 1, np.inf)]}, "finite"),
        (CUBE, {"creases": [(0, 1, -1)]}, "sharpness -1"),
        (CUBE, {"creases": [(0, 1)]}, "expected rows"),
        (CUBE, {"creases": [(0.5, 1, 1)]}, "whole numbers"),
        (CUBE, {"creases": 3}, "expected rows"),
        (CUBE, {"corners": [(9, 1)]}, "corners name the vertex 9, but no face has it"),
        (CUBE, {"corners": [(0, 1), (2,)]}, "expected rows"),
        (CUBE, {"corners": [(-1, 1)]}, "whole numbers"),
        (CUBE, {"boundary": "soft"}, "boundary is 'soft'; expected one of 'none', 'edge_only', 'edge_and_corner'"),
        (CUBE, {"boundary": 3}, "boundary is 3"),
        (CUBE, {"uv_rule": "x"}, "uv_rule is 'x'"),
        (CUBE, {"chaikin": "yes"}, "expected True or False"),
        (CUBE, {"tolerance": 0}, "tolerance is 0"),
        (CUBE, {"indices": [1]}, "expected a dict"),
        (CUBE, {"indices": {"colors": CUBE}}, "expected None; only 'uv' has lists"),
        (CUBE, {"indices": {"uv": CUBE[:5]}}, "faces of other sizes"),
        (CUBE, {"indices": {"uv": changed(CUBE, 0, [0, 1, 2, -1])}}, r"indices\['uv'\] holds the index -1"),
    ],
)
def test_what_has_no_limit_surface_is_refused_in_one_line(faces, options, expected):
    with refused(expected) as error:
        Subdivision(faces, **options)
    assert len(str(error.value)) < 250


def test_faces_that_share_two_edges_around_a_vertex_are_told_from_others():
    with pytest.raises(InputError, match="only faces 0 and 1 meet at vertex 4, which is inside the cage"):
        Subdivision([[0, 1, 4, 3], [1, 2, 3, 4]])
    # A ring of two faces.
    with pytest.raises(InputError, match="faces 0 and 1 share 2 edges; expected at most one"):
        Subdivision([[0, 1, 2, 3], [1, 0, 4, 3, 2, 5]])


@pytest.mark.parametrize("target", ["torch", "jax"])
def test_indices_of_every_engine_are_taken(target):
    faces = np.array(CUBE)
    given = (
        pytest.importorskip(target).tensor(faces)
        if target == "torch"
        else pytest.importorskip("jax").numpy.asarray(faces)
    )
    np.testing.assert_array_equal(Subdivision(given).cage.indices, faces.reshape(-1))


def test_traced_indices_are_refused():
    jax = pytest.importorskip("jax")
    with pytest.raises(InputError, match="traced"):
        jax.jit(lambda faces: Subdivision(faces) and 0)(np.array(CUBE))


@pytest.mark.parametrize(
    "theta, expected",
    [
        ({}, "has no 'vertices'"),
        ({"vertices": np.zeros((7, 3), np.float32)}, "7 rows, but its faces refer to row 7"),
        ({"vertices": np.zeros((8, 2), np.float32)}, "expected \\(rows, 3\\)"),
        ({"vertices": np.zeros((8, 3), int)}, "floating"),
        ({"vertices": np.full((8, 3), np.nan, np.float32)}, "8 control points"),
        ({"vertices": cube()[0], "colors": np.zeros((8, 2))}, "expected \\(rows, 1 or 3 or 4\\)"),
        ({"vertices": cube()[0], "uv": np.zeros((8, 2))}, "8 rows, but its faces refer to row 23"),
    ],
)
def test_parameters_that_do_not_fit_are_refused(theta, expected):
    surface = Subdivision(CUBE, indices={"uv": np.arange(24).reshape(6, 4)})
    part = rts.Part(surface, theta, "silhouette")
    with pytest.raises(InputError, match=expected):
        rts.render(part, rts.Camera.look_at((0, 0, 5), (0, 0, 0)), (8, 8))


# ------------------------------------------------------------------------------------------------ random cages


def base(rng):
    kind = rng.integers(5)
    vertices, faces = (
        cube()
        if kind == 0
        else ball()
        if kind == 1
        else prism(int(rng.integers(3, 9)))
        if kind == 2
        else sheet(*map(int, rng.integers(2, 6, 2)))
    )
    scheme = "loop" if kind == 1 and rng.random() < 0.7 else "catmark"
    faces = [list(f) for f in faces]
    if rng.random() < 0.4:
        for _ in range(rng.integers(1, 4)):
            if len(faces) > 1:
                faces.pop(int(rng.integers(len(faces))))
    if scheme == "catmark" and rng.random() < 0.5:  # Some faces in two: a quadrilateral into triangles, and so on.
        for i in range(len(faces)):
            f = faces[i]
            if len(f) > 3 and rng.random() < 0.3:
                cut = int(rng.integers(2, len(f) - 1))
                faces[i], more = f[: cut + 1], [*f[cut:], f[0]]
                faces.append(more)
    return vertices, faces, scheme


def tags(rng, faces):
    sharp = [0.3, 1.0, 2.7, 4.0, 10.0]
    sides = [(f[i], f[(i + 1) % len(f)]) for f in faces for i in range(len(f))]
    creases = [(*sides[i], rng.choice(sharp)) for i in rng.integers(0, len(sides), rng.integers(0, 6))]
    corners = [(rng.choice(faces[i]), rng.choice(sharp)) for i in rng.integers(0, len(faces), rng.integers(0, 3))]
    return creases, corners


def broken(rng, faces, creases, corners):
    """A rule broken, or perhaps not: it may be that all is still well."""
    i, top = int(rng.integers(len(faces))), max(map(max, faces)) + 1
    kind = rng.integers(14)
    if kind == 0:
        faces[i][0] = faces[i][-1]
    elif kind == 1:
        faces[i] = faces[i][:2]
    elif kind == 2:
        faces[i] = faces[i][::-1]
    elif kind == 3:
        faces.append(list(faces[i]))
    elif kind == 4:
        faces.append([faces[i][0], top, top + 1])
    elif kind == 5:
        faces.append([faces[i][1], faces[i][0], top, top + 1][: 3 + int(rng.integers(2))])
    elif kind == 6:  # A vertex on an edge, in the faces beside it: of valence 2.
        a, b = faces[i][:2]
        for f in faces:
            for k in range(len(f)):
                if {f[k], f[(k + 1) % len(f)]} == {a, b}:
                    f.insert(k + 1, top)
                    break
    elif kind == 7:
        creases.append((int(rng.integers(-1, top + 2)), int(rng.integers(top + 2)), 1.0))
    elif kind == 8:
        creases.append((faces[i][0], faces[i][1], rng.choice([np.nan, np.inf, -1.0])))
    elif kind == 9:
        corners.append((int(rng.integers(-1, top + 2)), rng.choice([1.0, np.nan])))
    elif kind == 10:
        faces[i][0] = int(rng.choice([-1, 2**31, 10**6]))
    elif kind == 11:  # Two vertices become one.
        a, b = rng.integers(0, top, 2)
        faces = [[a if v == b else v for v in f] for f in faces]
    elif kind == 12:
        faces[i] = []
    else:  # The face beside is the same one, folded.
        faces.append(faces[i][::-1])
    return faces, creases, corners


@pytest.mark.parametrize("first", quick(range(0, COUNT, STEP)))
def test_random_cages_give_a_clear_line_or_finite_points(first):
    refused = made = 0
    for number in range(first, min(first + STEP, COUNT)):
        rng = np.random.default_rng(number)
        _, faces, scheme = base(rng)
        creases, corners = tags(rng, faces)
        if number % 2:
            faces, creases, corners = broken(rng, faces, creases, corners)
        boundary = str(rng.choice(["none", "edge_only", "edge_and_corner"], p=[0.1, 0.3, 0.6]))
        sizes = [len(f) for f in faces]
        rows = np.split(rng.integers(0, 9, sum(sizes)), np.cumsum(sizes)[:-1])
        uv = {"uv": [r.tolist() for r in rows]} if rng.random() < 0.3 else None
        try:
            surface = Subdivision(
                faces, scheme, creases=creases, corners=corners, boundary=boundary, chaikin=bool(number % 3), indices=uv
            )
        except InputError as error:
            refused += 1
            assert "\n" not in str(error), number
            continue
        made += 1
        count = max(map(max, faces)) + 1
        vertices = rng.normal(size=(count, 3))
        face, params = somewhere(surface.limit, 30, number)
        points = surface.limit.points(vertices)
        found = points.evaluate(face, params, 2)
        weights = np.array([surface.limit.stencils(face, params), *surface.limit.derivative_stencils(face, params)])
        assert np.isfinite(found).all() and np.isfinite(weights).all(), number
        np.testing.assert_allclose(weights.sum(axis=2), np.array([1, 0, 0])[:, None] + np.zeros((1, 30)), atol=1e-6)
        directions = rng.normal(size=(30, 3))
        points.newton(
            face, params, found[:, 0] - directions, directions, np.array([1e-3, 0]), (1e-4, 10, 0.25, 0.02, 4)
        )
        assert len(surface.tessellate({"vertices": vertices}, 2)[1])
        if uv:
            assert np.isfinite(surface.limit.stencils(face, params, channel=1)).all()
    assert made > STEP / 8 and refused > STEP / 8


@pytest.mark.thorough
def test_cages_that_are_made_and_freed_leave_nothing_behind():
    vertices, faces = cube()
    cage = checked_cage(faces, "catmark", [(0, 1, 2.5), (1, 3, 10)])

    def memory():
        if sys.platform != "linux":
            return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        with open("/proc/self/statm") as file:
            return int(file.read().split()[1]) * resource.getpagesize()

    def some(count):
        for _ in range(count):
            limit = Limit(cage, Rules())
            limit.points(vertices).evaluate(np.zeros(1, int), np.zeros((1, 2)))

    some(200)
    before = memory()
    some(1000)
    # A cage of these takes a hundred kilobytes.
    assert memory() - before < 10e6


def test_points_outlive_the_name_of_their_surface():
    points = Limit(checked_cage(CUBE, "catmark")).points(cube()[0])
    assert np.isfinite(points.evaluate(np.zeros(9, int), np.zeros((9, 2)))).all()
    with pytest.raises(InputError, match="faces 6 to 6 of 6"):
        points.evaluate(np.array([6]), np.zeros((1, 2)))
    with pytest.raises(InputError, match="NaN"):
        points.evaluate(np.array([0]), np.full((1, 2), np.nan))


@pytest.mark.parametrize("corners", [3, 4, 5, 11])
def test_parameters_far_outside_of_a_face_are_refused(corners):
    vertices, faces = prism(corners)
    limit = Limit(checked_cage(faces, "catmark"))
    points = limit.points(vertices)
    rays = np.zeros((1, 3)), np.array([[0.0, 0, 1]]), np.array([1e-3, 0]), (1e-4, 6, 0.25, 0.02, 4)
    refused = 0
    for x in (-1e30, -7.0, -0.2, 0.7, 1.6, 2.4, 3.4, 4.0, 255.0, 1e5, 1e30):
        for y in (0.1, x):
            for call in (
                lambda at: points.evaluate([0], at, 2),
                lambda at: limit.stencils([0], at),
                lambda at: limit.derivative_stencils([0], at),
                lambda at: points.newton([0], at, *rays),
            ):
                try:
                    assert all(np.isfinite(found).all() for found in call([[x, y]]))
                except InputError as error:
                    refused += "far outside" in str(error)
    assert refused >= 4 * 12


def test_what_is_huge_or_flat_is_not_met_and_harms_nothing():
    vertices, faces = prism(5)
    limit = Limit(checked_cage(faces, "catmark"))
    face, params = somewhere(limit, 50)
    directions = np.random.default_rng(0).normal(size=(50, 3))
    for scale in (0.0, 1e-200, 1e-30, 1e30, 1e150, 1e200):
        points = limit.points(scale * vertices)
        limits = np.array([1e-3 * scale, 0]), (1e-4, 10, 0.25, 0.02, 4)
        found, at, depth, met = points.newton(face, params, -directions, directions, *limits)
        assert np.isin(found, range(7)).all() and np.isfinite(at).all()
        assert np.isfinite(depth[met]).all()


@pytest.mark.parametrize("first", ["limit", "points"])
def test_points_that_die_with_their_cage_leave_nothing_behind(first):
    limit = Limit(checked_cage(CUBE, "catmark"))
    owners, left = {"limit": limit, "points": limit.points(cube()[0])}, limit._left
    # As the collector may do it with a cycle: in any order.
    for name in sorted(owners, key=first.__ne__):
        (own,) = [f for f in list(weakref.finalize._registry) if f.peek() and f.peek()[0] is owners[name]]
        own()
    assert left == [0]


def test_samples_and_vertices_that_do_not_fit_are_refused():
    limit = Limit(checked_cage(CUBE, "catmark"))
    with pytest.raises(InputError, match=r"10 faces and parameters of shape \(2, 2\)"):
        limit.stencils(np.zeros(10, int), np.zeros((2, 2)))
    with pytest.raises(InputError, match=r"parameters of shape \(10, 1\)"):
        limit.stencils(np.zeros(10, int), np.zeros((10, 1)))
    with pytest.raises(InputError, match=r"vertices have shape \(7, 3\); expected \(V, 3\), V at least 8"):
        limit.points(cube()[0][:7])
    ray = np.zeros((2, 3))
    with pytest.raises(InputError, match="rays and limits"):
        limit.points(cube()[0]).newton(np.zeros(3, int), np.zeros((3, 2)), ray, ray, np.ones(2), (1, 1, 1, 1, 1))


def test_no_more_triangles_are_made_than_memory_holds():
    row = np.arange(180)
    quads = np.stack([row, row + 1, row + 182, row + 181], axis=-1)
    faces = (quads[None] + 181 * row[:, None, None]).reshape(-1, 4)
    vertices = np.random.default_rng(0).normal(size=(181 * 181, 3))
    with pytest.raises(InputError, match="32400 patches make 4246732800 triangles; expected fewer"):
        Subdivision(faces).tessellate({"vertices": vertices}, 256)


@pytest.mark.parametrize("name", ["vertices", "position", "normals"])
def test_attributes_cannot_have_names_that_mean_something_else(name):
    with pytest.raises(InputError, match=f"indices declares '{name}'"):
        Subdivision(CUBE, indices={name: None})


def test_a_cage_with_several_materials_is_warned_of(tmp_path):
    lines = [*(f"v {x} {y} {z}" for x, y, z in cube()[0]), *("f " + " ".join(str(i + 1) for i in f) for f in CUBE)]
    lines.insert(9, "usemtl one")
    lines.insert(11, "usemtl two")
    (tmp_path / "cage.obj").write_text("\n".join(lines) + "\n")
    with pytest.warns(rts.errors.FileWarning, match="materials, of which a cage can have but one"):
        rts.load(tmp_path / "cage.obj", surface="subdivision")
