"""The bases of plugins: what a class overrides and promises, objects of other classes, misspelt members."""

from types import SimpleNamespace

import numpy as np
import pytest
from analytic import Ellipsoid
from helpers import CAMERA, DIFFERENTIABLE, FRONT, SIZE, arrays, gradient, icosphere, mesh_part, quad, refused, show

import rts
from rts import splatting
from rts.contracts.checks import check_shader
from rts.contracts.records import Cells
from rts.plugin_api.records import Proxy, Samples
from rts.plugin_base import overrides, promised

pytestmark = pytest.mark.core

MESH = rts.plugin("surfaces", "mesh")
RASTER = rts.plugin("samplers", "raster")
BALL = {"center": np.zeros(3, np.float32), "radii": np.full(3, 0.8, np.float32)}


# ------------------------------------------------------------------------------------- what a class overrides


def test_what_a_class_overrides_is_read_off_it():
    class Refining(MESH):
        def refine(self, inputs, samples, rays):
            return samples

    class Still(Refining):
        refine = rts.TriangleSurface.refine

    class Mixin:
        def cropped(self, splats):
            return self.image(splats)

    class Mixed(Mixin, splatting.Plain):
        pass

    faces = icosphere(0)[1]
    assert not MESH(faces).refines and Refining(faces).refines and not Still(faces).refines
    assert type("Below", (Refining,), {})(faces).refines and not type("BelowStill", (Still,), {})(faces).refines
    assert all(overrides(kind, "cropped", rts.Splatter) for kind in (Mixed, Mixed()))
    assert not overrides(Far, "cropped", rts.Splatter) and not overrides(RASTER, "cropped", rts.Splatter)
    assert overrides(rts.plugin("samplers", "embree"), "prepare", rts.TriangleSampler)
    assert not overrides(RASTER, "prepare", rts.TriangleSampler)


def calling(self, theta, gbuffer, camera):
    return gbuffer["position"]


def test_a_promise_holds_for_the_class_that_states_it_and_for_its_call():
    one = type("One", (rts.Shader,), {"uniform": True, "reads": ("color",), "__call__": calling})
    kinds = {
        "as it is": (one, True),
        "inherited": (type("Below", (one,), {}), True),
        "another call": (other := type("Other", (one,), {"__call__": lambda *_: None}), False),
        "below it": (type("BelowOther", (other,), {}), False),
        "stated anew": (type("Anew", (other,), {"uniform": True, "reads": ("color",)}), True),
        "a call from elsewhere": (type("Mixed", (type("Mixin", (), {"__call__": lambda *_: None}), one), {}), False),
    }
    abstract = type("Abstract", (rts.Shader,), {"uniform": True, "reads": ("color",)})
    kinds["stated where there is no call yet"] = type("Full", (abstract,), {"__call__": calling}), True
    for name, (kind, holds) in kinds.items():
        for given in (kind, kind()):
            assert promised(given, "uniform") is holds, name
            assert promised(given, "reads") == (("color",) if holds else None), name
    stating = other()
    stating.uniform = True
    assert promised(stating, "uniform") and not promised(other(), "uniform")


def test_a_class_may_be_both_of_triangles_and_of_rays():
    class Both(Ellipsoid, rts.TriangleSurface, rts.RaySurface):
        """An ellipsoid whose triangles are refined to what the rays meet."""

        def __init__(self):
            self.vertices, self.faces = icosphere(2)

        def proxy_inputs(self, theta):
            return {"center": theta["center"], "radii": theta["radii"]}

        def proxy(self, inputs, camera, size):
            vertices = (inputs["center"] + 1.1 * inputs["radii"] * self.vertices).astype(np.float32)
            return Proxy(vertices, self.faces, np.zeros((len(self.faces), 0), np.int32), vertices[self.faces])

        def refine(self, inputs, samples, rays):
            hits = self.intersect(inputs, rays.origins, rays.directions, 2)
            row, depth, params = samples.row.copy(), samples.depth.copy(), samples.params.copy()
            for k, cells in enumerate(samples.row):
                index = cells[cells >= 0]
                row[k][cells >= 0] = np.where(hits.hit[k, index], index, -1)
                depth[k][cells >= 0] = hits.distance[k, index]
                params[index] = hits.params[k, index]
            return Samples(samples.ids, params, Cells(row, depth), samples.overflow)

    part = rts.Part(Both(), BALL, "normals")
    by_rays, by_triangles = (show(part, sampler=sampler, splatter="single") for sampler in ("rays", "raster"))
    assert by_rays[..., 3].sum() > 30
    np.testing.assert_allclose(by_triangles, by_rays, atol=2e-5)


