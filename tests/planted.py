"""Plugins with one mistake each, such as strangers make, and the check of the kit that finds it.

They are made of the plugins of `plugin_example`, `second_plugin` and `third_plugin`, which have none.
"""

import dataclasses
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from analytic import Ellipsoid
from second_plugin.gauss5 import Gauss5
from second_plugin.torus import Torus

import rts
from rts.arrays.engines import engine_of, namespace
from rts.contracts.surface import Rate
from rts.plugin_api.operations import Operation
from rts.splatting import Multi

sys.path.insert(0, str(Path(__file__).parent / "plugin_example"))  # Nothing need install them.
sys.path.insert(0, str(Path(__file__).parent / "third_plugin"))

from rts_plugin_example.heightfield import Heightfield
from rts_third_plugin.loft import Loft
from rts_third_plugin.toon import Toon

# ------------------------------------------------------------------------------------------------------ surfaces


class Ball(rts.RaySurface):
    """A sphere of θ["radius"] (1,): a sample is the point that was hit, which moves along its normal."""

    sample_widths = (0, 3)

    def __init__(self, share=1.0):
        self.share = share

    def check(self, theta):
        if tuple(getattr(theta.get("radius"), "shape", ())) != (1,):
            raise rts.InputError("ball: theta['radius'] must be (1,)")

    def evaluate(self, theta, samples):
        xp, point = namespace(theta["radius"]), samples.params
        length = xp.sqrt(xp.sum(point * point, axis=1) + 1e-20)[:, None]
        normal = point / length
        gbuffer = rts.GBuffer(position=point + self.share * (theta["radius"] - length) * normal)
        gbuffer.defer("normal", lambda: normal)
        return gbuffer

    def intersect(self, theta, origins, directions, layers):
        ones = np.ones(3, np.float32)
        engine = engine_of(origins)
        both = {"center": engine.constant(0 * ones, origins), "radii": theta["radius"] * engine.constant(ones, origins)}
        hits = Ellipsoid().intersect(both, origins, directions, layers)
        return hits._replace(params=hits.params * theta["radius"])

    def part(self):
        return rts.Part(self, {"radius": np.array([0.9], np.float32)}, "lambert")


class HalfFollowing(Loft):
    """Its points go half of the way that θ goes."""

    def evaluate(self, theta, samples):
        curves = theta["curves"]
        first = engine_of(curves).constant(Loft.example().theta["curves"], curves)
        return super().evaluate({"curves": first + 0.5 * (curves - first)}, samples)


class Keeping(Heightfield):
    """Keeps its first triangles on the object."""

    def proxy(self, inputs, camera, size):
        if "kept" not in self.__dict__:
            object.__setattr__(self, "kept", super().proxy(inputs.copy(), camera, size))
        return self.kept


class KeepingCorners(Loft):
    """Keeps its first vertices, and every array of as many, on the object."""

    def proxy(self, inputs, camera, size):
        if "kept" not in self.__dict__:
            object.__setattr__(self, "kept", np.array(inputs, np.float32))
        return super().proxy(self.kept, camera, size)


class Lifted(Heightfield):
    """θ["lift"] () raises it; the triangles do not know that."""

    def check(self, theta):
        super().check(theta)
        if tuple(getattr(theta.get("lift"), "shape", (1,))) != ():
            raise rts.InputError("theta['lift'] must be a number")

    def evaluate(self, theta, samples):
        gbuffer, xp = super().evaluate(theta, samples), namespace(theta["heights"])
        x = gbuffer["position"]
        gbuffer["position"] = xp.stack([x[:, 0], x[:, 1] + self.lift(theta), x[:, 2]], axis=-1)
        return gbuffer

    def lift(self, theta):
        return theta.get("lift", 0.0)

    @classmethod
    def example(cls):
        part = Heightfield.example()
        return part.replace(surface=cls(), theta={**part.theta, "lift": np.array(0.0, np.float32)})


class Remembering(Lifted):
    """Remembers what it leaves out of `proxy_inputs`."""

    def proxy_inputs(self, theta):
        lift = theta["lift"]
        object.__setattr__(self, "last", float(engine_of(lift).to_numpy(lift)))
        return theta["heights"]

    def proxy(self, inputs, camera, size):
        proxy = super().proxy(inputs, camera, size)
        return proxy._replace(vertices=proxy.vertices + np.array([0, self.last, 0], np.float32))

    def refine(self, inputs, samples, rays):
        moved = rays._replace(origins=rays.origins - [0, self.last, 0])
        return super().refine(inputs, samples, moved)


