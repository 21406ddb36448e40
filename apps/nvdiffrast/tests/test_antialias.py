"""`antialias`: its values, and its derivatives against coverage that is known and against area-sampled images."""

import numpy as np
import pytest
import rts_nvdiffrast.torch as dr
import scenes
import torch
import trimesh

import rts

CONTEXT = dr.RasterizeCudaContext()
SQUARE = torch.tensor([[-0.5, -0.5, 0.0], [0.5, -0.5, 0.0], [0.5, 0.5, 0.0], [-0.5, 0.5, 0.0]])
TWO = torch.tensor([[0, 1, 2], [0, 2, 3]], dtype=torch.int32)


def flat(vertices):
    """Clip space (1, V, 4) of vertices that are there already, with w = 1."""
    return torch.cat([vertices, torch.ones_like(vertices[:, :1])], dim=1)[None]


def mask(pos, tri, size=(32, 32), context=CONTEXT, **options):
    rast, _ = dr.rasterize(context, pos, tri, size)
    return dr.antialias((rast[..., 3:] > 0).to(pos.dtype), rast, pos, tri, **options)


def test_inside_and_outside_nothing_changes():
    pos = scenes.clip(scenes.CUBE)
    rast, _ = dr.rasterize(CONTEXT, pos, scenes.CUBE_FACES, (48, 48))
    color = torch.rand((1, 48, 48, 5), generator=torch.Generator().manual_seed(1))
    covered = rast[..., 3] > 0
    image = dr.antialias(color, rast, pos, scenes.CUBE_FACES)
    count = torch.nn.functional.avg_pool2d(covered.float(), 5, stride=1, padding=2)
    count[:, :2], count[:, -2:], count[:, :, :2], count[:, :, -2:] = 0, 0, 0, 0
    away = ((count > 0.999) | (count < 0.001)) & torch.ones_like(covered)
    away[:, :2] = away[:, -2:] = away[:, :, :2] = away[:, :, -2:] = False
    assert 500 < away.sum() < 2000
    torch.testing.assert_close(image[away], color[away], atol=1e-5, rtol=0)
    assert (image != color).any()


def test_a_pixel_at_an_outline_is_the_area_inside():
    shift = 0.013
    pos = flat(SQUARE + torch.tensor([shift, 0.021, 0]))
    image = mask(pos, TWO, (16, 16))
    first = torch.arange(16) / 8 - 1  # The lower side of each pixel.
    along, up = ((0.5 + by - first).clamp(0, 1 / 8) - (-0.5 + by - first).clamp(0, 1 / 8) for by in (shift, 0.021))
    area = 64 * up[:, None] * along
    corner = ((along > 0) & (along < 1 / 8))[None] & ((up > 0) & (up < 1 / 8))[:, None]
    torch.testing.assert_close(image[0, ..., 0][~corner], area[~corner], atol=1e-4, rtol=0)
    assert corner.sum() == 4
    torch.testing.assert_close(image[0, ..., 0][corner], area[corner], atol=0.3, rtol=0)


@pytest.mark.parametrize("angle", [0.0, 0.2, 0.464, 0.785, 1.2])
def test_a_slanted_outline_is_the_area_beside_it(angle):
    """A half-plane; the truth is the mean of 32 × 32 samples a pixel."""
    turn = scenes.rotation(torch.tensor([0, 0, angle]))
    corners = torch.tensor([[0.1, -6.0, 0], [0.1, 6, 0], [-6, 0, 0]]) @ turn.T
    image = mask(flat(corners), scenes.ONE, (12, 12))[0, ..., 0]
    x = (torch.arange(12 * 32) + 0.5) / (6 * 32) - 1
    inside = (turn[0, 0] * x[None] + turn[1, 0] * x[:, None] < 0.1).float()
    truth = inside.reshape(12, 32, 12, 32).mean((1, 3))
    torch.testing.assert_close(image[1:-1, 1:-1], truth[1:-1, 1:-1], atol=0.03, rtol=0)
    assert ((truth > 0.01) & (truth < 0.99)).sum() > 8


def test_triangles_may_be_smaller_than_pixels():
    """A sphere of 160,000 triangles grows: its disk by 2 / radius of its area."""
    points, faces, _ = scenes.sphere(200, 400)
    scale = torch.ones((), requires_grad=True)
    area = mask(flat(scale * points), faces, (48, 48)).sum()
    area.backward()
    assert area.item() == pytest.approx(torch.pi * (0.9 * 24) ** 2, rel=2e-3)
    assert scale.grad.item() == pytest.approx(2 * area.item(), rel=0.01)


