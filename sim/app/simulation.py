# SPDX-License-Identifier: MIT
"""From a scene to a world of particles: what resolution it gets, and how the engine's bodies map to its objects."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..events import StageProgress
from ..mpm.bodies import BodyParticles
from ..mpm.materials import (
    ElasticMaterial,
    FluidMaterial,
    NeoHookeanMaterial,
    SandMaterial,
    SnowMaterial,
    VonMisesMaterial,
)
from ..mpm.options import PADDING_CELLS, SolverOptions
from ..mpm.placement import fit_similarity
from ..mpm.sampling import sample_interior
from ..mpm.world import World
from ..scene.folder import SceneFolder
from ..scene.meshes import ObjectMesh
from ..scene.model import Material, Scene, SceneObject
from ..scene.units import Similarity
from .bake_inputs import BakeOptions
from .quality import Quality, load_quality

ENGINE_NAME = "mls-mpm"
MAX_PARTICLE_STEPS = 2e12
"""More is refused: at 10 million particle steps a second, which a laptop does, about two days."""

GRIDS = (128, 256, 512, 1024)
"""Grid sizes tried, in this order, until the scene and its motion fit at the wanted cell size."""


@dataclass(frozen=True)
class Simulation:
    """A world ready to run.

    body_of_object: for each object of the scene its body in ``world``, None for what stands still.
    rest_positions: for each object its particles (N, 3) at rest in world metres, or None.
    """

    world: World
    body_of_object: tuple[int | None, ...]
    rest_positions: tuple[NDArray[np.float64] | None, ...]

    @property
    def particle_count(self) -> int:
        """Particles of all bodies."""
        return sum(body.count for body in self.world.bodies)

    @property
    def engine_name(self) -> str:
        """Engine and where it runs, as the manifest names them."""
        return f"{ENGINE_NAME}/{self.world.arch}"

    def metrics(self) -> dict[str, Any]:
        """Of the present state: energies in J, momentum in kg m/s, gap to the ground in m (below 0 under it)."""
        energy = self.world.energy()
        bodies = range(len(self.world.bodies))
        return {
            "time_s": self.world.time,
            "substeps": self.world.substeps,
            "kinetic_j": energy.kinetic,
            "elastic_j": energy.elastic,
            "potential_j": energy.potential,
            "momentum": [float(c) for c in self.world.linear_momentum()],
            "ground_gap_m": min(self.world.ground_gap(i) for i in bodies),
            "outside": sum(self.world.particles_outside(i) for i in bodies),
        }


def build_world(
    folder: SceneFolder, meshes: Sequence[ObjectMesh], options: BakeOptions, progress: StageProgress
) -> Simulation:
    """Particles in every dynamic object of the scene, in a world that has room for their motion.

    Raises InputError for what this version's engine does not simulate, for meshes that are not closed, and for a
    scene in which nothing moves.
    """
    scene = folder.scene
    _refuse_unsupported(scene)
    moving = [i for i, item in enumerate(scene.objects) if item.role == "dynamic"]
    if not moving:
        raise InputError("objects: none has the role 'dynamic', so nothing would move")
    if len(moving) < len(scene.objects):
        progress.notice("objects of role 'collider' stand still; this version collides with the ground only")
    quality = load_quality(options.quality)
    solver, similarity = _resolution(
        scene, [meshes[i] for i in moving], [scene.objects[i] for i in moving], quality, options
    )
    bodies = [_body(scene.objects[i], meshes[i], solver, similarity, options.seed) for i in moving]
    world = World(bodies=bodies, ground=scene.ground, gravity=scene.gravity, similarity=similarity, options=solver)
    if world.arch != options.arch:
        progress.notice(f"{options.arch} is not available here; simulating on {world.arch}")
    count = sum(body.count for body in bodies)
    steps = (options.frames - 1) / options.fps / world.stable_step
    if steps * count > MAX_PARTICLE_STEPS:
        raise InputError(
            f"this would take about {steps:.2g} time steps of {count} particles, days of computing: lower the velocity "
            "or Young's modulus, raise the density, bake fewer frames, or choose a coarser quality"
        )
    cell_mm = solver.cell_size(similarity) * 1000
    progress.notice(f"{count} particles, cells of {cell_mm:.2g} mm, time steps of {world.stable_step * 1e6:.0f} µs")
    index = {scene_index: body_index for body_index, scene_index in enumerate(moving)}
    return Simulation(
        world=world,
        body_of_object=tuple(index.get(i) for i in range(len(scene.objects))),
        rest_positions=tuple(bodies[index[i]].positions if i in index else None for i in range(len(scene.objects))),
    )


def _refuse_unsupported(scene: Scene) -> None:
    """What the scene format can say and this engine cannot do is refused, never silently left out."""
    if scene.effects:
        raise InputError(
            f"effects: {scene.effects[0].name!r} is not simulated by this version; remove it from scene.json"
        )
    for item in scene.objects:
        if not item.fill and item.role == "dynamic":
            raise InputError(
                f"object {item.name}: fill is false, but this version simulates filled bodies only; set it to true"
            )


def _body(
    item: SceneObject, mesh: ObjectMesh, solver: SolverOptions, similarity: Similarity, seed: int
) -> BodyParticles:
    try:
        sample = sample_interior(mesh.vertices, mesh.faces, solver.particle_spacing(similarity), seed=seed)
    except InputError as error:
        raise InputError(f"object {item.name}: {error}") from None
    return BodyParticles(
        name=item.name,
        positions=sample.positions,
        volumes=sample.volumes,
        contact_radii=sample.contact_radii,
        material=engine_material(item.material),
        velocity=item.velocity,
        spin=item.spin,
    )


def engine_material(material: Material) -> ElasticMaterial:
    """The engine's class for the material's law, with the numbers that count under it."""
    m = material
    if m.law == "fluid":
        return FluidMaterial(density=m.density, bulk_modulus=m.bulk_modulus, viscosity=m.viscosity)
    solid: dict[str, Any] = {
        "density": m.density,
        "youngs_modulus": m.youngs_modulus,
        "poisson_ratio": m.poisson_ratio,
        "damping_time": m.damping_time,
    }
    if m.law == "neo_hookean":
        return NeoHookeanMaterial(**solid)
    if m.law == "von_mises":
        return VonMisesMaterial(**solid, yield_stress=m.yield_stress)
    if m.law == "snow":
        return SnowMaterial(
            **solid,
            critical_compression=m.critical_compression,
            critical_stretch=m.critical_stretch,
            hardening=m.hardening,
        )
    if m.law == "sand":
        return SandMaterial(**solid, friction_angle=m.friction_angle)
    return ElasticMaterial(**solid)


def _resolution(
    scene: Scene, meshes: Sequence[ObjectMesh], items: Sequence[SceneObject], quality: Quality, options: BakeOptions
) -> tuple[SolverOptions, Similarity]:
    """The smallest grid whose cells are as fine as the quality wants and whose box holds the motion."""
    lengths = [float(np.ptp(mesh.vertices, axis=0).max()) for mesh in meshes]
    volume = sum(abs(_volume(mesh)) for mesh in meshes)
    wanted = (max(volume, 1e-18) * quality.particles_per_cell / quality.particles) ** (1 / 3)
    cell = min(wanted, min(lengths) / quality.smallest_cells)
    # A throw beyond what the largest box holds ends at its walls; it never makes the cells coarser.
    largest = 0.4 * (GRIDS[-1] - 2 * PADDING_CELLS) * cell
    margin = min(largest, max([*lengths, *(_reach(scene, item, options) for item in items)]))
    points = [mesh.vertices for mesh in meshes]
    low, high = np.concatenate(points).min(axis=0), np.concatenate(points).max(axis=0)
    room = float((high - low).max()) + 2 * margin
    for grid in [quality.grid] if quality.grid else GRIDS:
        solver = SolverOptions(grid=grid, particles_per_cell=quality.particles_per_cell, arch=options.arch)
        if (grid - 2 * PADDING_CELLS) * cell >= room or grid == (quality.grid or GRIDS[-1]):
            break
    # ``fit_similarity`` makes cells coarser where even the largest grid has no room at the wanted size.
    fitted = fit_similarity(
        points, scene.ground, motion_margin=margin, cells_across=max(lengths) / cell, options=solver
    )
    return solver, fitted


def _volume(mesh: ObjectMesh) -> float:
    """Signed volume in m³ of a closed mesh."""
    a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
    return float(np.einsum("ti,ti->", a, np.cross(b, c)) / 6.0)


def _reach(scene: Scene, item: SceneObject, options: BakeOptions) -> float:
    """How far in metres an object may get from where it starts: up its throw, along its flight and the slide after."""
    speed = math.hypot(*item.velocity)
    gravity = math.hypot(*scene.gravity)
    duration = options.frames / options.fps
    if gravity < 1e-6:
        return speed * duration
    up = speed**2 / (2 * gravity)
    flight = 2 * speed / gravity
    slide = speed / (max(scene.ground.friction, 0.1) * gravity)
    return max(up, speed * min(duration, flight + slide))
