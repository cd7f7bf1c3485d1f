# SPDX-License-Identifier: MIT
"""Objects that are found without a box: on drawn photos, in a model's alpha, on the command line."""

import json
import shutil

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from physgen.batch.cli import main
from physgen.batch.commands import photo_commands
from physgen.sim.app import propose as propose_module
from physgen.sim.app.propose import LIST_FILE, PICTURE_FILE, best_proposals, choose, propose
from physgen.sim.errors import InputError
from physgen.sim.reconstruct.camera.vanishing_points import straight_lines
from physgen.sim.reconstruct.reconstruct_options import Proposal
from physgen.sim.reconstruct.segmentation.border_ownership import lines_go_on, sides_go_on
from physgen.sim.reconstruct.segmentation.object_proposals import (
    LEFT_ASIDE,
    candidates,
    proposals_from_alpha,
    propose_boxes,
    with_model,
    with_the_rest_aside,
)
from physgen.sim.reconstruct.segmentation.outline_sharpness import in_focus, outline_width, sharp_as
from physgen.sim.reconstruct.segmentation.proposal_features import lab_of
from PIL import Image
from scipy import ndimage

WIDTH, HEIGHT = 256, 192
THINGS = {(60, 110, 26): (190, 60, 40), (180, 90, 34): (40, 70, 150)}
"""Discs x, y, radius, and their colours."""
BEHIND = (100, 30, 20)
"""A coloured disc that is out of focus."""


def floor(seed=0):
    rng = np.random.default_rng(seed)
    streaks = ndimage.gaussian_filter(rng.normal(size=(HEIGHT, WIDTH)), (0.7, 12)) * 50
    return np.array([180.0, 150, 110]) + (streaks + rng.normal(scale=3, size=(HEIGHT, WIDTH)))[..., None]


def saved(image, path):
    Image.fromarray(np.clip(ndimage.gaussian_filter(image, (0.6, 0.6, 0)), 0, 255).astype(np.uint8)).save(path)
    return path


def drawn(path):
    rows, columns = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    image = floor()
    x, y, radius = BEHIND
    image[(columns - x) ** 2 + (rows - y) ** 2 < radius**2] = (40, 120, 60)
    image[:75] = ndimage.gaussian_filter(image[:75], (4, 4, 0))
    for (x, y, radius), colour in THINGS.items():
        image[(((columns - x) / (1.2 * radius)) ** 2 + ((rows - y - radius) / (0.3 * radius)) ** 2) < 1] *= 0.6
        image[(columns - x) ** 2 + (rows - y) ** 2 < radius**2] = colour
    return saved(image, path)


@pytest.fixture
def photo(tmp_path):
    return drawn(tmp_path / "photo.png")


@pytest.fixture(scope="module")
def proposals(tmp_path_factory):
    """A folder with the proposals of that photo, for tests that are not about the search."""
    folder = tmp_path_factory.mktemp("searched")
    propose(drawn(folder / "photo.png"), out=folder / "list")
    return folder / "list"


@pytest.fixture
def searched(photo, proposals, tmp_path):
    """The photo, beside the folder ``list`` with its proposals."""
    shutil.copytree(proposals, tmp_path / "list")
    return photo


def iou(box, other):
    width, height = (min(box[i + 2], other[i + 2]) - max(box[i], other[i]) for i in (0, 1))
    common = max(0, width) * max(0, height)
    return common / (sum((b[2] - b[0]) * (b[3] - b[1]) for b in (box, other)) - common)


def test_a_thing_that_nearly_fills_the_photo_gets_a_box_with_some_of_the_photo_around_it():
    alpha = np.zeros((HEIGHT, WIDTH))
    alpha[8:-8, 8:-8] = 1.0
    (x0, y0, x1, y1) = proposals_from_alpha(alpha)[0].box
    assert (x1 - x0) * (y1 - y0) < 0.98 * WIDTH * HEIGHT
    assert x0 <= 8 and y0 <= 8 and x1 >= WIDTH - 8 and y1 >= HEIGHT - 8


def test_both_things_are_found_and_come_first_and_what_is_out_of_focus_is_not(photo, tmp_path):
    found = propose(photo, out=tmp_path / "list")
    x, y, radius = BEHIND
    assert all(iou(item.box, (x - radius, y - radius, x + radius, y + radius)) < 0.3 for item in found)
    for x, y, radius in THINGS:
        assert max(iou(item.box, (x - radius, y - radius, x + radius, y + radius)) for item in found[:2]) > 0.5
    record = json.loads((tmp_path / "list" / LIST_FILE).read_text())
    assert (record["format"], record["width"], record["height"]) == ("physgen-proposals/1", WIDTH, HEIGHT)
    assert [tuple(item["box"]) for item in record["proposals"]] == [item.box for item in found]
    assert Image.open(tmp_path / "list" / PICTURE_FILE).size == (WIDTH, HEIGHT)


