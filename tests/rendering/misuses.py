"""Calls of every public function with one argument left open, beside those of `test_misuse`: its values go there."""

import tempfile
from dataclasses import replace

import numpy as np
import pytest
from networks import FIELD

import rts
from rts import Camera, regularizers
from rts.plugin_api.operations import Operation, gradient
from rts.plugin_api.records import Fragments, Proxy, RayHits
from rts_compare import compare, stability

SIZE = (12, 16)
CAMERA = Camera.look_at((0.4, 0.5, 4), (0, 0, 0))
PART = rts.Mesh.example()
FACES, VERTICES = np.array([(0, 1, 2), (0, 2, 3)], np.int32), np.eye(4, 3, dtype=np.float32)
POINTS = np.array([[0.1, 0.2, -2.0], [0.3, 0.1, -3.0]], np.float32)
SAMPLED = rts.sample(PART, CAMERA, SIZE)
BARE = rts.sample(PART, CAMERA, SIZE, splatter="none")
NDC = rts.Ndc((1.0, 1.0))
STEPS = rts.LargeSteps(np.zeros((4, 3)), FACES)
DOUBLE = Operation(
    "misuses.double",
    lambda x: 2 * x,
    ranks=(2,),
    shape=lambda x: x,
    forward=lambda operands, out: np.multiply(operands[0], 2, out=out) is None,
    push=lambda operands, tangents, out: np.multiply(tangents[0], 2, out=out) is None,
    pull=lambda operands, g, results: np.multiply(g, 2, out=results[0]) is None,
)


class Card(rts.TriangleSurface):
    """A square whose proxy is altered."""

    sample_widths = (3, 2)

    def __init__(self, **changes):
        self.changes = changes

    def evaluate(self, theta, samples):
        corners = VERTICES[samples.ids]
        u, v = samples.params[:, :1], samples.params[:, 1:2]
        return rts.GBuffer(position=u * corners[:, 0] + v * corners[:, 1] + (1 - u - v) * corners[:, 2])

    def proxy_inputs(self, theta):
        return theta["vertices"]

    def proxy(self, inputs, camera, size):
        return Proxy(VERTICES, FACES)._replace(**self.changes)


class Ball(rts.RaySurface):
    """A ray surface whose hits are altered."""

    sample_widths = (0, 1)

    def __init__(self, **changes):
        self.changes = changes

    def evaluate(self, theta, samples):
        return rts.GBuffer(position=samples.params * np.ones((1, 3), np.float32))

    def intersect(self, theta, origins, directions, layers):
        shape = (layers, len(origins))
        hits = RayHits(np.zeros(shape, bool), np.ones(shape, np.float32), np.zeros((*shape, 1), np.float32))
        return hits._replace(**self.changes)


class Traced(Card):
    """A surface whose evaluation is altered."""

    def evaluate(self, theta, samples):
        return self.changes["made"](super().evaluate(theta, samples))

    def proxy(self, inputs, camera, size):
        return Proxy(VERTICES, FACES)


class Raster(rts.TriangleSampler):
    """A sampler whose fragments are altered."""

    def __init__(self, **changes):
        self.changes = changes

    def rasterize(self, prepared, camera, size, layers, cull):
        shape = (layers, *size)
        ids, depth = np.full(shape, -1, np.int32), np.zeros(shape, np.float32)
        return Fragments(ids, np.zeros((*shape, 2), np.float32), depth)._replace(**self.changes)


def drawn(surface, theta=None, **options):
    theta = {"vertices": VERTICES} if theta is None else theta
    return rts.render(rts.Part(surface, theta, "silhouette"), CAMERA, SIZE, **options)


def pose():
    """A pose that is differentiable."""
    return pytest.importorskip("torch").zeros(6)


def scene(parameters):
    return PART.replace(transform=rts.rigid(parameters)), CAMERA


def checked(**options):
    return rts.check_gradient(scene, pose(), SIZE, **options)


def tuned(**options):
    given = {"scene": scene, "parameters": pose(), "size": SIZE, "samplers": ["raster"], "splatters": ["single"]}
    return rts.tune(**{**given, "tolerance": 1e9, "budget_s": 1e-3, "truth_samples": 2, "progress": False, **options})


def compared(**options):
    with tempfile.TemporaryDirectory() as folder:
        given = {"scene": scene, "parameters": pose(), "size": SIZE, "samplers": [], "output": folder}
        return compare(**{**given, "progress": False, **options})


