# SPDX-License-Identifier: MIT
"""Mask proposals for the object in a loose box, from colour and texture models.

As in GrabCut (Rother, Kolmogorov & Blake, SIGGRAPH 2004), with four differences: the surroundings are modelled by
place as well as by colour; shaded ground is ground; texture counts; and the middle of the box more likely holds the
object than its rim. Works on a small copy of the box and its surroundings.

OpenCV's grabCut holds a fast max-flow solver for pixel grids (Boykov & Kolmogorov, PAMI 2004), but computes the
pixels' costs from its own colour models. With models frozen to one Gaussian each, equal but for their means along the
first channel, the difference of the two costs is linear in that channel, so arbitrary unary costs can be passed
through it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ...composite.srgb import cielab
from .mask_cleanup import largest_component

Features = NDArray[np.float32]

SAMPLES = 6000
"""Largest number of pixels to learn from."""


@dataclass(frozen=True)
class ColourModel:
    """A mixture of ``k`` Gaussians over ``d`` features.

    weights: (k,), sum 1. means: (k, d). precisions: (k, d, d) inverse covariances. log_norms: (k,).
    """

    weights: NDArray[np.float64]
    means: NDArray[np.float64]
    precisions: NDArray[np.float64]
    log_norms: NDArray[np.float64]

    def log_likelihood(self, features: Features) -> NDArray[np.float32]:
        """Natural logarithm of the density (n,) at ``features`` (n, d)."""
        terms = np.empty((len(self.weights), len(features)), dtype=np.float32)
        # One row a feature: five times faster than one row a pixel.
        rows = np.ascontiguousarray(features.T)
        for index, (mean, precision) in enumerate(zip(self.means, self.precisions, strict=True)):
            # Whitened: a plain sum of squares is several times faster than a quadratic form.
            white = np.linalg.cholesky(precision).astype(np.float32).T @ (rows - mean.astype(np.float32)[:, None])
            squares = np.square(white, out=white).sum(axis=0)
            terms[index] = np.log(self.weights[index]) + self.log_norms[index] - 0.5 * squares
        top = terms.max(axis=0)
        return np.asarray(top + np.log(np.exp(terms - top).sum(axis=0)), dtype=np.float32)


def learn(features: Features, parts: int, spread: float | Sequence[float] = 3.0, seed: int = 0) -> ColourModel:
    """Fit at most ``parts`` Gaussians to ``features`` (n, d) by k-means, as GrabCut does.

    spread: least standard deviation of every Gaussian, in units of the features, one for all or (d,). Raises ValueError
    for no pixels.
    """
    if len(features) == 0:
        raise ValueError("no pixels to learn colours from")
    picked = np.ascontiguousarray(features[:: max(1, len(features) // SAMPLES)], dtype=np.float32)
    parts = max(1, min(parts, len(picked) // 20))
    cv2.setRNGSeed(seed)  # k-means starts from random centres; equal pixels must give equal models
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 12, 0.5)
    _, labels, _ = cv2.kmeans(picked, parts, np.empty((0, 0), dtype=np.int32), stop, 1, cv2.KMEANS_PP_CENTERS)
    weights, means, precisions, norms = [], [], [], []
    dimensions = picked.shape[1]
    for index in range(parts):
        members = picked[labels[:, 0] == index].astype(np.float64)
        if len(members) == 0:
            continue
        mean = members.mean(axis=0)
        covariance = (members - mean).T @ (members - mean) / len(members) + np.diag(
            np.broadcast_to(np.square(spread), dimensions)
        )
        weights.append(len(members) / len(picked))
        means.append(mean)
        precisions.append(np.linalg.inv(covariance))
        norms.append(-0.5 * (dimensions * np.log(2.0 * np.pi) + np.linalg.slogdet(covariance)[1]))
    return ColourModel(np.array(weights), np.array(means), np.array(precisions), np.array(norms))


Mask = NDArray[np.bool_]

LEVELS = 60.0
"""Grey values over which the costs are spread; few, because their differences count as contrast too."""
LIMIT = 10.0
"""Log likelihood ratios are clipped here."""


def graph_cut(
    ratio: NDArray[np.float32],
    contrast: NDArray[np.uint8],
    smoothness: float,
    *,
    barred: Mask,
    certain: Mask | None = None,
) -> Mask:
    """Return the mask (H, W) of least cost.

    ratio: (H, W) log likelihood ratio of object to background. contrast: (H, W, 2) two channels whose differences
    attract the outline. smoothness: cost of a pixel of outline across equal colours, at least 1, in units of ``ratio``.
    barred: certainly not the object. certain: certainly the object.
    """
    level = (np.clip(ratio, -LIMIT, LIMIT) + LIMIT) / (2.0 * LIMIT) * LEVELS
    image = np.dstack([np.round(level).astype(np.uint8), contrast])
    # grabCut's smoothness is 50: costs are made as large as that asks. Between the two ends lies LEVELS² / variance.
    variance = LEVELS**2 / (2.0 * LIMIT * 50.0 / smoothness)
    rest, own = _single_gaussian(0.0, variance), _single_gaussian(LEVELS, variance)
    labels = np.where(ratio > 0.0, cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
    labels[barred] = cv2.GC_BGD
    if certain is not None:
        labels[certain & ~barred] = cv2.GC_FGD
    cv2.grabCut(np.ascontiguousarray(image), labels, (0, 0, 1, 1), rest, own, 1, cv2.GC_EVAL_FREEZE_MODEL)
    return np.asarray((labels & 1).astype(bool))


def _single_gaussian(mean: float, variance: float) -> NDArray[np.float64]:
    """grabCut's model: 5 weights, 5 means of 3 numbers, 5 covariances of 9; only the first is used."""
    model = np.zeros((1, 65))
    model[0, 0] = 1.0
    model[0, 5] = mean
    # Neutralise the other two channels: equal means and a wide spread in both models.
    model[0, 20:29] = np.diag([variance, 1e8, 1e8]).ravel()
    return model


