# SPDX-License-Identifier: GPL-3.0-or-later
"""A capture, with its diagnosis if there is one, as a Blender collection that plays."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import bpy
import numpy as np
from mathutils import Matrix, Quaternion
from numpy.typing import NDArray

from ...sim.diagnose.capture import Camera, Capture, CaptureObject, Trial
from ...sim.errors import InputError
from ...sim.plane_axes import plane_axes
from ...sim.rigid_alignment import nearest_rotation
from ...sim.scene.model import Camera as SceneCamera
from .. import compat
from ..scene_io.photo_view import add_camera
from . import geometry_nodes as nodes
from .capture_materials import (
    BODIES,
    COLOURS,
    FOUND,
    GROUND,
    NOMINAL,
    OBSERVED,
    body_material,
    glowing_material,
    plain_material,
)
from .capture_motion import CARRIERS, Array, Clock, body_shifts, carriers, clock, depths, fit_poses, in_space

TRIAL, LAYER, ROLE, FRAMES, RATE = (f"physgen_{n}" for n in ("trial", "layer", "role", "frames", "rate"))
POINTS, BODY, SAMPLES = "points", "body", "samples"
MODIFIER = "PhysGen"

SMOOTH_DEG = 35.0
EDGES_ACROSS = 12
"""Longest edge of a body as a share of its size is 1 over this, so that colours can vary."""
MAX_VERTICES = 40_000


@dataclass(frozen=True)
class Diagnosed:
    """Arrays of a diagnosis, as from ``read_diagnosis``."""

    where: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    prediction: Mapping[str, NDArray[Any]] = field(default_factory=dict)

    def layer(self, trial: Trial, name: str) -> Array | None:
        """Return ``nominal`` or ``found`` of ``trial``, (T, K, 3), with withheld frames (T + P, K, 3); None if
        absent.
        """
        shown = self.where.get(f"{trial.name}.{name}")
        count = trial.observed.shape[1]
        if shown is None:
            return None
        if shown.shape != (len(trial.times), count, 3):
            raise InputError(
                f"where.npz: {trial.name}.{name} has shape {shown.shape}: of another capture; diagnose again"
            )
        later = self.prediction.get(f"{trial.name}.{'before' if name == NOMINAL else 'after'}")
        if (
            trial.predict_times is not None
            and later is not None
            and later.shape == (len(trial.predict_times), count, 3)
        ):
            shown = np.concatenate([shown, later])
        return np.asarray(shown, dtype=np.float64)

    def score(self, trial: Trial) -> Array | None:
        """Return the discrepancy (T, K) in m/s²; None if absent."""
        found = self.where.get(f"{trial.name}.point_score")
        if found is not None and found.shape != trial.observed.shape[:2]:
            raise InputError(
                f"where.npz: {trial.name}.point_score has shape {found.shape}: of another capture; diagnose again"
            )
        return None if found is None else np.asarray(found, dtype=np.float64)

    def most(self, capture: Capture) -> float:
        """High percentile of the discrepancy, m/s²: the value of the strongest colour. 0 if unknown."""
        values = [v[np.isfinite(v)] for v in map(self.score, capture.trials) if v is not None]
        return float(np.percentile(np.concatenate(values), 98)) if values and sum(map(len, values)) else 0.0


@dataclass(frozen=True)
class BuiltTrial:
    """A trial by frames. layers: name → (F, K, 3) m; score: (F, K) m/s² or None."""

    trial: Trial
    clock: Clock
    layers: Mapping[str, Array]
    score: Array | None


def prepare(capture: Capture, diagnosed: Diagnosed) -> list[BuiltTrial]:
    """Return the input of ``build``. Raises InputError for a diagnosis of another capture, or a trial too long
    to play.
    """
    return [_trial(capture, trial, diagnosed) for trial in capture.trials]


def build(scene: bpy.types.Scene, capture: Capture, built_trials: list[BuiltTrial]) -> bpy.types.Collection:
    """Add ``capture`` to ``scene``; return the collection."""
    root = bpy.data.collections.new("PhysGen capture")
    scene.collection.children.link(root)
    size = _extent(capture)
    _add_ground(root, capture, built_trials)
    if capture.camera is not None:
        _add_camera(scene, root, capture.camera)
    shapes = [_refined(item) for item in capture.objects]
    for built in built_trials:
        _add_trial(root, capture, built, shapes, size)
    bpy.data.batch_remove(shapes)
    return root


def remove(root: bpy.types.Collection) -> None:
    """Delete the collection of ``build`` with all contents that nothing else uses."""
    objects = list(root.all_objects)
    data = {item.data for item in objects if item.data is not None}
    data |= {item.animation_data.action for item in objects if item.animation_data and item.animation_data.action}
    bpy.data.batch_remove([*objects, *root.children_recursive, root])
    bpy.data.batch_remove([item for item in data if item.users == 0])


def trial_collections(root: bpy.types.Collection) -> dict[str, bpy.types.Collection]:
    """Return the collections of the trials by trial name."""
    return {child[TRIAL]: child for child in root.children if TRIAL in child}


def _trial(capture: Capture, trial: Trial, diagnosed: Diagnosed) -> BuiltTrial:
    layers = {name: diagnosed.layer(trial, name) for name in (NOMINAL, FOUND)}
    longest = max((len(v) for v in layers.values() if v is not None), default=len(trial.times))
    times = trial.times
    if trial.predict_times is not None and longest > len(times):
        times = np.concatenate([times, trial.predict_times])
    ticks = clock(times)
    if trial.points is not None:
        observed = trial.points
    else:
        assert capture.camera is not None and trial.pixels is not None
        observed = in_space(trial.pixels, capture.camera, _depth(capture, trial, layers))
    shown = {OBSERVED: observed, **{name: v for name, v in layers.items() if v is not None}}
    score = diagnosed.score(trial)
    return BuiltTrial(
        trial=trial,
        clock=ticks,
        layers={name: ticks.pick(_padded(values, len(times))) for name, values in shown.items()},
        score=None if score is None else ticks.pick(_padded(score, len(times))),
    )


def _padded(values: Array, count: int) -> Array:
    """Return ``values`` (T, …) padded to ``count`` samples with NaN."""
    rest = np.full((max(count - len(values), 0), *values.shape[1:]), np.nan)
    return np.concatenate([np.asarray(values, dtype=np.float64), rest])


def _depth(capture: Capture, trial: Trial, layers: Mapping[str, Array | None]) -> Array:
    """Return the depth (T, K) m at which pixels are shown: that of the fitted motion, else of the ground's point."""
    assert capture.camera is not None
    shape = trial.observed.shape[:2]
    for name in (FOUND, NOMINAL):
        found = layers[name]
        if found is not None:
            depth = depths(found[: shape[0]], capture.camera)
            return np.where(np.isfinite(depth) & (depth > 0), depth, np.nan)
    middle = float(depths(np.asarray(capture.ground.point), capture.camera))
    return np.full(shape, middle if middle > 0 else 1.0)


