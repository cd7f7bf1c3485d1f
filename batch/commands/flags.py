# SPDX-License-Identifier: GPL-3.0-or-later
"""Flags of objects and reconstruction that verbs of ``physgen`` share, and the requests made from them."""

from __future__ import annotations

import argparse
import dataclasses
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ...sim.errors import InputError
from ...sim.reconstruct import ObjectRequest, ReconstructOptions
from ...sim.reconstruct.adapters.adapter_registry import FOLDERS, weights_folder
from ...sim.reconstruct.reasoning.chat_client import DEFAULT_KEY_VARIABLE, ChatRequest
from ...sim.reconstruct.reconstruct_options import BACKS, SHAPES, UP_AXES, Pixel, Stroke
from ...sim.scene.equirectangular import FRAMES
from ...sim.scene.model import Vector

if TYPE_CHECKING:
    from ...sim.app.set_light import LightRequest

Named = tuple[str, Any]


def parse_numbers(text: str, count: int, what: str) -> tuple[float, ...]:
    """Return ``count`` finite comma-separated numbers. Raises ArgumentTypeError naming ``what`` was expected."""
    try:
        found = tuple(float(part) for part in text.split(","))
    except ValueError:
        found = ()
    if len(found) != count or not all(math.isfinite(n) for n in found):
        raise argparse.ArgumentTypeError(f"{text.strip()!r} is not {what}")
    return found


def parse_box(text: str) -> tuple[float, float, float, float]:
    """Return the box in ``x0,y0,x1,y1``."""
    a, b, c, d = parse_numbers(text, 4, "a box x0,y0,x1,y1 in pixels")
    return a, b, c, d


def box_text(box: Sequence[float]) -> str:
    """Return ``box`` as ``parse_box`` reads it."""
    return ",".join(f"{value:g}" for value in box)


def parse_vector(text: str) -> Vector:
    """Return the vector in ``x,y,z``."""
    x, y, z = parse_numbers(text, 3, "a vector x,y,z")
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
    u, v = parse_numbers(pixel, 2, "a place in the photo x,y")
    return parse_vector(place), (u, v)


def parse_stroke(text: str) -> Stroke:
    """Return the places in ``x,y,x,y,…``, a polyline; one place is a dot."""
    count = text.count(",") + 1
    numbers = parse_numbers(text, count + count % 2, "a stroke x,y,x,y,… in pixels")
    return tuple(zip(numbers[::2], numbers[1::2], strict=True))


OBJECT_FLAGS: dict[str, tuple[str, Callable[[str], Any], str, str]] = {
    "mask": ("mask", Path, "FILE", "image that is bright where the object is visible, instead of a box"),
    "kind": ("kind", str, "WORD", "what it is (orange, book, teddy): determines material, thickness and shape"),
    "shape": ("shape", _choice(SHAPES), "|".join(SHAPES), "shape model of its body"),
    "back": ("back", _choice(BACKS), "|".join(BACKS), "hidden side of an inflated body"),
    "thickness": ("thickness", float, "RATIO", "depth of the body relative to its width, 0.02 to 3"),
    "mesh": ("mesh", Path, "FILE", "OBJ, GLB, PLY or STL mesh to align with the photo"),
    "mesh-up": ("mesh_up", _choice(UP_AXES), "AXIS", "up axis of that mesh"),
}
"""Flag → field of ObjectRequest, parser, metavar, help. Given as OBJECT=VALUE."""


def add_anyway_flag(parser: argparse.ArgumentParser) -> None:
    """Add the flag that lets a stage begin for which memory is estimated to be too little (``cli.main`` acts on it)."""
    parser.add_argument("--anyway", action="store_true", help="start even if memory is estimated to be too small")


