# SPDX-License-Identifier: MIT
"""Alpha mattes: how much of each pixel an object covers, for fur, hair and blurred outlines.

Closed-form matting (Levin, Lischinski & Weiss, PAMI 30, 2008) in the band of pixels that are neither certainly object
nor certainly background: in every window of 3 × 3 pixels alpha is an affine function of colour. Only windows that hold
an unknown pixel are built, so cost and memory follow the outline's length. Where object and background have the same
colours, the outline stays where it was.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from ...srgb import bytes_to_linear, cielab, linear_to_bytes
from .box_crop import crop_around_box
from .colour_models import LIMIT, graph_cut, ground_likelihood, learn, principal_contrast
from .mask_geometry import grown, touching

Mask = NDArray[np.bool_]
Alpha = NDArray[np.float32]
Pixels = NDArray[np.uint8]

EPSILON = 1e-5
"""Least variance of colours (0 to 1) in a window: larger values make smoother mattes."""
MOST_UNKNOWN = 60_000
"""Unknown pixels above which a matte is computed on a smaller copy: 0.3 GiB and a few seconds."""
ROUNDS = 400
"""Steps of conjugate gradients; the error is below a grey value long before."""


@dataclass(frozen=True)
class Trimap:
    """own, other: (H, W) pixels that certainly are, or are not, the object. The rest is unknown."""

    own: Mask
    other: Mask

    @property
    def unknown(self) -> Mask:
        """Pixels (H, W) whose alpha is asked for."""
        return ~self.own & ~self.other


def closed_form_alpha(pixels: Pixels, trimap: Trimap) -> Alpha:
    """Return alpha (H, W), 0 to 1: exactly 1 on ``trimap.own``, 0 on ``trimap.other``, by colour in between.

    pixels: (H, W, 3) sRGB. Above ``MOST_UNKNOWN`` unknown pixels a smaller copy is solved and enlarged.
    """
    unknown = trimap.unknown
    known = np.asarray(trimap.own, dtype=np.float32)
    if not unknown.any() or not trimap.own.any() or not trimap.other.any():
        return np.where(unknown, np.float32(0.5), known)
    count = int(unknown.sum())
    if count > MOST_UNKNOWN:
        scale = float(np.sqrt(0.7 * MOST_UNKNOWN / count))
        size = (max(4, round(pixels.shape[1] * scale)), max(4, round(pixels.shape[0] * scale)))
        own, other = (
            cv2.resize(part.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.9
            for part in (trimap.own, trimap.other)
        )
        small = np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
        coarse = _in_window(small, Trimap(own, other))
        large = cv2.resize(coarse, pixels.shape[1::-1], interpolation=cv2.INTER_LINEAR)
        return np.where(unknown, np.clip(large, 0.0, 1.0), known).astype(np.float32)
    return _in_window(pixels, trimap)


def _in_window(pixels: Pixels, trimap: Trimap) -> Alpha:
    """Alpha (h, w), solved in the window of the unknown pixels."""
    unknown, known = trimap.unknown, np.asarray(trimap.own, dtype=np.float32)
    if not unknown.any():
        return known
    rows, columns = np.flatnonzero(unknown.any(axis=1)), np.flatnonzero(unknown.any(axis=0))
    window = (
        slice(max(0, rows[0] - 3), rows[-1] + 4),
        slice(max(0, columns[0] - 3), columns[-1] + 4),
    )
    result = known.copy()
    part = _solved(pixels[window].astype(np.float64) / 255.0, unknown[window], known[window])
    result[window] = np.where(unknown[window], part, known[window])
    return result


def _solved(colours: NDArray[np.float64], unknown: Mask, known: Alpha) -> Alpha:
    """Alpha (h, w) by the matting Laplacian of the windows that hold an unknown pixel."""
    height, width = unknown.shape
    if min(height, width) < 3:
        return np.where(unknown, np.float32(0.5), known)
    near = grown(unknown)
    near[0], near[-1], near[:, 0], near[:, -1] = False, False, False, False
    centres = np.flatnonzero(near)
    offsets = (np.arange(-1, 2)[:, None] * width + np.arange(-1, 2)).ravel()
    places = centres[:, None] + offsets
    flat = colours.reshape(-1, 3)
    values = flat[places]
    away = values - values.mean(axis=1, keepdims=True)
    covariance = np.einsum("nki,nkj->nij", away, away) / 9.0 + np.eye(3) * (EPSILON / 9.0)
    affinity = (1.0 + np.einsum("nki,nij,nlj->nkl", away, np.linalg.inv(covariance), away, optimize=True)) / 9.0
    blocks = (np.eye(9) - affinity).ravel()
    across = np.repeat(places, 9, axis=1).ravel(), np.tile(places, (1, 9)).ravel()
    laplacian = sparse.coo_matrix((blocks, across), shape=(flat.shape[0],) * 2).tocsr()
    wanted = np.flatnonzero(unknown.ravel())
    system = laplacian[wanted][:, wanted]
    fixed = np.where(unknown, 0.0, known).ravel().astype(np.float64)
    right = -(laplacian[wanted] @ fixed)
    # Half a second of imports that every bake and command would pay.
    from scipy.sparse.linalg import cg

    diagonal = np.maximum(system.diagonal(), 1e-9)
    system = system + sparse.diags_array(np.full(len(wanted), 1e-7))
    start = _nearest_known(unknown, known).ravel()[wanted]
    found, _ = cg(system, right, x0=start, rtol=1e-4, maxiter=ROUNDS, M=sparse.diags_array(1.0 / diagonal))
    result = known.astype(np.float32).ravel()
    result[wanted] = np.clip(found, 0.0, 1.0)
    return np.asarray(result.reshape(unknown.shape), dtype=np.float32)


def _nearest_known(unknown: Mask, known: Alpha) -> NDArray[np.float64]:
    """A guess of alpha: by how far each pixel is from both sides."""
    own, other = ~unknown & (known > 0.5), ~unknown & (known <= 0.5)
    inwards = cv2.distanceTransform((~own).astype(np.uint8), cv2.DIST_L2, 3)
    outwards = cv2.distanceTransform((~other).astype(np.uint8), cv2.DIST_L2, 3)
    return np.asarray(outwards / np.maximum(inwards + outwards, 1e-6), dtype=np.float64)


def outline_band(mask: Mask, width: float) -> Trimap:
    """Return a trimap whose unknown pixels lie within ``width`` pixels of the outline of ``mask``; thin parts keep
    their middle line as certain."""
    inwards = cv2.distanceTransform(np.pad(mask, 1).astype(np.uint8), cv2.DIST_L2, 5)[1:-1, 1:-1]
    outwards = cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, 5)
    ridge = mask & (inwards >= cv2.dilate(inwards, np.ones((3, 3), np.uint8)) - 1e-3) & (inwards > 1.0)
    return Trimap(own=mask & ((inwards > width) | ridge), other=~mask & (outwards > width))


LEAST_CONTRAST = 12.0
"""Distance of the colours of both sides, CIELAB, below which a matte is not trusted."""


def soft_alpha(pixels: Pixels, mask: Mask, *, width: float | None = None, others: Mask | None = None) -> Alpha:
    """Return the alpha (H, W) of the object with the hard ``mask``: soft where hair, fur or blur make it so.

    width: pixels on both sides of the outline in which alpha may differ from the mask; None is 1.5 % of the object's
    size, at least 3. others: (H, W) pixels of other objects, where alpha is 0. The matte is only used where the colours
    of both sides differ; elsewhere the mask stays, blurred by half a pixel.
    """
    size = float(np.sqrt(max(1, int(mask.sum()))))
    reach = max(3.0, 0.015 * size) if width is None else width
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    result = np.asarray(mask, dtype=np.float32)
    if not len(rows):
        return result
    margin = int(np.ceil(3 * reach)) + 4
    window = (
        slice(max(0, rows[0] - margin), rows[-1] + margin + 1),
        slice(max(0, columns[0] - margin), columns[-1] + margin + 1),
    )
    part, inside = np.ascontiguousarray(pixels[window]), mask[window]
    trimap = outline_band(inside, reach)
    barred = np.zeros_like(inside) if others is None else others[window] & ~inside
    trimap = Trimap(trimap.own, trimap.other | barred)
    matte = closed_form_alpha(part, trimap)
    hard = cv2.GaussianBlur(inside.astype(np.float32), (0, 0), 0.5)
    trust = _apart(part, trimap, 2.0 * reach)
    mixed = np.where(trimap.unknown, hard + (matte - hard) * trust, inside)
    # What is not connected with the object is not its hair.
    mixed = np.where(touching(mixed > 0.1, inside), mixed, 0.0)
    result[window] = np.where(barred, 0.0, mixed)
    return result


def _apart(pixels: Pixels, trimap: Trimap, reach: float) -> Alpha:
    """Return how far (h, w), 0 to 1, the local mean colours of both sides can be told apart."""
    lab = cielab(pixels)
    means = []
    for side in (trimap.own, trimap.other):
        weight = side.astype(np.float32)
        total = cv2.GaussianBlur(weight, (0, 0), reach)
        means.append(cv2.GaussianBlur(lab * weight[..., None], (0, 0), reach) / np.maximum(total, 1e-6)[..., None])
    apart = np.linalg.norm(means[0] - means[1], axis=2)
    return np.asarray(np.clip(apart / LEAST_CONTRAST - 0.5, 0.0, 1.0), dtype=np.float32)


CERTAIN = 0.95
"""Alpha from which a pixel's colour is the object's alone, and below 1 less which it is the background's."""
FAR = 4.0
"""Wider of the blurs from which both sides' colours are carried into the outline, over the narrower one."""


