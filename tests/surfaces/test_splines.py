"""Bézier and B-spline surfaces: against closed forms and an independent library, their triangles, their samples."""

import numpy as np
import pytest
from helpers import DIFFERENTIABLE, TORCH, arrays, open_edges, refused, samples_at, to_numpy

import rts
from rts import Camera, InputError, Part
from rts_surfaces.patches import tile_triangles
from rts_surfaces.patches.bspline import extraction
from rts_testing.compatibility import BORDER

pytestmark = pytest.mark.sampling

Bezier, BSpline, Revolution = (rts.plugin("surfaces", name) for name in ("bezier", "bspline", "revolution"))
SIZE = (60, 80)
CAMERA = Camera.look_at((1.5, 1.8, 3.0), (0, 0, 0), fov_y=40)
PATCH = np.arange(16)[None]


def at(surface, points, patch, params):
    """The G-buffer at parameters (N, 2) of patches (N,), in float64."""
    samples = samples_at(patch, np.asarray(params, np.float64))
    return surface.evaluate({"points": np.asarray(points, np.float64)}, samples)


def derivatives(surface, points, patch, params):
    """Points and derivatives along u and v, (N, 3, 3), as Newton's method has them."""
    return surface.geometry(np.asarray(points, np.float64)).points(np.asarray(patch), params, 2)[:, :3]


def grid(nu, nv, seed=0):
    rng = np.random.default_rng(seed)
    place = np.stack(np.meshgrid(np.linspace(-1, 1, nu), np.linspace(-1, 1, nv), indexing="ij"), axis=-1)
    return np.concatenate([place, 0.2 * rng.normal(size=(nu, nv, 1))], axis=-1)


def cubic(f, count=4):
    """Bézier points (16, 3) of the graph of a polynomial of degree 3 at most in each of x, y over [0, 1]²."""
    t = np.linspace(0, 1, count)
    basis = np.stack([(1 - t) ** 3, 3 * t * (1 - t) ** 2, 3 * t * t * (1 - t), t**3], axis=-1)
    x, y = np.meshgrid(t, t, indexing="ij")
    values = np.stack([x, y, f(x, y)], axis=-1)
    back = np.linalg.inv(basis)
    return np.einsum("ai,bj,ijc->abc", back, back, values).reshape(16, 3)


def paraboloid(x, y):
    return x * x - 0.7 * y * y + 0.4 * x * y


# ----------------------------------------------------------------------------------- against another library


@pytest.mark.parametrize("shape", [(4, 4), (5, 8), (9, 6)])
@pytest.mark.parametrize("ends", ["open", "clamped"])
def test_points_and_derivatives_of_b_splines_are_those_of_geomdl(shape, ends):
    geomdl = pytest.importorskip("geomdl.BSpline")
    points, surface = grid(*shape), BSpline(shape, ends)
    other = geomdl.Surface(normalize_kv=False)
    other.degree_u = other.degree_v = 3
    other.set_ctrlpts(points.reshape(-1, 3).tolist(), *shape)
    spans = [n - 3 for n in shape]
    knots = [np.arange(-3.0, s + 4) for s in spans]
    if ends == "clamped":
        knots = [k.clip(0, s) for k, s in zip(knots, spans, strict=True)]
    other.knotvector_u, other.knotvector_v = (k.tolist() for k in knots)
    rng = np.random.default_rng(1)
    params = np.concatenate([rng.random((40, 2)), [(0.0, 0.0), (0.25, 0.5)]])
    place = np.stack([rng.integers(0, s, len(params)) for s in spans], axis=-1)
    patch = place[:, 0] * spans[1] + place[:, 1]
    expected = np.array([other.derivatives(*(p + i), order=1) for p, i in zip(params, place, strict=True)], object)
    expected = np.array([[d[0][0], d[1][0], d[0][1]] for d in expected], np.float64)
    np.testing.assert_allclose(at(surface, points, patch, params)["position"], expected[:, 0], rtol=0, atol=1e-12)
    np.testing.assert_allclose(derivatives(surface, points, patch, params), expected, rtol=0, atol=1e-12)


