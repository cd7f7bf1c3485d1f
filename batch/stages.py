# SPDX-License-Identifier: GPL-3.0-or-later
"""Bake and render as processes of their own, and all stages from photo to video: ``physgen run`` and ``make demo``."""

from __future__ import annotations

import dataclasses
import json
import os
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from ..physgen_addon.render.render_options import RenderOptions, render_arguments, require_video_name
from ..sim.app import bake_worker
from ..sim.app.add_drops import Drop, add_drops
from ..sim.app.bake_options import BakeOptions, inputs_hash
from ..sim.app.reconstruct import Physics, reconstruct, require_physics
from ..sim.app.stage_process import own_command, run_stage
from ..sim.atomic import scratch_prefix
from ..sim.cache.bake_folder import Bake, load_bake
from ..sim.errors import RenderError, SimulationError
from ..sim.events import Event, IsCancelled, OnEvent, ignore, never
from ..sim.folder_lock import lock_beside
from ..sim.memory import RENDERING_RESERVED, available_memory, rendering_bytes, require_memory
from ..sim.reconstruct import ObjectRequest, ReconstructOptions
from ..sim.reconstruct.reasoning.chat_client import ChatRequest
from ..sim.reconstruct.reconstruct_options import object_names
from ..sim.scene.bake_quality import load_quality
from ..sim.scene.folder import Scene, require_photo
from ..sim.scene.overrides import check_overrides
from ..sim.scene.textured_mesh import texture_pixels
from .export import ENDINGS

if TYPE_CHECKING:
    from ..sim.app.default_motion import DefaultMotion
    from ..sim.app.set_light import LightRequest


def run_bake(folder: Scene, out: Path, options: BakeOptions, on_event: OnEvent, cancelled: IsCancelled) -> Event:
    """Bake the scene, as loaded, in a worker process of ``physgen.bake``; return its ``done`` event.

    Raises as ``sim.app.bake.bake``, and InputError when the scene on disk has changed since.
    """
    load_quality(options.quality)
    job = bake_worker.BakeJob(
        scene=str(folder.root.resolve()),
        out=str(out.resolve()),
        options=options,
        expected_inputs=inputs_hash(folder, options),
    )
    with tempfile.TemporaryDirectory(prefix=scratch_prefix()) as temporary:
        path = Path(temporary) / "job.json"
        path.write_text(json.dumps(bake_worker.job_to_json(job)), encoding="utf-8")
        return run_stage(own_command("sim.app.bake_worker", str(path)), on_event, cancelled, failure=SimulationError)


def render(
    scene: Scene,
    bake: Bake,
    *,
    out: str | Path,
    options: RenderOptions | None = None,
    frames: str | None = None,
    video: str | Path | None = None,
    on_event: OnEvent = ignore,
    cancelled: IsCancelled = never,
) -> tuple[Path, ...]:
    """Return the frames of ``bake`` rendered into the scene's photo, as image files in the folder ``out``, in order.

    Blender runs in a process of its own. Frames that exist and whose inputs have not changed are not rendered again.
    frames: a range such as ``1-48``, ``1,5,9`` or ``1-48x2``; None for all baked. video: also encode .mp4 or .webm.

    >>> import physgen
    >>> scene, baked = physgen.load_scene("scene"), physgen.load_bake("bake")  # doctest: +SKIP
    >>> options = physgen.RenderOptions(samples=32)
    >>> frames = physgen.render(scene, baked, out="frames", options=options, video="video.mp4")  # doctest: +SKIP

    Raises InputError for a scene without a photo and for unusable options, before Blender starts; RenderError when
    Blender fails; Cancelled when cancelled: complete frames are kept then.
    """
    options, out = options or RenderOptions(), Path(out)
    done = run_render(scene, bake, out, options, frames=frames, video=video, on_event=on_event, cancelled=cancelled)
    return tuple(out / name for name in done["files"])


def run_render(
    scene: Scene,
    bake: Bake,
    out: Path,
    options: RenderOptions,
    *,
    frames: str | None = None,
    video: str | Path | None = None,
    on_event: OnEvent,
    cancelled: IsCancelled,
) -> Event:
    """Return the ``done`` event of ``render``'s process, as ``physgen render --json`` prints it."""
    if video is not None:
        require_video_name(Path(video))
    require_photo(scene)
    camera = scene.model.camera
    width, height = round(camera.width * options.scale), round(camera.height * options.scale)
    points = sum(bake.manifest.files.values())
    texels = sum(texture_pixels(scene.file(item.mesh)) for item in scene.objects)
    textures = f" and {texels} pixels of textures" if texels else ""
    require_memory(
        rendering_bytes(width * height, points, texels),
        available_memory(RENDERING_RESERVED),
        what=f"frames of {width}x{height} pixels with {points} vertices and particles{textures}",
        remedy="give a lower --scale",
    )
    command = own_command("batch.render", str(scene.root.resolve()), "--bake", str(bake.root.resolve()))
    command += ["--out", str(out.resolve()), "--json", "--parent", str(os.getpid()), *render_arguments(options)]
    if frames is not None:
        command += ["--frames", frames]
    if video is not None:
        command += ["--video", str(Path(video).resolve())]
    # Blender occasionally crashes when a video or a process ends; complete frames are kept, so try once more.
    return run_stage(command, on_event, cancelled, failure=RenderError, restarts=1)


