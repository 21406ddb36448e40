"""Samplers' structures are built once, follow changes, and are released; `rts.prepare`; the choices of "auto"."""

import gc
import logging
import warnings
import weakref

import numpy as np
import pytest
from analytic import Ellipsoid
from helpers import arrays, icosphere, soup, to_numpy

import rts
from rts import Camera, GBuffer, InputError, Part, TriangleSampler, registry
from rts.errors import PluginError
from rts.plugin_api.records import Proxy
from rts.plugin_base import overrides
from rts.sampling import cache
from rts.sampling.cache import KEPT, fingerprint, same_faces

pytestmark = pytest.mark.sampling

CAMERA = Camera.look_at((1, 2, 3), (0, 0, 0), fov_y=50)
SIZE = (16, 20)
Mesh = rts.plugin("surfaces", "mesh")


def sampler_class(name):
    try:
        return rts.plugin("samplers", name)
    except PluginError as error:
        pytest.skip(str(error))


def counting(name):
    """A sampler that counts what it builds and what it moves."""

    class Counting(sampler_class(name)):
        def __init__(self):
            super().__init__()
            self.prepared, self.updated = [], 0

        def prepare(self, proxy):
            built = super().prepare(proxy)
            self.prepared.append((lambda: built) if isinstance(built, tuple) else weakref.ref(built))
            return built

    if overrides(Counting, "update", rts.TriangleSampler):

        def update(self, prepared, proxy):
            self.updated += 1
            return super(Counting, self).update(prepared, proxy)

        Counting.update = update
    return Counting()


class Plain(TriangleSampler):
    """A sampler that prepares something and knows no update; draws by the reference."""

    def __init__(self):
        self.reference, self.built = rts.plugin("samplers", "reference")(), 0

    def prepare(self, proxy):
        self.built += 1
        return Proxy(*proxy)

    def rasterize(self, prepared, camera, size, layers, cull):
        return self.reference.rasterize(prepared, camera, size, layers, cull)


def part_of(vertices, faces, **more):
    return Part(Mesh(faces), {"vertices": vertices}, **{"shader": "normals", **more})


def poses(count):
    return np.random.default_rng(0).normal(0, 0.3, (count, 6)).astype(np.float32)


PREPARING = ("embree", "opengl")

# ------------------------------------------------------------------------------------ built once for many poses


@pytest.mark.parametrize("name", PREPARING)
def test_numpy_builds_once_for_a_hundred_poses(name):
    sampler, part = counting(name), part_of(*icosphere(1))
    moved = [part.replace(transform=rts.rigid(p)) for p in poses(100)]
    images = [rts.render(p, CAMERA, SIZE, sampler=sampler, layers=1) for p in moved]
    assert len(sampler.prepared) == 1 and sampler.updated == 0
    assert np.abs(np.diff(images, axis=0)).max(axis=(1, 2, 3)).min() > 0


@pytest.mark.parametrize("constant", [True, False], ids=["NumPy vertices", "tensors"])
@pytest.mark.parametrize("target", ["torch-cpu", "jax"])
def test_eager_engines_build_once_for_a_hundred_poses(target, constant):
    vertices, faces = icosphere(1)
    sampler, part = counting("embree"), part_of(vertices if constant else arrays(target, vertices), faces)
    moving = arrays(target, poses(100 if target == "torch-cpu" else 8))
    for pose in moving:
        rts.render(part.replace(transform=rts.rigid(pose)), CAMERA, SIZE, sampler=sampler, layers=1)
    assert len(sampler.prepared) == 1


def test_torch_transforms_build_once():
    torch = pytest.importorskip("torch")
    sampler, part = counting("embree"), part_of(*icosphere(1))

    def image(pose):
        return rts.render(part.replace(transform=rts.rigid(pose)), CAMERA, SIZE, sampler=sampler, layers=1)

    many = torch.from_numpy(poses(30))
    matrix = torch.func.jacfwd(image)(many[0])
    assert matrix.shape == (*SIZE, 4, 6) and matrix.abs().max() > 0
    batch = torch.func.vmap(image)(many)
    assert len(sampler.prepared) == 1
    torch.testing.assert_close(batch[7], image(many[7]), atol=1e-5, rtol=1e-5)
    assert len(sampler.prepared) == 1