def test_points_and_derivatives_of_bezier_patches_are_those_of_geomdl():
    geomdl = pytest.importorskip("geomdl.BSpline")
    points = np.random.default_rng(0).normal(size=(16, 3))
    other = geomdl.Surface()
    other.degree_u = other.degree_v = 3
    other.set_ctrlpts(points.tolist(), 4, 4)
    other.knotvector_u = other.knotvector_v = [0, 0, 0, 0, 1, 1, 1, 1]
    params = np.random.default_rng(1).random((40, 2))
    expected = [other.derivatives(*p, order=1) for p in params]
    expected = np.array([[d[0][0], d[1][0], d[0][1]] for d in expected])
    zeros = np.zeros(40, int)
    np.testing.assert_allclose(at(Bezier(PATCH), points, zeros, params)["position"], expected[:, 0], atol=1e-12)
    np.testing.assert_allclose(derivatives(Bezier(PATCH), points, zeros, params), expected, rtol=0, atol=1e-12)
    normal = np.cross(expected[:, 1], expected[:, 2])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    np.testing.assert_allclose(at(Bezier(PATCH), points, zeros, params)["normal"], normal, atol=1e-10)


def test_a_periodic_spline_is_an_open_one_of_points_that_come_again():
    points = grid(5, 6)
    again = np.concatenate([points, points[:3]], axis=0)
    periodic, plain = BSpline((5, 6), ("periodic", "open")), BSpline((8, 6), "open")
    params = np.random.default_rng(1).random((30, 2))
    patch = np.random.default_rng(2).integers(0, 15, 30)
    np.testing.assert_allclose(
        at(periodic, points, patch, params)["position"], at(plain, again, patch, params)["position"], atol=1e-14
    )


def test_attributes_that_are_affine_in_the_points_are_so_on_the_surface():
    points, surface = grid(6, 5), BSpline((6, 5), "clamped")
    theta = {"points": points, "colors": 0.5 + 0.3 * points, "uv": points[..., :2] * 2}
    samples = rts.sample(Part(surface, theta), CAMERA, SIZE, splatter=None).samples[0]
    gbuffer = surface.evaluate(theta, samples)
    np.testing.assert_allclose(gbuffer["color"], 0.5 + 0.3 * gbuffer["position"], atol=1e-12)
    np.testing.assert_allclose(gbuffer["uv"], 2 * gbuffer["position"][:, :2], atol=1e-12)


# -------------------------------------------------------------------------------------------- closed forms


@pytest.mark.parametrize("target", ["numpy", *DIFFERENTIABLE])
@pytest.mark.parametrize("camera", [CAMERA, Camera.orthographic((1.5, 1.8, 3.0), (0.4, 0.4, 0), height=2.5)])
def test_samples_lie_on_the_graph_of_a_polynomial_with_its_normals(camera, target):
    surface = Bezier(PATCH)
    theta = {"points": cubic(paraboloid)}
    samples = rts.sample(Part(surface, theta), camera, SIZE, splatter=None).samples[0]
    used = np.unique(samples.row[samples.row >= 0])
    assert len(used) > 300
    gbuffer = surface.evaluate(arrays(target, theta, np.float64), samples)
    position, normal = (to_numpy(gbuffer[name])[used].astype(np.float64) for name in ("position", "normal"))
    x, y, z = position.T
    atol = 1e-6 if target == "jax" else 1e-12
    np.testing.assert_allclose(z, paraboloid(x, y), atol=atol)
    expected = np.stack([-2 * x - 0.4 * y, 1.4 * y - 0.4 * x, np.ones_like(x)], axis=-1)
    np.testing.assert_allclose(normal, expected / np.linalg.norm(expected, axis=1, keepdims=True), atol=10 * atol)


