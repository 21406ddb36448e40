"""Values from users: NaN and infinity, other dtypes, shared memory, empty images."""

import copy
import pickle

import numpy as np
import pytest
from helpers import ALL, DIFFERENTIABLE, TRIANGLE_SAMPLERS, arrays, gradient, rigid, to_numpy
from second_plugin.torus import Torus

import rts
from rts import Camera, InputError, Part
from rts.arrays.array_functions import is_finite
from rts.arrays.trees import leaves
from rts.plugin_api.records import Proxy

pytestmark = pytest.mark.rendering

SIZE = (24, 32)
CAMERA = Camera.look_at((0.4, 0.9, 4), (0, 0, 0), fov_y=45)
Mesh = rts.plugin("surfaces", "mesh")
PART = Mesh.example()
VERTICES, FACES = PART.theta["vertices"], PART.surface.faces
UV = np.stack([VERTICES[:, 0], VERTICES[:, 1]], axis=1) * 0.4 + 0.5
TEXTURE = np.random.default_rng(0).random((4, 4, 3)).astype(np.float32)


def made(shader="lambert", **theta):
    return PART.replace(theta={**PART.theta, **theta}, shader=shader)


def lit(shader="lambert", **light):
    return made(shader, light=light)


def show(part=PART, camera=CAMERA, size=SIZE, **options):
    return rts.render(part, camera, size, **options)


def with_nan(array, value=np.nan):
    array = np.array(array, np.float32)
    array.reshape(-1)[::2] = value
    return array


# ---------------------------------------------------------------------------------------------- not a number


@pytest.mark.parametrize("target", ALL)
def test_one_number_that_is_not_finite_is_found_wherever_it_is(target):
    x = np.random.default_rng(0).normal(size=(7, 5)).astype(np.float32)
    repeated = arrays(target, np.broadcast_to(x[:1], (9, 5))), arrays(target, np.broadcast_to(x[:, :1], (7, 9)))
    assert is_finite(arrays(target, x), arrays(target, x[:0]), arrays(target, x[0, 0]), *repeated)
    for value in (np.nan, -np.nan, np.inf, -np.inf):
        for at in ((0, 0), (6, 4), (3, 0)):
            bad = x.copy()
            bad[at] = value
            assert not is_finite(arrays(target, bad))
            assert not is_finite(arrays(target, np.broadcast_to(bad[at[0]], (9, 5))))
            assert is_finite(arrays(target, np.delete(bad, at[0], axis=0)))


UVS = UV.astype(np.float32)
HOLED = {  # The name of an entry, and a part whose entry has a value at every other place.
    "colours": ("theta['colors']", lambda nan: made(colors=with_nan(PART.theta["colors"], nan))),
    "normals": ("theta['normals']", lambda nan: made(normals=with_nan(VERTICES, nan))),
    "uv": ("theta['uv']", lambda nan: made("textured", uv=with_nan(UV, nan), texture=TEXTURE)),
    "texture": ("theta['texture']", lambda nan: made("textured", uv=UVS, texture=with_nan(TEXTURE, nan))),
    "colour": ("theta['color']", lambda nan: made(color=with_nan(np.ones(3), nan))),
    "direction of light": ("theta['light']['direction']", lambda nan: lit(direction=with_nan(np.ones(3), nan))),
    "color of light": ("theta['light']['color']", lambda nan: lit(color=with_nan(np.ones(3), nan))),
    "ambient of light": ("theta['light']['ambient']", lambda nan: lit(ambient=with_nan(np.ones(3), nan))),
    "one of two lights": (
        "theta['light']['direction']",
        lambda nan: lit(direction=np.float32([[0, 0, 1], [nan, 1, 0]])),
    ),
    "specular": ("theta['specular']", lambda nan: made("blinn_phong", specular=with_nan(np.ones(3), nan))),
    "shininess": ("theta['shininess']", lambda nan: made("blinn_phong", shininess=with_nan(np.ones(1), nan))),
    "light of highlights": (
        "theta['light']['direction']",
        lambda nan: lit("blinn_phong", direction=with_nan(np.ones(3), nan)),
    ),
    "range of depth": ("theta['depth_range']", lambda nan: made("depth", depth_range=with_nan(np.ones(2), nan))),
}


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("target", ["numpy", *DIFFERENTIABLE])
@pytest.mark.parametrize("what", HOLED)
def test_what_is_not_finite_is_refused_by_name(what, target, value):
    name, holed = HOLED[what]
    part = holed(value)
    with np.errstate(invalid="ignore"), pytest.raises(InputError) as error:
        show(part.replace(theta=arrays(target, part.theta)))
    assert name in str(error.value) and "NaN or infinity" in str(error.value)


