"""Reconstructions from small pictures: the whole, its files, and bad input."""

import csv
import http.client
import json
import re
import socket
import struct
import sys
from contextlib import closing

import numpy as np
import pytest
import rts_reconstruct
import trimesh
from PIL import Image
from seen_ellipsoid import CENTER, RADII, SIZE, cameras, images, on_white, views, written
from typer.testing import CliRunner

import rts
from rts_cli.main import app

TINY = dict(steps=9, size=SIZE, batch=3, held_out=4, texture=32, quick=True, progress=False)


@pytest.fixture
def folder(tmp_path):
    """A folder of pictures as Blender has it."""
    return written(tmp_path / "photos")


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
    monkeypatch.setattr("rts_reconstruct.run.PAUSE_S", 0.0)


@pytest.mark.thorough
def test_a_viewer_sees_steps_and_can_stop_them(tmp_path, no_pause):
    watch = Watching(stop=2)
    found = rts_reconstruct.reconstruct(views(), tmp_path, watch=watch, **TINY | {"texture": 0})
    assert ([number for number, _ in watch.calls], watch.ended, watch.views) == ([0, 1, 2], 1, 6)
    assert found.model.atlas is None and (tmp_path / "mesh.obj").is_file()


@pytest.mark.thorough
def test_black_masks_are_one_line_and_no_mesh(folder, tmp_path):
    tree = json.loads((folder / "transforms.json").read_text())
    rts.save_image(folder / "mask.png", np.zeros((SIZE, SIZE, 3), np.float32))
    for frame in tree["frames"]:
        frame["mask_path"] = "mask.png"
        rts.save_image(folder / frame["file_path"], on_white(rts.load_image(folder / frame["file_path"])))
    (folder / "transforms.json").write_text(json.dumps(tree))
    run = CliRunner().invoke(app, f"reconstruct {folder} -o {tmp_path / 'out'} --quick --size {SIZE}".split())
    assert run.exit_code == 1 and not (tmp_path / "out").exists()
    assert len(run.stderr.splitlines()) == 1 and "black all over in 8 of 8 views" in run.stderr


def gltf(path):
    """The tables of a binary glTF file."""
    data = path.read_bytes()
    return json.loads(data[20 : 20 + struct.unpack("<I", data[12:16])[0]])


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
    tables = gltf(out / "mesh.glb")
    assert "KHR_materials_unlit" in tables["extensionsUsed"]
    assert all("KHR_materials_unlit" in material["extensions"] for material in tables["materials"])
    page = (out / "report.html").read_text()
    assert page.count("data:image/png") == 6 and "<polyline" in page and "http:" not in page and "https:" not in page
    with Image.open(out / "turntable.gif") as turning:
        assert turning.n_frames == 36


