# SPDX-License-Identifier: MIT
"""Where the camera was, by all that is known: the user's options, EXIF, a depth map, the photo's lines, habit."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...scene.model import Camera
from ..options import ReconstructOptions
from ..photo import Photo
from . import camera as cameras
from .belief import Belief, Guess
from .depth_map import DepthMap
from .ground_plane import GroundPlane, fit_ground
from .posterior import Posterior, infer
from .segments import find_segments

Mask = NDArray[np.bool_]

DEFAULT_LOG_FOCAL_SIGMA = 0.28
"""Of the focal lengths of phones and cameras, zoom and cropping included: ±1σ is 65° to 38° along the longer side."""
DEPTH_LOG_FOCAL_SIGMA = 0.05
"""Of focal lengths that go with depth maps of networks."""
DEFAULT_PITCH_SIGMA_DEG = 13.0
DEFAULT_ROLL_SIGMA_DEG = 2.0
"""How people hold cameras."""
KNOWN_DEG = 5.0
"""A normal that the lines leave less uncertain than this is called theirs."""
KNOWN_LOG_FOCAL = 0.12


@dataclass(frozen=True)
class ViewEstimate:
    """The camera 1 unit above the ground z = 0 of a photo, and how well it is known.

    camera: world X right and level, Y away, Z up. focal_source, normal_source: in words, where they come from.
    fov_sigma_deg: standard deviation of the angle of view along the longer side; 0 where it was given.
    normal_sigma_deg: root mean square angle between the true normal of the ground and this one; 0 where it was given.
    horizon: rows in pixels where the horizon meets the left and the right edge; may lie outside the photo.
    metres_per_unit: by a depth map in metres; None where nothing tells. scale_source: where that comes from.
    """

    camera: Camera
    focal_source: str
    normal_source: str
    fov_sigma_deg: float
    normal_sigma_deg: float
    horizon: tuple[float, float]
    metres_per_unit: float | None = None
    scale_source: str = ""

    @property
    def fov_deg(self) -> float:
        """Angle of view along the longer side."""
        return cameras.fov_of_focal(self.camera.width, self.camera.height, self.camera.fx)


def estimate_view(
    picture: Photo,
    masks: Sequence[Mask],
    names: Sequence[str],
    options: ReconstructOptions,
    depth: DepthMap | None,
    notice: Callable[[str], None],
) -> ViewEstimate:
    """The camera of ``picture``, whose objects ``names`` have the ``masks`` (H, W).

    depth: of the same size as the photo. What ``options`` give is taken as it is. ``notice`` is told what was found,
    how sure that is, and which option corrects it. Raises InputError when an object does not stand below the horizon.
    """
    width, height = picture.width, picture.height
    contacts = np.array([_contact(mask) for mask in masks]).reshape(-1, 2)
    log_focal, focal_source = _focal(picture, options, depth)
    plane = None
    if depth is not None:
        plane = fit_ground(depth, math.exp(log_focal.mean), masks)
        notice(_about_plane(plane))
    belief = _belief(log_focal, plane, options, contacts - np.array([width, height]) / 2.0, height)
    if options.pitch_deg is not None or options.horizon_y is not None:
        # What is given may contradict itself; no line of the photo can change that.
        means = np.array([[belief.log_focal.mean, belief.pitch.mean, belief.roll.mean]])
        log_f, pitch, roll = (float(v) for v in belief.completed(means)[0])
        _check(cameras.camera_above_ground(width, height, math.exp(log_f), pitch, roll), contacts, names)
    found = infer(
        find_segments(picture.pixels, np.logical_or.reduce([*masks, np.zeros((height, width), bool)])), belief
    )
    # Averages of poses that all have the given horizon do not have it themselves.
    averages = np.array([[math.log(found.focal), found.pitch, found.roll]])
    camera = cameras.camera_above_ground(width, height, found.focal, *map(float, belief.completed(averages)[0, 1:]))
    _check(camera, contacts, names)
    normal_source = _normal_source(options, plane, found)
    if log_focal.sigma > 0.2 and found.log_focal_sigma < KNOWN_LOG_FOCAL:
        focal_source = "straight lines"
    estimate = ViewEstimate(
        camera=camera,
        focal_source=focal_source,
        normal_source=normal_source,
        fov_sigma_deg=0.0 if log_focal.sigma == 0 else _fov_sigma_deg(width, height, found),
        normal_sigma_deg=math.degrees(found.normal_sigma),
        horizon=cameras.horizon_at_edges(camera),
        metres_per_unit=plane.camera_height if plane is not None and plane.metric else None,
        scale_source="the depth map in metres" if plane is not None and plane.metric else "",
    )
    _tell(estimate, found, belief, notice)
    return estimate


def _fov_sigma_deg(width: int, height: int, found: Posterior) -> float:
    """The angle of view w = 2 atan(s / 2 f) changes by −sin w with log f."""
    fov = math.radians(cameras.fov_of_focal(width, height, found.focal))
    return math.degrees(math.sin(fov) * found.log_focal_sigma)


def _contact(mask: Mask) -> NDArray[np.float64]:
    """The lowest point (2,) of ``mask`` in pixels: middle of its lowest row."""
    rows = np.flatnonzero(mask.any(axis=1))
    if not len(rows):
        return np.array([mask.shape[1] / 2.0, float(mask.shape[0])])
    columns = np.flatnonzero(mask[rows[-1]])
    return np.array([(columns[0] + columns[-1] + 1) / 2.0, rows[-1] + 1.0])


def _check(camera: Camera, contacts: NDArray[np.float64], names: Sequence[str]) -> None:
    for name, contact in zip(names, contacts, strict=True):
        cameras.check_below_horizon(camera, contact, name)


def _focal(picture: Photo, options: ReconstructOptions, depth: DepthMap | None) -> tuple[Guess, str]:
    width, height = picture.width, picture.height
    if options.fov_deg is not None:
        return Guess(math.log(cameras.focal_of_fov(width, height, options.fov_deg)), 0.0), "fov_deg"
    if picture.exif_focal_px is not None:
        return Guess(math.log(picture.exif_focal_px), picture.exif_focal_sigma), picture.exif_source
    if depth is not None and depth.focal is not None:
        return Guess(math.log(depth.focal), DEPTH_LOG_FOCAL_SIGMA), "the depth map"
    usual = cameras.focal_of_fov(width, height, cameras.DEFAULT_FOV_DEG)
    return Guess(math.log(usual), DEFAULT_LOG_FOCAL_SIGMA), "what is usual"


def _belief(
    log_focal: Guess,
    plane: GroundPlane | None,
    options: ReconstructOptions,
    contacts: NDArray[np.float64],
    height: int,
) -> Belief:
    pitch = Guess(math.radians(cameras.DEFAULT_PITCH_DEG), math.radians(DEFAULT_PITCH_SIGMA_DEG))
    roll = Guess(0.0, math.radians(DEFAULT_ROLL_SIGMA_DEG))
    if plane is not None:
        pitch, roll = Guess(plane.pitch, plane.pitch_sigma), Guess(plane.roll, plane.roll_sigma)
    if options.pitch_deg is not None:
        pitch = Guess(math.radians(options.pitch_deg), 0.0)
    if options.roll_deg is not None:
        roll = Guess(math.radians(options.roll_deg), 0.0)
    horizon = None if options.horizon_y is None else (options.horizon_y - 0.5) * height
    return Belief(log_focal, pitch, roll, horizon, contacts)


def _normal_source(options: ReconstructOptions, plane: GroundPlane | None, found: Posterior) -> str:
    given = [name for name in ("horizon_y", "pitch_deg", "roll_deg") if getattr(options, name) is not None]
    if plane is not None:
        rest = "the depth map"
    elif math.degrees(found.normal_sigma) < KNOWN_DEG and found.gain > 1.0:
        rest = "straight lines"
    else:
        rest = "how cameras are held"
    if "roll_deg" in given and len(given) > 1:
        return " and ".join(given)
    return " and ".join([*given, rest])


def _about_plane(plane: GroundPlane | None) -> str:
    if plane is None:
        return "no ground was found in the depth map: it is not used for the camera; check that it is of this photo"
    return (
        f"ground found in the depth map: {100 * plane.inliers:.0f} % of the points beside the objects lie on it; the "
        f"camera looks {math.degrees(plane.pitch):.0f}° down on it"
        + (f" from {plane.camera_height:.2g} m" if plane.metric else "")
    )


def _tell(estimate: ViewEstimate, found: Posterior, belief: Belief, notice: Callable[[str], None]) -> None:
    if belief.log_focal.sigma > 0:
        notice(
            f"angle of view {estimate.fov_deg:.0f}° ± {max(estimate.fov_sigma_deg, 0.5):.0f}° along the longer side, "
            f"by {estimate.focal_source}; set fov_deg where this is wrong"
        )
    if not (belief.free[1] or belief.free[2]):
        return
    left, right = (row / estimate.camera.height for row in estimate.horizon)
    doubt = "" if estimate.normal_sigma_deg < KNOWN_DEG else ": the photo does not tell it well"
    notice(
        f"camera looks {math.degrees(found.pitch):.0f}° down, turned {math.degrees(found.roll):.1f}° (± "
        f"{max(estimate.normal_sigma_deg, 0.1):.1f}°) by {estimate.normal_source}{doubt}; the horizon is at "
        f"{left:.2f} of the height on the left and {right:.2f} on the right; set pitch_deg or horizon_y, and roll_deg, "
        "where this is wrong"
    )
