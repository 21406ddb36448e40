"""Parts of patches: values and normals as operations, tiles that meet, samples that are moved and pruned."""

import copy
import os
import pickle

import numpy as np
import pytest
from example_surfaces import part_of
from helpers import ALL, arrays, to_numpy
from thin_patches import lacking, thin_patches

import rts
from rts import Camera, InputError, Part
from rts.compiling.threads import read_only
from rts.contracts.records import Cells
from rts.plugin_api.records import Samples
from rts.sampling import layer_order
from rts.testing import OperationConformance
from rts_surfaces.patches import bicubic, tile_triangles
from rts_testing.compatibility import BORDER

pytestmark = pytest.mark.sampling

Bezier, BSpline, Revolution = (rts.plugin("surfaces", name) for name in ("bezier", "bspline", "revolution"))
RNG = np.random.default_rng(0)
CAMERA = Camera.look_at((1.5, 1.8, 3.0), (0, 0, 0), fov_y=40)


# --------------------------------------------------------------------------------------------- operations


def patches(width=3, count=60):
    """Rows, params, patches and table of three patches, one of which has a side that is a point."""
    rows, table = RNG.normal(size=(40, width)), RNG.permuted(np.tile(np.arange(39), (3, 1)), axis=1)[:, :16]
    table[1, :4] = 39
    params = RNG.random((count, 2)) * 1.04 - 0.02
    params[:3], params[3:6, 0] = [(0, 0), (1, 1), (0.5, 0.5)], [0, 1e-7, 1]
    patch = RNG.integers(0, 3, count)
    patch[3:6] = 1
    return rows, params, patch.astype(np.int32), table.astype(np.int32)


OPERATIONS = {"values": bicubic.VALUES, "normals": bicubic.NORMALS}


class TestPatches(OperationConformance):
    @pytest.fixture(params=OPERATIONS)
    def operation(self, request):
        return OPERATIONS[request.param]

    @pytest.fixture
    def operands(self, operation):
        rows, params, patch, table = patches()
        if operation is bicubic.NORMALS:
            params[4, 0] = 0  # Where one derivative is only nearly zero, roundings choose the tangent.
        return rows, params, patch, table


def test_normals_are_of_unit_length():
    found, _ = bicubic.NORMALS.value_on_host([read_only(x) for x in patches()], {})
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, rtol=1e-12)


@pytest.mark.parametrize("target", ALL)
@pytest.mark.parametrize("name", OPERATIONS)
def test_patches_and_points_that_are_not_there_are_refused(name, target):
    rows, params, patch, table = patches()
    for given, message in (
        ((rows, params, patch + 3, table), r"patches \d to 5 of 3; sample this surface anew"),
        ((rows[:20], params, patch, table), r"control points \d to 39 of 20; sample this surface anew"),
    ):
        with pytest.raises(InputError, match=message):
            to_numpy(OPERATIONS[name](*arrays(target, list(given))))
    with pytest.raises(InputError, match=r"\(9, 2\) and \(60,\)"):
        OPERATIONS[name](rows, params[:9], patch, table)


# -------------------------------------------------------------------------------------------------- tiles