@pytest.mark.parametrize("constant", [True, False], ids=["NumPy vertices", "arrays"])
def test_a_traced_function_of_jax_builds_once_for_a_hundred_poses(constant):
    jax = pytest.importorskip("jax")
    vertices, faces = icosphere(1)
    sampler, part = counting("embree"), part_of(vertices if constant else arrays("jax", vertices), faces)

    def image(pose):
        return rts.render(part.replace(transform=rts.rigid(pose)), CAMERA, SIZE, sampler=sampler, layers=1)

    compiled, many = jax.jit(image), arrays("jax", poses(100))
    images = np.stack([compiled(pose) for pose in many])
    assert len(sampler.prepared) == 1
    assert np.abs(np.diff(images, axis=0)).max(axis=(1, 2, 3)).min() > 0
    matrix = jax.jit(jax.jacfwd(image))(many[0])
    assert matrix.shape == (*SIZE, 4, 6) and np.isfinite(matrix).all() and np.abs(matrix).max() > 0
    batch = jax.jit(jax.vmap(image))(many[:5])
    np.testing.assert_allclose(batch, images[:5], atol=1e-5)
    assert len(sampler.prepared) == 1


def test_two_parts_have_structures_of_their_own():
    sampler = counting("embree")
    parts = [part_of(*icosphere(1)), part_of(*icosphere(1, 0.5, (1, 0, 0)))]
    for pose in poses(5):
        moved = [p.replace(transform=rts.rigid(pose)) for p in parts]
        found = rts.render(moved, CAMERA, SIZE, sampler=sampler)
        np.testing.assert_allclose(found, rts.render(moved, CAMERA, SIZE, sampler="raster"), atol=1e-5)
    assert len(sampler.prepared) == 2


# ----------------------------------------------------------------------------------------- changed vertices


@pytest.mark.parametrize("target", ["numpy", "torch-cpu"])
@pytest.mark.parametrize("name", PREPARING)
def test_a_change_in_place_is_noticed(name, target):
    sampler, (vertices, faces) = counting(name), icosphere(2)
    part = part_of(arrays(target, vertices), faces)
    before = to_numpy(rts.render(part, CAMERA, SIZE, sampler=sampler))
    part.theta["vertices"][:, 0] *= 0.5
    after = to_numpy(rts.render(part, CAMERA, SIZE, sampler=sampler))
    assert np.abs(after - before).max() > 0.1
    np.testing.assert_allclose(after, rts.render(part, CAMERA, SIZE, sampler="raster"), atol=1e-5)
    assert len(sampler.prepared) == 2
    part.theta["vertices"][0, 0] += 1e-6
    rts.render(part, CAMERA, SIZE, sampler=sampler)
    assert len(sampler.prepared) + sampler.updated == 3


def test_what_is_kept_does_not_change_with_the_array_it_was_made_of():
    sampler, (vertices, faces) = counting("embree"), icosphere(2)
    part = part_of(vertices, faces)
    before = rts.render(part, CAMERA, SIZE, sampler=sampler)
    original = vertices.copy()
    vertices *= 0.5
    rts.render(part, CAMERA, SIZE, sampler=sampler)
    vertices[:] = original
    np.testing.assert_array_equal(rts.render(part, CAMERA, SIZE, sampler=sampler), before)
    assert len(sampler.prepared) == 2 and sampler.updated == 0


