# SPDX-License-Identifier: MIT
"""Limbs that lie on the ground in front of a body: as thick as they are wide.

What the photo shows in front of the wall through a body, such as the legs of a sitting toy, lies on the ground. The
line of sight meets it at a grazing angle, so a limb inflated along it would be a flat tongue. Its middle is rather a
level sheet at the height of its radius, which ends at an upright one above the point where it touches the ground, and
its thickness is measured across that.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ..camera.ground_camera import ground_depth, on_ground
from .inflate import Silhouette
from .reference_surfaces import FOLD, MeasuredSurface, ReferenceSurface

Field = NDArray[np.float64]

LEAST_PX = 12
"""Pixels in front of the wall that are a limb; fewer are none."""
NARROW = 0.6
"""Radius of a limb over the half thickness of its body, at most."""
WIDE = 4.0
"""Its width over its radius, at most: wider ones are the body's own lower edge."""
LONG = 1.5
"""Its rows over its radius, at least: it is seen as long as it is thick. The lower edge of a round body is not."""
NEAR = 2.0
"""Distance around a limb, over its radius, up to which it may reach where nothing but the wall is seen."""
FARTHEST = 1e4
"""Distance, in heights of the camera, of what never meets the line of sight."""
STEEPEST = 4.0
"""Largest thickness along the line of sight over that across the limb."""


def with_limbs(reference: ReferenceSurface, silhouette: Silhouette) -> ReferenceSurface:
    """Return ``reference``, a wall, with the middle of what lies on the ground in front of it; itself if nothing
    does."""
    camera, unit = reference.camera, reference.unit_per_pixel
    height, width = silhouette.mask.shape
    corner = np.array([silhouette.left + 0.5, silhouette.top + 0.5])
    rows, columns = np.mgrid[:height, :width]
    pixels = np.stack([columns, rows], axis=-1).reshape(-1, 2) + corner
    rays = camera.rays(pixels)
    ground = np.minimum(ground_depth(camera, rays), FARTHEST)
    plain = np.minimum(reference.depths(pixels)[0], FARTHEST)
    facing = rays @ reference.normal
    wall = (reference.origin - camera.position) @ reference.normal / np.maximum(facing, 1e-9)
    wall = np.where(facing > 0.05, np.minimum(wall, FARTHEST), FARTHEST)
    floor = silhouette.mask & (ground < wall).reshape(height, width)
    labels, count = ndimage.label(floor)
    inflated = np.sqrt(np.maximum(silhouette.square_height, 0.0))
    level = reference.normal * (1.0, 1.0, 0.0)
    level /= np.linalg.norm(level)
    ahead = np.maximum(rays @ level, 0.05)
    found = np.zeros(count + 1, dtype=bool)
    end, sheet, reach, radii = (np.zeros(count + 1) for _ in range(4))
    for number in np.flatnonzero(np.bincount(labels[floor], minlength=count + 1) >= LEAST_PX):
        own = labels == number
        at = np.flatnonzero(own.any(axis=1))
        radius = unit * float(np.median(np.where(own, inflated, 0.0).max(axis=1)[at]))
        contact = np.array([np.flatnonzero(own[at[-1]]).mean(), at[-1] + 0.5]) + corner
        ray = camera.rays(contact)
        down = float(np.arctan2(-ray[2], np.hypot(ray[0], ray[1])))
        if down <= 0.0:
            continue
        end[number] = (on_ground(camera, contact) - camera.position) @ level + radius * np.tan(down / 2.0)
        sheet[number] = 1.0 - radius / camera.position[2]
        radii[number] = radius
        reach[number] = radius / np.tan(down)
        across = float(np.median(own.sum(axis=1)[at])) * unit
        narrow = radius < NARROW * silhouette.half_thickness * unit and across < WIDE * radius
        found[number] = narrow and len(at) * unit > LONG * radius
    if not found.any():
        return reference
    far, place = ndimage.distance_transform_edt(~found[labels], return_indices=True)
    nearest = labels[tuple(place)].ravel()
    # What else lies on the ground, such as the front of the body, stays as it is.
    near = (far.ravel() * unit < NEAR * radii[nearest]) & (found[labels] | ~floor).ravel()
    upright, lying = end[nearest] / ahead, sheet[nearest] * ground
    middle = np.where(near, np.minimum(np.maximum(upright, lying), wall), plain)
    # Across the sheet, the thickness along the line of sight is that over the sine of the angle between them; above the
    # round end, that of a ball; at the body, an upright one's.
    run = np.minimum(np.maximum(lying - upright, 0.0), np.maximum(wall - lying, 0.0)) * ahead
    share = near * np.clip(run / np.maximum(reach[nearest], 1e-9), 0.0, 1.0)
    sine = np.clip(-rays[:, 2] / np.linalg.norm(rays, axis=1), 1.0 / STEEPEST, 1.0)
    cosine = np.sqrt(1.0 - sine**2)
    longer = share * cosine**2 / sine + np.sqrt(1.0 - (share * cosine) ** 2)
    smooth = max(1.0, FOLD * float(np.median(radii[found])) / unit)
    most = 2.0 * float(middle[silhouette.mask.ravel()].max())
    depth, longer = (
        ndimage.gaussian_filter(values.reshape(height, width), smooth, mode="nearest")
        for values in (np.minimum(middle, most), longer)
    )
    surface = MeasuredSurface(depth, inflated * longer, silhouette.left, silhouette.top, longer)
    return replace(reference, middle=surface)
