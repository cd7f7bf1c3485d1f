# SPDX-License-Identifier: MIT
"""A user's Python function as a stage: import, signature check, and errors that name the function."""

from __future__ import annotations

import contextlib
import importlib
import importlib.util
import inspect
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError, PhysGenError
from .protocols import Depth, Mask, Pixels, checked_depth, checked_masks, checked_mesh, checked_pixels

PARAMETERS = {
    "segmenter": ("pixels", "boxes"),
    "inpainter": ("pixels", "hole"),
    "depth_estimator": ("pixels",),
    "mesher": ("pixels", "mask", "folder"),
}


def load_function(target: str, stage: str, where: str) -> Callable[..., Any]:
    """Return the function ``MODULE:NAME`` or ``FILE.py:NAME``, whose signature fits ``stage``. Raises InputError."""
    module_name, _, name = target.rpartition(":")
    if not module_name or not name:
        raise InputError(f"{where}: give python:MODULE:FUNCTION or python:FILE.py:FUNCTION")
    module = _from_file(Path(module_name), where) if module_name.endswith(".py") else _imported(module_name, where)
    function: Any = module
    for part in name.split("."):
        function = getattr(function, part, None)
    return checked_function(function, stage, where)


def checked_function(function: Any, stage: str, where: str) -> Callable[..., Any]:
    """Return ``function`` if its signature fits ``stage``. Raises InputError."""
    if not callable(function) or isinstance(function, type):
        raise InputError(f"{where}: there is no such function; check its name")
    expected = PARAMETERS[stage]
    try:
        inspect.signature(function).bind(*expected)
    except TypeError as error:
        raise InputError(f"{where}: cannot be called with ({', '.join(expected)}) as a {stage} is: {error}") from None
    except ValueError:
        # Functions written in C may have no signature.
        pass
    return function


def _imported(name: str, where: str) -> Any:
    try:
        return importlib.import_module(name)
    except KeyboardInterrupt:
        raise
    # A user's module may raise anything, even SystemExit.
    except BaseException as error:
        raise InputError(f"{where}: {name} cannot be imported ({type(error).__name__}: {error})") from error


def _from_file(path: Path, where: str) -> Any:
    if not path.is_file():
        raise InputError(f"{where}: there is no file {path}")
    name = f"physgen_adapter_{path.stem}"
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    # Dataclasses and pickle look up their module.
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    except BaseException as error:
        del sys.modules[name]
        if isinstance(error, KeyboardInterrupt):
            raise
        raise InputError(f"{where}: cannot be run ({type(error).__name__}: {error})") from error
    return module


@dataclass(frozen=True)
class _Function:
    function: Callable[..., Any]
    where: str

    def call(self, *arguments: Any) -> Any:
        """Return the function's result; InputError in place of its own exceptions."""
        try:
            return self.function(*(a.copy() if isinstance(a, np.ndarray) else a for a in arguments))
        except (PhysGenError, KeyboardInterrupt):
            raise
        except BaseException as error:
            raise InputError(f"{self.where}: failed with {type(error).__name__}: {str(error)[:500]}") from error


@dataclass(frozen=True)
class SegmenterFunction(_Function):
    """``protocols.Segmenter`` by a user's function, which may return a list of masks."""

    def __call__(self, pixels: Pixels, boxes: NDArray[np.float64]) -> NDArray[np.bool_]:
        """As the protocol says. Raises InputError."""
        found = self.call(pixels, np.asarray(boxes, dtype=np.float64))
        return checked_masks(found, (pixels.shape[0], pixels.shape[1]), len(boxes), self.where)


@dataclass(frozen=True)
class InpainterFunction(_Function):
    """``protocols.Inpainter`` by a user's function."""

    def __call__(self, pixels: Pixels, hole: Mask) -> Pixels:
        """As the protocol says. Raises InputError."""
        return checked_pixels(self.call(pixels, hole), pixels, hole, self.where)


@dataclass(frozen=True)
class DepthFunction(_Function):
    """``protocols.DepthEstimator`` by a user's function: a Depth, a dict, or an array of relative depth."""

    def __call__(self, pixels: Pixels) -> Depth:
        """As the protocol says. Raises InputError."""
        return checked_depth(self.call(pixels), (pixels.shape[0], pixels.shape[1]), "relative", self.where)


@dataclass(frozen=True)
class MesherFunction(_Function):
    """``protocols.Mesher`` by a user's function."""

    def __call__(self, pixels: Pixels, mask: Mask, folder: Path) -> Path:
        """As the protocol says. Raises InputError."""
        return checked_mesh(self.call(pixels, mask, folder), folder, self.where)


def function_problem(target: str) -> str | None:
    """Return the problem with ``MODULE:NAME`` or ``FILE.py:NAME``, found without running it; None if there is none."""
    module_name, _, name = target.rpartition(":")
    if not module_name or not name:
        return "give python:MODULE:FUNCTION or python:FILE.py:FUNCTION"
    if module_name.endswith(".py"):
        return None if Path(module_name).is_file() else f"there is no file {module_name}"
    with contextlib.suppress(ImportError, ValueError, AttributeError):
        # Of a.b.c only a is looked up: more would import a and a.b.
        if importlib.util.find_spec(module_name.partition(".")[0]) is not None:
            return None
    return f"the module {module_name} is not installed here"
