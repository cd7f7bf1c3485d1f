# SPDX-License-Identifier: MIT
"""What is left of a shadow is found where it is plain to see, and nothing else."""

import numpy as np
import pytest
from physgen.sim.reconstruct.lighting.shadow_masks import extend_hard_shadow

ROWS, COLUMNS = np.mgrid[:120, :160]
NOTHING = np.zeros((120, 160), dtype=bool)
WHOLE = (np.abs(ROWS - 60) < 15) & (np.abs(COLUMNS - 80) < 30)
FOUND = WHOLE & (COLUMNS < 85)


def photo(mask, share=0.4, noise=3.0, tint=(1.0, 1.0, 1.0)):
    random = np.random.default_rng(2)
    image = np.full((120, 160, 3), (190.0, 175.0, 150.0)) + random.normal(scale=noise, size=(120, 160, 1))
    # A share of the light, in sRGB bytes.
    image[mask] *= np.asarray(tint) * share ** (1 / 2.2)
    return np.clip(image, 0, 255).astype(np.uint8)


def test_the_rest_of_a_hard_shadow_is_found():
    found = extend_hard_shadow(photo(WHOLE), FOUND, NOTHING)
    assert (found & WHOLE).sum() > 0.95 * WHOLE.sum()
    assert (found & ~WHOLE).sum() < 0.05 * WHOLE.sum()


@pytest.mark.parametrize("other", ["bluer", "darker", "apart", "vast"])
def test_other_dark_things_are_left_out(other):
    thing = (np.abs(ROWS - 60) < 15) & (np.abs(COLUMNS - 120) < 12)
    pixels = photo(FOUND)
    if other == "vast":
        thing = (COLUMNS >= 85) & (ROWS > 5)
    look = {"bluer": photo(thing, tint=(0.6, 0.8, 1.3)), "darker": photo(thing, share=0.1)}.get(other, photo(thing))
    pixels = np.where(thing[..., None], look, pixels)
    closed = NOTHING
    if other in ("bluer", "darker"):
        # These touch the shadow.
        bridge = WHOLE & (COLUMNS >= 85) & (COLUMNS < 109)
        pixels = np.where(bridge[..., None], np.roll(look, -24, axis=1), pixels)
    assert (extend_hard_shadow(pixels, FOUND, closed) & ~FOUND).sum() < 0.1 * FOUND.sum()


def test_faint_shadows_uneven_ground_and_specks_stay_as_they_are():
    assert (extend_hard_shadow(photo(WHOLE, share=0.8), FOUND, NOTHING) == FOUND).all()
    striped = photo(WHOLE | (COLUMNS // 6 % 2 == 0), share=0.6)
    assert (extend_hard_shadow(striped, FOUND, NOTHING) == FOUND).all()
    speck = (ROWS == 60) & (np.abs(COLUMNS - 80) < 5)
    assert (extend_hard_shadow(photo(WHOLE), speck, NOTHING) == speck).all()


def test_no_shadow_is_added_on_other_objects():
    closed = WHOLE & (COLUMNS > 95)
    assert not (extend_hard_shadow(photo(WHOLE), FOUND, closed) & closed).any()
