# SPDX-License-Identifier: MIT
"""From a scene to the engine's world, without the engine: what is passed on, and what is refused before it starts."""

import dataclasses
import math

import numpy as np
import pytest
import trimesh
from physgen.sim.app.bake_estimate import estimate_bake
from physgen.sim.app.bake_options import BakeOptions, inputs_hash
from physgen.sim.app.scene_to_world_checks import BOX_BODIES, cell_size, vertices_at
from physgen.sim.constitutive import RigidMaterial
from physgen.sim.errors import InputError
from physgen.sim.mpm.geometry.signed_distance import overlap, signed_distance
from physgen.sim.mpm.scene_contacts import contact_table
from physgen.sim.scene.bake_quality import load_quality, quality_names
from physgen.sim.scene.folder import save_scene
from physgen.sim.scene.material import load_preset
from physgen.sim.scene.meshes import load_object_mesh
from physgen.sim.scene.model import Box, Contact, Effect, Ground, Key, Material, Motion, SceneObject
from scipy.spatial import cKDTree

OPTIONS = BakeOptions(frames=25, fps=24.0, quality="preview")
UP = (Key(time_s=0.0, value=(0.0, 0.0, 0.0)), Key(time_s=1.0, value=(0.0, 0.0, 0.2)))
RADIUS = 0.05
RISE = np.array([0.0, 0.0, 0.1])


@pytest.fixture
def world(ball_scene):
    """A factory of prepared worlds: balls, with changes to the first ball and to the scene."""

    def make(item=None, count=1, extra=(), **changes):
        folder = ball_scene(count=count, velocity=(0.0, 0.0, 0.0), **changes)
        first = dataclasses.replace(folder.model.objects[0], **(item or {}))
        objects = (first, *folder.model.objects[1:], *extra)
        return save_scene(folder.root, dataclasses.replace(folder.model, objects=objects))

    return make


def a_wall(**changes):
    return SceneObject(name="wall", mesh="meshes/ball0.glb", size_m=0.1, role="collider", **changes)


def away(x):
    """A place x m to the right."""
    return ((1.0, 0.0, 0.0, x), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0))


def lifted(z):
    """A place z m up."""
    return ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, z), (0.0, 0.0, 0.0, 1.0))


def test_a_rigid_ball_has_its_mesh(world):
    body = estimate_bake(world({"material": load_preset("wood")}), OPTIONS).setup.bodies[0]
    assert body.rigid and isinstance(body.material, RigidMaterial) and body.material.density == 550.0
    assert len(body.surface.vertices) == 642
    assert body.masses.sum() == pytest.approx(550 * 4 / 3 * math.pi * RADIUS**3, rel=0.02)


def test_tracks_goals_and_pins_reach_the_body(world):
    top = Box(low=(-1.0, -1.0, 0.08), high=(1.0, 1.0, 1.0))
    item = {
        "pins": (top,),
        "pin_motion": UP,
        "acceleration": UP,
        "velocity_keys": UP,
        "goal_stiffness": 5.0,
        "goal_damping": 0.5,
        "start_time": 0.25,
    }
    prepared = estimate_bake(world(item, gravity_track=UP), OPTIONS)
    body = prepared.setup.bodies[0]
    assert np.array_equal(body.pins, body.positions[:, 2] >= 0.08) and 0 < body.pins.sum() < body.count
    for track in (body.pin_motion, body.acceleration, body.velocity_keys, prepared.setup.gravity_track):
        np.testing.assert_allclose(track.at(0.5), (0, 0, 0.1))
    assert (body.goal_stiffness, body.goal_damping, body.start_time) == (5.0, 0.5, 0.25)


def test_a_box_of_pins_beside_the_body_is_refused(world):
    with pytest.raises(InputError, match=r"object ball0: pins\[0\].*move or enlarge"):
        estimate_bake(world({"pins": (Box(low=(5.0, 5.0, 5.0), high=(6.0, 6.0, 6.0)),)}), OPTIONS)
    with pytest.raises(InputError, match=r"object ball0.*rigid"):
        estimate_bake(world({"material": Material(law="rigid"), "goal_stiffness": 1.0}), OPTIONS)


def test_a_shell_weighs_what_its_thickness_says(world):
    whole = estimate_bake(world(), OPTIONS).setup.bodies[0]
    prepared = estimate_bake(world({"fill": False, "shell_thickness": 0.02}), OPTIONS)
    shell = prepared.setup.bodies[0]
    spacing = prepared.solver.particle_spacing(prepared.similarity)
    inner = RADIUS - 0.02
    expected = 1 - (inner / RADIUS) ** 3
    error = 3 * inner**2 * 0.5 * spacing / RADIUS**3
    assert shell.volumes.sum() / whole.volumes.sum() == pytest.approx(expected, abs=error)
    from_middle = np.linalg.norm(shell.positions - (0, 0, 0.052), axis=1)
    # The ball's flat faces lie up to 0.3 % inside its radius.
    assert from_middle.min() > inner - 0.003 * RADIUS
    with pytest.raises(InputError, match=r"object ball0: shell_thickness.*spacing"):
        estimate_bake(world({"fill": False, "shell_thickness": 0.001}), OPTIONS)