def broken(**options):
    return stability(**{"rows": [], "progress": False, "output": tempfile.gettempdir(), **options})


def volume(**options):
    return FIELD.volume_render(**{"camera": CAMERA, "size": SIZE, "samples": (3, 1), **options})


def energy(kind, **options):
    given = {"vertices": VERTICES, "faces": FACES, **options}
    regularizer = kind(**given)
    return regularizer(VERTICES)


def subdivided(**options):
    return rts.Subdivision(**{"faces": FACES, **options})


def residuals(**options):
    return rts.ImageResiduals(lambda p: scene(p)[0], CAMERA, SIZE, np.ones(SIZE, np.float32), **options)(pose())


def of_views(**options):
    """Residuals of a view, computed once."""
    view = rts.View(CAMERA, np.ones((*SIZE, 4), np.float32))
    given = {"scene": lambda p: scene(p)[0], "views": [view], **options}
    residuals = rts.ViewResiduals(**given)
    return residuals.of(residuals.load(residuals.draw(0)[0]))(pose())


OPERATION = "name", "specification", "ranks", "shape", "forward", "push", "pull", "differentiable", "packed", "keeps"
RENDERED = "parts cameras size sampler splatter layers supersample background capacity engine".split()


def open_in(function, *names, **fixed):
    """Calls of a function of named arguments, with one of them open, by their names."""
    return {name: lambda v, name=name: function(**{**fixed, name: v}) for name in names}


