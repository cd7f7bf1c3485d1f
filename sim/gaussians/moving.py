# SPDX-License-Identifier: MIT
"""Splats that follow particles: centres by skinning, each covariance by the deformation gradient around it.

Where matter deforms by F, the ellipsoid Σ = R S² Rᵀ becomes Σ' = F Σ Fᵀ (Xie et al. 2024, PhysGaussian): its half axes,
the columns of R S, become those of F R S. These are no longer at right angles; turned among themselves until they are
(one-sided Jacobi), they are the scales and rotation of Σ'. Numpy alone is enough: Blender's own process does it too.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..skinning.binding import Binding, bind, deform_locally
from .splats import LARGEST_SCALE, LEAST_SCALE, Splats

Array = NDArray[np.float64]

MOST_STRETCH = 8.0
"""Longer than so many times itself no splat gets along any direction: where matter tears, F says nothing of what is
seen, and splats would become needles."""

JACOBI_SWEEPS = 8
"""Of 3×3 matrices; five bring all angles to rounding."""

RIGHT = 1e-13
"""Cosine below which two axes count as at right angles: above rounding, or equally long ones would be turned by it."""

CHUNK = 50_000
"""Splats at a time: twelve neighbours with a matrix each take a kilobyte a splat."""


@dataclass(frozen=True)
class SplatBinding:
    """Which particles carry which splat: skin, for the N centres at rest, which are its ``rest``."""

    skin: Binding

    def __len__(self) -> int:
        return len(self.skin.rest)

    def part(self, rows: slice) -> Binding:
        """That of the splats ``rows``."""
        names = [field.name for field in dataclasses.fields(Binding)]
        return Binding(**{name: getattr(self.skin, name)[rows] for name in names})


def bind_splats(splats: Splats, particles: NDArray[np.floating]) -> SplatBinding:
    """Bind ``splats`` to the ``particles`` (P, 3) of the body at rest, both in world metres.

    Raises InputError when there are fewer than 4 particles, or they are not finite.
    """
    return SplatBinding(bind(splats.centres, particles))


def moved(
    splats: Splats, binding: SplatBinding, positions: NDArray[np.floating], gradients: NDArray[np.floating]
) -> Splats:
    """``splats`` where the particles' ``positions`` (P, 3) and deformation ``gradients`` (P, 3, 3) have taken them.

    Opacity and colour stay. Exact for affine motion up to ``MOST_STRETCH``. Particles that have flown off, and
    gradients that are not finite or turn matter inside out, do not count. Raises InputError when ``binding`` is of
    other splats.
    """
    return from_half_axes(splats, *moved_half_axes(splats, binding, positions, gradients))


def moved_half_axes(
    splats: Splats, binding: SplatBinding, positions: NDArray[np.floating], gradients: NDArray[np.floating]
) -> tuple[Array, Array]:
    """Centres (N, 3) and half axes (N, 3, 3), the columns of F R S in m, of what ``moved`` returns.

    Unlike scales and rotations they change smoothly from frame to frame, also where two axes become equally long, so
    that frames may be interpolated.
    """
    if len(binding) != len(splats):
        raise InputError(f"splats: {len(splats)} of them, and a binding of {len(binding)}: bind these splats")
    centres, axes = np.empty((len(splats), 3)), half_axes(splats)
    for start in range(0, len(splats), CHUNK):
        rows = slice(start, start + CHUNK)
        centres[rows], f = deform_locally(binding.part(rows), positions, gradients)
        axes[rows] = _limited(f) @ axes[rows]
    return centres, axes


def placed(splats: Splats, matrix: NDArray[np.floating]) -> Splats:
    """``splats`` under the affine map ``matrix`` (4, 4), which may also stretch, shear and mirror."""
    matrix = np.asarray(matrix, dtype=np.float64)
    centres = splats.centres @ matrix[:3, :3].T + matrix[:3, 3]
    return from_half_axes(splats, centres, matrix[:3, :3] @ half_axes(splats))


def half_axes(splats: Splats) -> Array:
    """(N, 3, 3) the columns of R S in m: from a splat's centre to where its density has fallen to exp(-½)."""
    return splats.axes() * splats.scales[:, None, :]


