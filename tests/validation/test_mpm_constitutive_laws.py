# SPDX-License-Identifier: MIT
"""Constitutive laws against theory and experiment; every tolerance has its source in the test's docstring."""

from __future__ import annotations

import io
import math

import numpy as np
import pytest
import trimesh
from physgen.sim.constitutive import (
    SHAPED,
    ElasticMaterial,
    FluidMaterial,
    NeoHookeanMaterial,
    SandMaterial,
    SnowMaterial,
    VonMisesMaterial,
)
from physgen.sim.mpm.bodies import BodyParticles
from physgen.sim.mpm.colliders import Collider, Surface
from physgen.sim.mpm.solver_options import Ground, SolverOptions
from physgen.sim.mpm.surface_contact import ContactTable, SurfaceContact
from physgen.sim.mpm.world import World

G = 9.81
NO_GRAVITY = (0.0, 0.0, 0.0)


def body_of(material, cell, size, *, bottom=(0.0, 0.0, 0.0), radius=None, **motion) -> BodyParticles:
    """Box of ``size`` (3) cells, or the upright cylinder of ``radius`` cells in it, 8 particles a cell."""
    spacing = cell / 2
    counts = [2 * c for c in size]
    index = np.stack(np.meshgrid(*[np.arange(n) for n in counts], indexing="ij"), axis=-1).reshape(-1, 3)
    local = (index + 0.5) * spacing - np.array([counts[0], counts[1], 0]) * spacing / 2
    if radius is not None:
        local = local[np.hypot(local[:, 0], local[:, 1]) < radius * cell]
    return BodyParticles(
        name="body",
        positions=local + np.asarray(bottom),
        volumes=np.full(len(local), spacing**3),
        material=material,
        contact_radii=np.full(len(local), spacing / 2),
        **motion,
    )


def give_motion(world: World, velocities: np.ndarray, gradients: np.ndarray) -> None:
    """Velocities (N, 3) in m/s and velocity gradients (N, 3, 3) for body 0, in the order of its particles."""
    state = world.checkpoint()
    order = state["ids"]
    scale = world.options.grid / 2.0 * world.similarity.scale
    state["v"] = (velocities[order] * scale).astype(np.float32)
    state["C"] = gradients[order].astype(np.float32)
    world.restore(state)


def bar_decay(options, similarity, cell, *, speed: float = 10.0, **fields: float) -> tuple[float, float]:
    """Decay rate and angular frequency of the first longitudinal mode of a free bar, nu = 0, E = 1e5 Pa.

    speed: of its waves in m/s, by which strain and velocity are weighed into one amplitude.
    """
    material = ElasticMaterial(density=1000.0, youngs_modulus=1e5, poisson_ratio=0.0, **fields)
    body = body_of(material, cell, (4, 4, 24), bottom=(0.0, 0.0, -12 * cell))
    world = World(bodies=[body], gravity=NO_GRAVITY, similarity=similarity, options=options)
    length = 24 * cell
    wave = math.pi / length
    height = body.positions[:, 2] + length / 2
    mode = np.cos(wave * height)
    velocities, gradients = np.zeros((body.count, 3)), np.zeros((body.count, 3, 3))
    velocities[:, 2] = 0.05 * mode
    gradients[:, 2, 2] = -0.05 * wave * np.sin(wave * height)
    give_motion(world, velocities, gradients)
    omega = wave * speed
    times, amplitudes = [], []
    for _ in range(60):
        world.advance(3 * 2 * math.pi / omega / 60)
        q = mode @ (world.positions(0) - body.positions)[:, 2]
        rate = mode @ world.velocities(0)[:, 2]
        times.append(world.time)
        amplitudes.append(0.5 * math.log(rate**2 + (omega * q) ** 2))
    return -float(np.polyfit(times, amplitudes, 1)[0]), omega


def test_a_vibrating_bar_decays_as_kelvin_voigt(options, similarity, cell):
    """Rate t w^2 / 2 for the retardation time t within 5 % (the wave speed in a thin bar is asked for as closely)."""
    time = 4e-3
    rate, omega = bar_decay(options, similarity, cell, damping_time=time)
    assert rate == pytest.approx(time * omega**2 / 2, rel=0.05)


