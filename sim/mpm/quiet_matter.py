# SPDX-License-Identifier: MIT
"""When stiff matter may take implicit steps: while it is quiet, and where they cost clearly less than explicit ones.

An impact is over in a few passages of a wave through the body, whatever its stiffness: explicit steps, whose length
follows the wave, resolve it in a number of steps that does not depend on the stiffness, and give the rebound. Between
impacts stiff matter flies, slides or rests as if it were rigid, its waves are too small and too fast to be seen, and an
implicit step (``implicit``) may be as long as the motion allows. So a world takes explicit steps in bursts while
anything is going on, and implicit ones in between; whether it does depends on its present state alone.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..events import IsCancelled
from ..rigid_alignment import nearest_pose
from .engine import Diverged, Engine, Stopped
from .implicit import rigid_part
from .implicit_choice import PAYS, longest_step, why_explicit
from .kernels import layout
from .packing import WorldSlot

logger = logging.getLogger(__name__)

Array = NDArray[np.float64]

BURST = 64
"""Explicit substeps that are taken at a time where matter is not quiet: some three passages of a wave through a body
of eight cells."""

FARTHEST = 0.4
"""Cells that matter may move in an implicit step."""

DRIFT = 0.9
"""Cells that particles may move between two sorts."""

MOST_BENT = 0.05
"""Cells, r.m.s., by which a quiet body may differ in shape from its rest: what an implicit step may damp."""

MOST_LOAD = 2.0
"""Force of surfaces over the weight of a quiet body at most: more is an impact."""


def new_quiet_matter(places: Sequence[WorldSlot], offsets: NDArray[np.int64], arch: str) -> QuietMatter | None:
    """What chooses implicit steps for the worlds ``places``, None where these are not possible; the log says why."""
    reason = why_explicit(places[0].setup) if len(places) == 1 else "there are several worlds"
    if arch != "cpu":
        reason = f"{arch} computes"
    if reason is not None:
        logger.info("explicit steps only: %s", reason)
        return None
    return QuietMatter(places[0], offsets)


class QuietMatter:
    """Steps of the world ``place``, the only one of its engine, explicit or implicit as its state asks."""

    def __init__(self, place: WorldSlot, offsets: NDArray[np.int64]) -> None:
        """offsets: number of the first particle of each body, and of all."""
        self._offsets = offsets
        self._rest = [place.cells.points_to_engine(body.positions) for body in place.setup.bodies]
        self._gravity = np.asarray(place.setup.gravity_at(0.0)) * place.cells.scale
        self._pull = float(np.linalg.norm(self._gravity))
        self._collider_speed = 0.0
        self.steps = self.passes = 0
        """Implicit steps so far, and the passes over all particles that they took."""

    def advance(self, engine: Engine, duration: float, longest_step: float, stop: IsCancelled, most_hit: float) -> None:
        """Advance ``engine`` by ``duration`` s as ``Engine.advance`` does.

        most_hit: speed in cells/s below which matter that comes to a surface need not bounce.
        """
        if engine.rigid_bodies.count:
            if engine.rigid_bodies.awake():
                engine.advance(np.array([duration]), longest_step=np.array([longest_step]), stop=stop)
                return
            self._collider_speed = engine.rigid_bodies.collider_speed()
        left = duration
        while left > 0:
            wasted = 0
            explicit = min(float(engine.stable_steps()[0]), longest_step)
            implicit = self._longest(engine, most_hit)
            if implicit > PAYS * explicit and left > PAYS * explicit and self._quiet(engine, most_hit):
                left, wasted = self._advance_implicitly(engine, left, explicit, most_hit, stop)
            if left > 0:
                burst = max(BURST, 2 * wasted) * explicit
                burst = left if left < 1.5 * burst else burst
                try:
                    engine.advance(np.array([burst]), longest_step=np.array([longest_step]), stop=stop)
                except Diverged:
                    engine.add_elapsed(duration - left)
                    raise
                left = 0.0 if burst == left else left - burst

    def _longest(self, engine: Engine, most_hit: float) -> float:
        """Longest implicit step in s that the motion allows."""
        speed = max(float(engine.worlds.control()[0, layout.SPEED]), self._collider_speed)
        step = longest_step(most_hit, self._pull)
        # The speed at the end of the step, falling.
        return min(step, FARTHEST / max(speed + self._pull * step, 1e-12))

    def _quiet(self, engine: Engine, most_hit: float) -> bool:
        """Whether every body is."""
        ids, x = engine.places()
        v, a, constants = (engine.particles.values(name).astype(np.float64) for name in ("v", "reaction", "constants"))
        for i, rest in enumerate(self._rest):
            mine = (ids >= self._offsets[i]) & (ids < self._offsets[i + 1])
            if mine.any():
                at_rest = rest[ids[mine] - self._offsets[i]]
                if not self._is_quiet(x[mine], v[mine], a[mine, :3], constants[mine, :1], at_rest, most_hit):
                    return False
        return True

    def _is_quiet(self, x: Array, v: Array, a: Array, m: Array, rest: Array, most_hit: float) -> bool:
        """Whether a body is: particles at ``x`` (n, 3) with velocities, contact accelerations, masses (n, 1), which are
        at ``rest`` where nothing acts."""
        rotation, translation = nearest_pose(rest, x)
        bent = x - rest @ rotation.T - translation
        if float(np.sqrt((bent**2).sum(axis=1).mean())) > MOST_BENT:
            return False
        load = float(np.linalg.norm((m * a).sum(axis=0)))
        if load > MOST_LOAD * float(m.sum()) * self._pull:
            return False
        if load == 0.0:
            return True
        deforming = v - rigid_part(m, x, v).at(x)
        return math.sqrt(float((m * deforming**2).sum() / m.sum())) < most_hit

    def _advance_implicitly(
        self, engine: Engine, left: float, explicit: float, most_hit: float, stop: IsCancelled
    ) -> tuple[float, int]:
        """Take implicit steps while they can be had and pay; the seconds that are left, and the passes over the
        particles of a step that did not pay."""
        drift, wasted = math.inf, 0
        while left > 0:
            if stop():
                raise Stopped
            longest = self._longest(engine, most_hit)
            dt = left / math.ceil(left / longest - 1e-6)
            # In a step of gravity alone.
            ahead = (float(engine.worlds.control()[0, layout.SPEED]) + self._pull * dt + self._collider_speed) * dt
            if drift + ahead > DRIFT:
                engine.begin_implicit()
                drift = 0.0
                if engine.bodies_meet:
                    break
            report = engine.implicit_step(dt, self._gravity, most_hit)
            self.passes += report.passes
            if not report.done:
                wasted = report.passes
                break
            self.steps += 1
            drift += report.farthest + self._collider_speed * dt
            left = left - dt if left > 1.5 * dt else 0.0
            if report.passes * explicit > dt:
                wasted = report.passes
                break
        return left, wasted