def test_moved_vertices_are_followed_by_refitting_and_look_the_same_as_built_anew(monkeypatch):
    from rts_backends.embree import library as embree_library
    from rts_backends.embree import sampler as embree

    rebuilt = []
    move = embree_library.Scene.move

    def record(self, *, rebuild):
        rebuilt.append(rebuild)
        move(self, rebuild=rebuild)

    monkeypatch.setattr(embree_library.Scene, "move", record)
    monkeypatch.setattr(embree, "REFITS", 4)
    sampler, (vertices, faces) = counting("embree"), soup(300, size=0.3)
    part, rng = part_of(vertices, faces), np.random.default_rng(0)
    for step in range(14):
        # Small steps, then corners thrown about, then all of it elsewhere and of another size.
        spread = 0.05 if step < 5 else 2.0
        moved = vertices + rng.normal(0, spread, vertices.shape).astype(np.float32)
        if step > 9:
            moved = (moved * 10.0 ** (step - 12) + 5).astype(np.float32)
        part = part.replace(theta={"vertices": moved})
        center, reach = moved.mean(axis=0), np.ptp(moved)
        camera = Camera.look_at(center + reach * np.array([0.3, 0.4, 1.5]), center, near=0.1 * reach, far=9 * reach)
        found = rts.sample(part, camera, (40, 50), sampler=sampler, layers=3, splatter=None)
        fresh = rts.sample(part, camera, (40, 50), sampler=sampler_class("embree")(), layers=3, splatter=None)
        for name in ("row", "depth"):
            np.testing.assert_array_equal(getattr(found, name), getattr(fresh, name))
        np.testing.assert_array_equal(found.samples[0].ids, fresh.samples[0].ids)
        assert (found.row >= 0).sum() > 300
    assert len(sampler.prepared) == KEPT and sampler.updated == 14 - KEPT
    # Both kept structures took turns, each built anew at every fourth move.
    assert sum(rebuilt) == 2 and len(rebuilt) == 14 - KEPT


def test_only_vertices_may_differ_where_structures_are_refitted():
    vertices, faces = icosphere(1)
    proxy = Proxy(vertices.astype(np.float32), faces.astype(np.int32))
    assert same_faces(proxy, proxy._replace(vertices=2 * proxy.vertices, faces=proxy.faces.copy()))
    assert not same_faces(proxy, proxy._replace(faces=proxy.faces[:, ::-1]))
    assert not same_faces(proxy, proxy._replace(vertices=proxy.vertices[:-1]))


def test_a_sampler_without_update_builds_anew_each_time():
    sampler, (vertices, faces) = Plain(), icosphere(1)
    part = part_of(vertices, faces)
    for _ in range(5):
        vertices *= 0.9
        found = rts.render(part, CAMERA, SIZE, sampler=sampler)
        np.testing.assert_allclose(found, rts.render(part, CAMERA, SIZE, sampler="raster"), atol=1e-5)
    assert sampler.built == 5


def test_a_failure_to_build_leaves_nothing_behind():
    sampler, (vertices, faces) = counting("embree"), icosphere(1)
    part = part_of(vertices, faces)
    expected = rts.render(part, CAMERA, SIZE, sampler=sampler)
    good = vertices.copy()
    for _ in range(4):
        vertices[3] = np.nan
        with pytest.raises(InputError, match="vertex 3"):
            rts.render(part, CAMERA, SIZE, sampler=sampler)
    vertices[:] = good
    np.testing.assert_array_equal(rts.render(part, CAMERA, SIZE, sampler=sampler), expected)


# ------------------------------------------------------------------------------------------ bounded, and let go


def test_a_surface_keeps_its_two_newest_structures_only():
    sampler, (vertices, faces) = Plain(), icosphere(1)
    part = part_of(vertices, faces)
    shapes = [(vertices * s).astype(np.float32) for s in (1.0, 0.9, 0.8)]
    for index in (0, 1, 0, 1, 1, 0):
        rts.render(part.replace(theta={"vertices": shapes[index]}), CAMERA, SIZE, sampler=sampler)
    assert sampler.built == 2
    for index in (2, 0, 2):
        rts.render(part.replace(theta={"vertices": shapes[index]}), CAMERA, SIZE, sampler=sampler)
    assert sampler.built == 3
    rts.render(part.replace(theta={"vertices": shapes[1]}), CAMERA, SIZE, sampler=sampler)
    assert sampler.built == 4
    (entries,) = sampler._keeper._entries.values()
    assert len(entries) == KEPT


@pytest.mark.parametrize("name", PREPARING)
def test_structures_go_with_their_surface(name):
    sampler = counting(name)
    for _ in range(3):
        rts.render(part_of(*icosphere(1)), CAMERA, SIZE, sampler=sampler)
    gc.collect()
    assert len(sampler.prepared) == 3
    assert [ref() for ref in sampler.prepared] == [None] * 3
    assert not len(sampler._keeper._entries)