def _extent(capture: Capture) -> float:
    """Return the largest extent of any object, m."""
    return float(max(np.ptp(item.vertices, axis=0).max() for item in capture.objects))


def _add_ground(root: bpy.types.Collection, capture: Capture, built_trials: list[BuiltTrial]) -> None:
    points = np.concatenate([v[np.isfinite(v).all(axis=2)] for built in built_trials for v in built.layers.values()])
    normal, origin = capture.ground.unit_normal, np.asarray(capture.ground.point, dtype=float)
    first, second = plane_axes(normal)
    low, high = np.percentile(points, [2, 98], axis=0)
    centre = (low + high) / 2
    centre = centre - ((centre - origin) @ normal) * normal
    half = 0.75 * float(np.linalg.norm(high - low)) + 2 * _extent(capture)
    mesh = bpy.data.meshes.new("ground")
    corners = [centre + half * (a * first + b * second) for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    mesh.from_pydata([tuple(c) for c in corners], [], [(0, 1, 2, 3)])
    mesh.materials.append(plain_material("capture ground", GROUND))
    item = bpy.data.objects.new("ground", mesh)
    item.color = (*GROUND, 1.0)
    item.hide_select = True
    root.objects.link(item)


def _add_camera(scene: bpy.types.Scene, root: bpy.types.Collection, camera: Camera) -> None:
    seen = SceneCamera(
        width=camera.width,
        height=camera.height,
        fx=camera.fx,
        fy=camera.fy,
        cx=camera.cx,
        cy=camera.cy,
        world_from_camera=_orthonormal(camera.matrix),
    )
    item = add_camera(scene, seen, (camera.width, camera.height))
    item.name = "capture camera"
    item.data.display_size = 0.2
    scene.collection.objects.unlink(item)
    root.objects.link(item)


def _orthonormal(matrix: Array) -> Any:
    """Return the nearest exact rotation: a capture's may be rounded more than a scene's."""
    exact = matrix.copy()
    exact[:3, :3] = nearest_rotation(matrix[:3, :3])
    return tuple(tuple(float(x) for x in row) for row in exact)


def _refined(item: CaptureObject) -> bpy.types.Mesh:
    """Return the object's rest mesh, subdivided to carry colours; each trial adds its carrier attributes."""
    vertices, faces = item.vertices, item.faces
    longest = float(np.ptp(vertices, axis=0).max()) / EDGES_ACROSS
    if len(vertices) < MAX_VERTICES / 8:
        # Imported late: panels that only draw do not need trimesh.
        from trimesh.remesh import subdivide_to_size

        vertices, faces = subdivide_to_size(vertices, faces, max_edge=max(longest, 1e-9), max_iter=12)
    mesh = bpy.data.meshes.new(item.name)
    mesh.from_pydata(np.asarray(vertices).tolist(), [], np.asarray(faces).tolist())
    import bmesh

    welded = bmesh.new()
    welded.from_mesh(mesh)
    bmesh.ops.remove_doubles(welded, verts=welded.verts, dist=1e-6 * max(longest, 1e-9) * EDGES_ACROSS)
    welded.to_mesh(mesh)
    welded.free()
    mesh.shade_smooth()
    mesh.set_sharp_from_angle(angle=math.radians(SMOOTH_DEG))
    attribute = mesh.color_attributes.new(nodes.COLOUR, "FLOAT_COLOR", "POINT")
    mesh.color_attributes.active_color = attribute
    return mesh


def _add_trial(
    root: bpy.types.Collection, capture: Capture, built: BuiltTrial, shapes: list[bpy.types.Mesh], size: float
) -> None:
    trial = built.trial
    collection = bpy.data.collections.new(trial.name)
    root.children.link(collection)
    collection[TRIAL], collection[FRAMES], collection[RATE] = trial.name, built.clock.frames, built.clock.rate
    samples = _add_samples(collection, built)
    shift = {name: np.zeros_like(values) for name, values in built.layers.items()}
    known = {name: np.zeros(values.shape[:2], dtype=bool) for name, values in built.layers.items()}
    for index, (item, shape) in enumerate(zip(capture.objects, shapes, strict=True)):
        mine = np.flatnonzero(trial.object_index == index)
        if not len(mine):
            continue
        mesh = shape.copy()
        mesh.name = f"{item.name} {trial.name}"
        _set_carriers(mesh, mine, trial.rest_points)
        for name, values in built.layers.items():
            poses = fit_poses(trial.rest_points[mine], values[:, mine])
            known[name][:, mine] = poses.known[:, None]
            if not item.belief.rigid:
                shift[name][:, mine] = body_shifts(trial.rest_points[mine], values[:, mine], poses)
            body = bpy.data.objects.new(f"{item.name} {name} {trial.name}", mesh)
            body[ROLE], body[LAYER] = BODY, name
            body.color = (*BODIES[name], 1.0)
            collection.objects.link(body)
            _animate(body, poses.rotations, poses.shifts)
            modifier = body.modifiers.new(MODIFIER, "NODES")
            modifier.node_group = nodes.body_group()
            inputs = {
                "Samples": samples,
                "Frames": built.clock.frames,
                "Points": len(trial.object_index),
                "First": int(mine[0]),
                "Shift": f"shift_{name}",
                "Known": f"known_{name}",
                "Deform": not item.belief.rigid,
                "Plain": (*BODIES[name], 1.0),
                "Material": body_material(name),
            }
            for key, value in inputs.items():
                nodes.set_input(modifier, key, value)
    for name, values in built.layers.items():
        _set_attribute(samples.data, f"shift_{name}", "FLOAT_VECTOR", "vector", shift[name])
        _set_attribute(samples.data, f"known_{name}", "BOOLEAN", "value", known[name])
        _add_points(collection, trial, name, values, size)


def _add_samples(collection: bpy.types.Collection, built: BuiltTrial) -> bpy.types.Object:
    """Add one vertex per frame and point, frame by frame, with its attributes; never visible itself."""
    frames, count = next(iter(built.layers.values())).shape[:2]
    mesh = bpy.data.meshes.new(f"samples {built.trial.name}")
    mesh.vertices.add(frames * count)
    if built.score is not None:
        _set_attribute(mesh, nodes.SCORE, "FLOAT", "value", np.nan_to_num(built.score))
    item = bpy.data.objects.new(f"samples {built.trial.name}", mesh)
    item[ROLE] = SAMPLES
    item.hide_viewport = item.hide_render = True
    collection.objects.link(item)
    return item


def _set_attribute(mesh: bpy.types.Mesh, name: str, kind: str, slot: str, values: NDArray[Any]) -> None:
    attribute = mesh.attributes.new(name, kind, "POINT")
    flat = values.ravel() if values.dtype == bool else values.astype(np.int32 if kind == "INT" else np.float32).ravel()
    attribute.data.foreach_set(slot, np.ascontiguousarray(flat))


def _set_carriers(mesh: bpy.types.Mesh, mine: NDArray[np.int64], rest_points: Array) -> None:
    vertices = np.empty(3 * len(mesh.vertices), dtype=np.float32)
    mesh.vertices.foreach_get("co", vertices)
    index, weights = carriers(vertices.reshape(-1, 3).astype(np.float64), rest_points[mine])
    for slot in range(CARRIERS):
        names = nodes.carrier_names(slot)
        given = slot < index.shape[1]
        chosen = mine[index[:, slot]] if given else np.full(len(index), mine[0])
        _set_attribute(mesh, names[0], "INT", "value", chosen)
        _set_attribute(mesh, names[1], "FLOAT", "value", weights[:, slot] if given else np.zeros(len(index)))


def _add_points(collection: bpy.types.Collection, trial: Trial, layer: str, values: Array, size: float) -> None:
    """Add all observed points of a layer; edges connect a point at neighbouring frames and become trails."""
    seen = np.isfinite(values).all(axis=2)
    number = np.full(seen.shape, -1)
    number[seen] = np.arange(int(seen.sum()))
    joined = seen[:-1] & seen[1:]
    edges = np.stack([number[:-1][joined], number[1:][joined]], axis=1)
    mesh = bpy.data.meshes.new(f"{layer} points {trial.name}")
    mesh.from_pydata(values[seen].tolist(), edges.tolist(), [])
    frame = np.broadcast_to(np.arange(len(values))[:, None], seen.shape)[seen]
    _set_attribute(mesh, nodes.SAMPLE, "INT", "value", frame)
    item = bpy.data.objects.new(f"{layer} points {trial.name}", mesh)
    item[ROLE], item[LAYER] = POINTS, layer
    item.color = (*COLOURS[layer], 1.0)
    collection.objects.link(item)
    modifier = item.modifiers.new(MODIFIER, "NODES")
    modifier.node_group = nodes.points_group()
    material = glowing_material(f"{layer} points", COLOURS[layer])
    nodes.set_input(modifier, "Radius", 0.02 * size)
    nodes.set_input(modifier, "Material", material)
    nodes.set_input(modifier, "Trail material", material)


def _animate(item: bpy.types.Object, rotations: Array, shifts: Array) -> None:
    """Insert keyframes of one pose per frame from frame 1 on, interpolated linearly."""
    item.rotation_mode = "QUATERNION"
    turns: list[Quaternion] = []
    for matrix in rotations:
        turn = Matrix(matrix.tolist()).to_quaternion()
        if turns and turn.dot(turns[-1]) < 0:
            turn = Quaternion((-turn.w, -turn.x, -turn.y, -turn.z))
        turns.append(turn)
    frames = np.arange(1, len(shifts) + 1, dtype=np.float32)
    curves = compat.new_curves(item)
    for path, values in (("location", shifts), ("rotation_quaternion", np.asarray([tuple(q) for q in turns]))):
        for axis in range(values.shape[1]):
            curve = curves.new(path, index=axis)
            curve.keyframe_points.add(len(frames))
            curve.keyframe_points.foreach_set(
                "co", np.stack([frames, values[:, axis]], axis=1).astype(np.float32).ravel()
            )
            for key in curve.keyframe_points:
                key.interpolation = "LINEAR"
            curve.update()
