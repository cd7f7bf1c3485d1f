# SPDX-License-Identifier: MIT
"""Drop and wobble of every material preset, beside what such matter does: rebound, squash, ringing, shape at rest.

    python -m physgen.benchmarks.materials [plush jelly ...] [--cells 12] [--json]

A specimen of each preset (see ``SPECIMENS``: its shape, size and height of fall) meets the ground, in the engine, at
the speed of its fall, and is watched for two seconds:

    e         coefficient of restitution: speed of its centre of mass when it leaves the ground over that at the impact
    squash    largest loss of height, % of the height at rest
    lost      distance of its particles from their places at rest after the best rigid motion (Kabsch 1976), r.m.s., %
              of the longest side, at the end
    Hz, decay a cylinder of the same height that is held at its foot and kicked sideways, without gravity: frequency,
              and the time in which the amplitude falls to 1/e, both of the damped cosine fitted to its mean shear

``wanted`` is what the sources (``TARGETS``) say of such matter; * marks a figure out of that range. Friction 0.8.
Rigid bodies meet it with their material's restitution, all others with none.
"""

from __future__ import annotations

import dataclasses
import json
import math
import sys
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import trimesh
from numpy.typing import NDArray
from physgen.benchmarks.common import benchmark_parser
from physgen.sim.rigid_alignment import nearest_pose

Array = NDArray[np.float64]
Mesh = tuple[Array, NDArray[np.int64]]
Span = tuple[float, float]

GRAVITY = 9.81
GAP = 0.02
"""Share of its size that a specimen falls in the engine; the fall before is given as a velocity."""


class Specimen(NamedTuple):
    """A body to drop: shape, longest side and height of fall in m."""

    shape: str
    size: float
    drop: float
    seconds: float = 2.0


class Target(NamedTuple):
    """Expected behaviour: ranges of e, of the squash in %, of the decay in s, and the largest loss of shape in %."""

    restitution: Span | None = None
    squash: Span | None = None
    decay: Span | None = None
    lost: float | None = None
    source: str = "estimate"


SPECIMENS = {
    "plush": Specimen("toy", 0.4, 0.4),
    "soft": Specimen("toy", 0.4, 0.4),
    "foam": Specimen("ball", 0.1, 0.5, 1.0),
    "jelly": Specimen("pudding", 0.1, 0.05),
    "medium": Specimen("ball", 0.08, 0.5, 0.6),
    "rubber": Specimen("ball", 0.06, 1.0, 0.5),
    "hard": Specimen("ball", 0.08, 0.5, 0.3),
    "wood": Specimen("ball", 0.08, 0.5),
    "metal": Specimen("ball", 0.03, 0.5),
    "clay": Specimen("ball", 0.08, 0.5, 0.6),
    "snow": Specimen("ball", 0.1, 0.5, 0.6),
    "sand": Specimen("ball", 0.1, 0.1, 0.6),
    "water": Specimen("ball", 0.1, 0.1, 0.6),
    "honey": Specimen("ball", 0.1, 0.1, 0.6),
}

TARGETS = {
    "plush": Target((0.0, 0.35), (10.0, 45.0), None, 3.0, "estimate: rises by a few per cent of its fall"),
    "soft": Target((0.0, 0.5), (5.0, 45.0), None, 3.0, "estimate: between plush and foam"),
    "foam": Target(
        (0.45, 0.8), (5.0, 40.0), None, 1.0, "ISO 8307, ball rebound: 20–60 % of the height by grade (trade figures)"
    ),
    "jelly": Target((0.0, 0.6), (3.0, 40.0), (0.7, 4.0), 3.0, "Ross-Murphy 1992: G'' a tenth to a hundredth of G'"),
    "medium": Target((0.4, 0.85), (1.0, 25.0), None, 1.0, "estimate: fruit to rubber"),
    "rubber": Target((0.75, 0.9), (3.0, 30.0), None, 1.0, "Cross 1999 (superball); Physics Factbook: 0.83"),
    "hard": Target((0.5, 0.9), (0.0, 10.0), None, 1.0, "Physics Factbook: hollow hard plastic ball, 0.69"),
    "wood": Target((0.5, 0.7), (0.0, 0.0), None, 0.01, "Physics Factbook: wooden ball, 0.60"),
    "metal": Target((0.5, 0.8), (0.0, 0.0), None, 0.01, "Physics Factbook: steel ball bearing, 0.60"),
    # KICK shears clay to three times its yield: a tenth to a quarter of critical damping.
    "clay": Target(
        (0.0, 0.1),
        (1.0, 60.0),
        (0.02, 0.05),
        None,
        "Cross 1999: plasticine, 0; Ishibashi & Zhang 1993: damping of clay",
    ),
    "snow": Target((0.0, 0.2), None, None, None, "estimate"),
    "sand": Target((0.0, 0.1), None, None, None, "estimate: grains"),
    "water": Target((0.0, 0.1), None, None, None, "estimate: a splash"),
    "honey": Target((0.0, 0.1), None, None, None, "estimate"),
}


