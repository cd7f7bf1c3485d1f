# SPDX-License-Identifier: MIT
"""What a transforms.json of NeRF, instant-ngp and nerfstudio says of each picture: where it is, and its camera.

Its matrices take the axes of OpenGL (x right, y up, z backward) to the world; its pixels are ours. Fields of other
stages (aabb_scale, depth_file_path) are ignored.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import InputError
from ...scene.json_fields import read_json
from ...scene.model import Camera

MAX_FRAMES = 2000
LENSES = ("PINHOLE", "SIMPLE_PINHOLE", "OPENCV", "SIMPLE_RADIAL", "RADIAL")
"""Models without distortion, or whose distortion is one of the coefficients."""
DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
SKEW = 1e-3
"""How far a matrix's entries may be from a rotation's; so much comes from a few printed digits."""


@dataclass(frozen=True)
class Frame:
    """One picture: its file, that of its mask if the frame names one, and the fields that make its camera."""

    file: str
    mask_file: str | None
    fields: dict[str, Any]
    where: str

    def camera(self, width: int, height: int) -> Camera:
        """Its camera for a picture of ``width`` by ``height``; InputError where the fields make none."""
        for name in DISTORTION:
            if self._number(name, 0.0) != 0:
                raise InputError(f"{self.where}: {name} distorts the picture: undistort it (colmap image_undistorter)")
        model = self.fields.get("camera_model", LENSES[0])
        if model not in LENSES:
            raise InputError(f"{self.where}: camera_model is {str(model)[:40]!r}: give pictures of a pinhole camera")
        own_width, own_height = self._number("w", width), self._number("h", height)
        if not (own_width >= 1 and own_height >= 1) or abs(own_width * height / (own_height * width) - 1) > 0.01:
            raise InputError(
                f"{self.where}: w, h are {own_width:g}, {own_height:g} and the picture has {width}x{height} pixels: "
                "give the picture that the camera is of"
            )
        across, down = width / own_width, height / own_height
        fx = self._focal("fl_x", "camera_angle_x", own_width)
        fy = self._focal("fl_y", "camera_angle_y", own_height)
        if fx is None and fy is None:
            raise InputError(f"{self.where}: has no focal length: give fl_x in pixels, or camera_angle_x in radians")
        fx, fy = fx or fy, fy or fx
        assert fx is not None and fy is not None
        cx, cy = self._number("cx", own_width / 2), self._number("cy", own_height / 2)
        try:
            return Camera(
                width=width,
                height=height,
                fx=fx * across,
                fy=fy * down,
                cx=cx * across,
                cy=cy * down,
                world_from_camera=self._pose(),
            )
        except InputError as error:
            raise InputError(f"{self.where}: {error}") from None

    def _number(self, name: str, default: float) -> float:
        value = self.fields.get(name, default)
        if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < 1e9:
            raise InputError(f"{self.where}: {name} is {str(value)[:40]!r}: give a number")
        return float(value)

    def _focal(self, length: str, angle: str, side: float) -> float | None:
        if length in self.fields:
            return self._positive(length)
        if angle not in self.fields:
            return None
        value = self._positive(angle)
        if value >= math.pi:
            raise InputError(f"{self.where}: {angle} is {value:g}: give radians below pi")
        return 0.5 * side / math.tan(0.5 * value)

    def _positive(self, name: str) -> float:
        value = self._number(name, 0.0)
        if value <= 1e-6:
            raise InputError(f"{self.where}: {name} is {value:g}: give a number above 0")
        return value

    def _pose(self) -> Any:
        given = self.fields.get("transform_matrix")
        if given is None:
            raise InputError(
                f"{self.where}: has no camera (transform_matrix): find the cameras first, for example with COLMAP and "
                "instant-ngp's colmap2nerf.py"
            )
        try:
            matrix = np.array(given, dtype=np.float64)
        except (TypeError, ValueError, OverflowError):
            matrix = np.empty(0)
        if matrix.shape not in ((4, 4), (3, 4)) or not (np.abs(matrix) < 1e9).all():
            raise InputError(f"{self.where}: transform_matrix is no 4x4 matrix of numbers: give camera to world")
        pose = np.eye(4)
        pose[:3] = matrix[:3]
        pose = pose @ FROM_OPENGL
        # The nearest rotation: files round their numbers.
        left, _, right = np.linalg.svd(pose[:3, :3])
        rotation = left @ right
        if np.abs(rotation - pose[:3, :3]).max() > SKEW or np.linalg.det(rotation) < 0:
            raise InputError(f"{self.where}: transform_matrix scales or mirrors: give a rotation and a shift")
        pose[:3, :3] = rotation
        return tuple(tuple(float(v) for v in row) for row in pose)


def read_frames(path: Path) -> tuple[Frame, ...]:
    """The frames of the file ``path``, in its order; their cameras are looked at when they are asked for.

    Raises InputError when it is missing, no such file, or has no frames.
    """
    document = read_json(path)
    frames = document.get("frames") if isinstance(document, dict) else None
    if not isinstance(frames, list) or not frames:
        raise InputError(f"{path}: has no list of frames: give a transforms.json as NeRF and instant-ngp have it")
    if len(frames) > MAX_FRAMES:
        raise InputError(f"{path}: has {len(frames)} frames, more than {MAX_FRAMES}: leave some out")
    shared = {name: value for name, value in document.items() if name not in ("frames", "transform_matrix")}
    found = []
    for index, frame in enumerate(frames):
        where = f"{path}: frames[{index}]"
        if not isinstance(frame, dict):
            raise InputError(f"{where}: is no object with fields")
        names = [frame.get("file_path"), frame.get("mask_path")]
        if not isinstance(names[0], str) or not isinstance(names[1], str | None):
            raise InputError(f"{where}: file_path is {str(names[0])[:40]!r}: give the name of its picture")
        found.append(Frame(names[0], names[1], {**shared, **frame}, where))
    return tuple(found)
