"""Shadows: closed forms of their edges and derivatives, no shadow of a surface on itself, and lights that cast them."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch

import rts
from rts import shadows
from rts.operations.coverage import COVERAGE
from rts.operations.depth_limits import FAR, NEARER
from rts.operations.depth_planes import PLANES
from rts.testing import OperationConformance
from rts_diagnostics.example_shapes import box, icosphere

pytestmark = pytest.mark.rendering

SIZE = 64
FLOOR = np.array([[-3, 0, -3], [3, 0, -3], [3, 0, 3], [-3, 0, 3]], np.float32)
SQUARE = np.array([[0, 2, 1], [0, 3, 2]], np.int32)


def part(vertices, faces, shader="lambert", **entries):
    return rts.Part(rts.Mesh(np.asarray(faces, np.int32)), {"vertices": vertices, **entries}, shader)


def grid(x, z, count=(401, 61)):
    """Points of the floor (N, 3), and the area of each."""
    xs, zs = np.linspace(*x, count[0]), np.linspace(*z, count[1])
    points = np.stack(np.broadcast_arrays(xs[None, :], 0.0, zs[:, None]), axis=-1).reshape(-1, 3)
    return points, (xs[1] - xs[0]) * (zs[1] - zs[0])


def camera_of(light, point):
    """The camera of a light at (3,), or in this direction."""
    if point:
        return rts.Camera.look_at(light, [0, 0, 0], fov_y=60, aspect=1.0)
    toward = 6 * light / torch.linalg.norm(light)
    return rts.Camera.orthographic(toward, torch.zeros(3, dtype=light.dtype), height=5.0, aspect=1.0, far=12.0)


def card(angle):
    """A card at height 1 whose edge passes x = 0.013 at this angle."""
    a = np.deg2rad(angle)
    turn = np.array([[np.cos(a), 0, -np.sin(a)], [0, 1, 0], [np.sin(a), 0, np.cos(a)]])
    return np.array([[-4, 1, -4], [0.013, 1, -4], [0.013, 1, 4], [-4, 1, 4]]) @ turn.T


@pytest.mark.parametrize("point", [False, True], ids=["distant", "point"])
@pytest.mark.parametrize("moved", ["occluder", "light", "receiver"])
def test_a_shadow_edge_lies_and_moves_as_the_closed_form(moved, point):
    light, points, angle = (
        np.array([0.8, 4.0, 0.5] if point else [0.3, 1.0, 0.2]),
        *grid((-1.5, 1.5), (-0.5, 0.5))[:1],
        17,
    )

    def edge(t, z):
        """The x of the edge on the floor at z: the place where the ray to the light passes the card's edge."""
        place, y = light + np.array([t * (moved == "light"), 0, 0]), t * (moved == "receiver")
        a, start = np.deg2rad(angle), 0.013 + np.cos(np.deg2rad(angle)) * t * (moved == "occluder")
        share = (1 - y) / (place[1] - y * point)
        keep = 1 - share if point else 1.0
        # x · keep + place.x · share, and so z, lie on the edge: x cos + z sin = start.
        across = np.cos(a) * keep
        return (start - (z * keep + place[2] * share) * np.sin(a) - place[0] * share * np.cos(a)) / across

    def share(t):
        along = torch.tensor([1.0, 0, 0], dtype=torch.float64) * t
        up = torch.tensor([0.0, 1, 0], dtype=torch.float64) * t
        occluder = torch.tensor(card(angle)) + along * (moved == "occluder")
        floor = torch.tensor(FLOOR, dtype=torch.float64) + up * (moved == "receiver")
        camera = camera_of(torch.tensor(light) + along * (moved == "light"), point)
        seen = shadows.seen_from([part(occluder, SQUARE), part(floor, SQUARE)], camera, (SIZE, SIZE))
        return shadows.visibility(seen, torch.tensor(points) + up * (moved == "receiver"), outside=1.0)

    value, change = torch.func.jvp(share, (torch.tensor(0.0).double(),), (torch.tensor(1.0).double(),))
    z, step = points.reshape(61, 401, 3)[:, 0, 2], 3.0 / 400
    cell = 5 / SIZE
    places = 1.5 - value.numpy().reshape(61, 401).sum(1) * step
    assert abs(np.mean(places - edge(0, z))) < 0.1 * cell
    speed = (edge(1e-5, z) - edge(-1e-5, z)) / 2e-5
    found = -change.numpy().reshape(61, 401).sum(1) * step
    assert found.sum() / speed.sum() == pytest.approx(1, abs=0.03)


