# SPDX-License-Identifier: MIT
"""C3D files and ROS 2 bags (``.mcap``, ``.db3``, or a bag's folder) → takes, through ezc3d and rosbags.

Both libraries run in a process of their own, under bounds (``recording_worker.py``); here files are looked at before,
and what came back after. ``pip install 'physgen[recordings]'`` brings them.
"""

from __future__ import annotations

import dataclasses
import importlib.util
import math
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ..errors import InputError
from ..files import open_file
from ..npz import read_npz
from ..processes import note_child
from ..validation import read_json
from .recording_worker import BYTES_A_SECOND, SPARE_S
from .recordings import RecordedTable

Array = NDArray[np.float64]

MAX_BYTES = {".c3d": 2**30, ".mcap": 2**35, ".db3": 2**35}
"""Largest file of each ending; bags hold pictures too, which are skipped."""
LIBRARY = {".c3d": "ezc3d", ".mcap": "rosbags", ".db3": "rosbags"}
PATIENCE = 20.0
"""Time to wait for a reader over the CPU time that it may take: others may keep the processor busy."""
MAX_FILES = 256
"""Of the folder of a bag."""
_HEADS = {".c3d": (1, b"\x50"), ".mcap": (0, b"\x89MCAP0\r\n"), ".db3": (0, b"SQLite format 3\0")}
_WORKER = Path(__file__).with_name("recording_worker.py")
CLOCKS = ("stamp", "log")
"""Times of a bag: of the messages' headers, or when the recorder received them."""


def is_recorded_file(path: Path) -> bool:
    """Return whether ``path`` has the ending of one of these, or is a folder."""
    return path.suffix.lower() in MAX_BYTES or path.suffix.lower() in (".zstd", ".bag") or path.is_dir()


def read_recorded_file(
    path: Path, columns: Mapping[str, str] | None = None, points: Sequence[str] = ()
) -> list[RecordedTable]:
    """Return the one take in ``path``. columns: ``{"time": "log"}`` takes the recorder's clock of a bag.

    points: labels of a C3D file, or names of what moves in a bag (child frame of a transform, else topic); empty: all
    points, or the only pose. Raises InputError for damaged files, missing libraries, several bodies.
    """
    if path.suffix.lower() == ".c3d":
        return [_c3d(path, points)]
    clock = dict(columns or {}).get("time", CLOCKS[0])
    if clock not in CLOCKS:
        raise InputError(f"{path}: time is {clock!r}: a bag has {' or '.join(CLOCKS)}")
    return [_bag(path, points, clock)]


def _run(path: Path, folder: Path | None = None) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """Return what the worker says of the file, and its arrays."""
    ending = path.suffix.lower()
    try:
        with open_file(path, MAX_BYTES[ending], what=f"{ending} file", folder=folder) as stream:
            size, head = os.fstat(stream.fileno()).st_size, stream.read(16)
    except FileNotFoundError:
        raise InputError(f"{path}: there is no such file; check its name") from None
    at, magic = _HEADS[ending]
    if head[at : at + len(magic)] != magic:
        raise InputError(f"{path}: is no {ending} file; record or export it again")
    if importlib.util.find_spec(LIBRARY[ending]) is None:
        raise InputError(f"{path}: {ending} needs {LIBRARY[ending]}: pip install 'physgen[recordings]'")
    limit = SPARE_S[ending] + size / BYTES_A_SECOND
    with tempfile.TemporaryDirectory(prefix="physgen-recording-") as place:
        # A name of our own: SQLite would read what follows a question mark as options.
        link = Path(place, f"recording{ending}")
        try:
            link.symlink_to(path.resolve())
        except OSError:
            shutil.copyfile(path, link)
        command = [sys.executable, "-I", str(_WORKER), str(link), place, *(p for p in sys.path if p)]
        environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
        process = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=environment,
            start_new_session=os.name != "nt",
        )  # fmt: skip
        note_child(process)
        try:
            # The worker's own bound is on what it computes.
            code = process.wait(timeout=PATIENCE * limit)
        except subprocess.TimeoutExpired:
            raise InputError(f"{path}: not read within {PATIENCE * limit:.0f} s; record less of it") from None
        finally:
            process.kill()
            process.wait()
        found = Path(place, "found.json")
        if code != 0 or not found.is_file():
            raise InputError(f"{path}: is damaged: its reader ended with {code}; record or export it again")
        said = read_json(found, folder=Path(place))
        if "error" in said:
            raise InputError(f"{path}: not readable ({said['error']}); record or export it again")
        return said, read_npz(Path(place, "arrays.npz"), 2**30, remedy="cut it")


