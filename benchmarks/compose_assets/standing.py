# SPDX-License-Identifier: MIT
"""Whether compositions stand, in an engine that is not ours: MuJoCo, with the meshes' signed distances as shapes.

MuJoCo takes the convex hull of a mesh otherwise, which would fill every ring and bowl.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from physgen.sim.mpm.colliders import Surface

from .sdf import Array

SECONDS = 5.0
STEP_S = 0.002
CHECKS_PER_SECOND = 20
DENSITY, FRICTION = 1000.0, 0.5
"""kg/m³ and Coulomb's coefficient of every object, those of ``StabilityOptions``."""

GRIP = 10.0
"""MuJoCo impratio: sticking contacts creep less."""

OCTREE_DEPTH = 6
"""Of the distance field of a mesh: cells down to 1/64 of its size, trilinear within."""

SEARCHES = 200
"""MuJoCo sdf_initpoints: places from which it looks for contacts of two shapes. From its 40 it finds a few of those
around a ring, which then creeps from one to the next: a ring drifts twice as far in a second as with 200."""

WANTED_DRIFT, WANTED_DEPTH, WANTED_SHARE = 0.02, 0.005, 0.95


@dataclass(frozen=True, kw_only=True)
class Standing:
    """Result of dropping objects under gravity.

    drift: the largest distance that any object's centre of mass moved from its start, over the largest extent of all.
    depth: the deepest contact at any check, over the same. seconds: simulated; fewer than asked for once something has
    moved by more than that extent, which has fallen off.
    """

    drift: float
    depth: float
    seconds: float

    @property
    def stands(self) -> bool:
        """Whether both are within what is wanted."""
        return self.drift < WANTED_DRIFT and self.depth < WANTED_DEPTH


def drop(background: Surface, foregrounds: Sequence[Surface], *, held: bool, seconds: float = SECONDS) -> Standing:
    """Return what becomes of the closed meshes under gravity, as rigid bodies of one density.

    held: the background stays where it is, as a finger is held by its hand, and there is no ground unless a foreground
    stands on it, as a bowl does; else all are free above a ground at their lowest point. Needs MuJoCo.
    """
    # Imported here: the benchmark does without it unless it is asked whether compositions stand.
    import mujoco

    every = np.concatenate([item.vertices for item in (background, *foregrounds)])
    size = float(np.ptp(every, axis=0).max())
    spec = mujoco.MjSpec()
    spec.option.timestep = STEP_S
    spec.option.impratio = GRIP
    spec.option.sdf_initpoints = SEARCHES
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    friction = [FRICTION, 0.005, 0.0001]
    for index, surface in enumerate((background, *foregrounds)):
        name = f"object_{index}"
        mesh = spec.add_mesh(name=name)
        mesh.uservert = np.ascontiguousarray(surface.vertices, dtype=np.float64).ravel()
        mesh.userface = np.ascontiguousarray(surface.faces, dtype=np.int32).ravel()
        mesh.needsdf, mesh.octree_maxdepth = 1, OCTREE_DEPTH
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_EXACT
        body = spec.worldbody
        if index or not held:
            body = spec.worldbody.add_body(name=name)
            body.add_freejoint()
        body.add_geom(name=name, type=mujoco.mjtGeom.mjGEOM_SDF, meshname=name, density=DENSITY, friction=friction)
    lowest = float(every[:, 2].min())
    if not held or min(item.vertices[:, 2].min() for item in foregrounds) < lowest + WANTED_DEPTH * size:
        sides = [10 * size, 10 * size, size]
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=sides, pos=[0.0, 0.0, lowest], friction=friction)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    start: Array = data.xipos.copy()
    drift = depth = 0.0
    steps = max(1, round(1 / (CHECKS_PER_SECOND * STEP_S)))
    while data.time < seconds - STEP_S / 2:
        mujoco.mj_step(model, data, nstep=steps)
        depth = max(depth, -float(min(data.contact.dist, default=0.0)) / size)
        drift = max(drift, float(np.linalg.norm(data.xipos - start, axis=1).max()) / size)
        if not math.isfinite(drift) or drift > 1.0:
            break
    return Standing(drift=drift if math.isfinite(drift) else math.inf, depth=depth, seconds=float(data.time))


def standing_text(rows: Sequence[tuple[str, str, Standing]]) -> str:
    """For a terminal: asset, what was dropped, and how it fared; then the share that stands of each kind."""
    lines = [
        f"{asset:8} {what:16} drift {100 * found.drift:8.2f} %  depth {100 * found.depth:6.3f} %  "
        f"{'stands' if found.stands else 'FALLS' if found.drift >= 1 else 'MOVES'}"
        for asset, what, found in rows
    ]
    for what in dict.fromkeys(what for _, what, _ in rows):
        good = [found.stands for _, kind, found in rows if kind == what]
        enough = sum(good) >= WANTED_SHARE * len(good)
        lines.append(f"{'yes' if enough else 'NO ':3}  {what}: {sum(good)} of {len(good)} stand {SECONDS:g} s")
    return "\n".join(lines)


Likeness = tuple[str, tuple[float, float], tuple[float, float]]
"""Asset, and dB against the input picture and the held-out views: of its composition, and of the same with seats."""


def seats_text(pictures: Sequence[Likeness]) -> str:
    """For a terminal: what the seats cost in the picture."""
    return "\n".join(
        f"{name:8} input view {a[0]:.2f} dB, seated {b[0]:.2f}; held out {a[1]:.2f}, seated {b[1]:.2f}"
        for name, a, b in pictures
    )


def standing_json(rows: Sequence[tuple[str, str, Standing]], pictures: Sequence[Likeness] = ()) -> dict[str, Any]:
    """The same for JSON; what is not finite becomes null."""
    return {
        "pictures": [
            {
                "asset": name,
                "reference_db": a[0],
                "held_out_db": a[1],
                "seated_reference_db": b[0],
                "seated_held_out_db": b[1],
            }
            for name, a, b in pictures
        ],
        "seconds": SECONDS,
        "wanted": {"drift": WANTED_DRIFT, "depth": WANTED_DEPTH, "share": WANTED_SHARE},
        "rows": [
            {
                "asset": asset,
                "what": what,
                "stands": found.stands,
                **{k: v if math.isfinite(v) else None for k, v in asdict(found).items()},
            }
            for asset, what, found in rows
        ],
    }
