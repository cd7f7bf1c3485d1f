# SPDX-License-Identifier: MIT
"""Default motion of a scene at rest: its freest objects hop where they have room, whole and in the picture.

Reconstruction stays true to the photo, in which everything is at rest; this is asked for separately (``physgen run``
does, without a velocity, spin, moving override or ``--still``). Paths are ballistic, as the engine's are until the
first contact; what follows is bounded: bounces, and sliding by v² / (2 μ g) or rolling on. Nothing is drawn at random.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..scene.folder import Scene, save_scene
from ..scene.meshes import load_object_mesh
from ..scene.model import Camera, Ground, SceneModel, SceneObject, Vector

Array = NDArray[np.float64]

MOST_MOVES = 3
"""Objects set in motion at most, one after another."""

HEIGHTS = ((0.05, 0.8), (0.3, 0.5), (1.0, 0.2), (3.0, 0.1))
"""Largest extent in m → peak of a hop over the mean of extent and height: a crate does not jump as a marble does."""

LOWER = (1.0, 0.8, 0.6, 0.45, 0.3, 0.2)
ASIDE = (0.5, 0.25, 0.0)
"""Shares of the peak, and of the object's width, that are tried in turn."""

DIRECTIONS = ((1.0, 0.0), (-1.0, 0.0), (0.8, -0.6), (-0.8, -0.6), (0.0, -1.0))
"""Ways to go, to the right of and away from the camera. Never away: what stands behind is not known."""

MARGIN = 0.025
"""Share of the frame's shorter side that stays free around what moves."""

OVER = 0.12
"""Share of its height in the picture by which a thing may leave the frame where there is no room for anything else."""

FINE_POINTS = 4000
"""Points of a surface that distances are measured to."""

MOMENTS = 12
"""Instants of a flight at which it is checked."""

LEAST_RISE_PX = 0.01
"""Peak below which a hop is not worth showing, over the frame's shorter side."""

LEAN, MOST_LEAN = 0.2, math.radians(8.0)
"""Turn of a flight over the angle at which the object would tip over, and at most, so that it lands on an edge. More
makes it bounce onto its back, which the photo does not show."""

CLIP_S, LONGEST_S = 2.4, 4.0
"""Wanted and greatest length of the clip in seconds."""

SLOW = (1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0)
"""Times slower than real that are offered."""

ROUND = 0.85
"""Sphericity 36 π V² / A³ of the hull above which a thing rolls: 1 for a ball, 0.67 for a tin, 0.52 for a cube."""

ROLL = 0.5
"""Spin of what rolls, over that of rolling where it comes down: the ground makes up the rest."""

STEADY = math.radians(20.0)
"""Angle of tipping over, in the worst direction, below which a thing only hops straight up, and less high."""

UNSTEADY = 0.4
"""Share of the usual peak of what falls over easily: a book on its edge shows its blank back when it does."""


@dataclass(frozen=True, kw_only=True)
class Move:
    """The motion of one object.

    name: of the object. height: peak of its path over its rest, m. aside: where it comes down, (3,) m from its rest.
    start_s: when it begins. flight_s: from leaving to coming down. velocity, spin: m/s and rad/s at the beginning.
    """

    name: str
    height: float
    aside: Vector
    start_s: float
    flight_s: float
    velocity: Vector
    spin: Vector


@dataclass(frozen=True, kw_only=True)
class DefaultMotion:
    """A motion of a scene's objects, and the clip that suits it. Made by ``default_motion``.

    moves: empty where nothing has room. frames, fps, slow: of a bake that shows all of it (``BakeOptions``).
    sentence: what was chosen, for people.

    >>> import physgen
    >>> scene = physgen.load_scene("scene")  # doctest: +SKIP
    >>> motion = physgen.default_motion(scene)  # doctest: +SKIP
    >>> scene = motion.applied(scene)  # doctest: +SKIP
    >>> options = physgen.BakeOptions(frames=motion.frames, fps=motion.fps, slow=motion.slow)  # doctest: +SKIP
    """

    moves: tuple[Move, ...]
    frames: int
    fps: float
    slow: float
    sentence: str

    def applied(self, scene: Scene) -> Scene:
        """Return ``scene`` with the objects' velocities, spins and start times, saved."""
        moves = {move.name: move for move in self.moves}
        objects = tuple(
            item
            if (move := moves.get(item.name)) is None
            else dataclasses.replace(item, velocity=move.velocity, spin=move.spin, start_time=move.start_s)
            for item in scene.objects
        )
        model = dataclasses.replace(scene.model, objects=objects)
        return scene if model == scene.model else save_scene(scene.root, model)


