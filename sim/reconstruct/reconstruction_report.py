# SPDX-License-Identifier: MIT
"""The HTML report of a reconstruction: one self-contained file with a picture of every stage."""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from ..errors import InputError
from ..html import page_head, prose, render
from ..page_style import page_style
from ..scene.environment import read_environment
from ..scene.folder import Scene
from ..scene.model import SceneObject
from ..version import VERSION
from . import report_pictures
from .lighting.light_estimate import describe_sun
from .photo_layers import Layers
from .turntable import sheet, turned_object

REPORT_FILE = "report.html"
WIDTH = 900
"""Width in pixels of a full-width picture."""
TURNTABLE_WIDTH = 1800
QUALITY = 88
_TEMPLATE = Path(__file__).with_name("reconstruction_report.html")
_EXTRA = """
img{display:block;max-width:100%;height:auto;border-radius:6px}
.gallery{display:grid;grid-template-columns:repeat(auto-fill,minmax(200px,1fr));gap:16px;margin-top:20px}
.gallery figure{margin:0}
"""


@dataclass(frozen=True, kw_only=True)
class Figure:
    """An embedded picture. data: its ``data:`` URL; width, height: pixels."""

    caption: str
    data: str
    width: int
    height: int


@dataclass(frozen=True, kw_only=True)
class Section:
    """A stage of the report. gallery: figures side by side; facts: (name, value, source); rows: of a table."""

    title: str
    text: str
    gallery: Sequence[Figure] = ()
    figures: Sequence[Figure] = ()
    facts: Sequence[tuple[str, str, str]] = ()
    columns: Sequence[str] = ()
    rows: Sequence[Sequence[str]] = ()


@dataclass(frozen=True, kw_only=True)
class ReportData:
    """Data of the report besides the scene.

    layers: of the photo. shapes: of each object's body. notices: of the run. sources: of the camera's numbers, by name.
    """

    pixels: NDArray[np.uint8]
    layers: Layers
    shapes: Sequence[str]
    notices: Sequence[str]
    sources: Mapping[str, str]


def write_report(path: Path, folder: Scene, data: ReportData) -> None:
    """Write the report of the scene ``folder`` to ``path``."""
    path.write_text(report_html(folder, data), encoding="utf-8")


def report_html(folder: Scene, data: ReportData) -> str:
    """Return the report as HTML."""
    names = [item.name for item in folder.model.objects]
    return render(
        _TEMPLATE,
        head=page_head(f"Reconstruction: {', '.join(names)}", page_style() + _EXTRA),
        title=_listed(names),
        notices=list(dict.fromkeys(data.notices)),
        sections=[
            _outlines(data, names),
            _hidden(data, names),
            _shadows(data),
            _background(data),
            _camera(folder, data),
            _shapes(folder, data),
            _light(folder),
            _physics(folder),
        ],
        prose=prose,
        version=VERSION,
    )


