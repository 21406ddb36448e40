"""Reconstructions from small pictures: each part by closed forms, then the whole, its files, and what it refuses."""

import csv
import json
import re
from functools import cache

import numpy as np
import pytest
import trimesh
from PIL import Image
from rts.cli.main import app
from typer.testing import CliRunner

import rts
import rts_reconstruct
from rts_reconstruct import measures, pictures, stages, starts, texturing, world
from rts_reconstruct.model import Model
from rts_reconstruct.saved import Saved

SIZE, DISTANCE, CENTER = 32, 4.0, np.array([3.0, -1.0, 2.0])
RADII = np.array([1.0, 0.75, 0.6])
TINY = dict(steps=9, size=SIZE, batch=3, held_out=4, texture=32, quick=True, progress=False)


def cameras(count=8):
    """Cameras all around CENTER."""
    z = 1 - (2 * np.arange(count) + 1) / count
    angle = np.pi * (1 + 5**0.5) * np.arange(count)
    ways = np.stack([np.cos(angle) * np.sqrt(1 - z * z), z, np.sin(angle) * np.sqrt(1 - z * z)], axis=1)
    return [rts.Camera.look_at(CENTER + DISTANCE * way, CENTER, fov_y=40, aspect=1.0) for way in ways]


@cache
def ellipsoid():
    """An ellipsoid about CENTER, red at one end and blue at the other."""
    mesh = trimesh.creation.icosphere(4)
    colors = np.stack([0.5 + 0.5 * mesh.vertices[:, 0], np.full(len(mesh.vertices), 0.3), 0.5 - 0.5 * mesh.vertices[:, 0]])
    theta = {"vertices": (CENTER + RADII * mesh.vertices).astype(np.float32), "colors": colors.T.astype(np.float32)}
    return rts.Part(rts.Mesh(mesh.faces), theta, "unlit")


@cache
def images():
    """Pictures of the ellipsoid, (H, W, 4)."""
    return [np.asarray(rts.render(ellipsoid(), c, (SIZE, SIZE), supersample=2)).clip(0, 1) for c in cameras()]


def views(change=lambda image: image):
    """Views of the ellipsoid, whose images `change` makes."""
    both = zip(cameras(), images(), strict=True)
    return [rts.View(camera, change(image), name=f"{i}.png") for i, (camera, image) in enumerate(both)]


def on_white(image):
    return image[..., :3] + 1 - image[..., 3:]


@pytest.fixture
def folder(tmp_path):
    """A folder of pictures as Blender has it."""
    path = tmp_path / "photos"
    path.mkdir()
    for i, image in enumerate(images()):
        rts.save_image(path / f"{i}.png", image)
    rts.save_views(path / "transforms.json", views())
    return path


# ------------------------------------------------------------------------------------------------------- parts


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
    found = pictures.read([rts.View(camera, images()[0])] * 2, 11, 0)  # 32 = 3 · 10 + 2
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


def test_pictures_without_alpha_need_a_plain_background():
    behind = np.array([0.2, 0.6, 0.4], np.float32)
    found = pictures.read(views(lambda image: image[..., :3] + (1 - image[..., 3:]) * behind), SIZE, 0)
    assert not found.outlined
    np.testing.assert_allclose(found.background, behind, atol=1e-6)
    noise = np.random.default_rng(0).random((SIZE, SIZE, 3)).astype(np.float32)
    with pytest.raises(rts.InputError, match="neither alpha nor masks, and their borders no plain colour"):
        pictures.read(views(lambda image: noise), SIZE, 0)


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
    with pytest.warns(rts.RtsWarning, match="no manifold"):
        assert len(stages.remeshed(model, 50).faces) == 48


