# SPDX-License-Identifier: MIT
"""A user's own mesh: mended, found again in the photo, and given the photo's colours."""

import io

import cv2
import numpy as np
import pytest
import trimesh
from physgen.sim.errors import InputError
from physgen.sim.mpm.geometry.triangles import check_closed, validated
from physgen.sim.reconstruct.camera.ground_camera import camera_above_ground
from physgen.sim.reconstruct.user_mesh.fit_user_mesh import fit_mesh, reproject_photo
from physgen.sim.reconstruct.user_mesh.mesh_alignment import UPS, align
from physgen.sim.reconstruct.user_mesh.mesh_repair import RepairedMesh, repair_mesh
from PIL import Image
from trimesh.visual.material import PBRMaterial

WIDTH, HEIGHT = 360, 270
VIEW = camera_above_ground(WIDTH, HEIGHT, 340.0, np.radians(28.0))


def chair():
    """Something whose front, back and sides differ, about 1 high, +Z up, resting on z = 0."""
    parts = [
        trimesh.creation.box((0.8, 0.5, 0.4), transform=moved(0, 0, 0.2)),
        trimesh.creation.box((0.2, 0.5, 1.0), transform=moved(-0.3, 0, 0.5)),
        trimesh.creation.icosphere(2, 0.18),
    ]
    parts[2].apply_transform(moved(0.25, 0.1, 0.55))
    return trimesh.util.concatenate(parts)


def moved(x, y, z):
    return trimesh.transformations.translation_matrix((x, y, z))


def placed(mesh, yaw, scale, x, y):
    turn = cv2.Rodrigues(np.array([0.0, 0.0, yaw]))[0]
    return scale * np.asarray(mesh.vertices) @ turn.T + (x, y, 0)


def outline(vertices, faces):
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    pixels = VIEW.project(vertices)[:, :2]
    for face in faces:
        cv2.fillConvexPoly(mask, np.round(pixels[face] * 16).astype(np.int32), 1, shift=4)
    return mask > 0


def quiet(_):
    """No notice is looked at."""


@pytest.mark.parametrize(("up", "yaw", "unit"), [("+y", 0.6, 1.0), ("-z", 2.5, 1000.0)])
def test_a_mesh_in_any_unit_and_axes_is_found_again(up, yaw, unit):
    mesh = chair()
    world, faces = placed(mesh, yaw, 0.35, 0.1, 2.0), np.asarray(mesh.faces)
    seen = outline(world, faces)
    file = unit * np.asarray(mesh.vertices) @ UPS[up] + (3.0, -2.0, 7.0)
    pose = align(VIEW, seen, np.zeros_like(seen), file, faces, ups=(up,))
    assert pose.overlap > 0.95
    assert np.linalg.norm(pose.place(file) - world, axis=1).mean() < 0.06 * 0.35


def test_clicked_points_turn_what_looks_alike():
    # A box looks the same from the front and from behind; two points tell.
    mesh = trimesh.creation.box((1.0, 0.4, 0.6), transform=moved(0, 0, 0.3))
    world, faces = placed(mesh, 2.6, 0.4, 0.0, 2.2), np.asarray(mesh.faces)
    seen = outline(world, faces)
    vertices = np.asarray(mesh.vertices)
    corners = np.argsort(VIEW.project(world)[:, 2])[:4]
    points = [(tuple(vertices[i]), tuple(VIEW.project(world)[i, :2])) for i in corners]
    pose = align(VIEW, seen, np.zeros_like(seen), vertices, faces, ups=("+z",), points=points)
    assert np.linalg.norm(pose.place(vertices) - world, axis=1).max() < 0.08 * 0.4


def test_specks_are_left_out_and_faces_turned_outward():
    mesh = trimesh.creation.icosphere(3)
    speck = trimesh.creation.box((0.05, 0.05, 0.05), transform=moved(2, 0, 0))
    both = trimesh.util.concatenate([mesh, speck])
    faces = np.asarray(both.faces).copy()
    faces[:100] = faces[:100, ::-1]
    said = []
    mended = repair_mesh(trimesh.Trimesh(both.vertices, faces, process=False), "ball", said.append)
    body = trimesh.Trimesh(mended.vertices, mended.faces)
    assert body.is_watertight and body.volume == pytest.approx(mesh.volume)
    assert len(said) == 2 and "removed" in said[0] and "inward" in said[1]


