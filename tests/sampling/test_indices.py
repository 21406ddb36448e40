"""No index is followed that was not looked at: what refers to nothing is refused, wherever it comes from."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from helpers import ALL, DIFFERENTIABLE, arrays, quad, refused, to_numpy

import rts
from rts import splatting
from rts.operations.combine import COMBINE, combine, interpolate
from rts.operations.linear import AFFINE
from rts.operations.projection import PROJECTION
from rts.operations.take import take
from rts.plugin_api.records import Fragments, Proxy
from rts.rendering.samples import sample
from rts.sampling.merging import merge
from rts.sampling.packing import pack_fragments
from rts.scene.rigid import RIGID

pytestmark = pytest.mark.sampling

KINDS = [splatting.Plain, splatting.Single, splatting.Multi, splatting.Edges]
POSITIONS, WHITE = np.array([(0.5, 0.5, 1.0), (1.5, 0.5, 1.0)]), np.ones((2, 4))
of_every_kind = pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)


def rows(value, dtype=np.int32):
    return np.array([[[0, value]]], dtype)


# ------------------------------------------------------------------------------------------------ splatters


@pytest.mark.parametrize("target", ALL)
@pytest.mark.parametrize("value", [2, -2, 10**8, -(10**9)])
@of_every_kind
def test_rows_of_no_sample_are_refused(kind, value, target):
    given = arrays(target, (POSITIONS, WHITE)), arrays(target, rows(value))
    with refused(f"row refers to sample {value}"):
        kind().splat(*given[0], given[1])


@pytest.mark.parametrize("value", [2**32, 2**32 + 1, -(2**32), -(2**32) + 1])
@of_every_kind
def test_rows_of_no_sample_are_refused_where_they_would_wrap_around(kind, value):
    with refused(f"row refers to sample {value}"):
        kind().splat(POSITIONS, WHITE, rows(value, np.int64))


@of_every_kind
def test_of_no_samples_none_can_be_referred_to(kind):
    empty = np.zeros((0, 3)), np.zeros((0, 4))
    with refused("row refers to sample 0 of 0"):
        kind().splat(*empty, rows(-1))
    assert not kind().splat(*empty, np.full((1, 1, 2), -1, np.int32)).any()


# ----------------------------------------------------------------------------------------------- operations


POINTS, WEIGHTS = np.arange(12.0).reshape(4, 3), np.full((2, 3), 0.25)


@pytest.mark.parametrize("target", ALL)
@pytest.mark.parametrize("wrong", [-1, 4, 2**31 - 1, -(2**31)])
@pytest.mark.parametrize("name", ["combine", "interpolate", "take"])
def test_ids_of_no_row_are_refused(name, wrong, target):
    ids = np.array([(0, 1, 2), (1, wrong, 3)], np.int32)
    points, weights, ids = arrays(target, (POINTS, WEIGHTS, ids))
    calls = {
        "combine": lambda: combine(points, ids, weights),
        "interpolate": lambda: interpolate(points, ids, 0, weights),
        "take": lambda: take(points, ids[1]),
    }
    with refused("refer to row|were asked for"):
        calls[name]()


@pytest.mark.parametrize("target", [t for t in DIFFERENTIABLE if t.startswith("torch")])
@pytest.mark.parametrize("wrong", [-1, 4])
def test_ids_of_no_row_are_refused_by_the_specification(wrong, target):
    torch = pytest.importorskip("torch")
    ids = torch.tensor([(0, 1, 2), (1, wrong, 3)])
    points, weights = (torch.tensor(x, dtype=torch.bfloat16) for x in (POINTS, WEIGHTS))
    for call in (lambda: combine(points, ids, weights), lambda: take(points, ids[1])):
        with refused("were asked for"):
            call()


@pytest.mark.parametrize("name", ["combine", "interpolate", "take"])
def test_ids_of_no_row_are_refused_inside_jit_and_their_gradients_stay_in_bounds(name):
    jax = pytest.importorskip("jax")
    points, weights = arrays("jax", (POINTS, WEIGHTS))

    def call(points, ids):
        if name == "take":
            return take(points, ids[1])
        return combine(points, ids, weights) if name == "combine" else interpolate(points, ids, 0, weights)

    for wrong in (-1, 4, 2**31 - 1):
        ids = jax.numpy.asarray([(0, 1, 2), (1, wrong, 3)])
        with pytest.raises(Exception, match=r"refer to row|were asked for"):
            jax.block_until_ready(jax.jit(call)(points, ids))
        # A gradient alone need not ask for the value; then nothing comes of what is out of bounds.
        found = jax.jit(jax.grad(lambda x, i: call(x, i).sum()))(points, ids)
        assert np.isfinite(to_numpy(found)).all()


@pytest.mark.parametrize("column", [-1, 1, 5])
def test_columns_that_are_not_there_are_refused(column):
    ids = np.zeros((2, 3), np.int32)
    with refused("sample this surface anew"):
        interpolate(POINTS, ids, column, WEIGHTS)
    for options in ({"column": column, "count": 3, "affine": True}, {"column": 0, "count": 4, "affine": False}):
        with refused("ids and weights have shapes"):
            COMBINE(POINTS, WEIGHTS, ids, **options)


@pytest.mark.parametrize("target", DIFFERENTIABLE)
@pytest.mark.parametrize(
    "operation, shapes",
    [
        (AFFINE, ((4, 3), (5, 3))),
        (AFFINE, ((4, 4), (5, 2))),
        (PROJECTION, ((3, 4), (5, 3))),
        (PROJECTION, ((4, 4), (5, 2))),
        (RIGID, ((5,), (3,))),
        (RIGID, ((6,), (2,))),
    ],
)
def test_operands_that_are_too_small_are_refused(operation, shapes, target):
    with refused("have shapes .* expected"):
        operation(*arrays(target, [np.ones(shape) for shape in shapes]))


# ------------------------------------------------------------------------------------------------- sampling


MESH = rts.plugin("rts.surfaces", "mesh")
CAMERA = rts.Camera.look_at((0, 0, 3), (0, 0, 0), aspect=1.0)
SIZE = (8, 8)


def card(z):
    vertices, faces = quad(z=z)
    return rts.Part(MESH(faces), {"vertices": vertices, "colors": np.ones_like(vertices)}, "unlit")


def of(raster, change):
    """A sampler that does as the rasterizer, but for a change of what it finds."""

    class Wrong(rts.plugin("rts.samplers", "raster")):
        if raster:

            def rasterize(self, *args):
                return change(super().rasterize(*args))
        else:

            def sample(self, *args):
                return change(super().sample(*args))

    return Wrong()


@pytest.mark.parametrize("wrong", [-2, -(2**31), 2, 2**31 - 1])
def test_triangles_that_are_not_there_are_refused(wrong):
    def change(fragments):
        ids = fragments.triangle_ids.copy()
        ids[0, 4, 4] = wrong
        return fragments._replace(triangle_ids=ids)

    with refused(
        f"the sampler gave triangle {wrong}" if wrong < 0 else f"rasterize of Wrong returned triangle {wrong} of 2"
    ):
        rts.render(card(0.0), CAMERA, SIZE, sampler=of(True, change))


def test_triangles_that_are_not_there_are_refused_when_they_are_packed():
    ids = np.full((1, 1, 2), -7, np.int32)
    with refused("triangle -7 to a cell"):
        pack_fragments(Fragments(ids, np.zeros((*ids.shape, 2)), np.zeros(ids.shape)), Proxy(*quad()))


def shifted(samples, by):
    return samples.replace(row=np.where(samples.row >= 0, samples.row + by, -1).astype(np.int32))


@pytest.mark.parametrize("splatter", ["none", "single", "multi", "edges"])
@pytest.mark.parametrize("count", [1, 2])
def test_rows_that_a_sampler_has_not_packed_are_refused(count, splatter):
    parts = [card(-0.5 * i) for i in range(count)]
    sampler = of(False, partial(shifted, by=9))
    with refused("row .*refers to sample .*(sample this scene anew|expected indices)"):
        rts.render(parts if count > 1 else parts[0], CAMERA, SIZE, sampler=sampler, splatter=splatter)


def test_rows_of_another_part_are_refused_when_parts_are_merged():
    sampler = rts.plugin("samplers", "raster")()
    samples = [sampler.sample(card(z), CAMERA, SIZE, layers=2) for z in (0.0, -0.5)]
    last = len(samples[0].ids) - 1
    merge(samples, 2)
    with refused(f"row of part 0 refers to sample {last + 1} of {last + 1}"):
        merge([shifted(samples[0], 1), samples[1]], 2)


@pytest.mark.parametrize("target", ALL)
@pytest.mark.parametrize("splatter", ["none", "single", "multi", "edges"])
@pytest.mark.parametrize("wrong", ["row", "ids", "negative ids"])
def test_samples_made_by_hand_are_looked_at(wrong, splatter, target):
    part = card(0.0)
    sampled = sample(part, CAMERA, SIZE, splatter=splatter)
    own = sampled.samples[0]
    if wrong == "row":
        row = sampled.row + np.int32(len(own.ids)) * (sampled.row >= 0)
        sampled = sampled.replace(row=row.astype(np.int32))
    else:
        ids = own.ids.copy()
        ids[3, 1] = 4 if wrong == "ids" else -1
        sampled = replace(sampled, samples=(replace(own, ids=ids),))
    part = part.replace(theta=arrays(target, dict(part.theta)))
    with refused("refers? to"):
        rts.render_samples(sampled, part, CAMERA, splatter=splatter)
