# SPDX-License-Identifier: MIT
"""The stage of a default motion: which hops and pushes its things have room for, and which of them shows most.

Paths are ballistic, as the engine's are until the first contact; what follows is bounded: bounces, and sliding by
v² / (2 μ g) or rolling on.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Collection, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from ..scene.folder import Scene
from ..scene.model import Ground, SceneObject
from .free_space import (
    Clearance,
    PlateColours,
    Thing,
    hidden_share,
    outside_frame,
    rotated,
    thing_at_rest,
    with_supports,
)
from .moves import Move, rounded, unit

Array = NDArray[np.float64]

HEIGHTS = ((0.05, 1.2), (0.3, 0.75), (1.0, 0.3), (3.0, 0.15))
"""Largest extent in m → peak of a hop over the mean of extent and height: a crate does not jump as a marble does."""

LOWER = (1.0, 0.8, 0.6, 0.45, 0.3, 0.2, 0.13)
ASIDE = (0.6, 0.3, 0.15, 0.0)
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

LEAN, MOST_LEAN = 0.2, math.radians(4.0)
"""Turn of a flight over the angle at which the object would tip over, and at most, so that it lands on an edge. More
makes it bounce onto its back, which the photo does not show."""

LANDING = 0.4
"""Speed aside with which a thing may come down, over that at which it would fall over its edge."""

TURN = math.radians(20.0)
"""Turn about the vertical of what hops or slides, so that it is seen to be a body; more would show its back."""

TURNS = (1.0, 0.5, 0.0)
"""Shares of it that are tried: what turns is wider, and may have no room, or shows a side that the photo does not."""

GUESSED = 0.05
"""Share of a thing's picture that may be of such sides after a move, beyond what was at rest (``Surface.guessed``)."""

SLIDE_TURN = math.radians(15.0)
"""The same of a push: it is seen longer, and friction that stops a turn brakes the way less."""

HIDDEN = 0.12
"""Share of a thing's picture that another may come to hide, beyond what it hid at rest."""

STEADY = math.radians(20.0)
"""Angle of tipping over, in the worst direction, below which a thing only hops straight up, and less high."""

FIRM = math.radians(30.0)
"""The same below which a thing neither turns nor leans in a hop: it comes down on a corner then, and falls or slides.
"""

UNSTEADY = 0.4
"""Share of the usual peak of what falls over easily: a book on its edge shows its blank back when it does."""

HEAVY_M = 0.5
"""Largest extent from which on a thing slides rather than hops: furniture."""

SLIDE = 0.6
"""Way of a push over the extent along it; shorter ones are tried in the shares of ``LOWER``."""

UPRIGHT = 1.5
"""Least push that a thing bears before it tips over its leading edge, over the friction of the ground."""

PUSHES = tuple((math.cos(n * math.pi / 8), math.sin(n * math.pi / 8)) for n in (0, 8, 1, 7, 15, 9, 14, 10, 13, 11, 12))
"""Ways of pushes, to the right of and away from the camera."""