# ---------------------------------------------------------------------------------------- objects of any class


def method(*_):
    return None


def test_functions_are_shaders_with_the_promises_that_they_make():
    def plain(theta, gbuffer, camera):
        return rts.plugin("shaders", "normals")()(theta, gbuffer, camera)

    def promising(theta, gbuffer, camera):
        return plain(theta, gbuffer, camera)

    promising.opaque, promising.reads = True, ("normal",)
    one, other = check_shader(plain, "the shader"), check_shader(promising, "the shader")
    assert (one.opaque, one.reads) == (False, None) and (other.opaque, other.reads) == (True, ("normal",))
    assert one == check_shader(plain, "the shader") != other and repr(one) == "<function plain>"
    part = mesh_part(icosphere(1))
    expected = show(part.replace(shader="normals"))
    for shader in (plain, promising):
        # One that does not promise alpha 1 is composited layer by layer, with colours 4e-5 cells nearer to outlines.
        np.testing.assert_allclose(show(part.replace(shader=shader)), expected, atol=1e-5)


def test_what_does_not_subclass_its_base_is_refused_by_its_name():
    part = mesh_part(icosphere(0))
    duck = SimpleNamespace(proxy=method, evaluate=method, image=method, sample=method)
    with pytest.raises(rts.InputError, match="part 0 is .*class subclasses rts.TriangleSurface or rts.RaySurface$"):
        show(part.replace(surface=duck))
    with pytest.raises(rts.InputError, match="the shader of part 0 is .*, or an object whose class subclasses rts.Sha"):
        show(part.replace(shader=duck))
    with pytest.raises(rts.InputError, match="the splatter is .*a name, or an object whose class subclasses rts.Sp"):
        show(part, splatter=duck)
    with pytest.raises(rts.InputError, match="the sampler is .*a name, or an object whose class subclasses rts.Sa"):
        show(part, sampler=duck)
    # Plugins that are known by now, each as what it is, are refused in place of one another.
    show(part, sampler=RASTER(), splatter=splatting.Plain())
    with pytest.raises(rts.InputError, match="the splatter is .*rts.Splatter"):
        show(part, splatter=RASTER())
    with pytest.raises(rts.InputError, match="the sampler is .*rts.Sampler"):
        show(part, sampler=splatting.Plain())


# ------------------------------------------------------------------------------------------- misspelt members


MISSPELT = [
    (MESH, "proxykey", "proxy_key"),
    (MESH, "table_spec", "table_specs"),
    (MESH, "refime", "refine"),
    (RASTER, "prepares", "prepare"),
    (RASTER, "updates", "update"),
    (splatting.Plain, "croped", "cropped"),
    (Ellipsoid, "read", "reads"),
]


@pytest.mark.parametrize("base, name, meant", MISSPELT, ids=str)
def test_a_method_that_is_one_letter_off_is_refused_when_first_used(base, name, meant):
    own = {name: lambda self, *args: None, "__init__": base.__init__}
    kind = type("Misspelt", (base,), own)
    part, options = mesh_part(icosphere(0)), {}
    if base is Ellipsoid:
        part, options = rts.Part(kind(), BALL), {"sampler": "rays"}
    elif base is MESH:
        part = part.replace(surface=kind(icosphere(0)[1]))
    else:
        options["sampler" if base is RASTER else "splatter"] = kind()
    with pytest.raises(rts.errors.PluginError, match=rf"Misspelt has a function '{name}'.*did you mean '{meant}'"):
        show(part, **options)