def _c3d(path: Path, wanted: Sequence[str]) -> RecordedTable:
    """Return the markers; occluded ones are NaN."""
    said, arrays = _run(path)
    points, labels, rate = arrays["points"], [str(label).strip() for label in said["labels"]], float(said["rate"])
    if len(points) < 3 or not labels:
        raise InputError(f"{path}: {len(points)} frames of {len(labels)} points; a motion needs 3 frames of 1 point")
    notes = []
    # A subject's name before each label says nothing where there is one subject.
    subjects = {label.partition(":")[0] for label in labels if ":" in label}
    if len(subjects) == 1:
        labels = [label.partition(":")[2] or label for label in labels]
    if wanted:
        missing = [name for name in wanted if name not in labels]
        if missing:
            raise InputError(f"{path}: there is no point {missing[0]!r}; there are {_listed(labels)}")
        keep = [labels.index(name) for name in wanted]
    else:
        # Programs call points without a name *1, *2 … or U1; points that are never seen are slots of a template.
        seen = np.isfinite(points).all(axis=2).any(axis=0)
        keep = [i for i, name in enumerate(labels) if seen[i] and not name.startswith("*")]
        if len(keep) < len(labels):
            notes.append(
                f"left out, unnamed or never seen: {_listed([n for i, n in enumerate(labels) if i not in keep])}"
            )
    if not keep:
        raise InputError(f"{path}: no named point is ever seen; label the points, or name them with points")
    labels = [labels[i] for i in keep]
    if twice := [name for name in labels if labels.count(name) > 1]:
        raise InputError(f"{path}: two points are called {twice[0]!r}; rename one")
    points = points[:, keep]
    hidden = int((~np.isfinite(points).all(axis=2)).sum())
    if hidden:
        notes.append(f"{hidden} of {points.shape[0] * points.shape[1]} points are occluded")
    unit = {"meters": "m", "metres": "m", "millimeters": "mm", "centimeters": "cm"}.get(said["unit"], said["unit"])
    if said["residual"] > 0:
        notes.append(f"residuals of the points: {float(said['residual']):.3g} {unit or 'units'} in the median")
    good = math.isfinite(rate) and rate > 0
    return RecordedTable(
        name=_name(path),
        times=np.arange(len(points)) / rate if good else None,
        points=points,
        labels=tuple(labels),
        time_unit="s" if good else "",
        length_unit=unit,
        up={"+y": "y", "-y": "-y", "-z": "-z"}.get(said["up"], ""),
        notes=tuple(notes),
    )


@dataclasses.dataclass(kw_only=True)
class _Source:
    """The moving frames of a bag. seen: rows (stamp ns, log ns) int64 and poses (7)."""

    name: str
    topic: str
    kind: str
    frame: str
    times: NDArray[np.int64]
    poses: Array

    @property
    def turns(self) -> bool:
        """Whether it has orientations: not all the same, which is how programs leave them out."""
        q = self.poses[:, 3:]
        return bool(
            np.isfinite(q).all()
            and (np.abs(np.linalg.norm(q, axis=1) - 1) < 0.05).all()
            and np.ptp(q, axis=0).max() > 1e-9
        )

    def text(self) -> str:
        """Say it in a message."""
        return f"{self.name} ({self.kind.rpartition('/')[2]}, {len(self.times)} in {self.frame or 'no frame'})"


