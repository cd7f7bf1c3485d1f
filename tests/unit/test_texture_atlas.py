# SPDX-License-Identifier: MIT
"""Bodies' textures seen from all sides: the photo in front, no mark twice, matter without seams or streaks behind."""

import functools
import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
import trimesh
from physgen.sim.reconstruct.camera.ground_camera import camera_above_ground
from physgen.sim.reconstruct.mesh_raster import rasterise
from physgen.sim.reconstruct.reconstruct_options import ObjectRequest, ReconstructOptions
from physgen.sim.reconstruct.shape.body_texture import crop_texture, glb_bytes, seen_vertices, textured
from physgen.sim.reconstruct.shape.built_body import build_body
from physgen.sim.reconstruct.shape.even_light import light_on
from physgen.sim.reconstruct.shape.plain_matter import plain_matter, synthesised_grain
from physgen.sim.reconstruct.shape.texture_atlas import textured_body
from physgen.sim.scene.shading import NEUTRAL, evenly_lit
from scipy import ndimage
from scipy.spatial import cKDTree

WIDTH, HEIGHT = 320, 280
VIEW = camera_above_ground(WIDTH, HEIGHT, 380.0, math.radians(12.0))
FUR, DARK, BLUE = (190, 130, 70), (25, 15, 10), (40, 60, 190)
ROWS, COLUMNS = np.mgrid[:HEIGHT, :WIDTH]
TOY = ((COLUMNS - 160) / 70.0) ** 2 + ((ROWS - 150) / 80.0) ** 2 < 1


def picture(mask, *, eyes=False, stripe=False):
    """A photo of grainy fur on grey ground, with two dark eyes or a stripe from outline to outline."""
    pixels = np.full((HEIGHT, WIDTH, 3), (120, 120, 125), np.float64)
    pixels[mask] = FUR
    if stripe:
        pixels[mask & (np.abs(ROWS - 150) < 14)] = BLUE
    pixels += np.random.default_rng(3).normal(0, 7, (HEIGHT, WIDTH, 1))
    if eyes:
        for column in (135, 185):
            pixels[(COLUMNS - column) ** 2 + (ROWS - 125) ** 2 < 9**2] = DARK
    return np.clip(pixels, 0, 255).astype(np.uint8)


@functools.cache
def body(name="toy", vertices=3000):
    mask = masks()[name]
    request = ObjectRequest(box=(0, 0, 9, 9), name="thing", shape="inflated")
    return build_body(VIEW, mask, request, ReconstructOptions(mesh_vertices=vertices), lambda said: None).mesh


def masks():
    ring = (COLUMNS - 160) ** 2 + (ROWS - 150) ** 2
    line, dot = np.zeros((HEIGHT, WIDTH), bool), np.zeros((HEIGHT, WIDTH), bool)
    line[60:220, 150:154] = True
    dot[200:206, 150:156] = True
    edge = np.zeros((HEIGHT, WIDTH), bool)
    edge[150:, :170] = True
    return {"toy": TOY, "ring": (ring < 80**2) & (ring > 60**2), "line": line, "dot": dot, "border": edge}


def made(photo, name="toy"):
    mask = masks()[name]
    return textured_body(VIEW, body(name), crop_texture(photo, mask), mask)


def seen_from(surface, turn_deg, side=260):
    """A picture (side, side, 4) with coverage of ``surface``, from the camera's height after a turn about it."""
    centre = (surface.vertices.min(axis=0) + surface.vertices.max(axis=0)) / 2
    turn = math.radians(turn_deg)
    towards = np.array([math.sin(turn), -math.cos(turn), 0.2])
    towards /= np.linalg.norm(towards)
    right = np.cross([0, 0, 1.0], towards)
    right /= np.linalg.norm(right)
    offset = surface.vertices - centre
    scale = 0.45 * side / np.linalg.norm(offset, axis=1).max()
    x, y = side / 2 + scale * offset @ right, side / 2 - scale * offset @ np.cross(towards, right)
    at = np.column_stack([x, y, 1e6 - offset @ towards])
    a, b, c = (at[surface.faces[:, i], :2] for i in range(3))
    front = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0]) < 0
    shown = rasterise(at, surface.faces, (side, side), front)
    height, width = surface.picture.shape[:2]
    uv = shown.interpolated(surface.faces, surface.uv)
    texels = surface.picture[
        np.clip(((1 - uv[:, 1]) * height).astype(int), 0, height - 1),
        np.clip((uv[:, 0] * width).astype(int), 0, width - 1),
    ]
    image = np.zeros((side, side, 4), np.uint8)
    image[shown.rows, shown.columns] = np.column_stack([texels, np.full(len(texels), 255)])
    return image


