# SPDX-License-Identifier: MIT
"""Where the skin of matter that flows no longer holds: its particles are shown there instead."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

TORN_STRETCH = 1.6
"""An edge of the skin that is longer than this, over its length at rest, has nothing beneath it any more."""

TORN_SHARE = 0.01
"""Share of the edges from which on a skin counts as torn."""


def edges(faces: NDArray[np.integer]) -> NDArray[np.int64]:
    """The edges (E, 2) of triangles (F, 3), each once."""
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).astype(np.int64)
    ends.sort(axis=1)
    return np.unique(ends, axis=0)


def lengths(vertices: NDArray[np.floating], ends: NDArray[np.integer]) -> NDArray[np.float64]:
    """Lengths (E,) of the edges ``ends`` (E, 2) with the vertices (V, 3) at ``vertices``."""
    return np.linalg.norm(np.asarray(vertices, dtype=np.float64)[ends[:, 1]] - vertices[ends[:, 0]], axis=1)


def first_torn(samples: Iterable[NDArray[np.floating]], faces: NDArray[np.integer]) -> int | None:
    """Index of the first of ``samples`` (V, 3) in which the skin with ``faces`` (F, 3) is torn; None: it holds.

    The first sample is the skin at rest. Samples are taken one by one, and none after the answer.
    """
    ends = edges(faces)
    rest: NDArray[np.float64] | None = None
    for index, vertices in enumerate(samples):
        now = lengths(vertices, ends)
        if rest is None:
            rest = np.maximum(now, 1e-12)
        elif len(ends) and float(np.mean(now > TORN_STRETCH * rest)) > TORN_SHARE:
            return index
    return None
