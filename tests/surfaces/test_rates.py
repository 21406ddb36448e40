"""Other rates of surfaces: tolerances, lattices, meshes of fewer faces."""

import numpy as np
import pytest
from helpers import DIFFERENTIABLE, arrays, icosphere, to_numpy

import rts

pytestmark = pytest.mark.rendering

CAMERA = rts.Camera.look_at((0, 0, 3), (0, 0, 0), fov_y=40)


def surface(name, *args, **options):
    return rts.plugin("surfaces", name)(*args, **options)


def changed(part, rate):
    theta = part.theta if rate.theta is None else rate.theta(part.theta)
    return part.replace(surface=rate.surface, theta=theta)


def area(part):
    """Covered share of the image; a unit sphere's outline has a closed form."""
    return rts.render(part, CAMERA, (128, 128), splatter="none", layers=1, supersample=2)[..., 3].mean()


DISK = np.pi * (np.tan(np.arcsin(0.8 / 3)) / np.tan(np.radians(20)) / 2) ** 2


@pytest.fixture(scope="module")
def sphere():
    pytest.importorskip("fast_simplification", reason="the extra `decimation` is not installed")
    vertices, faces = icosphere(5)
    vertices = (0.8 * vertices).astype(np.float32)
    return rts.Part(surface("mesh", faces), {"vertices": vertices, "colors": 0.5 + 0.5 * vertices}, "unlit")


class TestMesh:
    def test_fewer_faces(self, sphere):
        rates = sphere.surface.rates(sphere.theta)
        assert [r.setting for r in rates] == [f"faces={len(r.surface.faces)}" for r in rates]
        assert len(sphere.surface.faces) == 20480
        np.testing.assert_allclose([r.work for r in rates], [1 / 16, 1 / 4], rtol=0.01)
        for rate in rates:
            part = changed(sphere, rate)
            np.testing.assert_allclose(np.linalg.norm(part.theta["vertices"], axis=1), 0.8, atol=0.01)
            assert abs(area(part) / DISK - 1) < 0.02
            # Colours are those of a vertex nearby.
            assert np.abs(part.theta["colors"] - 0.5 - 0.5 * part.theta["vertices"]).max() < 0.08

    def test_attributes_of_other_names_stay(self, sphere):
        surface = rts.Mesh(sphere.surface.faces, indices={"features": None})
        theta = {"vertices": sphere.theta["vertices"], "features": sphere.theta["colors"]}

        def shader(theta, gbuffer, camera):
            return np.concatenate([gbuffer["features"], np.ones_like(gbuffer["features"][:, :1])], axis=1)

        shader.opaque = True
        part = changed(rts.Part(surface, theta, shader), surface.rates(theta)[0])
        image = rts.render(part, rts.Camera.look_at((0, 0, 3), (0, 0, 0)), (16, 16))
        np.testing.assert_allclose(image[8, 8], (0.5, 0.5, 0.9, 1), atol=0.08)

    def test_attributes_have_derivatives(self, sphere):
        torch = pytest.importorskip("torch")
        rate = sphere.surface.rates(sphere.theta)[0]
        colors = torch.tensor(sphere.theta["colors"], requires_grad=True)
        rate.theta({**sphere.theta, "colors": colors})["colors"].sum().backward()
        # Each vertex that is left passes on all of its derivative.
        assert colors.grad.sum() == 3 * rate.surface.faces.max() + 3

    def test_none_where_vertices_have_derivatives(self, sphere):
        torch = pytest.importorskip("torch")
        assert sphere.surface.rates({**sphere.theta, "vertices": torch.tensor(sphere.theta["vertices"])}) == ()

    def test_none_where_there_are_few_faces(self):
        example = rts.plugin("surfaces", "mesh").example()
        assert not list(example.surface.rates(example.theta))


def values_of_ball(count):
    axis = np.linspace(-1, 1, count)
    x, y, z = np.meshgrid(axis, axis, axis, indexing="ij")
    return (np.sqrt(x**2 + y**2 + z**2) - 0.8).astype(np.float32)


BOUNDS = ((-1, -1, -1), (1, 1, 1))


class TestIsosurface:
    def test_values(self):
        part = rts.Part(surface("isosurface", BOUNDS), {"values": values_of_ball(33)})
        rates = part.surface.rates(part.theta)
        assert [r.setting for r in rates] == ["shape=(9, 9, 9)", "shape=(17, 17, 17)"]
        np.testing.assert_allclose([r.work for r in rates], [(9 / 33) ** 3, (17 / 33) ** 3])
        errors = [abs(area(changed(part, r)) / DISK - 1) for r in rates]
        # Marching cubes are of second order.
        assert 2.5 < errors[0] / errors[1] < 6
        assert errors[1] < 0.01

    def test_values_that_do_not_divide(self):
        part = rts.Part(surface("isosurface", BOUNDS), {"values": values_of_ball(30)})
        assert part.surface.rates(part.theta) == []

    @pytest.mark.parametrize("target", DIFFERENTIABLE)
    def test_values_have_derivatives(self, target):
        part = rts.Part(surface("isosurface", BOUNDS), {"values": arrays(target, values_of_ball(9))})
        rate = part.surface.rates(part.theta)[-1]
        np.testing.assert_array_equal(to_numpy(rate.theta(part.theta)["values"]), values_of_ball(9)[::2, ::2, ::2])

    def test_function(self):
        def ball(theta, points):
            return rts.namespace(points).linalg.vector_norm(points, axis=-1) - theta["radius"]

        part = rts.Part(surface("isosurface", BOUNDS, 0.0, ball, (17, 17, 17)), {"radius": np.float32(0.8)})
        rates = part.surface.rates(part.theta)
        assert [r.setting for r in rates] == [f"shape=({n}, {n}, {n})" for n in (5, 9, 33)]
        assert part.surface.field.lattice(part.theta).shape == (17, 17, 17)
        assert abs(area(changed(part, rates[-1])) / DISK - 1) < 0.005


def test_tolerances():
    bezier = rts.plugin("surfaces", "bezier").example()
    rates = bezier.surface.rates(bezier.theta)
    assert [r.setting for r in rates] == ["tolerance=0.8", "tolerance=0.3", "tolerance=0.05"]
    faces = [len(r.surface.proxy(bezier.theta["points"], CAMERA.for_size((64, 64)), (64, 64)).faces) for r in rates]
    assert sorted(faces) == faces and faces[0] < faces[-1]
    assert bezier.surface.tolerance == 0.1
