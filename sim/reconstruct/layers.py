# SPDX-License-Identifier: MIT
"""What the photo falls apart into: outlines, shadows, what stands before what, and the place without any of it.

From the front to the back each object is taken out with its shadow and the gap filled, so that the next one can be
cut out again on a picture in which nothing stands before it (PhysGen3D, supplement A.1). What is then left of the
hidden part is completed by shape. The background itself is filled at once, from the photo: every filling of a filling
would be a little worse.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from ..composite.inpaint import FillOptions
from ..errors import InputError
from ..scene.model import Camera
from .adapters.names import adapter_content
from .background.border import blend
from .background.fill import fill_background
from .cut.complete import complete_outline
from .cut.hidden_colours import complete_colours
from .cut.order import Order, occlusion_order
from .cut.segment import Box, segment
from .options import ReconstructOptions
from .shadow.find import cast_shadows
from .shadow.holes import PENUMBRA_DILATION, object_holes
from .shadow.threshold import threshold_shadows
from .stage_store import Notice, StageStore
from .steps import Steps

Mask = NDArray[np.bool_]
Pixels = NDArray[np.uint8]
Inpainter = Callable[[Pixels, Mask], Pixels]

TOUCHING = 3
"""Pixels at 1024 that an outline may be away from another one, and still be hidden by it."""
PAPER_DILATION = 50.0
"""Pixels at 1024, side of the kernel that the paper dilates masks and hard shadows by."""
LEAST_HIDDEN = 0.004
"""Of an object's outline, the part that is worth completing."""


@dataclass(frozen=True)
class Layers:
    """All (H, W) bool or (H, W, 3) uint8, at working size, in the order of the objects.

    seen: what the photo shows of each object; full: its whole outline. shadows, holes: of each object, without other
    objects. colours: the photo with the hidden part of each object painted in its own colours. front_to_back: indices.
    uncovered: the picture after each removal, in that order, where something came to light.
    """

    seen: tuple[Mask, ...]
    full: tuple[Mask, ...]
    shadows: tuple[Mask, ...]
    holes: tuple[Mask, ...]
    colours: tuple[Pixels, ...]
    background: Pixels
    front_to_back: tuple[int, ...]
    uncovered: Mapping[int, Pixels]


def take_apart(
    pixels: Pixels,
    seen: Sequence[Mask],
    boxes: Sequence[Box],
    names: Sequence[str],
    view: Camera,
    options: ReconstructOptions,
    *,
    depth: NDArray[np.float32] | None,
    inpainter: Inpainter | None,
    store: StageStore,
    steps: Steps,
) -> Layers:
    """Take the photo ``pixels`` apart, whose objects show ``seen`` and lie in ``boxes``; ``view`` is over z = 0.

    depth: (H, W) metres or None. inpainter: fills holes in place of the built-in way. Raises InputError when hardly any
    background is left, or ``options.order`` does not name the objects.
    """
    steps.begin("shadows")
    cast = store.run(
        "shadows",
        {"pixels": pixels, "seen": seen, "view": view, "threshold": options.shadow_threshold},
        lambda notice: _cast(pixels, seen, view, options.shadow_threshold),
    )
    shadows = [np.asarray(shadow, dtype=bool) for shadow in cast["shadows"]]
    darkened = [np.asarray(shadow, dtype=bool) for shadow in cast["darkened"]]
    steps.begin("order")
    order = _order(seen, names, options, depth, steps.notice)
    fill = _filler(pixels, view, options, inpainter)
    full, colours, uncovered = _complete(pixels, seen, shadows, boxes, names, order, view, options, fill, store, steps)
    # Where the soft border is known, less is added around it.
    share = PENUMBRA_DILATION / PAPER_DILATION if options.shadow_threshold is None else 1.0
    holes = object_holes(seen, darkened, share * options.hole_dilation * max(pixels.shape[:2]) / 1024.0)
    steps.begin("background")
    union, objects = np.logical_or.reduce(holes), np.logical_or.reduce(list(seen))
    made = store.run(
        "background",
        {**_fill_inputs(pixels, view, options), "hole": union, "objects": objects},
        partial(_filled, fill, pixels, union, objects),
    )
    return Layers(
        seen=tuple(seen),
        full=tuple(full),
        shadows=tuple(shadows),
        holes=tuple(holes),
        colours=tuple(colours),
        background=made["picture"],
        front_to_back=order,
        uncovered=uncovered,
    )


Fill = Callable[[Pixels, Mask, Mask, Notice], Pixels]


def _filler(pixels: Pixels, view: Camera, options: ReconstructOptions, inpainter: Inpainter | None) -> Fill:
    settings = FillOptions(radius=options.patch_radius, limit=options.inpaint_pixels, seed=options.seed)

    def fill(picture: Pixels, hole: Mask, objects: Mask, notice: Notice) -> Pixels:
        if inpainter is None:
            return fill_background(picture, hole, objects, view, settings, notice)
        return blend(picture, inpainter(picture, hole), hole, objects) if hole.any() else picture.copy()

    return fill


