# SPDX-License-Identifier: GPL-3.0-or-later
"""Units, object names, frame clock and animation (objects, camera, gravity) of a Blender scene in terms of the scene
format.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace

import bpy
import numpy as np
from mathutils import Matrix
from numpy.typing import NDArray

from ...sim.errors import InputError
from ...sim.scene.camera_path import ZOOM_RANGE, CameraPath, PoseKey, camera_with_pose, is_still
from ...sim.scene.model import Camera, Key, Keys, Motion
from ...sim.scene.scene_object import Matrix4
from ...sim.validation import valid_names
from ..props.body_props import bodies
from ..text import decimal

Vector = tuple[float, float, float]


def metres_per_unit(scene: bpy.types.Scene) -> float:
    """Return the length of a Blender unit of ``scene`` in metres."""
    units = scene.unit_settings
    return 1.0 if units.system == "NONE" else decimal(units.scale_length)


def scaled(values: Iterable[float], factor: float = 1.0) -> Vector:
    """Return three typed numbers times ``factor``."""
    x, y, z = (decimal(value * factor) for value in values)
    return x, y, z


def placed(matrix: Matrix, unit: float) -> NDArray[np.float64]:
    """Return ``matrix`` (4, 4), object space to world, with translations in metres; ``unit`` is in metres."""
    result = np.array(matrix, dtype=np.float64)
    result[:3] *= unit
    return result


def matrix_rows(matrix: NDArray[np.float64]) -> Matrix4:
    """Return the rows of ``matrix`` (4, 4) as tuples, as the scene format has them."""
    return tuple((float(a), float(b), float(c), float(d)) for a, b, c, d in matrix)


@dataclass(frozen=True, kw_only=True)
class Clock:
    """The simulated frames. start, end: frame numbers, ``start`` at 0 s; fps: frames a second of the clip; slow: how
    many times slower than real it shows the motion.
    """

    start: int
    end: int
    fps: float
    slow: float = 1.0

    @property
    def rate(self) -> float:
        """Frames per second of the simulated time."""
        return self.fps * self.slow

    @property
    def frames(self) -> range:
        """Frame numbers."""
        return range(self.start, self.end + 1)

    def seconds(self, frame: float) -> float:
        """Return the simulated time of ``frame`` in s after the first; bit-exact where a bake has a sample."""
        return (frame - self.start) / self.rate

    def from_frame(self, frame: int) -> float:
        """Return the start time in seconds of what begins with ``frame``; 0 for frames before the first."""
        return self.seconds(max(frame, self.start))


def clock(scene: bpy.types.Scene) -> Clock:
    """Return the simulated frames of ``scene``. Raises InputError if there are none."""
    settings, render = scene.physgen.simulation, scene.render
    if settings.frame_end < settings.frame_start:
        raise InputError(
            f"simulation: ends at frame {settings.frame_end}, before it starts at {settings.frame_start}: raise the end"
        )
    return Clock(
        start=settings.frame_start,
        end=settings.frame_end,
        fps=decimal(render.fps / render.fps_base),
        slow=decimal(settings.slow),
    )


def export_names(scene: bpy.types.Scene) -> dict[str, str]:
    """Return the name in the scene folder of every body of ``scene``, by its name in Blender.

    A valid object name is kept, whatever the others are called. Raises InputError if two bodies have the same name,
    which only objects of linked files can have.
    """
    found = [item.name for item in bodies(scene)]
    for name in found:
        if found.count(name) > 1:
            raise InputError(f"two objects are called {name!r}, one of them is of a linked file: rename the other")
    return dict(zip(found, valid_names(found), strict=True))


TRANSFORM = ("location", "rotation_euler", "rotation_quaternion", "rotation_axis_angle", "scale")
"""Transform properties of an object or bone."""

PLACING = (*TRANSFORM, "delta_location", "delta_rotation_euler", "delta_rotation_quaternion", "delta_scale")
"""Properties of an object whose animation moves it."""

Channel = tuple[str, int]
"""Path and array index of a property, as in an animation curve."""


def curves(owner: bpy.types.ID) -> Iterator[bpy.types.FCurve]:
    """Return the active animation curves of ``owner``: of its action and its NLA strips, without muted ones."""
    data = owner.animation_data
    if data is None:
        return
    yield from _curves(data.action, data.action_slot)
    for track in data.nla_tracks:
        if not track.mute:
            for strip in track.strips:
                if not strip.mute:
                    yield from _curves(strip.action, strip.action_slot)


def _curves(action: bpy.types.Action | None, slot: bpy.types.ActionSlot | None) -> Iterator[bpy.types.FCurve]:
    if action is None or slot is None:
        return
    for layer in action.layers:
        for strip in layer.strips:
            bag = strip.channelbag(slot)
            if bag is not None:
                yield from (curve for curve in bag.fcurves if not curve.mute)


def drivers(owner: bpy.types.ID) -> list[bpy.types.FCurve]:
    """Return the drivers on properties of ``owner``."""
    data = owner.animation_data
    return [] if data is None else [curve for curve in data.drivers if not curve.mute]


def channels(owner: bpy.types.ID) -> set[Channel]:
    """Return the animated or driven properties of ``owner``."""
    return {(curve.data_path, curve.array_index) for curve in (*curves(owner), *drivers(owner))}


def why_it_moves(item: bpy.types.Object) -> str | None:
    """Return why ``item`` may move, as the end of a sentence with its remedy; None if it is static.

    Constraints count even if they have no effect: they are not evaluated.
    """
    animated = sorted({curve.data_path for curve in curves(item) if curve.data_path in PLACING})
    if animated:
        return f"is animated ({', '.join(animated)}; Object > Animation > Clear Keyframes)"
    driven = sorted({curve.data_path for curve in drivers(item) if curve.data_path in PLACING})
    if driven:
        return f"is driven ({', '.join(driven)}; right click on the value > Delete Drivers)"
    for constraint in item.constraints:
        if constraint.enabled and not constraint.mute:
            return f"has the constraint {constraint.name!r} (Object > Constraints > Clear Object Constraints)"
    if item.rigid_body is not None and item.rigid_body.type == "ACTIVE":
        return "is an active part of Blender's rigid body simulation (Object > Rigid Body > Remove)"
    parent = item.parent
    if parent is None:
        return None
    if item.parent_type != "OBJECT":
        return f"hangs on a part of {parent.name!r} ({item.parent_type.lower()}; Object > Parent > Clear Parent)"
    reason = why_it_moves(parent)
    return None if reason is None else f"is parented to {parent.name!r}, which {reason}"


Array = NDArray[np.float64]
Reader = Callable[[bpy.types.Depsgraph], None]
"""Reads from an evaluated frame."""

RIGID = 1e-5
"""Tolerance per entry for a motion's matrix to be rigid; Blender's matrices have 32 bits."""

STILL = 1e-6
"""Translations below this share of an object's size, and rotations below it in rad, are ignored."""


