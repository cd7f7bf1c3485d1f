# SPDX-License-Identifier: MIT
"""The page and its pictures as files."""

from __future__ import annotations

from pathlib import Path

from ...atomic import write_bytes
from ...page.theme import picture_style
from ..capture import Capture
from ..diagnosis import PAGE_FILE, Diagnosis
from .page import page
from .pictures import draw


def write_report(diagnosis: Diagnosis, capture: Capture, out: Path) -> None:
    """Write ``report.html`` and its pictures into the folder ``out``, which is made where it is missing.

    The page stands alone: style and pictures are inside, nothing is loaded, no script runs. The pictures are also there
    as ``timeline.svg``, ``object.svg``, ``ranking.svg``, ``gap.svg`` and, where there are takes, ``tracks.svg``. The
    same diagnosis gives the same bytes. NaN, empty takes and missing predictions are shown as what is not known.

    Raises InputError, with the way out, when a file cannot be written.
    """
    pictures = draw(diagnosis, capture)
    style = picture_style()
    for name, picture in pictures.files().items():
        write_bytes(out / name, picture.file(style).encode())
    write_bytes(out / PAGE_FILE, page(diagnosis, capture, pictures).encode())