GROUPS = {
    "BSpline": open_in(rts.BSpline, "tolerance", shape=(4, 4)),
    "Camera": {"aspect": lambda v: rts.render(PART, Camera(CAMERA.view, CAMERA.projection, v), SIZE)},
    "Fragments": open_in(lambda **o: drawn(Card(), sampler=Raster(**o)), "triangle_ids", "barycentrics", "depth"),
    "GBuffer": {
        "position": lambda v: drawn(Traced(made=lambda gbuffer: rts.GBuffer(position=v))),
        "gbuffer": lambda v: drawn(Traced(made=lambda gbuffer: v)),
    },
    "ImageResiduals": open_in(
        residuals, "background", "sampler", "splatter", "layers", "supersample", "capacity", "channels"
    ),
    "LargeSteps": open_in(
        lambda **o: rts.LargeSteps(**{"vertices": np.zeros((4, 3)), "faces": FACES, **o}),
        *("vertices", "faces", "smoothness"),
    ),
    "LargeSteps.encode": {"vertices": STEPS.encode},
    "LargeSteps.decode": {"u": STEPS.decode},
    "Loss": open_in(lambda **o: rts.Loss(**{"name": "huber", **o})(np.ones((2, 2))), "name", "f_scale"),
    "Ndc": open_in(lambda **o: rts.Ndc(**{"scale": (1.0, 1.0), **o}).from_world(POINTS), "scale", "near"),
    "Ndc.of_images": open_in(rts.Ndc.of_images, "size", "focal", "near", size=SIZE, focal=20.0),
    "Ndc.from_world": {"points": NDC.from_world},
    "Ndc.to_world": {"points": NDC.to_world},
    "Ndc.rays": open_in(NDC.rays, "origins", "directions", origins=POINTS, directions=-POINTS),
    "Operation": open_in(lambda **o: replace(DOUBLE, **o), *OPERATION),
    "Operation.call": {"operands": DOUBLE},
    "Part": {"replace": lambda v: PART.replace(theta=v)},
    "Proxy": open_in(lambda **o: drawn(Card(**o)), "vertices", "faces", "ids", "corner_params"),
    "RayHits": open_in(lambda **o: drawn(Ball(**o), {}), "hit", "distance", "params", "ids"),
    "Revolution": open_in(rts.Revolution, "ends", "tolerance", heights=np.arange(5.0)),
    "Samples": open_in(
        lambda **o: rts.render_samples(
            replace(BARE, samples=[BARE.samples[0].replace(**o)]), PART, CAMERA, splatter="none"
        ),
        *("ids", "params", "row", "depth"),
    ),
    "Sdf": open_in(lambda **o: rts.Sdf(lambda t, p: p[:, 0], **o), "isovalue", "inside", "reads", "attributes"),
    "Subdivision": open_in(
        subdivided, "faces", "scheme", "creases", "corners", "boundary", "chaikin", "indices", "uv_rule", "tolerance"
    ),
    "View": open_in(
        lambda **o: rts.View(**{"camera": CAMERA, "image": np.ones((*SIZE, 4), np.float32), **o}),
        *("camera", "image", "size", "mask"),
    ),
    "ViewResiduals": open_in(
        of_views,
        *"scene views batch window seed cameras exposure weights target unreadable memory".split(),
        *("background", "sampler", "splatter", "layers", "supersample", "capacity", "channels", "loss", "f_scale"),
    ),
    "check_gradient": open_in(checked, "loss", "samples", "tolerance", "budget_s"),
    "engine_of": {"trees": rts.engine_of},
    "exact_calibration": {"reach": lambda v: rts.splatting.exact_calibration(0.5, v)},
    "explain": open_in(
        lambda **o: rts.explain(PART, CAMERA, **o), "size", "splatter", "layers", "supersample", size=SIZE
    ),
    "fit": open_in(
        lambda **o: rts.fit(lambda p: p, pose(), steps=1, **o),
        *"progress jit method learning_rate validation validate_every checkpoint checkpoint_every".split(),
    ),
    "gradient": {"points": lambda v: gradient(lambda p: p[:, 0], v)},
    "gradient_image": {
        "parameters": lambda v: rts.gradient_image(lambda p: p, v),
        "direction": lambda v: rts.gradient_image(lambda p: p.reshape(1, 1, 1), pose()[:1], v),
    },
    "load": {"weld": lambda v: rts.load("no such model.obj", weld=v)},
    "load_radiance_field": {"path": rts.load_radiance_field},
    "load_views": {
        "path": rts.load_views,
        **open_in(
            lambda **o: rts.load_views("no such folder", **o),
            *("split", "downscale", "linear", "background", "pixel_center", "frame", "near", "far", "cache"),
        ),
    },
    "save_views": {"path": lambda v: rts.save_views(v, []), "views": lambda v: rts.save_views("views.json", v)},
    "namespace": {"arrays": rts.namespace},
    "plugins": {"details": lambda v: rts.plugins("surfaces", details=v)},
    "program": {"f": rts.program},
    "render_samples": {"engine": lambda v: rts.render_samples(SAMPLED, PART, CAMERA, engine=v)},
    "render_views": open_in(
        lambda **o: rts.render_views(**{"parts": PART, "cameras": [CAMERA] * 2, "size": SIZE, **o}), *RENDERED
    ),
    "sample": open_in(
        lambda **o: rts.sample(**{"parts": PART, "camera": CAMERA, "size": SIZE, "splatter": None, **o}),
        *("camera", "sampler", "supersample", "capacity", "engine"),
    ),
    "tune": open_in(
        tuned,
        *("scene", "parameters", "tolerance", "budget_s", "directions", "size", "modes", "engine", "samplers"),
        *("splatters", "truths", "truth_samples"),
    ),
    "volume_render": open_in(volume, "camera", "size", "near", "far", "samples", "background", "ndc"),
    "warmup": {"processes": rts.warmup},
    "ARAP": open_in(lambda **o: energy(regularizers.ARAP, **o), "vertices", "faces", "weights"),
    "EdgeLength": open_in(lambda **o: energy(regularizers.EdgeLength, **o), "vertices", "faces", "target"),
    "Laplacian": open_in(lambda **o: energy(regularizers.Laplacian, **o), "vertices", "faces", "weights", "relative"),
    "NormalConsistency": open_in(lambda **o: energy(regularizers.NormalConsistency, **o), "vertices", "faces"),
    "Regularizer": {"vertices": lambda v: regularizers.EdgeLength(VERTICES, FACES)(v)},
    "compare": open_in(
        compared,
        *("scene", "parameters", "directions", "size", "modes", "samplers", "splatters", "engines", "layers"),
        *("supersample", "surface", "truth_samples"),
    ),
    "stability": open_in(broken, "rows", "methods", "seeds", "steps", "truth_samples", "output", "more"),
}
CALLS = {f"{group}.{name}": call for group, calls in GROUPS.items() for name, call in calls.items()}

ALL = "stability.rows warmup.processes compare.samplers tune.samplers tune.splatters check_gradient.loss".split()
"""Where None is right, and takes long."""

RECORDS = "ArraySpec Rate Rays Splats Comparison Stability Tuned".split()
"""What the library gives, and users read; functions that take one are in the tables."""
