"""Thin things: triangles that touch cells and cover no centre near them, and adaptive images of these."""

import numpy as np
import pytest
from adaptive_scenes import CAMERA, SIZE, scene
from helpers import DIFFERENTIABLE, arrays, gradient, icosphere, quick, soup, to_numpy

import rts
from rts import Adaptive, Camera
from rts.plugin_api.records import Proxy
from rts.sampling.adaptive import missed
from rts_backends.reference import limits

pytestmark = pytest.mark.sampling

pytest.importorskip("numba")

MESH = rts.plugin("rts.surfaces", "mesh")
PIXELS = (40, 50)
SAMPLERS = ("raster", "reference")


def flat_camera(size=PIXELS):
    """An orthographic camera four units above the plane z = 0: a pixel is a unit, (0, 0) the upper left corner."""
    height, width = size
    camera = Camera.orthographic(
        (width / 2, -height / 2, 4), (width / 2, -height / 2, 0), height=height, aspect=width / height, near=1, far=9
    )
    return camera.map(lambda x: np.asarray(x, np.float64))


def strip(start, end, width, z=0.0):
    """Corners (4, 3) of a strip from `start` to `end`, (x, y) in pixels, and its two triangles."""
    start, end = np.array(start, float), np.array(end, float)
    along = (end - start) / np.linalg.norm(end - start)
    across = width / 2 * np.array([-along[1], along[0]])
    corners = np.array([start - across, end - across, end + across, start + across])
    return np.column_stack([corners * [1, -1], np.full(4, z)]).astype(np.float32), np.array([[0, 1, 2], [0, 2, 3]])


def several(*pieces):
    """Vertices and faces of pieces together."""
    firsts = np.cumsum([0, *(len(v) for v, _ in pieces)])
    return np.concatenate([v for v, _ in pieces]), np.concatenate(
        [f + n for (_, f), n in zip(pieces, firsts, strict=False)]
    )


def between(name, vertices, faces, camera=None, size=PIXELS, cull="none"):
    """Depths (H, W) of what lies between centres, and those of the cells."""
    camera = flat_camera(size) if camera is None else camera
    sampler = rts.plugin("samplers", name)()
    prepared = sampler.prepare(Proxy(np.asarray(vertices, np.float32), np.asarray(faces, np.int32)))
    depth = sampler.rasterize(prepared, camera, size, 1, cull).depth[0]
    return sampler.between(prepared, camera, size, cull, depth), depth


def cells_near(start, end, width, size=PIXELS):
    """Cells (H, W) bool that a strip touches, by the separating axes of a square and a rectangle."""
    y, x = np.indices(size) + 0.5
    start, end = np.array(start, float), np.array(end, float)
    length = np.linalg.norm(end - start)
    along = (end - start) / length
    off = np.stack([x, y], -1) - (start + end) / 2
    reach = np.abs(along).sum() / 2
    near = np.abs(off @ along) < length / 2 + reach
    near &= np.abs(off @ [-along[1], along[0]]) < width / 2 + reach
    half = np.abs(along) * length / 2 + np.abs([-along[1], along[0]]) * width / 2
    return near & (np.abs(off) < half + 0.5).all(axis=-1)


def around(cells):
    """Cells that have one of `cells` among the nine around them."""
    wide = np.pad(cells, 1)
    return np.lib.stride_tricks.sliding_window_view(wide, (3, 3)).any(axis=(2, 3))


WIRES = {
    "level": ((4.2, 20.8), (44.1, 20.8), 0.3),
    "upright": ((20.9, 3.3), (20.9, 36.6), 0.25),
    "slanted": ((6.3, 4.4), (31.7, 33.2), 0.25),
    "nearly level": ((3.3, 11.2), (45.2, 14.9), 0.4),
    "a speck": ((9.2, 9.15), (9.3, 9.25), 0.1),
}