@pytest.mark.parametrize("what", HOLED)
@pytest.mark.thorough
def test_in_a_compiled_program_what_is_not_a_number_stays_so(what):
    jax = pytest.importorskip("jax")
    part = HOLED[what][1](np.nan)
    image = jax.jit(lambda theta: show(part.replace(theta=theta)))(arrays("jax", part.theta))
    assert np.isnan(image).any()


@pytest.mark.parametrize("target", DIFFERENTIABLE)
def test_in_forward_mode_what_is_not_finite_is_refused(target):
    part, colors = made(), arrays(target, with_nan(PART.theta["colors"]))
    engine = rts.engine_of(colors)
    with pytest.raises(InputError, match=r"theta\['colors'\] of part 0 holds NaN"):
        engine.jvp(lambda c: show(made(colors=c)), colors, engine.namespace.ones_like(colors))
    assert part.theta["colors"].max() <= 1


def test_a_shader_that_gives_nan_is_named():
    def broken(theta, gbuffer, camera):
        return gbuffer["position"][:, [0, 1, 2, 2]] * np.nan

    with pytest.raises(InputError, match="what the shader .*broken.* returned of part 1 holds NaN"):
        show([PART.replace(transform=np.diag([0.5, 0.5, 0.5, 1])), PART.replace(shader=broken)])


def test_a_surface_that_gives_nan_is_named():
    class Holed(Mesh):
        def evaluate(self, theta, samples):
            gbuffer = super().evaluate(theta, samples)
            return rts.GBuffer(position=gbuffer["position"], color=gbuffer["color"] * np.nan)

    with pytest.raises(InputError, match="'color' of Mesh.* is NaN or infinite at samples of part 0"):
        show(Part(Holed(FACES), PART.theta, "unlit"))


def test_nan_that_no_sample_sees_hurts_nobody():
    colors = np.array(PART.theta["colors"])
    behind = VERTICES @ np.array([0.4, 0.9, 4]) < 0  # Corners of no face that is in sight from far away.
    hidden = behind & ~np.isin(np.arange(12), FACES[(~behind)[FACES].any(axis=1)])
    assert hidden.any()
    colors[hidden] = np.nan
    expected = show(made("unlit"), layers=1)
    np.testing.assert_array_equal(show(made("unlit", colors=colors), layers=1), expected)


COLORS = "colours", "texture", "colour", "color of light", "ambient of light", "specular"


@pytest.mark.filterwarnings("ignore:.*goes up to")  # Of a texture, once for each surface.
@pytest.mark.parametrize("target", ["numpy", *DIFFERENTIABLE])
@pytest.mark.parametrize("what", COLORS)
def test_colours_too_bright_for_their_derivatives_are_refused_by_name(what, target):
    for value in (3e38, -1.1e30):
        part = HOLED[what][1](value)
        with pytest.raises(InputError, match=r"holds a number of 1e\+30 or more; expected") as error:
            show(part.replace(theta=arrays(target, part.theta)))
        named = "the surface's 'color'" if what == "colours" else HOLED[what][0]
        assert named in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize("target", DIFFERENTIABLE)
@pytest.mark.parametrize("what", COLORS)
def test_colours_just_below_that_have_finite_gradients(what, target):
    part = HOLED[what][1](9e29)
    found = gradient(target, lambda t: show(part.replace(theta=t))[..., :3].mean(), arrays(target, part.theta))
    assert all(np.isfinite(x).all() for x in leaves(found))


@pytest.mark.parametrize("target", ["numpy", *DIFFERENTIABLE])
def test_colours_of_a_shader_and_of_a_background_too_bright_are_refused(target):
    def bright(theta, gbuffer, camera):
        return gbuffer["position"][:, [0, 1, 2, 2]] * 0 + 3e38

    part = PART.replace(theta=arrays(target, PART.theta))
    with pytest.raises(InputError, match="what the shader .*bright.* of part 0 holds a number of 1e.30 or more"):
        show(part.replace(shader=bright))
    with pytest.raises(InputError, match="background holds a number of 1e.30 or more"):
        show(part, background=arrays(target, np.full(3, 3e38)))