def test_without_damping_a_bar_keeps_swinging(options, similarity, cell):
    """Half a per cent of critical damping at most: what the transfers and symplectic Euler may take."""
    rate, omega = bar_decay(options, similarity, cell)
    assert abs(rate) < 0.005 * omega


@pytest.mark.parametrize("share, time", [(0.5, 0.01), (0.5, 0.1), (0.1, 0.02)])
def test_a_bar_with_a_part_that_relaxes_decays_as_zeners_solid(options, similarity, cell, share, time):
    """s of exp(s t) solves s² + w² (1 + q s t / (1 + s t)) = 0 with the relaxing share q; rate within 5 %."""
    wave = math.pi / (24 * cell)
    squared = (10.0 * wave) ** 2
    roots = np.roots([time, 1.0, squared * time * (1 + share), squared])
    swing = roots[np.argmax(roots.imag)]
    rate, _ = bar_decay(
        options, similarity, cell, speed=abs(swing.imag) / wave, relaxing_share=share, relaxation_time=time
    )
    assert rate == pytest.approx(-swing.real, rel=0.05)


def twist_decay(options, similarity, cell, viscosity: float) -> tuple[float, float]:
    """Decay rate of v = W r cos(pi z/L) in a free cylinder of fluid (1000 kg/m³), and the wavenumber pi/L."""
    fluid = FluidMaterial(density=1000.0, bulk_modulus=2e5, viscosity=viscosity)
    length = 12 * cell
    body = body_of(fluid, cell, (12, 12, 12), radius=6, bottom=(0.0, 0.0, -length / 2))
    world = World(bodies=[body], gravity=NO_GRAVITY, similarity=similarity, options=options)
    wave = math.pi / length
    x, y = body.positions[:, 0], body.positions[:, 1]
    mode = np.cos(wave * (body.positions[:, 2] + length / 2))
    slope = -wave * np.sin(wave * (body.positions[:, 2] + length / 2))
    spin = 0.05
    velocities, gradients = np.zeros((body.count, 3)), np.zeros((body.count, 3, 3))
    velocities[:, 0], velocities[:, 1] = -spin * y * mode, spin * x * mode
    gradients[:, 0, 1], gradients[:, 1, 0] = -spin * mode, spin * mode
    gradients[:, 0, 2], gradients[:, 1, 2] = -spin * y * slope, spin * x * slope
    give_motion(world, velocities, gradients)
    times, amplitudes = [], []
    for _ in range(10):
        world.advance(0.02)
        v = world.velocities(0)
        times.append(world.time)
        amplitudes.append(math.log(float(mode @ (x * v[:, 1] - y * v[:, 0]))))
    return -float(np.polyfit(times, amplitudes, 1)[0]), wave


@pytest.mark.slow
def test_viscosity_slows_a_twisting_fluid(options, similarity, cell):
    """The motion has no stress on any face, so it decays at eta/rho (pi/L)^2. 5 % of what the viscosity adds; what the
    transfers take without it is stated in docs/physics.md."""
    without, wave = twist_decay(options, similarity, cell, 0.0)
    with_it, _ = twist_decay(options, similarity, cell, 60.0)
    assert with_it - without == pytest.approx(60.0 / 1000.0 * wave**2, rel=0.05)


@pytest.mark.slow
@pytest.mark.xfail(strict=True, reason="0.1 /s, 2.5 % of that decay: the transfers still damp a little")
def test_a_fluid_without_viscosity_keeps_twisting(options, similarity, cell):
    """Less than 1 % of the decay that 60 Pa s gives."""
    rate, wave = twist_decay(options, similarity, cell, 0.0)
    assert rate < 0.01 * 60.0 / 1000.0 * wave**2


@pytest.mark.parametrize("speed", [4.5, 7.5])
def test_neo_hookean_survives_an_impact_faster_than_its_waves(options, similarity, cell, speed):
    """At 1.2 and 2 times the wave speed (3.7 m/s) no particle inverts, and the body is a box again when it has come to
    rest: as high as statics says, h (1 - rho g h / 2E), within a tenth of h."""
    material = NeoHookeanMaterial(density=1000.0, youngs_modulus=1e4, poisson_ratio=0.3, damping_time=5e-3)
    body = body_of(material, cell, (6, 6, 3), bottom=(0.0, 0.0, 0.5 * cell), velocity=(0.0, 0.0, -speed))
    world = World(bodies=[body], ground=Ground(), similarity=similarity, options=options)
    for _ in range(30):
        world.advance(0.002)
        assert np.linalg.det(world.elastic_gradients(0)).min() > 0
    world.advance(1.5)
    height = 3 * cell
    found = float(np.ptp(world.positions(0)[:, 2])) + cell / 2
    assert found == pytest.approx(height * (1 - 1000.0 * G * height / 2e4), abs=0.1 * height)


