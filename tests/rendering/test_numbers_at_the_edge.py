"""Numbers that are too large for places in the image: one error before any work; those at the limits are drawn."""

import numpy as np
import pytest
from helpers import quick

import rts
from rts.sampling.camera_checks import LARGEST as LARGEST_ENTRY
from rts.sampling.sample_checks import LARGEST as LARGEST_VERTEX
from rts_surfaces.mesh import Mesh

pytestmark = pytest.mark.rendering

SIZE = (16, 16)
CAMERA = rts.Camera.look_at((1, -3, 2), (0, 0, 0), aspect=1.0)
PART = Mesh.example()
HUGE = 3e38, 1e300
SAMPLERS = quick(["raster", "reference", "embree", "opengl"], 1)


def with_vertices(numbers):
    return PART.replace(theta={"vertices": numbers}, shader="normals")


def drawn(part, camera=CAMERA, **options):
    image = rts.render(part, camera, SIZE, **options)
    assert np.isfinite(image).all()


@pytest.mark.parametrize("sampler", SAMPLERS)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("size", [*HUGE, 1.01 * LARGEST_VERTEX])
def test_large_vertices_are_refused(size, dtype, sampler):
    if dtype == np.float32 and size > 1e39:
        pytest.skip("float32 ends before")
    for rows in slice(0, 1), slice(None):
        vertices = PART.theta["vertices"].astype(dtype)
        vertices[rows] = size * np.sign(vertices[rows])
        with pytest.raises(rts.InputError, match=r"vertices of Mesh\(20 faces\) reach .*expected at most 1e\+15"):
            rts.render(with_vertices(vertices), CAMERA, SIZE, sampler=sampler)


@pytest.mark.parametrize("sampler", SAMPLERS)
@pytest.mark.filterwarnings("ignore:nothing is seen", "ignore:the sampler", "ignore:triangles reach")
def test_vertices_and_entries_at_the_limits_are_drawn(sampler):
    vertices = PART.theta["vertices"].astype(np.float64)
    for rows in slice(0, 1), slice(None):
        far = vertices.copy()
        far[rows] *= LARGEST_VERTEX / 2
        drawn(with_vertices(far), sampler=sampler)
        for i, j in ((0, 3), (1, 3), (2, 3)):
            view = CAMERA.view.copy()
            view[i, j] = -LARGEST_ENTRY / 10
            drawn(with_vertices(far), CAMERA.replace(view=view), sampler=sampler)
            drawn(with_vertices(vertices), CAMERA.replace(view=view), sampler=sampler)


@pytest.mark.parametrize("place", [(0, 0), (0, 3), (2, 2), (2, 3)])
@pytest.mark.parametrize("size", [*HUGE, 1e160, 10 * LARGEST_ENTRY])
def test_large_entries_of_matrices_are_refused(size, place):
    transform = np.eye(4)
    transform[place] = size
    view, projection = CAMERA.view.copy(), CAMERA.projection.copy()
    view[place] = projection[place] = size
    cases = [
        (PART.replace(transform=transform), CAMERA, "transform of a part"),
        (PART, CAMERA.replace(view=view), "camera's view matrix"),
        (PART, CAMERA.replace(projection=projection), "camera's projection matrix"),
    ]
    for part, camera, what in cases:
        for parts in (part, [part, part]):
            with pytest.raises(rts.InputError, match=rf"{what}.* has an entry of size .*expected at most 1e\+18"):
                rts.render(parts, camera, SIZE)


def test_large_products_of_projection_and_view_are_refused():
    view, projection = CAMERA.view.copy(), CAMERA.projection.copy()
    view[0, 3], projection[0, 0] = 1e10, 1e10
    with pytest.raises(rts.InputError, match="product of the camera's projection and view has an entry of size "):
        rts.render(PART, CAMERA.replace(view=view, projection=projection), SIZE)


@pytest.mark.parametrize("name", ["bezier", "bspline", "subdivision"])
@pytest.mark.parametrize("whole", [False, True])
@pytest.mark.filterwarnings("ignore:overflow", "ignore:invalid value")
def test_large_control_points_are_refused(name, whole):
    part = rts.plugin("rts.surfaces", name).example()
    key = "vertices" if "vertices" in part.theta else "points"
    for size in HUGE:
        points = np.array(part.theta[key], np.float64)
        points.reshape(-1)[slice(None) if whole else slice(1)] = size
        with pytest.raises(rts.InputError):
            rts.render(part.replace(theta={**part.theta, key: points}), CAMERA, SIZE)
