# SPDX-License-Identifier: GPL-3.0-or-later
"""``--export slurm``: a plan as scripts for SLURM, job arrays that depend on each other (docs/farm.md)."""

from __future__ import annotations

import hashlib
import shlex
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from ...sim.atomic import write_bytes
from ...sim.errors import InputError
from .planning.plan import STAGES, Plan, Task, save_plan
from .runners import ClusterOptions, FarmOptions

MOST_IN_ARRAY = 1000
"""SLURM's default MaxArraySize is 1001."""

_Slots = tuple[tuple[str, int], ...]


@dataclass(kw_only=True)
class TaskArray:
    """Tasks of one stage with the same slots and the same dependencies, or each depending on its counterpart.

    number: position among all arrays; it depends on lower numbers only.
    tasks: id by index in the array.
    counterpart: number of the array whose task of the same index each one depends on; None: all depend on ``needs``.
    needs: ids that all of them depend on.
    """

    number: int
    stage: str
    slots: _Slots
    counterpart: int | None
    needs: tuple[str, ...]
    tasks: dict[int, str] = field(default_factory=dict)


def task_arrays(tasks: Sequence[Task]) -> list[TaskArray]:
    """Return the arrays of ``tasks``, dependencies first.

    A failed task stops only its dependants: chunks of one bake depend on that bake, not on all bakes.
    """
    followers = Counter((need, task.stage, _slots(task)) for task in tasks for need in task.needs)
    arrays: list[TaskArray] = []
    place: dict[str, tuple[int, int]] = {}
    open_arrays: dict[tuple[object, ...], TaskArray] = {}
    for task in tasks:
        slots = _slots(task)
        counterpart: int | None = None
        if len(task.needs) == 1 and followers[task.needs[0], task.stage, slots] == 1:
            counterpart, index = place[task.needs[0]]
            key: tuple[object, ...] = (task.stage, slots, counterpart)
        else:
            key = (task.stage, slots, frozenset(task.needs))
        array = open_arrays.get(key)
        if array is None or (counterpart is None and len(array.tasks) == MOST_IN_ARRAY):
            array = TaskArray(
                number=len(arrays),
                stage=task.stage,
                slots=slots,
                counterpart=counterpart,
                needs=() if counterpart is not None else task.needs,
            )
            arrays.append(array)
            open_arrays[key] = array
        if counterpart is None:
            index = len(array.tasks)
        array.tasks[index] = task.id
        place[task.id] = (array.number, index)
    return arrays


def dependency(array: TaskArray, arrays: Sequence[TaskArray]) -> str:
    """Return the dependencies of ``array`` for sbatch's ``--dependency``, or "". ``${job[N]}`` is array N's job."""
    if array.counterpart is not None:
        return f"aftercorr:${{job[{array.counterpart}]}}"
    wanted: dict[int, list[int]] = {}
    place = {name: (other.number, index) for other in arrays for index, name in other.tasks.items()}
    for need in array.needs:
        number, index = place[need]
        wanted.setdefault(number, []).append(index)
    words: list[str] = []
    for number, indices in wanted.items():
        if len(indices) == len(arrays[number].tasks):
            words.append(f"${{job[{number}]}}")
        else:
            words += [f"${{job[{number}]}}_{index}" for index in indices]
    return "afterok:" + ":".join(words) if words else ""


def array_indices(array: TaskArray) -> str:
    """Return the indices of ``array`` for sbatch's ``--array``: ``0-3,7``."""
    runs: list[list[int]] = []
    for index in sorted(array.tasks):
        if runs and runs[-1][1] == index - 1:
            runs[-1][1] = index
        else:
            runs.append([index, index])
    return ",".join(f"{first}-{last}" if last > first else str(first) for first, last in runs)


def _slots(task: Task) -> _Slots:
    return tuple(sorted(task.slots.items()))


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


def export_slurm(plan: Plan, options: FarmOptions) -> list[Path]:
    """Write ``plan`` into the folder ``options.out``: a submit script, and one script per stage; return the files.

    The plan file and the arrays' task lists are written below the plan's root, which the nodes share. Raises InputError
    when something cannot be written.
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
            f"--array={array_indices(array)}",
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
    command = shlex.join([cluster.python, "-P", "-m", "physgen.batch.farm.run_task", str(plan_file)])
    return _STAGE.format(directives="\n".join(sbatch_directives(cluster)), command=command, retries=options.retries)


def sbatch_directives(cluster: ClusterOptions) -> list[str]:
    """Return the ``#SBATCH`` lines for ``cluster``."""
    wanted = {
        "--cpus-per-task": str(cluster.cores),
        "--partition": cluster.queue,
        "--account": cluster.account,
        "--time": cluster.walltime,
        "--mem": cluster.memory,
    }
    # After a node failure the task is requeued, and its log appended to.
    fixed = ["--ntasks=1", "--requeue", "--open-mode=append"]
    return [f"#SBATCH {text}" for text in [*fixed, *(f"{k}={v}" for k, v in wanted.items() if v), *cluster.sbatch]]


def _save_list(array: TaskArray, folder: Path) -> Path:
    """Write a list of ids, line by index; named by its content hash, so that queued jobs keep their list."""
    lines = [array.tasks.get(index, "") for index in range(max(array.tasks) + 1)]
    text = "".join(f"{line}\n" for line in lines)
    return _save(folder / f"{hashlib.sha256(text.encode()).hexdigest()[:16]}.txt", text)


def _save(path: Path, text: str) -> Path:
    write_bytes(path, text.encode())
    return path


def _quoted(text: str | Path) -> str:
    return shlex.quote(str(text))
