# SPDX-License-Identifier: MIT
"""Resolve an adapter specification to a callable that replaces a stage.

python:MODULE:FUNCTION, python:FILE.py:FUNCTION a function as in ``protocols``
command:FILE.toml a program (``command_adapter``)
lama:FILE.onnx inpainting by LaMa through onnxruntime (``onnx_adapter``)
isnet:FILE.onnx segmentation by IS-Net through onnxruntime (``onnx_adapter``)
sam:FOLDER, sam2:FOLDER, depth-anything:FOLDER, depth-pro:FOLDER through transformers (``transformers_adapter``)
diffusers-inpaint:FOLDER inpainting through diffusers (``diffusers_adapter``)
sam-3d-objects:FOLDER, trellis:FOLDER, hunyuan3d:FOLDER, triposg:FOLDER programs that make meshes
picture:FILE inpainting from a picture without the objects (``picture_adapter``)
NAME one of these by name (``adapter_registry``)
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal, overload

from ...errors import InputError
from ...events import IsCancelled, never
from ...trust import TrustedSpec, UntrustedSpec, trusted_spec
from ..models import known_models
from ..models.model_folder import models_folder
from .adapter_registry import (
    ADAPTER_TYPES,
    DIFFUSERS,
    FOLDERS,
    OF_STAGE,
    PROGRAMS,
    named_adapters,
    other_stage,
    program_command,
    split_spec,
)
from .command_adapter import DepthCommand, InpainterCommand, MesherCommand, SegmenterCommand
from .command_file import read_command_file
from .onnx_adapter import load_isnet, load_lama
from .picture_adapter import load_picture
from .protocols import STAGES, DepthEstimator, Inpainter, Mesher, Segmenter
from .python_adapter import (
    DepthFunction,
    InpainterFunction,
    MesherFunction,
    SegmenterFunction,
    checked_function,
    load_function,
)

_FUNCTIONS: dict[str, Callable[[Callable[..., Any], str], Any]] = {
    "segmenter": SegmenterFunction,
    "inpainter": InpainterFunction,
    "depth_estimator": DepthFunction,
    "mesher": MesherFunction,
}
_COMMANDS: dict[str, Callable[..., Any]] = {
    "segmenter": SegmenterCommand,
    "inpainter": InpainterCommand,
    "depth_estimator": DepthCommand,
    "mesher": MesherCommand,
}
_FILES: dict[str, Callable[[Path, str], Any]] = {"lama": load_lama, "picture": load_picture, "isnet": load_isnet}


@overload
def resolve(
    stage: Literal["segmenter"], spec: TrustedSpec, cancelled: IsCancelled = ..., names: Path | None = ...
) -> Segmenter: ...
@overload
def resolve(
    stage: Literal["inpainter"], spec: TrustedSpec, cancelled: IsCancelled = ..., names: Path | None = ...
) -> Inpainter: ...
@overload
def resolve(
    stage: Literal["depth_estimator"], spec: TrustedSpec, cancelled: IsCancelled = ..., names: Path | None = ...
) -> DepthEstimator: ...
@overload
def resolve(
    stage: Literal["mesher"], spec: TrustedSpec, cancelled: IsCancelled = ..., names: Path | None = ...
) -> Mesher: ...
def resolve(stage: str, spec: TrustedSpec, cancelled: IsCancelled = never, names: Path | None = None) -> Any:
    """Return the adapter ``spec`` for ``stage``, as in ``protocols``; nothing is run yet.

    cancelled: polled while a program runs; a Python function is not interrupted. names: the user's file of names, in
    place of the environment's.

    Calls of the result raise InputError that names the adapter, for exceptions of the user's code and for invalid
    results. Raises InputError for a specification that cannot be found or does not fit ``stage``.
    """
    if stage not in STAGES:
        raise InputError(f"stage {stage!r}: is unknown; choose one of {', '.join(STAGES)}")
    if isinstance(spec, UntrustedSpec):
        # Types keep it out of this tree's code; this keeps it out of everybody's.
        trusted_spec(spec)
    parts = split_spec(spec)
    if parts is not None:
        return _of_kind(stage, *parts, cancelled)
    known = named_adapters(names)
    for adapter in known:
        if (adapter.stage, adapter.name) != (stage, spec):
            continue
        if adapter.spec is not None:
            kind, _, target = adapter.spec.partition(":")
            return _of_kind(stage, kind, target, cancelled)
        assert adapter.entry_point is not None
        where = f"adapter {spec} of {adapter.source}"
        try:
            function = adapter.entry_point.load()
        # A user's package may raise anything.
        except Exception as error:
            raise InputError(f"{where}: cannot be imported ({type(error).__name__}: {error})") from error
        return _FUNCTIONS[stage](checked_function(function, stage, where), where)
    if OF_STAGE.get(spec) == stage and spec in FOLDERS:
        # Before the message for what is merely not installed: most have such weights somewhere.
        place = models_folder() / spec
        raise InputError(
            f"{stage} {spec!r}: has no weights in {place}; name their folder by --weights DIR, or {spec}:DIR"
        )
    if any((model.stage, model.name) == (stage, spec) for model in known_models.KNOWN):
        raise InputError(
            f"{stage} {spec!r}: is not installed; run physgen models install {spec}, or leave the option out"
        )
    shown = ", ".join(a.name for a in known if a.stage == stage) or "none"
    raise InputError(
        f"{stage} {spec!r}: there is no adapter of that name (known: {shown}); give a name, or one of "
        f"{', '.join(f'{kind}:…' for kind in ADAPTER_TYPES)} (docs/extending.md)"
    )


def _of_kind(stage: str, kind: str, target: str, cancelled: IsCancelled) -> Any:
    where = f"adapter {kind}:{target}"
    if not target:
        raise InputError(f"{where}: has no target; give {kind}:… with a path or name (docs/extending.md)")
    if kind == "python":
        return _FUNCTIONS[stage](load_function(target, stage, where), where)
    path = Path(target).expanduser().absolute()
    if kind == "command":
        return _COMMANDS[stage](read_command_file(path, stage), cancelled)
    if stage != OF_STAGE[kind]:
        raise InputError(f"{where}: {other_stage(kind, stage)}")
    if kind in PROGRAMS:
        return MesherCommand(program_command(kind, path), cancelled)
    if kind == DIFFUSERS:
        from .diffusers_adapter import open_diffusers

        return open_diffusers(path, where)
    if kind in FOLDERS:
        # Imported here: few have torch, and it takes seconds.
        from .transformers_adapter import open_transformers

        return open_transformers(kind, path, where)
    return _FILES[kind](path, where)
