# SPDX-License-Identifier: MIT
"""Photo and boxes → scene folder: the stages in order, one temporary folder, one rename at the end."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..atomic import write_json
from ..errors import InputError
from ..events import IsCancelled, OnEvent, ignore, never
from ..scene.environment import prepared as prepared_environment
from ..scene.environment import write_environment
from ..scene.equirectangular import Radiance
from ..scene.folder import SceneFolder, save_scene
from ..scene.materials import load_preset
from ..scene.model import Camera, Ground, Light, SceneObject
from .adapters.resolve import resolve
from .bodies import Body, casters, make_bodies
from .layers import Layers, take_apart
from .light.estimate import ENVIRONMENT_FILE, LitScene, estimate_light
from .looks import estimate_looks
from .options import ObjectRequest, ReconstructOptions
from .outlines import cut_out
from .output import PHYSICS_FILE, replacing_folder
from .photo import Photo, load_photo
from .physics.answer import Answers, read_answer
from .physics.apply import DEFAULT_PRESET, ObjectPhysics, decide, ground_friction, in_words
from .physics.ask import ask as ask_endpoint
from .physics.by_name import shipped_names
from .physics.chat import ChatRequest
from .physics.record import physics_record
from .report.page import REPORT_FILE, Told, write_report
from .stage_store import STAGES_FOLDER, Arrays, Notice, StageStore
from .steps import Steps
from .view.depth_map import DepthMap, read_depth
from .view.estimate import ViewEstimate, estimate_view
from .view.scale import metres_per_unit
from .writing import Found, write_scene

Mask = NDArray[np.bool_]


def reconstruct(
    photo: Path,
    objects: Sequence[ObjectRequest],
    out: Path,
    options: ReconstructOptions | None = None,
    on_event: OnEvent = ignore,
    cancelled: IsCancelled = never,
    *,
    ask: ChatRequest | None = None,
    answered: str | None = None,
) -> SceneFolder:
    """Reconstruct the ``objects`` of ``photo`` into the scene folder ``out``, which is replaced when it is a scene.

    What an earlier reconstruction into ``out`` has computed from the same inputs is not computed again. The folder
    appears whole or not at all. ask: a model to ask what things are; answered: what one answered before, in its place.
    ``on_event`` gets progress and notices (docs/reconstruction.md), ``cancelled`` is asked between steps. Raises
    InputError for a photo, box or option that cannot be used, and Cancelled.
    """
    options = options or ReconstructOptions()
    if not objects:
        raise InputError("objects: none given; draw a box around at least one object")
    names = object_names(objects)
    objects = [replace(item, name=name) for item, name in zip(objects, names, strict=True)]
    for item in objects:
        load_preset(item.preset or DEFAULT_PRESET)
    steps = Steps(8 + 4 * len(objects) + options.report, on_event, cancelled)
    with replacing_folder(out) as folder:
        store = StageStore(folder / STAGES_FOLDER, out / STAGES_FOLDER, steps.notice)
        steps.begin("photo")
        picture = load_photo(photo, options.max_size)
        if picture.scale < 1.0:
            steps.notice(
                f"photo of {picture.original_size[0]}x{picture.original_size[1]} pixels is worked on at "
                f"{picture.width}x{picture.height}; max_size changes that"
            )
        objects = [_in_working_pixels(item, picture.scale) for item in objects]
        seen, boxes = cut_out(picture, objects, options, store, steps)
        steps.begin("physics")
        if answered is not None and ask is None:
            answers: Answers | None = read_answer(answered, len(names))
        else:
            answers = _asked(picture, seen, names, ask, store, steps)
        physics = decide(objects, names, answers, shipped_names())
        for name, decided in zip(names, physics, strict=True):
            steps.notice(in_words(name, decided))
        # What a thing is tells its shape as well.
        objects = [replace(item, kind=item.kind or known.name) for item, known in zip(objects, physics, strict=True)]
        steps.begin("camera")
        depth = _depth(picture, options, steps)
        estimate = estimate_view(picture, seen, names, options, depth, steps.notice)
        layers = take_apart(
            picture.pixels,
            seen,
            boxes,
            names,
            estimate.camera,
            options,
            depth=None if depth is None else 1.0 / depth.nearness,
            inpainter=None if options.inpainter is None else resolve("inpainter", options.inpainter, cancelled),
            store=store,
            steps=steps,
        )
        bodies = make_bodies(layers, estimate.camera, objects, options, store, steps)
        (folder / "light").mkdir()
        steps.begin("light")
        radiance, light = _light(folder, picture, layers, estimate.camera, bodies, options, steps)
        looks = estimate_looks(layers, estimate.camera, bodies, objects, physics, radiance, light, store, steps)
        steps.begin("write")
        found = Found(
            pixels=picture.pixels,
            layers=layers,
            view=estimate.camera,
            bodies=bodies,
            metres=_metres(bodies, physics, estimate, options, steps),
            light=light,
            looks=looks,
        )
        scene = write_scene(folder, found, objects, physics, _friction(answers, options))
        write_json(folder / PHYSICS_FILE, physics_record(names, physics, answers, ask))
        save_scene(folder, scene)
        if options.report:
            steps.begin("report")
            told = Told(
                pixels=picture.pixels,
                layers=layers,
                shapes=[body.shape for body in bodies],
                notices=steps.notices,
                sources={
                    "focal length": f"{estimate.focal_source}, ± {estimate.fov_sigma_deg:.0f}°",
                    "ground": f"{estimate.normal_source}, ± {estimate.normal_sigma_deg:.0f}°",
                },
            )
            write_report(folder / REPORT_FILE, SceneFolder(folder, scene), told)
        steps.finish()
    return SceneFolder(root=out, scene=scene)


def object_names(objects: Sequence[ObjectRequest]) -> list[str]:
    """The names that ``objects`` get. Raises InputError for a name that cannot be used or occurs twice."""
    names = [item.name or f"object_{number}" for number, item in enumerate(objects, start=1)]
    for name in names:
        # The scene model holds the rule for names; ask it before any work is done, not after.
        SceneObject(name=name, mesh="-", size_m=1.0)
    folded = [name.casefold() for name in names]
    if len(set(folded)) < len(folded):
        raise InputError(f"objects are named {names!r}: give every object a name of its own")
    return names


def _in_working_pixels(item: ObjectRequest, scale: float) -> ObjectRequest:
    return replace(item, mesh_points=tuple((place, (x * scale, y * scale)) for place, (x, y) in item.mesh_points))


def _asked(
    picture: Photo,
    seen: Sequence[Mask],
    names: Sequence[str],
    request: ChatRequest | None,
    store: StageStore,
    steps: Steps,
) -> Answers | None:
    """What the endpoint says of the objects; it is asked once about the same outlines."""
    if request is None:
        return None
    endpoint = {"address": str(request.address), "model": request.model}

    def raw(notice: Notice) -> Arrays:
        return {"raw": np.array(ask_endpoint(picture.pixels, seen, names, request, notice, steps.cancelled).raw)}

    try:
        made = store.run("physics", {"pixels": picture.pixels, "seen": seen, "names": names, **endpoint}, raw)
    except InputError as error:
        # An hour of corrections should not be lost to an endpoint that is down.
        steps.notice(f"{error}; the objects are judged by their names")
        return None
    return read_answer(str(made["raw"]), len(names))


def _depth(picture: Photo, options: ReconstructOptions, steps: Steps) -> DepthMap | None:
    if options.depth is not None:
        return read_depth(options.depth, picture.width, picture.height)
    if options.depth_estimator is None:
        return None
    found = resolve("depth_estimator", options.depth_estimator, steps.cancelled)(picture.pixels)
    return DepthMap(
        values=found.values,
        disparity=found.meaning == "inverse",
        metric=found.meaning == "metric",
        focal=found.focal_px,
    )


def _friction(answers: Answers | None, options: ReconstructOptions) -> float:
    return ground_friction(answers, Ground().friction) if options.friction is None else options.friction


def _metres(
    bodies: Sequence[Body],
    physics: Sequence[ObjectPhysics],
    estimate: ViewEstimate,
    options: ReconstructOptions,
    steps: Steps,
) -> float:
    """The scale, by the best that is known: what the user says, what was answered, a depth map, what is usual."""
    extents, notice = [body.extent for body in bodies], steps.notice
    for source in ("chosen", "asked", "named"):
        sizes = [item.size_m if item.size_source == source else None for item in physics]
        if source == "named" and estimate.metres_per_unit is not None:
            break
        if any(size is not None for size in sizes):
            if source == "named":
                notice("no object has a size: the scale is guessed from what such things usually measure; set a size_m")
            return metres_per_unit(extents, sizes, estimate, options.default_size_m, notice)
    return metres_per_unit(extents, [None] * len(bodies), estimate, options.default_size_m, notice)


def _light(
    folder: Path,
    picture: Photo,
    layers: Layers,
    view: Camera,
    bodies: Sequence[Body],
    options: ReconstructOptions,
    steps: Steps,
) -> tuple[Radiance, Light]:
    scene = LitScene(
        camera=view,
        ground=Ground(),
        pixels=picture.pixels,
        background=layers.background,
        masks=layers.seen,
        meshes=casters(view, layers.full, bodies),
    )
    given = None
    if options.environment is not None:
        given = prepared_environment(options.environment, options.environment_frame, view, scene.ground)
    radiance, light = estimate_light(scene, given, steps.notice, with_sun=options.sun)
    write_environment(folder / ENVIRONMENT_FILE, radiance)
    return radiance, light