@pytest.mark.slow
def test_a_plastic_bar_shortens_on_impact_as_in_taylors_test(similarity):
    """Final length L1/L = 0.12 + 0.88 exp(-rho v^2 / 2Y) of a bar shot at a smooth rigid wall [Wilkins and Guinan
    1973]; their fit to eight metals scatters by some hundredths of L, so 0.03. And the dent stays: 1 % of it."""
    options, cell = SolverOptions(grid=128), 2.0 / 128
    yield_stress, density = 5e4, 1700.0
    speed = math.sqrt(0.6 * yield_stress / density)
    clay = VonMisesMaterial(density=density, youngs_modulus=2e7, poisson_ratio=0.3, yield_stress=yield_stress)
    body = body_of(clay, cell, (8, 8, 32), radius=4, bottom=(0.0, 0.0, 0.1 * cell), velocity=(0.0, 0.0, -speed))
    world = World(
        bodies=[body], ground=Ground(friction=0.0), gravity=NO_GRAVITY, similarity=similarity, options=options
    )
    lengths = []
    for _ in range(3):
        world.advance(0.05)
        lengths.append((float(np.ptp(world.positions(0)[:, 2])) + cell / 2) / (32 * cell))
    assert lengths[1] == pytest.approx(0.12 + 0.88 * math.exp(-0.3), abs=0.03)
    assert lengths[2] == pytest.approx(lengths[1], abs=0.01 * (1 - lengths[1]))


@pytest.mark.long
@pytest.mark.parametrize("share, stands", [(0.7, True), (2.5, False)])
def test_clay_stands_up_to_the_height_that_it_bears(options, similarity, cell, share, stands):
    """A column yields at its foot where rho g h exceeds the yield stress. Below, it stays elastic (shorter by
    rho g h / 2E, twice that in the first swing); far above, it slumps. The quasi-static slump without friction below is
    1 - y (1 - ln y) of h with y = 1/2.5 [Pashias et al. 1996]; friction holds the foot, so only half is asked for."""
    height = 8 * cell
    yield_stress = 1700.0 * G * height / share
    clay = VonMisesMaterial(density=1700.0, youngs_modulus=5e6, poisson_ratio=0.3, yield_stress=yield_stress)
    body = body_of(clay, cell, (4, 4, 8))
    world = World(bodies=[body], ground=Ground(friction=0.5), similarity=similarity, options=options)
    world.advance(0.4)
    shorter = 1 - (float(np.ptp(world.positions(0)[:, 2])) + cell / 2) / height
    if stands:
        assert shorter < 2 * 1700.0 * G * height / (2 * 5e6)
    else:
        assert shorter > 0.5 * (1 - 0.4 * (1 - math.log(0.4)))


def test_snow_keeps_its_elastic_strain_in_its_limits_and_packs(options, similarity, cell):
    """Stomakhin et al. 2013: elastic stretches in [1 - 0.025, 1 + 0.0075], and the impact packs. The state between
    advances is a trial state, which the next substep maps back: it may be off by the strain of one substep."""
    snow = SnowMaterial(density=400.0, youngs_modulus=1.4e5, poisson_ratio=0.2)
    body = body_of(snow, cell, (5, 5, 5), bottom=(0.0, 0.0, 0.2 * cell), velocity=(0.0, 0.0, -4.0))
    world = World(bodies=[body], ground=Ground(), similarity=similarity, options=options)
    for _ in range(4):
        world.advance(0.05)
        step = options.max_step * np.linalg.norm(world.velocity_gradients(0), ord=2, axis=(1, 2))
        stretch = np.linalg.svd(world.elastic_gradients(0), compute_uv=False)
        assert (stretch.min(axis=1) > (1 - 0.025) * (1 - step) - 1e-4).all()
        assert (stretch.max(axis=1) < (1 + 0.0075) * (1 + step) + 1e-4).all()
    assert world.memories(0).min() < -0.01


