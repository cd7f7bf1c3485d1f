# SPDX-License-Identifier: GPL-3.0-or-later
"""A plan as scripts for SLURM: arrays that wait for each other (docs/farm-clusters.md)."""

from __future__ import annotations

import hashlib
import shlex
from collections.abc import Sequence
from pathlib import Path

from ...sim.atomic import write_bytes
from ...sim.errors import InputError
from .cluster_options import ClusterOptions
from .plan_file import save_plan
from .runners import FarmOptions
from .slurm_arrays import TaskArray, dependency, indices, task_arrays
from .task import STAGES, Plan

SUBMIT_FILE = "submit.sh"

_SUBMIT_HEAD = """\
#!/bin/bash
# Hands {what} to SLURM. Run it on a machine that has sbatch; run it again after failures: what is done is kept.
set -euo pipefail
here=$(cd -- "$(dirname -- "${{BASH_SOURCE[0]}}")" && pwd)
cd -- {root}
mkdir -p -- {logs}
job=()
held=()

# All or nothing: jobs that would wait for others that never came are taken back.
take_back() {{
    local code=$?
    if ((code != 0 && ${{#job[@]}} > 0)); then
        scancel "${{job[@]}}"
    fi
}}
trap take_back EXIT

# submit OPTIONS… SCRIPT LIST: its number becomes the next of job.
submit() {{
    local answer
    answer=$(sbatch --parsable --kill-on-invalid-dep=yes --output={logs}/%A_%a.out "$@")
    job+=("${{answer%%;*}}")
}}

# What waits for nothing is held until all is submitted: nothing can wait for a job that has ended and been forgotten.
"""

_SUBMIT_TAIL = """
for number in "${held[@]}"; do
    scontrol release "$number"
done
echo "submitted ${#job[@]} job arrays; squeue --me shows them"
"""

_STAGE = """\
#!/bin/bash
{directives}
set -euo pipefail
exec {command} "$SLURM_ARRAY_TASK_ID" --list "$1" --threads "${{SLURM_CPUS_PER_TASK:-0}}" --retries {retries}
"""


def export(plan: Plan, options: FarmOptions) -> list[Path]:
    """Write ``plan`` into the folder ``options.out``: a script that submits it, and one for each stage.

    The plan itself and the lists of the arrays' tasks are written below the plan's root, which the nodes see. Raises
    InputError when something cannot be written.
    """
    if options.out is None:
        raise InputError("--out is missing: name the folder that the scripts are written to")
    if options.out.is_file():
        raise InputError(f"{options.out}: is a file; name a folder for the scripts")
    plan_file = save_plan(plan)
    arrays = task_arrays(plan.tasks)
    lists = [_save_list(array, plan_file.parent) for array in arrays]
    written = [plan_file]
    for stage in STAGES:
        if any(array.stage == stage for array in arrays):
            text = _stage_script(plan_file, options)
            written.append(_save(options.out / f"{stage}.sbatch", text))
    logs = plan_file.parent.parent.relative_to(plan.root) / "slurm"
    submit = _save(options.out / SUBMIT_FILE, _submit_script(plan, arrays, lists, logs.as_posix()))
    submit.chmod(0o755)
    return [submit, *written, *lists]


def _submit_script(plan: Plan, arrays: Sequence[TaskArray], lists: Sequence[Path], logs: str) -> str:
    head = _SUBMIT_HEAD.format(
        what=f"{plan.name}: {len(plan.tasks)} tasks", root=_quoted(plan.root), logs=_quoted(logs)
    )
    lines = []
    for array, path in zip(arrays, lists, strict=True):
        waits = dependency(array, arrays)
        words = [
            f"--job-name={_quoted(f'{plan.name} {array.stage}')}",
            f"--array={indices(array)}",
            *(f"--gres={_quoted(f'{name}:{count}')}" for name, count in array.slots),
            f'--dependency="{waits}"' if waits else "--hold",
            f'"$here"/{array.stage}.sbatch',
            _quoted(path),
        ]
        lines.append(f"submit {' '.join(words)}")
        if not waits:
            lines.append('held+=("${job[-1]}")')
    return head + "\n".join(lines) + "\n" + _SUBMIT_TAIL


def _stage_script(plan_file: Path, options: FarmOptions) -> str:
    cluster = options.cluster
    command = shlex.join([cluster.python, "-m", "physgen.batch.farm.one", str(plan_file)])
    return _STAGE.format(directives="\n".join(directives(cluster)), command=command, retries=options.retries)


def directives(cluster: ClusterOptions) -> list[str]:
    """The ``#SBATCH`` lines that ``cluster`` asks for."""
    wanted = {
        "--cpus-per-task": str(cluster.cores),
        "--partition": cluster.queue,
        "--account": cluster.account,
        "--time": cluster.walltime,
        "--mem": cluster.memory,
    }
    # A task whose node has died begins again, and its log goes on.
    fixed = ["--ntasks=1", "--requeue", "--open-mode=append"]
    return [f"#SBATCH {text}" for text in [*fixed, *(f"{k}={v}" for k, v in wanted.items() if v), *cluster.sbatch]]


def _save_list(array: TaskArray, folder: Path) -> Path:
    """A list of ids, line by index; named by its content, so that what is queued keeps the list it was given."""
    lines = [array.tasks.get(index, "") for index in range(max(array.tasks) + 1)]
    text = "".join(f"{line}\n" for line in lines)
    return _save(folder / f"{hashlib.sha256(text.encode()).hexdigest()[:16]}.txt", text)


def _save(path: Path, text: str) -> Path:
    write_bytes(path, text.encode())
    return path


def _quoted(text: str | Path) -> str:
    return shlex.quote(str(text))
