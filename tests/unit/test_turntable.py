# SPDX-License-Identifier: GPL-3.0-or-later
"""Turntables show bodies as they are: nearest surface, in perspective, from the side that the angle says."""

import math

import numpy as np
import pytest
import trimesh
from physgen.sim.reconstruct import mesh_raster, turntable
from physgen.sim.reconstruct.mesh_raster import Paint, colours, paint_of, rasterise
from PIL import Image

QUAD = np.array([[0, 1, 2], [0, 2, 3]])


def projected(points, focal=100.0, middle=50.0):
    points = np.asarray(points, dtype=np.float64)
    flat = focal * points[:, :2] / points[:, 2:] + middle
    return np.concatenate([flat, points[:, 2:]], axis=1)


def test_a_tilted_texture_is_seen_in_perspective():
    # A plane that runs away from the viewer: x across, depth from 1 to 5, at y = 0.4.
    corners = [[-0.4, 0.4, 1.0], [0.4, 0.4, 1.0], [0.4, 0.4, 5.0], [-0.4, 0.4, 5.0]]
    screen = projected(corners)
    shown = rasterise(screen, QUAD, (100, 100))
    depth = shown.interpolated(QUAD, np.array([[1.0], [1.0], [5.0], [5.0]]))[:, 0]
    rows, columns = np.nonzero(shown.on_grid((100, 100)))
    # By rays: the plane y = 0.4 lies at depth 0.4 focal / (y - middle).
    expected = 0.4 * 100.0 / (rows + 0.5 - 50.0)
    assert depth == pytest.approx(expected, rel=1e-5)
    assert shown.depth == pytest.approx(expected, rel=1e-5)
    # Covered is what lies between both edges of the plane.
    assert set(rows) == set(range(58, 90))
    # A centre on the edge itself is covered, whatever the rounding.
    assert np.abs((columns + 0.5 - 50.0) * depth / 100.0).max() <= 0.4 * (1 + 1e-6)


@pytest.mark.parametrize("order", [[0, 1], [1, 0]])
def test_the_nearest_surface_is_seen_also_where_bodies_intersect(order):
    flat = np.array([[-1, -1, 2.0], [1, -1, 2.0], [1, 1, 2.0], [-1, 1, 2.0]])
    tilted = np.array([[-1, -1, 1.0], [1, -1, 3.0], [1, 1, 3.0], [-1, 1, 1.0]])
    both = [flat, tilted]
    vertices = np.concatenate([both[i] for i in order])
    faces = np.concatenate([QUAD, QUAD + 4])
    shown = rasterise(projected(vertices, middle=32.0, focal=20.0), faces, (64, 64))
    seen = np.full((64, 64), -1)
    seen[shown.rows, shown.columns] = shown.faces
    seen = seen[32]
    which = np.where(seen >= 0, np.array([order[0], order[0], order[1], order[1], 9])[seen], 9)
    # They cross at x = 0: left of it the tilted one is nearer, right of it the flat one.
    assert (which[23:31] == 1).all()
    assert (which[33:42] == 0).all()


def test_there_are_no_gaps_between_triangles_and_none_beyond_the_outline(monkeypatch):
    monkeypatch.setattr(mesh_raster, "CHUNK", 700)
    ball = trimesh.creation.icosphere(subdivisions=4, radius=1.0)
    vertices = np.asarray(ball.vertices) + np.array([0, 0, 5.0])
    shown = rasterise(projected(vertices, focal=200.0), np.asarray(ball.faces), (100, 100))
    seen = shown.on_grid((100, 100))
    y, x = np.mgrid[:100, :100] + 0.5 - 50.0
    # A ball of radius 1 at distance 5 is seen within tan(asin(1/5)) of the axis; the polyhedron lies within 1 % of it.
    reach = 200.0 * math.tan(math.asin(0.2))
    assert seen[np.hypot(x, y) < 0.99 * reach].all()
    assert not seen[np.hypot(x, y) > reach].any()
    assert np.abs(shown.corners.sum(axis=-1) - 1.0).max() < 1e-5


def test_triangles_behind_the_viewer_are_left_out():
    behind = np.array([[-1.0, 0, -1], [1, 0, -1], [0, 1, 4]])
    assert not len(rasterise(projected(behind), np.array([[0, 1, 2]]), (20, 20)).rows)


def test_a_fine_texture_is_averaged_not_sampled():
    texture = np.zeros((512, 512, 3), np.uint8)
    texture[(np.indices((512, 512)).sum(axis=0) % 2) == 0] = 255
    corners = [[-1, 1, 2.0], [1, 1, 2.0], [1, -1, 2.0], [-1, -1, 2.0]]
    screen = projected(corners, focal=100.0, middle=64.0)
    paint = Paint(texture=texture, uv=np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]]))
    shown = colours(rasterise(screen, QUAD, (128, 128)), screen, QUAD, paint)
    assert shown.mean() == pytest.approx(127.5, abs=1.0)
    assert shown.std() < 2.0


