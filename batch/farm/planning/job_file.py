# SPDX-License-Identifier: GPL-3.0-or-later
"""The job file ``physgen-jobs/1``: scenes, a matrix of parameters, how to bake and render (docs/farm.md)."""

from __future__ import annotations

import re
import tomllib
from dataclasses import dataclass, fields
from pathlib import Path, PurePosixPath
from typing import Any

from ....physgen_addon.frames.frame_index import parse_frame_range
from ....physgen_addon.render.render_options import RenderOptions
from ....sim.app.bake_options import BakeOptions
from ....sim.app.reconstruct import require_physics, with_physics
from ....sim.cache.bake_folder import WORLD_SPACE
from ....sim.errors import InputError
from ....sim.files import read_bytes
from ....sim.reconstruct import ObjectRequest, ReconstructOptions
from ....sim.reconstruct.reconstruct_options import object_names
from ....sim.scene.bake_quality import load_quality
from ....sim.scene.camera_path import load_camera_path
from ....sim.scene.folder import Scene, inside, load_scene
from ....sim.scene.overrides import check_overrides
from ....sim.validation import parse
from .job_matrix import FIELDS, Variant, VariantPhysics, brief, read_physics, read_variants, require_name

FORMAT = "physgen-jobs/1"
MAX_BYTES = 2**20
MOST_SCENES, MOST_SIMULATIONS = 1000, 50_000
"""Scenes, and variants of all of them together: more would not fit into a plan."""
_ENDLESS_NAME = re.compile(r"""(?<![\w"'.-])(?:[\w"'-]++[ \t]*+\.[ \t]*+){32}""")
"""Dotted keys this deep are meaningless here, and the time to parse one grows with the square of its depth."""

VIDEOS = ("mp4", "webm", "sheet")
ARCHITECTURES = ("cpu", "cuda", "vulkan", "metal")


@dataclass(frozen=True, kw_only=True)
class RenderSettings:
    """Frames and videos to render of a variant, besides ``RenderOptions``.

    frames: range such as ``1-48x2``; None for all baked frames. chunk: frames per task, 1 to 10000.
    video: outputs made from the frames, some of ``VIDEOS``; may be empty.
    """

    frames: str | None = None
    chunk: int = 24
    video: tuple[str, ...] = ("mp4",)

    def __post_init__(self) -> None:
        if not 1 <= self.chunk <= 10_000:
            raise InputError(f"chunk is {self.chunk}: give 1 to 10000 frames per task")
        for name in self.video:
            if name not in VIDEOS or self.video.count(name) > 1:
                raise InputError(f"video is {list(self.video)!r}: give each of {', '.join(VIDEOS)} at most once")


@dataclass(frozen=True, kw_only=True)
class JobScene:
    """A scene of a job with all its variants.

    photo: relative to the job file's folder, with the ``objects`` to segment and the options ``reading``; or
    folder: an existing scene folder. frames: numbers of the frames to render, increasing.
    """

    name: str
    photo: str | None
    objects: tuple[ObjectRequest, ...]
    reading: ReconstructOptions
    folder: Scene | None
    bake: BakeOptions
    options: RenderOptions
    render: RenderSettings
    frames: tuple[int, ...]
    variants: tuple[Variant, ...]


@dataclass(frozen=True, kw_only=True)
class Job:
    """A job file. root: its folder, absolute. out: folder of the results, relative to it."""

    name: str
    root: Path
    out: str
    scenes: tuple[JobScene, ...]


@dataclass(frozen=True, kw_only=True)
class _Top:
    format: str
    name: str
    scenes: tuple[Any, ...]
    out: str | None = None
    defaults: Any = None
    matrix: Any = None


@dataclass(frozen=True, kw_only=True)
class _Defaults:
    bake: Any = None
    render: Any = None


@dataclass(frozen=True, kw_only=True)
class _Photo:
    """Fields of a scene other than physics, bake, render, matrix and variants."""

    name: str
    photo: str | None = None
    scene: str | None = None
    boxes: tuple[tuple[float, float, float, float], ...] = ()
    names: tuple[str, ...] = ()
    sizes: tuple[float, ...] = ()
    horizon: float | None = None
    pitch: float | None = None
    fov: float | None = None


def load_job(path: Path) -> Job:
    """Return the job file at ``path``, validated with everything it refers to.

    Raises InputError naming field, value and remedy: for other formats, unknown fields, wrong types, duplicate names,
    and files that are missing or outside the job file's folder.
    """
    try:
        return _load(path)
    except RecursionError:
        raise InputError(f"{path}: is nested too deeply; this is not a job file") from None


