# SPDX-License-Identifier: MIT
"""Physical checks of a bake, frame by frame, from what it shows: penetration, momentum, energy, contact slip.

They look at the caches that are rendered, not at the engine's own state, except for the energies, which vertices do
not tell. Without the scene, which has faces, ground and gravity, only the energies are left.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ..cache.bake_folder import METRICS_FILE, WORLD_SPACE, Bake
from ..errors import Cancelled, InputError
from ..events import IsCancelled
from ..files import is_file
from ..mpm.geometry.inside_test import winding_numbers
from ..mpm.geometry.triangles import bisected, check_closed, squared_distances
from ..scene.folder import Scene
from ..scene.meshes import load_object_mesh
from ..scene.model import SceneModel
from ..validation import read_json
from .evaluation import LOWER, Curve, Measure, Section

Array = NDArray[np.float64]

TOUCH = 0.01
"""Share of an object's size within which it may touch what it stands on: no free flight, and its points slip."""
MOST_POINTS = 1500
"""Points of an object's surface, evenly chosen, that are looked for in another."""
GRAIN = 0.05
"""Longest edge, as a share of the smaller object's size, of the pieces of a surface whose middles are looked for."""
NEAREST = 12
"""Triangles, by their middles, among which the nearest one to a point is looked for."""
STILL_SPEED = 0.02
"""Sizes per second below which an object counts as resting; what slips then is not sliding but creeping."""

TITLES = {
    "ground_penetration": "Depth below the ground, share of the object's size",
    "object_penetration": "Depth of one object in another, share of the smaller one's size",
    "flight_error": "Acceleration in free flight off gravity's, share of gravity",
    "pull": "Pull of the ground, share of gravity",
    "energy_gain": "Mechanical energy gained, share of what is in motion",
    "contact_slip": "Slip of resting objects' contacts, sizes per second",
}
UNITS = {"contact_slip": "sizes/s"}


@dataclass
class _Body:
    """One object over time. size: largest extent at rest, m. centres: (T, 3) of its volume."""

    name: str
    faces: NDArray[np.int64]
    size: float
    moves: bool
    closed: bool
    centres: list[Array] = field(default_factory=list)
    gaps: list[float] = field(default_factory=list)
    beside: list[bool] = field(default_factory=list)
    slips: list[float] = field(default_factory=list)


def bake_physics(bake: Bake, scene: Scene | None, *, cancelled: IsCancelled) -> Section:
    """Return the section of ``bake``. scene: the folder that it was baked from; None leaves out what needs it.

    Raises InputError for a scene of other objects, a damaged bake, samples in mesh coordinates, and fewer than three
    frames.
    """
    count = bake.manifest.frames_done
    if count < 3:
        raise InputError(f"{bake.root}: has {count} frames; three or more show a motion")
    times = np.arange(count) / bake.manifest.rate
    values: dict[str, Measure] = {}
    curves: list[Curve] = []
    notices: list[str] = []
    if scene is None:
        reason = "needs the scene that was baked (--scene)"
    else:
        reason = ""
        seen, said = _motions(bake, scene, times, cancelled)
        notices += said
        for name, rows in seen.items():
            curves += [_curve(name, label, times, row) for label, row in rows.items()]
            known = [float(np.nanmax(row)) for row in rows.values() if np.isfinite(row).any()]
            values[name] = _measure(name, max(known, default=None), "" if known else _never(name))
    asleep = () if scene is None else [item.name for item in scene.model.objects if item.asleep]
    woken = _waking(bake, asleep)
    if woken:
        notices.append(
            f"{', '.join(woken)}: asleep at first, and no part of the energy until something touches it; the energy is "
            "compared before and after that alone"
        )
    energy, why = _energy_gain(bake, count, list(woken.values()))
    if energy is not None:
        curves.append(_curve("energy_gain", "", times, energy))
    values["energy_gain"] = _measure("energy_gain", None if energy is None else float(energy.max()), why)
    for name in TITLES:
        values.setdefault(name, _measure(name, None, reason))
    if scene is not None:
        notices += _explained(scene.model)
    return Section(
        name="bake",
        title="Physics of the bake",
        text=f"{count} frames of {bake.root.name}, {len(bake.manifest.objects)} objects; the worst of all frames",
        measures=tuple(values[name] for name in TITLES),
        curves=tuple(curves),
        notices=tuple(notices),
    )


