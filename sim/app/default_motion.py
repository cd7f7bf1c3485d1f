# SPDX-License-Identifier: MIT
"""Default motion of a scene at rest: its freest objects hop or slide where they have room, whole and in the picture.

Reconstruction stays true to the photo, in which everything is at rest; this is asked for separately (``physgen run``
does, without a velocity, spin, moving override or ``--still``). Paths are ballistic, as the engine's are until the
first contact; what follows is bounded: bounces, and sliding by v² / (2 μ g) or rolling on. A coarse run of the engine
(``clip_check.py``) checks it where there is time for one. Nothing is drawn at random.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..scene.folder import Scene, load_scene
from ..scene.model import Ground, SceneModel, SceneObject, Vector
from .free_space import Clearance, PlateColours, Thing, outside_frame, thing_at_rest, with_supports

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

MOMENTS = 12
"""Instants of a flight at which it is checked."""

LEAST_RISE_PX = 0.01
"""Peak below which a hop is not worth showing, over the frame's shorter side."""

LEAN, MOST_LEAN = 0.2, math.radians(8.0)
"""Turn of a flight over the angle at which the object would tip over, and at most, so that it lands on an edge. More
makes it bounce onto its back, which the photo does not show."""

SHORTEST_S, CLIP_S, LONGEST_S = 1.5, 2.4, 4.0
"""Least, wanted and greatest length of the clip in seconds."""

SLOW = (1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0)
"""Times slower than real that are offered."""

ROLL = 0.5
"""Spin of what rolls, over that of rolling where it comes down: the ground makes up the rest."""

STEADY = math.radians(20.0)
"""Angle of tipping over, in the worst direction, below which a thing only hops straight up, and less high."""

UNSTEADY = 0.4
"""Share of the usual peak of what falls over easily: a book on its edge shows its blank back when it does."""

HEAVY_M = 0.5
"""Largest extent from which on a thing slides rather than hops: furniture."""

SLIDE = 0.6
"""Way of a push over the extent along it; shorter ones are tried in the shares of ``LOWER``."""

UPRIGHT = 1.3
"""Least push that a thing bears before it tips over its leading edge, over the friction of the ground."""

PUSHES = tuple((math.cos(n * math.pi / 8), math.sin(n * math.pi / 8)) for n in (0, 8, 1, 7, 15, 9, 14, 10, 13, 11, 12))
"""Ways of pushes, to the right of and away from the camera."""

HOLD_S = 0.3
"""Time that the clip goes on after the last motion, so that it is seen to be over."""


@dataclass(frozen=True, kw_only=True)
class Move:
    """The motion of one object: a hop, or a push along the ground.

    name: of the object. height: peak of its path over its rest, m; 0 of a push. aside: where it comes down or stops,
    (3,) m from its rest. start_s: when it begins. flight_s: from leaving to coming down, or to stopping. velocity,
    spin: m/s and rad/s at the beginning.
    """

    name: str
    height: float
    aside: Vector
    start_s: float
    flight_s: float
    velocity: Vector
    spin: Vector

    @property
    def slides(self) -> bool:
        """Whether it is a push."""
        return self.height == 0.0

    def slower(self, share: float) -> Move:
        """Return the same move with ``share`` of the speed: to the square of it as high and as far."""
        return dataclasses.replace(
            self,
            height=share**2 * self.height,
            aside=_vector(share**2 * np.asarray(self.aside)),
            flight_s=share * self.flight_s,
            velocity=_vector(share * np.asarray(self.velocity)),
            spin=_vector(share * np.asarray(self.spin)),
        )


