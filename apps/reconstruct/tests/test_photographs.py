"""Pictures that come without masks, or with wrong ones: points, solids, outlines, verdicts."""

import dataclasses

import numpy as np
import pytest
import rts_reconstruct
import trimesh
from PIL import Image
from rts_reconstruct import (
    contradictions,
    detail,
    exposures,
    files,
    measures,
    outlining,
    pictures,
    points,
    posing,
    refining,
    sight,
    solid,
    texturing,
)
from rts_reconstruct.measures import measured
from rts_reconstruct.model import Model, moved_camera
from rts_reconstruct.points import Points
from rts_reconstruct.stages import Settings
from rts_reconstruct.verdict import verdict
from rts_reconstruct.world import World
from seen_ellipsoid import CENTER, RADII, SIZE, cameras, ellipsoid, images, on_white, views

import rts


def sphere(count=3000, radius=0.5, distance=3.0):
    """Points of a sphere about the origin, each seen by six cameras if its front faces them."""
    rng = np.random.default_rng(0)
    ways = rng.normal(size=(count, 3))
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    places = distance * np.concatenate([np.eye(3), -np.eye(3)])
    pairs = [(i, eye) for i, way in enumerate(ways) for eye in places if (eye - radius * way) @ way > 0.3]
    return Points(radius * ways, np.array([i for i, _ in pairs]), np.array([eye for _, eye in pairs]))


def truth():
    """The ellipsoid as a model, in the world of pictures about CENTER whose unit is 1."""
    ball = trimesh.creation.icosphere(3)
    colors = np.stack(
        [0.5 + 0.5 * ball.vertices[:, 0], np.full(len(ball.vertices), 0.3), 0.5 - 0.5 * ball.vertices[:, 0]]
    )
    poses = np.zeros((len(images()), 6), np.float32)
    return Model(np.float32(RADII * ball.vertices), np.int32(ball.faces), colors.T.astype(np.float32), poses)


def about(found, model):
    """A model about CENTER, in the world of pictures."""
    return model._replace(vertices=found.world.inside(CENTER + model.vertices).astype(np.float32))


# ----------------------------------------------------------------------------------------------------------- points


def test_the_region_is_about_the_densest_points_that_most_cameras_look_at():
    rng = np.random.default_rng(1)
    near, far = 0.3 * sphere().positions / 0.5, rng.uniform(-8, 8, size=(400, 3))
    found = points.region(Points(CENTER + np.concatenate([near, far]), np.zeros(1, int), np.zeros((1, 3))), views())
    np.testing.assert_allclose(found.center, CENTER, atol=0.05)
    assert 0.3 < found.unit < 0.4
    few = Points(CENTER + near[:50], np.zeros(1, int), np.zeros((1, 3)))
    assert points.region(few, views()) is None


def test_distances_of_points_are_in_percent_of_the_diagonal():
    ball = trimesh.creation.icosphere(5, radius=0.5)
    away = points.distances(sphere(radius=0.6), World(np.zeros(3), 1.0), ball.vertices, np.int32(ball.faces))
    np.testing.assert_allclose(away, 100 * 0.1 / np.sqrt(3), rtol=0.02)


def test_cameras_on_one_side_span_the_angle_between_them():
    pair = [
        rts.View(rts.Camera.look_at(eye, (0, 0, 0)), np.zeros((2, 2, 3), np.float32)) for eye in ((0, 0, 3), (3, 0, 0))
    ]
    assert points.span(pair, np.zeros(3)) == pytest.approx(90)


@pytest.mark.thorough
def test_what_lies_behind_points_is_a_solid():
    found = solid.solid_of(sphere())
    away = np.linalg.norm(found.vertices, axis=1) - 0.5
    assert found.is_watertight and np.abs(away).mean() < 0.5 * solid.CELL
    assert solid.solid_of(Points(np.full((1, 3), 5.0), np.zeros(1, int), np.full((1, 3), 9.0))) is None


# -------------------------------------------------------------------------------------------------- outlines, masks