def boundary(faces):
    """Directed edges of triangles without one that runs the other way."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    edges = edges[edges[:, 0] != edges[:, 1]]
    there = {tuple(e) for e in edges.tolist()}
    assert len(there) == len(edges)
    return [e for e in there if e[::-1] not in there]


@pytest.mark.parametrize("shape", [(4, 4), (5, 4), (20, 20)])
@pytest.mark.parametrize("seed", range(3))
def test_tiles_of_a_closed_surface_have_no_boundary_whatever_their_rates(shape, seed):
    surface, rng = BSpline(shape, "periodic"), np.random.default_rng(seed)
    u, v = (2 * np.pi * np.arange(n)[(slice(None), None)[:: 1 if i == 0 else -1]] / n for i, n in enumerate(shape))
    points = np.stack([(2 + np.cos(v)) * np.cos(u), (2 + np.cos(v)) * np.sin(u), np.sin(v) + 0 * u], axis=-1)
    for cut in (surface.tiles, surface.whole):
        edges = rng.integers(1, 8, len(cut.edge_tiles)).astype(np.int32)
        inner = rng.integers(2, 8, (len(cut.patch), 2)).astype(np.int32)
        proxy = tile_triangles.triangles(cut, surface.geometry(points).points, edges, inner)
        assert boundary(proxy.faces) == []
        assert len(np.unique(proxy.faces)) == len(proxy.vertices)
        # Vertices are where the parameters of triangles say.
        ids, params = np.repeat(proxy.ids[:, 0], 3), proxy.corner_params.reshape(-1, 2).astype(np.float64)
        there = surface.geometry(points).points(ids, params, 0)[:, 0]
        np.testing.assert_allclose(proxy.vertices[proxy.faces.reshape(-1)], there, atol=1e-5)


def test_the_corners_of_a_patch_are_shared_however_many_tiles_it_has():
    # Two patches beside each other, in all eight positions of the second.
    first = np.arange(16).reshape(4, 4)
    for turn in range(4):
        for mirrored in (False, True):
            second = np.concatenate([first[3:], np.arange(16, 28).reshape(3, 4)])
            second = np.rot90(second.T if mirrored else second, turn)
            surface = Bezier(np.stack([first.reshape(-1), second.reshape(-1)]))
            corners, edges = len(surface.tiles.corner_tiles), len(surface.tiles.edge_tiles)
            assert (corners, edges) == (2 * 25 - 5, 2 * 40 - 4)
            whole = surface.whole
            assert len(whole.corner_tiles) == 6 and len(whole.edge_tiles) == 7


# ------------------------------------------------------------------------------------------------ samples


SKEW = np.array([[0, 0.1, 0.2, 0], [0.05, 0, -0.1, 0.3], [0, 0, 0, 0], [0, 0, 0, 0]])


@pytest.mark.parametrize(
    "camera",
    [
        CAMERA,
        Camera.orthographic((1.5, 1.8, 3.0), (0.4, 0.4, 0), height=2.5),
        CAMERA.for_size((5, 7)).replace(projection=CAMERA.for_size((5, 7)).projection + SKEW),
    ],
)
def test_rays_of_packed_samples_are_those_of_the_camera(camera):
    size = (5, 7)
    camera = camera.for_size(size)
    row = RNG.permutation(70).reshape(2, *size).astype(np.int32)
    row[row >= 50] = -1
    none = np.zeros((50, 2), np.float32)
    samples = Samples(np.zeros((50, 1), np.int32), none, Cells(row, np.zeros(row.shape, np.float32)), np.int32(0))
    found, expected = layer_order.rays_of(samples, camera, size), camera.rays(size)
    for layer in range(2):
        there = row[layer] >= 0
        for part in ("origins", "directions"):
            rays = getattr(found, part)[row[layer][there]]
            np.testing.assert_allclose(rays, getattr(expected, part)[there], rtol=0, atol=1e-12)
    np.testing.assert_allclose(found.spread, expected.spread, rtol=1e-12)


def test_without_a_covered_cell_there_is_a_ray_of_the_first_pixel():
    size, row = (2, 3), np.full((1, 2, 3), -1, np.int32)
    samples = Samples(np.zeros((1, 1), np.int32), np.zeros((1, 2), np.float32), Cells(row, 0.0 * row), np.int32(0))
    found, expected = layer_order.rays_of(samples, CAMERA.for_size(size), size), CAMERA.rays(size)
    np.testing.assert_allclose(found.directions[0], expected.directions[0, 0], atol=1e-12)


PARTS = {"bezier": Bezier.example, "bspline": BSpline.example, "revolution": Revolution.example}


def test_newells_teapot_has_few_triangles_and_samples_at_the_centres_of_pixels(data):
    (part,) = rts.load(data / "bezier" / "teapot_patches.txt", surface="bezier")
    camera, size = Camera.look_at((5, -11, 6), (0.2, 0, 1.4), (0, 0, 1), fov_y=30), (256, 256)
    proxy = part.surface.proxy(part.theta["points"], camera.for_size(size), size)
    sampled = rts.sample(part, camera, size, layers=2, splatter=None)
    # One facet a pixel: two triangles for each, in front and behind.
    assert len(proxy.faces) <= (sampled.row >= 0).sum()
    theta = {"points": part.theta["points"].astype(np.float64)}
    position = part.surface.evaluate(theta, sampled.samples[0])["position"]
    layer, y, x = np.nonzero(sampled.row >= 0)
    wide = camera.for_size(size).with_border(size, BORDER)
    pixels = wide.project(position[sampled.row[layer, y, x]], sampled.row.shape[1:])
    off = np.abs(pixels[:, :2] - np.stack([x, y], axis=-1) - 0.5).max(axis=1)
    assert off.max() < 1e-3
    np.testing.assert_allclose(pixels[:, 2], sampled.depth[layer, y, x], rtol=1e-5)
    both = sampled.row[1] >= 0
    assert (sampled.depth[1] > sampled.depth[0])[both].all()


@pytest.mark.parametrize("name", PARTS)
def test_the_nearest_sample_does_not_depend_on_how_many_are_asked_for(name):
    coarse = Bezier.example().surface.table
    part = PARTS[name]()
    if name == "bezier":  # So coarse that triangles stand where the surface is not.
        part = part.replace(surface=Bezier(coarse, tolerance=3.0))
    found = [rts.sample(part, CAMERA, (120, 150), layers=k, splatter=None) for k in (1, 2, 6)]
    covered = [(f.row >= 0).any(axis=0) for f in found]
    for f, c in zip(found, covered, strict=True):
        np.testing.assert_array_equal(f.row[0] >= 0, c)
        np.testing.assert_array_equal(c, covered[-1])
        np.testing.assert_allclose(f.depth[0], found[-1].depth[0], rtol=1e-5)


@pytest.mark.parametrize("layers", [1, 2])
def test_newells_teapot_has_no_holes(data, layers):
    (part,) = rts.load(data / "bezier" / "teapot_patches.txt", surface="bezier")
    vertices, faces = part.surface.tessellate(part.theta, 64)
    mesh = Part(rts.plugin("surfaces", "mesh")(faces), {"vertices": vertices})
    for eye in ((5, -11, 6), (8, -8, 4)):
        camera = Camera.look_at(eye, (0.2, 0, 1.4), (0, 0, 1), fov_y=35)
        rows = [rts.sample(p, camera, (256, 256), layers=layers, splatter=None).row[0] >= 0 for p in (part, mesh)]
        inner = rows[1].copy()
        for axis in (0, 1):
            for step in (-1, 1):
                inner &= np.roll(rows[1], step, axis)
        assert not (inner & ~rows[0]).any()


THIN = int(os.environ.get("RTS_THIN", "24"))
"""How many shapes of thin patches are tried."""


@pytest.mark.parametrize("name", ["bezier", "bspline", "subdivision"])
def test_no_pixel_lacks_the_sheet_in_front_where_patches_are_thin(name):
    if name == "subdivision":
        part_of(name)
    wrong, pixels = {}, 0
    for number in range(1, 1 + THIN // (1 if name == "bezier" else 4)):
        view = thin_patches(number, name)
        lacks, known = lacking(view, rts.sample(view.part, view.camera, view.size, layers=1, splatter=None))
        pixels += known
        if lacks.any():
            wrong[number] = int(lacks.sum())
    assert not wrong
    assert pixels > 100


def test_the_side_of_a_patch_leads_to_the_one_beside_it_and_a_point_to_the_one_opposite():
    # Four patches around a point, their sides v = 0; each side u = 1 is the next one's u = 0.
    rim = 1 + np.arange(4 * 9).reshape(4, 3, 3)
    nets = [np.stack([np.full(4, 0), *np.concatenate([rim[k].T, rim[(k + 1) % 4].T[:, :1]], axis=1)]) for k in range(4)]
    surface = Bezier([net.T.reshape(-1) for net in nets])
    assert surface.across.tolist() == [
        [4 * ((k + 2) % 4), 4 * ((k + 1) % 4) + 3, -1, 4 * ((k + 3) % 4) + 1] for k in range(4)
    ]


@pytest.mark.parametrize("name", PARTS)
def test_outlines_are_within_the_tolerance_wherever_a_view_is_in_its_cell(name):
    part, rng, size = PARTS[name](), np.random.default_rng(0), (100, 120)
    fine = type(part.surface).__new__(type(part.surface))
    vars(fine).update(vars(part.surface) | {"tolerance": 0.005})
    lost = length = 0
    for _ in range(12):
        direction = rng.normal(size=3)
        eye = direction / np.linalg.norm(direction) * rng.uniform(2.5, 9)
        camera = Camera.look_at(eye, rng.normal(size=3) * 0.2, fov_y=rng.uniform(20, 50))
        rows = [
            rts.sample(part.replace(surface=s), camera, size, layers=2, splatter=None).row[0] >= 0
            for s in (part.surface, fine)
        ]
        lost += (rows[1] & ~rows[0]).sum()
        length += sum((rows[1] & ~np.roll(rows[1], step, axis)).sum() for step in (-1, 1) for axis in (0, 1)) / 2
    assert length > 1000
    assert lost <= 0.05 * length


def test_the_edge_of_a_flat_patch_is_as_fine_as_an_outline():
    x, y = np.meshgrid([-1.0, -0.4, 0.4, 1.0], [-1.0, -0.4, 0.4, 1.0], indexing="ij")
    x, y = x + 0.8 * x * (np.abs(y) < 1), y + 0.5 * y * (np.abs(x) < 1)
    points = np.stack([x, y, 0 * x], axis=-1).reshape(16, 3)
    camera, table = Camera.orthographic((0, 0, 3), (0, 0, 0), height=4.5), np.arange(16)[None]
    parts = [Part(Bezier(table, tolerance=t), {"points": points}) for t in (0.1, 0.001)]
    rows = [rts.sample(p, camera, (400, 400), layers=1, splatter=None).row[0] >= 0 for p in parts]
    sides = sum((rows[1] & ~np.roll(rows[1], step, axis)).sum() for step in (-1, 1) for axis in (0, 1))
    length = np.pi / 4 * sides  # Of a line in any direction.
    # Chords are off by two thirds of the tolerance on average, at most.
    assert 0 < (rows[1] & ~rows[0]).sum() <= 0.07 * length
    # Its inside is flat: there are few triangles but at the edge.
    proxy = parts[0].surface.proxy(points, camera.for_size((400, 400)), (400, 400))
    assert len(proxy.faces) < 1500


NAMES = [*PARTS, "subdivision"]


@pytest.mark.parametrize("name", ["bezier", "bspline", "subdivision"])
@pytest.mark.parametrize("scale", [(1e-3,) * 3, (1e3,) * 3, (1.0, 0.2, 1.0)])
def test_triangles_are_as_fine_where_a_transform_scales(name, scale):
    part, size = part_of(name), (150, 150)
    camera = Camera.look_at((1.5, 1.8, 4.5), (0, 0, 0), fov_y=40)
    entry = "vertices" if name == "subdivision" else "points"
    points = part.theta[entry].astype(np.float64)
    plain = part.replace(theta={entry: points}, shader="silhouette")
    scaled = plain.replace(theta={entry: points / scale}, transform=np.diag([*scale, 1.0]))
    rows = [rts.sample(p, camera, size, layers=2, splatter=None).row[0] >= 0 for p in (plain, scaled)]
    assert (rows[0] ^ rows[1]).sum() <= 0.005 * rows[0].sum()
    within = camera.for_size(size).within(scaled.transform)
    one = len(plain.surface.proxy(points, camera.for_size(size), size).faces)
    other = len(scaled.surface.proxy(points / scale, within, size).faces)
    assert 0.5 < other / one < (2 if scale[0] == scale[1] else 20)


@pytest.mark.parametrize("name", ["bezier", "subdivision"])
def test_points_of_no_patch_do_not_count(name):
    part = part_of(name)
    entry = "points" if name == "bezier" else "vertices"
    more = {e: np.concatenate([part.theta[e], part.theta[e][:1] + 1e5]) for e in (entry, "colors")}
    camera, size = CAMERA.for_size((100, 100)), (100, 100)
    one, other = (part.surface.proxy(t[entry].astype(float), camera, size) for t in (part.theta, more))
    np.testing.assert_array_equal(one.faces, other.faces)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("copied", [copy.deepcopy, lambda part: pickle.loads(pickle.dumps(part))])
def test_tables_of_copies_are_fixed_and_images_alike(name, copied):
    part = part_of(name)
    other = copied(part)
    for table in (*other.surface.tiles, *other.surface.whole):
        assert not table.flags.writeable
    np.testing.assert_array_equal(rts.render(other, CAMERA, (40, 50)), rts.render(part, CAMERA, (40, 50)))
