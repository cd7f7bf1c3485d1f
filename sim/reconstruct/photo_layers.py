# SPDX-License-Identifier: MIT
"""Decompose the photo into layers: masks, shadows, occlusion order, hidden parts and the clean background.

Objects are removed from front to back with their shadows, and the gap is inpainted, so that the next one can be
segmented again on a picture in which nothing stands in front of it (PhysGen3D, supplement A.1). The remaining hidden
part is completed by shape. The background itself is inpainted at once, from the photo: every inpainting of an inpainted
picture would be a little worse.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from ..composite.inpaint import FillOptions
from ..errors import InputError
from ..scene.model import Camera
from .adapters.adapter_registry import adapter_content
from .background.background_inpainting import blend, fill_background
from .background.unboxed_things import UnboxedThings, unboxed_things
from .lighting.ground_gloss import GroundGloss, estimate_gloss
from .lighting.shadow_masks import PENUMBRA_DILATION, cast_shadows, object_holes, threshold_shadows
from .reconstruct_options import ReconstructOptions
from .segmentation.amodal_completion import complete_colours, complete_outline
from .segmentation.box_crop import Box
from .segmentation.box_segmentation import segment
from .segmentation.occlusion_order import Order, occlusion_order
from .segmentation.plain_backdrop import remnants
from .shape.body_texture import TexturedSurface
from .stage_cache import Notice, StageCache, Steps

Mask = NDArray[np.bool_]
Pixels = NDArray[np.uint8]
Inpainter = Callable[[Pixels, Mask], Pixels]

TOUCHING = 3
"""Largest gap, in pixels at 1024, between masks of which one may hide a part of the other."""
PAPER_DILATION = 50.0
"""Side in pixels at 1024 of the kernel by which the paper dilates masks and hard shadows."""
LEAST_HIDDEN = 0.004
"""Smallest hidden share of an object's mask that is completed."""


@dataclass(frozen=True)
class Layers:
    """Layers of a photo, (H, W) bool or (H, W, 3) uint8 at working size, in the order of the objects.

    seen: visible pixels of each object; full: its whole mask. shadows, holes: of each object, without other objects.
    colours: the photo with the hidden part of each object painted in its own colours. background: the clean plate; the
    photo until ``make_clean_plate``. front_to_back: indices.
    uncovered: by index, the picture after each removal that revealed something. unboxed: things without a box, or
    None.
    """

    seen: tuple[Mask, ...]
    full: tuple[Mask, ...]
    shadows: tuple[Mask, ...]
    holes: tuple[Mask, ...]
    colours: tuple[Pixels, ...]
    background: Pixels
    front_to_back: tuple[int, ...]
    uncovered: Mapping[int, Pixels]
    unboxed: Mask | None = None


def separate_layers(
    pixels: Pixels,
    seen: Sequence[Mask],
    boxes: Sequence[Box],
    names: Sequence[str],
    view: Camera,
    options: ReconstructOptions,
    *,
    depth: NDArray[np.float32] | None,
    inpainter: Inpainter | None,
    store: StageCache,
    steps: Steps,
) -> Layers:
    """Return the layers of the photo ``pixels`` (H, W, 3), whose objects show ``seen`` and lie in ``boxes``.

    view: camera above z = 0. depth: (H, W) metres or None. inpainter: replaces the built-in inpainting. Raises
    InputError when hardly any background is left, or ``options.order`` does not name the objects.
    """
    steps.begin("shadows")
    cast = store.run(
        "shadows",
        {"pixels": pixels, "seen": seen, "names": names, "view": view, "threshold": options.shadow_threshold},
        lambda notice: _cast(pixels, seen, names, view, options.shadow_threshold, notice),
    )
    shadows = [np.asarray(shadow, dtype=bool) for shadow in cast["shadows"]]
    darkened = [np.asarray(shadow, dtype=bool) for shadow in cast["darkened"]]
    unboxed = UnboxedThings(stay=np.asarray(cast["stay"], dtype=bool), whole=np.asarray(cast["whole"], dtype=bool))
    steps.begin("order")
    order = _order(seen, names, options, depth, steps.notice)
    fill = _filler(view, options, inpainter, unboxed.whole)
    full, colours, uncovered = _complete(
        pixels, seen, shadows, unboxed.whole, boxes, names, order, view, options, fill, store, steps
    )
    # Where the penumbra is known, less dilation is needed.
    share = PENUMBRA_DILATION / PAPER_DILATION if options.shadow_threshold is None else 1.0
    beside = [thing & ~unboxed.stay for thing in remnants(pixels, seen)]
    darkened = [shadow | thing for shadow, thing in zip(darkened, beside, strict=True)]
    holes = object_holes(seen, darkened, share * options.hole_dilation * max(pixels.shape[:2]) / 1024.0, unboxed.stay)
    return Layers(
        seen=tuple(seen),
        full=tuple(full),
        shadows=tuple(shadows),
        holes=tuple(holes),
        colours=tuple(colours),
        background=pixels,
        front_to_back=order,
        uncovered=uncovered,
        unboxed=unboxed.whole,
    )


