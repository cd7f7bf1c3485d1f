# SPDX-License-Identifier: MIT
"""Objects of a photo without a box: where they are, and how likely each is an object.

Candidates come from a saliency map (Zhu, Liang, Wei & Sun, "Saliency optimization from robust background detection",
CVPR 2014), from what differs from the ground along the photo's border, and from regions inside closed contours. The
best are segmented in their boxes as if a user had drawn these, and judged by what comes out: closed contour, contrast
with the surroundings, standing on the ground, not cut by the photo's border. No learned weights.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from skimage.segmentation import felzenszwalb, slic

from ...srgb import cielab
from ..camera.vanishing_points import straight_lines
from ..reconstruct_options import Proposal
from .alike_blocks import alike_blocks
from .border_ownership import lines_go_on, sides_go_on
from .box_crop import crop_around_box, edge_strength, padded
from .colour_models import ground_likelihood
from .joined_pieces import in_one_piece
from .mask_geometry import Mask, extent_of, largest_component, largest_part, solidity_of
from .mask_proposals import ground_like
from .mask_proposals import proposals as mask_proposals
from .mask_proposals import score as objectness
from .outline_sharpness import FINE, in_focus, sharp_as
from .plain_backdrop import FULL, things_before_backdrop
from .proposal_features import (
    FEATURES,
    at_size_of,
    contrast_of,
    copy_of,
    cut_share,
    features_of,
    lab_of,
    score_of,
    share_on_edges,
)
from .round_things import circles_of_a_kind, round_things
from .whole_objects import CUT, Candidate, stacked_parts, whole_objects

Pixels = NDArray[np.uint8]
Box = tuple[float, float, float, float]

SIDE = 320
"""Longest side in pixels of the copy that is searched."""
MOST = 20
"""Largest number of proposals."""
EXAMINED = 18
"""Candidates that are segmented; a second for ten of them."""
MARGIN = 0.06
"""Margin of a proposed box around what was found in it, over its longer side: boxes are to be loose."""
LEAST_AREA, MOST_AREA = 0.0025, 0.6
"""Areas of objects over the photo's."""
ELSEWHERE = 0.4
"""Share of the smaller of two boxes in the other above which they hold the same object, or a part of it."""
LEAST_SIDE = 0.035
"""Least side of an object's box over the photo's shorter side."""
BESIDE = 0.06
"""Area over the largest object's below which a thing is left aside: a pebble beside a toy, a car far behind a hydrant.
An orange beside a book has 0.10."""
SIDES = 0.02
"""Strip along the photo's left and right border, over its width, that what goes through the photo reaches."""
GROUND, THING = 0.7, 0.5
"""Share of a candidate that could be ground, lit or shaded, from which it is left aside beside one that is below the
second share: strips of a mat beside a meal, blinds of a window, the gap in a handle."""
LEFT_ASIDE = 0.79
"""Largest score of what is left aside, below that of objects that are used unless the user says otherwise."""


@dataclass(frozen=True)
class Examined:
    """A candidate on the copy. mask: (h, w). features: see ``FEATURES``."""

    mask: Mask
    features: NDArray[np.float64]