def add_object_flags(parser: argparse.ArgumentParser, *, boxes: bool = True) -> None:
    """Add properties of single objects. boxes: also boxes, and lists in their order."""
    parser.set_defaults(wrong_usage=parser.error)
    group = parser.add_argument_group("objects")
    if boxes:
        text = "bounding box x0,y0,x1,y1 in pixels of the upright photo, one per object (default: objects are found)"
        group.add_argument("--box", type=parse_box, nargs="+", action="extend", default=[], metavar="BOX", help=text)
        text = "numbers of the proposed objects to use, instead of boxes (physgen propose lists them)"
        group.add_argument("--pick", type=int, nargs="+", action="extend", default=[], metavar="N", help=text)
        text = "object names, in the order of the boxes"
        group.add_argument("--name", nargs="+", action="extend", default=[], help=text)
        text = "largest extent in metres, one per object; the first sets the scene's scale"
        group.add_argument("--size", type=float, nargs="+", action="extend", default=[], metavar="METRES", help=text)
        text = "existing masks: a COCO file, or a file or folder of SAM masks; one object each"
        group.add_argument("--masks", type=Path, metavar="PATH", help=text)
        text = "names or kinds to use from --masks (default: all)"
        group.add_argument("--only", nargs="+", action="extend", default=[], metavar="NAME", help=text)
    else:
        text = "largest extent in metres"
        reader = _named(float, "METRES")
        group.add_argument(
            "--size", type=reader, nargs="+", action="extend", default=[], metavar="OBJECT=METRES", help=text
        )
        text, reader = "new bounding box, in pixels of the upright photo", _named(parse_box, "x0,y0,x1,y1")
        group.add_argument(
            "--box", type=reader, nargs="+", action="extend", default=[], metavar="OBJECT=BOX", help=text
        )
    for flag, (field, read, what, text) in OBJECT_FLAGS.items():
        reader = _named(read, what)
        group.add_argument(
            f"--{flag}", dest=field, type=reader, nargs="+", action="extend", default=[], metavar=f"OBJECT={what}",
            help=text,
        )  # fmt: skip
    text = (
        "point on that mesh in its own coordinates, and its pixel in the photo; a few of them initialise the alignment"
    )
    group.add_argument(
        "--mesh-point", dest="mesh_points", type=_named(_mesh_point, "x,y,z@u,v"), nargs="+", action="extend",
        default=[], metavar="OBJECT=x,y,z@u,v", help=text,
    )  # fmt: skip
    for flag, what in (("keep", "a part of the object"), ("drop", "background, such as the ground in a hole,")):
        text = f"stroke over {what} inside its box: a line through pixels of the upright photo; may be repeated"
        group.add_argument(
            f"--{flag}", type=_named(parse_stroke, "x,y,x,y,…"), nargs="+", action="extend", default=[],
            metavar="OBJECT=x,y,x,y,…", help=text,
        )  # fmt: skip


def add_reconstruction_flags(parser: argparse.ArgumentParser) -> None:
    """Add the options of the reconstruction: camera, ground, lighting from a file, adapters."""
    group = parser.add_argument_group("reconstruction")
    text = "height of the horizon as a fraction of the photo's, 0 top, 1 bottom; may be outside (default: estimated)"
    group.add_argument("--horizon", dest="horizon_y", type=float, metavar="Y", help=text)
    text = "how far the camera looks below the horizontal, instead of --horizon; about 50 looking down at a table"
    group.add_argument("--pitch", dest="pitch_deg", type=float, metavar="DEGREES", help=text)
    text = "roll of the camera; positive if the horizon drops to the right (default: estimated)"
    group.add_argument("--roll", dest="roll_deg", type=float, metavar="DEGREES", help=text)
    text = "field of view of the longer side (default: EXIF, else vanishing points, else 50)"
    group.add_argument("--fov", dest="fov_deg", type=float, metavar="DEGREES", help=text)
    text = (
        "depth map of the photo (.npy, .npz, .exr, .pfm, 16-bit .png), used for the ground and occlusion order; or "
        "depth-anything or depth-pro, with --weights"
    )
    group.add_argument("--depth", type=Path, metavar="FILE|MODEL", help=text)
    text = "all objects from front to back (default: estimated)"
    group.add_argument("--order", nargs="+", metavar="OBJECT", help=text)
    text = "fixed grey value below which ground is shadow, as in the paper (50), instead of the adaptive method"
    group.add_argument("--shadow-threshold", type=float, metavar="GREY", help=text)
    for stage, what in (
        ("inpainter", "inpainting"),
        ("segmenter", "segmentation"),
        ("depth-estimator", "estimating depth"),
        ("mesher", "making meshes"),
    ):
        text = f"adapter for {what} (docs/extending.md; default: built-in)"
        group.add_argument(f"--{stage}", metavar="ADAPTER", help=text)
    text = f"folder with the weights of the network ({', '.join(FOLDERS)}) named by --segmenter, --depth or --inpainter"
    group.add_argument("--weights", type=Path, metavar="DIR", help=text)
    text = "download the weights named by --segmenter, --depth or --inpainter, after showing size, source and licence"
    group.add_argument("--download", action="store_true", help=text)
    text = "also write SCENE/report.html, with images of every stage"
    group.add_argument("--report", action="store_true", help=text)
    add_environment_flags(parser)


