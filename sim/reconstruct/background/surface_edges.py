# SPDX-License-Identifier: MIT
"""Edges between surfaces behind a hole: a wall on the floor, a skirting board, a table's or a shelf's edge.

Such an edge is straight, or bends as it is traced beside the hole (``outline_tracing``). It is visible on both sides
and separates different surfaces. The first is accepted only if two surfaces, each with its own smooth light, explain
the colours much better than one. Further ones are lines across which the colour jumps alike on both sides of the hole:
narrow bands, such as a skirting, have no light of their own to be told by.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from .outline_tracing import bend

Mask = NDArray[np.bool_]
Picture = NDArray[np.float32]

COARSE = 40
"""Longer side in pixels of the copy in which lines are tried."""
AROUND = 0.6
"""Margin of the photo around a hole, over the size of the hole."""
STEEPEST = 0.15
"""Steepest slope of a line: steeper ones are corners of walls, where both sides are alike."""
LEAST = 0.08
"""Least visible share on each side of the line."""
GAIN, CLEARLY = 0.2, 0.28
"""Least gain in log likelihood per pixel of two surfaces over one; and the same including the step across the line."""
STEP, STEPS, UNUSUAL = 0.06, 0.8, 2.5
"""Colour difference across a line, in logarithms; share of its points that must show it on either side of the hole; and
the factor over the usual difference."""
MOST_STEP = 0.35
"""Step above which an edge is not more likely."""
LEAST_ERROR = 0.02
"""Residual in logarithms below which surfaces are not distinguished better."""
RIDGE = 1e-3
"""Regularisation of polynomials, relative to the data."""
MOST_THINGS, LEAST_THING = 4, 0.05
"""Most things in a hole around which edges are looked for, and the least size of one over the largest."""
NEAR = 0.35
"""Range beside what hides an edge in which it must be seen and is located, over the width of what hides it."""
FEWEST = 0.05
"""Least width on each side on which it must be seen, over the width of the window."""
PENUMBRA = 12.0
"""Pixels at 1024 inside a shadow's border in which it may still grow darker."""
ALIKE_DIM = 0.25
"""Difference in the share of shadow above which two pixels are not compared."""


@dataclass(frozen=True)
class Edge:
    """A line a x + b y = c in the photo, b > 0, a² + b² = 1, in pixels. bend: (W,) rows by which the edge lies below it
    in each column of the photo, None where it is straight."""

    a: float
    b: float
    c: float
    bend: NDArray[np.float32] | None = field(default=None, compare=False)

    def height(self, shape: tuple[int, int]) -> NDArray[np.float32]:
        """Return the signed distance (H, W) of the pixels' centres in pixels, positive below; from a bent edge along
        the line's normal, to first order."""
        y, x = np.ogrid[: shape[0], : shape[1]]
        if self.bend is not None:
            y = y - self.bend
        return np.asarray(self.a * (x + 0.5) + self.b * (y + 0.5) - self.c, dtype=np.float32)

    def below(self, shape: tuple[int, int]) -> Mask:
        """Return the pixels (H, W) below."""
        return np.asarray(self.height(shape) > 0.0)


def edges_behind(logs: Picture, part: Mask, hidden: Mask, shaded: Mask | None = None) -> list[Edge]:
    """Return edges that pass behind ``part`` (H, W), at most ``MOST_EDGES``, none of which cross there.

    They are looked for around what hides them. A shadow does not: an edge is seen in it, and the hole that it makes is
    often so large that its surroundings are all of the photo, whose lines are not straight from side to side. Its
    border counts as no edge.

    logs: (H, W, 3) logarithms of the photo's values, valid where not ``hidden``. shaded: (H, W) pixels that are seen in
    shadow.
    """
    dark = np.zeros_like(part) if shaded is None else shaded & ~hidden
    things = _things(part, hidden)
    if dark.any():
        side = 2 * max(1, round(PENUMBRA * max(part.shape) / 1024.0)) + 1
        deep = cv2.erode((dark | hidden).astype(np.uint8), np.ones((side, side), np.uint8)) > 0
        hidden, dark = hidden | (dark & ~deep), dark & deep
    for index, thing in enumerate(things):
        edges = _edges_near(logs, thing, hidden, dark, part)
        # One that passes behind a larger thing as well would have been found around that.
        edges = [edge for edge in edges if not any(_passes_behind(edge, larger) for larger in things[:index])]
        if edges:
            return edges
    return []


