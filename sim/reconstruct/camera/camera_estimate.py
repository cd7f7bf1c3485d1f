# SPDX-License-Identifier: MIT
"""Estimate camera and metric scale from options, EXIF, a depth map, straight lines, the objects, and priors.

Where many things of alike size, such as coins on a table, are as large at the top of the photo as at its bottom, the
camera looks down steeply. Size and viewpoint tell each other: Hoiem, Efros, Hebert, Putting Objects in Perspective
(2006), equation 3.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ...scene.model import Camera
from ..photo import Photo
from ..reconstruct_options import ReconstructOptions
from . import ground_camera as cameras
from .depth_map import DepthMap
from .ground_camera import DEFAULT_PITCH_DEG
from .ground_plane import GroundPlane, fit_ground_plane
from .pose_posterior import CameraPrior, Gaussian, PosePosterior, infer_pose
from .round_feet import pitch_from_round_feet
from .vanishing_points import find_segments

Box = tuple[float, float, float, float]
LEAST_THINGS = 5
"""Things from which their sizes count; with fewer, chance makes them alike."""
ALIKE = (0.05, 0.25)
"""Least standard deviation of the logarithm of alike sizes, and largest."""
STEEP_DEG, STEEPEST_DEG = 45.0, 88.0
"""Pitch from which a view is one from above, and the steepest; other photos keep the usual pose."""
ABOVE_SHARE = 0.15
"""Share of photos from above, of any pitch up to ``STEEPEST_DEG``, among those of things on a surface."""
SURE = 0.95
"""Probability of a view from above from which it is taken."""
LEAST_SIGMA_DEG = 6.0
"""Least standard deviation of the pitch: the sizes of real things are not independent of where they lie."""


def pitch_from_alike_sizes(
    boxes: Sequence[Box], size: tuple[int, int], focal: float, usual_sigma_deg: float
) -> Gaussian | None:
    """Return the pitch in radians of a camera that looks down on things of alike size, or None.

    boxes: x0, y0, x1, y1 in pixels of a photo of ``size`` (width, height); those that its border cuts do not count.
    focal: focal length in pixels. usual_sigma_deg: standard deviation of the usual pose, about ``DEFAULT_PITCH_DEG``.
    """
    width, height = size
    corners = np.array([box for box in boxes if min(box[:2]) > 1 and box[2] < width - 1 and box[3] < height - 1])
    if len(corners) < LEAST_THINGS:
        return None
    extents = np.sqrt((corners[:, 2] - corners[:, 0]) * (corners[:, 3] - corners[:, 1]))
    rows = (corners[:, 1] + corners[:, 3]) / 2.0 - height / 2.0
    degrees = np.arange(5.0, STEEPEST_DEG + 1.0)
    pitch = np.radians(degrees)[:, None]
    # Inverse depth of a point of the ground at each thing's row, times the camera's height.
    nearness = np.sin(pitch) + rows / focal * np.cos(pitch)
    real = np.log(extents) - np.log(np.maximum(nearness, 1e-9))
    spread = np.where((nearness > 0.02).all(axis=1), real.std(axis=1, ddof=1), np.inf)
    likelihood = -(len(extents) - 1) * np.log(np.maximum(spread, ALIKE[0]))
    usual = np.exp(-0.5 * np.square((degrees - DEFAULT_PITCH_DEG) / usual_sigma_deg))
    prior = (1.0 - ABOVE_SHARE) * usual / usual.sum() + ABOVE_SHARE / len(degrees)
    weight = prior * np.exp(likelihood - likelihood.max())
    weight /= weight.sum()
    above = degrees >= STEEP_DEG
    if weight[above].sum() < SURE or float(spread[above].min()) > ALIKE[1]:
        return None
    mean = float(weight @ degrees)
    sigma = max(LEAST_SIGMA_DEG, math.sqrt(float(weight @ np.square(degrees - mean))))
    return Gaussian(math.radians(mean), math.radians(sigma))


Mask = NDArray[np.bool_]

DEFAULT_LOG_FOCAL_SIGMA = 0.28
"""Standard deviation of the log focal length of phones and cameras, with zoom and cropping: ±1σ is 65° to 38° along the
longer side."""
DEPTH_LOG_FOCAL_SIGMA = 0.05
"""Standard deviation of the log focal length that networks return with depth maps."""
DEFAULT_PITCH_SIGMA_DEG = 13.0
DEFAULT_ROLL_SIGMA_DEG = 2.0
"""Standard deviations of how cameras are held."""
KNOWN_DEG = 5.0
"""A normal less uncertain than this is attributed to the lines."""
KNOWN_LOG_FOCAL = 0.12
TYPICAL = "a typical pose"


@dataclass(frozen=True)
class CameraEstimate:
    """The camera of a photo, 1 unit above the ground z = 0, and its uncertainty.

    camera: world X right and level, Y away, Z up. focal_source, normal_source: their sources, in words. fov_sigma_deg:
    standard deviation of the angle of view along the longer side; 0 if fixed. normal_sigma_deg: RMS angle between the
    true normal of the ground and this one; 0 if fixed. horizon: rows in pixels where the horizon meets the left and the
    right edge; may lie outside the photo. metres_per_unit: by a metric depth map; else None. scale_source: its source.
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
        """Angle of view in degrees along the longer side."""
        return cameras.fov_of_focal(self.camera.width, self.camera.height, self.camera.fx)


