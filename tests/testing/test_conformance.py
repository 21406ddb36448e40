"""The conformance kit on every built-in plugin; and for each check a broken plugin, to prove that it can fail."""

import inspect
import subprocess
import sys
from dataclasses import replace
from importlib.metadata import entry_points

import numpy as np
import planted
import pytest
from analytic import Ellipsoid
from helpers import splats_of

import rts
from rts import GBuffer, InputError, Part
from rts.arrays.array_functions import without_border
from rts.arrays.engines import engine_of, namespace
from rts.arrays.trees import map_leaves
from rts.contracts.records import Request
from rts.errors import PluginError
from rts.plugin_api.operations import Operation
from rts.plugin_api.records import Fragments, RayHits
from rts.registry import instance
from rts.scene.row_cameras import RowCameras
from rts.shading.pbr import Pbr
from rts.shading.shaders import Depth, Normals, Unlit
from rts.splatting import Multi, Plain, Single
from rts.testing import (
    EngineConformance,
    OperationConformance,
    SamplerConformance,
    ShaderConformance,
    SplatterConformance,
    SurfaceConformance,
)
from rts_testing import compatibility, scenes, shaders, splatters
from rts_testing.engine_examples import numbers

pytestmark = pytest.mark.plugins

Raster = rts.plugin("samplers", "raster")
RASTER = Raster()
Mesh, Bezier, BSpline = (rts.plugin("surfaces", name) for name in ("mesh", "bezier", "bspline"))


class CheckedEllipsoid(Ellipsoid):
    """With the error texts that the kit asks for."""

    def check(self, theta):
        for name in ("center", "radii"):
            shape = getattr(theta.get(name), "shape", None)
            if shape != (3,):
                raise InputError(f"theta[{name!r}] of an ellipsoid has shape {shape}; expected (3,)")


def ellipsoid(surface=None, shader="lambert"):
    theta = {"center": np.array([0.1, -0.05, 0.1], np.float32), "radii": np.array([1.0, 0.7, 0.8], np.float32)}
    return Part(surface or CheckedEllipsoid(), theta, shader)


# ------------------------------------------------------------------------------------------ what is built in


def made(kit, **fixtures):
    """A class of the kit for one plugin: its fixtures give these values, or what these functions and methods give."""

    def fixture(given):
        return pytest.fixture(lambda self: given() if inspect.isroutine(given) else given)

    return type("Made", (kit,), {name: fixture(given) for name, given in fixtures.items()})


TestMesh = made(SurfaceConformance, part=Mesh.example)
TestSkinned = made(SurfaceConformance, part=rts.Skinned.example)


@pytest.mark.thorough
class TestSkinnedNormals(SurfaceConformance):
    """Normals with a table of their own, shared between vertices, which morph targets change."""

    @pytest.fixture
    def part(self):
        bar = rts.Skinned.example()
        faces, vertices = bar.surface.mesh.faces, bar.theta["vertices"]
        normals = np.cross(*(vertices[faces[:, i]] - vertices[faces[:, 0]] for i in (1, 2)))
        table = np.repeat(np.arange(len(faces))[:, None], 3, axis=1)
        theta = {**bar.theta, "normals": normals, "morph_normals": 0.1 * normals[None, :, ::-1]}
        return bar.replace(surface=rts.Skinned(faces, bar.surface.joints, {"normals": table}), theta=theta)


TestBezier = made(SurfaceConformance, part=Bezier.example)
TestBSpline = made(SurfaceConformance, part=BSpline.example)
TestRevolution = made(SurfaceConformance, part=lambda: rts.plugin("surfaces", "revolution").example())
TestSubdivision = made(SurfaceConformance, part=lambda: subdivision().example())


class TestSubdivisionOfPolygons(SurfaceConformance):
    """Sub-faces, creases that end, and a face-varying map, open at one end."""

    @pytest.fixture
    def part(self):
        turn = np.arange(5) * 2 * np.pi / 5
        ring = [np.stack([r * np.cos(turn), r * np.sin(turn), np.full(5, z)], axis=1) for r, z in ((1, -0.8), (0.8, 1))]
        around = [[i, (i + 1) % 5, 5 + (i + 1) % 5, 5 + i] for i in range(5)]
        surface = subdivision()(
            [[5, 6, 7, 8, 9], *around],
            creases=[(5, 6, 10), (6, 7, 2.5), (7, 8, 0.5)],
            corners=[(0, 1.5)],
            indices={"uv": [[12, 13, 14, 15, 16], *([i, i + 1, i + 7, i + 6] for i in range(5))]},
        )
        vertices, rng = np.concatenate(ring), np.random.default_rng(0)
        theta = {"vertices": vertices, "colors": 0.5 + 0.4 * np.sin(3 * vertices), "uv": rng.random((17, 2))}
        theta["texture"] = rng.random((8, 8, 3))
        return Part(surface, {name: value.astype(np.float32) for name, value in theta.items()}, "lambert")


class TestLoop(SurfaceConformance):
    @pytest.fixture
    def part(self):
        part = Mesh.example()
        return part.replace(surface=subdivision()(part.surface.faces, "loop"))


def subdivision():
    try:
        return rts.plugin("surfaces", "subdivision")
    except PluginError as error:
        pytest.skip(str(error))


TestEllipsoid = made(SurfaceConformance, part=ellipsoid, sampler="rays")
TestRaster = made(SamplerConformance, sampler="raster")
TestReference = made(SamplerConformance, sampler="reference")
TestAuto = made(SamplerConformance, sampler="auto")


class TestEmbree(SamplerConformance):
    @pytest.fixture
    def sampler(self):
        try:
            return instance("rts.samplers", "embree")
        except PluginError as error:
            pytest.skip(str(error))


class TestOpenGL(SamplerConformance):
    @pytest.fixture
    def sampler(self):
        try:
            rts.sample(scenes.ball(), scenes.CAMERA, (2, 2), sampler="opengl", splatter=None)
        except PluginError as error:
            pytest.skip(str(error))
        return "opengl"


