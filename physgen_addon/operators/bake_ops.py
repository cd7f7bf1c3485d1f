# SPDX-License-Identifier: GPL-3.0-or-later
"""Operators: bake, pause, estimate."""

import contextlib
import threading
from pathlib import Path

import bpy

from ...sim.app.bake_options import BakeOptions, inputs_hash
from ...sim.app.bake_worker import BakeJob, job_to_json
from ...sim.app.stage_process import WarmStage, run_stage
from ...sim.cache.bake_folder import load_manifest
from ...sim.errors import Cancelled, InputError, PhysGenError
from ...sim.events import Event, IsCancelled, OnEvent
from ...sim.scene.folder import load_scene
from .. import background_jobs, bake_state, paths, unsaved_bakes
from ..background_jobs import Job, JobOperator, Work
from ..interpreter import bake_command, cli_command, find_python
from ..playback import bake_record, show_bake
from ..playback.bake_record import BakeRecord, read_record, write_record
from ..props.body_props import bodies
from ..props.preferences import python
from ..scene_io.export_animation import clock, export_names
from ..scene_io.export_scene import export_scene
from ..scene_io.motion_fingerprint import fingerprint
from ..text import duration, storage

warm_worker = WarmStage()
"""Of all bakes of this Blender: imports and kernels of one are there for the next."""


def warm_up(context: bpy.types.Context) -> None:
    """Start it, in a thread, for the bake that will come: it imports while the user chooses materials."""
    if bpy.app.background:
        return
    preferred = python(context)

    def prepare() -> None:
        # What is wrong is said when something is baked.
        with contextlib.suppress(PhysGenError):
            warm_worker.prepare(bake_command(find_python(preferred)))

    threading.Thread(target=prepare, name="physgen warm-up", daemon=True).start()


def unregister_warm_worker() -> None:
    """End it when the extension is disabled; it ends with Blender, too."""
    warm_worker.stop()


def exported(scene: bpy.types.Scene) -> tuple[Path, BakeOptions]:
    """Write the scene as a scene folder to its cache; return it with the simulation options.

    Raises InputError if nothing is simulated, frames or objects are invalid, or the cache is not writable.
    """
    settings = scene.physgen.simulation
    if not bodies(scene):
        raise InputError("nothing is simulated yet; select a mesh and press Simulate Selected (see Scene)")
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
        slow=times.slow,
        quality=settings.quality,
        arch=settings.device,
        seed=settings.seed,
        space="mesh",
        points=True,
    )
    return root, options


def option_arguments(options: BakeOptions) -> list[str]:
    """Return ``options`` as arguments of ``physgen``."""
    arguments = ["--frames", str(options.frames), "--fps", repr(options.fps), "--quality", options.quality]
    arguments += [
        "--slow",
        repr(options.slow),
        "--arch",
        options.arch,
        "--seed",
        str(options.seed),
        "--space",
        options.space,
    ]
    arguments.append("--points" if options.points else "--no-points")
    return [*arguments, "--implicit" if options.implicit else "--no-implicit"]


