# SPDX-License-Identifier: MIT
"""The physical step of an optimisation: velocities in, positions out (Yan et al., PhyCAGE, Algorithm 1, lines 4 to 9).

    x⁰ = μ^k,  v⁰ = −P ∇_μ L,  Δt = γ/N,  (x, v)^{n+1} = MPM(x^n, v^n, Δt, ψ) for n < N,  μ^{k+1} = x^N

The paper writes v⁰ = ∇_μ L; what descends is its negative, and P > 0 is the caller's scale, metres per unit of pseudo-
time for a unit of gradient. The first substep is then gradient descent with the rate Δt P, and what follows lets the
matter answer: neighbours go along, what meets an obstacle stops, what is in one is led out.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ...errors import InputError
from ...events import IsCancelled, never
from ...mpm.bodies import BodyParticles
from ...mpm.colliders import Collider, Surface
from ...mpm.contacts import ContactTable, SurfaceContact
from ...mpm.distance import DistanceLattice
from ...mpm.materials import ElasticMaterial
from ...mpm.options import SolverOptions
from ...mpm.placement import centred
from ...mpm.tracks import Track
from ...mpm.world import World
from .exit_side import obstacle_lattice
from .extension import Extension
from .gradients import BodyGradients
from .options import StepOptions
from .solid import filling, solid_of_points, solid_of_surface, volumes_of

Array = NDArray[np.float64]

DENSITY = 1000.0
"""kg/m³. Any would do: without gravity only the speed of waves counts, and that is an option."""

LEAST_STRETCH, MOST_STRETCH = 0.6, 1.6
"""Principal stretches that strain is kept within from step to step. What was pulled or pushed beyond, as at the edge of
an obstacle, has torn or yielded; kept, it would stiffen the body and shorten its substeps."""

CLEARANCE = 0.01
"""Grid cells that points keep from a surface besides the margin: contact is right to about half of that, and a point
that rests on a surface should not count as being in it."""

GRID = 256
"""Cells to count from; the engine has no walls."""


class PhysicalBody:
    """Points (N, 3) that move as parts of an elastic body beside obstacles, step by step of pseudo-time.

    points: world metres, where they are now; they may be in the obstacles, or behind their walls.
    surface: the object's closed surface, world metres; None takes what the points enclose (``solid.solid_of_points``).
    obstacles: what the body must stay out of, with tracks in units of steps if they move; each distance lattice is
        worked out here, unless the collider brings one.

    Filling particles make a body out of a skin of points. They have no loss of their own; if they were given velocity
    0, the grid, which shares momentum, would slow every point down by the mass behind it, and the more the finer the
    filling is. So v⁰ is extended to them harmonically (``extension``). A shift, turn or stretch of all points then is
    one of the body, whatever its filling is; what differs between neighbouring points is evened out by mass, which is
    of one density: a particle's is that of the space around it.

    Raises InputError on bad points, and for obstacles that are open.
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
        # The engine takes back depth at a cell a second where there is no gravity, so this many seconds are a step.
        self._seconds = self.options.recovery_cells
        solid = solid_of_points(own) if surface is None else solid_of_surface(surface)
        spacing = self.cell / math.cbrt(self.options.particles_per_cell)
        fill = filling(solid, spacing, own) if self.options.fill else np.zeros((0, 3))
        self._rest = np.concatenate([own, fill])
        self._volumes = volumes_of(solid, 0.5 * spacing, self._rest)
        self._extension = Extension(own, fill)
        self._gradients = BodyGradients(self._rest, self.cell)
        self._lattices: list[tuple[Surface, DistanceLattice]] = []
        self._solid: DistanceLattice | None = solid
        self._obstacles: tuple[Collider, ...] = ()
        self._world = self._new_world(obstacles, self._rest)

    # ---- what it is now -----------------------------------------------------------------------------------------

    @property
    def points(self) -> Array:
        """Where the points are, (N, 3) world metres."""
        return self.particles[: self._count]

    @property
    def gradients(self) -> Array:
        """Deformation gradients (N, 3, 3) of the points since the start, over all steps: for covariances, F Σ Fᵀ."""
        return self.particle_gradients[: self._count]

    @property
    def rest(self) -> Array:
        """Where points and filling particles were at the start, (M, 3) world metres; the points come first."""
        return self._rest.copy()

    @property
    def particles(self) -> Array:
        """Where points and filling particles are, (M, 3) world metres."""
        return self._world.positions(0)

    @property
    def particle_gradients(self) -> Array:
        """Deformation gradients (M, 3, 3) of points and filling particles since the start (``gradients``)."""
        return self._gradients.at(self.particles)

    @property
    def volumes(self) -> Array:
        """Volumes (M,) in m³ at rest of points and filling particles."""
        return self._volumes.copy()

    @property
    def lattices(self) -> tuple[DistanceLattice, ...]:
        """Distances to what is closed to the body, one of each obstacle, in the obstacle's place at rest."""
        return tuple(c.lattice for c in self._obstacles if c.lattice is not None)

    # ---- moving it ----------------------------------------------------------------------------------------------

    def step(self, velocities: NDArray[np.floating], *, duration: float = 1.0, stop: IsCancelled = never) -> None:
        """Advance by γ = ``duration`` of pseudo-time from v⁰ = ``velocities`` (N, 3), metres per pseudo-time.

        v⁰ = −P ∇L descends. Velocities of the end are dropped, as in the paper: the next step brings its own. Stiffness
        and contact are set in substeps, not seconds, so only the product γ v⁰ matters.

        stop: asked now and then; on yes, Cancelled is raised, and the body is lost.
        Raises InputError on a wrong shape or a number that is not finite; SimulationError when the body goes wrong.
        """
        given = np.asarray(velocities, dtype=np.float64)
        if given.shape != (self._count, 3) or not np.isfinite(given).all():
            raise InputError(
                f"physical step: velocities have shape {given.shape}: give finite ({self._count}, 3), one a point"
            )
        if not (math.isfinite(duration) and duration > 0):
            raise InputError(f"physical step: duration is {duration!r}: give a pseudo-time above 0")
        everything = (duration / self._seconds) * np.concatenate([given, self._extension(given)])
        kept = _kept(self._world.elastic_gradients(0), self.options.keep_strain)
        self._world.set_motion(0, velocities=everything, gradients=kept)
        self._world.advance(self._seconds, stop)

    def place(self, points: NDArray[np.floating]) -> None:
        """Put the points at (N, 3) world metres, without physics; filling particles go along with their neighbours."""
        given = np.asarray(points, dtype=np.float64)
        if given.shape != (self._count, 3) or not np.isfinite(given).all():
            raise InputError(f"physical body: points have shape {given.shape}: give finite ({self._count}, 3)")
        now = self.particles
        way = given - now[: self._count]
        positions = now + np.concatenate([way, self._extension(way)])
        self._world.set_motion(0, velocities=np.zeros_like(positions), positions=positions)

    def move_obstacles(self, obstacles: Sequence[Collider]) -> None:
        """Let these be the obstacles from now on. Their tracks begin at time 0 now and count in steps.

        A collider whose ``surface`` is the very one that was there before keeps its distances; of a new one the side on
        which the body has to leave is found anew, from the body as it is now.
        """
        positions, gradients = self.particles, self._world.elastic_gradients(0)
        self._solid = None
        self._world = self._new_world(obstacles, positions)
        self._world.set_motion(0, velocities=np.zeros_like(positions), gradients=gradients)

    # ---- making the world ---------------------------------------------------------------------------------------

    def _new_world(self, obstacles: Sequence[Collider], positions: Array) -> World:
        options = self.options
        solver = dataclasses.replace(
            options.solver,
            grid=GRID,
            cfl_elastic=SolverOptions().cfl_elastic,
            cfl_velocity=SolverOptions().cfl_velocity,
            max_step=self._seconds / options.substeps,
        )
        self._obstacles = tuple(self._with_lattice(collider, positions) for collider in obstacles)
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
        """Stiffness by dimension: E = ρ c² (1 + ν)(1 − 2ν)/(1 − ν) with c = ``wave_cells`` cells in Δt."""
        nu = self.options.poisson_ratio
        speed = self.options.wave_cells * self.cell * self.options.substeps / self._seconds
        modulus = DENSITY * speed**2 * (1 + nu) * (1 - 2 * nu) / (1 - nu)
        return ElasticMaterial(density=DENSITY, youngs_modulus=modulus, poisson_ratio=nu)

    def _in_seconds(self, collider: Collider) -> Collider:
        return dataclasses.replace(
            collider,
            translations=_slowed(collider.translations, self._seconds),
            rotations=_slowed(collider.rotations, self._seconds),
            vertices=_slowed(collider.vertices, self._seconds),
        )

    def _with_lattice(self, collider: Collider, positions: Array) -> Collider:
        collider = self._in_seconds(collider)
        if collider.lattice is not None or collider.vertices is not None:
            return collider
        for surface, lattice in self._lattices:
            if surface is collider.surface:
                return dataclasses.replace(collider, lattice=lattice)
        # The lattice is of the surface at rest, so the body is looked at from there.
        moved = collider.translations is not None or collider.rotations is not None
        known = None if moved else self._solid
        solid = known or solid_of_points(_from_rest(collider, positions))
        lattice = obstacle_lattice(collider.surface, solid, exit_side=self.options.exit_side)
        self._lattices = [*self._lattices[-7:], (collider.surface, lattice)]
        return dataclasses.replace(collider, lattice=lattice)


