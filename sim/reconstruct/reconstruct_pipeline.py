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

from ..atomic import write_json
from ..errors import InputError
from ..events import IsCancelled, OnEvent, ignore, never
from ..memory import RECONSTRUCTION_RESERVED, available_memory, reconstruction_bytes, require_memory
from ..scene.environment import prepared as prepared_environment
from ..scene.environment import write_environment
from ..scene.equirectangular import Radiance
from ..scene.folder import Scene, save_scene
from ..scene.material import load_preset
from ..scene.model import Camera, Ground, Light, SceneModel
from ..scene.scene_output import PHYSICS_FILE, replacing_folder
from ..trust import trusted_spec
from .adapters.resolve import resolve
from .appearance.appearance_estimate import estimate_appearances
from .appearance.fur import is_furry
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
)
from .reasoning.material_names import shipped_names
from .reasoning.material_query import query_materials
from .reconstruct_options import ObjectRequest, ReconstructOptions, object_names
from .reconstruction_report import REPORT_FILE, ReportData, write_report
from .scene_estimate import SceneEstimate, write_scene
from .segmentation.box_crop import Box
from .segmentation.object_masks import segment_objects
from .segmentation.object_proposals import propose_boxes
from .shape.object_bodies import Body, make_bodies, shadow_casters
from .stage_cache import STAGES_FOLDER, Arrays, Notice, StageCache, Steps

SEARCHED = 640
"""Longest side in pixels of the picture in which things are looked for whose sizes tell the camera."""


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
        picture = _working_photo(photo, objects, options, steps)
        objects = [_in_working_pixels(item, picture.scale) for item in objects]
        run = _Run(picture=picture, objects=objects, options=options, store=store, steps=steps)
        seen, boxes = segment_objects(picture, objects, options, store, steps)
        steps.begin("physics")
        answers = run.answers(seen, ask, answered)
        physics = decide_materials(objects, names, answers, shipped_names())
        # The kind of an object determines its shape as well.
        objects = [replace(item, kind=item.kind or known.name) for item, known in zip(objects, physics, strict=True)]
        run = replace(run, objects=objects)
        found, estimate, physics = run.estimated(seen, boxes, physics, folder)
        scene = write_scene(folder, found, objects, physics, _friction(answers, options))
        if at_rest is not None:
            scene = at_rest(Scene(folder, scene), steps.notice)
        write_json(folder / PHYSICS_FILE, physics_record(names, physics, answers, ask))
        save_scene(folder, scene)
        if options.report:
            steps.begin("report")
            write_report(folder / REPORT_FILE, Scene(folder, scene), _report_data(found, estimate, steps))
        if settle is not None:
            scene = settle(Scene(folder, scene))
            save_scene(folder, scene)
        steps.finish()
    return Scene(root=out, model=scene)


