# SPDX-License-Identifier: MIT
"""The one error tree of the project.

Every message names the field or file, the value that was found, and the way out, because it is shown as it
stands on a terminal, in Blender's status bar and in a farm's log.
"""

from __future__ import annotations


class PhysGenError(Exception):
    """Base of all errors that a user can do something about.

    ``exit_code`` is what the command line ends with (docs/cli.md).
    """

    exit_code = 3


class InputError(PhysGenError):
    """A photo, box, mask, mesh, scene, bake or option cannot be used as it is."""

    exit_code = 3


class SimulationError(PhysGenError):
    """The simulation could not be carried to its end."""

    exit_code = 4


class RenderError(PhysGenError):
    """Frames or the video could not be produced."""

    exit_code = 5


class Cancelled(PhysGenError):
    """The user or the system asked the job to stop; what was complete stays usable."""

    exit_code = 130
