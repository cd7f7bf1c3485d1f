# SPDX-License-Identifier: MIT
"""Skins cut where matter parts: closed pieces, kept volumes, copies that coincide until their crack opens."""

import dataclasses

import numpy as np
import pytest
import trimesh
from physgen.sim.app.bake import bake, is_up_to_date
from physgen.sim.app.bake_options import BakeOptions
from physgen.sim.cache.bake_folder import free_bake, load_bake
from physgen.sim.cache.pc2 import Pc2Reader
from physgen.sim.cache.torn_skin_file import read_torn_skin, write_torn_skin
from physgen.sim.errors import InputError
from physgen.sim.scene.folder import load_scene, save_scene
from physgen.sim.scene.scene_object import Box
from physgen.sim.skinning import bind, deform
from physgen.sim.tearing.blocks import NEVER, make_blocks, opening_times, regrouped
from physgen.sim.tearing.cut_skin import tear

CUBE = trimesh.creation.box((1, 1, 1)).subdivide().subdivide()
AXIS = (np.arange(16) + 0.5) / 16 - 0.5
MATTER = np.stack(np.meshgrid(AXIS, AXIS, AXIS, indexing="ij"), -1).reshape(-1, 3)
WHOLE = np.tile(np.eye(3), (len(MATTER), 1, 1))
LAST = 7


def halves(sample):
    """Two halves that part along X from sample 3 on, 0.2 m a sample."""
    return MATTER + np.sign(MATTER[:, :1]) * [0.1, 0, 0] * max(0, sample - 2)


def parted(at=halves, known=True):
    blocks = make_blocks(MATTER, 1.0)
    opens = opening_times(blocks, [(s, at(s), WHOLE if known else None) for s in range(LAST + 1)])
    return opens, tear(CUBE.vertices, CUBE.faces, MATTER, blocks, opens)


def shape_of(motion, sample):
    regular = CUBE.vertices if sample == 0 else deform(bind(CUBE.vertices, MATTER), halves(sample), WHOLE)
    return motion.vertices(sample, regular, halves(sample), WHOLE)


def test_a_halved_cube_becomes_two_closed_halves_of_its_volume():
    _, motion = parted()
    assert motion.skin.first == 3
    places = shape_of(motion, LAST)
    pieces = trimesh.Trimesh(places, motion.skin.faces).split(only_watertight=False)
    assert len(pieces) == 2
    for piece in pieces:
        assert piece.is_watertight
        # The walls are uneven by an eighth of a block; what one half lacks the other has.
        assert piece.volume == pytest.approx(0.5, abs=0.01)
    assert sum(piece.volume for piece in pieces) == pytest.approx(1.0, abs=1e-4)


def test_no_triangle_of_the_skin_spans_the_gap():
    _, motion = parted()
    faces = motion.skin.faces[~motion.skin.inside]

    def longest(sample):
        at = shape_of(motion, sample)[faces]
        return np.linalg.norm(at - at[:, [1, 2, 0]], axis=2)

    assert (longest(LAST) / longest(0)).max() < 1.001
    whole = deform(bind(CUBE.vertices, MATTER), halves(LAST), WHOLE)[CUBE.faces]
    rest = CUBE.vertices[CUBE.faces]
    stretched = np.linalg.norm(whole - whole[:, [1, 2, 0]], axis=2) / np.linalg.norm(rest - rest[:, [1, 2, 0]], axis=2)
    assert stretched.max() > 3  # what the uncut skin does


@pytest.mark.parametrize("sample", range(3))
def test_until_it_parts_the_skin_is_the_mesh_and_copies_coincide(sample):
    _, motion = parted()
    places = shape_of(motion, sample)
    regular = CUBE.vertices if sample == 0 else deform(bind(CUBE.vertices, MATTER), MATTER, WHOLE)
    assert (places[: len(CUBE.vertices)] == regular).all()
    copies = np.flatnonzero(motion.skin.weights[:, 0] == 1)
    copies = copies[copies < len(places) - len(motion.depths)]
    assert (places[copies] == regular[motion.skin.parents[copies, 0]]).all()
    walls = places[motion.skin.faces[motion.skin.inside]].reshape(-1, 3)
    assert (np.abs(walls) <= 0.5).all()  # inside the cube, or on its skin


def test_texture_coordinates_of_the_skin_are_the_meshs():
    _, motion = parted()
    skin = motion.skin
    outer = ~skin.inside
    rest = shape_of(motion, 0)
    corners = np.einsum("tcb,tbi->tci", skin.corners[outer], CUBE.vertices[CUBE.faces[skin.source[outer]]])
    np.testing.assert_allclose(corners, rest[skin.faces[outer]], atol=1e-6)
    assert trimesh.Trimesh(rest, skin.faces[outer], process=False).area == pytest.approx(CUBE.area, rel=1e-6)


