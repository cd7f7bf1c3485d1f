# SPDX-License-Identifier: MIT
"""The physical step of an optimisation: velocities in, positions out (Yan et al., PhyCAGE, Algorithm 1, lines 4 to 9).

    x⁰ = μ^k,  v⁰ = −P ∇_μ L,  Δt = γ/N,  (x, v)^{n+1} = MPM(x^n, v^n, Δt, ψ) for n < N,  μ^{k+1} = x^N

The paper writes v⁰ = ∇_μ L; what descends is its negative, and P > 0 is the caller's scale, metres per unit of pseudo-
time for a unit of gradient. The first substep is then gradient descent with the rate Δt P; in the following ones the
material responds: neighbours follow, contact stops, penetration is corrected. docs/composition.md."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ...constitutive import ElasticMaterial
from ...errors import InputError
from ...events import IsCancelled, never
from ...mpm.bodies import BodyParticles
from ...mpm.colliders import Collider, Surface, Track
from ...mpm.geometry.signed_distance import DistanceLattice
from ...mpm.solver_options import SolverOptions, centred
from ...mpm.surface_contact import ContactTable, SurfaceContact
from ...mpm.world import World
from .body_distances import fill_points, obstacle_lattice, particle_volumes, point_cloud_distances, surface_distances
from .deformation_fit import DeformationFit, HarmonicExtension

EXIT_SIDES = ("bulk", "nearest")


@dataclass(frozen=True, kw_only=True)
class StepOptions:
    """Options of the physical step of Algorithm 1. Raises InputError on a value out of range."""

    substeps: int = 20
    """N: MPM substeps of a step of pseudo-time γ, so Δt = γ/N; 1 to 1000. More are taken where Δt would be unstable,
    because of fast points or large strain."""

    cells_across: int = 32
    """Grid cells along the longest side of the body; 8 to 256."""

    particles_per_cell: int = 2
    """Filling particles for each grid cell inside the body; 1 to 8."""

    poisson_ratio: float = 0.3
    """Poisson's ratio of the body; 0 to 0.45."""

    wave_cells: float = 0.2
    """Grid cells that an elastic wave crosses in Δt, above 0, up to 0.5. It defines the stiffness, because pseudo-time
    has no seconds: Young's modulus follows from this speed. In a step a disturbance spreads through ``substeps *
    wave_cells`` cells."""

    recovery_cells: float = 0.25
    """Grid cells by which a step moves material out of an obstacle at most, 0.01 to 1: gently, so neighbours follow."""

    keep_strain: float = 1.0
    """Fraction of the strain carried over from step to step; 0 to 1. 1: an elastic body, which returns to its shape.
    0: Algorithm 1 to the letter, which passes on x and v only, so every step begins without strain."""

    friction: float = 0.0
    """Coulomb's coefficient between body and obstacle, 0 to 1. With 0 a loss may slide material along a surface."""

    margin: float = 0.0
    """Metres that points keep from the obstacles' surfaces; 0 to the size of a grid cell."""

    fill: bool = True
    """Whether the inside of the body is filled with particles; without them its points are all there is."""

    exit_side: str = "bulk"
    """Side on which points leave an obstacle: "bulk": the side of the body's middle, even through a wall that they have
    passed completely; "nearest": the nearest point of its surface."""

    solver: SolverOptions = field(default_factory=SolverOptions)
    """Where to compute (arch, threads, cache_folder); its other fields are ignored."""

    def __post_init__(self) -> None:
        for name, low, high in (("substeps", 1, 1000), ("cells_across", 8, 256), ("particles_per_cell", 1, 8)):
            value = getattr(self, name)
            if not (isinstance(value, int) and low <= value <= high):
                raise InputError(f"physical step: {name} is {value!r}: give a whole number from {low} to {high}")
        for name, least, most in (
            ("poisson_ratio", 0.0, 0.45),
            ("wave_cells", 1e-3, 0.5),
            ("recovery_cells", 0.01, 1.0),
            ("keep_strain", 0.0, 1.0),
            ("friction", 0.0, 1.0),
            ("margin", 0.0, math.inf),
        ):
            value = getattr(self, name)
            if not (math.isfinite(value) and least <= value <= most):
                raise InputError(f"physical step: {name} is {value!r}: give {least:g} to {most:g}")
        if self.exit_side not in EXIT_SIDES:
            raise InputError(f"physical step: exit_side is {self.exit_side!r}: choose one of {', '.join(EXIT_SIDES)}")


Array = NDArray[np.float64]


DENSITY = 1000.0
"""kg/m³. Arbitrary: without gravity only the wave speed matters, and that is an option."""

MIN_STRETCH, MAX_STRETCH = 0.6, 1.6
"""Range of principal stretches that are carried over between steps. Material beyond, as at the edge of an obstacle, has
torn or yielded; keeping that strain would stiffen the body and shorten its substeps."""

CLEARANCE = 0.01
"""Grid cells that points keep from a surface besides the margin: contact is accurate to about half of that, and a point
that rests on a surface should not count as inside."""

