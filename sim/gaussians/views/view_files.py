# SPDX-License-Identifier: MIT
"""Views in files: folders with transforms.json, read and written; image grids of SyncDreamer and Zero123++.

transforms.json is that of NeRF, instant-ngp and nerfstudio (docs/file-formats.md, Views folder). Its matrices map
OpenGL axes (x right, y up, z backward) to the world; its pixel coordinates are ours. Fields of other stages
(aabb_scale, depth_file_path) are ignored.

Cameras of the grids: for SyncDreamer (Liu et al. 2023) from the script that rendered its training views, for
Zero123++ (Shi et al. 2023) from its README and issues 68 and 73, where its authors give field of view and distance.
Neither knows an object's size: its bounding box (SyncDreamer) or sphere (Zero123++ 1.2) is scaled to 1 m; a larger
``distance`` scales it up."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from ...atomic import replacing
from ...errors import InputError
from ...scene.folder import inside
from ...scene.model import Camera
from ...validation import read_json, valid_names
from .posed_images import (
    Picture,
    PixelBudget,
    View,
    check_labels_in_mask,
    mask_folders,
    orbit_camera,
    over_white,
    plain_background_mask,
    read_coverage,
    read_image,
    read_labels,
)

MAX_FRAMES = 2000
CAMERA_MODELS = ("PINHOLE", "SIMPLE_PINHOLE", "OPENCV", "SIMPLE_RADIAL", "RADIAL")
"""Camera models without distortion, or whose distortion is given by the coefficients below."""
DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
MAX_SKEW = 1e-3
"""Largest deviation of a matrix's entries from a rotation's; rounding to a few printed digits causes as much."""


@dataclass(frozen=True)
class Frame:
    """One image of a transforms.json. file, mask_file: relative paths; fields: its camera; where: for messages."""

    file: str
    mask_file: str | None
    fields: dict[str, Any]
    where: str

    def camera(self, width: int, height: int) -> Camera:
        """Return its camera for an image of ``width`` by ``height``. Raises InputError on unusable fields."""
        for name in DISTORTION:
            if self._number(name, 0.0) != 0:
                raise InputError(f"{self.where}: {name} distorts the image: undistort it (colmap image_undistorter)")
        model = self.fields.get("camera_model", CAMERA_MODELS[0])
        if model not in CAMERA_MODELS:
            raise InputError(f"{self.where}: camera_model is {str(model)[:40]!r}: use images of a pinhole camera")
        own_width, own_height = self._number("w", width), self._number("h", height)
        if not (own_width >= 1 and own_height >= 1) or abs(own_width * height / (own_height * width) - 1) > 0.01:
            raise InputError(
                f"{self.where}: w, h are {own_width:g}, {own_height:g}, but the image has {width}x{height} pixels: "
                "use the image that belongs to this camera"
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
                f"{self.where}: has no camera (transform_matrix): estimate the cameras first, for example with COLMAP "
                "and instant-ngp's colmap2nerf.py"
            )
        try:
            matrix = np.array(given, dtype=np.float64)
        except (TypeError, ValueError, OverflowError):
            matrix = np.empty(0)
        if matrix.shape not in ((4, 4), (3, 4)) or not (np.abs(matrix) < 1e9).all():
            raise InputError(f"{self.where}: transform_matrix is not a 4x4 matrix of numbers: give camera to world")
        pose = np.eye(4)
        pose[:3] = matrix[:3]
        pose = pose @ FROM_OPENGL
        # The nearest rotation, because files round their numbers.
        left, _, right = np.linalg.svd(pose[:3, :3])
        rotation = left @ right
        if np.abs(rotation - pose[:3, :3]).max() > MAX_SKEW or np.linalg.det(rotation) < 0:
            raise InputError(f"{self.where}: transform_matrix scales or mirrors: give a rotation and a translation")
        pose[:3, :3] = rotation
        return tuple(tuple(float(v) for v in row) for row in pose)


def read_frames(path: Path) -> tuple[Frame, ...]:
    """Return the frames of the transforms.json ``path``, in file order; cameras are parsed on demand.

    Raises InputError when the file is missing, not a transforms.json, or has no frames or too many.
    """
    document = read_json(path)
    frames = document.get("frames") if isinstance(document, dict) else None
    if not isinstance(frames, list) or not frames:
        raise InputError(f"{path}: has no list of frames: give a transforms.json as NeRF and instant-ngp write it")
    if len(frames) > MAX_FRAMES:
        raise InputError(f"{path}: has {len(frames)} frames, more than {MAX_FRAMES}: remove some")
    shared = {name: value for name, value in document.items() if name not in ("frames", "transform_matrix")}
    found = []
    for index, frame in enumerate(frames):
        where = f"{path}: frames[{index}]"
        if not isinstance(frame, dict):
            raise InputError(f"{where}: is not an object with fields")
        names = [frame.get("file_path"), frame.get("mask_path")]
        if not isinstance(names[0], str) or not isinstance(names[1], str | None):
            raise InputError(f"{where}: file_path is {str(names[0])[:40]!r}: give the name of its image")
        found.append(Frame(names[0], names[1], {**shared, **frame}, where))
    return tuple(found)


TRANSFORMS = "transforms.json"
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".bmp")


def read_views(source: Path, *, objects: Sequence[str] = ()) -> tuple[View, ...]:
    """Return the views of the folder ``source``, or of a file that replaces its transforms.json.

    The mask of a view is, in this order: the frame's or ``masks/NAME.png``, the image's opacity, all labelled pixels,
    the foreground of a plain background. objects: folder names under ``masks``, the background object first.

    Raises InputError when cameras are missing or distorted, a file is missing, damaged, outside the folder or of
    another size, masks and labels contradict each other, or the images are too large.
    """
    path = source / TRANSFORMS if source.is_dir() else source
    folder = path.parent
    if not path.is_file():
        raise InputError(_missing_cameras(source))
    frames = read_frames(path)
    names = _view_names(frames)
    order = mask_folders(folder, objects)
    budget = PixelBudget()
    return tuple(_read_view(folder, frame, name, order, budget) for frame, name in zip(frames, names, strict=True))


def _missing_cameras(source: Path) -> str:
    pictures = [p for p in source.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES] if source.is_dir() else []
    if not pictures:
        return f"{source}: no such file; give a folder with {TRANSFORMS} and its images"
    return (
        f"{source}: has {len(pictures)} images but no {TRANSFORMS}, so their cameras are unknown: write one, for "
        "example with COLMAP and instant-ngp's colmap2nerf.py, or give an image grid of SyncDreamer or Zero123++"
    )


def _view_names(frames: Sequence[Frame]) -> list[str]:
    """Return a name for each frame: its file's, with those of its folders where two would be equal."""
    parts = [[part for part in frame.file.split("/") if part not in ("", ".")] for frame in frames]
    short = [Path(part[-1]).stem if part else "" for part in parts]
    if len(set(short)) == len(short):
        return short
    full = ["_".join([*part[:-1], stem]) for part, stem in zip(parts, short, strict=True)]
    if len(set(full)) < len(full):
        twice = next(name for name in full if full.count(name) > 1)
        where = frames[full.index(twice)].where
        raise InputError(f"{where}: has the image {twice[:60]!r}, which another frame has too: remove one")
    return full