def foreground_colours(pixels: Pixels, alpha: Alpha) -> Pixels:
    """Return the object's own colours (H, W, 3), sRGB, without the background that is mixed in where ``alpha`` < 1.

    pixels: (H, W, 3) sRGB. alpha: (H, W). Where alpha is 1 the photo's pixel stays bit for bit; where it is 0 the
    nearby object's colours are carried on. In linear light, since light is what a lens mixes: both sides' colours are
    blurred in from where they are certain, and the pixel's own deviation from their mixture is added to the object by
    its share (Forte, "Approximate fast foreground colour estimation", ICIP 2021).
    """
    unknown = alpha < 1.0
    if not unknown.any() or not (alpha >= CERTAIN).any():
        return pixels.copy()
    light = bytes_to_linear(pixels)
    own, other = (_carried(light, side) for side in (alpha >= CERTAIN, alpha <= 1.0 - CERTAIN))
    share = alpha[..., None]
    found = own + share * (light - share * own - (1.0 - share) * other)
    found = np.clip(found, 0.0, 1.0)
    return np.where(unknown[..., None], linear_to_bytes(found.astype(np.float32)), pixels)


def _carried(light: NDArray[np.float32], known: Mask) -> NDArray[np.float32]:
    """``light`` (H, W, 3) averaged over ``known`` (H, W) pixels nearby, from the nearest one where none is near."""
    if not known.any():
        return light
    weight = known.astype(np.float32)
    nearest = cv2.distanceTransformWithLabels(
        (~known).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )[1]
    places = np.zeros(int(nearest.max()) + 1, dtype=np.int64)
    places[nearest[known]] = np.flatnonzero(known)
    result = light.reshape(-1, 3)[places[nearest]]
    for sigma in (FAR * 1.5, 1.5):
        total = cv2.GaussianBlur(weight, (0, 0), sigma)
        mean = cv2.GaussianBlur(light * weight[..., None], (0, 0), sigma) / np.maximum(total, 1e-4)[..., None]
        trust = np.clip(total / 0.1, 0.0, 1.0)[..., None]
        result = result + (mean - result) * trust
    return np.asarray(result, dtype=np.float32)


