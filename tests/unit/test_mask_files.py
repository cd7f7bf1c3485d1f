# SPDX-License-Identifier: MIT
"""Masks that users bring: every mode of picture, and garbage."""

import io

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from physgen.sim.errors import InputError
from physgen.sim.reconstruct.segmentation.object_masks import read_mask
from PIL import Image

from .segmentation_scenes import HEIGHT, WIDTH, disc, overlap

TRUTH = disc(120, 100, 50)
GREY = TRUTH.astype(np.uint8)


def _rgba():
    pixels = np.full((HEIGHT, WIDTH, 4), 200, np.uint8)
    pixels[..., 3] = GREY * 255
    return Image.fromarray(pixels)


def _palette():
    image = Image.fromarray(GREY, mode="P")
    image.putpalette([0, 0, 0, 0, 0, 128] + [0] * 750)
    return image


@pytest.mark.parametrize(
    "image",
    [
        pytest.param(Image.fromarray(GREY * 255), id="grey"),
        pytest.param(Image.fromarray(GREY), id="0 and 1"),
        pytest.param(Image.fromarray(TRUTH), id="1 bit"),
        pytest.param(Image.fromarray(GREY.astype(np.uint16) * 40000), id="16 bits"),
        pytest.param(Image.fromarray(np.dstack([GREY * 255] * 3)), id="RGB"),
        pytest.param(Image.fromarray(np.dstack([GREY * 255, GREY * 255])), id="opaque and bright"),
        pytest.param(_rgba(), id="transparency"),
        pytest.param(_palette(), id="dark blue of a palette"),
    ],
)
def test_modes(tmp_path, image):
    image.save(tmp_path / "mask.png")
    assert (read_mask(tmp_path / "mask.png", WIDTH, HEIGHT) == TRUTH).all()


def test_opaque_alpha_leaves_it_to_brightness(tmp_path):
    Image.fromarray(np.dstack([GREY * 255] * 3 + [np.full_like(GREY, 255)])).save(tmp_path / "mask.png")
    assert (read_mask(tmp_path / "mask.png", WIDTH, HEIGHT) == TRUTH).all()


@pytest.mark.parametrize("size", [(160, 120), (640, 480), (1001, 750)])
def test_other_sizes_of_the_same_proportions(tmp_path, size):
    Image.fromarray(GREY * 255).resize(size).save(tmp_path / "mask.jpg", quality=80)
    assert overlap(read_mask(tmp_path / "mask.jpg", WIDTH, HEIGHT), TRUTH) > 0.97


def test_rotation_by_exif(tmp_path):
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.fromarray(np.ascontiguousarray(np.rot90(GREY * 255))).save(tmp_path / "mask.jpg", exif=exif)
    assert overlap(read_mask(tmp_path / "mask.jpg", WIDTH, HEIGHT), TRUTH) > 0.97


@pytest.mark.parametrize(
    ("pixels", "message"),
    [
        (np.zeros((HEIGHT, WIDTH), np.uint8), "empty"),
        (np.full((HEIGHT, WIDTH), 255, np.uint8), "full"),
        (np.eye(240, dtype=np.uint8) * 255, "aspect ratio"),
    ],
)
def test_masks_that_say_nothing(tmp_path, pixels, message):
    Image.fromarray(pixels).save(tmp_path / "mask.png")
    with pytest.raises(InputError, match=message):
        read_mask(tmp_path / "mask.png", WIDTH, HEIGHT)


def test_noise_of_jpeg_is_no_object(tmp_path):
    noise = np.random.default_rng(0).integers(0, 6, (HEIGHT, WIDTH)).astype(np.uint8)
    Image.fromarray(noise).save(tmp_path / "mask.jpg")
    with pytest.raises(InputError, match="empty"):
        read_mask(tmp_path / "mask.jpg", WIDTH, HEIGHT)


def test_missing_file_and_no_image(tmp_path):
    with pytest.raises(InputError, match="no such mask"):
        read_mask(tmp_path / "mask.png", WIDTH, HEIGHT)
    (tmp_path / "mask.png").write_text("not an image")
    with pytest.raises(InputError, match="not an image"):
        read_mask(tmp_path / "mask.png", WIDTH, HEIGHT)


def _encoded(kind):
    buffer = io.BytesIO()
    Image.fromarray(GREY[::4, ::4] * 255).save(buffer, kind)
    return buffer.getvalue()


@settings(max_examples=40, deadline=None)
@given(
    st.sampled_from(["PNG", "JPEG"]), st.lists(st.tuples(st.floats(0, 1), st.integers(0, 255)), max_size=8), st.data()
)
def test_damaged_files_give_a_mask_or_a_clear_error(tmp_path_factory, kind, changes, data):
    content = bytearray(_encoded(kind))
    for place, value in changes:
        content[min(len(content) - 1, int(place * len(content)))] = value
    del content[data.draw(st.integers(1, len(content))) :]
    path = tmp_path_factory.mktemp("fuzz") / "mask"
    path.write_bytes(bytes(content))
    try:
        mask = read_mask(path, 80, 60)
    except InputError as error:
        assert str(path) in str(error)
    else:
        assert mask.shape == (60, 80)
        assert mask.any() and not mask.all()