def _passes_behind(edge: Edge, thing: Mask) -> bool:
    """Whether ``thing`` (H, W) has pixels on both sides of ``edge``."""
    below = edge.below(thing.shape)[thing]
    return bool(below.any() and not below.all())


def _things(part: Mask, hidden: Mask) -> list[Mask]:
    """Return what hides edges in ``part``, largest first; all of it where nothing does."""
    covered = part & hidden
    count, labels, stats, _ = cv2.connectedComponentsWithStats(covered.astype(np.uint8), connectivity=8)
    if count < 2:
        return [part]
    areas = stats[1:count, cv2.CC_STAT_AREA]
    order = np.argsort(-areas, kind="stable")[:MOST_THINGS]
    return [np.asarray(labels == index + 1) for index in order if areas[index] >= LEAST_THING * areas.max()]


def _edges_near(logs: Picture, thing: Mask, hidden: Mask, shade: Mask, part: Mask) -> list[Edge]:
    """Edges that pass behind ``thing`` (H, W), a thing in the hole ``part``."""
    rows, columns = _window(thing)
    known, inner, dark = ~hidden[rows, columns], thing[rows, columns], shade[rows, columns]
    values = np.where(known[..., None], logs[rows, columns], 0.0).astype(np.float32)
    fine = _copy(values, known, inner, dark, FINE)
    steps = _steps(*fine)
    first = _best_line(*_copy(values, known, inner, dark, COARSE), steps)
    found: list[tuple[float, float]] = []
    if first is not None:
        ratio = known.shape[0] / fine[0].shape[0]
        found.append(_settled(values, known, inner, (first[0] * ratio, first[1] * ratio), first[2], ratio))
    strongest = 0.0 if first is None else float(np.linalg.norm(first[2]))
    found = _further_lines(values, known, inner, dark, found, strongest)
    width = columns.stop - columns.start
    bent = None
    # The lines of a skirting or a shelf are straight, as there are several.
    if first is not None and len(found) == 1:
        bent = bend(values, known & ~part[rows, columns], inner, found[0], first[2])
        if bent is not None:
            bent = np.pad(bent, (columns.start, hidden.shape[1] - columns.stop), mode="edge")
    edges = []
    for left, right in found:
        slope = (right - left) / width
        length = float(np.hypot(slope, 1.0))
        a, b = -slope / length, 1.0 / length
        edges.append(Edge(a=a, b=b, c=a * columns.start + b * (left + rows.start), bend=bent))
    return edges


def _copy(values: Picture, known: Mask, inner: Mask, dark: Mask, side: int) -> tuple[Picture, Mask, Mask, Picture]:
    """A copy (h, w, 3) of ``values`` whose longer side has ``side`` pixels, with what is known, the hole, and how much
    of each pixel is in shadow (h, w)."""
    scale = min(1.0, side / max(known.shape))
    size = (max(8, round(known.shape[1] * scale)), max(8, round(known.shape[0] * scale)))
    share, cut, dim = (
        cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA) for mask in (known, inner, dark)
    )
    sums = cv2.resize(values, size, interpolation=cv2.INTER_AREA)
    small = np.asarray(sums / np.maximum(share, 1e-6)[..., None], dtype=np.float32)
    return small, np.asarray(share > 0.9), np.asarray(cut > 0.5), np.asarray(dim, dtype=np.float32)


