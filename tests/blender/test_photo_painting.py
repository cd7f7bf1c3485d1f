# SPDX-License-Identifier: GPL-3.0-or-later
"""Masks and the horizon, painted and dragged over a photo: as events, as Blender keeps them, as they are drawn."""

import math
import subprocess
import sys
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

bpy = pytest.importorskip("bpy")
from physgen.physgen_addon.operators import mask_horizon_ops
from physgen.physgen_addon.operators.mask_horizon_ops import PHYSGEN_OT_paint_mask
from physgen.physgen_addon.operators.photo_object_ops import PHYSGEN_OT_draw_strokes, add_found, stroke_lines
from physgen.physgen_addon.operators.photo_ops import (
    PHYSGEN_OT_draw_box,
    add_box,
    set_photo,
)
from physgen.physgen_addon.panels.scene_panel import PHYSGEN_PT_scene
from physgen.physgen_addon.photo.photo_image import (
    PhotoTool,
    first_mask,
    mask_size,
    read_mask_image,
    store_mask,
    tool_help,
    widen,
    write_masks,
)
from physgen.physgen_addon.photo.photo_maths import Painting, ellipse, extent
from physgen.physgen_addon.photo.photo_request import (
    arguments,
    mask_files,
    scene_folder,
    take_camera,
)
from physgen.sim.reconstruct.camera.ground_camera import camera_above_ground
from physgen.sim.reconstruct.reconstruct_options import Proposal
from physgen.sim.reconstruct.segmentation.object_masks import read_mask

from . import checked_layout

ROOT = Path(__file__).resolve().parents[2]


pytestmark = pytest.mark.usefixtures("addon")


@pytest.fixture
def photo(tmp_path):
    """A grey photo, opened, with a box around nothing; the state of the scene."""
    path = tmp_path / "a ball.png"
    Image.new("RGB", (320, 240), (128, 128, 128)).save(path)
    set_photo(bpy.context.scene, path)
    add_box(bpy.context.scene, (116, 56, 212, 156), "ball")
    return bpy.context.scene.physgen_photo


def drawn(size=(320, 240), box=(100, 80, 200, 180)):
    return ellipse(*size, box)


# -- masks ------------------------------------------------------------------------------------------------------------


def test_a_painted_mask_is_packed_and_comes_back_with_the_file(photo, tmp_path):
    mask = drawn()
    image = store_mask(photo.boxes[0], mask)
    assert image.name == "ball mask" and image.packed_file is not None
    path = str(tmp_path / "shot.blend")
    bpy.ops.wm.save_as_mainfile(filepath=path)
    bpy.ops.wm.open_mainfile(filepath=path)
    box = bpy.context.scene.physgen_photo.boxes[0]
    assert (read_mask_image(box.mask) == mask).all()


def test_painting_again_changes_the_same_image_and_never_an_artists_own(photo):
    box = photo.boxes[0]
    mine = store_mask(box, drawn())
    assert store_mask(box, drawn(box=(0, 0, 50, 50))) == mine
    assert (read_mask_image(mine) == drawn(box=(0, 0, 50, 50))).all()
    own = bpy.data.images.new("own", 320, 240)
    box.mask = own
    assert store_mask(box, drawn()) != own and not read_mask_image(own).any()


def test_a_mask_goes_with_its_box(photo):
    box = photo.boxes[0]
    assert not bpy.ops.physgen.clear_mask.poll()
    store_mask(box, drawn())
    assert bpy.ops.physgen.clear_mask() == {"FINISHED"}
    assert box.mask is None and "ball mask" not in bpy.data.images
    store_mask(box, drawn())
    assert store_mask(box, np.zeros((240, 320), dtype=bool)) is None and box.mask is None
    store_mask(box, drawn())
    assert bpy.ops.physgen.remove_box() == {"FINISHED"} and "ball mask" not in bpy.data.images


