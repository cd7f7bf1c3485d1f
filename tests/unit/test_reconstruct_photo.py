# SPDX-License-Identifier: MIT
"""Photos of all kinds, sound and damaged."""

import io
import math
import struct
import time
import warnings

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from physgen.sim.errors import InputError
from physgen.sim.reconstruct.photo import focal_from_exif, load_photo
from PIL import Image, ImageCms


def gradient(width=96, height=64):
    x, y = np.meshgrid(np.linspace(0, 255, width), np.linspace(0, 255, height))
    return np.stack([x, y, 255 - x], axis=-1).astype(np.uint8)


@pytest.mark.parametrize("suffix", ["png", "tiff", "webp", "jpg"])
def test_formats_keep_their_pixels(tmp_path, suffix):
    path = tmp_path / f"photo.{suffix}"
    Image.fromarray(gradient()).save(path, **({"lossless": True} if suffix == "webp" else {}))
    photo = load_photo(path, 1920)
    assert photo.pixels.shape == (64, 96, 3)
    assert photo.scale == 1.0
    assert np.abs(photo.pixels.astype(int) - gradient()).max() <= (40 if suffix == "jpg" else 0)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_exif_rotation_is_applied(tmp_path, orientation):
    upright = np.zeros((60, 90, 3), np.uint8)
    upright[:20, :30] = (255, 0, 0)  # top left as seen by people
    undo = {2: 0, 3: 3, 4: 1, 5: 5, 6: 2, 7: 6, 8: 4}
    stored = Image.fromarray(upright)
    if orientation > 1:
        # Store what the camera would have stored: the inverse of what a viewer does for this tag.
        inverse = {2: 0, 3: 3, 4: 1, 5: 5, 6: 2, 7: 6, 8: 4}[orientation]
        stored = stored.transpose(Image.Transpose(inverse))
    assert undo
    exif = Image.Exif()
    exif[0x0112] = orientation
    path = tmp_path / "photo.jpg"
    stored.save(path, exif=exif, quality=95)
    photo = load_photo(path, 1920)
    assert photo.pixels.shape == (60, 90, 3)
    assert photo.original_size == (90, 60)
    assert photo.pixels[10, 15, 0] > 200
    assert photo.pixels[50, 75].max() < 50


def test_sixteen_bit_grey_is_scaled_not_clipped(tmp_path):
    path = tmp_path / "deep.png"
    values = np.linspace(0, 65535, 64 * 96).reshape(64, 96).astype(np.uint16)
    Image.fromarray(values).save(path)
    pixels = load_photo(path, 1920).pixels
    assert abs(int(pixels[32, 48, 0]) - int(values[32, 48]) // 257) <= 1


def test_cmyk_palette_grey_and_alpha_become_rgb(tmp_path):
    image = Image.fromarray(gradient())
    image.convert("CMYK").save(tmp_path / "cmyk.jpg", quality=95)
    image.convert("P").save(tmp_path / "palette.png")
    image.convert("L").save(tmp_path / "grey.png")
    clear = image.convert("RGBA")
    clear.putalpha(Image.fromarray(np.tile(np.array([0, 255], np.uint8), (64, 48))))
    clear.save(tmp_path / "alpha.png")
    assert np.abs(load_photo(tmp_path / "cmyk.jpg", 1920).pixels.astype(int) - gradient()).mean() < 12
    assert load_photo(tmp_path / "palette.png", 1920).pixels.shape == (64, 96, 3)
    assert np.ptp(load_photo(tmp_path / "grey.png", 1920).pixels, axis=2).max() == 0
    assert (load_photo(tmp_path / "alpha.png", 1920).pixels[:, 0] == 255).all()


def test_icc_profile_is_converted_and_a_broken_one_ignored(tmp_path):
    image = Image.fromarray(gradient())
    lab = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    image.save(tmp_path / "srgb.png", icc_profile=lab)
    assert np.abs(load_photo(tmp_path / "srgb.png", 1920).pixels.astype(int) - gradient()).max() <= 2
    image.save(tmp_path / "broken.png", icc_profile=b"no profile at all")
    assert (load_photo(tmp_path / "broken.png", 1920).pixels == gradient()).all()


def test_exif_focal_length(tmp_path):
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA405] = 50
    Image.fromarray(gradient(600, 400)).save(tmp_path / "photo.jpg", exif=exif)
    photo = load_photo(tmp_path / "photo.jpg", 1920)
    assert photo.exif_focal_px == pytest.approx(600 * 50 / 36, rel=1e-6)


