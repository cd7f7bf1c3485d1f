# SPDX-License-Identifier: MIT
"""Default motion of a scene at rest: the objects with most room hop or slide, one after another, within the picture.

A reconstructed scene is at rest, as the photo is. ``physgen run`` adds this motion unless a velocity, a spin, an
override that moves something or ``--still`` is given. The clip ends when the last object has come to rest.
``motion_stage.py`` chooses each move; where there is time, a coarse run of the engine checks them (``clip_check.py``).
Nothing is random.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ..scene.folder import Scene, load_scene
from ..scene.model import SceneModel, SceneObject, Vector
from ..scene.scene_object import Key
from .motion_stage import Stage
from .moves import Move

MOST_MOVES = 3
"""Most moves in a clip."""

MIDDLES = {1: (0.375,), 2: (0.25, 0.625), 3: (0.25, 0.5, 0.75)}
"""By the number of moves: the earliest time at which each is half-way, as a share of the clip."""

SHORTEST_S, CLIP_S, LONGEST_S = 1.5, 3.5, 4.5
"""Shortest, usual and longest clip in seconds."""

SLOW = (1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 8.0)
"""Slow motion to choose from: how many times slower than real."""

LEGIBLE_S = 0.5
"""Seconds of the clip that the longest flight should take, even if something still rolls at its end."""

ENDED = 0.5
"""Share of what follows the last move that a clip should show, if a move that repeats another can be left out for it:
what bounces for long would else be cut high in the air."""

LOW = 0.5
"""Share of its speed with which something hops that fell over: a quarter as high."""

LEAD_S, HOLD_S = 0.1, 0.25
"""Seconds of the clip before the first move, at least, and after the last object has come to rest."""


@dataclass(frozen=True, kw_only=True)
class DefaultMotion:
    """How a scene's objects move, and the clip that shows it. Made by ``default_motion``.

    moves: empty where nothing has room. frames, fps, slow: options of a bake that shows all of it (``BakeOptions``).
    action_s: estimated seconds in the scene until all is at rest. sentence: what was chosen, in words.

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
        model = dataclasses.replace(scene.model, objects=tuple(self._moved(item) for item in scene.objects))
        moved = scene if model == scene.model else scene.with_model(model)
        # A rehearsal of another motion may have saved that.
        return moved if load_scene(scene.root).model == model else moved.save()

    def _moved(self, item: SceneObject) -> SceneObject:
        moves = [move for move in self.moves if move.name == item.name]
        if not moves:
            return item
        first, *later = moves
        keys = [Key(time_s=move.start_s, value=move.velocity) for move in later]
        return dataclasses.replace(
            item,
            velocity=first.velocity,
            spin=first.spin,
            start_time=first.start_s,
            velocity_keys=tuple(keys),
        )


def default_motion(
    scene: Scene,
    *,
    fps: float = 24.0,
    frames: int | None = None,
    slow: float | None = None,
    calm: Collection[str] = (),
    plain: Collection[str] = (),
    low: Collection[str] = (),
    still: Collection[str] = (),
) -> DefaultMotion:
    """Return a motion for the objects of ``scene``, which are taken to be at rest: hops and pushes where there is room.

    How high an object hops depends on its size, its matter and the room above it. Its path stays in the picture and
    clear of other objects, and ends on ground that looks like the ground where it stands. fps: of the clip. frames,
    slow: its length, and how many times slower than real it is; None chooses them so that all of the motion is shown,
    in about three seconds. calm: names of objects that only hop straight up, and low. plain: of those that
    neither turn nor lean. low: of those that hop to a quarter of that height. still: of those that stay at rest.

    >>> import physgen
    >>> physgen.default_motion(physgen.load_scene("scene")).sentence  # doctest: +SKIP
    'none was given, so orange hops 6 cm high and 4 cm to the right; 4 times slower than real, 2.6 s'

    Raises InputError for a mesh or clean plate that cannot be read.
    """
    chosen = _moves(scene, calm, plain, still)
    moves = tuple(move.slower(LOW) if move.name in low else move for move in chosen)
    settle = moves[-1].settle_s if moves else 0.0
    return fitted(scene, moves, dict.fromkeys(SLOW, settle), fps=fps, frames=frames, slow=slow)