def blurred_behind(sharp):
    """A ball that is sharp or not before two coloured things that are out of focus, and the masks of all three."""
    rows, columns = np.mgrid[:120, :160] + 0.5
    image = np.full((120, 160, 3), 170.0) + np.random.default_rng(1).normal(scale=2, size=(120, 160, 1))
    masks = [(columns - x) ** 2 + (rows - y) ** 2 < r**2 for x, y, r in ((50, 32, 16), (112, 34, 18), (80, 84, 20))]
    for mask, colour in zip(masks, ((200, 40, 30), (30, 30, 40), (220, 180, 30)), strict=True):
        if mask is masks[-1]:
            image = ndimage.gaussian_filter(image, (4, 4, 0))
        image[mask] = colour
    image = ndimage.gaussian_filter(image, (0.7, 0.7, 0) if sharp else (4, 4, 0))
    return np.clip(image, 0, 255).astype(np.uint8), masks


def test_things_are_in_focus_as_sharp_as_the_sharpest_one():
    image, masks = blurred_behind(sharp=True)
    assert in_focus(masks, image) == [False, False, True]
    assert in_focus(masks, blurred_behind(sharp=False)[0]) == [True, True, True]


def test_what_is_softer_than_the_best_thing_on_a_fine_copy_is_not_as_sharp():
    """A house behind a can, as sharp as a fruit's outline on the coarse copy, but not on a copy of twice its size."""
    image, masks = np.full((480, 640, 3), 170.0), []
    rows, columns = np.mgrid[:480, :640] + 0.5
    for x, y, radius, colour in ((448, 136, 72, (30, 30, 40)), (320, 336, 80, (220, 180, 30))):
        masks.append((columns - x) ** 2 + (rows - y) ** 2 < radius**2)
        image = ndimage.gaussian_filter(image, (2.6, 2.6, 0))
        image[masks[-1]] = colour
    pixels = np.clip(ndimage.gaussian_filter(image, (0.7, 0.7, 0)), 0, 255).astype(np.uint8)
    small = [mask[::2, ::2] for mask in masks]
    assert in_focus(small, np.ascontiguousarray(pixels[::2, ::2])) == [True, True]
    assert sharp_as(1, small, pixels) == [False, True]
    # Where the soft one is the best, the photo is of soft things.
    assert sharp_as(0, small, pixels) == [True, True]


@pytest.mark.parametrize("sigma", [1.0, 2.0, 4.0])
def test_the_width_of_an_edge_is_that_of_its_blur(sigma):
    rows, columns = np.mgrid[:120, :160] + 0.5
    mask = (columns - 80) ** 2 + (rows - 60) ** 2 < 35**2
    lab = np.repeat(ndimage.gaussian_filter(100.0 * mask, sigma)[..., None], 3, axis=-1).astype(np.float32)
    # The step over the greatest slope of a step blurred by a Gaussian; a curved outline and 8 pixels' reach narrow it.
    assert outline_width(mask, lab) == pytest.approx(sigma * np.sqrt(2 * np.pi), rel=0.12)
    assert outline_width(np.zeros_like(mask), lab) is None


def test_an_equal_photo_is_searched_once_and_another_one_again(photo, tmp_path, monkeypatch):
    first = propose(photo, out=tmp_path / "list")
    # No search: what is read is what was found.
    monkeypatch.setattr(propose_module, "SEARCHED", None)
    assert propose(photo, out=tmp_path / "list") == first
    monkeypatch.undo()
    (tmp_path / "list" / LIST_FILE).write_text("{}")
    assert propose(photo, out=tmp_path / "list") == first


@pytest.mark.parametrize("image", [np.full((HEIGHT, WIDTH, 3), 120.0), floor(4)], ids=["even", "floor"])
def test_where_nothing_stands_out_one_line_says_so_and_nothing_is_written(image, tmp_path, capsys):
    path = saved(image, tmp_path / "photo.png")
    assert main(["reconstruct", str(path), "--out", str(tmp_path / "scene")]) == 3
    said = capsys.readouterr().err
    assert "no object stands out" in said and "--box" in said and said.count("\n") == 1
    assert [item.name for item in tmp_path.iterdir()] == ["photo.png"]


