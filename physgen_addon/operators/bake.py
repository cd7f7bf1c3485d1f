# SPDX-License-Identifier: GPL-3.0-or-later
"""Bake the scene beside Blender: what is done can be played while the rest is computed; stop and go on at any time."""

from __future__ import annotations

from pathlib import Path

import bpy

from ...sim.app.bake_inputs import BakeOptions, inputs_hash
from ...sim.app.process import run_stage
from ...sim.errors import Cancelled, InputError, PhysGenError
from ...sim.events import Event, IsCancelled, OnEvent
from ...sim.scene.folder import load_scene
from .. import bake_record, bake_state, jobs, paths, unsaved
from ..bake_record import BakeRecord, read_record, write_record
from ..bridge import playback
from ..bridge.export import export_scene
from ..bridge.export_names import export_names
from ..bridge.export_units import clock
from ..bridge.fingerprint import fingerprint
from ..interpreter import cli_command, find_python
from ..jobs import Job, JobOperator, Work
from ..props.body import bodies
from ..props.preferences import python
from ..text import duration, storage


def exported(scene: bpy.types.Scene) -> tuple[Path, BakeOptions]:
    """The scene as a scene folder in its cache, and how it is to be simulated.

    Raises InputError when nothing takes part, frames or objects cannot be used, or the cache cannot be written.
    """
    settings = scene.physgen.simulation
    if not bodies(scene):
        raise InputError("no object takes part in the simulation; select one and turn on In Simulation")
    if settings.frame_end <= settings.frame_start:
        raise InputError(
            f"End is frame {settings.frame_end} and Start {settings.frame_start}; let End come after Start"
        )
    if paths.is_unsaved_cache(scene):
        paths.make_unsaved_root()
        settings.unsaved = settings.unsaved or paths.unsaved_key()
    root = paths.scene_cache(scene) / "scene"
    paths.require_writable(root)
    export_scene(scene, root)
    times = clock(scene)
    options = BakeOptions(
        frames=len(times.frames),
        fps=times.fps,
        quality=settings.quality,
        arch=settings.device,
        seed=settings.seed,
        space="mesh",
        points=True,
    )
    return root, options


def option_arguments(options: BakeOptions) -> list[str]:
    """``options`` as arguments of ``physgen``."""
    arguments = ["--frames", str(options.frames), "--fps", repr(options.fps), "--quality", options.quality]
    arguments += ["--arch", options.arch, "--seed", str(options.seed), "--space", options.space]
    return [*arguments, "--points" if options.points else "--no-points"]


