# SPDX-License-Identifier: MIT
"""From an outline to a body: its shape, silhouette, volume, mesh and colours."""

import functools
import math

import cv2
import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from physgen.sim.errors import InputError
from physgen.sim.mpm.colliders import Surface
from physgen.sim.mpm.geometry.mesh_checks import check_surface
from physgen.sim.reconstruct.camera.ground_camera import camera_above_ground
from physgen.sim.reconstruct.reconstruct_options import ObjectRequest, ReconstructOptions
from physgen.sim.reconstruct.shape.built_body import build_body
from physgen.sim.reconstruct.shape.primitive_mesh import cube_surface
from physgen.sim.reconstruct.shape.primitives import Box, Sphere, SurfaceOfRevolution, rasterize
from physgen.sim.reconstruct.shape.surface_mesh import keep_main_part

WIDTH, HEIGHT = 480, 360
BOX = Box(0.1, 2.1, 0.5, 0.5, 0.4, 0.3)
CAN = SurfaceOfRevolution(-0.1, 2.0, (0.0, 0.5), (0.2, 0.2))
BALL = Sphere(0.05, 2.2, 0.25)
VOLUMES = {"box": 0.5 * 0.4 * 0.3, "cylinder": math.pi * 0.2**2 * 0.5, "sphere": 4 / 3 * math.pi * 0.25**3}


def view(pitch_deg=25.0):
    return camera_above_ground(WIDTH, HEIGHT, 520.0, math.radians(pitch_deg))


def outline(primitive, pitch_deg=25.0):
    return rasterize(primitive, view(pitch_deg), (HEIGHT, WIDTH), 0, 0)


def cup():
    """A can with a handle, through which the ground shows, and what of it is no handle."""
    can = outline(CAN)
    rows, columns = np.nonzero(can)
    handle = np.zeros((HEIGHT, WIDTH), np.uint8)
    middle = (int(columns.max()), int(np.median(rows)))
    cv2.ellipse(handle, middle, (26, 32), 0, 0, 360, 1, 11)
    return can | (handle > 0), can


def made(mask, notices=None, pitch_deg=25.0, seen=None, pixels=None, vertices=3000, **request):
    said = [] if notices is None else notices
    options = ReconstructOptions(mesh_vertices=vertices)
    wanted = ObjectRequest(box=(0, 0, 9, 9), name="thing", **request)
    return build_body(view(pitch_deg), mask, wanted, options, said.append, seen=seen, pixels=pixels)


@functools.cache
def body_alone(primitive):
    """Outline, body and notices of a primitive, or of a blob for None, of which nothing else is said; not to change."""
    mask, notices = blob(3) if primitive is None else outline(primitive), []
    return mask, made(mask, notices), notices


@functools.cache
def cup_body():
    """Not to change."""
    return made(cup()[0], vertices=7000)


def checked(body):
    """The mesh, after what holds for every body."""
    mesh = trimesh.Trimesh(body.mesh.vertices, body.mesh.faces, process=False)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.body_count == 1
    assert mesh.volume > 0
    assert len(np.unique(body.mesh.faces)) == len(body.mesh.vertices)
    assert mesh.area_faces.min() > 0
    assert len(np.unique(np.sort(body.mesh.faces, axis=1), axis=0)) == len(body.mesh.faces)
    assert body.mesh.vertices[:, 2].min() == 0.0
    assert (body.mesh.vertices[:, 2] == 0.0).sum() >= 3
    edges = mesh.edges_unique_length
    assert np.percentile(edges, 99) < 8 * np.median(edges)
    return mesh


@pytest.mark.parametrize(("primitive", "shape"), [(BOX, "box"), (CAN, "cylinder"), (BALL, "sphere")])
def test_a_clear_outline_becomes_its_primitive(primitive, shape):
    _, body, notices = body_alone(primitive)
    mesh = checked(body)
    assert body.shape == shape
    assert body.fit > 0.985
    assert mesh.volume == pytest.approx(VOLUMES[shape], rel=0.1)
    assert len(mesh.vertices) == pytest.approx(3000, rel=0.15)
    assert body.stability > 0.5
    assert not notices
    assert mesh.euler_number == 2
    assert np.abs(view().project(body.mesh.vertices)[:, :2] - body.mesh.pixels).max() < 1e-6