@dataclass(frozen=True, kw_only=True)
class DefaultMotion:
    """A motion of a scene's objects, and the clip that suits it. Made by ``default_motion``.

    moves: empty where nothing has room. frames, fps, slow: of a bake that shows all of it (``BakeOptions``).
    action_s: seconds that it takes in the scene, about. sentence: what was chosen, for people.

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
    action_s: float = 0.0
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
        moved = scene if model == scene.model else scene.with_model(model)
        # A rehearsal of another motion may have saved that.
        return moved if load_scene(scene.root).model == model else moved.save()


def default_motion(
    scene: Scene,
    *,
    fps: float = 24.0,
    frames: int | None = None,
    slow: float | None = None,
    calm: Collection[str] = (),
    still: Collection[str] = (),
) -> DefaultMotion:
    """Return a motion for the objects of ``scene``, which are taken to be at rest: a hop each, as they have room.

    The peak follows from size, matter and the room above; the whole path stays in the picture and clear of other
    objects, and ends on ground that looks like that where the object stands. fps: of the clip; frames, slow: its
    length and how many times slower than real it is; None chooses them so that all of the action is shown, in two to
    three seconds. calm: names of objects that only hop straight up, low; still: of those that are left at rest.

    >>> import physgen
    >>> physgen.default_motion(physgen.load_scene("scene")).sentence  # doctest: +SKIP
    'none was given, so orange hops 6 cm high and 4 cm to the right; 4 times slower than real, 2.6 s'

    Raises InputError for a mesh or clean plate that cannot be read.
    """
    moves = _moves(scene, calm, still)
    action = max((_end(_thing_of(scene, move.name), move) for move in moves), default=0.0)
    return fitted(scene, moves, dict.fromkeys(SLOW, action), fps=fps, frames=frames, slow=slow)


def fitted(
    scene: Scene,
    moves: tuple[Move, ...],
    ends: Mapping[float, float],
    *,
    fps: float,
    frames: int | None = None,
    slow: float | None = None,
) -> DefaultMotion:
    """Return the motion ``moves`` of ``scene`` with a clip that ends when they do.

    ends: for each of ``SLOW`` the second in the scene after which nothing is seen to move, so slowly shown. fps,
    frames, slow: as of ``default_motion``.
    """
    if slow is None:
        room = CLIP_S if frames is None else frames / fps - HOLD_S
        fitting = [each for each in SLOW if each * ends[each] <= room] if moves else []
        slow = fitting[-1] if fitting else SLOW[0]
    action = ends[min(SLOW, key=lambda each: abs(each - slow))]
    if frames is None:
        seconds = min(max(slow * action + HOLD_S, SHORTEST_S), LONGEST_S) if moves else 2.0
        frames = max(2, math.ceil(seconds * fps))
    sentence = _sentence(scene.model, moves, frames / fps, slow)
    return DefaultMotion(moves=moves, frames=frames, fps=fps, slow=slow, action_s=action, sentence=sentence)


def _moves(scene: Scene, calm: Collection[str], still: Collection[str]) -> tuple[Move, ...]:
    model = scene.model
    gravity = float(np.linalg.norm(model.gravity))
    # A hop comes down where gravity points into the ground; elsewhere nothing simple is right.
    if model.ground is None or gravity < 0.5 or float(np.dot(model.gravity, model.ground.unit_normal)) > -0.9 * gravity:
        return ()
    stage = _Stage(scene, gravity, calm)
    chosen: list[Move] = []
    for _ in range(MOST_MOVES):
        begin = 0.0 if not chosen else chosen[-1].start_s + 0.7 * chosen[-1].flight_s
        done = [move.name for move in chosen] + list(still)
        found = [stage.best(thing, begin, chosen) for thing in stage.things if thing.item.name not in done]
        rated = [pair for pair in found if pair is not None]
        if not rated:
            break
        chosen.append(max(rated, key=lambda pair: pair[0])[1])
    return tuple(chosen)


class _Stage:
    """The objects of a scene, its camera, and the ground as the photo shows it."""

    def __init__(self, scene: Scene, gravity: float, calm: Collection[str]) -> None:
        self.scene, self.gravity, self.calm = scene, gravity, calm
        self.camera, self.ground = scene.model.camera, scene.model.ground_plane
        self.up = self.ground.unit_normal
        ahead = np.asarray(self.camera.world_from_camera, dtype=np.float64)[:3, 2]
        # Looking straight down, the picture's upper edge is ahead.
        ahead = ahead if abs(ahead @ self.up) < 0.999 else -np.asarray(self.camera.world_from_camera)[:3, 1]
        self.away = _unit(ahead - (ahead @ self.up) * self.up)
        self.right = np.cross(self.away, self.up)
        turns = np.arange(8) * math.pi / 4.0
        self.ways = [math.cos(turn) * self.right + math.sin(turn) * self.away for turn in turns]
        self.things = with_supports([thing_at_rest(scene, item, self.ground) for item in scene.objects], self.up)
        self.plate = PlateColours(scene)

    def best(self, thing: Thing, begin: float, before: Sequence[Move]) -> tuple[float, Move] | None:
        """Return the best move of ``thing`` beginning at ``begin`` s, after the moves ``before``, and its rating; None
        where it has no room.
        """
        if not thing.free:
            return None
        blocked = [self._path(self._thing(move.name), move).reshape(-1, 3) for move in before]
        still = [o.points for o in self.things if o is not thing and o.item.name not in {move.name for move in before}]
        around = Clearance(thing, [*still, *blocked])
        hops = [[self._tries(thing, share, begin) for share in LOWER]]
        pushes = [[self._pushes(thing, share, begin) for share in LOWER]]
        ways = [*pushes, *hops] if self._slides_better(thing) else [*hops, *pushes]
        if thing.item.name in self.calm:
            ways = hops
        if not before:
            # Something that fills the picture may leave it by a little, alone, at last; lower peaks only show less.
            ways.append([self._tries(thing, share, begin) for share in LOWER[::-1]])
        for number, kind in enumerate(ways):
            over = OVER if number == 2 else 0.0
            for moves in kind:
                tries = [(self._rating(thing, move, around, over), move) for move in moves]
                rated = [(rating, move) for rating, move in tries if rating is not None]
                if rated:
                    return max(rated, key=lambda pair: pair[0])
        return None

    def _steady(self, thing: Thing) -> bool:
        if thing.item.name in self.calm:
            return False
        return thing.round or min(thing.tips(way, self.up) for way in self.ways) >= STEADY

    def _slides_better(self, thing: Thing) -> bool:
        return not self._steady(thing) or thing.item.size_m >= HEAVY_M

    def _thing(self, name: str) -> Thing:
        return next(thing for thing in self.things if thing.item.name == name)

    def _tries(self, thing: Thing, share: float, begin: float) -> Iterator[Move]:
        steady = self._steady(thing)
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

    def _pushes(self, thing: Thing, share: float, begin: float) -> Iterator[Move]:
        """Yield pushes of what stands on the ground and neither rolls, flows nor tips over its leading edge."""
        if thing.carried or thing.round or _flows(thing.item):
            return
        friction = self._friction(thing)
        for right, away in PUSHES:
            way = right * self.right + away * self.away
            if math.tan(thing.tips(way, self.up)) < UPRIGHT * friction:
                continue
            far = SLIDE * share * thing.extent(way)
            speed = math.sqrt(2.0 * friction * self.gravity * far)
            yield Move(
                name=thing.item.name,
                height=0.0,
                aside=_vector(far * way),
                start_s=round(begin, 4),
                flight_s=speed / (friction * self.gravity),
                velocity=_vector(speed * way),
                spin=(0.0, 0.0, 0.0),
            )

    def _friction(self, thing: Thing) -> float:
        return max(0.1, math.sqrt(self.ground.friction * _own_friction(thing.item, self.ground)))

    def _spin(self, thing: Thing, way: Array, shift: float, flight: float) -> Array:
        """Return the spin (3,) rad/s: forwards over the way it goes, as far as it will not fall over."""
        if thing.carried or _flows(thing.item):
            return np.zeros(3)
        axis = np.cross(self.up, way)
        if thing.round:
            return np.asarray(ROLL * axis * (shift / flight) / max(0.5 * thing.tall, 1e-9))
        # Leaning in the picture's plane shows most and turns nothing unseen to the camera.
        aslant = abs(float(way @ self.right)) / float(np.linalg.norm(way))
        return np.asarray(aslant * axis * min(LEAN * thing.tips(way, self.up), MOST_LEAN) / flight)

    def _path(self, thing: Thing, move: Move) -> Array:
        """Return the hull of ``thing`` (MOMENTS, K, 3) at instants of its flight, the last one where it comes down."""
        times = np.linspace(0.0, move.flight_s, MOMENTS)
        if move.slides:
            # Where friction is less than thought it goes on a little.
            gone = 1.2 * (1.0 - (1.0 - times / move.flight_s) ** 2)
            return np.asarray(thing.hull + gone[:, None, None] * np.asarray(move.aside))
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

    def _rating(self, thing: Thing, move: Move, around: Clearance, over: float) -> float | None:
        """Return how much ``move`` shows, in the thing's own size, less what speaks against it; None: has no room.

        over: share of its size in the picture by which it may leave the frame.
        """
        path = self._path(thing, move)
        after = path[-1] + self._run_out(thing, move)
        whole = np.concatenate([path, after[None]])
        pixels = self.camera.project(whole)[..., :2]
        size = float(np.ptp(pixels[0], axis=0).max())
        outside = outside_frame(self.camera, whole, MARGIN if over == 0 else 0.0)
        beyond = outside.max()
        # What stands in the margin already may go on along it; what the frame cuts would show where.
        cut = not over and outside_frame(self.camera, whole[:1], 0.0)[0] > 0
        if cut or beyond > outside[0] + over * size or not around.keeps(whole):
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

    def _run_out(self, thing: Thing, move: Move) -> Array:
        """Return how far (3,) it may go on after it came down, m."""
        aside = np.asarray(move.aside)
        speed = float(np.linalg.norm(aside)) / move.flight_s
        if speed == 0.0 or move.slides:
            return np.zeros(3)
        friction = self._friction(thing)
        far = speed * 2.0 * move.flight_s if thing.round else speed**2 / (2.0 * friction * self.gravity)
        return np.asarray(_unit(aside) * far)


def _flows(item: SceneObject) -> bool:
    return item.material.law in ("sand", "snow", "fluid")


def _own_friction(item: SceneObject, ground: Ground) -> float:
    if item.friction is not None:
        return item.friction
    return ground.friction if item.roughness is None else 0.05 + 0.9 * item.roughness


def _peak(thing: Thing) -> float:
    """Return the height in m to which a thing like this hops."""
    sizes, shares = zip(*HEIGHTS, strict=True)
    share = float(np.interp(math.log(thing.item.size_m), np.log(sizes), shares))
    matter = 0.35 if _flows(thing.item) else 0.75 if thing.item.material.law == "rigid" else 1.0
    return matter * share * math.sqrt(thing.item.size_m * max(thing.tall, 0.1 * thing.item.size_m))


def _thing_of(scene: Scene, name: str) -> Thing:
    return thing_at_rest(scene, next(item for item in scene.objects if item.name == name), scene.model.ground_plane)


def _end(thing: Thing, move: Move) -> float:
    """Return when ``move`` is over, about: flight, bounces, and a wobble that takes longer the larger the thing is.

    Rigid things hardly bounce here; what is round rolls on.
    """
    wobble = 0.35 * math.sqrt(thing.item.size_m / 0.15)
    bounces = 1.0 if move.slides else 1.7
    if thing.item.material.law == "rigid":
        wobble = 0.1 * wobble
        bounces = 1.0 if move.slides else 2.5 if thing.round else 1.1
    return move.start_s + bounces * move.flight_s + wobble


def _sentence(model: SceneModel, moves: Sequence[Move], seconds: float, slow: float) -> str:
    change = "change it with --velocity, --spin, --slow, --frames; --still leaves everything at rest"
    if not moves:
        return f"none was given, and no object has room for one within the picture, so nothing moves; {change}"
    parts = [f"{move.name} {_what(model, move)}" for move in moves]
    clock = "at real speed" if slow == 1.0 else f"{slow:g} times slower than real"
    return f"none was given, so {', then '.join(parts)}; {clock}, {seconds:.2g} s. {change[0].upper()}{change[1:]}"


def _what(model: SceneModel, move: Move) -> str:
    if move.slides:
        return f"slides {_where(model, move)}"
    return f"hops {_length(move.height)} high" + (f" and {_where(model, move)}" if any(move.aside) else "")


def _where(model: SceneModel, move: Move) -> str:
    aside = np.asarray(move.aside)
    turn = np.asarray(model.camera.world_from_camera)[:3, :3]
    right, away = float(aside @ turn[:, 0]), float(aside @ turn[:, 2])
    to = "to the right" if right > 0 else "to the left"
    if abs(right) < abs(away):
        to = "away from the camera" if away > 0 else "towards the camera"
    return f"{_length(float(np.linalg.norm(aside)))} {to}"


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
