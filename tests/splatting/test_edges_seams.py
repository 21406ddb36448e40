"""Seams: edges of a surface across which colours change are area averages, and move, as outlines do."""

import numpy as np
import pytest
import trimesh
from cards import SIZE, TWO, covered, flat, in_pixels, turned, two_colors
from found_outlines import sampled_with_outlines
from helpers import icosphere, pushed

import rts

torch = pytest.importorskip("torch")

pytestmark = pytest.mark.splatting

CAMERA = rts.Camera.look_at((1.5, 1.2, 2.5), (0, 0, 0), fov_y=40)
RED, GREEN = (0.9, 0.1, 0.2), (0.1, 0.8, 0.3)
ROOM = np.array([[-7.0, -6], [0, -6], [7, -6], [7, 6], [0, 6], [-7, 6]])
HALVES = np.array([[0, 1, 4], [0, 4, 5], [1, 2, 3], [1, 3, 4]])


def box(share=True, colors=None):
    """A box with a colour a face, whose corners faces share, with a table of colours; or each face has its own."""
    mesh = trimesh.creation.box((1.1, 0.9, 1.3))
    vertices, faces = np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.int32)
    sides = np.unique(np.round(mesh.face_normals).astype(int), axis=0, return_inverse=True)[1].reshape(-1)
    colors = np.random.default_rng(0).random((6, 3)).astype(np.float32) if colors is None else colors
    table = np.repeat(sides[:, None], 3, axis=1)
    if share:
        return rts.Part(rts.Mesh(faces, {"colors": table}), {"vertices": vertices, "colors": colors}, "unlit")
    corners = np.unique(np.stack([faces.ravel(), table.ravel()]), axis=1, return_inverse=True)
    rows, number = corners[0], corners[1].reshape(faces.shape)
    return rts.Part(rts.Mesh(number), {"vertices": vertices[rows[0]], "colors": colors[rows[1]]}, "unlit")


def seams_of(part, camera=CAMERA, size=(96, 96), **options):
    """The number of breaks between two samples of one surface."""
    _, outlines = sampled_with_outlines(part, camera, size, **options)
    return int((outlines.rows[:, :2] >= 0).all(axis=1).sum())


def halves(t, alpha=1.0):
    """A card of two colours, turned, and moved by t pixels to the right."""
    corners = torch.as_tensor(flat(turned(ROOM, 0.3, (12.2, 11.7))))
    table = np.array([[0, 0, 0], [0, 0, 0], [1, 1, 1], [1, 1, 1]])
    colors = np.array([RED, GREEN], np.float32)
    moved = corners + t * torch.tensor([1.0, 0.0, 0.0])
    colors = np.concatenate([colors, np.full((2, 1), alpha, np.float32)], axis=1)
    unlit = rts.plugin("shaders", "unlit")(opaque=alpha == 1)
    return rts.Part(rts.Mesh(HALVES, {"colors": table}), {"vertices": moved, "colors": colors}, unlit)


@pytest.mark.parametrize("alpha", [1.0, 0.6])
def test_halves_of_a_card_have_their_areas_and_the_derivatives_of_these(alpha):
    def truth(shift):
        image = np.zeros((*SIZE, 4))
        for corners, color in ((ROOM[[0, 1, 4, 5]], RED), (ROOM[[1, 2, 3, 4]], GREEN)):
            image += covered(turned(corners, 0.3, np.array([12.2, 11.7]) + shift), SIZE)[..., None] * (*color, 1)
        return alpha * image

    image, derivative = pushed(lambda t: rts.render(halves(t, alpha), in_pixels(), SIZE))
    h = np.array([1e-4, 0])
    expected = (truth(h) - truth(-h)) / 2e-4
    off = np.abs(image - truth(np.zeros(2))).max(axis=-1), np.abs(derivative - expected).max(axis=-1)
    # Of glass a seam is two outlines in one place, and where they end at the card's the pixels beside are off. Where a
    # line passes through the corner of a pixel its derivative is one-sided.
    corners = 0 if alpha == 1 else 2
    assert (off[0] > 2e-6).sum() == corners
    assert off[0].max() < 0.05
    assert (off[1] > 2e-3).sum() <= 2 + 2 * corners
    assert np.abs(expected).max() > 0.5


@pytest.mark.parametrize("share", [True, False])
def test_a_box_with_a_colour_a_face_is_an_area_average(share):
    image, truth = (np.asarray(rts.render(box(share), CAMERA, (96, 96), supersample=s)) for s in (1, 16))
    np.testing.assert_allclose(image, truth, atol=1e-4)


