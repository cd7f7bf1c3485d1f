# SPDX-License-Identifier: MIT
"""Light on surfaces, against what is known of spheres, boxes and open ground."""

import math
from functools import cache

import numpy as np
import pytest
import trimesh
from physgen.sim.reconstruct.appearance.object_shading import (
    LocalLighting,
    Occluders,
    local_lighting,
    shade,
    sky_lobe,
    sphere_directions,
    spherical_convolution,
    sun_lobe,
)
from physgen.sim.reconstruct.camera import ground_camera as cameras
from physgen.sim.reconstruct.creases import split_creases
from physgen.sim.reconstruct.lighting.ground_lighting import surface_points
from physgen.sim.reconstruct.mesh_raster import seen_faces, visible_pixels
from physgen.sim.scene.equirectangular import directions
from physgen.sim.scene.model import Light

VIEW = cameras.camera_above_ground(240, 180, 260.0, math.radians(28))
SUN = np.array([0.6, 0.0, 0.8])
BLACK = np.zeros(3)


def scene(strength=1.0, ground=0.4, sky=(1.0, 1.0, 1.0)):
    background = np.full((180, 240, 3), ground, np.float32)
    radiance = np.ones((32, 64, 3), np.float32) * np.float32(sky)
    light = Light(sun_direction=tuple(SUN) if strength else None, sun_strength=strength, sun_angle=0.02)
    return local_lighting(VIEW, background, np.array([0.0, 1.6, 0.0]), 0.5, radiance, light)


def sphere(height):
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=0.3)
    return np.asarray(mesh.vertices) + np.array([0.0, 1.6, height]), np.asarray(mesh.faces)


@cache
def lit_alone(height):
    """Vertices of a sphere at ``height``, their normals, and their light."""
    mesh = sphere(height)
    normals = (mesh[0] - mesh[0].mean(axis=0)) / 0.3
    return mesh[0], normals, shade(scene(), mesh[0], normals, mesh, [], BLACK)


def test_a_sphere_in_the_air_has_the_light_of_the_formula():
    _, normals, found = lit_alone(6.0)
    up = (1 + normals[:, 2]) / 2
    assert found.ambient[:, 0] == pytest.approx(0.5 * up + 0.4 * (1 - up), abs=0.02)
    assert found.sun == pytest.approx(0.5 / 0.8 * np.maximum(normals @ SUN, 0), abs=0.02)


def test_open_ground_is_white_where_matter_is():
    x, y = np.meshgrid(np.linspace(-0.3, 0.3, 5), np.linspace(1.3, 1.9, 5))
    places = np.column_stack([x.ravel(), y.ravel(), np.full(25, 1e-6)])
    up = np.tile([0.0, 0.0, 1.0], (25, 1))
    far = trimesh.creation.icosphere(subdivisions=1, radius=0.01)
    mesh = np.asarray(far.vertices) + np.array([0.0, 1.6, 9.0]), np.asarray(far.faces)
    for sky in ((1.0, 1.0, 1.0), (0.2, 0.3, 0.9)):
        found = shade(scene(sky=sky), places, up, mesh, [], BLACK)
        assert found.total == pytest.approx(np.ones((25, 3)), abs=0.02)


def test_a_sphere_on_the_ground_is_darker_below_than_in_the_air():
    _, normals, _ = lit_alone(0.3)
    on, above = (lit_alone(height)[2].ambient.mean(axis=1) for height in (0.3, 6.0))
    below, top = normals[:, 2] < -0.9, normals[:, 2] > 0.5
    assert on[below].mean() < 0.6 * above[below].mean()
    assert on[top] == pytest.approx(above[top], abs=0.02)


def test_another_body_takes_the_sun_away():
    mesh = sphere(0.3)
    normals = (mesh[0] - mesh[0].mean(axis=0)) / 0.3
    plate = trimesh.creation.box((0.7, 0.7, 0.02))
    plate.apply_transform(trimesh.geometry.align_vectors([0, 0, 1], SUN))
    plate.apply_translation(np.array([0.0, 1.6, 0.3]) + 0.5 * SUN)
    other = np.asarray(plate.vertices), np.asarray(plate.faces)
    alone, shaded = lit_alone(0.3)[2], shade(scene(), mesh[0], normals, mesh, [other], BLACK)
    lit = normals @ SUN > 0.3
    assert alone.reached[lit].mean() > 0.97
    assert shaded.reached[lit].mean() < 0.03
    assert shaded.total.mean() < 0.7 * alone.total.mean()


def test_a_convex_body_has_no_shadow_on_its_lit_side():
    mesh = sphere(0.3)
    normals = (mesh[0] - mesh[0].mean(axis=0)) / 0.3
    occluders = Occluders(surface_points(*mesh), mesh[0], normals)
    for direction in sphere_directions(24):
        cosine = normals @ direction
        reached = occluders.reached(direction)
        assert reached[cosine > 0.25].min() > 0.9
        # Points are moved out of the surface by 1.5 cells, and see over the horizon up to a cosine of -0.3.
        assert reached[cosine < -0.45].max() < 0.1


def test_normals_are_smooth_on_a_ball_and_not_around_a_box():
    vertices, faces = sphere(0.0)
    ball = split_creases(vertices, faces)
    assert len(ball.vertices) == len(vertices)
    radial = (ball.vertices - vertices.mean(axis=0)) / 0.3
    assert (ball.normals * radial).sum(axis=1).min() > 0.999
    box = trimesh.creation.box((1.0, 2.0, 3.0))
    found = split_creases(np.asarray(box.vertices), np.asarray(box.faces))
    assert len(found.vertices) == 24
    assert np.sort(np.abs(found.normals), axis=1) == pytest.approx(np.tile([0.0, 0.0, 1.0], (24, 1)))
    assert (found.vertices[found.faces] == np.asarray(box.vertices)[box.faces]).all()