def cone(cell, height: int, radius: int, friction_angle: float) -> BodyParticles:
    """Pile of sand, in cells."""
    sand = SandMaterial(density=1600.0, youngs_modulus=3.5e5, poisson_ratio=0.3, friction_angle=friction_angle)
    column = body_of(sand, cell, (2 * radius, 2 * radius, height), radius=radius)
    distance = np.hypot(column.positions[:, 0], column.positions[:, 1])
    keep = column.positions[:, 2] < height * cell * (1 - distance / (radius * cell))
    assert column.contact_radii is not None
    return BodyParticles(
        name="pile",
        positions=column.positions[keep],
        volumes=column.volumes[keep],
        material=sand,
        contact_radii=column.contact_radii[keep],
    )


@pytest.mark.slow
def test_a_pile_below_its_angle_of_repose_stands(options, similarity, cell):
    """A slope of 26.6 degrees of sand of 34.4 degrees: nothing moves by more than 0.1 cell in a second."""
    pile = cone(cell, 5, 10, 0.6)
    world = World(bodies=[pile], ground=Ground(friction=1.0), similarity=similarity, options=options)
    world.advance(1.0)
    assert np.linalg.norm(world.positions(0) - pile.positions, axis=1).max() < 0.1 * cell


@pytest.mark.long
def test_a_pile_above_its_angle_of_repose_slides(options, similarity, cell):
    """A slope of 48 degrees of sand of 28.6 degrees comes to rest below 28.6 degrees, and no volume is made or lost.
    Its flank, from 30 to 70 % of its height, is within 5 degrees of the angle, as dry sand starts and stops."""
    angle, radius = 0.5, 9
    pile = cone(cell, 10, radius, angle)
    world = World(bodies=[pile], ground=Ground(friction=1.0), similarity=similarity, options=options)
    world.advance(0.75)
    distance = np.hypot(*world.positions(0)[:, :2].T) / cell
    edges = np.arange(2 * radius)
    thickness = np.histogram(distance, bins=edges)[0] / 8.0 / (math.pi * np.diff(edges**2))
    slope = -np.polyfit(edges[2:7] + 0.5, thickness[2:7], 1)[0]
    assert 0.2 * math.tan(angle) < slope < math.tan(angle)
    flank = (thickness > 0.3 * thickness.max()) & (thickness < 0.7 * thickness.max())
    steepness = -np.polyfit(edges[:-1][flank], thickness[flank], 1)[0]
    assert math.atan(steepness) == pytest.approx(angle, abs=math.radians(5))
    assert np.abs(np.log(np.linalg.det(world.elastic_gradients(0)))).mean() < 0.01


@pytest.mark.slow
def test_sand_column_runs_out_as_measured(similarity):
    """r/r0 = 1 + 1.24 a for aspect ratios a below 1.7 [Lube et al. 2004]; 15 % is what the issue asks for."""
    options, cell, radius = SolverOptions(grid=128, max_step=2e-3), 2.0 / 128, 12
    sand = SandMaterial(density=1600.0, youngs_modulus=1e5, poisson_ratio=0.3, friction_angle=0.52)
    column = body_of(sand, cell, (2 * radius, 2 * radius, radius), radius=radius)
    world = World(bodies=[column], ground=Ground(friction=0.57), similarity=similarity, options=options)
    world.advance(5 * math.sqrt(radius * cell / G))
    front = np.hypot(*world.positions(0)[:, :2].T).max() / (radius * cell)
    assert front == pytest.approx(1 + 1.24, rel=0.15)


FRICTIONLESS = ContactTable(default=SurfaceContact(friction=0.0))


def slab(name: str, low, high) -> Collider:
    """Box from corner to corner, in metres."""
    box = trimesh.creation.box(bounds=np.array([low, high], dtype=float))
    return Collider(name=name, surface=Surface(vertices=np.asarray(box.vertices), faces=np.asarray(box.faces)))


def basin(left: float, right: float, width: float, height: float, thick: float) -> list[Collider]:
    """Four walls around left < x < right, |y| < width / 2, to stand on the ground, in metres."""
    side, top = width / 2, height
    return [
        slab("left", (left - thick, -side - thick, -thick), (left, side + thick, top)),
        slab("right", (right, -side - thick, -thick), (right + thick, side + thick, top)),
        slab("near", (left - thick, -side - thick, -thick), (right + thick, -side, top)),
        slab("far", (left - thick, side, -thick), (right + thick, side + thick, top)),
    ]


