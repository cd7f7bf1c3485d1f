# SPDX-License-Identifier: MIT
"""Everything touches everything: two kinds of matter in one world, against theory and against MuJoCo.

Tolerances are the requirements: 2 % of a draught, 1e-4 of the momentum, 5 % of a wave's speed, no particle through
a wall.
"""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from physgen.sim.constitutive import ElasticMaterial, FluidMaterial, RigidMaterial, SandMaterial
from physgen.sim.mpm.bodies import BodyParticles
from physgen.sim.mpm.colliders import Collider, Surface
from physgen.sim.mpm.solver_options import Ground
from physgen.sim.mpm.surface_contact import ContactTable, SurfaceContact
from physgen.sim.mpm.world import World
from physgen.sim.mpm.world_setup import WorldSetup

WATER = FluidMaterial(density=1000.0, bulk_modulus=2e5, viscosity=1.0)
SAND = SandMaterial(density=1600.0, youngs_modulus=1e6, poisson_ratio=0.3, friction_angle=0.6)


def walls(inner: tuple[float, float], height: float, thickness: float = 0.1) -> tuple[Collider, ...]:
    """Four static walls around a floor of ``inner`` m along x and y."""
    x, y = inner
    found = []
    for name, place, size in (
        ("left", (-(x + thickness) / 2, 0), (thickness, y + 2 * thickness)),
        ("right", ((x + thickness) / 2, 0), (thickness, y + 2 * thickness)),
        ("front", (0, -(y + thickness) / 2), (x, thickness)),
        ("back", (0, (y + thickness) / 2), (x, thickness)),
    ):
        mesh = trimesh.creation.box((*size, height))
        mesh.apply_translation((*place, height / 2))
        found.append(
            Collider(name=name, surface=Surface(vertices=np.asarray(mesh.vertices), faces=np.asarray(mesh.faces)))
        )
    return tuple(found)