MOST_EDGES = 4
FINE = 110
"""Longer side in pixels of the copy in which further lines are looked for."""
BAND = 2
"""Pixels of that copy on either side of a line whose mean colours are compared: a joint is no edge."""
STEEP = 0.35
"""Steepest slope of a further line."""
BESIDE = 0.8
"""Range beside the hole in which it is looked at, over the hole's width."""
LIKE, EVEN = 0.85, 0.8
"""Least cosine between the jumps on either side of the hole; least share of the columns that jump by half the mean."""
SPACE = 2.5
"""Least distance of two lines, in pixels of that copy."""
WEAKEST = 0.25
"""Least jump of a line over the strongest one: the lines of wood are weaker than the edges of a skirting on it."""
NEAR_FIRST = 0.12
"""Distance below the first edge, over the window's height, up to which further ones are looked for: below it is the
ground, whose lines are its pattern."""


def _further_lines(
    values: Picture, known: Mask, inner: Mask, dark: Mask, found: list[tuple[float, float]], strongest: float
) -> list[tuple[float, float]]:
    """``found`` and more lines, by the rows where they enter the window at the left and leave it at the right.

    Across each, the mean colours of narrow bands differ alike on both sides of the hole. strongest: jump of those
    found.
    """
    small, seen, cut, dim = _copy(values, known, inner, dark, FINE)
    height, width = seen.shape
    ratio = known.shape[0] / height
    rows, columns = np.flatnonzero(cut.any(axis=1)), np.flatnonzero(cut.any(axis=0))
    if not len(rows) or height < 4 * BAND:
        return found
    over, under, valid = _bands(small, seen, dim)
    usual = float(np.median(np.linalg.norm(under - over, axis=-1)[valid])) if valid.any() else 0.0
    least = max(2.0 * STEP, UNUSUAL * usual)
    x = np.flatnonzero(_beside(cut, BESIDE))
    ends = np.arange(0.0, height + 0.5, 1.0)
    left, right = (grid.ravel() for grid in np.meshgrid(ends, ends, indexing="ij"))
    fits = np.abs(right - left) <= STEEP * width
    left, right = left[fits], right[fits]
    y = left[:, None] + (right - left)[:, None] * (x + 0.5) / width
    line = np.clip(np.rint(y).astype(int), 0, height)
    jump = np.where(valid[line, x][..., None], (under - over)[line, x], 0.0)
    usable = valid[line, x] & ~cut.any(axis=0)[x]
    strength = np.full(len(left), np.inf)
    means = []
    for side in (x < columns[0], x > columns[-1]):
        count = usable[:, side].sum(axis=1)
        mean = (jump[:, side] * usable[:, side, None]).sum(axis=1) / np.maximum(count, 1)[:, None]
        size = np.linalg.norm(mean, axis=1)
        along = np.einsum("nxc,nc->nx", jump[:, side], mean / np.maximum(size, 1e-9)[:, None])
        alike = ((along > 0.5 * size[:, None]) & usable[:, side]).sum(axis=1) / np.maximum(count, 1)
        good = (count >= max(4, 0.5 * int(side.sum()))) & (alike >= EVEN) & (size >= least)
        strength = np.minimum(strength, np.where(good, size, 0.0))
        means.append(mean)
    cosine = (means[0] * means[1]).sum(axis=1) / np.maximum(
        np.linalg.norm(means[0], axis=1) * np.linalg.norm(means[1], axis=1), 1e-9
    )
    middle = (columns[0] + columns[-1] + 1) / 2.0
    at = left + (right - left) * middle / width
    strength[(cosine < LIKE) | (at < rows[0] + 1) | (at > rows[-1])] = 0.0
    if found:
        strength[at > sum(found[0]) / 2.0 / ratio + NEAR_FIRST * height] = 0.0
    taken = [(a / ratio, b / ratio) for a, b in found]
    result = list(found)
    bounds = np.array([columns[0], columns[-1] + 1.0]) / width
    while len(result) < MOST_EDGES:
        for a, b in taken:
            apart = (left - a)[:, None] + ((right - left) - (b - a))[:, None] * bounds
            strength[(np.abs(apart).min(axis=1) < SPACE) | (apart[:, 0] * apart[:, 1] <= 0.0)] = 0.0
        index = int(np.argmax(strength))
        if strength[index] <= WEAKEST * strongest:
            break
        strongest = max(strongest, float(strength[index]))
        taken.append((float(left[index]), float(right[index])))
        step = (means[0][index] + means[1][index]).astype(np.float64) / 2.0
        ends_here = (float(left[index]) * ratio, float(right[index]) * ratio)
        result.append(_settled(values, known, inner, ends_here, step, ratio))
    return result


