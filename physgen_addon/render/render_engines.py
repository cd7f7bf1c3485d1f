# SPDX-License-Identifier: GPL-3.0-or-later
"""Cycles and EEVEE set up to form the same image, their devices, and a still as linear arrays."""

from __future__ import annotations

import contextlib
import functools
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import bpy
import numpy as np
from numpy.typing import NDArray

from ...sim.app.stage_process import NO_WINDOW, child_environment
from ...sim.atomic import scratch_prefix
from ...sim.errors import InputError, RenderError
from .. import compat
from ..frames.frame_files import read_layers
from ..scene_io.photo_view import turn_to
from .render_options import RenderOptions
from .render_regions import Box
from .sky_lamps import SkyLamp

BACKENDS = {"optix": "OPTIX", "cuda": "CUDA", "hip": "HIP", "oneapi": "ONEAPI", "metal": "METAL"}
"""Cycles' names of device types; ``auto`` selects the first available. OptiX uses the ray tracing hardware of NVIDIA
cards, so it precedes CUDA.
"""


def graphics_cards(kind: str) -> list[str]:
    """Return names of this machine's graphics cards that Cycles can use as ``kind``; empty if build or driver
    lacks it.
    """
    return [device.name for device in _devices(kind)]


def choose_device(wanted: str, notice: Callable[[str], None]) -> str:
    """Return the device to render on, one of ``DEVICES`` but ``auto``; report it and the reason by ``notice``.

    wanted: one of ``DEVICES``; if unavailable, replaced by ``cpu``.
    """
    for kind in BACKENDS if wanted == "auto" else (wanted,):
        names = graphics_cards(kind) if kind in BACKENDS else []
        if names:
            notice(f"renders on {', '.join(names)} ({kind})")
            return kind
    if wanted in BACKENDS:
        notice(f"{wanted} is not available here; renders on the CPU")
    else:
        notice("renders on the CPU")
    return "cpu"


def use_device(scene: bpy.types.Scene, kind: str) -> None:
    """Make Cycles render ``scene`` on all graphics cards of ``kind``; on the CPU if there are none, or kind is none."""
    chosen = _devices(kind) if kind in BACKENDS else []
    if chosen:
        preferences = compat.cycles_preferences()
        preferences.compute_device_type = BACKENDS[kind]
        # The CPU beside the cards would only slow down renders as small as these.
        for device in preferences.devices:
            device.use = any(device.id == other.id for other in chosen)
    scene.cycles.device = "GPU" if chosen else "CPU"


def _devices(kind: str) -> list[bpy.types.PropertyGroup]:
    preferences = compat.cycles_preferences()
    backend = BACKENDS[kind]
    if preferences is None or backend not in {item[0] for item in preferences.get_device_types(bpy.context)}:
        return []
    try:
        return [device for device in preferences.get_devices_for_type(backend) if device.type == backend]
    except (RuntimeError, ValueError):
        # A driver that cannot be queried is unusable.
        return []


PROBE_SECONDS = 300
"""Without a graphics card the first image after an update of Blender or Mesa compiles for a minute."""

_MARK = "physgen-graphics:"
_PROBE = f"""
import bpy, tempfile, pathlib
scene = bpy.data.scenes.new("probe")
scene.render.engine = "BLENDER_EEVEE" if bpy.app.version >= (5, 0) else "BLENDER_EEVEE_NEXT"
scene.render.resolution_x = scene.render.resolution_y = 4
scene.eevee.taa_render_samples = 1
camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
scene.collection.objects.link(camera)
scene.camera = camera
with tempfile.TemporaryDirectory() as folder:
    scene.render.filepath = str(pathlib.Path(folder) / "probe.png")
    bpy.ops.render.render(write_still=True, scene=scene.name)
    drawn = pathlib.Path(scene.render.filepath).is_file()
import gpu, os, sys
if drawn:
    sys.stdout.write("\\n{_MARK}" + gpu.platform.renderer_get() + "\\n")
    sys.stdout.flush()
os._exit(0)
"""


@functools.cache
def require_graphics() -> str:
    """Return the name of the graphics card or software renderer.

    Blender crashes if there is neither, so a separate process draws a tiny image, once per rendering process, as
    drivers may be updated meanwhile. Raises RenderError with a remedy.
    """
    start = [bpy.app.binary_path, *compat.HEADLESS, "--python-expr"] if bpy.app.binary_path else [sys.executable, "-c"]
    # Blender leaves its crash report in the temporary folder.
    with tempfile.TemporaryDirectory(prefix=scratch_prefix()) as folder:
        try:
            result = subprocess.run(
                [*start, _PROBE],
                stdin=subprocess.DEVNULL,
                capture_output=True,
                timeout=PROBE_SECONDS,
                env={**child_environment(), "TMPDIR": folder, "TEMP": folder},
                cwd=folder,
                check=False,
                creationflags=NO_WINDOW,
            )
        except (OSError, subprocess.TimeoutExpired) as error:
            raise RenderError(f"whether Blender can draw is unknown ({error}); use --engine cycles") from error
    printed = result.stdout.decode(errors="replace").splitlines()
    names = [line.removeprefix(_MARK) for line in printed if line.startswith(_MARK)]
    if not names:
        raise RenderError(
            "EEVEE needs a graphics card or Mesa's EGL, and Blender found neither: install libegl1 and "
            "libgl1-mesa-dri (Debian's names), or use --engine cycles"
        )
    return names[0].strip()