TestRays = made(
    SamplerConformance,
    sampler="rays",
    parts=lambda: [ellipsoid(), ellipsoid().replace(transform=np.diag([1, 1.2, 0.8, 1]).astype(np.float32))],
)
TestNumpyEngine = made(EngineConformance, engine="numpy")
TestTorchEngine = made(EngineConformance, engine="torch")


class ShaderOfBuiltIn(ShaderConformance):
    __test__ = False

    @pytest.fixture
    def theta(self):
        return {"color": np.array([0.9, 0.8, 1.0], np.float32)}


TestSilhouette = made(ShaderOfBuiltIn, shader="silhouette")
TestNormals = made(ShaderOfBuiltIn, shader="normals")
TestDepth = made(ShaderOfBuiltIn, shader="depth", theta=lambda: {"depth_range": np.array([1.5, 6.0], np.float32)})
TestUnlit = made(ShaderOfBuiltIn, shader="unlit")
TestTranslucent = made(ShaderOfBuiltIn, shader=Unlit(opaque=False))
TestTextured = made(
    ShaderOfBuiltIn,
    shader="textured",
    theta=lambda: {"texture": np.random.default_rng(0).random((3, 4, 3)).astype(np.float32)},
)


class TestLambert(ShaderOfBuiltIn):
    @pytest.fixture
    def shader(self):
        return "lambert"

    @pytest.fixture
    def theta(self):
        light = {"direction": np.array([0.3, 0.6, 0.7], np.float32), "color": np.array([0.5, 0.6, 0.7], np.float32)}
        return {"color": np.array([0.9, 0.8, 1.0], np.float32), "light": light}


class TestPbr(ShaderOfBuiltIn):
    @pytest.fixture
    def shader(self):
        return "pbr"

    @pytest.fixture
    def theta(self):
        rng = np.random.default_rng(0)
        light = {
            "direction": rng.standard_normal((2, 3)),
            "color": rng.random((2, 3)),
            "position": np.array([(0.5, 2.0, 1.5)]),
            "intensity": np.array([(3.0, 2.0, 1.0)]),
            "axis": np.array([(-0.4, -2.0, -1.3)]),
            "cone": np.array([(0.1, 0.9)]),
            "ambient": np.array(0.1),
            "sh": np.array([3.0, *(0.3 * rng.standard_normal(15))])[:, None] * rng.uniform(0.5, 1, 3),
            "environment": rng.random((4, 8, 3)),
        }
        theta = {
            "color": np.array([0.9, 0.8, 1.0]),
            "texture": rng.uniform(0.2, 0.9, (3, 4, 3)),
            "metallic": rng.uniform(0.1, 0.9, (5, 4, 1)),
            "roughness": rng.uniform(0.3, 0.9, (3, 6, 1)),
            "normal_map": np.array([0, 0, 1]) + 0.3 * rng.standard_normal((4, 4, 3)),
            "occlusion": rng.random((2, 2, 1)),
            "emissive": rng.random((2, 3, 3)),
            "specular": rng.uniform(0.5, 3, (3, 3, 3)),
            "light": light,
        }
        return map_leaves(lambda x: x.astype(np.float32), theta)


class TestTranslucentPbr(ShaderOfBuiltIn):
    """Numbers in place of maps, and the default light."""

    @pytest.fixture
    def shader(self):
        return Pbr(opaque=False)

    @pytest.fixture
    def theta(self):
        numbers = {"metallic": 0.3, "roughness": 0.4, "occlusion": 0.8, "emissive": (2.0, 0.0, 0.1)}
        return {name: np.array(value, np.float32) for name, value in numbers.items()}


TestBlinnPhong = made(TestLambert, shader="blinn_phong")


class TestNone(SplatterConformance):
    moves_edges = False

    @pytest.fixture
    def splatter(self):
        return "none"


TestSingle = made(SplatterConformance, splatter="single")
TestMulti = made(SplatterConformance, splatter="multi")


class TestEdges(SplatterConformance):
    moves_edges = False  # Of splats alone: it moves the outlines that it is told.

    @pytest.fixture
    def splatter(self):
        return "edges"


TestEdgesAtCenters = made(TestEdges, splatter=lambda: rts.plugin("splatters", "edges")(colors="centers"))


# ---------------------------------------------------------------------------------------------- broken plugins
#
# Each differs from a plugin that conforms in one respect.


def stopped(x):
    return engine_of(x).stop_gradient(x)


def wrong_in_torch(x):
    """A thousandth too much, in one engine."""
    return x * 1.001 if engine_of(x).name == "torch" else x


class OddRaster(Raster):
    """A rasterizer whose fragments, or camera, are altered."""

    def __init__(self, alter=lambda fragments, scene: fragments, camera=lambda camera, size: camera, cull=None):
        self.alter, self.camera, self.cull = alter, camera, cull

    def rasterize(self, prepared, camera, size, layers, cull):
        seen = self.camera(camera, size)
        fragments = super().rasterize(prepared, seen, size, layers, self.cull or cull)
        return self.alter(fragments, (prepared, camera, size))


class OddSampler(rts.Sampler):
    """A sampler whose samples are altered."""

    def __init__(self, alter):
        self.alter = alter

    def sample(self, part, camera, size, layers, request):
        samples = RASTER.sample(part, camera, size, layers, Request(request.capacity))
        return self.alter(samples, part)


def altered(**changes):
    """A sampler with fields of its samples changed by functions of the samples."""
    return OddSampler(lambda samples, part: samples.replace(**{k: f(samples) for k, f in changes.items()}))


def next_triangle(fragments, scene):
    ids, count = fragments.triangle_ids, len(scene[0].faces)
    return fragments._replace(triangle_ids=np.where(ids >= 0, (ids + 1) % count, ids))