def dark_blobs(image):
    """Number of dark islands of more than ten pixels on the body in ``image``."""
    dark = (image[..., :3].mean(axis=2) < 70) & (image[..., 3] > 0)
    _, _, stats, _ = cv2.connectedComponentsWithStats(dark.astype(np.uint8))
    return int((stats[1:, cv2.CC_STAT_AREA] > 10).sum())


def test_eyes_are_not_repeated_behind():
    photo = picture(TOY, eyes=True)
    now, mirrored = made(photo), textured(body(), crop_texture(photo, TOY))
    assert dark_blobs(seen_from(now, 0)) == 2
    assert dark_blobs(seen_from(mirrored, 180)) == 2, "the count does not find what it should"
    for turn in (140, 160, 180, 200, 220):
        assert dark_blobs(seen_from(now, turn)) == 0


def test_a_stripe_that_reaches_the_outline_goes_round():
    for turn in (90, 180, 270):
        image = seen_from(made(picture(TOY, stripe=True)), turn).astype(int)
        blue = (image[..., 2] > image[..., 0] + 20) & (image[..., 3] > 0)
        covered = np.flatnonzero(image[..., 3].any(axis=0))
        inner = covered[len(covered) // 8 : -(len(covered) // 8)]
        assert blue[:, inner].any(axis=0).mean() > 0.95, turn
        # It stays a stripe.
        assert 0.05 < blue.sum() / (image[..., 3] > 0).sum() < 0.3, turn


def test_what_goes_round_stays_at_its_height():
    """Half way up, where light, marks and the way inwards from the outline leave heights as they are."""
    mesh = body()
    height = float(np.ptp(mesh.vertices[:, 2]))
    seen = seen_vertices(VIEW, mesh)
    middle = np.abs(mesh.vertices[:, 2] / height - 0.5) < 0.1
    behind = ~seen & middle & (mesh.vertices[:, 1] > np.percentile(mesh.vertices[~seen & middle][:, 1], 50))
    front = cKDTree(mesh.pixels[seen])
    distance, nearest = front.query(mesh.colours[behind])
    found = mesh.vertices[seen][nearest, 2]
    assert behind.sum() > 50 and np.median(distance) < 4.0
    assert np.median(np.abs(found - mesh.vertices[behind, 2])) < 0.04 * height


def test_well_seen_texels_are_the_photo_bit_for_bit():
    photo = picture(TOY, eyes=True)
    surface = made(photo)
    at = VIEW.project(surface.vertices)
    corner = at[surface.faces]
    a, b, c = (corner[:, i] for i in range(3))
    area = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    places = surface.vertices[surface.faces]
    normal = np.cross(places[:, 1] - places[:, 0], places[:, 2] - places[:, 0])
    towards = VIEW.position - places.mean(axis=1)
    lengths = np.linalg.norm(normal, axis=1) * np.linalg.norm(towards, axis=1)
    well = (normal * towards).sum(axis=1) / lengths > 0.5
    shown = rasterise(at, surface.faces, (WIDTH, HEIGHT), area < 0)
    # Of faces within 60 degrees, the pixels in the middle of the object.
    keep = well[shown.faces] & ndimage.binary_erosion(TOY, iterations=3)[shown.rows, shown.columns]
    height, width = surface.picture.shape[:2]
    uv = shown.interpolated(surface.faces, surface.uv)[keep]
    texels = surface.picture[((1 - uv[:, 1]) * height).astype(int), (uv[:, 0] * width).astype(int)]
    assert keep.sum() > 0.7 * TOY.sum()
    # Texture coordinates are interpolated in space, so a pixel's centre may fall on its neighbour's edge: not here.
    assert np.array_equal(texels, photo[shown.rows[keep], shown.columns[keep]])


def test_the_first_frame_is_the_photo_up_to_the_rim():
    photo = picture(TOY, eyes=True)
    surface = made(photo)
    side = 4
    at = VIEW.project(surface.vertices) * (side, side, 1)
    a, b, c = (at[surface.faces[:, i], :2] for i in range(3))
    front = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0]) < 0
    shown = rasterise(at, surface.faces, (WIDTH * side, HEIGHT * side), front)
    height, width = surface.picture.shape[:2]
    uv = shown.interpolated(surface.faces, surface.uv)
    image = np.zeros((HEIGHT * side, WIDTH * side, 3), np.float32)
    image[shown.rows, shown.columns] = surface.picture[
        ((1 - uv[:, 1]) * height).astype(int), (uv[:, 0] * width).astype(int)
    ]
    image = cv2.resize(image, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)
    error = ((image - photo) ** 2)[ndimage.binary_erosion(TOY, iterations=2)].mean()
    assert 10 * math.log10(255**2 / error) > 38.0