def test_a_photo_of_one_pixel_is_refused(tmp_path, capsys):
    Image.new("RGB", (1, 1)).save(tmp_path / "dot.png")
    assert main(["propose", str(tmp_path / "dot.png"), "--out", str(tmp_path / "list")]) == 3
    assert "at least 32x32" in capsys.readouterr().err
    assert not (tmp_path / "list").exists()


def test_the_command_lists_boxes_as_the_command_line_takes_them(searched, tmp_path, capsys):
    assert main(["propose", str(searched), "--out", str(tmp_path / "list")]) == 0
    lines = capsys.readouterr().out.splitlines()
    first = next(line for line in lines if line.strip().startswith("1 "))
    box = first.split("--box ")[1].split()[0]
    assert [float(v) for v in box.split(",")] == list(propose(searched, out=tmp_path / "list")[0].box)
    assert str(tmp_path / "list" / PICTURE_FILE) in lines[-1]


def requested(arguments, monkeypatch):
    """The boxes with which ``reconstruct`` would go on, and the notices."""
    seen = {}

    def instead(options, terminal, cancelled):
        notices = []
        photo_commands.use_found_boxes(options, options.out.with_name("list"), notices.append)
        seen.update(boxes=options.box, notices=[item["message"] for item in notices if item["event"] == "notice"])
        return 0

    monkeypatch.setattr(photo_commands, "run_reconstruct", instead)
    return main(["reconstruct", *map(str, arguments)]), seen


def test_without_a_box_the_best_are_taken_and_a_line_says_which(searched, tmp_path, monkeypatch):
    code, seen = requested([searched, "--out", tmp_path / "scene"], monkeypatch)
    assert code == 0 and len(seen["boxes"]) >= 2
    (line,) = seen["notices"]
    assert "--pick" in line and "--box" in line and PICTURE_FILE in line and "\n" not in line
    _, seen = requested([searched, "--out", tmp_path / "scene", "--pick", 2], monkeypatch)
    assert seen["boxes"] == [propose(searched, out=tmp_path / "list")[1].box]
    _, seen = requested([searched, "--out", tmp_path / "scene", "--name", "ball"], monkeypatch)
    assert len(seen["boxes"]) == 1


def test_picks_that_are_not_there_are_refused(searched, tmp_path, monkeypatch, capsys):
    for extra, message in (
        (["--pick", 99], "give numbers from 1 to"),
        (["--pick", 1, 1], "each once"),
        (["--pick", 1, "--box", "10,10,90,90"], "leave out one of the two"),
    ):
        assert requested([searched, "--out", tmp_path / "scene", *extra], monkeypatch)[0] == 3
        assert message in capsys.readouterr().err


def test_twenty_proposals_are_numbered_and_three_are_used():
    found = [Proposal((i, 0.0, i + 20.0, 20.0), 0.9) for i in range(20)]
    assert best_proposals(found) == [0, 1, 2]
    assert choose(found, [20, 3], 0) == [19, 2]
    assert choose(found, [], 5) == [0, 1, 2, 3, 4]
    assert best_proposals([Proposal((0, 0, 9, 9), 0.5)]) == [0]
    assert best_proposals([]) == []


def test_a_lawn_is_not_cut_into_an_object_unless_the_user_says_so(tmp_path, capsys):
    blades = np.random.default_rng(1).integers(0, 255, (400, 600, 3), dtype=np.uint8)
    Image.fromarray(blades).save(tmp_path / "lawn.png")
    found = propose(tmp_path / "lawn.png", out=tmp_path / "x_work" / "proposals")
    assert found and found[0].score < propose_module.LEAST_CLEAR
    assert main(["run", str(tmp_path / "lawn.png"), "--out", str(tmp_path / "x.mp4"), "--segmenter", "none"]) == 3
    assert "--pick 1" in capsys.readouterr().err and not (tmp_path / "x.mp4").exists()
    assert choose(found, [1], 0, least_clear=propose_module.LEAST_CLEAR) == [0]
    assert choose(found, [], 1, least_clear=propose_module.LEAST_CLEAR) == [0]


