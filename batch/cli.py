# SPDX-License-Identifier: GPL-3.0-or-later
"""The ``physgen`` command: every stage alone, or all of them (docs/cli.md).

Its parser has commands in groups, one short usage line, and errors without the list of flags.
"""

from __future__ import annotations

import argparse
import contextlib
import difflib
import os
import re
import signal
import sys
import textwrap
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NoReturn

from . import early_stop  # noqa: F401 - before the modules that take long

# isort: split
from ..sim import atomic
from ..sim.app.bake_options import BakeOptions
from ..sim.app.launch import STOP_SIGNALS
from ..sim.effects.registry import Effect, effect, effect_to_json, effects
from ..sim.errors import ANYWAY, OUT_OF_MEMORY, Cancelled, InputError, PhysGenError
from ..sim.events import IsCancelled
from ..sim.files import NOT_UTF8, shown, utf8
from ..sim.folder_lock import LOCK_FILE, release_all, remove_dead_lock
from ..sim.memory import ran_out
from ..sim.processes import kill_children
from ..sim.trust import LIST_FILE, config_folder
from ..sim.version import VERSION
from . import stages
from .commands import (
    compose_commands,
    diagnosis_commands,
    evaluation_commands,
    install_commands,
    photo_commands,
    render_commands,
    scene_commands,
)
from .farm import batch_command as farm_command
from .terminal import Terminal, stop_signals, tolerant

HELP_WIDTH = 100
"""Widest line of a help text, in characters."""
MOST_USAGE_FLAGS = 6
"""A command with more optional flags shows ``[options]`` in their place."""
INVALID_COMMAND = re.compile(r"argument COMMAND: invalid choice: '([^']*)' \(choose from (.*)\)", re.DOTALL)
"""Argparse's message for an unknown command; its list of all of them hides what matters."""
NAME = re.compile(r"[a-z][a-z-]*")
COMMAND_COLUMN = 16
"""Column at which the commands' texts begin."""


class HelpFormatter(argparse.RawDescriptionHelpFormatter):
    """Argparse's own, no wider than ``HELP_WIDTH``; descriptions keep their lines."""

    def __init__(self, prog: str) -> None:
        super().__init__(prog, max_help_position=28)
        self._width = min(self._width, HELP_WIDTH)


class CommandParser(argparse.ArgumentParser):
    """A parser whose usage is one line, and whose errors leave the list of all flags to ``--help``."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(formatter_class=HelpFormatter, allow_abbrev=False, **settings)

    def format_usage(self) -> str:
        """Return the usage; with many flags only what has to be given, and ``[options]``."""
        actions = self._actions
        if self.usage is not None:
            return super().format_usage()
        optional = [item for item in actions if item.option_strings and not item.required]
        if len(optional) <= MOST_USAGE_FLAGS:
            return super().format_usage()
        formatter = self._get_formatter()
        formatter.add_usage(None, [item for item in actions if item not in optional], [], prefix="")
        needed = formatter.format_help().strip().removeprefix(self.prog).strip()
        return f"usage: {self.prog} {needed} [options]\n"

    def format_help(self) -> str:
        """Return the help with the usage of ``format_usage``."""
        given = self.usage
        self.usage = self.format_usage().removeprefix("usage: ").strip().replace("%", "%%")
        try:
            return super().format_help()
        finally:
            self.usage = given

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> tuple[Any, list[str]]:
        """Return what was given; flags that no command knows are an error of the command, with the likeliest meant."""
        found, extra = super().parse_known_args(args, namespace)
        if extra:
            self.error(f"unrecognized arguments: {' '.join(extra)}{self._meant(extra[0], self._option_string_actions)}")
        return found, extra

    def _meant(self, given: str, known: Iterable[str]) -> str:
        near = difflib.get_close_matches(given.split("=")[0], list(known), n=1)
        return f"; did you mean {near[0]}?" if near else ""

    def error(self, message: str) -> NoReturn:
        """Exit with code 2: the usage, where flags are listed, and last what is wrong: farms record the last line."""
        choice = INVALID_COMMAND.match(message)
        if choice is not None:
            message = f"no command {choice[1]!r}{self._meant(choice[1], NAME.findall(choice[2]))}"
        text = f"{self.format_usage()}all options: {self.prog} --help\n{self.prog}: error: {message}\n"
        self.exit(2, text)


def command_list(groups: dict[str, list[tuple[str, str]]]) -> str:
    """Return the commands with their texts, a heading a group, no line wider than ``HELP_WIDTH`` characters."""
    lines = []
    for title, commands in groups.items():
        lines += ["", f"{title}:"]
        for name, text in commands:
            lines += textwrap.wrap(
                text,
                width=HELP_WIDTH,
                initial_indent=f"  {name:<{COMMAND_COLUMN - 2}}",
                subsequent_indent=" " * COMMAND_COLUMN,
            )
    return "\n".join(lines)


ABOUT = """\
One photo becomes a small physical world: reconstruct, simulate, render.

  physgen run photo.jpg                  photo.mp4: its objects are found, and move
  physgen COMMAND --help                 all options of a command
