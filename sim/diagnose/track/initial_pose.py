# SPDX-License-Identifier: MIT
"""Initial poses of the objects in a video's first frame, from the photo that the scene was reconstructed from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ...files import MAX_PICTURE_BYTES, read_bytes
from ...scene.folder import Scene, require_photo
from ..capture import Camera
from .feature_tracking import align, extract_patches, find_corners, identity_maps, smoothed, track_points, warp
from .pose_estimation import LEAST_POINTS, Array, Mask, Pose, cast, locate, silhouette
from .track_input import SceneBody, TrackOptions

IN_PLACE_PX = 0.75
"""Median shift in px between photo and frame up to which an object is at its scene pose."""
SIFT_RATIO = 0.8
"""Ratio test: best over second best distance of a match (Lowe, Int. J. Computer Vision 60, 2004)."""
LEAST_MATCHES = 10
_HALF = 8


@dataclass(frozen=True, kw_only=True)
class InitialPose:
    """An object at the start: pose, whether it is at its scene pose, and its mask (H, W), None if unknown."""

    pose: Pose
    in_place: bool
    mask: Mask | None


@dataclass(frozen=True, kw_only=True)
class ScenePhoto:
    """The scene's photo, grey (H, W), and its objects' masks at the video's resolution; None without a mask."""

    grey: NDArray[np.uint8]
    masks: tuple[Mask | None, ...]


def load_scene_photo(folder: Scene, camera: Camera, bodies: Sequence[SceneBody]) -> ScenePhoto:
    """Return the scene's photo. Raises InputError when it is missing, or it or a mask is not an image."""
    size = (camera.width, camera.height)
    masks: list[Mask | None] = []
    for body in bodies:
        name = body.source.mask
        masks.append(None if name is None else _picture(folder, name, size) > 127)
    return ScenePhoto(grey=_picture(folder, require_photo(folder)[0], size), masks=tuple(masks))


_STARTS = (b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff", b"II*\0", b"MM\0*", b"BM")
"""Of PNG, JPEG, TIFF and BMP. OpenCV decodes by content, and its JPEG 2000 has a hole in 4.10 and 4.11, which Blender
4.5's NumPy holds us to (CVE-2025-53644)."""


def _picture(folder: Scene, name: str, size: tuple[int, int]) -> NDArray[np.uint8]:
    path = folder.file(name)
    try:
        content = read_bytes(path, MAX_PICTURE_BYTES, what="picture")
        known = content.startswith(_STARTS) or (content[:4] == b"RIFF" and content[8:12] == b"WEBP")
        image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_GRAYSCALE) if known else None
    except FileNotFoundError:
        raise InputError(f"{path}: there is no such file; restore it or reconstruct the scene again") from None
    # OpenCV refuses more than 2^30 pixels, and some damage, by an error of its own.
    except cv2.error:
        image = None
    if image is None:
        raise InputError(f"{path}: is not an image that can be read; restore it or reconstruct the scene again")
    smaller = size[0] < image.shape[1]
    image = cv2.resize(image, size, interpolation=cv2.INTER_AREA if smaller else cv2.INTER_CUBIC)
    return np.asarray(image, dtype=np.uint8)


