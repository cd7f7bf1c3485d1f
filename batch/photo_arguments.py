# SPDX-License-Identifier: GPL-3.0-or-later
"""Arguments of the verbs that take a photo apart: what is cut out of it, and how it is read."""

from __future__ import annotations

import argparse
import dataclasses
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from ..sim.app.imported_masks import requests_of_masks
from ..sim.errors import InputError
from ..sim.reconstruct import ObjectRequest, ReconstructOptions
from ..sim.reconstruct.options import BACKS, SHAPES, UP_AXES, Pixel
from ..sim.reconstruct.physics.chat import DEFAULT_KEY_VARIABLE, ChatRequest
from ..sim.scene.equirectangular import FRAMES
from ..sim.scene.model import Vector

Named = tuple[str, Any]


def numbers(text: str, count: int, what: str) -> tuple[float, ...]:
    """``count`` finite numbers with commas between them. Raises ArgumentTypeError that says ``what`` was wanted."""
    try:
        found = tuple(float(part) for part in text.split(","))
    except ValueError:
        found = ()
    if len(found) != count or not all(math.isfinite(n) for n in found):
        raise argparse.ArgumentTypeError(f"{text.strip()!r} is not {what}")
    return found


def box(text: str) -> tuple[float, float, float, float]:
    """A box on the command line."""
    a, b, c, d = numbers(text, 4, "a box x0,y0,x1,y1 in pixels")
    return a, b, c, d


def vector(text: str) -> Vector:
    """A vector on the command line."""
    x, y, z = numbers(text, 3, "a vector x,y,z")
    return x, y, z


def _named(read: Callable[[str], Any], what: str) -> Callable[[str], Named]:
    def parse(text: str) -> Named:
        name, equals, value = text.partition("=")
        if not equals or not name or not value:
            raise argparse.ArgumentTypeError(f"{text!r} is not OBJECT={what}")
        try:
            return name, read(value)
        except ValueError:
            raise argparse.ArgumentTypeError(f"{value!r} is not {what}") from None

    return parse


def _choice(choices: Sequence[str]) -> Callable[[str], str]:
    def read(text: str) -> str:
        if text not in choices:
            raise argparse.ArgumentTypeError(f"{text!r} is none of {', '.join(choices)}")
        return text

    return read


def _mesh_point(text: str) -> tuple[Vector, Pixel]:
    place, at, pixel = text.partition("@")
    if not at:
        raise argparse.ArgumentTypeError(f"{text!r} is not x,y,z@u,v")
    u, v = numbers(pixel, 2, "a place in the photo x,y")
    return vector(place), (u, v)


OF_OBJECTS: dict[str, tuple[str, Callable[[str], Any], str, str]] = {
    "mask": ("mask", Path, "FILE", "a picture that is bright where the object is seen, in place of a box"),
    "kind": ("kind", str, "WORD", "what it is (orange, book, teddy): gives material, thickness, shape"),
    "shape": ("shape", _choice(SHAPES), "|".join(SHAPES), "what its body is taken for"),
    "back": ("back", _choice(BACKS), "|".join(BACKS), "what is behind the outline of an inflated body"),
    "thickness": ("thickness", float, "RATIO", "depth of the body over its width, 0.02 to 3"),
    "mesh": ("mesh", Path, "FILE", "OBJ, GLB, PLY or STL that is fitted to the photo"),
    "mesh-up": ("mesh_up", _choice(UP_AXES), "AXIS", "which axis of that file points up"),
}
"""Flag → field of ObjectRequest, how it is read, what it is called, help. Given as OBJECT=VALUE."""


def add_objects(parser: argparse.ArgumentParser, *, boxes: bool = True) -> None:
    """What is known of single objects. boxes: whether they are told by boxes and lists in their order as well."""
    parser.set_defaults(wrong_usage=parser.error)
    if boxes:
        text = "x0,y0,x1,y1 in pixels of the upright photo, one an object"
        parser.add_argument("--box", type=box, nargs="+", action="extend", default=[], metavar="BOX", help=text)
        text = "names of the objects, in the order of the boxes"
        parser.add_argument("--name", nargs="+", action="extend", default=[], help=text)
        text = "largest extent in metres, one an object; the first sets the scale of the scene"
        parser.add_argument("--size", type=float, nargs="+", action="extend", default=[], metavar="METRES", help=text)
        text = "outlines made elsewhere: a COCO file, or a file or folder of masks by SAM; one object each"
        parser.add_argument("--masks", type=Path, metavar="PATH", help=text)
        text = "names or kinds of those that are wanted of --masks (default: all)"
        parser.add_argument("--only", nargs="+", action="extend", default=[], metavar="NAME", help=text)
    else:
        text = "largest extent in metres"
        reader = _named(float, "METRES")
        parser.add_argument(
            "--size", type=reader, nargs="+", action="extend", default=[], metavar="OBJECT=METRES", help=text
        )
        text, reader = "another box around it, in pixels of the upright photo", _named(box, "x0,y0,x1,y1")
        parser.add_argument(
            "--box", type=reader, nargs="+", action="extend", default=[], metavar="OBJECT=BOX", help=text
        )
    for flag, (field, read, what, text) in OF_OBJECTS.items():
        reader = _named(read, what)
        parser.add_argument(
            f"--{flag}", dest=field, type=reader, nargs="+", action="extend", default=[], metavar=f"OBJECT={what}",
            help=text,
        )  # fmt: skip
    text = "a place on that mesh, in its own numbers, and where the photo shows it; a few of them start the fit"
    parser.add_argument(
        "--mesh-point", dest="mesh_points", type=_named(_mesh_point, "x,y,z@u,v"), nargs="+", action="extend",
        default=[], metavar="OBJECT=x,y,z@u,v", help=text,
    )  # fmt: skip


