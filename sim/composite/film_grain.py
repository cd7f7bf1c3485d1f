# SPDX-License-Identifier: MIT
"""The photo's noise (grain), and how much of it a rendered frame lacks.

Inpainted ground has none; a texture that is averaged, magnified, or blurred by motion or focus has less. A noise level
function (Liu, Freeman, Szeliski and Kang, "Noise estimation from a single image", CVPR 2006) gives the noise's strength
by brightness: shot noise rises with light, read noise does not, and the camera's tone curve and noise reduction bend
both, so it is measured rather than modelled. It is split into octaves of spatial frequency, because demosaicking, noise
reduction and JPEG leave grain coarser than a pixel, and into luma and chroma.

All values are 8-bit sRGB steps, where a photo's noise is roughly even and where it is seen.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..robust_deviation import MEDIAN_TO_DEVIATION
from ..srgb import Linear, linear_to_srgb, srgb_to_linear

SIGMAS = (0.8, 1.6, 3.2)
"""Blur standard deviations in pixels whose differences are the octaves."""
BLOCK = 16
LEVELS = 16
FLATTEST = 0.2
"""Share of the blocks of one brightness that counts as flat, judged by structure coarser than the octaves."""
QUIET = 0.2
"""Quantile of the flat blocks' energies taken as noise: fine texture only adds to it. Its ratio to the mean is
calibrated on white noise."""
STEEPEST = (0.1, 0.12)
"""Largest rise of noise from one brightness level to the next: steps, or share of the median. Limits levels at which
the photo shows only texture."""
CLIPPED = 2
"""Levels at either end whose noise may be clipped by black or white, and which do not limit others."""
COARSEST = (1.0, 0.8, 0.5)
"""Largest ratio of each octave to the first, as for grain of just under a pixel; more is texture or shading."""
FEWEST_BLOCKS = 12
FEWEST_PIXELS = 100
ROUNDING = 1 / 12
"""Variance of rounding to 8 bits, which writing the frame adds anyway."""
LEAST = 0.6
"""Grain below this, in steps, is rounding and compression of a clean image."""
WINDOWS = (11, 15, 23)
"""Window sizes in pixels for measuring a frame's own grain, per octave."""
ROUNDS = 12
"""Iterations of fitting the octaves' strengths, to within a percent."""
QUANTUM = 60.0
"""Quantisation steps per sigma for medians: OpenCV's fast median needs bytes."""

Planes = NDArray[np.float32]


@dataclass(frozen=True)
class NoiseModel:
    """sigma: (LEVELS, 3 octaves, 3 planes Y, Cb, Cr) standard deviation of the noise at brightness level i · 255 /
    (LEVELS − 1), in 8-bit steps, rounding taken off."""

    sigma: NDArray[np.float32]

    @property
    def is_clean(self) -> bool:
        """Whether the photo has no measurable grain."""
        return not bool(self.sigma.any())

    def at(self, luma: NDArray[np.float32], octave: int, plane: int) -> NDArray[np.float32]:
        """Return the standard deviation (...) at brightness ``luma`` (...), 0 to 255."""
        return np.interp(luma, np.linspace(0, 255, LEVELS), self.sigma[:, octave, plane]).astype(np.float32)


