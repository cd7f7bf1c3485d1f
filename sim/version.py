# SPDX-License-Identifier: MIT
"""The program's version, the same as in ``pyproject.toml`` and ``blender_manifest.toml`` (a test checks)."""

VERSION = "0.1.0"