@pytest.mark.parametrize("target", ALL)
def test_depths_of_black_and_white_that_are_one_are_refused(target):
    for given in (np.array([4.0, 4.0]), np.array([4.0, 4.0 + 1e-9])):  # One number in float32.
        part = made("depth", depth_range=given)
        with pytest.raises(InputError, match=r"theta\['depth_range'\] is .*4.*; expected two different depths"):
            show(part.replace(theta=arrays(target, part.theta)))


def test_numbers_too_large_to_be_squared_are_finite():
    image = show(made("unlit", color=np.full(3, 1e25, np.float32)), splatter="none")
    assert np.isfinite(image).all() and image.max() > 1e24


@pytest.mark.parametrize("target", ["numpy", *DIFFERENTIABLE])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_background_that_is_not_finite_is_refused(value, target):
    with pytest.raises(InputError, match="background holds NaN or infinity"):
        show(background=arrays(target, with_nan(np.ones(3), value)))


@pytest.mark.parametrize("sampler", ["raster", "rays"])
@pytest.mark.parametrize("target", ["numpy", *DIFFERENTIABLE])
def test_nan_in_a_transform_is_called_that(target, sampler):

    part = (Torus.example() if sampler == "rays" else PART).replace(transform=arrays(target, np.full((4, 4), np.nan)))
    with pytest.raises(InputError, match="the transform of a part holds NaN"):
        show(part, sampler=sampler)
    with pytest.raises(InputError, match="the camera's view matrix holds NaN"):
        show(part.replace(transform=np.eye(4)), CAMERA.replace(view=arrays(target, np.full((4, 4), np.nan))))


# ---------------------------------------------------------------------------------------------------- dtypes


def test_textures_of_bytes_are_refused():
    with pytest.raises(InputError, match="the texture has dtype uint8; expected floating .*rts.load_image"):
        show(made("textured", uv=UV.astype(np.float32), texture=(TEXTURE * 255).astype(np.uint8)))


@pytest.mark.parametrize("dtype", [">f4", ">f8", "f2", "g"])
def test_other_floats_of_numpy_are_taken_for_what_they_mean(dtype):
    given = VERTICES.astype(dtype)
    plain = given.astype(np.float64 if dtype in (">f8", "g") else np.float32)
    found = show(made(vertices=given, colors=PART.theta["colors"].astype(">f4")))
    expected = show(made(vertices=plain))
    assert found.dtype == expected.dtype
    np.testing.assert_array_equal(found, expected)


def test_a_camera_and_a_background_in_big_endian_are_taken_for_what_they_mean():
    swapped = CAMERA.map(lambda m: m.astype(">f8"))
    found = show(camera=swapped, background=np.ones(3, ">f4"))
    np.testing.assert_array_equal(found, show(background=np.ones(3, np.float32)))


@pytest.mark.parametrize(
    "theta, camera, expected",
    [
        (np.float32, np.float64, np.float32),
        (np.float64, np.float64, np.float64),
        (np.float64, np.float32, np.float64),
        (np.float32, np.float32, np.float32),
    ],
)
@pytest.mark.parametrize("options", [{}, {"supersample": 2}, {"background": np.ones(3)}, {"splatter": "none"}])
def test_the_dtype_of_a_numpy_image_is_the_widest_of_theta(theta, camera, expected, options):
    part = made(vertices=VERTICES.astype(theta)).replace(transform=np.eye(4))
    assert show(part, CAMERA.map(lambda m: m.astype(camera)), **options).dtype == expected


@pytest.mark.parametrize("parts", [1, 2])
def test_the_dtype_of_a_torch_image_is_the_widest_of_its_tensors(parts):
    torch = pytest.importorskip("torch")
    part = made(vertices=torch.tensor(VERTICES))
    scene = [part, PART.replace(theta={**PART.theta, "vertices": VERTICES.astype(np.float64) + 0.2})][:parts]
    assert show(scene).dtype == torch.float32
    assert show(scene, CAMERA.map(torch.tensor)).dtype == torch.float64
    assert show(scene, background=np.ones(3)).dtype == torch.float32


