# SPDX-License-Identifier: MIT
"""Where in a loose box is the object? Colours and texture, learned by turns with the outline.

As GrabCut does (Rother, Kolmogorov & Blake, SIGGRAPH 2004), with four differences: the surroundings are known by place
as well as by colour; shaded ground is ground; texture counts; and the middle of the box more likely holds the object
than its rim. Works on a small copy of the box and its surroundings.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from .colour_model import ColourModel, learn
from .graph_cut import LIMIT, graph_cut
from .mask_cleanup import largest_component

Mask = NDArray[np.bool_]
Box = tuple[int, int, int, int]

PLACE = 18.0
"""A background colour counts as this far off (CIELAB units) at the other end of the crop."""
REACH = 0.8
"""Standard deviation over which ground looks alike, as a fraction of half the crop."""
TEXTURE = 0.8
"""Weight of the local spread of lightness against lightness itself."""
SHADES = (0.7, 0.45, 0.28, 0.15)
"""Ground in shadow is the ground's colour times one of these (linear light)."""
SHADE_COST = 1.2
"""Log likelihood that shaded ground loses against lit ground: shadows are rarer."""
SMOOTHNESS = 4.0
"""Cost of a pixel of outline across equal colours, against log likelihoods."""
COMPACT = 0.92
"""Share of its convex hull from which a thing may be convex, and its notches mistakes."""
EDGE = 3.0
"""CIELAB units per pixel that make an edge."""
OBJECT_PARTS, GROUND_PARTS = 5, 7


@dataclass(frozen=True)
class View:
    """What the search looks at, at small size.

    pixels: (h, w, 3) uint8 sRGB. lab: (h, w, 3) CIELAB, slightly smoothed. texture: (h, w). box: x0, y0, x1, y1.
    others: (h, w) pixels that belong to other objects: neither this one nor its background.
    """

    pixels: NDArray[np.uint8]
    lab: NDArray[np.float32]
    texture: NDArray[np.float32]
    box: Box
    others: Mask

    @property
    def inside(self) -> Mask:
        """Where the object may be (h, w)."""
        x0, y0, x1, y1 = self.box
        result = np.zeros(self.others.shape, dtype=bool)
        result[y0:y1, x0:x1] = True
        return result & ~self.others

    @property
    def outside(self) -> Mask:
        """What is certainly background (h, w)."""
        x0, y0, x1, y1 = self.box
        result = ~self.others
        result[y0:y1, x0:x1] = False
        return result


def look(pixels: NDArray[np.uint8], box: Box, others: Mask) -> View:
    """The ``View`` of a small copy ``pixels`` (h, w, 3)."""
    smooth = cv2.GaussianBlur(pixels.astype(np.float32) / 255.0, (0, 0), 0.8)
    lab = np.asarray(cv2.cvtColor(smooth, cv2.COLOR_RGB2LAB), dtype=np.float32)
    light = cv2.cvtColor(pixels.astype(np.float32) / 255.0, cv2.COLOR_RGB2LAB)[..., 0]
    mean = cv2.GaussianBlur(light, (0, 0), 2.0)
    spread = np.sqrt(np.maximum(cv2.GaussianBlur(light**2, (0, 0), 2.0) - mean**2, 0.0))
    # An edge between two plain things is no texture: of the windows around a pixel the calmest counts.
    calm = cv2.erode(spread, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (9, 9)))
    return View(pixels, lab, np.asarray(TEXTURE * calm, dtype=np.float32), box, others)


def ground_likelihood(view: View, where: Mask, asked: Mask, shades: Sequence[float] = SHADES) -> NDArray[np.float32]:
    """Log likelihood (n,) that the pixels ``asked`` (h, w) show what ``where`` (h, w) shows near by, or its shade."""
    height, width = where.shape
    rows, columns = np.mgrid[:height, :width].astype(np.float32) / max(height, width) * (PLACE * 2.0)
    features = np.dstack([view.lab, view.texture, columns, rows])
    # The ground inside the box lies as far from all that is learned from as half the box is wide.
    lit = learn(features[where], GROUND_PARTS, (3.0, 3.0, 3.0, 3.0, REACH * PLACE, REACH * PLACE))
    queried = features[asked]
    best = lit.log_likelihood(queried)
    for shade in shades:
        best = np.maximum(best, _shaded(lit, shade).log_likelihood(queried) - SHADE_COST)
    # The model knows two numbers more than the object's, the place; spread over the crop they cost a constant.
    return best + np.float32(2.0 * np.log(2.0 * PLACE))


def _shaded(model: ColourModel, shade: float) -> ColourModel:
    """``model`` with all its colours darkened: CIELAB scales with the cube root of light, and so does its spread."""
    factor = shade ** (1.0 / 3.0)
    means = model.means.copy()
    # L* = 116 f - 16, while a* and b* have no offset.
    means[:, 0] = (means[:, 0] + 16.0) * factor - 16.0
    means[:, 1:3] *= factor
    means[:, 3] *= factor
    return ColourModel(model.weights, means, model.precisions, model.log_norms)