def test_a_crack_through_the_middle_of_blocks_leaves_no_block_between():
    axis = np.linspace(-0.5, 0.5, 17)
    matter = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    still = np.tile(np.eye(3), (len(matter), 1, 1))

    def at(sample):
        return matter + np.sign(matter[:, :1] - 1e-9) * [0.3, 0, 0] * max(0, sample - 2)

    blocks = make_blocks(matter, 1.0)
    blocks = regrouped(blocks, matter, at(LAST))
    opens = opening_times(blocks, [(s, at(s), still) for s in range(LAST + 1)])
    motion = tear(CUBE.vertices, CUBE.faces, matter, blocks, opens)
    places = motion.vertices(LAST, deform(bind(CUBE.vertices, matter), at(LAST), still), at(LAST), still)
    assert (np.abs(places[:, 0]) > 0.5).all()  # nothing lies in the gap, 3 m wide
    assert len(trimesh.Trimesh(places, motion.skin.faces).split(only_watertight=False)) == 2


def test_what_stretches_as_its_gradients_say_does_not_tear():
    pulled = np.tile(np.diag([4.0, 0.5, 0.5]), (len(MATTER), 1, 1))
    blocks = make_blocks(MATTER, 1.0)
    stretched = MATTER * [4.0, 0.5, 0.5]
    assert (opening_times(blocks, [(1, stretched, pulled)]) == NEVER).all()
    assert (opening_times(blocks, [(1, stretched, WHOLE)]) < NEVER).any()  # the same places, and no word of it


def test_what_flows_wide_is_filled_by_its_neighbours():
    pancake = np.random.default_rng(0).uniform([-2, -2, -0.03], [2, 2, 0.03], MATTER.shape)
    order = np.argsort(MATTER[:, 0], kind="stable")
    wide = np.empty_like(pancake)
    wide[order] = pancake[np.argsort(pancake[:, 0])]
    opens, _ = parted(lambda s: MATTER if s < 3 else wide, known=False)
    assert (opens < NEVER).mean() < 0.05


def test_a_crack_that_ends_inside_leaves_one_piece():
    def book(sample):
        lift = np.clip(MATTER[:, 2] + 0.1, 0, None) * 2 * max(0, sample - 2) * 0.2
        return MATTER + np.sign(MATTER[:, :1]) * np.stack([lift, 0 * lift, 0 * lift], axis=1)

    opens, motion = parted(book)
    assert 0 < (opens < NEVER).sum() < 100  # the whole section has a hundred bonds
    regular = deform(bind(CUBE.vertices, MATTER), book(LAST), WHOLE)
    mesh = trimesh.Trimesh(motion.vertices(LAST, regular, book(LAST), WHOLE), motion.skin.faces)
    skin = [piece for piece in mesh.split(only_watertight=False) if len(piece.faces) > 100]
    assert len(skin) == 1


def test_damaged_files_of_torn_skins_are_refused(tmp_path):
    _, motion = parted()
    path = tmp_path / "cube.torn.npz"
    write_torn_skin(path, motion.skin)
    sizes = len(CUBE.vertices), len(CUBE.faces)
    assert (read_torn_skin(path, *sizes).faces == motion.skin.faces).all()
    with pytest.raises(InputError, match="no torn skin"):
        read_torn_skin(path, sizes[0] // 2, sizes[1])
    whole, random = path.read_bytes(), np.random.default_rng(3)
    for _ in range(60):
        content = bytearray(whole)
        for at in random.integers(0, len(content), random.integers(1, 9)):
            content[at] = random.integers(256)
        path.write_bytes(content[: random.integers(len(content) // 2, len(content) + 1)])
        try:
            found = read_torn_skin(path, *sizes)
        except InputError:
            continue
        assert found.faces.max() < len(found.parents)
    for name, value in (("faces", motion.skin.faces + 10**6), ("weights", motion.skin.weights * np.nan)):
        write_torn_skin(path, dataclasses.replace(motion.skin, **{name: value}))
        with pytest.raises(InputError, match="bake again"):
            read_torn_skin(path, *sizes)


def test_a_bake_tears_what_is_thrown_from_its_pins(ball_scene, tmp_path):
    folder = ball_scene(preset="jelly", velocity=(8.0, 0.0, 2.0), height=0.2)
    item = dataclasses.replace(folder.model.objects[0], pins=(Box(low=(-0.1, -0.1, 0.0), high=(-0.02, 0.1, 0.4)),))
    scene = save_scene(folder.root, dataclasses.replace(folder.model, objects=(item,)))
    options = BakeOptions(frames=6, fps=48.0, quality="preview")
    found = bake(load_scene(scene.root), out=tmp_path / "bake", options=options)
    baked = found.manifest.objects[0]
    assert baked.torn > baked.vertices and 1 <= baked.torn_from < 6
    torn, regular = Pc2Reader(found.root / baked.torn_file), Pc2Reader(found.root / baked.file)
    for sample in range(baked.torn_from):
        assert (torn.sample(sample)[: baked.vertices] == regular.sample(sample)).all()
    assert not list((found.root / "checkpoints").glob("*.matter.npy"))
    assert is_up_to_date(load_scene(scene.root), found.root, options)
    assert {entry.file for entry in found.manifest.checksums} >= {baked.torn_file, baked.torn_skin}
    (found.root / baked.torn_skin).write_bytes(b"damaged")
    assert not is_up_to_date(load_scene(scene.root), found.root, options)
    again = bake(load_scene(scene.root), out=found.root, options=options)
    assert again.manifest.checksums == found.manifest.checksums
    assert load_bake(found.root).manifest == again.manifest
    free_bake(found.root)
    assert not found.root.exists()
