# SPDX-License-Identifier: MIT
"""The horizon in the middle column of a photo, to compare cameras with."""

import math


def horizon_row(height, focal, pitch, roll=0.0):
    """Row in pixels where the horizon crosses the middle column; may lie outside the photo."""
    return height / 2.0 - focal * math.tan(pitch) / math.cos(roll)


def pitch_of_horizon(height, focal, row, roll=0.0):
    """Pitch in radians of a camera with the horizon in ``row`` of the middle column."""
    return math.atan2((height / 2.0 - row) * math.cos(roll), focal)
