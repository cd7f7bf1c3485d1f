# SPDX-License-Identifier: MIT
"""The page: what was found, stage by stage, each with its picture and what corrects it. One file that loads nothing."""

from __future__ import annotations

import base64
import hashlib
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from ...errors import InputError
from ...page.markup import Markup, element, join
from ...page.style import page_style
from ...scene.environment import read_environment
from ...scene.folder import SceneFolder
from ...scene.meshes import read_mesh
from ...scene.model import SceneObject
from ...version import VERSION
from ..layers import Layers
from ..light.estimate import described
from . import drawing
from .body_picture import turntable

REPORT_FILE = "report.html"
WIDTH = 900
"""Pixels of a picture that goes across the page."""
QUALITY = 88
_EXTRA = """
img{display:block;max-width:100%;height:auto;border-radius:6px}
.gallery{display:grid;grid-template-columns:repeat(auto-fill,minmax(200px,1fr));gap:16px;margin-top:20px}
.gallery figure{margin:0}
"""


@dataclass(frozen=True, kw_only=True)
class Told:
    """What the page tells besides the scene: what was said meanwhile, and the inputs that decided it.

    layers: as the photo was taken apart. shapes: what each object's body was taken for. sources: where numbers come
    from, by what they are.
    """

    pixels: NDArray[np.uint8]
    layers: Layers
    shapes: Sequence[str]
    notices: Sequence[str]
    sources: Mapping[str, str]


def write_report(path: Path, folder: SceneFolder, told: Told) -> None:
    """Write the page of the scene ``folder`` to ``path``."""
    path.write_text(page(folder, told), encoding="utf-8")


def page(folder: SceneFolder, told: Told) -> str:
    """The page as text."""
    style = page_style() + _EXTRA
    allowed = base64.b64encode(hashlib.sha256(style.encode()).digest()).decode("ascii")
    policy = f"default-src 'none'; style-src 'sha256-{allowed}'; img-src data:; base-uri 'none'; form-action 'none'"
    names = [item.name for item in folder.scene.objects]
    head = element(
        "head",
        element("meta", charset="utf-8"),
        element("meta", http_equiv="Content-Security-Policy", content=policy),
        element("meta", name="viewport", content="width=device-width, initial-scale=1"),
        element("meta", name="color-scheme", content="light dark"),
        element("title", f"Reconstruction: {', '.join(names)}"),
        element("style", Markup(style)),
    )
    body = element(
        "body",
        element(
            "header",
            element("p", "From a photo to a scene, stage by stage", class_="eyebrow"),
            element("h1", _listed(names)),
            _notes(told.notices),
        ),
        element(
            "main",
            _outlines(told, names),
            _hidden(told, names),
            _shadows(told),
            _background(told),
            _camera(folder, told),
            _shapes(folder, told),
            _light(folder),
            _physics(folder),
        ),
        element("footer", element("p", f"PhysGen {VERSION}")),
    )
    return f"<!DOCTYPE html>\n{element('html', head, body, lang='en')}\n"