def add_environment_flags(parser: argparse.ArgumentParser) -> None:
    """Add an environment map from a file."""
    group = parser.add_argument_group("lighting")
    text = ".hdr or .exr that replaces the lighting estimated from the photo; for DiffusionLight hdr/NAME.exr"
    group.add_argument("--environment", type=Path, metavar="FILE", help=text)
    frame = (
        "direction of the map's centre: ahead and level (default), the camera's axis as in DiffusionLight, or world +X"
    )
    group.add_argument("--environment-frame", choices=FRAMES, default="ahead", help=frame)
    group.add_argument("--no-sun", action="store_true", help="no sun besides the environment")


def add_reasoning_flags(parser: argparse.ArgumentParser) -> None:
    """Add the chat endpoint that is asked for the objects' materials."""
    group = parser.add_argument_group("materials from a vision-language model")
    text = "OpenAI-compatible chat endpoint about the objects, such as https://host/v1 (docs/surface-and-light.md)"
    group.add_argument("--ask", metavar="URL", help=text)
    text = "name of the endpoint's model; it must accept images"
    group.add_argument("--model", metavar="NAME", help=text)
    text = "consent to sending the photo, with numbered outlines and your object names, to that endpoint"
    group.add_argument("--send-photo", action="store_true", help=f"{text}; without it nothing is sent")
    text = f"environment variable with the API key (default {DEFAULT_KEY_VARIABLE})"
    group.add_argument("--key-variable", metavar="NAME", default=DEFAULT_KEY_VARIABLE, help=text)
    text = "timeout of one attempt (default 90)"
    group.add_argument("--ask-timeout", type=float, metavar="SECONDS", default=90.0, help=text)
    group.add_argument("--ask-retries", type=int, metavar="N", default=2, help="further attempts (default 2)")


def chat_request(options: argparse.Namespace) -> ChatRequest | None:
    """Return the endpoint to ask, or None. Raises InputError for an incomplete request or missing consent."""
    if options.ask is None:
        if options.model is not None or options.send_photo:
            raise InputError("--model, --send-photo: need --ask URL; give it as well, or leave them out")
        return None
    if options.model is None:
        raise InputError("--ask: needs --model NAME, the endpoint's model")
    return ChatRequest(
        url=options.ask,
        model=options.model,
        key_variable=options.key_variable,
        timeout_s=options.ask_timeout,
        retries=options.ask_retries,
        consent=options.send_photo,
    )