class Stage:
    """The objects of a scene, its camera, and the ground as the photo shows it."""

    def __init__(self, scene: Scene, gravity: float, calm: Collection[str] = (), plain: Collection[str] = ()) -> None:
        self.scene, self.gravity, self.calm, self.plain = scene, gravity, calm, plain
        self.camera, self.ground = scene.model.camera, scene.model.ground_plane
        self.up = self.ground.unit_normal
        ahead = np.asarray(self.camera.world_from_camera, dtype=np.float64)[:3, 2]
        # Looking straight down, the picture's upper edge is ahead.
        ahead = ahead if abs(ahead @ self.up) < 0.999 else -np.asarray(self.camera.world_from_camera)[:3, 1]
        self.away = unit(ahead - (ahead @ self.up) * self.up)
        self.right = np.cross(self.away, self.up)
        turns = np.arange(8) * math.pi / 4.0
        self.ways = [math.cos(turn) * self.right + math.sin(turn) * self.away for turn in turns]
        self.things = with_supports([thing_at_rest(scene, item, self.ground) for item in scene.objects], self.up)
        self.plate = PlateColours(scene)
        self.rest = {thing.item.name: thing for thing in self.things}
        self._trails: dict[str, Array] = {}
        self._slack: dict[str, Array] = {}
        self._slid: dict[str, bool] = {}

    def take(self, move: Move) -> None:
        """Have ``move`` done: the things are from now on where it leaves them."""
        thing = self.thing(move.name)
        path = self._path(thing, move)
        farthest = self._run_out(thing, move)
        # It may stop anywhere on its run-out; until it does, the way there is not free for others.
        self._trails.pop(move.name, None)
        self._trails[move.name] = np.concatenate([path[-1] + share * farthest for share in (0.0, 0.5, 1.0)])
        self._slack[move.name] = 0.5 * farthest
        self._slid[move.name] = move.slides
        gone = thing.turned(self._turn(move), self.up).shifted(np.asarray(move.aside) + self._slack[move.name])
        self.things = [gone if other is thing else other for other in self.things]

    def best(self, thing: Thing) -> tuple[float, Move] | None:
        """Return the best move of ``thing`` and its rating; None where it has no room. When is not said: at 0."""
        name = thing.item.name
        if not thing.free or (self._again(thing) and name in self.calm):
            return None
        others = [other for other in self.things if other.item.name != name]
        around = Clearance(thing, [self._trails.get(other.item.name, other.points) for other in others])
        hops = [[self._tries(thing, share) for share in LOWER]]
        pushes = [[self._pushes(thing, share) for share in LOWER]]
        ways = [*pushes, *hops] if self._slides_better(thing) else [*hops, *pushes]
        if name in self.calm:
            ways = hops
        elif self._rocks(thing):
            # A push while it rocks trips it, so only where it cannot hop; a rehearsal drops it if it falls.
            ways = [*hops, *pushes]
        if set(self._trails) <= {name}:
            # Something that fills the picture may leave it by a little, alone, at last; lower peaks only show less.
            ways.append([self._tries(thing, share) for share in LOWER[::-1]])
        for number, kind in enumerate(ways):
            over = OVER if number == 2 else 0.0
            for moves in kind:
                tries = [(self._rating(thing, move, around, others, over), move) for move in moves]
                rated = [(rating, move) for rating, move in tries if rating is not None]
                if rated:
                    return max(rated, key=lambda pair: pair[0])
        return None

    def _steady(self, thing: Thing) -> bool:
        if thing.item.name in self.calm:
            return False
        return thing.round or self._tips(thing) >= STEADY

    def firm(self, thing: Thing) -> bool:
        """Return whether ``thing`` stands firmly in every direction."""
        return thing.item.name not in self.calm and self._tips(thing) >= FIRM

    def _tips(self, thing: Thing) -> float:
        """Return the angle in radians at which ``thing`` falls over, in the worst direction."""
        return min(thing.tips(way, self.up) for way in self.ways)

    def _slides_better(self, thing: Thing) -> bool:
        if thing.item.size_m >= HEAVY_M:
            return True
        # The next time something else.
        slid = self._slid.get(thing.item.name)
        return not self._steady(thing) if slid is None else not slid

    def _again(self, thing: Thing) -> bool:
        """Whether ``thing`` has moved: its velocity is set then, not its spin."""
        return thing.item.name in self._trails

    def _rocks(self, thing: Thing) -> bool:
        """Whether ``thing`` has just moved and is narrow, so that it may rock still."""
        return bool(self._trails) and list(self._trails)[-1] == thing.item.name and not self.firm(thing)

    def thing(self, name: str) -> Thing:
        """Return the thing of that name, where it stands now."""
        return next(thing for thing in self.things if thing.item.name == name)

    def _tries(self, thing: Thing, share: float) -> Iterator[Move]:
        steady = self._steady(thing) and not self._rocks(thing)
        height = share * _peak(thing) * (1.0 if steady else UNSTEADY)
        rise = math.sqrt(2.0 * self.gravity * height)
        flight = 2.0 * rise / self.gravity
        # What rolls on may leave the picture, wherever it was thrown: it bounces where it is.
        upright = thing.carried or thing.round or _flows(thing.item) or not steady
        for aside in (0.0,) if upright else ASIDE:
            ways = DIRECTIONS if aside else ((1.0, 0.0), (-1.0, 0.0))
            for (right, away), turn in itertools.product(ways, TURNS):
                way = right * self.right + away * self.away
                shift = self._landed(thing, way, aside * thing.extent(way), flight) * way
                spin = np.zeros(3)
                if steady and not self._again(thing):
                    spin = self._spin(thing, way, shift, flight, turn)
                yield Move(
                    name=thing.item.name,
                    height=height,
                    aside=rounded(shift),
                    start_s=0.0,
                    flight_s=flight,
                    settle_s=sum(self._settle(thing, flight, slides=False)),
                    pause_s=self._pause(thing, flight, slides=False),
                    velocity=rounded(rise * self.up + shift / flight),
                    spin=rounded(spin),
                )

    def _landed(self, thing: Thing, way: Array, wanted: float, flight: float) -> float:
        """Return how far in m ``thing`` hops along ``way``: as wanted, if it does not fall over on landing."""
        if wanted == 0.0:
            return wanted
        # Over its edge its centre rises by as much as that speed's energy lifts it.
        middle = float((thing.centre - thing.base.mean(axis=0)) @ self.up)
        rise = middle * (1.0 / math.cos(min(thing.tips(way, self.up), 1.4)) - 1.0)
        return min(wanted, LANDING * math.sqrt(2.0 * self.gravity * max(rise, 0.0)) * flight)

    def _pushes(self, thing: Thing, share: float) -> Iterator[Move]:
        """Yield pushes of what stands on the ground and neither rolls, flows nor tips over its leading edge."""
        if thing.carried or thing.round or _flows(thing.item):
            return
        friction = self._friction(thing)
        for (right, away), share_turn in itertools.product(PUSHES, TURNS):
            way = right * self.right + away * self.away
            if math.tan(thing.tips(way, self.up)) < UPRIGHT * friction:
                continue
            far = SLIDE * share * thing.extent(way)
            speed = math.sqrt(2.0 * friction * self.gravity * far)
            time = speed / (friction * self.gravity)
            straight = self._again(thing) or thing.item.name in self.plain
            turn = 0.0 if straight else self._facing(thing, way) * 2.0 * share_turn * SLIDE_TURN / time
            yield Move(
                name=thing.item.name,
                height=0.0,
                aside=rounded(far * way),
                start_s=0.0,
                flight_s=time,
                settle_s=sum(self._settle(thing, time, slides=True)),
                pause_s=self._pause(thing, time, slides=True),
                velocity=rounded(speed * way),
                spin=rounded(turn * self.up),
            )

    def _friction(self, thing: Thing) -> float:
        return max(0.1, math.sqrt(self.ground.friction * _own_friction(thing.item, self.ground)))

    def _spin(self, thing: Thing, way: Array, shift: Array, flight: float, share: float) -> Array:
        """Return the spin (3,) rad/s: ``share`` of the turn about the vertical, or, where that is 0, forwards over the
        way it goes, as far as it will not fall over. Not both: what comes down on an edge while it turns rolls on about
        its rim as a coin does, by as much again.
        """
        if thing.carried or thing.round or _flows(thing.item) or thing.item.name in self.plain or not self.firm(thing):
            return np.zeros(3)
        if share:
            return self._facing(thing, way) * share * TURN * self.up / flight
        axis = np.cross(self.up, way)
        # Leaning in the picture's plane shows most and turns nothing unseen to the camera.
        aslant = abs(float(way @ self.right)) / float(np.linalg.norm(way))
        return np.asarray(aslant * axis * min(LEAN * thing.tips(way, self.up), MOST_LEAN) / flight)

    def _facing(self, thing: Thing, way: Array) -> float:
        """Return the sign of the turn about the vertical by which ``thing`` faces the camera at the end of its way."""
        aside = float(way @ self.right)
        if abs(aside) < 1e-6:
            # Straight towards the camera: its face to the middle of the picture.
            aside = float(self.camera.project(thing.centre[None])[0, 0]) - 0.5 * self.camera.width
        return -1.0 if aside > 0 else 1.0

    def _turn(self, move: Move) -> float:
        """Return by how many radians ``move`` turns its thing about the vertical."""
        return float(np.asarray(move.spin) @ self.up) * move.flight_s * (0.5 if move.slides else 1.0)

    def _path(self, thing: Thing, move: Move) -> Array:
        """Return the hull of ``thing`` (MOMENTS, K, 3) at instants of its flight, the last one where it comes down."""
        times = np.linspace(0.0, move.flight_s, MOMENTS)
        if move.slides:
            # Where friction is less than thought it goes on a little.
            gone = 1.2 * (1.0 - (1.0 - times / move.flight_s) ** 2)
            turns = [thing.turned(share * self._turn(move), self.up).hull for share in gone]
            return np.asarray(turns + gone[:, None, None] * np.asarray(move.aside))
        spin = np.asarray(move.spin)
        rate = float(np.linalg.norm(spin))
        axis = spin / rate if rate > 0 else spin
        local = thing.hull - thing.centre
        found = []
        for t in times:
            place = thing.centre + np.asarray(move.velocity) * t - 0.5 * self.gravity * t * t * self.up
            found.append(place + rotated(local, axis, rate * t))
        return np.array(found)

    def _rating(
        self, thing: Thing, move: Move, around: Clearance, others: Sequence[Thing], over: float
    ) -> float | None:
        """Return how much ``move`` shows, in the thing's own size, less what speaks against it; None: has no room, or
        comes to hide one of ``others`` or itself.

        over: share of its size in the picture by which it may leave the frame.
        """
        path = self._path(thing, move)
        after = path[-1] + self._run_out(thing, move)
        whole = np.concatenate([path, after[None]])
        pixels = self.camera.project(whole)[..., :2]
        size = float(np.ptp(pixels[0], axis=0).max())
        slack = self._slack.get(move.name, np.zeros(3))
        # Where it stands now is known to within that.
        every = np.concatenate([whole, whole - slack, whole + slack]) if slack.any() else whole
        outside = outside_frame(self.camera, every, MARGIN if over == 0 else 0.0)
        beyond = outside.max()
        # What stands in the margin already may go on along it; what the frame cuts would show where.
        cut = not over and outside_frame(self.camera, whole[:1], 0.0)[0] > 0
        if cut or beyond > outside[0] + over * size or not around.keeps(every):
            return None
        middles = pixels.mean(axis=1)
        rise = float(np.linalg.norm(middles[MOMENTS // 2] - middles[0]))
        if rise < LEAST_RISE_PX * min(self.camera.width, self.camera.height):
            return None
        hides = self._hides(whole, others)
        if hides > HIDDEN or self._guessed(thing, move) > max(GUESSED, self._guessed(thing)):
            return None
        # From where it stood in the photo, not from where it stands now: what came back has gone nowhere.
        home = self.camera.project(self.rest[thing.item.name].hull)[:, :2].mean(axis=0)
        far = float(np.linalg.norm(middles[-1] - home))
        shown = min(rise / size, 1.0) + 0.5 * min(far / size, 0.6)
        if not over:
            shown += 0.1 * min(abs(self._turn(move)) / SLIDE_TURN, 1.0)
        foot = thing.hull - np.outer(self.ground.heights(thing.hull), self.up)
        unlike = self.plate.difference(self.camera, foot, foot + np.asarray(move.aside)) if any(move.aside) else 0.0
        # Of equal ones the way towards the middle, where there is more to see.
        middle = float(np.linalg.norm(pixels[-1].mean(axis=0) - (0.5 * self.camera.width, 0.5 * self.camera.height)))
        return (
            shown
            - 0.6 * unlike
            - 0.05 * middle / self.camera.width
            - hides
            - 2.0 * (float(beyond) / size if over else 0.0)
        )

    def _guessed(self, thing: Thing, move: Move | None = None) -> float:
        """Return the share of ``thing``'s picture, now or after ``move``, that the photo does not show."""
        if thing.round or _flows(thing.item):
            return 0.0
        after = thing if move is None else thing.turned(self._turn(move), self.up).shifted(np.asarray(move.aside))
        return self.rest[thing.item.name].surface.guessed(after.surface, self.camera.position)

    def _hides(self, whole: Array, others: Sequence[Thing]) -> float:
        """Return the largest share of a thing's picture that is hidden when the hulls ``whole`` (T, K, 3) have come to
        an end, beyond what was hidden at their beginning.
        """
        most = 0.0
        for other in others:
            before, after = (hidden_share(self.camera, hull, other.hull) for hull in (whole[0], whole[-1]))
            most = max(most, after - before)
        return most

    def _settle(self, thing: Thing, flight: float, *, slides: bool) -> tuple[float, float]:
        """Return how long ``thing`` moves, about, after it came down or stopped: bounces, and a wobble that takes
        longer the larger it is.

        Each bounce of rigid things takes the same share of the one before; what is round rolls on.
        """
        wobble = 0.35 * math.sqrt(thing.item.size_m / 0.15)
        bounces = 0.7
        if thing.item.material.law == "rigid":
            rebound = min(_rebound(thing.item, self.ground), 0.9)
            # What is narrow rocks.
            narrow = not slides and not thing.round and not self.firm(thing)
            wobble, bounces = (1.0 if narrow else 0.1) * wobble, 1.5 if thing.round else rebound / (1.0 - rebound)
        return 0.0 if slides else bounces * flight, wobble

    def _pause(self, thing: Thing, flight: float, *, slides: bool) -> float:
        """Return how long it is left alone then: what is rigid trips where it is pushed as it bounces."""
        bounces, wobble = self._settle(thing, flight, slides=slides)
        return (1.0 if thing.item.material.law == "rigid" else 0.5) * bounces + 0.5 * wobble

    def _run_out(self, thing: Thing, move: Move) -> Array:
        """Return how far (3,) it may go on after it came down, m."""
        aside = np.asarray(move.aside)
        speed = float(np.linalg.norm(aside)) / move.flight_s
        if speed == 0.0 or move.slides:
            return np.zeros(3)
        friction = self._friction(thing)
        far = speed**2 / (2.0 * friction * self.gravity)
        return np.asarray(unit(aside) * far)


def _flows(item: SceneObject) -> bool:
    return item.material.law in ("sand", "snow", "fluid")


def _own_friction(item: SceneObject, ground: Ground) -> float:
    if item.friction is not None:
        return item.friction
    return ground.friction if item.roughness is None else 0.05 + 0.9 * item.roughness


def _rebound(item: SceneObject, ground: Ground) -> float:
    """Speed of leaving the ground over that of coming down, 0 to 1, of the rigid ``item``."""
    given = max(item.restitution or 0.0, ground.restitution)
    return given if item.restitution is not None or given > 0 else item.material.rigid_restitution


def _peak(thing: Thing) -> float:
    """Return the height in m to which a thing like this hops."""
    sizes, shares = zip(*HEIGHTS, strict=True)
    share = float(np.interp(math.log(thing.item.size_m), np.log(sizes), shares))
    matter = 0.35 if _flows(thing.item) else 0.75 if thing.item.material.law == "rigid" else 1.0
    return matter * share * math.sqrt(thing.item.size_m * max(thing.tall, 0.1 * thing.item.size_m))