def affine_barycentrics(fragments, scene):
    """Interpolated in the image, as if there were no perspective."""
    proxy, camera, size = scene
    corners = proxy.faces[np.maximum(fragments.triangle_ids, 0)]
    w = camera.project(proxy.vertices.astype(np.float64), size)[:, 2][corners]
    b = np.concatenate([fragments.barycentrics, 1 - fragments.barycentrics.sum(-1, keepdims=True)], -1) * w
    return fragments._replace(barycentrics=(b / b.sum(-1, keepdims=True))[..., :2].astype(np.float32))


def half_a_pixel(camera, size):
    shift = np.eye(4)
    shift[0, 3] = 1 / size[1]
    return camera.replace(projection=shift @ camera.projection)


def wider_planes(camera, size):
    projection = camera.projection.copy()
    projection[2, 2:] = [-1.0001, -0.02] if projection[3, 2] else projection[2, 2:]
    return camera.replace(projection=projection)


def eroded(fragments, scene):
    """Without the leftmost pixels of everything."""
    ids = fragments.triangle_ids
    left = np.pad(ids, ((0, 0), (0, 0), (1, 0)), constant_values=-1)[..., :-1]
    return fragments._replace(triangle_ids=np.where(left[:1] >= 0, ids, -1))


class Unsteady(OddRaster):
    calls = 0

    def rasterize(self, *scene):
        self.calls += 1
        fragments = super().rasterize(*scene)
        return fragments._replace(barycentrics=fragments.barycentrics * np.float32(1 - 1e-6 * self.calls))


class Reusing(OddRaster):
    """Fills the same arrays again."""

    def rasterize(self, *scene):
        found = super().rasterize(*scene)
        kept = vars(self).setdefault("kept", {}).setdefault(found.depth.shape, found)
        for array, new in zip(kept, found, strict=True):
            array[...] = new
        return kept


class Forgetful(Raster):
    """Keeps the first triangles of a surface for ever."""

    def _entry(self, surface, inputs, camera, size):
        if not hasattr(self, "kept"):
            self.kept = {}
        if surface not in self.kept:
            self.kept[surface] = self._built(surface, inputs, camera, size)
        return self.kept[surface]


class StaleUpdate(Raster):
    """Gives what was prepared before for vertices that have moved."""

    def prepare(self, proxy):
        return proxy

    def update(self, prepared, proxy):
        return prepared


class Disarranged(Raster):
    """Triangles put in another order whose numbers are not told."""

    def arrange(self, prepared):
        return prepared._replace(faces=prepared.faces[::-1].copy())


class ByIdentity(Raster):
    """Keeps what it was given first by the identity of the faces."""

    def __init__(self):
        self.kept = {}

    def rasterize(self, prepared, *scene):
        return super().rasterize(self.kept.setdefault(id(prepared.faces), prepared), *scene)


class Roomy(rts.Sampler):
    """Takes no notice of the capacity."""

    def sample(self, part, camera, size, layers, request):
        return RASTER.sample(part, camera, size, layers)


class DropsTheFront(rts.Sampler):
    def sample(self, part, camera, size, layers, request):
        whole = RASTER.sample(part, camera, size, layers)
        first = max(0, len(whole.ids) - (request.capacity or len(whole.ids)))
        row = np.where(whole.row >= first, whole.row - first, -1).astype(np.int32)
        return whole.replace(ids=whole.ids[first:], params=whole.params[first:], row=row, overflow=np.int32(first))


class Complains(rts.Sampler):
    def __init__(self, error):
        self.error = error

    def sample(self, part, camera, size, layers, request):
        raise self.error


class AcceptsAnything(rts.Sampler):
    def sample(self, part, camera, size, layers, request):
        return RASTER.sample(scenes.ball(), camera, size, layers, Request(request.capacity))


def leaking(samples, part):
    xp = namespace(part.theta["vertices"])
    return replace(samples, params=samples.params + 1e-6 * xp.sum(part.theta["vertices"]))


def covering(samples, part):
    """Samples in every cell, whether something is there or not."""
    return samples.replace(row=samples.row * 0, depth=samples.depth * 0 + 1)


class AtPoints(type(rts.plugin("samplers", "raster")())):
    """A rasterizer whose points, or the samples of them, are altered."""

    def __init__(self, points=lambda points: points, alter=lambda found: found):
        self.points, self.alter = points, alter

    def sample(self, part, camera, size, layers, request):
        if request.points is None:
            return super().sample(part, camera, size, layers, request)
        return self.alter(
            super().sample(part, camera, size, layers, replace(request, points=self.points(request.points)))
        )


def without_the_last_layer(found):
    row = found.row.copy()
    row[-1] = -1
    return found.replace(row=row)


class OddTriangles(type(rts.plugin("samplers", "raster")())):
    """Tells triangles that are altered."""

    def __init__(self, alter):
        self.alter = alter

    def sample(self, part, camera, size, layers, request):
        found = super().sample(part, camera, size, layers, request)
        return found if found.triangle is None else self.alter(found)


