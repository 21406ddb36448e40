"""Facing, which keeps the front and the back of a sheet from pairing: its sources, and its effects."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
from helpers import DIFFERENTIABLE, TORCH, arrays, box, icosphere, rotation, soup, splats_of, to_numpy

import rts
from rts import splatting
from rts.contracts.oriented_pieces import pieces
from rts.contracts.records import Cells
from rts.sampling.facing import eye
from rts_backends.fused.splatters import Visible

pytestmark = pytest.mark.splatting

MESH = rts.plugin("rts.surfaces", "mesh")
CAMERA = rts.Camera.look_at((0.3, 0.4, 4.0), (0, 0, 0), fov_y=50)
SIZE = (24, 28)
BY_DEPTH = Visible(facing=False)


def part_of(mesh, **options):
    vertices, faces = mesh
    colors = np.random.default_rng(0).random(vertices.shape)
    return rts.Part(MESH(faces), {"vertices": vertices, "colors": colors}, "unlit", **options)


def strip(count, twisted=False):
    """A ring of `count` quads, oriented; or a Möbius strip."""
    i = np.arange(count)
    low, high = i, i + count
    after = (i + 1) % count
    faces = np.concatenate([np.stack(t, 1) for t in ((low, after, high), (after, after + count, high))])
    if twisted:
        ends = faces[[count - 1, 2 * count - 1]]
        swapped = ends.copy()
        swapped[ends == 0], swapped[ends == count] = count, 0
        faces[[count - 1, 2 * count - 1]] = swapped
    return faces


def test_pieces_hang_together_and_are_wound_alike():
    small, large = icosphere(0)[1], icosphere(1)[1]
    found = pieces(np.concatenate([small, large + 12]))
    assert set(found[:20]) == {2} and set(found[20:]) == {1} and found.dtype == np.int16
    flipped = large.copy()
    flipped[5] = flipped[5, ::-1]
    found = pieces(flipped)
    assert found[5] == 2 and set(np.delete(found, 5)) == {1}
    assert len(set(pieces(soup(30)[1]))) == 30
    assert set(pieces(strip(6))) == {1}
    assert set(pieces(strip(6, twisted=True))) == {0}
    # Three triangles at one edge.
    assert len(set(pieces(np.array([[0, 1, 2], [1, 0, 3], [0, 1, 4]])))) == 3


def test_pieces_of_a_plugin_are_checked():
    class Numbered(MESH):
        def pieces(self, proxy):
            return np.ones(5, np.int16)

    part = part_of(icosphere(1))
    with pytest.raises(rts.InputError, match=r"pieces of .* \(5,\); expected int16 of \(80,\)"):
        rts.sample(part.replace(surface=Numbered(part.surface.faces)), CAMERA, SIZE, splatter=None)


@pytest.mark.parametrize("kind", ["perspective", "orthographic", "mirrored"])
def test_what_is_seen_from_its_front_is_what_culling_leaves(kind):
    camera = CAMERA if kind != "orthographic" else rts.Camera.orthographic((1, 2, 4), (0, 0, 0), height=4)
    if kind == "mirrored":
        camera = camera.replace(view=np.diag([-1.0, 1, 1, 1]) @ camera.view)
    part = part_of(icosphere(1))
    told, culled = (rts.sample(part.replace(cull=c), camera, SIZE, layers=3, splatter=None) for c in ("none", "back"))
    assert culled.facing is None
    ids = told.samples[0].ids[told.row]
    front = (told.row >= 0) & (told.facing > 0)
    behind = (told.row >= 0) & (told.facing < 0)
    assert front[0].sum() > 50 and behind[1].sum() > 50 and not (front[1:].any() or behind[0].any())
    np.testing.assert_array_equal(ids[front], culled.samples[0].ids[culled.row][front])
    assert eye(camera.for_size(SIZE)).shape == (4,)


def leaf():
    """A closed flat ellipsoid that stands askew: near its rim backs are nearer to a neighbour's front than fronts."""
    vertices, faces = icosphere(3)
    return (vertices * (0.8, 0.5, 0.08) @ rotation((1, 2, 0), 60)).astype(np.float32), faces


def flat(theta, points):
    """The level of a flat ellipsoid that stands askew."""
    xp = rts.namespace(points)
    x, y, z = (points @ rts.engine_of(points).constant(rotation((1, 2, 0), 60).T.astype(np.float32), points)).T
    return xp.sqrt((x / 0.8) ** 2 + (y / 0.5) ** 2 + (z / theta["depth"]) ** 2 + 1e-12) - 1


