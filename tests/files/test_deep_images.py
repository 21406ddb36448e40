"""Pictures of 16 bits with colours: all of their bits are read, whatever the filters of their rows."""

import struct
import zlib

import numpy as np
import pytest
from PIL import Image

import rts
from rts.errors import InputError
from rts.files.images import read_image

pytestmark = pytest.mark.files

RNG = np.random.default_rng(0)
PASSES = [(0, 0, 8, 8), (0, 4, 8, 8), (4, 0, 8, 4), (0, 2, 4, 4), (2, 0, 4, 2), (0, 1, 2, 2), (1, 0, 2, 1)]


def filtered(rows, kind, step):
    """Rows (R, L) of bytes as a filter of PNG leaves them, each after the number of the filter."""
    rows = rows.astype(int)
    padded = np.pad(rows, ((1, 0), (step, 0)))
    left, above, corner = padded[1:, :-step], padded[:-1, step:], padded[:-1, :-step]
    choices = np.stack([left, above, corner])
    nearest = np.abs(left + above - corner - choices).argmin(axis=0)
    paeth = np.take_along_axis(choices, nearest[None], axis=0)[0]
    guess = [0 * rows, left, above, (left + above) // 2, paeth][kind]
    return np.pad((rows - guess).astype(np.uint8), ((0, 0), (1, 0)), constant_values=kind)


def png(pixels, kinds=(0,), interlaced=False, more=b""):
    """The bytes of a PNG of uint16 pixels (h, w, C); its rows, or passes, have filters of these kinds in turn."""
    height, width, channels = pixels.shape
    stream = b""
    for number, (row, column, down, across) in enumerate(PASSES if interlaced else [(0, 0, 1, 1)]):
        part = pixels[row::down, column::across]
        if part.size:
            raw = part.astype(">u2").reshape(len(part), -1).view(np.uint8)
            rows = [filtered(raw, kind, 2 * channels) for kind in kinds]
            stream += b"".join(rows[(i + number) % len(kinds)][i].tobytes() for i in range(len(part)))

    def chunk(name, content):
        return struct.pack(">I", len(content)) + name + content + struct.pack(">I", zlib.crc32(name + content))

    header = struct.pack(">IIBBBBB", width, height, 16, {2: 4, 3: 2, 4: 6}[channels], 0, 0, int(interlaced))
    body = zlib.compress(stream)
    data = chunk(b"IDAT", body[:40]) + chunk(b"IDAT", body[40:])
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + more + data + chunk(b"IEND", b"")


@pytest.mark.parametrize("kinds", [(0,), (1,), (2,), (3,), (4,), (4, 1, 3, 0, 2)])
@pytest.mark.parametrize("channels", [2, 3, 4])
@pytest.mark.parametrize("interlaced", [False, True], ids=["plain", "interlaced"])
def test_all_bits_are_read_whatever_the_filters(tmp_path, kinds, channels, interlaced):
    # Steps that bytes lose, beside noise.
    pixels = RNG.integers(0, 65536, (13, 11, channels)).astype(np.uint16)
    pixels[:6] = 32768 + np.arange(11)[:, None] + 3 * np.arange(channels)
    (tmp_path / "t.png").write_bytes(png(pixels, kinds, interlaced))
    with Image.open(tmp_path / "t.png") as image:  # That Pillow, too, takes it for this picture, but for its last bits.
        image.load()
        shown = np.asarray(image.convert("RGBA"))[..., :3]
    wanted = pixels[..., [0, 0, 0, 1]] if channels == 2 else pixels
    np.testing.assert_array_equal(shown, wanted[..., :3] >> 8)
    np.testing.assert_array_equal(read_image(tmp_path / "t.png"), wanted.astype(np.float32) / 65535)


def test_one_colour_of_16_bits_may_be_transparent(tmp_path):
    pixels = np.full((3, 4, 3), 9, np.uint16)
    pixels[1, 2] = 9, 9, 10
    clear = struct.pack(">HHH", 9, 9, 10)
    more = struct.pack(">I", 6) + b"tRNS" + clear + struct.pack(">I", zlib.crc32(b"tRNS" + clear))
    (tmp_path / "t.png").write_bytes(png(pixels, more=more))
    alpha = read_image(tmp_path / "t.png")[..., 3]
    assert alpha[1, 2] == 0 and alpha.sum() == 11


def test_a_texture_of_16_bits_keeps_them(tmp_path):
    pixels = np.full((2, 2, 3), 30000, np.uint16)
    pixels[1, 1] = 30001
    (tmp_path / "t.png").write_bytes(png(pixels))
    (tmp_path / "m.mtl").write_text("newmtl m\nmap_Kd t.png\n")
    (tmp_path / "m.obj").write_text(
        "mtllib m.mtl\nusemtl m\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nf 1/1 2/2 3/3\n"
    )
    texture = rts.load(tmp_path / "m.obj")[0].theta["texture"]
    encoded = np.array([30000, 30001]) / 65535
    np.testing.assert_allclose(texture[1, :, 0], ((encoded + 0.055) / 1.055) ** 2.4, rtol=1e-6)
    assert texture[1, 1, 0] > texture[1, 0, 0]
    np.testing.assert_array_equal(rts.load_image(tmp_path / "t.png")[..., :3], texture)


@pytest.mark.parametrize("cut", [60, 90, 200])
def test_a_deep_picture_that_is_cut_short_is_refused(tmp_path, cut):
    data = png(RNG.integers(0, 65536, (9, 9, 3)).astype(np.uint16))
    (tmp_path / "t.png").write_bytes(data[:cut])
    with pytest.raises(InputError, match="t.png cannot be read as an image"):
        rts.load_image(tmp_path / "t.png")