@pytest.mark.parametrize(
    ("primitive", "shape", "error_deg"), [(BOX, "box", 3.0), (BOX, "box", -3.0), (CAN, "cylinder", 3.0)]
)
def test_a_camera_three_degrees_off_keeps_shape_silhouette_and_proportions(primitive, shape, error_deg):
    mask = outline(primitive)
    body = made(mask, pitch_deg=25.0 + error_deg)
    mesh = checked(body)
    assert body.shape == shape
    assert body.fit > 0.97
    # Wrong in size as everything that camera sees, but not in proportion.
    size = {"box": 0.5 * np.cos(0.5) + 0.4 * np.sin(0.5), "cylinder": 0.5, "sphere": 0.5}[shape]
    assert mesh.volume / mesh.extents.max() ** 3 == pytest.approx(VOLUMES[shape] / size**3, rel=0.25)


def test_a_cup_keeps_its_handle_and_its_volume():
    body = cup_body()
    mesh = checked(body)
    assert body.shape == "cylinder"
    assert body.fit > 0.97
    # One hole: the handle's.
    assert mesh.euler_number == 0
    assert mesh.volume == pytest.approx(VOLUMES["cylinder"], rel=0.12)


def test_a_flat_book_lies():
    book = Box(0.0, 1.9, 0.4, 0.5, 0.36, 0.04)
    body = made(outline(book, 40.0), kind="book", pitch_deg=40.0)
    assert body.shape == "box"
    assert np.ptp(body.mesh.vertices[:, 2]) == pytest.approx(0.04, rel=0.35)
    assert checked(body).volume == pytest.approx(0.5 * 0.36 * 0.04, rel=0.35)


def blob(seed):
    random = np.random.default_rng(seed)
    angle = np.linspace(0, 2 * np.pi, 60, endpoint=False)
    radius = 62 + sum(random.normal(0, 16 / k) * np.cos(k * angle + random.uniform(0, 6)) for k in range(2, 7))
    corners = np.column_stack([240 + radius * np.cos(angle), 210 + radius * np.sin(angle)])
    image = np.zeros((HEIGHT, WIDTH), np.uint8)
    cv2.fillPoly(image, [np.round(corners).astype(np.int32)], 1)
    return image > 0


@settings(max_examples=3, deadline=None)
@given(seed=st.integers(0, 10_000), pitch=st.floats(8.0, 55.0), shape=st.sampled_from(["auto", "box", "cylinder"]))
def test_any_blob_becomes_a_sound_body_with_its_silhouette(seed, pitch, shape):
    notices = []
    body = made(blob(seed), notices, pitch_deg=pitch, shape=shape)
    checked(body)
    # Whoever insists on a box is told what it costs.
    assert body.fit > 0.96 or (shape != "auto" and any("overlaps its mask" in text for text in notices))
    if shape != "auto":
        assert body.shape == shape


def test_a_star_is_inflated():
    angle = np.linspace(0, 2 * np.pi, 10, endpoint=False)
    radius = np.where(np.arange(10) % 2, 90, 38)
    image = np.zeros((HEIGHT, WIDTH), np.uint8)
    corners = np.column_stack([240 + radius * np.cos(angle), 200 + radius * np.sin(angle)])
    cv2.fillPoly(image, [np.round(corners).astype(np.int32)], 1)
    body = made(image > 0)
    assert body.shape == "inflated"
    assert body.fit > 0.97
    checked(body)


def test_backs_and_thickness_of_inflated_bodies():
    mask = outline(BALL)
    symmetric, flat = made(mask, shape="inflated"), made(mask, back="flat")
    assert symmetric.shape == flat.shape == "inflated"
    assert checked(flat).volume < 0.65 * checked(symmetric).volume
    assert flat.fit > 0.97
    thin = made(mask, shape="inflated", thickness=0.3)
    assert checked(thin).volume < 0.6 * checked(symmetric).volume


def test_the_shape_that_the_user_wants_is_made_and_doubted():
    notices = []
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[120:260, 180:200] = mask[240:260, 180:300] = True
    body = made(mask, notices, shape="sphere")
    assert body.shape == "sphere"
    assert body.fit > 0.9
    assert any("overlaps" in text and "thing" in text for text in notices)


def test_a_thing_that_the_border_cuts_goes_on_outside():
    camera = view()
    left = float(camera.rays(np.array([25.0, 220.0]))[0] * 2.0)
    can = SurfaceOfRevolution(left, 2.0, (0.0, 0.4), (0.22, 0.22))
    mask = outline(can)
    assert mask[:, 0].any()
    body = made(mask, kind="can")
    mesh = checked(body)
    assert body.shape == "cylinder"
    assert mesh.volume == pytest.approx(math.pi * 0.22**2 * 0.4, rel=0.2)
    # All that lies outside takes its colours from inside.
    assert body.mesh.colours[:, 0].min() > -3.5