def test_samples_reproject_to_the_centres_of_their_pixels():
    for part in (Bezier.example(), BSpline.example()):
        sampled = rts.sample(part, CAMERA, SIZE, splatter=None)
        position = at_samples(part, sampled.samples[0])
        cells = np.argwhere(sampled.row >= 0)
        wide = CAMERA.for_size(SIZE).with_border(SIZE, BORDER)
        pixels = wide.project(position[sampled.row[tuple(cells.T)]], sampled.row.shape[1:])
        off = np.abs(pixels[:, :2] - cells[:, :0:-1] - 0.5).max(axis=1)
        # float32 for u and v; the compiled splatters ask for 2.5e-4.
        assert off.max() < 2.5e-4
        np.testing.assert_allclose(pixels[:, 2], sampled.depth[tuple(cells.T)], rtol=1e-6)


def at_samples(part, samples):
    return part.surface.evaluate({"points": part.theta["points"].astype(np.float64)}, samples)["position"]


@pytest.mark.parametrize("side", range(4))
def test_where_a_side_is_a_point_the_normal_is_the_limit(side):
    # A dome of revolution about z, nearly: x and y grow with the distance from the side that is a point.
    t = np.linspace(0, 1, 4)
    arc = np.array([(1, 0), (1, 0.6), (0.6, 1), (0, 1)])
    net = np.stack(
        [np.concatenate([r * arc, np.full((4, 1), z)], axis=1) for r, z in zip(t, (1, 1, 0.8, 0.4), strict=True)]
    )
    turned = [net, net[::-1], net.transpose(1, 0, 2), net.transpose(1, 0, 2)[:, ::-1]][side]
    outward = 1 if side in (0, 3) else -1
    params = np.array([(d, v) for d in (0.0, 1e-12, 1e-7, 1e-5, 1e-3) for v in (0.0, 0.3, 1.0)])
    params = [params, params * [-1, 1] + [1, 0], params[:, ::-1], params[:, ::-1] * [1, -1] + [0, 1]][side]
    found = at(Bezier(PATCH), turned.reshape(16, 3), np.zeros(len(params), int), params)["normal"]
    assert np.isfinite(found).all()
    np.testing.assert_allclose(found * outward, np.tile([0.0, 0, 1], (len(params), 1)), atol=5e-3)
    theta = {"points": turned.reshape(16, 3).astype(np.float32)}
    narrow = Bezier(PATCH).evaluate(theta, samples_at(np.zeros(len(params)), params.astype(np.float32)))["normal"]
    np.testing.assert_allclose(narrow, found, atol=5e-3)


# ----------------------------------------------------------------------------------------------- triangles


VIEWS = {
    "all in sight": CAMERA,
    "near": Camera.look_at((0.9, 0.3, 0.9), (0, 0.3, 0), fov_y=30),
    "inside": Camera.look_at((0, 0.2, 0), (0.4, 0.3, 0.1), fov_y=70, near=1e-3),
    "parallel": Camera.orthographic((1.5, 1.8, 3.0), (0, 0, 0), height=3.0),
    "far": Camera.look_at((100.0, 150.0, 200.0), (0, 0, 0), fov_y=2.0),
}


@pytest.mark.parametrize("view", VIEWS)
def test_triangles_meet_without_cracks_whatever_their_rates(view):
    part = BSpline.example()
    camera = VIEWS[view].for_size(SIZE)
    proxy = part.surface.proxy(part.theta["points"], camera, SIZE)
    # The vase is open at its two ends only.
    ends = open_edges(proxy.faces)
    heights = part.theta["points"][[0, -1], 0, 1]
    assert np.abs(proxy.vertices[ends][..., 1][..., None] - heights).min(axis=-1).max() < 1e-6
    points = at(part.surface, part.theta["points"], np.repeat(proxy.ids, 3), proxy.corner_params.reshape(-1, 2))
    np.testing.assert_allclose(proxy.vertices[proxy.faces].reshape(-1, 3), points["position"], atol=1e-6)


