# SPDX-License-Identifier: GPL-3.0-or-later
"""What moves by Blender's animation while the simulation runs: colliders, pins, gravity, sampled at every frame.

All of it is read in one pass over the frames, and in none where nothing moves. Between frames the simulation goes in
straight lines, as ``sim.scene.control`` says.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

import bpy
import numpy as np
from numpy.typing import NDArray

from ...sim.scene.model import Key, Keys, Motion
from .export_units import Clock

Array = NDArray[np.float64]
Reader = Callable[[bpy.types.Depsgraph], None]
"""Takes from an evaluated frame what it needs."""

RIGID = 1e-5
"""How far a motion's matrix may be from a rotation, entry by entry; Blender's matrices have 32 bits."""

STILL = 1e-6
"""Motion below this share of a thing's size, and turns below it in rad, are none."""


def view_layer(scene: bpy.types.Scene) -> bpy.types.ViewLayer:
    """The view layer of ``scene`` that counts: the one that is looked at, else the first."""
    looked_at = bpy.context.view_layer
    return looked_at if looked_at is not None and looked_at.id_data == scene else scene.view_layers[0]


def depsgraph(scene: bpy.types.Scene) -> bpy.types.Depsgraph:
    """What Blender has evaluated of ``scene``, brought up to date."""
    layer = view_layer(scene)
    layer.update()
    return layer.depsgraph


def sample(scene: bpy.types.Scene, clock: Clock, readers: Sequence[Reader]) -> None:
    """Let every reader see every frame of ``clock`` once, in order. The present frame comes back at the end.

    As with any change of frame, what was posed on animated objects without a keyframe is lost.
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
    """Keyframes of ``values`` (F, 3), one a frame of ``clock``; those inside a stretch of equal ones are left out."""
    rows = [tuple(float(f"{number:.9g}") + 0.0 for number in row) for row in values]
    last = len(rows) - 1
    return tuple(
        Key(time_s=clock.seconds(frame), value=row)
        for i, (frame, row) in enumerate(zip(clock.frames, rows, strict=True))
        if i in (0, last) or not rows[i - 1] == row == rows[i + 1]
    )


def rigid_motion(clock: Clock, matrices: Array, size: float) -> Motion | None:
    """The motion of ``matrices`` (F, 4, 4) against the first of them; None where they deform what they move.

    matrices: from own space to world metres, at every frame of ``clock``. size: of what moves, in m. A motion without
    keyframes stands still. The pivot is the origin of the thing, so that something that turns on the spot has no
    translations.
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
    """Axis times angle in rad (N, 3) of rotation matrices (N, 3, 3), of the nearest rotation where they are noisy.

    The quaternion is the eigenvector of Bar-Itzhack's matrix (J. Guidance 23(6), 2000), exact at every angle.
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
    """Hide ``modifiers`` in the viewport meanwhile."""
    for modifier in modifiers:
        modifier.show_viewport = False
    try:
        yield
    finally:
        for modifier in modifiers:
            modifier.show_viewport = True