def _listed(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def _notes(notices: Sequence[str]) -> Markup | None:
    if not notices:
        return None
    items = join(element("li", notice) for notice in dict.fromkeys(notices))
    return element("div", element("h2", "What was said meanwhile"), element("ul", items), class_="notes")


def _image(pixels: NDArray[np.uint8], text: str, width: int = WIDTH) -> Markup:
    shown = drawing.shrunk(pixels, width)
    buffer = io.BytesIO()
    Image.fromarray(shown).save(buffer, format="JPEG", quality=QUALITY, subsampling=0)
    data = base64.b64encode(buffer.getvalue()).decode("ascii")
    height, across = shown.shape[:2]
    return element("img", src=f"data:image/jpeg;base64,{data}", alt=text, width=across, height=height)


def _figure(pixels: NDArray[np.uint8], caption: str, width: int = WIDTH) -> Markup:
    return element("figure", _image(pixels, caption, width), element("figcaption", caption))


def _section(title: str, text: str, *parts: Markup | None) -> Markup:
    return element("section", element("h2", title), element("p", text), *parts)


def _outlines(told: Told, names: Sequence[str]) -> Markup:
    picture = drawing.outlined(told.pixels, told.layers.seen, fill=0.3, names=names)
    return _section(
        "What was cut out",
        "The outline of each object as far as the photo shows it. Where it is wrong, paint a mask.",
        _figure(picture, "Outlines over the photo."),
    )


def _hidden(told: Told, names: Sequence[str]) -> Markup:
    layers = told.layers
    order = " before ".join(names[i] for i in layers.front_to_back)
    single = [
        _figure(drawing.cut_out(layers.colours[i], layers.seen[i], layers.full[i]), names[i], 320)
        for i in layers.front_to_back
    ]
    steps = [_figure(picture, f"After {names[i]} is taken out.") for i, picture in layers.uncovered.items()]
    text = "Each object alone; what another one hides was completed by its shape, and is hatched."
    return _section(
        "Who stands before whom",
        f"From the front to the back: {order}. {text}" if len(names) > 1 else text,
        element("div", *single, class_="gallery"),
        *steps,
    )


def _shadows(told: Told) -> Markup:
    picture = drawing.shadowed(told.pixels, told.layers.shadows, told.layers.holes)
    return _section(
        "Shadows",
        "What each object darkens, in its colour. The white line surrounds all that is filled in the background.",
        _figure(picture, "Shadows and holes over the photo in grey."),
    )


def _background(told: Told) -> Markup:
    return _section(
        "The place without the objects",
        "Outside the white line of the picture before, it is the photo to the last bit.",
        _figure(told.layers.background, "The background."),
    )


def _camera(folder: SceneFolder, told: Told) -> Markup:
    scene = folder.scene
    camera, ground = scene.camera, scene.ground
    assert ground is not None
    spacing = drawing.grid_spacing(max(item.size_m for item in scene.objects))
    picture = drawing.ground_grid(told.pixels, camera, ground, spacing)
    longer = max(camera.width, camera.height)
    fov = math.degrees(2 * math.atan(longer / 2 / camera.fx))
    forward = np.asarray(camera.world_from_camera)[:3, 2]
    pitch = math.degrees(math.asin(max(-1.0, min(1.0, float(-forward @ ground.unit_normal)))))
    height = float(ground.heights(camera.position))
    facts = [
        ("Field of view", f"{fov:.0f}°", told.sources.get("focal length", "")),
        ("Looks down by", f"{pitch:.0f}°", told.sources.get("ground", "")),
        ("Height over the ground", f"{height:.2g} m", told.sources.get("scale", "")),
    ]
    table = element(
        "dl",
        *(
            element("div", element("dt", name), element("dd", value, element("small", why)))
            for name, value, why in facts
        ),
        class_="facts",
    )
    return _section(
        "Camera and ground",
        f"A grid of {spacing:g} m on the ground, the horizon in yellow. The lines should lie on the ground like tiles; "
        "where they do not, set the horizon or the pitch.",
        _figure(picture, "The ground as the camera is taken to see it."),
        table,
    )


def _shapes(folder: SceneFolder, told: Told) -> Markup:
    figures = []
    for item, shape in zip(folder.scene.objects, told.shapes, strict=True):
        mesh = read_mesh(folder.file(item.mesh))
        mesh.apply_transform(np.asarray(item.world_from_mesh))
        extent = np.ptp(np.asarray(mesh.vertices), axis=0) * 100
        size = " × ".join(f"{value:.3g}" for value in extent)
        text = f"{item.name}: {shape}, {size} cm, {len(mesh.vertices)} vertices"
        figures.append(_figure(turntable(mesh), f"{text}. From the front, the right, behind, and above.", 880))
    return _section(
        "Shape and texture",
        "What no camera saw is a guess: the kind, the shape, the thickness and the back can be told.",
        *figures,
    )


def _light(folder: SceneFolder) -> Markup:
    light = folder.scene.light
    picture = None
    if light.environment is not None:
        try:
            radiance = read_environment(folder.file(light.environment))
        except InputError:
            radiance = None
        if radiance is not None:
            shown = drawing.tone_mapped(np.asarray(radiance), 480)
            picture = _figure(shown, "The environment, all around; twice its mean is white.", 480)
    return _section("Light", f"{described(light).capitalize()}.", picture)


def _physics(folder: SceneFolder) -> Markup:
    head = ("Object", "Preset", "Density kg/m³", "Young's modulus Pa", "Size m", "Filled", "Friction")
    rows = [element("tr", element("th", item.name), *(element("td", cell) for cell in _cells(item, folder)))
            for item in folder.scene.objects]  # fmt: skip
    table = element(
        "table",
        element("thead", element("tr", *(element("th", name) for name in head))),
        element("tbody", *rows),
    )
    return _section("Matter", "What the simulation begins with.", table)


def _cells(item: SceneObject, folder: SceneFolder) -> list[str]:
    ground = folder.scene.ground
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
