# SPDX-License-Identifier: MIT
"""Stability of two composed objects: both are released on a ground, under gravity (Taichi)."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ...constitutive import ElasticMaterial, RigidMaterial
from ...errors import InputError, SimulationError
from ...events import IsCancelled, never
from ...mpm.bodies import BodyParticles
from ...mpm.colliders import Collider, Surface
from ...mpm.geometry.interior_sampling import sample_interior
from ...mpm.solver_options import Ground, SolverOptions, fit_similarity
from ...mpm.surface_contact import ContactTable, SurfaceContact
from ...mpm.world import World
from ...rigid_alignment import nearest_pose
from ...skinning import bind, deform
from .penetration import penetration_of_meshes

Array = NDArray[np.float64]

DEFAULT_MATERIAL = RigidMaterial(density=1000.0)

MAX_SLIP = 0.1
"""Fraction of the pair's size by which the foreground may move on the background."""

CONTACT_CELLS = 1.5
"""Grid cells within which surfaces count as in contact."""

TOPPLED_DEGREES = 45.0
"""Tilt from which a background counts as fallen over, which is only noted."""

CHECKS_PER_SECOND = 8
"""Times per simulated second at which the run may be stopped."""


@dataclass(frozen=True, kw_only=True)
class StabilityOptions:
    """Options of ``check_stability``. Raises InputError on a value out of range."""

    seconds: float = 1.0
    """Simulated time, above 0, up to 60."""

    gravity: float = 9.81
    """m/s², downwards along z; 0 to 1000."""

    friction: float = 0.5
    """Coulomb's coefficient of all surfaces, 0 to 10."""

    background: ElasticMaterial | RigidMaterial = DEFAULT_MATERIAL
    """Material of the background."""

    foreground: ElasticMaterial | RigidMaterial = DEFAULT_MATERIAL
    """Material of the foreground."""

    background_fixed: bool = False
    """Whether the background is held in place, as a finger by its hand; else it stands on the ground."""

    cells_across: int = 32
    """Grid cells along the longest side of the larger object, 8 to 128."""

    solver: SolverOptions = field(default_factory=SolverOptions)
    """Where to compute (arch, threads, cache_folder)."""

    def __post_init__(self) -> None:
        for name, least, most in (("seconds", 1e-3, 60.0), ("gravity", 0.0, 1e3), ("friction", 0.0, 10.0)):
            value = getattr(self, name)
            if not (math.isfinite(value) and least <= value <= most):
                raise InputError(f"pair stability: {name} is {value!r}: give {least:g} to {most:g}")
        if not (isinstance(self.cells_across, int) and 8 <= self.cells_across <= 128):
            raise InputError(f"pair stability: cells_across is {self.cells_across!r}: give 8 to 128")
        if self.background_fixed and not isinstance(self.background, RigidMaterial):
            raise InputError("pair stability: background_fixed needs a rigid background: make it rigid")


@dataclass(frozen=True, kw_only=True)
class PairStability:
    """Result of ``check_stability``."""

    stays: bool
    """Whether the foreground moved by less than a tenth of the pair's size on the background and still touches it."""

    slip: float
    """Displacement in metres of the foreground's centre of mass in the frame of the background's best rigid fit; NaN
    where the simulation failed."""

    size: float
    """Longest side of the pair's initial bounding box, metres."""

    gap: float
    """Final gap in metres; 0 where they touch; NaN where the simulation failed."""

    notes: tuple[str, ...] = ()
    """Further observations, one sentence each."""


def check_stability(
    background: Surface, foreground: Surface, *, options: StabilityOptions | None = None, stop: IsCancelled = never
) -> PairStability:
    """Return whether two closed meshes stay together, released under gravity on a ground at the pair's lowest point.

    Resolve penetration first: the engine only corrects small depths gently. Raises InputError where a mesh is open or
    too thin for the grid, Cancelled when ``stop`` returns True.
    """
    options = options or StabilityOptions()
    every = np.concatenate([background.vertices, foreground.vertices])
    size = float(np.ptp(every, axis=0).max())
    solver = SolverOptions(
        arch=options.solver.arch, threads=options.solver.threads, cache_folder=options.solver.cache_folder
    )
    similarity = fit_similarity([every], cells_across=options.cells_across, options=solver)
    cell = solver.cell_size(similarity)
    spacing = solver.particle_spacing(similarity)
    bodies = [_body_particles("foreground", foreground, options.foreground, spacing)]
    colliders = (Collider(name="background", surface=background),) if options.background_fixed else ()
    if not options.background_fixed:
        bodies.append(_body_particles("background", background, options.background, spacing))
    ground = Ground(point=(0.0, 0.0, float(every[:, 2].min())), friction=options.friction)
    world = World(
        bodies=bodies,
        colliders=colliders,
        gravity=(0.0, 0.0, -options.gravity),
        ground=ground,
        contacts=ContactTable(default=SurfaceContact(friction=options.friction)),
        similarity=similarity,
        options=solver,
    )
    rounds = max(1, round(CHECKS_PER_SECOND * options.seconds))
    try:
        for _ in range(rounds):
            world.advance(options.seconds / rounds, stop)
    except SimulationError as error:
        return PairStability(stays=False, slip=math.nan, size=size, gap=math.nan, notes=(str(error),))
    turn, shift, seen = np.eye(3), np.zeros(3), background
    if not options.background_fixed:
        turn, shift = nearest_pose(bodies[1].positions, world.positions(1), weights=bodies[1].masses)
        seen = _current_surface(world, 1, background)
    masses = bodies[0].masses
    start, end = (np.average(places, axis=0, weights=masses) for places in (bodies[0].positions, world.positions(0)))
    slip = float(np.linalg.norm((end - shift) @ turn - start))
    gap = penetration_of_meshes(_current_surface(world, 0, foreground), seen).apart
    notes = []
    if slip > MAX_SLIP * size:
        notes.append(f"the foreground moved by {1e3 * slip:.3g} mm, {100 * slip / size:.3g} % of the pair's size")
    if gap > CONTACT_CELLS * cell:
        notes.append(f"they no longer touch: {1e3 * gap:.3g} mm apart")
    tilt = math.degrees(math.acos(float(np.clip(turn[2, 2], -1.0, 1.0))))
    if tilt > TOPPLED_DEGREES:
        notes.append(f"the background fell over, by {tilt:.0f} degrees")
    stays = slip <= MAX_SLIP * size and gap <= CONTACT_CELLS * cell
    return PairStability(stays=stays, slip=slip, size=size, gap=gap, notes=tuple(notes))


def _body_particles(
    name: str, surface: Surface, material: ElasticMaterial | RigidMaterial, spacing: float
) -> BodyParticles:
    try:
        sample = sample_interior(surface.vertices, surface.faces, spacing)
    except InputError as error:
        raise InputError(f"pair stability: {name}: {error}") from None
    return BodyParticles(
        name=name,
        positions=sample.positions,
        volumes=sample.volumes,
        contact_radii=sample.contact_radii,
        material=material,
        surface=surface,
    )


def _current_surface(world: World, index: int, surface: Surface) -> Surface:
    """Return the body's current mesh: moved rigidly, or deformed with its particles."""
    body = world.bodies[index]
    if body.rigid:
        pose = world.pose(body.name)
        return Surface(vertices=surface.vertices @ pose.rotation.T + pose.translation, faces=surface.faces)
    carried = deform(bind(surface.vertices, body.positions), world.positions(index), world.deformation_gradients(index))
    return Surface(vertices=carried, faces=surface.faces)