def prior(view: View, *, middle: float = 1.0, rim: float = -3.0) -> NDArray[np.float32]:
    """Log odds (h, w) of being the object by place alone: high in the middle of the box, low at its rim."""
    x0, y0, x1, y1 = view.box
    rows, columns = np.mgrid[: view.others.shape[0], : view.others.shape[1]] + 0.5
    across = np.abs(columns - (x0 + x1) / 2.0) / max(1.0, (x1 - x0) / 2.0)
    down = np.abs(rows - (y0 + y1) / 2.0) / max(1.0, (y1 - y0) / 2.0)
    away = (across**4 + down**4) ** 0.25
    return np.asarray(middle + (rim - middle) * np.clip((away - 0.45) / 0.55, 0.0, 1.0) ** 1.5, dtype=np.float32)


def proposals(view: View, rounds: int) -> list[Mask]:
    """Guesses of the object (h, w): from the middle of the box, from what is unlike the surroundings, the same without
    shaded ground (black things on brown wood), and GrabCut's own."""
    inside = view.inside
    by_place = prior(view)
    outside = _background(view)
    found = []
    for shades in (SHADES, ()):
        ground = ground_likelihood(view, outside, inside, shades)
        unlike = np.full(inside.shape, -np.inf, dtype=np.float32)
        unlike[inside] = 1.5 * by_place[inside] - ground
        found.append(propose(view, unlike > np.quantile(unlike[inside], 0.6), ground, shades, rounds))
        if shades:
            found.append(propose(view, inside & (by_place > 0.0), ground, shades, rounds))
    found.append(_grabcut(view, rounds))
    return found


def propose(view: View, start: Mask, ground: NDArray[np.float32], shades: Sequence[float], rounds: int) -> Mask:
    """The object (h, w), beginning with the guess ``start``; empty when it dissolves.

    ground: ``ground_likelihood`` of what lies outside of the box, at the pixels inside of it.
    """
    inside = view.inside
    features = np.dstack([view.lab, view.texture])[inside]
    by_place = prior(view)
    contrast = _contrast(view.lab)
    found = start & inside
    for turn in range(rounds):
        if found.sum() < 20:
            return np.zeros_like(found)
        if turn == 2:
            rest = _background(view) | (inside & ~found & (by_place < 0.0))
            ground = ground_likelihood(view, rest, inside, shades)
        own = learn(features[found[inside]], OBJECT_PARTS).log_likelihood(features)
        ratio = np.zeros(inside.shape, dtype=np.float32)
        ratio[inside] = np.clip(own - ground, -4.0, 4.0)
        new = graph_cut(ratio + by_place, contrast, SMOOTHNESS, barred=~inside)
        if (new == found).all() and turn > 2:
            break
        found = new
    return found


def refine(view: View, found: Mask, band: int) -> Mask:
    """``found`` (h, w) with its outline decided again within ``band`` pixels, by the colours on both sides of it."""
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * band + 1, 2 * band + 1))
    binary = found.astype(np.uint8)
    core = cv2.erode(binary, kernel, borderValue=0) > 0
    beyond = (cv2.dilate(binary, kernel) == 0) & ~view.others
    open_ = ~core & ~beyond & view.inside
    if core.sum() < 20 or beyond.sum() < 50 or not open_.any():
        return found
    features = np.dstack([view.lab, view.texture])
    own = learn(features[core], OBJECT_PARTS).log_likelihood(features[open_])
    ratio = np.full(found.shape, -LIMIT, dtype=np.float32)
    ratio[core] = LIMIT
    ratio[open_] = np.clip(own - ground_likelihood(view, beyond, open_), -4.0, 4.0)
    return graph_cut(ratio, _contrast(view.lab), SMOOTHNESS, barred=~core & ~open_)


def _grabcut(view: View, rounds: int) -> Mask:
    labels = np.where(view.inside, cv2.GC_PR_FGD, cv2.GC_BGD).astype(np.uint8)
    labels[_background(view)] = cv2.GC_BGD
    return grabcut(view.pixels, labels, rounds)


def grabcut(pixels: NDArray[np.uint8], labels: NDArray[np.uint8], rounds: int) -> Mask:
    """OpenCV's GrabCut from ``labels`` (h, w) of its own kind; empty where there is nothing to learn from."""
    cv2.setRNGSeed(0)  # k-means starts from random centres; the same photo must give the same mask
    try:
        cv2.grabCut(
            np.ascontiguousarray(pixels),
            labels,
            (0, 0, 1, 1),
            np.zeros((1, 65)),
            np.zeros((1, 65)),
            rounds,
            cv2.GC_INIT_WITH_MASK,
        )
    except cv2.error:
        # A crop of one colour, or without background: the caller falls back.
        return np.zeros(labels.shape, dtype=bool)
    return np.asarray((labels & 1).astype(bool))