@pytest.mark.parametrize("number", range(4))
def test_the_sides_of_a_box_as_parts_of_their_own_meet_without_a_stair(number):
    """As a file gives them, with a material each: where two meet, both end."""
    whole, rng = box(False), np.random.default_rng(number)
    faces, vertices, colors = whole.surface.faces, whole.theta["vertices"], whole.theta["colors"]
    camera = rts.Camera.look_at(rng.normal(size=3) * 1.2 + 1.5, (0, 0, 0), fov_y=40)
    sides = np.unique(colors[faces[:, 0]], axis=0, return_inverse=True)[1].reshape(-1)
    parts = [rts.Part(rts.Mesh(faces[sides == k]), {"vertices": vertices, "colors": colors}, "unlit") for k in range(6)]
    image, truth = (np.asarray(rts.render(parts, camera, (48, 48), supersample=s)) for s in (1, 16))
    np.testing.assert_allclose(image, truth, atol=1e-4)


def test_a_rim_has_no_gaps():
    """Lines of centres that run along a seam find it as those across it do."""
    n, angle = 32, np.arange(32) * 2 * np.pi / 32
    ring = np.column_stack([0.8 * np.cos(angle), 0 * angle, 0.8 * np.sin(angle)])
    vertices = np.concatenate([ring - [0, 1, 0], ring + [0, 1, 0], [[0, -1, 0], [0, 1, 0]]]).astype(np.float32)
    i, j = np.arange(n), (np.arange(n) + 1) % n
    sides = np.concatenate([np.column_stack([i, n + i, n + j]), np.column_stack([i, n + j, j])])
    caps = np.concatenate([np.column_stack([0 * i + 2 * n, i, j]), np.column_stack([0 * i + 2 * n + 1, n + j, n + i])])
    table = np.repeat([[0], [1], [2]], [2 * n, n, n], axis=0).repeat(3, axis=1)
    colors = np.array([[0.9, 0.9, 0.9], [0.1, 0.2, 0.1], [0.1, 0.1, 0.3]], np.float32)
    mesh = rts.Mesh(np.concatenate([sides, caps]), {"colors": table})
    part = rts.Part(mesh, {"vertices": vertices, "colors": colors}, "unlit")
    for direction in np.random.default_rng(5).normal(size=(12, 3)):
        camera = rts.Camera.look_at(5.5 * direction / np.linalg.norm(direction), (0, 0, 0), fov_y=38)
        image, truth = (np.asarray(rts.render(part, camera, (64, 64), supersample=s)) for s in (1, 4))
        assert np.abs(image - truth).max() < 0.12


def test_two_colours_of_vertices_that_halves_have_of_their_own():
    image, truth = (np.asarray(rts.render(two_colors(), in_pixels(), SIZE, supersample=s)) for s in (1, 16))
    np.testing.assert_allclose(image, truth, atol=1e-5)


def test_a_box_of_glass_and_one_behind_a_pane_have_no_stairs():
    glass = rts.plugin("shaders", "unlit")(opaque=False)
    pane = np.array([[-0.8, -0.5, 1.2], [1.4, -0.4, 0.9], [0.2, 1.2, 1.3]], np.float32)
    colors = np.full((3, 4), 0.4, np.float32)
    pane = rts.Part(rts.Mesh([[0, 1, 2]]), {"vertices": pane, "colors": colors}, glass)
    whole = box()
    half = np.concatenate([whole.theta["colors"], np.full((6, 1), 0.5, np.float32)], axis=1)
    for parts in (whole.replace(shader=glass, theta={**whole.theta, "colors": half}), [whole, pane]):
        image, truth = (np.asarray(rts.render(parts, CAMERA, (96, 96), supersample=s)) for s in (1, 8))
        off = np.abs(image - truth).max(axis=-1)
        assert (off > 0.01).sum() < 20
        assert off.max() < 0.1


def test_small_triangles_that_hardly_turn_have_none():
    """A ball of many triangles, which share no vertices, is as expensive as one that does."""
    vertices, faces = icosphere(5, 0.7)
    whole = rts.Part(rts.Mesh(faces), {"vertices": vertices}, "lambert")
    apart = rts.Part(rts.Mesh(np.arange(3 * len(faces)).reshape(-1, 3)), {"vertices": vertices[faces].reshape(-1, 3)})
    assert seams_of(apart.replace(shader="lambert"), size=(64, 64)) == seams_of(whole, size=(64, 64))
    coarse, few = icosphere(1, 0.7)
    coarse = coarse[few].reshape(-1, 3)
    part = rts.Part(rts.Mesh(np.arange(len(coarse)).reshape(-1, 3)), {"vertices": coarse}, "lambert")
    assert seams_of(part, size=(64, 64)) > 100


