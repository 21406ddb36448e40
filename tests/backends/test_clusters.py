"""Triangles in clusters: what is passed over at once is what would not have been drawn, to the bit."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
from helpers import icosphere, rotation, soup
from soups import soup_of
from test_raster import CAMERAS, SIZE, triangles

import rts
from rts import Camera, Part
from rts.contracts.records import Request
from rts.plugin_api.records import Proxy

pytestmark = pytest.mark.sampling

pytest.importorskip("numba")


from rts_backends.raster import sampler as raster_sampler  # noqa: E402
from rts_backends.raster.clusters import Clusters  # noqa: E402
from rts_backends.raster.sampler import Raster  # noqa: E402
from rts_backends.triangles import pixel_matrix  # noqa: E402

KINDS = ("ball", "bumpy", "copies", "rounded", "with NaN", "soup", "nasty")


def mesh(kind):
    """Thousands of triangles of one kind, around the origin."""
    rng = np.random.default_rng(0)
    if kind == "soup":
        return soup(8000, 1, size=0.1)
    if kind == "nasty":
        parts = [triangles(k, seed) for seed in (1, 2) for k in ("slivers", "degenerate", "huge", "tiny")]
        parts += [soup(2000, 3, size=0.2), soup(2000, 4, size=1e-5)]
        offsets = np.cumsum([0, *(len(v) for v, _ in parts)])
        faces = np.concatenate([f + o for (_, f), o in zip(parts, offsets, strict=False)])
        return np.concatenate([v for v, _ in parts]), faces.astype(np.int32)
    vertices, faces = icosphere(5)
    if kind != "ball":
        vertices = vertices * (1 + 0.3 * np.sin(4 * vertices @ rng.normal(size=(3, 1))))
    if kind == "copies":  # At one depth the triangle of the lowest index is in front.
        faces = np.concatenate([faces, faces[rng.permutation(len(faces))], faces[::3, ::-1]])
    if kind == "rounded":  # Many triangles have no area, and many lie in one plane.
        vertices = np.round(vertices * 12) / 12
    if kind == "with NaN":
        vertices[rng.integers(len(vertices), size=20)] = rng.choice([np.nan, np.inf, -np.inf], (20, 1))
    return vertices.astype(np.float32), faces.astype(np.int32)


def looks():
    """Cameras all around, in it, and looking past it, with far and near planes that cut it."""
    rng = np.random.default_rng(5)
    for n in range(12):
        eye = rng.normal(size=3) * (0.3 if n % 3 == 0 else 2.5)
        near, far = (0.01, 50.0) if n % 2 else (1.5, 2.6)
        target = rng.normal(size=3) * (3.0 if n % 5 == 0 else 0.4)
        yield Camera.look_at(eye, target, fov_y=(90, 40, 4)[n % 3], aspect=1.25, near=near, far=far)
        yield Camera.orthographic(eye, target, height=(3.0, 0.3)[n % 2], aspect=1.25, near=near, far=far)


def assert_same(found, expected):
    for x, y in zip(found, expected, strict=True):
        assert x.dtype == y.dtype and x.tobytes() == y.tobytes()


# ------------------------------------------------------------------------------------------------ what they are


@pytest.mark.parametrize("kind", KINDS)
def test_clusters_hold_every_triangle_once_in_boxes_around_its_corners(kind):
    vertices, faces = mesh(kind)
    made = Clusters.of(Proxy(vertices, faces))
    np.testing.assert_array_equal(np.sort(made.order), np.arange(len(faces)))
    np.testing.assert_array_equal(made.vertices[made.faces], vertices[faces[made.order]])
    assert len(made.vertices) == len(np.unique(faces))
    for n, start in enumerate(range(0, len(faces), 256)):
        corners = made.vertices[made.faces[start : start + 256]].reshape(-1, 3)
        if np.isfinite(corners).all():
            np.testing.assert_array_equal(made.boxes[:, n], [*corners.min(axis=0), *corners.max(axis=0)])
        else:
            np.testing.assert_array_equal(made.boxes[:, n], [-np.inf] * 3 + [np.inf] * 3)
        blocks = np.unique(made.faces[start : start + 256] // 256)
        np.testing.assert_array_equal(np.sort(made.blocks[made.offsets[n] : made.offsets[n + 1]]), blocks)


def test_a_cone_holds_the_normals_of_its_cluster():
    vertices, faces = mesh("bumpy")
    made = Clusters.of(Proxy(vertices, faces))
    a, b, c = np.moveaxis(made.vertices[made.faces].astype(np.float64), 1, 0)
    normals = np.cross(b - a, c - a)
    lengths = np.linalg.norm(normals, axis=1)
    clusters = np.arange(len(faces)) // 256
    cosines = (normals * made.cones[:3].T[clusters]).sum(axis=1) / lengths
    known = made.cones[3] > 0
    assert known.mean() > 0.9
    for n in np.flatnonzero(known):
        np.testing.assert_allclose(cosines[clusters == n].min(), made.cones[3, n], rtol=0, atol=1e-12)
        np.testing.assert_allclose(lengths[clusters == n].min(), made.cones[4, n], rtol=1e-12)


def seen(made, camera, cull):
    """(C,) bool, the clusters that may show triangles."""
    size, every = (64, 64), np.zeros(made.boxes.shape[1], bool)
    every[made.seen(pixel_matrix(camera, size), size, camera.kept_sign(cull))[0]] = True
    return every


@pytest.mark.parametrize("flip", [1.0, -1.0])
@pytest.mark.parametrize("eye", [(0, 0, 100), (0.5, -2.0, 0.3), (0.2, 0.3, 0.1)])
def test_clusters_are_refused_where_all_their_triangles_face_away(eye, flip):
    vertices, faces = icosphere(6)
    made = Clusters.of(Proxy(vertices.astype(np.float32), faces.astype(np.int32)))
    a, b, c = np.moveaxis(made.vertices[made.faces].astype(np.float64), 1, 0)
    fronts = (np.cross(b - a, c - a) * (eye - a)).sum(axis=1) > 0
    split = np.arange(0, len(faces), 256)
    some = np.logical_or.reduceat(fronts, split)
    camera = Camera.look_at(eye, (0, 0, 0), fov_y=3 if eye[2] == 100 else 120, near=1e-3, far=1e3)
    camera = camera.replace(projection=np.diag([1, flip, 1, 1]) @ camera.projection)
    beside, back = (seen(made, camera, cull) for cull in ("none", "back"))
    assert back[some & beside].all()
    assert (np.linalg.norm(eye) < 1) == (not some.any())
    assert (~back & beside).sum() > 0.6 * (~some & beside).sum() > 20


def test_clusters_out_of_view_are_refused():
    vertices, faces = icosphere(6)
    made = Clusters.of(Proxy(vertices.astype(np.float32), faces.astype(np.int32)))
    (x0, y0, _), (_, y1, _) = made.boxes[:3], made.boxes[3:]
    # It sees x from −1.8 to −0.8 and y from −0.5 to 0.5; pixels are 1 / 64.
    found = seen(made, Camera.orthographic((-1.3, 0, 9), (-1.3, 0, 0), height=1.0, near=1, far=20), "none")
    assert found[(x0 < -0.8) & (y0 < 0.5) & (y1 > -0.5)].all() and 5 < found.sum() < 60
    assert not found[(x0 > -0.78) | (y0 > 0.52) | (y1 < -0.52)].any()
    for camera in (Camera.look_at((0, 0, 3), (0, 0, 6)), Camera.look_at((0, 0, 3), (0, 0, 0), near=5)):
        assert not seen(made, camera, "none").any()
    assert not seen(made, Camera.look_at((0, 0, 9), (0, 0, 0), far=7), "none").any()
    assert seen(made, Camera.look_at((0, 0, 9), (0, 0, 0), far=11), "none").all()


# -------------------------------------------------------------------------------------------- what is drawn of them


@pytest.mark.parametrize("kind", KINDS)
def test_fragments_of_clusters_are_those_of_the_triangles(kind):
    sampler, size = Raster(), SIZE
    proxy = Proxy(*mesh(kind))
    made, refused = Clusters.of(proxy), 0
    for n, camera in enumerate([*CAMERAS.values(), *looks()]):
        for layers, cull in ((1 + n % 3, "none"), (1 + n % 2, "back")):
            view = camera, size, layers, cull
            assert_same(sampler.rasterize(made, *view), sampler.rasterize(proxy, *view))
            found, _ = made.seen(pixel_matrix(camera, size), size, camera.kept_sign(cull))
            refused += made.boxes.shape[1] - len(found)
    assert refused > 50


def test_soups_of_all_kinds_are_drawn_as_ever():
    sampler = Raster()
    for number in range(600):
        case = soup_of(number)
        proxy = Proxy(case.vertices, np.ascontiguousarray(case.faces, np.int32))
        view = case.camera, case.size, case.layers, case.cull
        assert_same(sampler.rasterize(Clusters.of(proxy), *view), sampler.rasterize(proxy, *view))


def test_the_result_does_not_depend_on_the_number_of_threads(monkeypatch):
    made, sampler, results = Clusters.of(Proxy(*mesh("copies"))), Raster(), []
    for threads in ("1", "2", "3"):
        monkeypatch.setenv("RTS_NUM_THREADS", threads)
        results.append(sampler.rasterize(made, CAMERAS["perspective"], (96, 120), 3, "none"))
        again = Clusters.of(Proxy(*mesh("copies")))
        assert_same(again, made)
    for other in results[1:]:
        assert_same(other, results[0])


# --------------------------------------------------------------------------------------------------- rts.prepare


VIEW = Camera.look_at((0, 0.5, 3), (0, 0, 0), fov_y=40)


@pytest.fixture
def few(monkeypatch):
    """Few triangles are many."""
    monkeypatch.setattr(raster_sampler, "MANY", 1000)


def moves():
    rng = np.random.default_rng(2)
    yield from (rts.rigid(rng.normal(size=6) * (3, 3, 3, 0.6, 0.6, 0.6)) for _ in range(4))
    mirror = np.eye(4)
    mirror[:3, :3] = rotation((1, 2, 3), 70) @ np.diag([-0.8, 0.5, 1.2])
    yield mirror


@pytest.mark.parametrize("cull", ["none", "back"])
def test_samples_of_what_is_prepared_are_those_of_the_part(few, cull):
    vertices, faces = mesh("bumpy")
    part = Part(rts.plugin("surfaces", "mesh")(faces), {"vertices": vertices}, "normals", cull=cull)
    handle = rts.prepare(part, "raster")
    assert isinstance(handle.entries[0].prepared, Clusters)
    sampler, asked = handle.samplers[0], Request(triangles=True)
    for transform in moves():
        moved, posed = part.replace(transform=transform), handle.replace(transform=transform)
        found, expected = (
            sampler.sample(moved, VIEW, (40, 40), 2, replace(asked, entry=posed.entries[0])),
            sampler.sample(moved, VIEW, (40, 40), 2, asked),
        )
        for name in ("ids", "params", "row", "depth", "overflow", "triangle"):
            x, y = getattr(found, name), getattr(expected, name)
            assert (x is None) == (y is None)
            assert x is None or np.array_equal(x, y)
        for samples in (1, 2):
            expected = rts.render(moved, VIEW, (40, 40), sampler="raster", supersample=samples)
            np.testing.assert_array_equal(rts.render(posed, VIEW, (40, 40), supersample=samples), expected)


def test_copies_of_a_handle_are_in_clusters_again(few):
    vertices, faces = mesh("ball")
    part = Part(rts.plugin("surfaces", "mesh")(faces), {"vertices": vertices}, "silhouette")
    handle = rts.prepare(part, "raster")
    data = pickle.dumps(handle)
    copy = pickle.loads(data)
    assert_same(copy.entries[0].prepared, handle.entries[0].prepared)
    assert len(data) < 2 * (vertices.nbytes + faces.nbytes) + 5000
    np.testing.assert_array_equal(rts.render(copy, VIEW, (20, 20)), rts.render(handle, VIEW, (20, 20)))


def test_scratch_memory_is_not_copied_with_its_sampler():
    sampler, (vertices, faces) = Raster(), mesh("ball")
    new = len(pickle.dumps(sampler))
    sampler.rasterize(Proxy(vertices, faces), CAMERAS["perspective"], SIZE, 1, "none")
    data = pickle.dumps(sampler)
    assert len(data) == new < 200
    view = Proxy(vertices, faces), CAMERAS["perspective"], SIZE, 1, "none"
    assert_same(pickle.loads(data).rasterize(*view), sampler.rasterize(*view))


def test_few_triangles_and_samplers_that_draw_themselves_keep_their_order(few):
    class Own(Raster):
        def rasterize(self, prepared, camera, size, layers, cull):
            assert isinstance(prepared, Proxy)
            return super().rasterize(prepared, camera, size, layers, cull)

    small, large = icosphere(2), icosphere(4)
    for (vertices, faces), sampler in ((small, Raster()), (large, Own())):
        part = Part(rts.plugin("surfaces", "mesh")(faces), {"vertices": vertices.astype(np.float32)}, "silhouette")
        handle = rts.prepare(part, sampler)
        assert isinstance(handle.entries[0].prepared, Proxy)
        np.testing.assert_array_equal(
            rts.render(handle, VIEW, (20, 20)), rts.render(part, VIEW, (20, 20), sampler="raster")
        )
