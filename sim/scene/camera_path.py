# SPDX-License-Identifier: MIT
"""Camera moves relative to the photo's camera, and keyframed paths of them (``physgen-camera/1``).

Moves are limited in reach: the photo shows the objects from one side only, and what lies beyond is estimated.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..atomic import write_json
from ..errors import InputError
from ..smoothstep import smoothstep
from ..validation import finite, parse, read_json, require, require_range, to_json
from .model import Camera, Ground
from .scene_object import Matrix4

FloatArray = NDArray[np.float64]

MAX_ANGLE_DEG = 30.0
MAX_DISTANCE = 0.3
"""Largest relative change of the distance to the pivot."""
ZOOM_RANGE = (0.5, 4.0)
LOWEST = 0.05
"""Least height above the ground over the distance to the pivot; below it the ground is seen edge-on."""
USUAL_ANGLE_DEG, USUAL_DISTANCE = 10.0, 0.1
"""Moves up to these look right; beyond, estimated surfaces begin to show."""
STILL_PX = 0.02
"""A camera whose image differs by less than this many pixels counts as the photo's own."""


@dataclass(frozen=True, kw_only=True)
class CameraOffset:
    """A camera relative to the photo's, applied in this order; zeros and zoom 1 are the photo's own.

    azimuth_deg: orbit about the ground normal through the pivot; positive moves to the camera's right.
    elevation_deg: orbit about the horizontal axis through the pivot; positive rises.
    dolly: relative change of the distance to the pivot; -0.1 is a tenth nearer.
    right_m, up_m: shift along the image axes, metres.
    pan_deg, tilt_deg, roll_deg: rotation in place: right, up, clockwise as seen from behind the camera.
    zoom: focal length over the photo's.
    """

    azimuth_deg: float = 0.0
    elevation_deg: float = 0.0
    dolly: float = 0.0
    right_m: float = 0.0
    up_m: float = 0.0
    pan_deg: float = 0.0
    tilt_deg: float = 0.0
    roll_deg: float = 0.0
    zoom: float = 1.0

    def __post_init__(self) -> None:
        for item in fields(self):
            low, high, unit = -1e3, 1e3, "metres"
            if item.name.endswith("_deg"):
                low, high, unit = -MAX_ANGLE_DEG, MAX_ANGLE_DEG, "degrees"
            elif item.name == "dolly":
                low, high, unit = -MAX_DISTANCE, MAX_DISTANCE, "a share of the distance"
            elif item.name == "zoom":
                (low, high), unit = ZOOM_RANGE, "a factor"
            require_range(item.name, getattr(self, item.name), low, high, unit)


def offset_camera(camera: Camera, offset: CameraOffset, *, pivot: FloatArray, normal: FloatArray) -> Camera:
    """Return ``camera`` moved by ``offset``; ``pivot`` (3,) in world metres, ``normal`` (3,) unit, of the ground."""
    pose = np.asarray(camera.world_from_camera, dtype=np.float64)
    turn, position = pose[:3, :3], pose[:3, 3]
    around = turn_matrix(math.radians(offset.azimuth_deg) * normal)
    turn, position = around @ turn, pivot + around @ (position - pivot)
    # A negative turn about the horizontal axis to the camera's right raises the camera.
    right = np.cross(level_forward(turn, normal), normal)
    rise = turn_matrix(-math.radians(offset.elevation_deg) * right)
    turn, position = rise @ turn, pivot + (1.0 + offset.dolly) * (rise @ (position - pivot))
    position = position + offset.right_m * turn[:, 0] - offset.up_m * turn[:, 1]
    # OpenCV's y points down: a turn about it goes to the right, one about x goes up.
    x, y, z = np.eye(3)
    pan, tilt, roll = (math.radians(v) for v in (offset.pan_deg, offset.tilt_deg, offset.roll_deg))
    own = turn_matrix(pan * y) @ turn_matrix(tilt * x) @ turn_matrix(roll * z)
    return replace(
        camera_with_pose(camera, turn @ own, position), fx=camera.fx * offset.zoom, fy=camera.fy * offset.zoom
    )


def turn_matrix(vector: FloatArray) -> FloatArray:
    """Return the rotation (3, 3) about ``vector`` (3,) by its length in radians (Rodrigues' formula)."""
    angle = float(np.linalg.norm(vector))
    x, y, z = vector / max(angle, 1e-300)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + math.sin(angle) * cross + (1.0 - math.cos(angle)) * (cross @ cross))