@pytest.mark.parametrize("target", ["numpy", *TORCH])
def test_rays_tell_where_they_enter_and_leave_a_solid(target):
    part = rts.Part(rts.Sdf(flat, 1.0, lipschitz=None), arrays(target, {"depth": np.float32(0.08)}), "normals")
    cells = to_numpy(rts.sample(part, CAMERA, SIZE, layers=3, splatter=None).cells)
    covered = cells.row >= 0
    assert covered[1].sum() > 20 and not covered[2].any()
    np.testing.assert_array_equal(cells.facing, np.where(covered, np.array([1, -1, 0])[:, None, None], 0))
    two = to_numpy(rts.sample(part, CAMERA, SIZE, layers=2, splatter=None).cells)
    assert set(two.facing[1][two.row[1] >= 0]) == {-1 - Cells.MORE_BEHIND}
    images = [to_numpy(rts.render(part, CAMERA, SIZE, layers=layers, splatter="visible")) for layers in (1, 3)]
    np.testing.assert_allclose(*images, rtol=0, atol=1e-6)
    assert np.abs(images[0] - to_numpy(rts.render(part, CAMERA, SIZE, layers=3, splatter=BY_DEPTH))).max() > 1e-3


@pytest.mark.parametrize("mesh", [icosphere(3, 0.9), leaf(), box(0.7)], ids=["sphere", "leaf", "box"])
@pytest.mark.parametrize("layers", [3, 4])
def test_a_closed_body_looks_as_if_its_back_were_culled(mesh, layers):
    part = part_of(mesh)
    options = dict(sampler="raster", layers=layers)
    expected = rts.render(part.replace(cull="back"), CAMERA, SIZE, **options)
    np.testing.assert_allclose(rts.render(part, CAMERA, SIZE, **options), expected, rtol=0, atol=1e-6)


def test_by_depth_alone_a_back_may_pair_with_a_front():
    expected = rts.render(part_of(leaf(), cull="back"), CAMERA, SIZE, splatter="visible", layers=2)
    assert np.abs(rts.render(part_of(leaf()), CAMERA, SIZE, splatter=BY_DEPTH) - expected).max() > 0.02


def test_sheets_of_their_own_may_be_wound_in_any_way():
    # Two sheets, the hidden one the other way round, and triangles that hang together in nothing.
    vertices, faces = leaf()
    wound = faces, faces[:, ::-1] + len(vertices)
    sheets = np.concatenate([vertices, vertices - np.float32([0, 0, 0.05])]), np.concatenate(wound)
    alone = soup(30)
    for mesh, same in ((alone, True), (sheets, False)):
        images = [rts.render(part_of(mesh), CAMERA, SIZE, splatter=s, layers=4) for s in ("visible", BY_DEPTH)]
        assert np.array_equal(*images) == same
    whole = rts.render(part_of(sheets), CAMERA, SIZE, layers=6, splatter="visible")
    turned = rts.render(part_of((sheets[0], sheets[1][:, ::-1])), CAMERA, SIZE, layers=6, splatter="visible")
    np.testing.assert_allclose(whole, turned, rtol=0, atol=1e-5)


def scene():
    vertices, faces = leaf()
    return [
        part_of(icosphere(2, 0.8, (0.4, 0, 0))),
        part_of((vertices - np.float32([0.8, 0.3, 0]), faces)),
        part_of(icosphere(1, 0.7), cull="back"),
    ]


def test_order_of_parts_and_what_is_pruned_change_nothing():
    parts = scene()
    image = rts.render(parts, CAMERA, SIZE, layers=6, splatter="visible")
    np.testing.assert_allclose(
        rts.render(parts[::-1], CAMERA, SIZE, layers=6, splatter="visible"), image, rtol=0, atol=1e-6
    )
    np.testing.assert_allclose(
        rts.render(parts, CAMERA, SIZE, layers="auto", splatter="visible"), image, rtol=0, atol=1e-6
    )
    whole = rts.sample(parts, CAMERA, SIZE, layers=6, splatter="visible")
    np.testing.assert_allclose(rts.render_samples(whole, parts, CAMERA, splatter="visible"), image, rtol=0, atol=1e-6)
    copy = pickle.loads(pickle.dumps(whole))
    np.testing.assert_array_equal(copy.facing, whole.facing)
    numbers = [set((np.abs(whole.facing[whole.part == i]) % Cells.MORE_BEHIND).tolist()) - {0} for i in range(3)]
    assert numbers[0] and numbers[1] and not numbers[0] & numbers[1] and not numbers[2]
    by_depth = rts.render(parts, CAMERA, SIZE, splatter=BY_DEPTH, layers=6)
    assert np.abs(by_depth - image).max() > 0.02