def test_what_embree_holds_is_released_with_the_surface(monkeypatch):
    sampler = counting("embree")
    from rts_backends.embree import library

    released, release = [], library._release
    monkeypatch.setattr(library, "_release", lambda *given: released.append(given) or release(*given))
    part = part_of(*icosphere(1))
    for scale in (1.0, 0.9, 0.8, 0.7):
        theta = {"vertices": part.theta["vertices"] * np.float32(scale)}
        rts.render(part.replace(theta=theta), CAMERA, SIZE, sampler=sampler)
    assert not released and len(sampler.prepared) == KEPT
    del part
    gc.collect()
    assert len(released) == KEPT


@pytest.mark.parametrize("name", PREPARING)
def test_structures_go_with_their_sampler(name):
    sampler, part = counting(name), part_of(*icosphere(1))
    rts.render(part, CAMERA, SIZE, sampler=sampler)
    (built,) = sampler.prepared
    assert built() is not None
    del sampler
    gc.collect()
    assert built() is None


def test_a_handle_holds_its_structure_and_lets_it_go():
    sampler = counting("embree")
    handle = rts.prepare(part_of(*icosphere(1)), sampler)
    gc.collect()
    assert sampler.prepared[0]() is not None
    del handle
    gc.collect()
    assert sampler.prepared[0]() is None


# ---------------------------------------------------------------------------------------------- rts.prepare


@pytest.mark.parametrize("name", ["raster", "reference", *PREPARING])
def test_a_prepared_part_is_not_looked_at_again(name, monkeypatch):
    sampler, part = counting(name), part_of(*icosphere(2))
    expected = [rts.render(part.replace(transform=rts.rigid(p)), CAMERA, SIZE, sampler=name) for p in poses(5)]
    handle = rts.prepare(part, sampler)

    def refuse(*_):
        raise AssertionError("looked at the surface's inputs")

    monkeypatch.setattr("rts.sampling.triangle_sampler.fingerprint", refuse)
    monkeypatch.setattr(Mesh, "proxy", refuse)
    for pose, image in zip(poses(5), expected, strict=True):
        found = rts.render(handle.replace(transform=rts.rigid(pose)), CAMERA, SIZE)
        np.testing.assert_array_equal(found, image)
    assert len(sampler.prepared) == 1


def test_a_prepared_part_takes_other_shaders_and_theta_but_no_other_surface():
    vertices, faces = icosphere(2)
    colors = np.random.default_rng(0).uniform(size=vertices.shape).astype(np.float32)
    part = Part(Mesh(faces), {"vertices": vertices, "colors": colors}, "unlit")
    handle = rts.prepare(part, "raster")
    for changes in ({"shader": "normals"}, {"theta": {"vertices": vertices, "colors": 1 - colors}}, {"cull": "back"}):
        found = rts.render(handle.replace(**changes), CAMERA, SIZE)
        np.testing.assert_array_equal(found, rts.render(part.replace(**changes), CAMERA, SIZE, sampler="raster"))
    with pytest.raises(InputError, match="rts.prepare"):
        handle.replace(surface=Mesh(faces))


def test_later_changes_of_vertices_are_not_seen_by_a_handle():
    vertices, faces = icosphere(2)
    part = part_of(vertices, faces, shader="silhouette")
    handle = rts.prepare(part, sampler_class("embree"))
    before = rts.sample(handle, CAMERA, SIZE, splatter=None)
    vertices *= 0.5
    after = rts.sample(handle, CAMERA, SIZE, splatter=None)
    np.testing.assert_array_equal(after.depth, before.depth)


def test_several_prepared_parts_each_with_its_sampler():
    parts = [
        part_of(*icosphere(2)),
        Part(Ellipsoid(), {"center": np.float32([0.8, 0, 0]), "radii": np.float32([0.5, 0.7, 0.4])}, "normals"),
    ]
    handle = rts.prepare(parts)
    assert [type(s).__name__ for s in handle.samplers] == ["Raster", "Rays"]
    assert handle.entries[1] is None
    np.testing.assert_array_equal(rts.render(handle, CAMERA, SIZE), rts.render(parts, CAMERA, SIZE))
    move = rts.rigid((0, 0.3, 0, 0.2, 0, 0))
    moved = [parts[0], parts[1].replace(transform=move)]
    found = rts.render(handle.replace(1, transform=move), CAMERA, SIZE)
    np.testing.assert_array_equal(found, rts.render(moved, CAMERA, SIZE))
    assert np.abs(found - rts.render(parts, CAMERA, SIZE)).max() > 0.05