def make_clean_plate(
    layers: Layers,
    pixels: Pixels,
    surfaces: Sequence[TexturedSurface],
    view: Camera,
    options: ReconstructOptions,
    *,
    inpainter: Inpainter | None,
    store: StageCache,
    steps: Steps,
) -> tuple[Layers, GroundGloss]:
    """Return ``layers`` with the background, free of objects, shadows and mirror images, and the ground's gloss.

    surfaces: of the objects' bodies, in the unit of ``view``. Other arguments as of ``separate_layers``. Raises
    InputError when hardly any background is left.
    """
    unboxed = np.zeros_like(layers.seen[0]) if layers.unboxed is None else layers.unboxed
    objects = np.logical_or.reduce(list(layers.seen))
    steps.begin("gloss")
    made = store.run(
        "gloss",
        {"pixels": pixels, "covered": objects | unboxed, "view": view, "bodies": [vars(s) for s in surfaces]},
        lambda notice: _gloss(pixels, objects | unboxed, view, surfaces, notice),
    )
    reflectivity, roughness, correlation, by_chance = (float(v) for v in made["numbers"])
    images = tuple(np.asarray(image, dtype=bool) for image in made["images"])
    gloss = GroundGloss(reflectivity, roughness, correlation, by_chance, images, made["bare"])
    holes = tuple(hole | image for hole, image in zip(layers.holes, images, strict=True))
    union, mirrored = np.logical_or.reduce(layers.holes), np.logical_or.reduce(images)
    # There the ground is hardly seen, as on the objects themselves.
    lost = mirrored & ~unboxed & _strongly_changed(pixels, gloss.pixels)
    union, unseen = union | lost, objects | lost
    steps.begin("background")
    fill = _filler(view, options, inpainter, unboxed, mirrored)
    filled = store.run(
        "background",
        {
            **_fill_inputs(gloss.pixels, view, options),
            "hole": union,
            "objects": unseen,
            "barred": unboxed,
            "mirrored": mirrored,
        },
        partial(_filled, fill, gloss.pixels, union, unseen),
    )
    return replace(layers, holes=holes, background=filled["picture"]), gloss


STRONG, STRONG_SIGMA = 0.15, 0.012
"""Change of the photo's light by a mirror image, natural logarithm, above which what is left of its pattern shows; and
standard deviation over which it is averaged, over the photo's longer side."""


def _strongly_changed(pixels: Pixels, bare: Pixels) -> Mask:
    """Where (H, W) taking the mirror images out of ``pixels`` has left ``bare`` (H, W, 3) hardly any ground to level:
    errors of a few pixels and of the blur leave their pattern there in colours that no ground has."""
    before, after = (np.log(image.astype(np.float32) + 4.0) for image in (pixels, bare))
    change = cv2.GaussianBlur(np.abs(after - before).max(axis=-1), (0, 0), STRONG_SIGMA * max(pixels.shape[:2]))
    return np.asarray(change > STRONG)


