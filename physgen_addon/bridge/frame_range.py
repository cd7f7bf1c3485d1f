# SPDX-License-Identifier: GPL-3.0-or-later
"""Frame ranges as people write them. Needs no bpy."""

from __future__ import annotations

import re

from ...sim.errors import InputError


def parse_range(
    text: str | None, first: int, last: int, *, there: str = "baked; bake more or ask for fewer"
) -> list[int]:
    """Frame numbers of ``1-48``, ``1,5,9``, ``1-48x2`` or mixtures; None is ``first`` to ``last``, all there are.

    there: what the frames ``first`` to ``last`` are, and the way out, for the message.
    Raises InputError for anything else, and for frames that are not there.
    """
    if text is None:
        return list(range(first, last + 1))
    numbers: set[int] = set()
    for part in text.split(","):
        match = re.fullmatch(r"\s*(\d+)(?:-(\d+)(?:x(\d+))?)?\s*", part)
        if match is None or match[3] == "0":
            raise InputError(f"frames {text!r}: write 1-48, 1,5,9 or 1-48x2")
        start = int(match[1])
        stop = int(match[2]) if match[2] else start
        if stop < start:
            raise InputError(f"frames {text!r}: {start} comes after {stop}")
        if start < first or stop > last:
            raise InputError(f"frames {text!r}: frames {first} to {last} are {there}")
        numbers.update(range(start, stop + 1, int(match[3] or 1)))
    return sorted(numbers)