EEVEE_STEPS = 8
"""Time steps of motion blur in EEVEE."""

Channels = dict[str, NDArray[np.float32]]


def set_up_passes(scene: bpy.types.Scene) -> None:
    """Set up what every engine needs: transparent background, border only, raw linear values."""
    render = scene.render
    render.film_transparent = True
    render.use_compositing = render.use_sequencer = render.use_motion_blur = False
    render.use_border = render.use_crop_to_border = True
    scene.view_settings.view_transform = "Standard"
    compat.set_exr(render.image_settings)


def open_shutter(scene: bpy.types.Scene, share: float, samples: int) -> None:
    """Blur motion in the ``share`` of a frame interval before the frame, 0 for none, with so many samples.

    EEVEE's number of samples stays; they are spread over at least ``EEVEE_STEPS`` time steps.
    """
    settings = scene.render
    settings.use_motion_blur = share > 0
    if settings.engine == "CYCLES":
        scene.cycles.samples = samples
    else:
        # Without its screen-space blur, which smears outlines over the ground.
        scene.eevee.motion_blur_steps, scene.eevee.motion_blur_max = EEVEE_STEPS, 0
    if share > 0:
        settings.motion_blur_shutter, settings.motion_blur_position = share, "END"


def render_passes(scene: bpy.types.Scene, frame: int, box: Box, folder: Path) -> Channels:
    """Render ``box`` of ``scene`` at ``frame``; return channels (h, w) of the box such as ``Combined.R``.

    ``folder`` takes the temporary file. Raises RenderError if Blender fails.
    """
    settings = scene.render
    width, height = settings.resolution_x, settings.resolution_y
    # Blender rounds borders down to whole pixels; a quarter pixel keeps rounding on the right side.
    settings.border_min_x, settings.border_max_x = (box.x0 + 0.25) / width, min((box.x1 + 0.25) / width, 1.0)
    settings.border_min_y = (height - box.y1 + 0.25) / height
    settings.border_max_y = min((height - box.y0 + 0.25) / height, 1.0)
    path = folder / "layers.exr"
    path.unlink(missing_ok=True)
    settings.filepath = str(path)
    scene.frame_set(frame)
    try:
        # The operator renders its scene at the frame of the context's scene.
        with compat.active_scene(scene):
            bpy.ops.render.render(write_still=True, scene=scene.name)
    except RuntimeError as error:
        raise RenderError(f"frame {frame}: Blender could not render it: {error}") from error
    try:
        channels = read_layers(path)
    except InputError as error:
        # Blender does not report a failed write, and a full disk is the usual reason.
        raise RenderError(
            f"frame {frame}: Blender wrote no usable image; free space for temporary files, then run again ({error})"
        ) from error
    if next(iter(channels.values())).shape != (box.height, box.width):
        found = next(iter(channels.values())).shape
        raise RenderError(f"frame {frame}: Blender rendered {found} pixels instead of {(box.height, box.width)}")
    return channels


def stack(channels: Channels, name: str) -> NDArray[np.float32]:
    """Return the pass ``name`` as (h, w, 3). Raises RenderError if it is missing."""
    try:
        return np.stack([channels[f"{name}.{c}"] for c in "RGB"], axis=-1)
    except KeyError:
        raise RenderError(f"Blender wrote no pass {name!r}, only {sorted(channels)}") from None


def set_up_cycles(scene: bpy.types.Scene, options: RenderOptions, *, denoise: bool) -> None:
    """Set up Cycles for ``scene`` on ``options.device``, or on the CPU if that is unavailable."""
    render, cycles = scene.render, scene.cycles
    render.engine = "CYCLES"
    use_device(scene, options.device)
    cycles.samples = options.samples
    cycles.use_adaptive_sampling = False
    cycles.seed, cycles.use_animated_seed = options.seed, False
    # The ratio of light to reference lighting is independent of albedo only without bounces.
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
    """Denoise with OpenImageDenoise if ``wanted`` and available.

    Not with OptiX's denoiser: results would depend on the machine.
    """
    cycles = scene.cycles
    cycles.use_denoising = wanted and compat.denoiser_available()
    if cycles.use_denoising:
        cycles.denoiser = compat.DENOISER
        cycles.denoising_input_passes = "RGB_ALBEDO_NORMAL"
        cycles.denoising_prefilter = "FAST"
        cycles.denoising_quality = "BALANCED"
        cycles.denoising_use_gpu = False


