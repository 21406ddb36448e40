"""Steps from a surface to its samples: lifting, refinement, tables, capacity, merging."""

import numpy as np
import pytest
from analytic import Ellipsoid
from helpers import DIFFERENTIABLE, TRIANGLE_SAMPLERS, arrays, icosphere, to_numpy

import rts
from rts import Camera, GBuffer, Part
from rts.arrays.engines import engine_of
from rts.contracts.records import ArraySpec, Cells
from rts.plugin_api.records import Fragments, Proxy, Samples
from rts.sampling.merging import merge
from rts.sampling.packing import pack_fragments

pytestmark = pytest.mark.sampling

CAMERA = Camera.look_at((0.3, 0.5, 4), (0, 0, 0), fov_y=40, near=1, far=10)
SIZE = (20, 24)


class Ball(rts.TriangleSurface):
    """A sphere of radius θ["radius"] (1,), tessellated coarsely and polished along the rays."""

    sample_widths = (1, 3)

    def __init__(self):
        self.vertices, self.faces = icosphere(1)

    def proxy_inputs(self, theta):
        return theta["radius"]

    def proxy(self, inputs, camera, size):
        # Larger than the ball, so that every ray that meets the ball meets the proxy.
        vertices = (1.2 * inputs[0] * self.vertices).astype(np.float32)
        faces = self.faces.astype(np.int32)
        ids = np.arange(len(faces), dtype=np.int32)[:, None]
        return Proxy(vertices, faces, ids, vertices[faces])

    def refine(self, inputs, samples, rays):
        o, d = rays.origins, rays.directions
        a, b, c = (d * d).sum(1), (o * d).sum(1), (o * o).sum(1) - inputs[0] ** 2
        square = b * b - a * c
        distance = (-b - np.sqrt(np.maximum(square, 0))) / a
        point = (o + distance[:, None] * d) / inputs[0]
        cells = samples.row.reshape(-1)
        missed = (cells >= 0) & (square[cells] <= 0)
        row = np.where(missed, -1, cells).reshape(samples.row.shape).astype(np.int32)
        depth = np.where(row >= 0, distance[row], 0).astype(np.float32)
        tables = {"squares": (point**2).astype(np.float32)}
        return Samples(samples.ids, point.astype(np.float32), Cells(row, depth), samples.overflow, tables)

    def table_specs(self, rows, capacity):
        return {"squares": ArraySpec((rows, 3), np.float32, packed=capacity is None, by_sample=True)}

    def evaluate(self, theta, samples):
        assert set(samples.tables) <= {"squares"}
        return GBuffer(position=samples.params * theta["radius"])


@pytest.mark.parametrize("faces", [np.zeros((0, 3), np.int32), np.array([[0, 1, 2]], np.int32)], ids=["none", "one"])
def test_there_is_one_row_where_nothing_is_hit_which_is_zeros_without_triangles(faces, monkeypatch):
    fragments = Fragments(np.full((1, 2, 2), -1, np.int32), np.zeros((1, 2, 2, 2)), np.zeros((1, 2, 2)))
    pack_fragments(fragments, proxy := Proxy(np.zeros((3, 3)), faces))  # Loops are compiled with NumPy as it is.
    monkeypatch.setattr(np, "empty", lambda shape, dtype=float: np.full(shape, 7, dtype))
    samples = pack_fragments(fragments, proxy)
    assert samples.ids.shape == (1, 3) and (samples.row == -1).all() and (len(faces) or (samples.ids == 0).all())


@pytest.mark.parametrize("sampler", TRIANGLE_SAMPLERS)
def test_refined_samples_lie_on_the_true_surface_and_in_the_centres_of_their_pixels(sampler):
    part = Part(Ball(), {"radius": np.array([0.9])})
    samples = rts.plugin("samplers", sampler)().sample(part, CAMERA, SIZE, 1)
    cells = np.argwhere(samples.row[0] >= 0)
    assert len(cells) > 50
    rows = samples.row[0][tuple(cells.T)]
    positions = part.surface.evaluate(part.theta, samples)["position"][rows]
    np.testing.assert_allclose(np.linalg.norm(positions, axis=1), 0.9, rtol=1e-6)
    found = CAMERA.project(positions, SIZE)
    np.testing.assert_allclose(found[:, :2], cells[:, ::-1] + 0.5, atol=1e-4)
    np.testing.assert_allclose(found[:, 2], samples.depth[0][tuple(cells.T)], rtol=1e-5)
    np.testing.assert_allclose(samples.tables["squares"][rows].sum(1), 1, rtol=1e-5)


@pytest.mark.parametrize("target", DIFFERENTIABLE)
def test_refinement_and_tables_work_on_every_engine(target):
    reference = rts.render(Part(Ball(), {"radius": np.array([0.9], np.float32)}), CAMERA, SIZE, layers=1)
    part = Part(Ball(), {"radius": arrays(target, np.array([0.9]))})
    np.testing.assert_allclose(to_numpy(rts.render(part, CAMERA, SIZE, layers=1)), reference, atol=1e-4)
    if target == "jax":
        import jax

        traced = jax.jit(lambda r: rts.render(Part(part.surface, {"radius": r}), CAMERA, SIZE, layers=1))
        np.testing.assert_allclose(traced(part.theta["radius"]), reference, atol=1e-4)


