# SPDX-License-Identifier: GPL-3.0-or-later
"""Cycles for exact image formation: one pixel is the mean over its area, light is direct, nothing is clamped."""

from __future__ import annotations

import bpy

from . import compat, devices
from .options import RenderOptions


def set_up(scene: bpy.types.Scene, options: RenderOptions, *, denoise: bool) -> None:
    """Let Cycles render ``scene`` on ``options.device``, on the CPU where that is not there."""
    render, cycles = scene.render, scene.cycles
    render.engine = "CYCLES"
    devices.use(scene, options.device)
    cycles.samples = options.samples
    cycles.use_adaptive_sampling = False
    cycles.seed, cycles.use_animated_seed = options.seed, False
    # The ratio of light to rest light is only independent of albedo without bounces.
    cycles.max_bounces = cycles.diffuse_bounces = cycles.glossy_bounces = cycles.transmission_bounces = 0
    cycles.transparent_max_bounces = 0
    cycles.sample_clamp_direct = cycles.sample_clamp_indirect = 0.0
    cycles.light_sampling_threshold = 0.0
    cycles.pixel_filter_type, cycles.filter_width = "BOX", 1.0
    cycles.use_auto_tile = False
    set_denoising(scene, denoise and options.denoise)
    render.threads_mode = "FIXED" if options.threads else "AUTO"
    if options.threads:
        render.threads = options.threads
    # Keeps textures, lamps and the denoiser from one frame to the next.
    render.use_persistent_data = True


def set_denoising(scene: bpy.types.Scene, wanted: bool) -> None:
    """Denoise with OpenImageDenoise if ``wanted`` and there.

    Not with OptiX's denoiser: a picture would then depend on the machine that it was made on.
    """
    cycles = scene.cycles
    cycles.use_denoising = wanted and compat.denoiser_available()
    if cycles.use_denoising:
        cycles.denoiser = compat.DENOISER
        cycles.denoising_input_passes = "RGB_ALBEDO_NORMAL"
        cycles.denoising_prefilter = "FAST"
        cycles.denoising_quality = "BALANCED"
        cycles.denoising_use_gpu = False