def test_no_texel_is_stretched_on_the_unseen_side():
    surface = made(picture(TOY))
    places = surface.vertices[surface.faces]
    normal = np.cross(places[:, 1] - places[:, 0], places[:, 2] - places[:, 0])
    area = np.linalg.norm(normal, axis=1) / 2
    height, width = surface.picture.shape[:2]
    at = (surface.uv * (width, height))[surface.faces]
    first, second = at[:, 1] - at[:, 0], at[:, 2] - at[:, 0]
    texels = np.abs(first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]) / 2
    pixels_per_unit = VIEW.fx / np.median(VIEW.project(surface.vertices)[:, 2])
    density = np.sqrt(texels / np.maximum(area, 1e-12)) / pixels_per_unit
    # A photo's pixel at 68° covers 1 / cos 68° = 2.7 of its size, 0.61 per side.
    assert np.average(density > 0.45, weights=area) > 0.995
    mirrored = textured(body(), crop_texture(picture(TOY), TOY))
    height, width = mirrored.picture.shape[:2]
    at = (mirrored.uv * (width, height))[mirrored.faces]
    first, second = at[:, 1] - at[:, 0], at[:, 2] - at[:, 0]
    texels = np.abs(first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]) / 2
    assert (np.sqrt(texels) < 0.1 * np.median(np.sqrt(texels))).mean() > 0.02, "the bound holds for anything"


@pytest.mark.parametrize("name", ["ring", "line", "dot", "border"])
def test_odd_outlines_get_a_texture(name):
    surface = made(picture(masks()[name]), name)
    assert np.isfinite(surface.uv).all() and surface.uv.min() >= 0 and surface.uv.max() <= 1
    assert len(surface.faces) == len(body(name).faces)
    # Charts split vertices; welded again the body is closed.
    welded = trimesh.Trimesh(surface.vertices, surface.faces, process=False)
    welded.merge_vertices(merge_tex=True, merge_norm=True)
    assert welded.is_watertight
    # Nothing of the ground, which is grey, shows on the body.
    image = seen_from(surface, 180).astype(int)
    there = image[ndimage.binary_erosion(image[..., 3] > 0)]
    if name in ("ring", "border"):
        assert (there[:, 0] - there[:, 2] > 40).mean() > 0.95


def test_each_face_has_texels_of_its_own():
    surface = made(picture(masks()["ring"]), "ring")
    height, width = surface.picture.shape[:2]
    at = np.column_stack([surface.uv * (width, -height) + (0, height), np.ones(len(surface.uv))])
    shown = rasterise(at, surface.faces, (width, height), np.ones(len(surface.faces), bool))
    # Where two charts overlapped, half of the faces there would own no texel.
    corner = at[surface.faces]
    first, second = corner[:, 1, :2] - corner[:, 0, :2], corner[:, 2, :2] - corner[:, 0, :2]
    area = np.abs(first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]) / 2
    assert abs(len(shown.rows) / area.sum() - 1.0) < 0.02