def test_pixels_near_the_outline_of_a_solid_do_not_count():
    world, ball = World(CENTER, 1.0), trimesh.creation.icosphere(3, radius=0.6)
    view = outlining.cut_out(rts.View(cameras()[0], on_white(images()[0])), ball, world)
    alpha, counts = view.image[..., 3], view.mask
    assert alpha[SIZE // 2, SIZE // 2] == 1 and counts[SIZE // 2, SIZE // 2] == 1
    assert (alpha[0] == 0).all() and (counts[0] == 1).all()
    edges = np.abs(np.diff(alpha, axis=1)) > 0.5
    assert edges.any() and (counts[:, 1:][edges] == 0).all()


def test_masks_that_were_written_are_read_again_as_they_are_mended(tmp_path):
    world, ball = World(CENTER, 1.0), trimesh.creation.icosphere(3, radius=0.6)
    plain = views(on_white)
    outlining.write_masks(tmp_path, plain, range(len(plain)), ball, world)
    levels = np.array(Image.open(tmp_path / "0.png.png"))
    assert set(np.unique(levels)) == {outlining.BLACK, outlining.GREY, outlining.WHITE}
    levels[:4] = outlining.WHITE
    Image.fromarray(levels).save(tmp_path / "0.png.png")
    found = pictures.read(plain, SIZE, 0, masks=tmp_path)
    assert found.outlined and (found.views[0].image[:4, :, 3] == 1).all()
    np.testing.assert_array_equal(
        found.views[1].mask == 0, np.array(Image.open(tmp_path / "1.png.png")) == outlining.GREY
    )
    (tmp_path / "2.png.png").unlink()
    with pytest.raises(rts.InputError, match=r"lacks 1 of 8 masks: 2.png.png"):
        pictures.read(plain, SIZE, 0, masks=tmp_path)


def masked(inverted):
    """Views with masks, of which some are inverted."""
    return [
        rts.View(
            v.camera, on_white(v.image), name=v.name, mask=1 - v.image[..., 3] if i in inverted else v.image[..., 3]
        )
        for i, v in enumerate(views())
    ]


def test_inverted_masks_are_refused_with_a_name_and_the_polarity():
    with pytest.raises(
        rts.InputError, match=r"white along the border and black within in 8 of 8 views \(0.png.*expected white where"
    ):
        pictures.read(masked(range(8)), SIZE, 0)


def test_a_mask_that_contradicts_the_others_is_named():
    assert contradictions.contradictions(pictures.read(masked(()), SIZE, 0)) == ((), ())
    with pytest.warns(rts.errors.RtsWarning, match="look whether these are inverted"):
        one = pictures.read(masked([5]), SIZE, 0)
    (line,), liars = contradictions.contradictions(one)
    assert not liars
    assert "masks contradict each other:" in line  # Of so few views none is outvoted.
    more = []
    for i, camera in enumerate(cameras(20)):
        alpha = np.asarray(rts.render(ellipsoid(), camera, (SIZE, SIZE)))[..., 3]
        image = np.full((SIZE, SIZE, 3), 0.5, np.float32)
        more.append(rts.View(camera, image, name=f"{i}.png", mask=1 - alpha if i == 5 else alpha))
    with pytest.warns(rts.errors.RtsWarning, match="5.png"):
        several = pictures.read(more, SIZE, 0)
    (line,), liars = contradictions.contradictions(several)
    assert "show: 5.png (" in line and "expected" not in line and line.count(".png") == 1 and liars == (5,)
    rest = pictures.without(several, liars)
    assert [view.name for view in rest.views] == [view.name for view in rest.given]
    assert rest.numbers == [i for i in range(20) if i != 5]
    assert contradictions.consistency(several) < 0.5 and contradictions.consistency(rest) > 0.9


def test_masks_that_are_inexact_are_told_by_their_hull():
    def consistency(change):
        several = []
        for i, view in enumerate(views()):
            image = np.array(view.image)
            image[..., 3] = change(image[..., 3], i)
            several.append(rts.View(view.camera, image))
        return contradictions.consistency(pictures.read(several, SIZE, 0))

    assert consistency(lambda alpha, i: alpha) > 0.9
    assert consistency(lambda alpha, i: np.roll(alpha, 4 * (-1) ** i, axis=i // 2 % 2)) < contradictions.INEXACT
    assert contradictions.consistency(pictures.read(views(on_white), SIZE, 0)) == 1  # Without masks.


def test_masks_of_colmap_only_say_which_pixels_count():
    found = pictures.read(masked(()), SIZE, 0, np.ones(3), masks="ignore")
    assert not found.outlined
    np.testing.assert_allclose(found.views[0].mask, images()[0][..., 3], atol=1e-6)


@pytest.fixture(scope="module")
def misplaced():
    """Photographs of the ellipsoid before something green, their masks off by four pixels, and the right alpha."""
    size = (96, 96)
    y, x = np.mgrid[:96, :96] / 96
    behind = np.stack([0.2 * x, 0.5 + 0.4 * y, 0.3 * (1 - x)], axis=-1).astype(np.float32)
    found, truth = [], []
    for i, camera in enumerate(cameras()):
        image = np.asarray(rts.render(ellipsoid(), camera, size, background=behind)).clip(0, 1)
        alpha = np.asarray(rts.render(ellipsoid(), camera, size))[..., 3]
        mask = np.roll(alpha, 4 * (-1) ** i, axis=i // 2 % 2)
        found.append(rts.View(camera, image[..., :3], name=f"{i}.png", mask=mask))
        truth.append(alpha > 0.5)
    return found, truth


def test_masks_are_refined_to_the_edges_of_the_pictures(misplaced):
    views, truth = misplaced
    refined = [refining.refined(view).image for view in views]
    for image, view, right in zip(refined, views, truth, strict=True):
        alpha = image[..., 3] > 0.5
        assert (alpha & right).sum() / (alpha | right).sum() > 0.97
        rough = view.mask > 0.5
        assert (rough & right).sum() / (rough | right).sum() < 0.87
        np.testing.assert_array_equal(image[..., :3], view.image * alpha[..., None])
    again = [refining.refined(view).image for view in views]
    np.testing.assert_array_equal(refined, again)
    before, after = (contradictions.consistency(pictures.read(views, 96, 0, refine=refine)) for refine in (False, True))
    assert before < contradictions.INEXACT < after


def test_masks_are_refined_in_few_pixels_and_made_as_large_as_their_pictures(misplaced, monkeypatch):
    views, truth = misplaced
    monkeypatch.setattr(refining, "LARGEST", 48)
    alpha = refining.refined(views[0]).image[..., 3] > 0.5
    assert (alpha & truth[0]).sum() / (alpha | truth[0]).sum() > 0.93


def test_masks_without_a_side_stay_as_they_are(misplaced):
    view = misplaced[0][0]
    for mask in (np.ones(view.size), np.zeros(view.size)):
        plain = rts.View(view.camera, view.image, mask=mask.astype(np.float32))
        found = refining.refined(plain).image[..., 3]
        np.testing.assert_array_equal(found, mask)


def test_only_masks_are_refined_and_not_alpha_or_what_does_not_count(misplaced):
    shown = misplaced[0]
    assert pictures.read(shown, 96, 0).by_masks
    opaque = [rts.View(v.camera, np.concatenate([v.image, np.ones((96, 96, 1))], axis=2), mask=v.mask) for v in shown]
    assert pictures.read([*opaque[:3], *shown[3:]], 96, 0).by_masks  # Some of them with an alpha that tells nothing.
    refined = pictures.read([*opaque[:3], *shown[3:]], 96, 0, refine=True)
    assert refined.outlined and contradictions.consistency(refined) > contradictions.INEXACT
    assert not pictures.read(views(), SIZE, 0).by_masks
    assert not pictures.read(shown, 96, 0, np.ones(3), masks="ignore").by_masks


def test_masks_of_a_data_set_on_disk_are_refined(misplaced, tmp_path, capsys):
    """JPEG and masks beside, in folders whose pictures have the same names."""
    shown, truth = misplaced
    for i, view in enumerate(shown):
        for folder, pixels in (("images", view.image), ("masks", view.mask)):
            path = tmp_path / "set" / folder / f"{i // 4}" / (f"{i % 4}.jpg" + ".png" * (folder == "masks"))
            path.parent.mkdir(parents=True, exist_ok=True)
            Image.fromarray(np.uint8(255 * pixels)).save(path, quality=95)
    named = [rts.View(view.camera, view.image, name=f"{i // 4}/{i % 4}.jpg") for i, view in enumerate(shown)]
    rts.save_views(tmp_path / "set/sparse/0", named)
    quick = {"steps": 3, "size": 48, "texture": 0, "held_out": 0, "progress": False}
    rts_reconstruct.reconstruct(tmp_path / "set", tmp_path / "out", **quick)
    assert "outlines of masks were moved to edges of the pictures" in capsys.readouterr().err
    for i, right in enumerate(truth):
        with Image.open(tmp_path / f"out/masks/{i // 4}/{i % 4}.jpg.png") as mask:
            white = np.asarray(mask) > 128
        assert (white & right).sum() / (white | right).sum() > 0.9


def test_mended_masks_may_have_png_in_place_of_the_ending(misplaced, tmp_path):
    shown = [rts.View(view.camera, view.image, name=f"{i}.jpg") for i, view in enumerate(misplaced[0])]
    for i, view in enumerate(misplaced[0]):
        Image.fromarray(np.uint8(255 * view.mask)).save(tmp_path / (f"{i}.png" if i % 2 else f"{i}.jpg.png"))
    found = pictures.read(shown, 96, 0, masks=tmp_path)
    for one, other in zip(found.views, misplaced[0], strict=True):
        np.testing.assert_array_equal(one.image[..., 3] > 0.5, np.uint8(255 * other.mask) > 128)
    (tmp_path / "3.png").unlink()
    with pytest.raises(rts.InputError, match=r"lacks 1 of 8 masks: 3.jpg.png"):
        pictures.read(shown, 96, 0, masks=tmp_path)


def test_masks_of_pictures_without_names_are_numbered_as_in_the_data_set(misplaced, tmp_path):
    shown = [rts.View(view.camera, view.image, mask=view.mask) for view in misplaced[0]]
    found = pictures.read(shown, 96, 3, refine=True)
    outlining.write_alphas(tmp_path, found.given, found.numbers)
    mended = pictures.read(shown, 96, 3, masks=tmp_path)
    for one, other in zip(found.views + found.held_out, mended.views + mended.held_out, strict=True):
        np.testing.assert_array_equal(one.image[..., 3], other.image[..., 3])


def test_a_reconstruction_refines_masks_and_writes_them_to_be_looked_at(misplaced, tmp_path, capsys):
    views, truth = misplaced
    quick = {"steps": 3, "size": 48, "texture": 0, "held_out": 0, "progress": False}
    rts_reconstruct.reconstruct(views, tmp_path / "out", **quick)
    assert "outlines of masks were moved to edges of the pictures" in capsys.readouterr().err
    with Image.open(tmp_path / "out" / "masks" / "0.png.png") as mask:
        white = np.asarray(mask) > 128
    assert (white & truth[0]).sum() / (white | truth[0]).sum() > 0.97
    mended = pictures.read(views, 96, 0, masks=tmp_path / "out" / "masks")
    np.testing.assert_array_equal(mended.views[0].image[..., 3] > 0.5, white)
    assert mended.views[0].mask.min() == 1  # Their own masks are not used.


def test_without_opencv_inexact_masks_stay_and_the_extra_is_named(misplaced, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(refining, "is_installed", lambda: False)
    quick = {"steps": 3, "size": 48, "texture": 0, "held_out": 0, "progress": False}
    rts_reconstruct.reconstruct(misplaced[0], tmp_path / "out", **quick)
    said = capsys.readouterr().err
    assert "OpenCV (the extra photos)" in said and "large differences count less" in said
    assert not (tmp_path / "out" / "masks").exists()


# ------------------------------------------------------------------------------------------------ verdict, texture


def test_a_verdict_tells_a_blob_from_what_looks_like_the_pictures():
    found = pictures.read(views(), SIZE, 0)
    settings = Settings(4, 0, False, "mesh", False)
    fine, small = about(found, truth()), about(found, truth()._replace(vertices=0.4 * truth().vertices))
    rows = measured(fine, found)
    told = verdict(fine, found, rows, [[1.0] * 20 + [0.1] * 20], 0.0, settings)
    assert not told.blob and told.findings == () and "no fault was found" in str(told)
    blob = verdict(small, found, measured(small, found), [[1.0] * 40], 0.0, settings)
    assert blob.blob and "not a reconstruction" in str(blob) and "give more --steps, or another --start" in str(blob)
    lying = verdict(small, found, measured(small, found), [[1.0] * 40], 0.0, settings._replace(robust=True))
    assert "masks contradict each other" in str(lying)


def test_a_focal_length_is_a_factor_on_the_camera():
    camera = rts.Camera.look_at((0, 0, 4), (0, 0, 0), fov_y=40, aspect=1.0)
    moved = moved_camera(truth()._replace(focal=np.float32([np.log(1.1)])).cameras, camera, 0)
    point = np.array([[0.3, -0.2, 0.5]], np.float32)
    before, after = (np.asarray(c.project(point, (100, 100)))[0, :2] - 50 for c in (camera, moved.map(np.asarray)))
    np.testing.assert_allclose(after, 1.1 * before, rtol=1e-5)


def test_cameras_that_are_anchored_see_the_same_and_are_where_they_were():
    found = pictures.read(views(), SIZE, 0)
    model = about(found, truth())
    motion = np.float32([0.1, -0.2, 0.15, 0.05, 0.1, -0.1])
    away = model._replace(poses=np.repeat(motion[None], len(model.poses), axis=0))
    back = posing.anchored(away, found)
    np.testing.assert_allclose(back.poses, 0, atol=1e-5)
    for view in found.views[:3]:
        seen = [
            np.asarray(moved_camera(m.cameras, view.camera, 0).map(np.asarray).project(m.vertices, view.size))[:, :2]
            for m in (away, back)
        ]
        np.testing.assert_allclose(seen[0], seen[1], atol=1e-3)


def test_colours_that_no_view_sees_come_from_beside():
    mesh = trimesh.creation.icosphere(2)
    colors = np.where(mesh.vertices[:, :1] > 0, [[1.0, 0, 0]], [[0, 0, 1.0]]).astype(np.float32)
    model = Model(np.float32(mesh.vertices), np.int32(mesh.faces), colors, np.zeros((1, 6), np.float32))
    known = np.abs(mesh.vertices[:, 0]) > 0.5
    found = sight.filled(model, known).colors
    np.testing.assert_array_equal(found[known], colors[known])
    assert (found[~known] >= -1e-5).all() and (found[~known] <= 1 + 1e-5).all()
    middle = np.abs(mesh.vertices[:, 0]) < 1e-6
    np.testing.assert_allclose(found[middle][:, [0, 2]].mean(axis=0), 0.5, atol=0.05)
    assert sight.unseen_share(model, known) == pytest.approx(0.5, abs=0.2)


def test_what_no_view_sees_of_a_ball_is_cut_away():
    radius, distance = 0.5, 2.0
    ball = trimesh.creation.icosphere(5, radius=radius)
    camera = rts.Camera.look_at((0, 0, distance), (0, 0, 0), fov_y=40, aspect=1.0)
    image = np.ones((128, 128, 4), np.float32)
    one = dataclasses.replace(pictures.read(views(), SIZE, 0), views=[rts.View(camera, image)])
    model = Model(np.float32(ball.vertices), np.int32(ball.faces), np.float32(ball.vertices), np.zeros((1, 6)))
    known = sight.seen(model, one)
    rest, still, cut = sight.trimmed(model, known)
    # The angle at the ball's centre where normals and ways to the camera meet at a cosine of FACING.
    angle = np.arccos(sight.FACING) - np.arcsin(radius / distance * np.sqrt(1 - sight.FACING**2))
    assert cut == pytest.approx((1 + np.cos(angle)) / 2, abs=0.02)
    assert rest.vertices[:, 2].min() == pytest.approx(radius * np.cos(angle), abs=0.04)
    assert still.sum() == known.sum() and len(rest.vertices) == len(rest.colors) == rest.faces.max() + 1
    np.testing.assert_array_equal(rest.colors, rest.vertices)


def test_specks_are_cut_or_kept_with_what_surrounds_them():
    ball = trimesh.creation.icosphere(6)
    colors, poses = np.zeros((len(ball.vertices), 3), np.float32), np.zeros((1, 6), np.float32)
    model = Model(np.float32(ball.vertices), np.int32(ball.faces), colors, poses)
    right = ball.vertices[:, 0] > 0
    inward = ball.vertices @ (0.98, 0, np.sqrt(1 - 0.98**2))
    specked = right ^ (np.abs(inward) > np.cos(0.04))  # A dark speck among what is seen, and the reverse.
    assert (specked != right).sum() > 20
    np.testing.assert_array_equal(sight.trimmed(model, specked)[0].vertices, sight.trimmed(model, right)[0].vertices)
    whole, _, cut = sight.trimmed(model, np.zeros(len(right), bool))
    assert whole is model and cut == 0


@pytest.mark.thorough
def test_texels_that_no_pixel_tells_apart_are_averaged_by_their_weights():
    rng = np.random.default_rng(0)
    weights = np.ones((64, 64, 1), np.float32)
    weights[:, :8], weights[20:24, 20:24] = 0, 1e-3  # A chart's border, and texels that pictures hardly show.
    edge = np.zeros((64, 64, 3), np.float32)
    edge[:, 40:] = 0.5
    specks = np.where(weights < 1, 5, 0.1) * rng.choice([-1.0, 1.0], (64, 64, 3))
    found = texturing.without_specks(np.float32(edge + specks), weights, 4.0)
    inside = found[10:-10, 12:36]
    assert np.abs(inside).max() < 0.1 and inside.std() < 0.03
    np.testing.assert_allclose(found[:, 45:-5].mean((0, 1)), 0.5, atol=0.02)
    np.testing.assert_array_equal(found[:, :8], np.float32(edge + specks)[:, :8])
    np.testing.assert_allclose(texturing.without_specks(edge, weights, 0.0)[:, 8:], edge[:, 8:])


def test_a_horn_that_the_mesh_lacks_is_told():
    y, x = np.mgrid[:80, :80]
    body = (x - 40) ** 2 + (y - 45) ** 2 < 20**2
    horn = (abs(x - 40) < 2) & (y > 10) & (y < 40)
    speck = (x == 5) & (y == 5)
    whole = body | horn
    assert measures.longest_missing(whole | speck, body) == pytest.approx(15 / np.sqrt(whole.sum()), rel=0.1)
    assert measures.longest_missing(body, whole) == measures.longest_missing(body, body) == 0
    found = pictures.read(views(), SIZE, 0)
    model = about(found, truth())
    rows = measured(model, found)
    assert max(row.lacks for row in rows) < 0.03
    lacking = [row._replace(lacks=0.1) for row in rows[: len(rows) // 2 + 1]] + rows[len(rows) // 2 + 1 :]
    told = verdict(model, found, lacking, [[1.0] * 20 + [0.1] * 20], 0.0, Settings(4, 0, False, "mesh", False))
    assert not told.blob and "the mesh lacks parts that outlines show, such as in" in str(told)


def test_detail_of_the_pictures_as_they_are_is_added_to_the_texture():
    fine = 256
    stripes = np.float32([0.5, 0.5, 0.5]) * (1 + np.sign(np.sin(60 * np.linspace(0, 1, 256)))[None, :, None])
    ball = trimesh.creation.icosphere(4)
    way = ball.vertices / np.linalg.norm(ball.vertices, axis=1, keepdims=True)
    uv = np.float32(np.stack([0.5 + 0.5 * way[:, 0], 0.5 + 0.5 * way[:, 1]], axis=1))
    theta = {
        "vertices": np.float32(CENTER + RADII * ball.vertices),
        "uv": uv,
        "texture": np.repeat(stripes, 256, axis=0),
    }
    part = rts.Part(rts.Mesh(ball.faces), theta, "unlit")
    whole = [rts.View(c, np.asarray(rts.render(part, c, (fine, fine), supersample=2)).clip(0, 1)) for c in cameras()]
    found = pictures.read(whole, fine // 8, 0)
    grey = np.full((len(ball.vertices), 3), 0.5, np.float32)
    poses = np.zeros((len(whole), 6), np.float32)
    model = Model(np.float32(found.world.inside(theta["vertices"])), np.int32(ball.faces), grey, poses)
    plain = texturing.baked(model, 256)
    sharp = detail.detailed(plain, found)
    assert len(sharp.atlas.texture) >= 256
    errors = []
    for each in (plain, sharp):
        seen = np.asarray(rts.render(each.part, found.world.camera(whole[0].camera), (fine, fine)))
        inside = (seen[..., 3] == 1) & (whole[0].image[..., 3] == 1)
        errors.append(np.square(seen - whole[0].image)[inside][:, :3].mean())
    assert errors[1] < 0.6 * errors[0]


def test_what_a_run_that_was_killed_had_not_finished_is_removed(tmp_path):
    (tmp_path / ".new-abc").mkdir()
    (tmp_path / ".new-abc/mesh.obj").write_text("")
    (tmp_path / "mesh.obj").write_text("")
    files.forget_unfinished(tmp_path)
    assert [file.name for file in tmp_path.iterdir()] == ["mesh.obj"]


# ------------------------------------------------------------------------------------------------------- exposures


def test_exposures_that_differ_are_evened_out():
    logs = np.random.default_rng(0).uniform(-0.15, 0.15, len(images()))
    logs -= logs[[0, 1, 2, 4, 5, 6]].mean()  # The others are held out.
    factors = iter(np.exp(logs))
    taken = pictures.read(
        views(lambda image: image * np.append(np.full(3, next(factors)), 1).astype(np.float32)), SIZE, 4
    )
    model = about(taken, truth())
    found = exposures.exposures(model, taken)
    np.testing.assert_allclose(found, logs[taken.numbers], atol=0.01)
    even = exposures.evened(taken, found)
    for place, view in enumerate(even.views + even.held_out):
        image = images()[taken.numbers[place]]
        np.testing.assert_allclose(view.image, image, atol=0.01)
        np.testing.assert_allclose(even.given[place].image, image, atol=0.01)
    assert exposures.exposures(model, even) is None and exposures.evened(even, None) is even
    settings = Settings(4, 0, False, "mesh", False)
    told = verdict(model, even, measured(model, even), [[1.0] * 20 + [0.1] * 20], 0.0, settings)
    assert "exposures that differ by" in told.figures
    assert exposures.exposures(model, dataclasses.replace(taken, outlined=False)) is None  # Its background is one.


def test_a_shadow_on_less_than_half_of_a_picture_is_no_exposure():
    shaded = [np.array(image) for image in images()]
    for image in shaded[::2]:
        image[: 2 * SIZE // 5, :, :3] *= 0.7
    several = [rts.View(camera, image) for camera, image in zip(cameras(), shaded, strict=True)]
    found = pictures.read(several, SIZE, 0)
    assert exposures.exposures(about(found, truth()), found) is None
