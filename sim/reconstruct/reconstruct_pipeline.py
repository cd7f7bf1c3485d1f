# SPDX-License-Identifier: MIT
"""Photo and boxes to scene folder: the stages in order.

The folder is written under a temporary name and renamed at the end.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from ..atomic import write_json
from ..errors import InputError
from ..events import IsCancelled, OnEvent, ignore, never
from ..memory import RECONSTRUCTION_RESERVED, available_memory, reconstruction_bytes, require_memory
from ..scene.environment import prepared as prepared_environment
from ..scene.environment import write_environment
from ..scene.equirectangular import Radiance
from ..scene.folder import Scene, save_scene
from ..scene.material import load_preset
from ..scene.model import Camera, Ground, Light, SceneModel, SceneObject
from ..scene.scene_output import PHYSICS_FILE, replacing_folder
from ..trust import trusted_spec
from .adapters.resolve import resolve
from .appearance.appearance_estimate import ObjectAppearance, estimate_appearances
from .appearance.fur import is_furry
from .camera import ground_camera as cameras
from .camera.camera_estimate import CameraEstimate, estimate_camera, metres_per_unit
from .camera.depth_map import DepthMap, read_depth
from .lighting.ground_gloss import GroundGloss
from .lighting.light_estimate import ENVIRONMENT_FILE, LitScene, estimate_light
from .photo import Photo, load_photo
from .photo_layers import Layers, make_clean_plate, separate_layers
from .reasoning.answer_parser import Answers, read_answer
from .reasoning.chat_client import ChatRequest
from .reasoning.material_decision import (
    DEFAULT_PRESET,
    ObjectPhysics,
    decide_materials,
    decided_by_shapes,
    describe_decision,
    ground_friction,
    physics_record,
    to_material,
)
from .reasoning.material_names import shipped_names
from .reasoning.material_query import query_materials
from .reconstruct_options import ObjectRequest, ReconstructOptions, object_names
from .reconstruction_report import REPORT_FILE, ReportData, write_report
from .segmentation.object_masks import segment_objects
from .segmentation.object_proposals import propose_boxes
from .shape.body_texture import glb_bytes, world_from_gltf
from .shape.object_bodies import Body, make_bodies, shadow_casters
from .stage_cache import STAGES_FOLDER, Arrays, Notice, StageCache, Steps

SEARCHED = 640
"""Longest side in pixels of the picture in which things are looked for whose sizes tell the camera."""


@dataclass(frozen=True, kw_only=True)
class SceneEstimate:
    """The estimates that make a scene, lengths in the unit of ``view``; lists in the order of the objects.

    metres: per unit. view: camera above z = 0.
    """

    pixels: NDArray[np.uint8]
    layers: Layers
    view: Camera
    bodies: Sequence[Body]
    metres: float
    light: Light
    looks: Sequence[ObjectAppearance]
    gloss: GroundGloss


def write_scene(
    folder: Path,
    found: SceneEstimate,
    objects: Sequence[ObjectRequest],
    physics: Sequence[ObjectPhysics],
    friction: float,
) -> SceneModel:
    """Write all files except the light's and ``scene.json`` into ``folder``; return the scene that refers to them.

    objects: with their names. physics: material of each. friction: of the ground.
    """
    names = [item.name or "" for item in objects]
    layers = found.layers
    for sub in ("masks", "shadows", "holes", "meshes", "albedo", "shading"):
        (folder / sub).mkdir()
    save_png(folder / "photo.png", found.pixels)
    save_png(folder / "background.png", layers.background)
    bases = [_base_centre(body) for body in found.bodies]
    for i, name in enumerate(names):
        for sub, layer in (("masks", layers.seen[i]), ("shadows", layers.shadows[i]), ("holes", layers.holes[i])):
            save_png(folder / sub / f"{name}.png", layer.astype(np.uint8) * 255)
        if (layers.full[i] != layers.seen[i]).any():
            (folder / "full").mkdir(exist_ok=True)
            save_png(folder / "full" / f"{name}.png", layers.full[i].astype(np.uint8) * 255)
        surface, look = found.bodies[i].surface, found.looks[i]
        if surface.shading is not None:
            save_png(folder / "shading" / f"{name}.png", surface.shading)
        save_png(folder / "albedo" / f"{name}.png", look.albedo)
        content = glb_bytes(surface, bases[i], found.metres, roughness=look.roughness, metallic=look.metallic)
        (folder / "meshes" / f"{name}.glb").write_bytes(content)
    origin = bases[0] * (1.0, 1.0, 0.0)
    return SceneModel(
        camera=cameras.scaled_to_metres(found.view, origin, found.metres),
        objects=tuple(
            SceneObject(
                name=name,
                mesh=f"meshes/{name}.glb",
                world_from_mesh=world_from_gltf((bases[i] - origin) * found.metres),
                size_m=found.bodies[i].extent * found.metres,
                material=to_material(physics[i]),
                fill=physics[i].fill,
                roughness=physics[i].roughness,
                velocity=objects[i].velocity,
                spin=objects[i].spin,
                asleep=True,
                occlusion_order=layers.front_to_back.index(i),
                mask=f"masks/{name}.png",
                shadow=f"shadows/{name}.png",
                shading=None if found.bodies[i].surface.shading is None else f"shading/{name}.png",
            )
            for i, name in enumerate(names)
        ),
        ground=Ground(
            friction=friction,
            reflectivity=found.gloss.reflectivity,
            reflection_roughness=found.gloss.roughness,
        ),
        light=found.light,
    )


def _base_centre(body: Body) -> NDArray[np.float64]:
    """Centre (3,) of the part that rests on the ground or another object, in the body's unit."""
    vertices = body.surface.vertices
    bottom = float(vertices[:, 2].min())
    low = vertices[vertices[:, 2] <= bottom + 1e-6 * np.ptp(vertices[:, 2]) + 1e-12]
    return np.array([*((low[:, :2].min(axis=0) + low[:, :2].max(axis=0)) / 2.0), bottom])