def test_a_photo_is_of_a_toy_and_not_of_the_skirting_behind_it():
    rows, columns = np.mgrid[:192, :256] + 0.5
    image = np.full((192, 256, 3), (150.0, 150, 160)) + np.random.default_rng(3).normal(scale=2, size=(192, 256, 1))
    image[40:54], image[54:] = (250, 250, 250), image[54:] - 30
    image[((columns - 125) / 35) ** 2 + ((rows - 120) / 50) ** 2 < 1] = (200, 50, 40)
    image = np.clip(ndimage.gaussian_filter(image, (0.6, 0.6, 0)), 0, 255).astype(np.uint8)
    found = propose_boxes(image)
    assert best_proposals(found) == [0] and iou(found[0].box, (90, 70, 160, 170)) > 0.5
    reached = [np.flatnonzero(mask.any(axis=0))[[0, -1]] for mask in candidates(image)]
    assert reached and not any(first == 0 and last == 255 for first, last in reached)


def masks_of(*boxes):
    masks = np.zeros((len(boxes), 100, 200), bool)
    for mask, (x0, y0, x1, y1) in zip(masks, boxes, strict=True):
        mask[y0:y1, x0:x1] = True
    return list(masks)


def test_what_is_cut_or_tiny_is_used_where_there_is_nothing_else():
    whole, cut, speck = (60, 20, 110, 80), (150, 0, 200, 60), (20, 70, 28, 78)
    scores = [0.95, 0.97, 0.99]
    assert with_the_rest_aside(masks_of(whole, cut, speck), scores, [0.0] * 3) == [0.95, LEFT_ASIDE, LEFT_ASIDE]
    assert with_the_rest_aside(masks_of(cut, speck), scores[1:], [0.0] * 2) == [0.97, LEFT_ASIDE]
    assert with_the_rest_aside(masks_of(speck), scores[2:], [0.0]) == [0.99]
    assert with_the_rest_aside([], [], []) == []
    # A car far behind is left aside, an orange beside a book is not.
    far, orange = (120, 0, 132, 12), (120, 60, 138, 78)
    assert with_the_rest_aside(masks_of(whole, far, orange), [0.99, 0.98, 0.98], [0.0] * 3) == [0.99, LEFT_ASIDE, 0.98]
    # A poor one neither makes others tiny nor is raised.
    poor = (0, 0, 190, 99)
    assert with_the_rest_aside(masks_of(poor, speck), [0.6, 0.99], [0.0, 0.0]) == [0.6, 0.99]


def test_a_strip_of_the_mat_is_not_used_beside_the_meal_but_where_there_is_nothing_else():
    meal, strip = (60, 20, 110, 80), (120, 60, 190, 80)
    masks, scores = masks_of(meal, strip), [0.99, 0.93]
    assert with_the_rest_aside(masks, scores, [0.1, 0.9]) == [0.99, LEFT_ASIDE]
    assert with_the_rest_aside(masks, scores, [0.1, 0.6]) == [0.99, 0.93]
    assert with_the_rest_aside(masks, scores, [0.8, 0.9]) == [0.99, 0.93]
    # What is left aside itself says nothing about the others.
    assert with_the_rest_aside(masks, [0.6, 0.93], [0.1, 0.9]) == [0.6, 0.93]


def test_a_model_s_alpha_becomes_boxes():
    alpha = np.zeros((100, 200), np.float32)
    alpha[20:60, 30:80] = 0.9
    alpha[30:80, 120:180] = 1.0
    alpha[5:7, 5:7] = 1.0
    found = proposals_from_alpha(alpha)
    assert len(found) == 2
    assert iou(found[0].box, (120, 30, 180, 80)) > 0.7 and iou(found[1].box, (30, 20, 80, 60)) > 0.7
    assert found[0].score > found[1].score
    assert proposals_from_alpha(np.zeros((50, 50))) == []


def test_what_a_model_sees_as_one_is_one_and_its_objects_are_used_first():
    whole, lone = Proposal((40, 20, 140, 90), 0.93), Proposal((200, 20, 260, 80), 0.71)
    halves = [Proposal((40, 20, 88, 90), 0.99), Proposal((92, 22, 140, 90), 0.98)]
    other = Proposal((10, 120, 60, 170), 0.97)
    found = with_model([lone, whole], [*halves, other], 0.8)
    assert [item.box for item in found] == [whole.box, lone.box, other.box]
    assert best_proposals(found) == [0] and found[-1].score < 0.8
    assert with_model([], halves, 0.8) == halves


@settings(max_examples=40)
@given(st.integers(1, 40), st.integers(1, 40), st.integers(0, 2**31), st.booleans())
def test_any_alpha_gives_boxes_within_the_picture(height, width, seed, broken):
    rng = np.random.default_rng(seed)
    alpha = ndimage.gaussian_filter(rng.normal(size=(height, width)), 2.0) * 20
    if broken:
        alpha[0, 0], alpha[-1, -1] = np.nan, np.inf
    for item in proposals_from_alpha(alpha):
        x0, y0, x1, y1 = item.box
        assert 0 <= x0 < x1 <= width and 0 <= y0 < y1 <= height and 0 <= item.score <= 1


