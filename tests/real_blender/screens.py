# SPDX-License-Identifier: GPL-3.0-or-later
"""Inside Blender: its windows, the sidebar, the preferences, and pictures of them."""

from __future__ import annotations

import contextlib
import shutil
import subprocess
from collections.abc import Generator, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import bpy
import numpy as np

TAB = "PhysGen"


def window() -> bpy.types.Window:
    """The main window."""
    return bpy.context.window_manager.windows[0]


def viewport() -> bpy.types.Area:
    """The largest 3D viewport."""
    areas = [area for area in window().screen.areas if area.type == "VIEW_3D"]
    return max(areas, key=lambda area: area.width * area.height)


def region(area: bpy.types.Area, kind: str) -> bpy.types.Region:
    """Its region of that type."""
    return next(item for item in area.regions if item.type == kind)


def focus() -> Any:
    """Context as if the mouse were over the viewport."""
    area = viewport()
    return bpy.context.temp_override(window=window(), area=area, region=region(area, "WINDOW"))


def panels() -> list[type[bpy.types.Panel]]:
    """All registered panels of the tab, parents before their children."""
    found, waiting = [], list(bpy.types.Panel.__subclasses__())
    while waiting:
        kind = waiting.pop(0)
        waiting += kind.__subclasses__()
        if getattr(kind, "bl_category", "") == TAB and getattr(kind, "is_registered", False):
            found.append(kind)
    return sorted(found, key=lambda kind: bool(getattr(kind, "bl_parent_id", "")))


def open_all(names: Sequence[str] = ()) -> list[str]:
    """Let panels that begin closed begin open, because no script can open one; names of the panels of the tab.

    names: of the classes that begin open, with their children closed; none for all.
    """
    kinds = panels()
    for kind in reversed(kinds):
        bpy.utils.unregister_class(kind)
    for kind in kinds:
        options = getattr(kind, "bl_options", None)
        if options and "DEFAULT_CLOSED" in options and (not names or kind.__name__ in names):
            kind.bl_options = set(options) - {"DEFAULT_CLOSED"}
        bpy.utils.register_class(kind)
    return [kind.__name__ for kind in kinds]


@contextlib.contextmanager
def only(names: Sequence[str]) -> Iterator[None]:
    """Show these panels of the tab alone, open, so that long ones are seen whole.

    Blender keeps by a panel's identifier whether it is open, so they get others.
    """
    kinds = panels()
    before = {kind: dict(vars(kind)) for kind in kinds}
    for kind in reversed(kinds):
        bpy.utils.unregister_class(kind)
    shown = [kind for kind in kinds if kind.__name__ in names]
    for kind in shown:
        kind.bl_idname = f"{kind.__name__}_open"
        kind.bl_options = set(getattr(kind, "bl_options", ())) - {"DEFAULT_CLOSED"}
        parent = getattr(kind, "bl_parent_id", "")
        if parent:
            kind.bl_parent_id = f"{parent}_open"
        bpy.utils.register_class(kind)
    try:
        yield
    finally:
        for kind in reversed(shown):
            bpy.utils.unregister_class(kind)
            for name in ("bl_idname", "bl_options", "bl_parent_id"):
                if name in before[kind]:
                    setattr(kind, name, before[kind][name])
                elif name in vars(kind):
                    delattr(kind, name)
        for kind in kinds:
            bpy.utils.register_class(kind)


def on_screen(place: Any, area: bpy.types.Area) -> tuple[int, int]:
    """Where a point of the world is in the viewport ``area``, in pixels of the screen from its upper left corner."""
    from bpy_extras.view3d_utils import location_3d_to_region_2d

    shown = region(area, "WINDOW")
    found = location_3d_to_region_2d(shown, area.spaces.active.region_3d, place)
    return round(shown.x + found.x), round(window().height - (shown.y + found.y))


def show_sidebar() -> Generator[float, None, None]:
    """Open the sidebar on the extension's tab; a tab can only be chosen after the region has drawn once."""
    area = viewport()
    with bpy.context.temp_override(window=window(), area=area):
        if not bpy.context.screen.show_fullscreen:
            bpy.ops.screen.screen_full_area()
    yield 1.0
    area = viewport()
    area.spaces.active.show_region_ui = True
    area.tag_redraw()
    yield 1.0
    region(viewport(), "UI").active_panel_category = TAB
    viewport().tag_redraw()
    yield 0.5


