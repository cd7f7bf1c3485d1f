# SPDX-License-Identifier: MIT
"""Capture folders (``physgen-capture/1``), read and written; docs/file-formats.md describes them for other programs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..atomic import replacing, write_json
from ..errors import InputError
from ..folder_lock import lock_beside
from ..npz import read_npz
from ..scene.folder import inside
from ..scene.meshes import read_mesh
from ..validation import parse, read_json, to_json
from .capture import Array, Camera, Capture, CaptureObject, Ground, ObjectBelief, Trial, Vector
from .capture_checks import check_capture

FORMAT = "physgen-capture/1"
CAPTURE_FILE = "capture.json"
ROLES = ("fit", "predict")

MAX_TRIAL_BYTES = 512 * 2**20
"""Total size of a trial's arrays, as 64-bit floats; larger files are rejected before reading."""
MAX_CAPTURE_BYTES = 4 * MAX_TRIAL_BYTES
"""The same of all trials, and of all mesh files: one file may be named many times, and unpacks to a thousand times its
own size."""
MOST_OBJECTS, MOST_TRIALS = 1000, 10_000


@dataclass(frozen=True, kw_only=True)
class _TrialEntry:
    name: str
    file: str
    role: str


@dataclass(frozen=True, kw_only=True)
class _CaptureFile:
    format: str
    gravity: Vector
    ground: Ground
    objects: tuple[ObjectBelief, ...]
    noise_sigma: float
    trials: tuple[_TrialEntry, ...]
    camera: Camera | None = None


def load_capture(root: str | Path) -> Capture:
    """Read and check the capture folder ``root``.

    >>> import physgen
    >>> physgen.load_capture("capture").warnings  # doctest: +SKIP
    ()

    Raises InputError, with file, field, value and remedy, for anything malformed. Lesser problems are in ``warnings``.
    """
    root = Path(root)
    path = root / CAPTURE_FILE
    data = read_json(path, folder=root)
    if not isinstance(data, dict) or data.get("format") != FORMAT:
        found = data.get("format") if isinstance(data, dict) else None
        raise InputError(f"{path}: format is {found!r}: this program reads {FORMAT!r}")
    file = parse(_CaptureFile, data, str(path))
    if not 0 < len(file.objects) <= MOST_OBJECTS or not 0 < len(file.trials) <= MOST_TRIALS:
        raise InputError(
            f"{path}: has {len(file.objects)} objects and {len(file.trials)} trials: needs at least one object and one "
            f"trial, at most {MOST_OBJECTS} and {MOST_TRIALS}"
        )
    if not file.noise_sigma > 0:
        raise InputError(f"{path}: noise_sigma is {file.noise_sigma!r}: give the standard deviation of a coordinate")
    _refuse_twins(path, "objects", [o.name for o in file.objects])
    _refuse_twins(path, "trials", [t.name for t in file.trials])
    objects = []
    left = MAX_CAPTURE_BYTES
    for belief in file.objects:
        mesh_file = inside(root, belief.mesh)
        left -= mesh_file.stat().st_size if mesh_file.is_file() else 0
        _require_room(left, path, "meshes")
        mesh = read_mesh(mesh_file, textures=False)
        objects.append(
            CaptureObject(
                belief=belief,
                vertices=np.asarray(mesh.vertices, dtype=np.float64),
                faces=np.asarray(mesh.faces, dtype=np.int64),
            )
        )
    trials, left = [], MAX_CAPTURE_BYTES
    for entry in file.trials:
        trials.append(_load_trial(root, entry, len(objects)))
        left -= sum(array.nbytes for array in _trial_arrays(trials[-1]).values())
        _require_room(left, path, "trials")
    if file.camera is None and any(t.pixels is not None for t in trials):
        raise InputError(f"{path}: camera is missing, and there are trials of pixels: give the camera")
    if len({t.pixels is None for t in trials}) > 1:
        raise InputError(f"{path}: some trials have points and others pixels: make two captures of them")
    if not any(t.role == "fit" for t in trials):
        raise InputError(f"{path}: no trial has the role 'fit': there is nothing to fit to")
    capture = Capture(
        gravity=file.gravity,
        ground=file.ground,
        objects=tuple(objects),
        noise_sigma=file.noise_sigma,
        camera=file.camera,
        trials=tuple(trials),
        root=root,
    )
    return check_capture(capture)


def save_capture(capture: Capture, root: Path) -> None:
    """Write ``capture`` to the new folder ``root``, atomically. Raises InputError when it exists or is in use."""
    import trimesh

    with lock_beside(root), replacing(root) as partial:
        if root.exists():
            raise InputError(f"{root}: already exists; choose another folder")
        partial.mkdir(parents=True)
        entries = []
        for item in capture.objects:
            target = inside(partial, item.belief.mesh)
            target.parent.mkdir(parents=True, exist_ok=True)
            trimesh.Trimesh(item.vertices, item.faces, process=False).export(target)
        for trial in capture.trials:
            name = f"{trial.name}.npz"
            np.savez(inside(partial, name), **_trial_arrays(trial))  # type: ignore[arg-type]
            entries.append(_TrialEntry(name=trial.name, file=name, role=trial.role))
        file = _CaptureFile(
            format=FORMAT,
            gravity=capture.gravity,
            ground=capture.ground,
            objects=tuple(item.belief for item in capture.objects),
            noise_sigma=capture.noise_sigma,
            trials=tuple(entries),
            camera=capture.camera,
        )
        data = to_json(file)
        if capture.camera is None:
            del data["camera"]
        write_json(partial / CAPTURE_FILE, data)


