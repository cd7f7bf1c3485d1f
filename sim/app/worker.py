# SPDX-License-Identifier: MIT
"""The simulation's own process: ``python -m physgen.sim.app.worker JOB.json``.

The job file is ``{"format": "physgen-job/1", "use_case": "bake", "scene": …, "out": …, "options": {…}}``. Events
go to standard output as JSON lines; SIGTERM, or the parent's death, cancels.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TextIO

from ..errors import InputError, PhysGenError
from ..events import Event
from ..scene.json_fields import parse, read_json, to_json
from .bake import BakeOptions, bake

JOB_FORMAT = "physgen-job/1"
MODULE = __name__ if __name__ != "__main__" else f"{__package__}.worker"


@dataclass(frozen=True, kw_only=True)
class BakeJob:
    """One bake. scene, out: absolute folders."""

    scene: str
    out: str
    options: BakeOptions = field(default_factory=BakeOptions)


def job_to_json(job: BakeJob) -> dict[str, Any]:
    """The content of a job file."""
    return {"format": JOB_FORMAT, "use_case": "bake", **to_json(job)}


def run_job(path: Path, emit: Any, cancelled: Any) -> Event:
    """Carry out the job file at ``path``; the event to end with."""
    data = read_json(path)
    if not isinstance(data, dict) or data.pop("format", None) != JOB_FORMAT:
        raise InputError(f"{path}: not a job of format {JOB_FORMAT!r}")
    use_case = data.pop("use_case", None)
    if use_case != "bake":
        raise InputError(f"{path}: use_case is {use_case!r}: this version knows 'bake'")
    job = parse(BakeJob, data, str(path))
    manifest = bake(Path(job.scene), Path(job.out), job.options, emit, cancelled)
    return {"event": "done", "stage": "bake", "out": job.out, "frames": manifest.frames_done}


def main(arguments: list[str]) -> int:
    """Entry of the process; the exit code of docs/cli.md."""
    stop = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT, getattr(signal, "SIGBREAK", signal.SIGTERM)):
        signal.signal(number, lambda *_: stop.set())
    # Libraries print to standard output; events get a descriptor of their own.
    events: TextIO = os.fdopen(os.dup(1), "w", encoding="utf-8", buffering=1)
    os.dup2(2, 1)
    parent = os.getppid()

    def emit(event: Event) -> None:
        events.write(json.dumps(event, ensure_ascii=False) + "\n")

    def cancelled() -> bool:
        return stop.is_set() or os.getppid() != parent

    try:
        if len(arguments) != 1:
            raise InputError(f"worker: expected one job file, found {len(arguments)} arguments")
        emit(run_job(Path(arguments[0]), emit, cancelled))
    except PhysGenError as error:
        emit({"event": "error", "kind": type(error).__name__, "message": str(error)})
        return error.exit_code
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
