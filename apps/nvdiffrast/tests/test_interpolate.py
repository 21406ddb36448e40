"""`interpolate` against sums by hand, and what its docstring promises."""

import pytest
import rts_nvdiffrast.torch as dr
import scenes
import torch

import rts

SIZE = 12, 16
CONTEXT = dr.RasterizeCudaContext()
RAST, DB = dr.rasterize(
    CONTEXT, torch.cat([scenes.clip(scenes.CUBE), scenes.clip(scenes.CUBE, (0, 0.3, 0))]), scenes.CUBE_FACES, SIZE
)


def by_hand(attr, rast, db):
    """Attributes and changes of all of them at one pixel, from the corners' attributes (3, A)."""
    u, v = rast[:2].tolist()
    values = u * attr[0] + v * attr[1] + (1 - u - v) * attr[2]
    across, along = (db[i] * (attr[0] - attr[2]) + db[2 + i] * (attr[1] - attr[2]) for i in (0, 1))
    return values, torch.stack([across, along], dim=1).flatten()


@pytest.mark.parametrize("images", [None, 1, 2])
@pytest.mark.parametrize("chosen", ["all", [2, 0]])
def test_attributes_and_their_changes_are_weighted_sums(images, chosen):
    shape = (8, 3) if images is None else (images, 8, 3)
    attr = torch.rand(shape, generator=torch.Generator().manual_seed(1))
    values, changes = dr.interpolate(attr, RAST, scenes.CUBE_FACES, DB, chosen)
    columns = [0, 1, 2] if chosen == "all" else chosen
    assert values.shape == (2, *SIZE, 3) and changes.shape == (2, *SIZE, 2 * len(columns))
    covered = (RAST[..., 3] > 0).nonzero().tolist()
    assert 60 < len(covered) < 2 * 12 * 16
    for b, y, x in covered:
        own = attr.expand(2, -1, -1)[b] if images != 2 else attr[b]
        corners = own[scenes.CUBE_FACES[int(RAST[b, y, x, 3]) - 1].long()]
        expected, expected_changes = by_hand(corners, RAST[b, y, x], DB[b, y, x])
        torch.testing.assert_close(values[b, y, x], expected)
        torch.testing.assert_close(changes[b, y, x], expected_changes.reshape(3, 2)[columns].flatten())
    assert not values[RAST[..., 3] == 0].any() and not changes[RAST[..., 3] == 0].any()


def test_changes_are_those_from_pixel_to_pixel():
    """Of a triangle that fills the image, by central differences of rendered pixels."""
    pos = torch.tensor([[[-16.0, -4, 0.1, 2], [16, -4, 0.2, 2], [0, 12, 0.3, 2.2]]], dtype=torch.float64)
    rast, db = dr.rasterize(CONTEXT, pos, scenes.ONE, (64, 64))
    values, changes = dr.interpolate(torch.eye(3, dtype=torch.float64), rast, scenes.ONE, db, "all")
    assert (rast[..., 3] > 0).all()
    across = (values[:, 1:-1, 2:] - values[:, 1:-1, :-2]) / 2
    along = (values[:, 2:, 1:-1] - values[:, :-2, 1:-1]) / 2
    torch.testing.assert_close(changes[:, 1:-1, 1:-1, 0::2], across, atol=1e-5, rtol=0)
    torch.testing.assert_close(changes[:, 1:-1, 1:-1, 1::2], along, atol=1e-5, rtol=0)


def test_derivatives_are_those_of_finite_differences():
    rast, db = (x[:1, 4:7, 5:9].double().detach() for x in (RAST, DB))
    attr = torch.rand((1, 8, 2), dtype=torch.float64, generator=torch.Generator().manual_seed(2)).requires_grad_()
    assert (rast[..., 3] > 0).any()
    weights = rast[..., :2].clone().requires_grad_()

    def values(attr, weights, db):
        whole = torch.cat([weights, rast[..., 2:]], dim=3)
        return dr.interpolate(attr, whole, scenes.CUBE_FACES, db, "all")

    assert torch.autograd.gradcheck(values, (attr, weights, db.clone().requires_grad_()))


@pytest.mark.parametrize("options", [{}, {"rast_db": DB}, {"diff_attrs": "all"}, {"rast_db": DB, "diff_attrs": []}])
def test_without_both_options_there_are_no_changes(options):
    values, changes = dr.interpolate(torch.rand(8, 2), RAST, scenes.CUBE_FACES, **options)
    assert values.shape == (2, *SIZE, 2) and changes.shape == (2, *SIZE, 0)


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"attr": torch.rand(8)}, r"attr has shape \(8,\) and dtype float32; expected a tensor \(images"),
        ({"attr": torch.rand(3, 8, 2)}, "attr has 3 images and rast 2; expected as many, or 1"),
        ({"attr": torch.rand(7, 2)}, "tri names rows 0 to 7; expected 0 to 6, as attr has"),
        ({"attr": torch.ones(8, 2, dtype=torch.int32)}, "dtype int32"),
        ({"rast": RAST[..., :3]}, "rast has shape"),
        ({"tri": scenes.CUBE_FACES[:2]}, "expected that of rasterize"),
        ({"rast_db": DB[:1]}, "rast_db has shape .* expected the same"),
        ({"diff_attrs": [2]}, r"diff_attrs is \[2\]; expected 'all', None or indices from 0 to 1"),
        ({"diff_attrs": "none"}, "diff_attrs is 'none'"),
        ({"diff_attrs": 1}, "diff_attrs is 1"),
    ],
)
def test_wrong_arguments_are_refused_in_one_line(changes, message):
    given = {"attr": torch.rand(8, 2), "rast": RAST, "tri": scenes.CUBE_FACES, "rast_db": DB, "diff_attrs": "all"}
    with pytest.raises(rts.InputError, match=message) as error:
        dr.interpolate(**(given | changes))
    assert "\n" not in str(error.value)