@pytest.mark.thorough
def test_the_texture_is_fitted_to_pictures_of_twice_the_size(tmp_path, monkeypatch):
    sizes, fitted = [], rts_reconstruct.texturing.fitted

    def noted(model, known, pictures, *rest):
        sizes.extend(view.size for view in pictures.views)
        return fitted(model, known, pictures, *rest)

    monkeypatch.setattr(rts_reconstruct.texturing, "fitted", noted)
    options = TINY | {"size": SIZE // 4}
    found = rts_reconstruct.reconstruct(views(), tmp_path, **options)
    assert {view.size for view in found.pictures.views} == {(SIZE // 4, SIZE // 4)}
    assert sizes == [(SIZE // 2, SIZE // 2)] * len(found.pictures.views)


@pytest.mark.thorough
def test_what_pictures_from_above_do_not_see_is_cut_away(tmp_path):
    options = TINY | {"held_out": 0, "steps": 30}
    above = rts_reconstruct.reconstruct(views()[:4], tmp_path, **options)
    trimmed = rts_reconstruct.reconstruct(views()[:4], tmp_path, trim=True, resume=True, **options)
    meshes = [
        trimesh.Trimesh(found.pictures.world.outside(found.model.vertices), found.model.faces, process=False)
        for found in (above, trimmed)
    ]
    assert meshes[0].is_watertight and not meshes[1].is_watertight
    cut = 1 - meshes[1].area / meshes[0].area
    assert 0.1 < cut < 0.5 and f", {100 * cut:.0f} % cut away" in trimmed.verdict.figures
    assert f", {100 * cut:.0f} % cut away" in (tmp_path / "report.html").read_text()
    rest = (meshes[1].area_faces[:, None] * meshes[1].face_normals).sum(axis=0)
    assert rest[1] > 0.5 * np.linalg.norm(rest) > 0  # Of a closed mesh it is zero: what was cut away faced down.
    for name in ("mesh.obj", "mesh.glb"):
        part = rts.load(tmp_path / name)[0]
        assert len(part.surface.faces) == len(meshes[1].faces)
        image = np.asarray(rts.render(part.replace(shader="unlit"), cameras()[0], (SIZE, SIZE)))
        assert np.abs(image - images()[0]).mean() < 0.1
    with Image.open(tmp_path / "unseen.png") as unseen:
        assert (np.asarray(unseen) > 0).mean() < 0.05


@pytest.mark.thorough
@pytest.mark.parametrize("surface", ["mesh", "isosurface"])
def test_an_interrupted_run_leaves_a_mesh_and_goes_on_as_if_it_had_not_been(tmp_path, no_pause, surface):
    options = TINY | {"surface": surface}
    whole = rts_reconstruct.reconstruct(views(), tmp_path / "whole", **options)
    with pytest.raises(KeyboardInterrupt):
        rts_reconstruct.reconstruct(views(), tmp_path / "out", watch=Watching(interrupt=5), **options)
    first = (tmp_path / "out/mesh.obj").read_text()
    watch = Watching()
    again = rts_reconstruct.reconstruct(views(), tmp_path / "out", watch=watch, resume=True, **options)
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
def test_a_subdivision_surface_is_fitted_in_place_of_a_mesh(tmp_path):
    options = TINY | {"steps": 90, "texture": 0, "surface": "subdivision"}
    found = rts_reconstruct.reconstruct(views(), tmp_path, **options)
    mesh = trimesh.Trimesh(found.pictures.world.outside(found.model.vertices), found.model.faces)
    assert mesh.is_watertight and mesh.volume == pytest.approx(4 / 3 * np.pi * RADII.prod(), rel=0.1)
    assert found.psnr > 25
    # Smooth: neighbours of faces lean by little, as on a fine mesh of an ellipsoid.
    assert np.percentile(mesh.face_adjacency_angles, 99) < 0.5


@pytest.mark.thorough
def test_cameras_that_are_off_are_fitted(tmp_path):
    rng = np.random.default_rng(0)
    off = []
    for view in views():
        change = np.asarray(rts.rigid(np.concatenate([0.04 * rng.normal(size=3), 0.04 * rng.normal(size=3)])))
        off.append(rts.View(view.camera.replace(view=change @ view.camera.view), view.image, name=view.name))
    options = TINY | {"steps": 150, "held_out": 0, "texture": 0}
    kept = rts_reconstruct.reconstruct(off, tmp_path / "kept", **options)
    fitted = rts_reconstruct.reconstruct(off, tmp_path / "fitted", fit_cameras=True, **options)
    assert fitted.psnr > kept.psnr + 1
    # The cameras that were written see the mesh as those that were fitted.
    (tmp_path / "fitted/cameras/images").mkdir()
    for view in off:
        rts.save_image(tmp_path / f"fitted/cameras/images/{view.name}", view.image)
    again = rts.load_views(tmp_path / "fitted/cameras", split="all")
    mesh = rts.load(tmp_path / "fitted/mesh.obj")[0].replace(shader="unlit")
    for place, view in enumerate(again):
        seen = np.asarray(rts.render(mesh, view.camera, (SIZE, SIZE), supersample=2))
        expected = rts_reconstruct.measures.shown(fitted.model, fitted.pictures, place)
        np.testing.assert_allclose(seen[..., 3], expected[..., 3], atol=0.02)


@pytest.mark.thorough
def test_cameras_of_views_held_out_are_fitted_to_the_finished_mesh(tmp_path):
    shift = np.asarray(rts.rigid(np.array([0.03, -0.02, 0.03, 0.1, -0.05, 0.08])))
    off = views()
    off[3] = rts.View(off[3].camera.within(shift), off[3].image, name="3.png")  # One that is held out.
    options = TINY | {"steps": 150, "texture": 0}
    kept = rts_reconstruct.reconstruct(off, tmp_path / "kept", **options)
    fitted = rts_reconstruct.reconstruct(off, tmp_path / "fitted", fit_cameras=True, **options)
    by_number = [{row.number: row for row in found.measures} for found in (kept, fitted)]
    assert by_number[1][3].psnr > by_number[0][3].psnr + 5
    assert [rows[3].camera for rows in by_number] == ["given", "fitted"]
    assert "their cameras fitted" in repr(fitted) and "while the mesh stayed" in (fitted.files[-1]).read_text()


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
    assert "expected 'mesh', 'subdivision' or 'isosurface'" in told(folder, *out, "--surface", "nurbs")
    assert "no file none.obj" in told(folder, *out, "--start", "none.obj")
    assert "at least 16 texels" in told(folder, *out, "--texture", 3)
    assert "left to fit; expected at least two" in told(folder, *out, "--held-out", 1)
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        pytest.importorskip("viser")
        assert f"port {port} of 127.0.0.1 is in use" in told(folder, *out, "--watch", "--port", port)
    noise = np.random.default_rng(0).random((SIZE, SIZE, 3)).astype(np.float32)
    (tmp_path / "busy").mkdir()
    for i in range(len(images())):
        rts.save_image(tmp_path / f"busy/{i}.png", noise)
    rts.save_views(tmp_path / "busy/transforms.json", views())
    assert "neither alpha nor masks" in told(tmp_path / "busy", *out)
    damaged(folder, lambda tree: tree.update(frames=tree["frames"][:1]))
    assert "1 view in" in told(folder, *out)
    assert not (tmp_path / "out").exists()


# ---------------------------------------------------------------------------------------------------- the browser


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@pytest.mark.thorough
def test_a_fit_may_be_watched(folder, tmp_path, monkeypatch):
    viewer = pytest.importorskip("rts_viewer")
    pytest.importorskip("viser")
    steps, statuses = [], []

    def wait(watch):
        for name in ("127.0.0.1", "evil.example"):
            with closing(http.client.HTTPConnection("127.0.0.1", port, timeout=10)) as connection:
                connection.request("GET", "/", headers={"Host": name})
                statuses.append(connection.getresponse().status)
        watch.close()

    monkeypatch.setattr(viewer.Watch, "wait", wait)
    step = viewer.Watch.step
    monkeypatch.setattr(viewer.Watch, "step", lambda self, *a: (steps.append(a), step(self, *a))[1])
    words = ["--watch", "--port", str(port := free_port()), "--steps", "6", "--size", str(SIZE), "--texture", "0"]
    run = CliRunner().invoke(app, ["reconstruct", str(folder), "-o", str(tmp_path / "out"), "--quick", *words])
    assert run.exit_code == 0 and f"http://127.0.0.1:{port} shows the fit" in run.output
    assert f"http://127.0.0.1:{port} shows the result" in run.output and statuses == [200, 403]
    number, loss, vertices, faces, colors = steps[0]
    assert number == 0 and loss > 0 and faces.max() < len(vertices) == len(colors)
    np.testing.assert_allclose(colors, ((0.5 + 0.055) / 1.055) ** 2.4, rtol=1e-5)  # Grey, made linear.


def test_without_the_viewer_one_line_names_it(folder, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rts_viewer", None)
    run = CliRunner().invoke(app, ["reconstruct", str(folder), "-o", str(tmp_path / "out"), "--watch"])
    assert run.exit_code != 0 and "pip install ./apps/viewer" in str(run.exception) + run.output
