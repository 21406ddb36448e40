"""Found edges: images and derivatives in closed form, flux that adds up, and what is refused."""

import numpy as np
import pytest
import trimesh
from cards import SIZE, SQUARE, TWO, card, covered, flat, in_pixels, turned
from helpers import pushed

import rts

torch = pytest.importorskip("torch")
forward = pytest.importorskip("torch.autograd.forward_ad")

pytestmark = pytest.mark.splatting


def edges(parts, size=SIZE, **options):
    return rts.render(parts, in_pixels(size), size, splatter="edges", **options)


def moved(vertices, velocity):
    """A function of t: vertices + t · velocity."""
    start, velocity = torch.as_tensor(vertices), torch.as_tensor(np.asarray(velocity, np.float32))
    return lambda t: start + t * velocity


ANGLES = [0.0, 0.03, 0.3, 0.62]
PLACES = [(12.0, 12.0), (12.3, 12.2), (12.5, 12.5)]


@pytest.mark.parametrize("angle", ANGLES)
@pytest.mark.parametrize("place", PLACES)
def test_a_card_has_the_area_and_the_motion_of_its_polygon(angle, place):
    corners = turned(SQUARE, angle, place)
    velocity = np.column_stack([np.tile([1.0, 0.3], (4, 1)), np.zeros(4)])
    image, derivative = pushed(lambda t: edges(card(moved(flat(corners), velocity)(t))))
    step = 1e-5
    truth = [covered(corners + sign * step * velocity[:, :2], SIZE) for sign in (1, -1)]
    # An edge on a border belongs to both pixels, by halves, whichever way it moves.
    np.testing.assert_allclose(image[..., 3], covered(corners, SIZE), atol=2e-4)
    np.testing.assert_allclose(derivative[..., 3], (truth[0] - truth[1]) / (2 * step), atol=2e-3)


def test_a_card_that_turns_and_grows_has_the_motion_of_its_polygon():
    corners = turned(SQUARE, 0.3, (12.2, 11.7))
    away = corners - (12.2, 11.7)
    velocity = 0.05 * away + 0.08 * np.column_stack([-away[:, 1], away[:, 0]])
    _, derivative = pushed(lambda t: edges(card(moved(flat(corners), np.column_stack([velocity, np.zeros(4)]))(t))))
    step = 1e-5
    truth = (covered(corners + step * velocity, SIZE) - covered(corners - step * velocity, SIZE)) / (2 * step)
    assert np.linalg.norm(derivative[..., 3] - truth) < 0.01 * np.linalg.norm(truth)


@pytest.mark.parametrize("shape", ["ball", "spot-like"])
def test_a_rigid_shift_of_a_closed_silhouette_sums_to_zero(shape):
    import trimesh

    mesh = trimesh.creation.icosphere(2, radius=6.3) if shape == "ball" else trimesh.creation.box((9, 5, 7))
    turn = trimesh.transformations.euler_matrix(0.5, 0.3, 0.2)[:3, :3]
    vertices = (np.asarray(mesh.vertices) @ turn.T + [12.1, 12.4, -20]).astype(np.float32)
    for direction in ([1.0, 0, 0], [0, 1, 0]):
        _, derivative = pushed(lambda t, d=direction: edges(card(moved(vertices, d)(t), faces=np.asarray(mesh.faces))))
        assert np.abs(derivative[..., 3]).sum() > 5
        assert abs(derivative[..., 3].sum()) < 2e-4


def test_planes_that_cross_have_the_line_where_they_meet():
    # Depths 20 + a (x − 12) and 20 − a (x − 12) + t: the line is at x = 12 + t / (2 a).
    tilt = 0.7
    corners = np.array([[-5.0, -5], [30, -5], [30, 30], [-5, 30]])
    one = np.column_stack([corners, -(20 + tilt * (corners[:, 0] - 12.2))]).astype(np.float32)
    two = np.column_stack([corners, -(20 - tilt * (corners[:, 0] - 12.2))]).astype(np.float32)

    def scene(t):
        back = moved(two, np.tile([0, 0, -1.0], (4, 1)))(t)
        return edges([card(one, (1, 0, 0)), card(back, (0, 1, 0))])

    image, derivative = pushed(scene)
    np.testing.assert_allclose(image[5:-5, 12, 1], 0.8, atol=1e-3)
    np.testing.assert_allclose(derivative[5:-5, 12, 0], 1 / (2 * tilt), rtol=1e-3)
    np.testing.assert_allclose(derivative[5:-5, 12, 1], -1 / (2 * tilt), rtol=1e-3)
    assert np.abs(derivative[:, :11]).max() < 1e-5