@pytest.mark.parametrize("name", SAMPLERS)
@pytest.mark.parametrize("wire", WIRES)
def test_a_wire_is_told_where_no_cell_shows_it(name, wire):
    found, depth = between(name, *strip(*WIRES[wire], z=0.5))
    expected = cells_near(*WIRES[wire]) & ~around(depth > 0)
    assert expected.any()
    np.testing.assert_array_equal(found > 0, expected)
    np.testing.assert_allclose(found[expected], 3.5, rtol=1e-5)


@pytest.mark.parametrize("name", SAMPLERS)
def test_in_front_of_something_it_is_told_and_behind_it_is_not(name):
    card = strip((2.3, 20.2), (47.6, 20.2), 30.0)
    for z, told in ((0.5, True), (-0.5, False)):
        wire = strip(*WIRES["slanted"], z=z)
        found, depth = between(name, *several(card, wire))
        expected = cells_near(*WIRES["slanted"]) & ~around((depth > 0) & (depth < 4)) & (depth > 0) & told
        np.testing.assert_array_equal(found > 0, expected)
        assert expected.any() == told


@pytest.mark.parametrize("name", SAMPLERS)
def test_culled_triangles_are_not_told(name):
    vertices, faces = strip(*WIRES["slanted"])
    away = between(name, vertices, faces[:, ::-1], cull="back")[0], between(name, vertices, faces, cull="back")[0]
    assert sorted((x > 0).any() for x in away) == [False, True]


@pytest.mark.parametrize("detail", quick([1, 3, 5], 2))
@pytest.mark.parametrize("cull", ["none", "back"])
def test_small_triangles_of_a_fine_mesh_are_not_told(detail, cull):
    vertices, faces = icosphere(detail, 0.9)
    vertices = vertices * [1, 0.7, 1.2]
    camera = Camera.look_at((0.4, 0.5, 3.2), (0, 0, 0)).for_size(PIXELS).map(lambda x: np.asarray(x, np.float64))
    found, depth = between("raster", vertices, faces, camera, cull=cull)
    assert not found.any() and (depth > 0).sum() > 300


def test_clusters_of_a_mesh_that_stays_tell_the_same():
    vertices, faces = soup(70000, 0, size=0.004)
    camera = Camera.look_at((0.4, 0.5, 3.2), (0, 0, 0)).for_size(PIXELS).map(lambda x: np.asarray(x, np.float64))
    sampler = rts.plugin("samplers", "raster")()
    proxy = Proxy(np.asarray(vertices, np.float32), np.asarray(faces, np.int32))
    for cull in ("none", "back"):
        depth = np.zeros(PIXELS, np.float32)
        found, expected = (sampler.between(x, camera, PIXELS, cull, depth) for x in (sampler.arrange(proxy), proxy))
        assert (expected > 0).sum() > 500 and sampler.arrange(proxy) is not proxy
        np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("seed", [0, *(pytest.param(n, marks=pytest.mark.thorough) for n in range(1, 8))])
def test_raster_tells_what_the_reference_tells(seed):
    rng = np.random.default_rng(seed)
    for size in (0.7, 0.06):
        vertices, faces = soup(60, seed, size=size)
        eye = rng.normal(size=3)
        camera = Camera.look_at(3 * eye / np.linalg.norm(eye), (0, 0, 0)).for_size(PIXELS)
        camera = camera.map(lambda x: np.asarray(x, np.float64))
        for cull in ("none", "back", "front"):
            found, expected = (between(name, vertices, faces, camera, cull=cull)[0] for name in SAMPLERS)
            np.testing.assert_array_equal(found > 0, expected > 0)
            np.testing.assert_allclose(found, expected, rtol=1e-5)
            assert size > 0.1 or (found > 0).sum() > 5


def test_limits_follow_planes_and_ridges():
    y, x = np.indices((9, 9))
    plane = 5 + 0.3 * x + 0.2 * y
    inner = (slice(1, -1),) * 2
    np.testing.assert_allclose(limits(plane)[inner], (plane - 0.5 - 0.5)[inner])
    ridge = 5 + 0.4 * np.abs(x - 3.5)
    assert (limits(ridge)[1:-1, 3:5] <= 5).all() and (limits(ridge)[1:-1, 3:5] >= 4.7).all()
    assert np.isinf(limits(np.zeros((4, 5)))).all()


