# SPDX-License-Identifier: MIT
"""One world of bodies, or many that advance together, in metres, kilograms and seconds.

similarity = fit_similarity([vertices], options=options)
sample = sample_interior(vertices, faces, options.particle_spacing(similarity))
world = World(bodies=[BodyParticles(...)], ground=ground, similarity=similarity, options=options)
world.advance(1 / 24)
world.positions(0)

worlds = Worlds([setup, dataclasses.replace(setup, gravity=(0, 0, -1.62))], similarity=similarity, options=options)
worlds.advance(1 / 24)
worlds[1].positions(0)
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..events import IsCancelled, never
from ..scene.units import Similarity
from . import packing
from .bodies import BodyParticles, Vector
from .colliders import Collider, Track
from .solver_options import Ground, SolverOptions, fit_similarity
from .surface_contact import ContactTable
from .world_group import WorldGroup
from .world_setup import STANDARD_GRAVITY, WorldSetup
from .world_view import WorldView

State = dict[str, NDArray[np.generic]]


class Worlds:
    """Copies of a scene, or different scenes, that advance in the same launches.

    setups: what each world holds.
    similarity: where the worlds stand in the engine's box; None fits it to the bodies of the first.
    options: of the solver, for all of them.

    Every world takes its own substeps and gives the same bytes as it would alone. Therefore worlds share launches only
    with those of the same set of constitutive models (damping and fibres count): another set is another compiled
    kernel, which rounds differently. Deterministic on the CPU. Raises InputError when a body starts too far
    off or too deep in the ground.
    """

    def __init__(
        self,
        setups: Sequence[WorldSetup],
        *,
        similarity: Similarity | None = None,
        options: SolverOptions | None = None,
    ) -> None:
        if not setups:
            raise InputError("setups is empty: give at least one world")
        self.setups = tuple(setups)
        self.options = options or SolverOptions()
        self.similarity = similarity or fit_similarity(
            [body.positions for body in self.setups[0].bodies], options=self.options
        )
        cell = self.options.cell_size(self.similarity)
        members: dict[tuple[int, bool], list[int]] = {}
        for number, setup in enumerate(self.setups):
            members.setdefault((packing.laws_of(setup), packing.has_thin(setup, 1.0 / cell)), []).append(number)
        self._members = tuple(members.values())
        self._groups = tuple(
            WorldGroup(
                [self.setups[n] for n in numbers],
                numbers=numbers if len(self.setups) > 1 else [None],
                similarity=self.similarity,
                options=self.options,
            )
            for numbers in self._members
        )
        self._place = {
            number: (group, index)
            for group, numbers in zip(self._groups, self._members, strict=True)
            for index, number in enumerate(numbers)
        }

    def __len__(self) -> int:
        return len(self.setups)

    def __getitem__(self, index: int) -> WorldView:
        """World ``index``, to look at."""
        group, place = self._place[range(len(self))[index]]
        return WorldView(group, place)

    @property
    def cells(self) -> Similarity:
        """The map from world metres to cells."""
        return self._groups[0].cells

    @property
    def arch(self) -> str:
        """Where the engine computes: "cpu", "cuda" or "vulkan"."""
        return self._groups[0].arch

    @property
    def device_bytes(self) -> int:
        """Bytes that the engine's arrays take on the device."""
        return sum(group.device_bytes for group in self._groups)

    @property
    def retries(self) -> int:
        """Stretches of substeps that were repeated with shorter steps because they had diverged."""
        return sum(group.retries for group in self._groups)

    def time(self, world: int = 0) -> float:
        """Simulated time in s of world ``world``."""
        return self[world].time

    def advance(self, duration: float, stop: IsCancelled = never) -> None:
        """Advance all worlds by exactly ``duration`` seconds, in substeps that are stable.

        stop: called between launches of a few substeps, so it must be cheap. When it returns True, Cancelled is raised
            and the state is between two times: only ``restore`` works then.
        Raises SimulationError that names the body when a world diverges and shorter substeps do not help; the others
        are then at their own ``time``, before or at the end.
        """
        if not (math.isfinite(duration) and duration >= 0):
            raise InputError(f"duration is {duration!r}: give seconds, 0 or more")
        for group in self._groups:
            group.advance(duration, stop)

    def set_motion(
        self,
        world: int,
        index: int,
        *,
        velocities: NDArray[np.float64],
        velocity_gradients: NDArray[np.float64] | None = None,
        positions: NDArray[np.float64] | None = None,
        gradients: NDArray[np.float64] | None = None,
    ) -> None:
        """``World.set_motion`` of world ``world``."""
        group, place = self._place[range(len(self))[world]]
        group.set_motion(
            place,
            index,
            velocities=velocities,
            velocity_gradients=velocity_gradients,
            positions=positions,
            gradients=gradients,
        )

    def checkpoint(self) -> State:
        """Everything needed to continue, as arrays for ``numpy.savez``; a restored run continues with equal bytes."""
        if len(self._groups) == 1:
            return self._groups[0].checkpoint()
        return {
            f"{i}/{name}": values for i, group in enumerate(self._groups) for name, values in group.checkpoint().items()
        }

    def restore(self, checkpoint: Mapping[str, NDArray[np.generic]]) -> None:
        """Restore a state that ``checkpoint`` returned in worlds of the same setups, similarity and grid.

        Raises InputError for one of other worlds; it changes nothing then but in groups before the one that differs.
        """
        if len(self._groups) == 1:
            self._groups[0].restore(checkpoint)
            return
        for i, group in enumerate(self._groups):
            own = f"{i}/"
            group.restore({name.removeprefix(own): checkpoint[name] for name in checkpoint if name.startswith(own)})