def test_what_is_out_of_view_is_one_facet_and_what_has_an_outline_is_fine():
    surface, points = BSpline((16, 16)), grid(16, 16)
    near = Camera.look_at((-0.8, -0.8, 0.9), (-0.8, -0.8, 0), fov_y=20).for_size(SIZE)
    counts = np.bincount(surface.proxy(points, near, SIZE).ids[:, 0], minlength=13 * 13).reshape(13, 13)
    assert (counts[6:, 6:] == 2).all() and counts[:2, :2].min() > 2
    # From above no normal is across the view; seen flat, some are: there outlines may be.
    above = Camera.orthographic((0, 0, 9.0), (0, 0, 0), (0, 1, 0), height=3.0).for_size(SIZE)
    flat = Camera.orthographic((9.0, 0, 1.0), (0, 0, 0), (0, 0, 1), height=3.0).for_size(SIZE)
    small = grid(16, 16) * [1, 1, 0.1]
    assert len(surface.proxy(small, flat, SIZE).faces) > 3 * len(surface.proxy(small, above, SIZE).faces)


@pytest.mark.parametrize("rate", [0.1, 0.01, 0.001])
def test_tessellated_triangles_are_off_by_no_more_than_was_asked(rate):
    part = BSpline.example()
    vertices, faces = part.surface.tessellate(part.theta, rate)
    fine, _ = part.surface.tessellate(part.theta, 96)
    from scipy.spatial import cKDTree

    weights = np.random.default_rng(0).dirichlet((1, 1, 1), 3 * len(faces))
    places = np.einsum("nk,nkc->nc", weights, vertices[np.tile(faces, (3, 1))])
    spacing = 0.03  # Of the points that stand for the surface: chords of it are off by far less than this.
    distance = cKDTree(fine).query(places)[0]
    assert distance.max() < 1.2 * rate + spacing
    # Normal to the surface, at the parameters of the point.
    geometry = part.surface.geometry(part.theta["points"].astype(np.float64))
    found = part.surface.shapes(geometry)
    cuts = tile_triangles.by_error(part.surface.tiles, found, tile_triangles.Allowed.everywhere(len(found.bends), rate))
    proxy = tile_triangles.triangles(part.surface.tiles, geometry.points, *cuts)
    params = np.einsum("nk,nkc->nc", weights[: len(proxy.faces)], proxy.corner_params[: len(weights)])
    places = np.einsum("nk,nkc->nc", weights[: len(proxy.faces)], proxy.vertices[proxy.faces][: len(weights)])
    there = at(part.surface, part.theta["points"], proxy.ids[: len(params), 0], params)
    off = np.abs(((places - there["position"]) * there["normal"]).sum(axis=1))
    assert off.max() < 1.2 * rate
    assert off.max() > 0.1 * rate


def test_a_tessellation_by_rate_has_so_many_cuts():
    part = Bezier.example()
    vertices, faces = part.surface.tessellate(part.theta, 5)
    # Three patches of 25 cells; five triangles at the dome's top have no area.
    assert faces.shape == (3 * 50 - 5, 3) and vertices.dtype == np.float32
    with pytest.raises(InputError, match="rate is -1"):
        part.surface.tessellate(part.theta, -1)


def test_images_do_not_depend_on_what_was_rendered_before():
    part = BSpline.example()
    views = [Camera.look_at((1.5, 1.8, 3.0 * 1.02**i), (0, 0, 0), fov_y=40) for i in range(40)]
    sampler = rts.plugin("samplers", "embree")()
    one_after_the_other = [rts.render(part, view, SIZE, sampler=sampler) for view in views]
    for i in (0, 13, 39):
        fresh = rts.render(part, views[i], SIZE, sampler=rts.plugin("samplers", "embree")())
        np.testing.assert_array_equal(one_after_the_other[i], fresh)
    keys = {part.surface.proxy_key(part.theta["points"], view.for_size(SIZE), SIZE) for view in views}
    assert len(keys) < 25  # Views in cells: not one a view.


