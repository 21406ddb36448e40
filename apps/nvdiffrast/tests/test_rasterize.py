"""`rasterize` and `DepthPeeler` against closed forms, and what their docstrings promise."""

import numpy as np
import pytest
import rts_nvdiffrast.torch as dr
import scenes
import torch

import rts

SIZE = 24, 40


@pytest.fixture
def context():
    return dr.RasterizeCudaContext()


def test_a_triangle_is_its_closed_form(context):
    rast, db = dr.rasterize(context, scenes.TRIANGLE, scenes.ONE, SIZE)
    inside, expected, changes = scenes.closed_form(scenes.TRIANGLE[0], SIZE)
    assert 100 < inside.sum() < 800
    np.testing.assert_array_equal(rast[0, ..., 3].numpy(), inside)
    np.testing.assert_allclose(rast[0, ..., :3][inside], expected[inside], atol=1e-6)
    np.testing.assert_allclose(db[0][inside], changes[inside], atol=1e-6)
    assert not rast[0][~inside].any() and not db[0][~inside].any()


def test_row_0_is_the_bottom(context):
    low = torch.tensor([[[-1.0, -1.0, 0, 1], [1, -1, 0, 1], [0, -0.2, 0, 1]]])
    rast, _ = dr.rasterize(context, low, scenes.ONE, (16, 16))
    covered = rast[0, ..., 3].sum(dim=1)
    assert covered[0] > 10 and not covered[8:].any()


def test_the_nearer_triangle_is_shown_in_perspective_and_by_hand(context):
    square = torch.tensor([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    tri = torch.tensor([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]], dtype=torch.int32)
    for near in (0, 1):
        shifts = (-3.0, -4.0) if near == 0 else (-4.0, -3.0)
        pos = torch.cat([scenes.clip(square, (0, 0, 0), (0, 0, z)) for z in shifts], dim=1)
        middle = dr.rasterize(context, pos, tri, (8, 8))[0][0, 3:5, 3:5, 3]
        assert set(middle.flatten().tolist()) <= {2 * near + 1, 2 * near + 2}
        flat = torch.cat([pos[..., :2] / pos[..., 3:], pos[..., 2:3] / pos[..., 3:], torch.ones(1, 8, 1)], dim=2)
        rast, _ = dr.rasterize(context, flat, tri, (8, 8))
        assert set(rast[0, 3:5, 3:5, 3].flatten().tolist()) <= {2 * near + 1, 2 * near + 2}


def test_orthographic_and_perspective_show_the_same_of_one_picture(context):
    """A mesh seen after the division is the same picture, but for weights that are linear in the image."""
    pos = scenes.clip(scenes.CUBE)
    rast, _ = dr.rasterize(context, pos, scenes.CUBE_FACES, (32, 32))
    after, _ = dr.rasterize(context, pos / pos[..., 3:], scenes.CUBE_FACES, (32, 32))
    torch.testing.assert_close(rast[..., 3], after[..., 3])
    torch.testing.assert_close(rast[..., 2], after[..., 2], atol=1e-5, rtol=0)
    assert (rast[..., :2] - after[..., :2]).abs().max() > 0.01


def test_triangles_through_the_eye_are_cut_in_perspective(context):
    floor = torch.tensor([[-50.0, -1, 10], [50, -1, 10], [0, -1, -40]])
    rast, _ = dr.rasterize(context, scenes.clip(floor, (0, 0, 0), (0, 0, 0)), scenes.ONE, (16, 16))
    shown = rast[0, ..., 3] > 0
    assert shown[0].all() and not shown[8:].any()
    assert (rast[0, ..., 2][shown].abs() <= 1).all()


def test_beyond_the_near_and_the_far_plane_there_is_nothing(context):
    square = torch.tensor([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0]])
    for z, expected in ((-0.9, 0), (-1.1, 1), (-49, 1), (-51, 0)):
        pos = scenes.clip(square * 40, (0.001, 0.001, 0), (0, 0, z))
        assert bool(dr.rasterize(context, pos, scenes.ONE, (8, 8))[0][..., 3].any()) == expected, z


def test_ranges_are_images_of_their_own(context):
    pos = scenes.clip(scenes.CUBE)
    ranges = torch.tensor([[0, 4], [4, 8], [0, 12], [3, 0]], dtype=torch.int32)
    rast, db = dr.rasterize(context, pos[0], scenes.CUBE_FACES, SIZE, ranges=ranges)
    assert rast.shape == db.shape == (4, *SIZE, 4)
    for b, (first, count) in enumerate(ranges.tolist()):
        own, _ = dr.rasterize(context, pos, scenes.CUBE_FACES[first : first + count], SIZE)
        expected = torch.where(own[..., 3:] > 0, own + torch.tensor([0, 0, 0, first]), own)[0]
        torch.testing.assert_close(rast[b], expected)


def test_images_of_a_batch_are_those_of_each_alone(context):
    pos = torch.cat([scenes.clip(scenes.CUBE, (0.1 * i, 0.5, 0)) for i in range(3)])
    rast, db = dr.rasterize(context, pos, scenes.CUBE_FACES, SIZE)
    for b in range(3):
        own = dr.rasterize(context, pos[b : b + 1], scenes.CUBE_FACES, SIZE)
        torch.testing.assert_close((rast[b], db[b]), (own[0][0], own[1][0]))


def test_nothing_in_view_is_an_empty_image(context):
    none = torch.zeros((0, 3), dtype=torch.int32)
    for pos, tri in ((scenes.clip(scenes.CUBE, shift=(0, 0, 5.0)), scenes.CUBE_FACES), (scenes.TRIANGLE, none)):
        rast, db = dr.rasterize(context, pos.clone().requires_grad_(), tri, SIZE)
        assert not rast.any() and not db.any()
        (rast.sum() + db.sum()).backward()