def propose_boxes(pixels: Pixels, *, most: int = MOST) -> list[Proposal]:
    """Return at most ``most`` objects of ``pixels`` (H, W, 3), best first; boxes in its own pixels.

    Each box holds one whole object, not a group, a part, or an object with ground (``whole_objects``). Where one is
    sharp, those out of focus are left out; specks beside it and what the photo cuts come last. Before a plain backdrop
    the things on it come first. The list is empty where nothing stands out.
    """
    small = copy_of(pixels, SIDE)
    size = (small.shape[1], small.shape[0])
    found = [(item, score_of(item.features)) for item in examined_candidates(small)]
    found = [pair for pair in found if pair[1] >= LEAST_SCORE]
    found = _owning(found, pixels)
    sharp = in_focus([item.mask for item, _ in found], small)
    found = [pair for pair, is_sharp in zip(found, sharp, strict=True) if is_sharp]
    shade, ground = FEATURES.index("shade"), FEATURES.index("ground")
    whole = whole_objects(
        [Candidate(item.mask, value, bool(item.features[shade])) for item, value in found], lab_of(small)
    )
    across, down = pixels.shape[1] / size[0], pixels.shape[0] / size[1]
    result = []
    things = [[found[whole[k]] for k in group] for group in stacked_parts([found[i][0].mask for i in whole])]
    masks = [np.logical_or.reduce([item.mask for item, _ in parts]) for parts in things]
    listed = with_the_rest_aside(
        masks,
        [max(value for _, value in parts) for parts in things],
        [min(float(item.features[ground]) for item, _ in parts) for parts in things],
    )
    if sum(value > LEFT_ASIDE for value in listed) > 1:
        sharp = sharp_as(int(np.argmax(listed)), masks, pixels)
        listed = [value if clear else min(value, LEFT_ASIDE) for value, clear in zip(listed, sharp, strict=True)]
    masks, listed = in_one_piece(small, masks, listed, LEFT_ASIDE)
    for mask, value in sorted(zip(masks, listed, strict=True), key=lambda pair: -pair[1])[:most]:
        x0, y0, x1, y1 = _loose(extent_of(mask), size)
        box = (round(x0 * across), round(y0 * down), round(x1 * across), round(y1 * down))
        result.append(Proposal((float(box[0]), float(box[1]), float(box[2]), float(box[3])), round(value, 3)))
    seen, least = list(zip(masks, listed, strict=True)), LEFT_ASIDE + 0.01
    alike = round_things(pixels, seen, least)
    if not alike and not circles_of_a_kind(pixels):
        alike = alike_blocks(pixels, seen, least)
    return with_model(alike or things_before_backdrop(pixels, result), result, least)[:most]


def _owning(found: list[tuple[Examined, float]], pixels: Pixels) -> list[tuple[Examined, float]]:
    """Those of ``found`` that own their outline in ``pixels`` (H, W, 3), see ``border_ownership``; all where none is
    left."""
    fine = copy_of(pixels, FINE)
    lines, lightness = straight_lines(fine), lab_of(fine)[..., 0]
    kept = []
    for item, value in found:
        mask = at_size_of(item.mask, fine)
        if not lines_go_on(mask, lines) and not sides_go_on(mask, lightness):
            kept.append((item, value))
    return kept or found


def with_the_rest_aside(masks: Sequence[Mask], scores: Sequence[float], ground: Sequence[float]) -> list[float]:
    """Return the ``scores`` of the objects ``masks`` (h, w), at most ``LEFT_ASIDE`` for what a photo is not of.

    ground: share of each that could be ground. Left aside are those that mostly are, where another is not; objects
    that are tiny beside the largest one; and, where another is whole, those cut by the photo's border: their remainder
    is unknown, so they cannot be moved.
    """
    if any(share < THING and score > LEFT_ASIDE for share, score in zip(ground, scores, strict=True)):
        told = zip(scores, ground, strict=True)
        scores = [min(score, LEFT_ASIDE) if share >= GROUND else score for score, share in told]
    areas = [int(mask.sum()) for mask in masks]
    largest = max((area for area, score in zip(areas, scores, strict=True) if score > LEFT_ASIDE), default=0)
    main = [area >= BESIDE * largest for area in areas]
    cut = [cut_share(mask) > CUT for mask in masks]
    if any(m and not c and score > LEFT_ASIDE for m, c, score in zip(main, cut, scores, strict=True)):
        main = [m and not c for m, c in zip(main, cut, strict=True)]
    return [score if m else min(score, LEFT_ASIDE) for m, score in zip(main, scores, strict=True)]


def proposals_from_alpha(alpha: NDArray[np.floating], *, most: int = MOST) -> list[Proposal]:
    """Return the objects in a model's ``alpha`` (H, W), 0 to 1, for a photo without a box: its connected parts.

    Specks, gaps and parts below ``LEAST_AREA`` of the photo do not count. The score is the mean alpha of a part.
    """
    value = np.clip(np.nan_to_num(np.asarray(alpha, dtype=np.float32)), 0.0, 1.0)
    size = (value.shape[1], value.shape[0])
    side = max(1, round(0.004 * max(size))) * 2 + 1
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
    closed = cv2.morphologyEx((value > 0.5).astype(np.uint8), cv2.MORPH_CLOSE, kernel)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(closed, connectivity=8)
    result = []
    for index in range(1, count):
        part = labels == index
        if stats[index, cv2.CC_STAT_AREA] < LEAST_AREA * value.size:
            continue
        x0, y0, x1, y1 = _loose(extent_of(part), size)
        result.append((int(part.sum()), Proposal((x0, y0, x1, y1), round(float(value[part].mean()), 3))))
    return [item for _, item in sorted(result, key=lambda pair: -pair[0] * pair[1].score)][:most]