def photo_with(path, details=None, base=None, size=(600, 400)):
    exif = Image.Exif()
    exif.update(base or {})
    exif.get_ifd(0x8769).update(details or {})
    Image.fromarray(gradient(*size)).save(path, exif=exif)
    return load_photo(path, 1920)


def test_focal_length_from_the_sensors_resolution(tmp_path):
    # Canon EOS 40D: 3888 pixels in 0.876 inch, 50 mm.
    tags = {0x920A: 50.0, 0xA20E: 3888 / 0.876, 0xA20F: 2592 / 0.584, 0xA210: 2, 0xA002: 3888, 0xA003: 2592}
    photo = photo_with(tmp_path / "photo.jpg", tags)
    assert photo.exif_focal_px == pytest.approx(600 * 50 / (0.876 * 25.4), rel=1e-3)
    assert "sensor" in photo.exif_source
    # A resolution of the thumbnail gives a sensor of a few centimetres: not believed.
    assert photo_with(tmp_path / "photo.jpg", {**tags, 0xA20E: 100.0, 0xA20F: 100.0}).exif_focal_px is None


def test_focal_length_from_a_known_sensor(tmp_path):
    base = {0x010F: "Canon", 0x0110: "Canon EOS 5D Mark III"}
    photo = photo_with(tmp_path / "photo.jpg", {0x920A: 50.0}, base)
    assert photo.exif_focal_px == pytest.approx(600 * 50 / 36, rel=1e-3)
    assert photo.exif_focal_sigma > 0.02
    assert photo_with(tmp_path / "photo.jpg", {0x920A: 50.0}, {0x010F: "Nobody", 0x0110: "X1"}).exif_focal_px is None
    assert photo_with(tmp_path / "photo.jpg", {0x920A: 50.0, 0xA405: 75}, base).exif_focal_px == pytest.approx(
        75 / math.hypot(36, 24) * math.hypot(600, 400)
    )


def test_a_cropped_photo_keeps_its_focal_length_in_pixels(tmp_path):
    tags = {0xA405: 26, 0xA002: 4000, 0xA003: 3000}
    whole = photo_with(tmp_path / "photo.jpg", tags, size=(800, 600))
    # The middle square of it: the same lens, fewer columns.
    square = photo_with(tmp_path / "photo.jpg", tags, size=(600, 600))
    assert square.exif_focal_px == pytest.approx(whole.exif_focal_px)
    assert square.exif_focal_sigma > 3 * whole.exif_focal_sigma
    assert "cropped" in square.exif_source


@pytest.mark.parametrize("orientation", [1, 6])
def test_a_turned_photo_is_not_taken_for_a_cropped_one(tmp_path, orientation):
    tags = {0xA405: 26, 0xA002: 4000, 0xA003: 3000}
    photo = photo_with(tmp_path / "photo.jpg", tags, {0x0112: orientation}, size=(800, 600))
    assert photo.exif_focal_px == pytest.approx(1000 * 26 / math.hypot(36, 24))
    assert "cropped" not in photo.exif_source


_values = st.one_of(
    st.none(),
    st.integers(-(2**40), 2**40),
    st.floats(),
    st.sampled_from(["", "Canon", "LEICA M", b"\xff", (1, 0), "1/0"]),
)


@given(
    details=st.dictionaries(st.sampled_from([0xA405, 0x920A, 0xA404, 0xA002, 0xA003, 0xA20E, 0xA20F, 0xA210]), _values),
    base=st.dictionaries(st.sampled_from([0x010F, 0x0110]), _values),
)
def test_focal_length_is_valid_or_none_for_any_exif(details, base):
    found = focal_from_exif(base, details, 640, 480)
    assert found is None or (0.01 < found.per_diagonal < 500 and found.sigma > 0)