@pytest.mark.parametrize("target", DIFFERENTIABLE)
def test_engines_agree(target):
    parts = scene()[:2]
    image = rts.render(parts, CAMERA, SIZE, layers=4, splatter="visible")
    vertices = arrays(target, [p.theta["vertices"] for p in parts])

    def render(vertices):
        moved = [p.replace(theta={**p.theta, "vertices": v}) for p, v in zip(parts, vertices, strict=True)]
        return rts.render(moved, CAMERA, SIZE, layers=4, splatter="visible")

    render = pytest.importorskip("jax").jit(render) if target == "jax" else render
    np.testing.assert_allclose(to_numpy(render(vertices)), image, rtol=0, atol=1e-5)


def test_fine_samples_are_told_too():
    options = dict(supersample=rts.Adaptive(2), layers=3)
    expected = rts.render(part_of(leaf(), cull="back"), CAMERA, SIZE, **options)
    image = rts.render(part_of(leaf()), CAMERA, SIZE, **options)
    by_depth = rts.render(part_of(leaf()), CAMERA, SIZE, splatter=BY_DEPTH, **options)
    # By depth more pixels are active.
    assert np.abs(image - expected).sum() < 0.5 * np.abs(by_depth - expected).sum()


def test_samplers_that_know_no_lists_of_cells_tell_them_too():
    class Whole(rts.plugin("rts.samplers", "raster")):
        def sample(self, part, camera, size, layers, request):
            return super().sample(part, camera, size, layers, replace(request, cells=None))

    options = dict(supersample=rts.Adaptive(2), layers=3)
    listed, by_depth = (
        rts.render(scene(), CAMERA, SIZE, sampler="raster", splatter=s, **options) for s in (Visible(), BY_DEPTH)
    )
    whole = rts.render(scene(), CAMERA, SIZE, sampler=Whole(), **options)
    np.testing.assert_allclose(whole, listed, atol=1e-6)
    assert np.abs(whole - by_depth).max() > 1e-3


@pytest.mark.parametrize("layers", [2, 4])
def test_the_compiled_splatter_is_the_specification(layers):
    rng = np.random.default_rng(layers)
    covered = np.sort(rng.random((layers, 12, 14)) < 0.8, axis=0)[::-1]
    row = np.where(covered, np.cumsum(covered.reshape(-1)).reshape(covered.shape) - 1, -1).astype(np.int32)
    depth = 1 + np.cumsum(rng.choice([0.01, 0.1], covered.shape), axis=0) + 0.1 * rng.random(covered.shape)
    y, x = np.mgrid[:12, :14] + 0.5
    positions = np.stack([np.broadcast_to(x, depth.shape), np.broadcast_to(y, depth.shape), depth], axis=-1)[covered]
    rgba = rng.random((len(positions), 4))
    facing = np.where(covered, rng.integers(-2, 3, covered.shape), 0).astype(np.int16)
    facing[-1] += (np.sign(facing[-1]) * Cells.MORE_BEHIND).astype(np.int16)
    splats = splats_of(positions, rgba, row, facing=facing)
    images = [s.image(splats) for s in (Visible(), splatting.Visible(), Visible(facing=False))]
    np.testing.assert_allclose(images[0], images[1], rtol=0, atol=1e-12)
    assert np.abs(images[0] - images[2]).max() > 0.05
    target, tangents = rng.random(images[0].shape), rng.normal(size=(1, *positions.shape))
    found = Visible().normal_equations(splats, tangents, None, target)
    assert found is not None
    np.testing.assert_allclose(found[0], ((images[0] - target) ** 2).mean(), rtol=1e-12)
    torch = pytest.importorskip("torch")
    along, constant = torch.tensor(rng.normal(size=images[0].shape)), [torch.tensor(t) for t in (rgba, row, facing)]
    found = []
    for splatter in (Visible(), splatting.Visible()):
        moved = torch.tensor(positions, requires_grad=True)
        image = splatter.image(splats_of(moved, *constant[:2], facing=constant[2]))
        found.append(torch.autograd.grad((image * along).sum(), moved)[0].numpy())
    np.testing.assert_allclose(*found, rtol=0, atol=1e-10)


def test_found_outlines_do_not_depend_on_the_order_of_parts():
    parts = scene()
    images = [rts.render(own, CAMERA, SIZE, splatter="edges") for own in (parts, parts[::-1])]
    np.testing.assert_allclose(*images, rtol=0, atol=1e-6)