@pytest.mark.parametrize(("whole", "corners"), [(trimesh.creation.icosphere(2), 162), (trimesh.creation.box(), 24)])
def test_faces_of_their_own_corners_join_but_at_sharp_edges(whole, corners):
    """As STL has them: a ball is one smooth surface again, a box keeps its six sides apart."""
    faces = np.arange(3 * len(whole.faces)).reshape(-1, 3)
    split = trimesh.Trimesh(whole.vertices[whole.faces].reshape(-1, 3), faces, process=False)
    repaired = repair_mesh(split, "ball", quiet)
    assert len(repaired.vertices) == corners
    assert np.allclose(repaired.vertices[repaired.faces], whole.vertices[whole.faces])


def test_an_open_mesh_becomes_a_closed_volume_and_this_is_said():
    mesh = trimesh.creation.icosphere(3, 15.0)
    low = np.asarray(mesh.vertices)[np.asarray(mesh.faces)].mean(axis=1)[:, 2] < 12.0
    said = []
    mended = repair_mesh(
        trimesh.Trimesh(mesh.vertices, np.asarray(mesh.faces)[low], process=False), "bowl", said.append
    )
    assert check_closed(validated(mended.vertices, mended.faces)[1])
    assert abs(trimesh.Trimesh(mended.vertices, mended.faces).volume) > 0.8 * mesh.volume
    assert "not closed" in said[0]


def with_texture(mesh, uv, picture):
    image = None if picture is None else Image.fromarray(picture)
    visual = trimesh.visual.TextureVisuals(uv=uv, material=PBRMaterial(baseColorTexture=image))
    return trimesh.Trimesh(mesh.vertices, mesh.faces, visual=visual, process=False)


def colours_at(uv, picture):
    """Colours (n, 3) of ``picture``, repeated without end, at ``uv`` (n, 2)."""
    height, width = picture.shape[:2]
    x, y = np.floor(uv[:, 0] * width).astype(int) % width, np.floor((1 - uv[:, 1]) * height).astype(int) % height
    return picture[y, x].astype(int)


@pytest.mark.parametrize("repeats", [0.9, 1.7, 2.0])
def test_a_texture_that_repeats_looks_as_it_did(repeats):
    picture = np.zeros((64, 64, 3), np.uint8)
    picture[:] = np.add.outer(np.arange(64), 2 * np.arange(64))[..., None] * np.array([1, 0.5, 0.2])
    mesh = trimesh.creation.icosphere(2)
    uv = np.asarray(mesh.vertices)[:, :2] * repeats + (0.3, -7.4)
    said = []
    mended = repair_mesh(with_texture(mesh, uv, picture), "ball", said.append)
    assert not said and trimesh.Trimesh(mended.vertices, mended.faces).is_watertight
    assert mended.uv.min() >= 0.0 and mended.uv.max() <= 1.0
    middles = mended.uv[mended.faces].mean(axis=1)
    before = uv[np.asarray(mesh.faces)].mean(axis=1)
    # A place on the border between two pixels may round to either.
    assert np.mean(np.abs(colours_at(middles, mended.picture) - colours_at(before, picture)).max(axis=1) > 3) < 0.02


def test_a_mesh_without_usable_coordinates_or_with_too_many_repetitions_says_so():
    mesh, picture = trimesh.creation.icosphere(2), np.full((16, 16, 3), 90, np.uint8)
    said = []
    bare = repair_mesh(with_texture(mesh, np.full((len(mesh.vertices), 2), np.nan), picture), "ball", said.append)
    assert bare.uv is None and bare.colours is None and "no usable texture coordinates" in said[0]
    many = repair_mesh(with_texture(mesh, 500 * np.asarray(mesh.vertices)[:, :2], picture), "ball", said.append)
    assert many.uv is None and (many.colours == 90).all() and "repeats many times" in said[1]
    # Faces that share one place of the picture are no trouble: the photo has a part of the picture of its own.
    shared = repair_mesh(with_texture(mesh, np.full((len(mesh.vertices), 2), 0.5), picture), "ball", said.append)
    assert (shared.uv == 0.5).all() and len(said) == 2