def with_model(by_model: Sequence[Proposal], seen: Sequence[Proposal], most: float) -> list[Proposal]:
    """Return the objects ``by_model``, best first, and then those ``seen`` without one that lie elsewhere.

    A model sees as one what colours divide, such as a saucer or a motorcycle, and leaves out what only stands out.
    most: score below which the others stay, so that the model's are the ones that are used; all of ``seen`` where it
    found nothing.
    """
    if not by_model:
        return list(seen)
    elsewhere = [item for item in seen if all(_share_inside(item.box, own.box) < ELSEWHERE for own in by_model)]
    lowered = [Proposal(item.box, min(item.score, round(most - 0.01, 3))) for item in elsewhere]
    return [*sorted(by_model, key=lambda item: -item.score), *lowered][:MOST]


def _share_inside(box: Box, other: Box) -> float:
    """Share of the area of the smaller of two boxes that both have in common."""
    width, height = (min(box[i + 2], other[i + 2]) - max(box[i], other[i]) for i in (0, 1))
    area = min((b[2] - b[0]) * (b[3] - b[1]) for b in (box, other))
    return max(0.0, width) * max(0.0, height) / max(area, 1e-9)


def _loose(box: tuple[int, int, int, int], size: tuple[int, int]) -> Box:
    """``box`` with a margin, a smaller one or none where it would leave nothing of a photo of ``size`` around it."""
    x0, y0, x1, y1 = box
    margin = MARGIN * max(x1 - x0, y1 - y0) + 1.0
    for less in (1.0, 0.5, 0.25, 0.0):
        left, top = max(0.0, x0 - less * margin), max(0.0, y0 - less * margin)
        right, bottom = min(float(size[0]), x1 + less * margin), min(float(size[1]), y1 + less * margin)
        if (right - left) * (bottom - top) < FULL * size[0] * size[1]:
            break
    return left, top, right, bottom