def test_files_hold_the_mask_and_the_same_mask_is_the_same_file(photo):
    ball, cup = photo.boxes[0], add_box(bpy.context.scene, (0, 0, 60, 60), "cup")
    store_mask(ball, drawn())
    files = mask_files(photo, scene_folder(photo))
    assert list(files) == ["ball"]
    # An artist's picture that says it by transparency.
    cup.mask = bpy.data.images.new("cut out", 640, 480, alpha=True)
    pixels = np.full((480, 640, 4), 0.25, dtype=np.float32)
    pixels[..., 3] = np.kron(drawn(box=(20, 30, 90, 70)), np.ones((2, 2)))[::-1]
    cup.mask.pixels.foreach_set(pixels.ravel())
    files = mask_files(photo, scene_folder(photo))
    images = len(bpy.data.images)
    write_masks(dict(files.values()))
    assert len(bpy.data.images) == images
    assert (read_mask(files["ball"][0], 320, 240) == drawn()).all()
    assert (read_mask(files["cup"][0], 320, 240) == drawn(box=(20, 30, 90, 70))).all()
    before = {path: (path.read_bytes(), path.stat().st_ino) for path, _ in files.values()}
    write_masks(dict(files.values()))
    assert {path: (path.read_bytes(), path.stat().st_ino) for path in before} == before
    assert sorted(path.name for path in files["ball"][0].parent.iterdir()) == ["ball.png", "cup.png"]


def test_a_mask_that_cannot_be_written_is_told(photo, tmp_path):
    store_mask(photo.boxes[0], drawn())
    (tmp_path / "a ball_scene_masks").write_text("in the way")
    with pytest.raises(RuntimeError, match="mask cannot be written"):
        bpy.ops.physgen.reconstruct()


def test_painting_begins_with_the_best_that_is_known(photo, tmp_path):
    box, size = photo.boxes[0], mask_size(photo)
    assert size == (320, 240)
    assert extent(first_mask(photo, box, tmp_path / "none.png")) == (box.x0, box.y0, box.x1, box.y1)
    found, seen = tmp_path / "found.png", drawn((160, 120), (30, 20, 90, 80))
    Image.fromarray(seen.astype(np.uint8) * 255).save(found)
    images = len(bpy.data.images)
    assert (first_mask(photo, box, found) == np.kron(seen, np.ones((2, 2)))).all() and len(bpy.data.images) == images
    store_mask(box, drawn())
    assert (first_mask(photo, box, found) == drawn()).all()


def test_a_box_grows_with_its_mask(photo):
    box = photo.boxes[0]
    before = (box.x0, box.y0, box.x1, box.y1)
    # As for a photo that is shown smaller than it is.
    photo.width, photo.height = 640, 480
    painting = Painting(np.zeros((240, 320), dtype=bool))
    painting.press((310, 230), 6.0, adds=True)
    widen(photo, box, painting.mask)
    assert (box.x0, box.y0) == before[:2]
    assert 632 <= box.x1 <= 634 and 472 <= box.y1 <= 474
    widen(photo, box, np.zeros((240, 320), dtype=bool))
    assert 632 <= box.x1 <= 634


def test_nothing_is_painted_where_no_editor_shows_the_photo(photo):
    assert not bpy.ops.physgen.paint_mask.poll() and not bpy.ops.physgen.set_horizon.poll()


# -- strokes and drags, event by event --------------------------------------------------------------------------------

WIDE, HIGH = 800, 600
"""Pixels of the region in which the photo fills everything; it begins at 100, 50 of the window."""


class View:
    """What Blender tells of a region's view: here the photo fits it exactly."""

    def region_to_view(self, x, y):
        return x / WIDE, y / HIGH