SAMPLERS = {
    "samples_lie_on_the_centres_of_their_pixels": {
        "rows upside down": OddRaster(lambda f, _: Fragments(*(x[:, ::-1] for x in f))),
        "columns mirrored": OddRaster(lambda f, _: Fragments(*(x[:, :, ::-1] for x in f))),
        "half a pixel": OddRaster(camera=half_a_pixel),
        "ids off by one": OddRaster(next_triangle),
        "barycentrics exchanged": OddRaster(lambda f, _: f._replace(barycentrics=f.barycentrics[..., ::-1])),
        "no perspective": OddRaster(affine_barycentrics),
        "depth of another scale": OddRaster(lambda f, _: f._replace(depth=f.depth * np.float32(1.1))),
    },
    "triangles_are_told_where_it_says_so": {
        "everywhere": OddTriangles(lambda found: found.replace(triangle=np.maximum(found.triangle, 0))),
        "others": OddTriangles(lambda found: found.replace(triangle=found.triangle + (found.triangle == 0))),
    },
    "points_are_sampled_as_centres_are": {
        "half a cell aside": AtPoints(lambda points: points + 0.5),
        "a hair aside": AtPoints(lambda points: points + 0.01),
        "each once": AtPoints(lambda points: np.unique(points, axis=0)),
        "centres alone": AtPoints(lambda points: np.floor(points) + 0.5),
        "a layer less": AtPoints(alter=without_the_last_layer),
        "other triangles": AtPoints(alter=lambda found: found.replace(triangle=found.triangle + 1)),
    },
    "it_agrees_with_the_reference": {
        "nothing culled": OddRaster(cull="none"),
        "edges lost": OddRaster(eroded),
        "depth": OddRaster(lambda f, _: f._replace(depth=f.depth * np.float32(1 + 4e-5))),
    },
    "layers_are_front_to_back": {
        "reversed": OddRaster(lambda f, _: Fragments(*(np.ascontiguousarray(x[::-1]) for x in f))),
        "K - 1": OddRaster(lambda f, _: Fragments(*(np.concatenate([x[1:], x[:1]]) for x in f))),
    },
    "background_is_empty": {
        "depth": altered(depth=lambda s: np.where(s.row < 0, np.float32(9), s.depth)),
        "row 0": altered(row=lambda s: np.maximum(s.row, 0)),
        "shared rows": altered(row=lambda s: np.minimum(s.row, 5)),
        "row -2": altered(row=lambda s: np.where(s.row < 0, -2, s.row)),
    },
    "samples_lie_between_the_near_and_the_far_plane": {"no planes": OddRaster(camera=wider_planes)},
    "two_calls_give_the_same": {"a counter": Unsteady(), "kept by identity": ByIdentity(), "reused": Reusing()},
    "prepared_parts_are_sampled_alike": {"in another order": Disarranged()},
    "it_follows_theta": {"stale update": StaleUpdate(), "kept by identity": ByIdentity()},
    "it_sees_arrays_that_change_in_place": {"kept for ever": Forgetful()},
    "capacity_drops_the_deepest_layers_first": {
        "ignored": Roomy(),
        "front first": DropsTheFront(),
        "not counted": altered(overflow=lambda s: 0 * s.overflow),
    },
    "what_it_cannot_sample_is_refused_in_one_line": {
        "another error": Complains(AttributeError("no attribute 'proxy'")),
        "no words": Complains(InputError("")),
        "none": AcceptsAnything(),
    },
    "every_engine_finds_the_same_samples": {
        "not in torch": altered(depth=lambda s: wrong_in_torch(s.depth)),
        "not traceable": altered(depth=lambda s: np.asarray(s.depth) if engine_of(s.depth).name == "jax" else s.depth),
    },
    "engines_agree": {"not in torch": altered(params=lambda s: wrong_in_torch(s.params))},
    "samples_carry_no_derivative": {"leaking": OddSampler(leaking)},
    "unseen_parts_give_nothing_and_no_gradient": {"everywhere": OddSampler(covering)},
    "awkward_views_are_finite": {"NaN": altered(params=lambda s: s.params / (s.depth[0, 0, 0] * 0))},
}


class OddMesh(Mesh):
    """A mesh whose G-buffer is altered."""

    def __init__(self, alter=lambda gbuffer, theta, samples: None):
        super().__init__(Mesh.example().surface.faces)
        self.alter = alter

    def evaluate(self, theta, samples):
        gbuffer = super().evaluate(theta, samples)
        return self.alter(gbuffer, theta, samples) or gbuffer


def with_entry(name, change):
    """A mesh with an entry of its G-buffer changed."""

    def alter(gbuffer, theta, samples):
        gbuffer[name] = change(gbuffer[name], theta, samples)

    return OddMesh(alter)


class SwappedHits(Ellipsoid):
    def intersect(self, theta, origins, directions, layers):
        hits = super().intersect(theta, origins, directions, layers)
        return RayHits(*(x[::-1] for x in hits[:3]))


class Refined(OddMesh):
    def refine(self, inputs, samples, rays):
        return samples.replace(depth=np.full_like(samples.depth, 2))


class Renumbered(OddMesh):
    def refine(self, inputs, samples, rays):
        return samples.replace(row=np.where(samples.row > 0, samples.row - 1, samples.row))


class Lost(OddMesh):
    def refine(self, inputs, samples, rays):
        return samples.replace(depth=samples.depth * np.float32(np.nan))


class Shy(Ellipsoid):
    """Does not see what is nearer to a ray's origin than a twentieth."""

    def intersect(self, theta, origins, directions, layers):
        hits = super().intersect(theta, origins + 0.05 * directions, directions, layers)
        return hits._replace(distance=hits.distance + 0.05)


class Empty(Ellipsoid):
    """Gives NaN where nothing is hit."""

    def intersect(self, theta, origins, directions, layers):
        hits = super().intersect(theta, origins, directions, layers)
        return hits._replace(distance=np.where(hits.hit, hits.distance, np.nan))


class OneSided(Ellipsoid):
    """Gives but the first hit."""

    def intersect(self, theta, origins, directions, layers):
        hits = super().intersect(theta, origins, directions, layers)
        return hits._replace(hit=hits.hit & (np.arange(layers) == 0)[:, None])


class Holed(Ellipsoid):
    """Misses what comes from the right."""

    def intersect(self, theta, origins, directions, layers):
        hits = super().intersect(theta, origins, directions, layers)
        return hits._replace(hit=hits.hit & (directions[:, 0] > -0.1))


class Looking(Ellipsoid):
    """Looks at values of rays."""

    def intersect(self, theta, origins, directions, layers):
        return super().intersect(theta, origins, -directions if origins[0, 0] > 1e6 else directions, layers)


class Stale(OddMesh):
    def proxy(self, inputs, camera, size):
        if not hasattr(self, "kept"):
            self.kept = super().proxy(inputs.copy(), camera, size)
        return self.kept