def add_reading(parser: argparse.ArgumentParser) -> None:
    """How the photo is read: camera, ground, light from a file, adapters."""
    text = "height of the horizon as a fraction of the photo's, 0 top, 1 bottom; may lie outside (default: estimated)"
    parser.add_argument("--horizon", dest="horizon_y", type=float, metavar="Y", help=text)
    text = "angle of the view below the horizontal, instead of --horizon; about 50 for a look down at a table"
    parser.add_argument("--pitch", dest="pitch_deg", type=float, metavar="DEGREES", help=text)
    text = "turn of the camera; positive where the horizon falls to the right (default: estimated)"
    parser.add_argument("--roll", dest="roll_deg", type=float, metavar="DEGREES", help=text)
    text = "field of view of the longer side (default: EXIF, else vanishing points, else 50)"
    parser.add_argument("--fov", dest="fov_deg", type=float, metavar="DEGREES", help=text)
    text = "depth map of the photo (.npy, .npz, .exr, .pfm, .png of 16 bits), which tells ground and order"
    parser.add_argument("--depth", type=Path, metavar="FILE", help=text)
    text = "objects from the front to the back, all of them (default: as the outlines tell)"
    parser.add_argument("--order", nargs="+", metavar="OBJECT", help=text)
    text = "grey value below which ground is shadow, as in the paper (50), in place of the way that adapts"
    parser.add_argument("--shadow-threshold", type=float, metavar="GREY", help=text)
    for stage, what in (
        ("inpainter", "fills holes"),
        ("segmenter", "makes masks of boxes"),
        ("depth-estimator", "makes the depth map"),
        ("mesher", "makes meshes"),
    ):
        text = f"an adapter that {what} in place of the built-in way (docs/adapters.md)"
        parser.add_argument(f"--{stage}", metavar="ADAPTER", help=text)
    text = "also write SCENE/report.html, a page of pictures of every stage"
    parser.add_argument("--report", action="store_true", help=text)
    add_environment(parser)


def add_environment(parser: argparse.ArgumentParser) -> None:
    """Light from a file in place of what the photo tells."""
    text = ".hdr or .exr that replaces the light estimated from the photo; of DiffusionLight hdr/NAME.exr"
    parser.add_argument("--environment", type=Path, metavar="FILE", help=text)
    frame = "where the file's middle looks: ahead, level (default); along the camera's axis, as DiffusionLight's; or +X"
    parser.add_argument("--environment-frame", choices=FRAMES, default="ahead", help=frame)
    parser.add_argument("--no-sun", action="store_true", help="no sun beside the environment")


def add_asking(parser: argparse.ArgumentParser) -> None:
    """Whom to ask what the objects are made of."""
    text = "ask a model about the objects: an OpenAI-compatible chat endpoint, as https://host/v1 (docs/reasoning.md)"
    parser.add_argument("--ask", metavar="URL", help=text)
    text = "the model to ask, as the endpoint calls it; it must see pictures"
    parser.add_argument("--model", metavar="NAME", help=text)
    text = "agree that the photo, with numbered outlines and your names of the objects, is sent to that endpoint"
    parser.add_argument("--send-photo", action="store_true", help=f"{text}; without it nothing is sent")
    text = f"environment variable that holds the key (default {DEFAULT_KEY_VARIABLE})"
    parser.add_argument("--key-variable", metavar="NAME", default=DEFAULT_KEY_VARIABLE, help=text)
    text = "for one attempt (default 90)"
    parser.add_argument("--ask-timeout", type=float, metavar="SECONDS", default=90.0, help=text)
    parser.add_argument("--ask-retries", type=int, metavar="N", default=2, help="further attempts (default 2)")