def test_a_surface_that_cannot_be_hashed_is_sampled_all_the_same():
    class Unhashable(Ball):
        __hash__ = None

    part = Part(Unhashable(), {"radius": np.array([0.9])})
    expected = rts.render(Part(Ball(), part.theta), CAMERA, SIZE, sampler="raster")
    np.testing.assert_array_equal(rts.render(part, CAMERA, SIZE, sampler="raster"), expected)


@pytest.mark.filterwarnings("ignore::rts.errors.EmptyImageWarning")
@pytest.mark.parametrize("sampler", TRIANGLE_SAMPLERS)
def test_a_surface_without_a_triangle_is_an_empty_picture(sampler):

    class Nothing(Ball):
        def proxy(self, inputs, camera, size):
            proxy = super().proxy(inputs, camera, size)
            return proxy._replace(vertices=proxy.vertices[:0], faces=proxy.faces[:0], ids=proxy.ids[:0])

    image = rts.render(Part(Nothing(), {"radius": np.array([0.9])}), CAMERA, SIZE, sampler=sampler)
    np.testing.assert_array_equal(image, np.zeros((*SIZE, 4)))


@pytest.mark.parametrize("kind", ["infinite", "reversed"])
@pytest.mark.parametrize("sampler", [*TRIANGLE_SAMPLERS, "rays"])
def test_projections_with_an_infinite_far_plane_or_reversed_z_show_the_same(sampler, kind):
    projection = CAMERA.projection.copy()
    projection[2] = [0, 0, -1, -2] if kind == "infinite" else -projection[2]
    theta = {"center": np.zeros(3), "radii": np.ones(3)} if sampler == "rays" else {"radius": np.array([0.9])}
    part = Part(Ellipsoid() if sampler == "rays" else Ball(), theta)
    expected = rts.render(part, CAMERA, SIZE, sampler=sampler)
    assert expected.sum() > 100
    image = rts.render(part, CAMERA.replace(projection=projection), SIZE, sampler=sampler)
    np.testing.assert_allclose(image, expected, atol=1e-6)


@pytest.mark.parametrize("sampler", TRIANGLE_SAMPLERS)
def test_a_vertex_far_away_that_no_triangle_refers_to_has_no_effect(sampler):
    vertices, faces = icosphere(2)
    mesh = rts.plugin("surfaces", "mesh")(faces)
    expected = rts.render(Part(mesh, {"vertices": vertices}), CAMERA, SIZE, sampler=sampler)
    stray = np.concatenate([vertices, [[1e7, 1e7, 1e7]]])
    image = rts.render(Part(mesh, {"vertices": stray}), CAMERA, SIZE, sampler=sampler)
    np.testing.assert_allclose(image, expected, atol=1e-5)


@pytest.mark.parametrize("target", ["numpy", *DIFFERENTIABLE])
def test_parts_are_interleaved_alike_on_the_host_and_in_array_code(target, monkeypatch):
    rng = np.random.default_rng(0)
    parts = []
    for layers in (2, 3, 1):
        covered = np.logical_and.accumulate(rng.random((layers, 6, 7)) < 0.7, axis=0)
        depth = np.where(covered, np.sort(rng.integers(1, 6, covered.shape), axis=0), 0).astype(np.float32)
        row = np.full(covered.shape, -1, np.int32)
        row[covered] = rng.permutation(covered.sum())
        count = int(covered.sum())
        fields = np.zeros((count, 3), np.int32), np.zeros((count, 2), np.float32), Cells(row, depth), np.int32(0)
        parts.append(Samples(*(arrays(target, x) for x in fields)))
    for layers in (1, 3, 6):
        host = to_numpy(merge(parts, layers))
        with monkeypatch.context() as patch:
            patch.setattr(type(engine_of(parts[0].row)), "on_host", lambda *_: False)
            array_code = to_numpy(merge(parts, layers))
        compared = [(host, array_code)]
        if target == "jax":
            import jax

            compared.append((host, to_numpy(jax.jit(merge, static_argnums=1)(parts, layers))))
        for found, expected in compared:
            for name in ("part", "row", "depth"):
                np.testing.assert_array_equal(getattr(found, name), getattr(expected, name), err_msg=name)


@pytest.mark.thorough
def test_the_parts_of_batched_samples_are_those_of_each():
    jax = pytest.importorskip("jax")
    vertices, faces = icosphere(1)
    mesh = rts.plugin("surfaces", "mesh")(faces)
    behind = Part(mesh, {"vertices": (vertices - (0.5, 0, 1)).astype(np.float32)})

    def sampled(move):
        return rts.sample(
            [Part(mesh, {"vertices": vertices.astype(np.float32) + move}), behind],
            CAMERA,
            SIZE,
            splatter=None,
            layers=2,
        )

    moves = jax.numpy.asarray([(0, 0, 0), (0.4, 0.2, 0)], dtype=np.float32)
    batch = to_numpy(jax.vmap(sampled)(moves).part)
    assert set(np.unique(batch)) == {-1, 0, 1}
    for found, move in zip(batch, moves, strict=True):
        np.testing.assert_array_equal(found, to_numpy(sampled(move).part))