def test_hardly_a_sample_is_lost_at_the_outline():
    for part in (Bezier.example(), BSpline.example()):
        fine = part.replace(surface=type(part.surface)(*made_of(part.surface), tolerance=0.005))
        rows = [rts.sample(p, CAMERA, (120, 160), layers=4, splatter=None).row >= 0 for p in (part, fine)]
        # At open edges some lie beyond, by less than 2 % of a patch.
        assert (rows[0] & ~rows[1]).sum() <= 1e-3 * rows[1].sum()
        # A tolerance of 0.1 pixels, along the whole outline.
        assert (rows[1] & ~rows[0]).sum() <= 0.1 * outline(rows[1])


def outline(covered):
    """The number of cells on outlines: covered, with an empty neighbour."""
    return sum((covered & ~np.roll(covered, step, axis)).sum() for step in (-1, 1) for axis in (1, 2)) / 2


def made_of(surface):
    return (surface.table,) if isinstance(surface, Bezier) else (surface.shape, surface.ends)


# --------------------------------------------------------------------------------------------------- files

ROWS = [",".join(map(str, range(1, 17))), ",".join(map(str, [*range(13, 17), *range(17, 29)]))]


def text_of(points, rows=ROWS, promised=None):
    lines = [str(promised or len(rows)), *rows, str(len(points)), *(",".join(map(str, p)) for p in points)]
    return "\n".join(lines) + "\n"


def test_patches_are_read_from_text_and_arrays_with_their_normals_outside(tmp_path):
    points = np.random.default_rng(0).normal(size=(28, 3)).round(3)
    points[20] = points[3]  # Two that coincide become one.
    (tmp_path / "patches.txt").write_text(text_of(points))
    indices = np.array([list(map(int, row.split(","))) for row in ROWS]) - 1
    np.savez(tmp_path / "patches.npz", indices=indices, points=points)
    for name in ("patches.txt", "patches.npz"):
        (part,) = rts.load(tmp_path / name, surface="bezier")
        assert len(part.theta["points"]) == 27
        nets = part.surface.nets(part.theta["points"])
        np.testing.assert_allclose(nets, points[indices].reshape(-1, 4, 4, 3).transpose(0, 2, 1, 3), atol=1e-6)