def chat_request(options: argparse.Namespace) -> ChatRequest | None:
    """The endpoint to ask, None for none. Raises InputError when it is half told, or consent is missing."""
    if options.ask is None:
        if options.model is not None or options.send_photo:
            raise InputError("--model, --send-photo: are for --ask URL; give it as well, or leave them out")
        return None
    if options.model is None:
        raise InputError("--ask: needs --model NAME, the model that the endpoint shall take")
    return ChatRequest(
        url=options.ask,
        model=options.model,
        key_variable=options.key_variable,
        timeout_s=options.ask_timeout,
        retries=options.ask_retries,
        consent=options.send_photo,
    )


READING = (
    "horizon_y",
    "pitch_deg",
    "roll_deg",
    "fov_deg",
    "depth",
    "order",
    "shadow_threshold",
    "inpainter",
    "segmenter",
    "depth_estimator",
    "mesher",
    "environment",
    "environment_frame",
)
"""Options of the reconstruction that are flags of the same meaning."""


def reconstruct_options(options: argparse.Namespace, earlier: ReconstructOptions | None = None) -> ReconstructOptions:
    """Options of the reconstruction; what was not given is as in ``earlier``, or the default."""
    changes = {name: getattr(options, name) for name in READING if getattr(options, name, None) is not None}
    if "order" in changes:
        changes["order"] = tuple(changes["order"])
    if changes.get("environment") is None:
        changes.pop("environment_frame", None)
    if "horizon_y" in changes and "pitch_deg" not in changes:
        changes["pitch_deg"] = None
    if "pitch_deg" in changes and "horizon_y" not in changes:
        changes["horizon_y"] = None
    changes["report"] = options.report
    if options.no_sun:
        changes["sun"] = False
    return dataclasses.replace(earlier or ReconstructOptions(), **changes)


def object_requests(options: argparse.Namespace, out: Path) -> tuple[ObjectRequest, ...]:
    """What to cut out of the photo: a box each, then those of ``--masks``, then those that have a mask alone.

    out: the folder of the scene; imported masks are written beside it. Raises InputError for more names or sizes than
    boxes, and for what is said of no object; ends with the usage where no object is given.
    """
    for flag in ("name", "size"):
        given = getattr(options, flag)
        if len(given) > len(options.box):
            raise InputError(f"--{flag}: {len(given)} given for {len(options.box)} boxes; give at most one a box")
    fields: dict[str, dict[str, Any]] = {}
    for i, corners in enumerate(options.box):
        name = options.name[i] if i < len(options.name) else f"object_{i + 1}"
        if name in fields:
            raise InputError(f"--name {name}: is given twice; give every object a name of its own")
        fields[name] = {"box": corners, "size_m": options.size[i] if i < len(options.size) else None}
    if options.masks is not None:
        folder = out.resolve().with_name(f"{out.resolve().name}_masks")
        size = ReconstructOptions().max_size
        for item in requests_of_masks(options.masks, options.photo, folder, max_size=size, only=options.only):
            fields.setdefault(item.name or "", {}).update(mask=item.mask, kind=item.kind)
    elif options.only:
        raise InputError("--only: is for --masks PATH; give it as well, or leave it out")
    for name, _ in options.mask:
        fields.setdefault(name, {})
    if not fields:
        options.wrong_usage(
            "no object is given; add --box x0,y0,x1,y1 around one, or --mask NAME=FILE, or --masks PATH"
        )
    with_details(fields, options)
    return tuple(ObjectRequest(name=name, **known) for name, known in fields.items())


def corrected_requests(options: argparse.Namespace, earlier: Sequence[ObjectRequest]) -> tuple[ObjectRequest, ...]:
    """``earlier`` with what was said of single objects. Raises InputError for what is said of none."""
    fields: dict[str, dict[str, Any]] = {item.name or "": {} for item in earlier}
    for flag, field in (("size", "size_m"), ("box", "box")):
        for name, value in getattr(options, flag):
            if name not in fields:
                raise _unknown(flag, name, fields)
            fields[name][field] = value
    with_details(fields, options)
    return tuple(dataclasses.replace(item, **fields[item.name or ""]) for item in earlier)


def with_details(fields: dict[str, dict[str, Any]], options: argparse.Namespace) -> None:
    """Add what the flags of ``OF_OBJECTS`` say to ``fields`` by object's name. Raises InputError for another name."""
    for flag, (field, *_) in OF_OBJECTS.items():
        for name, value in getattr(options, field):
            if name not in fields:
                raise _unknown(flag, name, fields)
            fields[name][field] = value
    for name, point in options.mesh_points:
        if name not in fields:
            raise _unknown("mesh-point", name, fields)
        fields[name]["mesh_points"] = (*fields[name].get("mesh_points", ()), point)


def _unknown(flag: str, name: str, fields: dict[str, dict[str, Any]]) -> InputError:
    return InputError(f"--{flag} {name}=…: there is no object {name!r}; name one of {', '.join(fields)}")
