# SPDX-License-Identifier: MIT
"""Adapters by name: the user's TOML table, installed packages, programs that make meshes; and their status.

The table, named by the environment variable ``PHYSGEN_ADAPTERS``, maps names to specifications for each stage;
relative paths are relative to it:

    [inpainter]
    lama = "lama:models/lama.onnx"

A package registers ``STAGE.NAME`` in the entry point group ``physgen.adapters``, a function as in ``protocols``.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import importlib.util
import os
import shutil
from dataclasses import dataclass
from pathlib import Path

from ...errors import InputError
from ...files import MOST_HASHED, open_file
from ...trust import Spec, trusted_spec
from ..models.known_models import PackagedModel
from ..models.model_folder import list_models
from ..reconstruct_options import WITHOUT
from .command_file import CommandFile, read_command_file, read_toml
from .protocols import STAGES
from .python_adapter import function_problem

PROGRAM_PYTHON = "PHYSGEN_MESHER_PYTHON"
PRESETS = Path(__file__).resolve().parents[3] / "presets" / "meshers"
VARIABLE = "PHYSGEN_ADAPTERS"
GROUP = "physgen.adapters"
PATHS = ("command", "lama", "picture", "isnet")
"""Adapter types whose target is a file."""
DIFFUSERS = "diffusers-inpaint"
FOLDERS = ("sam", "sam2", "depth-anything", "depth-pro", DIFFUSERS)
"""Adapter types whose target is a folder of weights for transformers or diffusers."""
PROGRAMS = ("sam-3d-objects", "trellis", "hunyuan3d", "triposg")
"""Adapter types whose target is the folder of a program that makes meshes; ``presets/meshers`` says how each is run."""
ADAPTER_TYPES = (*PATHS, *FOLDERS, *PROGRAMS, "python")
OF_STAGE = {
    "lama": "inpainter",
    "picture": "inpainter",
    DIFFUSERS: "inpainter",
    "isnet": "segmenter",
    "sam": "segmenter",
    "sam2": "segmenter",
    "depth-anything": "depth_estimator",
    "depth-pro": "depth_estimator",
    **dict.fromkeys(PROGRAMS, "mesher"),
}
"""Stage of the types that serve one only."""


def program_command(kind: str, folder: Path) -> CommandFile:
    """Return how the program ``kind`` of ``PROGRAMS`` in ``folder`` is run. Raises InputError where it is not there."""
    if not folder.is_dir():
        raise InputError(f"{kind}: there is no folder {folder}; give the one that the program was cloned into")
    program_python(folder)
    return read_command_file(PRESETS / f"{kind}.toml", "mesher", folder.resolve())


def program_python(folder: Path) -> Path:
    """Return the interpreter of the program in ``folder``: PHYSGEN_MESHER_PYTHON, else that of its environment."""
    named = os.environ.get(PROGRAM_PYTHON, "").strip()
    inside = ("Scripts/python.exe",) if os.name == "nt" else ("bin/python",)
    places = [Path(named)] if named else [folder / name / part for name in (".venv", "venv") for part in inside]
    for place in places:
        if place.is_file():
            # Not resolved: a link is how an environment knows its packages.
            return place.absolute()
    shown = ", ".join(map(str, places))
    raise InputError(f"{folder}: no Python of its own was found ({shown}); name it in {PROGRAM_PYTHON}")


def weights_folder(kind: str, folder: Path) -> Path:
    """Return where the weights of ``kind`` are in ``folder``: in the part of that name if there is one, else there."""
    return folder / kind if (folder / kind / weights_index(kind)).is_file() else folder


def weights_index(kind: str) -> str:
    """Return the file that says what a folder of weights of ``kind`` holds."""
    return "model_index.json" if kind == DIFFUSERS else "config.json"


@dataclass(frozen=True, kw_only=True)
class NamedAdapter:
    """A named adapter. spec: ``TYPE:TARGET``, or None with an entry point; source: the file or package that names
    it."""

    stage: str
    name: str
    spec: str | None
    entry_point: importlib.metadata.EntryPoint | None
    source: str


def split_spec(spec: str) -> tuple[str, str] | None:
    """Return type and target of ``TYPE:TARGET``; None for a bare name."""
    kind, colon, target = spec.partition(":")
    return (kind, target) if colon and kind in ADAPTER_TYPES else None


def adapters_file() -> Path | None:
    """Return the user's file of names, if the environment variable is set."""
    value = os.environ.get(VARIABLE, "").strip()
    return Path(value).expanduser() if value else None