@pytest.mark.parametrize("cull", ["none", "back"])
def test_sides_that_are_there_with_both_windings_have_seams(cull):
    part = box(False)
    faces = part.surface.faces
    both = rts.Part(rts.Mesh(np.concatenate([faces, faces[:, ::-1]])), part.theta, "unlit", cull=cull)
    image, truth = (np.asarray(rts.render(both, CAMERA, (48, 48), supersample=s)) for s in (1, 16))
    assert (np.abs(image - truth).max(axis=-1) > 1e-3).sum() <= 8  # Beside corners: diagonals are seams, too.


def test_outlines_are_joined_to_no_seams():
    """Alpha, and how it changes, are those of one colour, but where a seam ends at the outline."""
    table = np.array([[0, 0, 0], [0, 0, 0], [1, 1, 1], [1, 1, 1]])
    corners, colors = torch.as_tensor(flat(turned(ROOM, 0.3, (12.2, 11.7)))), np.array([RED, GREEN], np.float32)
    back = box().replace(transform=np.diag([6.0, 6, 6, 1]) + np.eye(4, k=3) * [[14], [0], [0], [0]])

    def drawn(shader):
        def of(t):
            moved = corners + t * torch.tensor([1.0, 0.3, 0.0])
            front = rts.Part(rts.Mesh(HALVES, {"colors": table}), {"vertices": moved, "colors": colors}, shader)
            return rts.render([front, back.replace(shader=shader)], in_pixels(), SIZE)[..., 3]

        return pushed(of)

    for colored, plain in zip(drawn("unlit"), drawn("silhouette"), strict=True):
        assert (np.abs(colored - plain) > 1e-4).sum() <= 2


def test_where_crossings_have_no_room_outlines_come_first():
    """A rough ball whose triangles share no vertices, seen by a program, has more seams than that has room for."""
    jax = pytest.importorskip("jax")
    (vertices, faces), size = icosphere(3, 0.8), (48, 48)
    vertices = vertices * (1 + 0.1 * np.random.default_rng(0).random((len(vertices), 1)))
    vertices, mesh = vertices[faces].reshape(-1, 3).astype(np.float32), np.arange(3 * len(faces)).reshape(-1, 3)
    part = rts.Part(rts.Mesh(mesh), {"vertices": vertices}, "lambert")
    assert len(sampled_with_outlines(part, CAMERA, size)[1].place) > 8 * sum(size) + 100

    @jax.jit
    def drawn(vertices):
        return rts.render(part.replace(theta={"vertices": vertices}), CAMERA, size)

    with pytest.warns(rts.errors.InputWarning, match="edge crossings find no room beside"):
        image = np.asarray(drawn(jax.numpy.asarray(vertices)))
    plain = np.asarray(rts.render(part.replace(shader="silhouette"), CAMERA, size))
    np.testing.assert_allclose(image[..., 3], plain[..., 3], atol=1e-5)


def test_corners_of_a_proxy_need_a_row_a_face():
    class Odd(rts.Mesh):
        def proxy(self, inputs, camera, size):
            return super().proxy(inputs, camera, size)._replace(corners=np.zeros((2, 3), np.int32))

    part = rts.Part(Odd([[0, 1, 2], [0, 2, 3], [0, 3, 1]]), {"vertices": np.eye(4, 3, dtype=np.float32)}, "unlit")
    with pytest.raises(rts.InputError, match=r"has 3 faces, but corners of shape \(2, 3\)"):
        rts.render(part, CAMERA, (8, 8))


def test_every_way_draws_the_same():
    jax = pytest.importorskip("jax")
    part = box()
    expected = np.asarray(rts.render(part, CAMERA, (32, 40)))

    def drawn(vertices):
        return rts.render(part.replace(theta={**part.theta, "vertices": vertices}), CAMERA, (32, 40))

    vertices = part.theta["vertices"]
    small = rts.Part(rts.Mesh(TWO), {"vertices": np.float32([[9, 9, 9], [10, 9, 9], [9, 10, 9], [9, 9, 9]])}, "unlit")
    ways = {
        "torch": drawn(torch.tensor(vertices, requires_grad=True)).detach(),
        "jax": drawn(jax.numpy.asarray(vertices)),
        "jit": jax.jit(drawn)(jax.numpy.asarray(vertices)),
        "vmap": jax.vmap(drawn)(jax.numpy.asarray(vertices)[None])[0],
        "views": rts.render_views(part, [CAMERA, CAMERA], (32, 40))[1],
        "two parts": rts.render([part, small], CAMERA, (32, 40)),
        "prepared": rts.render(rts.prepare(part), CAMERA, (32, 40)),
    }
    for name, image in ways.items():
        np.testing.assert_allclose(np.asarray(image), expected, atol=3e-5, err_msg=name)