def _measure(name: str, value: float | None, note: str) -> Measure:
    return Measure(name=name, title=TITLES[name], value=value, unit=UNITS.get(name, ""), better=LOWER, note=note)


def _curve(name: str, label: str, times: Array, values: Array) -> Curve:
    return Curve(name=name, label=label, title=TITLES[name], unit=UNITS.get(name, ""), times=times, values=values)


def _never(name: str) -> str:
    return {
        "ground_penetration": "there is no ground",
        "object_penetration": "there are no two closed objects of which one is dynamic",
        "flight_error": "nothing is in free flight for three frames",
        "pull": "nothing touches the ground alone",
        "contact_slip": "nothing rests on the ground",
    }.get(name, "")


def _explained(model: SceneModel) -> list[str]:
    """Return what in the scene makes momentum and energy change by right."""
    reasons = [effect.name for effect in model.effects]
    reasons += [f"the motion of {item.name}" for item in model.objects if item.motion is not None]
    if model.gravity_track:
        reasons.append("a changing gravity")
    return [f"the scene has {', '.join(reasons)}: momentum and energy may change by it"] if reasons else []


def _motions(
    bake: Bake, scene: Scene, times: Array, cancelled: IsCancelled
) -> tuple[dict[str, dict[str, Array]], list[str]]:
    """Return for each figure its values (T,) by object or pair, and notices."""
    bodies = _bodies(bake, scene)
    ground = scene.model.ground
    normal = np.asarray(ground.unit_normal if ground else (0.0, 0.0, 1.0), dtype=np.float64)
    pairs = [(a, b) for a, b in itertools.combinations(bodies, 2) if (a.moves or b.moves) and a.closed and b.closed]
    depths: dict[str, list[float]] = {f"{a.name} and {b.name}": [] for a, b in pairs}
    before: dict[str, Array] = {}
    for frame in range(bake.first_frame, bake.last_frame + 1):
        if cancelled():
            raise Cancelled("the evaluation was cancelled; nothing was written")
        now = {body.name: np.asarray(bake.vertices(body.name, frame), dtype=np.float64) for body in bodies}
        for body in bodies:
            vertices = now[body.name]
            body.centres.append(volume_centre(vertices, body.faces) if body.closed else vertices.mean(axis=0))
            heights = ground.heights(vertices) if ground else np.full(len(vertices), np.inf)
            body.gaps.append(float(heights.min()))
            body.slips.append(_slip(heights, vertices, before.get(body.name), normal, body.size, bake.manifest.rate))
            body.beside.append(_beside(body, bodies, now))
        for a, b in pairs:
            smaller = min(a.size, b.size)
            depths[f"{a.name} and {b.name}"].append(_depth(a, b, now) / smaller)
        before = now
    moving = [body for body in bodies if body.moves]
    gravity = np.asarray(scene.model.gravity, dtype=np.float64)
    flights, pulls = {}, {}
    if float(np.linalg.norm(gravity)) > 0 and not scene.model.gravity_track:
        for body in moving:
            flights[body.name], pulls[body.name] = _accelerations(body, normal, gravity, bake.manifest.rate)
    found = {
        "ground_penetration": {b.name: np.maximum(0.0, -np.array(b.gaps)) / b.size for b in moving if ground},
        "object_penetration": {name: np.array(row) for name, row in depths.items()},
        "flight_error": flights,
        "pull": pulls,
        "contact_slip": {b.name: _resting_slip(b, bake.manifest.rate) for b in moving if ground},
    }
    open_ = [body.name for body in bodies if not body.closed]
    said = [f"{', '.join(open_)}: the mesh is open, so that nothing is inside it; centres are of its vertices"]
    return found, said if open_ else []