def test_a_photo_that_is_missing_is_named(tmp_path):
    with pytest.raises(InputError, match="no such photo"):
        propose(tmp_path / "nothing.jpg")


def boards(seed=0):
    """Boards with dark seams (200 x 300), lit from the side; and a grid of rows and columns."""
    noise = np.random.default_rng(seed).normal(scale=3.0, size=(200, 300, 1))
    picture = np.full((200, 300, 3), (150.0, 110.0, 70.0)) + noise
    picture[24::40] = picture[25::40] = (60.0, 40.0, 30.0)
    return picture, *np.mgrid[:200, :300]


def test_lines_go_on_through_a_patch_of_light_but_not_through_a_thing():
    """Sunlit boards of a bench flew beside a candle."""
    picture, rows, columns = boards()
    sunny = (np.abs(columns - 90) < 50) & (np.abs(rows - 100) < 70)
    thing = (np.abs(columns - 220) < 30) & (np.abs(rows - 100) < 60)
    # The sun is half a degree wide: light has soft edges.
    picture *= 1.0 + 0.4 * ndimage.gaussian_filter(sunny.astype(float), 8.0)[..., None]
    picture[thing] = (40.0, 90.0, 160.0)
    lines = straight_lines(np.clip(picture, 0, 255).astype(np.uint8))
    assert lines_go_on(sunny, lines)
    assert not lines_go_on(thing, lines)
    # A single line may end behind a thing and begin again beside it by chance.
    assert not lines_go_on(sunny, lines[:0])


def bench(seed=0):
    """A seat and a back of one colour with grass between them (300 x 400), the grass (h, w), and a grid of rows and
    columns: the slats' edges, which slope a little, go on before a post on either side."""
    rng = np.random.default_rng(seed)
    rows, columns = np.mgrid[:300, :400] + 0.5
    noise = rng.normal(scale=3.0, size=(300, 400, 1))
    picture = np.full((300, 400, 3), (60.0, 140.0, 110.0)) + noise
    between = (rows > 90 + 0.08 * columns) & (rows < 150 + 0.08 * columns)
    picture[between] = (45.0, 110.0, 85.0)
    gap = between & (columns > 70) & (columns < 330)
    grass = ndimage.gaussian_filter(rng.normal(size=(300, 400)), 1.0) * 60
    picture[gap] = (np.array([120.0, 130.0, 60.0]) + grass[..., None])[gap]
    return picture, gap, rows, columns


def test_a_gap_of_a_bench_lies_behind_its_slats_and_a_thing_on_it_does_not():
    """Grass between the slats of a bench flew beside a shoe."""
    picture, gap, rows, columns = bench()
    box = (np.abs(columns - 200) < 60) & (np.abs(rows - 220) < 50)
    picture[box] = (190.0, 90.0, 60.0)
    lightness = lab_of(np.clip(picture, 0, 255).astype(np.uint8))[..., 0]
    assert sides_go_on(gap, lightness)
    assert not sides_go_on(box, lightness)


def test_a_thing_that_ends_at_one_line_owns_its_outline():
    """A book's upper edge may lie in line with the far edge of its table."""
    picture, _, rows, columns = bench()
    picture[:] = np.where((rows < 120.0)[..., None], (200.0, 195.0, 190.0), (120.0, 90.0, 60.0))
    book = (np.abs(columns - 200) < 60) & (rows > 120) & (rows < 240)
    picture[book] = (50.0, 60.0, 150.0)
    assert not sides_go_on(book, lab_of(np.clip(picture, 0, 255).astype(np.uint8))[..., 0])


@pytest.mark.parametrize("shape", [(1, 1), (8, 8), (9, 400), (400, 9)])
def test_plain_pictures_have_no_sides_that_go_on(shape):
    plain = lab_of(np.full((*shape, 3), 90, np.uint8))[..., 0]
    assert not sides_go_on(np.ones(shape, bool), plain)
    assert not sides_go_on(np.zeros(shape, bool), plain)


@pytest.mark.parametrize("shape", [(1, 1), (8, 8), (9, 400)])
def test_pictures_without_lines_have_none_that_go_on(shape):
    plain = np.full((*shape, 3), 90, np.uint8)
    assert not lines_go_on(np.ones(shape, bool), straight_lines(plain))