class Scaled(Loft):
    """θ["scale"] () makes it larger; `proxy_inputs` leaves that out, which the example does not show."""

    def reads(self, theta):
        return ("curves", "scale")

    def check(self, theta):
        super().check(theta)
        if tuple(getattr(theta.get("scale"), "shape", (1,))) != ():
            raise rts.InputError("theta['scale'] must be a number")

    def evaluate(self, theta, samples):
        return super().evaluate({**theta, "curves": theta["curves"] * theta["scale"]}, samples)

    @classmethod
    def example(cls):
        part = Loft.example()
        return part.replace(surface=cls(7, 12), theta={**part.theta, "scale": np.array(1.0, np.float32)})


@dataclass(frozen=True)
class ByDistance(Heightfield):
    """Fewer triangles from afar, which is what `proxy_key` is to tell."""

    squares: int = 5
    key = staticmethod(lambda count, size: count)

    def count(self, inputs, camera):
        return 2 if np.linalg.norm(np.linalg.inv(camera.view)[:3, 3]) > 3.9 else 5

    def proxy_key(self, inputs, camera, size):
        return self.key(self.count(inputs, camera), size)

    def proxy(self, inputs, camera, size):
        return Heightfield.proxy(dataclasses.replace(self, squares=self.count(inputs, camera)), inputs, camera, size)


class OneKey(ByDistance):
    key = staticmethod(lambda count, size: 0)


class KeyOfSize(ByDistance):
    key = staticmethod(lambda count, size: size)


class TurnedDiagonals(Loft):
    """Quadrilaterals are cut along another diagonal, as the view has it."""

    def proxy(self, inputs, camera, size):
        proxy = super().proxy(inputs, camera, size)
        turned = np.asarray(camera.view)[0, 0] > 0.5
        return proxy._replace(faces=np.roll(proxy.faces, int(turned), axis=1))


class FacesInViewOrder(Loft):
    """Triangles come in the order of their distance."""

    def proxy(self, inputs, camera, size):
        proxy = super().proxy(inputs, camera, size)
        depth = camera.depth(proxy.vertices.astype(np.float64))[proxy.faces].mean(axis=1)
        return proxy._replace(faces=np.ascontiguousarray(proxy.faces[np.argsort(depth)]))


def with_normals(surface, change):
    """A surface whose normals are changed by a function of normal, position and parameters."""
    kind = type(surface)

    class OddNormals(kind):
        def evaluate(self, theta, samples):
            entries = super().evaluate(theta, samples)
            made = {name: entries[name] for name in list(entries)}
            made["normal"] = change(made["normal"], made["position"], samples.params)
            return rts.GBuffer(made)

    odd = object.__new__(OddNormals)
    odd.__dict__.update(surface.__dict__)
    return odd


def leaning(normal, *_):
    xp = namespace(normal)
    unit = normal / xp.sqrt(xp.sum(normal * normal, axis=1, keepdims=True) + 1e-20)
    return unit + engine_of(normal).constant(np.array([0.35, 0.0, 0.0]), normal)


def flattened(normal, *_):
    """Slopes twice as steep."""
    return normal * engine_of(normal).constant(np.array([2.0, 1.0, 2.0]), normal)


def nothing(normal, *_):
    return 0 * normal


def from_the_origin(normal, position, params):
    return position


@dataclass(frozen=True)
class Tessellated(Heightfield):
    """Knows how to become a mesh, and coarser and finer forms."""

    squares: int = 5

    def vertices(self, heights, cuts):
        proxy = dataclasses.replace(self, squares=cuts).proxy(np.asarray(heights, np.float32), None, None)
        return proxy.vertices, proxy.faces

    def cuts(self, rate):
        return max(1, int(rate)) if isinstance(rate, int) else max(1, int(np.ceil(1 / rate**0.5)))

    def tessellate(self, theta, rate):
        heights = engine_of(theta["heights"]).to_numpy(theta["heights"])
        return self.vertices(heights, self.cuts(rate))

    def rates(self, theta):
        return [Rate(f"squares={n}", n / self.squares, dataclasses.replace(self, squares=n)) for n in (2, 10)]