def default_motion(
    scene: Scene, *, fps: float = 24.0, frames: int | None = None, slow: float | None = None
) -> DefaultMotion:
    """Return a motion for the objects of ``scene``, which are taken to be at rest: a hop each, as they have room.

    The peak follows from size, matter and the room above; the whole path stays in the picture and clear of other
    objects, and ends on ground that looks like that where the object stands. fps: of the clip; frames, slow: its
    length and how many times slower than real it is; None chooses them so that all of the action is shown, in two to
    three seconds.

    >>> import physgen
    >>> physgen.default_motion(physgen.load_scene("scene")).sentence  # doctest: +SKIP
    'none was given, so orange hops 6 cm high and 4 cm to the right; 4 times slower than real, 2.6 s'

    Raises InputError for a mesh or clean plate that cannot be read.
    """
    moves = _moves(scene)
    action = max((_end(_object(scene.model, move.name), move) for move in moves), default=0.0)
    slow = slow if slow is not None else _slowness(action, None if frames is None else frames / fps)
    if frames is None:
        seconds = min(max(1.1 * action * slow, 2.0), LONGEST_S) if moves else 2.0
        frames = max(2, round(seconds * fps))
    return DefaultMotion(
        moves=moves, frames=frames, fps=fps, slow=slow, sentence=_sentence(scene.model, moves, frames / fps, slow)
    )


def _slowness(action_s: float, clip_s: float | None) -> float:
    """Return how many times slower ``action_s`` seconds are to be shown: the most that fits into the clip."""
    if action_s <= 0:
        return 1.0
    fitting = [slow for slow in SLOW if slow * action_s <= (CLIP_S if clip_s is None else clip_s / 1.1)]
    return fitting[-1] if fitting else 1.0


def _object(model: SceneModel, name: str) -> SceneObject:
    return next(item for item in model.objects if item.name == name)


@dataclass(frozen=True, eq=False)
class _Thing:
    """An object as it rests.

    hull: (K, 3) corners of its convex hull, with points of its surface in between; points: (N, 3) of its surface;
    centre: (3,); base: (B, 3) what it stands on; heights: of lowest and highest point over the ground; round: whether
    it rolls; carried: whether it stands on another object; free: whether it may be moved.
    """

    item: SceneObject
    hull: Array
    points: Array
    centre: Array
    base: Array
    heights: tuple[float, float]
    round: bool
    carried: bool = False
    free: bool = True

    @property
    def tall(self) -> float:
        """Height in m."""
        return self.heights[1] - self.heights[0]

    def extent(self, direction: Array) -> float:
        """Return the extent in m along the unit vector ``direction`` (3,)."""
        return float(np.ptp(self.hull @ direction))

    def tips(self, way: Array, up: Array) -> float:
        """Return by how many radians it leans, at most, along the level unit vector ``way`` before it falls over."""
        across = np.cross(up, way)
        # Where the base ends along a narrow strip in that direction; a narrow base ends soon, whatever its length.
        foot = (self.base - self.centre) @ np.stack([way, across], axis=1)
        ahead = foot[foot[:, 0] > 0]
        if len(ahead) == 0:
            return 0.0
        turns = np.abs(np.arctan2(ahead[:, 1], ahead[:, 0]))
        reach = float(np.linalg.norm(ahead[turns <= max(0.3, float(turns.min()))], axis=1).max())
        return math.atan2(reach, max(float((self.centre - self.base.mean(axis=0)) @ up), 1e-9))