def test_a_body_hidden_below_is_fitted_to_what_is_seen():
    mask = outline(BOX)
    rows = np.flatnonzero(mask.any(axis=1))
    seen = mask.copy()
    seen[rows[0] + 2 * len(rows) // 3 :] = False
    body = made(mask, seen=seen)
    assert body.shape == "box"
    assert checked(body).volume == pytest.approx(VOLUMES["box"], rel=0.2)


def test_visible_faces_show_their_pixels_and_others_pixels_of_the_object():
    for primitive in (BOX, CAN, BALL, None):
        mask, body, _ = body_alone(primitive)
        a, b, c = (body.mesh.vertices[body.mesh.faces[:, i]] for i in range(3))
        normal, towards = np.cross(b - a, c - a), view().position - a
        cosine = (normal * towards).sum(axis=1) / np.linalg.norm(normal, axis=1) / np.linalg.norm(towards, axis=1)
        front = np.unique(body.mesh.faces[cosine > 0.3])
        assert np.array_equal(body.mesh.colours[front], body.mesh.pixels[front])
        back = np.setdiff1d(np.arange(len(body.mesh.vertices)), np.unique(body.mesh.faces[cosine > 0.01]))
        at = np.floor(body.mesh.colours[back]).astype(int)
        inner = cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
        assert inner[at[:, 1], at[:, 0]].mean() > 0.99


def test_the_far_side_of_a_can_shows_its_wall_and_not_its_top():
    mask = outline(CAN, 40.0)
    body = made(mask, pitch_deg=40.0)
    vertices = body.mesh.vertices
    radius = np.hypot(vertices[:, 0] - CAN.x, vertices[:, 1] - CAN.y)
    far = (vertices[:, 1] > CAN.y + 0.1) & (radius > 0.19) & (vertices[:, 2] < 0.45) & (vertices[:, 2] > 0.02)
    top = rasterize(SurfaceOfRevolution(CAN.x, CAN.y, (0.4999, 0.5), (0.19, 0.19)), view(40.0), mask.shape, 0, 0)
    at = np.floor(body.mesh.colours[far]).astype(int)
    assert far.sum() > 50
    assert top[at[:, 1], at[:, 0]].mean() < 0.02


def test_empty_outlines_are_refused():
    with pytest.raises(InputError, match="thing"):
        made(np.zeros((HEIGHT, WIDTH), bool))


def test_equal_inputs_give_equal_bodies():
    first, second = cup_body(), made(cup()[0], vertices=7000)
    assert np.array_equal(first.mesh.vertices, second.mesh.vertices)
    assert np.array_equal(first.mesh.colours, second.mesh.colours)


@pytest.mark.parametrize("counts", [(1, 1, 1), (2, 3, 4), (5, 2, 3)])
def test_the_surface_of_a_block_is_closed_and_outward(counts):
    at, faces = cube_surface(counts)
    mesh = trimesh.Trimesh(at, faces, process=False)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.volume == pytest.approx(np.prod(counts))


def test_floating_parts_are_removed_and_measured():
    large, small = trimesh.creation.icosphere(2, 1.0), trimesh.creation.icosphere(2, 0.5)
    small.apply_translation((3.0, 0.0, 0.0))
    both = trimesh.util.concatenate([small, large])
    points, faces, lost = keep_main_part(np.asarray(both.vertices), np.asarray(both.faces))
    assert len(points) == len(large.vertices)
    assert lost == pytest.approx(0.2, abs=0.01)
    assert trimesh.Trimesh(points, faces, process=False).volume == pytest.approx(large.volume)


def test_a_can_whose_mask_lacks_a_corner_does_not_cross_itself():
    mask = outline(CAN)
    rows, columns = np.nonzero(mask)
    mask[: rows.min() + 14, columns.max() - 30 :] = False
    body = made(mask, shape="cylinder")
    checked(body)
    assert body.fit > 0.98
    assert check_surface(Surface(vertices=body.mesh.vertices, faces=body.mesh.faces), name="can") == ()


def test_a_can_up_to_the_horizon_stays_as_deep_as_wide_where_its_mask_lacks_a_rim():
    mask = outline(SurfaceOfRevolution(-0.1, 2.0, (0.0, 1.04), (0.25, 0.25)), 17.0)
    rows, columns = np.nonzero(mask)
    mask[: rows.min() + 9, : (columns.min() + columns.max()) // 2] = False
    body = made(mask, pitch_deg=17.0, vertices=1500, shape="cylinder")
    wide, deep, _ = np.ptp(body.mesh.vertices, axis=0)
    assert deep == pytest.approx(wide, rel=0.05)