def _fill_inputs(pixels: Pixels, view: Camera, options: ReconstructOptions) -> dict[str, object]:
    return {
        "pixels": pixels,
        "view": view,
        "options": [options.patch_radius, options.inpaint_pixels, options.seed, options.inpainter],
        "files": adapter_content("inpainter", options.inpainter),
    }


def _cast(pixels: Pixels, seen: Sequence[Mask], view: Camera, threshold: float | None) -> dict[str, NDArray[np.bool_]]:
    """The objects' shadows, and all that they darken, the soft borders as well."""
    if threshold is not None:
        shadows = np.stack(threshold_shadows(pixels, seen, threshold))
        return {"shadows": shadows, "darkened": shadows}
    cast = cast_shadows(pixels, seen, view)
    return {"shadows": np.stack([c.shadow for c in cast]), "darkened": np.stack([c.penumbra for c in cast])}


def _filled(fill: Fill, picture: Pixels, hole: Mask, objects: Mask, notice: Notice) -> dict[str, Pixels]:
    return {"picture": fill(picture, hole, objects, notice)}


def _order(
    seen: Sequence[Mask],
    names: Sequence[str],
    options: ReconstructOptions,
    depth: NDArray[np.float32] | None,
    notice: Notice,
) -> tuple[int, ...]:
    if options.order:
        if sorted(options.order) != sorted(names):
            raise InputError(f"order is {', '.join(options.order)}: name {', '.join(names)}, each once, front to back")
        return tuple(list(names).index(name) for name in options.order)
    found: Order = occlusion_order(seen, depth=depth)
    for pair in found.pairs:
        if pair.touching:
            front, behind = names[pair.front], names[pair.behind]
            notice(f"{front} stands before {behind}: {pair.reason}; give the order where this is wrong")
    return found.front_to_back


def _complete(
    pixels: Pixels,
    seen: Sequence[Mask],
    shadows: Sequence[Mask],
    boxes: Sequence[Box],
    names: Sequence[str],
    order: Sequence[int],
    view: Camera,
    options: ReconstructOptions,
    fill: Fill,
    store: StageStore,
    steps: Steps,
) -> tuple[list[Mask], list[Pixels], dict[int, Pixels]]:
    """Whole outlines, pictures with the hidden parts painted in, and the picture after removals that showed more."""
    full, colours = list(seen), [pixels] * len(seen)
    uncovered: dict[int, Pixels] = {}
    current, removed = pixels, np.zeros_like(seen[0])
    reach = max(1, round(TOUCHING * max(pixels.shape[:2]) / 1024.0))
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    for place, index in enumerate(order):
        name = names[index]
        steps.begin(f"complete {name}")
        blocked = np.asarray(cv2.dilate(removed.astype(np.uint8), kernel) > 0)
        if (blocked & seen[index]).any():
            made = store.run(
                "complete",
                {"pixels": pixels, "picture": current, "seen": seen[index], "before": removed, "box": boxes[index]},
                partial(_whole, pixels, current, seen[index], removed, boxes[index], name, options),
            )
            full[index], colours[index] = np.asarray(made["full"], dtype=bool), made["colours"]
            hidden = full[index] & ~seen[index]
            current = np.where(hidden[..., None], colours[index], current)
        behind = order[place + 1 :]
        near = cv2.dilate(seen[index].astype(np.uint8), kernel) > 0
        if any((near & seen[other]).any() for other in behind):
            hole = cv2.dilate((full[index] | shadows[index]).astype(np.uint8), kernel) > 0
            for other in behind:
                hole &= ~seen[other]
            made = store.run(
                "uncover",
                {**_fill_inputs(current, view, options), "hole": hole, "objects": seen[index]},
                partial(_filled, fill, current, hole, seen[index]),
            )
            current = made["picture"]
            uncovered[index] = current
        removed = removed | seen[index]
    return full, colours, uncovered


def _whole(
    pixels: Pixels,
    picture: Pixels,
    seen: Mask,
    before: Mask,
    box: Box,
    name: str,
    options: ReconstructOptions,
    notice: Notice,
) -> dict[str, NDArray[np.generic]]:
    again: Mask | None
    try:
        again = segment(picture, box, name, options.grabcut_iterations)
    except InputError:
        again = None
    full = complete_outline(seen, before, seen_again=again)
    hidden = int((full & ~seen).sum())
    if hidden < LEAST_HIDDEN * full.sum():
        return {"full": seen, "colours": pixels}
    notice(
        f"{name}: {100 * hidden / full.sum():.0f} % of it are hidden by what stands before it; its outline and colours "
        "there are a guess"
    )
    return {"full": full, "colours": complete_colours(pixels, seen, full)}
