# SPDX-License-Identifier: MIT
"""Image formation on small arrays."""

import itertools
import math

import numpy as np
import pytest
from physgen.sim import srgb
from physgen.sim.composite import compositing, disocclusion
from physgen.sim.composite.image_metrics import psnr
from physgen.sim.errors import InputError


def test_every_byte_survives_linear_light():
    values = np.arange(256, dtype=np.uint8)
    assert np.array_equal(srgb.linear_to_bytes(srgb.bytes_to_linear(values)), values)
    assert srgb.srgb_to_linear(np.array(0.5)) == pytest.approx(0.21404, abs=1e-5)


def test_psnr():
    black, grey = np.zeros((4, 4, 3), np.uint8), np.full((4, 4, 3), 51, np.uint8)
    assert psnr(black, black) == math.inf
    assert psnr(black, grey) == pytest.approx(20 * math.log10(5))
    mask = np.zeros((4, 4), bool)
    assert psnr(black, grey, mask) == math.inf


def test_shrinking_averages_light():
    image = np.zeros((2, 2, 3), np.float32)
    image[0, 0] = 1.0
    assert srgb.resized(image, 1, 1)[0, 0, 0] == pytest.approx(0.25)


def test_unreadable_images_are_named(tmp_path):
    (tmp_path / "bad.png").write_bytes(b"\x89PNG nothing")
    for name in ("bad.png", "missing.png"):
        with pytest.raises(InputError, match=name):
            srgb.read_rgb(tmp_path / name)


@pytest.fixture
def scene():
    rng = np.random.default_rng(1)
    photo, background = rng.random((2, 6, 8, 3)).astype(np.float32)
    mask = np.zeros((6, 8), bool)
    mask[2:4, 3:5] = True
    shadow = rng.uniform(0.2, 1, (6, 8, 3)).astype(np.float32)
    return photo, background, mask, shadow


def ground(scene, shadow, at_rest):
    photo, background, mask, rest_shadow = scene
    return compositing.ground_layer(
        photo=photo,
        background=background,
        shadow=shadow,
        rest_shadow=rest_shadow,
        at_rest=np.full((6, 8), at_rest, np.float32),
        masks=mask,
    )


def test_rest_is_the_photo_to_the_bit_but_never_inside_masks(scene):
    photo, background, mask, shadow = scene
    result = ground(scene, shadow, 1.0)
    assert np.array_equal(result[~mask], photo[~mask])
    assert np.allclose(result[mask], (background * shadow)[mask])


def test_gone_is_the_background_in_the_new_light(scene):
    _, background, _, shadow = scene
    assert np.allclose(ground(scene, shadow, 0.0), background * shadow)
    assert np.allclose(ground(scene, np.ones_like(shadow), 0.0), background)


def test_lifting_a_shadow_never_overshoots(scene):
    photo, background, mask, shadow = scene
    result = ground(scene, np.ones_like(shadow), 1.0)
    assert (result <= np.maximum(photo, background) + 1e-6)[~mask].all()


def test_light_ratio_is_one_at_rest_and_continues_beyond_the_outline():
    alpha = np.zeros((20, 20), np.float32)
    alpha[5:15, 5:15] = 1.0
    alpha[5, 5:15] = 0.1
    ratio = compositing.light_ratio(alpha[..., None] * np.float32(0.5) * np.ones(3, np.float32), alpha)
    assert np.allclose(ratio[4:16, 4:16], 0.5, atol=1e-3)
    assert np.allclose(ratio[0, 0], 1.0)


def test_compose_mixes_by_coverage():
    layer = compositing.empty_layer(2, 1)
    layer.alpha[0, 0] = 0.25
    layer.texture[0, 0] = 0.25
    result = compositing.compose(layer, np.full((1, 2, 3), 0.4, np.float32))
    assert result[0, 0, 0] == pytest.approx(0.25 + 0.75 * 0.4)
    assert result[0, 1, 0] == pytest.approx(0.4)


def test_rest_weight_fades_smoothly_from_one_to_zero():
    weights = [disocclusion.rest_weight(d) for d in np.linspace(0, 0.2, 100)]
    assert weights[0] == 1.0
    assert weights[-1] == 0.0
    assert all(a >= b for a, b in itertools.pairwise(weights))
    assert max(abs(a - b) for a, b in itertools.pairwise(weights)) < 0.06


def test_shares_sum_to_one_and_rest_is_exactly_one():
    places = np.zeros((3, 10, 12), bool)
    places[0, 2, 2] = places[1, 8, 9] = True
    shares = disocclusion.influence(list(places))
    assert np.allclose(shares.sum(0), 1)
    assert (disocclusion.rest_map(shares, [1.0, 1.0, 1.0]) == 1.0).all()
    moved = disocclusion.rest_map(shares, [0.0, 1.0, 1.0])
    assert moved[2, 2] < 0.1 < 0.9 < moved[8, 9]


