# SPDX-License-Identifier: GPL-3.0-or-later
"""What the camera does over a bake, and the background that it sees while it moves (docs/camera.md). Needs no bpy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ...sim.composite import canvas, depth_layers, transfer
from ...sim.composite.relief import Relief, borders_of
from ...sim.composite.stage import Stage, make_stage
from ...sim.errors import InputError
from ...sim.scene.camera_move import USUAL_ANGLE_DEG, USUAL_DISTANCE, at_size, reach
from ...sim.scene.camera_path import CameraPath, cameras, load_camera_path, swing
from ...sim.scene.folder import SceneFolder
from ...sim.scene.json_fields import to_json
from ...sim.scene.model import Camera
from .exr import read_layers
from .options import RenderOptions
from .plate import Plate


@dataclass(frozen=True)
class Shot:
    """The cameras of a bake's frames, and the stage that they look at.

    still: the photo's camera. cameras: by sample, from frame ``first_frame``; empty where none moves.
    stage: the background as the photo's camera stands to it; None where none moves.
    """

    still: Camera
    cameras: tuple[Camera, ...] = ()
    stage: Stage | None = None
    first_frame: int = 1
    notices: tuple[str, ...] = ()

    def camera(self, sample: int) -> Camera:
        """Of the frame that shows ``sample`` of the caches."""
        return self.cameras[min(sample, len(self.cameras) - 1)] if self.cameras else self.still

    def inputs(self, sample: int) -> Any:
        """What a frame's picture depends on besides everything else, as JSON; None for the photo's own camera."""
        camera = self.camera(sample)
        if camera == self.still or self.stage is None:
            return None
        return {
            "camera": to_json(camera),
            "borders": to_json(self._own_borders),
            "backdrop": self.stage.distance,
        }

    def borders(self, size: tuple[int, int]) -> canvas.Borders:
        """What all the cameras together see beyond a photo of ``size``.

        Of the whole path, so that machines that share its frames paint the same. Raises InputError for too much.
        """
        if self.stage is None:
            return canvas.Borders()
        numbers = {camera: number for number, camera in enumerate(self.cameras, start=self.first_frame)}
        views = [(f"frame {n}", at_size(camera, size)) for camera, n in numbers.items() if camera != self.still]
        return borders_of(self.stage, at_size(self.still, size), views)

    @cached_property
    def _own_borders(self) -> canvas.Borders:
        return self.borders((self.still.width, self.still.height))


def make_shot(
    folder: SceneFolder, rest: Sequence[NDArray[np.floating]], options: RenderOptions, *, first_frame: int, count: int,
    fps: float,
) -> Shot:  # fmt: skip
    """The shot that ``options`` ask for; ``rest`` (V, 3) are the objects' vertices at rest, world metres.

    Raises InputError for a file that cannot be used, and for a camera that goes where it cannot.
    """
    scene = folder.scene
    path = _path(options, first_frame, first_frame + count - 1)
    if path is None:
        return Shot(still=scene.camera)
    pivot = ground_centre(folder, rest)
    found = cameras(path, scene.camera, ground=scene.ground, pivot=pivot, first_frame=first_frame, count=count, fps=fps)
    if all(camera == scene.camera for camera in found):
        return Shot(still=scene.camera, notices=("the camera's path does not move it: frames are the photo's",))
    stage = make_stage(scene.camera, scene.ground, rest, path.backdrop_m)
    for number, camera in enumerate(found, start=first_frame):
        ahead = float((camera.position - stage.origin) @ stage.forward)
        if ahead >= stage.distance - stage.bend:
            raise InputError(
                f"frame {number}: the camera stands in the backdrop, {stage.distance:.3g} m from the photo's camera: "
                "give a larger backdrop_m, or a smaller move"
            )
    shot = Shot(still=scene.camera, cameras=tuple(found), stage=stage, first_frame=first_frame)
    # Asked now, so that a path that goes too far is refused before anything is rendered.
    shot.borders((scene.camera.width, scene.camera.height))
    centre = np.asarray(path.pivot if path.pivot is not None else pivot)
    return replace(shot, notices=_notices(scene.camera, found, centre))


def ground_centre(folder: SceneFolder, rest: Sequence[NDArray[np.floating]]) -> NDArray[np.float64]:
    """The middle (3,) of all objects' boxes, on the ground: what a camera goes around unless told otherwise."""
    ground = folder.scene.ground
    middle = np.mean([(np.min(v, axis=0) + np.max(v, axis=0)) / 2.0 for v in rest], axis=0)
    return np.asarray(middle - ground.heights(middle) * ground.unit_normal)


def make_relief(shot: Shot, folder: SceneFolder, plate: Plate, size: tuple[int, int]) -> Relief:
    """The background that ``shot`` sees, for frames of ``size``. Raises InputError for a depth that cannot be used."""
    assert shot.stage is not None
    photo, borders = at_size(shot.still, size), shot.borders(size)
    if folder.scene.depth is None:
        return Relief(camera=photo, stage=shot.stage, borders=borders)
    cut = depth_layers.cut(_depth(folder, size), plate.masks, shot.stage, photo, borders)
    relief = Relief(camera=photo, stage=shot.stage, borders=borders, ratio=cut.ratio)
    if not cut.things:
        return relief
    # A thing's outline is mixed with what it hides, so a little more is painted over.
    hidden = cv2.dilate(cut.hidden.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    behind = canvas.filled(plate.extended(borders).background, hidden)
    return replace(relief, things=cut.things, hidden=hidden, behind=behind)


def _depth(folder: SceneFolder, size: tuple[int, int]) -> NDArray[np.float32]:
    """The scene's depth map (H, W) at ``size``, metres along the camera's axis, without mixing near and far."""
    path = folder.file(str(folder.scene.depth))
    channels = read_layers(path)
    image = next(iter(channels.values()))
    camera = folder.scene.camera
    if image.shape != (camera.height, camera.width):
        raise InputError(
            f"{path}: is {image.shape[1]}×{image.shape[0]}, the camera's image is {camera.width}×{camera.height}; "
            "give a depth map of the photo's size"
        )
    return transfer.nearest(image, *size)


def _path(options: RenderOptions, first: int, last: int) -> CameraPath | None:
    if options.camera is not None:
        return load_camera_path(Path(options.camera))
    if not (options.orbit or options.rise or options.dolly):
        return None
    return swing(first=first, last=last, azimuth_deg=options.orbit, elevation_deg=options.rise, dolly=options.dolly)


def _notices(camera: Camera, found: Sequence[Camera], pivot: NDArray[np.float64]) -> tuple[str, ...]:
    reaches = [reach(camera, there, pivot) for there in found]
    around, nearer = max(a for a, _ in reaches), max(abs(n) for _, n in reaches)
    if around <= USUAL_ANGLE_DEG + 0.5 and nearer <= USUAL_DISTANCE + 0.005:
        return ()
    return (
        f"the camera moves by up to {around:.0f}° and {100 * nearer:.0f} % of its distance: beyond "
        f"{USUAL_ANGLE_DEG:g}° and {100 * USUAL_DISTANCE:g} % what the photo does not show begins to be seen",
    )