def _moves(scene: Scene) -> tuple[Move, ...]:
    model = scene.model
    gravity = float(np.linalg.norm(model.gravity))
    # A hop comes down where gravity points into the ground; elsewhere nothing simple is right.
    if model.ground is None or gravity < 0.5 or float(np.dot(model.gravity, model.ground.unit_normal)) > -0.9 * gravity:
        return ()
    stage = _Stage(scene, gravity)
    chosen: list[Move] = []
    for _ in range(MOST_MOVES):
        begin = 0.0 if not chosen else chosen[-1].start_s + 0.7 * chosen[-1].flight_s
        done = [move.name for move in chosen]
        found = [stage.best(thing, begin, chosen) for thing in stage.things if thing.item.name not in done]
        rated = [pair for pair in found if pair is not None]
        if not rated:
            break
        chosen.append(max(rated, key=lambda pair: pair[0])[1])
    return tuple(chosen)


class _Stage:
    """The objects of a scene, its camera, and the ground as the photo shows it."""

    def __init__(self, scene: Scene, gravity: float) -> None:
        self.scene, self.gravity = scene, gravity
        self.camera, self.ground = scene.model.camera, scene.model.ground_plane
        self.up = self.ground.unit_normal
        ahead = np.asarray(self.camera.world_from_camera, dtype=np.float64)[:3, 2]
        # Looking straight down, the picture's upper edge is ahead.
        ahead = ahead if abs(ahead @ self.up) < 0.999 else -np.asarray(self.camera.world_from_camera)[:3, 1]
        self.away = _unit(ahead - (ahead @ self.up) * self.up)
        self.right = np.cross(self.away, self.up)
        turns = np.arange(8) * math.pi / 4.0
        self.ways = [math.cos(turn) * self.right + math.sin(turn) * self.away for turn in turns]
        self.things = _with_supports([_thing(scene, item, self.ground) for item in scene.objects], self.up)
        self.plate = _Plate(scene)

    def best(self, thing: _Thing, begin: float, before: Sequence[Move]) -> tuple[float, Move] | None:
        """Return the best move of ``thing`` beginning at ``begin`` s, after the moves ``before``, and its rating; None
        where it has no room.
        """
        if not thing.free:
            return None
        blocked = [self._path(self._thing(move.name), move).reshape(-1, 3) for move in before]
        still = [o.points for o in self.things if o is not thing and o.item.name not in {move.name for move in before}]
        around = _Clearance(thing, [*still, *blocked])
        # Something that fills the picture may leave it by a little, alone, at last; lower peaks only show less.
        for over, shares in ((0.0, LOWER), (OVER, LOWER[::-1])) if not before else ((0.0, LOWER),):
            for share in shares:
                tries = [(self._rating(thing, move, around, over), move) for move in self._tries(thing, share, begin)]
                rated = [(rating, move) for rating, move in tries if rating is not None]
                if rated:
                    return max(rated, key=lambda pair: pair[0])
        return None

    def _thing(self, name: str) -> _Thing:
        return next(thing for thing in self.things if thing.item.name == name)

    def _tries(self, thing: _Thing, share: float, begin: float) -> Iterator[Move]:
        steady = thing.round or min(thing.tips(way, self.up) for way in self.ways) >= STEADY
        height = share * _peak(thing) * (1.0 if steady else UNSTEADY)
        rise = math.sqrt(2.0 * self.gravity * height)
        flight = 2.0 * rise / self.gravity
        for aside in (0.0,) if thing.carried or _flows(thing.item) or not steady else ASIDE:
            for right, away in DIRECTIONS if aside else ((1.0, 0.0), (-1.0, 0.0)):
                way = right * self.right + away * self.away
                shift = aside * thing.extent(way) * way
                lean = self._spin(thing, way, float(np.linalg.norm(shift)), flight)
                spin = lean if steady else np.zeros(3)
                yield Move(
                    name=thing.item.name,
                    height=height,
                    aside=_vector(shift),
                    start_s=round(begin, 4),
                    flight_s=flight,
                    velocity=_vector(rise * self.up + shift / flight),
                    spin=_vector(spin),
                )

    def _spin(self, thing: _Thing, way: Array, shift: float, flight: float) -> Array:
        """Return the spin (3,) rad/s: forwards over the way it goes, as far as it will not fall over."""
        if thing.carried or _flows(thing.item):
            return np.zeros(3)
        axis = np.cross(self.up, way)
        if thing.round:
            return np.asarray(ROLL * axis * (shift / flight) / max(0.5 * thing.tall, 1e-9))
        # Leaning in the picture's plane shows most and turns nothing unseen to the camera.
        aslant = abs(float(way @ self.right)) / float(np.linalg.norm(way))
        return np.asarray(aslant * axis * min(LEAN * thing.tips(way, self.up), MOST_LEAN) / flight)

    def _path(self, thing: _Thing, move: Move) -> Array:
        """Return the hull of ``thing`` (MOMENTS, K, 3) at instants of its flight, the last one where it comes down."""
        times = np.linspace(0.0, move.flight_s, MOMENTS)
        spin = np.asarray(move.spin)
        rate = float(np.linalg.norm(spin))
        axis = spin / rate if rate > 0 else spin
        local = thing.hull - thing.centre
        found = []
        for t in times:
            angle = rate * t
            turned = local * math.cos(angle) + np.cross(axis, local) * math.sin(angle)
            turned = turned + np.outer(local @ axis, axis) * (1.0 - math.cos(angle))
            place = thing.centre + np.asarray(move.velocity) * t - 0.5 * self.gravity * t * t * self.up
            found.append(turned + place)
        return np.array(found)

    def _rating(self, thing: _Thing, move: Move, around: _Clearance, over: float) -> float | None:
        """Return how much ``move`` shows, in the thing's own size, less what speaks against it; None: has no room.

        over: share of its size in the picture by which it may leave the frame.
        """
        path = self._path(thing, move)
        after = path[-1] + self._run_out(thing, move)
        whole = np.concatenate([path, after[None]])
        pixels = self.camera.project(whole)[..., :2]
        size = float(np.ptp(pixels[0], axis=0).max())
        beyond = _outside(self.camera, whole, MARGIN if over == 0 else 0.0).max()
        if beyond > _outside(self.camera, whole[:1], 0.0)[0] + over * size or not around.keeps(whole):
            return None
        rise = float(np.abs(pixels[MOMENTS // 2] - pixels[0]).max())
        if rise < LEAST_RISE_PX * min(self.camera.width, self.camera.height):
            return None
        shown = min(rise / size, 1.0) + 0.5 * min(float(np.linalg.norm(move.aside)) / thing.item.size_m, 0.5)
        foot = thing.hull - np.outer(self.ground.heights(thing.hull), self.up)
        unlike = self.plate.difference(self.camera, foot, foot + np.asarray(move.aside)) if any(move.aside) else 0.0
        # Of equal ones the way towards the middle, where there is more to see.
        middle = float(np.linalg.norm(pixels[-1].mean(axis=0) - (0.5 * self.camera.width, 0.5 * self.camera.height)))
        return shown - 0.6 * unlike - 0.05 * middle / self.camera.width - 2.0 * (float(beyond) / size if over else 0.0)

    def _run_out(self, thing: _Thing, move: Move) -> Array:
        """Return how far (3,) it may go on after it came down, m."""
        aside = np.asarray(move.aside)
        speed = float(np.linalg.norm(aside)) / move.flight_s
        if speed == 0.0:
            return np.zeros(3)
        friction = max(0.1, math.sqrt(self.ground.friction * _own_friction(thing.item, self.ground)))
        far = speed * 2.0 * move.flight_s if thing.round else speed**2 / (2.0 * friction * self.gravity)
        return np.asarray(_unit(aside) * far)


def _outside(camera: Camera, points: Array, margin: float) -> NDArray[np.float64]:
    """Return how far (T,) in pixels the farthest of ``points`` (T, K, 3) lies outside the frame less its margin."""
    seen = camera.project(points)
    edge = margin * min(camera.width, camera.height)
    x, y = seen[..., 0], seen[..., 1]
    over = np.maximum.reduce([edge - x, x - camera.width + edge, edge - y, y - camera.height + edge])
    over = np.where(seen[..., 2] > 0, over, np.inf)
    return np.asarray(np.maximum(over.max(axis=-1), 0.0))


class _Clearance:
    """How near a thing may come to others: as near as it rests, or a twentieth of its size."""

    def __init__(self, thing: _Thing, others: Sequence[Array]) -> None:
        from scipy.spatial import cKDTree

        self._trees = [cKDTree(points) for points in others]
        self._boxes = [(points.min(axis=0), points.max(axis=0)) for points in others]
        wanted = 0.05 * thing.item.size_m
        self._least = [min(wanted, 0.9 * float(tree.query(thing.points)[0].min())) for tree in self._trees]

    def keeps(self, path: Array) -> bool:
        """Return whether the thing stays clear along the hulls ``path`` (T, K, 3)."""
        for tree, (low, high), least in zip(self._trees, self._boxes, self._least, strict=True):
            near = (path.max(axis=1) > low - least).all(axis=1) & (path.min(axis=1) < high + least).all(axis=1)
            for hull in path[near]:
                if float(tree.query(hull)[0].min()) < least:
                    return False
        return True


class _Plate:
    """Colours of the clean plate, in a perceptual space."""

    SIDE = 320
    """Longest side in pixels at which it is compared."""

    def __init__(self, scene: Scene) -> None:
        self._image: NDArray[np.float32] | None = None
        if scene.model.background is None:
            return
        import cv2

        from ..composite.srgb import read_rgb

        image = read_rgb(scene.file(scene.model.background))
        scale = min(1.0, self.SIDE / max(image.shape[:2]))
        small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        lab = cv2.cvtColor(small.astype(np.float32) / 255.0, cv2.COLOR_RGB2LAB)
        self._image = np.asarray(lab, dtype=np.float32)

    def difference(self, camera: Camera, here: Array, there: Array) -> float:
        """Return how unlike the ground at the points ``here`` and ``there`` (K, 3) looks, 0 to 1: ΔE 40 is 1."""
        if self._image is None:
            return 0.0
        means = [self._colours(camera, points) for points in (here, there)]
        return min(1.0, float(np.linalg.norm(np.mean(means[0], axis=0) - np.mean(means[1], axis=0))) / 40.0)

    def _colours(self, camera: Camera, points: Array) -> NDArray[np.float32]:
        assert self._image is not None
        inner = np.concatenate([points, 0.5 * (points + points.mean(axis=0))])
        rows, columns = self._image.shape[:2]
        pixels = camera.project(inner)[:, :2] * (columns / camera.width, rows / camera.height)
        x, y = np.clip(pixels, 0, (columns - 1, rows - 1)).astype(int).T
        return self._image[y, x]


def _thing(scene: Scene, item: SceneObject, ground: Ground) -> _Thing:
    from scipy.spatial import ConvexHull, QhullError
    from trimesh.remesh import subdivide_to_size

    mesh = load_object_mesh(scene, item)
    vertices, points = mesh.vertices, mesh.vertices
    if len(vertices) < FINE_POINTS:
        # A few large faces: their corners alone do not tell where they are.
        points = np.asarray(subdivide_to_size(vertices, mesh.faces, max_edge=0.04 * item.size_m, max_iter=20)[0])
    try:
        hull = ConvexHull(vertices)
        corners, sphericity = vertices[hull.vertices], 36.0 * math.pi * hull.volume**2 / hull.area**3
    except QhullError:
        # A flat sheet.
        corners, sphericity = vertices, 0.0
    corners = corners[:: max(1, len(corners) // 300)]
    heights = ground.heights(vertices)
    held = bool(item.pins) or item.goal_stiffness > 0 or item.role != "dynamic" or item.splats is not None
    return _Thing(
        item=item,
        hull=np.concatenate([corners, points[:: max(1, len(points) // 300)]]),
        points=points[:: max(1, len(points) // FINE_POINTS)],
        centre=vertices.mean(axis=0),
        base=vertices[heights <= heights.min() + 0.06 * np.ptp(heights)],
        heights=(float(heights.min()), float(heights.max())),
        round=bool(sphericity > ROUND),
        free=not held,
    )


def _with_supports(things: Sequence[_Thing], up: Array) -> list[_Thing]:
    """Return ``things``, knowing what stands on another and what may not move because something stands on it."""
    found = []
    for thing in things:
        slack = 0.1 * thing.tall
        above = [
            other
            for other in things
            if other is not thing
            and other.heights[0] > slack + 0.02 * other.item.size_m
            and abs(other.heights[0] - thing.heights[1]) < 0.25 * max(thing.tall, other.tall)
            and _share_floor(thing, other, up)
        ]
        carried = thing.heights[0] > 0.05 * thing.item.size_m
        found.append(dataclasses.replace(thing, carried=carried, free=thing.free and not above))
    return found


def _share_floor(a: _Thing, b: _Thing, up: Array) -> bool:
    across = np.eye(3) - np.outer(up, up)
    first, second = a.hull @ across, b.hull @ across
    return bool((first.max(axis=0) >= second.min(axis=0)).all() and (second.max(axis=0) >= first.min(axis=0)).all())


def _flows(item: SceneObject) -> bool:
    return item.material.law in ("sand", "snow", "fluid")


def _own_friction(item: SceneObject, ground: Ground) -> float:
    if item.friction is not None:
        return item.friction
    return ground.friction if item.roughness is None else 0.05 + 0.9 * item.roughness


def _peak(thing: _Thing) -> float:
    """Return the height in m to which a thing like this hops."""
    sizes, shares = zip(*HEIGHTS, strict=True)
    share = float(np.interp(math.log(thing.item.size_m), np.log(sizes), shares))
    matter = 0.35 if _flows(thing.item) else 0.75 if thing.item.material.law == "rigid" else 1.0
    return matter * share * math.sqrt(thing.item.size_m * max(thing.tall, 0.1 * thing.item.size_m))


def _end(item: SceneObject, move: Move) -> float:
    """Return when ``move`` is over, about: flight, bounces, and a wobble that takes longer the larger the thing is."""
    wobble = 0.35 * math.sqrt(item.size_m / 0.15)
    return move.start_s + 1.7 * move.flight_s + (wobble if item.material.law != "rigid" else 0.6 * wobble)


def _sentence(model: SceneModel, moves: Sequence[Move], seconds: float, slow: float) -> str:
    change = "change it with --velocity, --spin, --slow, --frames; --still leaves everything at rest"
    if not moves:
        return f"none was given, and no object has room for one within the picture, so nothing moves; {change}"
    said = [f"{move.name} hops {_length(move.height)} high{_where(model, move)}" for move in moves]
    clock = "at real speed" if slow == 1.0 else f"{slow:g} times slower than real"
    return f"none was given, so {', then '.join(said)}; {clock}, {seconds:.2g} s. {change[0].upper()}{change[1:]}"


def _where(model: SceneModel, move: Move) -> str:
    aside = np.asarray(move.aside)
    far = float(np.linalg.norm(aside))
    if far == 0:
        return ""
    turn = np.asarray(model.camera.world_from_camera)[:3, :3]
    right, away = float(aside @ turn[:, 0]), float(aside @ turn[:, 2])
    sideways = "to the right" if right > 0 else "to the left"
    return f" and {_length(far)} {sideways if abs(right) >= abs(away) else 'towards the camera'}"


def _length(metres: float) -> str:
    if metres >= 1.0:
        return f"{metres:.2g} m"
    return f"{100 * metres:.2g} cm" if metres >= 0.01 else f"{1000 * metres:.2g} mm"


def _unit(vector: Array) -> Array:
    return np.asarray(vector / np.linalg.norm(vector))


def _vector(values: Array) -> Vector:
    """Return ``values`` (3,) to 6 digits, so that a scene folder says what is meant, the same on every machine."""
    x, y, z = (float(f"{value:.6g}") + 0.0 for value in values)
    return x, y, z


MOTION_FIELDS = (
    *("velocity", "spin", "velocity_keys", "acceleration", "start_time", "motion", "pin_motion", "pins", "role"),
    *("gravity", "gravity_track"),
)
"""Fields of objects and scene that say how things move."""


def tells_motion(velocities: Sequence[Vector], spins: Sequence[Vector], overrides: Sequence[str]) -> bool:
    """Return whether a request says itself how things move: velocities or spins (rest as well), or an override of what
    moves an object or of gravity.
    """
    fields = [text.partition("=")[0].rpartition(".")[2].strip() for text in overrides]
    return bool(velocities or spins) or any(name in MOTION_FIELDS for name in fields)
