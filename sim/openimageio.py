# SPDX-License-Identifier: MIT
"""What OpenImageIO says of files that it cannot read or write."""

from __future__ import annotations

from collections.abc import Callable


def last_error(geterror: Callable[[], str]) -> str:
    """The last line of ``geterror()``: OpenEXR says the same in several, and the last says it best.

    geterror: of OpenImageIO itself, or of one of its inputs and outputs. A damaged file's own bytes reach the message,
    and may be no text at all.
    """
    try:
        said = geterror()
    except UnicodeDecodeError:
        return "its header is damaged"
    return (said.strip().splitlines() or ["no reason given"])[-1]