def save_png(path: Path, pixels: NDArray[np.uint8]) -> None:
    """Write ``pixels`` (H, W) or (H, W, 3) as a PNG."""
    Image.fromarray(pixels).save(path, format="PNG", compress_level=4)


Mask = NDArray[np.bool_]


def reconstruct_photo(
    photo: Path,
    objects: Sequence[ObjectRequest],
    out: Path,
    options: ReconstructOptions | None = None,
    on_event: OnEvent = ignore,
    cancelled: IsCancelled = never,
    *,
    ask: ChatRequest | None = None,
    answered: str | None = None,
    at_rest: Callable[[Scene, Notice], SceneModel] | None = None,
    settle: Callable[[Scene], SceneModel] | None = None,
) -> Scene:
    """Reconstruct the ``objects`` of ``photo`` into the scene folder ``out``; an existing scene there is replaced.

    Stages with the same inputs as in an earlier reconstruction into ``out`` are cached. The folder appears whole or not
    at all. ask: request to a model about the objects; answered: the text of an earlier answer, used instead. at_rest:
    returns the model of a scene folder with all that it takes for its objects to stay where they are. settle: called
    with the whole folder before it takes its place; writes into it what belongs to it, and returns the scene to save.
    ``on_event`` receives progress and notices (docs/reconstruction.md), ``cancelled`` is polled between steps. Raises
    InputError for a photo, box or option that cannot be used, and Cancelled.
    """
    options = options or ReconstructOptions()
    if not objects:
        raise InputError("objects: none given; draw a box around at least one object")
    names = object_names(objects)
    objects = [replace(item, name=name) for item, name in zip(objects, names, strict=True)]
    for item in objects:
        load_preset(item.preset or DEFAULT_PRESET)
    steps = Steps(9 + 4 * len(objects) + options.report, on_event, cancelled)
    with replacing_folder(out) as folder:
        store = StageCache(folder / STAGES_FOLDER, out / STAGES_FOLDER, steps.notice)
        steps.begin("photo")
        picture = load_photo(photo, options.max_size)
        if picture.scale < 1.0:
            steps.notice(
                f"photo of {picture.original_size[0]}x{picture.original_size[1]} pixels is processed at "
                f"{picture.width}x{picture.height}; max_size changes that"
            )
        require_memory(
            reconstruction_bytes(_box_pixels(picture, objects), len(objects)),
            available_memory(RECONSTRUCTION_RESERVED),
            what=f"{len(objects)} objects in a photo of {picture.width}x{picture.height} pixels",
            remedy="scale the photo down",
        )
        objects = [_in_working_pixels(item, picture.scale) for item in objects]
        seen, boxes = segment_objects(picture, objects, options, store, steps)
        steps.begin("physics")
        if answered is not None and ask is None:
            answers: Answers | None = read_answer(answered, len(names))
        else:
            answers = _asked(picture, seen, names, ask, store, steps)
        physics = decide_materials(objects, names, answers, shipped_names())
        # The kind of an object determines its shape as well.
        objects = [replace(item, kind=item.kind or known.name) for item, known in zip(objects, physics, strict=True)]
        steps.begin("camera")
        depth = _depth(picture, options, steps)
        estimate = estimate_camera(
            picture, seen, options, depth, steps.notice, lambda: _boxes_of_things(picture.pixels)
        )
        named = options.inpainter
        inpainter = None if named is None else resolve("inpainter", trusted_spec(named), cancelled)
        layers = separate_layers(
            picture.pixels,
            seen,
            boxes,
            names,
            estimate.camera,
            options,
            depth=None if depth is None else 1.0 / depth.nearness,
            inpainter=inpainter,
            store=store,
            steps=steps,
        )
        bodies = make_bodies(layers, estimate.camera, objects, options, store, steps, depth=depth)
        layers, gloss = make_clean_plate(
            layers,
            picture.pixels,
            [body.surface for body in bodies],
            estimate.camera,
            options,
            inpainter=inpainter,
            store=store,
            steps=steps,
        )
        physics = decided_by_shapes(
            physics,
            [body.shape for body in bodies],
            [body.size for body in bodies],
            [is_furry(picture.pixels, mask) for mask in seen],
        )
        for name, decided in zip(names, physics, strict=True):
            steps.notice(describe_decision(name, decided))
        (folder / "light").mkdir()
        steps.begin("light")
        radiance, light = _light(folder, picture, layers, estimate.camera, bodies, options, steps)
        looks = estimate_appearances(layers, estimate.camera, bodies, objects, physics, radiance, light, store, steps)
        steps.begin("write")
        found = SceneEstimate(
            pixels=picture.pixels,
            layers=layers,
            view=estimate.camera,
            bodies=bodies,
            metres=_metres(bodies, physics, estimate, options, steps),
            light=light,
            looks=looks,
            gloss=gloss,
        )
        scene = write_scene(folder, found, objects, physics, _friction(answers, options))
        if at_rest is not None:
            scene = at_rest(Scene(folder, scene), steps.notice)
        write_json(folder / PHYSICS_FILE, physics_record(names, physics, answers, ask))
        save_scene(folder, scene)
        if options.report:
            steps.begin("report")
            report = ReportData(
                pixels=picture.pixels,
                layers=layers,
                shapes=[body.shape for body in bodies],
                notices=steps.notices,
                sources={
                    "focal length": f"{estimate.focal_source}, ± {estimate.fov_sigma_deg:.0f}°",
                    "ground": f"{estimate.normal_source}, ± {estimate.normal_sigma_deg:.0f}°",
                },
            )
            write_report(folder / REPORT_FILE, Scene(folder, scene), report)
        if settle is not None:
            scene = settle(Scene(folder, scene))
            save_scene(folder, scene)
        steps.finish()
    return Scene(root=out, model=scene)


