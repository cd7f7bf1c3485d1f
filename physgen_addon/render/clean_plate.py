# SPDX-License-Identifier: GPL-3.0-or-later
"""The clean plate: the photo without its objects, also under a moving camera (docs/rendering.md). Needs no bpy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ...sim import srgb
from ...sim.composite import backdrop, disocclusion
from ...sim.composite.backdrop import Backdrop, Proxy, Warp, borders_of, make_proxy
from ...sim.composite.compositing import SOFT, ObjectLayer, behind, shadow_exponents, shows_shadow
from ...sim.composite.outpaint import Borders, inpaint_hole, outpaint
from ...sim.errors import InputError
from ...sim.scene.camera_path import (
    USUAL_ANGLE_DEG,
    USUAL_DISTANCE,
    CameraPath,
    at_size,
    load_camera_path,
    reach,
    sample_cameras,
    swing,
)
from ...sim.scene.folder import Scene
from ...sim.scene.model import Camera
from ...sim.srgb import Linear
from ...sim.validation import to_json
from ..frames.frame_files import read_layers
from .render_options import RenderOptions


@dataclass(frozen=True)
class PlateView:
    """Camera of a frame, and the position on the photo of each of its pixels.

    camera: in pixels of the photo. size: (width, height) of the frames.
    relief: the background as geometry; None for the photo's own camera, for which images are passed through bit for
    bit.
    """

    camera: Camera
    size: tuple[int, int]
    relief: Backdrop | None = None

    @property
    def moved(self) -> bool:
        """Whether it is not the photo's own camera."""
        return self.relief is not None

    def warp(self, image: NDArray[Any]) -> NDArray[Any]:
        """Return ``image`` (H, W, …), weights, light or masks over the photo or its canvas, as seen by this camera."""
        return image if self._warp is None else self._warp.values(self._canvas(image))

    def colours(self, image: Linear) -> Linear:
        """Return ``image`` (H, W, 3) in the photo's colours as seen by this camera, with disoccluded background filled
        in.
        """
        return image if self._warp is None else self._warp.colours(self._canvas(image))

    def on_photo(self, points: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return positions on the photo (V, 2), in the frames' pixels, of the background behind ``points`` for this
        camera.

        points: (V, 3) world metres.
        """
        pixels = at_size(self.camera, self.size).project(points)[:, :2]
        return pixels if self._warp is None else self._warp.photo_pixels(pixels)

    @cached_property
    def _warp(self) -> Warp | None:
        return None if self.relief is None else self.relief.warp(at_size(self.camera, self.size))

    def _canvas(self, image: NDArray[Any]) -> NDArray[Any]:
        assert self.relief is not None
        return self.relief.borders.padded(image) if image.shape[1::-1] == self.size else image


@dataclass(frozen=True)
class Seen:
    """The plate seen by a view: photo and background (H, W, 3), the weight w (H, W), masks (H, W).

    contacts: (H, W) the weight of the objects' contacts with the ground alone, as smooth as these.
    """

    photo: srgb.Linear
    background: srgb.Linear
    at_rest: NDArray[np.float32]
    masks: NDArray[np.bool_]
    contacts: NDArray[np.float32]


@dataclass(frozen=True, kw_only=True)
class Extended:
    """The background on a canvas (H, W, 3) with ``borders``, and ``revealed``: the same with the photo's own shadows.

    halos: pixels of the photo around each object that are valid only from the photo's own camera.
    """

    borders: Borders
    background: srgb.Linear
    revealed: srgb.Linear
    halos: list[disocclusion.Rim]


class CleanPlate:
    """Photo and background in linear light, masks, and the weight of the pixels that are still at rest.

    photo, background: (H, W, 3) linear light. masks: (H, W) True where the photo shows an object; object_masks: per
    object.
    """

    def __init__(self, folder: Scene, size: tuple[int, int], rest_vertices: Sequence[NDArray[np.float32]]) -> None:
        """``size`` (width, height) of the frames; ``rest_vertices`` (V, 3) of each object, world metres.

        Raises InputError for an image that is missing, unreadable, or not of the camera's size.
        """
        self._folder, self._scene, self._size, self._rest = folder, folder.model, size, list(rest_vertices)
        self._extended: Extended | None = None
        self.photo, self.background = (self._image(name) for name in self._scene.photo_files)
        self.object_masks = masks = [self._mask(item.mask) for item in self._scene.objects]
        self.masks: NDArray[np.bool_] = np.logical_or.reduce(masks)
        self._shares = disocclusion.influence(
            [mask | self._mask(item.shadow) for mask, item in zip(masks, self._scene.objects, strict=True)]
        )
        edges = [disocclusion.inner_rim(mask) for mask in masks]
        self._outskirts = self._outside()
        self._rims = self._around(
            [np.maximum(outside, edge.astype(np.float32)) for outside, edge in zip(self._outskirts, edges, strict=True)]
        )
        self._cores: NDArray[np.bool_] = self.masks & ~np.logical_or.reduce(edges)
        self._behind = self.photo

    def _outside(self) -> list[NDArray[np.float32]]:
        """Return per object the share (H, W) of the pixels beside its mask that leave with it as soon as it moves."""
        rims = [disocclusion.rim_strength(mask, self.masks) for mask in self.object_masks]
        # Mirror images beside an object are the ground's, and brighter or darker than it.
        if not rims or self._scene.ground_plane.reflectivity > 0.0:
            return rims
        shadow = np.logical_or.reduce([self._mask(item.shadow) for item in self._scene.objects])
        left = disocclusion.remains(self.photo, self.background, self.object_masks, shadow)
        return [np.maximum(rim, rest) for rim, rest in zip(rims, left, strict=True)]

    def show_behind(self, layer: ObjectLayer) -> None:
        """Use at rest, behind the soft outlines of the objects, ``layer`` at rest, what the photo shows there."""
        soft = self.masks & (layer.alpha < 1.0 - SOFT)
        if not soft.any():
            return
        self._behind = behind(self.photo, layer)
        self._rims = self._around(
            [
                np.maximum(outside, (disocclusion.inner_rim(mask) | (soft & mask)).astype(np.float32))
                for outside, mask in zip(self._outskirts, self.object_masks, strict=True)
            ]
        )
        self._cores = self._cores & ~soft

    def seen(self, view: PlateView, now: Sequence[NDArray[np.float32]]) -> Seen:
        """Return the plate as seen by ``view`` with the objects' vertices at ``now`` (V, 3)."""
        contacts = self._contacts_at_rest(now)
        if view.relief is None:
            at_rest = contacts.copy()
            for rim, positions in zip(self._rims, now, strict=True):
                rim.apply(at_rest, self._pixels(positions))
            return Seen(self._behind, self.background, at_rest, self._cores, contacts)
        extended = self.extended(view.relief.borders)
        keep = np.where(self.masks, np.float32(0.0), np.float32(1.0))
        for halo, positions in zip(extended.halos, now, strict=True):
            halo.apply(keep, view.on_photo(positions))
        inner = view.relief.borders.inner(self._size)
        photo = extended.revealed.copy()
        photo[inner] += (self.photo - photo[inner]) * keep[..., None]
        return Seen(
            photo=view.colours(photo),
            background=view.colours(extended.background),
            at_rest=view.warp(contacts),
            masks=np.zeros(self.masks.shape, dtype=bool),
            contacts=view.warp(contacts),
        )

    def shadow_exponents(self, rest_shadow: srgb.Linear) -> NDArray[np.float32]:
        """Return the exponents (3,) that give rendered shadows the photo's colour and depth; ``rest_shadow`` (H, W, 3)
        is that at rest."""
        shaded, known = self._shaded_and_known()
        return shadow_exponents(self.photo, self.background, rest_shadow, shaded=shaded, known=known)

    def shows_shadow(self, rest_shadow: srgb.Linear) -> bool:
        """Return whether the photo shows shadows of its objects, where the scene says anything about that;
        ``rest_shadow`` as of ``shadow_exponents``."""
        if any(item.shadow is None for item in self._scene.objects):
            return True
        shaded, known = self._shaded_and_known()
        return shows_shadow(self.photo, self.background, rest_shadow, shaded=shaded, known=known)

    def _shaded_and_known(self) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        shaded = np.logical_or.reduce([self._mask(item.shadow) for item in self._scene.objects])
        rims = np.maximum.reduce([disocclusion.rim_strength(mask, self.masks) for mask in self.object_masks])
        return shaded, ~self.masks & (rims == 0.0)

    def extended(self, borders: Borders) -> Extended:
        """Return the background extended to a canvas with ``borders``, for a moving camera; computed once."""
        if self._extended is None or self._extended.borders != borders:
            background = outpaint(self.background, borders)
            shadow = np.logical_or.reduce([self._mask(item.shadow) for item in self._scene.objects])
            rims = np.maximum.reduce([disocclusion.rim_strength(mask, self.masks) for mask in self.object_masks])
            unknown = self.masks | (rims > 0)
            if all(item.shadow is None for item in self._scene.objects):
                shadow = disocclusion.found_shadow(self.photo, self.background, unknown)
            found = disocclusion.object_halos(self.photo, self.background, self.object_masks, shadow)
            ratio = disocclusion.shade(self.photo, self.background, shadow=shadow, unknown=unknown)
            self._extended = Extended(
                borders=borders,
                background=background,
                revealed=background * borders.faded(ratio),
                halos=self._around(found),
            )
        return self._extended

    def _contacts_at_rest(self, now: Sequence[NDArray[np.float32]]) -> NDArray[np.float32]:
        """Return the weight w (H, W) from the objects' ground contacts, with their vertices at ``now`` (V, 3)."""
        normal = np.asarray(self._scene.ground_plane.normal)
        weights = []
        for item, start, positions in zip(self._scene.objects, self._rest, now, strict=True):
            contact = disocclusion.contact_vertices(start, normal)
            weights.append(
                disocclusion.rest_weight(disocclusion.contact_displacement(start, positions, contact, item.size_m))
            )
        return disocclusion.rest_map(self._shares, weights)

    def _around(self, strengths: Sequence[NDArray[np.float32]]) -> list[disocclusion.Rim]:
        """Return one rim of ``strengths`` (H, W) per object."""
        return [disocclusion.Rim(s, self._pixels(start)) for s, start in zip(strengths, self._rest, strict=True)]

    def _image(self, name: str) -> srgb.Linear:
        pixels = srgb.read_rgb(self._folder.file(name))
        self._require_size(name, pixels)
        return srgb.resized(srgb.bytes_to_linear(pixels), *self._size)

    def _mask(self, name: str | None) -> NDArray[np.bool_]:
        if name is None:
            return np.zeros(self._size[::-1], dtype=bool)
        mask = srgb.read_mask(self._folder.file(name))
        self._require_size(name, mask)
        return np.asarray(srgb.resized(mask.astype(np.float32), *self._size) > 0.5)

    def _require_size(self, name: str, image: NDArray[np.generic]) -> None:
        height, width = image.shape[:2]
        camera = self._scene.camera
        if (width, height) != (camera.width, camera.height):
            raise InputError(
                f"{self._folder.file(name)}: is {width}×{height}, the camera's image is "
                f"{camera.width}×{camera.height}; reconstruct the scene again"
            )

    def _pixels(self, positions: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return pixels (V, 2) of world ``positions`` (V, 3) on the photo at the frames' size."""
        camera = self._scene.camera
        scale = np.array([self._size[0] / camera.width, self._size[1] / camera.height])
        return camera.project(positions)[:, :2] * scale


@dataclass(frozen=True)
class CameraMotion:
    """Cameras of a bake's frames, and the backdrop geometry.

    still: the photo's camera. cameras: by sample, from frame ``first_frame``; empty if static. stage: backdrop proxy
    geometry in the photo camera's frame; None if static.
    """

    still: Camera
    cameras: tuple[Camera, ...] = ()
    stage: Proxy | None = None
    first_frame: int = 1
    notices: tuple[str, ...] = ()

    def camera(self, sample: int) -> Camera:
        """Return the camera of the frame that shows ``sample`` of the caches."""
        return self.cameras[min(sample, len(self.cameras) - 1)] if self.cameras else self.still

    def inputs(self, sample: int) -> Any:
        """Return the camera's part of a frame's inputs as JSON; None for the photo's own camera."""
        camera = self.camera(sample)
        if camera == self.still or self.stage is None:
            return None
        return {
            "camera": to_json(camera),
            "borders": to_json(self._own_borders),
            "backdrop": self.stage.distance,
        }

    def borders(self, size: tuple[int, int]) -> Borders:
        """Return how far all cameras together see beyond a photo of ``size``.

        For the whole path, so that machines that share its frames compute the same background. Raises InputError for
        too much.
        """
        if self.stage is None:
            return Borders()
        numbers = {camera: number for number, camera in enumerate(self.cameras, start=self.first_frame)}
        views = [(f"frame {n}", at_size(camera, size)) for camera, n in numbers.items() if camera != self.still]
        return borders_of(self.stage, at_size(self.still, size), views)

    @cached_property
    def _own_borders(self) -> Borders:
        return self.borders((self.still.width, self.still.height))


def make_camera_motion(
    folder: Scene, rest: Sequence[NDArray[np.floating]], options: RenderOptions, *, first_frame: int, count: int,
    fps: float,
) -> CameraMotion:  # fmt: skip
    """Return the camera motion set by ``options``; ``rest`` (V, 3) are the objects' vertices at rest, world metres.

    Raises InputError for an invalid file, and for a camera path outside the admissible space.
    """
    scene = folder.model
    path = _path(options, first_frame, first_frame + count - 1)
    if path is None:
        return CameraMotion(still=scene.camera)
    pivot = ground_centre(folder, rest)
    found = sample_cameras(
        path, scene.camera, ground=scene.ground_plane, pivot=pivot, first_frame=first_frame, count=count, fps=fps
    )
    if all(camera == scene.camera for camera in found):
        return CameraMotion(still=scene.camera, notices=("the camera's path does not move it: frames are the photo's",))
    stage = make_proxy(scene.camera, scene.ground_plane, rest, path.backdrop_m)
    for number, camera in enumerate(found, start=first_frame):
        ahead = float((camera.position - stage.origin) @ stage.forward)
        if ahead >= stage.distance - stage.bend:
            raise InputError(
                f"frame {number}: the camera stands in the backdrop, {stage.distance:.3g} m from the photo's camera: "
                "give a larger backdrop_m, or a smaller move"
            )
    shot = CameraMotion(still=scene.camera, cameras=tuple(found), stage=stage, first_frame=first_frame)
    # Checked now, so that an excessive path is rejected before anything is rendered.
    shot.borders((scene.camera.width, scene.camera.height))
    centre = np.asarray(path.pivot if path.pivot is not None else pivot)
    return replace(shot, notices=_notices(scene.camera, found, centre))


def ground_centre(folder: Scene, rest: Sequence[NDArray[np.floating]]) -> NDArray[np.float64]:
    """Return the centre (3,) of all objects' boxes, on the ground: the default pivot of the camera."""
    ground = folder.model.ground_plane
    middle = np.mean([(np.min(v, axis=0) + np.max(v, axis=0)) / 2.0 for v in rest], axis=0)
    return np.asarray(middle - ground.heights(middle) * ground.unit_normal)


def make_relief(shot: CameraMotion, folder: Scene, plate: CleanPlate, size: tuple[int, int]) -> Backdrop:
    """Return the background geometry for the camera motion ``shot``, for frames of ``size``. Raises InputError for
    invalid depth.
    """
    assert shot.stage is not None
    photo, borders = at_size(shot.still, size), shot.borders(size)
    if folder.model.depth is None:
        return Backdrop(camera=photo, proxy=shot.stage, borders=borders)
    cut = backdrop.split_depth(_depth(folder, size), plate.masks, shot.stage, photo, borders)
    relief = Backdrop(camera=photo, proxy=shot.stage, borders=borders, ratio=cut.ratio)
    if not cut.layers:
        return relief
    # An object's outline is mixed with what it hides, so a slightly larger region is inpainted.
    hidden = cv2.dilate(cut.hidden.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    behind = inpaint_hole(plate.extended(borders).background, hidden)
    return replace(relief, layers=cut.layers, hidden=hidden, behind=behind)


def _depth(folder: Scene, size: tuple[int, int]) -> NDArray[np.float32]:
    """Return the scene's depth map (H, W) at ``size``, metres along the camera's axis, without mixing near and far."""
    path = folder.file(str(folder.model.depth))
    channels = read_layers(path)
    image = next(iter(channels.values()))
    camera = folder.model.camera
    if image.shape != (camera.height, camera.width):
        raise InputError(
            f"{path}: is {image.shape[1]}×{image.shape[0]}, the camera's image is {camera.width}×{camera.height}; "
            "give a depth map of the photo's size"
        )
    return srgb.nearest(image, *size)


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