def _read_view(folder: Path, frame: Frame, name: str, objects: Sequence[str], budget: PixelBudget) -> View:
    colours, alpha = read_image(_image_path(folder, frame), budget)
    size = (colours.shape[0], colours.shape[1])
    camera = frame.camera(size[1], size[0])
    labels = read_labels(folder, name, objects, size, budget)
    mask_file = frame.mask_file or f"masks/{name}.png"
    if frame.mask_file or (folder / mask_file).is_file():
        mask: Picture | None = read_coverage(inside(folder, mask_file), size, budget)
    elif alpha is not None:
        mask = alpha
    elif labels is not None:
        mask = (labels > 0).astype(colours.dtype)
    else:
        mask = plain_background_mask(colours)
    if mask is not None and labels is not None:
        check_labels_in_mask(name, mask, labels)
    pixels = colours if mask is None else over_white(colours, mask)
    return View(name=name, camera=camera, pixels=pixels, mask=mask, labels=labels)


def _image_path(folder: Path, frame: Frame) -> Path:
    """Return the frame's image file; NeRF's own data sets omit the suffix."""
    try:
        path = inside(folder, frame.file)
        found = path.is_file()
    except (InputError, OSError, ValueError) as error:
        raise InputError(f"{frame.where}: {error}") from None
    if found:
        return path
    for ending in IMAGE_SUFFIXES:
        other = inside(folder, frame.file + ending)
        if other.is_file():
            return other
    raise InputError(f"{frame.where}: no such image {path}: restore it, or remove the frame")


IMAGES, LABELS = "images", "labels"


def save_views(folder: Path, views: Sequence[View]) -> None:
    """Write ``views`` to the new folder ``folder`` atomically: transforms.json, images/, labels/.

    Images are 8-bit PNGs with the mask as their opacity. Raises InputError when there are no views, names are repeated
    or not valid as file names, or the folder is not empty.
    """
    names = [view.name for view in views]
    if not names:
        raise InputError(f"{folder}: no views to write: give at least one")
    if valid_names(names) != names:
        wrong = next(name for name, fit in zip(names, valid_names(names), strict=True) if name != fit)
        raise InputError(f"{folder}: a view cannot be called {wrong[:60]!r}: use distinct names of letters and digits")
    with replacing(folder) as partial:
        (partial / IMAGES).mkdir(parents=True)
        for view in views:
            _rgba_image(view).save(partial / IMAGES / f"{view.name}.png")
            if view.labels is not None:
                (partial / LABELS).mkdir(exist_ok=True)
                numbers = np.maximum(view.labels, 0).astype(np.uint8)
                Image.fromarray(numbers).save(partial / LABELS / f"{view.name}.png")
        document = {"camera_model": "PINHOLE", "frames": [_frame_json(view) for view in views]}
        (partial / TRANSFORMS).write_text(json.dumps(document, indent=2, allow_nan=False) + "\n", encoding="utf-8")
        if folder.is_dir():
            if any(folder.iterdir()):
                raise InputError(f"{folder}: is not empty: choose another folder, or empty it")
            # Windows does not replace folders, not even empty ones.
            folder.rmdir()


