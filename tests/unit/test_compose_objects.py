# SPDX-License-Identifier: MIT
"""Who fits whom: what touches is found, in order; what cannot be fitted is said with the way out."""

import numpy as np
import pytest
import trimesh
from physgen.sim.app.compose_inputs import contact_groups, ground_supports, read_compose_object, with_ground_slab
from physgen.sim.errors import InputError
from physgen.sim.mpm.colliders import Surface
from physgen.sim.mpm.geometry.signed_distance import signed_distance
from physgen.sim.scene.model import Ground

from .compose_scenes import a_scene, ball


def names(group):
    return [body.name for body in group.bodies]


@pytest.mark.long
def test_those_that_touch_hang_together_frontmost_first(tmp_path):
    meshes = {"a": ball(0), "b": ball(0.09), "far": ball(1), "c": ball(0.18), "x": ball(3), "y": ball(3.05)}
    found = contact_groups(a_scene(tmp_path / "s", meshes), (), cells=40)
    # What is listed last has the smallest occlusion order.
    assert sorted(map(names, found)) == [["c", "b", "a"], ["y", "x"]]
    folder = a_scene(tmp_path / "t", meshes, a={"role": "collider"})
    assert sorted(map(names, contact_groups(folder, (), cells=40))) == [["a", "c", "b"], ["y", "x"]]
    assert names(contact_groups(folder, ("a", "b"), cells=40)[0]) == ["a", "b"]


def test_the_one_that_passes_through_at_an_edge_is_found(tmp_path):
    """A thin wire through a coarse box: no vertex of either is near the other."""
    wire = trimesh.creation.cylinder(radius=0.001, height=2.0)
    folder = a_scene(tmp_path / "s", {"box": trimesh.creation.box((0.3, 0.3, 0.3)), "wire": wire})
    assert names(contact_groups(folder, (), cells=40)[0]) == ["wire", "box"]


@pytest.mark.parametrize(
    ("chosen", "words"),
    [
        ((), "'b' and 'a' do not touch: they are 20 cm apart"),
        (("a", "b"), "'a' and 'b' do not touch: they are 20 cm apart"),
        (("a",), "give at least two"),
        (("a", "a"), "every object once"),
        (("a", "q"), "there is no 'q'"),
    ],
)
def test_objects_apart_are_refused_with_their_distance(tmp_path, chosen, words):
    folder = a_scene(tmp_path / "s", {"a": ball(0), "b": ball(0.3)})
    with pytest.raises(InputError, match=words):
        contact_groups(folder, chosen, cells=40)


def test_impossible_meshes_are_refused(tmp_path):
    inner = a_scene(tmp_path / "in", {"seed": ball(0, 0.02), "fruit": ball(0)})
    with pytest.raises(InputError, match="'seed': is completely inside 'fruit'"):
        contact_groups(inner, (), cells=40)
    bowl = ball(0.08)
    bowl.update_faces(np.arange(len(bowl.faces)) > 5)
    with pytest.raises(InputError, match=r"'bowl': mesh is not closed.*fill its holes"):
        contact_groups(a_scene(tmp_path / "open", {"a": ball(0), "bowl": bowl}), (), cells=40)
    fixed = a_scene(tmp_path / "fixed", {"a": ball(0), "b": ball(0.08)}, b={"role": "collider"})
    with pytest.raises(InputError, match="'b': is a collider and cannot be deformed"):
        contact_groups(fixed, ("a", "b"), cells=40)
    two = a_scene(tmp_path / "two", {"a": ball(0), "b": ball(0.09), "c": ball(1), "d": ball(1.09)})
    with pytest.raises(InputError, match="do not touch"):
        contact_groups(two, ("a", "b", "c", "d"), cells=40)


def test_a_mirrored_mesh_has_its_faces_outward(tmp_path):
    mirror = ((-2.0, 0, 0, 1), (0, 1.0, 0, 0), (0, 0, 1.0, 0), (0, 0, 0, 1.0))
    folder = a_scene(tmp_path / "s", {"a": ball(0)}, a={"world_from_mesh": mirror})
    surface = read_compose_object(folder, folder.model.objects[0]).surface
    assert trimesh.Trimesh(surface.vertices, surface.faces).volume > 0


def test_the_ground_is_part_of_what_stays():
    stays = trimesh.creation.box((0.1, 0.1, 0.1), transform=trimesh.transformations.translation_matrix((0, 0, 0.05)))
    yields = Surface(vertices=np.asarray(ball(0.05).vertices), faces=np.asarray(ball(0).faces))
    tilted = np.array([0.0, 0.6, 0.8])
    for normal in ((0.0, 0.0, 1.0), tuple(tilted)):
        ground = Ground(normal=normal, point=(0.0, 0.0, -0.02))
        both = with_ground_slab(Surface(vertices=stays.vertices, faces=stays.faces), ground, [yields])
        lattice = signed_distance(both, 0.005, margin=0.0)
        below = np.array([0.09, 0.0, -0.02]) - 0.01 * np.asarray(normal)
        distance, way = lattice.at(np.array([below, (0.0, 0.0, 0.05)]))
        assert distance[0] == pytest.approx(-0.01, abs=1e-4) and distance[1] < 0
        assert way[0] / np.linalg.norm(way[0]) == pytest.approx(normal, abs=0.02)
    assert ground_supports(Ground(), yields) and not ground_supports(None, yields)
    assert not ground_supports(Ground(point=(0, 0, 0.05)), yields) and not ground_supports(
        Ground(point=(0, 0, -1)), yields
    )
