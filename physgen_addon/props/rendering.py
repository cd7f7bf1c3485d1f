# SPDX-License-Identifier: GPL-3.0-or-later
"""How a scene with a photo is rendered into it: what the panel shows, and ``RenderOptions`` made of it.

Blender reads the class's annotations as properties, so they must not be postponed to strings.
"""

import dataclasses

import bpy
from bpy.props import BoolProperty, EnumProperty, FloatProperty, IntProperty, StringProperty

from ..bridge.options import RenderOptions
from ..paths import RELATIVE
from ..typed import decimal

LEAST_F_NUMBER = 0.5
"""What is less would be a lens that nobody can build; 0 stands for none."""

FRAME_FORMATS = {"png": ("png", None), "png16": ("png", 16), "exr": ("exr", None), "exr_layers": ("exr-layers", None)}
"""Choice → kind of frame, and bits a channel where these are not the usual ones."""

_HELP = {item.name: item.metadata.get("help", "") for item in dataclasses.fields(RenderOptions)}


def _says(option: str) -> str:
    """What the command line says of ``option``, as a tooltip."""
    return _HELP[option][:1].upper() + _HELP[option][1:]


def _on_f_number(self: "PHYSGEN_PG_rendering", context: bpy.types.Context) -> None:
    if 0 < self.f_number < LEAST_F_NUMBER:
        self.f_number = LEAST_F_NUMBER


class PHYSGEN_PG_rendering(bpy.types.PropertyGroup):
    """How a scene with a photo is rendered into it."""

    engine: EnumProperty(
        name="Engine",
        description="Render engine",
        items=[
            ("cycles", "Cycles", "Traces rays"),
            ("eevee", "EEVEE", "Draws with the graphics card: much the same picture; slow without one"),
        ],
    )
    device: EnumProperty(
        name="Device",
        description="Where Cycles renders; what is not there falls back to the processor",
        items=[
            ("cpu", "CPU", "The processor: frames are small, and it leaves the graphics card to Blender's windows"),
            ("auto", "Automatic", "A graphics card, if there is one that Cycles can use"),
            ("optix", "OptiX", "NVIDIA cards with hardware for rays"),
            ("cuda", "CUDA", "NVIDIA cards"),
            ("hip", "HIP", "AMD cards"),
            ("oneapi", "oneAPI", "Intel cards"),
            ("metal", "Metal", "Apple's graphics"),
        ],
    )
    samples: IntProperty(
        name="Samples",
        description=f"{_says('samples')}; 0 is the engine's own choice",
        min=0,
        max=4096,
        soft_max=256,
    )
    scale: FloatProperty(name="Size", description=_says("scale"), default=1.0, min=0.05, max=4.0, soft_max=1.0)
    format: EnumProperty(
        name="Format",
        description="Of the frames' files; each format needs an output folder of its own",
        items=[
            ("png", "PNG", "8 bits a channel, as the photo has them"),
            ("png16", "PNG 16 Bit", "Smooth where colours are changed afterwards"),
            ("exr", "EXR", "Linear light, 16-bit floats: keeps what is brighter than white"),
            (
                "exr_layers",
                "EXR Layers",
                "Also objects, ground, shadow, depth, object ids and flow, for compositing",
            ),
        ],
    )
    video: EnumProperty(
        name="Video",
        description="What Render Video writes beside the frames",
        items=[("mp4", "MP4", "H.264: plays everywhere"), ("webm", "WebM", "VP9: for web pages")],
    )
    output: StringProperty(
        name="Output",
        description="Folder of the frames; // is beside the .blend",
        subtype="DIR_PATH",
        default="//physgen_render",
        options=RELATIVE,
    )
    motion_blur: FloatProperty(
        name="Motion Blur",
        description=_says("motion_blur"),
        default=RenderOptions.motion_blur,
        min=0.0,
        max=1.0,
        subtype="FACTOR",
    )
    grain: BoolProperty(name="Grain", description=_says("grain"), default=RenderOptions.grain)
    match_sharpness: BoolProperty(
        name="Sharpness", description=_says("match_sharpness"), default=RenderOptions.match_sharpness
    )
    reflections: BoolProperty(
        name="Reflections",
        description=f"{_says('reflections')}, which is the scene folder's ground.reflectivity",
        default=RenderOptions.reflections,
    )
    f_number: FloatProperty(
        name="F-Number",
        description=f"{_says('f_number')}; 0: off",
        default=0.0,
        min=0.0,
        max=64.0,
        soft_max=22.0,
        precision=1,
        step=10,
        update=_on_f_number,
    )
    focus_distance: FloatProperty(
        name="Focus",
        description="Distance of the plane of focus; 0: each object is in focus where it rests",
        min=0.0,
        soft_max=10.0,
        unit="LENGTH",
    )
    result: StringProperty(name="Result", description="What was rendered last", subtype="FILE_PATH", options=RELATIVE)


def render_options(rendering: PHYSGEN_PG_rendering) -> RenderOptions:
    """What the panel says. Raises InputError for what does not go together."""
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


CLASSES = (PHYSGEN_PG_rendering,)