@pytest.fixture
def window(photo):
    """A context with one image editor that shows the photo; there are no windows in background mode."""
    nothing = SimpleNamespace(
        cursor_modal_set=lambda name: None,
        cursor_modal_restore=lambda: None,
        status_text_set=lambda text: None,
        modal_handler_add=lambda operator: None,
    )
    region = SimpleNamespace(type="WINDOW", x=100, y=50, width=WIDE, height=HIGH, view2d=View())

    class Regions(list):
        def values(self):
            return self

    space = SimpleNamespace(image=photo.image)
    area = SimpleNamespace(
        type="IMAGE_EDITOR", spaces=SimpleNamespace(active=space), regions=Regions([region]), tag_redraw=lambda: None
    )
    nothing.screen = SimpleNamespace(areas=[area])
    return SimpleNamespace(scene=bpy.context.scene, window=nothing, workspace=nothing, window_manager=nothing)


def operate(kind):
    """The operator's own methods, without Blender, which makes no operator outside an event."""
    methods = {name: value for name, value in vars(kind).items() if callable(value) or name.startswith("tool_")}
    return type("Operator", (PhotoTool,), {**methods, "report": lambda self, level, text: None})()


def event(kind, u=0.0, v=0.0, value="PRESS", **held):
    """The mouse at the place u, v of the photo, from its upper left corner."""
    place = {"mouse_x": 100 + round(u * WIDE), "mouse_y": 50 + round((1 - v) * HIGH)}
    return SimpleNamespace(type=kind, value=value, **place, **{"ctrl": False, "shift": False, **held})


def test_strokes_make_a_mask(window, photo):
    operator, box = operate(PHYSGEN_OT_paint_mask), photo.boxes[0]
    assert operator.invoke(window, event("NONE")) == {"RUNNING_MODAL"}
    modal = partial(operator.modal, window)
    # Nothing was painted: nothing changes.
    assert modal(event("ESC")) == {"CANCELLED"} and box.mask is None
    operator.invoke(window, event("NONE"))
    for one in (
        event("LEFTMOUSE", 0.1, 0.1),
        event("MOUSEMOVE", 0.2, 0.1, "NOTHING"),
        event("LEFTMOUSE", 0.2, 0.1, "RELEASE"),
        event("MOUSEMOVE", 0.3, 0.3, "NOTHING"),
        event("LEFTMOUSE", 0.5, 0.5, ctrl=True),
        event("LEFTMOUSE", 0.5, 0.5, "RELEASE"),
        event("LEFTMOUSE", 0.8, 0.8),
        event("LEFTMOUSE", 0.8, 0.8, "RELEASE"),
        event("Z", ctrl=True),
    ):
        assert modal(one) == {"RUNNING_MODAL"}
    assert modal(event("WHEELUPMOUSE")) == {"PASS_THROUGH"} and modal(event("MIDDLEMOUSE")) == {"PASS_THROUGH"}
    assert modal(event("RET")) == {"FINISHED"}
    mask = read_mask_image(box.mask)
    for (u, v), inside in {(0.15, 0.1): True, (0.5, 0.5): False, (0.8, 0.8): False, (0.3, 0.3): False}.items():
        assert mask[int(v * 240), int(u * 320)] == inside
    # The brush is 20 pixels of the screen wide, 8 of the photo's: 320 of them fill 800.
    assert extent(mask)[:2] == (32 - 8, 24 - 8)
    assert box.x0 == 24


def test_a_click_elsewhere_ends_painting_and_keeps_it(window, photo):
    operator = operate(PHYSGEN_OT_paint_mask)
    operator.invoke(window, event("NONE"))
    operator.modal(window, event("LEFTMOUSE", 0.1, 0.1))
    operator.modal(window, event("LEFTMOUSE", 0.1, 0.1, "RELEASE"))
    assert operator.modal(window, event("LEFTMOUSE", 1.5, 0.1)) == {"FINISHED", "PASS_THROUGH"}
    assert read_mask_image(photo.boxes[0].mask)[24, 32]