def test_the_rim_gives_way_where_its_outline_moves():
    mask = np.zeros((30, 40), bool)
    mask[10:20, 10:30] = True
    corners = np.array([[10.0, 15.0], [30.0, 15.0]])
    rim = disocclusion.Rim(disocclusion.rim_strength(mask, mask), corners)
    weights = np.ones(mask.shape, np.float32)
    rim.apply(weights, corners)
    assert (weights == 1).all()
    rim.apply(weights, corners + np.array([[5.0, 0.0], [0.0, 0.0]]))
    assert weights[15, 9] == pytest.approx(0, abs=0.01)
    assert weights[15, 30] == 1
    assert weights[0, 0] == 1


def test_contact_is_the_foot():
    vertices = np.array([[0, 0, z] for z in np.linspace(0, 1, 11)])
    contact = disocclusion.contact_vertices(vertices, np.array([0, 0, 1.0]))
    assert contact.sum() == 2
    moved = vertices + np.array([0.3, 0.0, 0.0])
    assert disocclusion.contact_displacement(vertices, moved, contact, 1.0) == pytest.approx(0.3)


def disc(size=40, radius=14.0):
    """Coverage of a disc, and how much of it a soft border of 4 pixels leaves uncovered."""
    rows, columns = np.mgrid[:size, :size] - (size - 1) / 2.0
    depth = radius - np.hypot(rows, columns)
    alpha = np.clip(depth + 0.5, 0, 1).astype(np.float32)
    return alpha, (alpha * np.clip(0.5 - depth / 8.0, 0, 1)).astype(np.float32), depth


def test_a_soft_outline_at_rest_is_the_photo_whatever_lies_behind():
    alpha, lack, _ = disc()
    rng = np.random.default_rng(2)
    own, back = rng.uniform(0.2, 0.9, (2, 40, 40, 3)).astype(np.float32)
    cover = (alpha - lack)[..., None]
    photo = cover * own + (1 - cover) * back
    hard = compositing.ObjectLayer(texture=own * alpha[..., None], alpha=alpha, light=np.ones_like(own))
    reach = compositing.soft_reach(alpha, lack)
    assert 3 <= reach <= 6
    layer = compositing.matted(hard, lack, reach)
    soft = (layer.alpha > 0) & (layer.alpha < 1 - compositing.SOFT)
    assert soft.sum() > 200
    behind = compositing.behind(photo, layer)
    assert np.abs(behind - back)[soft].max() < 1e-3
    assert np.abs(compositing.compose(layer, behind) - photo)[soft].max() < 1e-5


@pytest.mark.parametrize("turned_px", [5.0, 7.0, 12.0])
def test_a_soft_outline_that_has_turned_to_the_front_hides_what_is_behind(turned_px):
    alpha, lack, depth = disc()
    reach = compositing.soft_reach(alpha, lack)
    turned = np.where(np.abs(depth - turned_px) < 1.5, 0.8 * alpha, 0.0).astype(np.float32)
    layer = compositing.ObjectLayer(texture=np.ones((40, 40, 3), np.float32), alpha=alpha, light=np.ones((40, 40, 3)))
    assert compositing.matted(layer, turned, reach).alpha[turned > 0].min() == 1.0
    assert compositing.matted(layer, lack, reach).alpha[lack > 0.3].max() < 0.7
    assert compositing.matted(layer, np.zeros_like(alpha), reach) is layer


def test_gaps_between_hairs_at_the_outline_stay_open():
    alpha, lack, depth = disc()
    rows, columns = np.mgrid[:40, :40]
    # Hairs a pixel wide across the soft band, every third pixel.
    hairs = ((rows + columns) % 3 == 0) & (depth < 4.0)
    lack = np.where(hairs, 0.0, lack).astype(np.float32)
    layer = compositing.ObjectLayer(texture=np.ones((40, 40, 3), np.float32), alpha=alpha, light=np.ones((40, 40, 3)))
    found = compositing.matted(layer, lack, compositing.soft_reach(alpha, lack))
    gaps = (depth > 1.0) & (depth < 3.0) & (lack > 0.05)
    assert gaps.sum() > 50
    assert np.abs(found.alpha - (alpha - lack))[gaps].max() < 0.02


def shaded_ground(seed=3):
    """Textured ground, the same in a brown shadow, and a grey rendered shadow that lies beside it by 3 pixels."""
    rng = np.random.default_rng(seed)
    background = rng.uniform(0.3, 0.6, (30, 40, 3)).astype(np.float32)
    shaded = np.zeros((30, 40), bool)
    shaded[8:22, 10:30] = True
    own = np.array([0.7, 0.55, 0.3], np.float32)
    photo = np.where(shaded[..., None], own * background, background)
    rendered = np.where(np.roll(shaded, 3, axis=1)[..., None], np.full(3, 0.4), 1.0).astype(np.float32)
    return photo, background, rendered, shaded, own


def test_a_rendered_shadow_takes_the_colour_and_depth_of_the_photos():
    photo, background, rendered, shaded, own = shaded_ground()
    known = np.ones_like(shaded)
    exponents = compositing.shadow_exponents(photo, background, rendered, shaded=shaded, known=known)
    assert np.log(0.4**exponents) == pytest.approx(np.log(own), rel=0.03)