@dataclass(frozen=True, kw_only=True)
class _Run:
    """One reconstruction under way. picture: at working size. objects: with their names, in its pixels."""

    picture: Photo
    objects: Sequence[ObjectRequest]
    options: ReconstructOptions
    store: StageCache
    steps: Steps

    @property
    def names(self) -> list[str]:
        """Return the objects' names."""
        return [item.name or "" for item in self.objects]

    def answers(self, seen: Sequence[Mask], ask: ChatRequest | None, answered: str | None) -> Answers | None:
        """Return the model's answers about the objects, or those in the text ``answered``; None where neither is.

        seen: (H, W) visible pixels of each object. A model's answers are cached for equal masks.
        """
        names, pixels, steps = self.names, self.picture.pixels, self.steps
        if ask is None:
            return None if answered is None else read_answer(answered, len(names))
        endpoint = {"address": str(ask.address), "model": ask.model}

        def raw(notice: Notice) -> Arrays:
            return {"raw": np.array(query_materials(pixels, seen, names, ask, notice, steps.cancelled).raw)}

        try:
            made = self.store.run("physics", {"pixels": pixels, "seen": seen, "names": names, **endpoint}, raw)
        except InputError as error:
            # An endpoint that is down must not lose an hour of corrections.
            steps.notice(f"{error}; the objects are judged by their names")
            return None
        return read_answer(str(made["raw"]), len(names))

    def estimated(
        self, seen: Sequence[Mask], boxes: Sequence[Box], physics: Sequence[ObjectPhysics], folder: Path
    ) -> tuple[SceneEstimate, CameraEstimate, tuple[ObjectPhysics, ...]]:
        """Return what the photo shows, its camera, and each object's ``physics``, completed from its shape.

        seen: (H, W) visible pixels of each object, which lies in its box of ``boxes``. Writes the environment map into
        the scene folder ``folder``.
        """
        steps, objects, pixels = self.steps, self.objects, self.picture.pixels
        steps.begin("camera")
        depth = self.depth()
        estimate = estimate_camera(
            self.picture, seen, self.options, depth, steps.notice, lambda: _boxes_of_things(pixels)
        )
        view = estimate.camera
        layers, bodies, gloss = self.layers_and_bodies(seen, boxes, view, depth)
        decided = self.decided_by_bodies(physics, bodies, seen)
        (folder / "light").mkdir()
        steps.begin("light")
        radiance, light = self.light(layers, view, bodies)
        write_environment(folder / ENVIRONMENT_FILE, radiance)
        looks = estimate_appearances(layers, view, bodies, objects, decided, radiance, light, self.store, steps)
        steps.begin("write")
        found = SceneEstimate(
            pixels=pixels,
            layers=layers,
            view=view,
            bodies=bodies,
            metres=self.metres_per_unit(bodies, decided, estimate),
            light=light,
            looks=looks,
            gloss=gloss,
        )
        return found, estimate, decided

    def depth(self) -> DepthMap | None:
        """Return the user's or the depth estimator's depth map (H, W); None where neither is given."""
        options, picture = self.options, self.picture
        if options.depth is not None:
            return read_depth(options.depth, picture.width, picture.height)
        if options.depth_estimator is None:
            return None
        estimator = resolve("depth_estimator", trusted_spec(options.depth_estimator), self.steps.cancelled)
        found = estimator(picture.pixels)
        return DepthMap(
            values=found.values,
            disparity=found.meaning == "inverse",
            metric=found.meaning == "metric",
            focal=found.focal_px,
        )

    def layers_and_bodies(
        self, seen: Sequence[Mask], boxes: Sequence[Box], view: Camera, depth: DepthMap | None
    ) -> tuple[Layers, Sequence[Body], GroundGloss]:
        """Return the photo's layers with the clean plate, the objects' bodies, and how the ground mirrors them.

        seen: (H, W) visible pixels of each object, which lies in its box of ``boxes``. view: camera above z = 0.
        """
        named = self.options.inpainter
        inpainter = None if named is None else resolve("inpainter", trusted_spec(named), self.steps.cancelled)
        layers = separate_layers(
            self.picture.pixels,
            seen,
            boxes,
            self.names,
            view,
            self.options,
            depth=None if depth is None else 1.0 / depth.nearness,
            inpainter=inpainter,
            store=self.store,
            steps=self.steps,
        )
        bodies = make_bodies(layers, view, self.objects, self.options, self.store, self.steps, depth=depth)
        layers, gloss = make_clean_plate(
            layers,
            self.picture.pixels,
            [body.surface for body in bodies],
            view,
            self.options,
            inpainter=inpainter,
            store=self.store,
            steps=self.steps,
        )
        return layers, bodies, gloss

    def decided_by_bodies(
        self, physics: Sequence[ObjectPhysics], bodies: Sequence[Body], seen: Sequence[Mask]
    ) -> tuple[ObjectPhysics, ...]:
        """Return each object's ``physics``, completed from its shape and its fur; each decision gives a notice."""
        decided = decided_by_shapes(
            physics,
            [body.shape for body in bodies],
            [body.size for body in bodies],
            [is_furry(self.picture.pixels, mask) for mask in seen],
        )
        for name, item in zip(self.names, decided, strict=True):
            self.steps.notice(describe_decision(name, item))
        return decided

    def metres_per_unit(
        self, bodies: Sequence[Body], physics: Sequence[ObjectPhysics], estimate: CameraEstimate
    ) -> float:
        """Return metres per unit by the best source: the user, a model's answer, a metric depth map, usual sizes."""
        extents, notice, usual = [body.extent for body in bodies], self.steps.notice, self.options.default_size_m
        for source in ("chosen", "asked", "named"):
            sizes = [item.size_m if item.size_source == source else None for item in physics]
            if source == "named" and estimate.metres_per_unit is not None:
                break
            if any(size is not None for size in sizes):
                if source == "named":
                    notice(
                        "no object has a size: the scale is guessed from the usual size of such objects; set a size_m"
                    )
                return metres_per_unit(extents, sizes, estimate, usual, notice)
        return metres_per_unit(extents, [None] * len(bodies), estimate, usual, notice)

    def light(self, layers: Layers, view: Camera, bodies: Sequence[Body]) -> tuple[Radiance, Light]:
        """Return the light that reaches the scene: its environment map and the sun, with what the user gave."""
        options = self.options
        scene = LitScene(
            camera=view,
            ground=Ground(),
            pixels=self.picture.pixels,
            background=layers.background,
            masks=layers.seen,
            meshes=shadow_casters(view, layers.full, bodies),
            things=layers.unboxed,
        )
        given = None
        if options.environment is not None:
            given = prepared_environment(options.environment, options.environment_frame, view, scene.ground)
        return estimate_light(scene, given, self.steps.notice, with_sun=options.sun)