def test_forty_megapixels_within_seconds(tmp_path):
    path = tmp_path / "large.jpg"
    Image.fromarray(np.full((5200, 7800, 3), 120, np.uint8)).save(path)
    start = time.monotonic()
    photo = load_photo(path, 1920)
    assert photo.pixels.shape == (1280, 1920, 3)
    assert photo.original_size == (7800, 5200)
    assert photo.scale == pytest.approx(1920 / 7800)
    assert time.monotonic() - start < 10


def test_decompression_bomb_is_refused_before_it_is_decoded(tmp_path):
    def chunk(kind, data):
        import zlib

        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", 60000, 60000, 8, 2, 0, 0, 0)
    (tmp_path / "bomb.png").write_bytes(b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", b""))
    with pytest.raises(InputError, match="million"):
        load_photo(tmp_path / "bomb.png", 1920)


def test_a_short_file_that_claims_a_large_photo_is_not_decoded(tmp_path):
    """TIFF may leave out nearly all of its rows: the decoder was busy for 7 s with 9 kB."""
    path = tmp_path / "photo.tif"
    Image.fromarray(gradient()).save(path)
    content = path.read_bytes()
    rows = struct.pack("<HHII", 0x0101, 4, 1, 64)
    assert content.count(rows) == 1
    path.write_bytes(content.replace(rows, struct.pack("<HHII", 0x0101, 4, 1, 10**6)))
    with pytest.raises(InputError, match="96x1000000 pixels and is too short"):
        load_photo(path, 1920)


def test_a_large_but_allowed_photo_does_not_warn(tmp_path):
    path = tmp_path / "wide.png"
    Image.new("L", (10000, 9500)).save(path)  # above Pillow's own warning limit
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert load_photo(path, 256).pixels.shape == (243, 256, 3)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("empty.jpg", b"", "not an image"),
        ("text.png", b"hello, world", "not an image"),
        ("drawing.gif", None, "GIF"),
    ],
)
def test_not_a_photo(tmp_path, name, content, message):
    path = tmp_path / name
    if content is None:
        Image.fromarray(gradient()).save(path)
    else:
        path.write_bytes(content)
    with pytest.raises(InputError, match=message):
        load_photo(path, 1920)


def test_missing_folder_and_tiny(tmp_path):
    with pytest.raises(InputError, match="no such photo"):
        load_photo(tmp_path / "missing.jpg", 1920)
    with pytest.raises(InputError):
        load_photo(tmp_path, 1920)
    Image.new("RGB", (8, 8)).save(tmp_path / "tiny.png")
    with pytest.raises(InputError, match="at least"):
        load_photo(tmp_path / "tiny.png", 1920)


@pytest.mark.parametrize("kind", ["JPEG", "PNG", "TIFF", "WEBP"])
def test_truncated_files_are_refused(tmp_path, kind):
    noisy = np.random.default_rng(0).integers(0, 255, (64, 96, 3), dtype=np.uint8)
    buffer = io.BytesIO()
    Image.fromarray(noisy).save(buffer, kind)
    path = tmp_path / "cut"
    path.write_bytes(buffer.getvalue()[: len(buffer.getvalue()) // 2])
    with pytest.raises(InputError):
        load_photo(path, 1920)


_SOUND = {}
for _kind in ("JPEG", "PNG", "TIFF", "WEBP"):
    _buffer = io.BytesIO()
    Image.fromarray(gradient()).save(_buffer, _kind)
    _SOUND[_kind] = _buffer.getvalue()


@settings(max_examples=60, deadline=5000, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    kind=st.sampled_from(sorted(_SOUND)),
    edits=st.lists(st.tuples(st.floats(0, 1), st.integers(0, 255)), max_size=12),
    cut=st.floats(0, 1),
    garbage=st.binary(max_size=64),
    from_scratch=st.booleans(),
)
def test_garbage_is_an_input_error_or_a_photo(tmp_path, kind, edits, cut, garbage, from_scratch):
    data = bytearray(_SOUND[kind])
    for place, value in edits:
        data[int(place * (len(data) - 1))] = value
    data = data[: max(4, int(cut * len(data)))] + garbage
    path = tmp_path / "fuzz"
    path.write_bytes(garbage if from_scratch else bytes(data))
    try:
        photo = load_photo(path, 256)
    except InputError:
        return
    assert photo.pixels.dtype == np.uint8
    assert photo.pixels.ndim == 3