BROKEN = {
    "cut": (lambda p: text_of(p)[: -len(text_of(p)) // 3], "points are promised"),
    "patches promised": (lambda p: text_of(p, promised=90), "90 patches are promised"),
    "short row": (lambda p: text_of(p, [ROWS[0][:-3]]), "line 2: .* is not 16 numbers"),
    "a word": (lambda p: text_of(p).replace("2,3,4", "2,x,4"), "line 2"),
    "no point of that number": (lambda p: text_of(p[:20]), "20 points, but indices from 0 to 27"),
    "NaN": (lambda p: text_of(p * [np.nan, 1, 1]), "NaN or infinite"),
    "empty": (lambda p: "", "ends before the number of patches"),
    "bytes": (lambda p: "\0\1\2", "line 1"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_damaged_patches_are_one_line_that_says_where(name, tmp_path):
    make, message = BROKEN[name]
    path = tmp_path / "patches.txt"
    path.write_text(make(np.random.default_rng(0).normal(size=(28, 3))))
    with refused(message) as error:
        rts.load(path, surface="bezier")
    assert "patches.txt" in str(error.value)


def test_what_is_no_file_of_patches_is_refused(tmp_path):
    (tmp_path / "a.npz").write_bytes(b"PK nothing")
    np.savez(tmp_path / "b.npz", indices=np.zeros((2, 15), int), points=np.zeros((3, 3)))
    for name, message in (("a.npz", "is no .npz with"), ("b.npz", r"indices of shape \(2, 15\)"), ("c.npz", "no file")):
        with pytest.raises(InputError, match=message):
            rts.load(tmp_path / name, surface="bezier")
    with pytest.raises(InputError, match="BSpline reads no files"):
        rts.load(tmp_path / "b.npz", surface="bspline")
    with pytest.raises(InputError, match="merge and weld are for meshes"):
        rts.load(tmp_path / "b.npz", surface="bezier", merge=True)


def test_newells_teapot_has_normals_outside_and_no_black_pole(data):
    (part,) = rts.load(data / "bezier" / "teapot_patches.txt", surface="bezier")
    (same,) = rts.load(data / "bezier" / "teapot_patches.npz", surface="bezier")
    np.testing.assert_array_equal(part.theta["points"], same.theta["points"])
    assert len(part.surface.table) == 32
    camera = Camera.look_at((4, -7, 4.5), (0.2, 0, 1.4), (0, 0, 1), fov_y=40)
    image = rts.render(part.replace(cull="back"), camera, (128, 128), layers=1)
    np.testing.assert_allclose(
        image[..., 3], rts.render(part, camera, (128, 128), layers=1, splatter="none")[..., 3], atol=1
    )
    above = Camera.orthographic((0, 0, 9), (0, 0, 0), (0, 1, 0), height=1.0)
    lid = rts.render(part.replace(shader="normals"), above, (65, 65), layers=1, splatter="none")
    # The top of the knob is the point of eight patches: its normals are upright, all around.
    np.testing.assert_allclose(lid[30:35, 30:35, :3], np.broadcast_to([0.5, 0.5, 1.0], (5, 5, 3)), atol=0.1)


# ----------------------------------------------------------------------------------------- swept profiles


@pytest.mark.parametrize("count, off", [(4, 3e-2), (8, 1.2e-3), (16, 7e-5)])
def test_a_swept_profile_is_nearly_a_surface_of_revolution(count, off):
    surface = Revolution(np.linspace(-1, 1, 5), count)
    vertices, _ = surface.tessellate({"radii": np.full(5, 0.8)}, 16)
    radius = np.hypot(vertices[:, 0], vertices[:, 2])
    np.testing.assert_allclose(radius, 0.8, rtol=off)
    assert radius.max() > 0.8 - 1e-6 and vertices[:, 1].min() == -1 and vertices[:, 1].max() == 1


def test_a_profile_is_the_b_spline_of_its_radii_and_heights_with_normals_outside():
    radii, heights = np.array([0.3, 0.9, 0.5, 0.7, 0.4, 0.6]), np.linspace(-1, 1, 6)
    surface = Revolution(heights, 8)
    curve = extraction(6, "clamped") @ np.stack([radii, heights], axis=-1)
    # Patches go along the profile first; the first of each eight starts in the plane of x and y.
    v = np.linspace(0, 1, 7)
    patch, params = np.repeat([0, 8, 16], 7), np.stack([np.tile(v, 3), np.zeros(21)], axis=-1)
    gbuffer = surface.evaluate({"radii": radii}, samples_at(patch, params))
    basis = np.stack([(1 - v) ** 3, 3 * v * (1 - v) ** 2, 3 * v * v * (1 - v), v**3], axis=-1)
    expected = np.concatenate([basis @ curve[3 * k : 3 * k + 4] for k in range(3)])
    found = gbuffer["position"]
    # A periodic span starts at its second control point: an eighth of a turn on.
    np.testing.assert_allclose(np.hypot(found[:, 0], found[:, 2]), expected[:, 0], rtol=1e-12)
    np.testing.assert_allclose(found[:, 1], expected[:, 1], atol=1e-12)
    assert ((gbuffer["normal"] * found * [1, 0, 1]).sum(axis=1) > 0).all()


@pytest.mark.parametrize("target", TORCH)
def test_radii_are_fitted_to_silhouettes(target):
    heights = np.linspace(-1, 1, 8)
    truth = np.array([0.7, 0.75, 0.3, 0.25, 0.2, 0.55, 0.5, 0.1], np.float32)
    surface, camera = Revolution(heights), Camera.look_at((0, 0.3, 4.0), (0, 0, 0), fov_y=35)
    mask = rts.render(Part(surface, {"radii": truth}), camera, (96, 96), supersample=2)[..., 3]
    residuals = rts.ImageResiduals(lambda radii: Part(surface, {"radii": radii}), camera, (96, 96), mask, supersample=2)
    start = arrays(target, np.full(8, 0.45))
    found = rts.fit(residuals, start, method="lm", steps=40)
    np.testing.assert_allclose(to_numpy(found.parameters), truth, atol=0.02)


def test_the_spread_of_a_camera_is_that_of_its_rays():
    for camera in VIEWS.values():
        np.testing.assert_allclose(camera.spread(SIZE), camera.rays(SIZE).spread, rtol=1e-12)


# ----------------------------------------------------------------------------------------------- bad input

POINTS = np.random.default_rng(0).normal(size=(16, 3)).astype(np.float32)
WRONG = {
    "index out of range": (lambda: show(Bezier(PATCH + 1), points=POINTS), "m of at least 17"),
    "negative index": (lambda: Bezier(PATCH - 1), "indices holds the index -1"),
    "fifteen points": (lambda: Bezier(PATCH[:, :15]), r"indices has shape \(1, 15\); expected \(T, 16\)"),
    "no points": (lambda: show(Bezier(PATCH), vertices=POINTS), "has no 'points'"),
    "flat points": (lambda: show(Bezier(PATCH), points=POINTS[:, :2]), r"theta\['points'\] .* has shape \(16, 2\)"),
    "integers": (lambda: show(Bezier(PATCH), points=np.zeros((16, 3), int)), "has dtype int64"),
    "wide colours": (
        lambda: show(Bezier(PATCH), points=POINTS, colors=POINTS[:, :2]),
        r"theta\['colors'\] .*1 or 3 or 4",
    ),
    "NaN": (lambda: show(Bezier(PATCH), points=POINTS * [[np.nan]] + POINTS), "16 control points .* NaN or infinite"),
    "other grid": (lambda: show(BSpline((4, 4)), points=np.zeros((4, 5, 3), np.float32)), r"expected \(4, 4, C\)"),
    "small grid": (lambda: BSpline((3, 5)), r"shape is \(3, 5\); expected \(nu, nv\), two integers of at least 4"),
    "fractional grid": (lambda: BSpline((4.5, 5)), "shape is"),
    "ends": (lambda: BSpline((4, 4), "closed"), "ends is 'closed'; expected one of open, clamped, periodic"),
    "three heights": (lambda: Revolution([0, 1, 2]), "heights is .*at least 4 numbers"),
    "few around": (lambda: Revolution(np.arange(5.0), 3), "count is 3; expected an integer of at least 4"),
    "radii": (lambda: show(Revolution(np.arange(5.0)), radii=np.ones(4, np.float32)), r"theta\['radii'\] .*\(5,\)"),
    "three ends": (lambda: BSpline((4, 4), ("open",) * 3), "ends is"),
    "tolerance": (lambda: Bezier(PATCH, tolerance=0.0), "tolerance is 0.0; expected a positive number"),
}


def show(surface, **theta):
    return rts.render(Part(surface, theta), CAMERA, SIZE)


@pytest.mark.parametrize("name", WRONG)
def test_bad_input_is_one_line_that_says_what_was_given(name):
    call, message = WRONG[name]
    with refused(message):
        call()


@pytest.mark.filterwarnings("ignore::rts.errors.EmptyImageWarning")
@pytest.mark.parametrize("target", DIFFERENTIABLE)
@pytest.mark.parametrize("name", ["a point", "a line", "a fold"])
def test_collapsed_patches_give_finite_images_and_gradients(name, target):
    points = {
        "a point": np.zeros((16, 3)),
        "a line": np.repeat(np.linspace(-1, 1, 4)[:, None], 4, axis=0) * [[1.0, 0.5, 0.0]],
        "a fold": cubic(lambda x, y: 0 * x)[[0, 1, 2, 3, 4, 5, 6, 7, 4, 5, 6, 7, 0, 1, 2, 3]],
    }[name]
    engine = rts.engine_of(arrays(target, points))

    def total(p):
        return rts.render(Part(Bezier(PATCH), {"points": p}, "lambert"), CAMERA, SIZE).sum()

    value, gradient = engine.value_and_grad(total)(arrays(target, points))
    assert np.isfinite(float(value)) and np.isfinite(to_numpy(gradient)).all()