def _bag_files(path: Path) -> list[Path]:
    if path.suffix.lower() == ".bag":
        raise InputError(f"{path}: is a bag of ROS 1: convert it with rosbags-convert")
    if path.suffix.lower() == ".zstd":
        raise InputError(f"{path}: is packed as a whole: unpack it with zstd -d")
    if not path.is_dir():
        return [path]
    files = sorted((p for p in path.iterdir() if p.suffix.lower() in (".mcap", ".db3")), key=_order)
    if not files:
        packed = any(p.suffix == ".zstd" for p in path.iterdir())
        raise InputError(
            f"{path}: its files are packed: unpack them with zstd -d" if packed else
            f"{path}: a folder without .mcap or .db3 is no bag of ROS 2"
        )  # fmt: skip
    if len(files) > MAX_FILES:
        raise InputError(f"{path}: has {len(files)} files, more than the {MAX_FILES} of a bag")
    return files


def _order(path: Path) -> list[tuple[int, str]]:
    """Sort bag_10 behind bag_9."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d{1,15})", path.name)]


def _sources(path: Path) -> dict[tuple[str, str], _Source]:
    """Return what moves in the bag by (name, topic)."""
    found: dict[tuple[str, str], _Source] = {}
    others: set[str] = set()
    for file in _bag_files(path):
        said, arrays = _run(file, path if path.is_dir() else None)
        others |= set(said["others"])
        times = np.stack([arrays["stamp"], arrays["log"]], axis=1)
        for index, entry in enumerate(said["sources"]):
            mine = arrays["source"] == index
            new = _Source(
                name=entry["name"] or entry["topic"], topic=entry["topic"], kind=entry["type"], frame=entry["frame"],
                times=times[mine], poses=arrays["pose"][mine],
            )  # fmt: skip
            old = found.get((new.name, new.topic))
            if old is not None:
                if old.frame != new.frame:
                    raise InputError(f"{path}: {new.name} is given in {old.frame!r} and in {new.frame!r}: record one")
                new = dataclasses.replace(
                    new, times=np.concatenate([old.times, new.times]), poses=np.concatenate([old.poses, new.poses])
                )
            found[new.name, new.topic] = new
    if not found:
        other = f"; it has {_listed(sorted(others))}" if others else ""
        raise InputError(f"{path}: no poses, transforms or points in this bag{other}")
    return found


def _bag(path: Path, wanted: Sequence[str], clock: str) -> RecordedTable:
    """Return the pose of one body, or the points of several sources."""
    every = _sources(path)
    moving = [s for s in every.values() if not s.topic.endswith("tf_static")]
    chosen = [s for s in moving if s.name in wanted or s.topic in wanted] if wanted else moving
    if missing := [name for name in wanted if not any(name in (s.name, s.topic) for s in moving)]:
        raise InputError(f"{path}: nothing is called {missing[0]!r}; there is {_listed([s.text() for s in moving])}")
    arrays = {s.topic for s in chosen} if all(s.kind.endswith(("PoseArray", "PointStamped")) for s in chosen) else set()
    if len(chosen) != 1 and not arrays:
        raise InputError(
            f"{path}: one body moves per import; say which with points: {_listed([s.text() for s in chosen or moving])}"
        )
    if len({s.frame for s in chosen}) > 1:
        raise InputError(f"{path}: the points are in frames {_listed(sorted({s.frame for s in chosen}))}: record one")
    notes = [f"poses are in the frame {chosen[0].frame or '(unnamed)'}"]
    chosen = [_fixed(path, s, every, notes) for s in chosen]
    series = [_series(path, s, clock, notes) for s in chosen]
    stamps = np.unique(np.concatenate([times for times, _ in series]))
    if len(stamps) < 3:
        raise InputError(f"{path}: {chosen[0].name} has {len(stamps)} times; a motion needs at least 3")
    points = np.full((len(stamps), len(chosen), 3), np.nan)
    for k, (times, poses) in enumerate(series):
        points[np.searchsorted(stamps, times), k] = np.where(
            np.isfinite(poses[:, :3]).all(axis=1)[:, None], poses[:, :3], np.nan
        )
    turns = None
    if len(chosen) == 1 and chosen[0].turns:
        turns = Rotation.from_quat(series[0][1][:, 3:]).as_matrix()
    elif len(chosen) == 1 and np.isfinite(chosen[0].poses[:, 3:]).all():
        notes.append("its orientation never changes, so it is taken as not measured: a point")
    labels = tuple(s.name for s in chosen)
    return RecordedTable(
        name=_name(path),
        # Nanoseconds since 1970 are beyond float64: count from the first.
        times=(stamps - stamps[0]) * 1e-9,
        points=points,
        labels=("",) if turns is not None else labels,
        time_unit="s",
        turns=turns,
        notes=tuple(dict.fromkeys(notes)),
    )


def _series(path: Path, source: _Source, clock: str, notes: list[str]) -> tuple[NDArray[np.int64], Array]:
    """Return rising stamps (T,) in ns and poses (T, 7). Raises InputError for stamps that occur twice or fall."""
    stamps = source.times[:, CLOCKS.index(clock)]
    if clock == CLOCKS[0] and not stamps.any():
        stamps = source.times[:, 1]
        notes.append(f"{source.name} has no stamps: times are the recorder's")
    if clock == CLOCKS[0] and (stamps == 0).any():
        raise InputError(f"{path}: some messages of {source.name} have no stamp: take --column time=log")
    steps, held = np.diff(stamps), np.nan_to_num(source.poses)
    again = np.concatenate([[False], (steps == 0) & (held[1:] == held[:-1]).all(axis=1)])
    if again.any():
        notes.append(f"{source.name}: {int(again.sum())} messages that were sent twice are left out")
        stamps, poses = stamps[~again], source.poses[~again]
    else:
        poses = source.poses
    steps = np.diff(stamps)
    if (steps <= 0).any():
        row = int(np.argmax(steps <= 0)) + 1
        what = "occurs twice, with different poses" if steps[row - 1] == 0 else "is earlier than before"
        seconds = (int(stamps[row]) - int(stamps[0])) * 1e-9
        other = "" if clock == "log" else ", or take the recorder's clock with --column time=log"
        raise InputError(
            f"{path}: stamp of message {row + 1} of {source.name} ({seconds:.6f} s) {what}: cut the bag there{other}"
        )
    return stamps, poses


def _fixed(path: Path, source: _Source, every: Mapping[tuple[str, str], _Source], notes: list[str]) -> _Source:
    """Return the source in the outermost frame that holds its own by constant transforms.

    Raises InputError where a frame on the way moves: its poses would have to be interpolated.
    """
    parents = {s.name: s for s in every.values() if s.kind.endswith(("TFMessage", "TransformStamped"))}
    rest: set[str] = set()
    while source.frame in parents and source.frame not in rest:
        rest.add(source.frame)
        parent = parents[source.frame]
        if np.ptp(parent.poses, axis=0).max() > 1e-6 or not np.isfinite(parent.poses).all():
            raise InputError(
                f"{path}: {source.name} is given in {source.frame!r}, which itself moves in {parent.frame!r}: "
                "record it in a frame that stands still"
            )
        turn = Rotation.from_quat(_unit(path, parent.name, parent.poses[:1, 3:])[0])
        poses = source.poses.copy()
        poses[:, :3] = turn.apply(poses[:, :3]) + parent.poses[0, :3]
        if source.turns:
            poses[:, 3:] = (turn * Rotation.from_quat(_unit(path, source.name, poses[:, 3:]))).as_quat()
        notes.append(f"{source.frame} stands still in {parent.frame or '(unnamed)'}, in which all is given")
        source = dataclasses.replace(source, frame=parent.frame, poses=poses)
    return source


def _unit(path: Path, name: str, quaternions: Array) -> Array:
    length = np.linalg.norm(quaternions, axis=1)
    if not (np.abs(length - 1) < 0.05).all():
        raise InputError(
            f"{path}: a quaternion of {name} has length {length[np.argmax(np.abs(length - 1))]:.3g}, not 1"
        )
    return quaternions / length[:, None]


def _listed(names: Sequence[str]) -> str:
    shown = [name if len(name) < 80 else f"{name[:77]}…" for name in names[:12]]
    return ", ".join(shown) + (f" and {len(names) - 12} more" if len(names) > 12 else "")


def _name(path: Path) -> str:
    return re.sub(r"[^\w-]+", "_", path.stem) or "take"