def _load(path: Path) -> Job:
    data = _read(path)
    where = path.name
    if data.get("format") != FORMAT:
        found = data.get("format")
        newer = isinstance(found, str) and found.startswith("physgen-jobs/")
        remedy = "update PhysGen" if newer else f'begin the file with format = "{FORMAT}"'
        raise InputError(f"{where}: format is {brief(found)}, this version reads {FORMAT!r}; {remedy}")
    top = parse(_Top, data, where)
    name = require_name(top.name, f"{where}.name")
    root = path.resolve().parent
    out = name if top.out is None else top.out
    if not PurePosixPath(out).parts or str(PurePosixPath(out)) != out or out.startswith("-"):
        raise InputError(f"{where}.out: is {out!r}: give a separate folder for the results, such as {name!r}")
    _inside(root, out, f"{where}.out")
    if not 0 < len(top.scenes) <= MOST_SCENES:
        raise InputError(f"{where}.scenes: {len(top.scenes)} given; give 1 to {MOST_SCENES}")
    defaults = parse(_Defaults, {} if top.defaults is None else top.defaults, f"{where}.defaults")
    scenes: list[JobScene] = []
    for index, table in enumerate(top.scenes):
        scene = _scene(table, top, defaults, root, f"{where}.scenes[{index}]", where)
        if any(scene.name.casefold() == other.name.casefold() for other in scenes):
            raise InputError(
                f"{where}.scenes[{index}].name: {scene.name!r} is used twice; give every scene a unique name"
            )
        scenes.append(scene)
        if sum(len(scene.variants) for scene in scenes) > MOST_SIMULATIONS:
            raise InputError(f"{where}: makes more than {MOST_SIMULATIONS} simulations; split the job")
    return Job(name=name, root=root, out=out, scenes=tuple(scenes))


def _read(path: Path) -> dict[str, Any]:
    try:
        text = read_bytes(path, MAX_BYTES, what="job file").decode("utf-8")
        if endless := _ENDLESS_NAME.search(text):
            raise InputError(f"{path}: {brief(endless[0])}: is nested too deeply; this is not a job file")
        return tomllib.loads(text)
    except FileNotFoundError as error:
        raise InputError(f"{path}: {error.strerror or error}; give the name of a job file") from None
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: not readable as TOML ({error})") from None


def _scene(table: Any, top: _Top, defaults: _Defaults, root: Path, where: str, file: str) -> JobScene:
    if not isinstance(table, dict):
        raise InputError(f"{where}: expected a table, found {brief(table)}")
    known = {f.name for f in fields(_Photo)}
    rest = {key: value for key, value in table.items() if key not in known}
    unknown = sorted(set(rest) - {*FIELDS, "bake", "render", "matrix", "variants"})
    if unknown:
        others = [*sorted(known), *FIELDS, "bake", "render", "matrix", "variants"]
        raise InputError(f"{where}.{unknown[0]}: unknown field; known are {', '.join(others)}")
    entry = parse(_Photo, {key: value for key, value in table.items() if key in known}, where)
    require_name(entry.name, f"{where}.name")
    bake = _bake(_merged(defaults.bake, rest.get("bake"), f"{file}.defaults.bake", f"{where}.bake"), where)
    render_table = _merged(defaults.render, rest.get("render"), f"{file}.defaults.render", f"{where}.render")
    options, render = _render(render_table, root, f"{where}.render")
    try:
        frames = tuple(parse_frame_range(render.frames, 1, bake.frames))
    except InputError as error:
        raise InputError(f"{where}.render.frames: {error}") from None
    objects, reading, folder = _source(entry, root, where)
    matrices = [(top.matrix, f"{file}.matrix"), (rest.get("matrix"), f"{where}.matrix")]
    variants = read_variants(
        read_physics(rest, where), [(t, w) for t, w in matrices if t is not None], rest.get("variants"), where
    )
    names = [o.name for o in folder.model.objects] if folder else object_names(objects)
    for variant in variants:
        _check_physics(variant.physics, names, folder, f"{where}, variant {variant.name}")
    return JobScene(
        name=entry.name,
        photo=entry.photo,
        objects=objects,
        reading=reading,
        folder=folder,
        bake=bake,
        options=options,
        render=render,
        frames=frames,
        variants=variants,
    )


def _merged(common: Any, own: Any, common_where: str, own_where: str) -> dict[str, Any]:
    merged: dict[str, Any] = {}
    for table, where in ((common, common_where), (own, own_where)):
        if table is not None and not isinstance(table, dict):
            raise InputError(f"{where}: expected a table, found {brief(table)}")
        merged |= table or {}
    return merged