def pond(similarity, depth: int) -> tuple[World, float]:
    """Thick water (50 Pa s), 16 cells square, let go in a basin of 20 cells, and the cell size in metres."""
    options = SolverOptions(grid=32)
    cell = 2.0 / 32
    fluid = FluidMaterial(density=1000.0, bulk_modulus=2e5, viscosity=50.0)
    world = World(
        bodies=[body_of(fluid, cell, (16, 16, depth))],
        ground=Ground(friction=0.0),
        colliders=basin(-10 * cell, 10 * cell, 20 * cell, 16 * cell, 4 * cell),
        contacts=FRICTIONLESS,
        similarity=similarity,
        options=options,
    )
    return world, cell


@pytest.mark.long
def test_a_pond_stays_above_the_ground_and_keeps_its_volume(similarity):
    """0.1 cell deep at most, as for solids; the mean compression is rho g H / 2K = 0.6 %, so 1 %."""
    world, cell = pond(similarity, 4)
    world.advance(0.5)
    assert world.ground_gap(0) > -0.1 * cell
    assert np.abs(world.positions(0)[:, :2]).max() < 10.1 * cell
    assert abs(np.exp(world.memories(0)).mean() - 1) < 0.01


@pytest.mark.slow
def test_a_pond_comes_to_rest_with_hydrostatic_pressure(similarity):
    """dp/dz = -rho g within 5 %, between a cell above the ground and a cell below the surface, mean of five frames."""
    world, cell = pond(similarity, 8)
    world.advance(2.9)
    heights, pressures = [], []
    for _ in range(5):
        world.advance(0.02)
        x = world.positions(0) / cell
        inner = (np.abs(x[:, :2]) < 6).all(axis=1) & (x[:, 2] > 1) & (x[:, 2] < 4.3)
        heights.append(x[inner, 2] * cell)
        pressures.append(np.maximum(2e5 / 7 * (np.exp(-7 * world.memories(0)[inner]) - 1), 0))
    assert np.sqrt((world.velocities(0) ** 2).mean()) < 0.01 * math.sqrt(G * 8 * cell)
    slope = np.polyfit(np.concatenate(heights), np.concatenate(pressures), 1)[0]
    assert slope == pytest.approx(-1000.0 * G, rel=0.05)


@pytest.mark.slow
def test_a_dam_break_runs_and_sinks_as_measured(similarity):
    """Water column of width a and height 2a in a channel [Martin and Moyce 1952, tables 2 and 6, a = 2.25 in].

    Their zero of time is uncertain by the gate, so the front's mean speed from z = 1.89 a on is compared: 1.78 a in
    1.35 of t sqrt(2 g / a). And the height that is left at the wall at t sqrt(g / a) = 0.93, 1.46 and 2.00. 10 %:
    their two sizes of column differ by 3 to 5 %."""
    options, cells = SolverOptions(grid=128, max_step=2e-3), 16
    cell = 2.0 / options.grid
    a = cells * cell
    water = FluidMaterial(density=1000.0, bulk_modulus=100 * 1000.0 * G * 2 * a, viscosity=0.0)
    column = body_of(water, cell, (cells, 3, 2 * cells), bottom=(a / 2, 0.0, 0.0))
    world = World(
        bodies=[column],
        ground=Ground(friction=0.0),
        colliders=basin(0.0, 6 * a, 3 * cell, 3 * a, 4 * cell),
        contacts=FRICTIONLESS,
        similarity=similarity,
        options=options,
    )

    def front() -> float:
        return float(world.positions(0)[:, 0].max() + cell / 4) / a

    def height() -> float:
        at_wall = world.positions(0)[:, 0] < cell
        return float(world.positions(0)[at_wall, 2].max() + cell / 4) / (2 * a)

    unit = math.sqrt(a / G)
    world.advance(0.93 * unit)
    assert height() == pytest.approx(0.83, rel=0.1)
    while front() < 1.89:
        world.advance(0.01 * unit)
    passed, start = world.time, front()
    world.advance(1.46 * unit - world.time)
    assert height() == pytest.approx(0.67, rel=0.1)
    world.advance(passed + 1.35 * unit / math.sqrt(2) - world.time)
    assert front() - start == pytest.approx(1.78, rel=0.1)
    world.advance(max(0.0, 2.0 * unit - world.time))
    assert height() == pytest.approx(0.50, rel=0.1)