def _slowed(track: Track | None, seconds: float) -> Track | None:
    """The track with times in steps of ``seconds`` as one in seconds."""
    return None if track is None else Track(times=track.times * seconds, values=track.values)


def _from_rest(collider: Collider, positions: Array) -> Array:
    """World places as they are seen from the collider's surface at rest, when its tracks begin."""
    local = positions - collider.middle
    if collider.translations is not None:
        local = local - collider.translations.at(0.0)
    if collider.rotations is not None:
        local = Rotation.from_rotvec(collider.rotations.at(0.0)).inv().apply(local)
    return np.asarray(local + collider.middle)


def _kept(gradients: Array, share: float) -> Array:
    """Gradients (M, 3, 3) with the ``share`` of their strain ln V, held within ``LEAST_STRETCH`` and ``MOST_STRETCH``.

    Those that change lose their rotation, too: stress of an isotropic body depends on V = (F Fᵀ)^½ alone.
    """
    if share == 0:
        return np.broadcast_to(np.eye(3), gradients.shape).copy()
    kept = gradients.copy()
    squares = gradients @ gradients.transpose(0, 2, 1)
    # By Gershgorin's theorem the squares of the stretches lie within the off-diagonal sums around the diagonal.
    diagonal = np.diagonal(squares, axis1=1, axis2=2)
    beside = np.abs(squares).sum(axis=2) - diagonal
    held = ((diagonal + beside < MOST_STRETCH**2) & (diagonal - beside > LEAST_STRETCH**2)).all(axis=1)
    which = np.flatnonzero(~held) if share == 1 else np.arange(len(gradients))
    values, axes = np.linalg.eigh(squares[which])
    stretches = np.clip(np.maximum(values, 1e-12) ** (0.5 * share), LEAST_STRETCH, MOST_STRETCH)
    kept[which] = (axes * stretches[:, None, :]) @ axes.transpose(0, 2, 1)
    return kept