def estimate_camera(
    picture: Photo,
    masks: Sequence[Mask],
    options: ReconstructOptions,
    depth: DepthMap | None,
    notice: Callable[[str], None],
    things: Callable[[], Sequence[Box]] = tuple,
) -> CameraEstimate:
    """Return the camera of ``picture``, whose objects have the ``masks`` (H, W).

    depth: of the same size as the photo. Values in ``options`` are fixed. ``notice`` receives each estimate, its
    uncertainty, and the option that overrides it. What lies above a given horizon hangs, and does not count. things:
    boxes of all things in the photo, in its pixels; asked for only where nothing else tells the camera's pitch.
    """
    width, height = picture.width, picture.height
    contacts = np.array([_contact(mask) for mask in masks]).reshape(-1, 2)
    log_focal, focal_source = _focal(picture, options, depth)
    plane = None
    if depth is not None:
        plane = fit_ground_plane(depth, math.exp(log_focal.mean), masks)
        notice(_about_plane(plane))
    prior = _prior(log_focal, plane, options, contacts - np.array([width, height]) / 2.0, height)
    if options.pitch_deg is not None or options.horizon_y is not None:
        # What does not stand below a given horizon hangs, and says nothing about the ground.
        means = np.array([[prior.log_focal.mean, prior.pitch.mean, prior.roll.mean]])
        log_f, pitch, roll = (float(v) for v in prior.completed(means)[0])
        given = cameras.camera_above_ground(width, height, math.exp(log_f), pitch, roll)
        stands = np.array([cameras.stands_below(given, contact) for contact in contacts], dtype=bool)
        prior = replace(prior, contacts=prior.contacts[stands])
    lines = find_segments(picture.pixels, np.logical_or.reduce([*masks, np.zeros((height, width), bool)]))
    found = infer_pose(lines, prior)
    normal_source = _normal_source(options, plane, found)
    if normal_source == TYPICAL:
        alike = pitch_from_alike_sizes(things(), (width, height), found.focal, DEFAULT_PITCH_SIGMA_DEG)
        told, source = alike, "things of alike size"
        if told is None:
            told, source = pitch_from_round_feet(masks, (width, height), found.focal), "round feet of objects"
        if told is not None:
            prior = replace(prior, pitch=told)
            found, normal_source = infer_pose(lines, prior), source
    # The mean of poses with the given horizon does not have it itself.
    averages = np.array([[math.log(found.focal), found.pitch, found.roll]])
    camera = cameras.camera_above_ground(width, height, found.focal, *map(float, prior.completed(averages)[0, 1:]))
    if log_focal.sigma > 0.2 and found.log_focal_sigma < KNOWN_LOG_FOCAL:
        focal_source = "straight lines"
    estimate = CameraEstimate(
        camera=camera,
        focal_source=focal_source,
        normal_source=normal_source,
        fov_sigma_deg=0.0 if log_focal.sigma == 0 else _fov_sigma_deg(width, height, found),
        normal_sigma_deg=math.degrees(found.normal_sigma),
        horizon=cameras.horizon_at_edges(camera),
        metres_per_unit=plane.camera_height if plane is not None and plane.metric else None,
        scale_source="the depth map in metres" if plane is not None and plane.metric else "",
    )
    _tell(estimate, found, prior, notice)
    return estimate