@pytest.mark.parametrize("kind", ["meta", "sparse_coo", "complex64"])
def test_tensors_that_are_no_plain_arrays_are_refused_by_name(kind):
    torch = pytest.importorskip("torch")
    tensor = torch.tensor(VERTICES)
    made_of = {
        "meta": lambda: tensor.to("meta"),
        "sparse_coo": tensor.to_sparse,
        "complex64": lambda: tensor.to(torch.complex64),
    }
    with pytest.raises(InputError, match=rf"part 0's theta\['vertices'\] .*{kind}"):
        show(made(vertices=made_of[kind]()))


# -------------------------------------------------------------------------------------------- shared memory


@pytest.mark.parametrize("sampler", TRIANGLE_SAMPLERS)
@pytest.mark.parametrize("by", [3, 10_000_000])
def test_a_mesh_keeps_its_faces_whatever_becomes_of_the_callers_array(sampler, by):
    faces, colors = np.array(FACES), np.array(FACES)
    mesh = Mesh(faces, {"colors": colors})
    part = Part(mesh, PART.theta, "unlit")
    expected = show(part, sampler=sampler)
    faces += by
    colors += by
    np.testing.assert_array_equal(show(part, sampler=sampler), expected)
    with pytest.raises(ValueError, match="read-only"):
        mesh.faces += 1


def test_copies_of_a_mesh_are_as_fixed_as_it_is():
    part = PART.replace(surface=Mesh(FACES, {"uv": FACES[::-1]}), theta={**PART.theta, "uv": UV})
    for mesh in (copy.copy(part.surface), copy.deepcopy(part.surface), pickle.loads(pickle.dumps(part.surface))):
        assert not mesh.faces.flags.writeable
        np.testing.assert_array_equal(show(part.replace(surface=mesh)), show(part))


class Astray(Mesh):
    """A plugin that gives triangles of other vertices than there are, as cheap ones are not looked at twice."""

    def __init__(self, changes):
        super().__init__(FACES)
        self.changes = changes

    def proxy(self, inputs, camera, size):
        return super().proxy(inputs, camera, size)._replace(**self.changes)


WRONG_PROXIES = {
    "too large": ({"faces": FACES + 10_000_000}, "faces from 10000000 to 10000011, but 12 vertices"),
    "negative": ({"faces": FACES - 1}, "faces from -1 to 10, but 12 vertices"),
    "too few ids": ({"ids": FACES[:2]}, r"20 faces, but ids of shape \(2, 3\)"),
    "flat ids": ({"ids": FACES.reshape(-1)}, r"ids of shape \(60,\)"),
    "too few params": ({"corner_params": np.zeros((2, 3, 2), np.float32)}, "20 faces, but corner_params"),
    "flat params": ({"corner_params": np.zeros((20, 6), np.float32)}, "corner_params of shape"),
    "fractions": ({"faces": FACES + 0.5}, "faces of shape .* and dtype float64; expected"),
    "no faces": ({"faces": np.zeros((20, 4), np.int32)}, r"faces of shape \(20, 4\)"),
    "integers": ({"vertices": np.zeros((12, 3), int)}, "vertices of shape .* and dtype int64"),
    "flat vertices": ({"vertices": VERTICES[:, :2]}, r"vertices of shape \(12, 2\)"),
    "many ids": ({"ids": np.zeros((20, 4), np.int32)}, "4 ids a triangle, but sample_widths says 3"),
}


@pytest.mark.parametrize("sampler", TRIANGLE_SAMPLERS)
@pytest.mark.parametrize("wrong", WRONG_PROXIES)
def test_no_index_of_a_plugin_reaches_compiled_code_unchecked(wrong, sampler):
    changes, message = WRONG_PROXIES[wrong]
    with pytest.raises(InputError, match=message):
        show(Part(Astray(changes), {"vertices": VERTICES}), sampler=sampler)


@pytest.mark.parametrize("sampler", TRIANGLE_SAMPLERS)
@pytest.mark.parametrize("by", [10_000_000, -1])
def test_a_proxy_that_is_prepared_by_hand_is_checked_too(sampler, by):
    chosen = rts.plugin("samplers", sampler)()
    camera = CAMERA.for_size(SIZE)
    with pytest.raises(InputError, match="the proxy has faces from"):
        chosen.rasterize(chosen.prepare(Proxy(VERTICES, FACES + np.int32(by))), camera, SIZE, 1, "none")