def test_a_finer_brush_paints_less(window, photo):
    sizes = []
    for changes in (0, 3, -3):
        store_mask(photo.boxes[0], np.arange(240 * 320).reshape(240, 320) == 0)
        operator = operate(PHYSGEN_OT_paint_mask)
        operator.invoke(window, event("NONE"))
        kind = "LEFT_BRACKET" if changes > 0 else "RIGHT_BRACKET"
        for _ in range(abs(changes)):
            operator.modal(window, event(kind))
        operator.modal(window, event("LEFTMOUSE", 0.5, 0.5))
        operator.modal(window, event("RIGHTMOUSE"))
        sizes.append(int(read_mask_image(photo.boxes[0].mask).sum()))
    # The size is remembered: first as it is, then finer by three steps, then as it was.
    assert sizes[1] < 0.5 * sizes[0] and sizes[2] == sizes[0]


def test_painting_stops_when_its_box_is_gone(window, photo):
    operator = operate(PHYSGEN_OT_paint_mask)
    operator.invoke(window, event("NONE"))
    photo.boxes.clear()
    assert operator.modal(window, event("MOUSEMOVE", 0.5, 0.5, "NOTHING")) == {"CANCELLED"}


def test_the_horizon_follows_the_mouse(window, photo):
    photo.has_found, photo.found_horizon = True, 0.2
    operator = operate(mask_horizon_ops.PHYSGEN_OT_set_horizon)
    operator.invoke(window, event("NONE"))
    modal = partial(operator.modal, window)
    assert photo.camera == "HORIZON" and modal(event("MOUSEMOVE", 0.5, 0.9, "NOTHING")) == {"PASS_THROUGH"}
    for one in (
        event("LEFTMOUSE", 0.5, 0.5),
        event("MOUSEMOVE", 0.5, 0.4, "NOTHING"),
        event("MOUSEMOVE", 0.4, 0.3, "NOTHING"),
        event("LEFTMOUSE", 0.4, 0.3, "RELEASE"),
    ):
        assert modal(one) == {"RUNNING_MODAL"}
    assert (photo.horizon, photo.roll) == (pytest.approx(0.0, abs=1e-6), pytest.approx(0.0, abs=1e-6))
    modal(event("LEFTMOUSE", 0.9, 0.5))
    modal(event("MOUSEMOVE", 0.9, 0.6, "NOTHING"))
    assert photo.horizon == pytest.approx(0.05, abs=1e-6)
    assert math.tan(photo.roll) == pytest.approx(0.1 * 240 / 320, abs=1e-6)
    assert modal(event("LEFTMOUSE", 1.5, 0.5)) == {"FINISHED", "PASS_THROUGH"}


# -- horizon ----------------------------------------------------------------------------------------------------------


def test_the_horizon_that_was_found_is_where_a_correction_begins(photo):
    assert mask_horizon_ops.horizon_shown(photo) is None
    take_camera(photo, camera_above_ground(320, 240, 300.0, math.radians(35)))
    expected = 0.5 - 300.0 * math.tan(math.radians(35)) / 240
    assert photo.found_horizon == pytest.approx(expected, abs=1e-4)
    assert math.degrees(photo.found_pitch) == pytest.approx(35, abs=1e-3)
    ends, _, label = mask_horizon_ops.horizon_shown(photo)
    assert ends == pytest.approx((expected, expected), abs=1e-4) and "as found" in label
    mask_horizon_ops.take_over(photo)
    assert photo.camera == "HORIZON" and photo.horizon == pytest.approx(expected, abs=1e-4)
    mask_horizon_ops.drag(photo, (photo.horizon, photo.roll), 0.9, 0.1)
    left, right = mask_horizon_ops.horizon_shown(photo)[0]
    assert (left, right) == pytest.approx((expected, expected + 0.1), abs=1e-4) and photo.roll > 0
    # What was told stays when it is taken up again.
    mask_horizon_ops.take_over(photo)
    assert photo.horizon == pytest.approx(expected + 0.05, abs=1e-4)


# -- drawing ----------------------------------------------------------------------------------------------------------

