# SPDX-License-Identifier: MIT
"""Capture folder → diagnosis folder: report.json, where.npz, prediction.npz, report.html and its pictures."""

from __future__ import annotations

from pathlib import Path

from ..atomic import replacing_tree
from ..diagnose import run_diagnosis
from ..diagnose.capture import Capture
from ..diagnose.diagnosis import REPORT_FILE, Diagnosis, write_diagnosis
from ..diagnose.report import write_report
from ..diagnose.run_diagnosis import DiagnoseOptions
from ..errors import InputError
from ..events import IsCancelled, OnEvent, ignore, never
from ..folder_lock import lock_beside


def diagnose(
    capture: Capture,
    *,
    out: str | Path,
    options: DiagnoseOptions | None = None,
    on_event: OnEvent = ignore,
    cancelled: IsCancelled = never,
) -> Diagnosis:
    """Return which unmodelled effect explains ``capture``, and write the diagnosis folder ``out``, whole or not at all.

    ``out`` holds report.json, report.html with its pictures, where.npz and prediction.npz (docs/diagnosis.md); an
    earlier diagnosis there is replaced.

    >>> import physgen
    >>> capture = physgen.load_capture("capture")  # doctest: +SKIP
    >>> physgen.diagnose(capture, out="diagnosis").verdict.effect  # doctest: +SKIP
    'air_drag'

    Raises InputError when ``out`` holds something else, and what ``sim.diagnose.run_diagnosis.diagnose`` raises.
    """
    out = Path(out)
    if out.exists() and not (out / REPORT_FILE).is_file() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"{out}: is there and holds no diagnosis; choose another folder")
    if capture.root is not None and out.resolve() == capture.root.resolve():
        raise InputError(f"{out}: is the capture itself; choose another folder")
    for warning in capture.warnings:
        on_event({"event": "notice", "stage": "diagnose", "message": warning})
    # From the start: two at once would each take minutes, and one be lost.
    with lock_beside(out):
        diagnosis = run_diagnosis.diagnose(capture, options, on_event, cancelled)
        try:
            with replacing_tree(out) as partial:
                write_diagnosis(diagnosis, partial)
                write_report(diagnosis, capture, partial)
        except OSError as error:
            raise InputError(
                f"{out}: cannot be written ({error.strerror or error}); free space or choose another folder"
            ) from error
    return diagnosis
