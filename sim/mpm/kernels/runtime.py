# SPDX-License-Identifier: MIT
"""Taichi's process-wide runtime: started once, reused by every world, with a fall-back to the CPU."""

from __future__ import annotations

import contextlib
import io
import logging
import os
import weakref
from typing import Any

import taichi as ti

from ...errors import InputError
from ...memory import ran_out
from ..solver_options import SolverOptions

logger = logging.getLogger(__name__)

MOST_GROUPS = 2112
"""Groups of threads that a card gets at most in a launch; they take what there is to do in turn. Of Taichi's own 8448
on an H200 most find nothing to do in a small world."""

_GENERATION = 0
_ASKED: tuple[str, int, str] | None = None
_ARCH = "cpu"
_ARRAYS: weakref.WeakSet[ti.Ndarray] = weakref.WeakSet()


def ensure_started(options: SolverOptions) -> tuple[str, int]:
    """Start Taichi for ``options`` unless it already runs that way.

    Returns the architecture in use ("cpu" after a fallback, which is logged) and the generation of the runtime. A
    change of architecture, thread count or cache folder restarts Taichi, which loses the arrays of earlier worlds; a
    world compares its generation before each use.
    """
    global _ASKED, _ARCH
    folder = "" if options.cache_folder is None else str(options.cache_folder)
    wanted = (_available(options.arch), options.threads, folder)
    asked = wanted
    if asked == _ASKED and ti.lang.impl.get_runtime().prog is not None:
        return _ARCH, _GENERATION
    arguments: dict[str, object] = {
        "arch": getattr(ti, wanted[0]),
        "default_fp": ti.f32,
        # It would let the compiler sum in any order, and give the four numbers of a node different ones: then it cannot
        # work on them at once, which took a third of the time of the pass over elastic particles.
        "fast_math": False,
        "offline_cache": True,
        "log_level": ti.ERROR,
        "enable_fallback": False,
        # Of no measurable use to these kernels, and it takes a third to half of the compile time.
        "cfg_optimization": False,
    }
    if wanted[0] == "cuda":
        arguments["saturating_grid_dim"] = MOST_GROUPS
    if wanted[1]:
        arguments["cpu_max_num_threads"] = wanted[1]
    if folder:
        arguments["offline_cache_file_path"] = folder
    try:
        _start(arguments)
    except RuntimeError as error:
        if ran_out(error):
            raise MemoryError(str(error)) from error
        if wanted[0] == "cpu":
            raise InputError(f"solver option cache_folder is {folder!r}: Taichi did not start ({error})") from error
        logger.warning("Taichi could not start on %s (%s); computing on the CPU", wanted[0], error)
        _start({**arguments, "arch": ti.cpu})
        wanted = ("cpu", options.threads, folder)
    _ASKED, _ARCH = asked, wanted[0]
    return wanted[0], _GENERATION


def _start(arguments: dict[str, object]) -> None:
    """``ti.init`` without its line on standard output, which belongs to the caller's own results, and without its
    question for a newer version: once a day it would send its makers this system's kind and an identifier."""
    os.environ["TI_SKIP_VERSION_CHECK"] = "ON"
    _leave_source_lines_out()
    _leave_call_stacks_out()
    _let_go_of_arrays()
    with contextlib.redirect_stdout(io.StringIO()) as output:
        ti.init(**arguments)
    logger.debug("%s", output.getvalue().strip())


def _leave_source_lines_out() -> None:
    """Let Taichi say in which line a node of a kernel stands, without drawing that line.

    It draws it for each of 40 000 nodes at every start, for messages that are hardly ever needed: a quarter of the time
    that kernels from its cache take to get ready. The text is in its messages alone, neither in what is compiled nor in
    the keys of its cache. Nothing of this is a promise of Taichi's: where a version has no such function, or its
    arguments look different, all stays as that version has it.
    """
    try:
        from taichi.lang.ast.ast_transformer_utils import ASTTransformerContext
    except ImportError:
        return
    drawn = getattr(ASTTransformerContext, "get_pos_info", None)
    if drawn is None or getattr(drawn, "leaves_lines_out", False):
        return

    def named(context: Any, node: Any) -> str:
        try:
            line, kernel = node.lineno + context.lineno_offset, context.func.func.__name__
            return f'File "{context.file}", line {line}, in {kernel}:\n'
        except (AttributeError, TypeError):
            return str(drawn(context, node))

    named.leaves_lines_out = True  # type: ignore[attr-defined]
    ASTTransformerContext.get_pos_info = named


def _leave_call_stacks_out() -> None:
    """Let Taichi allocate arrays without formatting the Python call stack of each.

    A world has more than two hundred arrays, and each stack takes a millisecond or two; it is shown when an allocation
    fails, where Python prints the same one. Private, too: a version without this function stays as it is.
    """
    for name in ("_ndarray", "matrix"):
        module = getattr(ti.lang, name, None)
        if module is not None and hasattr(module, "get_traceback"):
            module.get_traceback = _no_stack


def _no_stack(stacklevel: int = 1) -> str:
    return ""


def generation() -> int:
    """Number of times that Taichi was started in this process."""
    return _GENERATION


class FreedArray(ti.Ndarray):  # type: ignore[misc]  # Taichi has no types
    """What an array becomes when Taichi restarts."""

    @property
    def arr(self) -> Any:
        """The memory that it had; raises RuntimeError."""
        raise RuntimeError("this array was freed when Taichi restarted: make a new one")


def new_array(kind: Any, length: int) -> ti.Ndarray:
    """A new array of zeros on the device, whose memory is given back when nothing refers to it any more.

    Taichi (1.7) does that for arrays of numbers alone: those of vectors and matrices, nearly all that a world has, stay
    until it is restarted. Whoever uses an array from before a restart gets RuntimeError.
    """
    array = ti.ndarray(kind, length)
    _ARRAYS.add(array)
    if not hasattr(type(array), "__del__"):
        weakref.finalize(array, _give_back, _GENERATION, array.arr).atexit = False
    return array


def _give_back(made: int, memory: Any) -> None:
    """Let Taichi free ``memory`` of an array that was ``made`` in this generation; a restart has freed all before."""
    program = ti.lang.impl.get_runtime().prog
    if made == _GENERATION and program is not None:
        program.delete_ndarray(memory)


def _let_go_of_arrays() -> None:
    """Turn all arrays into FreedArray before Taichi restarts, which frees their memory.

    Taichi frees an array of numbers when nothing refers to it, also one from before a restart: by an address, at which
    a new array may lie by then. That one was freed in its stead, and the next substep wrote to memory of others.
    """
    global _ASKED, _GENERATION
    for array in _ARRAYS:
        del array.arr
        array.__class__ = FreedArray
    _ARRAYS.clear()
    _ASKED = None
    _GENERATION += 1


def _available(arch: str) -> str:
    """``arch``, or "cpu" with a logged reason where this build or machine has none."""
    if arch == "cpu":
        return arch
    if arch == "metal":
        logger.warning(
            "solver option arch 'metal': has no double precision, which the clock needs; computing on the CPU"
        )
        return "cpu"
    if not ti.lang.misc.is_arch_supported(getattr(ti, arch)):
        logger.warning("solver option arch %r: not available here; computing on the CPU", arch)
        return "cpu"
    return arch
