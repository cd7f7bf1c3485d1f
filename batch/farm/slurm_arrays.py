# SPDX-License-Identifier: GPL-3.0-or-later
"""Tasks of a plan as SLURM's job arrays, and what each array waits for."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field

from .task import Task

MOST_IN_ARRAY = 1000
"""SLURM's MaxArraySize is 1001 where nobody has changed it."""

_Slots = tuple[tuple[str, int], ...]


@dataclass(kw_only=True)
class TaskArray:
    """Tasks of one stage that take the same slots and wait for the same, or each for its counterpart.

    number: position among all arrays; it waits for arrays of lower numbers only.
    tasks: id by index in the array.
    counterpart: number of the array whose task of the same index each one waits for; None where all wait for ``needs``.
    needs: ids that all of them wait for.
    """

    number: int
    stage: str
    slots: _Slots
    counterpart: int | None
    needs: tuple[str, ...]
    tasks: dict[int, str] = field(default_factory=dict)


def task_arrays(tasks: Sequence[Task]) -> list[TaskArray]:
    """The arrays of ``tasks``, those that others wait for first.

    One failed task holds back what needs it and nothing else: chunks of one bake wait for that bake, not for all bakes.
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
    """What ``array`` waits for as sbatch's ``--dependency`` says it, or "". ``${job[N]}`` is the job of array N."""
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


def indices(array: TaskArray) -> str:
    """The indices of ``array`` as sbatch's ``--array`` says them: ``0-3,7``."""
    runs: list[list[int]] = []
    for index in sorted(array.tasks):
        if runs and runs[-1][1] == index - 1:
            runs[-1][1] = index
        else:
            runs.append([index, index])
    return ",".join(f"{first}-{last}" if last > first else str(first) for first, last in runs)


def _slots(task: Task) -> _Slots:
    return tuple(sorted(task.slots.items()))
