# SPDX-License-Identifier: GPL-3.0-or-later
"""``--export flamenco``: a plan as a job of Flamenco, Blender Studio's render farm (docs/farm.md)."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from ...sim.atomic import write_bytes, write_json
from ...sim.errors import InputError
from .planning.plan import Plan, save_plan
from .runners import FarmOptions

SCRIPT_FILE = "physgen_batch.js"
JOB_TYPE = "physgen-batch"
"""Flamenco's name of the script: its file name with dashes."""

JOB_FILE = "job.json"
TASK_TYPES = {"reconstruct": "misc", "variant": "misc", "bake": "misc", "render": "blender", "encode": "ffmpeg"}
"""Stage → Flamenco's task type, by which workers can be restricted."""

_PLATFORMS = {"win32": "windows", "darwin": "darwin"}


def export_flamenco(plan: Plan, options: FarmOptions) -> list[Path]:
    """Write ``plan`` into the folder ``options.out``: the job type, and the job to submit; return the files.

    The plan file is written below its root, which the workers share. Raises InputError when something cannot be
    written, or for braces in the path, which Flamenco takes for variables.
    """
    if options.out is None:
        raise InputError("--out is missing: name the folder that the job is written to")
    if options.out.is_file():
        raise InputError(f"{options.out}: is a file; name a folder for the job")
    if "{" in str(plan.root):
        raise InputError(f"{plan.root}: braces are variables in Flamenco; rename the folder")
    plan_file = save_plan(plan)
    script = options.out / SCRIPT_FILE
    write_bytes(script, Path(__file__).with_name("flamenco_job_type.js").read_bytes())
    job = options.out / JOB_FILE
    write_json(job, _job(plan, plan_file, options))
    return [script, job, plan_file]


def _job(plan: Plan, plan_file: Path, options: FarmOptions) -> dict[str, Any]:
    """Return the ``SubmittedJob`` of Flamenco's API."""
    numbers = {task.id: number for number, task in enumerate(plan.tasks)}
    tasks = [[task.id, TASK_TYPES[task.stage], [numbers[need] for need in task.needs]] for task in plan.tasks]
    return {
        "name": plan.name,
        "type": JOB_TYPE,
        # Tells the manager how to translate paths where workers mount the folder elsewhere.
        "submitter_platform": _PLATFORMS.get(sys.platform, "linux"),
        "priority": 50,
        "settings": {
            "plan": str(plan_file),
            "python": options.cluster.python,
            "retries": 0,
            "tasks": json.dumps(tasks, separators=(",", ":"), ensure_ascii=False),
        },
        "metadata": {"project": plan.name, "physgen": plan.version},
    }
