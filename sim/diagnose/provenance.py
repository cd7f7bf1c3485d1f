# SPDX-License-Identifier: MIT
"""Provenance of a diagnosis: name and content hash of the capture, command and version, without paths or times."""

from __future__ import annotations

import hashlib
import json
import shlex
from dataclasses import dataclass

import numpy as np

from ..validation import to_json
from ..version import VERSION
from .capture import Capture


@dataclass(frozen=True, kw_only=True)
class Provenance:
    """capture: name of its folder, or "". content_sha256: of all that was measured and assumed. command: that repeats
    it. version: of this program."""

    capture: str
    content_sha256: str
    command: str
    version: str = VERSION


def provenance(capture: Capture, arguments: tuple[str, ...]) -> Provenance:
    """Return where a diagnosis of ``capture`` with these ``arguments`` of the command line comes from."""
    name = capture.root.resolve().name if capture.root is not None else ""
    words = ["physgen", "diagnose", name or "CAPTURE", "--out", "DIR", *arguments]
    return Provenance(capture=name, content_sha256=content_hash(capture), command=shlex.join(words))


def content_hash(capture: Capture) -> str:
    """Return the SHA-256, in hexadecimal, of everything in ``capture`` that a diagnosis reads.

    It is of values, not of files: neither compression nor the folder's name changes it.
    """
    digest = hashlib.sha256()
    assumed = {
        "gravity": capture.gravity,
        "ground": to_json(capture.ground),
        "objects": [to_json(item.belief) for item in capture.objects],
        "noise_sigma": capture.noise_sigma,
        "camera": None if capture.camera is None else to_json(capture.camera),
        "trials": [[t.name, t.role, "points" if t.points is not None else "pixels"] for t in capture.trials],
    }
    digest.update(json.dumps(assumed, sort_keys=True).encode())
    arrays = [a for item in capture.objects for a in (item.vertices, item.faces)]
    for trial in capture.trials:
        arrays += [trial.times, trial.observed, trial.object_index, trial.rest_points]
        arrays += [] if trial.predict_times is None else [trial.predict_times]
    for array in arrays:
        values = np.ascontiguousarray(array, dtype="<f8") + 0.0
        # One bit pattern for everything that is not seen.
        values = np.where(np.isnan(values), np.nan, values)
        digest.update(repr(values.shape).encode())
        digest.update(values.tobytes())
    return digest.hexdigest()
