# SPDX-License-Identifier: MIT
"""Tables of recorded motion → trials: CSV of markers or poses, Tracker's .trk, DeepLabCut's CSV.

Nothing here is metres or Z up yet: a table gives numbers, names and what its headings say of units
(``sim.app.import_capture`` decides).
"""

from __future__ import annotations

import csv
import dataclasses
import math
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ..errors import InputError
from ..files import read_text

Array = NDArray[np.float64]

MAX_BYTES, MAX_TRACKER_BYTES = 256 * 2**20, 32 * 2**20
"""Largest file, and largest Tracker project, which takes twenty times as much memory."""
MOST_CELLS, MOST_COLUMNS, MOST_HEADING = 20_000_000, 4096, 200
"""Cells of a table, columns of it, and characters of a heading; of a Tracker project its points times its frames."""

LIKELIHOOD = 0.6
"""DeepLabCut's likelihood below which a point counts as not seen."""

TIME_NAMES = ("time", "times", "t", "timestamp", "sec", "seconds")
TRIAL_NAMES = ("trial", "take", "run", "throw")
FRAME_NAMES = ("frame", "frames", "index")
QUATERNION, EULER = ("qw", "qx", "qy", "qz"), ("roll", "pitch", "yaw")
MATRIX = tuple(f"r{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3))
UNITS: Mapping[str, float] = {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}


@dataclass(frozen=True, kw_only=True, eq=False)
class RecordedTable:
    """One take as a table gives it. labels: (K,) of the points.

    times: (T,) in ``time_unit`` ("" where unsaid), or None where rows are frames. points: (T, K, 3) in ``length_unit``,
    NaN where not seen; of a picture's plane (x right, y down) in ``px``, with zeros as third. turns: (T, 3, 3) of a
    table of poses, whose only point is the body's reference. up: the axis that the file calls up, "" where it is z or
    unsaid. notes: what was decided in reading, as sentences.
    """

    name: str
    times: Array | None
    points: Array
    labels: tuple[str, ...]
    time_unit: str = ""
    length_unit: str = ""
    planar: bool = False
    turns: Array | None = None
    up: str = ""
    notes: tuple[str, ...] = ()


def read_recording(
    path: Path, columns: Mapping[str, str] | None = None, points: Sequence[str] = ()
) -> list[RecordedTable]:
    """Return the takes in the file ``path``. columns: our name (``time``, ``trial``, ``x``, …) → the table's heading.

    points: labels of the points to keep, in this order; all where empty. Raises InputError with file, row and remedy
    for anything that is no such table.
    """
    from .recorded_files import is_recorded_file, read_recorded_file

    if is_recorded_file(path):
        return read_recorded_file(path, columns, points)
    tables = _read_tables(path, columns)
    if not points:
        return tables
    missing = [name for name in points if any(name not in table.labels for table in tables)]
    if missing:
        raise InputError(f"{path}: there is no point {missing[0]!r}; there are {', '.join(tables[0].labels)}")
    return [
        dataclasses.replace(t, points=t.points[:, [t.labels.index(name) for name in points]], labels=tuple(points))
        for t in tables
    ]


def _read_tables(path: Path, columns: Mapping[str, str] | None) -> list[RecordedTable]:
    try:
        most = MAX_TRACKER_BYTES if path.suffix.lower() == ".trk" else MAX_BYTES
        text = read_text(path, most, what="table of motion").removeprefix("\ufeff")
    except FileNotFoundError:
        raise InputError(f"{path}: there is no such file; check its name") from None
    if path.suffix.lower() == ".trk":
        return [_read_tracker(path, text)]
    if path.suffix.lower() not in (".csv", ".tsv", ".txt"):
        raise InputError(f"{path}: {path.suffix or 'no ending'} is not read; export CSV, C3D, or MCAP")
    first = text.partition("\n")[0]
    separator = max(",;\t", key=first.count)
    if (cells := text.count(separator) + text.count("\n")) > MOST_CELLS or first.count(separator) >= MOST_COLUMNS:
        raise InputError(
            f"{path}: has {cells} cells, {first.count(separator) + 1} in a row; a table has at most {MOST_CELLS}, "
            f"{MOST_COLUMNS} in a row: export fewer points"
        )
    try:
        rows = [row for row in csv.reader(text.splitlines(), delimiter=separator) if any(cell.strip() for cell in row)]
    except csv.Error as error:
        raise InputError(f"{path}: not readable as a table ({error}); export it anew as CSV") from None
    if len(rows) > 3 and rows[0][0].strip() == "scorer" and rows[1][0].strip() == "bodyparts":
        return [_read_deeplabcut(path, rows)]
    return _read_table(path, rows, dict(columns or {}))


def _heading(cell: str) -> tuple[str, str]:
    """Return (name, unit) of a heading such as "time_ms", "x [mm]" or "ball.x (m)"; lower case."""
    word = cell.strip().lower()
    found = re.fullmatch(r"(.*?)[\s_]*[\[(]\s*([a-zµ]+)\s*[\])]", word) or re.fullmatch(
        r"(.+)_(m|mm|cm|s|ms|us|ns)", word
    )
    if found is None:
        return word, ""
    unit = found[2].replace("µs", "us")
    return found[1].strip(" _"), {"sec": "s", "meters": "m", "metres": "m"}.get(unit, unit)


def _read_table(path: Path, rows: list[list[str]], columns: dict[str, str]) -> list[RecordedTable]:
    if len(rows) < 4:
        raise InputError(f"{path}: has {max(len(rows) - 1, 0)} rows; a motion needs a heading and at least 3")
    if (longest := max(map(len, rows[0]))) > MOST_HEADING:
        raise InputError(f"{path}: has a heading of {longest} characters; give names of at most {MOST_HEADING}")
    headings = [_heading(cell) for cell in rows[0]]
    if all(re.fullmatch(r"[-+\d.eE]*", name) for name, _ in headings):
        raise InputError(f"{path}: the first row has no names; give headings such as time,x,y,z")
    raw = [cell.strip().lower() for cell in rows[0]]
    for ours, theirs in columns.items():
        if theirs.strip().lower() not in raw:
            raise InputError(f"{path}: there is no column {theirs!r}; the columns are {', '.join(rows[0])}")
        index = raw.index(theirs.strip().lower())
        headings[index] = (ours.lower(), headings[index][1])
    names = [name for name, _ in headings]
    for name in names:
        if name and names.count(name) > 1:
            raise InputError(f"{path}: two columns are called {name!r}: rename one, or map others with --column")
    units = dict(headings)
    trial = next((n for n in TRIAL_NAMES if n in names), None)
    time = next((n for n in TIME_NAMES if n in names), None)
    if time is None and not any(n in names for n in FRAME_NAMES):
        raise InputError(f"{path}: no column of times among {', '.join(rows[0])}: map it with --column time=NAME")
    takes: dict[str, list[list[str]]] = {}
    for number, row in enumerate(rows[1:], 2):
        if len(row) != len(names):
            raise InputError(f"{path}: row {number} has {len(row)} cells, the heading {len(names)}")
        takes.setdefault(row[names.index(trial)].strip() if trial else path.stem, []).append(row)
    points = _point_columns(path, names)
    lengths = {units[n] for group in points.values() for n in group if n is not None and units[n]}
    if len(lengths) > 1:
        raise InputError(f"{path}: lengths in {' and '.join(sorted(lengths))}: export one unit")
    found = []
    inside = {time, *(name for group in points.values() for name in group)} - {trial}
    wanted = [(i, name) for i, name in enumerate(names) if name in inside]
    for name, lines in takes.items():
        table = {n: _numbers(path, lines, i, n) for i, n in wanted}
        blank = np.zeros(len(lines))
        stacked = [[blank if n is None else table[n] for n in group] for group in points.values()]
        found.append(
            RecordedTable(
                name=re.sub(r"[^\w-]+", "_", name) or "take",
                times=table[time] if time else None,
                points=np.array(stacked).transpose(2, 0, 1),
                labels=tuple(points),
                time_unit=units[time] if time else "",
                length_unit=lengths.pop() if len(lengths) == 1 and len(takes) == 1 else next(iter(lengths), ""),
                planar=any(group[2] is None for group in points.values()),
                turns=_turns(path, lines, names) if list(points) == [""] else None,
            )
        )
    return found


def _point_columns(path: Path, names: Sequence[str]) -> dict[str, list[str | None]]:
    """Return label → headings of x, y and z; z is None in a table of a plane."""
    found: dict[str, list[str | None]] = {}
    for name in names:
        match = re.fullmatch(r"(?:(.*?)[\s_.:]+)?x", name)
        if match is None or match[0] in QUATERNION:
            continue
        stem = name[:-1]
        if f"{stem}y" in names:
            found[match[1] or ""] = [name, f"{stem}y", f"{stem}z" if f"{stem}z" in names else None]
    if not found:
        raise InputError(f"{path}: no columns x, y, z (or NAME_x, NAME_y, NAME_z): map them with --column x=NAME …")
    if len({group[2] is None for group in found.values()}) > 1:
        raise InputError(f"{path}: some points have a z and others have none")
    return found


def _numbers(path: Path, lines: Sequence[Sequence[str]], index: int, name: str) -> Array:
    values = np.empty(len(lines))
    for i, row in enumerate(lines):
        cell = row[index].strip()
        try:
            values[i] = float(cell) if cell else math.nan
        except ValueError:
            raise InputError(f"{path}: column {name!r} holds {cell!r}, which is no number") from None
    return np.where(np.isfinite(values), values, math.nan)


def _turns(path: Path, lines: Sequence[Sequence[str]], names: Sequence[str]) -> Array | None:
    """Return rotations (T, 3, 3) from a quaternion, Euler angles or a matrix; None where there are none."""

    def columns(wanted: Sequence[str]) -> Array | None:
        if not all(n in names for n in wanted):
            return None
        return np.stack([_numbers(path, lines, names.index(n), n) for n in wanted], axis=1)

    if (q := columns(QUATERNION)) is not None:
        length = np.linalg.norm(q, axis=1)
        if not np.isfinite(length).all():
            raise InputError(
                f"{path}: a part of a quaternion is missing in row {int(np.argmin(np.isfinite(length))) + 2}"
            )
        if np.abs(length - 1).max() > 0.05:
            raise InputError(f"{path}: quaternions of length {length[np.argmax(np.abs(length - 1))]:.3g}, not 1")
        return Rotation.from_quat(np.roll(q / length[:, None], -1, axis=1)).as_matrix()
    if (angles := columns(EULER)) is not None:
        # Degrees where any angle is beyond a full turn in radians.
        if not np.isfinite(angles).all():
            raise InputError(f"{path}: roll, pitch or yaw is missing in a row; leave that row out")
        degrees = bool(np.abs(angles).max() > 2 * math.pi + 0.01)
        return Rotation.from_euler("xyz", angles, degrees=degrees).as_matrix()
    if (matrix := columns(MATRIX)) is not None:
        turns = matrix.reshape(-1, 3, 3)
        if not np.allclose(turns @ turns.transpose(0, 2, 1), np.eye(3), atol=1e-2):
            raise InputError(f"{path}: r11 … r33 are no rotations: their rows are not orthonormal")
        if (np.linalg.det(turns) < 0).any():
            raise InputError(f"{path}: r11 … r33 mirror: the axes are left-handed; flip one, of positions as well")
        return turns
    return None


def _read_deeplabcut(path: Path, rows: list[list[str]]) -> RecordedTable:
    """Return pixels by body part; rows are frames."""
    parts, kinds = [c.strip() for c in rows[1]], [c.strip() for c in rows[2]]
    if kinds[0] != "coords" or len({len(rows[1]), len(rows[2]), *(len(r) for r in rows[3:])}) != 1:
        raise InputError(f"{path}: not a whole table of DeepLabCut: rows scorer, bodyparts, coords, then numbers")
    labels = tuple(dict.fromkeys(parts[1:]))
    pairs = list(enumerate(zip(parts, kinds, strict=True)))[1:]
    data = {(p, k): _numbers(path, rows[3:], i, f"{p} {k}") for i, (p, k) in pairs}
    points = np.zeros((len(rows) - 3, len(labels), 3))
    for i, label in enumerate(labels):
        for axis, kind in enumerate(("x", "y")):
            if (label, kind) not in data:
                raise InputError(f"{path}: {label} has no column {kind}")
            points[:, i, axis] = data[label, kind]
        points[~(data.get((label, "likelihood"), np.ones(len(points))) >= LIKELIHOOD), i] = math.nan
    return RecordedTable(name=path.stem, times=None, points=points, labels=labels, length_unit="px", planar=True)


def _read_tracker(path: Path, text: str) -> RecordedTable:
    """Return the point masses of a Tracker project, with its scale, origin, tilt and frame time applied: m and s."""
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise InputError(f"{path}: declares entities, which no Tracker project needs")
    try:
        root = ElementTree.fromstring(text)  # noqa: S314  entities are refused above
    except ElementTree.ParseError as error:
        raise InputError(f"{path}: not a Tracker project ({error})") from None

    masses, clocks = _of_class(root, "tracker.PointMass"), _of_class(root, "ClipControl")
    systems = [item for found in _of_class(root, "ImageCoordSystem") for item in found.iter("object")]
    frames = [item for item in systems if "FrameData" in (item.get("class") or "")]
    if not masses or not frames:
        raise InputError(f"{path}: has no point mass or no coordinate system; track one in Tracker and save again")
    system = frames[0]
    scale, tilt = _property(path, system, "xscale"), math.radians(_property(path, system, "angle", 0.0))
    origin = np.array([_property(path, system, "xorigin"), _property(path, system, "yorigin")])
    if not scale > 0:
        raise InputError(f"{path}: xscale is {scale!r} pixels per unit: calibrate in Tracker")
    step_ms = _property(path, clocks[0], "delta_t", 0.0) if clocks else 0.0
    if not step_ms > 0:
        raise InputError(f"{path}: delta_t, the time of a frame in ms, is missing")
    tracks = _tracks(path, masses)
    order = sorted({frame for own in tracks.values() for frame in own})
    if len(order) < 3:
        raise InputError(f"{path}: {len(order)} frames are tracked; a motion needs at least 3")
    if len(order) * len(tracks) > MOST_CELLS:
        raise InputError(f"{path}: {len(tracks)} points in {len(order)} frames are too many; save fewer tracks")
    points = np.full((len(order), len(tracks), 3), math.nan)
    for k, own in enumerate(tracks.values()):
        for i, frame in enumerate(order):
            if frame in own:
                right, down = (np.array(own[frame]) - origin) / scale
                up = -down
                points[i, k] = (
                    math.cos(tilt) * right + math.sin(tilt) * up,
                    math.cos(tilt) * up - math.sin(tilt) * right,
                    0.0,
                )
    return RecordedTable(
        name=re.sub(r"[^\w-]+", "_", path.stem),
        times=np.array(order) * step_ms * 1e-3,
        points=points,
        labels=tuple(tracks),
        time_unit="s",
        length_unit="m",
        planar=True,
    )


def _of_class(root: ElementTree.Element, name: str) -> list[ElementTree.Element]:
    """The objects of a Tracker project whose class ends in ``name``."""
    return [item for item in root.iter("object") if (item.get("class") or "").endswith(name)]


def _property(path: Path, item: ElementTree.Element, name: str, default: float | None = None) -> float:
    """The number ``name`` of an object of the project ``path``. Raises InputError without it and a ``default``."""
    for entry in item.findall("property"):
        if entry.get("name") == name and entry.text:
            try:
                value = float(entry.text)
            except ValueError:
                break
            if math.isfinite(value):
                return value
            raise InputError(f"{path}: {name} is {value} in {item.get('class')}; track it again")
    if default is None:
        raise InputError(f"{path}: {name} is missing in {item.get('class')}")
    return default


def _tracks(path: Path, masses: list[ElementTree.Element]) -> dict[str, dict[int, tuple[float, float]]]:
    """The place in pixels of each point mass in each frame where it is tracked, by name."""
    tracks: dict[str, dict[int, tuple[float, float]]] = {}
    for item in masses:
        name = next((e.text for e in item.findall("property") if e.get("name") == "name" and e.text), "mass")
        own = tracks.setdefault(name, {})
        for entry in item.findall("property[@name='framedata']/property"):
            index = re.fullmatch(r"\[(\d{1,9})\]", entry.get("name") or "")
            data = entry.find("object")
            if index is not None and data is not None:
                own[int(index[1])] = (_property(path, data, "x"), _property(path, data, "y"))
    return tracks
