# SPDX-License-Identifier: MIT
"""The scene: what stands in the photo, where, of what matter, under which light.

Metres, kilograms, seconds; the world is right-handed with +Z up. A reconstructed scene has its origin on the
ground, X to the right of the camera and Y away from it. All data here are immutable.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError

Vector = tuple[float, float, float]
Matrix4 = tuple[tuple[float, float, float, float], ...]

FORMAT = "physgen-scene/1"
ROLES = ("dynamic", "collider")
LAWS = ("fixed_corotated", "neo_hookean", "von_mises", "snow", "sand", "fluid")
IDENTITY4: Matrix4 = tuple(tuple(1.0 if i == j else 0.0 for j in range(4)) for i in range(4))  # type: ignore[misc]


def _require(condition: bool, field_name: str, value: object, remedy: str) -> None:
    if not condition:
        raise InputError(f"{field_name} is {value!r}: {remedy}")


def _finite(*numbers: float) -> bool:
    return all(math.isfinite(n) for n in numbers)


@dataclass(frozen=True, kw_only=True)
class Camera:
    """Pinhole camera without distortion, OpenCV axes (x right, y down, z forward).

    width, height: pixels of ``photo.png``.
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
        _require(self.width > 0 and self.height > 0, "camera size", (self.width, self.height), "give positive pixels")
        _require(
            _finite(self.fx, self.fy, self.cx, self.cy) and self.fx > 0 and self.fy > 0,
            "camera fx, fy, cx, cy",
            (self.fx, self.fy, self.cx, self.cy),
            "give finite pixels, focal lengths above zero",
        )
        matrix = np.asarray(self.world_from_camera, dtype=float)
        _require(
            matrix.shape == (4, 4) and bool(np.isfinite(matrix).all()),
            "camera world_from_camera",
            matrix.shape,
            "give a finite 4x4 matrix",
        )
        rotation = matrix[:3, :3]
        _require(
            bool(np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-4)) and bool(np.linalg.det(rotation) > 0),
            "camera world_from_camera",
            "not a rotation",
            "its upper left 3x3 part must be a right-handed rotation without scale",
        )

    def rays(self, pixels: NDArray[np.floating]) -> NDArray[np.float64]:
        """World directions (..., 3) through ``pixels`` (..., 2), with unit depth along the optical axis."""
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
        """World ``points`` (..., 3) to pixels and depth (..., 3): x, y in pixels, z metres along the optical axis."""
        matrix = np.asarray(self.world_from_camera, dtype=np.float64)
        local = (np.asarray(points, dtype=np.float64) - matrix[:3, 3]) @ matrix[:3, :3]
        depth = local[..., 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            x = self.fx * local[..., 0] / depth + self.cx
            y = self.fy * local[..., 1] / depth + self.cy
        return np.stack([x, y, depth], axis=-1)


@dataclass(frozen=True, kw_only=True)
class Ground:
    """The supporting plane. ``normal`` is a unit vector that points to the side on which objects stand.

    friction: Coulomb's kinetic coefficient, 0 (ice) and up; 0.4 is wood on wood.
    static_friction: Coulomb's static coefficient, not below ``friction``; None takes ``friction``.
    restitution: Newton's coefficient for rigid bodies, 0 (no bounce) to 1.
    """

    point: Vector = (0.0, 0.0, 0.0)
    normal: Vector = (0.0, 0.0, 1.0)
    friction: float = 0.4
    static_friction: float | None = None
    restitution: float = 0.0

    def __post_init__(self) -> None:
        _require(_finite(*self.point), "ground.point", self.point, "give three finite numbers in metres")
        _require(
            _finite(*self.normal) and abs(math.hypot(*self.normal) - 1.0) < 1e-3,
            "ground.normal",
            self.normal,
            "give a unit vector",
        )
        _require(_finite(self.friction) and 0 <= self.friction <= 10, "ground.friction", self.friction, "give 0 to 10")
        static = self.static_friction
        _require(
            static is None or (_finite(static) and self.friction <= static <= 10),
            "ground.static_friction",
            static,
            "give friction or more, up to 10, or null",
        )
        _require(
            _finite(self.restitution) and 0 <= self.restitution <= 1,
            "ground.restitution",
            self.restitution,
            "give 0 to 1",
        )


@dataclass(frozen=True, kw_only=True)
class Material:
    """What an object is made of.

    preset: name of the preset in ``presets/materials`` that the numbers come from, or "custom".
    density: kg/m³, above 0 and up to 30000.
    youngs_modulus: Pa, 1e2 to 1e12.
    poisson_ratio: 0 to 0.49.
    law: how it responds, one of ``LAWS``: elastic; elastic for large strain; plastic (clay, metal); snow; sand; fluid.
    damping_time: s, 0 to 10; Kelvin–Voigt retardation time viscosity / modulus of solids. A vibration of angular
        frequency w decays at the rate damping_time w² / 2.
    yield_stress: Pa, 1 to 1e12; of ``von_mises``, in tension.
    friction_angle: radians, 0.01 to 1.4; of ``sand``, internal.
    critical_compression, critical_stretch: strains, 1e-4 to 0.5; what ``snow`` bears elastically.
    hardening: 0 to 30; of ``snow``, its moduli grow by exp(hardening (1 - J)) when packed to the volume ratio J.
    bulk_modulus: Pa, 10 to 1e12; of ``fluid``, which has no Young's modulus and Poisson's ratio.
    viscosity: Pa s, 0 to 1e5; of ``fluid``, dynamic.

    Numbers of another law than the material's own are kept and do nothing.
    """

    preset: str = "custom"
    density: float = 1000.0
    youngs_modulus: float = 5e5
    poisson_ratio: float = 0.3
    law: str = "fixed_corotated"
    damping_time: float = 0.0
    yield_stress: float = 1e4
    friction_angle: float = 0.6
    critical_compression: float = 0.025
    critical_stretch: float = 0.0075
    hardening: float = 10.0
    bulk_modulus: float = 2e5
    viscosity: float = 0.0

    def __post_init__(self) -> None:
        _require(self.law in LAWS, "material.law", self.law, f"choose one of {', '.join(LAWS)}")
        for name, low, high, unit in (
            ("damping_time", 0.0, 10.0, "seconds"),
            ("yield_stress", 1.0, 1e12, "pascals"),
            ("friction_angle", 0.01, 1.4, "radians"),
            ("critical_compression", 1e-4, 0.5, "a strain"),
            ("critical_stretch", 1e-4, 0.5, "a strain"),
            ("hardening", 0.0, 30.0, "a number"),
            ("bulk_modulus", 10.0, 1e12, "pascals"),
            ("viscosity", 0.0, 1e5, "Pa s"),
        ):
            value = getattr(self, name)
            _require(
                _finite(value) and low <= value <= high,
                f"material.{name}",
                value,
                f"give {unit} from {low:g} to {high:g}",
            )
        _require(
            _finite(self.density) and 0 < self.density <= 3e4,
            "material.density",
            self.density,
            "give kg/m³ above 0 and up to 30000",
        )
        _require(
            _finite(self.youngs_modulus) and 1e2 <= self.youngs_modulus <= 1e12,
            "material.youngs_modulus",
            self.youngs_modulus,
            "give pascals between 1e2 and 1e12",
        )
        _require(
            _finite(self.poisson_ratio) and 0 <= self.poisson_ratio <= 0.49,
            "material.poisson_ratio",
            self.poisson_ratio,
            "give a number from 0 to 0.49",
        )


@dataclass(frozen=True, kw_only=True)
class SceneObject:
    """One thing in the photo.

    name: letters, digits, ``_``, ``-`` and spaces; it names the object's files.
    mesh, mask, shadow: files relative to the scene folder; mask and shadow may be None.
    world_from_mesh: 4x4 similarity from the mesh file's own coordinates to world metres.
    size_m: largest extent in metres.
    role: ``dynamic`` moves, ``collider`` stays where it is.
    fill: sample the whole inside (True) or only a shell (False).
    velocity: m/s; spin: rad/s about the centre of mass; both at time 0.
    occlusion_order: 0 is frontmost.
    """

    name: str
    mesh: str
    world_from_mesh: Matrix4 = IDENTITY4
    size_m: float
    role: str = "dynamic"
    material: Material = field(default_factory=Material)
    fill: bool = True
    velocity: Vector = (0.0, 0.0, 0.0)
    spin: Vector = (0.0, 0.0, 0.0)
    occlusion_order: int = 0
    mask: str | None = None
    shadow: str | None = None

    def __post_init__(self) -> None:
        allowed = (
            bool(self.name)
            and len(self.name) <= 64
            and all(c.isalnum() or c in "_- " for c in self.name)
            and self.name == self.name.strip()
        )
        _require(allowed, "object.name", self.name, "use up to 64 letters, digits, spaces, '_' and '-'")
        _require(self.role in ROLES, f"object {self.name}: role", self.role, f"choose one of {', '.join(ROLES)}")
        _require(
            _finite(self.size_m) and self.size_m > 0, f"object {self.name}: size_m", self.size_m, "give metres above 0"
        )
        _require(
            _finite(*self.velocity), f"object {self.name}: velocity", self.velocity, "give three finite numbers in m/s"
        )
        _require(_finite(*self.spin), f"object {self.name}: spin", self.spin, "give three finite numbers in rad/s")
        matrix = np.asarray(self.world_from_mesh, dtype=float)
        _require(
            matrix.shape == (4, 4) and bool(np.isfinite(matrix).all()) and abs(float(np.linalg.det(matrix))) > 1e-18,
            f"object {self.name}: world_from_mesh",
            matrix.shape,
            "give a finite, invertible 4x4 matrix",
        )


@dataclass(frozen=True, kw_only=True)
class Effect:
    """A physical effect of the registry with its parameters (docs/effects.md).

    objects: names of the objects that it acts on; empty for all that it can act on.
    """

    name: str
    parameters: tuple[tuple[str, float], ...] = ()
    objects: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Light:
    """What lights the objects.

    environment: equirectangular EXR in linear light relative to the scene folder, or None for plain white.
    sun_direction: unit vector from the scene to the sun, or None for no sun.
    sun_strength: irradiance of the sun over the irradiance of the environment on the open ground, 0 to 20.
    sun_angle: apparent diameter in radians; larger is softer.
    """

    environment: str | None = None
    sun_direction: Vector | None = None
    sun_strength: float = 1.0
    sun_angle: float = 0.15

    def __post_init__(self) -> None:
        if self.sun_direction is not None:
            _require(
                _finite(*self.sun_direction) and abs(math.hypot(*self.sun_direction) - 1.0) < 1e-3,
                "light.sun_direction",
                self.sun_direction,
                "give a unit vector or null",
            )
        _require(
            _finite(self.sun_strength) and 0 <= self.sun_strength <= 20,
            "light.sun_strength",
            self.sun_strength,
            "give 0 to 20",
        )
        _require(
            _finite(self.sun_angle) and 0 <= self.sun_angle <= math.pi,
            "light.sun_angle",
            self.sun_angle,
            "give 0 to pi radians",
        )


@dataclass(frozen=True, kw_only=True)
class Scene:
    """A whole scene. File names are relative to the scene folder."""

    camera: Camera
    objects: tuple[SceneObject, ...]
    ground: Ground = field(default_factory=Ground)
    gravity: Vector = (0.0, 0.0, -9.81)
    effects: tuple[Effect, ...] = ()
    light: Light = field(default_factory=Light)
    photo: str = "photo.png"
    background: str = "background.png"
    depth: str | None = None

    def __post_init__(self) -> None:
        _require(len(self.objects) > 0, "objects", (), "a scene needs at least one object")
        _require(
            _finite(*self.gravity) and math.hypot(*self.gravity) <= 1e4,
            "gravity",
            self.gravity,
            "give three numbers in m/s², together up to 10000",
        )
        names = [o.name.casefold() for o in self.objects]
        _require(
            len(set(names)) == len(names),
            "objects",
            [o.name for o in self.objects],
            "give every object a name of its own",
        )
        present = {o.name for o in self.objects}
        for index, effect in enumerate(self.effects):
            for name in effect.objects:
                _require(
                    name in present,
                    f"effects[{index}].objects",
                    name,
                    f"name some of {', '.join(sorted(present))}, or none for all",
                )