class TestDerivatives:
    def test_u_and_v_and_their_changes(self, context):
        """Against finite differences in float64, at pixels that stay inside."""
        pos = scenes.TRIANGLE.double().requires_grad_()
        inside = dr.rasterize(context, scenes.TRIANGLE.double(), scenes.ONE, (6, 6))[0][..., 3] > 0

        def values(x):
            rast, db = dr.rasterize(context, x, scenes.ONE, (6, 6))
            return rast[inside][:, :2], db[inside]

        assert inside.sum() > 5
        assert torch.autograd.gradcheck(values, pos)

    def test_z_and_triangle_have_none(self, context):
        pos = scenes.TRIANGLE.clone().requires_grad_()
        dr.rasterize(context, pos, scenes.ONE, SIZE)[0][..., 2:].square().sum().backward()
        assert not pos.grad.any()

    def test_without_grad_db_the_changes_have_none(self, context):
        pos = scenes.TRIANGLE.clone().requires_grad_()
        assert dr.rasterize(context, pos, scenes.ONE, SIZE)[1].requires_grad
        rast, db = dr.rasterize(context, pos, scenes.ONE, SIZE, grad_db=False)
        assert rast.requires_grad and not db.requires_grad


class TestPeeling:
    def test_layers_come_front_to_back(self, context):
        pos = scenes.clip(scenes.CUBE)
        with dr.DepthPeeler(context, pos, scenes.CUBE_FACES, SIZE) as peeler:
            layers = [peeler.rasterize_next_layer()[0] for _ in range(3)]
        torch.testing.assert_close(layers[0], dr.rasterize(context, pos, scenes.CUBE_FACES, SIZE)[0])
        front, back, none = (layer[..., 3] > 0 for layer in layers)
        assert torch.equal(front, back) and not none.any()  # A convex body has two.
        assert (layers[1][..., 2][back] > layers[0][..., 2][back]).all()

    def test_outside_of_with_it_is_refused(self, context):
        peeler = dr.DepthPeeler(context, scenes.TRIANGLE, scenes.ONE, SIZE)
        with pytest.raises(rts.InputError, match="outside of `with"):
            peeler.rasterize_next_layer()


class TestArguments:
    @pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
    def test_dtype_and_shape(self, context, dtype):
        rast, db = dr.rasterize(context, scenes.TRIANGLE.to(dtype), scenes.ONE, list(SIZE))
        assert rast.dtype == db.dtype == dtype and rast.shape == db.shape == (1, *SIZE, 4)
        assert rast.is_contiguous() and db.is_contiguous()

    def test_indices_of_64_bits_do(self, context):
        pairs = (dr.rasterize(context, scenes.TRIANGLE, scenes.ONE.to(d), SIZE)[0] for d in (torch.int32, torch.int64))
        torch.testing.assert_close(*pairs)

    def test_an_opengl_context_is_the_same(self, context):
        other = dr.RasterizeGLContext(output_db=True, mode="manual")
        other.set_context()
        torch.testing.assert_close(
            dr.rasterize(other, scenes.TRIANGLE, scenes.ONE, SIZE),
            dr.rasterize(context, scenes.TRIANGLE, scenes.ONE, SIZE),
        )
        other.release_context()

    @pytest.mark.parametrize(
        "changes, message",
        [
            ({"glctx": None}, "glctx is NoneType; expected a RasterizeCudaContext"),
            (
                {"pos": scenes.TRIANGLE[..., :3]},
                r"pos has shape \(1, 3, 3\) and dtype float32; expected a tensor \(images",
            ),
            ({"pos": scenes.TRIANGLE.half()}, "dtype float16"),
            ({"pos": scenes.TRIANGLE.numpy()}, "pos is ndarray"),
            ({"tri": scenes.ONE.float()}, "tri has shape .* dtype float32; expected a tensor"),
            ({"tri": scenes.ONE + 1}, "tri names rows 1 to 3; expected 0 to 2, as pos has"),
            ({"tri": scenes.ONE[0]}, r"tri has shape \(3,\)"),
            ({"resolution": 16}, r"resolution is 16; expected \(height, width\)"),
            ({"resolution": (16, 0)}, r"resolution is \(16, 0\)"),
            ({"resolution": (8.9, 16)}, r"resolution is \(8.9, 16\)"),
            ({"pos": scenes.TRIANGLE * torch.nan}, r"pos\[0, 0, 0\] is NaN or infinite"),
            ({"pos": scenes.TRIANGLE[:0]}, r"pos has shape \(0, 3, 4\)"),
            (
                {"pos": scenes.TRIANGLE[0], "ranges": torch.zeros((0, 2), dtype=torch.int32)},
                r"ranges has shape \(0, 2\)",
            ),
            ({"pos": scenes.TRIANGLE[0]}, "ranges is NoneType"),
            ({"pos": scenes.TRIANGLE[0], "ranges": torch.tensor([[0, 2]])}, "counts within 1 triangles"),
            ({"pos": scenes.TRIANGLE[0], "ranges": torch.tensor([0, 1])}, r"ranges has shape \(2,\)"),
        ],
    )
    def test_wrong_ones_are_refused_in_one_line(self, context, changes, message):
        given = {"glctx": context, "pos": scenes.TRIANGLE, "tri": scenes.ONE, "resolution": SIZE}
        with pytest.raises(rts.InputError, match=message) as error:
            dr.rasterize(**(given | changes))
        assert "\n" not in str(error.value)

    def test_levels_of_messages(self):
        before = dr.get_log_level()
        dr.set_log_level(3)
        assert dr.get_log_level() == 3
        dr.set_log_level(before)
        with pytest.raises(rts.InputError, match="level is 9"):
            dr.set_log_level(9)