def test_a_handle_serves_in_torch_and_in_a_traced_function_of_jax():
    part = part_of(*icosphere(2))
    handle = rts.prepare(part, "raster")
    expected = rts.render(part.replace(transform=rts.rigid(poses(1)[0])), CAMERA, SIZE, sampler="raster")
    torch = pytest.importorskip("torch")
    pose = torch.from_numpy(poses(1)[0])

    def image(pose):
        return rts.render(handle.replace(transform=rts.rigid(pose)), CAMERA, SIZE)

    np.testing.assert_allclose(image(pose), expected, atol=1e-5)
    assert torch.func.jacfwd(image)(pose).abs().max() > 0
    jax = pytest.importorskip("jax")
    np.testing.assert_allclose(jax.jit(image)(jax.numpy.asarray(poses(1)[0])), expected, atol=1e-5)


# --------------------------------------------------------------------- triangles that depend on the view


class Ball(rts.TriangleSurface):
    """A sphere cut into more triangles the nearer it is; the parameters of a sample are a point near the sphere."""

    sample_widths = (3, 3)

    def __init__(self):
        self.made = []

    def proxy_inputs(self, theta):
        return theta["radius"]

    def _level(self, camera):
        distance = np.linalg.norm(np.linalg.inv(camera.view)[:3, 3])
        return int(np.clip(6 - distance / 2, 0, 4))

    def proxy_key(self, inputs, camera, size):
        return self._level(camera)

    def proxy(self, inputs, camera, size):
        level = self._level(camera)
        self.made.append(level)
        vertices, faces = icosphere(level, float(inputs))
        return Proxy(vertices, faces, corner_params=vertices[faces])

    def evaluate(self, theta, samples):
        return GBuffer(position=samples.params * (theta["radius"] / theta["radius"]), normal=samples.params)


@pytest.mark.parametrize("name", ["embree", "raster"])
def test_triangles_that_depend_on_the_view_are_made_anew_when_their_key_changes(name):
    surface, sampler = Ball(), counting(name)
    part = Part(surface, {"radius": np.float32(1.0)}, "normals")

    def look(distance):
        camera = Camera.look_at((0, 0.2 * distance, distance), (0, 0, 0), fov_y=60 / distance)
        return rts.render(part, camera, SIZE, sampler=sampler), rts.render(part, camera, SIZE, sampler="reference")

    levels = []
    for distance in (3.0, 3.1, 3.2, 8.0, 8.1, 3.0):
        surface.made.clear()
        found, expected = look(distance)
        np.testing.assert_allclose(found, expected, atol=1e-5)
        levels.append(list(surface.made))
    # One sampler and the other each make it: when first seen, and no more while the key stays.
    assert [len(made) for made in levels] == [2, 0, 0, 2, 0, 0]
    assert levels[0][0] > levels[3][0]


def test_a_handle_of_such_triangles_needs_a_camera_and_a_size():
    surface = Ball()
    part = Part(surface, {"radius": np.float32(1.0)}, "normals")
    for given in ({}, {"camera": CAMERA}, {"size": SIZE}):
        with pytest.raises(InputError, match="give camera and size"):
            rts.prepare(part, "raster", **given)
    move = rts.rigid((0, 0, 0, 0, 0, -5))
    handle = rts.prepare(part.replace(transform=move), "raster", camera=CAMERA, size=SIZE)
    assert len(surface.made) == 1
    near = Ball()
    rts.prepare(Part(near, part.theta, "normals"), "raster", camera=CAMERA, size=SIZE)
    assert near.made[0] > surface.made[0]
    rts.render(handle, CAMERA, SIZE)
    assert len(surface.made) == 1


# --------------------------------------------------------------------------------------- auto and explain


@pytest.fixture
def few(monkeypatch):
    """As if eighty triangles were many."""
    monkeypatch.setattr("rts.sampling.auto.STATIC_FACES", 80)