def test_a_baked_texture_looks_like_the_colours():
    model = ball()
    baked = texturing.baked(model, 256)
    camera = rts.Camera.look_at((0, 0.5, 3), (0, 0, 0), fov_y=45)
    pair = [np.asarray(rts.render(m.part, camera, (64, 64))) for m in (model, baked)]
    assert np.abs(pair[0] - pair[1]).max() < 0.03
    np.testing.assert_allclose(baked.atlas.colors(model.faces, len(model.vertices)), model.colors, atol=0.03)


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
    poses = np.zeros((6, 6), np.float32)
    model = Model(inside, ellipsoid().surface.faces, theta["colors"], poses)
    rows = measures.measured(model, found)
    assert [row.held_out for row in rows] == [False] * 6 + [True] * 2
    assert min(row.psnr for row in rows) > 45 and min(row.iou for row in rows) > 0.99
    worse = measures.measured(model._replace(vertices=1.2 * inside), found)
    assert max(row.psnr for row in worse) < 25 and max(row.iou for row in worse) < 0.85


def test_what_is_kept_is_read_again_and_refused_for_other_settings(tmp_path):
    model = texturing.baked(ball(1), 16)
    Saved(tmp_path, {"seed": 0}).write(model, [[1.0, 0.5]], 3.0)
    again, losses, seconds = Saved(tmp_path, {"seed": 0}).read()
    assert (losses, seconds) == ([[1.0, 0.5]], 3.0)
    np.testing.assert_array_equal(again.atlas.texture, model.atlas.texture)
    with pytest.raises(rts.InputError, match="seed was 0"):
        Saved(tmp_path, {"seed": 1}).read()
    (tmp_path / "stages.npz").write_bytes(b"PK")
    with pytest.raises(rts.InputError, match="damaged"):
        Saved(tmp_path, {"seed": 0}).read()


# ----------------------------------------------------------------------------------------------------- the whole


class Watching:
    """A viewer that notes what it is shown, and asks to stop, or interrupts, at a step."""

    def __init__(self, stop=None, interrupt=None):
        self.stop, self.interrupt, self.calls, self.ended, self.views = stop, interrupt, [], 0, 0

    def begin(self, views):
        self.views = len(views)

    def step(self, number, loss, vertices, faces, colors):
        assert vertices.shape == colors.shape and faces.max() < len(vertices)
        self.calls.append((number, loss))
        if self.interrupt is not None and number >= self.interrupt:
            raise KeyboardInterrupt
        return self.stop is not None and number >= self.stop

    def end(self):
        self.ended += 1


@pytest.fixture
def no_pause(monkeypatch):
    monkeypatch.setattr("rts_reconstruct.reconstruction.PAUSE_S", 0.0)


@pytest.mark.thorough
def test_a_viewer_sees_steps_and_can_stop_them(tmp_path, no_pause):
    watch = Watching(stop=2)
    found = rts_reconstruct.reconstruct(views(), tmp_path, watch=watch, **TINY | {"texture": 0})
    assert ([number for number, _ in watch.calls], watch.ended, watch.views) == ([0, 1, 2], 1, 6)
    assert found.model.atlas is None and (tmp_path / "mesh.obj").is_file()


@pytest.mark.thorough
def test_files_hold_the_mesh_with_its_texture(folder, tmp_path):
    out = tmp_path / "out"
    run = CliRunner().invoke(
        app, f"reconstruct {folder} -o {out} --quick --steps 60 --size {SIZE} --texture 64 --held-out 4".split()
    )
    assert run.exit_code == 0, run.output
    assert re.search(r"PSNR \d+\.\d dB \(held-out views\)", run.output)
    part = rts.load(out / "mesh.obj")[0]
    mesh = trimesh.Trimesh(part.theta["vertices"], part.surface.faces, process=False)
    assert mesh.is_watertight and np.linalg.norm(mesh.centroid - CENTER) < 0.1
    assert mesh.volume == pytest.approx(4 / 3 * np.pi * RADII.prod(), rel=0.2)
    # Both files look like the pictures, whose colours load_image decodes.
    for name in ("mesh.obj", "mesh.glb"):
        image = np.asarray(rts.render(rts.load(out / name)[0].replace(shader="unlit"), cameras()[3], (SIZE, SIZE)))
        assert np.abs(image - images()[3]).mean() < 0.05, name
    rows = list(csv.DictReader((out / "views.csv").read_text().splitlines()))
    assert [row["held_out"] for row in rows] == list("00010001")
    assert all(float(row["psnr_db"]) > 20 and float(row["iou"]) > 0.9 for row in rows)
    page = (out / "report.html").read_text()
    assert page.count("data:image/png") == 6 and "<polyline" in page and "http" not in page
    with Image.open(out / "turntable.gif") as turning:
        assert turning.n_frames == 36