class OneCutMore(Tessellated):
    def cuts(self, rate):
        return super().cuts(rate) + 1


class AlwaysFour(Tessellated):
    def cuts(self, rate):
        return 4


class Coarsening(Tessellated):
    def cuts(self, rate):
        return max(1, round(8 / super().cuts(rate)))


class OffItsSurface(Tessellated):
    def vertices(self, heights, cuts):
        vertices, faces = super().vertices(heights, cuts)
        return vertices + np.array([0, 0.05, 0], np.float32), faces


class FacesOfNothing(Tessellated):
    def vertices(self, heights, cuts):
        vertices, faces = super().vertices(heights, cuts)
        return vertices[:-1], faces


class RatesElsewhere(Tessellated):
    def rates(self, theta):
        return [r._replace(theta=lambda theta: {"heights": 0.8 * theta["heights"]}) for r in super().rates(theta)]


class RatesWithoutWork(Tessellated):
    def rates(self, theta):
        return [r._replace(work=0.0) for r in super().rates(theta)]


class RatesUnsaid(Tessellated):
    def rates(self, theta):
        return [r._replace(setting="coarse") for r in super().rates(theta)]


class CoarseLoft(Loft):
    """Leaves out every other point of a section, and says that this is more work."""

    def rates(self, theta):
        def thinner(theta):
            return {**theta, "curves": theta["curves"][:, ::2]}

        def thinnest(theta):
            return {**theta, "curves": theta["curves"][:, ::4]}

        given = [(2, Loft(7, 6), thinner), (4, Loft(7, 3), thinnest)]
        return [Rate(f"points={s.points}", work, s, f) for work, s, f in given]


class Miscounted(Loft):
    """Forgets that a quadrilateral is two triangles."""

    @property
    def face_count(self):
        return (self.sections - 1) * self.points


def _pushed_wrong(operands, tangents, out):
    out[...] = 0.5 * (0 if tangents[0] is None else tangents[0])


SAME = Operation(
    "tests.same",
    lambda x: x,
    ranks=(2,),
    shape=lambda x: x,
    forward=lambda operands, out: np.copyto(out, operands[0]),
    push=_pushed_wrong,
    pull=lambda operands, g, results: np.copyto(results[0], g),
    differentiable=1,
    packed=(0,),
    packed_result=True,
)
"""The identity, whose derivative in forward mode is half of what it is in reverse mode."""


class HalfForward(Loft):
    """A colour of its own, wrong in forward mode; the example's shader does not read it."""

    def evaluate(self, theta, samples):
        gbuffer = super().evaluate(theta, samples)
        position = gbuffer["position"]
        gbuffer.defer("color", lambda: SAME(position))
        return gbuffer


class KeepsMisses(Heightfield):
    """Leaves samples on the triangles where rays miss the surface."""

    def refine(self, inputs, samples, rays):
        refined = super().refine(inputs, samples, rays)
        return refined.replace(depth=np.where(refined.row < 0, samples.depth, refined.depth), row=samples.row)


# ------------------------------------------------------------------------------------------- shaders and splatters


@dataclass(frozen=True)
class LongNormals(Toon):
    """Takes normals for unit vectors."""

    def __call__(self, theta, gbuffer, camera):
        normal = gbuffer["normal"]
        xp = namespace(normal)
        length = xp.sqrt(xp.sum(normal * normal, axis=1, keepdims=True) + 1e-20)
        rgba, shade = super().__call__(theta, gbuffer, camera), length / (1 + length)
        return xp.concat([rgba[:, :3] * shade, rgba[:, 3:]], axis=1)


def sunlit(theta, gbuffer, camera):
    """Lambert's law for a light whose direction is taken for a unit vector."""
    if "light" not in theta:
        raise rts.InputError("a sunlit surface needs theta['light']")
    light = theta["light"]
    xp = namespace(gbuffer["normal"], light["direction"])
    normal = rts.plugin_api.arrays.unit(gbuffer["normal"])
    shade = xp.clip(xp.sum(normal * light["direction"], axis=1, keepdims=True), 0.0, 1.0)
    return xp.concat([shade + 0 * normal, xp.ones_like(shade)], axis=1)


def shadowless(theta, gbuffer, camera):
    """Lambert's law without shadows."""
    light = {name: value for name, value in theta["light"].items() if name != "shadow"}
    return rts.plugin("rts.shaders", "lambert")()({**theta, "light": light}, gbuffer, camera)


