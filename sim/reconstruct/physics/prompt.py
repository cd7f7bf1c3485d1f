# SPDX-License-Identifier: MIT
"""What is asked about the marked photo (the questions of PhysGen3D, supplement A.3; the words are our own)."""

from __future__ import annotations

import re
from collections.abc import Sequence

_OWN_NAME = re.compile(r"object_\d+\Z")

MAX_HINT = 60
"""Characters of a name that are passed on."""

_QUESTIONS = """\
The photo shows {count} marked with a coloured outline and a number. Judge the physics of each one, and of the surface \
on which they stand. Rough figures are fine; always give your best guess.

Write one line for each numbered object, in order, with six entries separated by commas:
number, name, density, stiffness, size, filling

- number: the one written on the photo.
- name: what it is, in one word; join words with an underscore.
- density: kg/m³, a plain number. Mass over volume of the whole object with what is inside; but where you answer no \
for filling, of the matter of its wall.
- stiffness: soft, medium or hard. soft: plush, foam, cloth, anything that a finger squeezes easily. medium: rubber, \
fruit, soft plastic. hard: wood, metal, glass, ceramics, hard plastic. This stands for Young's modulus.
- size: its longest extent in metres in reality, a plain number.
- filling: yes if there is matter throughout its inside, no if it is a thin shell around air.

Then write one last line with a single number from 0 to 1: how rough the supporting surface is, 0 for polished like \
ice, 1 for coarse like sandpaper.

Write nothing else: no heading, no units, no ranges, no thousands separators, no explanation. \
An answer for a photo of two objects looks like this:
1, camera_model, 200, soft, 0.15, yes
2, camera, 2700, hard, 0.20, no
0.2
"""


def prompt(names: Sequence[str | None]) -> str:
    """The question about as many objects as there are ``names``, which mentions those that tell something.

    None, "" and names that we gave ourselves (object_1) tell nothing. Names are cut to one line of ``MAX_HINT``
    characters, so that they stay names.
    """
    count = len(names)
    text = _QUESTIONS.format(count="one object" if count == 1 else f"{count} objects, each")
    hints = [f"{number}: {hint}" for number, name in enumerate(names, start=1) if (hint := _hint(name))]
    if hints:
        text += "\nWhat the photographer calls them (use it to know what they are): " + "; ".join(hints) + "\n"
    return text


def _hint(name: str | None) -> str:
    plain = " ".join("".join(c if c.isalnum() or c in "-_'" else " " for c in name or "").split())
    return "" if _OWN_NAME.match(plain) else plain[:MAX_HINT].strip()