Box = tuple[int, int, int, int]

COARSE = 420
"""Longest side in pixels of the copy on which a model's alpha and the colours are reconciled."""
MARGIN = 0.35
"""Background around a box to learn from, over its longer side."""
BELIEF = 3.0
"""Log odds of a model's alpha of 1: a colour that is e³ times likelier on the other side outweighs it."""


def refine_alpha(
    pixels: Pixels, alpha: NDArray[np.floating], *, box: Box | None = None, keep: Mask | None = None,
    drop: Mask | None = None, others: Mask | None = None,
) -> Alpha:  # fmt: skip
    """Return a model's ``alpha`` (H, W), 0 to 1, corrected by the colours of object and background.

    pixels: (H, W, 3) sRGB. Where model and colours disagree, a cut between both decides on a small copy: a foot that
    the model missed is taken back, ground that it took is dropped. The outline then follows the photo by closed-form
    matting. box: x0, y0, x1, y1 outside of which alpha is 0; keep, drop: (H, W) certain pixels; others: (H, W) other
    objects. An alpha without certain pixels on both sides is returned as it is.
    """
    value = np.clip(np.nan_to_num(np.asarray(alpha, dtype=np.float32)), 0.0, 1.0)
    x0, y0, x1, y1 = box or (0, 0, value.shape[1], value.shape[0])
    margin = MARGIN * max(x1 - x0, y1 - y0)
    window = (
        slice(max(0, round(y0 - margin)), round(y1 + margin)),
        slice(max(0, round(x0 - margin)), round(x1 + margin)),
    )
    if (
        (window[0].start, window[1].start) != (0, 0)
        or window[0].stop < value.shape[0]
        or window[1].stop < value.shape[1]
    ):
        # Only what is around the box matters, and a copy of that is finer than one of the whole photo.
        left, top = window[1].start, window[0].start
        parts = (None if part is None else part[window] for part in (keep, drop, others))
        own, other, taken = parts
        result = np.zeros_like(value)
        result[window] = refine_alpha(
            np.ascontiguousarray(pixels[window]),
            value[window],
            box=(x0 - left, y0 - top, x1 - left, y1 - top),
            keep=own,
            drop=other,
            others=taken,
        )
        return result
    inside = np.zeros(value.shape, dtype=bool)
    inside[y0:y1, x0:x1] = True
    if others is not None:
        inside &= ~others
    value = np.where(inside, value, np.float32(0.0))
    empty = np.zeros(value.shape, dtype=bool)
    own, other = (empty if part is None else part for part in (keep, drop))
    if not (value > 0.5).any() or (value > 0.5).all():
        return value
    hard = _reconciled(pixels, value, inside, own & inside, other, empty if others is None else others)
    if not hard.any():
        return value
    changed = hard != (value > 0.5)
    size = float(np.sqrt(hard.sum()))
    trimap = outline_band(hard, max(3.0, 0.012 * size))
    # Where the model itself is soft there may be hair.
    soft = (value > 0.08) & (value < 0.92) & ~changed & inside
    certain = Trimap(
        own=(trimap.own & ~soft & ~other) | (own & inside), other=((trimap.other & ~soft) | other | ~inside) & ~own
    )
    matte = closed_form_alpha(pixels, certain)
    trust = _apart(pixels, certain, max(6.0, 0.024 * size))
    fallback = np.where(changed, hard.astype(np.float32), value)
    return np.asarray(np.where(certain.unknown, fallback + (matte - fallback) * trust, certain.own), dtype=np.float32)