def _bodies(bake: Bake, scene: Scene) -> list[_Body]:
    named = {item.name: item for item in scene.model.objects}
    found = []
    for cached in bake.manifest.objects:
        item = named.get(cached.name)
        if item is None:
            raise InputError(f"{scene.root}: has no object {cached.name}, which {bake.root} has; name its own scene")
        if cached.space != WORLD_SPACE:
            raise InputError(f"{bake.root}: its samples are in the coordinates of each mesh; bake with --space world")
        mesh = load_object_mesh(scene, item)
        if len(mesh.vertices) != cached.vertices:
            raise InputError(
                f"{scene.root}: {item.name} has {len(mesh.vertices)} vertices and {cached.vertices} in {bake.root}; "
                "name the scene that was baked"
            )
        size = float(np.ptp(bake.vertices(cached.name, bake.first_frame), axis=0).max())
        moves = item.role == "dynamic"
        # Textured meshes have several vertices at one place along their seams.
        _, first_of, place = np.unique(mesh.vertices, axis=0, return_index=True, return_inverse=True)
        faces = first_of[place.reshape(-1)[mesh.faces]]
        faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
        found.append(_Body(name=item.name, faces=faces, size=max(size, 1e-9), moves=moves, closed=_closed(faces)))
    return found


def _closed(faces: NDArray[np.int64]) -> bool:
    try:
        check_closed(faces)
    except InputError:
        return False
    return True


def volume_centre(vertices: Array, faces: NDArray[np.int64]) -> Array:
    """Return the centre (3,) of the volume that a closed mesh encloses; of its vertices where that is nothing.

    Each triangle spans a tetrahedron with a point in the middle, with signed volume; the centre is their mean.
    """
    middle = vertices.mean(axis=0)
    a, b, c = (vertices[faces[:, i]] - middle for i in range(3))
    volumes = np.einsum("ij,ij->i", a, np.cross(b, c))
    total = float(volumes.sum())
    if abs(total) < 1e-12 * float(np.abs(volumes).sum() + 1e-300):
        return np.asarray(middle)
    return np.asarray(middle + (volumes / total) @ (a + b + c) / 4)


def _slip(heights: Array, now: Array, before: Array | None, normal: Array, size: float, rate: float) -> float:
    """Return how fast, in sizes a second, the points near the ground move along it; NaN where none is near it."""
    if before is None:
        return float("nan")
    near = heights < TOUCH * size
    if not near.any():
        return float("nan")
    way = now[near] - before[near]
    along = way - np.outer(way @ normal, normal)
    return float(np.linalg.norm(along, axis=1).mean()) * rate / size


def _resting_slip(body: _Body, rate: float) -> Array:
    """Return the slip (T,) where the object as a whole moves slowly, else NaN."""
    speeds = np.linalg.norm(np.gradient(np.array(body.centres), axis=0), axis=1) * rate / body.size
    return np.where(speeds < STILL_SPEED, np.array(body.slips), np.nan)


def _beside(body: _Body, bodies: Sequence[_Body], now: dict[str, Array]) -> bool:
    """Return whether the box of ``body``, grown by what counts as touching, meets that of another object."""
    margin = TOUCH * body.size
    low, high = now[body.name].min(axis=0) - margin, now[body.name].max(axis=0) + margin
    return any(
        bool(((now[o.name].min(axis=0) <= high) & (now[o.name].max(axis=0) >= low)).all())
        for o in bodies
        if o is not body
    )


def _accelerations(body: _Body, normal: Array, gravity: Array, rate: float) -> tuple[Array, Array]:
    """Return the error of the acceleration in free flight (T,), and how much the ground pulls (T,), in gravities.

    The second difference of the centre is the mean of the acceleration over two frames, weighted to the middle. Free
    is what touches neither ground nor another object in the three frames; the ground alone can push, never pull.
    """
    strength = float(np.linalg.norm(gravity))
    centres = np.array(body.centres)
    off = np.full(len(centres), np.nan)
    pull = np.full(len(centres), np.nan)
    beyond = (centres[2:] - 2 * centres[1:-1] + centres[:-2]) * rate**2 - gravity
    away = (np.array(body.gaps) > TOUCH * body.size) & ~np.array(body.beside)
    alone = ~np.array(body.beside)
    free = away[2:] & away[1:-1] & away[:-2]
    lone = alone[2:] & alone[1:-1] & alone[:-2] & ~free
    off[1:-1][free] = np.linalg.norm(beyond[free], axis=1) / strength
    pull[1:-1][lone] = np.maximum(0.0, -(beyond[lone] @ normal)) / strength
    return off, pull