@pytest.mark.parametrize(("millimetres", "told"), [(1.5, True), (8.0, False)])
def test_a_leaf_has_its_thickness_and_says_when_it_is_too_thin(world, millimetres, told):
    """Beside a ball, whose cells are 8 to 9 mm: a sheet is thin, a ball is not; the line names object and remedy."""
    folder = world()
    trimesh.creation.box((0.1, 0.1, millimetres / 1000)).export(folder.root / "meshes" / "leaf.glb")
    leaf = SceneObject(
        name="leaf", mesh="meshes/leaf.glb", size_m=0.1, material=load_preset("soft"), world_from_mesh=lifted(0.2)
    )
    model = dataclasses.replace(folder.model, objects=(*folder.model.objects, leaf))
    prepared = estimate_bake(save_scene(folder.root, model), OPTIONS)
    ball, sheet = prepared.setup.bodies
    assert ball.thickness is None
    assert sheet.thickness == pytest.approx(millimetres / 1000, rel=1e-3)
    lines = [line for line in prepared.warnings if "leaf" in line]
    assert len(lines) == told
    if told:
        assert "object leaf: 0.0015 m thick" in lines[0] and "or bake with a finer quality" in lines[0]
        half = 0.5 * prepared.solver.cell_size(prepared.similarity)
        assert f"make it {half:.2g} m thick" in lines[0]


def test_colliders_move_as_the_scene_says(world):
    quarter = (Key(time_s=0.0, value=(0.0, 0.0, 0.0)), Key(time_s=1.0, value=(0.0, 0.0, math.pi / 2)))
    wall = a_wall(world_from_mesh=away(0.5), motion=Motion(translations=UP, rotations=quarter, pivot=(0.0, 0.0, 0.0)))
    prepared = estimate_bake(world(extra=(wall,)), OPTIONS)
    assert (prepared.body_of_object, prepared.collider_of_object) == ((0, None), (None, 0))
    collider = prepared.setup.colliders[0]
    rest = collider.surface.vertices
    np.testing.assert_array_equal(vertices_at(collider, 0.0), rest)
    turned = np.stack([-rest[:, 1], rest[:, 0], rest[:, 2] + 0.2], axis=1)
    np.testing.assert_allclose(vertices_at(collider, 2.0), turned, atol=1e-12)
    half = math.sqrt(0.5)
    np.testing.assert_allclose(vertices_at(collider, 0.5)[:, 0], half * rest[:, 0] - half * rest[:, 1], atol=1e-12)


def test_a_deforming_collider_reads_its_file_and_counts_in_the_hash(world):
    folder = world()
    rest = load_object_mesh(folder, a_wall(world_from_mesh=away(0.5))).vertices
    vertices = np.stack([rest, rest + RISE])
    np.savez(folder.root / "meshes/wall.npz", times=np.array([0.0, 1.0]), vertices=vertices)
    wall = a_wall(world_from_mesh=away(0.5), motion=Motion(vertices_file="meshes/wall.npz"))
    folder = save_scene(folder.root, dataclasses.replace(folder.model, objects=(*folder.model.objects, wall)))
    prepared = estimate_bake(folder, OPTIONS)
    assert not [w for w in prepared.warnings if "jumps" in w]
    np.testing.assert_allclose(vertices_at(prepared.setup.colliders[0], 0.5), rest + RISE / 2, atol=1e-7)
    before = inputs_hash(folder, OPTIONS)
    np.savez(folder.root / "meshes/wall.npz", times=np.array([0.0, 1.0]), vertices=vertices + 0.02)
    assert inputs_hash(folder, OPTIONS) != before
    assert [w for w in estimate_bake(folder, OPTIONS).warnings if "jumps" in w]


def test_rigid_matter_bounces_where_nothing_else_says_how(world):
    model = world(count=4, preset="soft").model
    wood, metal = load_preset("wood"), load_preset("metal")
    quiet = dataclasses.replace(model.objects[1], material=metal, restitution=0.0)
    objects = (
        dataclasses.replace(model.objects[0], material=wood),
        quiet,
        model.objects[2],
        dataclasses.replace(model.objects[3], material=metal),
    )
    table = contact_table(dataclasses.replace(model, objects=objects))
    assert table.between("ball0", "ground").restitution == wood.rigid_restitution > 0
    assert table.between("ball0", "ball3").restitution == min(wood.rigid_restitution, metal.rigid_restitution)
    for other in ("ball1", "ball2"):
        assert table.between("ball0", other).restitution == table.between(other, "ground").restitution == 0.0
    scene = dataclasses.replace(model, objects=objects, ground=Ground(restitution=0.2))
    assert contact_table(scene).between("ball0", "ground").restitution == 0.2