class Counting(OddMesh):
    calls = 0

    def evaluate(self, theta, samples):
        self.calls += 1
        gbuffer = super().evaluate(theta, samples)
        gbuffer["position"] = gbuffer["position"] + 1e-4 * self.calls
        return gbuffer


class WrongWidths(OddMesh):
    sample_widths = property(lambda self: (4, 2), lambda self, widths: None)


class Inflated(OddMesh):
    def proxy(self, inputs, camera, size):
        return super().proxy(1.01 * inputs, camera, size)


class ViewDependent(OddMesh):
    def proxy(self, inputs, camera, size):
        return super().proxy(inputs + 1e-3 * camera.view[0, 0], camera, size)


class Unchecked(OddMesh):
    def check(self, theta):
        pass


def looks_at_values(gbuffer, theta, samples):
    if theta["vertices"][0, 0] > 100:
        gbuffer["position"] = gbuffer["position"] + 1


def over_nothing(x, theta, samples):
    """Divided by what is zero in a row that only pads."""
    total = samples.params[:, :1] + samples.params[:, 1:]
    return x * (total / total)


SURFACES = {
    "samples_lie_on_the_centres_of_their_pixels": {
        "moved": with_entry("position", lambda x, *_: x + 0.05),
        "corners exchanged": with_entry(
            "position", lambda x, t, s: OddMesh().evaluate(t, replace(s, params=s.params[:, ::-1]))["position"]
        ),
        "another depth": Refined(),
    },
    "layers_are_front_to_back": {"farthest first": SwappedHits()},
    "refine_keeps_samples_on_their_rays": {"another depth": Refined(), "rows renumbered": Renumbered(), "NaN": Lost()},
    "rays_from_before_a_hit_find_it": {"nothing near": Shy(), "NaN where nothing is hit": Empty()},
    "rays_from_behind_hit_the_same_places": {"no second hits": OneSided(), "a hole": Holed()},
    "intersect_can_be_compiled": {"looks at values": Looking()},
    "two_renders_are_the_same": {"a counter": Counting(), "kept for ever": Stale()},
    "the_g_buffer_has_a_row_for_each_sample": {
        "widths": WrongWidths(),
        "no position": OddMesh(lambda g, t, s: GBuffer(normal=g["position"])),
        "one row": with_entry("color", lambda x, *_: x[:1]),
        "no columns": with_entry("color", lambda x, *_: x[:, 0]),
        "float64": with_entry("color", lambda x, *_: x * np.float64(1)),
        "padding": with_entry("color", over_nothing),
    },
    "triangles_have_their_corners_on_the_surface": {
        "inflated": Inflated(),
        "normals inward": with_entry("normal", lambda x, *_: -x),
    },
    "triangles_depend_on_the_view_only_with_a_key": {"no key": ViewDependent()},
    "evaluate_can_be_compiled": {"looks at values": OddMesh(looks_at_values)},
    "gradients_at_frozen_samples_are_finite_differences": {
        "position detached": with_entry("position", lambda x, *_: stopped(x)),
        "color detached": with_entry("color", lambda x, *_: stopped(x)),
        "half detached": with_entry("normal", lambda x, *_: 0.5 * (x + stopped(x))),
    },
    "engines_agree": {"not in torch": with_entry("color", lambda x, *_: wrong_in_torch(x))},
    "the_image_depends_on_the_surface": {"detached": with_entry("position", lambda x, *_: stopped(x))},
    "unseen_it_gives_nothing_and_no_gradient": {"padding": with_entry("position", over_nothing)},
    "awkward_views_are_finite": {"NaN": with_entry("color", lambda x, *_: x / (x - x))},
    "wrong_theta_is_refused_in_one_line": {"no check": Unchecked()},
}


def by_camera(theta, gbuffer, camera):
    """One colour, but another through each camera."""
    xp = namespace(gbuffer["position"])
    return xp.ones_like(gbuffer["color"]) * xp.abs(camera.view[0, 0])


by_camera.uniform = True


def shading(change=lambda rgba, theta, gbuffer: rgba, **promises):
    """A shader whose colours are altered."""

    def shader(theta, gbuffer, camera):
        return change(Unlit(opaque=False)(theta, gbuffer, camera), theta, gbuffer)

    for name, value in promises.items():
        setattr(shader, name, value)
    return shader


def straight(rgba, theta, gbuffer):
    return namespace(rgba).concat(Unlit().base_color(theta, gbuffer), axis=1)


def by_length(rgba, theta, gbuffer):
    xp = namespace(rgba)
    return rgba * xp.sqrt(xp.sum(gbuffer["normal"] ** 2, axis=1, keepdims=True))


def one_view(theta, gbuffer, camera):
    """Shades all samples as those of the first."""
    first = camera.of_rows(1 + 0 * camera.number) if isinstance(camera, RowCameras) else camera
    return Depth()(theta, gbuffer, first)


def by_matrix(theta, gbuffer, camera):
    return Normals()(theta, {"normal": gbuffer["normal"] @ camera.view[:3, :3].T}, camera)


for _shader in (one_view, by_matrix):
    _shader.takes_views, _shader.reads = True, ("normal",)