def _bake(table: dict[str, Any], where: str) -> BakeOptions:
    options = parse(BakeOptions, table, f"{where}.bake")
    if options.space != WORLD_SPACE:
        raise InputError(f"{where}.bake.space: is {options.space!r}: rendering needs {WORLD_SPACE!r}; leave it out")
    if options.arch not in ARCHITECTURES:
        raise InputError(f"{where}.bake.arch: is {options.arch!r}: choose one of {', '.join(ARCHITECTURES)}")
    try:
        load_quality(options.quality)
    except InputError as error:
        raise InputError(f"{where}.bake: {error}") from None
    return options


def _render(table: dict[str, Any], root: Path, where: str) -> tuple[RenderOptions, RenderSettings]:
    """Return the options that are flags of ``physgen render``, paths relative to ``root``, and the job file's own."""
    flags = {f.name: f.metadata.get("choices") for f in fields(RenderOptions) if "help" in f.metadata}
    del flags["threads"]
    own = [f.name for f in fields(RenderSettings)]
    unknown = sorted(set(table) - {*flags, *own})
    if unknown:
        remedy = (
            "give --threads to physgen batch" if unknown[0] == "threads" else f"known are {', '.join([*own, *flags])}"
        )
        raise InputError(f"{where}.{unknown[0]}: unknown field; {remedy}")
    for name, choices in flags.items():
        if choices is not None and table.get(name, choices[0]) not in choices:
            raise InputError(f"{where}.{name}: is {brief(table[name])}: choose one of {', '.join(choices)}")
    settings = parse(RenderSettings, {name: table[name] for name in own if name in table}, where)
    options = parse(RenderOptions, {name: table[name] for name in flags if name in table}, where)
    if options.camera is not None:
        try:
            load_camera_path(inside(root, options.camera))
        except InputError as error:
            raise InputError(f"{where}.camera: {error}") from None
    return options, settings


def _source(
    entry: _Photo, root: Path, where: str
) -> tuple[tuple[ObjectRequest, ...], ReconstructOptions, Scene | None]:
    """Return the source of a scene: objects and options of a photo, or an existing folder."""
    if (entry.photo is None) == (entry.scene is None):
        raise InputError(f"{where}: give either photo, with boxes, or scene, a scene folder")
    if entry.scene is not None:
        extra = [f.name for f in fields(_Photo) if f.name not in ("name", "scene") and getattr(entry, f.name)]
        if extra:
            raise InputError(f"{where}.{extra[0]}: applies to a photo; leave it out with scene")
        return (), ReconstructOptions(), load_scene(_inside(root, entry.scene, f"{where}.scene"))
    assert entry.photo is not None
    if not _inside(root, entry.photo, f"{where}.photo").is_file():
        raise InputError(f"{where}.photo: there is no {entry.photo!r} in {root}; check its name")
    if not entry.boxes:
        raise InputError(f"{where}.boxes: missing; give [x0, y0, x1, y1] in pixels, one per object")
    for name in ("names", "sizes"):
        if len(getattr(entry, name)) > len(entry.boxes):
            raise InputError(f"{where}.{name}: {len(getattr(entry, name))} given for {len(entry.boxes)} boxes")
    try:
        objects = tuple(
            ObjectRequest(
                box=box,
                name=entry.names[i] if i < len(entry.names) else None,
                size_m=entry.sizes[i] if i < len(entry.sizes) else None,
            )
            for i, box in enumerate(entry.boxes)
        )
        object_names(objects)
        return objects, ReconstructOptions(horizon_y=entry.horizon, pitch_deg=entry.pitch, fov_deg=entry.fov), None
    except InputError as error:
        raise InputError(f"{where}: {error}") from None


def _inside(root: Path, name: str, where: str) -> Path:
    try:
        return inside(root, name)
    except InputError as error:
        raise InputError(f"{where}: {error}") from None


def _check_physics(physics: VariantPhysics, names: list[str], folder: Scene | None, where: str) -> None:
    """Raise InputError now for physics that the simulation would refuse hours later."""
    try:
        if folder is not None:
            with_physics(folder.model, physics.as_physics)
        else:
            require_physics(len(names), physics.as_physics)
            check_overrides(names, physics.settings)
        for item in physics.effects or ():
            unknown = [name for name in item.objects if name not in names]
            if unknown:
                raise InputError(f"effect {item.name!r}: there is no object {unknown[0]!r}; choose {', '.join(names)}")
    except InputError as error:
        raise InputError(f"{where}: {error}") from None
