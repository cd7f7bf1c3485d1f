# SPDX-License-Identifier: GPL-3.0-or-later
"""Properties of rendering into the photo, and ``RenderOptions`` made from them.

Blender reads the class's annotations as properties, so they must not be postponed to strings.
"""

import bpy
from bpy.props import EnumProperty, IntProperty, StringProperty

from ...sim.validation import range_of
from ..paths import RELATIVE
from ..render.render_options import RenderOptions
from ..text import decimal
from .generated_properties import from_field, help_text, percentage, switch

LEAST_F_NUMBER = range_of(RenderOptions, "f_number")[0]
"""Of a real lens; 0 stands for none."""

FRAME_FORMATS = {"png": ("png", None), "png16": ("png", 16), "exr": ("exr", None), "exr_layers": ("exr-layers", None)}
"""Menu entry → type of frame, and bits a channel unless default."""


def _on_f_number(self: "PHYSGEN_PG_rendering", context: bpy.types.Context) -> None:
    if 0 < self.f_number < LEAST_F_NUMBER:
        self.f_number = LEAST_F_NUMBER


class PHYSGEN_PG_rendering(bpy.types.PropertyGroup):
    """Settings of rendering a scene into its photo."""

    engine: from_field(
        RenderOptions,
        "engine",
        "Engine",
        items=[
            ("cycles", "Cycles", "Traces rays"),
            ("eevee", "EEVEE", "Rasterises on the graphics card: nearly the same image; slow without one"),
        ],
    )
    device: from_field(
        RenderOptions,
        "device",
        "Device",
        "Render device of Cycles; falls back to the CPU",
        items=[
            ("cpu", "CPU", "CPU: frames are small, and the graphics card stays free for Blender's windows"),
            ("auto", "Automatic", "A graphics card, if there is one that Cycles can use"),
            ("optix", "OptiX", "NVIDIA cards with ray tracing hardware"),
            ("cuda", "CUDA", "NVIDIA cards"),
            ("hip", "HIP", "AMD cards"),
            ("oneapi", "oneAPI", "Intel cards"),
            ("metal", "Metal", "Apple's graphics"),
        ],
    )
    samples: from_field(
        RenderOptions,
        "samples",
        "Samples",
        help_text(RenderOptions, "samples"),
        default=0,
        min=0,
        soft_max=256,
    )
    own_samples: switch("samples", "Own Samples", "Choose the number of samples; off: the engine's usual one", 64)
    scale: from_field(
        RenderOptions,
        "scale",
        "Scale",
        "Share of the photo's resolution",
        min=0.05,
        soft_max=1.0,
        subtype="FACTOR",
    )
    size: percentage("scale", "Size", "Share of the photo's resolution", low=5.0, high=400.0)
    format: EnumProperty(
        name="Format",
        description="File format of the frames. PNG and EXR do not mix: the second goes to a folder beside the first",
        items=[
            ("png", "PNG", "8 bits a channel, as in the photo"),
            ("png16", "PNG 16 Bit", "For later colour grading"),
            ("exr", "EXR", "Linear light, 16-bit floats: keeps highlights above white"),
            (
                "exr_layers",
                "EXR Layers",
                "Also objects, ground, shadow, depth, object ids and flow, for compositing",
            ),
        ],
    )
    video: EnumProperty(
        name="Video",
        description="Video format that Render Video writes beside the frames",
        items=[("mp4", "MP4", "H.264: plays everywhere"), ("webm", "WebM", "VP9: for web pages")],
    )
    output: StringProperty(
        name="Output",
        description="Folder of the frames; // is beside the .blend",
        subtype="DIR_PATH",
        default="//physgen_render",
        options=RELATIVE,
    )
    motion_blur: from_field(RenderOptions, "motion_blur", "Motion Blur", subtype="FACTOR")
    grain: from_field(RenderOptions, "grain", "Grain")
    match_sharpness: from_field(RenderOptions, "match_sharpness", "Sharpness")
    reflections: from_field(
        RenderOptions,
        "reflections",
        "Reflections",
        f"{help_text(RenderOptions, 'reflections')} (ground.reflectivity of the scene folder)",
    )
    f_number: from_field(
        RenderOptions,
        "f_number",
        "F-Number",
        help_text(RenderOptions, "f_number"),
        min=0.0,
        soft_max=22.0,
        precision=1,
        step=10,
        update=_on_f_number,
    )
    blurs_depth: switch("f_number", "Depth of Field", "Blur what is out of focus, as a lens does", 2.8)
    own_focus: switch(
        "focus_distance", "Own Focus", "Choose the plane of focus; off: each object is in focus at rest", 1.0
    )
    focus_distance: from_field(
        RenderOptions,
        "focus_distance",
        "Focus",
        "Distance of the plane of focus",
        soft_max=10.0,
    )
    farm: EnumProperty(
        name="Where",
        description="Program that runs the job",
        items=[
            ("local", "This Machine", "Baked and rendered here, several tasks at a time; resumed when run again"),
            ("flamenco", "Flamenco", "Written as a job of Blender Studio's render farm"),
            ("slurm", "SLURM", "Written as scripts for a cluster; submit.sh hands them over"),
        ],
    )
    farm_folder: StringProperty(
        name="Farm Folder",
        description="Folder of the job and its results; all machines of a farm need it at the same path",
        subtype="DIR_PATH",
        default="//physgen_farm",
        options=RELATIVE,
    )
    farm_chunk: IntProperty(name="Frames per Task", description="Frames that one task renders", default=24, min=1)
    result: StringProperty(name="Result", description="Last rendered file", subtype="FILE_PATH", options=RELATIVE)


def render_options(rendering: PHYSGEN_PG_rendering) -> RenderOptions:
    """Return the options set in the panel. Raises InputError for invalid combinations."""
    kind, bits = FRAME_FORMATS[rendering.format]
    return RenderOptions(
        engine=rendering.engine,
        device=rendering.device if rendering.engine == "cycles" else RenderOptions.device,
        samples=rendering.samples or RenderOptions.samples,
        scale=decimal(rendering.scale),
        format=kind,
        bits=bits,
        motion_blur=decimal(rendering.motion_blur),
        grain=rendering.grain,
        match_sharpness=rendering.match_sharpness,
        reflections=rendering.reflections,
        f_number=decimal(rendering.f_number) or None,
        focus_distance=decimal(rendering.focus_distance) or None,
    )