def a_painted_box():
    """Half a metre wide; front (-y) red, right (+x) green, back blue, left yellow, top white."""
    tones = {(0, -1, 0): (255, 0, 0), (1, 0, 0): (0, 255, 0), (0, 1, 0): (0, 0, 255), (-1, 0, 0): (255, 255, 0)}
    box = trimesh.creation.box(extents=(0.5, 0.5, 0.5))
    box.unmerge_vertices()
    normals = np.rint(box.face_normals).astype(int)
    per_face = [tones.get(tuple(n), (255, 255, 255)) for n in normals]
    return trimesh.Trimesh(box.vertices, box.faces, vertex_colors=np.repeat(per_face, 3, axis=0), process=False)


@pytest.mark.parametrize(
    ("azimuth", "tone"), [(0, (255, 0, 0)), (90, (0, 255, 0)), (180, (0, 0, 255)), (270, (255, 255, 0))]
)
def test_angles_go_round_to_the_right_of_who_took_the_photo(azimuth, tone):
    body = turntable.turned(a_painted_box(), np.array([0.0, -3.0, 1.0]))
    view = turntable.view(body, azimuth, side=64)
    assert tuple(view.pixels[34, 32]) == tone
    assert tuple(view.pixels[14, 32]) == (255, 255, 255), "its top, seen from a little above"
    assert view.cover[34, 32] == 1.0
    assert tuple(view.pixels[62, 32]) == turntable.GROUND


def test_a_view_from_another_side_of_the_world_turns_with_the_viewer():
    body = turntable.turned(a_painted_box(), np.array([4.0, 0.0, 1.0]))
    assert tuple(turntable.view(body, 0.0, side=48).pixels[26, 24]) == (0, 255, 0)
    above = turntable.turned(a_painted_box(), np.array([0.0, 0.0, 5.0]))
    assert turntable.view(above, 0.0, side=48).cover.any(), "a photo from right above has some side as its front"


def test_the_sheet_has_eight_views_one_from_above_and_a_legend():
    body = turntable.turned(a_painted_box(), np.array([0.0, -3.0, 1.0]))
    picture = turntable.sheet(body, side=60)
    assert picture.shape == (120, 300, 3)
    cells = picture.reshape(2, 60, 5, 60, 3).transpose(0, 2, 1, 3, 4)
    assert tuple(cells[0, 0, 32, 30]) == (255, 0, 0)
    assert tuple(cells[1, 0, 32, 30]) == (0, 0, 255)
    assert tuple(cells[0, 4, 30, 30]) == (255, 255, 255), "from above"
    body_colours = cells[1, 4].reshape(-1, 3)
    assert (np.ptp(body_colours.astype(int), axis=1) == 0).all(), "the legend is grey"


def test_a_body_that_hovers_casts_its_dark_patch_away_from_itself():
    resting = turntable.turned(a_painted_box(), np.array([0.0, -3.0, 1.0]))
    hovering = turntable.turned(a_painted_box(), np.array([0.0, -3.0, 1.0]), ground=-0.45)
    views = [turntable.view(body, 0.0, side=96) for body in (resting, hovering)]
    assert not np.array_equal(views[0].pixels, views[1].pixels)
    assert np.array_equal(views[0].cover, views[1].cover)


def test_texture_colours_and_plain_meshes_are_all_shown():
    flat = trimesh.creation.box(extents=(1, 1, 1))
    assert paint_of(flat).texture is None
    picture = Image.fromarray(np.full((4, 4, 3), (10, 200, 30), np.uint8))
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=picture)
    flat.visual = trimesh.visual.TextureVisuals(uv=np.random.default_rng(0).random((8, 2)) * 3 - 1, material=material)
    body = turntable.turned(flat, np.array([0.0, -3.0, 0.0]))
    view = turntable.view(body, 30.0, side=40)
    assert (np.abs(view.body[view.cover > 0.99].astype(int) - (10, 200, 30)) <= 1).all()


def test_the_nearest_triangle_is_seen_as_by_rays_and_of_equals_the_first():
    generator = np.random.default_rng(5)
    at = np.column_stack([generator.uniform(-5, 45, (30, 2)), generator.uniform(1, 3, 30)])
    faces = generator.integers(0, 30, (25, 3))
    faces = np.concatenate([faces, faces])
    shown = rasterise(at, faces, (40, 30))
    found = np.full((30, 40), -1)
    found[shown.rows, shown.columns] = shown.faces
    depth = np.full((30, 40), np.inf)
    depth[shown.rows, shown.columns] = shown.depth
    places = np.stack(np.meshgrid(np.arange(40) + 0.5, np.arange(30) + 0.5), axis=-1)
    nearest, first = np.full((30, 40), np.inf), np.full((30, 40), -1)
    for number, (a, b, c) in enumerate(at[faces]):
        if abs(np.linalg.det(np.stack([b - a, c - a])[:, :2])) < 1e-9:
            continue
        # 1 / depth is linear on the screen.
        st = np.linalg.solve(np.stack([b - a, c - a])[:, :2].T, (places - a[:2])[..., None])[..., 0]
        inside = (st >= 0).all(axis=-1) & (st.sum(axis=-1) <= 1)
        here = 1 / (1 / a[2] + st @ (1 / np.array([b[2], c[2]]) - 1 / a[2]))
        closer = inside & (here < nearest - 1e-12)
        nearest[closer], first[closer] = here[closer], number
    assert (first >= 0).mean() > 0.5 and first.max() < 25
    assert np.array_equal(found, first)
    np.testing.assert_allclose(depth, nearest, rtol=1e-12)
