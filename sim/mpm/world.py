# SPDX-License-Identifier: MIT
"""The engine's facade: a world of bodies, in metres, kilograms and seconds.

similarity = fit_similarity([vertices], options=options)
sample = sample_interior(vertices, faces, options.particle_spacing(similarity))
world = World(bodies=[BodyParticles(...)], ground=ground, similarity=similarity, options=options)
world.advance(1 / 24)
world.positions(0)
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from ..events import IsCancelled, never
from ..scene.units import Similarity
from .bodies import BodyParticles, Vector
from .colliders import Collider
from .contacts import ContactTable
from .options import Ground, SolverOptions
from .setup import STANDARD_GRAVITY, WorldSetup
from .tracks import Track
from .view import WorldView
from .worlds import Worlds


class World(WorldView):
    """One world, advanced in time.

    The arguments are those of ``WorldSetup``, besides similarity: where the world stands in the engine's box (None fits
    it to the bodies), and options: of the solver.

    Deterministic on the CPU: equal input gives equal bytes. Raises InputError when a body stands too deep in
    the ground.
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
        """Stretches of substeps that were taken again with shorter steps because they had gone wrong."""
        return self._worlds.retries

    def advance(self, duration: float, stop: IsCancelled = never) -> None:
        """Advance by exactly ``duration`` seconds, in substeps that are stable.

        stop: asked between launches of a few substeps, so it must be cheap; asking changes nothing. When it says yes,
        Cancelled is raised, and the state is of no time: nothing but ``restore`` works then.
        Raises SimulationError that names the body when the world goes wrong and shorter substeps do not help.
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
        """Give every particle of body ``index`` a motion of its own, in the order in which they were given.

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
        """Take up a state that ``checkpoint`` returned in a world of the same bodies, similarity and grid."""
        self._worlds.restore(checkpoint)