class Bake(JobOperator):
    """A bake of the context's scene: ``begin``, then ``tick`` until it returns a result."""

    bl_idname = bake_state.BAKE_OPERATOR
    job_title = "Bake"
    keeps_redo = True

    def request(self, context: bpy.types.Context) -> Work:
        """Export the scene and return the bake job; later edits cannot affect it."""
        scene = context.scene
        bake_state.set_trouble(scene, "")
        root, options = exported(scene)
        names = export_names(scene)
        start = scene.physgen.simulation.frame_start
        for item in bodies(scene):
            item.physgen.cache = names[item.name]
        looks = show_bake.looks_of(scene, names)
        record = BakeRecord(fingerprints=(fingerprint(scene),), frame_start=start, looks=looks)
        self._shown = 0
        self._is_first = not scene.physgen.simulation.bake
        preferred, before = python(context), background_jobs.stopping()

        def work(on_event: OnEvent, cancelled: IsCancelled) -> Event:
            on_event({"event": "detail", "fingerprint": record.fingerprints[0]})
            background_jobs.wait_for(before, on_event, cancelled)
            interpreter = find_python(preferred)
            inputs = inputs_hash(load_scene(root), options)
            folder = root.parent / bake_record.BAKES / inputs[:12]
            mine = BakeRecord(
                folder=str(folder),
                fingerprints=record.fingerprints,
                frame_start=record.frame_start,
                looks=record.looks,
            )
            write_record(mine)
            on_event({"event": "detail", "folder": str(folder)})
            job = BakeJob(scene=str(root), out=str(folder), options=options, expected_inputs=inputs)
            measured = False

            def relay(event: Event) -> None:
                nonlocal measured
                if not measured and int(event.get("done") or 0) > 0 and event.get("event") == "progress":
                    measured = True
                    write_record(bake_record.with_spacings(mine))
                on_event(event)

            done = warm_worker.run(bake_command(interpreter), job_to_json(job), relay, cancelled)
            return {**done, "folder": str(folder)}

        return work

    def begin(self, context: bpy.types.Context) -> Job:
        """Start as any job; errors are also shown in the panel, because reports vanish."""
        try:
            return super().begin(context)
        except PhysGenError as error:
            bake_state.set_trouble(context.scene, str(error))
            raise

    def progressed(self, scene: bpy.types.Scene, job: Job) -> None:
        """Attach the caches at the first frame; Blender reads appended frames by itself."""
        bake_state.mark_progress(scene)
        folder, done = job.details.get("folder"), job.done or 0
        if folder is None or done < 1 or done == self._shown:
            return
        path = Path(folder)
        # Undo may have detached the caches.
        if not self._shown or not bake_state.shows(scene, path):
            record = read_record(path)
            if record is None or not bake_record.playable(path):
                return
            if job.undone and not bake_state.matches(scene, record):
                return
            show_bake.show(scene, record)
        self._refresh_held_frame(scene, done)
        self._shown = done

    def _refresh_held_frame(self, scene: bpy.types.Scene, done: int) -> None:
        """Re-evaluate if the current frame lies beyond the last baked one, which has just been appended."""
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
        if self._job.undone and not bake_state.matches(scene, record):
            bake_state.observe(scene)
            return "Baked, but what was baked has been undone: redo it to see the bake"
        troubles = show_bake.show(scene, record)
        # Of the bake: settings may have been undone since it began.
        last = record.frame_start + load_manifest(folder).frames_done - 1
        ends = self._is_first and scene.frame_end > last and not _animated_after(last)
        scene.frame_end = last if ends else max(scene.frame_end, last)
        waits = paths.is_unsaved_cache(scene)
        unsaved_bakes.settle(scene)
        bake_state.observe(scene)
        sentence = f"Baked frames {record.frame_start} to {last}"
        if ends:
            sentence += f"; playback now ends at {last}"
        if waits:
            sentence += ". Save the file to keep them: they are in a temporary folder"
        return ". ".join([sentence, *troubles])

    def stopped(self, scene: bpy.types.Scene, error: PhysGenError) -> None:
        """Keep the available frames playable."""
        bake_state.set_trouble(scene, "" if isinstance(error, Cancelled) else str(error))
        unsaved_bakes.settle(scene)
        bake_state.refresh(scene)


def _animated_after(frame: int) -> bool:
    """Return whether any animation of the file goes on after ``frame``."""
    return any(action.frame_range[1] > frame for action in bpy.data.actions)


class PHYSGEN_OT_bake(Bake, bpy.types.Operator):
    """Simulate the scene. Frames can be played as they arrive; a stopped bake is resumed"""

    bl_idname = bake_state.BAKE_OPERATOR
    bl_label = "Bake"
    bl_options = {"UNDO"}  # noqa: RUF012


class PHYSGEN_OT_pause_bake(bpy.types.Operator):
    """Pause the bake. Its frames stay playable, and Bake resumes it, even after Blender was closed"""

    bl_idname = "physgen.pause_bake"
    bl_label = "Pause"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Enabled while this scene is being baked."""
        return bake_state.bake_job(context.scene) is not None

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Request the stop; the worker saves its state."""
        job = bake_state.bake_job(context.scene)
        if job is not None:
            job.cancel()
        return {"FINISHED"}


class PHYSGEN_OT_estimate_bake(JobOperator, bpy.types.Operator):
    """Estimate the number of particles, memory and time of the bake"""

    bl_idname = "physgen.estimate_bake"
    bl_label = "Estimate"
    job_title = "Estimate"

    def request(self, context: bpy.types.Context) -> Work:
        """Export the scene and return the estimate as a child process."""
        scene = context.scene
        root, options = exported(scene)
        current, preferred, before = fingerprint(scene), python(context), background_jobs.stopping()

        def work(on_event: OnEvent, cancelled: IsCancelled) -> Event:
            background_jobs.wait_for(before, on_event, cancelled)
            command = cli_command(find_python(preferred), "estimate", str(root), *option_arguments(options))
            return {**run_stage(command, on_event, cancelled), "fingerprint": current}

        return work

    def finished(self, scene: bpy.types.Scene, final: Event) -> str:
        """Store the estimate until the scene changes."""
        settings = scene.physgen.simulation
        settings.estimate, settings.estimate_of = estimate_text(final), str(final["fingerprint"])
        bake_state.observe(scene)
        return settings.estimate


def estimate_text(cost: Event) -> str:
    """Return the result of ``physgen estimate`` as a sentence."""
    return (
        f"About {duration(float(cost['seconds']))} and {storage(int(cost['memory_bytes']))} of memory, "
        f"{storage(int(cost['disk_bytes']))} on the disk: {cost['particles']} particles, "
        f"{cost['substeps']} time steps"
    )
