# SPDX-License-Identifier: MIT
"""Mask proposals for the object in a loose box, from colour and texture models.

As in GrabCut (Rother, Kolmogorov & Blake, SIGGRAPH 2004), with four differences: the surroundings are modelled by
place as well as by colour; shaded ground is ground; texture counts; and the middle of the box more likely holds the
object than its rim. Works on a small copy of the box and its surroundings.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from .box_crop import EDGE, BoxCrop, edge_strength
from .colour_models import (
    LIMIT,
    OBJECT_PARTS,
    PLACE,
    REACH,
    SHADES,
    SMOOTHNESS,
    graph_cut,
    ground_likelihood,
    learn,
    principal_contrast,
)
from .mask_geometry import Mask, grown, hull_of, outline_of

COMPACT = 0.92
"""Share of its convex hull above which a mask's notches are considered errors."""


def prior(view: BoxCrop, *, middle: float = 1.0, rim: float = -3.0) -> NDArray[np.float32]:
    """Return the log odds (h, w) of the object by position: high in the middle of the box, low at its rim."""
    x0, y0, x1, y1 = view.box
    rows, columns = np.mgrid[: view.others.shape[0], : view.others.shape[1]] + 0.5
    across = np.abs(columns - (x0 + x1) / 2.0) / max(1.0, (x1 - x0) / 2.0)
    down = np.abs(rows - (y0 + y1) / 2.0) / max(1.0, (y1 - y0) / 2.0)
    away = (across**4 + down**4) ** 0.25
    return np.asarray(middle + (rim - middle) * np.clip((away - 0.45) / 0.55, 0.0, 1.0) ** 1.5, dtype=np.float32)


def proposals(view: BoxCrop, rounds: int) -> list[Mask]:
    """Return proposals (h, w): from the middle of the box, from what differs from the surroundings, the same without
    shaded ground (black objects on brown wood), and GrabCut's own."""
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
            if view.keep.any():
                found.append(propose(view, view.keep, ground, shades, rounds))
    found.append(_grabcut(view, rounds))
    return found


def propose(view: BoxCrop, start: Mask, ground: NDArray[np.float32], shades: Sequence[float], rounds: int) -> Mask:
    """Return the object (h, w), starting from ``start``; empty when it dissolves.

    ground: ``ground_likelihood`` of the pixels outside the box, at those inside.
    """
    inside = view.inside
    features = np.dstack([view.lab, view.texture])[inside]
    by_place = prior(view)
    contrast = principal_contrast(view.lab)
    keep = view.keep & inside
    found = (start & inside) | keep
    stroked = _stroked(view, inside)
    for turn in range(rounds):
        if found.sum() < 20 and not keep.any():
            return np.zeros_like(found)
        if turn == 2:
            rest = _background(view) | (inside & ~found & (by_place < 0.0))
            ground = ground_likelihood(view, rest, inside, shades)
        own = learn(features[found[inside]], OBJECT_PARTS).log_likelihood(features)
        ratio = np.zeros(inside.shape, dtype=np.float32)
        ratio[inside] = np.clip(own - ground, -4.0, 4.0)
        if stroked is not None:
            ratio[inside] = np.clip(ratio[inside] + stroked, -4.0, 4.0)
        new = graph_cut(ratio + by_place, contrast, SMOOTHNESS, barred=~inside, certain=keep)
        if (new == found).all() and turn > 2:
            break
        found = new
    return found


def _stroked(view: BoxCrop, inside: Mask) -> NDArray[np.float32] | None:
    """Log likelihood ratio (n,) of the pixels ``inside`` by the strokes alone: a stroke speaks for its own colours, the
    louder the nearer, while nothing unlike it lies in between; None without strokes."""
    if not view.keep.any() and not (view.drop & ~view.others).any():
        return None
    rows, columns = np.mgrid[: inside.shape[0], : inside.shape[1]].astype(np.float32) / max(inside.shape) * (PLACE * 2)
    features = np.dstack([view.lab, view.texture, columns, rows])
    result = np.zeros(int(inside.sum()), dtype=np.float32)
    for strokes, sign in ((view.keep, 1.0), (view.drop, -1.0)):
        if strokes.any():
            spread = (4.0, 4.0, 4.0, 4.0, REACH * PLACE, REACH * PLACE)
            model = learn(features[strokes], 3, spread)
            # Above the density three standard deviations away, a pixel is like the stroke.
            least = float(model.log_norms.max()) - 4.5
            likeness = np.clip((model.log_likelihood(features[inside]) - least) / 4.5, 0.0, 1.0)
            result += np.float32(sign * 8.0) * likeness.astype(np.float32)
    return result


