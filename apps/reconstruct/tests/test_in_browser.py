"""The report, and a reconstruction that is watched, as a browser shows them."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from rts_reconstruct import files, measures, pictures, report
from rts_reconstruct.model import Model
from rts_reconstruct.verdict import Verdict
from seen_ellipsoid import SIZE, ellipsoid, images, views

import rts

sys.path.append(str(Path(__file__).parents[2] / "viewer/tests"))
pytest.importorskip("websockets")
from browser import Browser, program, until  # noqa: E402
from viewed import free_port  # noqa: E402

pytestmark = [
    pytest.mark.skipif(program() is None, reason="no browser on PATH; expected Debian's package chromium"),
    pytest.mark.thorough,
]
FETCHED = "performance.getEntriesByType('resource').filter(entry => !entry.name.startsWith('data:')).length"
LOADED = "[...document.images].map(image => image.complete && image.naturalWidth > 0)"


def share(picture, color, within=12):
    """The share of pixels of a colour."""
    return (np.abs(picture.astype(int) - color).max(axis=-1) <= within).mean()


def test_the_report_shows_pictures_differences_losses_and_measures(tmp_path):
    found = pictures.read(views(), SIZE, 4)
    theta = ellipsoid().theta
    inside = found.world.inside(theta["vertices"]).astype(np.float32)
    model = Model(inside, ellipsoid().surface.faces, theta["colors"], np.zeros((8, 6), np.float32))
    rows = measures.measured(model, found)
    files.write_turntable(tmp_path / "turntable.gif", model, found)
    losses = [[1.0, 0.5, 0.2], [0.3, 0.1]]
    told = Verdict(False, "overlap 0.9", ("b.png: look at <light>",))
    report.write_report(tmp_path / "report.html", model, found, rows, losses, "42 <faces>", told)
    with Browser(f"file://{tmp_path}/report.html", tmp_path / "profile") as browser:
        until(lambda: "Measures" in browser.text(), 60)
        loaded = until(lambda: (seen := browser.run(LOADED)) and all(seen) and seen, 30)
        assert len(loaded) == 1 + 3 * 2  # The turntable, and a picture, a render and a difference of two views.
        assert all(words in browser.text() for words in ("42 <faces>", "PSNR, dB", *told.findings))
        assert browser.run(FETCHED) == 0
        browser.run("document.images[1].scrollIntoView()")
        first = browser.picture()
        browser.run("document.querySelector('svg').scrollIntoView()")
        second = browser.picture()
    Image.fromarray(first).save(tmp_path / "report_views.png")
    Image.fromarray(second).save(tmp_path / "report_end.png")
    assert share(first, (128, 128, 128)) > 0.02  # A difference, which is grey where there is none.
    assert (np.abs(first[..., 0].astype(int) - first[..., 2]) > 60).mean() > 0.005  # The ends are red and blue.
    assert share(second, (0x25, 0x63, 0xEB)) > 0.0005  # The curve.
    assert share(second, (0xEE, 0xF4, 0xFF), 2) > 0.005  # Rows of views held out.


def test_a_reconstruction_is_watched_paused_and_stopped(tmp_path):
    pytest.importorskip("viser")
    photos, port = tmp_path / "photos", free_port()
    photos.mkdir()
    for i, image in enumerate(images()):
        rts.save_image(photos / f"{i}.png", image)
    rts.save_views(photos / "transforms.json", views())
    words = f"--quick --watch --port {port} --steps 100000 --size {SIZE} --texture 0 -o {tmp_path / 'out'}".split()
    command = [sys.executable, "-m", "rts", "reconstruct", str(photos), *words]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    try:
        assert process.stdout.readline() == f"http://127.0.0.1:{port} shows the fit\n"
        with Browser(f"http://127.0.0.1:{port}", tmp_path / "profile") as browser:
            until(lambda: "running at step" in browser.text(), 120)

            def colored():
                middle = browser.picture()[:, 320:760].astype(int)
                return (np.abs(middle[..., 0] - middle[..., 2]) > 40).mean() > 0.01

            until(colored, 120)  # The ellipsoid, whose ends are red and blue.
            browser.click("pause")
            until(lambda: "paused at step" in browser.text(), 60)
            Image.fromarray(browser.picture()).save(tmp_path / "watched.png")
            browser.click("go on")
            until(lambda: "running at step" in browser.text(), 60)
            browser.click("stop")
            until(lambda: "ended at step" in browser.text(), 120)
            browser.click("close")
            rest = process.communicate(timeout=120)[0]
        assert process.returncode == 0, rest
        assert f"http://127.0.0.1:{port} shows the result" in rest and (tmp_path / "out/mesh.glb").is_file()
    finally:
        process.kill()
        process.wait()