def differentiable_camera():
    torch = pytest.importorskip("torch")
    return CAMERA.map(lambda m: torch.as_tensor(np.asarray(m, np.float32)))


ELLIPSOID = Part(Ellipsoid(), {"center": np.zeros(3, np.float32), "radii": np.ones(3, np.float32)}, "normals")
CHOICES = {
    "no triangles": (lambda: (ELLIPSOID, CAMERA), "rays", ("no triangles", "Ellipsoid")),
    "many that stay": (lambda: (part_of(*icosphere(1)), differentiable_camera()), "embree", ("80 triangles",)),
    "few": (lambda: (part_of(*icosphere(0)), differentiable_camera()), "raster", ("20 triangles", "80")),
    "may move": (
        lambda: (part_of(arrays("torch-cpu", icosphere(1)[0]), icosphere(1)[1]), differentiable_camera()),
        "raster",
        ("may change",),
    ),
    "one render of NumPy": (lambda: (part_of(*icosphere(1)), CAMERA), "raster", ("may change",)),
}


@pytest.mark.parametrize("name", CHOICES)
def test_auto_chooses_by_triangles_and_what_moves_says_why_and_renders_so(few, name, caplog):
    given, sampler, words = CHOICES[name]
    part, camera = given()
    sampler_class(sampler)
    (choice,) = rts.explain(part, camera)
    assert choice.sampler == sampler and all(word in choice.reason for word in words)
    with caplog.at_level(logging.DEBUG, logger="rts"):
        image = rts.render(part, camera, SIZE)
    assert f"{sampler} for {part.surface!r}: {choice.reason}" in caplog.text
    assert all(record.levelno == logging.DEBUG for record in caplog.records)
    expected = rts.render(part, camera, SIZE, sampler="rays" if sampler == "rays" else "raster")
    np.testing.assert_allclose(to_numpy(image), to_numpy(expected), atol=1e-5 if sampler == "embree" else 0)
    both = rts.explain([part_of(*icosphere(0)), part], camera)
    assert [c.sampler for c in both] == ["raster", sampler]


def test_without_embree_raster_serves_and_the_reason_says_so(few, monkeypatch):
    plugin = registry.plugin

    def missing(group, name):
        if name == "embree":
            raise PluginError(
                "the sampler 'embree' needs the package 'embreex': pip install 'rasterize-then-splat[embree]'"
            )
        return plugin(group, name)

    monkeypatch.setattr(registry, "plugin", missing)
    (choice,) = rts.explain(part_of(*icosphere(1)), differentiable_camera())
    assert choice.sampler == "raster" and "pip install 'rasterize-then-splat[embree]'" in choice.reason
    handle = rts.prepare(part_of(*icosphere(1)))
    assert type(handle.samplers[0]).__name__ == "Raster"


def test_a_prepared_part_counts_as_static(few):
    sampler_class("embree")
    handle = rts.prepare([part_of(*icosphere(1)), part_of(*icosphere(0))])
    assert [type(s).__name__ for s in handle.samplers] == ["Embree", "Raster"]


def test_prepared_parts_are_explained_by_the_sampler_that_they_have(few):
    sampler_class("embree")
    parts = [part_of(*icosphere(1)), part_of(*icosphere(0))]
    for sampler, names in (("auto", ["embree", "raster"]), ("reference", ["reference"] * 2)):
        choices = rts.explain(rts.prepare(parts, sampler), CAMERA)
        assert [c.sampler for c in choices] == names and "prepared" in choices[0].reason
    own = sampler_class("reference")()
    assert rts.explain(rts.prepare(parts[0], own), CAMERA)[0].sampler == type(own).__name__


# --------------------------------------------------------------------------------------------- fingerprints


@pytest.mark.parametrize("count", [1, 2, 3, 5, 7, 8, 9, 31, 64, 100])
def test_a_fingerprint_changes_with_any_byte(count):
    data = np.random.default_rng(count).integers(0, 256, count).astype(np.uint8)
    seen = {fingerprint(data)}
    for i in range(count):
        for bit in (0, 3, 7):
            changed = data.copy()
            changed[i] ^= np.uint8(1 << bit)
            seen.add(fingerprint(changed))
    assert len(seen) == 1 + 3 * count


