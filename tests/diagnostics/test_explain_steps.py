"""`rts.explain` tells of shaders whose colours step inside a surface."""

import numpy as np
import pytest
from helpers import ALL, CAMERA, SIZE, arrays, box, icosphere

import rts

pytestmark = pytest.mark.rendering

BALL, FACES = icosphere(2)


def shader_of(share):
    """A shader whose colour goes by the share (N, 1) of one of two colours."""

    def shader(theta, gbuffer, camera):
        xp = rts.namespace(gbuffer["position"])
        way = share(xp, gbuffer, camera, {"edge": 0.2, **theta})
        return xp.concat([way, 1 - way, 0 * way, 0 * way + 1], axis=1)

    shader.opaque = True
    return shader


def where(xp, condition):
    return xp.where(condition, 1.0, 0.0) if xp is np else xp.astype(condition, xp.float32)


STEPS = {
    "uv": lambda xp, g, camera, theta: where(xp, g["uv"][:, :1] > 0.5),
    "rounding": lambda xp, g, camera, theta: xp.floor(4 * g["uv"][:, :1]) / 4,
    "across": lambda xp, g, camera, theta: where(xp, g["position"][:, 1:2] > theta["edge"]),
    "bands": lambda xp, g, camera, theta: xp.floor(0.5 + 2 * abs(g.unit("normal")[:, 1:2])) / 2,
}
SMOOTH = {
    "ramp": lambda xp, g, camera, theta: 1 / (1 + xp.exp(-40 * (g["uv"][:, :1] - 0.5))),
    "kink": lambda xp, g, camera, theta: abs(g["position"][:, 1:2]) / 2,
    "edge": lambda xp, g, camera, theta: 0 * g["uv"][:, :1] + theta["edge"],
    "normals": lambda xp, g, camera, theta: (1 + g.unit("normal")[:, :1]) / 2,
}


def remarks(target, shader):
    theta = {"vertices": BALL, "uv": 0.5 + 0.3 * BALL[:, :2]}
    part = rts.Part(rts.Mesh(FACES), arrays(target, theta), shader)
    return rts.explain(part, CAMERA, SIZE)[0].remarks


@pytest.mark.parametrize("target", ALL)
@pytest.mark.parametrize("kind", STEPS)
def test_a_step_is_told_with_its_remedy(kind, target):
    [remark] = remarks(target, shader_of(STEPS[kind]))
    assert "colours step inside the surface" in remark and "no derivative" in remark and "sigmoid" in remark


@pytest.mark.parametrize("target", ALL)
@pytest.mark.parametrize("kind", SMOOTH)
def test_nothing_is_told_of_smooth_colours(kind, target):
    assert remarks(target, shader_of(SMOOTH[kind])) == ()


def test_built_in_shaders_do_not_step():
    for name in ("lambert", "normals", "silhouette", "blinn_phong", "depth"):
        assert remarks("numpy", name) == ()


def test_sides_of_a_surface_may_have_colours_of_their_own():
    """An open tube: the outline between its outside and its inside is no step of its shader."""
    turn = 2 * np.pi * np.arange(24) / 24
    ring = np.stack([0.7 * np.cos(turn), 0 * turn, 0.7 * np.sin(turn)], 1)
    vertices, i = np.concatenate([ring - [0, 0.5, 0], ring + [0, 0.5, 0]]), np.arange(24)
    j = (i + 1) % 24
    faces = np.concatenate([np.stack([i, i + 24, j], 1), np.stack([j, i + 24, j + 24], 1)])

    def side(xp, g, camera, theta):
        return where(xp, (g["face_normal"] * camera.toward(g["position"])).sum(1)[:, None] > 0)

    part = rts.Part(rts.Mesh(faces), {"vertices": vertices}, shader_of(side))
    camera = rts.Camera.look_at((0, 2, 2.5), (0, 0, 0), fov_y=40)
    shown = rts.render(part, camera, SIZE)
    assert shown[..., 0].max() > 0.9 < shown[..., 1].max()
    assert rts.explain(part, camera, SIZE)[0].remarks == ()


def test_colours_that_go_on_along_each_wall_of_a_room_do_not_step():
    """Between walls that face one another, and through the inside of a solid, no colour is seen."""
    corners, faces = box(1.0)
    walls = corners[faces].reshape(-1, 3).astype(np.float32)  # No vertices in common: flat normals.
    part = rts.Part(rts.Mesh(np.arange(len(walls)).reshape(-1, 3)), {"vertices": walls}, shader_of(SMOOTH["normals"]))
    camera = rts.Camera.look_at((0.23, 0.11, 0.8), (0, 0, 0), fov_y=70)
    assert rts.explain(part, camera, SIZE)[0].remarks == ()
    inside = shader_of(lambda xp, g, camera, theta: where(xp, (g["position"] ** 2).sum(1)[:, None] < 0.5 * 0.49))
    theta = {"vertices": BALL, "uv": 0 * BALL[:, :2]}
    assert rts.explain(rts.Part(rts.Mesh(FACES), theta, inside), CAMERA, SIZE)[0].remarks == ()


def test_shaders_may_take_theta_for_the_dict_that_it_is():
    def shader(theta, gbuffer, camera):
        assert isinstance(theta, dict)
        mixed = theta.copy() | {"tint": np.float32(0.5)}
        return 0 * gbuffer["position"][:, :1] + mixed["tint"] * np.ones(4, np.float32)

    part = rts.Part(rts.Mesh(FACES), {"vertices": BALL}, shader)
    assert all("step" not in remark for remark in rts.explain(part, CAMERA, SIZE)[0].remarks)
