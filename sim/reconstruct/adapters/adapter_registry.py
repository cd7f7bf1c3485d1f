# SPDX-License-Identifier: MIT
"""Adapters by name: command files, the user's TOML table, installed packages, and their status.

The table, named by the environment variable ``PHYSGEN_ADAPTERS``, maps names to specifications for each stage;
relative paths are relative to it:

    [inpainter]
    lama = "lama:models/lama.onnx"

A package registers ``STAGE.NAME`` in the entry point group ``physgen.adapters``, a function as in ``protocols``. A
command file is a TOML file that says how a user's own program is run in place of a stage (docs/extending.md).
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import importlib.util
import os
import re
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ...errors import InputError
from ...files import MOST_HASHED, open_file
from ...files import read_toml as bounded_toml
from ...scene.meshes import MESH_SUFFIXES
from ...trust import Spec, trusted_spec
from ..models.known_models import PackagedModel
from ..models.model_folder import list_models
from ..reconstruct_options import WITHOUT
from .protocols import MEANINGS, STAGES
from .python_adapter import function_problem

MAX_BYTES = 64 * 2**10
MOST_SECONDS = 86_400.0
PLACEHOLDERS = {
    "segmenter": ("input", "boxes", "output"),
    "inpainter": ("input", "mask", "output"),
    "depth_estimator": ("input", "output"),
    "mesher": ("input", "photo", "mask", "output"),
}
ALWAYS = ("here", "python", "program", "program_python")
OUTPUTS = {
    "segmenter": ("masks.npy", (".npy", ".npz", "")),
    "inpainter": ("filled.png", (".png",)),
    "depth_estimator": ("depth.npy", (".npy", ".npz")),
    "mesher": ("mesh.glb", (".glb", ".gltf", ".obj", ".ply", ".stl", "")),
}
"""Default file name of ``{output}``, and its allowed extensions; "": a folder of PNGs."""
_KEYS = ("stage", "command", "output", "folder", "time_limit_s", "environment", "meaning", "description", "results")
_PATTERN = re.compile(r"(?:[A-Za-z0-9_*-][A-Za-z0-9_.*-]*/){0,4}[A-Za-z0-9_*-][A-Za-z0-9_.*-]*")
_PLACEHOLDER = re.compile(r"\{([a-z_]+)\}")


@dataclass(frozen=True, kw_only=True)
class CommandFile:
    """A user's program for one ``stage``.

    command: arguments with placeholders such as ``{input}``. output: file name of ``{output}``. folder: working
    directory; None is the temporary folder of its files. time_limit_s: after which it is killed. environment:
    additional variables. meaning: of a depth, one of ``MEANINGS``.
    results: of a mesher that writes a folder, names or patterns of its mesh; the first that is there counts. program:
    folder of the program, for a file that serves any place.
    """

    path: Path
    stage: str
    command: tuple[str, ...]
    output: str
    folder: Path | None
    time_limit_s: float
    environment: tuple[tuple[str, str], ...]
    meaning: str
    results: tuple[str, ...] = ()
    program: Path | None = None

    def arguments(self, places: dict[str, Path | str]) -> list[str]:
        """Return the command with every placeholder replaced by its value in ``places``."""
        return [_PLACEHOLDER.sub(lambda match: str(places[match[1]]), part) for part in self.command]


def read_command_file(path: Path, stage: str, program: Path | None = None) -> CommandFile:
    """Read and validate the file ``path`` for ``stage`` without running anything. Raises InputError.

    program: folder of the program that it is for, which is then its working folder.
    """
    data = read_toml(path)
    unknown = sorted(set(data) - set(_KEYS))
    if unknown:
        raise InputError(f"{path}: {unknown[0]}: unknown key; known are {', '.join(_KEYS)}")
    if data.get("stage") not in STAGES:
        raise InputError(f"{path}: stage is {_brief(data.get('stage'))}; choose one of {', '.join(STAGES)}")
    if data["stage"] != stage:
        raise InputError(f"{path}: is for the stage {data['stage']}, not for {stage}")
    limit = data.get("time_limit_s", 600)
    if isinstance(limit, bool) or not isinstance(limit, int | float) or not 0 < limit <= MOST_SECONDS:
        raise InputError(f"{path}: time_limit_s is {_brief(limit)}; give seconds up to {MOST_SECONDS:g}")
    meaning = data.get("meaning", "relative")
    if meaning not in MEANINGS:
        raise InputError(f"{path}: meaning is {_brief(meaning)}; choose one of {', '.join(MEANINGS)}")
    command, output = _command(data.get("command"), stage, path), _output(data.get("output"), stage, path)
    if program is None and any("{program" in part for part in command):
        raise InputError(f"{path}: command has {{program}}: it is one of the shipped files; name yours by its place")
    return CommandFile(
        path=path,
        stage=stage,
        command=command,
        output=output,
        results=_results(data.get("results"), stage, output, path),
        program=program,
        folder=program or _folder(data.get("folder"), path),
        time_limit_s=float(limit),
        environment=_environment(data.get("environment", {}), path),
        meaning=meaning,
    )


def read_toml(path: Path) -> dict[str, Any]:
    """Return the content of the small TOML file ``path``. Raises InputError."""
    try:
        return bounded_toml(path, MAX_BYTES, what="adapter file")
    except FileNotFoundError:
        raise InputError(f"{path}: there is no such file; its contents are described in docs/extending.md") from None


def _command(value: Any, stage: str, path: Path) -> tuple[str, ...]:
    good = isinstance(value, list) and value and all(isinstance(p, str) and "\0" not in p for p in value)
    if not good:
        raise InputError(f"{path}: command: expected a list of arguments, as ['/usr/bin/python3', '{{here}}/fill.py']")
    allowed = PLACEHOLDERS[stage] + ALWAYS
    used = {name for part in value for name in _PLACEHOLDER.findall(part)}
    wrong = sorted(used - set(allowed))
    if wrong:
        raise InputError(f"{path}: command has {{{wrong[0]}}}; of a {stage} there are {{{'}, {'.join(allowed)}}}")
    if "output" not in used or ("input" not in used and "photo" not in used):
        raise InputError(f"{path}: command: has no {{input}} or no {{output}}; it must contain both")
    return tuple(value)


def _output(value: Any, stage: str, path: Path) -> str:
    usual, endings = OUTPUTS[stage]
    if value is None:
        return usual
    good = isinstance(value, str) and re.fullmatch(r"[A-Za-z0-9_-]+(\.[A-Za-z0-9]+)?", value)
    if not good or Path(value).suffix.lower() not in endings:
        shown = ", ".join(ending or "none (a folder)" for ending in endings)
        raise InputError(f"{path}: output is {_brief(value)}; give a file name with one of the endings {shown}")
    return str(value)


def _results(value: Any, stage: str, output: str, path: Path) -> tuple[str, ...]:
    wanted = stage == "mesher" and not Path(output).suffix
    if value is None and not wanted:
        return ()
    good = isinstance(value, list) and value and all(isinstance(p, str) and _PATTERN.fullmatch(p) for p in value)
    if not wanted or not good or any(Path(p).suffix.lower() not in MESH_SUFFIXES for p in value):
        raise InputError(
            f"{path}: results is {_brief(value)}; a mesher whose output is a folder has patterns of mesh files in it, "
            "as ['mesh.glb', '*/*_textured.glb'], and nothing else has them"
        )
    return tuple(value)


def _folder(value: Any, path: Path) -> Path | None:
    if value is None:
        return None
    if not isinstance(value, str) or "\0" in value or not (path.resolve().parent / value).is_dir():
        raise InputError(
            f"{path}: folder is {_brief(value)}: there is no such folder; leave it out for a temporary one"
        )
    return path.resolve().parent / value


def _environment(value: Any, path: Path) -> tuple[tuple[str, str], ...]:
    good = isinstance(value, dict) and all(
        isinstance(text, str) and name and not set("=\0") & set(name) and "\0" not in text
        for name, text in value.items()
    )
    if not good:
        raise InputError(f"{path}: environment: expected texts by the names of variables")
    return tuple(sorted(value.items()))


def _brief(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


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