def view_layer(scene: bpy.types.Scene) -> bpy.types.ViewLayer:
    """Return the view layer to export: the one in the window, else the first."""
    looked_at = bpy.context.view_layer
    return looked_at if looked_at is not None and looked_at.id_data == scene else scene.view_layers[0]


def depsgraph(scene: bpy.types.Scene) -> bpy.types.Depsgraph:
    """Return the evaluated dependency graph of ``scene``."""
    layer = view_layer(scene)
    layer.update()
    return layer.depsgraph


def sample(scene: bpy.types.Scene, clock: Clock, readers: Sequence[Reader]) -> None:
    """Call every reader at every frame of ``clock``, in order; restore the current frame.

    As with any frame change, unkeyed poses of animated objects are lost.
    """
    if not readers:
        return
    frame, part = scene.frame_current, scene.frame_subframe
    try:
        for number in clock.frames:
            scene.frame_set(number)
            graph = view_layer(scene).depsgraph
            for read in readers:
                read(graph)
    finally:
        scene.frame_set(frame, subframe=part)


def keys(clock: Clock, values: Sequence[Sequence[float]] | Array) -> Keys:
    """Return keyframes of ``values`` (F, 3), one per frame of ``clock``, without those inside constant stretches."""
    rows = [(_rounded(x), _rounded(y), _rounded(z)) for x, y, z in values]
    last = len(rows) - 1
    return tuple(
        Key(time_s=clock.seconds(frame), value=row)
        for i, (frame, row) in enumerate(zip(clock.frames, rows, strict=True))
        if i in (0, last) or not rows[i - 1] == row == rows[i + 1]
    )


def _rounded(number: float) -> float:
    """Return ``number`` rounded to 9 significant digits, without negative zero."""
    return float(f"{number:.9g}") + 0.0


def rigid_motion(clock: Clock, matrices: Array, size: float) -> Motion | None:
    """Return the rigid motion of ``matrices`` (F, 4, 4) relative to the first; None if they deform.

    matrices: object space to world in metres, at every frame of ``clock``. size: of the object, m. A static object has
    no keyframes. The pivot is the object's origin, so that rotation in place has no translations.
    """
    turns = matrices[:, :3, :3] @ np.linalg.inv(matrices[0, :3, :3])
    if np.abs(turns @ turns.transpose(0, 2, 1) - np.eye(3)).max() > RIGID or (np.linalg.det(turns) < 0).any():
        return None
    pivot = matrices[0, :3, 3]
    shifts = matrices[:, :3, 3] - pivot
    vectors = rotation_vectors(turns)
    moves, rotates = np.abs(shifts).max() > STILL * size, np.abs(vectors).max() > STILL
    return Motion(
        translations=keys(clock, shifts) if moves else (),
        rotations=keys(clock, vectors) if rotates else (),
        pivot=(float(pivot[0]), float(pivot[1]), float(pivot[2])) if rotates else None,
    )