def named_adapters(path: Path | None = None) -> list[NamedAdapter]:
    """Return all names: those of the user's file, of packages, of installed models; the first of a name counts.

    path: the user's file, else ``adapters_file()``. Raises InputError.
    """
    path = path or adapters_file()
    found = [] if path is None else _from_file(path)
    for point in importlib.metadata.entry_points(group=GROUP):
        stage, dot, name = point.name.partition(".")
        if dot and stage in STAGES:
            package = point.dist.name if point.dist is not None else "an installed package"
            found.append(NamedAdapter(stage=stage, name=name, spec=None, entry_point=point, source=package))
    for status in list_models():
        if status.is_installed:
            model = status.model
            spec = f"{model.name}:{status.path}"
            found.append(
                NamedAdapter(stage=model.stage, name=model.name, spec=spec, entry_point=None, source="physgen models")
            )
    return found


def spec_files(stage: str, spec: str, names: Path | None = None) -> list[Path]:
    """Return the known files that ``spec`` depends on, to detect changes.

    names: the user's file, else ``adapters_file()``. Raises InputError if that cannot be read.
    """
    parts, found = split_spec(spec), []
    if parts is None:
        table = names or adapters_file()
        found = [] if table is None else [table]
        named = [a.spec for a in named_adapters(names) if (a.stage, a.name) == (stage, spec) and a.spec is not None]
        parts = split_spec(named[0]) if named else None
    if parts is not None and parts[0] in FOLDERS:
        # The weights themselves are gigabytes: their configuration stands for them.
        found.append(Path(parts[1]).expanduser().absolute() / weights_index(parts[0]))
    elif parts is not None:
        kind, target = parts
        path = target if kind in PATHS else target.rpartition(":")[0]
        if kind in PATHS or path.endswith(".py"):
            found.append(Path(path).expanduser().absolute())
    return [path for path in found if path.is_file()]


def chosen_segmenter(asked: Spec | None) -> str | None:
    """Return the segmenter for what a user ``asked``: by default an installed model that can be used, if there is one.

    None is the weight-free way.
    """
    if asked is not None:
        return None if asked == WITHOUT else trusted_spec(asked)
    if onnxruntime_version() is None:
        return None
    good = [item.model for item in list_models() if item.is_installed and item.problem is None]
    # What runs through transformers takes minutes on a CPU, so that it is for those who name it.
    return next((model.name for model in good if isinstance(model, PackagedModel)), None)


def _content(path: Path) -> str:
    with open_file(path, MOST_HASHED, what="file of an adapter") as file:
        return hashlib.file_digest(file, lambda: hashlib.blake2b(digest_size=16)).hexdigest()


def adapter_content(stage: str, spec: Spec | None) -> tuple[str, ...]:
    """Return the specification and the hashes of its files, as a cache key; () for none."""
    if spec is None:
        return ()
    spec = trusted_spec(spec)
    try:
        return (
            spec,
            *(_content(path) for path in spec_files(stage, spec)),
        )
    except OSError as error:
        raise InputError(f"{stage} {spec}: cannot be read ({error.strerror or error}); check its files") from None