def test_sheets_of_one_part_that_cross_have_the_line_where_they_meet():
    tilt = 0.7
    corners = np.array([[-5.0, -5], [30, -5], [30, 30], [-5, 30]])
    sheets = [np.column_stack([corners, -(20 + s * tilt * (corners[:, 0] - 12.2))]) for s in (1, -1)]
    vertices = np.concatenate(sheets).astype(np.float32)
    part = rts.Part(
        rts.Mesh(np.concatenate([TWO, TWO + 4])),
        {"vertices": None, "colors": np.repeat(np.eye(3, dtype=np.float32)[:2], 4, axis=0)},
        "unlit",
    )
    velocity = np.concatenate([np.zeros((4, 3)), np.tile([0, 0, -1.0], (4, 1))])

    def scene(t):
        return edges(part.replace(theta={**part.theta, "vertices": moved(vertices, velocity)(t)}))

    image, derivative = pushed(scene)
    np.testing.assert_allclose(image[5:-5, 12, 1], 0.8, atol=1e-3)
    np.testing.assert_allclose(derivative[5:-5, 12, 0], 1 / (2 * tilt), rtol=1e-3)


def test_an_edge_uncovers_the_front_of_its_neighbour_with_one_layer():
    near, far = turned(SQUARE, 0.2, (10.2, 12)), turned(SQUARE * 1.2, -0.3, (14, 11.6))

    def scene(t):
        return edges(
            [card(moved(flat(near), np.tile([1.0, 0, 0], (4, 1)))(t), (1, 0, 0)), card(flat(far, 4), (0, 1, 0))]
        )

    image, derivative = pushed(scene)
    step = 1e-5
    red, other = covered(near, SIZE), covered(far, SIZE)
    truth = (covered(near + [step, 0], SIZE) - covered(near - [step, 0], SIZE)) / (2 * step)
    np.testing.assert_allclose(image[..., 0], red, atol=0.02)
    assert np.linalg.norm(derivative[..., 0] - truth) < 0.02 * np.linalg.norm(truth)
    amid = (other == 1) & (red < 1)
    # Where an edge of the far card ends at the near one, the pixel is off by an eighth.
    np.testing.assert_allclose(derivative[amid, 1], -truth[amid], atol=0.03)


@pytest.mark.parametrize("sampler", ["raster", "embree", "reference"])
def test_forward_mode_and_reverse_mode_agree(sampler):
    corners = flat(turned(SQUARE, 0.3, (12.2, 11.7))).astype(np.float64)
    weights = torch.as_tensor(np.random.default_rng(0).normal(size=(*SIZE, 4)))
    velocity = torch.as_tensor(np.random.default_rng(1).normal(size=(4, 3)))

    def loss(t):
        return (edges(card(torch.as_tensor(corners) + t * velocity), sampler=sampler) * weights).sum()

    with forward.dual_level():
        result = loss(forward.make_dual(torch.zeros((), dtype=torch.float64), torch.ones((), dtype=torch.float64)))
        by_forward = float(forward.unpack_dual(result).tangent)
    t = torch.zeros((), dtype=torch.float64, requires_grad=True)
    loss(t).backward()
    assert t.grad is not None
    assert float(t.grad) == pytest.approx(by_forward, rel=1e-5)


def test_parts_beside_one_another_are_drawn_as_each_alone():
    """Their colours change across them, so that rows of other cells would show."""
    parts, ramp = [], np.random.default_rng(3).random((4, 3)).astype(np.float32)
    for number, (place, angle) in enumerate([((6.1, 12.2), 0.3), ((17.8, 11.7), -0.2)]):
        corners = flat(turned(SQUARE * (0.6, 1), angle, place))
        parts.append(rts.Part(rts.Mesh(TWO), {"vertices": corners, "colors": np.roll(ramp, number, 0)}, "unlit"))
    alone = [edges(part) for part in parts]
    assert all(image[..., 3].max() > 0.9 for image in alone)
    np.testing.assert_allclose(edges(parts), alone[0] + alone[1], atol=1e-6)


@pytest.mark.filterwarnings("ignore:second derivatives")
def test_the_area_of_a_square_that_shifts_has_no_curvature():
    """d² of a pixel's area is 0 but where a corner turns: at most 0.02 px⁻² for each pixel of perimeter."""
    corners = flat(turned(SQUARE, 0.3, (12.2, 11.7)))

    def area(t):
        return edges(card(moved(corners, np.tile([1.0, 0, 0], (4, 1)))(t)))[..., 3].sum()

    t = torch.zeros((), requires_grad=True)
    (first,) = torch.autograd.grad(area(t), t, create_graph=True)
    second = torch.autograd.grad(first, t)[0] if first.requires_grad else torch.zeros(())
    assert abs(float(second)) <= 0.02 * 52


def test_losses_have_no_steps_as_a_card_moves():
    """In steps of 1/200 pixel, the largest change of a pixel is that of an edge that moves by as much."""
    images = [edges(card(flat(turned(SQUARE, 0.3, (12.2 + i / 200, 11.7)))))[..., 3] for i in range(60)]
    assert np.abs(np.diff(images, axis=0)).max() < 0.01


def test_supersampling_keeps_the_area():
    corners = turned(SQUARE, 0.3, (12.2, 11.7))
    image = edges(card(flat(corners)), supersample=3)
    np.testing.assert_allclose(image[..., 3], covered(corners, SIZE), atol=2e-4)


