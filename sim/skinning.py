# SPDX-License-Identifier: MIT
"""Mesh vertices that follow particles, by weights and local deformation gradients; where a skin is torn.

At rest a vertex at X is bound to its k nearest particles X_i with smooth, compact weights w_i. Later each of them
predicts the vertex, p_i = x_i + F_i (X − X_i), and the vertex is their weighted mean. The prediction is exact for every
affine motion, so texture and edges stay smooth, and at rest it gives X back to rounding.

A particle that has flown off (a floater) or whose F is broken predicts something that its neighbours do not. Such
predictions are faded out by Tukey's biweight about the neighbours' median, so they never drag a vertex.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from .errors import InputError

Array = NDArray[np.float64]

OUTLIER_SPACINGS = 1.5
"""Predictions farther than this many local particle spacings from the median of their neighbours count nothing.

In a smooth deformation predictions differ by second-order terms, a small part of the spacing, whereas a particle
that has lost its neighbours is at least one spacing away from where they say it is."""

LEAST_VOLUME = 1e-9
"""Volume over that at rest below which a deformation gradient is taken for broken."""


@dataclass(frozen=True)
class Binding:
    """Particles that carry each vertex, with weights.

    particles: (V, k) indices, nearest first.
    weights: (V, k) non-negative, rows sum to 1.
    offsets: (V, k, 3) rest offsets X − X_i in metres.
    spacing: (V,) local particle spacing in metres.
    rest: (V, 3) rest positions of the vertices in metres.
    """

    particles: NDArray[np.int64]
    weights: Array
    offsets: Array
    spacing: Array
    rest: Array

    def rows(self, rows: NDArray[np.integer] | slice) -> Binding:
        """Return the binding of the vertices ``rows`` alone."""
        return Binding(**{part.name: getattr(self, part.name)[rows] for part in fields(self)})


def bind(vertices: NDArray[np.floating], particles: NDArray[np.floating], *, neighbours: int = 12) -> Binding:
    """Bind rest ``vertices`` (V, 3) to rest ``particles`` (N, 3), both in world metres.

    neighbours: how many particles carry a vertex, 4 to 64; more is smoother, fewer follows detail.
    Raises InputError when there are fewer particles than 4 or anything is not finite.
    """
    # Late: inside Blender ``compact_weights`` is enough, and scipy may be missing there.
    from scipy.spatial import cKDTree

    rest: Array = np.array(vertices, dtype=np.float64)
    particles = np.asarray(particles, dtype=np.float64)
    if len(particles) < 4:
        raise InputError(f"skinning: {len(particles)} particles cannot carry a mesh; choose a finer quality")
    if not (np.isfinite(rest).all() and np.isfinite(particles).all()):
        raise InputError("skinning: vertices or particles are not finite")
    count = min(neighbours, len(particles) - 1)
    distance, index = cKDTree(particles).query(rest, k=count + 1)
    index = index[:, :-1].astype(np.int64)
    # k particles fill about a ball that reaches to the first one left out.
    spacing = np.maximum(distance[:, -1], 1e-12) * (4.0 / 3.0 * np.pi / count) ** (1.0 / 3.0)
    return Binding(
        particles=index,
        weights=compact_weights(distance),
        offsets=rest[:, None, :] - particles[index],
        spacing=spacing,
        rest=rest,
    )


def compact_weights(distance: Array) -> Array:
    """Return weights (V, k) of k neighbours from the sorted distances (V, k + 1) to them and to the first one left out.

    That one sets the support: weights vanish where the set of neighbours changes, which keeps them continuous along
    the surface. Rows sum to 1.
    """
    support = np.maximum(distance[:, -1:], 1e-12)
    weights = (1.0 - np.minimum(distance[:, :-1] / support, 1.0) ** 2) ** 3 + 1e-9
    return weights / weights.sum(axis=1, keepdims=True)


def deform(
    binding: Binding,
    positions: NDArray[np.floating],
    gradients: NDArray[np.floating],
    *,
    keep: NDArray[np.bool_] | None = None,
) -> Array:
    """Return vertex positions (V, 3) for particle ``positions`` (N, 3) and deformation ``gradients`` (N, 3, 3), metres.

    keep: (V, k) which particles carry each vertex at all; None: all of them. Particles that are not finite count as
    floaters. A vertex all of whose particles are lost keeps its rest place.
    """
    return _votes(binding, positions, gradients, keep).places(binding)


def deform_locally(
    binding: Binding, positions: NDArray[np.floating], gradients: NDArray[np.floating]
) -> tuple[Array, Array]:
    """Return the vertices (V, 3) as ``deform`` does, and the deformation gradient F (V, 3, 3) around each.

    F is the mean of those particles' gradients by which the vertex is placed; gradients that are not finite or inverted
    (det F ≤ 0) do not count. It is exact for affine motion. Where none counts, or their mean is inverted, F is that of
    the heaviest sound one, and the identity where there is none.
    """
    votes = _votes(binding, positions, gradients)
    f = np.asarray(gradients, dtype=np.float64)[binding.particles]
    sound = np.isfinite(f).all(axis=(2, 3))
    f = np.where(sound[..., None, None], f, np.eye(3))
    sound &= np.linalg.det(f) > LEAST_VOLUME
    weights = np.where(sound, votes.robust, 0.0)
    total = weights.sum(axis=1)
    mean = np.einsum("vk,vkij->vij", weights / np.maximum(total, 1e-6)[:, None], f)
    bad = (total < 1e-6) | ~(np.linalg.det(mean) > LEAST_VOLUME)
    # Without agreement: the nearest sound particle (neighbours are sorted by distance).
    row = np.flatnonzero(bad)
    heaviest = np.where(sound[row], binding.weights[row], -1.0).argmax(axis=1)
    mean[row] = np.where(sound[row].any(axis=1)[:, None, None], f[row, heaviest], np.eye(3))
    return votes.places(binding), mean


@dataclass(frozen=True)
class _Votes:
    """Predictions of particles for their vertices. predicted: (V, k, 3); valid: (V, k), finite; robust: (V, k) weights
    without those of floaters; centre: (V, 3) the median of what is predicted."""

    predicted: Array
    valid: NDArray[np.bool_]
    robust: Array
    centre: Array

    def places(self, binding: Binding) -> Array:
        """Vertex positions (V, 3)."""
        total = self.robust.sum(axis=1, keepdims=True)
        # Where predictions disagree entirely (torn material) the median itself is the best estimate.
        torn = total[:, 0] < 1e-6
        mean = np.einsum("vk,vki->vi", self.robust / np.maximum(total, 1e-6), self.predicted)
        mean[torn] = self.centre[torn]
        lost = ~self.valid.any(axis=1)
        mean[lost] = binding.rest[lost]
        return mean


def _votes(
    binding: Binding,
    positions: NDArray[np.floating],
    gradients: NDArray[np.floating],
    keep: NDArray[np.bool_] | None = None,
) -> _Votes:
    x = np.asarray(positions, dtype=np.float64)[binding.particles]
    f = np.asarray(gradients, dtype=np.float64)[binding.particles]
    predicted = x + np.einsum("vkij,vkj->vki", f, binding.offsets)
    valid = np.isfinite(predicted).all(axis=2)
    if keep is not None:
        valid &= keep
    weights = np.where(valid, binding.weights, 0.0)
    predicted = np.where(valid[..., None], predicted, binding.rest[:, None, :])
    centre = _median(predicted, valid)
    distance = np.linalg.norm(predicted - centre[:, None, :], axis=2) / (OUTLIER_SPACINGS * binding.spacing[:, None])
    robust = weights * np.where(distance < 1.0, (1.0 - np.minimum(distance, 1.0) ** 2) ** 2, 0.0)
    return _Votes(predicted, valid, robust, centre)


def _median(values: Array, valid: NDArray[np.bool_]) -> Array:
    """Median over axis 1 of the ``valid`` (V, k) entries of ``values`` (V, k, 3), one coordinate at a time.

    It is not weighted, because a floater that happens to be a vertex's nearest particle would outvote the rest.
    """
    ordered = np.sort(np.where(valid[..., None], values, np.inf), axis=1)
    middle = np.maximum(valid.sum(axis=1) - 1, 0) // 2
    median = np.take_along_axis(ordered, middle[:, None, None], axis=1)[:, 0, :]
    return np.where(np.isfinite(median), median, 0.0)


TORN_STRETCH = 1.6
"""An edge of the skin that is longer than this, over its length at rest, has nothing beneath it any more."""

TORN_SHARE = 0.01
"""Share of the edges from which on a skin counts as torn."""


def edges(faces: NDArray[np.integer]) -> NDArray[np.int64]:
    """Return the edges (E, 2) of triangles (F, 3), each once."""
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).astype(np.int64)
    ends.sort(axis=1)
    return np.unique(ends, axis=0)


def lengths(vertices: NDArray[np.floating], ends: NDArray[np.integer]) -> NDArray[np.float64]:
    """Return the lengths (E,) of the edges ``ends`` (E, 2) with the vertices (V, 3) at ``vertices``."""
    return np.linalg.norm(np.asarray(vertices, dtype=np.float64)[ends[:, 1]] - vertices[ends[:, 0]], axis=1)


def first_torn(samples: Iterable[NDArray[np.floating]], faces: NDArray[np.integer]) -> int | None:
    """Return the index of the first of ``samples`` (V, 3) in which the skin with ``faces`` (F, 3) is torn, or None.

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
