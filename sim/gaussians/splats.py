# SPDX-License-Identifier: MIT
"""Gaussian splats as data: an object as a cloud of coloured, half transparent ellipsoids. No Taichi.

Kerbl et al. 2023, 3D Gaussian Splatting; without view-dependent colour (spherical harmonics of degree 0 only), because
matter that moves takes its colour along.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError

Array = NDArray[np.float64]

LEAST_SCALE, LARGEST_SCALE = 1e-7, 1e6
"""Metres between which a splat's standard deviations lie."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Splats:
    """N Gaussians, world metres. Raises InputError on bad shapes or numbers; the arrays are copied and read-only.

    A splat's density at x is exp(-½ (x - μ)ᵀ Σ⁻¹ (x - μ)) with Σ = R diag(s²) Rᵀ.
    """

    centres: Array
    """(N, 3) μ in metres."""

    scales: Array
    """(N, 3) s, standard deviations in metres along the splat's own axes, above 0."""

    rotations: Array
    """(N, 4) unit quaternions w, x, y, z of R, which takes the splat's own axes to the world's; made unit here."""

    opacities: Array
    """(N,) share of light that the middle of a splat holds back, 0 to 1."""

    colours: Array
    """(N, 3) sRGB as files keep it (not linear), 0 to 1; a little beyond is kept, as fits go there."""

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
        if count and not (self.scales.min() >= LEAST_SCALE and self.scales.max() <= LARGEST_SCALE):
            raise InputError(
                f"splats: scales go from {self.scales.min():g} to {self.scales.max():g} m: give {LEAST_SCALE:g} to "
                f"{LARGEST_SCALE:g}"
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
        """(N, 3, 3) R: its columns are the splat's axes in the world."""
        w, x, y, z = self.rotations.T
        rows = (
            (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
            (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
            (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
        )
        return np.stack([np.stack(row, axis=-1) for row in rows], axis=1)

    def covariances(self) -> Array:
        """(N, 3, 3) Σ in m²."""
        spread = self.axes() * self.scales[:, None, :]
        return np.asarray(spread @ spread.transpose(0, 2, 1))

    def chosen(self, which: NDArray[np.bool_] | NDArray[np.integer]) -> Splats:
        """The splats of a mask (N,) or of indices, in their order."""
        names = [field.name for field in dataclasses.fields(self)]
        return Splats(**{name: getattr(self, name)[which] for name in names})

    def changed(self, **arrays: Array) -> Splats:
        """The same with some of its arrays replaced."""
        return dataclasses.replace(self, **arrays)


def joined(parts: Sequence[Splats]) -> Splats:
    """All splats of ``parts`` in one, in their order. Raises InputError when there is none."""
    if not parts:
        raise InputError("splats: nothing to join: give at least one object")
    names = [field.name for field in dataclasses.fields(Splats)]
    return Splats(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in names})
