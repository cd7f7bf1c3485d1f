# SPDX-License-Identifier: GPL-3.0-or-later
"""The remaining time that a command shows, and what its terminal gets to see."""

import ast
import io
import json
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from physgen.batch.terminal import RemainingTime, Terminal
from physgen.sim.events import STAGES, step_words

ROOT = Path(__file__).resolve().parents[2]


class Clock:
    """A clock that a test sets."""

    def __init__(self):
        self.now = 0.0

    def __call__(self):
        return self.now


def event(stage, done, total, eta_s=None):
    return {"event": "progress", "stage": stage, "done": done, "total": total, "eta_s": eta_s}


GUESSES = {"reconstruct": 40.0, "bake": 30.0, "render": 200.0}


def test_first_it_is_what_was_guessed():
    assert RemainingTime(GUESSES, clock=Clock()).update(event("reconstruct", 0, 20)) == pytest.approx(270)


def test_a_stage_without_an_estimate_of_its_own_is_followed_by_its_pace():
    clock = Clock()
    left = RemainingTime({"reconstruct": 40.0}, clock=clock)
    left.update(event("reconstruct", 0, 20))
    clock.now = 300.0
    # Half is done after five minutes: the other half takes about as long, whatever was guessed.
    assert left.update(event("reconstruct", 10, 20)) == pytest.approx(225, abs=80)
    clock.now = 570.0
    assert left.update(event("reconstruct", 19, 20)) == pytest.approx(30, abs=5)


def test_a_machine_four_times_slower_than_guessed_is_so_for_what_follows():
    clock = Clock()
    left = RemainingTime(GUESSES, clock=clock)
    left.update(event("reconstruct", 0, 2))
    clock.now = 160.0
    assert left.update(event("reconstruct", 2, 2)) == pytest.approx(4 * 230)


def test_a_cached_stage_makes_no_machine_faster():
    left = RemainingTime(GUESSES, clock=Clock())
    left.update(event("reconstruct", 0, 2))
    assert left.update(event("reconstruct", 2, 2)) == pytest.approx(230)


def test_a_stage_that_begins_anew_is_counted_from_there():
    clock = Clock()
    left = RemainingTime({}, clock=clock)
    for begun in (0.0, 100.0):
        clock.now = begun
        left.update(event("rehearsal", 0, 10))
        clock.now = begun + 5.0
        assert left.update(event("rehearsal", 5, 10)) == pytest.approx(5.0, abs=2.6)


@given(st.lists(st.tuples(st.sampled_from([*GUESSES, "propose"]), st.integers(0, 9), st.integers(0, 9),
                          st.none() | st.floats(0, 1e6), st.floats(0, 1e5)), max_size=30))  # fmt: skip
def test_it_is_never_negative_nor_endless(steps):
    clock = Clock()
    left = RemainingTime(GUESSES, clock=clock)
    for stage, done, total, eta, passed in steps:
        clock.now += passed
        assert 0 <= left.update(event(stage, done, total, eta)) < 1e9


HOSTILE = "ball\x1b]0;t\x07\x9b2J\u202e\ud800 é→\ttab"
SHOWN = "ball�]0;t��2J�� é→\ttab"


def out(encoding="utf-8"):
    return io.TextIOWrapper(io.BytesIO(), encoding=encoding)


def written(stream):
    stream.flush()
    return stream.buffer.getvalue()


def test_names_from_a_strangers_folder_give_a_terminal_no_orders(capsys):
    stream = out()
    terminal = Terminal(as_json=False, out=stream)
    terminal.line(HOSTILE)
    terminal({"event": "notice", "stage": "track", "message": HOSTILE})
    terminal({"event": "progress", "stage": "bake", "done": 1, "total": 1, "message": f"{HOSTILE}\nerror: no"})
    terminal.error("InputError", HOSTILE)
    lines = written(stream).decode().splitlines()
    assert lines[:2] == [SHOWN, f"track: {SHOWN}"]
    assert len(lines) == 3 and lines[2].startswith("Simulating ") and f"{SHOWN} error: no" in lines[2]
    assert capsys.readouterr().err == f"error: {SHOWN}\n"


@pytest.mark.parametrize("encoding", ["utf-8", "ascii", "cp1252"])
def test_json_lines_say_the_same_and_hold_no_orders(encoding):
    stream = out(encoding)
    terminal = Terminal(as_json=True, out=stream)
    event = {"event": "notice", "message": HOSTILE + "\u2028\N{GRINNING FACE}"}
    terminal(event)
    terminal.error("InputError", HOSTILE)
    first, second = written(stream).decode(encoding).splitlines()
    assert json.loads(first) == event and json.loads(second)["message"] == HOSTILE
    assert all(c.isprintable() for c in first + second)


def test_a_terminal_that_lacks_a_character_gets_its_number():
    stream = out("ascii")
    Terminal(as_json=False, out=stream).line("photo → video")
    assert written(stream) == b"photo \\u2192 video\n"


def test_every_stage_has_words_for_people():
    """Terminals and Blender show what is being done, not the stage's name, which programs read."""
    found = set()
    for path in (path for folder in ("sim", "batch", "physgen_addon") for path in (ROOT / folder).rglob("*.py")):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        constants = {
            target.id: node.value.value
            for node in tree.body
            if isinstance(node, ast.Assign) and isinstance(node.value, ast.Constant)
            for target in node.targets
            if isinstance(target, ast.Name)
        }
        for call in (node for node in ast.walk(tree) if isinstance(node, ast.Call) and len(node.args) > 1):
            if isinstance(call.func, ast.Name) and call.func.id == "StageProgress":
                stage = call.args[1]
                found.add(stage.value if isinstance(stage, ast.Constant) else constants[stage.id])
    assert {"bake", "render", "track", "evaluate"} < found <= set(STAGES)
    stream = out()
    Terminal(as_json=False, out=stream)(event("propose", 0, 2))
    assert written(stream).decode().startswith("Finding objects ")
    as_json = out()
    Terminal(as_json=True, out=as_json)(event("propose", 0, 2))
    assert json.loads(written(as_json))["stage"] == "propose"


@pytest.mark.parametrize(
    ("step", "words"),
    [("segment a cup", "cutting out a cup"), ("look of mesh 2", "estimating the surface of mesh 2"), ("x", "x")],
)
def test_a_step_is_told_with_the_name_of_its_object(step, words):
    assert step_words(step) == words


def test_no_line_promises_that_nothing_is_left():
    """The end of a stage is not the end of the command, and the end of the last one needs no promise."""
    stream = out()
    terminal = Terminal(as_json=False, expected_s={"track": 6.0, "fit": 12.0}, out=stream)
    terminal(event("track", 10, 10))
    terminal(event("fit", 5, 5))
    first, second = written(stream).decode().splitlines()
    assert first.endswith("elapsed, about 0:12 left") and second.endswith("elapsed")
