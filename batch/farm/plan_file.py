# SPDX-License-Identifier: GPL-3.0-or-later
"""A plan as a file, for schedulers that start every task by itself (docs/file-formats.md)."""

from __future__ import annotations

import hashlib
import json
import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ...sim.atomic import write_bytes
from ...sim.errors import InputError
from ...sim.scene.json_fields import MAX_JSON_BYTES, parse, read_json
from .task import STAGES, Plan, Task

FORMAT = "physgen-plan/1"
MOST_TASKS = 50_000
MOST_ARGUMENTS = 20_000
MOST_SLOTS = 1000
NAME = re.compile(r"[\w .+@-]{1,200}")
"""One part of a task's id: it also names files."""


@dataclass(frozen=True, kw_only=True)
class _Slot:
    name: str
    count: int


@dataclass(frozen=True, kw_only=True)
class _Meaning:
    variant: str
    text: str


@dataclass(frozen=True, kw_only=True)
class _FileTask:
    """``Task`` as it is written: mappings are lists."""

    id: str
    stage: str
    argv: tuple[str, ...]
    needs: tuple[str, ...] = ()
    inputs: tuple[str, ...] = ()
    produces: tuple[str, ...] = ()
    slots: tuple[_Slot, ...] = ()
    farm_folder: str = ".farm"


@dataclass(frozen=True, kw_only=True)
class _FilePlan:
    name: str
    root: str
    version: str
    tasks: tuple[_FileTask, ...]
    out: str = "."
    meanings: tuple[_Meaning, ...] = ()


def save_plan(plan: Plan) -> Path:
    """Write ``plan`` below its root, beside its records, under a name that its content gives; the file.

    A plan that differs gets another file, so what a scheduler was told yesterday stays what it was. The root is written
    relative to the file: a machine that mounts the folder elsewhere reads the same plan. Raises InputError when it
    cannot be written, or when ``load_plan`` would refuse it.
    """
    folder = plan.root / (plan.tasks[0].farm_folder if plan.tasks else ".farm") / "plans"
    data = {"format": FORMAT, **_to_json(plan, os.path.relpath(plan.root, folder))}
    content = (json.dumps(data, indent=1, ensure_ascii=False) + "\n").encode()
    path = folder / f"{hashlib.sha256(content).hexdigest()[:16]}.json"
    if len(content) > MAX_JSON_BYTES:
        raise InputError(f"{plan.name}: {len(plan.tasks)} tasks are too many for one plan; split the job")
    _plan(data, path)
    if not path.is_file():
        write_bytes(path, content)
    return path


def load_plan(path: Path) -> Plan:
    """The plan at ``path``. Raises InputError, with field and value, for whatever is not as ``save_plan`` writes it.

    Files of a task never lead out of the root, and the root is one of the folders that the file lies in.
    """
    return _plan(read_json(path), path)


def task_of(plan: Plan, name: str) -> Task:
    """The task of ``plan`` with the id ``name``. Raises InputError when there is none."""
    found = next((task for task in plan.tasks if task.id == name), None)
    if found is None:
        raise InputError(f"{plan.name}: has no task {name!r}; it has {plan.tasks[0].id if plan.tasks else 'none'} …")
    return found


def _to_json(plan: Plan, root: str) -> dict[str, Any]:
    tasks = [
        {
            "id": task.id,
            "stage": task.stage,
            "argv": list(task.argv),
            "needs": list(task.needs),
            "inputs": list(task.inputs),
            "produces": list(task.produces),
            "slots": [{"name": name, "count": count} for name, count in sorted(task.slots.items())],
            "farm_folder": task.farm_folder,
        }
        for task in plan.tasks
    ]
    return {
        "name": plan.name,
        "root": Path(root).as_posix(),
        "version": plan.version,
        "out": plan.out,
        "meanings": [{"variant": key, "text": text} for key, text in plan.meanings.items()],
        "tasks": tasks,
    }


def _plan(data: Any, path: Path) -> Plan:
    if not isinstance(data, dict) or data.get("format") != FORMAT:
        raise InputError(f"{path}: not a plan of format {FORMAT!r}; write it out again with this version")
    file = parse(_FilePlan, {key: value for key, value in data.items() if key != "format"}, str(path))
    if len(file.tasks) > MOST_TASKS:
        raise InputError(f"{path}: has {len(file.tasks)} tasks, {MOST_TASKS} is the most; split the job")
    if not file.name.isprintable() or not 0 < len(file.name) <= 200:
        raise InputError(f"{path}.name: is {file.name[:60]!r}; expected 1 to 200 characters that can be shown")
    _check_inside(file.out, f"{path}.out")
    seen: set[str] = set()
    for index, task in enumerate(file.tasks):
        _check_task(task, seen, f"{path}.tasks[{index}]")
        seen.add(task.id)
    return Plan(
        name=file.name,
        root=_root(file.root, path),
        version=file.version,
        tasks=tuple(_task(task) for task in file.tasks),
        out=file.out,
        meanings={meaning.variant: meaning.text for meaning in file.meanings},
    )


def _task(task: _FileTask) -> Task:
    return Task(
        id=task.id,
        stage=task.stage,
        argv=task.argv,
        needs=task.needs,
        inputs=task.inputs,
        produces=task.produces,
        slots={slot.name: slot.count for slot in task.slots},
        farm_folder=task.farm_folder,
    )


def _root(text: str, path: Path) -> Path:
    """The folder ``text`` leads to from the file at ``path``: upwards only."""
    parts = text.split("/")
    if len(parts) > 32 or (set(parts) != {".."} and parts != ["."]):
        raise InputError(f"{path}.root: is {text[:60]!r}; expected '../..', as many as the file lies deep in the root")
    return Path(os.path.normpath(path.absolute().parent / text))


def _check_task(task: _FileTask, seen: set[str], where: str) -> None:
    if task.stage not in STAGES:
        raise InputError(f"{where}.stage: is {task.stage[:60]!r}; known are {', '.join(STAGES)}")
    for part in task.id.split("/"):
        _check_name(part, f"{where}.id")
    if task.id in seen:
        raise InputError(f"{where}.id: {task.id!r} is there twice; every task needs an id of its own")
    missing = [name for name in task.needs if name not in seen]
    if missing:
        raise InputError(f"{where}.needs: {missing[0][:60]!r} is no task before it; those that others need come first")
    if not task.argv or len(task.argv) > MOST_ARGUMENTS or any("\0" in word for word in task.argv):
        raise InputError(f"{where}.argv: expected 1 to {MOST_ARGUMENTS} arguments without zero bytes")
    for field in ("inputs", "produces"):
        for name in getattr(task, field):
            _check_inside(name, f"{where}.{field}")
    _check_inside(task.farm_folder, f"{where}.farm_folder")
    for slot in task.slots:
        _check_name(slot.name, f"{where}.slots")
        if not 0 < slot.count <= MOST_SLOTS:
            raise InputError(f"{where}.slots: {slot.name} is {slot.count}; expected 1 to {MOST_SLOTS}")


def _check_name(text: str, where: str) -> None:
    if not NAME.fullmatch(text) or text in (".", "..") or text != text.strip():
        raise InputError(f"{where}: {text[:60]!r} is no name; use letters, digits, blanks and . _ - + @")


def _check_inside(text: str, where: str) -> None:
    """A path relative to the root that stays in it, on every system."""
    parts = text.split("/")
    if not text or "\\" in text or ":" in parts[0] or "\0" in text or text.startswith("/") or ".." in parts:
        raise InputError(f"{where}: {text[:60]!r} leads out of the job's folder; name it relative to that, with /")