def lattice(low: np.ndarray, high: np.ndarray, spacing: float) -> np.ndarray:
    """Places (N, 3) of a lattice that fills the box, half a spacing from its faces."""
    axes = [np.arange(a + spacing / 2, b, spacing) for a, b in zip(low, high, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def filled(name: str, material, places: np.ndarray, spacing: float, **fields) -> BodyParticles:
    return BodyParticles(
        name=name,
        positions=places,
        volumes=np.full(len(places), spacing**3),
        contact_radii=np.full(len(places), spacing / 2),
        material=material,
        **fields,
    )


def in_tub(bodies, side, cell, similarity, options):
    """A world of ``bodies`` between slippery walls, ``side`` wide and 14 cells high, on slippery ground."""
    return World(
        bodies=bodies,
        ground=Ground(friction=0.0),
        colliders=walls((side, side), 14 * cell),
        contacts=ContactTable(default=SurfaceContact(friction=0.0)),
        similarity=similarity,
        options=options,
    )


@pytest.mark.long
def test_a_pond_in_a_tub_holds_its_level_and_comes_to_rest(similarity, options, cell):
    """Eight cells deep and wide, let go for 2 s: its level within 3 % of its depth, as the issue asks of its pressure,
    and r.m.s. speed below 0.01 sqrt(g H), as for the thick pond. Without crowding, ln J stays where it was while
    particles pile up on floor and walls: the level falls by 11 %, the speed is 0.019 of that.

    dp/dz = -rho g within 3 % (the issue's) between one and five cells above the floor, up to the walls, mean over eight
    periods 4 H / c of its slowest sound, in which the pond still breathes. Pushed at the particles' places and not at
    its surface, water next to floor and walls had half the pressure, circulated, and the gradient was 13 % short."""
    spacing, side, depth = cell / 2, 8 * cell, 8 * cell
    places = lattice((-side / 2, -side / 2, 0), (side / 2, side / 2, depth), spacing)
    world = in_tub([filled("water", WATER, places, spacing)], side, cell, similarity, options)
    world.advance(2.0)
    at = world.positions(0)
    away = np.abs(at[:, :2]).max(axis=1) < side / 2 - 1.5 * cell
    level = np.quantile(at[away, 2], 0.985) + spacing / 2
    assert level == pytest.approx(depth, rel=0.03)
    assert np.sqrt((world.velocities(0) ** 2).mean()) < 0.01 * np.sqrt(9.81 * depth)
    slopes = []
    for _ in range(32):
        world.advance(depth / WATER.wave_speed)
        height = world.positions(0)[:, 2]
        inner = (height > cell) & (height < 5 * cell)
        pressure = WATER.bulk_modulus / 7 * (np.exp(-7 * world.memories(0)[inner]) - 1)
        slopes.append(np.polyfit(height[inner], pressure, 1)[0])
    assert np.mean(slopes) == pytest.approx(-1000.0 * 9.81, rel=0.03)


@pytest.mark.long
def test_disordered_water_keeps_its_level(similarity, options, cell):
    """Places moved by up to 0.3 of their spacing, also into walls, which throw the water up by a fifth of its depth:
    within 3 % of it after a second (the issue's). Flying apart, ln J forgot how far, and the water stood 12 % too high
    for good."""
    spacing, side, depth = cell / 2, 8 * cell, 8 * cell
    places = lattice((-side / 2, -side / 2, 0), (side / 2, side / 2, depth), spacing)
    places += np.random.default_rng(0).uniform(-0.3, 0.3, places.shape) * spacing
    world = in_tub([filled("water", WATER, places, spacing)], side, cell, similarity, options)
    world.advance(0.1)
    assert world.positions(0)[:, 2].mean() > 1.1 * depth / 2, "it was thrown up"
    world.advance(0.9)
    at = world.positions(0)
    away = np.abs(at[:, :2]).max(axis=1) < side / 2 - 1.5 * cell
    assert np.quantile(at[away, 2], 0.985) + spacing / 2 == pytest.approx(depth, rel=0.03)
    assert 2 * at[:, 2].mean() == pytest.approx(depth, rel=0.03)
    assert np.sqrt((world.velocities(0) ** 2).mean()) < 0.01 * np.sqrt(9.81 * depth)


@pytest.fixture
def floating(box_body, similarity, options, cell):
    """Draught over height of a block of ``density`` that floats upright in a tub, and how much still moves.

    Level by what is seen: the highest particles away from block and walls, and half a spacing of water above them."""

    def measure(density: float, height: float = 6, seconds: float = 1.5) -> tuple[float, float]:
        spacing, tub, depth, side = cell / 2, 20 * cell, 8 * cell, 8 * cell
        height *= cell
        sunk = density / 1000.0 * height
        bottom = depth - sunk
        places = lattice((-tub / 2, -tub / 2, 0), (tub / 2, tub / 2, depth), spacing)
        hole = (np.abs(places[:, :2]) < side / 2).all(axis=1) & (places[:, 2] > bottom)
        water = filled("water", WATER, places[~hole], spacing)
        block = box_body(
            name="block", center=(0.0, 0.0, bottom + height / 2), size=(side, side, height), density=density
        )
        world = in_tub([water, block], tub, cell, similarity, options)
        world.advance(seconds)
        found = []
        for _ in range(10):
            world.advance(0.05)
            at = world.positions(0)
            away = (np.abs(at[:, :2]).max(axis=1) > 6 * cell) & (np.abs(at[:, :2]).max(axis=1) < 8.5 * cell)
            level = np.quantile(at[away, 2], 0.98) + spacing / 2
            found.append((level - (world.pose("block").center[2] - height / 2)) / height)
        return float(np.mean(found)), float(np.ptp(found))

    return measure


@pytest.mark.long
@pytest.mark.parametrize("density", [500.0])
def test_a_wooden_block_floats_at_its_archimedes_draught(floating, density):
    """Of its height by its density over the water's, within 2 % (the issue's)."""
    draught, _ = floating(density)
    assert draught == pytest.approx(density / 1000.0, rel=0.02)


@pytest.fixture
def sunk_ball(ball_body, similarity, options, cell):
    """A steel ball dropped on a bed of sand: heights of its lowest point over time, and the world."""

    def measure(seconds: float = 1.0):
        spacing, tub, depth, radius = cell / 2, 18 * cell, 8 * cell, 2.5 * cell
        sand = filled("sand", SAND, lattice((-tub / 2, -tub / 2, 0), (tub / 2, tub / 2, depth), spacing), spacing)
        ball = ball_body(
            name="ball",
            center=(0, 0, depth + radius + 0.5 * cell),
            radius=radius,
            density=7800.0,
            velocity=(0, 0, -1.5),
        )
        world = World(
            bodies=[sand, ball],
            ground=Ground(friction=0.6),
            colliders=walls((tub, tub), 14 * cell),
            similarity=similarity,
            options=options,
        )
        heights = []
        for _ in range(20):
            world.advance(seconds / 20)
            heights.append(float(world.pose("ball").center[2]) - radius)
        return np.array(heights), depth, radius, world

    return measure


@pytest.mark.long
def test_a_ball_of_steel_sinks_into_sand_and_stays(sunk_ball, cell):
    """It sits deeper than 0.3 of its radius, has not reached the floor, holds no grain, and in the last quarter
    of a second stays within 0.1 cell, what this folder allows at rest (measured: 1.63 deep, quivering by 0.01)."""
    heights, depth, radius, world = sunk_ball()
    deep = depth - heights
    assert np.ptp(heights[-6:]) < 0.1 * cell
    assert deep[-1] > 0.3 * radius and heights[-1] > cell
    away = np.linalg.norm(world.positions(0) - world.pose("ball").center, axis=1)
    assert away.min() > radius - 0.1 * cell


@pytest.fixture
def soft_bowl(similarity, options, cell):
    """A bowl of jelly with walls and a floor ``wall`` cells thick, full of water: shares of it outside over time."""

    def measure(wall: int, seconds: float, looks: int):
        spacing, inner, depth, rim = cell / 2, 8 * cell, 4 * cell, 6 * cell
        half, thick = inner / 2, wall * cell
        places = lattice((-half - thick, -half - thick, 0), (half + thick, half + thick, rim), spacing)
        hollow = (np.abs(places[:, :2]) < half).all(axis=1) & (places[:, 2] > thick)
        bowl = filled(
            "bowl", ElasticMaterial(density=1000.0, youngs_modulus=5e5, poisson_ratio=0.3), places[~hollow], spacing
        )
        water = filled("water", WATER, lattice((-half, -half, thick), (half, half, thick + depth), spacing), spacing)
        world = World(bodies=[bowl, water], ground=Ground(friction=0.6), similarity=similarity, options=options)
        lost = []
        for _ in range(looks):
            world.advance(seconds / looks)
            at, ring = world.positions(1), world.positions(0)
            # Outside is below the floor's middle or beyond the wall's, as these stand now.
            far = np.abs(at[:, :2]).max(axis=1) > np.abs(ring[:, :2]).max(axis=1).max() - thick / 2
            under = at[:, 2] < 0.5 * thick
            lost.append(int((far | under).sum()))
        return np.array(lost), world

    return measure


@pytest.mark.long
@pytest.mark.parametrize("wall", [1, 2])
def test_water_stands_in_a_soft_bowl(soft_bowl, wall):
    """Walls of one and of two cells: not one particle of water is in the outer half of a wall, or beyond, for 0.6 s
    (1,260 substeps)."""
    lost, _ = soft_bowl(wall, 0.6, 4)
    assert lost.max() == 0


@pytest.mark.long
def test_the_layer_on_a_soft_floor_bears_the_water_above_it(soft_bowl, cell):
    """At least two thirds of it in the half cell on the middle of the floor, a cell thick, mean from 0.6 to 0.8 s.
    Where nodes behind the face took both bodies for apart it bore a quarter, sank, and the floor swelled."""
    _, world = soft_bowl(1, 0.6, 1)
    start = world.bodies[1].positions
    lowest = (start[:, 2] < start[:, 2].min() + 1e-6) & (np.abs(start[:, :2]).max(axis=1) < 2 * cell)
    loads = []
    for _ in range(8):
        world.advance(0.025)
        loads.append(np.mean(WATER.bulk_modulus / 7 * (np.exp(-7 * world.memories(1)[lowest]) - 1)))
    assert np.mean(loads) > 2 / 3 * 1000.0 * 9.81 * np.ptp(start[:, 2])


@pytest.mark.slow
def test_a_soft_bowl_holds_its_water_for_ten_thousand_substeps(soft_bowl):
    """Walls of one cell, as above. Water left through the corners after 2,000 where nodes alone told its distance."""
    lost, world = soft_bowl(1, 4.8, 12)
    assert world.substeps > 10_000
    assert lost.max() == 0


@pytest.mark.slow
def test_water_that_sloshes_keeps_its_volume(similarity, options, cell):
    """A column of eight cells breaks in a tub three times as long: height of its centre of mass within 3 % (the
    issue's) of that of the same water at rest, mean over the second after 3.5 s, two swings. Packed on the floor, where
    crowding counted next to nothing, it stood 23 % too low."""
    spacing, side, depth, length = cell / 2, 8 * cell, 8 * cell, 24 * cell
    places = lattice((-length / 2, -side / 2, 0), (-length / 2 + side, side / 2, depth), spacing)
    world = World(
        bodies=[filled("water", WATER, places, spacing)],
        ground=Ground(friction=0.0),
        colliders=walls((length, side), 30 * cell),
        contacts=ContactTable(default=SurfaceContact(friction=0.0)),
        similarity=similarity,
        options=options,
    )
    world.advance(3.5)
    heights = []
    for _ in range(16):
        world.advance(1 / 16)
        heights.append(world.positions(0)[:, 2].mean())
    assert 2 * np.mean(heights) == pytest.approx(depth * side / length, rel=0.03)


def test_rigid_soft_granular_and_fluid_keep_their_momentum_together(box_body, similarity, options, cell):
    """Four blocks that fly at each other, no weight and no ground: momentum within 1e-4 of the sum of all |m v|."""
    spacing, side = cell / 2, 4 * cell
    soft = ElasticMaterial(density=1000.0, youngs_modulus=1e5, poisson_ratio=0.3)
    bodies = []
    for name, material, corner, velocity in (
        ("jelly", soft, (-1, 0), (2.0, 0.1, 0.0)),
        ("sand", SAND, (1, 0), (-2.0, 0.0, 0.1)),
        ("water", WATER, (0, 1), (0.0, -2.0, 0.0)),
    ):
        low = np.array([corner[0] * 1.3 * side - side / 2, corner[1] * 1.3 * side - side / 2, 0.0])
        bodies.append(filled(name, material, lattice(low, low + side, spacing), spacing, velocity=velocity))
    bodies.append(
        box_body(
            name="wood", center=(0.0, -1.3 * side, side / 2), size=(side,) * 3, density=500.0, velocity=(0, 2.0, 0)
        )
    )
    world = World(bodies=bodies, gravity=(0, 0, 0), similarity=similarity, options=options)
    before = world.linear_momentum()
    scale = sum(float(b.masses.sum()) * float(np.linalg.norm(b.velocity)) for b in bodies)
    world.advance(0.15)
    moved = [np.linalg.norm(world.velocities(i).mean(axis=0) - b.velocity) for i, b in enumerate(bodies[:3])]
    assert min(moved) > 0.2, "all of them met"
    assert np.linalg.norm(world.pose("wood").velocity - (0, 2.0, 0)) > 0.2
    assert np.abs(world.linear_momentum() - before).max() < 1e-4 * scale


@pytest.mark.long
def test_a_tower_of_ten_boxes_is_at_rest_from_the_start(box_body, rigid_bodies):
    """Within 1 mm/s at every tenth of the first half second. Sweeps alone leave 12 mm/s: they do not converge."""
    bodies = tuple(box_body(name=f"box{i}", center=(0.0, 0.0, 0.1 + 0.2 * i)) for i in range(10))
    world = rigid_bodies(WorldSetup(bodies=bodies, ground=Ground(friction=0.5)))
    for _ in range(5):
        world.advance(1e-3, 100)
        assert max(np.linalg.norm(world.pose(0, f"box{i}").velocity) for i in range(10)) < 1e-3


@pytest.mark.slow
def test_a_tower_of_ten_boxes_stands_for_ten_seconds(box_body, rigid_bodies):
    """Drift below 1 % of a box's size, at rest within 1 mm/s."""
    bodies = tuple(box_body(name=f"box{i}", center=(0.0, 0.0, 0.1 + 0.2 * i)) for i in range(10))
    world = rigid_bodies(WorldSetup(bodies=bodies, ground=Ground(friction=0.5)))
    world.advance(1e-3, 10_000)
    drift = [np.linalg.norm(world.pose(0, f"box{i}").center - [0, 0, 0.1 + 0.2 * i]) / 0.2 for i in range(10)]
    assert max(drift) < 0.01
    assert max(np.linalg.norm(world.pose(0, f"box{i}").velocity) for i in range(10)) < 1e-3


DOMINO = (0.04, 0.12, 0.24)
"""Thickness, width and height of a domino in metres."""
PITCH = 0.12
COUNT = 20
START_SPIN = 1.5
"""rad/s that the first domino starts with: enough to go over its edge."""
FALLEN = np.radians(10.0)


def passing_times(angles: np.ndarray, step: float) -> np.ndarray:
    """First time at which each domino (columns of ``angles``, rad) leans by FALLEN, linear between samples."""
    times = []
    for lean in angles.T:
        i = int(np.argmax(lean > FALLEN))
        assert lean[i] > FALLEN, "a domino stands"
        times.append(step * (i - (lean[i] - FALLEN) / (lean[i] - lean[i - 1])))
    return np.array(times)


def mujoco_row(friction: float, step: float = 2e-4, seconds: float = 3.0) -> np.ndarray:
    """The same row in MuJoCo: stiff contacts, elliptic cones; lean (T, COUNT) in rad."""
    mujoco = pytest.importorskip("mujoco")
    x, y, z = (s / 2 for s in DOMINO)
    bodies = "".join(
        f'<body name="d{i}" pos="{i * PITCH} 0 {z}"><freejoint/>'
        f'<geom type="box" size="{x} {y} {z}" density="600"/></body>'
        for i in range(COUNT)
    )
    xml = (
        f'<mujoco><option timestep="{step}" cone="elliptic" impratio="10" integrator="implicitfast"/>'
        f'<default><geom friction="{friction} 0 0" condim="3" solref="{2.5 * step} 1" solimp="0.95 0.99 0.0005"/>'
        "</default>"
        f'<worldbody><geom type="plane" size="10 10 1"/>{bodies}</worldbody></mujoco>'
    )
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    data.qvel[4] = START_SPIN
    # About its lower front edge, as ``row`` starts it.
    data.qvel[0], data.qvel[2] = START_SPIN * z, START_SPIN * x
    lean = []
    for i in range(int(seconds / step)):
        mujoco.mj_step(model, data)
        if i % 5 == 4:
            lean.append(np.arccos(np.clip(data.xmat.reshape(-1, 3, 3)[1:, 2, 2], -1, 1)))
    return np.array(lean)


def row(rigid_bodies, friction: float, step: float = 1e-3, seconds: float = 3.0) -> np.ndarray:
    """Lean (T, COUNT) in rad of the dominoes here."""
    x, y, z = (s / 2 for s in DOMINO)
    mesh = trimesh.creation.box(DOMINO)
    bodies = []
    for i in range(COUNT):
        middle = np.array([i * PITCH, 0.0, z])
        places = lattice((-x, -y, -z), (x, y, z), DOMINO[0] / 4) + middle
        first = {"velocity": (START_SPIN * z, 0, START_SPIN * x), "spin": (0, START_SPIN, 0)} if i == 0 else {}
        bodies.append(
            BodyParticles(
                name=f"d{i}",
                positions=places,
                volumes=np.full(len(places), np.prod(DOMINO) / len(places)),
                material=RigidMaterial(density=600.0),
                surface=Surface(vertices=np.asarray(mesh.vertices) + middle, faces=np.asarray(mesh.faces)),
                **first,
            )
        )
    contact = SurfaceContact(friction=friction)
    world = rigid_bodies(
        WorldSetup(bodies=tuple(bodies), ground=Ground(friction=friction), contacts=ContactTable(default=contact))
    )
    lean = []
    for _ in range(int(seconds / step)):
        world.advance(step, 1)
        lean.append([np.arccos(np.clip(world.pose(0, f"d{i}").rotation[2, 2], -1, 1)) for i in range(COUNT)])
    return np.array(lean)


@pytest.mark.slow
@pytest.mark.parametrize("friction", [0.2])
def test_a_row_of_twenty_dominoes_falls_as_fast_as_in_mujoco(rigid_bodies, friction):
    """Dominoes a second between the fifth and the fifteenth, within 5 % (the issue's)."""
    theirs = passing_times(mujoco_row(friction), 1e-3)
    ours = passing_times(row(rigid_bodies, friction), 1e-3)
    assert 10 / (ours[14] - ours[4]) == pytest.approx(10 / (theirs[14] - theirs[4]), rel=0.05)
