"""Pictures of any brightness, .hdr and .exr."""

import numpy as np
import pytest

import rts
from rts import InputError

pytestmark = pytest.mark.files

IMAGE = (np.random.default_rng(0).random((5, 9, 3)) ** 4 * 60).astype(np.float32)
IMAGE[0, 0] = 0
HEAD = b"#?RADIANCE\n# a remark\nFORMAT=32-bit_rle_rgbe\nEXPOSURE=2\n\n-Y 1 +X 8\n"


def test_hdr_keeps_colours_to_a_256th_of_the_brightest_channel(tmp_path):
    rts.save_image(tmp_path / "new" / "a.hdr", IMAGE)
    again = rts.load_image(tmp_path / "new" / "a.hdr")
    assert again.shape == (5, 9, 4) and again.dtype == np.float32 and (again[..., 3] == 1).all()
    assert (abs(again[..., :3] - IMAGE) <= IMAGE.max(axis=2, keepdims=True) / 256).all()


def test_runs_of_hdr_are_read(tmp_path):
    # Each component: a run of eight; two literals and a run of six; literals; a run.
    lines = [bytes([136, 128]), bytes([2, 64, 32, 134, 16]), bytes([8, *range(8)]), bytes([136, 129])]
    (tmp_path / "a.hdr").write_bytes(HEAD + bytes([2, 2, 0, 8]) + b"".join(lines))
    red, green, blue, _ = rts.load_image(tmp_path / "a.hdr")[0].T
    # Mantissas / 256 times 2, over an exposure of 2.
    np.testing.assert_allclose(red, 128 / 256)
    np.testing.assert_allclose(green, np.array([64, 32, 16, 16, 16, 16, 16, 16]) / 256)
    np.testing.assert_allclose(blue, np.arange(8) / 256)


@pytest.mark.parametrize("body", [b"", bytes([2, 2, 0, 9]), bytes([2, 2, 0, 8, 200, 1]), bytes([2, 2, 0, 8, 3, 1])])
def test_damaged_hdr_is_refused(tmp_path, body):
    (tmp_path / "a.hdr").write_bytes(HEAD + body)
    with pytest.raises(InputError, match="a.hdr cannot be read as a picture"):
        rts.load_image(tmp_path / "a.hdr")


def test_other_kinds_of_hdr_are_refused(tmp_path):
    (tmp_path / "a.hdr").write_bytes(HEAD.replace(b"rgbe", b"xyze") + b"0")
    with pytest.raises(InputError, match="no Radiance picture of red, green and blue"):
        rts.load_image(tmp_path / "a.hdr")


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_exr_keeps_all(tmp_path, channels):
    pytest.importorskip("OpenEXR")
    image = np.random.default_rng(0).random((5, 9, channels)).astype(np.float32)
    rts.save_image(tmp_path / "a.exr", image)
    color = image[..., :3] if channels > 1 else image.repeat(3, axis=2)
    alpha = image[..., 3:] if channels == 4 else np.ones((5, 9, 1))
    np.testing.assert_array_equal(rts.load_image(tmp_path / "a.exr"), np.concatenate([color, alpha], axis=2))
    (tmp_path / "b.exr").write_bytes(b"no picture")
    with pytest.raises(InputError, match="b.exr cannot be read as a picture"):
        rts.load_image(tmp_path / "b.exr")


def test_exposure_compresses_bright_colours_of_a_png(tmp_path):
    rts.save_image(tmp_path / "a.png", np.full((2, 2, 3), 3.0), exposure=-1)
    assert 0.9 < rts.load_image(tmp_path / "a.png")[0, 0, 0] < 0.97
    with pytest.raises(InputError, match="expected None, but for colours in a .png"):
        rts.save_image(tmp_path / "a.hdr", IMAGE, exposure=1)
