# SPDX-License-Identifier: GPL-3.0-or-later
"""Job file → plan: reconstruct once a photo, then variant → bake → render in chunks → encode for each variant."""

from __future__ import annotations

import itertools
import json
from collections.abc import Sequence

from ....physgen_addon.frames.frame_index import own_fps
from ....physgen_addon.render.render_options import render_arguments
from ....sim.app.bake_options import BakeOptions
from ....sim.errors import InputError
from ....sim.reconstruct.reconstruct_options import object_names
from ....sim.scene.folder import SCENE_FILE
from ....sim.scene.model import Vector
from ....sim.version import VERSION
from .job_file import Job, JobScene
from .job_matrix import Variant, describe
from .plan import Plan, Task

MOST_TASKS = 100_000
GPU = "gpu"
_VIDEO_FILES = {"mp4": "video.mp4", "webm": "video.webm", "sheet": "sheet.png"}


def make_plan(job: Job) -> Plan:
    """Return the plan of ``job``, variant by variant, so that the first videos are finished soon.

    Raises InputError for too many tasks.
    """
    tasks: list[Task] = []
    meanings: dict[str, str] = {}
    for scene in job.scenes:
        builder = _Builder(job, scene)
        tasks += builder.once
        for variant in scene.variants:
            meanings[f"{scene.name}/{variant.name}"] = describe(variant.physics)
            tasks += builder.variant(variant)
            if len(tasks) > MOST_TASKS:
                raise InputError(
                    f"{job.name}: has more than {MOST_TASKS} tasks; give fewer variants or larger chunks of frames"
                )
    return Plan(name=job.name, root=job.root, version=VERSION, tasks=tuple(tasks), out=job.out, meanings=meanings)


def frame_chunks(frames: Sequence[int], size: int) -> list[tuple[int, ...]]:
    """Return ``frames`` in chunks of ``size``."""
    return [tuple(frames[i : i + size]) for i in range(0, len(frames), size)]


def range_text(frames: Sequence[int]) -> str:
    """Return increasing frame numbers in the form of ``--frames``: ``1-12``, ``1-23x2`` or ``1,5,6``."""
    steps = {b - a for a, b in itertools.pairwise(frames)}
    if len(frames) == 1:
        return str(frames[0])
    if len(steps) == 1:
        step = steps.pop()
        return f"{frames[0]}-{frames[-1]}" + (f"x{step}" if step > 1 else "")
    return ",".join(map(str, frames))


def number_text(number: float) -> str:
    """Return the exact text of a number, without a decimal point if it is whole."""
    return str(int(number)) if number == int(number) and abs(number) < 1e15 else repr(number)


def _positional(path: str) -> str:
    """Return ``path`` as an argument that is not taken for a flag."""
    return f"./{path}" if path.startswith("-") else path


def _vectors(flag: str, vectors: Sequence[Vector]) -> list[str]:
    return [f"{flag}={','.join(map(number_text, vector))}" for vector in vectors]