SHADERS = {
    "it_gives_a_premultiplied_color_for_each_sample": {
        "straight alpha": shading(straight),
        "too bright": shading(lambda c, *_: 2 * c),
        "negative": shading(lambda c, *_: c - 0.1),
        "no alpha": shading(lambda c, *_: c[:, :3]),
        "float64": shading(lambda c, *_: c.astype(np.float64)),
    },
    "samples_are_shaded_one_by_one": {
        "all together": shading(lambda c, *_: c * namespace(c).mean(c)),
        "by number": shading(lambda c, *_: c * (0.5 + np.arange(len(c), dtype=np.float32)[:, None] / 200)),
    },
    "opaque_is_true": {"translucent": shading(opaque=True)},
    "uniform_is_one_color": {
        "many": shading(uniform=True),
        "another from each view": by_camera,
    },
    "it_reads_what_it_says": {
        "color unsaid": shading(reads=("uv",)),
        "normal unsaid": shading(by_length, reads=("color",)),
        "θ unsaid": shading(lambda c, t, g: 0 * c + (1 if "color" in t else 0.5), reads=("uv", "normal")),
    },
    "samples_of_several_views_are_shaded_as_by_each": {
        "one view": one_view,
        "reads unsaid": shading(takes_views=True),
        "no matrices": by_matrix,
    },
    "engines_agree": {"not in torch": shading(lambda c, *_: wrong_in_torch(c))},
    "gradients_are_finite_differences": {"detached": shading(lambda c, *_: stopped(c))},
    "awkward_samples_have_finite_gradients": {"root of zero": shading(by_length)},
    "what_is_missing_is_refused_in_one_line": {"KeyError": shading(lambda c, t, g: c * t["color"][0])},
}


class OddMulti(Multi):
    """A splatter whose input or output is altered."""

    def __init__(self, given=lambda p, c, r: (p, c, r), made=lambda image, p, c, r: image):
        super().__init__()
        object.__setattr__(self, "given", given)
        object.__setattr__(self, "made", made)

    def image(self, splats):
        given = splats.positions, splats.rgba, splats.row
        return self.made(super().image(splats_of(*self.given(*given))), *given)


def from_centres(positions, rgba, row):
    """Positions mirrored at the centres of their cells, for one sample a cell in order."""
    centres = engine_of(positions).constant(splatters.everywhere(splatters.LAYERS).positions)
    return 2 * centres - positions, rgba, row


def all_rows(image, positions, rgba, row):
    xp = namespace(image)
    return image + 1e-3 * xp.mean(rgba)


class Curious(OddMulti):
    reads = frozenset({"depths"})


class Cutting(OddMulti):
    """Cells in the border do not splat at all."""

    def cropped(self, splats):
        middle, border = np.zeros(splats.row.shape[1:], bool), splats.border
        middle[border : len(middle) - border, border : middle.shape[1] - border] = True
        return without_border(super().image(splats.replace(row=np.where(middle, splats.row, -1))), border)


class Dark(Single):
    """It promises to be translucent, and drops the layers behind."""

    translucent = True


SPLATTERS = {
    "it_reads_what_there_is": {"depths": Curious()},
    "a_constant_interior_stays": {"dimmed": OddMulti(made=lambda image, *_: 0.99 * image)},
    "the_front_layer_hides_those_behind": {"back to front": OddMulti(lambda p, c, r: (p, c, r[::-1]))},
    "light_passes_through_translucent_layers": {"fronts only": Dark()},
    "empty_cells_stay_empty": {"last row": OddMulti(lambda p, c, r: (p, c, np.where(r < 0, len(c) - 1, r)))},
    "colors_stay_premultiplied": {
        "alpha halved": OddMulti(made=lambda image, *_: image * np.array([1, 1, 1, 0.5])),
        "summed": OddMulti(made=lambda image, *_: 1.5 * image),
    },
    "the_order_of_packed_rows_has_no_effect": {
        "by number": OddMulti(lambda p, c, r: (p, c * np.linspace(0, 1, len(c))[:, None], r))
    },
    "rows_of_no_cell_have_no_effect": {"all rows": OddMulti(made=all_rows)},
    "cells_of_the_border_only_splat": {"cut off": Cutting()},
    "a_shape_that_moves_brightens_what_it_moves_into": {"mirrored": OddMulti(from_centres), "none": Plain()},
    "every_engine_gives_the_same_image": {"not in torch": OddMulti(made=lambda image, *_: wrong_in_torch(image))},
    "engines_agree": {
        "detached in torch": OddMulti(lambda p, c, r: (stopped(p) if engine_of(p).name == "torch" else p, c, r))
    },
    "rows_of_no_cell_have_no_gradient": {"all rows": OddMulti(made=all_rows)},
}


def engine_with(**members):
    """The engine of torch with some members altered."""
    base = rts.plugin("engines", "torch")
    return lambda: type("OddTorch", (base,), members)()


def leaking_host(self, fn, specs, *args):
    """A host call whose results have the derivative of its first argument."""
    found = list(super(type(self), self).call_host(fn, specs, *args))
    found[0] = found[0] + (args[0] - args[0].detach())
    return tuple(found)


def of_base(name, change):
    """A method whose result is altered."""
    return lambda self, *args: change(getattr(super(type(self), self), name)(*args))


def forgetful(self, *args):
    """An optimiser that does not take its state back."""
    step = super(type(self), self).optimizer(*args)
    step.restore = lambda state, parameters: None
    return step


def others(name, function):
    """The namespace of torch with another function."""
    from types import SimpleNamespace

    from array_api_compat import torch as array_api

    return SimpleNamespace(**{**vars(array_api), name: function})


