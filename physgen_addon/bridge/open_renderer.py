# SPDX-License-Identifier: GPL-3.0-or-later
"""A renderer on the device that there is: one that fails on a graphics card is replaced by one on the CPU."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

from ...sim.composite.layers import FrameLayers
from ...sim.errors import RenderError
from ...sim.scene.folder import SceneFolder
from . import caches, compat, devices, graphics
from .data_passes import DataLayers
from .options import RenderOptions
from .plan import Frame
from .renderer import Renderer
from .shot import Shot


class OpenRenderer:
    """Renders the frames of a plan. Close it after use."""

    def __init__(
        self,
        scene: SceneFolder,
        bake: caches.Bake,
        options: RenderOptions,
        shot: Shot,
        notice: Callable[[str], None],
    ) -> None:
        """``notice`` is told which device renders. Raises InputError and RenderError as ``Renderer`` does."""
        self._inputs, self._notice = (scene, bake, shot), notice
        if options.engine == "eevee":
            notice(f"EEVEE draws on {graphics.require_graphics()}")
        else:
            compat.enable_cycles()
            options = dataclasses.replace(options, device=devices.choose(options.device, notice))
        self._options = options
        try:
            self._renderer = self._open()
        except RenderError as error:
            self._fall_back(error)

    def layers(self, frame: Frame) -> tuple[FrameLayers, DataLayers | None]:
        """``frame`` and what it was made of; its data where the options ask for layers. RenderError when it fails."""
        try:
            return self._layers(frame)
        except RenderError as error:
            self.close()
            self._fall_back(error)
            return self._layers(frame)

    def close(self) -> None:
        """Remove what was built in Blender."""
        self._renderer.close()

    def _open(self) -> Renderer:
        scene, bake, shot = self._inputs
        return Renderer(scene, bake, self._options, shot)

    def _fall_back(self, error: RenderError) -> None:
        """Open a renderer on the CPU after one failed with ``error`` on a graphics card; else ``error`` is raised."""
        if self._options.engine != "cycles" or self._options.device == "cpu":
            raise error
        self._notice(f"{self._options.device} failed ({error}); renders on the CPU from here on")
        self._options = dataclasses.replace(self._options, device="cpu")
        self._renderer = self._open()

    def _layers(self, frame: Frame) -> tuple[FrameLayers, DataLayers | None]:
        renderer, data = self._renderer, None
        made = renderer.frame(frame.sample, frame.cameras[0])
        if self._options.frame_format.layered:
            data = renderer.data(frame.sample, after=frame.after, before=frame.before, cameras=frame.cameras)
        return made, data