def test_the_faint_outskirts_of_a_soft_shadow_take_nothing_from_its_depth():
    photo, background, rendered, shaded, own = shaded_ground()
    known = np.ones_like(shaded)
    soft = np.where(rendered < 1.0, rendered, np.float32(0.93))
    exponents = compositing.shadow_exponents(photo, background, soft, shaded=shaded, known=known)
    assert np.log(0.4**exponents) == pytest.approx(np.log(own), rel=0.03)


def test_towards_a_contact_a_tinted_shadow_is_black_in_every_colour():
    exponents, umbra = np.array([0.65, 1.0, 1.3], np.float32), 0.3
    levels = np.array([1.0, 0.6, 0.3, 0.15, 0.03, 0.0], np.float32)
    found = compositing.tinted_shadow(np.repeat(levels[None, :, None], 3, axis=2), exponents, umbra)[0]
    assert found[:3] == pytest.approx(levels[:3, None] ** exponents)
    # Half the umbra's light is half its colour's; without light there is none.
    assert found[3] == pytest.approx(0.5 * found[2]) and found[4] == pytest.approx(0.1 * found[2])
    assert (found[5] == 0.0).all() and (np.diff(found, axis=0) <= 0.0).all()
    even = compositing.tinted_shadow(np.full((1, 1, 3), 0.05, np.float32), np.ones(3, np.float32), umbra)
    assert even == pytest.approx(0.05)


def test_without_a_telling_shadow_it_stays_as_rendered():
    photo, background, rendered, shaded, _ = shaded_ground()
    known = np.ones_like(shaded)
    for dark, where in ((photo, np.zeros_like(shaded)), (background, shaded), (2.0 * photo / 0.3, shaded)):
        found = compositing.shadow_exponents(dark, background, rendered, shaded=where, known=known)
        assert (found == 1.0).all()
    # What cannot be is bounded: a black shadow, and one of which the render has hardly any.
    deep = compositing.shadow_exponents(0.0 * photo, background, rendered, shaded=shaded, known=known)
    assert (deep <= compositing.DEPTHS[1] * compositing.TINTS[1]).all() and (deep > 0).all()
    none = compositing.shadow_exponents(photo, background, np.ones_like(rendered), shaded=shaded, known=known)
    assert np.isfinite(none).all() and none.max() <= compositing.DEPTHS[1] * compositing.TINTS[1]


def test_what_turns_to_a_lamp_is_no_brighter_than_the_brightest_of_the_photo():
    own = np.array([0.2, 0.5, 0.9, 0.5], np.float32)
    light = np.stack([np.full(3, value, np.float32) for value in (6.0, 1.05, 1.4, 0.6)])[None]
    texture = np.repeat(own[None, :, None], 3, axis=2)
    layer = compositing.ObjectLayer(texture=texture, alpha=np.ones((1, 4), np.float32), light=light)
    bound = np.full((1, 4), 0.8, np.float32)
    lit = compositing.rolled_off(layer, bound).light * texture
    # Far above the bound it comes up to it, little gain and darkening stay, and what was brighter gains nothing.
    assert lit[0, :, 0] == pytest.approx([0.2 * (2.5 + 1.5 * -np.expm1(-3.5 / 1.5)), 0.525, 0.9, 0.3], abs=0.001)
    assert lit[0, 0, 0] < 0.8
    assert (compositing.rolled_off(layer, np.full((1, 4), np.inf, np.float32)).light == light).all()


def test_beside_what_landed_where_it_stood_a_cut_out_on_white_has_no_shadow_with_an_edge():
    """The photo shows none, so none may show within the clean plate around the outline either."""
    white = np.ones((30, 40, 3), np.float32)
    rows, columns = np.mgrid[:30, :40]
    away = np.hypot(rows - 15.0, columns - 20.0)
    mask, rim = away < 8, (away >= 8) & (away < 12)
    rendered = np.repeat((1.0 - 0.7 * np.exp(-away / 8.0))[..., None], 3, axis=2).astype(np.float32)
    nothing = np.zeros_like(mask)
    assert not compositing.shows_shadow(white, white, rendered, shaded=nothing, known=~mask & ~rim)
    shaded = ~mask & (rendered[..., 0] < 0.9)
    assert compositing.shows_shadow(white * rendered, white, rendered, shaded=shaded, known=~mask)
    assert compositing.shows_shadow(white, white, np.ones_like(white), shaded=nothing, known=~mask)

    def shown(contacts):
        shadow = compositing.appearing(rendered, np.full(mask.shape, contacts, np.float32))
        return compositing.ground_layer(
            photo=white,
            background=white,
            shadow=shadow,
            rest_shadow=np.ones_like(shadow),
            at_rest=np.where(rim, np.float32(0.0), np.float32(contacts)),
            masks=mask,
        )

    assert (shown(1.0) == 1.0).all()
    landed = shown(0.95)[15, :, 0]
    assert np.abs(np.diff(landed)).max() < 0.01
    assert shown(0.0) == pytest.approx(rendered)