def from_half_axes(splats: Splats, centres: NDArray[np.floating], axes: NDArray[np.floating]) -> Splats:
    """``splats`` with other ``centres`` (N, 3) and with Σ = A Aᵀ for A in ``axes`` (N, 3, 3).

    Columns of A that are at right angles stay the axes, in their order; others are turned as little as it takes. So a
    splat's axes do not change places from one frame to the next, and rigid motion keeps its scales.
    """
    columns = _right_angled(np.array(axes, dtype=np.float64))
    lengths = np.linalg.norm(columns, axis=1)
    rotation = columns / np.maximum(lengths, 1e-300)[:, None, :]
    # The third axis from the others: never mirrored, and at right angles also where the splat has become flat.
    rotation[:, :, 1] -= (rotation[:, :, 0] * rotation[:, :, 1]).sum(axis=1, keepdims=True) * rotation[:, :, 0]
    rotation[:, :, 2] = np.cross(rotation[:, :, 0], rotation[:, :, 1])
    return splats.changed(
        centres=np.asarray(centres, dtype=np.float64),
        scales=np.clip(lengths, LEAST_SCALE, LARGEST_SCALE),
        rotations=quaternions(rotation),
    )


def as_points(centres: NDArray[np.floating], axes: NDArray[np.floating]) -> Array:
    """(4N, 3): of each splat its centre, then the ends of its three half axes. How caches keep splats."""
    centres = np.asarray(centres, dtype=np.float64)[:, None, :]
    return np.concatenate([centres, centres + np.swapaxes(axes, 1, 2)], axis=1).reshape(-1, 3)


def from_points(splats: Splats, points: NDArray[np.floating]) -> Splats:
    """``splats`` where ``points`` (4N, 3) of ``as_points`` say; these may have gone through any affine map."""
    groups = np.asarray(points, dtype=np.float64).reshape(-1, 4, 3)
    return from_half_axes(splats, groups[:, 0], np.swapaxes(groups[:, 1:] - groups[:, :1], 1, 2))


def quaternions(rotations: Array) -> Array:
    """(N, 4) unit quaternions w, x, y, z of ``rotations`` (N, 3, 3), by Shepperd's method: from the largest of them."""
    m = rotations
    trace = np.trace(m, axis1=1, axis2=2)
    # Four times the squares, and the products of each with the others.
    squares = np.stack([1 + trace, *(1 + 2 * m[:, i, i] - trace for i in range(3))], axis=1)
    wx, wy, wz = m[:, 2, 1] - m[:, 1, 2], m[:, 0, 2] - m[:, 2, 0], m[:, 1, 0] - m[:, 0, 1]
    xy, xz, yz = m[:, 0, 1] + m[:, 1, 0], m[:, 0, 2] + m[:, 2, 0], m[:, 1, 2] + m[:, 2, 1]
    w, x, y, z = squares.T
    table = np.stack(
        [np.stack(row, axis=1) for row in ((w, wx, wy, wz), (wx, x, xy, xz), (wy, xy, y, yz), (wz, xz, yz, z))], axis=1
    )
    found = table[np.arange(len(m)), squares.argmax(axis=1)]
    return np.asarray(found / np.linalg.norm(found, axis=1, keepdims=True))


def _limited(gradients: Array) -> Array:
    """``gradients`` (N, 3, 3) with no stretch above ``MOST_STRETCH``."""
    found = gradients
    long = np.flatnonzero(np.linalg.norm(gradients, axis=(1, 2)) > MOST_STRETCH)
    if len(long):
        u, s, vt = np.linalg.svd(gradients[long])
        found = gradients.copy()
        found[long] = u * np.minimum(s, MOST_STRETCH)[:, None, :] @ vt
    return found


def _right_angled(columns: Array) -> Array:
    """(N, 3, 3) A V with orthogonal columns, V a rotation by the least angles (Hestenes 1958, one-sided Jacobi)."""
    for _ in range(JACOBI_SWEEPS):
        largest = 0.0
        for p, q in ((0, 1), (0, 2), (1, 2)):
            a, b = columns[:, :, p], columns[:, :, q]
            aa, bb, ab = (a * a).sum(axis=1), (b * b).sum(axis=1), (a * b).sum(axis=1)
            skew = np.abs(ab) / np.maximum(np.sqrt(aa * bb), 1e-300)
            turn = skew > RIGHT
            largest = max(largest, float(skew.max(initial=0.0)))
            zeta = (bb - aa) / (2 * np.where(turn, ab, 1.0))
            tangent = np.where(turn, np.where(zeta < 0, -1.0, 1.0) / (np.abs(zeta) + np.hypot(1.0, zeta)), 0.0)
            cosine = 1 / np.hypot(1.0, tangent)
            c, s = cosine[:, None], (cosine * tangent)[:, None]
            columns[:, :, p], columns[:, :, q] = c * a - s * b, s * a + c * b
        if largest <= RIGHT:
            break
    return columns
