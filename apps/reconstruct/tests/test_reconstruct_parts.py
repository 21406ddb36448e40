"""Each part of a reconstruction, by closed forms."""

import json

import numpy as np
import pytest
import trimesh
from rts_reconstruct import files, masks, measures, pictures, stages, starts, texturing, world
from rts_reconstruct.model import Model
from rts_reconstruct.saved import Saved
from seen_ellipsoid import CENTER, DISTANCE, RADII, SIZE, cameras, ellipsoid, images, on_white, views

import rts
from rts.tool_api.files import writing


def test_the_world_lies_where_the_cameras_look_and_they_see_the_same():
    found = world.around(cameras())
    np.testing.assert_allclose(found.center, CENTER, atol=1e-5)
    assert found.unit == pytest.approx(DISTANCE * np.sin(np.radians(20)))
    points = np.random.default_rng(0).normal(size=(20, 3))
    for camera in cameras():
        before, after = camera.project(found.outside(points), (SIZE, SIZE)), found.camera(camera)
        seen = after.project(points, (SIZE, SIZE))
        np.testing.assert_allclose(seen[:, :2], before[:, :2], atol=1e-6)
        np.testing.assert_allclose(found.unit * seen[:, 2], before[:, 2], atol=1e-6)
    np.testing.assert_allclose(found.inside(found.outside(points)), points, atol=1e-12)


def test_cameras_that_look_away_are_refused():
    turned = [rts.Camera.look_at(c, 2 * c - CENTER) for c in CENTER + DISTANCE * np.eye(3)]
    with pytest.raises(rts.InputError, match="look away"):
        world.around(turned)


