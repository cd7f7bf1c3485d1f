# SPDX-License-Identifier: MIT
"""A camera's path, ``physgen-camera/1``: keys of how it is moved from the photo's own camera, smooth between them."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..atomic import write_json
from .camera_move import ZOOM_RANGE, Offset, check_reach, is_still, moved, posed, turn_matrix, turn_vector
from .checks import finite, require, require_range
from .json_fields import parse, read_json, to_json
from .model import Camera, Ground
from .object import Matrix4

FORMAT = "physgen-camera/1"
INTERPOLATIONS = ("smooth", "linear")
MAX_TIME = 1e6


@dataclass(frozen=True, kw_only=True)
class _Timed:
    """When a key is: ``frame`` as the bake numbers them, or ``time_s`` seconds after its first frame; one of both."""

    frame: float | None = None
    time_s: float | None = None

    def __post_init__(self) -> None:
        both = (self.frame, self.time_s)
        require((self.frame is None) != (self.time_s is None), "frame, time_s", both, "give one of the two")
        require_range("frame", self.frame, -MAX_TIME, MAX_TIME)
        require_range("time_s", self.time_s, -MAX_TIME, MAX_TIME, "seconds")

    def at(self, first_frame: int, fps: float) -> float:
        """The frame, whole or not."""
        if self.frame is not None:
            return self.frame
        assert self.time_s is not None
        return first_frame + self.time_s * fps


@dataclass(frozen=True, kw_only=True)
class MoveKey(_Timed, Offset):
    """A key that says how the camera is moved from the photo's (see ``Offset``)."""

    def __post_init__(self) -> None:
        _Timed.__post_init__(self)
        Offset.__post_init__(self)


@dataclass(frozen=True, kw_only=True)
class PoseKey(_Timed):
    """A key that says where the camera is.

    world_from_camera: 4x4 rigid transform, metres, OpenCV axes. zoom: focal length over the photo's.
    """

    world_from_camera: Matrix4
    zoom: float = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        require_range("zoom", self.zoom, *ZOOM_RANGE, "a factor")
        # The model's camera holds the rule for poses.
        Camera(width=1, height=1, fx=1.0, fy=1.0, cx=0.0, cy=0.0, world_from_camera=self.world_from_camera)


@dataclass(frozen=True, kw_only=True)
class CameraPath:
    """Keys, and what lies between them; the camera stands still before the first and after the last.

    interpolation: ``smooth`` (monotone cubic, at rest at both ends) or ``linear``.
    pivot: what the camera goes around, world metres; None takes the middle of the objects, on the ground.
    backdrop_m: how far along the ground the upright backdrop stands, metres from the camera; None chooses.
    keys, poses: moves or poses, not both, in rising order of time.
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
    """Read a ``physgen-camera/1`` file. Raises InputError naming the file and the field."""
    return parse(CameraPath, read_json(path), str(path))


def save_camera_path(path: Path, camera_path: CameraPath) -> None:
    """Write ``camera_path``, whole or not at all; ``load_camera_path`` gives the equal object back."""
    content = to_json(camera_path)
    for key in (*content["keys"], *content["poses"]):
        del key["time_s" if key["time_s"] is None else "frame"]
    write_json(path, content)


def swing(*, first: int, last: int, azimuth_deg: float = 0.0, elevation_deg: float = 0.0, dolly: float = 0.0,
          zoom: float = 1.0) -> CameraPath:  # fmt: skip
    """One smooth move over the frames ``first`` to ``last``, from the photo's camera to the one named."""
    end = MoveKey(
        frame=float(max(last, first + 1)), azimuth_deg=azimuth_deg, elevation_deg=elevation_deg, dolly=dolly, zoom=zoom
    )
    return CameraPath(keys=(MoveKey(frame=float(first)), end))


def cameras(
    path: CameraPath,
    camera: Camera,
    *,
    ground: Ground,
    pivot: NDArray[np.floating],
    first_frame: int,
    count: int,
    fps: float,
) -> list[Camera]:
    """The camera of each of ``count`` frames from ``first_frame``; ``camera`` itself where it is not moved.

    pivot (3,): used where the path names none. Raises InputError for a camera that goes too far or too low.
    """
    centre = np.asarray(path.pivot if path.pivot is not None else pivot, dtype=np.float64)
    keys: Sequence[_Timed] = path.keys or path.poses
    times = np.array([key.at(first_frame, fps) for key in keys])
    wanted = first_frame + np.arange(count, dtype=np.float64)
    rows = interpolated(times, _rows(path, camera), wanted, smooth=path.interpolation == "smooth")
    found = []
    for number, row in zip(range(first_frame, first_frame + count), rows, strict=True):
        if path.keys:
            values = [float(value) for value in row]
            names = [item.name for item in fields(Offset)]
            # What lies between two good keys is good; rounding may say otherwise by the last digit.
            offset = Offset(**dict(zip(names, np.round(values, 12).tolist(), strict=True)))
            there = moved(camera, offset, pivot=centre, normal=ground.unit_normal)
        else:
            there = _pose(camera, row)
        if is_still(camera, there, centre):
            there = camera
        else:
            check_reach(camera, there, pivot=centre, ground=ground, where=f"frame {number}")
        found.append(there)
    return found


def _rows(path: CameraPath, camera: Camera) -> NDArray[np.float64]:
    """What is interpolated (K, n), a row a key."""
    if path.keys:
        return np.array([[asdict(key)[item.name] for item in fields(Offset)] for key in path.keys])
    base = np.asarray(camera.world_from_camera, dtype=np.float64)
    rows = []
    for key in path.poses:
        pose = np.asarray(key.world_from_camera, dtype=np.float64)
        # Turns from the photo's camera are small, so their vectors may be mixed like numbers.
        turn = turn_vector(pose[:3, :3] @ base[:3, :3].T)
        rows.append([*turn, *(pose[:3, 3] - base[:3, 3]), key.zoom])
    return np.array(rows)


def _pose(camera: Camera, row: NDArray[np.float64]) -> Camera:
    base = np.asarray(camera.world_from_camera, dtype=np.float64)
    there = posed(camera, turn_matrix(row[:3]) @ base[:3, :3], base[:3, 3] + row[3:6])
    return replace(there, fx=camera.fx * float(row[6]), fy=camera.fy * float(row[6]))


def interpolated(
    times: NDArray[np.float64], values: NDArray[np.float64], wanted: NDArray[np.float64], *, smooth: bool
) -> NDArray[np.float64]:
    """``values`` (K, n) at ``times`` (K,), rising, as they are at ``wanted`` (m,): (m, n); constant outside.

    smooth: cubic Hermite with the slopes of Fritsch & Butland (1984), which never overshoots, and 0 at both ends.
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
    rest = t * t * (3 - 2 * t)
    bend = width * (t * (1 - t) ** 2 * slopes[index] - t * t * (1 - t) * slopes[index + 1])
    # The weight is taken from the nearer key, so that a value that does not change is kept to the last bit.
    return np.asarray(np.where(rest < 0.5, low + rest * (high - low), high - (1 - rest) * (high - low)) + bend)
