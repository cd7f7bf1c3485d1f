# SPDX-License-Identifier: MIT
"""Gaussian splats: an object as a cloud of coloured, translucent ellipsoids, and how they move with particles.

Kerbl et al. 2023, 3D Gaussian Splatting; without view-dependent colour (spherical harmonics of degree 0 only), because
moving material takes its colour along. Under a deformation gradient F the ellipsoid Σ = R S² Rᵀ becomes Σ' = F Σ Fᵀ
(Xie et al. 2024, PhysGaussian): its half axes, the columns of R S, become those of F R S. Made orthogonal again by
one-sided Jacobi rotations, they are the scales and rotation of Σ'. NumPy only: Blender's own process imports this."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..skinning import Binding, bind, deform_locally

Array = NDArray[np.float64]

MIN_SCALE, MAX_SCALE = 1e-7, 1e6
"""Range of a splat's standard deviations in metres."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Splats:
    """N Gaussians in world metres; the arrays are copied and read-only.

    The density at x is exp(-½ (x - μ)ᵀ Σ⁻¹ (x - μ)) with Σ = R diag(s²) Rᵀ. Raises InputError on wrong shapes, values
    that are not finite or out of range, and zero quaternions.
    """

    centres: Array
    """(N, 3) μ in metres."""

    scales: Array
    """(N, 3) s, standard deviations in metres along the splat's local axes, ``MIN_SCALE`` to ``MAX_SCALE``."""

    rotations: Array
    """(N, 4) quaternions w, x, y, z of R, local axes to world axes; normalised here."""

    opacities: Array
    """(N,) alpha at a splat's centre, 0 to 1."""

    colours: Array
    """(N, 3) sRGB (not linear), 0 to 1; values slightly beyond, which fits produce, are kept."""

    def __post_init__(self) -> None:
        count = len(self.centres) if np.ndim(self.centres) else 0
        widths = {"centres": (3,), "scales": (3,), "rotations": (4,), "opacities": (), "colours": (3,)}
        for name, width in widths.items():
            value = np.array(getattr(self, name), dtype=np.float64)
            if value.shape != (count, *width):
                wanted = ", ".join(["N", *(str(w) for w in width)])
                raise InputError(f"splats: {name} have shape {value.shape}: give ({wanted}) with N = {count}")
            if not np.isfinite(value).all():
                bad = int(np.flatnonzero(~np.isfinite(value.reshape(count, -1)).all(axis=1))[0])
                raise InputError(f"splats: {name} of splat {bad} are {value[bad]!r}: give finite numbers")
            object.__setattr__(self, name, value)
        if count and not (self.scales.min() >= MIN_SCALE and self.scales.max() <= MAX_SCALE):
            raise InputError(
                f"splats: scales go from {self.scales.min():g} to {self.scales.max():g} m: give {MIN_SCALE:g} to "
                f"{MAX_SCALE:g}"
            )
        lengths = np.linalg.norm(self.rotations, axis=1)
        if count and lengths.min() < 1e-12:
            raise InputError(f"splats: rotation of splat {int(lengths.argmin())} is zero: give a quaternion w, x, y, z")
        object.__setattr__(self, "rotations", self.rotations / np.where(lengths > 0, lengths, 1.0)[:, None])
        if count and not (self.opacities.min() >= 0 and self.opacities.max() <= 1):
            raise InputError(
                f"splats: opacities go from {self.opacities.min():g} to {self.opacities.max():g}: give 0 to 1"
            )
        for name in widths:
            getattr(self, name).flags.writeable = False

    def __len__(self) -> int:
        return len(self.centres)

    def axes(self) -> Array:
        """Return (N, 3, 3) R, whose columns are the splat's axes in the world."""
        w, x, y, z = self.rotations.T
        rows = (
            (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
            (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
            (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
        )
        return np.stack([np.stack(row, axis=-1) for row in rows], axis=1)

    def covariances(self) -> Array:
        """Return (N, 3, 3) Σ in m²."""
        spread = self.axes() * self.scales[:, None, :]
        return np.asarray(spread @ spread.transpose(0, 2, 1))

    def subset(self, which: NDArray[np.bool_] | NDArray[np.integer]) -> Splats:
        """Return the splats selected by a mask (N,) or by indices, in that order."""
        names = [field.name for field in dataclasses.fields(self)]
        return Splats(**{name: getattr(self, name)[which] for name in names})

    def changed(self, **arrays: Array) -> Splats:
        """Return a copy with some arrays replaced."""
        return dataclasses.replace(self, **arrays)


def joined(parts: Sequence[Splats]) -> Splats:
    """Return the splats of all ``parts``, concatenated. Raises InputError when there are no parts."""
    if not parts:
        raise InputError("splats: nothing to join: give at least one object")
    names = [field.name for field in dataclasses.fields(Splats)]
    return Splats(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in names})


MAX_STRETCH = 8.0
"""Largest stretch of a splat in any direction: where material tears, F no longer describes the surface, and splats
would become needles."""

JACOBI_SWEEPS = 8
"""For 3×3 matrices; five reduce all angles to rounding error."""

ORTHOGONAL = 1e-13
"""Cosine below which two axes count as orthogonal: above rounding error, or equally long axes would be turned by it."""

CHUNK = 50_000
"""Splats processed at a time: twelve neighbours with a matrix each take a kilobyte a splat."""


@dataclass(frozen=True)
class SplatBinding:
    """Skinning weights of N splats. skin: binding of the centres at rest (``skin.rest``) to particles."""

    skin: Binding

    def __len__(self) -> int:
        return len(self.skin.rest)


def bind_splats(splats: Splats, particles: NDArray[np.floating]) -> SplatBinding:
    """Return the binding of ``splats`` to ``particles`` (P, 3), both at rest in world metres.

    Raises InputError for fewer than 4 particles, and for positions that are not finite.
    """
    return SplatBinding(bind(splats.centres, particles))


def deformed_half_axes(
    splats: Splats, binding: SplatBinding, positions: NDArray[np.floating], gradients: NDArray[np.floating]
) -> tuple[Array, Array]:
    """Return centres (N, 3) and half axes (N, 3, 3), the columns of F R S, in metres, of ``splats`` deformed with
    particles at ``positions`` (P, 3), metres, and ``gradients`` F (P, 3, 3).

    Exact for affine motion up to ``MAX_STRETCH``. Particles that have flown off, and gradients that are not finite or
    inverted, are ignored. Unlike scales and rotations, half axes change smoothly from frame to frame, even where two
    become equally long, so frames may be interpolated. Raises InputError when ``binding`` belongs to other splats.
    """
    if len(binding) != len(splats):
        raise InputError(f"splats: there are {len(splats)}, but the binding has {len(binding)}: bind these splats")
    centres, axes = np.empty((len(splats), 3)), half_axes(splats)
    for start in range(0, len(splats), CHUNK):
        rows = slice(start, start + CHUNK)
        centres[rows], f = deform_locally(binding.skin.rows(rows), positions, gradients)
        axes[rows] = _limited(f) @ axes[rows]
    return centres, axes


def transform_splats(splats: Splats, matrix: NDArray[np.floating]) -> Splats:
    """Return ``splats`` under the affine map ``matrix`` (4, 4), which may stretch, shear and mirror."""
    matrix = np.asarray(matrix, dtype=np.float64)
    centres = splats.centres @ matrix[:3, :3].T + matrix[:3, 3]
    return from_half_axes(splats, centres, matrix[:3, :3] @ half_axes(splats))


def half_axes(splats: Splats) -> Array:
    """Return (N, 3, 3) the columns of R S in m: from the centre to where the density has fallen to exp(-½)."""
    return splats.axes() * splats.scales[:, None, :]


def from_half_axes(splats: Splats, centres: NDArray[np.floating], axes: NDArray[np.floating]) -> Splats:
    """Return ``splats`` with ``centres`` (N, 3) and Σ = A Aᵀ for A in ``axes`` (N, 3, 3), both in metres.

    Orthogonal columns of A stay the axes, in their order; others are turned by the least angle. So a splat's axes are
    not permuted from one frame to the next, and rigid motion preserves its scales.
    """
    columns = _orthogonal_columns(np.array(axes, dtype=np.float64))
    lengths = np.linalg.norm(columns, axis=1)
    rotation = columns / np.maximum(lengths, 1e-300)[:, None, :]
    # The third axis from the others: never mirrored, and orthogonal even where the splat has become flat.
    rotation[:, :, 1] -= (rotation[:, :, 0] * rotation[:, :, 1]).sum(axis=1, keepdims=True) * rotation[:, :, 0]
    rotation[:, :, 2] = np.cross(rotation[:, :, 0], rotation[:, :, 1])
    return splats.changed(
        centres=np.asarray(centres, dtype=np.float64),
        scales=np.clip(lengths, MIN_SCALE, MAX_SCALE),
        rotations=quaternions(rotation),
    )


def as_points(centres: NDArray[np.floating], axes: NDArray[np.floating]) -> Array:
    """Return (4N, 3) points in metres, the layout of caches: each splat's centre, then the ends of its half axes."""
    centres = np.asarray(centres, dtype=np.float64)[:, None, :]
    return np.concatenate([centres, centres + np.swapaxes(axes, 1, 2)], axis=1).reshape(-1, 3)


def from_points(splats: Splats, points: NDArray[np.floating]) -> Splats:
    """Return ``splats`` placed by ``points`` (4N, 3) of ``as_points``, which may have gone through any affine map."""
    groups = np.asarray(points, dtype=np.float64).reshape(-1, 4, 3)
    return from_half_axes(splats, groups[:, 0], np.swapaxes(groups[:, 1:] - groups[:, :1], 1, 2))


def quaternions(rotations: Array) -> Array:
    """Return (N, 4) unit quaternions w, x, y, z of ``rotations`` (N, 3, 3), by Shepperd's method."""
    m = rotations
    trace = np.trace(m, axis1=1, axis2=2)
    # Four times the squared entries, and their products; the row of the largest entry is well conditioned.
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
    """Return ``gradients`` (N, 3, 3) with principal stretches clamped to ``MAX_STRETCH``."""
    found = gradients
    long = np.flatnonzero(np.linalg.norm(gradients, axis=(1, 2)) > MAX_STRETCH)
    if len(long):
        u, s, vt = np.linalg.svd(gradients[long])
        found = gradients.copy()
        found[long] = u * np.minimum(s, MAX_STRETCH)[:, None, :] @ vt
    return found


def _orthogonal_columns(columns: Array) -> Array:
    """Return (N, 3, 3) A V with orthogonal columns, V a product of least rotations (Hestenes 1958)."""
    for _ in range(JACOBI_SWEEPS):
        largest = 0.0
        for p, q in ((0, 1), (0, 2), (1, 2)):
            a, b = columns[:, :, p], columns[:, :, q]
            aa, bb, ab = (a * a).sum(axis=1), (b * b).sum(axis=1), (a * b).sum(axis=1)
            skew = np.abs(ab) / np.maximum(np.sqrt(aa * bb), 1e-300)
            turn = skew > ORTHOGONAL
            largest = max(largest, float(skew.max(initial=0.0)))
            zeta = (bb - aa) / (2 * np.where(turn, ab, 1.0))
            tangent = np.where(turn, np.where(zeta < 0, -1.0, 1.0) / (np.abs(zeta) + np.hypot(1.0, zeta)), 0.0)
            cosine = 1 / np.hypot(1.0, tangent)
            c, s = cosine[:, None], (cosine * tangent)[:, None]
            columns[:, :, p], columns[:, :, q] = c * a - s * b, s * a + c * b
        if largest <= ORTHOGONAL:
            break
    return columns