def test_views_are_held_out_and_made_smaller_by_means():
    found = pictures.read(views(), SIZE // 2, 4)
    assert (found.numbers, len(found.held_out)) == ([0, 1, 2, 4, 5, 6, 3, 7], 2)
    expected = images()[3].reshape(SIZE // 2, 2, SIZE // 2, 2, 4).mean(axis=(1, 3))
    np.testing.assert_allclose(found.held_out[0].image, expected, atol=1e-6)
    assert found.outlined


def test_a_size_that_does_not_divide_cuts_the_rest():
    camera = cameras()[0]
    found = pictures.read(views()[:2], 11, 0)  # 32 = 3 · 10 + 2
    assert found.views[0].size == (10, 10)
    point = np.array([[0.2, 0.1, -0.1]])
    whole = np.asarray(camera.project(point + CENTER, (SIZE, SIZE)))[0, :2]
    small = np.asarray(found.views[0].camera.project(found.world.inside(point + CENTER), (10, 10)))[0, :2]
    np.testing.assert_allclose(small, whole / 3, atol=1e-6)


def test_masks_cut_the_object_out():
    masked = [rts.View(v.camera, on_white(v.image), mask=v.image[..., 3]) for v in views()]
    found = pictures.read(masked, SIZE, 0)
    assert found.outlined and found.views[0].mask is None
    alpha = images()[0][..., 3]
    np.testing.assert_allclose(found.views[0].image[..., 3], alpha, atol=1e-6)
    np.testing.assert_allclose(found.views[0].image[..., :3], on_white(images()[0]) * alpha[..., None], atol=1e-6)


def masked(black, change=on_white):
    """Views of which the first ones have black masks, and the others masks of the object."""
    return [
        rts.View(v.camera, change(v.image), mask=v.image[..., 3] * (i >= black), name=v.name)
        for i, v in enumerate(views())
    ]


def test_masks_that_are_black_in_half_of_the_views_are_refused_and_in_fewer_warned_of():
    for black in (4, 8):
        with pytest.raises(rts.InputError, match=f"black all over in {black} of 8 views .*0.png, 1.png, 2.png, …"):
            pictures.read(masked(black), SIZE, 0)
    with pytest.raises(rts.InputError, match="alpha or masks are black all over in 8 of 8"):
        pictures.read(views(lambda image: 0 * image), SIZE, 4)
    with pytest.warns(rts.errors.RtsWarning, match=r"black all over in 3 of 8 views \(0.png, 1.png, 2.png\) .*; what"):
        pictures.read(masked(3), SIZE, 0)


def test_masks_that_are_white_all_over_tell_no_object():
    def white(change):
        return [rts.View(v.camera, change(v.image), mask=np.ones((SIZE, SIZE), np.float32)) for v in views()]

    with pytest.warns(rts.errors.RtsWarning, match="white all over, so that they tell no object; colours alone"):
        assert not pictures.read(white(on_white), SIZE, 0).outlined
    noise = np.random.default_rng(0).random((SIZE, SIZE, 3)).astype(np.float32)
    with pytest.raises(rts.InputError, match="white all over, .* borders have no plain colour .* black outside of the"):
        pictures.read(white(lambda image: noise), SIZE, 0)


def test_pictures_without_alpha_need_a_plain_background():
    behind = np.array([0.2, 0.6, 0.4], np.float32)
    found = pictures.read(views(lambda image: image[..., :3] + (1 - image[..., 3:]) * behind), SIZE, 0)
    assert not found.outlined
    np.testing.assert_allclose(found.background, behind, atol=1e-6)
    noise = np.random.default_rng(0).random((SIZE, SIZE, 3)).astype(np.float32)
    with pytest.raises(rts.InputError, match="neither alpha nor masks, and the pictures' borders have no plain colour"):
        pictures.read(views(lambda image: noise), SIZE, 0)


@pytest.mark.parametrize("masked", [False, True])
def test_pixels_that_a_lens_leaves_no_picture_are_no_object_mask(tmp_path, masked):
    for i, image in enumerate(images()):
        rts.save_image(tmp_path / f"{i}.png", on_white(image))
        rts.save_image(tmp_path / f"mask_{i}.png", np.repeat(image[..., 3:] > 0.5, 3, axis=2).astype(np.float32))
    rts.save_views(tmp_path / "transforms.json", views())
    tree = json.loads((tmp_path / "transforms.json").read_text())
    for i, frame in enumerate(tree["frames"]):
        frame["k1"] = 0.5  # A pincushion: the corners of undistorted pictures are outside of those taken.
        if masked:
            frame["mask_path"] = f"mask_{i}.png"
    (tmp_path / "transforms.json").write_text(json.dumps(tree))
    loaded = rts.load_views(tmp_path, linear=False)
    assert (loaded[0].mask < 0.5).mean() > 2 * masks.OUTSIDE
    found = pictures.read(tmp_path, SIZE, 0)
    assert found.outlined == masked
    corner, middle = found.views[0].mask[0, 0], found.views[0].mask[SIZE // 2, SIZE // 2]
    assert (corner, middle) == (0, 1)  # Corners do not count, whatever the object's mask is.
    if masked:
        assert found.views[0].image[SIZE // 2, SIZE // 2, 3] == 1 and found.views[0].image[8, 0, 3] == 0


def test_the_hull_of_pictures_encloses_the_object():
    found = pictures.read(views(), SIZE, 0)
    hull = starts.start("hull", found)
    truth = 4 / 3 * np.pi * RADII.prod() / found.world.unit**3
    assert hull.is_watertight and 0.95 * truth < hull.volume < 1.5 * truth
    with pytest.raises(rts.InputError, match="start is 'hull'"):
        starts.start("hull", pictures.read(views(on_white), SIZE, 0))


def test_a_mesh_to_start_from_is_in_the_world_of_the_cameras(tmp_path):
    trimesh.creation.icosphere(1).apply_translation(CENTER).export(tmp_path / "ball.obj")
    found = pictures.read(views(), SIZE, 0)
    mesh = starts.start(tmp_path / "ball.obj", found)
    np.testing.assert_allclose(np.linalg.norm(mesh.vertices, axis=1), 1 / found.world.unit, rtol=1e-4)
    trimesh.creation.icosphere(1).apply_translation(CENTER + 50).export(tmp_path / "far.obj")
    with pytest.raises(rts.InputError, match="none of 8 views sees anything of the start"):
        starts.start(tmp_path / "far.obj", found)


def ball(count=3):
    """A ball with colours that are linear in the positions."""
    mesh = trimesh.creation.icosphere(count)
    vertices = np.asarray(mesh.vertices, np.float32)
    colors = np.stack([0.5 + 0.4 * vertices[:, i] for i in range(3)], axis=1)
    return Model(vertices, np.asarray(mesh.faces, np.int32), colors, np.zeros((8, 6), np.float32))


def test_remeshing_keeps_shape_and_colours():
    model = stages.remeshed(ball(), 3000)
    mesh = trimesh.Trimesh(model.vertices, model.faces, process=False)
    assert mesh.is_watertight and 2000 < len(model.faces) < 4500
    assert mesh.volume == pytest.approx(4.1, abs=0.1)
    np.testing.assert_allclose(model.colors, 0.5 + 0.4 * model.vertices, atol=0.05)


def test_a_mesh_that_is_no_manifold_is_split():
    fan = np.array([[0, 1, 2], [0, 1, 3], [0, 1, 4]], np.int32)
    model = Model(np.eye(5, 3, dtype=np.float32), fan, np.zeros((5, 3), np.float32), np.zeros((1, 6), np.float32))
    with pytest.warns(rts.errors.RtsWarning, match="no manifold"):
        assert len(stages.remeshed(model, 50).faces) == 48


def test_a_baked_texture_looks_like_the_colours():
    model = ball()
    baked = texturing.baked(model, 256)
    camera = rts.Camera.look_at((0, 0.5, 3), (0, 0, 0), fov_y=45)
    pair = [np.asarray(rts.render(m.part, camera, (64, 64))) for m in (model, baked)]
    assert np.abs(pair[0] - pair[1]).mean() < 0.005  # Averages of texels mix charts at seams.
    np.testing.assert_allclose(baked.atlas.colors(model.faces, len(model.vertices)), model.colors, atol=0.03)


def written(folder, model):
    return files.write_mesh(folder, model, pictures.read(views(), SIZE, 0))


def test_a_mesh_without_a_texture_leaves_no_texture_of_an_earlier_run(tmp_path):
    model = ball(1)
    names = {"mesh.obj", "mesh.glb", "mesh.mtl", "texture.png"}
    assert {file.name for file in written(tmp_path, texturing.baked(model, 64))} == names
    assert {file.name for file in tmp_path.iterdir()} == names
    assert {file.name for file in written(tmp_path, model)} == {"mesh.obj", "mesh.glb"}
    assert {file.name for file in tmp_path.iterdir()} == {"mesh.obj", "mesh.glb"}


def test_a_full_disk_leaves_the_last_mesh_as_it_was(tmp_path):
    resource = pytest.importorskip("resource")
    written(tmp_path, ball(1))
    before = {file.name: file.read_bytes() for file in tmp_path.iterdir()}
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, limits[1]))
    try:
        with pytest.raises(rts.InputError, match=r"cannot be written \(File too large\)") as caught:
            with writing(tmp_path):
                written(tmp_path, ball(4))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert "\n" not in str(caught.value)
    assert {file.name: file.read_bytes() for file in tmp_path.iterdir()} == before


def test_motions_of_a_world_are_motions_of_the_data_set():
    found = world.around(cameras())
    matrix = np.asarray(rts.rigid(np.array([0.2, -0.1, 0.3, 0.5, 0.1, -0.4])))
    points = np.random.default_rng(0).normal(size=(5, 3))
    moved = points @ matrix[:3, :3].T + matrix[:3, 3]
    outer = found.motion(matrix)
    np.testing.assert_allclose(found.outside(points) @ outer[:3, :3].T + outer[:3, 3], found.outside(moved), atol=1e-6)


def test_ssim_of_plain_pictures_is_its_closed_form():
    a, b = np.full((20, 20, 3), 0.25), np.full((20, 20, 3), 0.5)
    assert measures.ssim(a, a) == pytest.approx(1)
    assert measures.ssim(a, b) == pytest.approx((2 * 0.25 * 0.5 + 1e-4) / (0.25**2 + 0.5**2 + 1e-4))
    noise = np.random.default_rng(0).random((40, 40, 3))
    assert measures.ssim(noise, 1 - noise) < 0


def test_measures_of_the_truth_are_best():
    found = pictures.read(views(), SIZE, 4)
    theta = ellipsoid().theta
    inside = found.world.inside(theta["vertices"]).astype(np.float32)
    poses = np.zeros((8, 6), np.float32)
    model = Model(inside, ellipsoid().surface.faces, theta["colors"], poses)
    rows = measures.measured(model, found)
    assert [row.held_out for row in rows] == [False] * 6 + [True] * 2
    assert min(row.psnr for row in rows) > 45 and min(row.iou for row in rows) > 0.99
    worse = measures.measured(model._replace(vertices=1.2 * inside), found)
    assert max(row.psnr for row in worse) < 25 and max(row.iou for row in worse) < 0.85


def test_what_is_kept_is_read_again_and_refused_for_other_settings(tmp_path):
    model = texturing.baked(ball(1), 16)
    Saved(tmp_path, {"seed": 0}).write(model, [[1.0, 0.5]], 3.0, np.array([0.1, -0.1]))
    again, losses, seconds, exposures = Saved(tmp_path, {"seed": 0}).read()
    assert (losses, seconds, exposures.tolist()) == ([[1.0, 0.5]], 3.0, [0.1, -0.1])
    Saved(tmp_path, {"seed": 0}).write(model, [[1.0, 0.5]], 3.0)
    assert Saved(tmp_path, {"seed": 0}).read()[3] is None
    np.testing.assert_array_equal(again.atlas.texture, model.atlas.texture)
    with pytest.raises(rts.InputError, match="seed was 0"):
        Saved(tmp_path, {"seed": 1}).read()
    (tmp_path / "stages.npz").write_bytes(b"PK")
    with pytest.raises(rts.InputError, match="damaged"):
        Saved(tmp_path, {"seed": 0}).read()