def test_a_fingerprint_tells_zeros_of_any_shape_and_type_apart():
    shapes = [(12,), (3, 4), (4, 3), (2, 6), (1, 12), (24,), (0,), (0, 3), ()]
    types = [np.float32, np.float64, np.int32, np.int64, np.uint8]
    assert len({fingerprint(np.zeros(s, t)) for s in shapes for t in types}) == len(shapes) * len(types)
    a, b = np.zeros(2, np.float32), np.ones(2, np.float32)
    assert len({fingerprint(t) for t in ((a, b), (b, a), (a,), (a, b, a), ())}) == 5


def test_equal_bytes_have_equal_fingerprints_wherever_they_lie():
    data = np.random.default_rng(0).normal(size=(50, 3)).astype(np.float32)
    spread = np.zeros((100, 6), np.float32)
    spread[::2, ::2] = data
    odd = np.frombuffer(b"x" + data.tobytes(), np.uint8)[1:].view(np.float32).reshape(50, 3)
    for same in (data.copy(), np.asfortranarray(data), spread[::2, ::2], odd):
        assert fingerprint({"vertices": same}) == fingerprint({"vertices": data})
    read_only = data.copy()
    read_only.flags.writeable = False
    assert fingerprint(read_only) == fingerprint(data)
    assert cache.fingerprint([data, {"b": 2 * data, "a": data}]) == fingerprint([data, {"a": data, "b": 2 * data}])


@pytest.mark.parametrize("target", ["numpy", "torch-cpu"])
def test_a_renderer_gives_the_images_of_render(target):
    prepared = rts.prepare([part_of(*icosphere(1)), part_of(*icosphere(2), shader="normals")])
    settings = {"layers": 3, "background": (0.1, 0.2, 0.3)}
    draw = prepared.renderer(CAMERA, SIZE, **settings)
    for pose in arrays(target, poses(3)):
        moved = rts.rigid(pose)
        np.testing.assert_array_equal(
            to_numpy(draw(index=1, transform=moved)),
            to_numpy(rts.render(prepared.replace(1, transform=moved), CAMERA, SIZE, **settings)),
        )
    np.testing.assert_array_equal(to_numpy(draw()), to_numpy(rts.render(prepared, CAMERA, SIZE, **settings)))
    painted = {"shader": "depth", "cull": "back"}
    np.testing.assert_array_equal(
        to_numpy(draw(-1, **painted)), to_numpy(rts.render(prepared.replace(1, **painted), CAMERA, SIZE, **settings))
    )


def test_a_renderer_refuses_what_render_refuses():
    prepared = rts.prepare(part_of(*icosphere(1)))
    with pytest.raises(InputError, match="layers"):
        prepared.renderer(CAMERA, SIZE, layers=0)
    with pytest.raises(InputError, match="camera"):
        prepared.renderer(None, SIZE)
    draw = prepared.renderer(CAMERA, SIZE)
    for changes, words in (
        ({"transform": np.eye(3)}, r"transform of part 0 .*expected a \(4, 4\) array"),
        ({"surface": Mesh(icosphere(1)[1])}, "keeps its surface"),
        ({"index": 1, "transform": np.eye(4)}, "one of 1 parts"),
        ({"index": 1}, "one of 1 parts"),
        ({"colour": 1}, "colour"),
    ):
        with pytest.raises(InputError, match=words):
            draw(**changes)


@pytest.mark.parametrize("kind", ["numpy", "torch"])
def test_a_render_of_a_handle_warns_of_vertices_that_have_changed(kind):
    torch = pytest.importorskip("torch")
    vertices, faces = icosphere(2)
    part = part_of(vertices, faces, shader="silhouette")
    if kind == "torch":
        part = part.replace(theta=part.theta | {"vertices": torch.tensor(vertices)})
    handle = rts.prepare(part, "raster")
    draw = handle.renderer(CAMERA, SIZE)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        draw(transform=rts.rigid(np.full(6, 0.01)))
        rts.render(handle, CAMERA, SIZE)
    part.theta["vertices"][:] *= 0.9
    for call in (draw, lambda: rts.render(handle, CAMERA, SIZE)):
        with pytest.warns(rts.errors.InputWarning, match="vertices of part 0 have changed since rts.prepare"):
            call()