GRID_CELLS = 256
"""Nominal grid size; the engine has no walls."""


class PhysicalBody:
    """Points (N, 3) that move as parts of an elastic body beside obstacles, in steps of pseudo-time.

    points: current positions, world metres; they may be in the obstacles, or behind their walls.
    surface: the object's closed surface, world metres; None uses what the points enclose
        (``body_distances.point_cloud_distances``).
    obstacles: colliders, with tracks in units of steps if they move; distance lattices are computed here unless given.

    Filling particles turn a shell of points into a body. They have no loss of their own; with velocity 0 they would
    slow every point down through the grid, which shares momentum, the more the finer the filling. So v⁰ is extended to
    them harmonically (``HarmonicExtension``). A translation, rotation or stretch of all points then is one of the whole
    body, whatever its filling; differences between neighbouring points are averaged by mass at uniform density.

    Raises InputError on invalid points, and for open obstacles.
    """

    def __init__(
        self,
        *,
        points: NDArray[np.floating],
        surface: Surface | None = None,
        obstacles: Sequence[Collider] = (),
        options: StepOptions | None = None,
    ) -> None:
        self.options = options or StepOptions()
        own = np.array(points, dtype=np.float64)
        if own.ndim != 2 or own.shape[1:] != (3,) or len(own) < 8 or not np.isfinite(own).all():
            raise InputError(f"physical body: points have shape {own.shape}: give finite (N, 3), N at least 8")
        self._count = len(own)
        self._size = float(np.ptp(own, axis=0).max())
        if not self._size > 0:
            raise InputError("physical body: points are all in one place: give an object with an extent")
        self.cell = self._size / self.options.cells_across
        if self.options.margin > self.cell:
            raise InputError(
                f"physical step: margin is {self.options.margin:g} m: give 0 to {self.cell:g}, the size of a grid cell"
            )
        # Without gravity the engine corrects penetration by a cell a second, so a step lasts this many seconds.
        self._seconds = self.options.recovery_cells
        solid = point_cloud_distances(own) if surface is None else surface_distances(surface)
        spacing = self.cell / math.cbrt(self.options.particles_per_cell)
        fill = fill_points(solid, spacing, own) if self.options.fill else np.zeros((0, 3))
        self._rest = np.concatenate([own, fill])
        self._volumes = particle_volumes(solid, 0.5 * spacing, self._rest)
        self._extension = HarmonicExtension(own, fill)
        self._gradients = DeformationFit(self._rest, self.cell)
        self._obstacles = tuple(self._with_lattice(collider, solid) for collider in obstacles)
        self._world = self._new_world()

    # ---- state ---------------------------------------------------------------------------------------------------

    @property
    def points(self) -> Array:
        """Current points, (N, 3) world metres."""
        return self.particles[: self._count]

    @property
    def gradients(self) -> Array:
        """Deformation gradients (N, 3, 3) of the points since the start, for covariances F Σ Fᵀ."""
        return self.particle_gradients[: self._count]

    @property
    def rest(self) -> Array:
        """Initial points and filling particles, (M, 3) world metres; the points come first."""
        return self._rest.copy()

    @property
    def particles(self) -> Array:
        """Current points and filling particles, (M, 3) world metres."""
        return self._world.positions(0)

    @property
    def particle_gradients(self) -> Array:
        """Deformation gradients (M, 3, 3) of points and filling particles since the start (``gradients``)."""
        return self._gradients.at(self.particles)

    @property
    def lattices(self) -> tuple[DistanceLattice, ...]:
        """Signed distances to the region closed to the body, one for each obstacle, at its rest pose."""
        return tuple(c.lattice for c in self._obstacles if c.lattice is not None)

    # ---- motion --------------------------------------------------------------------------------------------------

    def step(self, velocities: NDArray[np.floating], *, duration: float = 1.0, stop: IsCancelled = never) -> None:
        """Advance by γ = ``duration`` of pseudo-time from v⁰ = ``velocities`` (N, 3), metres per pseudo-time.

        v⁰ = −P ∇L descends. Final velocities are discarded, as in the paper: every step starts with its own. Stiffness
        and contact are defined per substep, not second, so only the product γ v⁰ matters.

        stop: polled; when it returns True, Cancelled is raised and the body is unusable. Raises InputError on wrong
        shapes and values that are not finite; SimulationError when the simulation diverges.
        """
        given = np.asarray(velocities, dtype=np.float64)
        if given.shape != (self._count, 3) or not np.isfinite(given).all():
            raise InputError(
                f"physical step: velocities have shape {given.shape}: give finite ({self._count}, 3), one per point"
            )
        if not (math.isfinite(duration) and duration > 0):
            raise InputError(f"physical step: duration is {duration!r}: give a pseudo-time above 0")
        everything = (duration / self._seconds) * np.concatenate([given, self._extension(given)])
        kept = _kept_strain(self._world.elastic_gradients(0), self.options.keep_strain)
        self._world.set_motion(0, velocities=everything, gradients=kept)
        self._world.advance(self._seconds, stop)

    def place(self, points: NDArray[np.floating]) -> None:
        """Move the points to (N, 3) world metres, without simulation; filling particles follow their neighbours.

        Raises InputError on wrong shapes and values that are not finite.
        """
        given = np.asarray(points, dtype=np.float64)
        if given.shape != (self._count, 3) or not np.isfinite(given).all():
            raise InputError(f"physical body: points have shape {given.shape}: give finite ({self._count}, 3)")
        now = self.particles
        way = given - now[: self._count]
        positions = now + np.concatenate([way, self._extension(way)])
        self._world.set_motion(0, velocities=np.zeros_like(positions), positions=positions)

    # ---- world ---------------------------------------------------------------------------------------------------

    def _new_world(self) -> World:
        options, positions = self.options, self._rest
        solver = dataclasses.replace(
            options.solver,
            grid=GRID_CELLS,
            cfl_elastic=SolverOptions().cfl_elastic,
            cfl_velocity=SolverOptions().cfl_velocity,
            max_step=self._seconds / options.substeps,
        )
        middle = 0.5 * (positions.min(axis=0) + positions.max(axis=0))
        body = BodyParticles(
            name="body",
            positions=positions,
            volumes=self._volumes,
            material=self._material(),
            contact_radii=np.full(len(positions), self.options.margin + CLEARANCE * self.cell),
        )
        return World(
            bodies=[body],
            gravity=(0.0, 0.0, 0.0),
            colliders=self._obstacles,
            contacts=ContactTable(default=SurfaceContact(friction=options.friction)),
            similarity=centred(middle, self.cell, solver),
            options=solver,
        )

    def _material(self) -> ElasticMaterial:
        """Return the elastic material with E = ρ c² (1 + ν)(1 − 2ν)/(1 − ν), c = ``wave_cells`` cells in Δt."""
        nu = self.options.poisson_ratio
        speed = self.options.wave_cells * self.cell * self.options.substeps / self._seconds
        modulus = DENSITY * speed**2 * (1 + nu) * (1 - 2 * nu) / (1 - nu)
        return ElasticMaterial(density=DENSITY, youngs_modulus=modulus, poisson_ratio=nu)

    def _in_seconds(self, collider: Collider) -> Collider:
        return dataclasses.replace(
            collider,
            translations=_track_in_seconds(collider.translations, self._seconds),
            rotations=_track_in_seconds(collider.rotations, self._seconds),
            vertices=_track_in_seconds(collider.vertices, self._seconds),
        )

    def _with_lattice(self, collider: Collider, solid: DistanceLattice) -> Collider:
        collider = self._in_seconds(collider)
        if collider.lattice is not None or collider.vertices is not None:
            return collider
        if collider.translations is not None or collider.rotations is not None:
            # The lattice is of the surface at rest, so the body is transformed to that frame.
            solid = point_cloud_distances(_in_rest_frame(collider, self._rest))
        lattice = obstacle_lattice(collider.surface, solid, exit_side=self.options.exit_side)
        return dataclasses.replace(collider, lattice=lattice)


