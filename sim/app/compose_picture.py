# SPDX-License-Identifier: MIT
"""The picture that a composition has to look like, and how much it does. Imports Taichi when it renders."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..composite.metrics import psnr
from ..composite.ssim import ssim
from ..composite.transfer import read_mask, read_rgb
from ..errors import InputError
from ..gaussians.compose.asset import Reference
from ..gaussians.splats import Splats
from ..scene.folder import SceneFolder
from ..scene.model import Camera, SceneObject

MIXED = 2
"""Pixels around an object whose colours the photo has mixed with what is behind."""


@dataclass(frozen=True, kw_only=True)
class Likeness:
    """How much the composition looks like the picture, over all of it. psnr: dB; ssim: 1 where they are equal."""

    psnr: float
    ssim: float


def require_picture(folder: SceneFolder) -> None:
    """Raise InputError, with the way out, where ``folder`` has no photo to look at."""
    if folder.scene.photo is None:
        raise InputError(
            f"{folder.root}: this scene has no photo, so there is nothing to look like; give --no-picture, which "
            "leaves the objects to physics alone (method ppps)"
        )


def reference_of(folder: SceneFolder, items: Sequence[SceneObject], *, size: int) -> Reference:
    """The scene's photo, its longer side ``size`` pixels or less, for the objects ``items``.

    The backdrop is the photo itself, shadows and other objects included, and behind what it shows of ``items`` the
    scene's background: so nothing but these objects can make a difference. Without masks of them, the background.

    Raises InputError when the scene has no photo, or pictures of another size than its camera's.
    """
    require_picture(folder)
    scene = folder.scene
    assert scene.photo is not None and scene.background is not None
    photo, background = (read_rgb(folder.file(name)) for name in (scene.photo, scene.background))
    wanted = (scene.camera.height, scene.camera.width, 3)
    for name, picture in ((scene.photo, photo), (scene.background, background)):
        if picture.shape != wanted:
            raise InputError(
                f"{folder.file(name)}: has {picture.shape[1]}x{picture.shape[0]} pixels, the scene's camera "
                f"{wanted[1]}x{wanted[0]}; restore the picture"
            )
    masks = [read_mask(folder.file(item.mask)) for item in items if item.mask is not None]
    if len(masks) == len(items) and all(mask.shape == wanted[:2] for mask in masks):
        seen = np.any(masks, axis=0).astype(np.uint8)
        wide = cv2.dilate(seen, np.ones((2 * MIXED + 1, 2 * MIXED + 1), np.uint8)).astype(np.bool_)
        background = np.where(wide[..., None], background, photo)
    camera = smaller(scene.camera, size)
    return Reference(camera=camera, pixels=_fitted(photo, camera), backdrop=_fitted(background, camera))


def smaller(camera: Camera, size: int) -> Camera:
    """``camera`` with at most ``size`` pixels along the longer side; the same view."""
    share = min(1.0, size / max(camera.width, camera.height))
    width, height = max(1, round(camera.width * share)), max(1, round(camera.height * share))
    x, y = width / camera.width, height / camera.height
    return dataclasses.replace(
        camera,
        width=width,
        height=height,
        fx=camera.fx * x,
        cx=camera.cx * x,
        fy=camera.fy * y,
        cy=camera.cy * y,
    )


def _fitted(picture: NDArray[np.uint8], camera: Camera) -> NDArray[np.float64]:
    small = cv2.resize(picture.astype(np.float64) / 255.0, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    return np.asarray(small, dtype=np.float64)


def seen_colours(folder: SceneFolder, places: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
    """(N, 3) the photo's sRGB colours along the rays to ``places`` (N, 3): what a mesh without a picture wears."""
    scene = folder.scene
    assert scene.photo is not None
    photo = read_rgb(folder.file(scene.photo))
    pixels = scene.camera.project(places)[:, :2]
    column = np.clip(np.nan_to_num(pixels[:, 0]), 0, photo.shape[1] - 1).astype(np.int64)
    row = np.clip(np.nan_to_num(pixels[:, 1]), 0, photo.shape[0] - 1).astype(np.int64)
    return photo[row, column].astype(np.float64) / 255.0


def likeness(splats: Splats, reference: Reference) -> Likeness:
    """How much ``splats`` look like the reference."""
    # Late: it needs Taichi, which whoever only asks for the picture does not.
    from ..gaussians.raster.rasteriser import Rasteriser

    seen = Rasteriser().render(splats, reference.camera, background=(0.0, 0.0, 0.0))
    picture = np.clip(seen.colour + (1.0 - seen.alpha[..., None]) * reference.backdrop, 0.0, 1.0).astype(np.float64)
    return Likeness(psnr=psnr(picture, reference.pixels, peak=1.0), ssim=ssim(picture, reference.pixels))