def _from_file(path: Path) -> list[NamedAdapter]:
    found = []
    for stage, names in read_toml(path).items():
        if stage not in STAGES or not isinstance(names, dict):
            raise InputError(f"{path}: {stage}: expected the tables {', '.join(f'[{s}]' for s in STAGES)}")
        for name, spec in names.items():
            parts = split_spec(spec) if isinstance(spec, str) else None
            if parts is None or ":" in name:
                raise InputError(
                    f"{path}: {stage}.{name}: expected a text, one of {', '.join(f'{k}:…' for k in ADAPTER_TYPES)}"
                )
            found.append(
                NamedAdapter(
                    stage=stage, name=name, spec=_absolute(*parts, path.parent), entry_point=None, source=str(path)
                )
            )
    return found


def _absolute(kind: str, target: str, folder: Path) -> str:
    if kind in PATHS + FOLDERS + PROGRAMS:
        return f"{kind}:{folder / Path(target).expanduser()}"
    module, colon, name = target.rpartition(":")
    return f"{kind}:{folder / Path(module).expanduser()}{colon}{name}" if module.endswith(".py") else f"{kind}:{target}"


@dataclass(frozen=True, kw_only=True)
class AdapterStatus:
    """An adapter and whether it can be used, as far as can be checked without running it.

    text: its specification, or the problem.
    """

    stage: str
    name: str
    usable: bool
    text: str


def list_adapters() -> list[AdapterStatus]:
    """Return all named adapters. An unreadable file of names is returned as an unusable adapter."""
    try:
        named = named_adapters()
    except InputError as error:
        return [AdapterStatus(stage="adapters", name=str(adapters_file()), usable=False, text=str(error))]
    return [_status(adapter) for adapter in named]


def onnxruntime_version() -> str | None:
    """Return the version of the installed onnxruntime, without importing it; None if there is none."""
    for name in ("onnxruntime", "onnxruntime-gpu", "onnxruntime-directml"):
        try:
            return importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return "of unknown version" if importlib.util.find_spec("onnxruntime") else None


def _status(adapter: NamedAdapter) -> AdapterStatus:
    if adapter.entry_point is not None:
        problem, what = (
            function_problem(f"{adapter.entry_point.module}:x"),
            f"{adapter.entry_point.value} of {adapter.source}",
        )
    else:
        assert adapter.spec is not None
        kind, _, target = adapter.spec.partition(":")
        problem, what = _problem(adapter.stage, kind, target), adapter.spec
    text = what if problem is None else f"{what}: {problem}"
    return AdapterStatus(stage=adapter.stage, name=adapter.name, usable=problem is None, text=text)


def other_stage(kind: str, stage: str) -> str:
    """Return that adapters of the type ``kind`` are of another stage than ``stage``."""
    article = "an" if OF_STAGE[kind][0] in "aeio" else "a"
    return f"is {article} {OF_STAGE[kind]}, not a {stage}"


def _problem(stage: str, kind: str, target: str) -> str | None:
    if kind == "python":
        return function_problem(target)
    path = Path(target)
    if kind == "command":
        try:
            program = read_command_file(path, stage).command[0]
        except InputError as error:
            return str(error)
        if program.startswith("{"):
            return None
        return None if shutil.which(program) else f"there is no program {program}"
    if stage != OF_STAGE[kind]:
        return other_stage(kind, stage)
    if kind in PROGRAMS:
        try:
            program_command(kind, path)
        except InputError as error:
            return str(error)
        return None
    if kind in FOLDERS:
        from ...gaussians.guidance import pretrained_models
        from . import diffusers_adapter, transformers_adapter

        if kind == DIFFUSERS:
            found, lacking = diffusers_adapter.pipeline_problem(path), pretrained_models.missing_packages()
        else:
            found, lacking = transformers_adapter.folder_problem(kind, path), transformers_adapter.missing_packages()
        return found or (f"needs {', '.join(lacking)}; install physgen[models]" if lacking else None)
    if not path.is_file():
        return "there is no such file"
    if kind in ("lama", "isnet") and onnxruntime_version() is None:
        return "needs onnxruntime; install physgen[models]"
    return None
