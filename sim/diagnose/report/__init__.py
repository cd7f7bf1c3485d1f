# SPDX-License-Identifier: MIT
"""The page that a person reads after a diagnosis, and its pictures; plain HTML and SVG, nothing but numpy and Pillow.

``write`` puts the files down, ``page`` lays the page out, one file a picture. ``markup`` escapes everything that is not
markup already, so that names from a capture never become markup.
"""

from .quantities import parameter_text
from .write import write_report

__all__ = ["parameter_text", "write_report"]