def rotation_vectors(rotations: Array) -> Array:
    """Return rotation vectors (N, 3), rad, of rotation matrices (N, 3, 3); noisy ones are projected to the nearest
    rotation.

    The quaternion is the eigenvector of Bar-Itzhack's matrix (J. Guidance 23(6), 2000), accurate at every angle.
    """
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = np.moveaxis(rotations, 0, -1)
    matrix = np.array(
        [
            [xx - yy - zz, yx + xy, zx + xz, zy - yz],
            [yx + xy, yy - xx - zz, zy + yz, xz - zx],
            [zx + xz, zy + yz, zz - xx - yy, yx - xy],
            [zy - yz, xz - zx, yx - xy, xx + yy + zz],
        ]
    )
    quaternions = np.linalg.eigh(np.moveaxis(matrix, -1, 0))[1][:, :, -1]
    quaternions = np.where(quaternions[:, 3:] < 0, -quaternions, quaternions)
    axes, cosines = quaternions[:, :3], quaternions[:, 3]
    sines = np.linalg.norm(axes, axis=1)
    angles = 2 * np.arctan2(sines, cosines)
    return axes * (angles / np.where(sines > 0, sines, 1.0))[:, None]


@contextmanager
def modifiers_off(modifiers: Sequence[bpy.types.Modifier]) -> Iterator[None]:
    """Hide ``modifiers`` in the viewport within the context."""
    for modifier in modifiers:
        modifier.show_viewport = False
    try:
        yield
    finally:
        for modifier in modifiers:
            modifier.show_viewport = True


def camera_path(scene: bpy.types.Scene, photo: Camera, frames: Sequence[int], *, first_frame: int) -> CameraPath | None:
    """Return the path of the scene's camera over ``frames``, numbered from ``first_frame``; None if it is static.

    photo: the photo's camera, to which the scene's is compared; static means that it shows the photo's own view, also
    if the scene has no camera. The current frame is restored. Raises InputError for a lens that does not match the
    photo's.
    """
    if scene.camera is None:
        return None
    now, part = scene.frame_current, scene.frame_subframe
    seen = []
    try:
        for frame in frames if _may_move(scene) else (now,):
            scene.frame_set(frame)
            seen.append(_seen(scene, photo))
    finally:
        scene.frame_set(now, subframe=part)
    ahead = photo.position + np.asarray(photo.world_from_camera)[:3, 2]
    if all(is_still(photo, camera, ahead) for camera in seen):
        return None
    keys = [
        PoseKey(
            frame=float(first_frame + index),
            world_from_camera=camera.world_from_camera,
            zoom=camera.fx / photo.fx,
        )
        for index, camera in enumerate(seen)
    ]
    return CameraPath(interpolation="linear", poses=tuple(keys))


def _may_move(scene: bpy.types.Scene) -> bool:
    """Return whether the scene's camera may move."""
    item = scene.camera
    animated = any(owner.animation_data is not None for owner in (item, item.data))
    cut = any(marker.camera is not None for marker in scene.timeline_markers)
    return animated or cut or item.parent is not None or len(item.constraints) > 0


def _seen(scene: bpy.types.Scene, photo: Camera) -> Camera:
    """Return ``photo`` at the pose and focal length of the scene's camera at the current frame."""
    graph = scene.view_layers[0].depsgraph
    item = scene.camera.evaluated_get(graph)
    if item.data.type != "PERSP":
        raise InputError(f"camera {scene.camera.name!r} is no perspective camera: the photo was taken by one")
    pose = np.array(item.matrix_world, dtype=np.float64)
    turn = pose[:3, :3] / np.linalg.norm(pose[:3, :3], axis=0)
    there = camera_with_pose(photo, turn @ np.diag([1.0, -1.0, -1.0]), pose[:3, 3])
    render = scene.render
    lens = item.calc_matrix_camera(
        graph, x=photo.width, y=photo.height, scale_x=render.pixel_aspect_x, scale_y=render.pixel_aspect_y
    )
    zoom = float(lens[0][0]) * photo.width / 2.0 / photo.fx
    # Blender stores lenses in 32 bits.
    zoom = 1.0 if abs(zoom - 1.0) < 1e-5 else zoom
    if not ZOOM_RANGE[0] <= zoom <= ZOOM_RANGE[1]:
        raise InputError(
            f"camera {scene.camera.name!r} has {zoom:.2g} times the photo's focal length: give it the lens of the "
            f"photo's camera, or {ZOOM_RANGE[0]:g} to {ZOOM_RANGE[1]:g} times that"
        )
    return replace(there, fx=photo.fx * zoom, fy=photo.fy * zoom)
