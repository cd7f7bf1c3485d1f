# SPDX-License-Identifier: MIT
"""Albedo and roughness of spheres that formulas of the test's own have drawn."""

import math
from functools import cache

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from physgen.sim.reconstruct.appearance.albedo import compute_albedo, division_exponent
from physgen.sim.reconstruct.appearance.appearance_estimate import estimate_appearance
from physgen.sim.reconstruct.camera import ground_camera as cameras
from physgen.sim.reconstruct.reasoning.material_decision import decide_materials
from physgen.sim.reconstruct.reasoning.material_names import shipped_names
from physgen.sim.reconstruct.reconstruct_options import ObjectRequest
from physgen.sim.reconstruct.shape.body_texture import TexturedSurface, crop_texture
from physgen.sim.scene.model import Light
from physgen.sim.srgb import bytes_to_linear, linear_to_bytes

RADIUS, MIDDLE = 0.3, np.array([0.0, 1.6, 0.3])
GROUND = 0.4
SUN = np.array([-0.5, -0.5, 0.7071067811865476])
STRENGTH, ANGLE = 1.5, 0.06
COLOUR = np.array([0.5, 0.16, 0.08])
VIEW = cameras.camera_above_ground(160, 120, 173.0, math.radians(28))
WHITE_SKY = np.ones((32, 64, 3), np.float32)


def hit():
    """Mask of the sphere, and normals and views (n, 3) where it is seen."""
    rows, columns = np.mgrid[:120, :160]
    rays = VIEW.rays(np.stack([columns + 0.5, rows + 0.5], axis=-1))
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    towards = VIEW.position - MIDDLE
    half = rays @ towards
    inside = half**2 - (towards @ towards - RADIUS**2)
    mask = inside > 0
    places = VIEW.position + (-half - np.sqrt(np.maximum(inside, 0)))[..., None] * rays
    return mask, ((places - MIDDLE) / RADIUS)[mask], -rays[mask]


def lobe(normals, views, roughness):
    """Sun of the disc's middle only, in the textbook's angles: GGX with Smith's separable shadowing and Schlick's F."""
    alpha = roughness**2
    half = views + SUN
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    lit, facing, straight = (np.maximum((normals * v).sum(axis=1), 1e-6) for v in (SUN, views, half))
    tan2 = 1 / straight**2 - 1
    distribution = 1 / (math.pi * alpha**2 * straight**4 * (1 + tan2 / alpha**2) ** 2)
    masking = 1.0
    for cosine in (lit, facing):
        masking = masking * 2 / (1 + np.sqrt(1 + alpha**2 * (1 / cosine**2 - 1)))
    fresnel = 0.04 + 0.96 * (1 - (views * half).sum(axis=1)) ** 5
    return np.where((normals @ SUN) > 0, distribution * masking * fresnel / (4 * facing), 0.0)


@cache
def photo(roughness=None, strength=STRENGTH, paint="plain"):
    """The sphere on grey ground under an even sky and a sun, and its mask. Open white ground would be just white."""
    mask, normals, views = hit()
    sky = 1 / (1 + strength)
    radiance = strength / (1 + strength) / SUN[2]
    up = (1 + normals[:, 2]) / 2
    light = sky * up + GROUND * (1 - up) + radiance * np.maximum(normals @ SUN, 0)
    albedo = np.tile(COLOUR, (len(normals), 1))
    if paint == "spot":
        # A white label where this sun makes no highlight, as a highlight of another one looks.
        place = np.array([0.75, -0.6, 0.28])
        albedo[normals @ (place / np.linalg.norm(place)) > 0.98] = 0.85
    elif paint == "checks":
        albedo[(np.floor(normals * 4).sum(axis=1) % 2).astype(bool)] = (0.7, 0.7, 0.65)
    seen = albedo * light[:, None]
    if roughness is not None:
        facing = (normals * views).sum(axis=1)
        # What is rough mirrors no horizon: half from above and half from below, by where the mirror looks.
        above = (1 + 2 * facing * normals[:, 2] - views[:, 2]) / 2
        mirrored = 0.04 * (sky * above + GROUND * (1 - above))
        seen = seen + (math.pi * radiance * lobe(normals, views, roughness) + mirrored)[:, None]
    picture = np.full((120, 160, 3), GROUND)
    picture[mask] = seen
    return linear_to_bytes(picture.astype(np.float32)), mask, albedo


def body(pixels, mask):
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=RADIUS)
    vertices = np.asarray(mesh.vertices) + MIDDLE
    crop = crop_texture(pixels, mask)
    return TexturedSurface(vertices, np.asarray(mesh.faces), crop.uv(VIEW.project(vertices)[:, :2]), crop.pixels), crop


def physics(kind=None):
    return decide_materials([ObjectRequest(box=(0, 0, 9, 9), kind=kind)], [None], None, shipped_names())[0]