def test_the_same_photo_gives_the_same_bytes():
    photo = picture(TOY, eyes=True)
    first, second = (glb_bytes(made(photo), np.zeros(3), 1.0) for _ in range(2))
    assert first == second


def test_islands_are_marks_and_stripes_are_not():
    marks = plain_matter(picture(TOY, eyes=True), TOY).marks
    eyes = sum((COLUMNS - column) ** 2 + (ROWS - 125) ** 2 < 8**2 for column in (135, 185)) > 0
    assert marks[eyes].all() and marks.sum() < 4 * eyes.sum()
    matter = plain_matter(picture(TOY, stripe=True), TOY)
    assert not matter.marks[np.abs(ROWS - 150) < 8].any()
    assert np.abs(matter.colours[150, 120:200] - BLUE).max() < 30


def test_a_ribbon_goes_round_without_its_bow():
    """As wide as at its narrower end: the bow reaches the outline on the left, and lies in shade on the right."""
    ribbon = TOY & (np.abs(ROWS - 150) < 9)
    bow = TOY & (np.abs(ROWS - 150) < 26) & (COLUMNS < 190) & ~ribbon
    pixels = picture(TOY).astype(np.float64)
    pixels[ribbon | bow] = (190, 40, 45)
    pixels[COLUMNS > 195] *= 0.6
    found = plain_matter(pixels.astype(np.uint8), TOY)
    well_inside = bow & (np.abs(ROWS - 150) > 13) & (np.abs(COLUMNS - 150) < 45)
    assert found.marks[well_inside].mean() > 0.95
    # Nearer to fur than to the bow in green, which tells them apart.
    assert (found.colours[well_inside][:, 1] > (130 + 40) / 2).mean() > 0.95
    assert found.marks[ribbon & (np.abs(ROWS - 150) < 4) & (np.abs(COLUMNS - 160) < 60)].mean() < 0.05


def test_what_touches_the_outline_with_a_corner_is_a_mark():
    """A patch that is mostly in front, on fur; one of which half may be behind is none."""
    below = (COLUMNS - 160) ** 2 + (ROWS - 150) ** 2 < 60**2
    for middle, mark in ((88, True), (76, False)):
        patch = TOY & ((COLUMNS - 160) ** 2 + (ROWS - middle) ** 2 < 18**2)
        pixels = picture(TOY)
        pixels[patch] = BLUE
        found = plain_matter(pixels, TOY)
        assert found.marks[patch].mean() > 0.95 if mark else not found.marks.any()
        assert not found.marks[below & (ROWS > 110)].any()


def test_a_mark_is_filled_from_what_it_lies_on():
    """A yellow patch on a blue cushion that reaches down to the wood below leaves cushion, no wood."""
    pixels = np.full((HEIGHT, WIDTH, 3), (120, 120, 125), np.uint8)
    mask = (np.abs(COLUMNS - 160) < 90) & (np.abs(ROWS - 130) < 100)
    cushion = mask & (ROWS < 120)
    pixels[mask], pixels[cushion] = (190, 140, 80), (60, 90, 170)
    patch = (np.abs(COLUMNS - 140) < 22) & (ROWS > 70) & (ROWS < 120)
    pixels[patch] = (250, 240, 90)
    found = plain_matter(pixels, mask)
    assert found.marks[patch].mean() > 0.9
    # Its upper two thirds: at its lower end, cushion and wood are smoothed into each other everywhere.
    filled = found.colours[patch & (ROWS < 103)]
    assert np.abs(filled - (60, 90, 170)).max() < 20
    assert np.abs(found.colours[(ROWS > 140) & (ROWS < 200) & (np.abs(COLUMNS - 160) < 60)] - (190, 140, 80)).max() < 20


def test_a_badge_that_touches_a_wing_is_a_mark():
    """White as light as the belly and as colourless as the wing is an island in no channel alone."""
    pixels = np.full((HEIGHT, WIDTH, 3), (120, 120, 125), np.uint8)
    pixels[TOY] = (205, 170, 60)
    wing = TOY & (COLUMNS < 150) & (np.abs(ROWS - 150) < 40)
    badge = ((COLUMNS - 166) / 18) ** 2 + ((ROWS - 150) / 24) ** 2 < 1
    pixels[wing], pixels[badge] = (95, 95, 100), (178, 175, 172)
    found = plain_matter(pixels, TOY)
    assert found.marks[badge].mean() > 0.95
    assert found.marks[wing & (COLUMNS < 140)].mean() < 0.02
    # How far the wing goes on behind it is not known; next to the belly there is belly.
    assert np.abs(found.colours[badge & (COLUMNS > 172)] - (205, 170, 60)).max() < 20