def test_edges_may_end_behind_the_eye():
    """A road whose edges pass the eye, beside the same road from a little ahead of it on."""
    images, grads = [], []
    for end in (1.0, -0.8):
        width = torch.tensor(0.4, requires_grad=True)
        corners = [(-1, end), (1, end), (1, -9.0), (-1, -9.0)]
        road = torch.stack([torch.stack([x * width, width * 0 - 0.5, width * 0 + z]) for x, z in corners])
        images.append(mask(scenes.clip(road, (0, 0, 0), (0, 0, 0)), TWO, (24, 24)))
        images[-1].sum().backward()
        grads.append(width.grad)
    torch.testing.assert_close(*images, atol=1e-4, rtol=0)
    torch.testing.assert_close(*grads, rtol=1e-3, atol=0)
    assert grads[0] > 10


class TestOfAPose:
    """The derivative of a loss in a pose, beside differences of images of 8 × 8 samples a pixel."""

    SIZE, FINE, STEP = 96, 8, 0.01
    POSES = dict.fromkeys(("sphere", "box"), (0.4, 0.6, 0.1, 0.05, -0.1, 0.1)) | {
        "torus": (0.53, -0.56, 2.72, 0.13, 0.17, 0.04),
        "capsule": (-1.34, -2.21, -0.41, -0.18, -0.05, -0.04),
    }
    """Rotation vectors and shifts; those of torus and capsule are poses of `benchmarks/nvdiffrast.py`."""

    def shape(self, name):
        """Vertices, faces, and a vector for each vertex, which makes its colour."""
        if name == "sphere":
            points, faces, _ = scenes.sphere(24, 48)
            return points, faces, points
        if name == "box":
            return scenes.CUBE, scenes.CUBE_FACES, scenes.CUBE
        mesh = trimesh.creation.torus(0.8, 0.3) if name == "torus" else trimesh.creation.capsule(0.8, 0.4)
        points, faces, normals = (np.array(x) for x in (mesh.vertices, mesh.faces, mesh.vertex_normals))
        return torch.tensor(points).float(), torch.tensor(faces).int(), torch.tensor(normals).float()

    def image(self, shape, pose, fine=None):
        points, faces, color = shape
        size = self.SIZE * (fine or 1)
        pos = scenes.clip(points, pose[:3], torch.cat([pose[3:5], pose[5:] - 3.5]))
        rast, _ = dr.rasterize(CONTEXT, pos, faces, (size, size))
        image, _ = dr.interpolate(color[None], rast, faces)
        if fine is None:
            return dr.antialias(image, rast, pos, faces)[0]
        return image[0].reshape(self.SIZE, fine, self.SIZE, fine, -1).mean((1, 3)).double()

    @pytest.mark.parametrize("colored", [False, True])
    @pytest.mark.parametrize("name, first", [("sphere", 3), ("box", 0), ("torus", 0), ("capsule", 0)])
    def test_is_that_of_areas(self, name, first, colored):
        """A sphere's mask does not tell how it is turned: only shifts count."""
        points, faces, directions = self.shape(name)
        shape = points, faces, 0.5 + 0.5 * directions if colored else torch.ones(len(points), 1)
        pose = torch.tensor(self.POSES[name], requires_grad=True)
        goal = pose.detach() + torch.tensor([0.05, -0.03, 0.04, 0.04, 0.05, -0.06])
        with torch.no_grad():
            target, here = self.image(shape, goal, self.FINE), self.image(shape, pose, self.FINE)
            steps = self.STEP * torch.eye(6)
            changes = [self.image(shape, pose + e, self.FINE) - self.image(shape, pose - e, self.FINE) for e in steps]
        truth = torch.stack([(2 * (here - target) * change).sum() / (2 * self.STEP) for change in changes])
        (self.image(shape, pose) - target).square().sum().backward()
        assert (pose.grad - truth)[first:].norm() < 0.05 * truth[first:].norm()


@pytest.mark.parametrize("matrix", ["perspective", "orthographic"])
def test_the_covered_area_changes_as_it_should(matrix):
    """A square of side a grows: the area by 2 a."""
    side = torch.tensor(1.1, requires_grad=True)
    vertices = SQUARE * side
    if matrix == "perspective":
        pos, scale = scenes.clip(vertices, (0, 0, 0.3)), 2.5 / 3.5
        # A vertex on the axis at another depth, so that z is affine in w.
        extra = scenes.clip(torch.tensor([[0.0, 0, 0.4], [0.001, 0, 0.4], [0, 0.001, 0.4]]), (0, 0, 0))
        pos, tri = torch.cat([pos, extra], dim=1), torch.cat([TWO, torch.tensor([[4, 5, 6]], dtype=torch.int32)])
    else:
        pos, tri, scale = flat(vertices), TWO, 1.0
    area = mask(pos, tri, (128, 128)).mean() * 4
    area.backward()
    expected = (scale * 1.1) ** 2
    assert area.item() == pytest.approx(expected, rel=0.02)
    assert side.grad.item() == pytest.approx(2 * scale**2 * 1.1, rel=0.03)