def test_what_other_parts_hide_is_not_missed():
    row, depth = np.array([[0, 0, -1, -1]]), np.array([[2.0, 2.0, 0, 0]])
    between = np.array([[1.0, 3.0, 3.0, 0]])
    np.testing.assert_array_equal(missed(row, depth, between), [[True, False, True, False]])
    settled = np.array([[-1, -1, 0, -1]], np.int8)
    np.testing.assert_array_equal(missed(row, depth, between, settled), [[True, False, False, False]])


# ------------------------------------------------------------------------------------------------ adaptive images


def wire_part(wire="slanted", z=0.0, color=(1.0, 0.5, 0.2)):
    vertices, faces = strip(*WIRES[wire], z=z)
    return rts.Part(MESH(faces), {"vertices": vertices, "color": np.array(color, np.float32)}, "unlit")


def render(parts, supersample, **options):
    return to_numpy(
        rts.render(
            parts, flat_camera(), PIXELS, supersample=supersample, **{"splatter": "visible", "layers": 2, **options}
        )
    )


@pytest.mark.parametrize("wire", [wire for wire in WIRES if wire != "a speck"])
def test_a_wire_has_the_image_that_as_many_samples_everywhere_give(wire):
    part = wire_part(wire)
    adaptive, finer = (render(part, s) for s in (Adaptive(4, thin=True), 4))
    np.testing.assert_allclose(adaptive, finer, atol=1e-6)


def test_the_alpha_of_a_wire_sums_to_its_area():
    start, end, width = WIRES["slanted"]
    area = width * np.linalg.norm(np.subtract(end, start))
    total = {s: render(wire_part(), s)[..., 3].sum() for s in (Adaptive(8, thin=True), Adaptive(8))}
    assert abs(total[Adaptive(8, thin=True)] / area - 1) < 0.03
    assert total[Adaptive(8)] / area < 0.8


@pytest.mark.parametrize("first", [True, False])
def test_a_wire_before_another_part_is_seen(first):
    card, faces = strip((2.3, 20.2), (47.6, 20.2), 30.0)
    behind = rts.Part(MESH(faces), {"vertices": card, "color": np.array([0.2, 0.4, 1.0])}, "unlit")
    parts = [wire_part(z=0.5), behind] if first else [behind, wire_part(z=0.5)]
    adaptive, finer = (render(parts, s) for s in (Adaptive(4, thin=True), 4))
    start, end, width = WIRES["slanted"]
    inside = cells_near(start, end, width)
    np.testing.assert_allclose(adaptive[inside], finer[inside], atol=1e-6)
    hidden = [part.replace(theta={**part.theta, "vertices": part.theta["vertices"] - [0, 0, 1]}) for part in parts[:1]]
    if first:  # Behind the card it changes nothing.
        both = [render([*hidden, behind], s) for s in (Adaptive(4, thin=True), Adaptive(4))]
        np.testing.assert_array_equal(*both)


def test_unless_asked_nothing_looks_between_samples():
    class Refusing(rts.plugin("samplers", "raster")):
        def between(self, *_):
            raise AssertionError("it was asked")

    for supersample in (1, 2, Adaptive(4)):
        images = [render(wire_part(), supersample, sampler=sampler) for sampler in (Refusing(), "raster")]
        np.testing.assert_array_equal(*images)
    with pytest.raises(AssertionError, match="it was asked"):
        render(wire_part(), Adaptive(4, thin=True), sampler=Refusing())


def test_without_thin_things_images_are_the_same_to_the_last_bit():
    for shader in ("unlit", "lambert"):
        images = [
            rts.render(
                scene(shader=shader), CAMERA, SIZE, supersample=Adaptive(4, thin=thin), layers=3, splatter="visible"
            )
            for thin in (True, False)
        ]
        np.testing.assert_array_equal(*map(to_numpy, images))