@pytest.mark.parametrize("vertices", [np.zeros((3, 3)), [[0, 0, 0], [1, 0, 0], [2, 0, 0]]])
def test_a_mesh_without_extent_or_area_is_refused(vertices):
    with pytest.raises(InputError, match="export it again"):
        repair_mesh(trimesh.Trimesh(vertices, [[0, 1, 2]], process=False), "sliver", quiet)


def test_the_photo_is_seen_where_the_camera_sees_the_mesh(tmp_path):
    mesh = chair()
    world, faces = placed(mesh, 0.6, 0.35, 0.1, 2.0), np.asarray(mesh.faces)
    seen = outline(world, faces)
    photo = np.full((HEIGHT, WIDTH, 3), 90, np.uint8)
    photo[seen] = (200, 60, 40)
    own = Image.new("RGB", (16, 16), (40, 60, 220))
    own.format = "PNG"
    material = PBRMaterial(baseColorTexture=own)
    visual = trimesh.visual.TextureVisuals(uv=np.full((len(mesh.vertices), 2), 0.5), material=material)
    file = np.asarray(mesh.vertices) @ UPS["+y"]
    buffer = io.BytesIO()
    trimesh.Trimesh(file, faces, visual=visual, process=False).export(buffer, file_type="glb")
    (tmp_path / "chair.glb").write_bytes(buffer.getvalue())
    said = []
    fitted = fit_mesh(
        tmp_path / "chair.glb", VIEW, seen, seen, photo, name="chair", up="auto", points=(), notice=said.append
    )
    surface = fitted.surface
    assert check_closed(validated(surface.vertices, surface.faces)[1])
    assert abs(surface.vertices[:, 2].min()) < 1e-9
    height, width = surface.picture.shape[:2]
    colours = surface.picture[
        np.clip((1 - surface.uv[:, 1]) * height, 0, height - 1).astype(int),
        np.clip(surface.uv[:, 0] * width, 0, width - 1).astype(int),
    ]
    a, b, c = (surface.vertices[surface.faces[:, i]] for i in range(3))
    towards = np.einsum("ti,ti->t", np.cross(b - a, c - a), VIEW.position - a) > 0
    reddish = (colours[surface.faces][..., 0] > 150).all(axis=1)
    blue = (colours[surface.faces][..., 2] > colours[surface.faces][..., 0]).all(axis=1)
    assert reddish[~towards].mean() < 0.1 and blue[~towards].mean() > 0.9
    assert reddish[towards].mean() > 0.6
    assert "%" in said[-1]


def test_a_mesh_without_colours_has_no_second_face_behind():
    mesh = trimesh.creation.icosphere(4, 0.3)
    centre = np.array([0.0, 2.0, 0.3])
    world, faces = np.asarray(mesh.vertices) + centre, np.asarray(mesh.faces)
    seen = outline(world, faces)
    photo = np.full((HEIGHT, WIDTH, 3), 90, np.uint8)
    photo[seen] = (200, 60, 40)
    middle = VIEW.project(centre)[:2].astype(int)
    for side in (-14, 14):
        cv2.circle(photo, (int(middle[0]) + side, int(middle[1])), 6, (10, 10, 10), -1)
    surface = reproject_photo(VIEW, RepairedMesh(world, faces, None, None, None), world, seen, photo)
    assert check_closed(validated(surface.vertices, surface.faces)[1])
    colours = colours_at(surface.uv[surface.faces].mean(axis=1), surface.picture)
    behind = (surface.vertices[surface.faces].mean(axis=1) - centre) @ (centre - VIEW.position) > 0
    assert (colours[~behind, 0] < 80).any() and not (colours[behind, 0] < 120).any()