def ground_like(view: View) -> Mask:
    """Where in the box (h, w) the colour, texture and place are usual for the surroundings, lit or shaded."""
    result = np.zeros(view.others.shape, dtype=bool)
    outside = _background(view)
    usual = np.quantile(ground_likelihood(view, outside, outside, ()), 0.1)
    result[view.inside] = ground_likelihood(view, outside, view.inside) > usual
    return result


def score(view: View, mask: Mask, ground: Mask) -> float:
    """How much like an object ``mask`` looks, about 0 to 1: fitted to overlaps with true masks on drawn scenes.

    Its outline runs along edges of the picture, it is rather convex, does not reach the sides of a loose box, and holds
    little of what looks like ground: ``ground`` (h, w), see ``ground_like``.
    """
    if mask.sum() < 20:
        return -1.0
    binary = mask.astype(np.uint8)
    solid = float(mask.sum()) / float(_hull(mask).sum())
    kernel = np.ones((3, 3), np.uint8)
    outline = (cv2.dilate(binary, kernel) > 0) & ~(cv2.erode(binary, kernel, borderValue=0) > 0)
    # Where another object covers this one there is no edge of its own to ask for.
    outline &= ~(cv2.dilate(view.others.astype(np.uint8), kernel) > 0)
    on_edges = float((edge_strength(view.lab)[outline] > EDGE).mean()) if outline.any() else 0.0
    x0, y0, x1, y1 = view.box
    height, width = mask.shape
    sides = [
        mask[y0, x0:x1] if y0 > 0 else None,
        mask[y1 - 1, x0:x1] if y1 < height else None,
        mask[y0:y1, x0] if x0 > 0 else None,
        mask[y0:y1, x1 - 1] if x1 < width else None,
    ]
    reaching = sum(float(side.mean()) for side in sides if side is not None)
    return 0.37 * solid + 0.66 * on_edges - 0.43 * reaching - 0.25 * float(ground[mask].mean())


def without_notches(mask: Mask, inside: Mask) -> Mask | None:
    """One more guess: the convex hull of a ``mask`` (h, w) that almost fills it; None where it does not."""
    if mask.sum() < 20:
        return None
    hull = _hull(mask) & inside
    return hull if COMPACT < float(mask.sum()) / float(hull.sum()) < 0.995 else None


def _hull(mask: Mask) -> Mask:
    drawn = np.zeros(mask.shape, dtype=np.uint8)
    cv2.fillConvexPoly(drawn, cv2.convexHull(np.argwhere(mask)[:, ::-1].astype(np.int32)), 1)
    return np.asarray(drawn > 0)


def edge_strength(lab: NDArray[np.float32]) -> NDArray[np.float32]:
    """Change of colour (h, w) in CIELAB units per pixel."""
    across, down = (cv2.Sobel(lab, cv2.CV_32F, *direction, scale=1.0 / 8.0) for direction in ((1, 0), (0, 1)))
    return np.asarray(np.sqrt((across**2 + down**2).sum(axis=2)), dtype=np.float32)


def largest_part(mask: Mask, others: Mask) -> Mask:
    """The largest connected part of ``mask``; parts that only ``others`` divide stay together."""
    if not others.any():
        return largest_component(mask)
    _, labels = cv2.connectedComponents((mask | others).astype(np.uint8), connectivity=8)
    sizes = np.bincount(labels[mask].astype(np.int64), minlength=2)
    kept = mask & (labels == int(np.argmax(sizes)))
    # What the others divide counts if it is more than a speck.
    _, parts, stats, _ = cv2.connectedComponentsWithStats(kept.astype(np.uint8), connectivity=8)
    areas = stats[:, cv2.CC_STAT_AREA].copy()
    areas[0] = 0
    return np.asarray(np.isin(parts, np.flatnonzero(areas >= 0.05 * areas.max()))) & kept


def _background(view: View) -> Mask:
    """What is certainly background, and the rim of the box where there is nothing outside of it."""
    outside = view.outside
    if outside.sum() >= 50:
        return outside
    x0, y0, x1, y1 = view.box
    rim = view.inside
    dy, dx = max(1, (y1 - y0) // 20), max(1, (x1 - x0) // 20)
    rim[y0 + dy : y1 - dy, x0 + dx : x1 - dx] = False
    return outside | rim


def _contrast(lab: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Two channels (h, w, 2) that hold most of the colour differences: the first two principal components."""
    flat = lab.reshape(-1, 3)
    away = flat - flat.mean(axis=0)
    vectors = np.linalg.eigh(away.T @ away)[1]
    projected = away @ vectors[:, :0:-1]
    return np.asarray(np.clip(projected + 128.0, 0, 255).astype(np.uint8).reshape(*lab.shape[:2], 2))
