# SPDX-License-Identifier: MIT
"""The scene model: camera, ground, objects, light, effects and contacts, as immutable dataclasses.

Metres, kilograms, seconds; the world is right-handed with +Z up. A reconstructed scene has its origin on the ground, X
to the camera's right and Y away from it.
"""

from __future__ import annotations

import math
import unicodedata
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..validation import GROUND, finite, quantity, require, require_quantities
from .material import LAWS, Material
from .scene_object import (
    CONTACT_MODES,
    IDENTITY4,
    ROLES,
    Box,
    Contact,
    FactorMap,
    Key,
    Keys,
    MaterialTrack,
    Matrix4,
    Motion,
    NumberKey,
    SceneObject,
    Vector,
    require_rising,
)

__all__ = [
    "CONTACT_MODES",
    "FORMAT",
    "GROUND",
    "IDENTITY4",
    "LAWS",
    "ROLES",
    "Box",
    "Camera",
    "Contact",
    "Effect",
    "FactorMap",
    "Ground",
    "Key",
    "Keys",
    "Light",
    "Material",
    "MaterialTrack",
    "Matrix4",
    "Motion",
    "NumberKey",
    "SceneModel",
    "SceneObject",
    "Vector",
]

FORMAT = "physgen-scene/1"


@dataclass(frozen=True, kw_only=True)
class Camera:
    """Pinhole camera without distortion, OpenCV axes (x right, y down, z forward).

    width, height: pixels of the photo.
    fx, fy, cx, cy: pixels; the centre of the top left pixel is (0.5, 0.5).
    world_from_camera: 4x4 rigid transform, metres.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    world_from_camera: Matrix4

    def __post_init__(self) -> None:
        require(self.width > 0 and self.height > 0, "camera size", (self.width, self.height), "give positive pixels")
        require(
            finite(self.fx, self.fy, self.cx, self.cy) and self.fx > 0 and self.fy > 0,
            "camera fx, fy, cx, cy",
            (self.fx, self.fy, self.cx, self.cy),
            "give finite pixels, focal lengths above zero",
        )
        matrix = np.asarray(self.world_from_camera, dtype=float)
        require(
            matrix.shape == (4, 4) and bool(np.isfinite(matrix).all()),
            "camera world_from_camera",
            matrix.shape,
            "give a finite 4x4 matrix",
        )
        rotation = matrix[:3, :3]
        require(
            bool(np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-4)) and bool(np.linalg.det(rotation) > 0),
            "camera world_from_camera",
            "not a rotation",
            "its upper left 3x3 part must be a right-handed rotation without scale",
        )

    def rays(self, pixels: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return world directions (..., 3) through ``pixels`` (..., 2), with unit depth along the optical axis."""
        pixels = np.asarray(pixels, dtype=np.float64)
        local = np.stack(
            [(pixels[..., 0] - self.cx) / self.fx, (pixels[..., 1] - self.cy) / self.fy, np.ones(pixels.shape[:-1])],
            axis=-1,
        )
        return local @ np.asarray(self.world_from_camera)[:3, :3].T

    @property
    def position(self) -> NDArray[np.float64]:
        """Centre of projection (3,) in world metres."""
        return np.asarray(self.world_from_camera, dtype=np.float64)[:3, 3]

    def project(self, points: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return pixels and depth (..., 3) of world ``points`` (..., 3): x, y in pixels, z metres along the axis."""
        matrix = np.asarray(self.world_from_camera, dtype=np.float64)
        local = (np.asarray(points, dtype=np.float64) - matrix[:3, 3]) @ matrix[:3, :3]
        depth = local[..., 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            x = self.fx * local[..., 0] / depth + self.cx
            y = self.fy * local[..., 1] / depth + self.cy
        return np.stack([x, y, depth], axis=-1)


@dataclass(frozen=True, kw_only=True)
class Ground:
    """The ground plane; ``normal`` is a unit vector towards the objects' side.

    friction: Coulomb's kinetic coefficient, 0 (ice) and up; 0.4 is wood on wood.
    static_friction: Coulomb's static coefficient, not below ``friction``; None takes ``friction``.
    restitution: Newton's coefficient for rigid bodies, 0 (no bounce) to 1; for deformables, the share of the outermost
        layer's energy that is returned.
    reflectivity: reflectance at normal incidence, 0 (matte) to 1 (a mirror); 0.04 is varnish, glass or water. It rises
        towards grazing angles.
    reflection_roughness: blur of reflections, 0 (polished) to 1, as the roughness of Blender's shaders.
    """

    point: Vector = (0.0, 0.0, 0.0)
    normal: Vector = (0.0, 0.0, 1.0)
    friction: float = quantity(0.4, 0.0, 10.0)
    static_friction: float | None = quantity(None, 0.0, 10.0)
    restitution: float = quantity(0.0, 0.0, 1.0)
    reflectivity: float = quantity(0.0, 0.0, 1.0)
    reflection_roughness: float = quantity(0.15, 0.0, 1.0)

    def __post_init__(self) -> None:
        require(finite(*self.point), "ground.point", self.point, "give three finite numbers in metres")
        require(
            finite(*self.normal) and abs(math.hypot(*self.normal) - 1.0) < 1e-3,
            "ground.normal",
            self.normal,
            "give a unit vector",
        )
        require_quantities(self, "ground.")
        static = self.static_friction
        require(
            static is None or self.friction <= static,
            "ground.static_friction",
            static,
            "give friction or more, up to 10, or null",
        )

    @property
    def unit_normal(self) -> NDArray[np.float64]:
        """``normal`` (3,), renormalised in float64."""
        normal = np.asarray(self.normal, dtype=np.float64)
        return np.asarray(normal / np.linalg.norm(normal))

    def heights(self, points: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return signed heights (...) of ``points`` (..., 3) above the plane, metres."""
        return np.asarray((np.asarray(points, dtype=np.float64) - np.asarray(self.point)) @ self.unit_normal)


@dataclass(frozen=True, kw_only=True)
class Effect:
    """A registered physical effect with its parameters (docs/simulation.md).

    objects: names of the objects that it acts on; empty for all that it applies to.
    """

    name: str
    parameters: tuple[tuple[str, float], ...] = ()
    objects: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Light:
    """Environment and sun that light the objects.

    environment: equirectangular EXR in linear light, relative to the scene folder, or None for uniform white.
    sun_direction: unit vector from the scene to the sun, or None for no sun.
    sun_strength: irradiance of the sun over that of the environment on open ground, 0 to 20.
    sun_angle: apparent diameter in radians; larger gives softer shadows.
    """

    environment: str | None = None
    sun_direction: Vector | None = None
    sun_strength: float = 1.0
    sun_angle: float = 0.15

    def __post_init__(self) -> None:
        if self.sun_direction is not None:
            require(
                finite(*self.sun_direction) and abs(math.hypot(*self.sun_direction) - 1.0) < 1e-3,
                "light.sun_direction",
                self.sun_direction,
                "give a unit vector or null",
            )
        require(
            finite(self.sun_strength) and 0 <= self.sun_strength <= 20,
            "light.sun_strength",
            self.sun_strength,
            "give 0 to 20",
        )
        require(
            finite(self.sun_angle) and 0 <= self.sun_angle <= math.pi,
            "light.sun_angle",
            self.sun_angle,
            "give 0 to pi radians",
        )


MOST_OBJECTS, MOST_EFFECTS = 2000, 1000
"""Of a scene; contacts are kept for every pair of objects."""


@dataclass(frozen=True, kw_only=True)
class SceneModel:
    """A complete scene. File names are relative to the scene folder.

    ground: None for no floor; ``contacts`` cannot name it then.
    photo, background: both None for a scene without a photo, which can be baked but not rendered into anything.
    gravity: m/s²; gravity_track: keyframes that replace it; empty: constant.
    contacts: pairs whose contact parameters do not follow from the two surfaces.
    """

    camera: Camera
    objects: tuple[SceneObject, ...]
    ground: Ground | None = field(default_factory=Ground)
    gravity: Vector = (0.0, 0.0, -9.81)
    effects: tuple[Effect, ...] = ()
    light: Light = field(default_factory=Light)
    photo: str | None = "photo.png"
    background: str | None = "background.png"
    depth: str | None = None
    gravity_track: Keys = ()
    contacts: tuple[Contact, ...] = ()

    def __post_init__(self) -> None:
        count = len(self.objects)
        require(count > 0, "objects", (), "a scene needs at least one object")
        require(count <= MOST_OBJECTS, "number of objects", count, f"a scene has at most {MOST_OBJECTS}")
        count = len(self.effects)
        require(count <= MOST_EFFECTS, "number of effects", count, f"a scene has at most {MOST_EFFECTS}")
        require(
            (self.photo is None) == (self.background is None),
            "photo, background",
            (self.photo, self.background),
            "give both files, or null for both: a scene without a photo",
        )
        require(
            finite(*self.gravity) and math.hypot(*self.gravity) <= 1e4,
            "gravity",
            self.gravity,
            "give three numbers in m/s², together up to 10000",
        )
        # Some file systems take letters composed in other ways for the same.
        names = [unicodedata.normalize("NFC", o.name).casefold() for o in self.objects]
        require(
            len(set(names)) == len(names),
            "objects",
            [o.name for o in self.objects],
            "give every object a name of its own",
        )
        present = {o.name for o in self.objects}
        for index, effect in enumerate(self.effects):
            for name in effect.objects:
                if name not in present:
                    remedy = f"name some of {', '.join(sorted(present))}, or none for all"
                    require(False, f"effects[{index}].objects", name, remedy)
        require_rising("gravity_track", self.gravity_track)
        for i, key in enumerate(self.gravity_track):
            strength = math.hypot(*key.value)
            require(strength <= 1e4, f"gravity_track[{i}].value", key.value, "give m/s², together up to 10000")
        self._check_contacts()

    def _check_contacts(self) -> None:
        # In order, for the message.
        known = dict.fromkeys([o.name for o in self.objects] + ([GROUND] if self.ground is not None else []))
        pairs = set()
        for i, contact in enumerate(self.contacts):
            for name in contact.between:
                if name not in known:
                    missing = "no ground" if name == GROUND else f"no object {name!r}"
                    remedy = f"there is {missing}; choose two of {', '.join(known)}"
                    require(False, f"contacts[{i}].between", list(contact.between), remedy)
            pair = frozenset(contact.between)
            require(pair not in pairs, f"contacts[{i}].between", list(contact.between), "name every pair once")
            pairs.add(pair)

    @property
    def ground_plane(self) -> Ground:
        """The ground. Raises InputError for a scene without one."""
        if self.ground is None:
            raise InputError("the scene has no ground: give one")
        return self.ground

    @property
    def photo_files(self) -> tuple[str, str]:
        """Photo and background in the scene folder. Raises InputError for a scene without a photo."""
        if self.photo is None or self.background is None:
            raise InputError("the scene has no photo: give photo and background")
        return self.photo, self.background