def _trial_arrays(trial: Trial) -> dict[str, NDArray[Any]]:
    arrays: dict[str, NDArray[Any]] = {
        "times": trial.times,
        ("points" if trial.points is not None else "pixels"): trial.observed,
        "object_index": trial.object_index,
        "rest_points": trial.rest_points,
    }
    if trial.predict_times is not None:
        arrays["predict_times"] = trial.predict_times
    return arrays


def _refuse_twins(path: Path, what: str, names: list[str]) -> None:
    seen: set[str] = set()
    for name in names:
        if name in seen:
            raise InputError(f"{path}: {what}: two are called {name!r}: give each its own name")
        seen.add(name)


def _require_room(left: int, path: Path, what: str) -> None:
    if left < 0:
        raise InputError(f"{path}: its {what} take more than {MAX_CAPTURE_BYTES >> 20} MiB; make several captures")


def _load_trial(root: Path, entry: _TrialEntry, objects: int) -> Trial:
    path = inside(root, entry.file)
    where = f"{path} (trial {entry.name!r})"
    if entry.role not in ROLES:
        raise InputError(f"{where}: role is {entry.role!r}: give {' or '.join(ROLES)}")
    arrays = read_arrays(path)
    if 8 * sum(array.size for array in arrays.values()) > MAX_TRIAL_BYTES:
        raise InputError(f"{where}: has more numbers than fit in {MAX_TRIAL_BYTES >> 20} MiB; shorten the trial")
    times = _array(arrays, "times", (None,), where)
    frames = len(times)
    if frames < 3:
        raise InputError(f"{where}: has {frames} frames; a motion needs at least 3")
    if not np.isfinite(times).all() or not (np.diff(times) > 0).all():
        bad = int(np.flatnonzero(~(np.diff(times) > 0))[0]) + 1 if np.isfinite(times).all() else 0
        raise InputError(f"{where}: times[{bad}] is {float(times[bad])!r}: give finite seconds in rising order")
    if ("points" in arrays) == ("pixels" in arrays):
        raise InputError(f"{where}: give either points or pixels")
    kind, size = ("points", 3) if "points" in arrays else ("pixels", 2)
    observed = _array(arrays, kind, (frames, None, size), where)
    count = observed.shape[1]
    if count == 0:
        raise InputError(f"{where}: {kind} has no points: track at least one")
    if np.isinf(observed).any():
        raise InputError(f"{where}: {kind} has infinite numbers: write NaN where a point was not seen")
    # A point with a missing coordinate counts as not seen.
    observed = np.where(np.isfinite(observed).all(axis=2, keepdims=True), observed, np.nan)
    if not np.isfinite(observed).any():
        raise InputError(f"{where}: no point was seen in any frame; leave this trial out")
    index = _array(arrays, "object_index", (count,), where)
    if (index != np.round(index)).any() or index.min() < 0 or index.max() >= objects:
        raise InputError(f"{where}: object_index goes from {index.min():g} to {index.max():g}: give 0 to {objects - 1}")
    rest = _array(arrays, "rest_points", (count, 3), where)
    if not np.isfinite(rest).all():
        raise InputError(f"{where}: rest_points are not finite: every point needs its place on the mesh")
    wanted = None
    if entry.role == "predict":
        wanted = _array(arrays, "predict_times", (None,), where)
        if not np.isfinite(wanted).all() or not (np.diff(wanted) > 0).all() or (len(wanted) and wanted[0] <= times[-1]):
            raise InputError(f"{where}: predict_times: give rising seconds after the last frame, {times[-1]:g} s")
    return Trial(
        name=entry.name,
        role=entry.role,
        times=times,
        points=observed if kind == "points" else None,
        pixels=observed if kind == "pixels" else None,
        object_index=index.astype(np.int64),
        rest_points=rest,
        predict_times=wanted,
    )


def read_arrays(path: Path) -> Mapping[str, NDArray[Any]]:
    """Return all arrays of the ``.npz`` at ``path``; never unpickles.

    Raises InputError when it is missing, too large once unpacked, or not an archive of plain arrays.
    """
    return read_npz(path, MAX_TRIAL_BYTES, own=True, remedy="shorten the trial")


def _array(arrays: Mapping[str, NDArray[Any]], name: str, shape: tuple[int | None, ...], where: str) -> Array:
    if name not in arrays:
        raise InputError(f"{where}: {name} is missing")
    value = arrays[name]
    if value.dtype.kind not in "fiub":
        raise InputError(f"{where}: {name} holds {value.dtype}, not numbers")
    if value.ndim != len(shape) or any(n is not None and n != m for n, m in zip(shape, value.shape, strict=True)):
        wanted = "(" + ", ".join("any" if n is None else str(n) for n in shape) + ")"
        raise InputError(f"{where}: {name} has shape {value.shape}: expected {wanted}")
    return np.asarray(value, dtype=np.float64)