class _Builder:
    """Builds the tasks of one scene; paths are relative to the job file's folder."""

    def __init__(self, job: Job, scene: JobScene) -> None:
        self._scene = scene
        self._farm = f"{job.out}/.farm"
        self._folder = f"{job.out}/{scene.name}"
        if scene.folder is None:
            self._names = tuple(object_names(scene.objects))
            self._source = f"{self._folder}/scene"
            self._files = _reconstructed_files(self._names)
            self.once = [self._reconstruct()]
        else:
            self._names = tuple(item.name for item in scene.folder.model.objects)
            self._source = scene.folder.root.relative_to(job.root).as_posix()
            self._files = (SCENE_FILE, *scene.folder.files())
            self.once = []

    def _task(
        self,
        id: str,
        stage: str,
        argv: Sequence[str],
        *,
        needs: Sequence[str] = (),
        inputs: Sequence[str],
        produces: Sequence[str],
        gpu: bool = False,
    ) -> Task:
        return Task(
            id=id,
            stage=stage,
            argv=tuple(argv),
            needs=tuple(needs),
            inputs=tuple(inputs),
            produces=tuple(produces),
            slots={GPU: 1} if gpu else {},
            farm_folder=self._farm,
        )

    def _reconstruct(self) -> Task:
        scene = self._scene
        assert scene.photo is not None
        argv = ["reconstruct", _positional(scene.photo), "--out", self._source]
        argv += [f"--box={','.join(map(number_text, item.box or ()))}" for item in scene.objects]
        argv += [f"--name={name}" for name in self._names]
        # Sizes are in the order of the objects, without gaps.
        sizes = [item.size_m for item in scene.objects if item.size_m is not None]
        argv += [f"--size={number_text(size)}" for size in sizes]
        reading = scene.reading
        for flag, value in (("horizon", reading.horizon_y), ("pitch", reading.pitch_deg), ("fov", reading.fov_deg)):
            argv += [] if value is None else [f"--{flag}={number_text(value)}"]
        return self._task(
            f"{scene.name}/reconstruct",
            "reconstruct",
            argv,
            inputs=[scene.photo],
            produces=[f"{self._source}/{name}" for name in self._files],
        )

    def variant(self, variant: Variant) -> list[Task]:
        """Return the tasks from the scene to the videos of one variant."""
        prefix, folder = f"{self._scene.name}/{variant.name}", f"{self._folder}/{variant.name}"
        copy = self._copy(variant, prefix, f"{folder}/scene")
        bake = self._bake(variant, prefix, folder)
        renders = self._renders(prefix, folder)
        return [copy, bake, *renders, *self._encodes(prefix, folder, renders)]

    def _copy(self, variant: Variant, prefix: str, out: str) -> Task:
        physics = variant.physics
        argv = ["variant", _positional(self._source), "--out", out]
        argv += [f"--preset={name}" for name in physics.presets]
        argv += _vectors("--velocity", physics.velocities) + _vectors("--spin", physics.spins)
        argv += [f"--set={text}" for text in physics.settings]
        if physics.effects is not None:
            listed = [
                {
                    "name": e.name,
                    "parameters": dict(e.parameters),
                    **({"objects": list(e.objects)} if e.objects else {}),
                }
                for e in physics.effects
            ]
            argv.append(f"--effects-json={json.dumps(listed, ensure_ascii=False)}")
        return self._task(
            f"{prefix}/variant",
            "variant",
            argv,
            needs=[task.id for task in self.once],
            inputs=[f"{self._source}/{name}" for name in self._files],
            produces=[f"{out}/{name}" for name in self._files],
        )

    def _bake(self, variant: Variant, prefix: str, folder: str) -> Task:
        options = self._scene.bake
        seed = options.seed if variant.physics.seed is None else variant.physics.seed
        out = f"{folder}/bake"
        argv = ["bake", f"{folder}/scene", "--out", out, "--frames", str(options.frames)]
        argv += ["--fps", number_text(options.fps), "--quality", options.quality, "--arch", options.arch]
        argv += ["--seed", str(seed), *([] if options.points else ["--no-points"])]
        argv += [] if options.implicit else ["--no-implicit"]
        argv += [] if options.slow == 1.0 else ["--slow", number_text(options.slow)]
        return self._task(
            f"{prefix}/bake",
            "bake",
            argv,
            needs=[f"{prefix}/variant"],
            inputs=[f"{folder}/scene"],
            produces=[f"{out}/manifest.json", *(f"{out}/{name}.pc2" for name in self._names)],
            gpu=options.arch != BakeOptions.arch,
        )

    def _renders(self, prefix: str, folder: str) -> list[Task]:
        options = self._scene.options
        suffix = options.frame_format.suffix
        files = [] if options.camera is None else [options.camera]
        tasks = []
        for frames in frame_chunks(self._scene.frames, self._scene.render.chunk):
            name = f"{frames[0]:04d}-{frames[-1]:04d}"
            out = f"{folder}/frames/{name}"
            argv = ["render", f"{folder}/scene", "--bake", f"{folder}/bake", "--out", out]
            argv += ["--frames", range_text(frames), *render_arguments(options)]
            tasks.append(
                self._task(
                    f"{prefix}/render-{name}",
                    "render",
                    argv,
                    needs=[f"{prefix}/bake"],
                    inputs=[f"{folder}/scene", f"{folder}/bake", *files],
                    produces=[f"{out}/{number:04d}{suffix}" for number in frames],
                    gpu=options.device != "cpu",
                )
            )
        return tasks

    def _encodes(self, prefix: str, folder: str, renders: Sequence[Task]) -> list[Task]:
        fps = own_fps(self._scene.frames, self._scene.bake.fps)
        folders = [str(task.produces[0].rpartition("/")[0]) for task in renders]
        return [
            self._task(
                f"{prefix}/encode-{kind}",
                "encode",
                ["encode", *folders, "--out", f"{folder}/{_VIDEO_FILES[kind]}", "--fps", number_text(fps)],
                needs=[task.id for task in renders],
                inputs=[name for task in renders for name in task.produces],
                produces=[f"{folder}/{_VIDEO_FILES[kind]}"],
            )
            for kind in self._scene.render.video
        ]


def _reconstructed_files(names: Sequence[str]) -> tuple[str, ...]:
    """Return the files that ``physgen reconstruct`` writes for objects of these ``names``."""
    each = [f for name in names for f in (f"meshes/{name}.glb", f"masks/{name}.png", f"shadows/{name}.png")]
    return (SCENE_FILE, "photo.png", "background.png", "light/environment.exr", *each)