"""

Command = Callable[[argparse.Namespace, Terminal, IsCancelled], int]


def build_parser() -> CommandParser:
    """Return the parser of the ``physgen`` command."""
    parser = CommandParser(prog="physgen", usage="physgen COMMAND [options]")
    parser.add_argument("--version", action="version", version=f"physgen {VERSION}")
    commands = parser.add_subparsers(
        dest="command", required=True, metavar="COMMAND", prog="physgen", help=argparse.SUPPRESS
    )
    groups: dict[str, list[tuple[str, str]]] = {}

    def command(name: str, run: Command, text: str) -> CommandParser:
        sub = commands.add_parser(name, description=text)
        sub.add_argument("--json", action="store_true", help="progress and result as JSON lines")
        sub.set_defaults(run=run)
        list(groups.values())[-1].append((name, text))
        return sub

    groups["From a photo to a video"] = []
    photo_commands.add_run(command("run", photo_commands.run_run, "photo → video: all stages"))
    listed = "list the objects of a photo that stand out, for --box and --pick; a numbered picture of them"
    photo_commands.add_propose(command("propose", photo_commands.run_propose, listed))
    photo_commands.add_reconstruct(command("reconstruct", photo_commands.run_reconstruct, "photo → scene folder"))
    again = "reconstruct a scene's photo again with corrected inputs"
    photo_commands.add_correct(command("correct", photo_commands.run_correct, again))
    photo_commands.add_light(command("light", photo_commands.run_light, "change the lighting of a scene folder"))
    scene_commands.add_bake(command("bake", scene_commands.run_bake, "scene folder → bake folder"))
    photo_commands.add_render(
        command("render", photo_commands.run_render, "scene folder and bake folder → frames, video")
    )
    sheet = "frames → video or animated contact sheet"
    render_commands.add_encode(command("encode", render_commands.run_encode, sheet))
    many = "job file → scenes, bakes and videos of all variants, on one or many machines"
    farm_command.add_batch(command("batch", farm_command.run_batch, many))

    groups["From a recording to the missing effect"] = []
    why = "video of one plain body → why its simulation differs, with a video of both side by side"
    diagnosis_commands.add_explain(command("explain", diagnosis_commands.run_explain, why))
    diagnosis_commands.add_track(command("track", diagnosis_commands.run_track, "videos of a scene → capture folder"))
    tables = "recorded motion (CSV, Tracker, DeepLabCut, C3D, ROS bags) → capture folder"
    diagnosis_commands.add_capture(command("capture", diagnosis_commands.run_capture, tables))
    lack = "capture of a real motion → effects missing from its simulation"
    diagnosis_commands.add_diagnose(command("diagnose", diagnosis_commands.run_diagnose, lack))
    examined = "test the diagnosis on simulated motion with withheld labels"
    diagnosis_commands.add_blind_check(command("blind-check", diagnosis_commands.run_blind_check, examined))

    groups["Scenes"] = []
    photo_commands.add_import(
        command("import", photo_commands.run_import, "PhysGen3D or PhysGen folder, splats, MJCF or URDF → scene folder")
    )
    views = "multi-view images of one or two objects → scene folder with their splats"
    compose_commands.add_fit_splats(command("fit-splats", compose_commands.run_fit_splats, views))
    varied = "scene folder → new scene folder with other physics and effects"
    scene_commands.add_variant(command("variant", scene_commands.run_variant, varied))
    fitted = "scene folder → new scene folder whose objects no longer intersect"
    compose_commands.add_compose(command("compose", compose_commands.run_compose, fitted))
    scene_commands.add_export(
        command("export", scene_commands.run_export, "scene folder, and its bake → USD or Alembic")
    )

    groups["Bakes"] = []
    cost = "estimate time, memory and disk space of a bake; writes nothing"
    scene_commands.add_estimate(command("estimate", scene_commands.run_estimate, cost))
    previews = "serve coarse runs requested on standard input (docs/file-formats.md)"
    scene_commands.add_preview(command("preview", scene_commands.run_preview, previews))
    sound = "compare the files of a bake, scene or frames folder with their checksums"
    scene_commands.add_check(command("check", scene_commands.run_check, sound))
    packed = "pack a bake to send it; --unpack unpacks one"
    scene_commands.add_pack(command("pack", scene_commands.run_pack, packed))
    scene_commands.add_free(
        command("free", scene_commands.run_free, "delete a bake: the files its manifest lists, nothing else")
    )

    groups["Realism of a video"] = []
    real = "measure a video against recordings, or by itself; a page, JSON and tables"
    evaluation_commands.add_evaluate(command("evaluate", evaluation_commands.run_evaluate, real))
    asked = "photos and videos → pages on which people judge them; with --collect: answers → results"
    evaluation_commands.add_questionnaire(command("questionnaire", evaluation_commands.run_questionnaire, asked))

    groups["This installation"] = []
    listing = command("effects", _effects, "list physical effects with their equations and parameters")
    listing.add_argument("name", nargs="*", metavar="NAME", help="only these (default: all)")
    kept = "list, install or remove models that improve the reconstruction"
    install_commands.add_models(command("models", install_commands.run_models, kept))
    command("doctor", _doctor, "check the installation and name what is missing")
    parser.description = ABOUT + command_list(groups)
    return parser


def _effects(options: argparse.Namespace, terminal: Terminal, cancelled: IsCancelled) -> int:
    found = [effect(name) for name in options.name] or list(effects().values())
    terminal({"event": "done", "effects": [effect_to_json(item) for item in found]})
    terminal.line("\n\n".join(_effect_text(item) for item in found))
    return 0


def _effect_text(item: Effect) -> str:
    lines = [f"{item.name} ({item.kind}): {item.summary}"]
    lines += [f"    {title.lower()}: {item.section(title)}" for title in ("Equation", "Bodies", "Source")]
    for p in item.parameters:
        unit = "" if p.unit == "1" else f" {p.unit}"
        lines.append(f"    {p.name} = {p.default:g}{unit}, {p.low:g} to {p.high:g}: {p.description}")
    return "\n".join(lines)


def _doctor(options: argparse.Namespace, terminal: Terminal, cancelled: IsCancelled) -> int:
    report = install_commands.examine()
    terminal({"event": "done", "report": report})
    terminal.line("\n".join(f"{'ok     ' if ok else 'MISSING'} {name}: {text}" for name, ok, text in report))
    return 0 if all(ok for _, ok, _ in report) else InputError.exit_code


def _keep_negative_vectors(arguments: Sequence[str]) -> list[str]:
    """Return ``arguments`` with a leading space before negative vectors, which argparse takes for flags."""
    return [f" {a}" if re.match(r"-[\d.][\d.,eE+-]*$", a) else a for a in arguments]


def recover(options: argparse.Namespace, terminal: Terminal) -> None:
    """Put back or remove what killed runs left of the files and folders that the command names, and among the system's
    temporary files; say so."""
    recovered = atomic.recover_scratch()
    for path in (*_named_paths(options), config_folder() / LIST_FILE):
        recovered += atomic.recover(path)
        for lock in (path / LOCK_FILE, path.with_name(f".{path.name}{LOCK_FILE}")):
            remove_dead_lock(lock)
    for sentence in recovered:
        terminal({"event": "notice", "stage": "recover", "message": sentence})


def _named_paths(options: argparse.Namespace) -> Iterator[Path]:
    for value in vars(options).values():
        for item in value if isinstance(value, list) else [value]:
            if isinstance(item, Path) and item.name:
                yield item


def _require_utf8(options: argparse.Namespace) -> None:
    """Raise InputError for a path whose bytes are no UTF-8: libraries below would end in the middle of the work."""
    here = []
    # A working folder that is gone is none.
    with contextlib.suppress(OSError):
        here.append(Path.cwd())
    for path in (*_named_paths(options), *here):
        if not utf8(str(path)):
            raise InputError(f"{shown(path)}: {NOT_UTF8}")


def force_exit(terminal: Terminal) -> NoReturn:
    """End a command that does not stop by itself, and leave nothing of it but what was complete."""
    kill_children()
    atomic.remove_unfinished()
    release_all()
    terminal.error("Cancelled", "cancelled in the middle of a long step; run it again to continue")
    os._exit(Cancelled.exit_code)


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point of ``physgen``; returns the exit code (docs/cli.md)."""
    try:
        return _main(arguments)
    finally:
        if arguments is None:
            # Python ends next and puts the system's own handlers back: a signal would be the exit code of work done.
            for number in STOP_SIGNALS:
                signal.signal(number, signal.SIG_IGN)