def saliency(pixels: Pixels, segments: NDArray[np.int_]) -> NDArray[np.float32]:
    """Return how much each pixel (h, w), 0 to 1, stands out from what is connected with the picture's border.

    segments: (h, w) numbers of superpixels from 0. Zhu et al., equations 4 to 9.
    """
    # Half a second of imports that every bake and command would pay.
    from scipy.sparse.csgraph import dijkstra
    from scipy.sparse.linalg import spsolve

    lab = cielab(pixels)
    count = int(segments.max()) + 1
    flat = segments.ravel()
    area = np.bincount(flat, minlength=count).astype(np.float64)
    mean = np.stack([np.bincount(flat, lab[..., c].ravel(), count) for c in range(3)], axis=1) / area[:, None]
    rows, columns = np.indices(segments.shape)
    middle = np.stack(
        [np.bincount(flat, (rows / max(segments.shape)).ravel(), count),
         np.bincount(flat, (columns / max(segments.shape)).ravel(), count)], axis=1,
    ) / area[:, None]  # fmt: skip
    pairs = _neighbours(segments)
    step = np.linalg.norm(mean[pairs[:, 0]] - mean[pairs[:, 1]], axis=1)
    border = np.zeros(count, dtype=bool)
    border[np.unique(np.concatenate([segments[0], segments[-1], segments[:, 0], segments[:, -1]]))] = True
    # Small steps are shading: they must not add up along a floor.
    least = np.full(count, np.inf)
    np.minimum.at(least, pairs.ravel(), np.repeat(step, 2))
    cut = float(least.mean())
    graph = sparse.coo_matrix((np.maximum(step - cut, 1e-3), (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    geodesic = dijkstra(graph.tocsr(), directed=False)
    near = np.exp(-(geodesic**2) / (2.0 * 10.0**2))
    connectivity = near[:, border].sum(axis=1) / np.sqrt(near.sum(axis=1))
    behind = 1.0 - np.exp(-(connectivity**2) / 2.0)
    colour = np.linalg.norm(mean[:, None] - mean[None], axis=2)
    place = np.exp(-(np.linalg.norm(middle[:, None] - middle[None], axis=2) ** 2) / (2.0 * 0.25**2))
    contrast = (colour * place * behind).sum(axis=1)
    contrast = contrast / max(float(contrast.max()), 1e-9)
    weight = np.exp(-(step**2) / (2.0 * 10.0**2)) + 0.1
    both = sparse.coo_matrix((weight, (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    both = both + both.T
    system = sparse.diags_array(behind + contrast + np.asarray(both.sum(axis=1)).ravel()) - both
    value = np.clip(spsolve(system.tocsc(), contrast), 0.0, None)
    value = value / max(float(value.max()), 1e-9)
    return np.asarray(value[segments], dtype=np.float32)


def _neighbours(segments: NDArray[np.int_]) -> NDArray[np.int_]:
    """Pairs (n, 2) of superpixels that touch, and those along the picture's border, each once."""
    across = np.stack([segments[:, :-1].ravel(), segments[:, 1:].ravel()], axis=1)
    down = np.stack([segments[:-1].ravel(), segments[1:].ravel()], axis=1)
    pairs = np.sort(np.concatenate([across, down]), axis=1)
    return np.unique(pairs[pairs[:, 0] != pairs[:, 1]], axis=0)


def _unlike_border(pixels: Pixels) -> NDArray[np.float32]:
    """Return how little each pixel (h, w) looks like the photo's border, lit or shaded; log likelihood, larger is
    rarer."""
    height, width = pixels.shape[:2]
    view = crop_around_box(pixels, (0, 0, width, height), np.zeros((height, width), dtype=bool))
    rim = np.ones((height, width), dtype=bool)
    depth = max(3, round(0.05 * min(height, width)))
    rim[depth:-depth, depth:-depth] = False
    everything = np.ones_like(rim)
    return np.asarray(-ground_likelihood(view, rim, everything).reshape(height, width), dtype=np.float32)


def candidates(pixels: Pixels) -> list[Mask]:
    """Return regions (h, w) of the copy that may be objects, unordered and overlapping."""
    height, width = pixels.shape[:2]
    smooth = np.asarray(cv2.bilateralFilter(pixels, 5, 30.0, 3.0), dtype=np.uint8)
    lab = cielab(smooth)
    segments = slic(lab, n_segments=300, compactness=12.0, start_label=0, convert2lab=False, channel_axis=-1)
    stands_out = saliency(smooth, np.asarray(segments))
    rare = _unlike_border(pixels)
    maps = [stands_out, cv2.GaussianBlur(rare, (0, 0), 1.5)]
    result: list[Mask] = []
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (3, 3))
    for value in maps:
        levels = np.quantile(value, (0.6, 0.7, 0.8, 0.87, 0.92, 0.96, 0.985))
        for level in np.unique(levels):
            above = cv2.morphologyEx((value > level).astype(np.uint8), cv2.MORPH_OPEN, kernel)
            result += _parts(above > 0)
    for level in (0.25, 0.4, 0.55, 0.7):
        result += _parts(stands_out > level)
    for scale in (60.0, 180.0, 500.0):
        regions = np.asarray(felzenszwalb(smooth, scale=scale, sigma=0.6, min_size=40))
        result += [regions == index for index in range(int(regions.max()) + 1)]
    result += _closed_contours(lab)
    return [mask for mask in result if _plausible(mask, height, width)]


def _parts(mask: Mask) -> list[Mask]:
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=4)
    least = LEAST_AREA * mask.size
    return [labels == index for index in range(1, count) if stats[index, cv2.CC_STAT_AREA] >= least]


def _closed_contours(lab: NDArray[np.float32]) -> list[Mask]:
    """Regions inside closed contours: strong edges with gaps bridged, filled."""
    edges = edge_strength(lab)
    result = []
    for quantile, side in ((0.85, 3), (0.85, 7), (0.92, 5), (0.95, 9)):
        strong = (edges > max(1.5, float(np.quantile(edges, quantile)))).astype(np.uint8)
        kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
        closed = cv2.morphologyEx(strong, cv2.MORPH_CLOSE, kernel)
        contours, _ = cv2.findContours(closed, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
        for contour in contours:
            filled = np.zeros_like(closed)
            cv2.drawContours(filled, [contour], -1, 1, cv2.FILLED)
            result.append(filled > 0)
    return result


def _plausible(mask: Mask, height: int, width: int) -> bool:
    area = int(mask.sum())
    if not LEAST_AREA * mask.size <= area <= MOST_AREA * mask.size:
        return False
    x0, y0, x1, y1 = extent_of(mask)
    if min(x1 - x0, y1 - y0) < LEAST_SIDE * min(height, width) or (x1 - x0) * (y1 - y0) > 0.85 * mask.size:
        return False
    # What goes through the photo from side to side, as floors and shelves do, or touches three sides is its background.
    through = x0 <= SIDES * width and x1 >= (1.0 - SIDES) * width
    return not through and (x0 == 0) + (y0 == 0) + (x1 == width) + (y1 == height) <= 2


def examined_candidates(pixels: Pixels) -> list[Examined]:
    """Return the most promising candidates of the copy ``pixels`` (h, w, 3), segmented in their boxes."""
    height, width = pixels.shape[:2]
    lab = lab_of(pixels)
    edges = edge_strength(lab)
    rough = [(mask, _promise(mask, lab, edges)) for mask in candidates(pixels)]
    rough.sort(key=lambda pair: -pair[1])
    chosen: list[tuple[Mask, tuple[int, int, int, int]]] = []
    for mask, _ in rough:
        box = extent_of(mask)
        if all(_box_iou(box, other) < 0.75 for _, other in chosen):
            chosen.append((mask, box))
        if len(chosen) == EXAMINED:
            break
    result: list[Examined] = []
    for mask, box in chosen:
        found, value, ground = _segmented(pixels, _loose(box, (width, height)), mask)
        if found is not None and _plausible(found, height, width):
            result.append(Examined(found, features_of(found, mask, (value, ground), lab, edges)))
    return result


def _promise(mask: Mask, lab: NDArray[np.float32], edges: NDArray[np.float32]) -> float:
    """A quick judgement of a candidate, larger is better."""
    return (
        1.0 * share_on_edges(mask, edges)
        + 0.6 * min(1.0, contrast_of(mask, lab) / 30.0)
        - 1.0 * cut_share(mask)
        + 0.4 * solidity_of(mask)
        + 0.08 * float(np.log(mask.mean()))
    )


def _segmented(pixels: Pixels, box: Box, start: Mask) -> tuple[Mask | None, float, float]:
    """The object (h, w) in ``box``, its objectness, and the share of it that could be ground, lit or shaded; None
    where there is none."""
    height, width = pixels.shape[:2]
    x0, y0, x1, y1 = (round(v) for v in box)
    window, inner = padded((x0, y0, x1, y1), (height, width))
    crop = np.ascontiguousarray(pixels[window])
    nothing = np.zeros(crop.shape[:2], dtype=bool)
    view = crop_around_box(crop, inner, nothing)
    if view.outside.sum() < 60 or view.inside.sum() < 60:
        return None, 0.0, 1.0
    guesses = [largest_part(mask, nothing) for mask in mask_proposals(view, 3)]
    guesses.append(largest_component(start[window] & view.inside))
    ground = ground_like(view)
    values = [objectness(view, mask, ground) for mask in guesses]
    best = int(np.argmax(values))
    if guesses[best].sum() < 20:
        return None, 0.0, 1.0
    result = np.zeros((height, width), dtype=bool)
    result[window] = guesses[best]
    return result, float(values[best]), float(ground[guesses[best]].mean())


LEAST_SCORE = 0.5
"""Score below which a candidate is not proposed."""


def _box_iou(first: Sequence[float], second: Sequence[float]) -> float:
    width = min(first[2], second[2]) - max(first[0], second[0])
    height = min(first[3], second[3]) - max(first[1], second[1])
    common = max(0.0, width) * max(0.0, height)
    areas = [(b[2] - b[0]) * (b[3] - b[1]) for b in (first, second)]
    return float(common / max(1e-9, sum(areas) - common))