def find_initial_poses(
    body: SceneBody,
    index: int,
    photo: ScenePhoto,
    grey: NDArray[np.uint8],
    camera: Camera,
    options: TrackOptions,
    where: str,
) -> InitialPose:
    """Return the pose of the object in the frame ``grey`` (H, W): at its scene pose, near it, or anywhere by features.

    where: names video and frame in messages. Raises InputError for an object without texture, or one not found.
    """
    scene_pose = body.pose(camera)
    shown = silhouette(body.surface, scene_pose, camera)
    mask = photo.masks[index]
    visible = shown if mask is None else shown & mask
    if not visible.any():
        raise InputError(
            f"object {body.source.name!r}: not visible to the scene's camera; check camera and world_from_mesh"
        )
    area = float(visible.sum())
    half = int(np.clip(round(0.07 * np.sqrt(area)), 4, 10))
    corners = find_corners(
        photo.grey,
        visible,
        count=max(options.density, 40),
        half=half,
        spacing=max(4.0, 0.05 * np.sqrt(area)),
        min_contrast=options.min_contrast,
    )
    hits = cast(body.surface, scene_pose, camera, corners)
    corners, rest = corners[hits.face >= 0], hits.rest[hits.face >= 0]
    if len(corners) < LEAST_POINTS:
        raise InputError(no_texture(body.source.name, len(corners), "in the scene's photo"))
    ends, good = _followed(photo.grey, grey, corners)
    if good.sum() >= max(LEAST_POINTS, 0.4 * len(corners)):
        shift = np.linalg.norm(ends[good] - corners[good], axis=1)
        if np.median(shift) <= IN_PLACE_PX:
            return InitialPose(pose=scene_pose, in_place=True, mask=mask)
        fitted = locate(camera, rest[good], ends[good], scene_pose, tolerance=2.0, largest=4.0)
        if fitted is not None and fitted.inliers.sum() >= LEAST_MATCHES:
            return InitialPose(pose=fitted.pose, in_place=False, mask=None)
    pose = _recognised(body, scene_pose, photo.grey, visible, grey, camera)
    if pose is None:
        raise InputError(
            f"{where}: object {body.source.name!r} is not at its scene pose and not recognised elsewhere; give "
            "--start-frame of a frame that shows it as the photo does, or reconstruct the scene from this frame"
        )
    return InitialPose(pose=pose, in_place=False, mask=None)


def no_texture(name: str, count: int, where: str) -> str:
    """Return the error message for an object with too little texture."""
    return (
        f"object {name!r}: {count} trackable points were found {where}, {LEAST_POINTS} are needed: its surface shows "
        "too little texture; add a pattern (stickers, dots, marker lines), film it larger, sharper and in more "
        "light, or lower --min-contrast"
    )


def _followed(photo: NDArray[np.uint8], grey: NDArray[np.uint8], corners: Array) -> tuple[Array, Mask]:
    ends, miss = track_points(photo, grey, corners, corners, 10)
    good = miss < 1.0
    if not good.any():
        return ends, good
    patches = warp(extract_patches(smoothed(photo), corners, _HALF), identity_maps(len(corners)), _HALF)
    places, score = align(smoothed(grey), patches, np.where(good[:, None], ends, corners), _HALF)
    good &= (score > 0.7) & (np.linalg.norm(places - ends, axis=1) < 3.0)
    return places, good


def _recognised(
    body: SceneBody,
    scene_pose: Pose,
    photo: NDArray[np.uint8],
    visible: Mask,
    grey: NDArray[np.uint8],
    camera: Camera,
) -> Pose | None:
    """Return the pose from SIFT matches between the object in the photo and the frame."""
    sift = cv2.SIFT.create(contrastThreshold=0.02)
    known, known_features = sift.detectAndCompute(photo, visible.astype(np.uint8))
    found, found_features = sift.detectAndCompute(grey, None)
    if known_features is None or found_features is None or len(known) < LEAST_MATCHES or len(found) < 2:
        return None
    pairs = cv2.BFMatcher(cv2.NORM_L2).knnMatch(known_features, found_features, k=2)
    pairs = [p for p in pairs if len(p) == 2 and p[0].distance < SIFT_RATIO * p[1].distance]
    if len(pairs) < LEAST_MATCHES:
        return None
    before = np.array([known[p[0].queryIdx].pt for p in pairs]) + 0.5
    after = np.array([found[p[0].trainIdx].pt for p in pairs]) + 0.5
    hits = cast(body.surface, scene_pose, camera, before)
    on = hits.face >= 0
    if on.sum() < LEAST_MATCHES:
        return None
    rest, after = hits.rest[on], after[on]
    matrix = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]])
    try:
        good, turn, shift, inliers = cv2.solvePnPRansac(
            rest, after, matrix, None, iterationsCount=2000, reprojectionError=4.0, flags=cv2.SOLVEPNP_EPNP
        )
    except cv2.error:
        return None
    if not good or inliers is None or len(inliers) < LEAST_MATCHES or shift[2, 0] <= 0:
        return None
    rows = inliers.ravel()
    guess = Pose(
        rotation=np.asarray(cv2.Rodrigues(turn)[0], np.float64), translation=np.asarray(shift, np.float64).ravel()
    )
    fitted = locate(camera, rest[rows], after[rows], guess, tolerance=2.0, largest=4.0)
    if fitted is None or fitted.inliers.sum() < LEAST_MATCHES:
        return None
    return fitted.pose
