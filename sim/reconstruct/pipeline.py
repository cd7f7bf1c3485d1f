# SPDX-License-Identifier: MIT
"""Photo and boxes → scene folder: the stages in order, one temporary folder, one rename at the end."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from ..composite.inpaint import FillOptions, inpaint
from ..errors import Cancelled, InputError
from ..events import IsCancelled, OnEvent, ignore, never
from ..scene.environment import prepared as prepared_environment
from ..scene.environment import write_environment
from ..scene.folder import SceneFolder, save_scene
from ..scene.materials import load_preset
from ..scene.model import Camera, Ground, Light, Scene, SceneObject
from . import camera as cameras
from .body import contact_pixel
from .horizon import estimate_pitch
from .inflate import Silhouette, inflate
from .light import ENVIRONMENT_FILE, LitScene, estimate_light
from .mask_cleanup import largest_component
from .mesh import BodyMesh, bare_mesh, build_mesh
from .options import ObjectRequest, ReconstructOptions
from .output import replacing_folder
from .photo import Photo, load_photo
from .segment import check_distinct, pixel_box, segment
from .shadow import find_shadow, ground_brightness, object_holes
from .texture import crop_texture, glb_bytes, world_from_gltf

Mask = NDArray[np.bool_]


class _Steps:
    """Reports progress, passes notices on, and stops between steps when asked to."""

    def __init__(self, total: int, on_event: OnEvent, cancelled: IsCancelled) -> None:
        self._total, self._done, self._on_event, self._cancelled = total, 0, on_event, cancelled

    def begin(self, name: str) -> None:
        if self._cancelled():
            raise Cancelled(f"reconstruction cancelled before step {name!r}; nothing was written")
        event = {"event": "progress", "stage": "reconstruct", "step": name, "message": name}
        self._on_event({**event, "done": self._done, "total": self._total})
        self._done += 1

    def finish(self) -> None:
        if self._cancelled():
            raise Cancelled("reconstruction cancelled at its end; nothing was written")
        event = {"event": "progress", "stage": "reconstruct", "step": "done", "message": "done"}
        self._on_event({**event, "done": self._total, "total": self._total})

    def notice(self, message: str) -> None:
        self._on_event({"event": "notice", "stage": "reconstruct", "message": message})


@dataclass(frozen=True)
class _Layers:
    """What the photo falls apart into, all (H, W) or (H, W, 3) at working size."""

    masks: tuple[Mask, ...]
    shadows: tuple[Mask, ...]
    holes: tuple[Mask, ...]
    background: NDArray[np.uint8]


def reconstruct(
    photo: Path,
    objects: Sequence[ObjectRequest],
    out: Path,
    options: ReconstructOptions | None = None,
    on_event: OnEvent = ignore,
    cancelled: IsCancelled = never,
) -> SceneFolder:
    """Reconstruct the ``objects`` of ``photo`` into the scene folder ``out``, which is replaced when it is a scene.

    The folder appears whole or not at all. ``on_event`` gets progress and notices (docs/reconstruction.md),
    ``cancelled`` is asked between steps. Raises InputError for a photo, box or option that cannot be used, and
    Cancelled.
    """
    options = options or ReconstructOptions()
    if not objects:
        raise InputError("objects: none given; draw a box around at least one object")
    names = object_names(objects)
    materials = [load_preset(item.preset) for item in objects]
    steps = _Steps(5 + 3 * len(objects), on_event, cancelled)
    with replacing_folder(out) as folder:
        steps.begin("photo")
        picture = load_photo(photo, options.max_size)
        if picture.scale < 1.0:
            steps.notice(
                f"photo of {picture.original_size[0]}x{picture.original_size[1]} pixels is worked on at "
                f"{picture.width}x{picture.height}; max_size changes that"
            )
        masks = _segment_all(picture, objects, names, options, steps)
        silhouettes = [inflate(mask, item.thickness) for mask, item in zip(masks, objects, strict=True)]
        steps.begin("camera")
        view = _camera(picture, masks, silhouettes, names, options, steps)
        layers = _take_apart(picture, masks, names, view, options, steps)
        bodies = []
        for name, silhouette in zip(names, silhouettes, strict=True):
            steps.begin(f"mesh {name}")
            bodies.append(_body(name, view, silhouette, options, steps))
        (folder / "light").mkdir()
        steps.begin("light")
        light = _light(folder, picture, layers, view, silhouettes, options, steps)
        steps.begin("write")
        scene = _write(folder, picture, layers, view, bodies, names, objects, materials, options, light, steps)
        save_scene(folder, scene)
        steps.finish()
    return SceneFolder(root=out, scene=scene)


def object_names(objects: Sequence[ObjectRequest]) -> list[str]:
    """The names that ``objects`` get. Raises InputError for a name that cannot be used or occurs twice."""
    names = [item.name or f"object_{number}" for number, item in enumerate(objects, start=1)]
    for name in names:
        # The scene model holds the rule for names; ask it before any work is done, not after.
        SceneObject(name=name, mesh="-", size_m=1.0)
    folded = [name.casefold() for name in names]
    if len(set(folded)) < len(folded):
        raise InputError(f"objects are named {names!r}: give every object a name of its own")
    return names


def _segment_all(
    picture: Photo,
    objects: Sequence[ObjectRequest],
    names: Sequence[str],
    options: ReconstructOptions,
    steps: _Steps,
) -> list[Mask]:
    boxes = [
        pixel_box(item.box, picture.scale, picture.width, picture.height, name)
        for item, name in zip(objects, names, strict=True)
    ]
    masks = []
    for name, box in zip(names, boxes, strict=True):
        steps.begin(f"segment {name}")
        masks.append(segment(picture.pixels, box, name, options.grabcut_iterations, steps.notice))
    check_distinct(masks, names)
    # Where two masks still overlap a little, the object that stands nearer (lower in the photo) has it.
    order = sorted(range(len(masks)), key=lambda i: -int(np.flatnonzero(masks[i].any(axis=1))[-1]))
    taken = np.zeros(masks[0].shape, dtype=bool)
    for index in order:
        masks[index] = largest_component(masks[index] & ~taken)
        taken |= masks[index]
    return masks


def _camera(
    picture: Photo,
    masks: Sequence[Mask],
    silhouettes: Sequence[Silhouette],
    names: Sequence[str],
    options: ReconstructOptions,
    steps: _Steps,
) -> Camera:
    focal, source = cameras.focal_px(picture.width, picture.height, picture.exif_focal_px, options.fov_deg)
    contacts = [float(contact_pixel(silhouette)[1]) for silhouette in silhouettes]
    if options.pitch_deg is not None:
        pitch = math.radians(options.pitch_deg)
    elif options.horizon_y is not None:
        pitch = cameras.pitch_of_horizon(picture.height, focal, options.horizon_y * picture.height)
    else:
        estimate = estimate_pitch(picture.pixels, np.logical_or.reduce(masks), focal)
        lowest_allowed = math.radians(cameras.MIN_DECLINATION_DEG * 2) - math.atan2(
            min(contacts) - picture.height / 2.0, focal
        )
        pitch = max(math.radians(cameras.DEFAULT_PITCH_DEG) if estimate is None else estimate, lowest_allowed)
        how = "taken as" if estimate is None else "estimated from straight lines:"
        row = cameras.horizon_row(picture.height, focal, pitch) / picture.height
        steps.notice(
            f"camera pitch {how} {math.degrees(pitch):.0f}° (horizon at {row:.2f} of the height, focal length "
            f"{focal:.0f} px by {source}); set horizon_y or pitch_deg where this is wrong"
        )
    for name, contact in zip(names, contacts, strict=True):
        cameras.check_horizon(picture.height, focal, pitch, contact, name)
    return cameras.camera_above_ground(picture.width, picture.height, focal, pitch)


def _take_apart(
    picture: Photo,
    masks: Sequence[Mask],
    names: Sequence[str],
    view: Camera,
    options: ReconstructOptions,
    steps: _Steps,
) -> _Layers:
    pitch = math.asin(max(-1.0, min(1.0, -view.world_from_camera[2][2])))
    horizon = cameras.horizon_row(picture.height, view.fy, pitch)
    union = np.logical_or.reduce(masks)
    grey = ground_brightness(picture.pixels)
    shadows = []
    for name, mask in zip(names, masks, strict=True):
        steps.begin(f"shadow {name}")
        shadows.append(
            find_shadow(grey, mask, union & ~mask, horizon_row=horizon, fixed_threshold=options.shadow_threshold)
        )
    dilation = options.hole_dilation * max(picture.width, picture.height) / 1024.0
    holes = object_holes(masks, shadows, dilation)
    steps.begin("background")
    background = inpaint(
        picture.pixels,
        np.logical_or.reduce(holes),
        union,
        FillOptions(
            radius=options.patch_radius,
            limit=options.inpaint_pixels,
            seed=options.seed,
            # Seen from high above, the ground is all there is, and looks the same at all heights.
            by_row=horizon > -0.5 * picture.height,
        ),
    )
    return _Layers(masks=tuple(masks), shadows=tuple(shadows), holes=tuple(holes), background=background)


def _body(name: str, view: Camera, silhouette: Silhouette, options: ReconstructOptions, steps: _Steps) -> BodyMesh:
    body, margin = build_mesh(view, silhouette, options.mesh_vertices)
    if margin < 0.05:
        steps.notice(f"{name}: may topple, its base does not carry its centre of mass; a larger thickness helps")
    return body


def _metres_per_unit(
    bodies: Sequence[BodyMesh], objects: Sequence[ObjectRequest], options: ReconstructOptions, steps: _Steps
) -> float:
    extents = [float(np.ptp(body.vertices, axis=0).max()) for body in bodies]
    for extent, item in zip(extents, objects, strict=True):
        if item.size_m is not None:
            return item.size_m / extent
    steps.notice(
        f"no object has a size: the first one is taken to be {options.default_size_m:g} m large; set its size_m"
    )
    return options.default_size_m / extents[0]


def _write(
    folder: Path,
    picture: Photo,
    layers: _Layers,
    view: Camera,
    bodies: Sequence[BodyMesh],
    names: Sequence[str],
    objects: Sequence[ObjectRequest],
    materials: Sequence[Any],
    options: ReconstructOptions,
    light: Light,
    steps: _Steps,
) -> Scene:
    metres = _metres_per_unit(bodies, objects, options, steps)
    bases = [_base_centre(body) for body in bodies]
    origin = bases[0]
    for sub in ("masks", "shadows", "holes", "meshes"):
        (folder / sub).mkdir()
    _save_png(folder / "photo.png", picture.pixels)
    _save_png(folder / "background.png", layers.background)
    depth = [float(view.project(base)[2]) for base in bases]
    items = []
    for i, name in enumerate(names):
        for sub, layer in (("masks", layers.masks[i]), ("shadows", layers.shadows[i]), ("holes", layers.holes[i])):
            _save_png(folder / sub / f"{name}.png", layer.astype(np.uint8) * 255)
        texture = crop_texture(picture.pixels, layers.masks[i])
        (folder / "meshes" / f"{name}.glb").write_bytes(glb_bytes(bodies[i], texture, bases[i], metres))
        items.append(
            SceneObject(
                name=name,
                mesh=f"meshes/{name}.glb",
                world_from_mesh=world_from_gltf((bases[i] - origin) * metres),
                size_m=float(np.ptp(bodies[i].vertices, axis=0).max()) * metres,
                material=materials[i],
                velocity=objects[i].velocity,
                spin=objects[i].spin,
                occlusion_order=sum(other < depth[i] for other in depth),
                mask=f"masks/{name}.png",
                shadow=f"shadows/{name}.png",
            )
        )
    return Scene(
        camera=cameras.scaled_to_metres(view, origin, metres),
        objects=tuple(items),
        ground=Ground(friction=options.friction),
        light=light,
    )


def _base_centre(body: BodyMesh) -> NDArray[np.float64]:
    """Middle (3,) of the part that rests on the ground, in world units."""
    low = body.vertices[body.vertices[:, 2] <= 1e-6 * np.ptp(body.vertices[:, 2]) + 1e-12]
    return np.array([*((low[:, :2].min(axis=0) + low[:, :2].max(axis=0)) / 2.0), 0.0])


def _light(
    folder: Path,
    picture: Photo,
    layers: _Layers,
    view: Camera,
    silhouettes: Sequence[Silhouette],
    options: ReconstructOptions,
    steps: _Steps,
) -> Light:
    bare = [bare_mesh(view, silhouette) for silhouette in silhouettes]
    scene = LitScene(
        camera=view,
        ground=Ground(),
        pixels=picture.pixels,
        background=layers.background,
        masks=layers.masks,
        meshes=[(body.vertices, body.faces) for body in bare],
    )
    given = None
    if options.environment is not None:
        given = prepared_environment(options.environment, options.environment_frame, view, scene.ground)
    radiance, light = estimate_light(scene, given, steps.notice, with_sun=options.sun)
    write_environment(folder / ENVIRONMENT_FILE, radiance)
    return light


def _save_png(path: Path, pixels: NDArray[np.uint8]) -> None:
    Image.fromarray(pixels).save(path, format="PNG", compress_level=4)
