# SPDX-License-Identifier: MIT
"""The project's error tree, and the text of OpenImageIO's errors.

Every message names the field or file, the value found and the remedy, because it is shown unchanged in a terminal,
in Blender's status bar and in a farm's log.
"""

from __future__ import annotations

from collections.abc import Callable

ANYWAY = "PHYSGEN_ANYWAY"
"""Environment variable, set by ``--anyway`` for a command and the processes that it starts: estimates of memory refuse
nothing."""

OUT_OF_MEMORY = (
    "memory ran out; nothing that was finished is lost: close other programs, choose a coarser quality or a smaller "
    "picture, and run it again"
)


class PhysGenError(Exception):
    """Base of all errors that the user can fix.

    exit_code: of the command line (docs/cli.md).

    >>> import physgen
    >>> try:
    ...     physgen.load_scene("no such folder")
    ... except physgen.PhysGenError as error:
    ...     code = error.exit_code
    >>> code
    3
    """

    exit_code = 3


class InputError(PhysGenError):
    """Unusable input: a photo, box, mask, mesh, scene, bake or option."""

    exit_code = 3


class SimulationError(PhysGenError):
    """The simulation failed before its end."""

    exit_code = 4


class RenderError(PhysGenError):
    """Frames or the video could not be produced."""

    exit_code = 5


class Cancelled(PhysGenError):
    """The job was cancelled by the user or the system; completed results stay usable."""

    exit_code = 130


def openimageio_error(geterror: Callable[[], str]) -> str:
    """Return the last line of ``geterror()``: OpenEXR repeats an error in several lines, the last most precisely.

    geterror: of OpenImageIO itself, or of one of its inputs and outputs. Messages about damaged files may hold bytes of
    the file that are not UTF-8.
    """
    try:
        reason = geterror()
    except UnicodeDecodeError:
        return "its header is damaged"
    return (reason.strip().splitlines() or ["no reason given"])[-1]