Box = tuple[int, int, int, int]

PLACE = 18.0
"""Distance (CIELAB units) that the length of the crop adds to a background colour."""
REACH = 0.8
"""Standard deviation over which ground looks alike, over half the crop."""
TEXTURE = 0.8
"""Weight of the local standard deviation of lightness relative to lightness."""
SHADES = (0.7, 0.45, 0.28, 0.15)
"""Factors (linear light) of shaded ground on the ground's colour."""
SHADE_COST = 1.2
"""Log likelihood penalty of shaded ground: shadows are rarer."""
SMOOTHNESS = 4.0
"""Cost of a pixel of outline across equal colours, in log likelihood."""
COMPACT = 0.92
"""Share of its convex hull above which a mask's notches are considered errors."""
EDGE = 3.0
"""Gradient of an edge, in CIELAB units per pixel."""
OBJECT_PARTS, GROUND_PARTS = 5, 7


@dataclass(frozen=True)
class BoxCrop:
    """A small copy of the box and its surroundings.

    pixels: (h, w, 3) uint8 sRGB. lab: (h, w, 3) CIELAB, slightly smoothed. texture: (h, w). box: x0, y0, x1, y1.
    others: (h, w) pixels of other objects: neither this one nor its background. keep, drop: (h, w) pixels that the user
    says belong to the object, or to its background.
    """

    pixels: NDArray[np.uint8]
    lab: NDArray[np.float32]
    texture: NDArray[np.float32]
    box: Box
    others: Mask
    keep: Mask
    drop: Mask

    @property
    def inside(self) -> Mask:
        """Pixels (h, w) that may belong to the object."""
        x0, y0, x1, y1 = self.box
        result = np.zeros(self.others.shape, dtype=bool)
        result[y0:y1, x0:x1] = True
        return result & ~self.others & ~self.drop

    @property
    def outside(self) -> Mask:
        """Pixels (h, w) that are certainly background."""
        x0, y0, x1, y1 = self.box
        result = ~self.others
        result[y0:y1, x0:x1] = False
        return result | self.drop


def crop_around_box(
    pixels: NDArray[np.uint8], box: Box, others: Mask, *, keep: Mask | None = None, drop: Mask | None = None
) -> BoxCrop:
    """Return the ``BoxCrop`` of a small copy ``pixels`` (h, w, 3)."""
    empty = np.zeros(pixels.shape[:2], dtype=bool)
    lab = cielab(pixels, blur=0.8)
    light = cielab(pixels)[..., 0]
    mean = cv2.GaussianBlur(light, (0, 0), 2.0)
    spread = np.sqrt(np.maximum(cv2.GaussianBlur(light**2, (0, 0), 2.0) - mean**2, 0.0))
    # An edge between two plain surfaces is not texture: use the calmest window around each pixel.
    calm = cv2.erode(spread, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (9, 9)))
    return BoxCrop(
        pixels,
        lab,
        np.asarray(TEXTURE * calm, dtype=np.float32),
        box,
        others,
        empty if keep is None else keep,
        empty if drop is None else drop,
    )