class World(WorldView):
    """One world, advanced in time.

    The arguments are those of ``WorldSetup``, besides similarity: where the world stands in the engine's box (None fits
    it to the bodies), and options: of the solver.

    Deterministic on the CPU: equal input gives equal bytes. Raises InputError when a body stands too deep in
    the ground.

    >>> import physgen
    >>> world = physgen.World(bodies=bodies)  # of sim.mpm.bodies.BodyParticles  # doctest: +SKIP
    >>> world.advance(1 / 24)  # seconds  # doctest: +SKIP
    >>> world.positions(0).shape  # world metres  # doctest: +SKIP
    (4096, 3)
    """

    def __init__(
        self,
        *,
        bodies: Sequence[BodyParticles],
        ground: Ground | None = None,
        gravity: Vector = STANDARD_GRAVITY,
        gravity_track: Track | None = None,
        colliders: Sequence[Collider] = (),
        contacts: ContactTable | None = None,
        similarity: Similarity | None = None,
        options: SolverOptions | None = None,
    ) -> None:
        setup = WorldSetup(
            bodies=tuple(bodies),
            ground=ground,
            gravity=gravity,
            gravity_track=gravity_track,
            colliders=tuple(colliders),
            contacts=contacts or ContactTable(),
        )
        self._worlds = Worlds([setup], similarity=similarity, options=options)
        first = self._worlds[0]
        super().__init__(first.group, first.index)

    @property
    def similarity(self) -> Similarity:
        """Where the world stands in the engine's box."""
        return self._worlds.similarity

    @property
    def options(self) -> SolverOptions:
        """Of the solver."""
        return self._worlds.options

    @property
    def arch(self) -> str:
        """Where the engine computes: "cpu", "cuda" or "vulkan"."""
        return self._worlds.arch

    @property
    def device_bytes(self) -> int:
        """Bytes that the engine's arrays take on the device."""
        return self._worlds.device_bytes

    @property
    def retries(self) -> int:
        """Stretches of substeps that were repeated with shorter steps because they had diverged."""
        return self._worlds.retries

    def advance(self, duration: float, stop: IsCancelled = never) -> None:
        """Advance by exactly ``duration`` seconds, in substeps that are stable.

        stop: called between launches of a few substeps, so it must be cheap. When it returns True, Cancelled is raised
            and the state is between two times: only ``restore`` works then.
        Raises SimulationError that names the body when the world diverges and shorter substeps do not help.
        """
        self._worlds.advance(duration, stop)

    def set_motion(
        self,
        index: int,
        *,
        velocities: NDArray[np.float64],
        velocity_gradients: NDArray[np.float64] | None = None,
        positions: NDArray[np.float64] | None = None,
        gradients: NDArray[np.float64] | None = None,
    ) -> None:
        """Set the motion of every particle of body ``index``, in the order in which the particles were given.

        velocities: (N, 3) m/s.
        velocity_gradients: (N, 3, 3) 1/s, the APIC velocity gradients; None sets them to 0, because those of the old
            motion do not belong to the new one.
        positions: (N, 3) world metres; None leaves the particles where they are.
        gradients: (N, 3, 3) elastic deformation gradients; None keeps them.

        Where positions are given, the impulses of contacts start anew from 0.
        Raises InputError on a wrong shape, on numbers that are not finite, and for a body that is rigid or has not
        started.
        """
        self._worlds.set_motion(
            0,
            index,
            velocities=velocities,
            velocity_gradients=velocity_gradients,
            positions=positions,
            gradients=gradients,
        )

    def checkpoint(self) -> dict[str, NDArray[np.generic]]:
        """Everything needed to continue, as arrays for ``numpy.savez``; a restored world continues with equal bytes."""
        return self._worlds.checkpoint()

    def restore(self, checkpoint: Mapping[str, NDArray[np.generic]]) -> None:
        """Restore a state that ``checkpoint`` returned in a world of the same bodies, similarity and grid."""
        self._worlds.restore(checkpoint)