def test_stripes_go_on_behind_a_mark_as_stripes():
    pixels = np.full((HEIGHT, WIDTH, 3), (120, 120, 125), np.uint8)
    mask = (np.abs(COLUMNS - 160) < 60) & (np.abs(ROWS - 150) < 110)
    red = mask & ((ROWS - 40) % 40 < 20)
    pixels[mask], pixels[red] = (215, 210, 195), (190, 60, 55)
    plain = plain_matter(pixels, mask).colours
    pixels[((COLUMNS - 165) / 24) ** 2 + ((ROWS - 155) / 22) ** 2 < 1] = (35, 45, 120)
    found = plain_matter(pixels, mask)
    assert found.marks[155, 165]
    # Each pixel is as where there is no mark, but where the wavering edge of a stripe runs.
    assert (np.abs(found.colours - plain).max(axis=-1)[mask] > 40).mean() < 0.02


def test_synthesised_grain_keeps_its_contrast_and_does_not_repeat():
    swatch = np.random.default_rng(0).normal(0, 10, (48, 48, 3)).astype(np.float32)
    rows, columns = np.mgrid[:300, :300]
    grain = synthesised_grain(swatch, np.column_stack([columns.ravel(), rows.ravel()]).astype(float), 1)
    grain = grain.reshape(300, 300, 3)
    # Over 20 000 patches' pixels the deviation scatters by a per cent.
    assert abs(grain.std() / swatch.std() - 1.0) < 0.05
    assert abs(grain.mean()) < 0.5
    spectrum = np.abs(np.fft.fft2(grain[..., 0])) ** 2
    repeated = np.real(np.fft.ifft2(spectrum)) / spectrum.sum() * grain[..., 0].size
    repeated[:4, :4] = repeated[-3:, :4] = repeated[:4, -3:] = repeated[-3:, -3:] = 0
    assert repeated.max() < 0.3 * np.real(np.fft.ifft2(spectrum))[0, 0] / spectrum.sum() * grain[..., 0].size