def _working_photo(photo: Path, objects: Sequence[ObjectRequest], options: ReconstructOptions, steps: Steps) -> Photo:
    """Return the photo at the size at which it is processed, once memory is known to suffice for its ``objects``."""
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
    return picture


def _box_pixels(picture: Photo, objects: Sequence[ObjectRequest]) -> int:
    """Return the working pixels in the boxes of all objects; one that has only a mask counts as a quarter photo."""
    whole, found = picture.width * picture.height, 0.0
    for item in objects:
        x0, y0, x1, y1 = item.box or (0, 0, 0, 0)
        found += min(abs(x1 - x0) * abs(y1 - y0) * picture.scale**2, whole) if item.box else whole / 4
    return int(found)


def _in_working_pixels(item: ObjectRequest, scale: float) -> ObjectRequest:
    """Return ``item`` with its points in the photo times ``scale``."""
    return replace(item, mesh_points=tuple((place, (x * scale, y * scale)) for place, (x, y) in item.mesh_points))


def _boxes_of_things(pixels: NDArray[np.uint8]) -> list[tuple[float, float, float, float]]:
    """Return the boxes of all things that stand out in ``pixels`` (H, W, 3), in its pixels."""
    scale = min(1.0, SEARCHED / max(pixels.shape[:2]))
    small = pixels
    if scale < 1.0:
        small = np.asarray(cv2.resize(pixels, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.uint8)
    return [tuple(value / scale for value in item.box) for item in propose_boxes(small)]  # type: ignore[misc]


def _friction(answers: Answers | None, options: ReconstructOptions) -> float:
    """Return the ground's coefficient of friction: the user's, a model's, or the usual one."""
    return ground_friction(answers, Ground().friction) if options.friction is None else options.friction


def _report_data(found: SceneEstimate, estimate: CameraEstimate, steps: Steps) -> ReportData:
    """Return what the report shows besides the scene."""
    return ReportData(
        pixels=found.pixels,
        layers=found.layers,
        shapes=[body.shape for body in found.bodies],
        notices=steps.notices,
        sources={
            "focal length": f"{estimate.focal_source}, ± {estimate.fov_sigma_deg:.0f}°",
            "ground": f"{estimate.normal_source}, ± {estimate.normal_sigma_deg:.0f}°",
        },
    )