MIXED = (
    NeoHookeanMaterial(
        density=1000.0,
        youngs_modulus=1e5,
        poisson_ratio=0.3,
        damping_time=1e-3,
        relaxing_share=0.5,
        relaxation_time=0.02,
    ),
    VonMisesMaterial(density=1800.0, youngs_modulus=1e6, poisson_ratio=0.4, yield_stress=1e4),
    SnowMaterial(density=400.0, youngs_modulus=1.4e5, poisson_ratio=0.2),
    SandMaterial(density=1600.0, youngs_modulus=3.5e5, poisson_ratio=0.3, friction_angle=0.6),
    FluidMaterial(density=1000.0, bulk_modulus=1e5, viscosity=1.0),
    ElasticMaterial(density=1000.0, youngs_modulus=1e5, poisson_ratio=0.3),
)


def mixed_world(options, similarity, cell) -> World:
    bodies = [
        body_of(m, cell, (3, 3, 3), bottom=((i - 2.5) * 6 * cell, 0.0, 0.5 * cell), velocity=(0.0, 0.2, -2.0))
        for i, m in enumerate(MIXED)
    ]
    return World(bodies=bodies, ground=Ground(), similarity=similarity, options=options)


def mixed_bytes(world: World) -> bytes:
    calls = (world.positions, world.velocities, world.elastic_gradients, world.memories)
    return b"".join(f(i).tobytes() for i in range(len(MIXED)) for f in calls)


@pytest.mark.usefixtures("repeatable")
def test_all_laws_in_one_world_are_deterministic_and_resume_exactly(options, similarity, cell):
    first = mixed_world(options, similarity, cell)
    first.advance(0.05)
    file = io.BytesIO()
    np.savez(file, **first.checkpoint())
    first.advance(0.05)
    second = mixed_world(options, similarity, cell)
    file.seek(0)
    with np.load(file, allow_pickle=False) as stored:
        second.restore(stored)
    second.advance(0.05)
    assert mixed_bytes(first) == mixed_bytes(second)
    assert np.isfinite(first.energy().total)


@pytest.mark.parametrize("material", MIXED, ids=lambda m: type(m).__name__)
def test_free_flight_keeps_momentum(options, similarity, cell, material):
    """1e-4 of momentum and angular momentum, as docs/physics.md asks of elastic bodies."""
    body = body_of(material, cell, (4, 4, 4), velocity=(0.5, 0.0, 0.2), spin=(0.0, 1.0, 2.0))
    world = World(bodies=[body], gravity=NO_GRAVITY, similarity=similarity, options=options)
    linear, angular = world.linear_momentum(), world.angular_momentum()
    world.advance(0.1)
    assert np.abs(world.linear_momentum() - linear).max() < 1e-4 * np.linalg.norm(linear)
    assert np.abs(world.angular_momentum() - angular).max() < 1e-4 * np.linalg.norm(angular)


@pytest.mark.parametrize("material", MIXED, ids=lambda m: type(m).__name__)
def test_rest_is_the_identity_and_a_rotation_is_itself(options, similarity, cell, material):
    """Skinning reads these: at rest 1 to the rounding of positions, a spun body its rotation within 1 %. Matter
    without cohesion flies apart on straight lines, F = I + t W, which is another 4.4 %: sqrt(1 + (w t)^2)."""
    spin = 3.0
    body = body_of(material, cell, (4, 4, 4), spin=(0.0, 0.0, spin))
    world = World(bodies=[body], gravity=NO_GRAVITY, similarity=similarity, options=options)
    assert np.abs(world.deformation_gradients(0) - np.eye(3)).max() < 1e-7
    world.advance(0.1)
    c, s = math.cos(0.1 * spin), math.sin(0.1 * spin)
    error = world.deformation_gradients(0) - np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    assert np.abs(error).mean() < (0.01 if material.cohesion == SHAPED else 0.01 + math.hypot(1, 0.1 * spin) - 1)