class HalfOfThree(Multi):
    """Wrong in forward mode where there are three layers."""

    def image(self, splats):
        if splats.row.shape[0] < 3:
            return super().image(splats)
        return super().image(replace(splats, rgba=SAME(splats.rgba)))


class Indexing(Gauss5):
    """Takes samples by index though there are none."""

    def image(self, splats):
        namespace(splats.rgba).take(splats.rgba, splats.row[0, :1, 0] * 0, axis=0)
        return super().image(splats)


# ------------------------------------------------------------------------------------------------- where they are found


def of(surface):
    """A part of a surface: its class's example, with it in place of the example's."""
    return surface.part() if isinstance(surface, Ball) else type(surface).example().replace(surface=surface)


def torus(change):
    theta = {"radii": Torus.example().theta["radii"]}
    return rts.Part(with_normals(Torus(), change), theta, "lambert")


TINT = {"tint": np.array([0.9, 0.6, 0.2], np.float32)}
SUN = {"light": {"direction": np.array([0.6, 0.0, 0.8], np.float32)}}

NORMALS = {
    f"{how}, {of_what}": part(change)
    for how, change in {"leaning": leaning, "zero": nothing, "of another slope": flattened}.items()
    for of_what, part in {
        "heights": lambda change: of(with_normals(Heightfield(), change)),
        "a torus": torus,
    }.items()
}

SURFACES = {
    "the_surface_follows_theta": {
        "the wrong way": of(Ball(-1.0)),
        "too little": of(Ball(0.6)),
    },
    "triangles_have_their_corners_on_the_surface": {
        "too little": of(HalfFollowing(7, 12)),
        "kept on the object": of(Keeping()),
        "vertices kept on the object": of(KeepingCorners(7, 12)),
        "half of the faces": of(Miscounted(7, 12)),
        "leaning normals": of(with_normals(Loft(7, 12), leaning)),
        "normals of another slope": of(with_normals(Loft(7, 12), flattened)),
        "normals of zero": of(with_normals(Loft(7, 12), nothing)),
    },
    "triangles_are_made_anew_for_every_array_that_moves_them": {
        "an offset left out": Lifted.example(),
        "an offset remembered": Remembering.example(),
        "a factor left out": Scaled.example(),
    },
    "triangles_depend_on_the_view_only_with_a_key": {
        "one key": of(OneKey()),
        "the size alone": of(KeyOfSize()),
        "faces turned": of(TurnedDiagonals(7, 12)),
        "faces sorted": of(FacesInViewOrder(7, 12)),
    },
    "normals_stand_upright": {**NORMALS, "from the origin": torus(from_the_origin)},
    "tessellate_gives_a_mesh_on_the_surface": {
        "a cut more": of(OneCutMore()),
        "always as many": of(AlwaysFour()),
        "coarser at higher rates": of(Coarsening()),
        "off the surface": of(OffItsSurface()),
        "corners that are not there": of(FacesOfNothing()),
    },
    "rates_are_the_surface_coarser_or_finer": {
        "elsewhere": of(RatesElsewhere()),
        "without work": of(RatesWithoutWork()),
        "without a setting": of(RatesUnsaid()),
        "coarser for more work": of(CoarseLoft(7, 12)),
    },
    "forward_and_reverse_mode_agree": {"half in forward mode": of(HalfForward(7, 12)).replace(shader="normals")},
    "refine_keeps_samples_on_their_rays": {"misses kept": of(KeepsMisses())},
}
SHADERS = {
    "lengths_of_directions_have_no_effect": {"of normals": (LongNormals(), TINT), "of lights": (sunlit, SUN)},
    "shadows_dim_what_lights_add": {"none": (shadowless, SUN)},
}
SPLATTERS = {
    "engines_agree": {"half of three layers": HalfOfThree()},
    "no_rows_give_an_empty_image": {"by index": Indexing()},
}

SOUND = {
    "the_surface_follows_theta": of(Ball()),
    "triangles_depend_on_the_view_only_with_a_key": of(ByDistance()),
    "tessellate_gives_a_mesh_on_the_surface": of(Tessellated()),
    "rates_are_the_surface_coarser_or_finer": of(Tessellated()),
}
"""Check → what the plugins with that mistake are made of, without it."""