RECONSTRUCTION_FIELDS = (
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
"""Fields of ReconstructOptions that are flags of the same name."""


def reconstruct_options(options: argparse.Namespace, earlier: ReconstructOptions | None = None) -> ReconstructOptions:
    """Return the options of the reconstruction, over those of ``earlier`` or the defaults."""
    changes = {
        name: getattr(options, name) for name in RECONSTRUCTION_FIELDS if getattr(options, name, None) is not None
    }
    if "order" in changes:
        changes["order"] = tuple(changes["order"])
    _take_models(changes, options.weights)
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


def _take_models(changes: dict[str, Any], weights: Path | None) -> None:
    """Turn a model's name in ``changes`` into an adapter with its weights. Raises InputError for weights of none."""
    name = str(changes.get("depth"))
    if name in FOLDERS and not Path(name).exists():
        if "depth_estimator" in changes:
            raise InputError(f"--depth {name} and --depth-estimator {changes['depth_estimator']}: give one of them")
        changes["depth"] = None
        changes["depth_estimator"] = name
    named = [stage for stage in ("segmenter", "depth_estimator", "inpainter") if changes.get(stage) in FOLDERS]
    if weights is None:
        return
    if not named:
        raise InputError(f"--weights: is for {', '.join(FOLDERS)}; name one by --segmenter, --depth or --inpainter")
    for stage in named:
        changes[stage] = f"{changes[stage]}:{weights_folder(changes[stage], weights).resolve()}"


def object_requests(options: argparse.Namespace, out: Path) -> tuple[ObjectRequest, ...]:
    """Return the objects to segment: those with boxes, then those of ``--masks``, then those with only a mask.

    out: the scene folder; imported masks are written beside it. Raises InputError for more names or sizes than boxes
    and for unknown objects; exits with the usage if there is no object.
    """
    for flag in ("name", "size"):
        given = getattr(options, flag)
        if len(given) > len(options.box):
            raise InputError(f"--{flag}: {len(given)} given for {len(options.box)} boxes; give at most one per box")
    fields: dict[str, dict[str, Any]] = {}
    for i, corners in enumerate(options.box):
        name = options.name[i] if i < len(options.name) else f"object_{i + 1}"
        if name in fields:
            raise InputError(f"--name {name}: is given twice; give every object a unique name")
        fields[name] = {"box": corners, "size_m": options.size[i] if i < len(options.size) else None}
    if options.masks is not None:
        from ...sim.app.import_folder import mask_requests

        folder = out.resolve().with_name(f"{out.resolve().name}_masks")
        size = ReconstructOptions().max_size
        for item in mask_requests(options.masks, options.photo, folder, max_size=size, only=options.only):
            fields.setdefault(item.name or "", {}).update(mask=item.mask, kind=item.kind)
    elif options.only:
        raise InputError("--only: needs --masks PATH; give it as well, or leave it out")
    for name, _ in options.mask:
        fields.setdefault(name, {})
    if not fields:
        options.wrong_usage(
            "no object is given; add --box x0,y0,x1,y1 around one, or --mask NAME=FILE, or --masks PATH"
        )
    add_object_details(fields, options)
    return tuple(ObjectRequest(name=name, **known) for name, known in fields.items())


def corrected_requests(options: argparse.Namespace, earlier: Sequence[ObjectRequest]) -> tuple[ObjectRequest, ...]:
    """Return ``earlier`` with the properties given. Raises InputError for unknown objects."""
    fields: dict[str, dict[str, Any]] = {item.name or "": {} for item in earlier}
    for flag, field in (("size", "size_m"), ("box", "box")):
        for name, value in getattr(options, flag):
            if name not in fields:
                raise _unknown_object(flag, name, fields)
            fields[name][field] = value
    add_object_details(fields, options)
    return tuple(dataclasses.replace(item, **fields[item.name or ""]) for item in earlier)


def given_anew(options: argparse.Namespace) -> dict[str, Any]:
    """Return what the flags of ``correct`` put in place of paths and adapters in the scene's record, by its fields."""
    fresh = reconstruct_options(options)
    names = ("inpainter", "segmenter", "depth_estimator", "mesher", "depth", "environment")
    found = {f"options.{name}": value for name in names if (value := getattr(fresh, name)) is not None}
    return found | {
        f"objects.{name}.{part}": path for part in ("mask", "mesh") for name, path in getattr(options, part)
    }


def add_object_details(fields: dict[str, dict[str, Any]], options: argparse.Namespace) -> None:
    """Add the flags of ``OBJECT_FLAGS`` to ``fields`` by object name. Raises InputError for an unknown name."""
    for flag, (field, *_) in OBJECT_FLAGS.items():
        for name, value in getattr(options, field):
            if name not in fields:
                raise _unknown_object(flag, name, fields)
            fields[name][field] = value
    # What may be given several times for one object.
    for flag, field in (("mesh-point", "mesh_points"), ("keep", "keep"), ("drop", "drop")):
        for name, value in getattr(options, field):
            if name not in fields:
                raise _unknown_object(flag, name, fields)
            fields[name][field] = (*fields[name].get(field, ()), value)


def _unknown_object(flag: str, name: str, fields: dict[str, dict[str, Any]]) -> InputError:
    return InputError(f"--{flag} {name}=…: there is no object {name!r}; name one of {', '.join(fields)}")


def add_sun_flags(parser: argparse.ArgumentParser) -> None:
    """Add the sun: given, or estimated from the photo."""
    direction = "direction towards the sun: right, away from the camera, up; any length"
    parser.add_argument("--sun-direction", type=parse_vector, metavar="x,y,z", help=direction)
    strength = "irradiance of the sun on open ground relative to everything else, 0 to 20"
    parser.add_argument("--sun-strength", type=float, metavar="S", help=strength)
    angle = "apparent diameter of the sun; 0.5 is the real one, larger gives softer shadows"
    parser.add_argument("--sun-angle", type=float, metavar="DEGREES", help=angle)
    parser.add_argument("--estimate", action="store_true", help="estimate the sun from the photo's shadows again")


def light_request(options: argparse.Namespace) -> LightRequest:
    """Return the request of ``physgen light``. Raises InputError for an empty or contradictory one."""
    from ...sim.app.set_light import LightRequest

    request = LightRequest(
        environment=options.environment,
        frame=options.environment_frame,
        sun=not options.no_sun,
        sun_direction=options.sun_direction,
        sun_strength=options.sun_strength,
        sun_angle_deg=options.sun_angle,
        estimate=options.estimate,
    )
    if dataclasses.replace(request, frame="ahead") == LightRequest():
        raise InputError("nothing to do: give --environment FILE, --sun-direction x,y,z, --no-sun or --estimate")
    return request