def test_two_layers_ask_for_no_second_sample():
    sampled = rts.sample(card(flat(SQUARE + 12)), in_pixels(), SIZE, splatter="edges", layers=2)
    assert sampled.row.shape[0] == 1


def test_no_colour_leaves_the_range_of_those_that_are_seen():
    """Light that turns away at the limb: the sample at a centre is dark, that beside the outline bright, or the other
    way around."""
    ball = trimesh.creation.icosphere(2, radius=0.7)
    theta = {"vertices": np.float32(ball.vertices), "light": {"direction": np.float32([0.3, 0.8, 0.5])}}
    camera = rts.Camera.look_at((0, 0, 3), (0, 0, 0), fov_y=40)
    image = rts.render(rts.Part(rts.Mesh(ball.faces), theta, "lambert"), camera, (128, 128), splatter="edges")
    assert image.min() > -1e-6
    assert (image[..., :3] - image[..., 3:]).max() < 1e-6


@pytest.mark.parametrize("angle", [0.05, 0.3, 0.62])
@pytest.mark.parametrize("width", [0.1, 0.3, 0.6])
def test_a_strip_that_hardly_a_centre_sees_has_its_area_and_motion(angle, width):
    """Its ends between lines of centres are cut off; so areas lack up to a third of a pixel's length."""
    corners = turned(SQUARE * [1, width / 12], angle, (12.1, 12.2))
    velocity = np.column_stack([np.tile([-np.sin(angle), np.cos(angle)], (4, 1)), np.zeros(4)])
    image, derivative = pushed(lambda t: edges(card(moved(flat(corners), velocity)(t))))
    step, shares = 1e-5, covered(corners, SIZE)
    truth = [covered(corners + sign * step * velocity[:, :2], SIZE) for sign in (1, -1)]
    truth = (truth[0] - truth[1]) / (2 * step)
    assert image[..., 3].sum() == pytest.approx(shares.sum(), abs=2 / 3 * width)
    assert np.abs(image[..., 3] - shares).max() < 0.6 * width
    gain = (derivative[..., 3] * truth).sum() / (truth**2).sum()
    assert gain == pytest.approx(1, abs=0.15)


def test_a_needle_reaches_to_its_tip():
    corners = np.array([[3.5, 11.7], [19.9, 12.3], [3.5, 12.6]])
    shares = covered(corners, SIZE)
    image = edges(card(flat(corners), faces=np.array([[0, 1, 2]])))[..., 3]
    assert shares[12, 19] > 0.01
    np.testing.assert_allclose(image[:, 5:], shares[:, 5:], atol=2e-3)


def test_edges_that_run_along_a_line_of_centres_but_for_rounding_are_passed_over():
    """A triangle through the camera plane may meet a line of centres farther away than integers reach."""
    from rts.outlines.gaps import Gaps
    from rts.outlines.seen_mesh import SeenMesh
    from rts.outlines.silhouettes_loops import ANY_SIZE

    clip, rows = np.array([[0, 0, 1, -0.1], [0, 0, -1, 100.0]]), np.eye(4)[[0, 1, 2, 2]]
    faces, none = np.array([[0, 1, 2], [1, 0, 2]], np.int32), np.full((2, 3), -1, np.int32)
    both, starts = np.zeros(2, np.int8), np.int32([0, 1])
    marks = np.zeros((2, 8, 8), bool)
    marks[0, :, :-1], marks[1, :-1] = True, True
    for side in (1e-25, -1e-25):
        for third in ((9, -5, -1), (9, 5, -1), (-9, -5, -1), (-9, 5, -1)):
            vertices = np.array([(-1000, side, 1), (1000, 0, 1), third], np.float32)
            seen = np.float32((vertices @ rows[:3, :3].T)[:, :2] / vertices[:, 2:])
            seen[vertices[:, 2] <= 0] = np.nan
            sides = np.int8([ANY_SIZE, ANY_SIZE])
            listed = np.int32([0, 1]), np.int8([3, 3]), np.zeros(2, np.int32), np.int32([2])
            own = SeenMesh(0, starts, vertices, faces, none, rows, clip, both, seen, sides, *listed)
            names, spans, _ = own.spans(Gaps.of(marks), True)
            names, spans = names[names[:, 0] >= 0], spans[names[:, 0] >= 0]
            assert (names[:, 0] < 112).all()
            assert np.isfinite(spans).all()


def test_an_image_that_is_set_on_a_splatter_is_drawn():
    splatter = rts.plugin("splatters", "edges")()
    part, own = card(flat(turned(SQUARE, 0.3, (12.0, 12.0)))), splatter.image
    expected = 2 * rts.render(part, in_pixels(SIZE), SIZE, splatter=splatter)
    splatter.image = lambda splats: 2 * own(splats)
    np.testing.assert_array_equal(rts.render(part, in_pixels(SIZE), SIZE, splatter=splatter), expected)
