# SPDX-License-Identifier: GPL-3.0-or-later
"""The stages as processes, one after another: what ``physgen run`` and ``make demo`` do."""

from __future__ import annotations

import dataclasses
import json
import os
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ..physgen_addon.bridge.formats import require_video_name
from ..physgen_addon.bridge.option_flags import render_arguments
from ..physgen_addon.bridge.options import RenderOptions
from ..sim.app import worker
from ..sim.app.bake_inputs import BakeOptions, inputs_hash
from ..sim.app.process import own_command, run_stage
from ..sim.app.quality import load_quality
from ..sim.app.reconstruct import reconstruct_scene, require_physics, set_all_physics
from ..sim.errors import RenderError, SimulationError
from ..sim.events import Event, IsCancelled, OnEvent
from ..sim.reconstruct import ObjectRequest, ReconstructOptions
from ..sim.reconstruct.physics.chat import ChatRequest
from ..sim.reconstruct.pipeline import object_names
from ..sim.scene.folder import SceneFolder, load_scene, require_photo
from ..sim.scene.model import Vector
from ..sim.scene.overrides import check_overrides


def bake_stage(
    folder: SceneFolder, out: Path, options: BakeOptions, on_event: OnEvent, cancelled: IsCancelled
) -> Event:
    """Bake the scene that ``folder`` was when it was loaded, in the worker process.

    Raises what ``sim.app.bake.bake`` raises, and InputError when the scene was changed meanwhile.
    """
    load_quality(options.quality)
    job = worker.BakeJob(
        scene=str(folder.root.resolve()),
        out=str(out.resolve()),
        options=options,
        expected_inputs=inputs_hash(folder, options),
    )
    with tempfile.TemporaryDirectory(prefix="physgen-") as temporary:
        path = Path(temporary) / "job.json"
        path.write_text(json.dumps(worker.job_to_json(job)), encoding="utf-8")
        return run_stage(own_command("sim.app.worker", str(path)), on_event, cancelled, failure=SimulationError)


def render_stage(
    scene: Path,
    bake: Path,
    out: Path,
    options: RenderOptions,
    on_event: OnEvent,
    cancelled: IsCancelled,
    *,
    frames: str | None = None,
    video: Path | None = None,
) -> Event:
    """Render ``frames`` (None for all that are baked), and ``video`` from them, in a process that holds bpy.

    Raises InputError, before that process starts, for a scene without a photo and for options that cannot be used.
    """
    if video is not None:
        require_video_name(video)
    require_photo(load_scene(scene))
    command = own_command("batch.render", str(scene.resolve()), "--bake", str(bake.resolve()))
    command += ["--out", str(out.resolve()), "--json", "--parent", str(os.getpid()), *render_arguments(options)]
    if frames is not None:
        command += ["--frames", frames]
    if video is not None:
        command += ["--video", str(video.resolve())]
    # Blender crashes now and then when a video or a process ends; whole frames are kept, so it is tried once more.
    return run_stage(command, on_event, cancelled, failure=RenderError, restarts=1)


@dataclass(frozen=True, kw_only=True)
class RunRequest:
    """A whole job. ``work`` keeps ``scene``, ``bake`` and ``frames``; ``video`` is the result.

    presets, velocities, spins: by object, in the order of ``objects``; what is not given is ``medium`` and at rest, so
    that the same request always gives the same video. A single preset goes to all objects.
    overrides: ``OBJECT.FIELD=VALUE``, as ``sim/scene/overrides`` reads them.
    """

    photo: Path
    objects: tuple[ObjectRequest, ...]
    video: Path
    work: Path
    presets: tuple[str, ...] = ()
    velocities: tuple[Vector, ...] = ()
    spins: tuple[Vector, ...] = ()
    overrides: tuple[str, ...] = ()
    reconstruct: ReconstructOptions = dataclasses.field(default_factory=ReconstructOptions)
    ask: ChatRequest | None = None
    bake: BakeOptions = dataclasses.field(default_factory=BakeOptions)
    render: RenderOptions = dataclasses.field(default_factory=RenderOptions)


def expected_seconds(frames: int, *, stages: Sequence[str] = ("reconstruct", "bake", "render")) -> dict[str, float]:
    """First guesses for stages that have not begun: the coffee demo on two cores; paces measured later replace them."""
    guesses = {"reconstruct": 15.0, "bake": 8.0 + 0.6 * frames, "render": 8.0 + 5.0 * frames}
    return {stage: guesses[stage] for stage in stages}


def run(request: RunRequest, on_event: OnEvent, cancelled: IsCancelled) -> Path:
    """Photo → video. Each stage does nothing when its inputs have not changed.

    Everything that can be checked before the first stage is: nobody should wait for a message about the last one.
    """
    require_physics(len(request.objects), request.presets, request.velocities, request.spins)
    check_overrides(object_names(request.objects), request.overrides)
    load_quality(request.bake.quality)
    require_video_name(request.video)
    scene, bake = request.work / "scene", request.work / "bake"
    reconstruct_scene(request.photo, request.objects, scene, request.reconstruct, on_event, cancelled, ask=request.ask)
    folder = set_all_physics(
        scene,
        presets=request.presets,
        velocities=request.velocities,
        spins=request.spins,
        overrides=request.overrides,
        friction=request.reconstruct.friction,
    )
    bake_stage(folder, bake, request.bake, on_event, cancelled)
    render_stage(scene, bake, request.work / "frames", request.render, on_event, cancelled, video=request.video)
    return request.video