def ground_likelihood(view: BoxCrop, where: Mask, asked: Mask, shades: Sequence[float] = SHADES) -> NDArray[np.float32]:
    """Return the log likelihood (n,) that the pixels ``asked`` (h, w) look like nearby pixels of ``where`` (h, w), lit
    or shaded."""
    height, width = where.shape
    rows, columns = np.mgrid[:height, :width].astype(np.float32) / max(height, width) * (PLACE * 2.0)
    features = np.dstack([view.lab, view.texture, columns, rows])
    # The ground inside the box is up to half the box' width away from the learned pixels.
    lit = learn(features[where], GROUND_PARTS, (3.0, 3.0, 3.0, 3.0, REACH * PLACE, REACH * PLACE))
    queried = features[asked]
    best = lit.log_likelihood(queried)
    for shade in shades:
        best = np.maximum(best, _shaded(lit, shade).log_likelihood(queried) - SHADE_COST)
    # The model has two more features than the object's, the position; spread over the crop they cost a constant.
    return best + np.float32(2.0 * np.log(2.0 * PLACE))


def _shaded(model: ColourModel, shade: float) -> ColourModel:
    """``model`` with all colours darkened: CIELAB scales with the cube root of light, and so does its spread."""
    factor = shade ** (1.0 / 3.0)
    means = model.means.copy()
    # L* = 116 f - 16, while a* and b* have no offset.
    means[:, 0] = (means[:, 0] + 16.0) * factor - 16.0
    means[:, 1:3] *= factor
    means[:, 3] *= factor
    return ColourModel(model.weights, means, model.precisions, model.log_norms)


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
    binary = mask.astype(np.uint8)
    solid = float(mask.sum()) / float(_hull_mask(mask).sum())
    kernel = np.ones((3, 3), np.uint8)
    outline = (cv2.dilate(binary, kernel) > 0) & ~(cv2.erode(binary, kernel, borderValue=0) > 0)
    # Where another object covers this one it has no edge of its own.
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
    """Return the convex hull of a ``mask`` (h, w) that almost fills it, else None."""
    if mask.sum() < 20:
        return None
    hull = _hull_mask(mask) & inside
    return hull if COMPACT < float(mask.sum()) / float(hull.sum()) < 0.995 else None


def _hull_mask(mask: Mask) -> Mask:
    drawn = np.zeros(mask.shape, dtype=np.uint8)
    cv2.fillConvexPoly(drawn, cv2.convexHull(np.argwhere(mask)[:, ::-1].astype(np.int32)), 1)
    return np.asarray(drawn > 0)


def edge_strength(lab: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the colour gradient (h, w) in CIELAB units per pixel."""
    across, down = (cv2.Sobel(lab, cv2.CV_32F, *direction, scale=1.0 / 8.0) for direction in ((1, 0), (0, 1)))
    return np.asarray(np.sqrt((across**2 + down**2).sum(axis=2)), dtype=np.float32)


def largest_part(mask: Mask, others: Mask) -> Mask:
    """Return the largest connected part of ``mask``; parts separated only by ``others`` stay together."""
    if not others.any():
        return largest_component(mask)
    _, labels = cv2.connectedComponents((mask | others).astype(np.uint8), connectivity=8)
    sizes = np.bincount(labels[mask].astype(np.int64), minlength=2)
    kept = mask & (labels == int(np.argmax(sizes)))
    # Parts separated by the others count if they are more than specks.
    _, parts, stats, _ = cv2.connectedComponentsWithStats(kept.astype(np.uint8), connectivity=8)
    areas = stats[:, cv2.CC_STAT_AREA].copy()
    areas[0] = 0
    return np.asarray(np.isin(parts, np.flatnonzero(areas >= 0.05 * areas.max()))) & kept


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


def principal_contrast(lab: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Return the first two principal components (h, w, 2) of colour."""
    flat = lab.reshape(-1, 3)
    away = flat - flat.mean(axis=0)
    vectors = np.linalg.eigh(away.T @ away)[1]
    projected = away @ vectors[:, :0:-1]
    return np.asarray(np.clip(projected + 128.0, 0, 255).astype(np.uint8).reshape(*lab.shape[:2], 2))