def test_print_all_over_is_no_grain():
    calm = picture(TOY)
    checks = np.where(((ROWS // 5 + COLUMNS // 5) % 2)[..., None] > 0, 220, 40) + (calm.astype(int) - FUR) // 4
    assert plain_matter(calm, TOY).swatch.std() > 5
    assert plain_matter(np.clip(checks, 0, 255).astype(np.uint8), TOY).swatch.std() < 2


def lit_from_the_right(strength=0.8):
    """The toy as an even ball in the light of a window to its right; linear light of the whole (h, w)."""
    across = np.clip((COLUMNS - 160) / 70.0, -1.0, 1.0)
    level = np.exp(strength * across)
    colour = (np.array(FUR) / 255.0) ** 2.2 * level[..., None] * 0.6
    pixels = np.full((HEIGHT, WIDTH, 3), (120, 120, 125), np.float64)
    pixels[TOY] = 255.0 * np.clip(colour[TOY], 0, 1) ** (1 / 2.2)
    pixels += np.random.default_rng(3).normal(0, 3, (HEIGHT, WIDTH, 1))
    return np.clip(pixels, 0, 255).astype(np.uint8), strength * across


def test_light_that_follows_the_shape_is_told_from_paint():
    photo, truth = lit_from_the_right()
    texture = crop_texture(photo, TOY)
    height, width = texture.pixels.shape[:2]
    window = (slice(texture.top, texture.top + height), slice(texture.left, texture.left + width))
    inside = ndimage.binary_erosion(TOY, iterations=8)[window]
    light = light_on(VIEW, body(), texture, TOY[window]).picture.mean(axis=2)[inside]
    wanted = truth[window][inside]
    assert np.corrcoef(light, wanted)[0, 1] > 0.97
    assert np.std(wanted - light) < 0.35 * np.std(wanted)
    # Spots that lie anywhere are paint.
    spotted = picture(TOY)
    for row, column in np.random.default_rng(2).uniform((90, 110), (210, 210), (14, 2)):
        spotted[(ROWS - row) ** 2 + (COLUMNS - column) ** 2 < 10**2] //= 2
    light = light_on(VIEW, body(), crop_texture(spotted, TOY), TOY[window]).picture[inside]
    assert np.abs(light).mean() < 0.05


def evenly(surface):
    return replace(surface, picture=evenly_lit(surface.picture, surface.shading, "toy"))


def brightness(surface, turn_deg, place):
    """Linear light of a square of ``surface`` from an angle, its middle at ``place`` of its width from the left."""
    image = seen_from(surface, turn_deg)
    shown = np.argwhere(image[..., 3] > 0)
    row, first, width = shown[:, 0].mean(), shown[:, 1].min(), np.ptp(shown[:, 1])
    square = image[int(row) - 12 : int(row) + 12, int(first + place * width) - 8 :][:, :16, :3]
    return (square.mean(axis=(0, 1)) / 255.0) ** 2.2


def test_evenly_lit_a_body_is_as_bright_from_all_sides():
    """In the photo its right side is exp(2 · 0.5) = 2.7 times as bright as its left one. Pixels and normals along the
    outline are doubtful, so a quarter of that may be left beside it."""
    photo, _ = lit_from_the_right(0.5)
    surface = made(photo)
    sides = [(0, 0.15), (0, 0.5), (0, 0.85), (60, 0.5), (120, 0.5), (180, 0.5), (240, 0.5), (300, 0.5)]
    lit = [brightness(surface, *side) for side in sides]
    assert np.ptp(np.log(lit), axis=0).min() > 0.7
    even = [brightness(evenly(surface), *side) for side in sides]
    assert np.ptp(np.log(even), axis=0).max() < 0.25
    # As what faces the camera.
    assert np.abs(np.log(even[1] / lit[1])).max() < 0.05


def test_paint_stays_where_it_says_nothing_of_the_light():
    surface = made(picture(TOY, stripe=True))
    used = surface.uv * surface.picture.shape[1::-1]
    rows, columns = (surface.picture.shape[0] - used[:, 1] - 0.5).astype(int), (used[:, 0] - 0.5).astype(int)
    values = surface.shading[rows.clip(0, None), columns.clip(0, None)]
    # 4 of 80 to a factor of e are 5 %.
    assert np.abs(values.astype(int) - NEUTRAL).max() <= 4


def test_light_is_doubted_where_the_pixels_around_do_not_follow_it():
    """Where the body is not shaped as it seems, its normals say nothing of the pixels; blotches would be the result."""
    photo, _ = lit_from_the_right(0.6)
    wrong = TOY & (COLUMNS > 165) & (ROWS > 165)
    photo[wrong] = photo[140:160, 155:165].mean(axis=(0, 1))
    texture = crop_texture(photo, TOY)
    height, width = texture.pixels.shape[:2]
    light = light_on(VIEW, body(), texture, TOY[texture.top :, texture.left :][:height, :width])
    at = np.array([[115, 150], [205, 150], [200, 190], [195, 195]]) - (texture.left, texture.top)
    left, right, *there = light.trust[at[:, 1], at[:, 0]]
    assert min(left, right) > 0.75
    assert max(there) < 0.5


def test_the_back_is_as_bright_on_both_sides():
    photo, _ = lit_from_the_right()
    back = seen_from(made(photo), 180.0)
    shown = np.argwhere(back[..., 3] > 0)
    middle, reach = shown.mean(axis=0), np.ptp(shown, axis=0)
    rows = slice(int(middle[0] - reach[0] / 6), int(middle[0] + reach[0] / 6))
    sides = [back[rows, int(middle[1] + turn * reach[1] / 4) - 8 :, :3][:, :16].mean() for turn in (-1, 1)]
    # In the photo they are 1.5 times apart.
    assert max(sides) / min(sides) < 1.15


def test_what_comes_from_places_far_apart_blends_behind():
    """A toy that is fur on its left and blue on its right; behind, each half has the colour of one of two pixels."""
    photo = picture(TOY)
    photo[TOY & (COLUMNS > 160)] = BLUE
    mesh = body()
    behind = ~seen_vertices(VIEW, mesh)
    places = np.where(mesh.vertices[:, :1] > 0.0, (120.0, 150.0), (200.0, 150.0))
    mesh = replace(mesh, colours=np.where(behind[:, None], places, mesh.colours))
    back = seen_from(textured_body(VIEW, mesh, crop_texture(photo, TOY), TOY), 180.0).astype(float)
    rows = np.flatnonzero(back[..., 3].any(axis=1))
    rows = rows[len(rows) // 3 : 2 * len(rows) // 3]
    # From one colour to the other, of which grain is a tenth.
    red = (back[rows, :, 0] - BLUE[0]) / (FUR[0] - BLUE[0])
    between = (red > 0.25) & (red < 0.75) & (back[rows, :, 3] > 0)
    between[:, : 130 - 40] = between[:, 130 + 40 :] = False
    # Faces are 4 pixels wide; the band around the seam is 21 pixels, half of which is between a quarter and three.
    assert np.median(between.sum(axis=1)) > 6


def test_no_flat_spots_on_a_round_side():
    """Even faces of a round body are no flat side: with another light, or pixels of its outline, they were dots."""
    pixels = np.full((HEIGHT, WIDTH, 3), (60, 50, 45), np.float64)
    across, up = (COLUMNS - 160) / 70.0, (150 - ROWS) / 80.0
    pixels[TOY] = (np.array([230, 215, 200]) * (0.75 + 0.25 * (up + 0.4 * across))[..., None].clip(0.2, 1.0))[TOY]
    surface = made(np.clip(pixels, 0, 255).astype(np.uint8))
    for turn in (100, 140, 180, 220, 260):
        image = seen_from(surface, turn)
        inside = ndimage.binary_erosion(image[..., 3] > 0, iterations=4)
        nearest = ndimage.distance_transform_edt(image[..., 3] == 0, return_distances=False, return_indices=True)
        grey = cv2.medianBlur(image[..., :3].mean(axis=2).astype(np.float32), 3)[tuple(nearest)]
        spots = [cv2.morphologyEx(grey, kind, np.ones((11, 11))) for kind in (cv2.MORPH_BLACKHAT, cv2.MORPH_TOPHAT)]
        assert np.max(spots, axis=0)[inside].max() < 12, turn


def painted_box(turn_deg, paint):
    """The textured box, the camera that looks down at it by 25°, and the matrix of its turn.

    paint: unit normals (n, 3) before the box was turned to sRGB colours (n, 3).
    """
    view = camera_above_ground(WIDTH, HEIGHT, 380.0, math.radians(25.0))
    size = np.array([0.5, 0.4, 0.35])
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (0, 2)]) * size / 2
    turn = math.radians(turn_deg)
    matrix = np.array([[math.cos(turn), -math.sin(turn), 0], [math.sin(turn), math.cos(turn), 0], [0, 0, 1]])
    solid = trimesh.convex.convex_hull(corners @ matrix.T + (0, 2.1, 0))
    at = view.project(solid.vertices)
    shown = rasterise(at, solid.faces, (WIDTH, HEIGHT))
    pixels, mask = np.full((HEIGHT, WIDTH, 3), (120, 120, 125), np.uint8), np.zeros((HEIGHT, WIDTH), bool)
    mask[shown.rows, shown.columns] = True
    pixels[shown.rows, shown.columns] = paint(solid.face_normals[shown.faces] @ matrix)
    request = ObjectRequest(box=(0, 0, 9, 9), name="box", shape="box")
    box = build_body(view, mask, request, ReconstructOptions(mesh_vertices=3000), lambda said: None).mesh
    return textured_body(view, box, crop_texture(pixels, mask), mask), view, matrix


def colours_of(surface):
    """Colours (T, 3) in the middles of the faces of ``surface``, and their unit normals (T, 3)."""
    a, b, c = (surface.vertices[surface.faces[:, i]] for i in range(3))
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    height, width = surface.picture.shape[:2]
    uv = surface.uv[surface.faces].mean(axis=1)
    return surface.picture[((1 - uv[:, 1]) * height).astype(int), (uv[:, 0] * width).astype(int)].astype(int), normal


def walls_of_a_box(turn_deg, paint):
    """Colours (T, 3) in the middles of the hidden walls' faces of a box, and their unit normals (T, 3) before the turn;
    see ``painted_box``."""
    surface, view, matrix = painted_box(turn_deg, paint)
    texels, normal = colours_of(surface)
    place = surface.vertices[surface.faces[:, 0]]
    wall = (np.abs(normal[:, 2]) < 0.3) & ((normal * (view.position - place)).sum(1) < 0)
    assert wall.sum() > 200
    return texels[wall], normal[wall] @ matrix


def shaded(front, flank=0.5, top=1.7):
    """Paint of a box of one colour whose top is in brighter light, and whose flanks are in the shade."""
    return lambda normal: front * np.select([normal[:, 2:] > 0.5, normal[:, 1:2] < -0.5], [top, 1.0], flank)


def test_evenly_lit_a_box_is_of_one_colour_on_all_sides():
    front = np.array([110, 85, 60])
    surface, _, matrix = painted_box(25.0, shaded(front))
    for texels, most in ((surface, None), (evenly(surface), 0.12)):
        colour, normal = colours_of(texels)
        normal = normal @ matrix
        ways = [
            np.median(colour[normal @ way > 0.9], axis=0)
            for way in np.array([[0, -1, 0], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, 0, 1]])
        ]
        apart = max(np.abs(way / front - 1.0).max() for way in ways)
        assert apart > 0.45 if most is None else apart < most


def test_a_hidden_side_of_a_box_has_its_colours_up_to_the_edge():
    """Along an edge between a visible and a hidden side, a vertex has the photo's pixel: it must not be mixed in."""
    texels, _ = walls_of_a_box(35.0, lambda normal: np.where(normal[:, 2:] > 0.5, (20, 40, 190), (200, 150, 60)))
    assert (texels[:, 0] > texels[:, 2]).mean() == 1.0


def test_the_back_of_a_box_is_as_bright_as_its_front():
    """Not as the mean of its front and of what is seen at a slant: a bright top, a dark flank."""
    front = np.array([110, 85, 60])
    texels, normal = walls_of_a_box(15.0, shaded(front))
    back = texels[normal[:, 1] > 0.9]
    # Top and flank still have a part, by the squared cosines 0.18 and 0.05 of their angles to the camera.
    assert np.abs(np.median(back, axis=0) / front - 1.0).max() < 0.08


def test_a_ball_is_as_bright_behind_as_in_front_at_the_same_height():
    """Light from above on a saturated colour, whose light is not told from paint: mirrored about the camera, which
    looks down, the back would be pale."""
    mask = ((COLUMNS - 160) ** 2 + (ROWS - 150) ** 2) < 80**2
    pixels = np.full((HEIGHT, WIDTH, 3), (90, 110, 150), np.float64)
    right, up = (COLUMNS[mask] - 160) / 80.0, (150 - ROWS[mask]) / 80.0
    height = up * math.cos(math.radians(30.0)) + np.sqrt(1 - right**2 - up**2) * math.sin(math.radians(30.0))
    pixels[mask] = np.array([1.0, 0.7, 0.02]) * (180 + 70 * height)[:, None]
    pixels = cv2.GaussianBlur(pixels, (0, 0), 0.8).astype(np.uint8)
    view = camera_above_ground(WIDTH, HEIGHT, 380.0, math.radians(30.0))
    request = ObjectRequest(box=(0, 0, 9, 9), name="ball", shape="sphere")
    ball = build_body(view, mask, request, ReconstructOptions(mesh_vertices=3000), lambda said: None).mesh
    surface = textured_body(view, ball, crop_texture(pixels, mask), mask)
    front, back = (seen_from(surface, turn).astype(int) for turn in (0, 180))
    for row in (60, 90, 130, 170):
        difference = front[row, 100:160, :3].mean(axis=0) - back[row, 100:160, :3].mean(axis=0)
        assert np.abs(difference).max() < 4, f"row {row}"
