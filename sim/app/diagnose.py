# SPDX-License-Identifier: MIT
"""Capture folder → diagnosis folder: report.json, where.npz, prediction.npz, report.html and its pictures."""

from __future__ import annotations

import shutil
from pathlib import Path

from ..atomic import replacing
from ..diagnose.capture import load_capture
from ..diagnose.conclude import DiagnoseOptions, diagnose
from ..diagnose.diagnosis import REPORT_FILE, Diagnosis, write_diagnosis
from ..diagnose.report import write_report
from ..errors import InputError
from ..events import IsCancelled, OnEvent, ignore, never


def diagnose_capture(
    root: Path,
    out: Path,
    options: DiagnoseOptions | None = None,
    on_event: OnEvent = ignore,
    cancelled: IsCancelled = never,
) -> Diagnosis:
    """Diagnose the capture folder ``root`` and write the folder ``out``, whole or not at all.

    An earlier diagnosis in ``out`` is replaced. Raises what ``load_capture`` and ``diagnose`` raise, and InputError
    when ``out`` holds something else.
    """
    if out.exists() and not (out / REPORT_FILE).is_file() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"{out}: is there and holds no diagnosis; choose another folder")
    if out.resolve() == root.resolve():
        raise InputError(f"{out}: is the capture itself; choose another folder")
    capture = load_capture(root)
    for warning in capture.warnings:
        on_event({"event": "notice", "stage": "diagnose", "message": warning})
    diagnosis = diagnose(capture, options, on_event, cancelled)
    with replacing(out) as partial:
        partial.mkdir()
        write_diagnosis(diagnosis, partial)
        write_report(diagnosis, capture, partial)
        if out.is_dir():
            shutil.rmtree(out)
    return diagnosis