def fitted(
    scene: Scene,
    moves: tuple[Move, ...],
    settles: Mapping[float, float],
    *,
    fps: float,
    frames: int | None = None,
    slow: float | None = None,
) -> DefaultMotion:
    """Return ``moves`` of objects of ``scene`` at times that fill a clip, and that clip.

    settles: for each of ``SLOW``, the seconds in the scene from the end of the last move until nothing is seen to move
    in a clip that is so slow. fps, frames, slow: as of ``default_motion``.
    """
    if not moves:
        given = frames or max(2, math.ceil(2.0 * fps))
        sentence = _sentence(scene.model, moves, given / fps, slow or SLOW[0])
        return DefaultMotion(moves=moves, frames=given, fps=fps, slow=slow or SLOW[0], sentence=sentence)
    least = {each: _seconds(moves, len(moves) * _apart(moves, each), settles[each], each) for each in SLOW}
    if slow is None:
        room = CLIP_S if frames is None else frames / fps
        fitting = [each for each in SLOW if least[each] <= room]
        slow = fitting[-1] if fitting else SLOW[0]
        if frames is None:
            flight = max(move.flight_s for move in moves)
            slow = max(slow, min(SLOW, key=lambda each: abs(each * flight - LEGIBLE_S)))
    most = LONGEST_S if frames is None else frames / fps
    if len(moves) > 1 and _seconds(moves, len(moves) * _apart(moves, slow), 0.0, slow) > most:
        # The last would be cut.
        settles = dict.fromkeys(SLOW, moves[-2].settle_s)
        return fitted(scene, moves[:-1], settles, fps=fps, frames=frames, slow=slow)
    near = min(SLOW, key=lambda each: abs(each - slow))
    shorter = _without_repeat(moves)
    if shorter and _seconds(moves, len(moves) * _apart(moves, slow), ENDED * settles[near], slow) > most:
        return fitted(scene, shorter, settles, fps=fps, frames=frames, slow=slow)
    seconds = least[near] if frames is None else frames / fps
    apart = _apart(moves, slow)
    # What takes long to come to rest, as what rolls, would leave the others to the beginning of the clip.
    whole = min(seconds, most) / slow
    middles = [max(MIDDLES[len(moves)][0] * whole, 0.5 * moves[0].flight_s + LEAD_S / slow)]
    for middle in MIDDLES[len(moves)][1:]:
        middles.append(max(middle * whole, middles[-1] + apart))
    if frames is None:
        seconds = min(max(_seconds(moves, middles[-1], settles[near], slow), SHORTEST_S), LONGEST_S)
        frames = max(2, math.ceil(seconds * fps))
    timed = tuple(
        dataclasses.replace(move, start_s=round(max(0.0, middle - 0.5 * move.flight_s), 4))
        for move, middle in zip(moves, middles, strict=True)
    )
    action = timed[-1].landed_s + settles[near]
    sentence = _sentence(scene.model, timed, frames / fps, slow)
    return DefaultMotion(moves=timed, frames=frames, fps=fps, slow=slow, action_s=action, sentence=sentence)


def _apart(moves: Sequence[Move], slow: float) -> float:
    """Return the least seconds in the scene from the middle of one move to that of the next, and before the first."""
    least = 0.5 * moves[0].flight_s + LEAD_S / slow
    for before, after in itertools.pairwise(moves):
        rest = before.pause_s if before.name == after.name else 0.0
        least = max(least, 0.5 * before.flight_s + rest + 0.5 * after.flight_s)
    return least


def _without_repeat(moves: tuple[Move, ...]) -> tuple[Move, ...]:
    """Return ``moves`` without the last of a thing that has moved before, unless it ends them; empty where there is
    none. What comes later must not rely on it: it was a hop on the spot, or all that comes later are."""
    for at in range(len(moves) - 2, 0, -1):
        again = any(move.name == moves[at].name for move in moves[:at])
        if again and (moves[at].on_the_spot or all(move.on_the_spot for move in moves[at + 1 :])):
            return (*moves[:at], *moves[at + 1 :])
    return ()


def _seconds(moves: Sequence[Move], middle: float, settle: float, slow: float) -> float:
    """Return the length in seconds of a clip that ends when all is at rest.

    middle: time at which the last of ``moves`` is half-way; settle: from its end until all is at rest; s in the scene.
    """
    return slow * (middle + 0.5 * moves[-1].flight_s + settle) + HOLD_S


def _moves(scene: Scene, calm: Collection[str], plain: Collection[str], still: Collection[str]) -> tuple[Move, ...]:
    model = scene.model
    gravity = float(np.linalg.norm(model.gravity))
    # A hop comes down where gravity points into the ground; elsewhere nothing simple is right.
    if model.ground is None or gravity < 0.5 or float(np.dot(model.gravity, model.ground.unit_normal)) > -0.9 * gravity:
        return ()
    stage = Stage(scene, gravity, calm, plain)
    chosen: list[Move] = []
    while len(chosen) < MOST_MOVES:
        move = _next_move(stage, chosen, still)
        if move is None:
            break
        stage.take(move)
        chosen.append(move)
    return tuple(chosen)


def _next_move(stage: Stage, chosen: Sequence[Move], still: Collection[str]) -> Move | None:
    """Return the best move of a thing that has not moved yet, else another move of the one that has rested longest.

    Round things move last and only once: they roll on for long, and nothing else should get in their way.
    """
    moved = list(dict.fromkeys(move.name for move in chosen))
    fresh = [thing for thing in stage.things if thing.item.name not in (*moved, *still)]
    rated = [(thing.round, pair) for thing in fresh if (pair := stage.best(thing)) is not None]
    standing = [pair for rolls, pair in rated if not rolls]
    rolling = [pair for rolls, pair in rated if rolls]
    if standing:
        return max(standing, key=lambda pair: pair[0])[1]
    if MOST_MOVES - len(chosen) > len(rolling) and not any(stage.thing(name).round for name in moved):
        for name in moved:
            found = stage.best(stage.thing(name))
            # The same hop on the spot twice in a row looks like one that never comes down.
            if found is not None and not (found[1].on_the_spot and chosen[-1].on_the_spot and chosen[-1].name == name):
                return found[1]
    return max(rolling, key=lambda pair: pair[0])[1] if rolling else None


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


MOTION_FIELDS = (
    *("velocity", "spin", "velocity_keys", "acceleration", "start_time", "motion", "pin_motion", "pins", "role"),
    *("gravity", "gravity_track"),
)
"""Fields of objects and scene that say how things move."""


def tells_motion(velocities: Sequence[Vector], spins: Sequence[Vector], overrides: Sequence[str]) -> bool:
    """Return whether a request says how things move: by velocities or spins, even of 0, or by an override of gravity or
    of what moves an object.
    """
    fields = [text.partition("=")[0].rpartition(".")[2].strip() for text in overrides]
    return bool(velocities or spins) or any(name in MOTION_FIELDS for name in fields)