ODD_ENGINES = {
    "it_owns_its_arrays_alone": {"everything": engine_with(owns=lambda self, x: True)},
    "constants_keep_their_values": {
        "float64": engine_with(constant=lambda self, value, like=None: __import__("torch").tensor(np.array(value))),
        "all floats": engine_with(constant=of_base("constant", lambda x: x.float())),
    },
    "its_namespace_is_that_of_the_array_api": {
        "where": lambda: engine_with(namespace=others("where", lambda c, a, b: __import__("torch").where(c, b, a)))()
    },
    "host_functions_are_called_with_numpy": {
        "tensors": engine_with(call_host=lambda self, fn, specs, *args: fn(*args)),
    },
    "host_functions_have_no_derivative": {"leaking": engine_with(call_host=leaking_host)},
    "what_is_decided_by_the_device_is_the_same": {
        "off by one": engine_with(by_host=of_base("by_host", lambda found: tuple(x + 1 for x in found)))
    },
    "segments_are_summed": {
        "halved": engine_with(segment_sum=of_base("segment_sum", lambda x: x / 2)),
        "detached": engine_with(segment_sum=of_base("segment_sum", lambda x: x.detach() + 0 * x)),
    },
    "loops_end_early": {
        "never": engine_with(
            repeat=lambda self, body, going, state, most: [state := body(state) for _ in range(most)][-1]
        )
    },
    "loops_have_no_derivative": {
        "has one": engine_with(
            repeat=lambda self, body, going, state, most: type(self)._repeated(body, going, state, most)
        )
    },
    "rows_have_gradients": {
        "halved": engine_with(gradient_of_rows=of_base("gradient_of_rows", lambda x: x / 2)),
        "detached": engine_with(gradient_of_rows=of_base("gradient_of_rows", lambda x: x.detach() + 0 * x)),
    },
    "unused_rows_are_filled": {
        "left": engine_with(padded=lambda self, x: True, fill_unused=lambda self, x, row: x),
    },
    "functions_of_rows_in_use_are_those_of_all_rows": {
        "one too few": engine_with(
            by_rows_in_use=lambda self, f, rows, row, whole: f({"x": rows["x"] * (row.max() > 2)})
        ),
    },
    "compiled_functions_are_the_same": {"off by one": engine_with(jit=lambda self, f: lambda *args: f(*args) + 1)},
    "without_derivatives_it_says_so": {"has them": engine_with(differentiates=False)},
    "gradients_are_those_of_closed_forms": {
        "doubled": engine_with(
            value_and_grad=lambda self, f: (
                lambda tree: (
                    (found := super(type(self), self).value_and_grad(f)(tree))[0],
                    rts.arrays.trees.map_leaves(lambda x: 2 * x, found[1]),
                )
            )
        )
    },
    "forward_mode_can_be_differentiated": {
        "detached": engine_with(jvp=of_base("jvp", lambda found: tuple(x.detach() + 0 * x for x in found)))
    },
    "jacobians_have_a_row_an_unknown": {
        "negative": engine_with(
            jacobian=lambda self, f: (
                lambda v: (
                    (found := super(type(self), self).jacobian(f)(v))[0],
                    tuple(-x for x in found[1]),
                )
            )
        )
    },
    "stop_gradient_stops_it": {"passes": engine_with(stop_gradient=lambda self, x: x)},
    "checkpoints_have_the_same_gradient": {
        "detached": engine_with(checkpoint=of_base("checkpoint", lambda x: x.detach() + 0 * x))
    },
    "optimizers_step": {
        "too far": engine_with(
            optimizer=lambda self, name, rate, parameters: super(type(self), self).optimizer(
                name, 2 * np.asarray(rate) if isinstance(rate, list) else 2 * rate, parameters
            )
        )
    },
    "optimizers_go_on_from_their_state": {"afresh": engine_with(optimizer=forgetful)},
    "operations_are_their_specification": {
        "a thousandth more": engine_with(apply=of_base("apply", lambda x: x * 1.001)),
        "half detached": engine_with(apply=of_base("apply", lambda x: (x + x.detach()) / 2)),
    },
    "a_render_is_numpys": {"a thousandth more": engine_with(apply=of_base("apply", lambda x: x * 1.001))},
}


def scaled(**members):
    """x · k of x (N, C) and k (C,), with some members altered."""

    def push(operands, tangents, out):
        out[...] = sum(t * x for t, x in zip(tangents, reversed(operands), strict=True) if t is not None)

    def pull(operands, g, results):
        if results[0] is not None:
            results[0][...] = g * operands[1]
        if results[1] is not None:
            results[1][...] = (g * operands[0]).sum(axis=0)

    given = {
        "specification": lambda x, k: x * k,
        "shape": lambda x, k: x,
        "forward": lambda operands, out: np.multiply(*operands, out=out) is None,
        "push": push,
        "pull": pull,
    }
    options = {"differentiable": 2, "packed": (0,), "packed_result": True}
    return Operation("tests.odd", ranks=(2, 1), **{**given, **options, **members})


def forward_of_all(operands, out):
    np.multiply(*operands, out=out)
    out += operands[0].sum()


def push_that_adds(operands, tangents, out):
    for t, x in zip(tangents, reversed(operands), strict=True):
        if t is not None:
            out += t * x


def push_of_all(operands, tangents, out):
    out[...] = tangents[0] * operands[1] + tangents[1] * operands[0]


def push_of_kept(operands, tangents, out, kept):
    """Right only with what forward has kept."""
    scaled().push(operands, tangents, out)
    out *= 1 if kept else 0.5


def keeping(operands, out):
    np.multiply(*operands, out=out)
    return True


ODD_OPERATIONS = {
    "forward_is_the_specification": {
        "a thousandth more": scaled(forward=lambda x, out: np.multiply(*x, out=out).__imul__(1.001) is None),
        "nothing written": scaled(forward=lambda operands, out: operands[0] * operands[1]),
        "a row unwritten": scaled(forward=lambda x, out: np.multiply(x[0][1:], x[1], out=out[1:]) is None),
        "a row less": scaled(shape=lambda x, k: (x[0] - 1, x[1]), forward=lambda x, out: out.fill(1)),
        "operands changed": scaled(forward=lambda x, out: np.multiply(*x, out=x[0]) is None),
        "always float64": scaled(specification=lambda x, k: (x * k).astype(np.float64)),
        "an error": scaled(forward=lambda operands: None),
    },
    "push_is_the_derivative_of_the_specification": {
        "of all operands": scaled(push=push_of_all),
        "added": scaled(push=push_that_adds),
        "halved": scaled(push=lambda x, t, out: out.__setitem__(..., 0.5)),
    },
    "pull_is_the_transpose_of_push": {
        "nothing written": scaled(pull=lambda operands, g, results: None),
        "all results": scaled(pull=lambda x, g, results: results[0].__setitem__(..., g * x[1])),
    },
    "what_forward_keeps_changes_nothing": {
        "needed": scaled(
            keeps=True,
            forward=keeping,
            push=push_of_kept,
            pull=lambda x, g, results, kept: scaled().pull(x, g, results),
        )
    },
    "rows_are_computed_by_themselves": {
        "all together": scaled(forward=forward_of_all),
    },
    "every_engine_gives_the_value_and_derivatives_of_the_specification": {
        "a thousandth more": scaled(forward=lambda x, out: np.multiply(*x, out=out).__imul__(1.001) is None),
        "no pull": scaled(pull=lambda operands, g, results: None),
        "doubled push": scaled(push=lambda x, t, out: (scaled().push(x, t, out), out.__imul__(2))),
    },
}

