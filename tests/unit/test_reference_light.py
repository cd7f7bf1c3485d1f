# SPDX-License-Identifier: MIT
"""Reference lighting along a surface: across split vertices, and over what the photo hides."""

import numpy as np
from physgen.sim.composite.reference_light import SurfaceGraph

ROWS = 3


def tube(count, split):
    """A tube along x: ``ROWS`` rows of ``count`` vertices; those in the middle occur twice, unconnected."""
    x, turns = np.arange(count, dtype=float), 2 * np.pi / ROWS * np.arange(ROWS)
    vertices = np.concatenate([np.column_stack([x, 0 * x + np.cos(turn), 0 * x + np.sin(turn)]) for turn in turns])
    i = np.arange(count - 1)
    faces = []
    for row in range(ROWS):
        own, other = row * count + i, (row + 1) % ROWS * count + i
        faces += [np.column_stack([own, own + 1, other]), np.column_stack([own + 1, other + 1, other])]
    faces = np.concatenate(faces)
    if split:
        twice = np.arange(ROWS) * count + count // 2
        new = np.arange(len(vertices))
        new[twice] = len(vertices) + np.arange(ROWS)
        right = (vertices[faces].mean(axis=1)[:, 0] > count // 2)[:, None]
        faces = np.where(right, new[faces], faces)
        vertices = np.concatenate([vertices, vertices[twice]])
    return vertices, faces


def test_light_goes_on_behind_as_a_straight_line_between_what_is_seen():
    for split in (False, True):
        vertices, faces = tube(21, split)
        seen = (vertices[:, 0] < 4) | (vertices[:, 0] > 16)
        light = np.where(seen, 1.0 + 0.1 * vertices[:, 0], 0.0)[:, None] * (1.0, 0.5, 0.25)
        found = SurfaceGraph(vertices, faces).continued(light, seen)
        assert np.array_equal(found[seen], light[seen])
        # Each vertex has as many neighbours to the left as to the right: harmonic is linear, up to the weight HOLD.
        assert np.abs(found[:, 0] - (1.0 + 0.1 * vertices[:, 0])).max() < 1e-3


def test_smoothing_does_not_stop_where_vertices_are_split():
    vertices, faces = tube(21, False)
    split, split_faces = tube(21, True)
    step = (vertices[:, :1] > 10).astype(float)
    whole = SurfaceGraph(vertices, faces).smoothed(step, 3)
    parts = SurfaceGraph(split, split_faces).smoothed((split[:, :1] > 10).astype(float), 3)
    assert np.allclose(parts[: len(whole)], whole)
    assert np.array_equal(parts[-ROWS:], parts[[10, 31, 52]])


def test_hidden_objects_are_unchanged_and_loose_parts_get_the_mean():
    vertices, faces = tube(9, False)
    light = np.random.default_rng(0).uniform(0.5, 1.0, (len(vertices), 3))
    graph = SurfaceGraph(vertices, faces)
    assert np.array_equal(graph.continued(light, np.zeros(len(vertices), bool)), light)
    two = SurfaceGraph(np.concatenate([vertices, vertices + 50.0]), np.concatenate([faces, faces + len(vertices)]))
    seen = np.arange(2 * len(vertices)) < len(vertices)
    found = two.continued(np.concatenate([light, 0 * light]), seen)
    assert np.allclose(found[len(vertices) :], light.mean(axis=0))
