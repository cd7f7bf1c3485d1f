# SPDX-License-Identifier: MIT
"""A scene object: mesh, placement, material, keyframes, pins, collider motion, and contacts between pairs."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field, fields

import numpy as np
from numpy.typing import NDArray

from ..constitutive import RIGID, model_of
from ..validation import finite, may_be_named, quantity, range_of, require, require_quantities, require_range
from .material import Material

Vector = tuple[float, float, float]

CONTACT_MODES = ("separate", "slip", "sticky")


@dataclass(frozen=True, kw_only=True)
class Key:
    """One keyframe: ``value`` at ``time_s`` seconds after frame 1; unit and meaning are those of the field."""

    time_s: float
    value: Vector

    def __post_init__(self) -> None:
        require(finite(self.time_s), "time_s", self.time_s, "give finite seconds")
        require(len(self.value) == 3 and finite(*self.value), "value", self.value, "give three finite numbers")


Keys = tuple[Key, ...]
"""Keyframes, linear in between, constant before the first and after the last; empty: no track."""


@dataclass(frozen=True, kw_only=True)
class NumberKey:
    """One keyframe of a single number: ``value`` at ``time_s`` seconds after frame 1."""

    time_s: float
    value: float

    def __post_init__(self) -> None:
        require(finite(self.time_s), "time_s", self.time_s, "give finite seconds")
        require(finite(self.value), "value", self.value, "give a finite number")


STEADY = ("density", "rigid_restitution")
"""Numbers of a material that have no track: matter keeps its mass."""


@dataclass(frozen=True, kw_only=True)
class MaterialTrack:
    """A number of the object's material over time, in place of the material's own.

    field: a number of ``Material`` that its law reads, but for the density.
    keys: at least one, in the range of that field, linear in between.
    """

    field: str
    keys: tuple[NumberKey, ...]

    def __post_init__(self) -> None:
        known = [f.name for f in fields(Material) if "range" in f.metadata and f.name not in STEADY]
        require(self.field in known, "material_tracks.field", self.field, f"choose one of {', '.join(known)}")
        where = f"material_tracks.{self.field}"
        require(len(self.keys) > 0, where, self.keys, "give at least one keyframe")
        require_rising(where, self.keys)
        low, high = range_of(Material, self.field)
        for key in self.keys:
            require_range(where, key.value, low, high)


@dataclass(frozen=True, kw_only=True)
class FactorMap:
    """A factor on a property of an object's matter that varies from place to place, from weights on its surface.

    Matter has the weight w, 0 to 1, of the nearest point of the surface; the factor is at_zero^(1-w) at_one^w, so that
    a weight of 0.5 between 0.1 and 10 means 1.

    attribute: name of the vertices' attribute in the mesh file that holds the weights: of a PLY file a property, of a
        GLB file an attribute that begins with ``_``.
    file: in place of it a file in the scene folder: an ``.npz`` with ``weights`` (V,), the vertices in the order of the
        mesh file, or a PNG or JPEG picture laid on by the mesh's texture coordinates (red channel, black 0, white 1).
    at_zero, at_one: factors of weight 0 and 1, 0.001 to 1000.
    """

    attribute: str | None = None
    file: str | None = None
    at_zero: float = quantity(1.0, 1e-3, 1e3)
    at_one: float = quantity(1.0, 1e-3, 1e3)

    def __post_init__(self) -> None:
        require_quantities(self, "factor map: ")
        one = (self.attribute is None) != (self.file is None)
        require(one, "factor map: attribute, file", (self.attribute, self.file), "give one of the two")


def require_rising(field_name: str, keys: Sequence[Key | NumberKey]) -> None:
    """Raise InputError unless the times of ``keys`` rise."""
    for before, after in itertools.pairwise(keys):
        require(
            before.time_s < after.time_s,
            f"{field_name}: time_s after {before.time_s:g}",
            after.time_s,
            "give rising times, each once",
        )


@dataclass(frozen=True, kw_only=True)
class Box:
    """An axis-aligned box in world metres between the corners ``low`` and ``high``."""

    low: Vector
    high: Vector

    def __post_init__(self) -> None:
        require(finite(*self.low), "low", self.low, "give three finite numbers in metres")
        good = finite(*self.high) and all(a < b for a, b in zip(self.low, self.high, strict=True))
        require(good, "high", self.high, f"give three finite numbers in metres above those of low, {self.low}")


@dataclass(frozen=True, kw_only=True)
class Motion:
    """Motion of a collider: rigid (translations, rotations) or per vertex (vertices_file).

    translations: m, added to the mesh's position.
    rotations: rotation vectors (axis times angle in rad) about ``pivot``, with constant angular velocity in between.
    pivot: world point in metres; None takes the centre of the mesh's bounding box.
    vertices_file: ``.npz`` in the scene folder with ``times`` (K,) in s, rising, and ``vertices`` (K, V, 3) in world
        metres, V and their order as in the object's mesh file.
    """

    translations: Keys = ()
    rotations: Keys = ()
    pivot: Vector | None = None
    vertices_file: str | None = None

    def __post_init__(self) -> None:
        require_rising("motion.translations", self.translations)
        require_rising("motion.rotations", self.rotations)
        pivot = self.pivot
        require(pivot is None or finite(*pivot), "motion.pivot", pivot, "give three finite numbers in metres or null")
        both = self.vertices_file is not None and bool(self.translations or self.rotations)
        require(not both, "motion.vertices_file", self.vertices_file, "leave out translations and rotations with it")


@dataclass(frozen=True, kw_only=True)
class Contact:
    """Contact parameters of one pair of surfaces; None follows from the two objects (docs/file-formats.md).

    between: two object names, or one and ``ground``.
    friction, static_friction: Coulomb's coefficients, 0 to 10.
    restitution: Newton's coefficient, rigid bodies only, 0 to 1.
    mode: ``separate`` (friction, free to separate), ``slip`` (no separation, no friction), ``sticky`` (no separation,
        no sliding).
    rolling_resistance: lever arm in m of the normal force against rolling, rigid bodies only, 0 to 1.
    adhesion: attraction in m/s² (force over the reduced mass of the two) within ``adhesion_reach`` m; 0 to 1e5 and
        0 to 1.
    """

    between: tuple[str, str]
    friction: float | None = None
    static_friction: float | None = None
    restitution: float | None = None
    mode: str | None = None
    rolling_resistance: float = 0.0
    adhesion: float = 0.0
    adhesion_reach: float = 0.0

    def __post_init__(self) -> None:
        first, second = self.between
        require(first != second, "contact.between", self.between, "name two different things")
        require_surface("contact", self.friction, self.static_friction, self.restitution, self.mode)
        require_range("contact.rolling_resistance", self.rolling_resistance, 0.0, 1.0, "metres")
        require_range("contact.adhesion", self.adhesion, 0.0, 1e5, "m/s²")
        require_range("contact.adhesion_reach", self.adhesion_reach, 0.0, 1.0, "metres")


def require_surface(
    where: str, friction: float | None, static_friction: float | None, restitution: float | None, mode: str | None
) -> None:
    """Raise InputError for surface parameters out of range; ``where`` prefixes the field names."""
    require_range(f"{where}.friction", friction, 0.0, 10.0)
    require_range(f"{where}.static_friction", static_friction, 0.0, 10.0)
    if static_friction is not None:
        require(
            friction is not None and friction <= static_friction,
            f"{where}.static_friction",
            static_friction,
            f"give friction (it is {friction}) as well, and no less than it here",
        )
    require_range(f"{where}.restitution", restitution, 0.0, 1.0)
    known = mode is None or mode in CONTACT_MODES
    require(known, f"{where}.mode", mode, f"choose one of {', '.join(CONTACT_MODES)}, or null")


Matrix4 = tuple[tuple[float, float, float, float], ...]

ROLES = ("dynamic", "collider")
IDENTITY4: Matrix4 = tuple(tuple(1.0 if i == j else 0.0 for j in range(4)) for i in range(4))  # type: ignore[misc]

MOST_PINS = 1000
"""Of an object: every particle is compared with each."""

LEAST_ANGLE = 1e-6
"""Volume of the unit cube under ``world_from_mesh`` over the product of its edge lengths; below, it is degenerate."""


@dataclass(frozen=True, kw_only=True)
class SceneObject:
    """An object of a scene.

    name: letters, digits, ``_``, ``-`` and spaces; it names the object's files.
    mesh, mask, shadow: files relative to the scene folder; mask and shadow may be None.
    world_from_mesh: invertible 4x4 affine map from the mesh file's coordinates to world metres; non-uniform scale,
        shear and mirroring are allowed.
    size_m: largest extent in metres.
    role: ``dynamic`` is simulated; ``collider`` is static or follows ``motion``, and others hit it.
    fill: solid (True), or a shell of ``shell_thickness`` m below the surface (False; None takes two grid cells), which
        weighs correspondingly less.
    velocity: m/s; spin: rad/s about the centre of mass; both at the start.
    occlusion_order: 0 is frontmost.
    roughness: of the surface, 0 (polished) to 1 (coarse); determines friction where ``friction`` is None.
    friction, static_friction: Coulomb's coefficients of the surface, 0 to 10; restitution: 0 to 1; contact_mode: one of
        ``CONTACT_MODES``. None takes the ground's, or those of ``Ground()`` where there is no ground. How two surfaces
        combine: docs/file-formats.md.
    motion: of a collider; None for a static one.
    splats: PLY file of Gaussian splats in the mesh file's coordinates, relative to the scene folder, or None. They are
        what is rendered; the mesh is filled with particles and collides, and the splats follow the particles.
    shading: picture (``shading.py``) of the photo's light on the mesh's texture, relative to the scene folder, or None.

    Of dynamic objects only:
    asleep: whether the object keeps the pose it has at the start until something touches it, if it stands and nothing
        but gravity acts on it; reconstructed objects do, since the photo shows them at rest.
    held: with ``asleep``, whether it does so where nothing carries it, too: it hangs, or leans on what is not there.
    start_time: s at which the object enters the simulation; until then it stays in place and touches nothing.
    acceleration: keyframes of force over mass in m/s².
    velocity_keys: keyframes at which the object's mean velocity in m/s is set.
    pins: particles inside one of the boxes at rest are held in place, or moved along ``pin_motion`` (keyframes of
        displacement in m).
    goal_stiffness: spring of all particles to their rest positions, force over mass and distance in 1/s², 0 (none) to
        1e6; goal_damping: share of critical damping, 0 to 1.
    material_tracks: numbers of the material over time, each named once.
    stiffness_map: factor on Young's modulus (fluids: bulk modulus and viscosity) from place to place; not of rigid
        objects. density_map: on the density.
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
    shell_thickness: float | None = quantity(None, 1e-6, 1e3, "metres")
    roughness: float | None = quantity(None, 0.0, 1.0)
    friction: float | None = None
    static_friction: float | None = None
    restitution: float | None = None
    contact_mode: str | None = None
    motion: Motion | None = None
    splats: str | None = None
    shading: str | None = None
    asleep: bool = False
    held: bool = False
    start_time: float = quantity(0.0, 0.0, 1e6, "seconds")
    acceleration: Keys = ()
    velocity_keys: Keys = ()
    pins: tuple[Box, ...] = ()
    pin_motion: Keys = ()
    goal_stiffness: float = quantity(0.0, 0.0, 1e6, "1/s²")
    goal_damping: float = quantity(0.0, 0.0, 1.0)
    material_tracks: tuple[MaterialTrack, ...] = ()
    stiffness_map: FactorMap | None = None
    density_map: FactorMap | None = None

    def __post_init__(self) -> None:
        allowed = (
            bool(self.name) and len(self.name) <= 64 and may_be_named(self.name) and self.name == self.name.strip()
        )
        require(allowed, "object.name", self.name, "use up to 64 letters, digits, spaces, '_' and '-'")
        require(self.role in ROLES, f"object {self.name}: role", self.role, f"choose one of {', '.join(ROLES)}")
        require(
            finite(self.size_m) and self.size_m > 0, f"object {self.name}: size_m", self.size_m, "give metres above 0"
        )
        require(
            finite(*self.velocity), f"object {self.name}: velocity", self.velocity, "give three finite numbers in m/s"
        )
        require(finite(*self.spin), f"object {self.name}: spin", self.spin, "give three finite numbers in rad/s")
        matrix = np.asarray(self.world_from_mesh, dtype=float)
        require(
            matrix.shape == (4, 4) and _invertible(matrix),
            f"object {self.name}: world_from_mesh",
            matrix.tolist(),
            "give a finite, invertible 4x4 matrix whose last row is 0 0 0 1: no axis may be scaled to nothing",
        )
        self._check_control()

    def _check_control(self) -> None:
        where = f"object {self.name}"
        require_quantities(self, f"{where}: ")
        require_surface(where, self.friction, self.static_friction, self.restitution, self.contact_mode)
        require(
            self.splats is None or self.splats.lower().endswith(".ply"),
            f"{where}: splats",
            self.splats,
            "give a PLY file of splats inside the scene folder, or null",
        )
        bends = self.motion is not None and self.motion.vertices_file is not None
        require(
            self.splats is None or not bends,
            f"{where}: splats",
            self.splats,
            "splats follow particles or a rigid motion, not vertices_file: make the object dynamic, or give null",
        )
        for name in ("acceleration", "velocity_keys", "pin_motion"):
            require_rising(f"{where}: {name}", getattr(self, name))
        require(len(self.pins) <= MOST_PINS, f"{where}: number of pins", len(self.pins), f"give at most {MOST_PINS}")
        held = bool(self.pins) or self.goal_stiffness > 0
        require(held or not self.pin_motion, f"{where}: pin_motion", "given", "give pins or goal_stiffness as well")
        if self.role == "dynamic":
            require(self.motion is None, f"{where}: motion", "given", "only an object of role 'collider' has one")
            self._check_matter(where)
            return
        matter = ("material_tracks", "stiffness_map", "density_map")
        for name in ("start_time", "acceleration", "velocity_keys", "pins", "goal_stiffness", *matter):
            require(not getattr(self, name), f"{where}: {name}", "given", "only an object of role 'dynamic' has one")

    def _check_matter(self, where: str) -> None:
        law = self.material.law
        read = () if law == RIGID else model_of(law).reads
        named = [track.field for track in self.material_tracks]
        for name in named:
            reads = ", ".join(n for n in read if n != "fibre_axis") or "none"
            require(name in read, f"{where}: material_tracks", name, f"the law {law!r} reads {reads}: choose one")
            require(named.count(name) == 1, f"{where}: material_tracks", name, "give every field one track")
        soft = law != RIGID or self.stiffness_map is None
        require(soft, f"{where}: stiffness_map", "given", "leave it out of a rigid object, or choose another law")


def _invertible(matrix: NDArray[np.float64]) -> bool:
    """Return whether the 4x4 ``matrix`` is affine and not degenerate, independent of the mesh's unit."""
    if not np.isfinite(matrix).all() or not np.allclose(matrix[3], (0.0, 0.0, 0.0, 1.0), atol=1e-6):
        return False
    scales = np.linalg.norm(matrix[:3, :3], axis=0)
    return bool((scales > 0).all() and abs(np.linalg.det(matrix[:3, :3] / scales)) > LEAST_ANGLE)
