# SPDX-License-Identifier: MIT
"""A running world and how its bodies map to the objects of its scene."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..events import StageProgress
from ..mpm.world import World
from .scene_bodies import engine_material
from .scene_to_world import PreparedWorld, cost_text, steps_text
from .scene_to_world_checks import vertices_at

__all__ = ["ENGINE_NAME", "Simulation", "build_world", "engine_material"]

ENGINE_NAME = "mls-mpm"


@dataclass(frozen=True)
class Simulation:
    """A world ready to run.

    prepared: what it was made from.
    rest_positions: for each object its particles (N, 3) at rest in world metres, or None.
    """

    world: World
    prepared: PreparedWorld
    rest_positions: tuple[NDArray[np.float64] | None, ...]

    @property
    def body_of_object(self) -> tuple[int | None, ...]:
        """Return for each object of the scene its body in ``world``, None for colliders."""
        return self.prepared.body_of_object

    @property
    def particle_count(self) -> int:
        """Return the number of particles of all bodies."""
        return self.prepared.particle_count

    @property
    def engine_name(self) -> str:
        """Return the engine and where it runs, as the manifest names them."""
        return f"{ENGINE_NAME}/{self.world.arch}"

    def collider_vertices(self, slot: int) -> NDArray[np.float64] | None:
        """Return the vertices (V, 3) of the moving collider that object ``slot`` is, world metres; None for others."""
        index = self.prepared.collider_of_object[slot]
        if index is None or not self.prepared.setup.colliders[index].moves:
            return None
        return vertices_at(self.prepared.setup.colliders[index], self.world.time)

    def metrics(self) -> dict[str, Any]:
        """Return the present metrics: energies in J, momentum in kg m/s, gap to the ground in m.

        The gap is below 0 under the ground, and None without one.
        """
        energy = self.world.energy()
        bodies = range(len(self.world.bodies))
        return {
            "time_s": self.world.time,
            "substeps": self.world.substeps,
            "kinetic_j": energy.kinetic,
            "elastic_j": energy.elastic,
            "potential_j": energy.potential,
            "momentum": [float(c) for c in self.world.linear_momentum()],
            "ground_gap_m": None if self.world.setup.ground is None else min(map(self.world.ground_gap, bodies)),
            "outside": sum(self.world.particles_outside(i) for i in bodies),
        }


def build_world(prepared: PreparedWorld, arch: str, progress: StageProgress) -> Simulation:
    """Return the prepared world, ready to run on ``arch``, after saying what it will cost and what is odd about it.

    Raises InputError for a bake that would take too long or too much memory.
    """
    for warning in prepared.warnings:
        progress.notice(warning)
    prepared.require_affordable()
    progress.notice(cost_text(prepared))
    steps = steps_text(prepared)
    if steps is not None:
        progress.notice(steps)
    simulation = start_world(prepared)
    asleep = [body.name for i, body in enumerate(simulation.world.bodies) if simulation.world.asleep(i)]
    if asleep:
        progress.notice(
            f"at rest until something touches them: {', '.join(asleep)} (--set {asleep[0]}.asleep=false lets it go)"
        )
    found = simulation.world.arch
    if found != arch:
        prepared = prepared.on(found)
        prepared.require_affordable()
        progress.notice(f"{arch} is not available here; simulating on {found}, {cost_text(prepared)}")
        simulation = dataclasses.replace(simulation, prepared=prepared)
    return simulation


def start_world(prepared: PreparedWorld) -> Simulation:
    """Return the world that ``prepared`` describes, ready to run."""
    setup = prepared.setup
    world = World(
        bodies=setup.bodies,
        ground=setup.ground,
        gravity=setup.gravity,
        gravity_track=setup.gravity_track,
        colliders=setup.colliders,
        contacts=setup.contacts,
        similarity=prepared.similarity,
        options=prepared.solver,
    )
    return Simulation(
        world=world,
        prepared=prepared,
        rest_positions=tuple(None if i is None else setup.bodies[i].positions for i in prepared.body_of_object),
    )
