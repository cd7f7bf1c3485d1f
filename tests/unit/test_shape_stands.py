# SPDX-License-Identifier: MIT
"""How safely bodies stand: margins of known shapes, and what counts as their base."""

import tomllib

import numpy as np
import pytest
import trimesh
from physgen.sim.app.bake_quality import QUALITY_FOLDER
from physgen.sim.reconstruct.shape.support import COARSEST_CELLS, COARSEST_PARTICLES, support_of


def support(mesh):
    return support_of(np.asarray(mesh.vertices, dtype=float), np.asarray(mesh.faces))


def test_a_box_and_a_cone_stand_as_geometry_says():
    """A box by half its width; a cone by its radius, its centre of mass a quarter up; on its tip it has no base."""
    box = support(trimesh.creation.box((0.2, 0.3, 0.5)))
    assert (box.margin, box.inradius, box.height, box.volume) == pytest.approx((0.1, 0.1, 0.5, 0.03))
    assert box.wanted == pytest.approx(max(0.15 * 0.5, 2.0 * (0.03 * 8 / 6000) ** (1 / 3)))
    cone = trimesh.creation.cone(radius=0.1, height=0.3, sections=360)
    assert support(cone).margin == pytest.approx(0.1, rel=1e-3)
    cone.apply_transform(np.diag([1.0, -1.0, -1.0, 1.0]))
    assert support(cone).margin == -np.inf


def test_a_leaning_body_topples_by_as_much_as_it_leans():
    leaning = trimesh.creation.box((0.2, 0.2, 0.4))
    vertices = np.asarray(leaning.vertices).copy()
    vertices[:, 0] += 0.7 * (vertices[:, 2] + 0.2)
    assert support_of(vertices, np.asarray(leaning.faces)).margin == pytest.approx(0.1 - 0.7 * 0.2)


def test_a_film_on_the_ground_is_no_base():
    """A disc of 0.2 mm around the foot of a box of 10 cm, cells of 1.1 cm: the box stands on its own foot only."""
    box = trimesh.creation.box((0.1, 0.1, 0.1)).subdivide().subdivide()
    box.apply_translation((0, 0, 0.05))
    film = trimesh.creation.cylinder(radius=0.2, height=2e-4, sections=64)
    film.apply_translation((0.15, 0, 1e-4))
    both = support(trimesh.util.concatenate([box, film]))
    # The film's own weight moves the centre of mass by 2.5 % of 15 cm.
    assert both.margin == pytest.approx(0.05, abs=0.005)


def test_the_coarsest_quality_is_the_coarsest():
    found = [tomllib.loads(path.read_text(encoding="utf-8")) for path in QUALITY_FOLDER.glob("*.toml")]
    coarse = [quality for quality in found if "grid" not in quality]
    assert min(quality["particles"] for quality in coarse) == COARSEST_PARTICLES
    assert min(quality["smallest_cells"] for quality in coarse) == COARSEST_CELLS
