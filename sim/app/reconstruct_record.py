# SPDX-License-Identifier: MIT
"""``reconstruct.json``: what a scene folder was reconstructed from; to whoever reads it, a stranger's wishes.

Its paths and adapters reach beyond the folder, so it is ``Untrusted`` (``sim/trust.py``): a folder that this user made
is in their list, any other counts after their word.

Also the programs and files that an adapter's specification would run or read, found without running it, for consent.
"""

from __future__ import annotations

import dataclasses
import importlib.util
import os
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from ..errors import InputError
from ..files import read_bytes
from ..reconstruct import ObjectRequest, ReconstructOptions
from ..reconstruct.adapters.adapter_registry import PROGRAMS, split_spec
from ..reconstruct.adapters.command_file import read_command_file
from ..reconstruct.adapters.protocols import STAGES
from ..reconstruct.models import known_models
from ..reconstruct.reconstruct_options import WITHOUT
from ..scene.folder import Scene
from ..scene.scene_output import STAMP_FILE
from ..trust import NOTHING, READS, RUNS, Agreed, Claim, Replaced, Untrusted, UntrustedSpec, code_hash, trusted_spec
from ..validation import MAX_JSON_BYTES, json_value, parse, to_json


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


T = TypeVar("T")


@dataclass(frozen=True, kw_only=True)
class Request:
    """The inputs that a scene was reconstructed from: ``photo``, ``objects`` and ``options``, with absolute paths."""

    photo: Path
    objects: tuple[ObjectRequest, ...]
    options: ReconstructOptions


@dataclass(frozen=True, kw_only=True)
class Stamp:
    """Record of what a scene folder was reconstructed from.

    inputs_hash: of all that the scene depends on. presets: material presets asked for, by object. scene: ``scene.json``
    as reconstructed, before physics or light were edited. request: what was asked for.
    """

    inputs_hash: str
    presets: tuple[str | None, ...]
    scene: Any
    request: Untrusted[Request]


@dataclass(frozen=True, kw_only=True)
class _File:
    inputs_hash: str
    photo: Path
    objects: tuple[ObjectRequest, ...]
    options: ReconstructOptions
    scene: Any


def stamp_to_json(inputs_hash: str, request: Request, scene: Any) -> dict[str, Any]:
    """Return the content of ``reconstruct.json``; ``scene`` is that of ``scene.json``. Paths become absolute."""
    file = _File(
        inputs_hash=inputs_hash,
        photo=request.photo.resolve(),
        objects=tuple(_resolved(item, ("mask", "mesh")) for item in request.objects),
        options=_resolved(request.options, ("environment", "depth")),
        scene=scene,
    )
    return to_json(file)  # type: ignore[no-any-return]


def _resolved(value: T, names: Sequence[str]) -> T:
    """Return the dataclass ``value`` with the paths in its fields ``names`` absolute."""
    paths = {name: path.resolve() for name in names if (path := getattr(value, name)) is not None}
    return dataclasses.replace(value, **paths)  # type: ignore[type-var]


def read_stamp(root: Path) -> Stamp | None:
    """Return the record of what the folder ``root`` was reconstructed from; None without one, or of another version."""
    path = root / STAMP_FILE
    try:
        content = read_bytes(path, MAX_JSON_BYTES, folder=root)
        file = parse(_File, json_value(content, STAMP_FILE), STAMP_FILE)
    except (FileNotFoundError, InputError):
        return None
    return Stamp(
        inputs_hash=file.inputs_hash,
        presets=tuple(item.preset for item in file.objects),
        scene=file.scene,
        request=Untrusted(
            path,
            content,
            lambda: list(_claims(file, root)),
            lambda replaced: _released(file, replaced),
        ),
    )


def require_stamp(scene: Scene) -> Stamp:
    """Return the record of what ``scene`` was reconstructed from. Raises InputError when it has none."""
    stamp = read_stamp(scene.root)
    if stamp is None:
        raise InputError(
            f"{scene.root}: has no record of its reconstruction ({STAMP_FILE} is missing or of another version); "
            "reconstruct it from the photo again"
        )
    return stamp


def require_request(scene: Scene, agreed: Agreed | None = None, replaced: Replaced = NOTHING) -> Request:
    """Return what ``scene`` was reconstructed from, for a correction.

    agreed: asked about paths and adapters of a folder that this user has neither made nor agreed to. replaced:
    values that are given anew, by fields such as ``options.segmenter`` and ``objects.cup.mask``. Raises InputError
    without a record, and ``NotTrusted``.
    """
    return require_stamp(scene).request.opened(agreed, replaced)


def _claims(file: _File, root: Path) -> Iterator[Claim]:
    """Yield all that the record asks for beyond the folder ``root``: every path and every adapter in it."""
    for where, path in _paths(file):
        if not _within(path, root):
            yield Claim(READS, where, str(path))
    for stage in STAGES:
        spec = getattr(file.options, stage)
        if spec is not None:
            text = spec.claimed() if isinstance(spec, UntrustedSpec) else str(spec)
            claim = spec_claim(stage, text, f"options.{stage}")
            if claim is not None:
                yield claim


def _within(path: Path, root: Path) -> bool:
    """Return whether ``path`` is in the folder ``root``, links followed.

    Nothing outside is touched to find out: on Windows a look at another computer's folder tells it who looks.
    """
    try:
        home = root.resolve()
        named = Path(os.path.normpath(path.absolute()))
        if not (named.is_relative_to(home) or named.is_relative_to(root.absolute())):
            return False
        # A link may lead out.
        return path.resolve().is_relative_to(home)
    except (OSError, ValueError, RuntimeError):
        return False


def _paths(file: _File) -> Iterator[tuple[str, Path]]:
    """Yield every field that is a path: by its type, so that none can be forgotten."""
    yield "photo", file.photo
    for number, item in enumerate(file.objects, start=1):
        for field in dataclasses.fields(item):
            value = getattr(item, field.name)
            if isinstance(value, Path):
                yield f"objects.{item.name or f'object_{number}'}.{field.name}", value
    for field in dataclasses.fields(file.options):
        value = getattr(file.options, field.name)
        if isinstance(value, Path):
            yield f"options.{field.name}", value


def _released(file: _File, replaced: Replaced) -> Request:
    """Return the request for use; called by ``Untrusted.opened`` alone."""
    options: dict[str, Any] = {}
    for stage in STAGES:
        spec = getattr(file.options, stage)
        options[stage] = trusted_spec(spec.claimed()) if isinstance(spec, UntrustedSpec) else spec
    fields = [field.name for field in dataclasses.fields(ReconstructOptions)]
    options |= {name: replaced[f"options.{name}"] for name in fields if f"options.{name}" in replaced}
    objects = []
    for number, item in enumerate(file.objects, start=1):
        start = f"objects.{item.name or f'object_{number}'}."
        given = {name.removeprefix(start): value for name, value in replaced.items() if name.startswith(start)}
        objects.append(dataclasses.replace(item, **given))
    return Request(
        photo=file.photo,
        objects=tuple(objects),
        options=dataclasses.replace(file.options, **options),
    )
