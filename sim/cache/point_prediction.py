# SPDX-License-Identifier: MIT
"""Numbers of points, predicted from those of points around them: what varies smoothly over a body takes few bits.

The points are taken in levels, from one for the whole body to all of them, by cells of half the size each time; a point
is predicted from up to eight of the levels before, by weights that reproduce affine functions (moving least squares,
Levin 1998, doi:10.1090/S0025-5718-98-00974-0). Who predicts whom follows from the points alone, by integers and single
rounded operations, so that every machine finds the same.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

NEIGHBOURS = 8
_ONE = 4096
"""Weights are whole numbers over this."""
_STIFF = 0.03
"""Share of the neighbours' spread that is added in every direction, since those of a flat patch have none across it."""
_CHUNK = 1 << 16
_AROUND = np.array([(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1)], np.int64)


@dataclass(frozen=True)
class PointPrediction:
    """``order`` (V,): the points from coarse to fine. ``weights``: for each level but the first, a sparse matrix (new
    points, points before) of whole numbers."""

    order: NDArray[np.int64]
    weights: Sequence[Any]

    def surprises(self, values: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return (V, 3), in ``order``, ``values`` (V, 3) less what the points before say of them."""
        values = values[self.order]
        found = values.copy()
        for weights in self.weights:
            before, new = weights.shape[1], weights.shape[0]
            found[before : before + new] -= _rounded(weights @ values[:before])
        return found

    def values(self, surprises: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the values (V, 3) that have these ``surprises``."""
        found = surprises.copy()
        for weights in self.weights:
            before, new = weights.shape[1], weights.shape[0]
            found[before : before + new] += _rounded(weights @ found[:before])
        values = np.empty_like(found)
        values[self.order] = found
        return values


def point_prediction(places: NDArray[np.int64]) -> PointPrediction:
    """Return the prediction among points at ``places`` (V, 3), whole numbers from 0 below 2²⁰."""
    from scipy import sparse

    size = 1 << int(places.max(initial=0)).bit_length()
    used = np.zeros(len(places), bool)
    order, weights = np.empty(0, np.int64), []
    while len(order) < len(places):
        free = np.flatnonzero(~used)
        if size > 0:
            # One of each cell that has none yet. Cells lie within those before, so a cell has never more than one.
            cells, first = np.unique(_keys(places[free] // size), return_index=True)
            new = np.sort(free[first[~np.isin(cells, _keys(places[order] // size))]])
        else:
            new = free
        if len(order) and len(new):
            columns, numbers = _level(places, order, new, max(2 * size, 1))
            rows = np.repeat(np.arange(len(new)), columns.shape[1])
            entries = (numbers.ravel(), (rows, columns.ravel()))
            weights.append(sparse.csr_matrix(entries, shape=(len(new), len(order)), dtype=np.int64))
        order = np.concatenate([order, new])
        used[new] = True
        size //= 2
    return PointPrediction(order=order, weights=tuple(weights))


def _keys(cells: NDArray[np.int64]) -> NDArray[np.int64]:
    """One number a cell; those beside the points are at -1 and 2²⁰ at most."""
    x, y, z = (cells.T + 1).astype(np.int64)
    return np.asarray((x << 42) + (y << 21) + z)


def _level(
    places: NDArray[np.int64], order: NDArray[np.int64], new: NDArray[np.int64], size: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Positions in ``order`` (N, K) of the points in the cells around each of ``new``, the nearest ones, and their
    weights (N, K), which are 0 where there are fewer."""
    keys = _keys(places[order] // size)
    by_key = np.argsort(keys, kind="stable")
    sorted_keys, parts = keys[by_key], []
    for chunk in (new[at : at + _CHUNK] for at in range(0, len(new), _CHUNK)):
        cells = (places[chunk] // size)[:, None] + _AROUND
        wanted = _keys(cells.reshape(-1, 3)).reshape(len(chunk), -1)
        columns = by_key[np.searchsorted(sorted_keys, wanted).clip(max=len(keys) - 1)]
        there = keys[columns] == wanted
        away = places[order[columns]] - places[chunk][:, None]
        far = np.where(there, (away**2).sum(axis=2), np.int64(1) << 60)
        # Stable, so that of equally far ones the one in the earlier cell comes first on every machine.
        nearest = np.argsort(far, axis=1, kind="stable")[:, :NEIGHBOURS]
        columns, there = np.take_along_axis(columns, nearest, 1), np.take_along_axis(there, nearest, 1)
        away = np.take_along_axis(away, nearest[:, :, None], 1).astype(np.float64)
        parts.append((np.where(there, columns, 0), _weights(away, there)))
    found, numbers = (np.concatenate(each) for each in zip(*parts, strict=True))
    return found, numbers


def _weights(away: NDArray[np.float64], there: NDArray[np.bool_]) -> NDArray[np.int64]:
    """(N, K) whole numbers that sum to ``_ONE``, for neighbours ``away`` (N, K, 3) from the point, where ``there``."""
    x, y, z = (away[:, :, axis] for axis in range(3))
    near = np.where(there, 1.0 / (x * x + y * y + z * z + 1.0), 0.0)
    all_of = _total(near)
    middle = [_total(near * each) / all_of for each in (x, y, z)]
    x, y, z = (each - centre[:, None] for each, centre in zip((x, y, z), middle, strict=True))
    xx, yy, zz = (_total(near * each * each) for each in (x, y, z))
    xy, xz, yz = _total(near * x * y), _total(near * x * z), _total(near * y * z)
    # Lone neighbours have no spread; any positive number then gives their plain mean.
    more = _STIFF * (xx + yy + zz) + 1e-9
    xx, yy, zz = xx + more, yy + more, zz + more
    minors = (yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy)
    determinant = xx * minors[0] + xy * minors[1] + xz * minors[2]
    inverse = (
        minors,
        (minors[1], xx * zz - xz * xz, xy * xz - xx * yz),
        (minors[2], xy * xz - xx * yz, xx * yy - xy * xy),
    )
    slopes = [-(row[0] * middle[0] + row[1] * middle[1] + row[2] * middle[2]) / determinant for row in inverse]
    tilt = x * slopes[0][:, None] + y * slopes[1][:, None] + z * slopes[2][:, None]
    share = near * (1.0 / all_of[:, None] + tilt)
    numbers = np.rint(share.clip(-1.0, 2.0) * _ONE).astype(np.int64)
    numbers[:, 0] += _ONE - numbers.sum(axis=1)
    return numbers


def _total(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sums over the neighbours, one by one: a library's own sum may add in another order elsewhere."""
    found = values[:, 0].copy()
    for column in values.T[1:]:
        found += column
    return found


def _rounded(sums: NDArray[np.int64]) -> NDArray[np.int64]:
    return np.asarray((sums + _ONE // 2) >> 12)