def _bands(small: Picture, seen: Mask, dim: Picture) -> tuple[Picture, Picture, Mask]:
    """Mean colours (h + 1, w, 3) of the bands over and under each line between rows, and whether both are known and
    alike in shadow."""
    height, width = seen.shape
    total = np.concatenate([np.zeros((1, width, 3)), np.cumsum(np.where(seen[..., None], small, 0.0), axis=0)])
    count = np.concatenate([np.zeros((1, width)), np.cumsum(seen, axis=0)])
    rows = np.arange(height + 1)
    top, bottom = np.maximum(rows - BAND, 0), np.minimum(rows + BAND, height)
    full = (count[rows] - count[top] == BAND) & (count[bottom] - count[rows] == BAND)
    full &= np.abs(dim[np.maximum(rows - 1, 0)] - dim[np.minimum(rows, height - 1)]) < ALIKE_DIM
    over, under = (total[rows] - total[top]) / BAND, (total[bottom] - total[rows]) / BAND
    return over.astype(np.float32), under.astype(np.float32), np.asarray(full)


def _window(part: Mask) -> tuple[slice, slice]:
    rows, columns = np.flatnonzero(part.any(axis=1)), np.flatnonzero(part.any(axis=0))
    room = round(AROUND * max(np.ptp(rows), np.ptp(columns))) + 8
    return (
        slice(max(0, int(rows[0]) - room), min(part.shape[0], int(rows[-1]) + 1 + room)),
        slice(max(0, int(columns[0]) - room), min(part.shape[1], int(columns[-1]) + 1 + room)),
    )


def _best_line(
    small: Picture, known: Mask, cut: Mask, dim: Picture, steps: Steps
) -> tuple[float, float, NDArray[np.float64]] | None:
    """Rows at which the best of ``steps`` enters at the left and leaves at the right, and the colour step down across
    it.

    Surfaces are compared on this copy (h, w, 3), which is coarser than that of ``steps``.
    """
    height, width = known.shape
    y, x = np.meshgrid(np.linspace(-1, 1, height), np.linspace(-1, 1, width), indexing="ij")
    terms = [np.ones_like(x), x, y, x * y, x * x, y * y]
    if dim[known].any():
        # A surface's light is smooth but for its shadow.
        terms.append(dim.astype(np.float64))
    basis = np.stack(terms, axis=-1)[known]
    target = small[known].astype(np.float64)
    if len(basis) < 60 or not cut.any():
        return None
    at_y, at_x = (axis + 0.5 for axis in np.nonzero(known))
    cut_y, cut_x = (axis + 0.5 for axis in np.nonzero(cut))
    # Weak regularisation, so that a side of few pixels is not explained by an oscillating polynomial.
    ridge = RIDGE * len(basis) * np.diag([0.0] + [1.0] * (len(terms) - 1))
    powers = np.square(target).sum(axis=1)
    squares, products, power = basis.T @ basis, basis.T @ target, float(powers.sum())

    def left_over(squares: NDArray[np.float64], products: NDArray[np.float64]) -> float:
        solved = np.linalg.solve(squares + ridge + 1e-9 * np.eye(len(terms)), products)
        return -float((products * solved).sum())

    def cost(error: float, count: int) -> float:
        """Negative log likelihood of ``count`` pixels with squared ``error`` in total."""
        return 0.5 * count * float(np.log(max(error, 0.0) / count + 3 * LEAST_ERROR**2))

    changes = steps.strongest(height)
    whole = cost(power + left_over(squares, products), len(basis))
    best: tuple[float, float, float] | None = None
    for left in range(1, height):
        for right in range(1, height):
            if abs(right - left) > STEEPEST * width or changes[left, right] < 0.0:
                continue
            line = left + (right - left) / width * cut_x
            behind = float((cut_y > line).mean())
            if not 0.03 < behind < 0.97:
                continue
            below = at_y > left + (right - left) / width * at_x
            count = int(below.sum())
            if min(count, len(below) - count) < LEAST * len(below):
                continue
            part = basis[below]
            mine, my = part.T @ part, part.T @ target[below]
            my_power = powers[below].sum()
            # Each surface has its own variance: a table is plain, the room behind it is not.
            error = cost(my_power + left_over(mine, my), count)
            error += cost(power - my_power + left_over(squares - mine, products - my), len(below) - count)
            # Distant edges appear nearly level.
            if whole - error < GAIN * len(basis):
                continue
            score = error + (abs(right - left) / width - float(changes[left, right])) * len(basis)
            if best is None or score < best[0]:
                best = (score, float(left), float(right))
    if best is None or whole - best[0] < CLEARLY * len(basis):
        return None
    distance = at_y - (best[1] + (best[2] - best[1]) / width * at_x)
    near_below, near_above = (distance > 0.5) & (distance < 4), (distance < -0.5) & (distance > -4)
    if not near_below.any() or not near_above.any():
        return None
    ends = steps.within(height, int(best[1]), int(best[2]))
    return *ends, target[near_below].mean(axis=0) - target[near_above].mean(axis=0)


