# SPDX-License-Identifier: MIT
"""The optimal denoiser of a finite set of images, in closed form: no network, no weights.

A diffusion model trained on the images y_1 … y_M minimises E‖ε̂(x_t, t) - ε‖² over the set and the noise. The minimum
is known in closed form (Karras et al. 2022, appendix B.3; De Bortoli 2022): with x_t = √ᾱ x + √(1-ᾱ) ε,

    E[x | x_t] = Σ p_j y_j,  p = softmax_j(-‖x_t - √ᾱ y_j‖² / (2 (1-ᾱ))),  ε̂ = (x_t - √ᾱ E) / √(1-ᾱ).

Images are scaled from 0..1 to -1..1, as such models do. Conditioned on a camera or a subject, it is the optimum for the
matching subset. docs/composition.md says where this can replace a model, and where it cannot.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ...scene.model import Camera
from .score_distillation import Array, NoiseSchedule, RenderedView

MAX_BYTES = 4 * 2**30
"""Memory of the set."""
BLOCK = 2**21
"""Values of the set converted to 64 bits at a time: 16 MiB."""
NEGLIGIBLE = 1e-18
"""Weight p below which an image no longer changes the mean in 64 bits."""


class IdealDenoiser:
    """``Guidance`` from a set of images (M, H, W, 3), sRGB 0 to 1; stored in 32 bits, evaluated in 64.

    cameras: camera of each image, M of them, which condition it on the view, as in Zero123 and SyncDreamer. Only images
        count whose camera is rotated (roll included) by at most ``within`` against the rendered one. A hard cut-off:
        the likelihood of an image outweighs any smooth preference for a view by orders of magnitude, so that the wrong
        view would win as soon as it matches better.
    within: degrees, above 0 to 180.
    subjects: subject of each image, M names: only images of the rendered subject count then.
    """

    name = "ideal denoiser"

    def __init__(
        self,
        pictures: NDArray[Any],
        *,
        schedule: NoiseSchedule | None = None,
        cameras: Sequence[Camera] = (),
        within: float = 5.0,
        subjects: Sequence[str] = (),
    ) -> None:
        """Raises InputError on invalid or too many images, and on another number of cameras or subjects."""
        shape = np.shape(pictures)
        if len(shape) != 4 or shape[3] != 3 or 0 in shape:
            raise InputError(
                f"pictures of the ideal denoiser have shape {shape}: give (M, H, W, 3) with M of 1 or more"
            )
        if math.prod(shape) * 4 > MAX_BYTES:
            raise InputError(
                f"{shape[0]} pictures of {shape[2]}x{shape[1]} need {math.prod(shape) * 4 / 2**30:.1f} GiB: give fewer "
                f"or smaller ones, up to {MAX_BYTES >> 30} GiB"
            )
        for what, given in (("cameras", cameras), ("subjects", subjects)):
            if len(given) not in (0, shape[0]):
                raise InputError(f"{len(given)} {what} for {shape[0]} pictures: give one for each, or none")
        if not 0 < within <= 180:
            raise InputError(f"within is {within!r}: give degrees above 0, up to 180")
        self.schedule = schedule or NoiseSchedule()
        self._size = shape[1:]
        self._set = np.empty((shape[0], math.prod(shape[1:])), dtype=np.float32)
        self._squares = np.empty(shape[0])
        for index in range(shape[0]):
            picture = np.asarray(pictures[index], dtype=np.float64).ravel()
            # Written so that NaN fails too.
            if not (picture.min() >= -0.01 and picture.max() <= 1.01):
                raise InputError(
                    f"picture {index} of the ideal denoiser goes from {picture.min():g} to {picture.max():g}: give "
                    "finite sRGB from 0 to 1"
                )
            self._set[index] = 2 * picture - 1
            self._squares[index] = np.sum(self._set[index].astype(np.float64) ** 2)
        self._turns = np.array([np.asarray(c.world_from_camera, dtype=np.float64)[:3, :3] for c in cameras])
        self._within = within
        self._subjects = np.array(subjects, dtype=object)

    def gradient(self, seen: RenderedView, timestep: int, random: np.random.Generator) -> Array:
        """Return the gradient (H, W, 3) as ``Guidance`` defines it; ∂z/∂picture = 2, because z = 2 picture - 1.

        Raises InputError on a picture of another size than the set's, and on a camera or subject not in the set.
        """
        alpha, weight = self.schedule.alpha(timestep), self.schedule.weight(timestep)
        if seen.picture.shape != self._size:
            raise InputError(
                f"picture of {seen.subject!r} is {seen.picture.shape}, those of the ideal denoiser are {self._size}: "
                "render them at one size"
            )
        clean = (2 * np.asarray(seen.picture, dtype=np.float64) - 1).ravel()
        noisy = math.sqrt(alpha) * clean + math.sqrt(1 - alpha) * random.standard_normal(clean.shape)
        mean = self._mean(noisy, alpha, self.counted(seen))
        # ε̂ - ε = √(ᾱ / (1-ᾱ)) (x - E): ε cancels exactly, so it is omitted rather than subtracted.
        answer = 2 * weight * math.sqrt(alpha / (1 - alpha)) * (clean - mean)
        return np.asarray(answer.reshape(self._size))

    def noise(self, noisy: NDArray[Any], timestep: int, counted: NDArray[np.bool_] | None = None) -> Array:
        """Return ε̂ (H, W, 3) of ``noisy`` (H, W, 3), an image scaled to -1..1 with the noise of ``timestep``.

        counted: (M,) mask of the images to use; None: all. The score ∇ log p_t is -ε̂ / √(1-ᾱ). Raises InputError on
        another size than the set's.
        """
        alpha = self.schedule.alpha(timestep)
        if np.shape(noisy) != self._size:
            raise InputError(f"noisy picture has shape {np.shape(noisy)}: give {self._size}, the set's")
        flat = np.asarray(noisy, dtype=np.float64).ravel()
        mean = self._mean(flat, alpha, np.ones(len(self._set), dtype=bool) if counted is None else counted)
        return np.asarray(((flat - math.sqrt(alpha) * mean) / math.sqrt(1 - alpha)).reshape(self._size))

    def counted(self, seen: RenderedView) -> NDArray[np.bool_]:
        """Return (M,) mask of the images that match the camera and subject of ``seen``. Raises InputError if none."""
        counted = np.ones(len(self._set), dtype=bool)
        if len(self._subjects):
            counted = np.asarray(self._subjects == seen.subject)
            if not counted.any():
                known = ", ".join(sorted(set(self._subjects)))
                raise InputError(
                    f"subject {seen.subject!r} is in no picture of the ideal denoiser: it has {known[:300]}"
                )
        if len(self._turns):
            turn = np.asarray(seen.camera.world_from_camera, dtype=np.float64)[:3, :3]
            cosines = (np.einsum("mij,ij->m", self._turns, turn) - 1) / 2
            angles = np.degrees(np.arccos(np.clip(cosines, -1, 1)))
            nearest = float(angles[counted].min())
            if nearest > self._within:
                raise InputError(
                    f"camera of {seen.subject!r} is rotated by {nearest:.1f} degrees against the nearest of the ideal "
                    f"denoiser's, more than {self._within:g}: add pictures from there, or use a larger within"
                )
            counted &= angles <= self._within
        return counted

    def _mean(self, noisy: Array, alpha: float, counted: NDArray[np.bool_]) -> Array:
        """Return E[x | x_t] (D,) of ``noisy`` (D,)."""
        members = np.flatnonzero(counted)
        width = max(1, BLOCK // len(members))
        products = np.zeros(len(members))
        for start in range(0, noisy.size, width):
            part = slice(start, start + width)
            products += self._set[members, part].astype(np.float64) @ noisy[part]
        # ‖x_t‖² is omitted: it is the same for all.
        logits = (math.sqrt(alpha) * products - alpha * self._squares[members] / 2) / (1 - alpha)
        shares = np.exp(logits - logits.max())
        shares /= shares.sum()
        mean = np.zeros(noisy.size)
        for share, member in zip(shares, members, strict=True):
            if share > NEGLIGIBLE:
                mean += share * self._set[member].astype(np.float64)
        return mean