def export_alembic(
    scene: Scene, bake: Bake, file: str | Path, *, on_event: OnEvent = ignore, cancelled: IsCancelled = never
) -> None:
    """Write the objects of ``scene`` with the motion of ``bake`` to the new ``file``, ``.abc``: meshes, grains, camera.

    Blender runs in a process of its own; its first frame is the bake's. Grains are vertices, liquids their surface.

    >>> import physgen
    >>> scene, baked = physgen.load_scene("scene"), physgen.load_bake("bake")  # doctest: +SKIP
    >>> physgen.export_alembic(scene, baked, "scene.abc")  # doctest: +SKIP

    Raises InputError where the file exists or the bake is of another scene, RenderError when Blender fails; Cancelled.
    """
    run_export(scene, bake, Path(file), on_event, cancelled)


def run_export(scene: Scene, bake: Bake, file: Path, on_event: OnEvent, cancelled: IsCancelled) -> Event:
    """Return the ``done`` event of the process of ``export_alembic``."""
    from ..sim.app.export_usd import require_target

    require_target(scene, bake, file, ENDINGS)
    command = own_command("batch.export", str(scene.root.resolve()), "--bake", str(bake.root.resolve()))
    command += ["--out", str(file.resolve()), "--json", "--parent", str(os.getpid())]
    return run_stage(command, on_event, cancelled, failure=RenderError)


@dataclass(frozen=True, kw_only=True)
class Choices:
    """Choices left to the program, to suit the scene (``sim/app/default_motion``).

    motion: of the objects. frames, slow: with it, the clip's length and slow motion, in place of the bake's options.
    """

    motion: bool = False
    frames: bool = False
    slow: bool = False


@dataclass(frozen=True, kw_only=True)
class RunRequest:
    """A job from photo to ``video``; ``work`` holds ``scene``, ``bake`` and ``frames``.

    physics: per object, in the order of ``objects``; by default ``medium`` and at rest. choices: what is chosen
    instead. drops: what falls into the picture. light: in place of the photo's estimated one. The same request always
    gives the same video.
    """

    photo: Path
    objects: tuple[ObjectRequest, ...]
    video: Path
    work: Path
    physics: Physics = dataclasses.field(default_factory=Physics)
    reconstruct: ReconstructOptions = dataclasses.field(default_factory=ReconstructOptions)
    ask: ChatRequest | None = None
    bake: BakeOptions = dataclasses.field(default_factory=BakeOptions)
    render: RenderOptions = dataclasses.field(default_factory=RenderOptions)
    choices: Choices = dataclasses.field(default_factory=Choices)
    drops: tuple[Drop, ...] = ()
    light: LightRequest | None = None


def expected_seconds(frames: int, *, stages: Sequence[str] = ("reconstruct", "bake", "render")) -> dict[str, float]:
    """Return initial guesses per stage, of photos a megapixel large on two cores, until their pace is known."""
    guesses = {"reconstruct": 40.0, "bake": 8.0 + 0.6 * frames, "render": 8.0 + 5.0 * frames}
    return {stage: guesses[stage] for stage in stages}


EXPLAIN_SECONDS = {"track": 6.0, "fit": 12.0, "compare": 3.0}
"""Initial guesses per stage of ``physgen explain``, of a hundred frames on two cores."""


def choose_motion(
    scene: Scene,
    options: BakeOptions,
    choices: Choices,
    on_event: OnEvent,
    *,
    rehearsals: Path | None = None,
    cancelled: IsCancelled = never,
) -> tuple[Scene, BakeOptions]:
    """Return ``scene`` set in motion and the options of a bake that shows it; a notice says what was chosen.

    rehearsals: folder for coarse bakes, which tell when the motion is over and whether all of it is in the picture;
    None is content with an estimate. A scene with effects moves by these: the caller asks for no default motion then.
    """
    # Imported here: it needs SciPy, which most commands do without.
    from ..sim.app.default_motion import default_motion

    frames = None if choices.frames else options.frames
    slow = None if choices.slow else options.slow
    motion = default_motion(scene, fps=options.fps, frames=frames, slow=slow)
    if rehearsals is not None and motion.moves:
        motion = _rehearse(scene, motion, options, frames, slow, rehearsals, on_event, cancelled)
    on_event({"event": "notice", "stage": "motion", "message": motion.sentence})
    return motion.applied(scene), dataclasses.replace(options, frames=motion.frames, slow=motion.slow)