def test_surfaces_combine_by_the_documented_rules(world):
    folder = world(
        {"friction": 0.1, "restitution": 0.5, "contact_mode": "slip"},
        count=3,
        ground=Ground(friction=0.4, static_friction=0.9, restitution=0.2),
    )
    rough = dataclasses.replace(folder.model.objects[1], roughness=1.0)
    objects = (folder.model.objects[0], rough, folder.model.objects[2])
    named = (Contact(between=("ball0", "ball2"), friction=0.7, adhesion=2.0), Contact(between=("ground", "ball1")))
    table = contact_table(dataclasses.replace(folder.model, objects=objects, contacts=named))
    icy = table.between("ball0", "ground")
    assert icy.friction == pytest.approx(math.sqrt(0.1 * 0.4)) and icy.static_friction == pytest.approx(0.3)
    assert (icy.restitution, icy.mode) == (0.5, "slip")
    assert table.between("ball1", "ball2").friction == pytest.approx(math.sqrt(0.95 * 0.4))
    own = table.between("ball2", "ground")
    assert (own.friction, own.static_friction, own.restitution, own.mode) == (0.4, 0.9, 0.2, "separate")
    given = table.between("ball2", "ball0")
    assert (given.friction, given.adhesion, given.restitution, given.mode) == (0.7, 2.0, 0.5, "slip")
    assert table.between("ball1", "ground").friction == pytest.approx(math.sqrt(0.95 * 0.4))


def test_a_scene_without_surfaces_has_no_pairs(world):
    folder = world(count=2, ground=Ground(friction=0.3))
    table = contact_table(folder.model)
    assert not table.pairs and table.default.friction == 0.3


@pytest.mark.parametrize(("height", "refused"), [(0.05, False), (0.047, False), (0.02, True), (-1.0, True)])
def test_a_body_sunk_in_the_ground_is_refused_by_name_and_depth(world, height, refused):
    folder = world(height=height)
    if not refused:
        estimate_bake(folder, OPTIONS)
        return
    with pytest.raises(InputError, match=rf"object ball0.*{RADIUS - height:.3g} m below the ground: lift it"):
        estimate_bake(folder, OPTIONS)


@pytest.mark.parametrize(
    ("distance", "outcome"),
    [(0.11, "free"), (0.1, "free"), (0.096, "pushed"), (0.08, "hollow"), (0.05, "hollow"), (0.0, "still")],
)
@pytest.mark.parametrize("material", ["jelly", "wood"])
def test_bodies_in_each_other_are_made_to_share_no_space(world, distance, outcome, material):
    matter = load_preset(material)
    other = SceneObject(
        name="other", mesh="meshes/ball0.glb", size_m=0.1, world_from_mesh=away(distance), material=matter
    )
    prepared = estimate_bake(world({"material": matter}, extra=(other,)), OPTIONS)
    warnings = [w for w in prepared.warnings if "other" in w]
    words = {"pushed": "pushed apart", "hollow": "hollow", "still": "stays where it is"}
    assert [outcome in words and words[outcome] in w for w in warnings] == [True] * (outcome != "free")
    a, b = prepared.setup.bodies
    spacing = prepared.solver.particle_spacing(prepared.similarity)
    if outcome == "hollow":
        # Half a particle from the other's surface, which may be a particle's place; the lattice rounds a little off.
        assert cKDTree(a.positions).query(b.positions)[0].min() > 0.45 * spacing
        middles = [np.array([0.0, 0.0, 0.052]), np.array([distance, 0.0, 0.052])]
        for body, own, foreign in zip((a, b), middles, middles[::-1], strict=True):
            assert (np.linalg.norm(body.positions - own, axis=1) < 1.01 * RADIUS).all()
            if body.rigid and len(body.surface.vertices) != 642:
                skin = body.surface.vertices
                # Flat faces and the lattice cut corners by 1 % at most.
                assert np.linalg.norm(skin - foreign, axis=1).min() > 0.99 * RADIUS
                assert np.linalg.norm(skin - own, axis=1).max() < 1.01 * RADIUS
    elif outcome == "still":
        assert min(a.start_time, b.start_time) == 0.0 and max(a.start_time, b.start_time) > prepared.duration


def test_bodies_that_come_in_at_different_times_keep_their_shape(world):
    other = SceneObject(name="other", mesh="meshes/ball0.glb", size_m=0.1, world_from_mesh=away(0.05), start_time=1.0)
    prepared = estimate_bake(world(extra=(other,)), OPTIONS)
    assert len({body.count for body in prepared.setup.bodies}) == 1
    assert not [w for w in prepared.warnings if "other" in w]


