# SPDX-License-Identifier: GPL-3.0-or-later
"""Light found in photos that Cycles takes under known suns, by the ordinary way from photo to scene."""

import pytest

bpy = pytest.importorskip("bpy")
from physgen.benchmarks.light import WANTED_DEG, WANTED_SHARE, Case, measure


@pytest.mark.long
@pytest.mark.parametrize(
    "case",
    [
        Case(azimuth=150, elevation=40, strength=1.5, shape="ball", ground="grain"),
        pytest.param(
            Case(azimuth=25, elevation=30, strength=3.0, shape="jug", ground="planks", angle=3), marks=pytest.mark.slow
        ),
    ],
    ids=lambda case: case.shape,
)
def test_a_known_sun_is_found_again(first_fill, tmp_path, case):
    found = measure(case, tmp_path, (320, 240), 8)
    assert found["direction_deg"] < WANTED_DEG
    assert abs(found["ratio_share"]) < WANTED_SHARE
    assert found["angle_deg"] < 20


@pytest.mark.long
def test_a_shadow_all_around_is_no_sun(first_fill, tmp_path):
    found = measure(Case(azimuth=0, elevation=90, strength=0.0), tmp_path, (320, 240), 8)
    assert found["light"]["sun_direction"] is None
