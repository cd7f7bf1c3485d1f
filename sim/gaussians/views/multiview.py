# SPDX-License-Identifier: MIT
"""Pictures in which SyncDreamer and Zero123++ put their views side by side → views with the published cameras.

SyncDreamer (Liu et al. 2023): the script that rendered its training views. Zero123++ (Shi et al. 2023): its README and
issues 68 and 73, where its authors give field of view and distance. Neither knows an object's size: its bounding box
(SyncDreamer) or sphere (Zero123++ 1.2) is scaled to 1 m, and a longer ``distance`` makes it that much larger.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

from ...errors import InputError
from .backdrop import plain_backdrop_mask
from .orbit import orbit_camera
from .pictures import Budget, read_colours
from .view import View, before_white


@dataclass(frozen=True)
class Layout:
    """A grid of square views, row by row, of cameras that look at the object's middle.

    azimuths, elevations: degrees, one a view; azimuth 0 is the side from which the given picture was taken, +x in the
    world of the views, and z is up. focal: focal length over a view's side. distance: metres.
    """

    columns: int
    rows: int
    azimuths: tuple[float, ...]
    elevations: tuple[float, ...]
    focal: float
    distance: float


_BLENDER_FOCAL = 35 / 32
"""A lens of 35 mm on a sensor of 32 mm, as the scripts after Zero-1-to-3 set it: a field of view of 49.1°."""
_SIX = tuple(30.0 + 60.0 * i for i in range(6))

LAYOUTS = {
    "syncdreamer": Layout(16, 1, tuple(22.5 * i for i in range(16)), (30.0,) * 16, _BLENDER_FOCAL, 1.5),
    # Its distance follows the given picture's and is not published: that of SyncDreamer, of the same family.
    "zero123++1.1": Layout(2, 3, _SIX, (30.0, -20.0) * 3, _BLENDER_FOCAL, 1.5),
    "zero123++1.2": Layout(
        2, 3, _SIX, (20.0, -10.0) * 3, 0.5 / math.tan(math.radians(15)), 0.5 / math.tan(math.radians(15))
    ),
}


def read_multiview(path: Path, layout: str, *, distance: float | None = None) -> tuple[View, ...]:
    """The views in the picture ``path``, in the order of ``LAYOUTS[layout]``.

    Masks come from its opacity, else from a plain backdrop, else there are none. distance: metres of the cameras from
    the object's middle; None: the layout's own. Raises InputError on an unknown layout, and on a picture that is
    missing, damaged, or not of the layout's shape.
    """
    if layout not in LAYOUTS:
        raise InputError(f"layout is {layout!r}: choose one of {', '.join(LAYOUTS)}")
    if distance is not None and not (math.isfinite(distance) and distance > 0):
        raise InputError(f"distance is {distance!r}: give metres above 0, or leave it out")
    grid = LAYOUTS[layout]
    colours, alpha = read_colours(path, Budget())
    height, width = colours.shape[:2]
    side = width // grid.columns
    if side < 8 or width != side * grid.columns or height != side * grid.rows:
        raise InputError(
            f"{path}: has {width}x{height} pixels, not {grid.columns} by {grid.rows} square views as {layout} has: "
            f"choose another layout ({', '.join(LAYOUTS)}), or give the picture as the program wrote it"
        )
    views = []
    for index, (azimuth, elevation) in enumerate(zip(grid.azimuths, grid.elevations, strict=True)):
        row, column = divmod(index, grid.columns)
        window = (slice(row * side, (row + 1) * side), slice(column * side, (column + 1) * side))
        pixels = colours[window]
        mask = plain_backdrop_mask(pixels) if alpha is None else alpha[window]
        camera = orbit_camera(azimuth, elevation, distance or grid.distance, side=side, focal=grid.focal)
        name = f"{path.stem}-{index:02d}"
        pixels = pixels if mask is None else before_white(pixels, mask)
        views.append(View(name=name, camera=camera, pixels=pixels, mask=mask))
    return tuple(views)