def _frame_json(view: View) -> dict[str, Any]:
    camera = view.camera
    pose = np.asarray(camera.world_from_camera, dtype=np.float64) @ FROM_OPENGL
    return {
        "file_path": f"{IMAGES}/{view.name}.png",
        "w": camera.width,
        "h": camera.height,
        "fl_x": camera.fx,
        "fl_y": camera.fy,
        "cx": camera.cx,
        "cy": camera.cy,
        "transform_matrix": pose.tolist(),
    }


def _rgba_image(view: View) -> Image.Image:
    if view.mask is None:
        return Image.fromarray(_bytes(view.pixels))
    share = view.mask[..., None]
    # Undo the compositing over white.
    own = np.where(share > 0, (view.pixels - (1 - share)) / np.maximum(share, 1e-6), 1.0)
    return Image.fromarray(_bytes(np.concatenate([np.clip(own, 0, 1), share], axis=2)))


def _bytes(values: Any) -> Any:
    return np.rint(values * 255).astype(np.uint8)


@dataclass(frozen=True)
class GridLayout:
    """A grid of square views, row by row, of cameras that look at the object's centre.

    azimuths, elevations: degrees, one a view; azimuth 0 is the side from which the input image was taken, +x in the
    world of the views, z up. focal: focal length over a view's side. distance: metres.
    """

    columns: int
    rows: int
    azimuths: tuple[float, ...]
    elevations: tuple[float, ...]
    focal: float
    distance: float


_BLENDER_FOCAL = 35 / 32
"""A 35 mm lens on a 32 mm sensor, as the scripts derived from Zero-1-to-3 set it: a field of view of 49.1°."""
_SIX_AZIMUTHS = tuple(30.0 + 60.0 * i for i in range(6))

LAYOUTS = {
    "syncdreamer": GridLayout(16, 1, tuple(22.5 * i for i in range(16)), (30.0,) * 16, _BLENDER_FOCAL, 1.5),
    # Its distance follows the input image's and is not published: that of SyncDreamer, of the same family.
    "zero123++1.1": GridLayout(2, 3, _SIX_AZIMUTHS, (30.0, -20.0) * 3, _BLENDER_FOCAL, 1.5),
    "zero123++1.2": GridLayout(
        2, 3, _SIX_AZIMUTHS, (20.0, -10.0) * 3, 0.5 / math.tan(math.radians(15)), 0.5 / math.tan(math.radians(15))
    ),
}


def read_view_grid(path: Path, layout: str, *, distance: float | None = None) -> tuple[View, ...]:
    """Return the views in the image grid ``path``, in the order of ``LAYOUTS[layout]``.

    Masks come from its opacity, else from a plain background, else there are none. distance: metres from the cameras to
    the object's centre; None: the layout's own. Raises InputError on an unknown layout, and on an image that is
    missing, damaged, or not of the layout's shape.
    """
    if layout not in LAYOUTS:
        raise InputError(f"layout is {layout!r}: choose one of {', '.join(LAYOUTS)}")
    if distance is not None and not (math.isfinite(distance) and distance > 0):
        raise InputError(f"distance is {distance!r}: give metres above 0, or omit it")
    grid = LAYOUTS[layout]
    colours, alpha = read_image(path, PixelBudget())
    height, width = colours.shape[:2]
    side = width // grid.columns
    if side < 8 or width != side * grid.columns or height != side * grid.rows:
        raise InputError(
            f"{path}: has {width}x{height} pixels, not the {grid.columns} by {grid.rows} square views of {layout}: "
            f"choose another layout ({', '.join(LAYOUTS)}), or give the image as the program wrote it"
        )
    views = []
    for index, (azimuth, elevation) in enumerate(zip(grid.azimuths, grid.elevations, strict=True)):
        row, column = divmod(index, grid.columns)
        window = (slice(row * side, (row + 1) * side), slice(column * side, (column + 1) * side))
        pixels = colours[window]
        mask = plain_background_mask(pixels) if alpha is None else alpha[window]
        camera = orbit_camera(azimuth, elevation, distance or grid.distance, side=side, focal=grid.focal)
        name = f"{path.stem}-{index:02d}"
        pixels = pixels if mask is None else over_white(pixels, mask)
        views.append(View(name=name, camera=camera, pixels=pixels, mask=mask))
    return tuple(views)