# ---- specimens ------------------------------------------------------------------------------------------------------


def ball() -> Mesh:
    """A ball of diameter 1 on the plane z = 0."""
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=0.5)
    return np.asarray(mesh.vertices) + np.array((0.0, 0.0, 0.5)), np.asarray(mesh.faces)


def pudding() -> Mesh:
    """An upright cylinder of height 1 and diameter 1.2 on the plane z = 0."""
    mesh = trimesh.creation.cylinder(radius=0.6, height=1.0, sections=48)
    return np.asarray(mesh.vertices) + np.array((0.0, 0.0, 0.5)), np.asarray(mesh.faces)


TOY = (
    ((0.0, 0.0, 0.30), 0.24),
    ((0.0, -0.02, 0.68), 0.20),
    *(((0.17 * s, 0.0, 0.86), 0.075) for s in (-1, 1)),
    *(((0.24 * s, -0.06, 0.40), 0.08) for s in (-1, 1)),
    *(((0.30 * s, -0.10, 0.32), 0.075) for s in (-1, 1)),
    *(((0.14 * s, -0.22, 0.09), 0.09) for s in (-1, 1)),
    *(((0.14 * s, -0.32, 0.09), 0.085) for s in (-1, 1)),
    ((0.0, -0.21, 0.64), 0.07),
)
"""Balls (centre, radius) of a sitting bear of height 1: trunk, head, ears, arms, legs, snout."""

BLEND = 0.03
"""Radius with which the balls of the toy are joined."""


