# SPDX-License-Identifier: GPL-3.0-or-later
"""The program's turn: it gets a folder with a photo and a request, and nothing else. Runs as a process of its own.

    python -m physgen.benchmarks.reconstruct_pictures.attempt FOLDER

FOLDER holds ``photo.jpg`` and ``request.json``: {"objects": [{"name", "box", "size_m" | null}, …]}. It gets
``scene/`` and ``result.json``: {"error" | null, "cpu_s", "stages": {step: CPU seconds}, "notices": […]}.
"""

from __future__ import annotations

import json
import sys
import time
import traceback
from pathlib import Path

from physgen.sim.app.reconstruct import reconstruct
from physgen.sim.errors import PhysGenError
from physgen.sim.events import Event
from physgen.sim.reconstruct import ObjectRequest, ReconstructOptions

PHOTO, REQUEST, SCENE, ANSWER = "photo.jpg", "request.json", "scene", "result.json"


def attempt(folder: Path) -> dict[str, object]:
    """Reconstruct what lies in ``folder``; what to write into ``result.json``."""
    wanted = [
        ObjectRequest(name=item["name"], box=tuple(item["box"]), size_m=item["size_m"])
        for item in json.loads((folder / REQUEST).read_text())["objects"]
    ]
    marks: list[tuple[str, float]] = []
    notices: list[str] = []

    def on_event(event: Event) -> None:
        if event["event"] == "progress":
            marks.append((str(event.get("step", event.get("message", ""))).split(" ")[0], time.process_time()))
        elif event["event"] == "notice":
            notices.append(str(event["message"]))

    error = None
    began = time.process_time()
    try:
        reconstruct(folder / PHOTO, wanted, out=folder / SCENE, options=ReconstructOptions(), on_event=on_event)
    except PhysGenError as problem:
        error = str(problem)
    except Exception:  # A bug in what is judged must not end the judging; it is shown and counts as a failure.
        error = traceback.format_exc()
    ended = time.process_time()
    stages: dict[str, float] = {}
    for (step, start), (_, stop) in zip(marks, [*marks[1:], ("", ended)], strict=True):
        stages[step] = round(stages.get(step, 0.0) + stop - start, 3)
    return {"error": error, "cpu_s": round(ended - began, 2), "stages": stages, "notices": notices}


if __name__ == "__main__":
    FOLDER = Path(sys.argv[1])
    (FOLDER / ANSWER).write_text(json.dumps(attempt(FOLDER)))