def xdotool(*words: object) -> None:
    """Move the mouse or press keys, as the user of the window."""
    subprocess.run(["xdotool", *map(str, words)], check=True)


def drawn(times: int = 2) -> Generator[float, None, None]:
    """Wait until Blender has handled what the X server sent, and has drawn that often: minutes where it is busy."""
    seen: list[int] = []
    handler = bpy.types.SpaceView3D.draw_handler_add(lambda: seen.append(1), (), "WINDOW", "POST_PIXEL")
    try:
        while len(seen) < times:
            viewport().tag_redraw()
            yield 0.1
    finally:
        bpy.types.SpaceView3D.draw_handler_remove(handler, "WINDOW")


def middle() -> tuple[int, int]:
    """The middle of the viewport, in pixels of the screen from its upper left corner."""
    area = region(viewport(), "WINDOW")
    return area.x + area.width // 2, window().y + window().height - (area.y + area.height // 2)


def point(x: int, y: int) -> Generator[float, None, None]:
    """Move the mouse there; Blender learns of it when it handles events."""
    xdotool("mousemove", x - 3, y, "mousemove", x, y)
    yield from drawn()


def aim() -> None:
    """Put the mouse into the middle of the viewport, where popups then open."""
    xdotool("mousemove", *middle())


def click(x: int, y: int) -> Generator[float, None, None]:
    """One left click."""
    yield from point(x, y)
    xdotool("click", 1)
    yield from drawn()


def drag(
    start: tuple[int, int], goal: tuple[int, int], path: Path, wait: Iterable[float] = ()
) -> Generator[float, None, None]:
    """Drag what lies at ``start`` to ``goal`` and drop it there; ``path``: a picture just before it is let go.

    wait: what to wait for before the picture, such as ``session.until``.
    """
    yield from point(*start)
    xdotool("mousedown", 1)
    yield 0.5
    for share in (0.05, 0.1, 0.4, 0.8, 1.0):
        xdotool("mousemove", *(round(a + share * (b - a)) for a, b in zip(start, goal, strict=True)))
        yield 0.4
    yield from wait
    yield from drawn(3)
    picture(window(), path)
    xdotool("mouseup", 1)
    yield 1.0
    yield from drawn(3)


def press(key: str) -> Generator[float, None, None]:
    """One key, such as ``shift+p``."""
    xdotool("key", key)
    yield from drawn()


def widen(area: bpy.types.Area, width: int) -> Generator[float, None, None]:
    """Drag the edge of the sidebar of ``area`` until it is ``width`` px wide; nothing without xdotool."""
    if shutil.which("xdotool") is None:
        return
    lost = 0
    for attempt in range(3):
        yield from _drag_edge(area, width + lost)
        missing = width - region(area, "UI").width
        if abs(missing) <= 2 or attempt == 2:
            return
        # What the mouse moves before Blender takes it for a drag is lost; so is a short drag, as a whole.
        lost += missing
        yield from _drag_edge(area, width - 150)