def _track_in_seconds(track: Track | None, seconds: float) -> Track | None:
    """Return ``track`` with times in seconds instead of steps of ``seconds``."""
    return None if track is None else Track(times=track.times * seconds, values=track.values)


def _in_rest_frame(collider: Collider, positions: Array) -> Array:
    """Return world positions (M, 3) in the frame of the collider's rest pose, when its tracks begin."""
    local = positions - collider.middle
    if collider.translations is not None:
        local = local - collider.translations.at(0.0)
    if collider.rotations is not None:
        local = Rotation.from_rotvec(collider.rotations.at(0.0)).inv().apply(local)
    return np.asarray(local + collider.middle)


def _kept_strain(gradients: Array, share: float) -> Array:
    """Return gradients (M, 3, 3) with the fraction ``share`` of their strain ln V, within the kept stretches.

    Those that change lose their rotation: stress of an isotropic body depends on V = (F Fᵀ)^½ alone.
    """
    if share == 0:
        return np.broadcast_to(np.eye(3), gradients.shape).copy()
    kept = gradients.copy()
    squares = gradients @ gradients.transpose(0, 2, 1)
    # By Gershgorin's theorem the squares of the stretches lie within the off-diagonal sums around the diagonal.
    diagonal = np.diagonal(squares, axis1=1, axis2=2)
    beside = np.abs(squares).sum(axis=2) - diagonal
    held = ((diagonal + beside < MAX_STRETCH**2) & (diagonal - beside > MIN_STRETCH**2)).all(axis=1)
    which = np.flatnonzero(~held) if share == 1 else np.arange(len(gradients))
    values, axes = np.linalg.eigh(squares[which])
    stretches = np.clip(np.maximum(values, 1e-12) ** (0.5 * share), MIN_STRETCH, MAX_STRETCH)
    kept[which] = (axes * stretches[:, None, :]) @ axes.transpose(0, 2, 1)
    return kept