@pytest.mark.parametrize("shape", ["disk", "sphere"])
def test_a_shadow_grows_at_its_edge_alone(shape):
    if shape == "disk":
        turn = np.linspace(0, 2 * np.pi, 200, endpoint=False)
        ring = np.stack([np.cos(turn), 0 * turn, np.sin(turn)], axis=1)
        vertices, faces = np.concatenate([[[0, 0, 0]], ring]), [[0, 1 + i, 1 + (i + 1) % 200] for i in range(200)]
    else:
        vertices, faces = icosphere(4)
    points, area = grid((-1.2, 1.2), (-1.2, 1.2), (201, 201))

    def share(r):
        parts = [part(r * torch.tensor(vertices) + torch.tensor([0, 1.0, 0]), faces), part(torch.tensor(FLOOR), SQUARE)]
        seen = shadows.seen_from(parts, camera_of(torch.tensor([0.0, 1, 1e-4]).double(), False), (SIZE, SIZE))
        return shadows.visibility(seen, torch.tensor(points))

    value, change = torch.func.jvp(share, (torch.tensor(0.8).double(),), (torch.tensor(1.0).double(),))
    assert (1 - value).sum().item() * area == pytest.approx(np.pi * 0.8**2, rel=0.01)
    assert -change.sum().item() * area == pytest.approx(2 * np.pi * 0.8, rel=0.05)
    inside = np.hypot(points[:, 0], points[:, 2]) < 0.8 - 3 * 5 / SIZE
    assert not change[inside].any() and value[inside].max() < 1e-9