def test_a_surface_in_front_of_another_moves_over_it():
    """Colours 0.2 and 0.9, both covering: a shift of the front square moves its left and right edge."""
    shift = torch.zeros((), requires_grad=True)
    front = SQUARE + torch.stack([shift, shift * 0, shift * 0 - 0.5])
    back = 3 * SQUARE + torch.tensor([0, 0, 0.5])
    pos, tri = flat(torch.cat([front, back])), torch.cat([TWO, TWO + 4])
    rast, _ = dr.rasterize(CONTEXT, pos, tri, (32, 32))
    color = torch.where(rast[..., 3:] <= 2, 0.2, 0.9)
    image = dr.antialias(color, rast, pos, tri)
    half = image[0, :, 16:, 0].sum() * (2 / 32) ** 2
    half.backward()
    assert shift.grad.item() == pytest.approx(1.0 * (0.2 - 0.9), rel=0.03)  # An edge of length 1 goes right.


class TestColoursThatMove:
    """A plane whose colour is a ramp in x, moved along x: u and v carry the motion of colours, `antialias` none."""

    SLOPE = 0.3

    def slopes(self, f):
        """The derivative in the shift of the mean of an antialiased image, and of `f` of its colours."""
        shift, found = torch.zeros((), requires_grad=True), []
        pos = flat(4 * SQUARE + torch.stack([shift, shift * 0, shift * 0]))
        rast, _ = dr.rasterize(CONTEXT, pos, TWO, (16, 16))
        color, _ = dr.interpolate(self.SLOPE * 4 * SQUARE[:, :1].contiguous(), rast, TWO)
        for x in (f(color), dr.antialias(f(color), rast, pos, TWO)):
            found += torch.autograd.grad(x.mean(), shift, retain_graph=True)
        return [slope.item() for slope in found]

    def test_move_once(self):
        assert self.slopes(lambda color: color) == pytest.approx([-self.SLOPE, -self.SLOPE], rel=1e-4)

    def test_hidden_from_autograd_stay(self):
        assert self.slopes(lambda color: color.detach() + 0 * color) == [0, 0]

    def test_attributes_keep_their_gradient(self):
        attr = (4 * SQUARE[:, :1]).contiguous().requires_grad_()
        pos = flat(4 * SQUARE).requires_grad_()
        rast, _ = dr.rasterize(CONTEXT, pos, TWO, (16, 16))
        color, _ = dr.interpolate(attr, rast, TWO)
        dr.antialias(color, rast, pos, TWO).mean().backward()
        (expected,) = torch.autograd.grad(dr.interpolate(attr, rast.detach(), TWO)[0].mean(), attr)
        torch.testing.assert_close(attr.grad, expected)


def test_the_derivative_in_colours_is_that_of_the_value():
    pos = scenes.clip(scenes.CUBE.double())
    rast, _ = dr.rasterize(CONTEXT, pos, scenes.CUBE_FACES, (6, 6))
    color = torch.rand((1, 6, 6, 2), dtype=torch.float64, generator=torch.Generator().manual_seed(1)).requires_grad_()
    assert torch.autograd.gradcheck(lambda c: dr.antialias(c, rast, pos, scenes.CUBE_FACES), color)


def test_the_boost_is_a_factor():
    grads = []
    for boost in (1.0, 3.0):
        pos = scenes.clip(scenes.CUBE).requires_grad_()
        mask(pos, scenes.CUBE_FACES, pos_gradient_boost=boost)[:, 10:].sum().backward()
        grads.append(pos.grad)
    assert grads[0].abs().max() > 0.1
    torch.testing.assert_close(grads[1], 3 * grads[0])


def test_a_topology_that_is_kept_changes_nothing():
    pos = scenes.clip(scenes.CUBE)
    kept = dr.antialias_construct_topology_hash(scenes.CUBE_FACES)
    torch.testing.assert_close(
        mask(pos, scenes.CUBE_FACES, topology_hash=kept), mask(pos, scenes.CUBE_FACES), rtol=0, atol=0
    )