def turn_vector(matrix: FloatArray) -> FloatArray:
    """Return the rotation vector (3,) of a rotation by less than half a turn; inverts ``turn_matrix``."""
    m = matrix
    axis = np.array([m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]]) / 2.0
    sine, cosine = float(np.linalg.norm(axis)), (float(np.trace(m)) - 1.0) / 2.0
    return np.asarray(axis * (math.atan2(sine, cosine) / sine if sine > 1e-12 else 1.0))


def camera_with_pose(camera: Camera, turn: FloatArray, position: FloatArray) -> Camera:
    """Return ``camera`` at ``position`` (3,) with axes ``turn`` (3, 3: right, down and forward as columns)."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn, position
    a, b, c, d = (tuple(float(x) for x in row) for row in pose)
    return replace(camera, world_from_camera=(a, b, c, d))  # type: ignore[arg-type]


def level_forward(turn: FloatArray, normal: FloatArray) -> FloatArray:
    """Return the unit vector (3,) along the ground, away from a camera with axes ``turn`` (3, 3)."""
    for axis in (turn[:, 2], -turn[:, 1]):
        level = axis - (axis @ normal) * normal
        length = float(np.linalg.norm(level))
        # For a camera that looks straight down, forward is up in the image.
        if length > 0.05:
            break
    return np.asarray(level / length)


def at_size(camera: Camera, size: tuple[int, int]) -> Camera:
    """Return ``camera`` rescaled to images of ``size`` (width, height)."""
    width, height = size
    x, y = width / camera.width, height / camera.height
    return replace(
        camera, width=width, height=height, fx=camera.fx * x, cx=camera.cx * x, fy=camera.fy * y, cy=camera.cy * y
    )


def is_still(camera: Camera, other: Camera, pivot: FloatArray) -> bool:
    """Return whether points around ``pivot`` (3,) project to the same pixels in both, within ``STILL_PX``."""
    a, b = (np.asarray(c.world_from_camera, dtype=np.float64) for c in (camera, other))
    focal, side = max(camera.fx, camera.fy), max(camera.width, camera.height)
    distance = float(np.linalg.norm(a[:3, 3] - pivot))
    shift = focal * float(np.linalg.norm(a[:3, 3] - b[:3, 3])) / max(distance, 1e-9)
    turn = (focal + side) * float(np.abs(a[:3, :3] - b[:3, :3]).max())
    zoom = side * max(abs(other.fx / camera.fx - 1.0), abs(other.fy / camera.fy - 1.0))
    centre = max(abs(other.cx - camera.cx), abs(other.cy - camera.cy))
    return max(shift, turn, zoom, centre) < STILL_PX


def reach(camera: Camera, other: Camera, pivot: FloatArray) -> tuple[float, float]:
    """Return degrees from ``camera`` to ``other`` around ``pivot`` (3,), and relative change of the distance to it."""
    here, there = camera.position - pivot, other.position - pivot
    near, far = float(np.linalg.norm(here)), float(np.linalg.norm(there))
    # The cosine alone cannot resolve angles below 1e-6.
    angle = math.atan2(float(np.linalg.norm(np.cross(here, there))), float(here @ there))
    return math.degrees(angle), far / max(near, 1e-12) - 1.0


def check_reach(camera: Camera, other: Camera, *, pivot: FloatArray, ground: Ground, where: str) -> None:
    """Raise InputError, starting with ``where``, if ``other`` is too far from ``camera`` or too low."""
    around, nearer = reach(camera, other, pivot)
    if around > MAX_ANGLE_DEG + 1e-6:
        raise InputError(f"{where}: the camera is {around:.0f}° around the pivot; give up to {MAX_ANGLE_DEG:g}°")
    if abs(nearer) > MAX_DISTANCE + 1e-6:
        raise InputError(
            f"{where}: the camera's distance to the pivot changes by {100 * nearer:.0f} %; give up to "
            f"{100 * MAX_DISTANCE:g} %"
        )
    a, b = (np.asarray(c.world_from_camera, dtype=np.float64)[:3, :3] for c in (camera, other))
    turned = math.degrees(float(np.linalg.norm(turn_vector(a.T @ b))))
    if turned > 1.5 * MAX_ANGLE_DEG:
        raise InputError(f"{where}: the camera is turned by {turned:.0f}°; give up to {1.5 * MAX_ANGLE_DEG:g}°")
    height = float(ground.heights(other.position))
    least = LOWEST * float(np.linalg.norm(camera.position - pivot))
    if height < least:
        raise InputError(
            f"{where}: the camera is {height:.3g} m above the ground; keep it at least {least:.3g} m above: less "
            "elevation, or a smaller move down"
        )


FORMAT = "physgen-camera/1"
INTERPOLATIONS = ("smooth", "linear")
MAX_TIME = 1e6


@dataclass(frozen=True, kw_only=True)
class _Timed:
    """Time of a key: either ``frame`` as the bake numbers them, or ``time_s`` seconds after its first frame."""

    frame: float | None = None
    time_s: float | None = None

    def __post_init__(self) -> None:
        both = (self.frame, self.time_s)
        require((self.frame is None) != (self.time_s is None), "frame, time_s", both, "give one of the two")
        require_range("frame", self.frame, -MAX_TIME, MAX_TIME)
        require_range("time_s", self.time_s, -MAX_TIME, MAX_TIME, "seconds")

    def at(self, first_frame: int, fps: float) -> float:
        """Return the key's frame, possibly fractional."""
        if self.frame is not None:
            return self.frame
        assert self.time_s is not None
        return first_frame + self.time_s * fps