def _depth(a: _Body, b: _Body, now: dict[str, Array]) -> float:
    """Return the largest depth in metres of the surface of one object in the other, both ways round."""
    found = 0.0
    for inner, outer in ((a, b), (b, a)):
        vertices = now[outer.name]
        box = vertices.min(axis=0), vertices.max(axis=0)
        corners = now[inner.name][inner.faces]
        near = ((corners.max(axis=1) > box[0]) & (corners.min(axis=1) < box[1])).all(axis=1)
        if near.any():
            # Large faces are looked at between their corners, too.
            pieces = bisected(corners[near], GRAIN * min(a.size, b.size), box=box)[0]
            points = np.concatenate([pieces.mean(axis=1), now[inner.name]])
            found = max(found, depth_in(points, vertices, outer.faces))
    return found


def depth_in(points: Array, vertices: Array, faces: NDArray[np.int64]) -> float:
    """Return the largest depth in metres of ``points`` (N, 3) below the surface of a closed mesh; 0 if none is inside.

    Of points in its bounding box ``MOST_POINTS`` at most, evenly chosen.
    """
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    points = points[((points > low) & (points < high)).all(axis=1)]
    if not len(points):
        return 0.0
    points = points[:: -(-len(points) // MOST_POINTS)]
    corners = vertices[faces]
    inside = points[winding_numbers(points, corners, oriented=True) != 0]
    if not len(inside):
        return 0.0
    near = cKDTree(corners.mean(axis=1)).query(inside, k=min(NEAREST, len(corners)))[1].reshape(len(inside), -1)
    repeated = np.repeat(inside, near.shape[1], axis=0)
    squares = squared_distances(repeated, corners[near.ravel()]).reshape(near.shape)
    return float(np.sqrt(squares.min(axis=1).max()))


def _waking(bake: Bake, asleep: Sequence[str]) -> dict[str, int]:
    """Return for each object of ``asleep`` that ever moves the sample at which it first does."""
    found = {}
    for name in asleep:
        first = bake.vertices(name, bake.first_frame)
        for frame in range(bake.first_frame + 1, bake.last_frame + 1):
            if not np.array_equal(bake.vertices(name, frame), first):
                found[name] = frame - bake.first_frame
                break
    return found


def _energy_gain(bake: Bake, count: int, woken: Sequence[int]) -> tuple[Array | None, str]:
    """Return how far the energy (T,) is above its least value so far, and why it is unknown.

    Relative to the most that was ever in motion, stored or above the lowest place. woken: samples at which an object
    that slept begins to move; there, and one sample to both sides, the least value is taken anew.
    """
    path = bake.root / METRICS_FILE
    if not is_file(path):
        return None, "the bake has no metrics.json; bake again"
    rows = _metric_rows(read_json(path, folder=bake.root), str(path))
    if len(rows) < count:
        return None, f"metrics.json has {len(rows)} of {count} frames; bake again"
    kinetic, elastic, potential = np.array(rows[:count]).T
    total = kinetic + elastic + potential
    scale = float((kinetic + elastic + potential - potential.min()).max())
    least, gain = float(total[0]), np.zeros(count)
    for i, value in enumerate(total):
        near = any(abs(i - at) <= 1 for at in woken)
        least = float(value) if near else min(least, float(value))
        gain[i] = value - least
    return (gain / scale if scale > 0 else np.zeros(count)), ""


def _metric_rows(data: Any, where: str) -> list[tuple[float, float, float]]:
    """Return (kinetic, elastic, potential) in J of each frame. Raises InputError for another content."""
    names = ("kinetic_j", "elastic_j", "potential_j")
    frames = data.get("frames") if isinstance(data, dict) else None
    rows: list[tuple[float, float, float]] = []
    for frame in frames if isinstance(frames, list) else ():
        values = [frame.get(name) for name in names] if isinstance(frame, dict) else []
        good = [v for v in values if isinstance(v, int | float) and not isinstance(v, bool) and abs(v) < 1e300]
        if len(good) < len(names):
            raise InputError(f"{where}: frame {len(rows) + 1} has no {', '.join(names)}; bake again")
        rows.append((float(good[0]), float(good[1]), float(good[2])))
    if not rows:
        raise InputError(f"{where}: holds no frames; bake again")
    return rows
