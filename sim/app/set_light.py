# SPDX-License-Identifier: MIT
"""Changes of a scene's light: an environment from a file, a sun as given, or both estimated from the photo."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..atomic import replacing
from ..errors import InputError
from ..events import OnEvent, ignore
from ..folder_lock import lock_beside
from ..reconstruct.background.unboxed_things import unboxed_things
from ..reconstruct.lighting.light_estimate import LitScene, describe_sun, estimate_light, light_with_sun
from ..reconstruct.shape.inflate import inflate
from ..reconstruct.shape.inflated_mesh import shadow_mesh
from ..scene.environment import prepared, write_environment
from ..scene.equirectangular import FRAMES, Radiance
from ..scene.folder import Scene, load_scene, require_photo, save_scene
from ..scene.meshes import load_object_mesh
from ..scene.model import Ground, Light, Vector
from ..scene.scene_output import STAMP_FILE
from ..srgb import read_mask, read_rgb

LIGHT_FOLDER = "light"


@dataclass(frozen=True, kw_only=True)
class LightRequest:
    """Changes to the light of a scene; fields that are not given leave it as it is.

    environment: .hdr or .exr file; frame: the direction of its middle column (``sim.scene.equirectangular.FRAMES``).
    sun: False removes the sun. sun_direction: towards the sun (right, away, up), of any length; sun_strength: its
    irradiance over the environment's on open ground, 0 to 20; sun_angle_deg: its apparent diameter, 0 to 180.
    estimate: estimate the sun from the photo's shadows and, without ``environment``, the environment from the photo. A
    new environment alone implies this, because the sun's strength is relative to it.
    """

    environment: Path | None = None
    frame: str = "ahead"
    sun: bool = True
    sun_direction: Vector | None = None
    sun_strength: float | None = None
    sun_angle_deg: float | None = None
    estimate: bool = False

    def __post_init__(self) -> None:
        given = [n for n in ("sun_direction", "sun_strength", "sun_angle_deg") if getattr(self, n) is not None]
        if given and not self.sun:
            raise InputError(f"{given[0]} and no sun: give one of them, not both")
        if given and self.estimate:
            raise InputError(f"{given[0]} and estimate: the sun is either given or estimated; leave one of them out")
        if self.frame not in FRAMES:
            raise InputError(f"frame is {self.frame!r}: choose {', '.join(FRAMES)}")
        if self.sun_direction is not None:
            length = math.hypot(*self.sun_direction)
            if not (math.isfinite(length) and length > 1e-6):
                raise InputError(f"sun_direction is {self.sun_direction!r}: give three numbers x,y,z towards the sun")
        for name, high in (("sun_strength", 20.0), ("sun_angle_deg", 180.0)):
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and 0 <= value <= high):
                raise InputError(f"{name} is {value!r}: give 0 to {high:g}")


def set_light(scene: Scene, *, request: LightRequest, on_event: OnEvent = ignore) -> Scene:
    """Return ``scene``, as it is on disk, relit as ``request`` says; its folder is changed completely or, on an error,
    not at all.

    Raises InputError for a scene, file or sun that cannot be used, and for a scene that another process is changing.
    """
    with lock_beside(scene.root):
        # Not as it was before: a correction may have ended since.
        return _relit(load_scene(scene.root), request, on_event)


def _relit(scene: Scene, request: LightRequest, on_event: OnEvent) -> Scene:
    folder = scene
    ground = folder.model.ground or Ground()

    def notice(message: str) -> None:
        on_event({"event": "notice", "stage": "light", "message": message})

    sun_given = (request.sun_direction, request.sun_strength, request.sun_angle_deg) != (None, None, None)
    given = None
    if request.environment is not None:
        given = prepared(request.environment, request.frame, folder.model.camera, ground)
    radiance, light = given, folder.model.light
    if not sun_given and (request.estimate or given is not None):
        radiance, light = _estimated(folder, given, request, notice)
    elif not request.sun:
        light = dataclasses.replace(light, sun_direction=None)
    if sun_given:
        light = _with_sun(light, request, ground)
    light = _keep(folder, radiance, light)
    if light == folder.model.light:
        notice(f"unchanged: {describe_sun(light)}")
        return folder
    old, changed = folder.model.light.environment, dataclasses.replace(folder.model, light=light)
    saved = save_scene(scene.root, changed)
    if old is not None and old != light.environment and old.startswith(f"{LIGHT_FOLDER}/"):
        # Windows keeps a file in use; nothing refers to it any more.
        with contextlib.suppress(OSError):
            folder.file(old).unlink(missing_ok=True)
    notice(describe_sun(light))
    return saved


def _estimated(
    folder: Scene, given: Radiance | None, request: LightRequest, notice: Callable[[str], None]
) -> tuple[Radiance, Light]:
    if given is not None and not request.sun:
        return given, Light()
    scene = folder.model
    photo, background, ground = require_photo(folder)
    masks = []
    for item in scene.objects:
        if item.mask is None:
            raise InputError(
                f"object {item.name!r} has no mask, so the sun cannot be estimated from its shadow; give it with "
                "--sun-direction, or none with --no-sun"
            )
        masks.append(read_mask(folder.file(item.mask)))
    # A body made from an outline was moved to stand safely; its shadow fits better where the outline has it.
    bare = (folder.root / STAMP_FILE).is_file() and np.allclose(ground.normal, (0, 0, 1)) and ground.point[2] == 0
    meshes = []
    for item, mask in zip(scene.objects, masks, strict=True):
        body = shadow_mesh(scene.camera, inflate(mask, None)) if bare else load_object_mesh(folder, item)
        meshes.append((body.vertices, body.faces))
    pixels, behind = read_rgb(folder.file(photo)), read_rgb(folder.file(background))
    size = (scene.camera.height, scene.camera.width)
    for name, picture in (("photo", pixels), ("background", behind), *zip(("mask",) * len(masks), masks, strict=True)):
        if picture.shape[:2] != size:
            raise InputError(
                f"{folder.root}: its {name} is {picture.shape[1]}x{picture.shape[0]} pixels, its camera's picture "
                f"{size[1]}x{size[0]}; reconstruct the scene again"
            )
    things = unboxed_things(pixels, masks, scene.camera).whole if bare else None
    lit = LitScene(
        camera=scene.camera, ground=ground, pixels=pixels, background=behind, masks=masks, meshes=meshes, things=things
    )
    return estimate_light(lit, given, notice, with_sun=request.sun)


def _with_sun(light: Light, request: LightRequest, ground: Ground) -> Light:
    direction = request.sun_direction or light.sun_direction
    if direction is None:
        raise InputError("the scene has no sun: give its direction too, x,y,z towards it (right, away, up)")
    height = float(np.asarray(direction) @ ground.unit_normal) / math.hypot(*direction)
    if height <= 0.01:
        raise InputError(f"sun_direction is {direction!r}: the sun is below the ground; the third number is up")
    strength = light.sun_strength if request.sun_strength is None else request.sun_strength
    angle = light.sun_angle if request.sun_angle_deg is None else math.radians(request.sun_angle_deg)
    return light_with_sun(light, direction, strength, angle)


def _keep(folder: Scene, radiance: Radiance | None, light: Light) -> Light:
    """Write ``radiance`` under a name of its own, so that the old light stays whole until the scene names the new."""
    if radiance is None:
        return light
    name = f"{LIGHT_FOLDER}/environment-{hashlib.sha256(radiance.tobytes()).hexdigest()[:8]}.exr"
    path = folder.file(name)
    with replacing(path) as partial:
        write_environment(partial, radiance)
    return dataclasses.replace(light, environment=name)