def _gloss(
    pixels: Pixels, covered: Mask, view: Camera, surfaces: Sequence[TexturedSurface], notice: Notice
) -> dict[str, NDArray[np.generic]]:
    found = estimate_gloss(pixels, covered, view, surfaces)
    if found.reflectivity > 0.0:
        notice(
            f"the ground mirrors the objects: reflectivity {found.reflectivity:.2g}, roughness {found.roughness:.2g} "
            f"(correlation {found.correlation:.2f}, beside them {found.by_chance:.2f}); set ground.reflectivity if this"
            " is wrong"
        )
    numbers = [found.reflectivity, found.roughness, found.correlation, found.by_chance]
    return {"numbers": np.array(numbers), "images": np.stack(found.images), "bare": found.pixels}


Fill = Callable[[Pixels, Mask, Mask, Notice], Pixels]


def _filler(
    view: Camera,
    options: ReconstructOptions,
    inpainter: Inpainter | None,
    unboxed: Mask,
    mirrored: Mask | None = None,
) -> Fill:
    settings = FillOptions(radius=options.patch_radius, limit=options.inpaint_pixels, seed=options.seed)

    def fill(picture: Pixels, hole: Mask, objects: Mask, notice: Notice) -> Pixels:
        if inpainter is None:
            # What was mirrored is levelled, which an adapter does not do: it keeps the photo without it.
            whole = hole if mirrored is None else hole | (mirrored & ~unboxed)
            return fill_background(picture, whole, objects, view, settings, notice, unboxed, mirrored)
        return blend(picture, inpainter(picture, hole), hole, objects) if hole.any() else picture.copy()

    return fill


def _fill_inputs(pixels: Pixels, view: Camera, options: ReconstructOptions) -> dict[str, object]:
    return {
        "pixels": pixels,
        "view": view,
        "options": [options.patch_radius, options.inpaint_pixels, options.seed, options.inpainter],
        "files": adapter_content("inpainter", options.inpainter),
    }


MISSING = 0.5
"""Share of a foreseen shadow that was not found above which a notice tells."""


def _cast(
    pixels: Pixels, seen: Sequence[Mask], names: Sequence[str], view: Camera, threshold: float | None, notice: Notice
) -> dict[str, NDArray[np.bool_]]:
    """The objects' shadows, the same with their penumbras and where one may have been missed, and unboxed things."""
    things = unboxed_things(pixels, seen, view)
    if things.count:
        what = (
            "1 thing on the ground near the objects has no box: it stays"
            if things.count == 1
            else (f"{things.count} things on the ground near the objects have no box: they stay")
        )
        notice(f"{what} in the photo")
    rest = {"stay": things.stay, "whole": things.whole}
    if threshold is not None:
        shadows = np.stack(threshold_shadows(pixels, seen, threshold)) & ~things.stay
        return {"shadows": shadows, "darkened": shadows, **rest}
    cast = cast_shadows(pixels, seen, view, things.stay)
    for name, found in zip(names, cast, strict=True):
        if found.missing > MISSING:
            notice(
                f"{name}: {100 * found.missing:.0f} % of the shadow that the light should cast was not found; the "
                "ground there is inpainted as well, in case it was missed"
            )
    darkened = np.stack([c.penumbra | c.expected for c in cast])
    return {"shadows": np.stack([c.shadow for c in cast]), "darkened": darkened, **rest}


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
            notice(f"{front} is in front of {behind}: {pair.reason}; give the order if this is wrong")
    return found.front_to_back


def _complete(
    pixels: Pixels,
    seen: Sequence[Mask],
    shadows: Sequence[Mask],
    unboxed: Mask,
    boxes: Sequence[Box],
    names: Sequence[str],
    order: Sequence[int],
    view: Camera,
    options: ReconstructOptions,
    fill: Fill,
    store: StageCache,
    steps: Steps,
) -> tuple[list[Mask], list[Pixels], dict[int, Pixels]]:
    """Whole masks, pictures with the hidden parts painted in, and by index the picture after removals that revealed
    more."""
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
                {**_fill_inputs(current, view, options), "hole": hole, "objects": seen[index], "barred": unboxed},
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
        f"{name}: {100 * hidden / full.sum():.0f} % of it is hidden by objects in front; its outline and colours "
        "there are a guess"
    )
    return {"full": full, "colours": complete_colours(pixels, seen, full)}