def _box_pixels(picture: Photo, objects: Sequence[ObjectRequest]) -> int:
    """Return the working pixels in the boxes of all objects; one that has only a mask counts as a quarter photo."""
    whole, found = picture.width * picture.height, 0.0
    for item in objects:
        x0, y0, x1, y1 = item.box or (0, 0, 0, 0)
        found += min(abs(x1 - x0) * abs(y1 - y0) * picture.scale**2, whole) if item.box else whole / 4
    return int(found)


def _in_working_pixels(item: ObjectRequest, scale: float) -> ObjectRequest:
    return replace(item, mesh_points=tuple((place, (x * scale, y * scale)) for place, (x, y) in item.mesh_points))


def _asked(
    picture: Photo,
    seen: Sequence[Mask],
    names: Sequence[str],
    request: ChatRequest | None,
    store: StageCache,
    steps: Steps,
) -> Answers | None:
    """The model's answers about the objects; the result is cached for equal masks."""
    if request is None:
        return None
    endpoint = {"address": str(request.address), "model": request.model}

    def raw(notice: Notice) -> Arrays:
        return {"raw": np.array(query_materials(picture.pixels, seen, names, request, notice, steps.cancelled).raw)}

    try:
        made = store.run("physics", {"pixels": picture.pixels, "seen": seen, "names": names, **endpoint}, raw)
    except InputError as error:
        # An endpoint that is down must not lose an hour of corrections.
        steps.notice(f"{error}; the objects are judged by their names")
        return None
    return read_answer(str(made["raw"]), len(names))


def _boxes_of_things(pixels: NDArray[np.uint8]) -> list[tuple[float, float, float, float]]:
    """Return the boxes of all things that stand out in ``pixels`` (H, W, 3), in its pixels."""
    scale = min(1.0, SEARCHED / max(pixels.shape[:2]))
    small = pixels
    if scale < 1.0:
        small = np.asarray(cv2.resize(pixels, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.uint8)
    return [tuple(value / scale for value in item.box) for item in propose_boxes(small)]  # type: ignore[misc]


def _depth(picture: Photo, options: ReconstructOptions, steps: Steps) -> DepthMap | None:
    if options.depth is not None:
        return read_depth(options.depth, picture.width, picture.height)
    if options.depth_estimator is None:
        return None
    found = resolve("depth_estimator", trusted_spec(options.depth_estimator), steps.cancelled)(picture.pixels)
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
    estimate: CameraEstimate,
    options: ReconstructOptions,
    steps: Steps,
) -> float:
    """Metres per unit by the best source: the user, a model's answer, a metric depth map, usual sizes."""
    extents, notice = [body.extent for body in bodies], steps.notice
    for source in ("chosen", "asked", "named"):
        sizes = [item.size_m if item.size_source == source else None for item in physics]
        if source == "named" and estimate.metres_per_unit is not None:
            break
        if any(size is not None for size in sizes):
            if source == "named":
                notice("no object has a size: the scale is guessed from the usual size of such objects; set a size_m")
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
        meshes=shadow_casters(view, layers.full, bodies),
        things=layers.unboxed,
    )
    given = None
    if options.environment is not None:
        given = prepared_environment(options.environment, options.environment_frame, view, scene.ground)
    radiance, light = estimate_light(scene, given, steps.notice, with_sun=options.sun)
    write_environment(folder / ENVIRONMENT_FILE, radiance)
    return radiance, light