def _fov_sigma_deg(width: int, height: int, found: PosePosterior) -> float:
    """Propagate the uncertainty: the angle of view w = 2 atan(s / 2 f) changes by −sin w with log f."""
    fov = math.radians(cameras.fov_of_focal(width, height, found.focal))
    return math.degrees(math.sin(fov) * found.log_focal_sigma)


def _contact(mask: Mask) -> NDArray[np.float64]:
    """The lowest point (2,) of ``mask`` in pixels: middle of its lowest row."""
    rows = np.flatnonzero(mask.any(axis=1))
    if not len(rows):
        return np.array([mask.shape[1] / 2.0, float(mask.shape[0])])
    columns = np.flatnonzero(mask[rows[-1]])
    return np.array([(columns[0] + columns[-1] + 1) / 2.0, rows[-1] + 1.0])


def _focal(picture: Photo, options: ReconstructOptions, depth: DepthMap | None) -> tuple[Gaussian, str]:
    width, height = picture.width, picture.height
    if options.fov_deg is not None:
        return Gaussian(math.log(cameras.focal_of_fov(width, height, options.fov_deg)), 0.0), "fov_deg"
    if picture.exif_focal_px is not None:
        return Gaussian(math.log(picture.exif_focal_px), picture.exif_focal_sigma), picture.exif_source
    if depth is not None and depth.focal is not None:
        return Gaussian(math.log(depth.focal), DEPTH_LOG_FOCAL_SIGMA), "the depth map"
    usual = cameras.focal_of_fov(width, height, cameras.DEFAULT_FOV_DEG)
    return Gaussian(math.log(usual), DEFAULT_LOG_FOCAL_SIGMA), "a typical lens, as nothing tells it"


def _prior(
    log_focal: Gaussian,
    plane: GroundPlane | None,
    options: ReconstructOptions,
    contacts: NDArray[np.float64],
    height: int,
) -> CameraPrior:
    pitch = Gaussian(math.radians(cameras.DEFAULT_PITCH_DEG), math.radians(DEFAULT_PITCH_SIGMA_DEG))
    roll = Gaussian(0.0, math.radians(DEFAULT_ROLL_SIGMA_DEG))
    if plane is not None:
        pitch, roll = Gaussian(plane.pitch, plane.pitch_sigma), Gaussian(plane.roll, plane.roll_sigma)
    if options.pitch_deg is not None:
        pitch = Gaussian(math.radians(options.pitch_deg), 0.0)
    if options.roll_deg is not None:
        roll = Gaussian(math.radians(options.roll_deg), 0.0)
    horizon = None if options.horizon_y is None else (options.horizon_y - 0.5) * height
    return CameraPrior(log_focal, pitch, roll, horizon, contacts)


def _normal_source(options: ReconstructOptions, plane: GroundPlane | None, found: PosePosterior) -> str:
    given = [name for name in ("horizon_y", "pitch_deg", "roll_deg") if getattr(options, name) is not None]
    if plane is not None:
        rest = "the depth map"
    elif math.degrees(found.normal_sigma) < KNOWN_DEG and found.gain > 1.0:
        rest = "straight lines"
    else:
        rest = TYPICAL
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