def test_each_pixel_shows_the_nearest_surface():
    near, far = sphere(0.3), sphere(0.3)
    vertices = np.concatenate([near[0], far[0] + (0.05, 0.8, 0.0)])
    faces = np.concatenate([near[1], far[1] + len(near[0])])
    found = visible_pixels(VIEW, vertices, faces)
    rays = VIEW.rays(np.column_stack([found.columns, found.rows]) + 0.5)
    places = found.interpolated(faces, vertices)
    depth = VIEW.project(places)[:, 2]
    assert places == pytest.approx(VIEW.position + rays * depth[:, None], abs=1e-6)
    # The near one hides most of the far one: it is hit wherever its own disc is.
    alone = visible_pixels(VIEW, *near)
    own = np.zeros((180, 240), bool)
    own[found.rows[found.faces < len(near[1])], found.columns[found.faces < len(near[1])]] = True
    assert own[alone.rows, alone.columns].all() and own.sum() == len(alone.rows)
    front = seen_faces(VIEW, vertices, faces)
    normals = np.cross(*(vertices[faces[:, i]] - vertices[faces[:, 0]] for i in (1, 2)))
    away = (normals * (vertices[faces].mean(axis=1) - VIEW.position)).sum(axis=1) > 0
    assert not front[away].any()
    square = (normals * (VIEW.position - vertices[faces].mean(axis=1))).sum(axis=1)
    square /= np.linalg.norm(normals, axis=1) * np.linalg.norm(vertices[faces].mean(axis=1) - VIEW.position, axis=1)
    assert front[: len(near[1])][square[: len(near[1])] > 0.4].all()


def given_back(roughness, cosine, steps=300):
    """Share of the light from all around that single scattering by white microfacets sends off at ``cosine``.

    Summed over the microfacets' normals m rather than over lights, where it is ∫ D(m) (v·m) G₂(v, l) dm / (n·v), with
    Smith's functions written in tangents (Heitz, JCGT 2014, eq. 72 and 99). What is missing to 1 is scattered again.
    """
    alpha = roughness**2
    root, turn = (np.arange(steps)[:, None] + 0.5) / steps, (np.arange(steps) + 0.5) / steps * 2 * math.pi
    # Normals with density D cos θ are at tan² θ = α² share / (1 - share) (Walter et al. 2007, eq. 35), each of weight
    # (v·m) / cos θ. That grows without end at grazing ones; in the root of 1 - share it does not.
    theta = np.arctan(alpha * np.sqrt(1 - root**2) / root)
    m = np.stack([np.sin(theta) * np.cos(turn), np.sin(theta) * np.sin(turn), np.cos(theta) + 0 * turn], axis=-1)
    view = np.array([math.sqrt(1 - cosine**2), 0.0, cosine])
    facing = m @ view
    light = 2 * facing[..., None] * m - view

    def smith(z):
        return (np.sqrt(1 + alpha**2 * (1 / np.clip(z, 1e-6, 1) ** 2 - 1)) - 1) / 2

    weight = 2 * root * np.maximum(facing, 0) / (m[..., 2] * cosine)
    # With masking alone it is all of the light: the projected area of what is seen is that of the surface.
    assert (weight / (1 + smith(cosine))).mean() == pytest.approx(1.0, abs=0.001)
    both = np.where(light[..., 2] > 0, 1 / (1 + smith(cosine) + smith(light[..., 2])), 0.0)
    return float((weight * both).mean())


@pytest.mark.parametrize("cosine", [0.4, 0.87, 1.0])
@pytest.mark.parametrize("roughness", [0.4, 0.6, 1.0])
def test_the_sun_s_reflection_gives_back_what_microfacets_do(roughness, cosine):
    normal, view = np.array([[0.0, 0.0, 1.0]]), np.array([[math.sqrt(1 - cosine**2), 0.0, cosine]])
    lights = sphere_directions(6000)
    lights = lights[lights[:, 2] > 0]
    bare = LocalLighting(np.zeros((32, 64, 3)), BLACK, SUN, 1.0, 0.01, np.ones(3))
    # The mean over a disc that is the whole sky. A sun of radiance over π 1 is irradiance π.
    mean = sun_lobe(bare, normal, view, roughness, 1.0, lights)[0] / math.pi
    assert mean * 2 * math.pi == pytest.approx(given_back(roughness, cosine), abs=0.01)


@pytest.mark.parametrize("alpha2", [0.02, 0.3, 1.0])
def test_a_sum_around_is_the_one_over_all_pairs_of_pixels(alpha2):
    picture = np.random.default_rng(1).random((16, 32, 3))
    towards, solid = directions(16, 32)
    flat = towards.reshape(-1, 3)

    def weight(cosine):
        return np.maximum(cosine, 0) / (1 + alpha2 - cosine) ** 2

    pairs = weight(np.clip(flat @ flat.T, -1, 1)) * solid.ravel()
    assert spherical_convolution(picture, weight).reshape(-1, 3) == pytest.approx(
        pairs @ picture.reshape(-1, 3), rel=1e-9
    )


def test_a_mirror_in_even_light_looks_as_that():
    even = LocalLighting(np.ones((32, 64, 3)), np.ones(3), None, 0.0, 0.1, np.ones(3))
    normals = sphere_directions(200)
    views = normals.copy()
    assert sky_lobe(even, normals, views, 0.1, 1.0) == pytest.approx(np.ones((200, 3)), abs=0.06)
    varnish = sky_lobe(even, normals, views, 0.1, 0.04)
    assert varnish == pytest.approx(np.full((200, 3), 0.04), abs=0.01)