LAMBERTIAN = {"color": np.array([0.9, 0.8, 1.0], np.float32)}


def surface_part(surface):
    if isinstance(surface, Part):
        return surface
    return Mesh.example().replace(surface=surface) if isinstance(surface, Mesh) else ellipsoid(surface)


def shader_fixtures(shader):
    shader, theta = shader if isinstance(shader, tuple) else (shader, LAMBERTIAN)
    return {"shader": shader, "theta": theta, "gbuffer": shaders.random_gbuffer()}


def both(broken, strangers):
    """Broken plugins by the check that finds them, of two tables."""
    return {check: {**broken.get(check, {}), **strangers.get(check, {})} for check in {**broken, **strangers}}


KIT = {
    SamplerConformance: (SAMPLERS, lambda sampler: {"sampler": sampler, "parts": [scenes.ball(), CULLED]}),
    SurfaceConformance: (
        both(SURFACES, planted.SURFACES),
        lambda surface: {"part": surface_part(surface), "sampler": "auto"},
    ),
    ShaderConformance: (both(SHADERS, planted.SHADERS), shader_fixtures),
    SplatterConformance: (both(SPLATTERS, planted.SPLATTERS), lambda splatter: {"splatter": splatter}),
    OperationConformance: (
        ODD_OPERATIONS,
        lambda operation: {
            "operation": operation,
            "operands": [numbers(6, 3).astype(float), numbers(3).astype(float)],
            "params": {},
            "dtype": np.float32,
            "share": 0.5,
            "name": "torch",
        },
    ),
    EngineConformance: (ODD_ENGINES, lambda make: {"engine": make(), "name": "projective_map"}),
}
CULLED = scenes.ball(cull="back")
ENGINE = {"looks at values": "jax", "not traceable": "jax"}
"""The engine to show it in; the others with torch."""

BROKEN = [
    pytest.param(kit, check, fixtures, plugin, ENGINE.get(name, "torch"), id=f"{kit.__name__}-{check}-{name}")
    for kit, (checks, fixtures) in KIT.items()
    for check, plugins in checks.items()
    for name, plugin in plugins.items()
]


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("kit, check, fixtures, plugin, engine", BROKEN)
def test_a_broken_plugin_fails_the_check(kit, check, fixtures, plugin, engine):
    pytest.importorskip("torch")
    pytest.importorskip("jax")
    method = getattr(kit(), f"test_{check}")
    arguments = fixtures(plugin)
    wanted = set(inspect.signature(method).parameters)
    if "engine" in wanted and "engine" not in arguments:
        arguments["engine"] = engine
    if check == "its_namespace_is_that_of_the_array_api":
        arguments["name"] = "where"
    # What breaks the contract of proxies is refused wherever it is drawn.
    with pytest.raises((AssertionError, rts.InputError)) as failure:
        method(**{name: value for name, value in arguments.items() if name in wanted})
    assert str(failure.value)


@pytest.mark.parametrize("check", planted.SOUND)
def test_without_its_mistake_a_plugin_passes(check):
    method = getattr(SurfaceConformance(), f"test_{check}")
    given = {"part": planted.SOUND[check], "sampler": "auto"}
    method(**{name: given[name] for name in inspect.signature(method).parameters})


def test_what_is_wrong_anyway_is_not_taken_for_a_change_in_place_unseen():
    with pytest.raises(AssertionError, match="after a change in place of the arrays of θ: the depth of"):
        SamplerConformance().test_it_sees_arrays_that_change_in_place(
            OddRaster(lambda f, _: f._replace(depth=f.depth * np.float32(1.001))), [scenes.ball()]
        )
    SamplerConformance().test_it_sees_arrays_that_change_in_place(altered(depth=lambda s: s.depth), [scenes.ball()])


@pytest.mark.parametrize(
    "sampler", [OddRaster(lambda f, _: Fragments(*(x[:, ::-1] for x in f))), OddRaster(next_triangle)]
)
def test_an_image_that_is_not_the_reference_s_is_not_ok(sampler):
    compatibility.attempt(Mesh.example(), OddRaster(), "numpy")
    with pytest.raises(rts.RtsError, match="pixels are not those of the sampler 'reference'"):
        compatibility.attempt(Mesh.example(), sampler, "numpy")


@pytest.mark.parametrize("kit", KIT, ids=lambda kit: kit.__name__)
def test_every_check_is_proved(kit):
    checks = {name.removeprefix("test_") for name in dir(kit) if name.startswith("test_")}
    assert set(KIT[kit][0]) == checks


@pytest.mark.parametrize("kit", KIT, ids=lambda kit: kit.__name__)
def test_only_subclasses_are_collected(kit):
    assert not kit.__test__
    assert type("TestMine", (kit,), {}).__test__


def test_the_kit_is_loaded_by_nothing_but_its_own_import():
    names = "('pytest', '_pytest', 'rts.testing', 'rts_testing')"
    code = f"import sys, rts, rts_cli.main; print([m for m in sys.modules if m.startswith({names})])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
    assert not [e for e in entry_points(group="pytest11") if e.dist and e.dist.name == "rasterize-then-splat"]
