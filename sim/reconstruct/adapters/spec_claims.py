# SPDX-License-Identifier: MIT
"""Programs and files that an adapter's specification would run or read, found without running it, for consent."""

from __future__ import annotations

import importlib.util
import shutil
from pathlib import Path

from ...errors import InputError
from ...trust import READS, RUNS, Claim, code_hash
from ..models import known_models
from ..reconstruct_options import WITHOUT
from .adapter_registry import PROGRAMS, read_command_file, split_spec


def spec_claim(stage: str, spec: str, where: str) -> Claim | None:
    """Return what ``spec`` for ``stage`` asks for; None for the built-in ways and the models that PhysGen installs.

    where: its field. A name of the user's own table or of an installed package is a claim, too: which of the user's
    programs a photo goes to is for the user to say.
    """
    parts = split_spec(spec)
    if parts is None:
        if spec == WITHOUT or any((model.stage, model.name) == (stage, spec) for model in known_models.KNOWN):
            return None
        return Claim(RUNS, where, f"{spec} (an adapter of this machine)")
    kind, target = parts
    if kind == "python":
        return _function_claim(spec, target, where)
    path = Path(target).expanduser().absolute()
    if kind == "command":
        return _command_claim(stage, spec, path, where)
    if kind in PROGRAMS:
        return Claim(RUNS, where, f"{kind}:{path}", code_hash([path]))
    return Claim(READS, where, f"{kind}:{path}")


def _function_claim(spec: str, target: str, where: str) -> Claim:
    module, _, _ = target.rpartition(":")
    if module.endswith(".py"):
        path = Path(module).absolute()
        return Claim(RUNS, where, f"{spec} ({path})", code_hash([path.parent]))
    places: list[Path] = []
    try:
        # Of a.b.c only a is looked up: more would import a and a.b.
        found = importlib.util.find_spec(module.partition(".")[0])
    except (ImportError, ValueError, AttributeError):
        found = None
    if found is not None:
        folders = [Path(place) for place in found.submodule_search_locations or ()]
        places = folders or ([Path(found.origin)] if found.origin else [])
    # What was installed is the user's; what merely lies in the working folder may have come with the file.
    places = [place for place in places if "site-packages" not in place.parts]
    shown = f" ({places[0]})" if places else ""
    return Claim(RUNS, where, f"{spec}{shown}", code_hash(places))


def _command_claim(stage: str, spec: str, path: Path, where: str) -> Claim:
    try:
        file = read_command_file(path, stage)
    except InputError:
        return Claim(RUNS, where, spec, code_hash([path]))
    here = str(path.resolve().parent)
    words = [word.replace("{here}", here) for word in file.command]
    places = [path.parent, *([file.folder] if file.folder else [])]
    places += [Path(word) for word in words[1:] if Path(word).is_absolute() and Path(word).is_file()]
    program = shutil.which(words[0])
    places += [Path(program)] if program else []
    environment = "".join(f" {name}={text!r}" for name, text in file.environment)
    return Claim(RUNS, where, f"{spec}: {words}{environment}", code_hash(places))