@dataclass(frozen=True, kw_only=True)
class MoveKey(_Timed, CameraOffset):
    """A key that moves the camera relative to the photo's (see ``Offset``)."""

    def __post_init__(self) -> None:
        _Timed.__post_init__(self)
        CameraOffset.__post_init__(self)


@dataclass(frozen=True, kw_only=True)
class PoseKey(_Timed):
    """A key that places the camera.

    world_from_camera: 4x4 rigid transform, metres, OpenCV axes. zoom: focal length over the photo's.
    """

    world_from_camera: Matrix4
    zoom: float = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        require_range("zoom", self.zoom, *ZOOM_RANGE, "a factor")
        # Checked by the scene's camera.
        Camera(width=1, height=1, fx=1.0, fy=1.0, cx=0.0, cy=0.0, world_from_camera=self.world_from_camera)


@dataclass(frozen=True, kw_only=True)
class CameraPath:
    """Keys and their interpolation; the camera stands still before the first and after the last.

    interpolation: ``smooth`` (monotone cubic, at rest at both ends) or ``linear``.
    pivot: centre of orbits, world metres; None takes the centre of the objects, on the ground.
    backdrop_m: distance of the upright backdrop along the ground, metres from the camera; None chooses it.
    keys, poses: either moves or poses, in rising order of time.
    """

    format: str = FORMAT
    interpolation: str = "smooth"
    pivot: tuple[float, float, float] | None = None
    backdrop_m: float | None = None
    keys: tuple[MoveKey, ...] = ()
    poses: tuple[PoseKey, ...] = ()

    def __post_init__(self) -> None:
        require(self.format == FORMAT, "format", self.format, f"this program reads {FORMAT}")
        known = self.interpolation in INTERPOLATIONS
        require(known, "interpolation", self.interpolation, f"choose one of {', '.join(INTERPOLATIONS)}")
        require(self.pivot is None or finite(*self.pivot), "pivot", self.pivot, "give three finite numbers or null")
        require_range("backdrop_m", self.backdrop_m, 1e-3, 1e5, "metres")
        counts = (len(self.keys), len(self.poses))
        require((counts[0] > 0) != (counts[1] > 0), "keys, poses", counts, "give keys, or poses, at least one")
        for name, items in (("keys", self.keys), ("poses", self.poses)):
            _require_order(name, items)


def _require_order(name: str, keys: Sequence[_Timed]) -> None:
    for i, (before, after) in enumerate(itertools.pairwise(keys)):
        where = f"{name}[{i + 1}]"
        same = (before.frame is None) == (after.frame is None)
        require(same, f"{where}.frame", after.frame, "give all keys a frame, or all of them time_s")
        unit = "time_s" if after.frame is None else "frame"
        a, b = getattr(before, unit), getattr(after, unit)
        require(a < b, f"{where}.{unit}", b, f"give more than the {a:g} before it")


def load_camera_path(path: Path) -> CameraPath:
    """Return the path in a ``physgen-camera/1`` file. Raises InputError that names the file and field."""
    return parse(CameraPath, read_json(path), str(path))


def save_camera_path(path: Path, camera_path: CameraPath) -> None:
    """Write ``camera_path`` atomically; ``load_camera_path`` returns the equal object."""
    content = to_json(camera_path)
    for key in (*content["keys"], *content["poses"]):
        del key["time_s" if key["time_s"] is None else "frame"]
    write_json(path, content)


def swing(*, first: int, last: int, azimuth_deg: float = 0.0, elevation_deg: float = 0.0, dolly: float = 0.0,
          zoom: float = 1.0) -> CameraPath:  # fmt: skip
    """Return one smooth move over frames ``first`` to ``last``, from the photo's camera to the given offset."""
    end = MoveKey(
        frame=float(max(last, first + 1)), azimuth_deg=azimuth_deg, elevation_deg=elevation_deg, dolly=dolly, zoom=zoom
    )
    return CameraPath(keys=(MoveKey(frame=float(first)), end))


