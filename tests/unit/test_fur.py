# SPDX-License-Identifier: MIT
"""Fur is distinguished from prints, wood grain and smooth surfaces by its texture."""

import cv2
import numpy as np
import pytest
from physgen.sim.reconstruct.appearance.fur import is_furry

SIDE = 260
ROWS, COLUMNS = np.mgrid[:SIDE, :SIDE].astype(np.float32)
BODY = (COLUMNS - 130) ** 2 / 110**2 + (ROWS - 130) ** 2 / 120**2 < 1


def drawn(texture, base=(150, 90, 60)):
    """A body of one colour, shaded from top to bottom, with ``texture`` (h, w) in grey values."""
    shade = 1.1 - 0.4 * ROWS / SIDE
    picture = np.asarray(base)[None, None] * shade[..., None] + texture[..., None]
    return np.where(BODY[..., None], np.clip(picture, 0, 255), 200).astype(np.uint8)


def hairs(seed, along=1.0, across=1.0, strength=14.0):
    noise = np.random.default_rng(seed).normal(size=(SIDE, SIDE)).astype(np.float32)
    soft = cv2.GaussianBlur(noise, (0, 0), sigmaX=along, sigmaY=across)
    return strength * soft / soft.std()


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("strength", [8.0, 14.0, 22.0])
def test_hairs_in_all_directions_everywhere_are_fur(seed, strength):
    assert is_furry(drawn(hairs(seed, strength=strength)), BODY)


@pytest.mark.parametrize("seed", range(4))
def test_grain_with_a_direction_prints_and_smooth_things_are_none(seed):
    assert not is_furry(drawn(hairs(seed, along=6.0, across=0.8)), BODY)  # wood
    assert not is_furry(drawn(hairs(seed, strength=0.7)), BODY)  # a camera's noise
    letters = np.where((ROWS % 60 < 25) & (COLUMNS > 60), hairs(seed, strength=40.0), 0.0)
    assert not is_furry(drawn(letters), BODY)


def test_what_is_too_small_to_show_hairs_is_none():
    small = (slice(None, None, 3), slice(None, None, 3))
    assert not is_furry(drawn(hairs(0))[small], BODY[small])
    assert not is_furry(drawn(hairs(0)), np.zeros_like(BODY))
