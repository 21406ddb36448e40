"""The surface `mesh`: normals, attributes of vertices and corners, and that they are computed when read."""

import numpy as np
import pytest
from helpers import (
    ALL,
    CAMERA,
    DIFFERENTIABLE,
    FRONT,
    SIZE,
    arrays,
    gradient,
    icosphere,
    mesh_part,
    quad,
    refused,
    show,
    to_numpy,
)

import rts
from rts import GBuffer, Part

pytestmark = pytest.mark.rendering

Mesh = rts.plugin("surfaces", "mesh")


@pytest.mark.parametrize("target", ALL)
def test_smooth_normals_of_a_sphere_are_its_radii(target):
    vertices, faces = icosphere(3, 2.0)
    normals = to_numpy(Mesh(faces).vertex_normals(arrays(target, vertices)))
    np.testing.assert_allclose(normals, vertices / 2, atol=0.01)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-6)


def test_smooth_normals_of_a_flat_sheet_and_of_a_lone_vertex():
    vertices, faces = quad()
    vertices = np.concatenate([vertices, [(5, 5, 5)]]).astype(np.float32)
    normals = Mesh(faces).vertex_normals(vertices)
    np.testing.assert_array_equal(normals, [(0, 0, 1)] * 4 + [(0, 0, 0)])


def test_smooth_normals_follow_vertices_that_change_in_place():
    vertices, faces = quad()
    mesh = Mesh(faces)
    mesh.vertex_normals(vertices)
    vertices[:] = vertices[:, [2, 1, 0]]
    np.testing.assert_allclose(mesh.vertex_normals(vertices), [(-1, 0, 0)] * 4)


def test_given_normals_take_the_place_of_smooth_ones():
    tilted = np.broadcast_to(np.float32((0.6, 0, 0.8)), (4, 3))
    image = show(mesh_part(quad(-9, 9, -9, 9), shader="normals", theta={"normals": tilted}), FRONT)
    np.testing.assert_allclose(image[..., :3], np.broadcast_to((0.8, 0.5, 0.9), (*SIZE, 3)), atol=1e-6)


@pytest.mark.parametrize("target", ALL)
def test_vertex_attributes_are_interpolated_linearly_in_space(target):
    # A sheet that recedes: colour is the world coordinate, so each pixel shows where its ray meets the sheet.
    vertices = np.array([(-2, -2, -3), (2, -2, 1), (2, 2, 1), (-2, 2, -3)], np.float32)
    colors = np.clip((vertices + (2, 2, 3)) / 4, 0, 1)
    part, camera = arrays(target, (mesh_part((vertices, quad()[1]), shader="unlit", theta={"colors": colors}), CAMERA))
    image = show(part, camera, splatter="none")
    rays = CAMERA.rays(SIZE)
    # The sheet is z = x − 1.
    depth = (rays.origins[..., 0] - 1 - rays.origins[..., 2]) / (rays.directions[..., 2] - rays.directions[..., 0])
    points = rays.origins + depth[..., None] * rays.directions
    inside = image[..., 3] == 1
    assert inside.sum() > 100
    np.testing.assert_allclose(image[inside][:, :3], (points[inside] + (2, 2, 3)) / 4, rtol=0, atol=1e-5)


@pytest.mark.parametrize("target", ALL)
def test_attributes_of_corners_are_read_through_their_own_indices(target):
    vertices, faces = quad(-9, 9, -9, 9)
    # One colour for each triangle; uv of the second triangle differ at the shared vertices.
    part = mesh_part(
        (vertices, faces),
        indices={"colors": [(0, 0, 0), (1, 1, 1)], "heat": [(2, 2, 2), (0, 0, 0)], "uv": None},
        theta={
            "colors": np.array([(1.0, 0, 0), (0, 1.0, 0)]),
            "heat": np.array([(0.25,), (0.5,), (0.75,)]),
            "uv": np.zeros((4, 2)),
        },
        shader=heat_in_blue,
    )
    part, camera = arrays(target, (part, FRONT))
    image = show(part, camera, (20, 24), splatter="none")
    # The diagonal rises to the right, triangle 0 is below it.
    np.testing.assert_allclose(image[15, 15], (1, 0, 0.75, 1), atol=1e-6)
    np.testing.assert_allclose(image[5, 5], (0, 1, 0.25, 1), atol=1e-6)