def _listed(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def _figure(pixels: NDArray[np.uint8], caption: str, width: int = WIDTH) -> Figure:
    shown = report_pictures.shrunk(pixels, width)
    buffer = io.BytesIO()
    Image.fromarray(shown).save(buffer, format="JPEG", quality=QUALITY, subsampling=0)
    data = base64.b64encode(buffer.getvalue()).decode("ascii")
    height, across = shown.shape[:2]
    return Figure(caption=caption, data=f"data:image/jpeg;base64,{data}", width=across, height=height)


def _outlines(data: ReportData, names: Sequence[str]) -> Section:
    picture = report_pictures.outlined(data.pixels, data.layers.seen, fill=0.3, names=names)
    return Section(
        title="Segmentation",
        text="The visible part of each object. If it is wrong, paint a mask.",
        figures=[_figure(picture, "Masks over the photo.")],
    )


def _hidden(data: ReportData, names: Sequence[str]) -> Section:
    layers = data.layers
    order = ", ".join(names[i] for i in layers.front_to_back)
    single = [
        _figure(report_pictures.cut_out(layers.colours[i], layers.seen[i], layers.full[i]), names[i], 320)
        for i in layers.front_to_back
    ]
    steps = [_figure(picture, f"After {names[i]} is removed.") for i, picture in layers.uncovered.items()]
    text = "Each object alone; parts hidden by another one were completed by shape, and are hatched."
    return Section(
        title="Occlusion order",
        text=f"From the front to the back: {order}. {text}" if len(names) > 1 else text,
        gallery=single,
        figures=steps,
    )


def _shadows(data: ReportData) -> Section:
    picture = report_pictures.shadowed(data.pixels, data.layers.shadows, data.layers.holes)
    return Section(
        title="Shadows",
        text="The shadow of each object, in its colour. The white line surrounds all inpainted pixels.",
        figures=[_figure(picture, "Shadows and holes over the photo in grey.")],
    )


def _background(data: ReportData) -> Section:
    return Section(
        title="Background",
        text="Outside the white line of the previous picture it equals the photo bit for bit.",
        figures=[_figure(data.layers.background, "The background.")],
    )


def _camera(folder: Scene, data: ReportData) -> Section:
    scene = folder.model
    camera, ground = scene.camera, scene.ground
    assert ground is not None
    spacing = report_pictures.grid_spacing(max(item.size_m for item in scene.objects))
    picture = report_pictures.ground_grid(data.pixels, camera, ground, spacing)
    longer = max(camera.width, camera.height)
    fov = math.degrees(2 * math.atan(longer / 2 / camera.fx))
    forward = np.asarray(camera.world_from_camera)[:3, 2]
    pitch = math.degrees(math.asin(max(-1.0, min(1.0, float(-forward @ ground.unit_normal)))))
    height = float(ground.heights(camera.position))
    facts = [
        ("Field of view", f"{fov:.0f}°", data.sources.get("focal length", "")),
        ("Looks down by", f"{pitch:.0f}°", data.sources.get("ground", "")),
        ("Height over the ground", f"{height:.2g} m", data.sources.get("scale", "")),
    ]
    return Section(
        title="Camera and ground",
        text=f"A grid of {spacing:g} m on the ground, the horizon in yellow. The lines should lie on the ground like "
        "tiles; if they do not, set the horizon or the pitch.",
        figures=[_figure(picture, "The estimated ground.")],
        facts=facts,
    )


def _shapes(folder: Scene, data: ReportData) -> Section:
    figures = []
    for item, shape in zip(folder.model.objects, data.shapes, strict=True):
        body = turned_object(folder, item)
        extent = np.ptp(body.vertices, axis=0) * 100
        size = " × ".join(f"{value:.3g}" for value in extent)
        text = f"{item.name}: {shape}, {size} cm, {len(body.vertices)} vertices"
        figures.append(_figure(sheet(body), f"{text}.", TURNTABLE_WIDTH))
    return Section(
        title="Shape and texture",
        text="Each body from eight sides, without light: at 0° as photographed, then around it to the right; the dark "
        "patch is where it stands. Unseen surfaces are a guess: kind, shape, thickness and back can be set.",
        figures=figures,
    )


def _light(folder: Scene) -> Section:
    light = folder.model.light
    figures = []
    if light.environment is not None:
        try:
            radiance = read_environment(folder.file(light.environment))
        except InputError:
            radiance = None
        if radiance is not None:
            shown = report_pictures.tone_mapped(np.asarray(radiance), 480)
            figures.append(_figure(shown, "The environment, all around; twice its mean is white.", 480))
    ground = folder.model.ground
    facts = []
    if ground is not None and ground.reflectivity > 0.0:
        text = f"{ground.reflectivity:.2g}, roughness {ground.reflection_roughness:.2g}"
        facts = [("The ground mirrors", text, "share at normal incidence, by the objects' mirror images")]
    return Section(title="Light", text=f"{describe_sun(light).capitalize()}.", figures=figures, facts=facts)


def _physics(folder: Scene) -> Section:
    columns = ("Object", "Preset", "Density kg/m³", "Young's modulus Pa", "Size m", "Filled", "Friction")
    rows = [[item.name, *_cells(item, folder)] for item in folder.model.objects]
    return Section(title="Material", text="Initial values of the simulation.", columns=columns, rows=rows)


def _cells(item: SceneObject, folder: Scene) -> list[str]:
    ground = folder.model.ground
    friction = item.friction
    if friction is None and ground is not None:
        friction = ground.friction
    return [
        item.material.preset or "",
        f"{item.material.density:.4g}",
        f"{item.material.youngs_modulus:.3g}",
        f"{item.size_m:.3g}",
        "yes" if item.fill else "no",
        "" if friction is None else f"{friction:.2g}",
    ]