def _drag_edge(area: bpy.types.Area, width: int) -> Generator[float, None, None]:
    bar = region(area, "UI")
    x, y = bar.x, window().y + window().height - (bar.y + bar.height // 2)
    xdotool("mousemove", x - 20, y, "mousemove", x, y)
    yield from drawn()
    xdotool("mousedown", 1)
    yield from drawn()
    for share in (0.5, 1.0):
        xdotool("mousemove", round(x - share * (width - bar.width)), y)
        yield from drawn()
    xdotool("mouseup", 1)
    yield from drawn()


def arrange(widths: Sequence[int]) -> Generator[float, None, None]:
    """Make the window viewports alone, one a width of the sidebar, each on the tab, and let new files look like that.

    The last is the largest. Nothing is arranged without xdotool, as only the mouse can change a sidebar's width.
    """
    for area in [area for area in window().screen.areas if area.type != "VIEW_3D"]:
        with bpy.context.temp_override(window=window(), area=area):
            bpy.ops.screen.area_close()
        yield 0.2
    for width in widths[:-1]:
        area = viewport()
        with bpy.context.temp_override(window=window(), area=area, region=region(area, "WINDOW")):
            bpy.ops.screen.area_split(direction="VERTICAL", factor=(width + 170) / area.width)
        yield 0.2
    shown = sorted((area for area in window().screen.areas if area.type == "VIEW_3D"), key=lambda area: area.x)
    for area in shown:
        area.spaces.active.show_region_ui = True
        # Pictures are of panels; without a graphics card all else is the processor's work.
        area.spaces.active.overlay.show_floor = area.spaces.active.overlay.show_ortho_grid = False
    yield from drawn()
    for area, width in zip(shown, widths, strict=True):
        region(area, "UI").active_panel_category = TAB
        yield from widen(area, width)
    bpy.ops.wm.save_homefile()
    yield 0.5


def shoot(folder: Path, name: str) -> Generator[float, None, None]:
    """Write ``NAME.png``, the window, and ``NAME_WIDTH.png``, each sidebar alone, as they look when all is drawn."""
    folder.mkdir(exist_ok=True)
    # Panels slide to their places over several drawings.
    for _ in range(3):
        for area in window().screen.areas:
            area.tag_redraw()
        yield 0.2
    yield from drawn()
    path = folder / f"{name}.png"
    picture(window(), path)
    for area in window().screen.areas:
        if area.type == "VIEW_3D":
            bar = region(area, "UI")
            if bar.width > 1:
                crop(path, folder / f"{name}_{bar.width}.png", (bar.x, bar.y, bar.width, bar.height))


def shoot_preferences(folder: Path, name: str, addon: str) -> Generator[float, None, None]:
    """Write ``NAME.png``: the add-on's page in a preferences window of its own, which is closed again."""
    before = set(bpy.context.window_manager.windows)
    with bpy.context.temp_override(window=window()):
        bpy.ops.preferences.addon_show(module=addon)
    yield 1.5
    own = next(item for item in bpy.context.window_manager.windows if item not in before)
    picture(own, folder / f"{name}.png")
    with bpy.context.temp_override(window=own):
        bpy.ops.wm.window_close()
    yield 0.5


def picture(shown: bpy.types.Window, path: Path) -> None:
    """Write what ``shown`` shows to ``path``.

    Blender's own screenshots are black where Mesa draws in software, so the X server is asked where ImageMagick can.
    """
    ask = shutil.which("import")
    if ask is None:
        with bpy.context.temp_override(window=shown):
            bpy.ops.screen.screenshot(filepath=str(path))
    else:
        # Nobody manages the windows: the newest lies on top, and their places are those of the screen.
        subprocess.run([ask, "-silent", "-window", "root", str(path)], check=True)
        screen = read(path)
        if (shown.width, shown.height) != (screen.shape[1], screen.shape[0]):
            crop(path, path, (shown.x, shown.y, shown.width, shown.height))
    pixels = read(path)[..., :3]
    assert float(pixels.max() - pixels.min()) > 0.1, f"{path.name} shows nothing"


def read(path: Path) -> np.ndarray:
    """A picture as floats (H, W, 4), first row at the bottom."""
    image = bpy.data.images.load(str(path))
    width, height = image.size
    pixels = np.empty(width * height * 4, dtype=np.float32)
    image.pixels.foreach_get(pixels)
    bpy.data.images.remove(image)
    return pixels.reshape(height, width, 4)


DOCUMENTED = (0, 20, 1050, 952)
"""Of the window of ``tour.py``, from the lower left: viewport and timeline of Blender's own layout."""


def document(source: Path, target: Path, width: int = 900) -> None:
    """Write the part DOCUMENTED of the window ``source`` as a picture for docs/images, a JPEG ``width`` px wide."""
    part = target.with_suffix(".png")
    crop(source, part, DOCUMENTED)
    image = bpy.data.images.load(str(part))
    image.scale(width, round(width * DOCUMENTED[3] / DOCUMENTED[2]))
    image.filepath_raw, image.file_format = str(target), "JPEG"
    image.save(quality=85)
    bpy.data.images.remove(image)
    part.unlink()


def crop(source: Path, target: Path, box: tuple[int, int, int, int]) -> None:
    """Write the part ``box`` (x, y, width, height, from the lower left) of ``source`` to ``target``."""
    x, y, width, height = box
    part = read(source)[y : y + height, x : x + width]
    image = bpy.data.images.new("part", part.shape[1], part.shape[0], alpha=False)
    image.pixels.foreach_set(np.ascontiguousarray(part).ravel())
    image.filepath_raw, image.file_format = str(target), "PNG"
    image.save()
    bpy.data.images.remove(image)
