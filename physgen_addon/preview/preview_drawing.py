# SPDX-License-Identifier: GPL-3.0-or-later
"""Viewport drawing of the preview's proxies, over the scene: not stored in the file or the undo history."""

from __future__ import annotations

from typing import Any

import bpy
import gpu
from gpu_extras.batch import batch_for_shader

from .preview_session import Clip, Session, shade_vertices


class Drawing:
    """Draws what ``session`` shows, in every 3D viewport of its scene, until removed."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._clip: Clip | None = None
        self._batches: dict[int, list[Any]] = {}
        self._handle: Any = bpy.types.SpaceView3D.draw_handler_add(self._draw, (), "WINDOW", "POST_VIEW")

    def remove(self) -> None:
        """Stop drawing."""
        if self._handle is not None:
            bpy.types.SpaceView3D.draw_handler_remove(self._handle, "WINDOW")
            self._handle = None
        self._batches = {}

    def _draw(self) -> None:
        session, clip = self._session, self._session.clip
        if clip is None or clip.done == 0 or bpy.context.scene.session_uid != session.scene_uid:
            return
        if clip is not self._clip:
            self._clip, self._batches = clip, {}
        shader = gpu.shader.from_builtin("SMOOTH_COLOR")
        if session.frame not in self._batches:
            self._batches[session.frame] = _batches(clip, session.frame, shader)
        depth, blend = gpu.state.depth_test_get(), gpu.state.blend_get()
        gpu.state.depth_test_set("LESS_EQUAL")
        gpu.state.depth_mask_set(True)
        gpu.state.face_culling_set("BACK")
        gpu.state.blend_set("ALPHA")
        with gpu.matrix.push_pop():
            gpu.matrix.scale_uniform(1.0 / session.unit)
            for batch in self._batches[session.frame]:
                batch.draw(shader)
        gpu.state.face_culling_set("NONE")
        gpu.state.depth_mask_set(False)
        gpu.state.depth_test_set(depth)
        gpu.state.blend_set(blend)


def _batches(clip: Clip, frame: int, shader: Any) -> list[Any]:
    """Return the GPU batches of ``frame``, cached so that a loop costs nothing."""
    return [
        batch_for_shader(
            shader,
            "TRIS",
            {"pos": proxy.samples[frame], "color": shade_vertices(proxy.samples[frame], proxy.faces)},
            indices=proxy.faces,
        )
        for proxy in clip.proxies
    ]