class Bake(JobOperator):
    """A bake of the context's scene, step by step: ``begin``, ``tick`` until it returns something."""

    bl_idname = bake_state.BAKE_OPERATOR
    job_title = "Bake"

    def request(self, context: bpy.types.Context) -> Work:
        """The scene folder is written now, so that what is changed afterwards cannot get into the bake."""
        scene = context.scene
        bake_state.set_trouble(scene, "")
        root, options = exported(scene)
        names = export_names(scene)
        start = scene.physgen.simulation.frame_start
        for item in bodies(scene):
            item.physgen.cache = names[item.name]
        looks = tuple(playback.look_of(item, names[item.name], start) for item in bodies(scene))
        record = BakeRecord(fingerprints=(fingerprint(scene),), frame_start=start, looks=looks)
        self._shown = 0
        preferred, before = python(context), jobs.stopping()

        def work(on_event: OnEvent, cancelled: IsCancelled) -> Event:
            on_event({"event": "detail", "fingerprint": record.fingerprints[0]})
            jobs.wait_for(before, on_event, cancelled)
            interpreter = find_python(preferred)
            folder = root.parent / bake_record.BAKES / inputs_hash(load_scene(root), options)[:12]
            mine = BakeRecord(
                folder=str(folder),
                fingerprints=record.fingerprints,
                frame_start=record.frame_start,
                looks=record.looks,
            )
            write_record(mine)
            on_event({"event": "detail", "folder": str(folder)})
            command = cli_command(interpreter, "bake", str(root), "--out", str(folder), *option_arguments(options))
            measured = False

            def relay(event: Event) -> None:
                nonlocal measured
                if not measured and int(event.get("done") or 0) > 0 and event.get("event") == "progress":
                    measured = True
                    write_record(bake_record.with_spacings(mine))
                on_event(event)

            return {**run_stage(command, relay, cancelled), "folder": str(folder)}

        return work

    def begin(self, context: bpy.types.Context) -> Job:
        """As any job; what cannot be baked is also said in the panel, because reports vanish."""
        try:
            return super().begin(context)
        except PhysGenError as error:
            bake_state.set_trouble(context.scene, str(error))
            raise

    def progressed(self, scene: bpy.types.Scene, job: Job) -> None:
        """Attach the caches as soon as there is a frame; afterwards Blender reads what is appended by itself."""
        bake_state.mark_progress(scene)
        folder, done = job.details.get("folder"), job.done or 0
        if folder is None or done < 1 or done == self._shown:
            return
        path = Path(folder)
        # Undo may have taken it out again.
        if not self._shown or not bake_state.shows(scene, path):
            record = read_record(path)
            if record is None or not bake_record.playable(path):
                return
            playback.show(scene, record)
        self._refresh_held_frame(scene, done)
        self._shown = done

    def _refresh_held_frame(self, scene: bpy.types.Scene, done: int) -> None:
        """What stands beyond the last frame shows that frame, and has to be looked at again when there is a new one."""
        start = scene.physgen.simulation.frame_start
        if scene.frame_current >= start + self._shown:
            for item in bodies(scene):
                item.update_tag(refresh={"DATA"})

    def finished(self, scene: bpy.types.Scene, final: Event) -> str:
        """Show the whole bake."""
        folder = Path(str(final["folder"]))
        record = read_record(folder)
        if record is None:
            raise InputError(f"{folder}: the record of the bake is gone; bake again")
        troubles = playback.show(scene, record)
        last = scene.physgen.simulation.frame_end
        scene.frame_end = max(scene.frame_end, last)
        waits = paths.is_unsaved_cache(scene)
        unsaved.settle(scene)
        bake_state.observe(scene)
        sentence = f"frames {record.frame_start} to {last} are baked"
        if waits:
            sentence += "; they wait in a temporary folder until you save the file"
        return ". ".join([sentence, *troubles])

    def stopped(self, scene: bpy.types.Scene, error: PhysGenError) -> None:
        """Frames that are there stay playable."""
        bake_state.set_trouble(scene, "" if isinstance(error, Cancelled) else str(error))
        unsaved.settle(scene)
        bake_state.refresh(scene)


class PHYSGEN_OT_bake(Bake, bpy.types.Operator):
    """Simulate the scene. Frames can be played as they arrive; a bake that was stopped goes on where it was"""

    bl_idname = bake_state.BAKE_OPERATOR
    bl_label = "Bake"
    bl_options = {"UNDO"}  # noqa: RUF012


class PHYSGEN_OT_pause_bake(bpy.types.Operator):
    """Stop the bake for now. Its frames stay playable, and Bake goes on where it was, also after Blender was closed"""

    bl_idname = "physgen.pause_bake"
    bl_label = "Pause"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """This scene is being baked."""
        return bake_state.bake_job(context.scene) is not None

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Ask; the worker stores where it is."""
        job = bake_state.bake_job(context.scene)
        if job is not None:
            job.cancel()
        return {"FINISHED"}


class PHYSGEN_OT_estimate_bake(JobOperator, bpy.types.Operator):
    """Say how many particles the bake will have, and what memory and time it will take"""

    bl_idname = "physgen.estimate_bake"
    bl_label = "Estimate"
    job_title = "Estimate"

    def request(self, context: bpy.types.Context) -> Work:
        """The estimate as a child process, on the scene folder as it is written now."""
        scene = context.scene
        root, options = exported(scene)
        current, preferred, before = fingerprint(scene), python(context), jobs.stopping()

        def work(on_event: OnEvent, cancelled: IsCancelled) -> Event:
            jobs.wait_for(before, on_event, cancelled)
            command = cli_command(find_python(preferred), "estimate", str(root), *option_arguments(options))
            return {**run_stage(command, on_event, cancelled), "fingerprint": current}

        return work

    def finished(self, scene: bpy.types.Scene, final: Event) -> str:
        """Keep it for as long as the scene stays as it is."""
        settings = scene.physgen.simulation
        settings.estimate, settings.estimate_of = estimate_text(final), str(final["fingerprint"])
        bake_state.observe(scene)
        return settings.estimate


def estimate_text(cost: Event) -> str:
    """The answer of ``physgen estimate`` in a sentence."""
    return (
        f"About {duration(float(cost['seconds']))} and {storage(int(cost['memory_bytes']))} of memory, "
        f"{storage(int(cost['disk_bytes']))} on the disk: {cost['particles']} particles, "
        f"{cost['substeps']} time steps"
    )


CLASSES = (PHYSGEN_OT_bake, PHYSGEN_OT_pause_bake, PHYSGEN_OT_estimate_bake)