@pytest.mark.parametrize("shape", ["sphere", "box"])
@pytest.mark.parametrize("angle", [5, 25, 45, 65, 85])
def test_a_convex_body_does_not_shade_itself(shape, angle):
    vertices, faces = icosphere(4) if shape == "sphere" else box([-1, -1, -1], [1, 1, 1])
    a = np.deg2rad(angle)
    direction = np.array([0.8 * np.cos(a), np.sin(a), 0.6 * np.cos(a)])
    body = part(vertices.astype(np.float32), faces)
    lit = shadows.with_shadows(body, {"direction": direction}, size=SIZE)[0].theta["light"]["shadow"][0]
    corners = vertices[faces]
    weights = np.random.default_rng(0).dirichlet([1, 1, 1], (len(faces), 20000 // len(faces)))
    points = np.einsum("fks,fsc->fkc", weights, corners)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    cosines = (normals / np.linalg.norm(normals, axis=1, keepdims=True)) @ direction
    share = shadows.visibility(lit, points.reshape(-1, 3).astype(np.float32)).reshape(points.shape[:2])
    loss = np.clip(cosines, 0, None)[:, None] * (1 - share)
    assert loss.sum() < 0.005 * np.clip(cosines, 0, None).sum() * share.shape[1]
    assert share[cosines > 0.4].min() > 0.99


def test_a_shadow_begins_where_a_sphere_touches_the_floor():
    vertices, faces = icosphere(4)
    scene = [part((vertices + [0, 1, 0]).astype(np.float32), faces), part(FLOOR, SQUARE)]
    light = {"direction": np.array([1.0, 1.0, 0.0])}
    lit = shadows.with_shadows(scene, light, size=256)[0].theta["light"]["shadow"][0]
    along = np.linspace(-0.5, 0.6, 221)
    share = shadows.visibility(lit, np.stack([along, 0 * along, 0 * along], axis=1).astype(np.float32))
    # The shadow is an ellipse about (−1, 0), of half axes √2 and 1, whose end is at √2 − 1.
    assert share[along > 0.53].min() > 0.99
    assert share[np.abs(along) < 0.29].max() < 0.01


def test_light_is_dimmed_by_alpha_and_averaged():
    glass = rts.plugin("rts.shaders", "unlit")(opaque=False)
    plate = part(FLOOR * 0.5 + np.float32([0, 1, 0]), SQUARE, glass, color=np.float32([1, 0, 0, 0.25]))
    lower = plate.replace(theta={**plate.theta, "vertices": plate.theta["vertices"] - np.float32([0, 0.5, 0])})
    camera = rts.Camera.orthographic([0, 5, 0], [0, 0, 0], height=8, aspect=1.0, far=10)
    points = np.float32([[0, 0, 0], [0, 0.7, 0], [0, 2, 0], [9, 0, 0], [0, 6, 0]])
    floor = part(FLOOR, SQUARE)
    one = shadows.seen_from([plate, floor], camera, (SIZE, SIZE))
    np.testing.assert_allclose(shadows.visibility(one, points), [0.75, 0.75, 1, 0, 0], atol=1e-5)
    two = shadows.seen_from([plate, lower, floor], camera, (SIZE, SIZE))
    np.testing.assert_allclose(shadows.visibility(two, points, 1.0), [0.75**2, 0.75, 1, 1, 1], atol=1e-5)
    for shadow, expected in ((one, 0.75), (two, 0.75**2), ([one, two], (0.75 + 0.75**2) / 2), (None, 1)):
        light = {"direction": np.float32([0, 1, 0]), "color": np.float32([1, 1, 1]), "ambient": 0.0, "shadow": [shadow]}
        for shader in ("lambert", "blinn_phong", "pbr"):
            shaded = [
                rts.render(
                    part(FLOOR, SQUARE, shader, light=x, specular=np.float32(0)),
                    rts.Camera.orthographic([0, 5, 0], [0, 0, 0], height=1),
                    (4, 4),
                )
                for x in (light, {**light, "shadow": [None]})
            ]
            np.testing.assert_allclose(shaded[0][..., 0] / shaded[1][..., 0], expected, atol=1e-4)


def test_a_light_among_the_parts_sees_all_around():
    vertices, faces = icosphere(3)
    places = 2 * np.concatenate([np.eye(3), -np.eye(3)])[[0, 3, 5]]
    scene = [part((0.4 * vertices + p).astype(np.float32), faces) for p in places]
    light = {"position": np.zeros(3), "intensity": np.ones(3)}
    lit = shadows.with_shadows(scene, light, size=SIZE)[0].theta["light"]["shadow"][0]
    assert len(lit.pictures) == 6
    points = np.float32([[3, 0, 0], [-3, 0, 0], [0, 0, -3], [0, 0, 3], [0, 3, 0], [1.5, 0, 0], [2, 2, 2]])
    np.testing.assert_allclose(shadows.visibility(lit, points), [0, 0, 0, 1, 1, 1, 1], atol=1e-6)


def test_nothing_hides_nothing():
    behind = rts.Camera.look_at([0, 5, 0], [0, 9, 0])
    seen = shadows.seen_from(part(FLOOR, SQUARE), behind, (8, 8))
    np.testing.assert_array_equal(shadows.visibility(seen, np.float32([[0, 9, 0], [0, 0, 0]])), [1, 0])


def pictured(engine, shift, direction):
    """The image of a sphere's shadow on the floor."""
    vertices, faces = icosphere(2)
    ball = part(engine(0.5 * vertices) + shift + engine([0, 1, 0]), faces)
    scene = [part(engine(FLOOR), SQUARE), ball]
    lit = shadows.with_shadows(scene, {"direction": direction, "ambient": 0.2}, size=32, bounds=((0, 0, 0), 4.3))
    return rts.render(lit, rts.Camera.look_at([0, 6, 4], [0, 0, 0]), (24, 24))


@pytest.mark.thorough
def test_engines_agree():
    shift, direction = np.float32([0.1, 0.0, 0.2]), np.float32([0.6, 1.0, 0.3])
    weights = np.random.default_rng(0).standard_normal((24, 24, 4)).astype(np.float32)

    def to_torch(x):
        return torch.tensor(np.asarray(x, np.float32))

    def to_jax(x):
        return jnp.asarray(np.asarray(x, np.float32))

    expected = (pictured(lambda x: np.asarray(x, np.float32), shift, direction) * weights).sum()
    at = [to_torch(x).requires_grad_() for x in (shift, direction)]
    value = (pictured(to_torch, *at) * to_torch(weights)).sum()
    value.backward()
    assert value.item() == pytest.approx(expected, rel=1e-4)

    def loss(a, b):
        return (pictured(to_jax, a, b) * weights).sum()

    value, gradient = jax.jit(jax.value_and_grad(loss, (0, 1)))(to_jax(shift), to_jax(direction))
    assert float(value) == pytest.approx(expected, rel=1e-4)
    for a, b in zip(gradient, at, strict=True):
        np.testing.assert_allclose(a, b.grad, rtol=1e-3, atol=1e-3 * abs(b.grad).max())


@pytest.mark.thorough
@pytest.mark.parametrize("unknown", ["light", "place"])
def test_a_shadow_tells_the_light_and_what_casts_it(unknown):
    """A sphere outside of the picture is seen by its shadow alone."""
    vertices, faces = icosphere(2)

    def scene(p):
        ball = part(torch.tensor(0.5 * vertices).float() + p["place"], faces)
        light = {"direction": torch.cat([p["light"][:1], torch.ones(1), p["light"][1:]]), "ambient": 0.2}
        return shadows.with_shadows([part(FLOOR, SQUARE), ball], light, size=256, bounds=((0, 0, 0), 4.5))

    # Just the floor is in view.
    camera = rts.Camera.orthographic([0, 0.5, 0], [0, 0, 0], height=3.0, aspect=1.0)
    truth = {"place": torch.tensor([0.9, 2.0, 0.7]), "light": torch.tensor([0.5, 0.3])}
    target = rts.render(scene(truth), camera, (48, 48)).detach()
    start = {"place": torch.tensor([1.2, 2.0, 0.45]), "light": torch.tensor([0.62, 0.18])}
    free = {unknown: start[unknown]}
    loss = rts.ImageResiduals(lambda p: scene({**truth, **p}), camera, (48, 48), target)
    found = rts.fit(loss, free, method="lm", steps=25)
    axes = [0, 1] if unknown == "light" else [0, 2]
    assert (
        np.abs((found.parameters[unknown] - truth[unknown]).numpy()[axes]).max() < 2 * 1.05 * 4.5 / 256
    )  # A pixel of the light's picture.


@pytest.mark.parametrize("size", [64, 996])
def test_even_depths_count_from_what_is_seen(size):
    """And not from empty cells around it, however many there are; else a float's digits would not tell depths there."""
    far = rts.Camera.look_at((0, 500, 0.1), (0, 0, 0), fov_y=4, near=0.01, far=1000)
    card = part(FLOOR, SQUARE)
    (numpy,) = shadows.seen_from(card, far, (size, size)).pictures
    (traced,) = jax.jit(lambda v: shadows.seen_from(part(v, SQUARE), far, (size, size), capacity=2**20))(FLOOR).pictures
    for found in (numpy, traced):
        assert abs(float(found.lens[2]) - 500) < 1


def test_compiled_planes_are_the_specification():
    """Two smooth bodies over a slope, with holes; through a perspective lens."""
    y, x = np.mgrid[:40, :50] + 0.5
    depth = 30 + 0.3 * x - 0.1 * y
    for center, radius in (((15, 20), 12.2), ((30, 18), 8.1)):
        height = radius**2 - (x - center[0]) ** 2 - (y - center[1]) ** 2
        depth = np.where(height > 0, 20 - np.sqrt(abs(height)), depth)
    row = np.where(np.random.default_rng(0).random(depth.shape) > 0.95, -1, 1).astype(np.int32)
    for lens in ([1.0, 0.0, 25.0, 1.0, 1.0], [0.0, 0.05, 25.0, 1.0, 1.2]):
        found = PLANES(depth, row, np.array(lens))
        np.testing.assert_allclose(found, PLANES.specification(depth, row, np.array(lens)), atol=1e-9)
        assert (found[1] > 0).sum() == (row >= 0).sum()


class TestCoverage(OperationConformance):
    @pytest.fixture
    def operation(self):
        return COVERAGE

    @pytest.fixture
    def operands(self):
        rng = np.random.default_rng(0)
        height, width = 9, 11
        near = rng.random((height, width)) < 0.4
        planes = np.zeros((9, height, width))
        planes[0] = np.where(near, rng.uniform(-1, 0, (height, width)), 8.0) + 0.2 * np.arange(width)
        planes[1], planes[2] = rng.random((height, width)) < 0.9, 0.2
        planes[4:8] = rng.uniform(0, 1, (4, height, width))
        limit = planes[0] + NEARER * (1 + 0.2) - 0.2 * (np.arange(width) + 0.5)
        planes[8] = np.where(planes[1] > 0, limit, FAR)
        # Some of them beside the picture, some before its near plane.
        points = np.stack([rng.uniform(-1, 8, 40), rng.uniform(-1, 6, 40), np.zeros(40)], axis=1)
        points[:, 2] = 1 / (1 / 3 - (8.0 + 0.2 * (points[:, 0] + 1.5)) / 24)
        points[::9, 2] = 0.1
        samples = np.concatenate([np.zeros((height * width, 2)), rng.uniform(0.2, 0.9, (height * width, 1))], axis=1)
        row = np.where(planes[1] > 0, rng.permutation(height * width).reshape(height, width), -1).astype(np.int32)
        return [samples, points, row, planes, np.array([0.0, 1 / 3, 3.0, 0.2, 1.0])]

    @pytest.fixture(params=[True, False])
    def params(self, request):
        return {"opaque": request.param}


@pytest.mark.parametrize(
    ("shadow", "message"),
    [
        (FLOOR, "a list with an entry for each light"),
        ([None, None], "has 2 entries, and there are 1 lights"),
        ([3.0], "a list with an entry for each light"),
        ([[]], "a list with an entry for each light"),
    ],
)
def test_wrong_shadows_are_refused(shadow, message):
    light = {"direction": np.float32([0, 1, 0]), "shadow": shadow}
    with pytest.raises(rts.InputError, match=message):
        rts.render(part(FLOOR, SQUARE, light=light), rts.Camera.look_at([0, 5, 0], [0, 0, 0]), (8, 8))


def test_wrong_arguments_are_refused():
    floor = part(FLOOR, SQUARE)
    for light, message in (({"ambient": 1.0}, "direction"), ({"color": np.ones(3), "position": np.ones(3)}, "color")):
        with pytest.raises(rts.InputError, match=message):
            shadows.with_shadows(floor, light)
    with pytest.raises(rts.InputError, match="bounds"):
        shadows.with_shadows(floor, {"direction": np.ones(3)}, bounds=3.0)
    with pytest.raises(rts.InputError, match="one number of pixels"):
        shadows.with_shadows(floor, {"direction": np.ones(3)}, size=(32, 32))
    with pytest.raises(rts.InputError, match="zero"):
        shadows.with_shadows(floor, {"direction": np.zeros(3)})
    with pytest.raises(rts.InputError, match="seen_from"):
        shadows.visibility(floor, FLOOR)
    seen = shadows.seen_from(floor, rts.Camera.look_at([0, 5, 0], [0, 0, 0]), (8, 8))
    with pytest.raises(rts.InputError, match=r"\(N, 3\)"):
        shadows.visibility(seen, FLOOR[0])
    with pytest.raises(rts.InputError, match="traced"):
        jax.jit(lambda v: shadows.with_shadows(part(v, SQUARE), {"direction": np.ones(3)})[0].theta["vertices"])(FLOOR)


def test_a_scene_that_has_no_extent_is_refused_and_culled_parts_cast_shadows():
    light = {"direction": np.array([0, 1.0, 0])}
    lid = part(FLOOR * np.float32(0.3) + np.float32([0, 1, 0]), np.ascontiguousarray(SQUARE[:, ::-1])).replace(
        cull="back"
    )
    lit = shadows.with_shadows([part(FLOOR, SQUARE), lid], light, size=32)
    seen = lit[0].theta["light"]["shadow"][0]
    assert lit[1].cull == "back" and shadows.visibility(seen, np.zeros((1, 3), np.float32), 1.0)[0] < 1e-6
    field = rts.plugin("surfaces", "sdf").example()
    for wrong, message in (
        ([field], "cannot become a mesh"),
        ([part(FLOOR, SQUARE).replace(theta={})], "vertices"),
        ([part(FLOOR[:, :2], SQUARE)], "vertices"),
        ([part(FLOOR * np.nan, SQUARE)], "finite"),
    ):
        with pytest.raises(rts.InputError, match=message):
            shadows.with_shadows(wrong, light, size=16)
    for bounds in (([0, 0, 0], "x"), ([0, 0, 0], np.ones(2)), ([0, 0, 0], -1.0)):
        with pytest.raises(rts.InputError, match="bounds"):
            shadows.with_shadows([part(FLOOR, SQUARE)], light, size=16, bounds=bounds)
    for outside in ("a", math.nan, None):
        with pytest.raises(rts.InputError, match="outside"):
            shadows.visibility(seen, FLOOR, outside)


def test_a_far_point_light_keeps_its_shadow_where_its_place_is_traced():
    lid = part(jnp.asarray(FLOOR * np.float32(0.5) + np.float32([0, 1, 0])), SQUARE)

    def share(place):
        lit = shadows.with_shadows(
            [part(jnp.asarray(FLOOR), SQUARE), lid], {"position": place}, size=64, bounds=([0, 0, 0], 4.5)
        )
        return shadows.visibility(lit[0].theta["light"]["shadow"][0], jnp.zeros((1, 3)), 1.0)[0]

    place = jnp.array([0.0, 25.0, 0.0])
    assert share(place) < 0.01 and jax.jit(share)(place) < 0.3