@pytest.mark.thorough
def test_an_interrupted_run_leaves_a_mesh_and_goes_on_as_if_it_had_not_been(tmp_path, no_pause):
    whole = rts_reconstruct.reconstruct(views(), tmp_path / "whole", **TINY)
    with pytest.raises(KeyboardInterrupt):
        rts_reconstruct.reconstruct(views(), tmp_path / "out", watch=Watching(interrupt=5), **TINY)
    first = (tmp_path / "out/mesh.obj").read_text()
    watch = Watching()
    again = rts_reconstruct.reconstruct(views(), tmp_path / "out", watch=watch, resume=True, **TINY)
    assert watch.calls[0][0] in (3, 4, 5)
    np.testing.assert_array_equal(again.model.vertices, whole.model.vertices)
    np.testing.assert_array_equal(again.model.atlas.texture, whole.model.atlas.texture)
    assert (tmp_path / "out/mesh.obj").read_text() != first


@pytest.mark.thorough
def test_a_plain_background_is_enough(tmp_path):
    options = TINY | {"steps": 90, "texture": 0}
    found = rts_reconstruct.reconstruct(views(on_white), tmp_path, **options)
    mesh = trimesh.Trimesh(found.pictures.world.outside(found.model.vertices), found.model.faces)
    assert mesh.volume == pytest.approx(4 / 3 * np.pi * RADII.prod(), rel=0.2)
    assert found.measures[0].iou is None and found.psnr > 20


@pytest.mark.thorough
def test_cameras_that_are_off_are_fitted(tmp_path):
    rng = np.random.default_rng(0)
    off = []
    for view in views():
        change = np.asarray(rts.rigid(np.concatenate([0.04 * rng.normal(size=3), 0.04 * rng.normal(size=3)])))
        off.append(rts.View(view.camera.replace(view=change @ view.camera.view), view.image))
    options = TINY | {"steps": 150, "held_out": 0, "texture": 0}
    kept = rts_reconstruct.reconstruct(off, tmp_path / "kept", **options)
    fitted = rts_reconstruct.reconstruct(off, tmp_path / "fitted", fit_cameras=True, **options)
    assert fitted.psnr > kept.psnr + 1


# ------------------------------------------------------------------------------------------------------- refused


def damaged(folder, change):
    tree = json.loads((folder / "transforms.json").read_text())
    change(tree)
    (folder / "transforms.json").write_text(json.dumps(tree))


def test_bad_input_is_one_line(folder, tmp_path):
    def told(*arguments):
        run = CliRunner().invoke(app, ["reconstruct", *map(str, arguments)])
        assert run.exit_code == 1 and run.stderr.count("\n") == 1, run.stderr
        return run.stderr

    assert "none" in told(tmp_path / "none")
    (tmp_path / "file").write_text("")
    assert "is a file; expected a folder" in told(folder, "-o", tmp_path / "file")
    out = ["-o", tmp_path / "out"]
    assert "expected a whole number, at least 3" in told(folder, *out, "--steps", 0)
    assert "expected three numbers, such as 1,1,1" in told(folder, *out, "--background", "red")
    assert "no file none.obj" in told(folder, *out, "--start", "none.obj")
    assert "at least 16 texels" in told(folder, *out, "--texture", 3)
    assert "left to fit; expected at least two" in told(folder, *out, "--held-out", 1)
    damaged(folder, lambda tree: tree.update(frames=tree["frames"][:1]))
    assert "1 view in" in told(folder, *out)
    assert not (tmp_path / "out").exists()