def _expected_seconds(options: argparse.Namespace) -> dict[str, float] | None:
    """Return first guesses of the stages of a command that has several; None for others."""
    if options.command == "run":
        return stages.expected_seconds(options.frames or BakeOptions.frames)
    return dict(stages.EXPLAIN_SECONDS) if options.command == "explain" else None


def _main(arguments: Sequence[str] | None) -> int:
    # Help, too, has arrows and quotes that not every encoding has.
    tolerant(sys.stdout)
    options = build_parser().parse_args(_keep_negative_vectors(sys.argv[1:] if arguments is None else arguments))
    terminal = Terminal(as_json=options.json, expected_s=_expected_seconds(options))
    run: Command = options.run
    if getattr(options, "anyway", False):
        # For the processes that this one starts, too.
        os.environ[ANYWAY] = "1"
    with stop_signals(lambda: force_exit(terminal)) as stopped:
        try:
            _require_utf8(options)
            # Before this command has a temporary folder of its own: the others' are beside it.
            recover(options, terminal)
            with atomic.own_scratch():
                return run(options, terminal, lambda: stopped() or terminal.reader_gone)
        except PhysGenError as error:
            terminal.error(type(error).__name__, str(error))
            if isinstance(error, Cancelled) and arguments is None:
                # Not the seconds that some libraries take to unload.
                sys.stdout.flush()
                os._exit(error.exit_code)
            return error.exit_code
        # A path that no file system takes, a disk that went away, no memory left: one line, like any other mistake.
        except OSError as error:
            name = "" if error.filename is None else f"{shown(atomic.final_path(Path(str(error.filename))))}: "
            terminal.error(InputError.__name__, f"{name}{error.strerror or error}; choose another path, or free space")
            return InputError.exit_code
        except Exception as error:
            if not ran_out(error):
                raise
            terminal.error(InputError.__name__, f"{options.command}: {OUT_OF_MEMORY}")
            return InputError.exit_code


if __name__ == "__main__":
    sys.exit(main())