def refine(view: BoxCrop, found: Mask, band: int) -> Mask:
    """Return ``found`` (h, w) with its outline re-estimated within ``band`` pixels, by the colours on both sides."""
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * band + 1, 2 * band + 1))
    binary = found.astype(np.uint8)
    core = ((cv2.erode(binary, kernel, borderValue=0) > 0) | view.keep) & ~view.drop
    beyond = ((cv2.dilate(binary, kernel) == 0) & ~view.others & ~view.keep) | view.drop
    open_ = ~core & ~beyond & view.inside
    if core.sum() < 20 or beyond.sum() < 50 or not open_.any():
        return found
    features = np.dstack([view.lab, view.texture])
    own = learn(features[core], OBJECT_PARTS).log_likelihood(features[open_])
    ratio = np.full(found.shape, -LIMIT, dtype=np.float32)
    ratio[core] = LIMIT
    ratio[open_] = np.clip(own - ground_likelihood(view, beyond, open_), -4.0, 4.0)
    return graph_cut(ratio, principal_contrast(view.lab), SMOOTHNESS, barred=~core & ~open_)


def _grabcut(view: BoxCrop, rounds: int) -> Mask:
    labels = np.where(view.inside, cv2.GC_PR_FGD, cv2.GC_BGD).astype(np.uint8)
    labels[_background(view)] = cv2.GC_BGD
    labels[view.keep & view.inside] = cv2.GC_FGD
    return grabcut(view.pixels, labels, rounds)


def grabcut(pixels: NDArray[np.uint8], labels: NDArray[np.uint8], rounds: int) -> Mask:
    """Return the result of OpenCV's GrabCut from its ``labels`` (h, w); empty if there are no pixels to learn from."""
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


def ground_like(view: BoxCrop) -> Mask:
    """Return pixels (h, w) in the box whose colour, texture and position are typical of the surroundings, lit or
    shaded."""
    result = np.zeros(view.others.shape, dtype=bool)
    outside = _background(view)
    usual = np.quantile(ground_likelihood(view, outside, outside, ()), 0.1)
    result[view.inside] = ground_likelihood(view, outside, view.inside) > usual
    return result


def score(view: BoxCrop, mask: Mask, ground: Mask) -> float:
    """Return an objectness score of ``mask``, about 0 to 1, fitted to overlaps with true masks on drawn scenes.

    An object's outline follows image edges, is rather convex, does not reach the sides of a loose box, and contains
    little that looks like ground: ``ground`` (h, w), see ``ground_like``.
    """
    if mask.sum() < 20:
        return -1.0
    solid = float(mask.sum()) / float(hull_of(mask).sum())
    outline = outline_of(mask)
    # Where another object covers this one it has no edge of its own.
    outline &= ~grown(view.others)
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
    """Return the convex hull of a ``mask`` (h, w) that almost fills it, else None."""
    if mask.sum() < 20:
        return None
    hull = hull_of(mask) & inside
    return hull if COMPACT < float(mask.sum()) / float(hull.sum()) < 0.995 else None


def _background(view: BoxCrop) -> Mask:
    """Certain background; plus the rim of the box where there is nothing outside of it."""
    outside = view.outside
    if outside.sum() >= 50:
        return outside
    x0, y0, x1, y1 = view.box
    rim = view.inside
    dy, dx = max(1, (y1 - y0) // 20), max(1, (x1 - x0) // 20)
    rim[y0 + dy : y1 - dy, x0 + dx : x1 - dx] = False
    return outside | rim