@cache
def estimated(*, kind=None, sun=tuple(SUN), doubted=False, **how):
    """Appearance, and albedo (n, 3) where the sphere is seen. ``sun`` is what is told, not what drew the photo."""
    pixels, mask, _ = photo(**how)
    surface, crop = body(pixels, mask)
    strength = how.get("strength", STRENGTH)
    light = Light(sun_direction=sun, sun_strength=strength, sun_angle=ANGLE)
    background = np.broadcast_to(linear_to_bytes(np.full(3, GROUND, np.float32)), pixels.shape)
    said = []
    found, albedo = estimate_appearance(
        VIEW, surface, mask, pixels, background, [], WHITE_SKY, light, physics(kind), said.append, "thing"
    )
    whole = np.zeros_like(pixels)
    whole[crop.top : crop.top + albedo.shape[0], crop.left : crop.left + albedo.shape[1]] = albedo
    assert albedo.shape == surface.picture.shape and albedo.dtype == np.uint8
    assert said[0].startswith("thing: roughness")
    assert ["would differ more than in the photo" in words for words in said[1:]] == [True] * doubted
    return found, bytes_to_linear(whole)[mask].astype(float)


def spread(colours):
    return float((colours.std(axis=0) / colours.mean(axis=0)).max())


def inner():
    """Where the outline's mixed pixels and grazing views are left out, and what lies next to the ground."""
    _, normals, views = hit()
    return ((normals * views).sum(axis=1) > 0.35) & (normals[:, 2] > -0.5)


@pytest.mark.parametrize("roughness", [0.2, 0.5])
def test_roughness_is_fitted_to_the_highlight(roughness):
    found, _ = estimated(roughness=roughness)
    assert found.source == "fitted" and found.metallic == 0.0
    assert found.roughness == pytest.approx(roughness, abs=0.1)


def test_the_highlight_is_not_in_the_albedo():
    _, albedo = estimated(roughness=0.2)
    _, mask, _ = photo(roughness=0.2)
    before = bytes_to_linear(photo(roughness=0.2)[0])[mask].astype(float)
    assert spread(before[inner()]) > 0.4
    assert spread(albedo[inner()][:, :1]) < 0.12


def test_albedo_of_matt_matter_has_its_colour_and_no_shading():
    _, albedo = estimated()
    found = albedo[inner()]
    before = bytes_to_linear(photo()[0])[photo()[1]].astype(float)[inner()]
    assert spread(before) > 0.2
    assert spread(found[:, :1]) < 0.1
    assert found.mean(axis=0) == pytest.approx(COLOUR, rel=0.12, abs=0.05)


def test_albedo_keeps_what_is_painted():
    _, albedo = estimated(paint="checks")
    truth = photo(paint="checks")[2]
    white = truth[:, 2] > 0.5
    use = inner()
    ratio = albedo[white & use].mean(axis=0) / albedo[~white & use].mean(axis=0)
    assert ratio[:2] == pytest.approx((np.array([0.7, 0.7, 0.65]) / COLOUR)[:2], rel=0.2)


def test_a_wrong_sun_makes_the_albedo_no_less_even_than_the_photo():
    found, albedo = estimated(sun=(-SUN[0], -SUN[1], SUN[2]), doubted=True)
    before = bytes_to_linear(photo()[0])[photo()[1]].astype(float)
    assert found.source == "default"
    before, after = (np.log(v[inner()].mean(axis=1)).std() for v in (before, albedo))
    # The decision is over all that is seen but the outline, so on this part it need not hold to the last digit.
    assert after < 1.03 * before


def test_nothing_is_whiter_than_white():
    bright = np.random.default_rng(2).uniform(0.5, 1.0, (20, 20, 3))
    albedo, exponent = compute_albedo(bright, np.full((20, 20, 3), 0.4), None, np.ones((20, 20), bool))
    assert exponent == 1.0
    found = bytes_to_linear(albedo)
    assert np.percentile(found.max(axis=2), 99.5) == pytest.approx(0.95, abs=0.01)
    assert found / bright == pytest.approx(np.full(bright.shape, 0.95), rel=0.03)


@settings(max_examples=30, deadline=None)
@given(st.floats(-2.0, 3.0), st.integers(0, 1000))
def test_the_exponent_is_where_one_colour_is_most_even(truth, seed):
    """Of light that is the ``truth``-th power of what was computed, and of paint that no light explains."""
    rng = np.random.default_rng(seed)
    computed = np.exp(rng.normal(0, 0.4, (40, 40, 1))) * np.ones(3)
    matter = np.exp(rng.normal(0, 0.02, (40, 40, 1))) * COLOUR
    brightness = 0.1 * matter * computed**truth
    found = division_exponent(brightness, computed, np.ones((40, 40), bool))
    # Half the shading is as far from all of it as from none: there it turns.
    assert found == pytest.approx(1.0 if truth > 0.5 else max(truth, 0.0), abs=0.02) or abs(truth - 0.5) < 0.02
    few = np.zeros((40, 40), bool)
    few[:15, :15] = True
    assert division_exponent(brightness, computed, few) == 1.0


@pytest.mark.parametrize("how", [{}, {"paint": "spot"}, {"paint": "checks", "roughness": 0.2}])
def test_bright_spots_off_the_sun_are_not_highlights(how):
    found, _ = estimated(**how)
    assert found.source == "default"
    assert (found.roughness, found.metallic) == (0.6, 0.0)


def test_without_a_sun_the_class_says():
    found, _ = estimated(kind="steel", sun=None, roughness=0.2)
    assert found.source == "class" and found.metallic == 1.0
    assert found.roughness == physics("steel").appearance_roughness
    assert "no sun" in found.note


def test_a_metal_by_its_name_is_not_fitted_as_varnish():
    found, _ = estimated(kind="steel", roughness=0.2, doubted=True)
    assert found.source == "class" and found.metallic == 1.0
