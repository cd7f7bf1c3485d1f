# SPDX-License-Identifier: MIT
"""Jobs, plans, records, what comes through pipes, configuration, models, answers."""

from __future__ import annotations

import contextlib
import gzip
import io
import json
import tarfile
import tomllib
from pathlib import Path

from loaders import add, put_json, text_of
from physgen.batch import demo
from physgen.batch.farm.planning.job_file import load_job
from physgen.batch.farm.planning.plan import load_plan, save_plan
from physgen.batch.farm.planning.task_graph import make_plan
from physgen.batch.farm.run_task import listed_task
from physgen.batch.farm.task_records import Record, load_record, record_path, save_record
from physgen.sim.app import bake_worker
from physgen.sim.app.preview_server import parse_request, request_id
from physgen.sim.app.stage_process import parse_event
from physgen.sim.errors import InputError
from physgen.sim.gaussians.guidance.pretrained_models import read_json as read_model_json
from physgen.sim.reconstruct.adapters.adapter_registry import named_adapters
from physgen.sim.reconstruct.adapters.command_file import read_toml
from physgen.sim.reconstruct.models.model_folder import ArchiveReader
from physgen.sim.reconstruct.reasoning.answer_parser import read_answer
from physgen.sim.reconstruct.reasoning.material_names import load_names
from physgen.sim.scene.material import read_presets
from physgen.sim.version import VERSION


def _job(folder: Path) -> None:
    lines = ['format = "physgen-jobs/1"', 'name = "job"', "[matrix]", 'presets = ["soft", ["hard"]]', "seeds = [0, 3]"]
    lines += ["velocities = [[0, 0, 1]]", '"cup.density" = [300, 0.5]', "[defaults.bake]", "frames = 12", "fps = 24"]
    lines += ["[[scenes]]", 'name = "cup"', 'photo = "cup.png"', "boxes = [[1, 2, 30, 40]]", 'names = ["cup"]']
    (folder / "jobs.toml").write_text("\n".join(lines))
    (folder / "cup.png").write_bytes(b"any")


def _plan(folder: Path) -> None:
    _job(folder)
    save_plan(make_plan(load_job(folder / "jobs.toml"))).rename(folder / "plan.json")
    plan = json.loads((folder / "plan.json").read_text())
    put_json(folder / "plan.json", {**plan, "root": ".", "tasks": plan["tasks"][:3]})


def _record(folder: Path) -> None:
    _plan(folder)
    task = load_plan(folder / "plan.json").tasks[0]
    made = Record(
        task=task.id,
        version=VERSION,
        argv=task.argv,
        inputs=(("a", "0"),),
        produced=(),
        seconds=1.0,
        cpu_seconds=1.0,
        worker="w",
    )
    save_record(task, folder, made)
    record_path(task, folder).rename(folder / "record.json")


def _read_record(folder: Path) -> None:
    task = load_plan(folder / "plan.json").tasks[0]
    record_path(task, folder).parent.mkdir(parents=True, exist_ok=True)
    record_path(task, folder).unlink(missing_ok=True)
    with contextlib.suppress(FileNotFoundError):
        (folder / "record.json").rename(record_path(task, folder))
    load_record(task, folder)


def _worker_job(folder: Path) -> None:
    options = {"frames": 48, "fps": 24.0, "quality": "standard", "arch": "cpu", "seed": 0}
    put_json(
        folder / "job.json",
        {
            "format": "physgen-job/1",
            "use_case": "bake",
            "scene": str(folder),
            "out": str(folder / "b"),
            "options": options,
        },
    )


def _run_job(folder: Path) -> None:
    """The job is read; its scene is not there."""
    with contextlib.suppress(InputError):
        bake_worker.run_job(folder / "job.json", lambda event: None, lambda: False)


add("job file", "jobs.toml", _job, lambda f: load_job(f / "jobs.toml"))
add("plan", "plan.json", _plan, lambda f: load_plan(f / "plan.json"))
add("task record", "record.json", _record, _read_record)
add(
    "worker's job",
    "job.json",
    _worker_job,
    _run_job,
)
add(
    "list of tasks",
    "list.txt",
    lambda f: (f / "list.txt").write_text("a/b\nc/d\n"),
    lambda f: listed_task(f / "list.txt", "1"),
)
add(
    "preview request",
    "r.json",
    lambda f: put_json(
        f / "r.json", {"id": 1, "scene": "s", "overrides": ["a.density=3"], "frames": 10, "fps": 24, "particles": 500}
    ),
    lambda f: (request_id(text_of(f / "r.json")), parse_request(text_of(f / "r.json"))),
)
add(
    "event",
    "e.json",
    lambda f: put_json(f / "e.json", {"event": "progress", "stage": "bake", "done": 1, "total": 2}),
    lambda f: parse_event(text_of(f / "e.json")),
)


def _archive(folder: Path) -> None:
    packed = io.BytesIO()
    with tarfile.open(fileobj=packed, mode="w", format=tarfile.USTAR_FORMAT) as tar:
        for name, content in (("model/a.bin", b"x" * 700), ("model/b.bin", b"y" * 300)):
            info = tarfile.TarInfo(name)
            info.size = len(content)
            tar.addfile(info, io.BytesIO(content))
    (folder / "m.tgz").write_bytes(gzip.compress(packed.getvalue(), mtime=0))


def _read_archive(folder: Path) -> None:
    with ArchiveReader(folder / "m.tgz", 2**20) as reader:
        for _ in reader.members():
            for _ in reader.content():
                pass


def _adapters(folder: Path) -> None:
    (folder / "a.toml").write_text(
        '[segmenter]\nmine = "python:stages.py:segment"\n[depth_estimator]\nother = "command:d.toml"\n'
    )


def _preset(folder: Path) -> None:
    (folder / "jelly.toml").write_text(
        'description = "jelly"\ndensity = 1000\nyoungs_modulus = 1e4\npoisson_ratio = 0.4\n'
    )


def _names_table(folder: Path) -> None:
    source = Path(demo.__file__).parents[1] / "presets" / "names.toml"
    (folder / "n.toml").write_bytes(source.read_bytes())


def _demo(folder: Path) -> None:
    (folder / "d.toml").write_bytes(demo.CONFIG.read_bytes())
    assert tomllib.loads((folder / "d.toml").read_text())


ANSWER = """| object | material | density | E |
|---|---|---|---|
| 1 | wood | 700 kg/m3 | 1e9 Pa |
2. rubber, 1100, soft
roughness 0.4
"""

add("model archive", "m.tgz", _archive, _read_archive)
add("adapters", "a.toml", _adapters, lambda f: (read_toml(f / "a.toml"), named_adapters(f / "a.toml")))
add("material preset", "jelly.toml", _preset, read_presets)
add("names of objects", "n.toml", _names_table, lambda f: load_names(f / "n.toml"))
add("demo", "d.toml", _demo, lambda f: demo.load_config(f / "d.toml"))
add(
    "configuration of a model",
    "config.json",
    lambda f: put_json(f / "config.json", {"model_type": "sam", "vision_config": {"size": 3}}),
    lambda f: read_model_json(f / "config.json", "model", "give another"),
)
add(
    "answer of a model",
    "a.txt",
    lambda f: (f / "a.txt").write_text(ANSWER),
    lambda f: read_answer(text_of(f / "a.txt").decode("utf-8", "replace"), 2),
)