def _tell(estimate: CameraEstimate, found: PosePosterior, prior: CameraPrior, notice: Callable[[str], None]) -> None:
    if prior.log_focal.sigma > 0:
        notice(
            f"field of view {estimate.fov_deg:.0f}° ± {max(estimate.fov_sigma_deg, 0.5):.0f}° along the longer side, "
            f"from {estimate.focal_source}; set fov_deg to change it"
        )
    if not (prior.free[1] or prior.free[2]):
        return
    left, right = (row / estimate.camera.height for row in estimate.horizon)
    doubt = "" if estimate.normal_sigma_deg < KNOWN_DEG else ", which the photo hardly constrains"
    notice(
        f"camera pitched {math.degrees(found.pitch):.0f}° down, rolled {math.degrees(found.roll):.1f}° (± "
        f"{max(estimate.normal_sigma_deg, 0.1):.1f}°), from {estimate.normal_source}{doubt}; horizon at {left:.2f} of "
        f"the height on the left, {right:.2f} on the right; set pitch_deg or horizon_y, and roll_deg, to change it"
    )


CONTRADICTION = 1.5
"""Ratio of implied scales above which sizes contradict each other."""


def metres_per_unit(
    extents_units: Sequence[float],
    sizes_m: Sequence[float | None],
    estimate: CameraEstimate,
    default_size_m: float,
    notice: Callable[[str], None],
) -> float:
    """Return metres per unit of a world in which the camera is 1 unit above the ground.

    extents_units: largest extent of each object, above 0. sizes_m: the same in metres, None where unknown. Several
    sizes are combined by the median weighted by extent, because a large object is measured better. Without any, a
    metric depth map decides, else the first object is ``default_size_m``. Raises InputError for an invalid extent.
    """
    for extent in extents_units:
        if not (np.isfinite(extent) and extent > 0):
            raise InputError(f"extent of an object is {extent!r}: it must be positive; give another mask or mesh")
    known = [(size / extent, extent) for extent, size in zip(extents_units, sizes_m, strict=True) if size is not None]
    if known:
        scale = _weighted_median(known)
        low, high = min(s for s, _ in known), max(s for s, _ in known)
        if high > CONTRADICTION * low:
            notice(
                f"the sizes of the objects contradict each other by a factor of {high / low:.1f}: the scene's scale is "
                "that of the majority; check size_m, or the camera (pitch_deg, fov_deg)"
            )
        measured = estimate.metres_per_unit
        if measured is not None and max(measured / scale, scale / measured) > CONTRADICTION:
            notice(
                f"from {estimate.scale_source} the objects are {measured / scale:.2g} times as large as size_m says; "
                "size_m is used"
            )
        return scale
    if estimate.metres_per_unit is not None:
        largest = max(extents_units, default=0.0) * estimate.metres_per_unit
        notice(f"scale from {estimate.scale_source}: the largest object is {largest:.2g} m; size_m overrides it")
        return estimate.metres_per_unit
    if not extents_units:
        raise InputError("objects: none given; the scale of a world needs at least one")
    notice(f"no size is known: the first object is assumed to be {default_size_m:g} m across; set its size_m")
    return default_size_m / extents_units[0]


def _weighted_median(values: Sequence[tuple[float, float]]) -> float:
    """The smallest value at which half of the weight is reached; of two of equal weight, their geometric mean."""
    ordered = sorted(values)
    half = sum(weight for _, weight in ordered) / 2.0
    reached = 0.0
    for index, (value, weight) in enumerate(ordered):
        reached += weight
        if abs(reached - half) < 1e-9 * half and index + 1 < len(ordered):
            return float(np.sqrt(value * ordered[index + 1][0]))
        if reached > half:
            return value
    return ordered[-1][0]