def estimate_noise(photo: Linear) -> NoiseModel:
    """Return the noise model of ``photo`` (H, W, 3), measured in the flattest blocks of each brightness."""
    planes = _planes(photo)
    height, width = (n // BLOCK * BLOCK for n in planes.shape[:2])
    sigma = np.zeros((LEVELS, len(SIGMAS), 3), np.float32)
    if height < 3 * BLOCK or width < 3 * BLOCK:
        return NoiseModel(sigma)
    bands, coarse = _octaves(planes)
    luma = _blocks(planes[:height, :width, 0]).mean(axis=1)
    structure = np.sum([np.ptp(_blocks(coarse[:height, :width, p]), axis=1) for p in range(3)], axis=0)
    energy = _energies(bands)
    white = _energies(_octaves(_white(256, 256, 0))[0])[:, 0]
    usual, quiet = white.mean(axis=-1), np.quantile(white, QUIET, axis=-1)
    known = []
    centres = np.linspace(0, 255, LEVELS)
    for index, centre in enumerate(centres):
        here = np.nonzero(np.abs(luma - centre) <= 255 / (LEVELS - 1))[0]
        if len(here) < FEWEST_BLOCKS:
            continue
        count = max(FEWEST_BLOCKS // 2, round(FLATTEST * len(here)))
        flat = here[np.argsort(structure[here], kind="stable")[:count]]
        variance = np.quantile(energy[:, :, flat], QUIET, axis=-1) * (usual / quiet)[:, None]
        sigma[index] = np.sqrt(np.maximum(variance - ROUNDING * usual[:, None], 0.0))
        known.append(index)
    if not known:
        return NoiseModel(sigma)
    inner = [level for level in known if CLIPPED <= level < LEVELS - CLIPPED] or known
    distance = np.abs(np.arange(LEVELS)[:, None] - np.array(inner)[None])
    for plane in range(3):
        for octave in range(len(SIGMAS)):
            found = sigma[inner, octave, plane]
            slope = max(STEEPEST[0], STEEPEST[1] * float(np.median(found)))
            even = np.interp(centres, centres[known], sigma[known, octave, plane])
            even = np.minimum(even, (found[None] + slope * distance).min(axis=1))
            sigma[:, octave, plane] = np.minimum(even, COARSEST[octave] * (sigma[:, 0, plane] if octave else even))
    sigma[np.sqrt((sigma**2).sum(axis=(1, 2))) < LEAST] = 0.0
    return NoiseModel(sigma)


def noise_share(model: NoiseModel, photo: Linear, mask: NDArray[np.bool_]) -> float:
    """Return the share (0 to 1) of the photo's grain visible inside ``mask`` (H, W); 1 where the mask is too small.

    Texture mistaken for grain elsewhere must not be added to an object that is smooth in the photo.
    """
    inside = cv2.erode(mask.astype(np.uint8), np.ones((WINDOWS[0], WINDOWS[0]), np.uint8), borderValue=0) > 0
    if model.is_clean or inside.sum() < FEWEST_PIXELS:
        return 1.0
    bands, coarse = _octaves(_planes(photo))
    wanted = model.at(coarse[..., 0], 0, 0)
    there = _local_sigma(bands[0][..., 0], wanted, WINDOWS[0])
    return float(np.clip(np.median(there[inside] / np.maximum(wanted[inside], 1e-3)), 0.0, 1.0))


def _energies(bands: list[Planes]) -> NDArray[np.float64]:
    """Return the mean square (octaves, 3, N) of each octave, plane and block of bands (H, W, 3), full blocks only."""
    height, width = (n // BLOCK * BLOCK for n in bands[0].shape[:2])
    return np.array([[(_blocks(band[:height, :width, p]) ** 2).mean(axis=1) for p in range(3)] for band in bands])


class Grain:
    """Adds the grain that frames lack relative to one photo. The pattern is static, as the photo's own."""

    def __init__(self, model: NoiseModel, size: tuple[int, int], seed: int) -> None:
        """``size`` is width and height of the frames."""
        self._model = model
        self._patterns: list[Planes] = []
        if not model.is_clean:
            bands, _ = _octaves(_white(*size, seed))
            self._patterns = [band / band.std(axis=(0, 1)) for band in bands]
            self._overlap = _overlap()

    def add(self, frame: Linear, changed: NDArray[np.float32]) -> Linear:
        """Return ``frame`` (H, W, 3) with the missing grain, by weight ``changed`` (H, W, 0 to 1); 0 leaves it exactly.

        Existing grain is measured in the frame itself by local medians, which are robust against outlines and texture.
        """
        rows, columns = np.nonzero(changed.max(axis=1) > 0)[0], np.nonzero(changed.max(axis=0) > 0)[0]
        if self._model.is_clean or not len(rows):
            return frame
        margin = 2 * max(WINDOWS)
        height, width = changed.shape
        window = (
            slice(max(0, rows[0] - margin), min(height, rows[-1] + margin + 1)),
            slice(max(0, columns[0] - margin), min(width, columns[-1] + margin + 1)),
        )
        weight = changed[window]
        planes = _planes(frame[window])
        bands, coarse = _octaves(planes)
        added = np.zeros_like(planes)
        for plane in range(3):
            if not self._model.sigma[:, :, plane].any():
                continue
            missing = []
            for octave, band in enumerate(bands):
                wanted = self._model.at(coarse[..., 0], octave, plane)
                there = _local_sigma(band[..., plane], wanted, WINDOWS[octave])
                missing.append(np.maximum(wanted**2 - there**2, 0.0))
            for gain, pattern in zip(_gains(missing, self._overlap), self._patterns, strict=True):
                added[..., plane] += pattern[window][..., plane] * gain
        result, grainy = frame.copy(), weight > 0
        shown = _rgb(planes + added * weight[..., None])[grainy]
        result[window][grainy] = srgb_to_linear(np.clip(shown / 255.0, 0.0, 1.0))
        return result


def _overlap() -> NDArray[np.float64]:
    """Return the mean product (k, i, j) that octave k measures of unit-variance patterns i and j."""
    patterns = [band / band.std() for band in _octaves(_white(256, 256, 1))[0]]
    measured = [_octaves(pattern)[0] for pattern in patterns]
    count = len(SIGMAS)
    return np.array(
        [[[float((measured[i][k] * measured[j][k]).mean()) for j in range(count)] for i in range(count)]
         for k in range(count)]
    )  # fmt: skip


def _gains(missing: list[NDArray[np.float32]], overlap: NDArray[np.float64]) -> list[NDArray[np.float32]]:
    """Return pattern strengths (octaves, H, W) whose sum has the variances ``missing`` in every octave.

    Iterated because octaves overlap; solved at a quarter of the size, because strengths are smooth.
    """
    height, width = missing[0].shape
    small = (max(1, width // 4), max(1, height // 4))
    wanted = np.stack([cv2.resize(m, small, interpolation=cv2.INTER_AREA) for m in missing]).astype(np.float64)
    gains = np.sqrt(wanted)
    for _ in range(ROUNDS):
        measured = np.einsum("kij,ihw,jhw->khw", overlap, gains, gains, optimize=True)
        gains *= np.sqrt(np.sqrt(wanted / np.maximum(measured, 1e-6)))
    return [np.asarray(cv2.resize(g.astype(np.float32), (width, height))) for g in gains]


def _local_sigma(band: NDArray[np.float32], wanted: NDArray[np.float32], window: int) -> NDArray[np.float32]:
    """Return the local standard deviation (H, W) of ``band``, quantised to ``wanted / QUANTUM``."""
    relative = np.asarray(np.abs(band) / np.maximum(wanted, 1e-3) * QUANTUM)
    median = cv2.medianBlur(np.clip(np.rint(relative), 0, 255).astype(np.uint8), window)
    smooth = cv2.GaussianBlur(median.astype(np.float32), (0, 0), window / 4)
    return np.asarray(smooth * (MEDIAN_TO_DEVIATION / QUANTUM) * wanted)


def _octaves(planes: Planes) -> tuple[list[Planes], Planes]:
    """Return differences of successively blurred ``planes`` (H, W, C), fine to coarse, and the remainder."""
    bands, finer = [], planes
    for sigma in SIGMAS:
        blurred = np.asarray(cv2.GaussianBlur(planes, (0, 0), sigma), dtype=np.float32)
        bands.append(finer - blurred)
        finer = blurred
    return bands, finer


def _white(width: int, height: int, seed: int) -> Planes:
    return np.random.default_rng(seed).standard_normal((height, width, 3), dtype=np.float32)


def _blocks(plane: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return ``plane`` (H, W), both multiples of BLOCK, as (N, BLOCK²)."""
    rows, columns = (n // BLOCK for n in plane.shape)
    return plane.reshape(rows, BLOCK, columns, BLOCK).swapaxes(1, 2).reshape(rows * columns, -1)


def _planes(linear: Linear) -> Planes:
    """Return Y, Cb, Cr (H, W, 3) in steps of 255, not rounded."""
    return np.asarray(cv2.cvtColor(linear_to_srgb(linear), cv2.COLOR_RGB2YCrCb) * np.float32(255.0))


def _rgb(planes: Planes) -> NDArray[np.float32]:
    return np.asarray(cv2.cvtColor(planes / np.float32(255.0), cv2.COLOR_YCrCb2RGB) * np.float32(255.0))