def _rehearse(
    scene: Scene,
    motion: DefaultMotion,
    options: BakeOptions,
    frames: int | None,
    slow: float | None,
    folder: Path,
    on_event: OnEvent,
    cancelled: IsCancelled,
) -> DefaultMotion:
    """Return ``motion`` with the speed and the clip that coarse bakes in ``folder`` suggest.

    What falls over in one only hops straight up in the next, then to a quarter of the height, and stays where it is if
    it falls over even so. What turns sides to the camera that the photo does not show neither turns nor leans in the
    next, then hops straight up. What does either in a later move of its own is spared that one. What leaves the picture
    at a lower speed, too, stays where it is if something else moves.
    """
    from ..sim.app.clip_check import MOST_REHEARSALS, rehearsal_options, rehearsed
    from ..sim.app.default_motion import default_motion

    low: set[str] = set()
    calm: set[str] = set()
    plain: set[str] = set()
    still: set[str] = set()
    for number in range(MOST_REHEARSALS):
        out = folder / str(number)
        try:
            run_bake(motion.applied(scene), out, rehearsal_options(motion, options), ignore, cancelled)
        except SimulationError as error:
            message = f"no rehearsal: {error}; when the motion is over is an estimate"
            on_event({"event": "notice", "stage": "motion", "message": message})
            return motion
        found = rehearsed(scene, load_bake(out), motion, frames=frames, slow=slow)
        moved = {move.name for move in motion.moves}
        fallen = moved & set(found.toppled)
        # A hop straight up is the least there is.
        turned = (moved & set(found.turned)) - calm
        # Even at a lower speed, as a stone that rolls; unless nothing else moves.
        gone = moved & set(found.leaving) if number == MOST_REHEARSALS - 2 else set()
        gone = gone if moved - gone else set()
        shorter = found.shortened(scene)
        if shorter is not None and number < MOST_REHEARSALS - 1:
            motion = shorter
        elif fallen or turned or gone:
            still |= gone | (fallen & low)
            low |= fallen & calm
            calm |= fallen | (turned & plain)
            plain |= turned
            motion = default_motion(
                scene, fps=options.fps, frames=frames, slow=slow, calm=calm, plain=plain, low=low, still=still
            )
            if not motion.moves:
                return motion
        elif not found.leaving or number == MOST_REHEARSALS - 1:
            return found.motion
        else:
            motion = found.tamed(scene)
    return motion


def photo_to_video(request: RunRequest, on_event: OnEvent, cancelled: IsCancelled) -> Path:
    """Run all stages from photo to video; return its path. A stage whose inputs have not changed does nothing.

    Everything is validated before the first stage starts, as far as possible.
    """
    require_physics(len(request.objects), request.physics)
    check_overrides(object_names(request.objects), request.physics.overrides)
    load_quality(request.bake.quality)
    require_video_name(request.video)
    with lock_beside(request.work / "scene"):
        scene, options = _moving_scene(request, on_event, cancelled)
    run_bake(scene, request.work / "bake", options, on_event, cancelled)
    render(
        scene,
        load_bake(request.work / "bake"),
        out=request.work / "frames",
        options=request.render,
        video=request.video,
        on_event=on_event,
        cancelled=cancelled,
    )
    return request.video


def _moving_scene(request: RunRequest, on_event: OnEvent, cancelled: IsCancelled) -> tuple[Scene, BakeOptions]:
    """Return the scene of ``request`` as it is to be baked, and the options of that; the caller holds its folder, so
    that nothing changes it between the steps."""
    scene = reconstruct(
        request.photo,
        request.objects,
        out=request.work / "scene",
        options=request.reconstruct,
        physics=request.physics,
        ask=request.ask,
        on_event=on_event,
        cancelled=cancelled,
    )
    options = request.bake
    if request.light is not None:
        # Imported here: it needs SciPy, which most commands do without.
        from ..sim.app.set_light import set_light

        scene = set_light(scene, request=request.light, on_event=on_event)
    if request.drops:
        scene = add_drops(scene, request.drops)
    if request.choices.motion and not scene.model.effects:
        rehearsals = request.work / "rehearsal"
        scene, options = choose_motion(
            scene, options, request.choices, on_event, rehearsals=rehearsals, cancelled=cancelled
        )
    return scene, options