def test_ranges_are_images_of_their_own():
    """Two cubes in one table, one of them turned; an image of both, of each, and of none."""
    pos = torch.cat([scenes.clip(scenes.CUBE), scenes.clip(scenes.CUBE, (0.1, 0.2, 0.8))], dim=1)
    tri = torch.cat([scenes.CUBE_FACES, scenes.CUBE_FACES + 8])
    ranges = torch.tensor([[0, 24], [0, 12], [12, 12], [2, 0]], dtype=torch.int32)
    rast, _ = dr.rasterize(CONTEXT, pos[0], tri, (24, 24), ranges=ranges)
    image = dr.antialias((rast[..., 3:] > 0).float(), rast, pos[0], tri)
    for b, (first, count) in enumerate(ranges.tolist()):
        torch.testing.assert_close(image[b], mask(pos, tri[first : first + count], (24, 24))[0])


def test_a_peeled_layer_has_outlines_of_its_own():
    """A cube's back has the outline of its front."""
    turned = scenes.CUBE @ scenes.rotation(torch.tensor([0.4, 0.6, 0.1])).T
    for layer in range(2):
        scale = torch.ones((), requires_grad=True)
        pos = flat(scale * turned)
        with dr.DepthPeeler(CONTEXT, pos, scenes.CUBE_FACES, (48, 48)) as peeler:
            for _ in range(layer + 1):
                rast, _ = peeler.rasterize_next_layer()
        area = dr.antialias((rast[..., 3:] > 0).float(), rast, pos, scenes.CUBE_FACES).sum()
        area.backward()
        assert scale.grad.item() == pytest.approx(2 * area.item(), rel=0.05)


def test_positions_of_one_image_and_of_ranges_are_alike():
    """The shape of `pos` says which, whatever `rasterize` was given."""
    pos, whole = scenes.clip(scenes.CUBE), torch.tensor([[0, 12]], dtype=torch.int32)
    batch = dr.rasterize(CONTEXT, pos, scenes.CUBE_FACES, (24, 24))[0]
    ranges = dr.rasterize(CONTEXT, pos[0], scenes.CUBE_FACES, (24, 24), ranges=whole)[0]
    color = (batch[..., 3:] > 0).float()
    images = [dr.antialias(color, r, p, scenes.CUBE_FACES) for r in (batch, ranges) for p in (pos, pos[0])]
    for image in images[1:]:
        torch.testing.assert_close(image, images[0])


def test_infinite_colours_stay():
    pos = scenes.clip(scenes.CUBE).requires_grad_()
    rast, _ = dr.rasterize(CONTEXT, pos, scenes.CUBE_FACES, (24, 24))
    color = torch.where(rast[..., 3:] > 0, 1.0, torch.inf)
    assert dr.antialias(color, rast, pos, scenes.CUBE_FACES)[0, 0, 0] == torch.inf


def test_nothing_in_view_stays_as_it_is():
    pos = scenes.clip(scenes.CUBE, shift=(0, 0, 5.0)).requires_grad_()
    rast, _ = dr.rasterize(CONTEXT, pos, scenes.CUBE_FACES, (8, 8))
    color = torch.rand(1, 8, 8, 3)
    image = dr.antialias(color, rast, pos, scenes.CUBE_FACES)
    torch.testing.assert_close(image, color)
    image.sum().backward()


COLOR = torch.zeros(1, 8, 8, 3)
RAST = dr.rasterize(CONTEXT, scenes.TRIANGLE, scenes.ONE, (8, 8))[0]


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"color": COLOR[0]}, r"color has shape \(8, 8, 3\) and dtype float32; expected a tensor \(images"),
        ({"color": COLOR[:, :4]}, r"shapes are color \(1, 4, 8, 3\), rast \(1, 8, 8, 4\)"),
        ({"rast": RAST[..., :2]}, "rast has shape"),
        ({"pos": scenes.TRIANGLE.expand(2, -1, -1)}, "expected as many images"),
        ({"tri": scenes.ONE + 1}, "tri names rows 1 to 3"),
        ({"pos": scenes.TRIANGLE * torch.inf}, r"pos\[0, 0, .\] is NaN or infinite"),
        ({"color": COLOR[..., :0]}, r"color has shape \(1, 8, 8, 0\)"),
        ({"topology_hash": scenes.ONE}, "expected what antialias_construct_topology_hash gave"),
        ({"topology_hash": dr.antialias_construct_topology_hash(TWO)}, "topology_hash is of other triangles"),
    ],
)
def test_wrong_arguments_are_refused_in_one_line(changes, message):
    given = {"color": COLOR, "rast": RAST, "pos": scenes.TRIANGLE, "tri": scenes.ONE}
    with pytest.raises(rts.InputError, match=message) as error:
        dr.antialias(**(given | changes))
    assert "\n" not in str(error.value)