DRAWING = """
import os, sys
import bpy, gpu
if not hasattr(gpu, "init"):
    os._exit(3)
sys.path.insert(0, sys.argv[1])
gpu.init()
sys.stdout.write("ready\\n")
sys.stdout.flush()
import numpy as np
from mathutils import Matrix
from physgen.physgen_addon.photo.photo_maths import Painting, ellipse
from physgen.physgen_addon.operators.mask_horizon_ops import (
    USER_COLOUR,
    draw_brush,
    draw_horizon,
    draw_tint,
    tint_texture,
)
wide, high = 320, 240
screen = gpu.types.GPUOffScreen(wide, high)
with screen.bind():
    buffer = gpu.state.active_framebuffer_get()
    buffer.clear(color=(0.5, 0.5, 0.5, 1.0))
    with gpu.matrix.push_pop():
        gpu.matrix.load_matrix(Matrix.Identity(4))
        rows = ((2 / wide, 0, 0, -1), (0, 2 / high, 0, -1), (0, 0, 1, 0), (0, 0, 0, 1))
        gpu.matrix.load_projection_matrix(Matrix(rows))
        place = lambda u, v: (u * wide, (1 - v) * high)
        draw_tint(place, tint_texture(Painting(ellipse(640, 480, (100, 40, 300, 200)))))
        draw_brush((260.0, 40.0), 20.0)
        draw_horizon(place, (0.6, 0.7), USER_COLOUR, "horizon", high, 1.0)
    pixels = buffer.read_color(0, 0, wide, high, 4, 0, "UBYTE")
    pixels.dimensions = wide * high * 4
np.save(sys.argv[2], np.array(pixels, dtype=np.uint8).reshape(high, wide, 4)[::-1])
sys.stdout.write("drawn\\n")
sys.stdout.flush()
os._exit(0)
"""


def test_overlays_are_drawn_at_the_right_place_on_the_photo(tmp_path):
    """By Blender's own graphics, without a window, in a process of its own: without a driver it may die."""
    command = [sys.executable, "-c", DRAWING, str(ROOT.parent), str(tmp_path / "seen.npy")]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path)
    if "ready" not in done.stdout:
        pytest.skip("this machine has nothing to draw with, or this Blender needs a window to draw")
    assert "drawn" in done.stdout, done.stderr
    seen = np.load(tmp_path / "seen.npy")[..., :3].astype(int)
    red, green, blue = np.moveaxis(seen, -1, 0)
    magenta = (red > green + 60) & (blue > green + 40)
    # The mask's 640 x 480 pixels lie on 320 x 240 of the screen, row 0 at the top; a border of a pixel is not tinted.
    inner, outer = ellipse(320, 240, (52, 22, 148, 98)), ellipse(320, 240, (49, 19, 151, 101))
    assert magenta[inner].all() and not magenta[~outer].any()
    cyan = (blue > red + 80) & (green > red + 80)
    for column in (5, 160, 315):
        rows = np.flatnonzero(cyan[:, column])
        assert len(rows) and abs(rows.mean() - 240 * (0.6 + 0.1 * (column + 0.5) / 320)) < 2
    rows, columns = np.mgrid[:240, :320] + 0.5
    away = np.hypot(columns - 260, 240 - rows - 40)
    for radius, tone in ((20.0, 255), (21.5, 0)):
        ring = (seen == tone).all(axis=-1) & (np.abs(away - radius) < 1.2)
        angles = np.arctan2(rows - 200, columns - 260)[ring]
        assert len(np.unique((angles * 4).astype(int))) >= 24
    assert (seen[away < 18] == seen[0, 0]).all()


