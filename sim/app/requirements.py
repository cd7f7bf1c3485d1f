# SPDX-License-Identifier: MIT
"""Packages that an interpreter needs to simulate, and whether this one has them.

As a module, ``launch.py sim.app.requirements`` prints one line of JSON: ``python`` (its version), ``missing``
(missing requirements), ``trouble`` (why Taichi does not load, or null), ``installs`` (whether pip may install into
it, which Linux distributions and Blender forbid) and ``renders`` (whether it has bpy to render with).
"""

from __future__ import annotations

import importlib
import importlib.util
import json
import sys
import sysconfig
from pathlib import Path

MODULE = "sim.app.requirements"
"""From the tree's root, for ``own_command``."""

REQUIREMENTS = {
    "numpy": "numpy>=1.26",
    "taichi": "taichi>=1.7.4,<1.8",
    "trimesh": "trimesh>=5.0,<6",
    "scipy": "scipy>=1.11",
    "skimage": "scikit-image>=0.24",
    "PIL": "pillow>=12.1.1",
    "patchmatch": "pypatchmatch>=2.0,<3",
    "cv2": "opencv-python-headless>=4.10",
    "OpenImageIO": "openimageio>=3.0",
    "yaml": "pyyaml>=6",
    "jinja2": "jinja2>=3.1.6,<4",
}
"""Module → requirement for pip; the widest range of pyproject.toml."""

RENDERER = "bpy>=4.5,<5.3"
"""Requirement for rendering into a photo, where Blender's own Python cannot."""

OLDEST, NEWEST = (3, 11), (3, 13)
"""Python versions for which all of them have wheels; Taichi 1.7.4 supports up to 3.13."""


def missing() -> list[str]:
    """Return this interpreter's missing requirements, in pip's format."""
    return [wanted for name, wanted in REQUIREMENTS.items() if importlib.util.find_spec(name) is None]


def installs() -> bool:
    """Return whether pip may install into this interpreter (PEP 668)."""
    own = sys.prefix != sys.base_prefix
    return own or not (Path(sysconfig.get_path("stdlib")) / "EXTERNALLY-MANAGED").exists()


def renders() -> bool:
    """Return whether this interpreter has Blender as a module; it is not imported."""
    return importlib.util.find_spec("bpy") is not None


def main() -> None:
    """Print the answer. A Taichi whose libraries do not fit the machine may crash here, which callers handle too."""
    lacking, trouble = missing(), None
    if not lacking:
        try:
            importlib.import_module("taichi")
        except Exception as error:
            trouble = f"Taichi does not load ({type(error).__name__}: {error})"
    version = ".".join(str(number) for number in sys.version_info[:3])
    answer = {"python": version, "missing": lacking, "trouble": trouble, "installs": installs(), "renders": renders()}
    sys.stdout.write(json.dumps(answer) + "\n")


if __name__ == "__main__":
    main()