@pytest.mark.parametrize("kind", ["thin", "self-intersecting"])
def test_odd_meshes_are_told_by_name(world, kind):
    folder = world()
    # Alone it has cells of 2.4 mm, and contact of soft sheets is right from half a cell on.
    mesh = trimesh.creation.box((0.1, 0.1, 0.001))
    if kind == "self-intersecting":
        ball = trimesh.creation.icosphere(subdivisions=2, radius=RADIUS)
        mesh = trimesh.util.concatenate([ball, ball.copy().apply_translation((0.04, 0, 0))])
    mesh.apply_translation((0, 0, 0.06))
    mesh.export(folder.root / "meshes/ball0.glb")
    quality = dataclasses.replace(OPTIONS, quality="preview")
    assert any("ball0" in warning for warning in estimate_bake(folder, quality).warnings)


def test_a_body_in_a_collider_has_room_there(world):
    prepared = estimate_bake(world(extra=(a_wall(world_from_mesh=away(0.06)),)), OPTIONS)
    assert any("wall has a hollow" in warning for warning in prepared.warnings)
    wall, ball = prepared.setup.colliders[0].surface, prepared.setup.bodies[0]
    assert overlap(ball.positions, signed_distance(wall, 0.002, margin=0.0)) < 0.0005
    # One that moves keeps its shape, because its vertices are those of its mesh file.
    moving = a_wall(world_from_mesh=away(0.06), motion=Motion(translations=UP))
    led = estimate_bake(world(extra=(moving,)), OPTIONS)
    assert any("simulated without that part" in warning for warning in led.warnings)
    assert len(led.setup.colliders[0].surface.vertices) == 642 and led.setup.bodies[0].count < ball.count
    assert (
        estimate_bake(world(extra=(a_wall(world_from_mesh=away(0.12)),)), OPTIONS).setup.bodies[0].count == ball.count
    )


def broken(kind):
    ball = trimesh.creation.icosphere(subdivisions=2, radius=RADIUS)
    ball.apply_translation((0, 0, 0.06))
    if kind == "open":
        ball.update_faces(np.arange(len(ball.faces)) > 10)
    elif kind == "flat":
        ball.vertices[:, 2] = 0.06
    elif kind == "point":
        ball.vertices[:] = 0.06
    elif kind == "paper":
        ball.vertices[:, 2] = 0.06 + (ball.vertices[:, 2] - 0.06) * 1e-14
    return ball


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("open", "not closed.*fill its holes"),
        ("flat", "volume|extent|area"),
        ("point", "extent|area"),
        ("paper", "volume|area"),
    ],
)
def test_meshes_that_cannot_be_filled_are_refused_by_the_objects_name(world, kind, words):
    folder = world()
    broken(kind).export(folder.root / "meshes/ball0.glb")
    with pytest.raises(InputError, match=f"object ball0: .*({words})"):
        estimate_bake(folder, OPTIONS)


def test_a_pea_beside_a_house_is_refused_before_a_billion_particles(world):
    big = 400.0
    house = SceneObject(
        name="house",
        mesh="meshes/ball0.glb",
        size_m=40.0,
        world_from_mesh=((big, 0, 0, 100.0), (0, big, 0, 0), (0, 0, big, 0), (0, 0, 0, 1.0)),
    )
    with pytest.raises(InputError, match=r"particles.*object ball0.*too fine for object house.*coarser quality"):
        estimate_bake(world(extra=(house,)), OPTIONS)


def test_an_unknown_effect_is_refused_by_name(world):
    with pytest.raises(InputError, match="a spell"):
        estimate_bake(world(effects=(Effect(name="a spell"),)), OPTIONS)


@pytest.mark.parametrize("name", quality_names())
def test_qualities_get_the_particles_they_want(world, name):
    quality = load_quality(name)
    if quality.particles > 50_000 or quality.grid is not None:
        assert name != "papers" or (quality.grid, quality.particles_per_cell) == (256, 8)
        return
    prepared = estimate_bake(world(), dataclasses.replace(OPTIONS, quality=name))
    assert prepared.particle_count == pytest.approx(quality.particles, rel=0.1)
    assert prepared.cost.substeps == math.ceil(1.0 / prepared.stable_step)


def test_the_papers_profile_has_256_cells_over_the_box(world):
    folder = world()
    mesh = load_object_mesh(folder, folder.model.objects[0])
    assert cell_size([mesh], load_quality("papers")) == pytest.approx(BOX_BODIES * 2 * RADIUS / 256)


def test_a_fall_back_to_the_processor_is_estimated_anew(world):
    fast = estimate_bake(world(), dataclasses.replace(OPTIONS, arch="cuda"))
    assert fast.on("cpu").cost.seconds > fast.cost.seconds and fast.on("cuda").cost == fast.cost
