# SPDX-License-Identifier: MIT
"""Whether two objects that were fitted together stay together: both are let go on a ground, under gravity."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError, SimulationError
from ...events import IsCancelled, never
from ...mpm.bodies import BodyParticles
from ...mpm.colliders import Collider, Surface
from ...mpm.contacts import ContactTable, SurfaceContact
from ...mpm.materials import ElasticMaterial, RigidMaterial
from ...mpm.options import Ground, SolverOptions
from ...mpm.placement import fit_similarity
from ...mpm.sampling import sample_interior
from ...mpm.world import World
from ...skinning.binding import bind, deform
from .penetration import penetration_of_meshes

Array = NDArray[np.float64]

RIGID = RigidMaterial(density=1000.0)

MOST_SLIP = 0.1
"""Share of the pair's size by which the foreground may move on the background."""

TOUCHING = 1.5
"""Grid cells within which surfaces count as in contact."""

TOPPLED = 45.0
"""Degrees from which on a background counts as fallen over, which is said and no more."""

CHECKS = 8
"""Times in a second at which the run may be stopped."""


@dataclass(frozen=True, kw_only=True)
class HoldOptions:
    """How a pair is let go. Raises InputError on a value out of range."""

    seconds: float = 1.0
    """How long, in seconds, above 0, up to 60."""

    gravity: float = 9.81
    """m/s², downwards along z; 0 to 1000."""

    friction: float = 0.5
    """Coulomb's coefficient of all surfaces, 0 to 10."""

    background: ElasticMaterial | RigidMaterial = RIGID
    """What the background is made of."""

    foreground: ElasticMaterial | RigidMaterial = RIGID
    """What the foreground is made of."""

    background_fixed: bool = False
    """Whether the background is held where it is, as a finger is by its hand; else it stands on the ground."""

    cells_across: int = 32
    """Grid cells along the longest side of the larger object, 8 to 128."""

    solver: SolverOptions = field(default_factory=SolverOptions)
    """Where to compute (arch, threads, cache_folder)."""

    def __post_init__(self) -> None:
        for name, least, most in (("seconds", 1e-3, 60.0), ("gravity", 0.0, 1e3), ("friction", 0.0, 10.0)):
            value = getattr(self, name)
            if not (math.isfinite(value) and least <= value <= most):
                raise InputError(f"staying together: {name} is {value!r}: give {least:g} to {most:g}")
        if not (isinstance(self.cells_across, int) and 8 <= self.cells_across <= 128):
            raise InputError(f"staying together: cells_across is {self.cells_across!r}: give 8 to 128")
        if self.background_fixed and not isinstance(self.background, RigidMaterial):
            raise InputError("staying together: background_fixed is given for one that deforms: make it rigid")


@dataclass(frozen=True, kw_only=True)
class Together:
    """What became of a pair."""

    stays: bool
    """Whether the foreground moved by less than a tenth of the pair's size on the background and still touches it."""

    slip: float
    """Metres that the foreground's centre of mass moved against the background, seen from the background's best rigid
    fit; NaN where the run went wrong."""

    size: float
    """Longest side of the pair's bounding box at the start, metres."""

    gap: float
    """Metres between the two at the end; 0 where they touch; NaN where the run went wrong."""

    notes: tuple[str, ...] = ()
    """What else was seen, one sentence each."""


def stays_together(
    background: Surface, foreground: Surface, *, options: HoldOptions | None = None, stop: IsCancelled = never
) -> Together:
    """Let two closed meshes go under gravity on a ground at the pair's lowest point, and see whether they part.

    They must not be in each other by more than the engine pushes apart gently: resolve penetration first.
    Raises InputError where a mesh is open or too thin for the grid, Cancelled when ``stop`` says so.
    """
    options = options or HoldOptions()
    every = np.concatenate([background.vertices, foreground.vertices])
    size = float(np.ptp(every, axis=0).max())
    solver = SolverOptions(
        arch=options.solver.arch, threads=options.solver.threads, cache_folder=options.solver.cache_folder
    )
    similarity = fit_similarity([every], cells_across=options.cells_across, options=solver)
    cell = solver.cell_size(similarity)
    spacing = solver.particle_spacing(similarity)
    bodies = [_body("foreground", foreground, options.foreground, spacing)]
    colliders = (Collider(name="background", surface=background),) if options.background_fixed else ()
    if not options.background_fixed:
        bodies.append(_body("background", background, options.background, spacing))
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
    rounds = max(1, round(CHECKS * options.seconds))
    try:
        for _ in range(rounds):
            world.advance(options.seconds / rounds, stop)
    except SimulationError as error:
        return Together(stays=False, slip=math.nan, size=size, gap=math.nan, notes=(str(error),))
    turn, shift, seen = np.eye(3), np.zeros(3), background
    if not options.background_fixed:
        turn, shift = _rigid_fit(bodies[1].positions, world.positions(1), bodies[1].masses)
        seen = _surface_now(world, 1, background)
    masses = bodies[0].masses
    start, end = (np.average(places, axis=0, weights=masses) for places in (bodies[0].positions, world.positions(0)))
    slip = float(np.linalg.norm((end - shift) @ turn - start))
    gap = penetration_of_meshes(_surface_now(world, 0, foreground), seen).apart
    notes = []
    if slip > MOST_SLIP * size:
        notes.append(f"the foreground moved by {1e3 * slip:.3g} mm, {100 * slip / size:.3g} % of the pair's size")
    if gap > TOUCHING * cell:
        notes.append(f"they no longer touch: {1e3 * gap:.3g} mm apart")
    tilt = math.degrees(math.acos(float(np.clip(turn[2, 2], -1.0, 1.0))))
    if tilt > TOPPLED:
        notes.append(f"the background fell over, by {tilt:.0f} degrees")
    stays = slip <= MOST_SLIP * size and gap <= TOUCHING * cell
    return Together(stays=stays, slip=slip, size=size, gap=gap, notes=tuple(notes))


def _body(name: str, surface: Surface, material: ElasticMaterial | RigidMaterial, spacing: float) -> BodyParticles:
    try:
        sample = sample_interior(surface.vertices, surface.faces, spacing)
    except InputError as error:
        raise InputError(f"staying together: {name}: {error}") from None
    return BodyParticles(
        name=name,
        positions=sample.positions,
        volumes=sample.volumes,
        contact_radii=sample.contact_radii,
        material=material,
        surface=surface,
    )


def _surface_now(world: World, index: int, surface: Surface) -> Surface:
    """The body's mesh as it is now: turned with a rigid one, carried by the particles of one that deforms."""
    body = world.bodies[index]
    if body.rigid:
        pose = world.pose(body.name)
        return Surface(vertices=surface.vertices @ pose.rotation.T + pose.translation, faces=surface.faces)
    carried = deform(bind(surface.vertices, body.positions), world.positions(index), world.deformation_gradients(index))
    return Surface(vertices=carried, faces=surface.faces)


def _rigid_fit(rest: Array, now: Array, weights: Array) -> tuple[Array, Array]:
    """Rotation R (3, 3) and shift (3,) with now ≈ R rest + shift, by weighted least squares (Kabsch 1976)."""
    before, after = (np.average(places, axis=0, weights=weights) for places in (rest, now))
    u, _, vt = np.linalg.svd(((now - after) * weights[:, None]).T @ (rest - before))
    turn = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
    return turn, after - turn @ before