def heat_in_blue(theta, gbuffer, camera):
    xp = rts.namespace(gbuffer["position"])
    color = gbuffer["color"]
    one = xp.ones_like(color[:, :1])
    return xp.concat([color[:, :2], gbuffer["heat"], one], axis=1)


def test_tables_of_attributes_are_those_that_were_given():
    _, faces = quad()
    table = [(1, 0, 0), (1, 1, 1)]
    mesh = rts.Mesh(faces, {"uv": table, "heat": None, "colors": faces})
    assert set(mesh.indices) == {"uv", "heat"} and mesh.indices["heat"] is None
    np.testing.assert_array_equal(mesh.indices["uv"], table)
    assert set(rts.Mesh(mesh.faces, mesh.indices).indices) == {"uv", "heat"} and rts.Mesh(faces).indices == {}


def test_vertices_beside_faces_are_told_where_they_belong():
    with pytest.raises(rts.InputError, match=r"\(T, 3\) integers. Vertices are no argument: Part\(Mesh\(faces\)"):
        rts.Mesh(*quad())


def test_more_rows_than_vertices_want_a_table():
    part = mesh_part(quad(), theta={"uv": np.zeros((6, 2))})
    with refused(r"theta\['uv'\] of a mesh has 6 rows, and there are 4 vertices; .* indices"):
        show(part)


def test_attributes_of_vertices_need_no_indices_but_their_name():
    part = mesh_part(
        quad(-9, 9, -9, 9),
        indices={"heat": None},
        theta={"heat": np.full((4, 1), 0.5), "colors": np.zeros((4, 3))},
        shader=heat_in_blue,
    )
    np.testing.assert_allclose(show(part, FRONT)[9, 9], (0, 0, 0.5, 1), atol=1e-6)


class CountingMesh(Mesh):
    def __init__(self, faces):
        super().__init__(faces)
        self.asked = 0

    def _smooth_normals(self, *given):
        self.asked += 1
        return super()._smooth_normals(*given)


@pytest.mark.parametrize("pose_only", [False, True], ids=["all differentiable", "only the transform differentiable"])
@pytest.mark.parametrize("target", ALL)
def test_normals_are_computed_only_for_a_shader_that_reads_them(target, pose_only):
    vertices, faces = icosphere(1)
    theta = {"vertices": vertices if pose_only else arrays(target, vertices)}
    transform, camera = arrays(target, (np.eye(4), CAMERA))
    for shader, asked in (("silhouette", 0), ("unlit", 0), ("depth", 0), ("lambert", 1)):
        mesh = CountingMesh(faces)
        rts.render(Part(mesh, theta, shader, transform), camera, SIZE)
        assert (mesh.asked > 0) == asked, shader


def test_a_deferred_attribute_is_computed_once_when_first_read():
    calls = []
    gbuffer = GBuffer(position=np.zeros((2, 3)))
    gbuffer.defer("normal", lambda: calls.append(1) or np.ones((2, 3)))
    assert "normal" in gbuffer and list(gbuffer) == ["position", "normal"] and calls == []
    np.testing.assert_array_equal(gbuffer["normal"], gbuffer["normal"])
    assert calls == [1]
    with pytest.raises(rts.InputError, match="reads 'uv'.*'position', 'normal'"):
        gbuffer["uv"]


@pytest.mark.parametrize("target", DIFFERENTIABLE)
def test_a_function_is_a_shader_and_its_theta_is_differentiable(target):
    def tinted(theta, gbuffer, camera):
        xp = rts.namespace(gbuffer["position"])
        one = xp.ones_like(gbuffer["position"])
        return xp.concat([one * theta["tint"] ** 2, one[:, :1]], axis=1)

    mesh, camera = quad(-9, 9, -9, 9), arrays(target, FRONT)
    part = mesh_part(mesh, shader=tinted)
    found = gradient(
        target,
        lambda tint: rts.render(part.replace(theta={**part.theta, "tint": tint}), camera, SIZE)[..., 1].sum(),
        arrays(target, np.array([0.1, 0.2, 0.3])),
    )
    np.testing.assert_allclose(found, (0, 2 * 0.2 * SIZE[0] * SIZE[1], 0), rtol=1e-5)
