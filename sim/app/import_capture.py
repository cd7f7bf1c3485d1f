# SPDX-License-Identifier: MIT
"""Recordings of other programs → capture folder; units and axes guessed from the motion are always reported."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..diagnose.capture import Capture, CaptureObject, Ground, ObjectBelief, Trial
from ..diagnose.capture_folder import load_capture, save_capture
from ..errors import InputError
from ..events import OnEvent, ignore
from ..files import read_text
from ..importers.recordings import UNITS, RecordedTable, read_recording

Array = NDArray[np.float64]
Confirm = Callable[[str], bool]

MAX_REST_BYTES = 2**20
"""Of a table of places on a body."""

FREE_FALL = (7.0, 12.5)
"""Downward acceleration in m/s² that counts as free fall with its errors and drag."""

LONGEST_STEP_S, FARTHEST_M, NEAREST_M = 0.5, 100.0, 0.005
"""Median time step, and extent of the motion, beyond which the units are doubted."""
LONGEST_TAKE_S, LARGEST_M = 1e6, 1e6
"""What no recording of a body reaches, whatever its units: numbers beyond are damage, and their squares overflow."""

AXES: Mapping[str, tuple[tuple[int, float], ...]] = {
    "z": ((0, 1.0), (1, 1.0), (2, 1.0)),
    "y": ((0, 1.0), (2, -1.0), (1, 1.0)),
    "-y": ((0, 1.0), (2, 1.0), (1, -1.0)),
    "-z": ((0, 1.0), (1, -1.0), (2, -1.0)),
}
"""Axis that points up → source axis and sign of our x, y, z; all are rotations, so nothing is mirrored."""


@dataclass(frozen=True, kw_only=True)
class ImportRequest:
    """Facts about a recording that its table does not hold.

    diameter: of a ball in m; or mesh: file of the body in its rest frame, m. density: kg/m³; or mass: kg. name: of the
    object. rest: CSV with NAME,x,y,z of the markers in the mesh's frame; not needed for a single point, which is the
    centre, nor for poses. points: which of the recorded points are used (markers; of a bag the moving frame or topic),
    all where empty. columns: our name → heading of the table; of a bag time is ``stamp`` or ``log``.
    time_unit (s, ms, us, ns), length_unit (m, cm, mm, px), up (z, y, -y, -z): None to guess from the motion.
    scale: m per pixel. fps: of tables whose rows are frames. ground: height of the ground, m. friction, restitution: of
    the ground. noise: standard deviation of a coordinate in m; None to measure it. hold_out: share of the last take
    shown, the rest is withheld and predicted; 0 keeps all takes complete.
    """

    diameter: float | None = None
    mesh: Path | None = None
    density: float | None = None
    mass: float | None = None
    name: str = "body"
    rest: Path | None = None
    points: tuple[str, ...] = ()
    columns: Mapping[str, str] = field(default_factory=dict)
    time_unit: str | None = None
    length_unit: str | None = None
    up: str | None = None
    scale: float | None = None
    fps: float | None = None
    ground: float = 0.0
    friction: float = 0.5
    restitution: float | None = None
    noise: float | None = None
    hold_out: float = 0.0

    def __post_init__(self) -> None:
        if (self.diameter is None) == (self.mesh is None):
            raise InputError("give either diameter of a ball or mesh of a body")
        if (self.density is None) == (self.mass is None):
            raise InputError("give either density in kg/m³ or mass in kg")
        for name in ("diameter", "density", "mass", "scale", "fps", "noise"):
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and value > 0):
                raise InputError(f"{name} is {value!r}: give a number above 0")
        if self.time_unit is not None and self.time_unit not in ("s", "ms", "us", "ns"):
            raise InputError(f"time_unit is {self.time_unit!r}: give s, ms, us or ns")
        if self.length_unit is not None and self.length_unit not in ("m", "cm", "mm", "px"):
            raise InputError(f"length_unit is {self.length_unit!r}: give m, cm, mm or px")
        if self.up is not None and self.up not in AXES:
            raise InputError(f"up is {self.up!r}: give {', '.join(AXES)}")
        if not 0 <= self.hold_out < 1:
            raise InputError(f"hold_out is {self.hold_out!r}: give the share that is shown, 0 to below 1")


def import_capture(
    files: Sequence[str | Path],
    request: ImportRequest,
    *,
    out: str | Path,
    confirm: Confirm | None = None,
    on_event: OnEvent = ignore,
) -> Capture:
    """Return the capture of the recordings ``files``, written to ``out``.

    They are CSV, Tracker's .trk, DeepLabCut's CSV, C3D, or bags of ROS 2 (MCAP, db3, or a folder of them).

    Every guess is reported as a notice. One that changes numbers (milliseconds, millimetres, another axis up)
    must be confirmed: ``confirm`` is asked with a sentence; None refuses, naming the option that answers.

    >>> import physgen
    >>> ball = physgen.ImportRequest(diameter=0.04, mass=0.0027)  # doctest: +SKIP
    >>> physgen.import_capture(["rally.csv"], ball, out="capture").fit_trials  # doctest: +SKIP

    Raises InputError with file, row and remedy; nothing is then written.
    """
    out = Path(out)
    if out.exists():
        raise InputError(f"{out}: already exists; choose another folder")
    tables = _takes(files, request)

    def say(message: str) -> None:
        on_event({"event": "notice", "stage": "import", "message": message})

    def settle(guess: str, option: str) -> None:
        if confirm is None or not confirm(f"{guess}. Is that right?"):
            raise InputError(f"{guess}; say so with {option}, or what is right")
        say(guess)

    item = _body(request)
    for table in tables:
        for note in table.notes:
            say(f"take {table.name!r}: {note}")
    times = [_times(t, request, settle) for t in tables]
    points = _lengths(tables, request, settle)
    points, turns = _upright(tables, points, times, request, settle)
    rest = _rest(tables[0], item, request)
    trials = [_trial(*take, rest) for take in zip(tables, times, points, turns, strict=True)]
    noise = request.noise
    if noise is None:
        noise = _noise(trials)
        say(f"noise: {1e3 * noise:.3g} mm per coordinate, from how the points jump from frame to frame")
    _check_heights(trials, item, request)
    if len(trials) == 1:
        say("a lone take: a cause is judged by its second half only; three takes that differ tell far more")
    if request.hold_out and len(trials) > 1:
        trials[-1] = _withheld(trials[-1], request.hold_out)
    capture = Capture(
        gravity=(0.0, 0.0, -9.81),
        ground=Ground(point=(0.0, 0.0, request.ground), friction=request.friction, restitution=request.restitution),
        objects=(item,),
        noise_sigma=noise,
        camera=None,
        trials=tuple(trials),
    )
    save_capture(capture, out)
    return load_capture(out)


def _takes(files: Sequence[str | Path], request: ImportRequest) -> list[RecordedTable]:
    """Return the takes in ``files``, which track the same points, with a name of its own each."""
    tables = [t for file in files for t in read_recording(Path(file), request.columns, request.points)]
    if not tables:
        raise InputError("no file was given")
    if len({t.labels for t in tables}) > 1:
        raise InputError("the takes have different points: track the same points in each")
    names = [t.name for t in tables]
    return [
        dataclasses.replace(t, name=f"{t.name}_{i}") if names.count(t.name) > 1 else t for i, t in enumerate(tables)
    ]


def _trial(table: RecordedTable, times: Array, points: Array, turns: Array | None, rest: Array) -> Trial:
    """Return the take ``table`` as a trial.

    times: (T,) s. points: (T, K, 3) m, tracked ones, or the body's origin where its ``turns`` (T, 3, 3) are known.
    rest: (K, 3) m in its rest frame.
    """
    return Trial(
        name=table.name,
        role="fit",
        times=times,
        points=points if turns is None else points + np.einsum("tij,kj->tki", turns, rest),
        pixels=None,
        object_index=np.zeros(len(rest), dtype=np.int64),
        rest_points=rest,
    )


def _check_heights(trials: Sequence[Trial], item: CaptureObject, request: ImportRequest) -> None:
    """Raise InputError where a point is farther below the ground than the body is large."""
    low = min(float(np.nanmin(t.observed[..., 2])) for t in trials)
    size = float(np.ptp(item.vertices, axis=0).max())
    if low < request.ground - size:
        raise InputError(
            f"a point is at a height of {low:.3g} m, below the ground at {request.ground:g} m: give ground"
        )


def _body(request: ImportRequest) -> CaptureObject:
    import trimesh

    if request.diameter is not None:
        mesh = trimesh.creation.icosphere(subdivisions=3, radius=request.diameter / 2)
        volume = math.pi * request.diameter**3 / 6
    else:
        from ..scene.meshes import read_mesh

        assert request.mesh is not None
        mesh = read_mesh(request.mesh, textures=False)
        volume = abs(float(trimesh.Trimesh(mesh.vertices, mesh.faces).volume))
    density = request.density if request.density is not None else (request.mass or 0.0) / max(volume, 1e-12)
    if not 0.01 < density < 30000:
        raise InputError(f"mass and size give {density:.3g} kg/m³, which is no matter: check kg and m")
    belief = ObjectBelief(name=request.name, mesh="body.obj", density_kg_m3=density, stiffness="hard")
    return CaptureObject(
        belief=belief,
        vertices=np.asarray(mesh.vertices, dtype=np.float64),
        faces=np.asarray(mesh.faces, dtype=np.int64),
    )


def _times(table: RecordedTable, request: ImportRequest, settle: Callable[[str, str], None]) -> Array:
    """Return rising times (T,) in s from 0."""
    if table.times is None:
        if request.fps is None:
            raise InputError(f"take {table.name!r}: rows are frames: give fps")
        return np.arange(len(table.points)) / request.fps
    times = table.times
    for row, (here, step) in enumerate(zip(times[1:], np.diff(times), strict=True), 1):
        if not step > 0:
            what = "occurs twice" if step == 0 else "is not a number" if math.isnan(step) else "is earlier than before"
            raise InputError(
                f"take {table.name!r}: time {here:.9g} of sample {row + 1} {what}: remove or repair that row"
            )
    unit = request.time_unit or table.time_unit
    if not unit:
        unit, step = "s", float(np.median(np.diff(times)))
        for factor in ("ms", "us", "ns"):
            if step * UNITS[unit] > LONGEST_STEP_S:
                unit = factor
        if unit != "s":
            settle(f"take {table.name!r}: the times look like {unit}: a step of {step:g}", f"--time-unit {unit}")
    if unit not in UNITS:
        raise InputError(f"take {table.name!r}: times in {unit!r}: give --time-unit s, ms, us or ns")
    times = (times - times[0]) * UNITS[unit]
    if not times[-1] <= LONGEST_TAKE_S:
        raise InputError(f"take {table.name!r}: lasts {times[-1]:.3g} s: check its times, or give --time-unit")
    return times


def _lengths(
    tables: Sequence[RecordedTable], request: ImportRequest, settle: Callable[[str, str], None]
) -> list[Array]:
    """Return points (T, K, 3) in m, of a plane as x and height."""
    unit = request.length_unit or tables[0].length_unit
    extent = max(float(np.nanmax(np.ptp(np.nan_to_num(t.points), axis=0), initial=0.0)) for t in tables)
    if not unit:
        unit = "m"
        if extent > FARTHEST_M:
            unit = "mm"
            settle(f"the points move by {extent:.4g}: they look like mm", "--length-unit mm")
        elif extent < NEAREST_M:
            raise InputError(f"the points move by {extent:.3g} only: give length_unit, or a take with motion")
    if unit == "px":
        if request.scale is None:
            raise InputError("the points are pixels of a picture: give scale, m per pixel in the plane of motion")
        if not tables[0].planar:
            raise InputError("length_unit is px, but the points have three coordinates")
        # A picture's y points down.
        factors = request.scale * np.array([1.0, -1.0, 0.0])
    elif unit in UNITS:
        factors = UNITS[unit] * np.ones(3)
    else:
        raise InputError(f"lengths in {unit!r}: give --length-unit m, cm or mm")
    found = [(t.points * factors)[..., [0, 2, 1]] if t.planar else t.points * factors for t in tables]
    for table, points in zip(tables, found, strict=True):
        farthest = float(np.nanmax(np.abs(points), initial=0.0))
        if not farthest <= LARGEST_M:
            raise InputError(f"take {table.name!r}: a point is {farthest:.3g} m away: check it, or give --length-unit")
    return found


def _upright(
    tables: Sequence[RecordedTable],
    points: list[Array],
    times: list[Array],
    request: ImportRequest,
    settle: Callable[[str, str], None],
) -> tuple[list[Array], list[Array | None]]:
    """Return points and rotations in axes with z up."""
    up = request.up
    if up is None:
        up, fall = "z", _falls(points, times)
        for name in AXES:
            (axis, sign) = AXES[name][2]
            if FREE_FALL[0] < -sign * fall[axis] < FREE_FALL[1]:
                up = name
                break
        if up == "z" and tables[0].up and not FREE_FALL[0] < -fall[2] < FREE_FALL[1]:
            up = tables[0].up
            settle(f"take {tables[0].name!r} calls {up} up, and nothing falls freely", f"--up={up}")
        elif up != "z":
            settle(f"things fall along {'+' if up[0] == '-' else '-'}{up[-1]}: {up} looks like up", f"--up={up}")
    if up == "z":
        return points, [t.turns for t in tables]
    turn = np.zeros((3, 3))
    for row, (axis, sign) in enumerate(AXES[up]):
        turn[row, axis] = sign
    return [p @ turn.T for p in points], [None if t.turns is None else turn @ t.turns for t in tables]


def _falls(points: list[Array], times: list[Array]) -> Array:
    """Return the acceleration (3,) m/s² of the steepest stretch of free motion, a median over parabolas."""
    found = []
    for seen, clock in zip(points, times, strict=True):
        centre = seen.mean(axis=1)
        good = np.isfinite(centre).all(axis=1)
        centre, clock = centre[good], clock[good]
        width = max(5, len(clock) // 4)
        for first in range(0, len(clock) - width + 1, max(1, width // 2)):
            part = slice(first, first + width)
            found.append(2 * np.polyfit(clock[part] - clock[first], centre[part], 2)[0])
    return np.median(found, axis=0) if found else np.zeros(3)


def _rest(table: RecordedTable, item: CaptureObject, request: ImportRequest) -> Array:
    """Return the places (K, 3) m of the tracked points in the body's rest frame."""
    if table.turns is not None:
        # A pose shows every point of the body: its extreme corners stand for it.
        low, high = item.vertices.min(axis=0), item.vertices.max(axis=0)
        corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]) * (high - low) + low
        nearest = [int(np.argmin(np.linalg.norm(item.vertices - c, axis=1))) for c in corners]
        return item.vertices[sorted(set(nearest))]
    if len(table.labels) == 1 and request.rest is None:
        return np.zeros((1, 3)) if request.diameter is not None else item.vertices.mean(axis=0)[None]
    if request.rest is None:
        raise InputError(
            f"{len(table.labels)} points are tracked: give rest, a CSV name,x,y,z of their places on the body"
        )
    places: dict[str, list[float]] = {}
    try:
        text = read_text(request.rest, MAX_REST_BYTES, what="table of places").removeprefix("\ufeff")
    except FileNotFoundError:
        raise InputError(f"{request.rest}: there is no such file; check its name") from None
    for row in text.splitlines():
        cells = [c.strip() for c in row.split(",")]
        try:
            places[cells[0].lower()] = [float(c) for c in cells[1:4]]
        except ValueError:
            continue
    missing = [label for label in table.labels if len(places.get(label.lower(), ())) != 3]
    if missing:
        raise InputError(f"{request.rest}: has no place for {', '.join(missing)}: a row name,x,y,z in m for each")
    return np.array([places[label.lower()] for label in table.labels])


def _noise(trials: Sequence[Trial]) -> float:
    """Return the noise of a coordinate in m: third differences of white noise have 20 times its variance."""
    jumps = [np.abs(np.diff(t.observed, 3, axis=0)).ravel() for t in trials]
    every = np.concatenate(jumps)
    every = every[np.isfinite(every) & (every > 0)]
    return max(float(np.median(every)) / 0.6745 / math.sqrt(20), 1e-5) if len(every) else 1e-3


def _withheld(trial: Trial, share: float) -> Trial:
    shown = int(np.clip(round(share * len(trial.times)), 3, len(trial.times) - 1))
    return dataclasses.replace(
        trial,
        role="predict",
        times=trial.times[:shown],
        points=trial.observed[:shown],
        predict_times=trial.times[shown:],
    )
