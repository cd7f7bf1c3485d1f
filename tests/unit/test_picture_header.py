# SPDX-License-Identifier: MIT
"""What a picture claims is known before anything decodes it: for Blender, which takes the memory first."""

import struct
import zlib

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from physgen.physgen_addon.frames.frame_files import Part, write_exr
from physgen.sim.errors import InputError
from physgen.sim.picture_header import FORMATS, require_picture, require_picture_bytes
from physgen.sim.scene.environment import write_environment
from PIL import Image


def bomb_png(width, height):
    """A PNG of one bit a pixel, all of them black, whole: some 120 bytes for a million pixels."""
    packer, row = zlib.compressobj(9), bytes(1 + (width + 7) // 8)
    packed = b"".join(packer.compress(row) for _ in range(height)) + packer.flush()

    def chunk(kind, content):
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    head = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 1, 0, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + head + chunk(b"IDAT", packed) + chunk(b"IEND", b"")


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".progressive.jpg", ".exif.jpg", ".tif", ".webp", ".lossless.webp",
                                    ".alpha.webp", ".bmp", ".hdr", ".exr"])  # fmt: skip
def test_the_size_is_that_which_decoders_find(tmp_path, suffix):
    width, height = 37, 23
    pixels = np.random.default_rng(0).integers(0, 255, (height, width, 3), np.uint8)
    path = tmp_path / f"picture{suffix}"
    if suffix == ".hdr":
        cv2.imwrite(str(path), pixels.astype(np.float32) / 255)
    elif suffix == ".exr":
        write_environment(path, pixels.astype(np.float32) / 255)
    else:
        image = Image.fromarray(pixels)
        more = {}
        if suffix == ".progressive.jpg":
            more = {"progressive": True}
        elif suffix == ".exif.jpg":
            exif = Image.Exif()
            exif[0x010E] = "a thumbnail or so" * 2000
            more = {"exif": exif}
        elif suffix == ".lossless.webp":
            more = {"lossless": True}
        elif suffix == ".alpha.webp":
            image.putalpha(90)
        image.save(path, **more)
    assert require_picture(path) == (width, height)
    assert require_picture_bytes(path.read_bytes(), "x") == (width, height)


def test_of_an_exr_with_parts_the_largest_counts(tmp_path):
    parts = [
        Part(name=name, channels=("R", "G", "B"), pixels=np.zeros((12, 20, 3), np.float32))
        for name in ("small", "large")
    ]
    write_exr(tmp_path / "0001.exr", parts, fps=24.0)
    assert require_picture(tmp_path / "0001.exr") == (20, 12)
    content = bytearray((tmp_path / "0001.exr").read_bytes())
    window = b"dataWindow\0box2i\0" + struct.pack("<5i", 16, 0, 0, 19, 11)
    second = content.rindex(window) + len(window) - 16
    assert content.index(window) < second - len(window)
    content[second : second + 16] = struct.pack("<4i", 0, 0, 99, 79)
    assert require_picture_bytes(bytes(content), "x") == (100, 80)
    content[second : second + 16] = struct.pack("<4i", 0, 0, 9_999, 9_999)
    with pytest.raises(InputError, match="claims 10000x10000 pixels"):
        require_picture_bytes(bytes(content), "x")


@pytest.mark.parametrize(("width", "height"), [(20_000, 20_000), (2**31 - 1, 1), (2**24, 2)])
def test_what_claims_too_much_is_refused(tmp_path, width, height):
    path = tmp_path / "photo.png"
    path.write_bytes(bomb_png(8, 8).replace(struct.pack(">II", 8, 8), struct.pack(">II", width, height), 1))
    with pytest.raises(InputError, match=rf"photo\.png: claims {width}x{height} pixels"):
        require_picture(path)


DAMAGED = (
    b"",
    b"\x89PNG\r\n\x1a\n",
    b"\xff\xd8" + b"\xff" * 9000,
    b"#EXTM3U\nhttp://a/b.ts\n",
    b"%!PS-Adobe-3.0\n",
    b"II*\0\xff\xff\xff\xff",
    b"\x76\x2f\x31\x01\2\0\0\0dataWindow\0box2i\0\x10\0\0\0",
    b"#?RADIANCE\n\n",
    b"\0\0\0\x0cjP  \r\n\x87\n",
    bomb_png(0, 5),
)
BEGINNINGS = (
    b"\x89PNG\r\n\x1a\n",
    b"\xff\xd8\xff",
    b"RIFF____WEBPVP8",
    b"II*\0",
    b"MM\0*",
    b"BM",
    b"\x76\x2f\x31\x01",
    b"#?",
)


@pytest.mark.parametrize("content", DAMAGED)
def test_what_is_no_picture_of_these_formats_is_refused(tmp_path, content):
    path = tmp_path / "photo.png"
    path.write_bytes(content)
    with pytest.raises(InputError, match=f"is not a readable picture; give {FORMATS}"):
        require_picture(path)
    with pytest.raises(InputError, match="cannot be read; check that it is there"):
        require_picture(tmp_path / "none.png")


@given(st.binary(max_size=400), st.sampled_from(BEGINNINGS))
def test_any_bytes_have_a_size_or_are_refused(rest, start):
    try:
        width, height = require_picture_bytes(start + rest, "x")
    except InputError:
        return
    assert 0 < width * height <= 200_000_000