def toy() -> Mesh:
    """A sitting bear of height 1 on the plane z = 0, with ears, arms and legs as thin as those of a stuffed toy."""
    from skimage.measure import marching_cubes

    low, high, count = np.array([-0.5, -0.5, -0.1]), np.array([0.5, 0.5, 1.1]), (60, 60, 72)
    axes = [np.linspace(a, b, n) for a, b, n in zip(low, high, count, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    distance = np.full(count, 9.0)
    for centre, radius in TOY:
        own = np.linalg.norm(points - centre, axis=-1) - radius
        share = np.clip(0.5 + 0.5 * (distance - own) / BLEND, 0.0, 1.0)
        distance = distance * (1 - share) + own * share - BLEND * share * (1 - share)
    distance = np.maximum(distance, 0.02 - points[..., 2])
    vertices, faces, _, _ = marching_cubes(distance, 0.0, spacing=[axis[1] - axis[0] for axis in axes])
    vertices = np.asarray(vertices, dtype=np.float64) + low
    vertices -= (0.0, 0.0, vertices[:, 2].min())
    return vertices / vertices[:, 2].max(), np.asarray(faces, dtype=np.int64)[:, ::-1]


SHAPES: dict[str, Callable[[], Mesh]] = {"ball": ball, "pudding": pudding, "toy": toy}


def world_of(
    preset: str, mesh: Mesh, cells: float, *, height: float = 0.0, speed: float = 0.0, held: bool = False
) -> Any:
    """A ``World`` with the mesh (metres) of the preset's material ``height`` m above the ground, falling at ``speed``.

    held: it is held at its foot, and there is neither gravity nor ground.
    """
    from physgen.sim.app.scene_bodies import engine_material
    from physgen.sim.mpm.bodies import BodyParticles
    from physgen.sim.mpm.colliders import Surface
    from physgen.sim.mpm.geometry.interior_sampling import sample_interior
    from physgen.sim.mpm.solver_options import Ground, SolverOptions, fit_similarity
    from physgen.sim.mpm.world import World
    from physgen.sim.scene.material import load_preset

    vertices, faces = mesh[0] + np.array((0.0, 0.0, height)), mesh[1]
    options = SolverOptions()
    similarity = fit_similarity([vertices], cells_across=cells, options=options)
    sample = sample_interior(vertices, faces, options.particle_spacing(similarity))
    material = load_preset(preset)
    body = BodyParticles(
        name=preset,
        positions=sample.positions,
        volumes=sample.volumes,
        contact_radii=sample.contact_radii,
        material=engine_material(material),
        surface=Surface(vertices=vertices, faces=faces),
        velocity=(0.0, 0.0, -speed),
    )
    if held:
        foot = sample.positions[:, 2] < vertices[:, 2].min() + 0.6 * options.cell_size(similarity)
        body = dataclasses.replace(body, pins=foot)
    bounce = material.rigid_restitution if material.law == "rigid" else 0.0
    return World(
        bodies=[body],
        gravity=(0.0, 0.0, 0.0 if held else -GRAVITY),
        ground=None if held else Ground(friction=0.8, restitution=bounce),
        similarity=similarity,
        options=options,
    )


# ---- measuring ------------------------------------------------------------------------------------------------------


def shape_loss(rest: Array, now: Array) -> float:
    """R.m.s. distance of ``now`` (N, 3) from ``rest`` (N, 3) after the best rigid motion, over rest's longest side."""
    turn, shift = nearest_pose(rest, now)
    apart = rest @ turn.T + shift - now
    return float(np.sqrt((apart**2).sum(axis=1).mean()) / np.ptp(rest, axis=0).max())


@dataclasses.dataclass(frozen=True, kw_only=True)
class Drop:
    """Result of a drop: coefficient of restitution, largest squash and loss of shape (shares), cost."""

    restitution: float
    squash: float
    lost: float
    particles: int
    substeps: int


def drop(preset: str, specimen: Specimen, cells: float) -> Drop:
    """Drop the specimen and watch it for its time."""
    vertices, faces = SHAPES[specimen.shape]()
    vertices = vertices * (specimen.size / np.ptp(vertices, axis=0).max())
    gap = GAP * specimen.size
    impact = math.sqrt(2 * GRAVITY * specimen.drop)
    world = world_of(
        preset, (vertices, faces), cells, height=gap, speed=math.sqrt(max(impact**2 - 2 * GRAVITY * gap, 0.0))
    )
    rest = world.positions(0)
    tall = float(np.ptp(rest[:, 2]))
    # The first contact lasts as long as waves take through the body, a few times; sampled finely, the rest coarsely.
    fine = min(0.25, 0.1 * specimen.seconds + 4.0 * gap / impact)
    times = [*np.linspace(0.0, fine, 101)[1:], *np.arange(fine, specimen.seconds, 1 / 60)[1:]]
    leaving, least = 0.0, tall
    for time in times:
        world.advance(time - world.time)
        places = world.positions(0)
        least = min(least, float(np.ptp(places[:, 2])))
        if leaving == 0.0 and world.ground_gap(0) > 0.2 * gap:
            leaving = max(0.0, float(np.average(world.velocities(0)[:, 2], weights=world.bodies[0].masses)))
    return Drop(
        restitution=leaving / impact,
        squash=1.0 - least / tall,
        lost=shape_loss(rest, world.positions(0)),
        particles=len(rest),
        substeps=world.substeps,
    )


PERIODS = 16
"""Periods of a shear beam, 4 h / c_s, for which a kicked cylinder is watched."""

KICK = 0.05
"""Shear to which the kick leads."""


def wobble(preset: str, size: float, cells: float) -> tuple[float, float] | None:
    """Frequency in Hz and decay time in s of a cylinder of height ``size`` m kicked sideways; None where no fit is."""
    from scipy.optimize import curve_fit

    vertices, faces = pudding()
    world = world_of(preset, (vertices * size, faces), 1.2 * cells, held=True)
    body = world.bodies[0]
    shear_speed = math.sqrt(body.material.shear_modulus / body.material.density)
    omega = 0.5 * math.pi * shear_speed / size
    rise = body.positions[:, 2] - body.positions[:, 2].mean()
    velocities, gradients = np.zeros((body.count, 3)), np.zeros((body.count, 3, 3))
    velocities[:, 0] = KICK * omega * body.positions[:, 2]
    gradients[:, 0, 2] = KICK * omega
    world.set_motion(0, velocities=velocities, velocity_gradients=gradients)
    duration = PERIODS * 2 * math.pi / omega
    times, shear = np.linspace(0.0, duration, 20 * PERIODS + 1), [0.0]
    for time in times[1:]:
        world.advance(time - world.time)
        shear.append(float(world.positions(0)[:, 0] @ rise / (rise @ rise)))

    def model(t: Array, a: float, b: float, rate: float, turn: float, mean: float) -> Array:
        return np.exp(-rate * t) * (a * np.cos(turn * t) + b * np.sin(turn * t)) + mean

    best, error = None, np.inf
    for guess in (0.6, 0.8, 1.0):
        start = (0.0, KICK, 0.05 * omega, guess * omega, 0.0)
        try:
            found, _ = curve_fit(model, times, shear, start, maxfev=4000)
        except RuntimeError:
            continue
        off = float(((model(times, *found) - shear) ** 2).mean())
        if off < error:
            best, error = found, off
    if best is None or best[2] <= 0:
        return None
    return float(abs(best[3]) / (2 * math.pi)), float(1.0 / best[2])


def measure(preset: str, cells: float, *, seconds: float | None = None) -> dict[str, Any]:
    """All figures of the preset, in SI units and shares."""
    from physgen.sim.constitutive import cohesion_of
    from physgen.sim.scene.material import load_preset

    specimen = SPECIMENS[preset]
    if seconds is not None:
        specimen = specimen._replace(seconds=seconds)
    seen = drop(preset, specimen, cells)
    rings = wobble(preset, specimen.size, cells) if cohesion_of(load_preset(preset).law) == "shaped" else None
    return {
        "specimen": f"{specimen.shape} {specimen.size:g} m, from {specimen.drop:g} m",
        "restitution": round(seen.restitution, 3),
        "squash": round(seen.squash, 4),
        "lost": round(seen.lost, 5),
        "hertz": None if rings is None else round(rings[0], 2),
        "decay_s": None if rings is None else round(rings[1], 3),
        "particles": seen.particles,
        "substeps": seen.substeps,
    }


# ---- printing -------------------------------------------------------------------------------------------------------


def judged(value: float | None, span: Span | None, form: str) -> str:
    """The value, with * where it is outside of the span."""
    if value is None:
        return "–"
    text = format(value, form)
    return text if span is None or span[0] - 1e-9 <= float(text) <= span[1] + 1e-9 else text + " *"


def row(preset: str, found: dict[str, Any]) -> str:
    """A line of the table."""
    target = TARGETS[preset]
    lost = None if target.lost is None else (0.0, target.lost)
    cells = [
        f"`{preset}`",
        found["specimen"],
        judged(found["restitution"], target.restitution, ".2f"),
        "–" if target.restitution is None else "{:g}–{:g}".format(*target.restitution),
        judged(100 * found["squash"], target.squash, ".0f"),
        "–" if target.squash is None else "{:g}–{:g}".format(*target.squash),
        judged(100 * found["lost"], lost, ".2f"),
        "–" if target.lost is None else f"≤ {target.lost:g}",
        "–" if found["hertz"] is None else f"{found['hertz']:.1f}",
        judged(found["decay_s"], target.decay, ".2f"),
        "–" if target.decay is None else "{:g}–{:g}".format(*target.decay),
        target.source,
    ]
    return "| " + " | ".join(cells) + " |"


HEAD = (
    "| preset | specimen | e | wanted | squash % | wanted | lost % | wanted | Hz | decay s | wanted | source |\n"
    "| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |"
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    parser = benchmark_parser("materials", __doc__, cells=5.0, seconds=0.05, names=["jelly"])
    parser.add_argument("names", nargs="*", default=list(SPECIMENS), metavar="PRESET", help="default: all")
    parser.add_argument("--cells", type=float, default=12.0, help="across each specimen (default: %(default)s)")
    parser.add_argument("--seconds", type=float, help="instead of each specimen's own")
    options = parser.parse_args(arguments)
    unknown = sorted(set(options.names) - set(SPECIMENS))
    if unknown:
        parser.error(f"unknown preset {unknown[0]!r}: choose from {', '.join(SPECIMENS)}")
    result = {}
    if not options.json:
        print(HEAD, flush=True)
    for name in options.names:
        result[name] = measure(name, options.cells, seconds=options.seconds)
        if not options.json:
            print(row(name, result[name]), flush=True)
    if options.json:
        print(json.dumps(result))
    return 0


if __name__ == "__main__":
    sys.exit(main())