MAX_SUBPIXELS = 8
MAX_DRAWN = 2**24
"""Maximum number of pixels drawn at once, including subpixels; each takes some 60 bytes of graphics memory."""
MAX_ANGLE = 1.2
"""A lamp with a wider spread of directions would shine through the ground beside it."""


def set_up_eevee(scene: bpy.types.Scene, options: RenderOptions) -> None:
    """Set up EEVEE for ``scene`` with soft light."""
    render, eevee = scene.render, scene.eevee
    render.engine = compat.eevee()
    # Every sample is at another position within all pixels, and in another direction within every lamp.
    eevee.taa_render_samples = options.samples
    render.filter_size = 1.0
    render.use_high_quality_normals = True
    eevee.use_raytracing = eevee.use_fast_gi = False
    eevee.clamp_surface_direct = eevee.clamp_surface_indirect = 0.0
    eevee.use_shadows = True
    eevee.shadow_pool_size = "1024"
    # Unlit: the lamps include the sky. A scene without a world would be given one.
    scene.world = bpy.data.worlds.new("no light")
    tree = compat.node_tree(scene.world)
    shader, output = tree.nodes.new("ShaderNodeBackground"), tree.nodes.new("ShaderNodeOutputWorld")
    shader.inputs["Strength"].default_value = 0.0
    tree.links.new(shader.outputs["Background"], output.inputs["Surface"])


def set_up_colours(scene: bpy.types.Scene, options: RenderOptions) -> None:
    """Set up EEVEE for the colours of ``scene``, rendered at ``subpixels`` times the resolution."""
    set_up_eevee(scene, options)
    # All its samples would be alike: with this filter they lie in the middle of the pixel.
    scene.eevee.taa_render_samples, scene.render.filter_size = 1, 0.0


def subpixels(options: RenderOptions) -> int:
    """Return samples along a pixel's side. EEVEE has no box filter, and any other includes neighbouring pixels."""
    return int(np.clip(round(options.samples**0.5), 1, MAX_SUBPIXELS))


def colours(
    scene: bpy.types.Scene, layers: tuple[str, str], frame: int, box: Box, side: int, folder: Path
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Return the first pass of ``layers`` (h, w, 3), coverage (h, w), and red and green of the second pass (h, w, 2) in
    ``box``, averaged over ``side`` times ``side`` subpixels.

    ``folder`` takes temporary files. Raises RenderError if Blender fails.
    """
    rows = max(MAX_DRAWN // (box.width * side * side), 1)
    parts = []
    for top in range(box.y0, box.y1, rows):
        strip = Box(box.x0 * side, top * side, box.x1 * side, min(top + rows, box.y1) * side)
        channels = render_passes(scene, frame, strip, folder)
        second = [channels[f"{layers[1]}.{channel}"] for channel in "RG"]
        whole = np.dstack([stack(channels, layers[0]), channels["Combined.A"], *second])
        height, width = whole.shape[0] // side, whole.shape[1] // side
        parts.append(whole.reshape(height, side, width, side, 6).mean(axis=(1, 3)))
    pixels = np.concatenate(parts).astype(np.float32, copy=False)
    return pixels[..., :3], pixels[..., 3], pixels[..., 4:]


def add_lamp(scenes: list[bpy.types.Scene], lamp: SkyLamp, *, finest: float) -> None:
    """Add ``lamp`` to ``scenes``; ``finest`` (metres) is the required resolution of its shadows."""
    data = bpy.data.lights.new("sky", "SUN")
    irradiance = float(lamp.irradiance.max())
    data.energy, data.color = irradiance, (lamp.irradiance / max(irradiance, 1e-30)).tolist()
    data.angle = min(lamp.angle, MAX_ANGLE)
    sharpen(data, finest=finest)
    item = bpy.data.objects.new("sky", data)
    item.rotation_euler = turn_to(lamp.direction).to_euler()
    for scene in scenes:
        scene.collection.objects.link(item)


def sharpen(data: bpy.types.Light, *, finest: float) -> None:
    """Make soft shadows of the sun lamp ``data`` from hard ones, one for each sample's direction.

    EEVEE's own soft shadows trace rays through one shadow map and leak at contacts. ``finest``: size of a pixel of the
    map, metres; finer maps cost memory and time.
    """
    data.use_shadow, data.use_shadow_jitter, data.shadow_jitter_overblur = True, True, 0.0
    data.shadow_filter_radius = 1.0
    data.shadow_maximum_resolution = float(np.clip(finest, 1e-5, 1e3))


@contextlib.contextmanager
def unseen(collection: bpy.types.Collection) -> Iterator[None]:
    """Make the contents of ``collection`` cast shadows but invisible to the camera.

    Cycles has ``indirect_only`` for it, which EEVEE lacks.
    """
    items = [item for item in collection.all_objects if item.visible_camera]
    for item in items:
        item.visible_camera = False
    try:
        yield
    finally:
        for item in items:
            item.visible_camera = True