@pytest.mark.parametrize("target", DIFFERENTIABLE)
def test_the_gradient_of_a_wire_is_that_of_as_many_samples_everywhere(target):
    part, weights = wire_part(), arrays(target, np.random.default_rng(0).random((*PIXELS, 4)))
    gradients = []
    for supersample in (Adaptive(4, thin=True), 4):

        def loss(vertices, supersample=supersample):
            moved = part.replace(theta={**part.theta, "vertices": vertices})
            return (
                rts.render(moved, flat_camera(), PIXELS, supersample=supersample, splatter="visible", layers=2)
                * weights
            ).sum()

        gradients.append(gradient(target, loss, arrays(target, part.theta["vertices"])))
    np.testing.assert_allclose(*gradients, rtol=1e-3, atol=1e-3)
    assert np.abs(gradients[0]).max() > 0.1


def test_compiled_by_jax_a_wire_has_the_same_image():
    jax = pytest.importorskip("jax")
    part = wire_part()

    def image(vertices):
        moved = part.replace(theta={**part.theta, "vertices": vertices})
        return rts.render(
            moved,
            flat_camera(),
            PIXELS,
            supersample=Adaptive(2, thin=True),
            capacity=4000,
            splatter="visible",
            layers=2,
        )

    vertices = arrays("jax", part.theta["vertices"])
    np.testing.assert_allclose(jax.jit(image)(vertices), render(part, 2), atol=1e-6)


def test_explain_counts_pixels_with_something_between_samples():
    options = {"size": PIXELS, "supersample": Adaptive(4, thin=True)}
    (choice,), (plain,) = (
        rts.explain(wire_part(), flat_camera(), **{**options, **more}) for more in ({}, {"supersample": 1})
    )
    found, _ = between("raster", *strip(*WIRES["slanted"]))
    assert choice.between == (found > 0).sum() > 0 and plain.between is None
    assert rts.explain(scene(), CAMERA, SIZE, supersample=Adaptive(4, thin=True))[0].between == 0


class Mute(rts.plugin("samplers", "reference")):
    """A sampler of triangles that does not tell."""

    between = rts.TriangleSampler.between


def test_samplers_that_do_not_tell_change_nothing_and_say_so():
    part, mute = wire_part(), Mute()
    plain = render(part, Adaptive(4), sampler=mute)
    with pytest.warns(rts.errors.InputWarning, match=r"the sampler Mute does not tell .* of Mesh\(2 faces\); give"):
        np.testing.assert_array_equal(render(part, Adaptive(4, thin=True), sampler=mute), plain)
    with pytest.warns(rts.errors.InputWarning, match="does not tell"):
        sampled = rts.sample(
            part, flat_camera(), PIXELS, supersample=Adaptive(4, thin=True), sampler=mute, splatter="visible", layers=2
        )
    assert sampled.between is None


def test_auto_takes_a_sampler_that_tells(monkeypatch):
    pytest.importorskip("rts_backends.embree.sampler")
    monkeypatch.setattr("rts.sampling.auto.STATIC_FACES", 2)
    torch = pytest.importorskip("torch")
    part, camera = wire_part(), flat_camera().map(lambda x: torch.tensor(x, dtype=torch.float32))

    def found(supersample):
        (choice,) = rts.explain(part, camera, PIXELS, supersample=supersample)
        return choice.sampler, choice.between

    assert found(Adaptive(4)) == ("embree", None)
    sampler, count = found(Adaptive(4, thin=True))
    assert sampler == "raster" and count > 0
    images = [
        rts.render(
            part, camera, PIXELS, supersample=Adaptive(4, thin=True), sampler=sampler, splatter="visible", layers=2
        )
        for sampler in ("auto", "raster")
    ]
    np.testing.assert_array_equal(*map(to_numpy, images))
    with pytest.warns(rts.errors.InputWarning, match="the sampler embree does not tell"):
        rts.render(rts.prepare(part), camera, PIXELS, supersample=Adaptive(4, thin=True), splatter="visible", layers=2)


def test_a_wrong_thin_is_refused():
    with pytest.raises(rts.InputError, match="thin of Adaptive is 'yes'; expected True or False"):
        Adaptive(4, thin="yes")
    assert Adaptive.of_text("adaptive:4:thin=True") == Adaptive(4, thin=True)
