# SPDX-License-Identifier: MIT
"""Overrides of scene fields, one line each: ``cup.density=300``, ``cup.preset=wood``, ``ground.friction=0.1``."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from typing import Any

from ..errors import InputError
from ..validation import to_json
from .folder import parse_scene, scene_to_json
from .material import load_preset
from .model import GROUND, Camera, Ground, Material, SceneModel, SceneObject

WHOLE = "scene"
"""Name of the scene itself before the dot."""

SHAPE_FIELDS = ("name", "mesh", "world_from_mesh", "size_m", "occlusion_order", "mask", "shadow")
"""Fields of an object that come from the photo; all others are physics."""

PHYSICS_FIELDS = tuple(f.name for f in dataclasses.fields(SceneObject) if f.name not in SHAPE_FIELDS)
MATERIAL_FIELDS = tuple(f.name for f in dataclasses.fields(Material))
GROUND_FIELDS = ("friction", "static_friction", "restitution", "reflectivity", "reflection_roughness")
SCENE_FIELDS = ("gravity", "gravity_track", "contacts")


def apply_overrides(scene: SceneModel, overrides: Sequence[str]) -> SceneModel:
    """Return ``scene`` with the overrides ``OBJECT.FIELD=VALUE`` applied in order.

    OBJECT: an object's name, ``ground`` or ``scene`` (gravity, gravity_track, contacts). FIELD: a field of the
    object or its material; ``preset`` sets all numbers of a preset. VALUE: JSON, bare text, or comma-separated numbers.
    Raises InputError that names the override.
    """
    if not overrides:
        return scene
    data = scene_to_json(scene)
    for text in overrides:
        _apply(data, text)
    return parse_scene(data, f"--set {' '.join(overrides)}")


def check_overrides(names: Sequence[str], overrides: Sequence[str]) -> None:
    """Raise InputError unless ``overrides`` apply to a scene with objects of these ``names``."""
    rest = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    camera = Camera(width=1, height=1, fx=1.0, fy=1.0, cx=0.5, cy=0.5, world_from_camera=rest)
    objects = tuple(SceneObject(name=name, mesh="-", size_m=1.0) for name in names)
    apply_overrides(SceneModel(camera=camera, objects=objects), overrides)


def without_physics(scene: SceneModel, friction: float) -> SceneModel:
    """Return ``scene`` with default physics: default materials at rest on a ground of ``friction``. Effects and
    the ground's gloss, which is seen only, stay.
    """
    shapes = [{name: getattr(item, name) for name in SHAPE_FIELDS} for item in scene.objects]
    return dataclasses.replace(
        scene,
        objects=tuple(SceneObject(**shape) for shape in shapes),
        ground=scene.ground
        and Ground(
            point=scene.ground.point,
            normal=scene.ground.normal,
            friction=friction,
            reflectivity=scene.ground.reflectivity,
            reflection_roughness=scene.ground.reflection_roughness,
        ),
        gravity=SceneModel.gravity,
        gravity_track=(),
        contacts=(),
    )


def _apply(data: dict[str, Any], text: str) -> None:
    place, equals, value = text.partition("=")
    name, dot, field = (part.strip() for part in place.partition("."))
    if not (equals and dot and name and field):
        raise InputError(f"--set {text}: give OBJECT.FIELD=VALUE, such as cup.density=300 or ground.friction=0.1")
    objects = {item["name"]: item for item in data["objects"]}
    if name in objects:
        _apply_to_object(objects[name], field, _value(value), text)
    elif name == GROUND:
        _known(field, GROUND_FIELDS, text)
        if data["ground"] is None:
            raise InputError(f"--set {text}: the scene has no ground; give it one in scene.json first")
        data["ground"][field] = _value(value)
    elif name == WHOLE:
        _known(field, SCENE_FIELDS, text)
        data[field] = _value(value)
    else:
        raise InputError(f"--set {text}: there is no object {name!r}; choose {', '.join([*objects, GROUND, WHOLE])}")


def _apply_to_object(item: dict[str, Any], field: str, value: Any, text: str) -> None:
    field = field.removeprefix("material.")
    if field == "preset":
        try:
            item["material"] = to_json(load_preset(str(value)))
        except InputError as error:
            raise InputError(f"--set {text}: {error}") from None
        return
    _known(field, [*(f for f in PHYSICS_FIELDS if f != "material"), *MATERIAL_FIELDS], text)
    (item["material"] if field in MATERIAL_FIELDS else item)[field] = value


def _known(field: str, fields: Sequence[str], text: str) -> None:
    if field not in fields:
        raise InputError(f"--set {text}: there is no field {field!r}; known are {', '.join(fields)}")


def _value(text: str) -> Any:
    text = text.strip()
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        pass
    try:
        return [float(part) for part in text.split(",")] if "," in text else text
    except ValueError:
        return text