def test_strokes_become_flags_and_yield_to_a_mask(window, photo):
    operator, box = operate(PHYSGEN_OT_draw_strokes), photo.boxes[0]
    operator.invoke(window, event("NONE"))
    modal = partial(operator.modal, window)
    assert modal(event("ESC")) == {"CANCELLED"} and not box.keep
    operator.invoke(window, event("NONE"))
    for one in (
        event("LEFTMOUSE", 0.4, 0.4),
        event("MOUSEMOVE", 0.5, 0.4, "NOTHING"),
        event("LEFTMOUSE", 0.5, 0.4, "RELEASE"),
        event("LEFTMOUSE", 0.45, 0.5, ctrl=True),
        event("LEFTMOUSE", 0.45, 0.5, "RELEASE"),
        event("LEFTMOUSE", 0.6, 0.6),
        event("LEFTMOUSE", 0.6, 0.6, "RELEASE"),
        event("Z", ctrl=True),
    ):
        assert modal(one) == {"RUNNING_MODAL"}
    assert modal(event("MIDDLEMOUSE")) == {"PASS_THROUGH"}
    assert modal(event("RET")) == {"FINISHED"}
    assert (stroke_lines(box.keep), stroke_lines(box.drop)) == ([[(128, 96), (160, 96)]], [[(144, 120)]])
    words = arguments(photo, online=False)
    assert words[words.index("--keep") + 1] == "ball=128,96,160,96"
    assert words[words.index("--drop") + 1] == "ball=144,120"
    store_mask(box, np.ones((240, 320), bool))
    assert "--keep" not in arguments(photo, online=False)
    assert PHYSGEN_OT_draw_strokes.why_not(window).startswith("Clear the mask")
    assert stroke_lines("1,2,x 3,4 5") == [[(3.0, 4.0)]]


def test_found_objects_become_boxes_once(photo):
    found = [Proposal((10.0, 20.0, 90.0, 100.0), 0.95), Proposal((116.0, 56.0, 212.0, 156.0), 0.94)]
    found.append(Proposal((220.0, 100.0, 300.0, 200.0), 0.6))
    # The second is the box that is there; the third is far worse than the best.
    assert add_found(bpy.context.scene, found, every=False) == 1
    assert tuple(getattr(photo.boxes[1], side) for side in ("x0", "y0", "x1", "y1")) == (10, 20, 90, 100)
    assert add_found(bpy.context.scene, found, every=True) == 1
    assert add_found(bpy.context.scene, found, every=True) == 0


def test_boxes_are_drawn_one_after_the_other(window, photo):
    operator = operate(PHYSGEN_OT_draw_box)
    operator.invoke(window, event("NONE"))
    # The panel says it, because the status bar is far from where one looks.
    said = "Drag a box around each object. Enter, Esc, right click: done"
    assert tool_help() == said and said in " ".join(checked_layout.draw(PHYSGEN_PT_scene).words)
    modal, before = partial(operator.modal, window), len(photo.boxes)
    for u in (0.1, 0.5):
        assert modal(event("LEFTMOUSE", u, 0.2)) == {"RUNNING_MODAL"}
        assert modal(event("MOUSEMOVE", u + 0.2, 0.4, "NOTHING")) == {"RUNNING_MODAL"}
        assert modal(event("LEFTMOUSE", u + 0.2, 0.4, "RELEASE")) == {"RUNNING_MODAL"}
        # Moving on draws nothing, and zooming stays possible.
        assert modal(event("MOUSEMOVE", 0.9, 0.9, "NOTHING")) == {"PASS_THROUGH"}
    # A click without a drag is no box.
    modal(event("LEFTMOUSE", 0.5, 0.5))
    modal(event("LEFTMOUSE", 0.5, 0.5, "RELEASE"))
    assert modal(event("RET")) == {"FINISHED"} and tool_help() == ""
    drawn = [(box.x0, box.y0, box.x1, box.y1) for box in list(photo.boxes)[before:]]
    assert drawn == [(32, 48, 96, 96), (160, 48, 224, 96)]


def test_a_box_may_be_drawn_when_no_editor_shows_the_photo(photo):
    assert bpy.ops.physgen.draw_box.poll()