@pytest.mark.parametrize("engine", ["jax", "torch"])
def test_faces_that_are_traced_are_refused_by_name(engine):
    framework = pytest.importorskip(engine)

    def image(faces):
        return show(Part(Mesh(faces), {"vertices": VERTICES}))

    with pytest.raises(InputError, match="faces is traced, and topology must be known while Python runs"):
        if engine == "jax":
            framework.jit(image)(framework.numpy.asarray(FACES))
        else:
            framework.func.vmap(image)(framework.tensor(FACES)[None])


def test_faces_of_any_engine_are_taken():
    torch, jax = pytest.importorskip("torch"), pytest.importorskip("jax")
    for faces in (FACES.tolist(), FACES.astype(np.uint16), torch.tensor(FACES), jax.numpy.asarray(FACES)):
        np.testing.assert_array_equal(Mesh(faces).faces, FACES)


# -------------------------------------------------------------------------------------------- empty images

TRIANGLE = Part(Mesh([[0, 1, 2]]), {"vertices": np.array([[-1, -1, 0], [1, -1, 0], [0, 1, 0]], np.float32)})
TINY = np.array([[0.001, 0, 0], [0.002, 0, 0], [0.001, 0.001, 0]], np.float32)
EMPTY = {
    "behind": (TRIANGLE, Camera.look_at((0, 0, 4), (0, 0, 8)), "the part lies behind the camera"),
    "near": (TRIANGLE, Camera.look_at((0, 0, 4), (0, 0, 0), near=10.0), "nearer than the near plane, at 10"),
    "far": (TRIANGLE, Camera.look_at((0, 0, 4), (0, 0, 0), far=1.0), "beyond the far plane, at 1"),
    "left": (TRIANGLE, Camera.look_at((0, 0, 4), (4, 0, 0)), "outside of the view, beyond its left edge"),
    "right": (TRIANGLE, Camera.look_at((0, 0, 4), (-4, 0, 0)), "outside of the view, beyond its right edge"),
    "above": (TRIANGLE, Camera.look_at((0, 0, 4), (0, -4, 0)), "outside of the view, beyond its top edge"),
    "below": (TRIANGLE, Camera.look_at((0, 0, 4), (0, 4, 0)), "outside of the view, beyond its bottom edge"),
    "culled": (TRIANGLE.replace(cull="back"), Camera.look_at((0, 0, -4), (0, 0, 0)), "cull='back' leaves out"),
    "tiny": (
        TRIANGLE.replace(theta={"vertices": TINY}),
        Camera.look_at((0, 0, 4), (0, 0, 0)),
        "between the centres of pixels",
    ),
    "a line": (
        TRIANGLE.replace(theta={"vertices": np.float32([[-1, 0, 0], [0, 0, 0], [1, 0, 0]])}),
        Camera.look_at((0, 0, 4), (0, 0, 0)),
        "the triangles of the part have no area",
    ),
    "transparent": (
        TRIANGLE.replace(
            theta={**TRIANGLE.theta, "color": np.array([1, 1, 1, 0], np.float32)},
            shader=rts.plugin("shaders", "unlit")(opaque=False),
        ),
        Camera.look_at((0, 0, 4), (0, 0, 0)),
        "an alpha of 0",
    ),
}


@pytest.mark.parametrize("options", [{}, {"supersample": 2}, {"background": (1.0, 1.0, 1.0)}], ids=str)
@pytest.mark.parametrize("target", ["numpy", *DIFFERENTIABLE])
@pytest.mark.parametrize("name", EMPTY)
def test_an_empty_image_is_warned_of_with_its_cause(name, target, options):
    part, camera, cause = EMPTY[name]
    with pytest.warns(rts.errors.EmptyImageWarning, match=cause) as caught:
        show(part.replace(theta=arrays(target, part.theta)), camera, **options)
    assert len(caught) == 1 and caught[0].filename == __file__


def test_an_empty_image_of_several_parts_names_each():
    part, camera, _ = EMPTY["left"]
    with pytest.warns(rts.errors.EmptyImageWarning, match="part 0 lies outside .* left edge; part 1 lies outside"):
        show([part, part], camera)


def test_an_image_in_which_one_part_is_seen_is_not_empty():
    part, camera, _ = EMPTY["left"]
    show([part, part.replace(transform=rigid(translation=(4, 0, 0)))], camera)


# ------------------------------------------------------------------------------------- engines by name, copies