def _beside(cut: Mask, share: float) -> Mask:
    """Columns (w,) of the hole ``cut`` (h, w) and ``share`` of its width beside it.

    Farther away an edge may end, or bend in a wide lens.
    """
    columns = np.flatnonzero(cut.any(axis=0))
    reach = max(4, round(share * (columns[-1] + 1 - columns[0])))
    at = np.arange(cut.shape[1])
    return np.asarray((at >= columns[0] - reach) & (at <= columns[-1] + reach))


@dataclass(frozen=True, eq=False)
class Steps:
    """Lines (n,) by the rows where they enter and leave a copy of height ``height``, and the colour change (n,) across
    each, on the side of the hole where it is smaller."""

    left: NDArray[np.float64]
    right: NDArray[np.float64]
    change: NDArray[np.float64]
    height: int

    def _cells(self, height: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        ratio = height / self.height
        return np.rint(self.left * ratio).astype(np.intp), np.rint(self.right * ratio).astype(np.intp)

    def strongest(self, height: int) -> NDArray[np.float64]:
        """The largest change (height + 1, height + 1) by the rows of a copy of ``height``; -1 without a line."""
        result = np.full((height + 1, height + 1), -1.0)
        np.maximum.at(result, self._cells(height), self.change)
        return result

    def within(self, height: int, left: int, right: int) -> tuple[float, float]:
        """The line of the largest change that ``strongest`` counts there."""
        rows = self._cells(height)
        index = int(np.argmax(np.where((rows[0] == left) & (rows[1] == right), self.change, -1.0)))
        return float(self.left[index]), float(self.right[index])


def _steps(small: Picture, known: Mask, cut: Mask, dim: Picture) -> Steps:
    """Lines across which the colours change on both sides of the hole ``cut`` (h, w)."""
    height, width = known.shape
    left, right = (grid.ravel() for grid in np.meshgrid(np.arange(height), np.arange(height), indexing="ij"))
    level = np.abs(right - left) <= STEEPEST * width
    left, right = left[level].astype(np.float64), right[level].astype(np.float64)
    near = np.flatnonzero(_beside(cut, NEAR))
    middle = float(np.nonzero(cut)[1].mean()) + 0.5
    x = near + 0.5
    y = left[:, None] + (right - left)[:, None] / width * x
    above, below = np.floor(y - 1.0).astype(int), np.floor(y + 1.0).astype(int)
    inside = (above >= 0) & (below < height)
    above, below = np.clip(above, 0, height - 1), np.clip(below, 0, height - 1)
    seen = inside & known[above, near] & known[below, near]
    seen &= np.abs(dim[above, near] - dim[below, near]) < ALIKE_DIM
    # Changes that occur everywhere, such as wood grain, separate nothing.
    both = known[2:] & known[:-2]
    usual = np.median(np.linalg.norm(small[2:] - small[:-2], axis=-1)[both]) if both.any() else 0.0
    change = np.where(seen[..., None], small[below, near] - small[above, near], 0.0)
    step = np.linalg.norm(change, axis=-1) > max(STEP, 1.2 * usual)
    least = np.full(len(left), MOST_STEP)
    some = np.zeros(len(left), dtype=bool)
    means = []
    fewest = max(3, round(FEWEST * width))
    for side in (x < middle, x >= middle):
        count = seen[:, side].sum(axis=1)
        share = step[:, side].sum(axis=1) / np.maximum(count, 1)
        # Steps of both signs along a line, as over spots, are not an edge either.
        means.append(change[:, side].sum(axis=1) / np.maximum(count, 1)[:, None])
        mean = np.linalg.norm(means[-1], axis=-1)
        # A hole that reaches the border of the picture is open there.
        open_side = int((side & ~cut.any(axis=0)[near]).sum()) < fewest
        enough = count >= fewest
        clear = enough & (share >= STEPS) & (mean >= max(STEP, UNUSUAL * usual))
        least = np.minimum(least, np.where(clear, mean, np.where(open_side & ~enough, least, -1.0)))
        some |= clear
    # A line that is brighter below on one side of the hole and darker on the other, as boards and mirror images are,
    # is an edge only if the surfaces alone say so.
    least = np.where((means[0] * means[1]).sum(axis=1) < 0.0, np.minimum(least, 0.0), least)
    kept = some & (least >= 0.0)
    return Steps(left[kept], right[kept], least[kept], height)


def _settled(
    logs: Picture, known: Mask, cut: Mask, ends: tuple[float, float], step: NDArray[np.float64], ratio: float
) -> tuple[float, float]:
    """``ends`` refined to where the colours change by ``step`` most suddenly beside the hole ``cut``."""
    size = max(float(np.linalg.norm(step)), 1e-6)
    plane = np.asarray(logs @ (step / size).astype(np.float32), dtype=np.float32)
    usable = known & _beside(cut, NEAR)
    seen = cv2.erode(usable.astype(np.uint8), np.ones((5, 5), np.uint8)).astype(np.float32)
    x = np.linspace(0.5, known.shape[1] - 0.5, min(known.shape[1], 400))
    # A wide comparison cannot locate a sharp step within it: the last pass is narrow.
    for spacing, reach in ((max(ratio / 3.0, 0.5), 1.5), (max(ratio / 12.0, 0.25), 1.5), (0.25, 0.5)):
        moves = spacing * np.arange(-5, 6)
        shift = np.stack(np.meshgrid(moves, moves, indexing="ij"), axis=-1).reshape(-1, 2)
        first, last = ends[0] + shift[:, :1], ends[1] + shift[:, 1:]
        y = first + (last - first) * x / known.shape[1]
        across = np.broadcast_to(x, y.shape).astype(np.float32) - np.float32(0.5)

        def at(image: Picture, rows: NDArray[np.float64], across: NDArray[np.float32] = across) -> Picture:
            return np.asarray(cv2.remap(image, across, (rows - 0.5).astype(np.float32), cv2.INTER_LINEAR))

        weight = np.minimum(at(seen, y - 3.0), at(seen, y + 3.0))
        change = np.clip(at(plane, y + reach) - at(plane, y - reach), -size, size)
        total = weight.sum(axis=1)
        score = np.where(total > 0.05 * len(x), (weight * change).sum(axis=1) / np.maximum(total, 1e-6), -np.inf)
        # Break ties by the smallest move.
        score = score - 1e-6 * np.abs(shift).sum(axis=1)
        index = int(np.argmax(score))
        if np.isfinite(score[index]):
            ends = (float(first[index, 0]), float(last[index, 0]))
    return ends