def _reconciled(pixels: Pixels, value: Alpha, inside: Mask, keep: Mask, drop: Mask, others: Mask) -> Mask:
    """The object (H, W) by the model's alpha and the colours of both sides together."""
    height, width = value.shape
    scale = min(1.0, COARSE / max(height, width))
    size = (max(2, round(width * scale)), max(2, round(height * scale)))
    small = np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    shares = [
        cv2.resize(part.astype(np.float32), size, interpolation=cv2.INTER_AREA)
        for part in (value, inside, keep, drop, others)
    ]
    belief, open_ = np.asarray(shares[0]), shares[1] > 0.5
    own, other, taken = (np.asarray(part > 0.0) for part in shares[2:])
    other &= ~own
    view = crop_around_box(small, (0, 0, *size), taken, keep=own, drop=other)
    kernel = np.ones((3, 3), np.uint8)
    certain = (cv2.erode((belief > 0.9).astype(np.uint8), kernel, borderValue=0) > 0) | own
    beyond = (cv2.erode((belief < 0.05).astype(np.uint8), kernel) > 0) & ~taken & ~own | other
    if certain.sum() < 20 or beyond.sum() < 50:
        return value > 0.5
    features = np.dstack([view.lab, view.texture])
    likely = learn(features[certain], 7).log_likelihood(features[open_])
    ratio = np.full(belief.shape, -LIMIT, dtype=np.float32)
    colour = np.clip(likely - ground_likelihood(view, beyond, open_), -4.0, 4.0)
    ratio[open_] = colour + (2.0 * belief[open_] - 1.0) * BELIEF
    cut = graph_cut(ratio, principal_contrast(view.lab), 4.0, barred=~open_ | other, certain=own & open_)
    cut = touching(cut, certain)
    if cut.sum() < 0.5 * (belief > 0.5).sum():
        # The colours say that most of it is ground: camouflage, so the model knows better.
        return value > 0.5
    # On the copy only what it can resolve was decided; elsewhere the model's own outline is finer.
    kernel = np.ones((3, 3), np.uint8)
    differs = cut != (belief > 0.5)
    thick = cv2.morphologyEx(differs.astype(np.uint8), cv2.MORPH_OPEN, kernel) > 0
    changed = cv2.dilate(touching(differs, thick).astype(np.uint8), kernel)
    large, where = (
        cv2.resize(part.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR) > 0.5
        for part in (cut, changed)
    )
    return np.asarray(np.where(where, large, value > 0.5) & inside)
