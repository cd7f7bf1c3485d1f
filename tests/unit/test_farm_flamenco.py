# SPDX-License-Identifier: GPL-3.0-or-later
"""The job type for Flamenco, run by a JavaScript engine, with a stand-in for what Flamenco hands to scripts."""

import json
import subprocess
import sys

import pytest
import quickjs
from physgen.batch.farm.flamenco_export import TASK_TYPES, export_flamenco
from physgen.batch.farm.planning.plan import STAGES, Plan, Task
from physgen.batch.farm.runners import FarmOptions
from physgen.batch.farm.task_records import record_path
from physgen.sim.errors import InputError
from physgen.sim.version import VERSION

FLAMENCO = """
"use strict";
const author = {
    Task: (name, type) => ({
        name, type, commands: [], needs: [],
        addCommand(command) { this.commands.push(command); },
        addDependency(task) { if (!task.name) throw "no task"; this.needs.push(task.name); },
    }),
    Command: (name, parameters) => ({ name, parameters }),
};
function compiled(settings) {
    const tasks = [];
    compileJob({ settings, addTask: (task) => tasks.push(task) });
    return JSON.stringify(tasks);
}
"""


def a_plan(root):
    task = Task(id="cup/reconstruct", stage="reconstruct", argv=("effects", "wind"))
    bakes = [Task(id=f"cup/ä {n}/bake", stage="bake", argv=("effects",), needs=(task.id,)) for n in "ab"]
    last = Task(id="cup/encode", stage="encode", argv=("effects",), needs=tuple(bake.id for bake in bakes))
    return Plan(name='a "job"', root=root, version=VERSION, tasks=(task, *bakes, last))


def test_the_job_compiles_to_its_tasks_and_their_commands_run(tmp_path):
    plan = a_plan(tmp_path / "a folder's name")
    plan.root.mkdir()
    script, job_file, plan_file = export_flamenco(plan, FarmOptions(out=tmp_path / "out"))
    job = json.loads(job_file.read_text())
    assert job["type"] == script.stem.replace("_", "-")
    engine = quickjs.Context()
    engine.eval(FLAMENCO + script.read_text())
    job_type = json.loads(engine.eval("JSON.stringify(JOB_TYPE)"))
    assert {s["key"] for s in job_type["settings"]} == set(job["settings"])
    kinds = {"string": str, "int32": int}
    assert all(isinstance(job["settings"][s["key"]], kinds[s["type"]]) for s in job_type["settings"])
    tasks = json.loads(engine.eval(f"compiled({json.dumps(job['settings'])})"))
    assert [(t["name"], t["type"], t["needs"]) for t in tasks] == [
        (task.id, TASK_TYPES[task.stage], list(task.needs)) for task in plan.tasks
    ]
    [command] = tasks[0]["commands"]
    assert command["name"] == "exec" and all(isinstance(word, str) for word in command["parameters"]["args"])
    assert str(plan_file) in command["parameters"]["args"]
    subprocess.run([command["parameters"]["exe"], *command["parameters"]["args"]], check=True, capture_output=True)
    assert record_path(plan.tasks[0], plan.root).is_file()
    assert command["parameters"]["exe"] == sys.executable


def test_every_stage_has_a_type_that_workers_of_flamenco_take():
    assert set(TASK_TYPES) == set(STAGES)
    assert set(TASK_TYPES.values()) <= {"blender", "ffmpeg", "file-management", "misc"}


def test_braces_in_the_path_are_refused_for_they_are_variables(tmp_path):
    with pytest.raises(InputError, match="braces"):
        export_flamenco(a_plan(tmp_path / "{jobs}"), FarmOptions(out=tmp_path / "out"))
    assert not (tmp_path / "out").exists()