def test_a_value_in_place_of_a_method_is_refused():
    kind = type("Valued", (Ellipsoid,), {"reads": ("center",)})
    with pytest.raises(
        rts.errors.PluginError, match=r"Valued has the value \('center',\) for 'reads'; expected a method"
    ):
        show(rts.Part(kind(), BALL), sampler="rays")


ATTRIBUTES = {
    "two columns": ("normal", lambda x: x[:, :2]),
    "integers": ("normal", lambda x: x.astype(np.int32)),
    "one dimension": ("normal", lambda x: x[:, 0]),
    "half the rows": ("normal", lambda x: x[: len(x) // 2]),
    "a list": ("normal", lambda x: x.tolist()),
    "three coordinates": ("uv", lambda x: x),
    "two colours": ("color", lambda x: x[:, :2]),
}


@pytest.mark.parametrize("deferred", [False, True])
@pytest.mark.parametrize("fault", ATTRIBUTES)
def test_an_attribute_of_a_wrong_shape_is_refused_by_its_name(fault, deferred):
    name, change = ATTRIBUTES[fault]

    class Odd(MESH):
        def evaluate(self, theta, samples):
            gbuffer = super().evaluate(theta, samples)
            if deferred:
                gbuffer.defer(name, lambda: change(gbuffer["position"]))
            else:
                gbuffer[name] = change(gbuffer["position"])
            return gbuffer

    vertices, faces = icosphere(1)
    theta = {"vertices": vertices}
    if name == "uv":
        theta["texture"] = np.ones((2, 2, 3), np.float32)
    part = rts.Part(Odd(faces), theta, "textured" if name == "uv" else "lambert")
    with pytest.raises(rts.InputError, match=f"'{name}'.* (has shape|is a list).*; expected"):
        show(part)


@pytest.mark.parametrize("layers", [0, "all", 1.5])
def test_layers_of_a_splatter_are_a_count(layers):
    splatter = type("Odd", (splatting.Plain,), {"layers": layers})()
    with pytest.raises(rts.InputError, match="layers of .* is .*; expected an integer of at least 1, or None"):
        show(mesh_part(icosphere(0)), splatter=splatter)


@pytest.mark.parametrize("result", [None, 1.0, np.zeros((3, 4))])
def test_a_splatter_that_gives_no_image_is_told(result):
    splatter = type("Odd", (splatting.Plain,), {"image": lambda self, splats: result})()
    with pytest.raises(rts.InputError, match="the image of .*Odd.*; expected"):
        show(mesh_part(icosphere(0)), splatter=splatter)


def test_terms_of_residuals_have_three_methods():
    class Terms(rts.Residuals):
        def __call__(self, parameters):
            return parameters

        def draw(self, step):
            return [0]

    torch = pytest.importorskip("torch")
    with pytest.raises(rts.InputError, match="has draw without load and of; terms need all three"):
        rts.fit(Terms(), torch.zeros(2), steps=1)
    own = {"load": lambda self, key: {}, "of": lambda self, data: self}
    for name, change, expected in (
        ("draw", lambda self, step: 3, "draw of .* gave no list of keys"),
        ("of", lambda self, data: None, "of of .* gave None; expected residuals of one term"),
    ):
        with pytest.raises(rts.InputError, match=expected):
            rts.fit(type("Odd", (Terms,), {**own, name: change})(), torch.zeros(2), steps=1)


def test_an_update_without_a_prepare_is_refused_where_a_sampler_is_made():
    own = {"update": method, "rasterize": method}
    refused = "^Lone has an update, .* and no prepare; write prepare, or leave update"
    with pytest.raises(rts.errors.PluginError, match=refused):
        type("Lone", (rts.TriangleSampler,), own)()
    complete = type("Complete", (rts.TriangleSampler,), {**own, "prepare": method})
    type("Derived", (complete,), {"update": method})()


@pytest.mark.parametrize("name", ["center", "examples", "tessellate", "refined_by_hand", "keys", "checks"])
def test_any_other_name_is_the_plugin_s_own(name):
    class Own(MESH):  # It has a `check`, and so `checks` is no slip.
        pass

    setattr(Own, name, method)
    vertices, faces = icosphere(1)
    assert show(rts.Part(Own(faces), {"vertices": vertices}))[..., 3].any()


def test_a_splatter_that_overrides_the_direct_call_is_told_what_that_is_for():
    class Old(splatting.Multi):
        def splat(self, positions, rgba, row):
            return super().splat(positions, rgba, row)

    refused = "Old overrides 'splat', which is final: Splat packed .* direct calls"
    with pytest.raises(rts.errors.PluginError, match=refused):
        show(mesh_part(icosphere(0)), splatter=Old())


# ------------------------------------------------------------------------------------- the seam of the splatters


class Far(rts.Splatter):
    """Shifts everything by its reach, so that what lies so far beyond the image shows in it."""

    def __init__(self, reach):
        self.reach = reach

    def image(self, splats):
        self.seen = splats
        image, r = splatting.Plain().image(splats), self.reach
        xp = rts.namespace(image)
        return xp.concat([xp.zeros_like(image[:, :r, :]), image[:, : image.shape[1] - r, :]], axis=1)


@pytest.mark.parametrize("reach", [1, 2, 4])
def test_the_border_is_as_wide_as_a_splatter_reaches(reach):
    part, splatter = mesh_part(quad(-9, 9, -9, 9)), Far(reach)
    assert (show(part, FRONT, splatter=splatter)[..., 3] == 1).all()
    assert splatter.seen.border == reach + 1
    sampled = rts.sample(part, FRONT, SIZE, splatter=splatter)
    assert sampled.border == reach + 1 and sampled.row.shape[1:] == tuple(n + 2 * reach + 2 for n in SIZE)
    np.testing.assert_array_equal(
        rts.render_samples(sampled, part, FRONT, splatter=splatter), show(part, FRONT, splatter=splatter)
    )
    np.testing.assert_array_equal(
        rts.render_samples(sampled, part, FRONT, splatter="single"), show(part, FRONT, splatter="single")
    )


def test_samples_with_too_narrow_a_border_are_refused():
    part = mesh_part(quad())
    sampled = rts.sample(part, FRONT, SIZE, splatter="single")
    with refused("a border of 2 cells, and Far, which reaches 3, needs 4; give it to rts.sample"):
        rts.render_samples(sampled, part, FRONT, splatter=Far(3))


@pytest.mark.parametrize("splatter", ["none", "single", "multi"])
def test_samples_for_no_splatter_have_a_border_for_every_built_in_one(splatter):
    part = mesh_part(icosphere(1, 2.0))
    found = rts.render_samples(rts.sample(part, FRONT, SIZE, splatter=None, layers=2), part, FRONT, splatter=splatter)
    np.testing.assert_allclose(found, show(part, FRONT, splatter=splatter), rtol=0, atol=1e-6)


@pytest.mark.parametrize("target", DIFFERENTIABLE)
def test_row_is_an_array_of_the_engine_of_the_positions(target):
    seen = []

    class Looking(splatting.Plain):
        def image(self, splats):
            seen.append([type(x).__module__.split(".")[0] for x in (splats.positions, splats.rgba, splats.row)])
            return super().image(splats)

    part = mesh_part(icosphere(1))
    moved = part.replace(transform=arrays(target, np.eye(4)))
    sampled = rts.sample(part, CAMERA, SIZE)  # NumPy's, though what is rendered is not.
    rts.render(moved, CAMERA, SIZE, splatter=Looking())
    rts.render_samples(sampled, moved, CAMERA, splatter=Looking())
    Looking().splat(arrays(target, np.ones((1, 3))), np.ones((1, 4), np.float32), [[[0]]])
    assert all(len(set(kinds)) == 1 and kinds[0] != "numpy" for kinds in seen) and len(seen) == 3


# ------------------------------------------------------------------------------------------------- what is sampled


@pytest.mark.parametrize("target", DIFFERENTIABLE)
def test_theta_goes_to_proxy_inputs_without_derivatives(target):
    seen = []

    class Watching(MESH):
        def proxy_inputs(self, theta):
            seen.append(theta["vertices"])
            return theta["vertices"] * 1

    vertices, faces = icosphere(1)
    surface = Watching(faces)

    def total(v):
        return rts.render(rts.Part(surface, {"vertices": v}), CAMERA, SIZE).sum()

    found = gradient(target, total, arrays(target, vertices))
    assert np.abs(found).max() > 0
    if target.startswith("torch"):
        assert not any(getattr(x, "requires_grad", False) for x in seen)
    else:
        assert not any(type(x).__name__ == "JVPTracer" for x in seen)


def test_a_subclass_of_a_splatter_may_have_an_image_of_its_own():
    class Half(splatting.Edges):
        def image(self, splats):
            return 0.5 * super().image(splats)

    part = mesh_part(icosphere(1))
    np.testing.assert_allclose(show(part, splatter=Half()), 0.5 * show(part), atol=1e-6)


@pytest.mark.parametrize("splatter", ["none", "edges", "multi"])
def test_a_shader_may_close_over_arrays_that_the_scene_has_none_of(splatter):
    torch = pytest.importorskip("torch")
    color = torch.tensor([0.2, 0.4, 0.6, 1.0], requires_grad=True)
    part = mesh_part(icosphere(1), shader=lambda theta, gbuffer, camera: color.expand(gbuffer.like.shape[0], 4))
    for parts in (part, [part, mesh_part(quad(z=-2.0))]):
        image = rts.render(parts, CAMERA, SIZE, splatter=splatter)
        image.sum().backward()
        assert color.grad.abs().sum() > 0


def test_a_surface_that_has_the_methods_of_another_base_is_told_to_subclass_that():
    class Lost(rts.Surface):
        sample_widths, evaluate, intersect = (0, 3), Ellipsoid.evaluate, Ellipsoid.intersect

    with pytest.raises(rts.errors.PluginError, match="Lost has the methods of rts.RaySurface; subclass that"):
        show(rts.Part(Lost(), BALL))


def test_what_plugins_give_in_wrong_shapes_is_refused_by_name():
    def ray(**changes):
        class Odd(Ellipsoid):
            def intersect(self, *args):
                hits = super().intersect(*args)
                return hits._replace(**{k: f(hits) for k, f in changes.items()})

        return rts.Part(Odd(), BALL)

    class Wide(splatting.Plain):
        def image(self, splats):
            return super().image(splats)[..., :3]

    class Flat(MESH):
        def evaluate(self, theta, samples):
            return {"position": super().evaluate(theta, samples)["position"][:, :2]}

    vertices, faces = icosphere(1)
    cases = (
        (lambda: show(ray(params=lambda h: h.params[..., :2]), sampler="rays"), "intersect of .*Odd.* gave shapes"),
        (lambda: show(ray(hit=lambda h: h.hit * 1), sampler="rays"), "gave hit of dtype int.*expected bool"),
        (lambda: show(mesh_part((vertices, faces)), splatter=Wide()), r"image of .*Wide.* has shape \(20, 24, 3\)"),
        (lambda: show(rts.Part(Flat(faces), {"vertices": vertices})), r"'position' of .* has shape .*expected .* 3\)"),
    )
    for call, words in cases:
        with pytest.raises(rts.InputError, match=words):
            call()


def test_whole_numbers_of_theta_are_counts_and_indices_for_a_shader():
    torch = pytest.importorskip("torch")

    def shader(theta, gbuffer, camera):
        total = 0 * gbuffer["position"][:, :1]
        for _ in range(theta["terms"]):
            total = total + theta["table"][theta["row"]]
        return torch.cat([total, total, total, 0 * total + 1], dim=1)

    vertices, faces = icosphere(0)
    theta = {"vertices": torch.tensor(vertices), "terms": 3, "row": 1, "table": np.array([9.0, 0.25], np.float32)}
    image = rts.render(rts.Part(MESH(faces), theta, shader), CAMERA, SIZE)
    assert float(image[..., 0].max()) == pytest.approx(0.75)
