# SPDX-License-Identifier: MIT
"""One thing in the photo: where it stands, of what it is made, how it begins and what acts on it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from .checks import finite, require, require_range
from .control import Box, Keys, Motion, Vector, require_rising, require_surface
from .matter import Material

Matrix4 = tuple[tuple[float, float, float, float], ...]

ROLES = ("dynamic", "collider")
IDENTITY4: Matrix4 = tuple(tuple(1.0 if i == j else 0.0 for j in range(4)) for i in range(4))  # type: ignore[misc]

LEAST_ANGLE = 1e-6
"""Volume of a unit cube under ``world_from_mesh`` over that of a brick with its edges; below, it is flat."""


@dataclass(frozen=True, kw_only=True)
class SceneObject:
    """One thing in the photo.

    name: letters, digits, ``_``, ``-`` and spaces; it names the object's files.
    mesh, mask, shadow: files relative to the scene folder; mask and shadow may be None.
    world_from_mesh: 4x4 affine map from the mesh file's own coordinates to world metres: any that can be undone, also
        with another scale along each axis, sheared or mirrored.
    size_m: largest extent in metres.
    role: ``dynamic`` moves, ``collider`` stays where it is or goes where ``motion`` takes it, and others hit it.
    fill: matter through the whole inside (True), or only within ``shell_thickness`` m of the surface (False; None takes
        two grid cells): a hollow body that weighs as much less.
    velocity: m/s; spin: rad/s about the centre of mass; both at the start.
    occlusion_order: 0 is frontmost.
    roughness: of the surface, 0 (polished) to 1 (coarse); gives its friction where ``friction`` is None.
    friction, static_friction: Coulomb's coefficients of the surface, 0 to 10; restitution: 0 to 1; contact_mode: one of
        ``CONTACT_MODES``. None takes the ground's, or those of ``Ground()`` where there is no ground.
        docs/file-formats.md says how those of two surfaces combine.
    motion: of a collider; None stands still.
    splats: PLY file of Gaussian splats in the mesh file's own coordinates, relative to the scene folder, or None: what
        is seen of the object. The mesh is then what is filled with matter and collides, and splats follow that matter.

    Of dynamic objects only:
    start_time: s at which the object comes into the simulation; until then it stays in place and touches nothing.
    acceleration: keyframes of force over mass in m/s².
    velocity_keys: keyframes of the velocity in m/s that the whole object is given at their times.
    pins: what of the object is inside one of the boxes at rest is held in place, or goes along ``pin_motion``
        (keyframes of the way in m).
    goal_stiffness: pull of all matter to its place at rest, force over mass and distance in 1/s², 0 (none) to 1e6;
        goal_damping: share of critical damping, 0 to 1.
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
    shell_thickness: float | None = None
    roughness: float | None = None
    friction: float | None = None
    static_friction: float | None = None
    restitution: float | None = None
    contact_mode: str | None = None
    motion: Motion | None = None
    splats: str | None = None
    start_time: float = 0.0
    acceleration: Keys = ()
    velocity_keys: Keys = ()
    pins: tuple[Box, ...] = ()
    pin_motion: Keys = ()
    goal_stiffness: float = 0.0
    goal_damping: float = 0.0

    def __post_init__(self) -> None:
        allowed = (
            bool(self.name)
            and len(self.name) <= 64
            and all(c.isalnum() or c in "_- " for c in self.name)
            and self.name == self.name.strip()
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
        require_range(f"{where}: shell_thickness", self.shell_thickness, 1e-6, 1e3, "metres")
        require_range(f"{where}: roughness", self.roughness, 0.0, 1.0)
        require_surface(where, self.friction, self.static_friction, self.restitution, self.contact_mode)
        require_range(f"{where}: start_time", self.start_time, 0.0, 1e6, "seconds")
        require_range(f"{where}: goal_stiffness", self.goal_stiffness, 0.0, 1e6, "1/s²")
        require_range(f"{where}: goal_damping", self.goal_damping, 0.0, 1.0)
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
            "splats follow matter or a rigid motion, not vertices_file: let the object be dynamic, or give null",
        )
        for name in ("acceleration", "velocity_keys", "pin_motion"):
            require_rising(f"{where}: {name}", getattr(self, name))
        held = bool(self.pins) or self.goal_stiffness > 0
        require(held or not self.pin_motion, f"{where}: pin_motion", "given", "give pins or goal_stiffness as well")
        if self.role == "dynamic":
            require(self.motion is None, f"{where}: motion", "given", "only an object of role 'collider' has one")
            return
        for name in ("start_time", "acceleration", "velocity_keys", "pins", "goal_stiffness"):
            require(not getattr(self, name), f"{where}: {name}", "given", "only an object of role 'dynamic' has one")


def _invertible(matrix: NDArray[np.float64]) -> bool:
    """Whether the 4x4 ``matrix`` is affine and flattens no body, whatever unit the mesh is in."""
    if not np.isfinite(matrix).all() or not np.allclose(matrix[3], (0.0, 0.0, 0.0, 1.0), atol=1e-6):
        return False
    scales = np.linalg.norm(matrix[:3, :3], axis=0)
    return bool((scales > 0).all() and abs(np.linalg.det(matrix[:3, :3] / scales)) > LEAST_ANGLE)