@pytest.mark.parametrize("engine", ["torch", "jax"])
def test_an_engine_by_name_computes_a_numpy_scene(engine):
    pytest.importorskip(engine)
    found = show(engine=engine)
    assert rts.engine_of(found).name == engine
    np.testing.assert_allclose(to_numpy(found), show(), atol=1e-5)
    sampled = rts.sample(PART, CAMERA, SIZE, engine=engine)
    assert rts.engine_of(sampled.row).name == engine
    again = rts.render_samples(sampled, PART, CAMERA, engine=engine)
    np.testing.assert_allclose(to_numpy(again), show(), atol=1e-5)


def test_an_engine_of_another_name_than_that_of_the_arrays_is_refused():
    torch = pytest.importorskip("torch")
    pytest.importorskip("jax")
    with pytest.raises(rts.errors.EngineError, match="engine is 'jax', but the scene has torch arrays"):
        show(made(vertices=torch.tensor(VERTICES)), engine="jax")
    with pytest.raises(InputError, match="no engine named 'tensorflow'"):
        show(engine="tensorflow")


def network():
    torch = pytest.importorskip("torch")
    torch.manual_seed(0)
    return torch.nn.Sequential(torch.nn.Linear(3, 8), torch.nn.Tanh(), torch.nn.Linear(8, 4), torch.nn.Sigmoid())


def test_a_network_may_shade_a_numpy_scene_and_without_an_engine_the_error_says_how():
    torch, net = pytest.importorskip("torch"), network()

    class Shader(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.net = net

        def forward(self, theta, gbuffer, camera):
            return self.net(gbuffer["position"])

    for shader in (Shader(), lambda theta, gbuffer, camera: net(gbuffer["position"])):
        image = show(PART.replace(shader=shader), engine="torch")
        (gradient,) = torch.autograd.grad(image.sum(), net[0].weight)
        assert gradient.abs().max() > 0
        with pytest.raises(TypeError) as error:
            show(PART.replace(shader=shader))
        assert "engine='torch'" in error.value.__notes__[0]


def test_weights_in_theta_are_parameters_like_any_other():
    torch, net = pytest.importorskip("torch"), network()

    def shader(theta, gbuffer, camera):
        return torch.func.functional_call(net, theta["weights"], (gbuffer["position"],))

    image = show(made(shader, weights=dict(net.named_parameters())))
    gradients = torch.autograd.grad(image.sum(), list(net.parameters()))
    assert all(g.abs().max() > 0 for g in gradients)


@pytest.mark.parametrize("name", ["auto", *TRIANGLE_SAMPLERS])
def test_samplers_and_prepared_handles_are_pickled_and_copied_without_what_they_keep(name):
    sampler = rts.plugin("samplers", name)()
    expected = show(sampler=sampler)
    prepared = rts.prepare(PART, sampler)
    for copied in (lambda x: pickle.loads(pickle.dumps(x)), copy.copy, copy.deepcopy):
        np.testing.assert_array_equal(show(sampler=copied(sampler)), expected)
        np.testing.assert_array_equal(show(copied(prepared)), expected)
    if name == "embree":
        assert len(pickle.dumps(sampler)) < 300


def test_a_capacity_beyond_memory_is_refused():
    with pytest.raises(InputError, match=r"capacity is 100000000000000, rows of about .* GiB"):
        show(capacity=10**14)


class Greedy(Torus):
    """A surface that may read any entry of θ."""

    def reads(self, theta):
        return tuple(theta)


def test_shaders_get_constants_of_the_engine_that_the_surface_may_read_too():
    torch = pytest.importorskip("torch")
    color, seen = np.float32([0.8, 0.5, 0.3]), []

    def shader(theta, gbuffer, camera):
        seen.append(type(theta["color"]))
        return rts.namespace(gbuffer["normal"]).concat([gbuffer["normal"], 0 * gbuffer["normal"][:, :1] + 1], axis=1)

    def image(pose, shader):
        part = Part(Greedy(), {"radii": np.float32([0.9, 0.35]), "color": color}, shader, transform=rts.rigid(pose))
        return rts.render(part, CAMERA, SIZE)

    pose = torch.tensor([0.1, 0.2, 0, 0, 0.1, 0])
    image(pose, shader)
    assert set(seen) == {torch.Tensor}
    slope = torch.func.jvp(lambda pose: image(pose, "lambert"), (pose,), (torch.ones(6),))[1]
    assert torch.isfinite(slope).all() and slope.abs().max() > 0.1