def sample_cameras(
    path: CameraPath,
    camera: Camera,
    *,
    ground: Ground,
    pivot: NDArray[np.floating],
    first_frame: int,
    count: int,
    fps: float,
) -> list[Camera]:
    """Return the camera of each of ``count`` frames from ``first_frame``; ``camera`` itself where it is not moved.

    pivot: (3,), used where the path has none. Raises InputError for a camera that goes too far or too low.
    """
    centre = np.asarray(path.pivot if path.pivot is not None else pivot, dtype=np.float64)
    keys: Sequence[_Timed] = path.keys or path.poses
    times = np.array([key.at(first_frame, fps) for key in keys])
    wanted = first_frame + np.arange(count, dtype=np.float64)
    rows = interpolate_keys(times, _rows(path, camera), wanted, smooth=path.interpolation == "smooth")
    found = []
    for number, row in zip(range(first_frame, first_frame + count), rows, strict=True):
        if path.keys:
            values = [float(value) for value in row]
            names = [item.name for item in fields(CameraOffset)]
            # Between two valid keys everything is valid, up to rounding of the last digit.
            offset = CameraOffset(**dict(zip(names, np.round(values, 12).tolist(), strict=True)))
            there = offset_camera(camera, offset, pivot=centre, normal=ground.unit_normal)
        else:
            there = _pose(camera, row)
        if is_still(camera, there, centre):
            there = camera
        else:
            check_reach(camera, there, pivot=centre, ground=ground, where=f"frame {number}")
        found.append(there)
    return found


def _rows(path: CameraPath, camera: Camera) -> NDArray[np.float64]:
    """Return the interpolated values (K, n), one row per key."""
    if path.keys:
        return np.array([[asdict(key)[item.name] for item in fields(CameraOffset)] for key in path.keys])
    base = np.asarray(camera.world_from_camera, dtype=np.float64)
    rows = []
    for key in path.poses:
        pose = np.asarray(key.world_from_camera, dtype=np.float64)
        # Rotations from the photo's camera are small, so their vectors may be interpolated linearly.
        turn = turn_vector(pose[:3, :3] @ base[:3, :3].T)
        rows.append([*turn, *(pose[:3, 3] - base[:3, 3]), key.zoom])
    return np.array(rows)


def _pose(camera: Camera, row: NDArray[np.float64]) -> Camera:
    base = np.asarray(camera.world_from_camera, dtype=np.float64)
    there = camera_with_pose(camera, turn_matrix(row[:3]) @ base[:3, :3], base[:3, 3] + row[3:6])
    return replace(there, fx=camera.fx * float(row[6]), fy=camera.fy * float(row[6]))


def interpolate_keys(
    times: NDArray[np.float64], values: NDArray[np.float64], wanted: NDArray[np.float64], *, smooth: bool
) -> NDArray[np.float64]:
    """Return ``values`` (K, n) at rising ``times`` (K,) interpolated at ``wanted`` (m,): (m, n); constant outside.

    smooth: monotone cubic Hermite with the slopes of Fritsch & Butland (1984), and slope 0 at both ends.
    """
    at = np.clip(wanted, times[0], times[-1])
    if len(times) == 1:
        return np.repeat(values, len(wanted), axis=0)
    index = np.clip(np.searchsorted(times, at, side="right") - 1, 0, len(times) - 2)
    widths = np.diff(times)
    t = ((at - times[index]) / widths[index])[:, None]
    if not smooth:
        return np.asarray(values[index] * (1 - t) + values[index + 1] * t)
    chords = np.diff(values, axis=0) / widths[:, None]
    slopes = np.zeros_like(values)
    before, after = chords[:-1], chords[1:]
    rising = before * after > 0
    first, second = (2 * widths[1:] + widths[:-1])[:, None], (widths[1:] + 2 * widths[:-1])[:, None]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        mean = (first + second) / (first / before + second / after)
    slopes[1:-1] = np.where(rising, mean, 0.0)
    width = widths[index][:, None]
    low, high = values[index], values[index + 1]
    rest = smoothstep(t)
    bend = width * (t * (1 - t) ** 2 * slopes[index] - t * t * (1 - t) * slopes[index + 1])
    # Weighted from the nearer key, so that a constant value stays the same to the last bit.
    return np.asarray(np.where(rest < 0.5, low + rest * (high - low), high - (1 - rest) * (high - low)) + bend)
