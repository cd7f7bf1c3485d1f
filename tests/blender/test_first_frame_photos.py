# SPDX-License-Identifier: GPL-3.0-or-later
"""The first frame is the photo: reconstructed, at rest, rendered. Photos beside the repository where they are there."""

from pathlib import Path

import pytest
from physgen.batch.demo import shipped_photo
from physgen.benchmarks.first_frame import measure

PHOTOS = Path(__file__).resolve().parents[3] / "shared" / "photos"
BOXES = {
    "coffee": [(70, 12, 488, 392)],
    "orange_and_book": [(215, 960, 475, 1190), (625, 450, 1240, 1200)],
    "clay_and_camera": [(300, 600, 780, 930), (1050, 460, 1720, 950)],
    "plush_and_book": [(175, 225, 1025, 1000), (1050, 530, 1735, 985)],
}
INSIDE_DB, WHOLE_DB = 35.0, 38.0


@pytest.mark.slow
@pytest.mark.parametrize("name", BOXES)
def test_the_first_frame_is_the_photo(name):
    photo = shipped_photo(name) if name == "coffee" else PHOTOS / f"{name}.jpg"
    if not photo.is_file():
        pytest.skip(f"{photo} is not there")
    found = measure(photo, BOXES[name], samples=16)
    assert found["psnr_mask_db"] >= INSIDE_DB, found
    assert found["psnr_all_db"] >= WHOLE_DB, found
